"""Fig. 2 of the paper: one period of stick-slip at v_b = .05, .20 and .405, as published (cubic) and exact.

python scripts/figure_2.py                     writes figures/figure_2.csv and figures/figure_2.png
python scripts/figure_2.py --out elsewhere     into another folder
"""

from pathlib import Path

import numpy as np

from scripts.figures import PANELS, metadata, run, select
from sd_friction_env import OscillatorParameters, Table, limit_cycle, simulate
from sd_friction_env.pictures import plotting

BELT_SPEEDS = (0.05, 0.20, 0.405)
SAMPLES = 400


def compute() -> Table:
    """Return one period of each cycle, from breakaway (from the maximum of x in pure slip)."""
    parts = []
    for geometry in PANELS:
        for speed in BELT_SPEEDS:
            cycle = limit_cycle(OscillatorParameters(geometry=geometry, belt_speed=speed))
            history = simulate(
                cycle.parameters, cycle.x_phase0, cycle.v_phase0, cycle.period, dt=cycle.period / SAMPLES
            )
            n = len(history.t)
            parts.append(
                {
                    "geometry": np.full(n, geometry),
                    "belt_speed": np.full(n, speed),
                    "kind": np.full(n, cycle.kind),
                    **history.to_table(),
                }
            )
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Table(columns, metadata(OscillatorParameters(geometry=geometry) for geometry in PANELS))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw displacement, velocity and phase plane: a column for each belt speed, both geometries in each panel."""
    figure, axes = plotting.new_figure(10.5, 8.0, 3, len(BELT_SPEEDS))
    for column, speed in zip(axes.T, BELT_SPEEDS, strict=True):
        for (geometry, title), style in zip(PANELS.items(), plotting.PAIR, strict=True):
            cycle = select(table, geometry=geometry, belt_speed=speed)
            label = f"{title}: {cycle['kind'][0]}"
            column[0].plot(cycle["t"], cycle["x"], label=label, **style)
            column[1].plot(cycle["t"], cycle["v"], **style)
            column[2].plot(cycle["x"], cycle["v"], **style)
        column[0].set_title(f"$v_b = {speed:g}$", loc="left")
        column[0].legend(fontsize=7.5, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.08))
        for axis, x_label, y_label in zip(
            column, (r"time $\tau$", r"time $\tau$", "$x$"), ("$x$", r"$\dot x$", r"$\dot x$"), strict=True
        ):
            axis.set_xlabel(x_label)
            axis.set_ylabel(y_label)
    plotting.save_figure(figure, path)


if __name__ == "__main__":
    raise SystemExit(run("figure_2", __doc__, compute, draw))
