"""Basins of attraction of two oscillators with two attractors each, exact geometry."""

from pathlib import Path

from scripts.figures.common import metadata
from sd_friction_env import OscillatorParameters, Table, basin_grid
from sd_friction_env.pictures import plotting

PLANTS = (OscillatorParameters(alpha=0.2, belt_speed=0.2), OscillatorParameters(alpha=0.5, belt_speed=0.43))
LIMITS = ((-1.5, 1.5), (-1.0, 1.0))
SHAPE = (360, 240)


def compute() -> Table:
    """Return a row for each attractor: its kind, its place and the share of the starts that reach it."""
    rows = []
    for plant in PLANTS:
        _, _, found = basin_grid(plant, *LIMITS, SHAPE)
        for label, cycle in enumerate(found.attractors):
            share, error = found.fraction(label)
            where = {"alpha": plant.alpha, "belt_speed": plant.belt_speed, "kind": cycle.kind}
            size = {"x_min": cycle.x_min, "x_max": cycle.x_max, "amplitude": cycle.amplitude}
            rows.append(where | size | {"fraction": share, "standard_error": error})
    return Table.from_rows(rows, metadata(PLANTS))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw the basins of both oscillators; the grids are computed again, for they are too large to keep."""
    figure, axes = plotting.new_figure(11.0, 4.2, 1, len(PLANTS))
    for axis, plant in zip(axes[0], PLANTS, strict=True):
        plotting.draw_basins(axis, *basin_grid(plant, *LIMITS, SHAPE))
        axis.set_title(rf"$\alpha = {plant.alpha:g}$, $v_b = {plant.belt_speed:g}$", loc="right", fontsize=10)
    plotting.save_figure(figure, path)
