"""Versions of what a result depends on, for its record."""

from types import ModuleType

import numpy as np
import scipy

import sd_friction_env


def versions(*modules: ModuleType) -> dict[str, str]:
    """Return the versions of this package and of ``modules`` (none: NumPy and SciPy), by name."""
    return {module.__name__: str(module.__version__) for module in (sd_friction_env, *(modules or (np, scipy)))}
