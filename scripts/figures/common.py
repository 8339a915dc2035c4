"""What the figures share: the two geometries, the table's header, and how tables are cut."""

import functools
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import sd_friction_env
from sd_friction_env import OscillatorParameters, Table

PANELS = {"cubic": "as published (cubic, Eq. 9)", "exact": "exact (Eq. 4)"}


@functools.cache
def commit() -> str:
    """Return what git calls the working tree, "unknown" outside of a checkout."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def metadata(parameters: Iterable[OscillatorParameters]) -> dict[str, str]:
    """Return a table's header: versions, commit and parameters."""
    header = {"sd_friction_env": sd_friction_env.__version__, "numpy": np.__version__, "commit": commit()}
    return header | {f"parameters {i}": str(p) for i, p in enumerate(parameters, start=1)}


def select(table: Table, **values: Any) -> Table:
    """Return the rows in which each named column has the value given."""
    chosen = np.ones(table.n_rows, dtype=bool)
    for name, value in values.items():
        chosen &= table[name] == value
    return Table({name: column[chosen] for name, column in table.items()}, table.metadata)
