"""Fig. 4 of the paper: amplitude (a) and frequency (b) over belt speed for alpha = .2, .5, .7, .8.

    python scripts/figure_4.py                     writes figures/figure_4.csv and figures/figure_4.png
    python scripts/figure_4.py --out elsewhere     into another folder

The paper gives its frequency no unit: cycles per unit of time fits its axis with the cubic model, radians with the
exact one, so both are drawn.
"""

from pathlib import Path

import numpy as np

from scripts.figures import PANELS, curve_with_edges, metadata, run, select, stack
from sd_friction_env import OscillatorParameters, Table
from sd_friction_env.pictures import plotting

ALPHAS = (0.2, 0.5, 0.7, 0.8)
BELT_SPEEDS = np.linspace(0.0, 0.6, 121)
ROWS = {
    "amplitude": r"amplitude $A$",
    "frequency": r"frequency, cycles per unit of time",
    "angular_frequency": r"frequency, radians per unit of time",
}


def compute() -> Table:
    """Return all curves in one table, each of the right-hand well."""
    plants = [OscillatorParameters(geometry=geometry, alpha=alpha) for geometry in PANELS for alpha in ALPHAS]
    curves = (curve_with_edges(plant, BELT_SPEEDS, geometry=plant.geometry, alpha=plant.alpha) for plant in plants)
    return stack(curves, metadata(plants))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw a row for each quantity and a column for each geometry."""
    figure, axes = plotting.new_figure(10.5, 10.5, len(ROWS), len(PANELS), sharex=True, sharey="row")
    for column, (geometry, title) in zip(axes.T, PANELS.items(), strict=True):
        for axis, quantity in zip(column, ROWS, strict=True):
            for alpha, style in zip(ALPHAS, plotting.FAMILY, strict=True):
                curve = select(table, geometry=geometry, alpha=alpha)
                plotting.draw_family_member(axis, curve, quantity, rf"$\alpha = {alpha:g}$", style)
        column[0].set_title(title, fontsize=10, loc="left")
        column[0].legend(fontsize=8, frameon=False, loc="upper right")
        column[-1].set_xlabel(r"belt speed $v_b$")
        column[-1].set_xlim(0.0, 0.6)
    for row, label in zip(axes, ROWS.values(), strict=True):
        row[0].set_ylabel(label)
        row[0].set_ylim(bottom=0.0)
    plotting.save_figure(figure, path)


if __name__ == "__main__":
    raise SystemExit(run("figure_4", __doc__, compute, draw))
