"""Training, evaluation and optimal control of the environments in :mod:`sd_friction_env` (not part of the wheel)."""
