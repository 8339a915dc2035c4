"""``python -m sd_friction_env`` is the program that is also installed as ``sd-friction``."""

from sd_friction_env.cli.main import main

raise SystemExit(main())
