"""Stick-slip chaos of the forced SD belt, and its basins (our own parameters, exact geometry)."""

from pathlib import Path

import numpy as np

from scripts.figures.common import metadata
from sd_friction_env import OscillatorParameters, Table, simulate
from sd_friction_env.physics.forced import (
    bifurcation_diagram,
    drive_period,
    forced_basins,
    lyapunov_exponent,
    poincare_section,
)
from sd_friction_env.pictures import plotting

PLANT = OscillatorParameters(alpha=0.6, belt_speed=0.2, force_amplitude=0.28, force_frequency=1.2)
ON_THE_CHAOS = (1.15, 0.2)  # a start that stays on it
SWEEP = ("force_amplitude", np.linspace(0.02, 0.45, 345))
LIMITS = ((-1.6, 1.6), (-1.2, 1.2))
SHAPE = (200, 150)


def compute() -> Table:
    """Return a row for each value and direction of the sweep: the exponent, the share of stick, the section's ends."""
    diagram = bifurcation_diagram(PLANT, *SWEEP, direction="both", cycles=300, transient=200, lyapunov=True)
    rows = []
    for way in ("up", "down"):
        for value in SWEEP[1]:
            part = (diagram["direction"] == way) & (diagram["value"] == value)
            row = {"value": value, "direction": way}
            row |= {name: diagram[name][part][0] for name in ("exponent", "standard_error")}
            row |= {"stick_fraction": diagram["stick_fraction"][part].mean()}
            rows.append(row | {"least_x": diagram["x"][part].min(), "greatest_x": diagram["x"][part].max()})
    chaos = lyapunov_exponent(PLANT, *ON_THE_CHAOS, cycles=20_000)
    exponent = {"exponent at parameters 1": f"{chaos.largest:.5f}, standard error {chaos.standard_error:.5f}"}
    return Table.from_rows(rows, metadata([PLANT]) | exponent)


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw the sweep, and section, portrait and basins at one value; their points are computed again, for they are too
    many to keep."""
    period = drive_period(PLANT)
    figure, axes = plotting.new_figure(11.0, 7.4, 2, 2)
    (top, section), (bottom, portrait) = axes
    plotting.draw_bifurcation(top, bifurcation_diagram(PLANT, *SWEEP, direction="both", cycles=100, transient=200))
    plotting.draw_exponents(bottom, table)
    for axis in (top, bottom):
        axis.axvline(PLANT.force_amplitude, color="0.45", linewidth=0.9, linestyle=(0, (6, 3)))
        axis.set_xlabel("force amplitude $f$")
        axis.set_xlim(table["value"].min(), table["value"].max())
    plotting.draw_section(section, poincare_section(PLANT, *ON_THE_CHAOS, cycles=6000))
    section.set_title(f"$f = {PLANT.force_amplitude:g}$, section at $t = 0$ mod {period:.4f}", loc="left", fontsize=10)
    history = simulate(PLANT, *ON_THE_CHAOS, t_end=230.0 * period, dt=0.01)
    late = history.t > 200.0 * period
    x, v, stuck = history.x[late], history.v[late], history.mode[late] == 0
    plotting.draw_portrait(portrait, x, v, stuck, linewidth=0.7)
    portrait.set_title("30 cycles of the force", loc="left", fontsize=10)
    portrait.legend(fontsize=8, frameon=False)
    plotting.save_figure(figure, path, dpi=110)

    figure, axes = plotting.new_figure(7.0, 5.0, 1, 1)
    plotting.draw_forced_basins(axes[0, 0], forced_basins(PLANT, *LIMITS, SHAPE, cycles=150))
    plotting.save_figure(figure, path.with_name("forced_basins.png"))
