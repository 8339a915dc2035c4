"""Figs. 2 to 5 of the paper, as published (cubic) and exact, and the closed forms of the linear belt."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scripts.figures.common import PANELS, metadata, select
from sd_friction_env import OscillatorParameters, Table, limit_cycle, simulate
from sd_friction_env.physics import theory
from sd_friction_env.physics.curves import refined_curve
from sd_friction_env.physics.orbits import rest_place
from sd_friction_env.pictures import plotting

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SAMPLES = 400
CYCLE_SPEEDS = (0.05, 0.20, 0.405)
ALPHAS = (0.2, 0.5, 0.7, 0.8)
RATIOS = (0.085, 0.12, 0.18, 0.25)
# The paper gives its frequency no unit: cycles per unit of time fits its axis with the cubic model, radians with the
# exact one, so both are drawn.
QUANTITIES = {
    "amplitude": r"amplitude $A$",
    "frequency": r"frequency, cycles per unit of time",
    "angular_frequency": r"frequency, radians per unit of time",
}
LINEAR = OscillatorParameters(geometry="linear")
# Small and solid over large and hollow, so that neither hides the other.
_CONTROLLED = (
    {"marker": "o", "markersize": 4.0, "color": plotting.GREEN, "zorder": 4},
    {
        "marker": "s",
        "markersize": 8.5,
        "color": plotting.GREEN,
        "markerfacecolor": "none",
        "markeredgewidth": 1.5,
        "zorder": 3,
    },
    {"marker": "^", "markersize": 11.0, "color": plotting.GREEN, "markerfacecolor": "none", "zorder": 3},
)


@plotting.house_style()
def _draw_controlled_points(axis: "Axes", series: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> None:
    """Lay closed-loop amplitudes over a passive curve: (belt speeds, amplitudes) by name."""
    for style, (name, (speeds, amplitudes)) in zip(_CONTROLLED, series.items(), strict=False):
        axis.plot(speeds, amplitudes, linestyle="none", label=name, **style)  # type: ignore[arg-type]


def plant(geometry: str, ratio: float) -> OscillatorParameters:
    """Return the oscillator with (mu_s - mu_m)/v_m = ratio, by its mu_m."""
    nominal = OscillatorParameters()
    return nominal.replace(geometry=geometry, mu_m=nominal.mu_s - ratio * nominal.v_m)


def curve(parameters: OscillatorParameters, end: float, **labels: Any) -> Table:
    """Return the amplitude curve up to a belt speed, every 0.005, with labels as columns.

    The mass starts at the spring's right-hand place of rest: alpha < 1 has two wells, and from x = 0, between them, the
    cubic oscillator with alpha = 0.2 loses contact at the highest belt speeds.
    """
    found = refined_curve(parameters, np.linspace(0.0, end, round(200 * end) + 1), x=rest_place(parameters), v=0.0)
    return found.labelled(**labels)


def compute_2() -> Table:
    """Return one period of each cycle, from breakaway (from the maximum of x in pure slip)."""
    parts = []
    for geometry in PANELS:
        for speed in CYCLE_SPEEDS:
            cycle = limit_cycle(OscillatorParameters(geometry=geometry, belt_speed=speed))
            start = cycle.parameters, cycle.x_phase0, cycle.v_phase0
            history = simulate(*start, cycle.period, dt=cycle.period / SAMPLES).to_table()
            parts.append(history.labelled(geometry=geometry, belt_speed=speed, kind=cycle.kind))
    return Table.stacked(parts, metadata(OscillatorParameters(geometry=geometry) for geometry in PANELS))


def compute_3() -> Table:
    """Return the curve of each geometry."""
    plants = [OscillatorParameters(geometry=geometry) for geometry in PANELS]
    return Table.stacked((curve(p, 0.6, geometry=p.geometry) for p in plants), metadata(plants))


def compute_4() -> Table:
    """Return the curve of each geometry and alpha, of the right-hand well."""
    plants = [OscillatorParameters(geometry=geometry, alpha=alpha) for geometry in PANELS for alpha in ALPHAS]
    return Table.stacked((curve(p, 0.6, geometry=p.geometry, alpha=p.alpha) for p in plants), metadata(plants))


def compute_5() -> Table:
    """Return the curve of each geometry and ratio."""
    plants = {(geometry, ratio): plant(geometry, ratio) for geometry in PANELS for ratio in RATIOS}
    curves = (curve(p, 0.45, geometry=geometry, ratio=ratio) for (geometry, ratio), p in plants.items())
    return Table.stacked(curves, metadata(plants.values()))


def compute_linear() -> Table:
    """Return the curve with columns for x_max over the equilibrium, A+ (stick-slip) and A1 (pure slip)."""
    p, found = LINEAR, curve(LINEAR, 0.6)
    speeds = found["belt_speed"]
    v_b1 = theory.linear_hopf_belt_speed(p.mu_s, p.mu_m, p.v_m, p.beta, p.g1)
    upper = found["x_max"] - theory.steady_friction(speeds, p.mu_s, p.k1, p.k3) * p.g1
    first = np.where(speeds < v_b1, theory.pure_slip_amplitude(np.minimum(speeds, v_b1), v_b1), np.nan)
    closed = {"upper": upper, "closed_upper": theory.stick_slip_upper_amplitude(speeds, p.beta, p.k1, p.k3, p.g1)}
    return Table(dict(found) | closed | {"closed_pure_slip": first}, metadata([p]))


@plotting.house_style()
def draw_2(table: Table, path: Path) -> None:
    """Draw displacement, velocity and phase plane: a column for each belt speed, both geometries in each panel."""
    figure, axes = plotting.new_figure(10.5, 8.0, 3, len(CYCLE_SPEEDS))
    names = (r"time $\tau$", "$x$"), (r"time $\tau$", r"$\dot x$"), ("$x$", r"$\dot x$")
    for column, speed in zip(axes.T, CYCLE_SPEEDS, strict=True):
        for (geometry, title), style in zip(PANELS.items(), plotting.PAIR, strict=True):
            cycle = select(table, geometry=geometry, belt_speed=speed)
            for axis, (x, y) in zip(column, (("t", "x"), ("t", "v"), ("x", "v")), strict=True):
                axis.plot(cycle[x], cycle[y], label=f"{title}: {cycle['kind'][0]}", **style)
        column[0].set_title(f"$v_b = {speed:g}$", loc="left")
        column[0].legend(fontsize=7.5, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.08))
        for axis, (x, y) in zip(column, names, strict=True):
            axis.set(xlabel=x, ylabel=y)
    plotting.save_figure(figure, path)


@plotting.house_style()
def draw_3(
    table: Table,
    path: Path,
    controlled: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]] | None = None,
    trained: float | None = None,
) -> None:
    """Draw amplitude over belt speed, with v_b0 and v_b1.

    Args:
        table: of ``compute_3``. path: of the picture.
        controlled: maps a geometry to closed-loop points (belt speeds, amplitudes) by name.
        trained: the belt speed at which the controllers were trained; marked where there are points.
    """
    figure, axes = plotting.new_figure(10.5, 4.2, 1, len(PANELS), sharey=True)
    for axis, (geometry, title) in zip(axes[0], PANELS.items(), strict=True):
        found = select(table, geometry=geometry)
        plotting.draw_amplitude_curve(axis, found)
        plotting.mark_critical_speeds(axis, found["v_b0"][0], found["v_b1"][0])
        points = (controlled or {}).get(geometry, {})
        _draw_controlled_points(axis, points)
        if points and trained is not None:
            label = f"trained at $v_b = {trained:g}$"
            axis.axvline(trained, color=plotting.GREEN, linewidth=1.2, linestyle=":", label=label)
        axis.set(xlim=(0.0, 0.6), ylim=(-0.012, 0.6), xlabel=r"belt speed $v_b$")
        axis.set_title(title, fontsize=10, loc="left")
        axis.legend(loc="upper left", fontsize=8, frameon=False)
    axes[0, 0].set_ylabel(r"amplitude $A = (x_{max} - x_{min})/2$")
    plotting.save_figure(figure, path)


@plotting.house_style()
def draw_4(table: Table, path: Path) -> None:
    """Draw a row for each quantity and a column for each geometry."""
    figure, axes = plotting.new_figure(10.5, 10.5, len(QUANTITIES), len(PANELS), sharex=True, sharey="row")
    for column, (geometry, title) in zip(axes.T, PANELS.items(), strict=True):
        for axis, quantity in zip(column, QUANTITIES, strict=True):
            for alpha, style in zip(ALPHAS, plotting.FAMILY, strict=True):
                found = select(table, geometry=geometry, alpha=alpha)
                plotting.draw_family_member(axis, found, quantity, rf"$\alpha = {alpha:g}$", style)
        column[0].set_title(title, fontsize=10, loc="left")
        column[0].legend(fontsize=8, frameon=False, loc="upper right")
        column[-1].set(xlabel=r"belt speed $v_b$", xlim=(0.0, 0.6))
    for row, label in zip(axes, QUANTITIES.values(), strict=True):
        row[0].set_ylabel(label)
        row[0].set_ylim(bottom=0.0)
    plotting.save_figure(figure, path)


@plotting.house_style()
def draw_5(table: Table, path: Path) -> None:
    """Draw a panel for each geometry."""
    figure, axes = plotting.new_figure(10.5, 4.2, 1, len(PANELS), sharey=True)
    for axis, (geometry, title) in zip(axes[0], PANELS.items(), strict=True):
        for ratio, style in zip(RATIOS, plotting.FAMILY, strict=True):
            found = select(table, geometry=geometry, ratio=ratio)
            plotting.draw_family_member(axis, found, "amplitude", rf"$(\mu_s - \mu_m)/v_m = {ratio:g}$", style)
        axis.set(xlim=(0.0, 0.45), ylim=(0.0, 0.52), xlabel=r"belt speed $v_b$")
        axis.set_title(title, fontsize=10, loc="left")
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    axes[0, 0].set_ylabel(r"amplitude $A$ (solid: stick-slip; dashed: pure slip)")
    plotting.save_figure(figure, path)


@plotting.house_style()
def draw_linear(table: Table, path: Path) -> None:
    """Draw the upper half-amplitude of stick-slip and the amplitude of pure slip, each with its closed form."""
    figure, axes = plotting.new_figure(10.5, 4.0, 1, 2)
    panels = (
        ("stick-slip", "upper", "closed_upper", "stick-slip: $A_+ = x_{max} - \\bar x$"),
        ("pure-slip", "amplitude", "closed_pure_slip", "pure slip: $A_1$"),
    )
    for axis, (kind, value, form, name) in zip(axes[0], panels, strict=True):
        part = select(table, kind=kind)
        axis.plot(part["belt_speed"], part[value], label="orbits", **plotting.PAIR[0])
        axis.plot(part["belt_speed"], part[form], label="closed form", **plotting.PAIR[1])
        axis.set_title(name, loc="left", fontsize=10)
        axis.set_xlabel(r"belt speed $v_b$")
        axis.legend(fontsize=8, frameon=False)
    axes[0, 0].set_ylabel("amplitude")
    plotting.save_figure(figure, path)
