"""Fig. 5 of the paper: amplitude over belt speed for (mu_s - mu_m)/v_m = .085, .12, .18, .25.

python scripts/figure_5.py                     writes figures/figure_5.csv and figures/figure_5.png
python scripts/figure_5.py --out elsewhere     into another folder
"""

from pathlib import Path

import numpy as np

from scripts.figures import PANELS, curve_with_edges, metadata, run, select, stack
from sd_friction_env import OscillatorParameters, Table
from sd_friction_env.pictures import plotting

RATIOS = (0.085, 0.12, 0.18, 0.25)
BELT_SPEEDS = np.linspace(0.0, 0.45, 91)


def plant(geometry: str, ratio: float) -> OscillatorParameters:
    """Return the oscillator with (mu_s - mu_m)/v_m = ratio, by its mu_m."""
    nominal = OscillatorParameters()
    return nominal.replace(geometry=geometry, mu_m=nominal.mu_s - ratio * nominal.v_m)


def compute() -> Table:
    """Return all curves in one table."""
    plants = {(geometry, ratio): plant(geometry, ratio) for geometry in PANELS for ratio in RATIOS}
    curves = (
        curve_with_edges(p, BELT_SPEEDS, geometry=geometry, ratio=ratio) for (geometry, ratio), p in plants.items()
    )
    return stack(curves, metadata(plants.values()))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw a panel for each geometry."""
    figure, axes = plotting.new_figure(10.5, 4.2, 1, len(PANELS), sharey=True)
    for axis, (geometry, title) in zip(axes[0], PANELS.items(), strict=True):
        for ratio, style in zip(RATIOS, plotting.FAMILY, strict=True):
            curve = select(table, geometry=geometry, ratio=ratio)
            plotting.draw_family_member(axis, curve, "amplitude", rf"$(\mu_s - \mu_m)/v_m = {ratio:g}$", style)
        axis.set_xlim(0.0, 0.45)
        axis.set_ylim(0.0, 0.52)
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel(r"belt speed $v_b$")
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    axes[0, 0].set_ylabel(r"amplitude $A$ (solid: stick-slip; dashed: pure slip)")
    plotting.save_figure(figure, path)


if __name__ == "__main__":
    raise SystemExit(run("figure_5", __doc__, compute, draw))
