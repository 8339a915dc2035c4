"""Versions of what a result depends on, for its record."""

from types import ModuleType

import sd_friction_env


def versions(*modules: ModuleType) -> dict[str, str]:
    """Return the versions of this package and of other modules by name."""
    return {module.__name__: str(module.__version__) for module in (sd_friction_env, *modules)}
