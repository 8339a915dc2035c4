"""The command ``sd-friction``."""
