"""Fig. 3 of the paper: amplitude over belt speed, with v_b0 and v_b1, as published (cubic) and exact.

python scripts/figure_3.py                     writes figures/figure_3.csv and figures/figure_3.png
python scripts/figure_3.py --out elsewhere     into another folder
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from scripts.figures import PANELS, curve_with_edges, metadata, run, select, stack
from sd_friction_env import OscillatorParameters, Table
from sd_friction_env.pictures import plotting

BELT_SPEEDS = np.linspace(0.0, 0.6, 121)


def compute() -> Table:
    """Return both curves in one table."""
    plants = [OscillatorParameters(geometry=geometry) for geometry in PANELS]
    return stack((curve_with_edges(plant, BELT_SPEEDS, geometry=plant.geometry) for plant in plants), metadata(plants))


@plotting.house_style()
def draw(
    table: Table,
    path: Path,
    controlled: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]] | None = None,
) -> None:
    """Draw the table; ``controlled`` maps a geometry to closed-loop points (belt speeds, amplitudes) by name."""
    figure, axes = plotting.new_figure(10.5, 4.2, 1, len(PANELS), sharey=True)
    for axis, (geometry, title) in zip(axes[0], PANELS.items(), strict=True):
        curve = select(table, geometry=geometry)
        plotting.draw_amplitude_curve(axis, curve)
        axis.set_xlim(0.0, 0.6)
        axis.set_ylim(-0.012, 0.6)
        plotting.mark_critical_speeds(axis, curve["v_b0"][0], curve["v_b1"][0])
        plotting.draw_controlled_points(axis, (controlled or {}).get(geometry, {}))
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel(r"belt speed $v_b$")
        axis.legend(loc="upper left", fontsize=8, frameon=False)
    axes[0, 0].set_ylabel(r"amplitude $A = (x_{max} - x_{min})/2$")
    plotting.save_figure(figure, path)


if __name__ == "__main__":
    raise SystemExit(run("figure_3", __doc__, compute, draw))
