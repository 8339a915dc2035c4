"""What the figure scripts share: the two geometries, the table's header, and computing apart from drawing."""

import argparse
import functools
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import sd_friction_env
from sd_friction_env import OscillatorParameters, Table, amplitude_curve, critical_belt_speeds
from sd_friction_env.physics.orbits import rest_place

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


def stack(tables: Iterable[Mapping[str, Any]], header: Mapping[str, str]) -> Table:
    """Return tables of the same columns one below the other."""
    parts = list(tables)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, header)


def curve_with_edges(parameters: OscillatorParameters, belt_speeds: Any, **labels: Any) -> dict[str, Any]:
    """Return an amplitude curve with more points between v_b0 and v_b1, where it is steep, and labels as columns.

    The mass starts at the spring's right-hand place of rest: alpha < 1 has two wells, and from x = 0, between them, the
    cubic oscillator with alpha = .2 loses contact at the highest belt speeds.
    """
    v_b0, v_b1 = critical_belt_speeds(parameters)
    edge = v_b1 - (v_b1 - v_b0) * np.linspace(0.0, 1.0, 25) ** 2
    speeds = np.unique(np.concatenate((belt_speeds, edge - 1e-9, [v_b0 + 1e-9, v_b1 + 1e-9])))
    curve = amplitude_curve(parameters, speeds, x=rest_place(parameters), v=0.0)
    labels |= {"v_b0": v_b0, "v_b1": v_b1}
    return {name: np.full(curve.n_rows, value) for name, value in labels.items()} | dict(curve)


def run(name: str, doc: str | None, compute: Callable[[], Table], draw: Callable[[Table, Path], None]) -> int:
    """Compute, write the table, and draw what was written; return the exit status."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for both files (default: figures)")
    options = parser.parse_args()
    table, picture = options.out / f"{name}.csv", options.out / f"{name}.png"
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        compute().to_csv(table)
        draw(Table.from_csv(table), picture)
    except OSError as error:
        print(f"{name}: cannot write into --out {str(options.out)!r}: {error}", file=sys.stderr)
        return 1
    print(f"wrote {table} and {picture}")
    return 0
