"""Figures drawn from tables and histories, readable in grey; needs matplotlib (extra "plot")."""

import contextlib
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.extras import extra
from sd_friction_env.physics.basins import Basins
from sd_friction_env.physics.charts import filled_regions
from sd_friction_env.physics.forced import ForcedBasins
from sd_friction_env.physics.orbits import LimitCycle
from sd_friction_env.physics.simulation import Trajectory
from sd_friction_env.physics.tables import Table
from sd_friction_env.storage import atomic_file, checked_ending

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, one meaning each: blue sticks, vermilion slips, green is controlled, grey is passive. The
# others have no fixed meaning. Lines differ in dash or weight too, so that grey prints tell them apart.
BLUE, VERMILION, GREEN, GREY, BLACK = "#0072B2", "#D55E00", "#009E73", "#8A8A8A", "#202020"
SKY, ORANGE, PURPLE = "#56B4E9", "#E69F00", "#CC79A7"
BRANCHES = {
    "stick-slip": {"color": BLUE, "linestyle": "-", "linewidth": 2.2, "label": r"stick-slip, $A_0$"},
    "pure-slip": {"color": VERMILION, "linestyle": (0, (4, 1.2)), "linewidth": 2.2, "label": r"pure slip, $A_1$"},
    "steady-slip": {"color": GREY, "linestyle": ":", "linewidth": 1.8, "label": "steady slip"},
    "neutral": {"color": PURPLE, "linestyle": "-.", "linewidth": 1.8, "label": "neutral, as started"},
}
PAIR = ({"color": BLACK, "linewidth": 2.0}, {"color": ORANGE, "linewidth": 1.8, "linestyle": (0, (4, 1.2))})
# A family of curves: colours of falling lightness, a marker each.
FAMILY = (
    {"color": SKY, "marker": "o"},
    {"color": ORANGE, "marker": "s"},
    {"color": PURPLE, "marker": "^"},
    {"color": BLACK, "marker": "D"},
)
LINES = {"stick-slip": "-", "pure-slip": (0, (3, 1)), "steady-slip": (0, (1, 1.5))}  # of a family's members
WAYS = {"up": ORANGE, "down": BLACK}
REGIONS = {
    "stick-slip": "#A6CEE3",
    "pure slip": "#FDD9B5",
    "bistable": "#DDC7E8",
    "neutral": "#B9E3C6",
    "steady slip": "#F5F5F5",
    "none": "#BBBBBB",
}
BORDERS = {
    "v_b0": {"color": BLUE, "linestyle": "-", "label": "$v_{b0}$: stick ends (grazing)"},
    "v_b1": {"color": VERMILION, "linestyle": (0, (4, 1.2)), "label": "$v_{b1}$: steady slip unstable (Hopf)"},
    "fold": {"color": BLACK, "linestyle": (0, (1, 1)), "label": "fold of pure-slip cycles"},
}
CHART_MARKERS = {"turn": "s", "Bautin": "D", "grazing fold": "^", "meeting": "o"}
BRANCH_MARKERS = {
    "fold": "s",
    "branch point": "P",
    "flip": "D",
    "Neimark-Sacker": "*",
    "grazing-sliding": "^",
    "crossing-sliding": "v",
    "switching-sliding": "<",
    "adding-sliding": ">",
    "grazing": "o",
}
LABELS = {
    "alpha": r"anchor height $\alpha$",
    "g1": "weight $g_1$",
    "beta": r"damping ratio $\beta$",
    "mu_s": r"static friction $\mu_s$",
    "mu_m": r"least kinetic friction $\mu_m$",
    "v_m": "speed of least friction $v_m$",
    "belt_speed": "belt speed $v_b$",
    "mu_k": r"kinetic friction $\mu_k$",
    "mu_v": r"viscous friction $\mu_v$",
    "v_0": "decay speed of friction $v_0$",
    "delta": r"friction decay $\delta$",
    "kappa": r"cubic stiffness $\kappa$",
    "force_amplitude": "force amplitude $f$",
    "force_frequency": r"force frequency $\Omega$",
}

FORMATS = (".png", ".svg", ".pdf")


@contextlib.contextmanager
def house_style() -> Iterator[None]:
    """Draw in matplotlib's own style within the block, or the function that this decorates.

    What the user's matplotlibrc asks for may not be there: LaTeX, a font. What else draws into our figures does so in
    this style too.

    Raises:
        ImportError: if matplotlib is not installed.
    """
    with extra("plot"):
        import matplotlib
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams["svg.hashsalt"] = "sd_friction_env"  # the names in an .svg do not change from run to run
        yield


@house_style()
def new_figure(width: float, height: float, rows: int, columns: int, **arguments: Any) -> tuple["Figure", Any]:
    """Return a figure (inches) and its axes, an array of shape (rows, columns), without touching a display.

    Raises:
        ImportError: if matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **arguments)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="0.92", linewidth=0.8)
        axis.set_axisbelow(True)
    return figure, axes


@house_style()
def save_figure(figure: "Figure", path: str | os.PathLike[str], dpi: int = 150) -> None:
    """Write a figure, whole or not at all, with nothing in the file that changes from run to run.

    Raises:
        ValueError: if the name ends in none of ``FORMATS``. OSError: if the file cannot be written.
    """
    ending = checked_ending(path, FORMATS, "a figure's path")
    with atomic_file(path, "wb") as file:
        if ending == ".png":
            from PIL import Image

            figure.savefig(drawn := io.BytesIO(), format="png", dpi=dpi)
            # A palette of 256 colours: a third of the size, and no difference to the eye.
            picture = Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE)
            picture.save(file, "PNG", optimize=True, dpi=(dpi, dpi))
        else:
            figure.savefig(file, format=ending[1:], metadata={{".svg": "Date", ".pdf": "CreationDate"}[ending]: None})


def label_of(name: str) -> str:
    """Return the name of an axis for a parameter: its meaning and its symbol."""
    return LABELS.get(name, name.replace("_", " "))


def _symbol_of(name: str) -> str:
    """Return a parameter's symbol, its name where it has none."""
    return f"${LABELS[name].split('$')[1]}$" if name in LABELS else name


def _shown(curve: Table, kind: str, column: str) -> NDArray[np.float64]:
    """Return a column where the motion is of a kind, else NaN; stick-slip begins with the rest on a belt at rest."""
    chosen = curve["kind"] == kind
    if kind == "stick-slip":
        chosen = chosen | ((curve["kind"] == "rest") & (curve["belt_speed"] == 0.0))
    return np.where(chosen, curve[column], np.nan)


@house_style()
def draw_amplitude_curve(axis: "Axes", curve: Table, column: str = "amplitude") -> None:
    """Draw one curve over the belt speed, a line for each kind of motion."""
    for kind, style in BRANCHES.items():
        shown = _shown(curve, kind, column)
        if np.isfinite(shown).any():
            axis.plot(curve["belt_speed"], shown, **style)  # type: ignore[arg-type]


@house_style()
def draw_family_member(axis: "Axes", curve: Table, column: str, label: str, style: Mapping[str, str]) -> None:
    """Draw one curve of several: solid in stick-slip, dashed in pure slip, dotted in steady slip, with a few markers
    to tell it in grey."""
    for kind, line in LINES.items():
        first: dict[str, Any] = {"label": label, "markevery": (4, 16), "marker": style["marker"], "markersize": 4.5}
        extra = first if kind == "stick-slip" else {}
        shown = _shown(curve, kind, column)
        axis.plot(curve["belt_speed"], shown, color=style["color"], linestyle=line, linewidth=1.8, **extra)


@house_style()
def mark_critical_speeds(axis: "Axes", v_b0: float, v_b1: float) -> None:
    """Mark v_b0 and v_b1; their values stand above the axes, to the left and right of the pair."""
    marks = ((v_b0, "right", rf"$v_{{b0}} = {v_b0:.4f}$"), (v_b1, "left", rf"$v_{{b1}} = {v_b1:.4f}$"))
    for speed, side, label in marks:
        if np.isfinite(speed):
            axis.axvline(speed, color="0.45", linewidth=0.9, linestyle=(0, (6, 3)))
            above = axis.get_xaxis_transform()
            axis.text(speed, 1.01, label, transform=above, va="bottom", ha=side, fontsize=8, color="0.3")


@house_style()
def draw_amplitude_table(table: Table, members: Sequence[Mapping[str, Any]]) -> "Figure":
    """Draw the curves of a sweep: one by its branches, several as a family, attractors as points.

    Args:
        table: of :func:`curves.refined_curve` (or :func:`curves.attractor_curves`), with a column for each swept
            parameter.
        members: the swept parameters of each curve, by name.
    """
    figure, axes = new_figure(6.4, 4.4, 1, 1)
    axis = axes[0, 0]
    for i, member in enumerate(members):
        chosen = np.ones(table.n_rows, dtype=bool)
        for name, value in member.items():
            chosen &= table[name] == value
        curve = Table({name: column[chosen] for name, column in table.items()})
        label = ", ".join(f"{_symbol_of(name)} = {value}" for name, value in member.items())
        if "well" in table:
            for well, marker in (("left", "<"), ("right", ">"), ("only", "o"), ("both", "D")):
                part = curve["well"] == well
                if part.any():
                    style = {"marker": marker, "markersize": 3.5, "linestyle": "none", "color": FAMILY[i % 4]["color"]}
                    name = f"{label} {well} well" if well in ("left", "right") else label or "attractor"
                    axis.plot(curve["belt_speed"][part], curve["amplitude"][part], label=name, **style)
        elif len(members) == 1:
            draw_amplitude_curve(axis, curve)
            low, high = curve["belt_speed"].min(), curve["belt_speed"].max()
            speeds = (curve["v_b0"][0], curve["v_b1"][0])
            mark_critical_speeds(axis, *(speed if low <= speed <= high else np.nan for speed in speeds))
        else:
            draw_family_member(axis, curve, "amplitude", label, FAMILY[i % len(FAMILY)])
    axis.set(xlabel=r"belt speed $v_b$", ylabel=r"amplitude $A$")
    if len(members) > 1 and "well" not in table:
        axis.set_title("solid: stick-slip; dashed: pure slip; dotted: steady slip", fontsize=8, loc="left")
    axis.set_ylim(bottom=-0.02 * axis.get_ylim()[1])  # steady slip lies on zero
    if len(members) <= 12:
        axis.legend(fontsize=8, frameon=False)
    return figure


@house_style()
def draw_history(history: Trajectory) -> "Figure":
    """Draw displacement, velocity and phase portrait of one history, stick phases marked."""
    figure, axes = new_figure(11.0, 3.2, 1, 3, width_ratios=(2.2, 2.2, 1.6))
    stuck = history.mode == 0
    for axis, values, label in ((axes[0, 0], history.x, "$x$"), (axes[0, 1], history.v, r"$\dot x$")):
        axis.plot(history.t, values, color=VERMILION, linewidth=1.4, label="slip")
        axis.plot(history.t, np.where(stuck, values, np.nan), color=BLUE, linewidth=2.6, label="stick")
        axis.set(xlabel=r"time $\tau$", ylabel=label)
        axis.margins(x=0)
    draw_portrait(axes[0, 2], history.x, history.v, stuck)
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


@house_style()
def draw_portrait(
    axis: "Axes", x: NDArray[np.float64], v: NDArray[np.float64], stuck: NDArray[np.bool_], linewidth: float = 1.2
) -> None:
    """Draw a phase portrait, its stick phases marked."""
    axis.plot(x, v, color=VERMILION, linewidth=linewidth, label="slip")
    axis.plot(np.where(stuck, x, np.nan), v, color=BLUE, linewidth=2.6, label="stick")
    axis.set(xlabel="$x$", ylabel=r"$\dot x$")


def _draw_dots(axis: "Axes", x: Any, y: Any, size: float, color: str, label: str) -> None:
    """Draw many points, and their name in the legend with a marker that is large enough to see."""
    style: dict[str, Any] = {"linestyle": "none", "color": color, "markeredgewidth": 0.0}
    axis.plot(x, y, marker=".", markersize=size, rasterized=True, **style)
    axis.plot([], [], marker="o", markersize=max(size, 4.0), label=label, **style)


def attractor_name(cycle: LimitCycle) -> str:
    """Return an attractor's kind and place."""
    return f"{cycle.kind} round x = {0.5 * (cycle.x_max + cycle.x_min):.2f}"


@house_style()
def draw_basins(axis: "Axes", x: NDArray[np.float64], v: NDArray[np.float64], found: Basins) -> None:
    """Draw a grid of basins with the attractors on it.

    Args:
        x, v: axes of the grid, shapes (n,) and (m,). found: its basins, labels of shape (m, n).
    """
    names = [*map(attractor_name, found.attractors)]
    shares = [found.fraction(label)[0] for label in range(-2, len(names))]
    _draw_labels(axis, x, v, found.labels, names, shares, lost="#BBBBBB", height=1.17)
    lines = ("-", (0, (4, 1.5)), (0, (1, 1)), "-.")
    for i, cycle in enumerate(found.attractors):
        states = np.array([cycle.state(phase) for phase in np.linspace(0.0, 1.0, 400)])
        axis.plot(*states.T, color=BLACK, linewidth=1.6, linestyle=lines[i % len(lines)])
        if cycle.amplitude == 0.0:
            axis.plot(*states[0], marker="o", color=BLACK)
    axis.axhline(found.parameters.belt_speed, color="0.45", linewidth=0.8, linestyle=":")


@house_style()
def draw_forced_basins(axis: "Axes", found: ForcedBasins) -> None:
    """Draw a grid of forced basins with the section points of the periodic attractors on it."""
    names = [f"period {orbit.multiple}" for orbit in found.attractors] + ["chaos"] * (found.chaos is not None)
    shares = [found.fraction(label) for label in range(-2, len(names))]
    _draw_labels(axis, found.x, found.v, found.labels, names, shares, lost=GREY, height=1.12)
    for orbit, marker in zip(found.attractors, "osD^v<>ph*" * len(found.attractors), strict=False):
        style: dict[str, Any] = {"linestyle": "none", "markersize": 5.5, "markeredgecolor": "white", "color": BLACK}
        axis.plot(*orbit.points.T, marker=marker, **style)
    axis.axhline(found.parameters.belt_speed, color="0.45", linewidth=0.8, linestyle=":")


def _draw_labels(
    axis: "Axes", x: Any, v: Any, labels: Any, names: list[str], shares: list[float], *, lost: str, height: float
) -> None:
    """Draw the labels of a grid of starts, and a legend ``height`` axes above of those that have a share.

    Args:
        names: of the labels from 0 on. shares: of the labels from -2 on. lost: colour of lost contact.
    """
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    names = ["undecided", "contact lost", *names]
    shades = ["#F5F5F5", lost, "#A6CEE3", "#FDD9B5", "#B9E3C6", "#DDC7E8", "#F7EFA5"]
    colours = [shades[i % len(shades)] for i in range(len(names))]
    norm = BoundaryNorm(np.arange(-2.5, len(names) - 2), len(names))
    axis.grid(visible=False)
    axis.pcolormesh(x, v, labels, cmap=ListedColormap(colours), norm=norm, shading="nearest", rasterized=True)
    axis.set(xlim=(x[0], x[-1]), ylim=(v[0], v[-1]), xlabel="start $x$", ylabel=r"start $\dot x$")
    patches = [
        Patch(facecolor=colour, edgecolor="0.6", label=f"{name}, {100.0 * share:.1f}%")
        for name, colour, share in zip(names, colours, shares, strict=True)
        if share > 0.0
    ]
    axis.legend(handles=patches, fontsize=8, loc="upper left", bbox_to_anchor=(0.0, height), ncols=4, frameon=False)


@house_style()
def draw_bifurcation(axis: "Axes", diagram: Table) -> None:
    """Draw the section points of :func:`forced.bifurcation_diagram`: the way down in small points over the way up, so
    that both show where they meet."""
    values = np.unique(diagram["value"]).size
    size = float(np.clip(600.0 / values, 2.2, 6.0))  # in points; a few values leave room for larger ones
    for (way, color), share in zip(WAYS.items(), (1.0, 0.5), strict=True):
        part = diagram["direction"] == way
        if part.any():
            _draw_dots(axis, diagram["value"][part], diagram["x"][part], share * size, color, way)
    axis.set(xlabel=label_of(diagram.metadata["swept"]), ylabel="$x$ on the section")
    axis.legend(fontsize=8, frameon=False, loc="best")


def _mark_special(axis: "Axes", kinds: Any, x: Any, y: Any, markers: Mapping[str, str]) -> dict[str, Any]:
    """Mark the points whose kind has a marker; return the handles by kind."""
    handles: dict[str, Any] = {}
    for kind, marker in markers.items():
        part = kinds == kind
        if part.any():
            mark: dict[str, Any] = {"linestyle": "none", "color": BLACK, "markersize": 5.5, "label": kind}
            handles[kind] = axis.plot(x[part], y[part], marker=marker, **mark)[0]
    return handles


@house_style()
def draw_branches(axis: "Axes", branches: Table) -> None:
    """Draw the section points of :func:`forced.orbit_branches`, stable orbits solid and unstable dashed, with a marker
    at each bifurcation; over :func:`draw_bifurcation` they go through its points."""
    name = branches.metadata["over"]
    for branch, cycle in sorted(set(zip(branches["branch"].tolist(), branches["cycle"].tolist(), strict=True))):
        part = (branches["branch"] == branch) & (branches["cycle"] == cycle)
        x, stable, special = branches["x"][part], branches["stable"][part], branches["kind"][part] != "point"
        for label, drawn, line in (("stable", stable, "-"), ("unstable", ~stable, (0, (4, 1.2)))):
            shown, style = np.where(drawn | special, x, np.nan), {"color": PURPLE, "linewidth": 1.6, "linestyle": line}
            axis.plot(branches[name][part], shown, label="" if branch + cycle > 0 else label, **style)  # type: ignore[arg-type]
    _mark_special(axis, branches["kind"], branches[name], branches["x"], BRANCH_MARKERS)
    axis.set_xlabel(label_of(name))
    axis.set_ylabel("$x$ on the section")
    axis.legend(fontsize=8, frameon=False, loc="best")


@house_style()
def draw_chart(axis: "Axes", chart: Table) -> None:
    """Draw a chart of :func:`stability_chart`: its regions, its curves, and a marker at each special point."""
    from matplotlib.patches import Patch

    name, against = chart.metadata["over"], chart.metadata.get("against", "belt_speed")
    over, other = chart[name], chart[against]
    handles: dict[str, Any] = {}
    for kind, values, low, high in filled_regions(chart):
        axis.fill_between(values, low, high, color=REGIONS[kind], linewidth=0.0)
        handles[kind] = Patch(facecolor=REGIONS[kind], edgecolor="0.6", label=kind)
    for curve, style in BORDERS.items():
        for branch in np.unique(chart["branch"][(chart["curve"] == curve) & (chart["branch"] >= 0)]):
            part = (chart["curve"] == curve) & (chart["branch"] == branch)
            handles[curve] = axis.plot(over[part], other[part], linewidth=2.0, **style)[0]  # type: ignore[arg-type]
    handles |= _mark_special(axis, chart["kind"], over, other, CHART_MARKERS)
    if against == "belt_speed":
        axis.set_ylim(bottom=0.0)
    axis.margins(x=0.0, y=0.0)
    axis.set(xlabel=label_of(name), ylabel=label_of(against))
    axis.legend(handles=list(handles.values()), fontsize=8, loc="best")


@house_style()
def draw_response(axis: "Axes", curve: Table) -> None:
    """Draw :func:`forced.response_curve`: the amplitude, and in a second scale the phase of the first harmonic."""
    angles = axis.twinx()
    for way, size in zip(WAYS, (5.0, 2.5), strict=True):
        part = curve["direction"] == way
        if part.any():
            _draw_dots(axis, curve["value"][part], curve["amplitude"][part], size, WAYS[way], way)
            angles.plot(curve["value"][part], curve["phase"][part], color=WAYS[way], linewidth=1.0, linestyle=":")
    axis.set(xlabel=label_of(curve.metadata["swept"]), ylabel="amplitude")
    angles.set_ylabel("phase (dotted), rad")
    axis.legend(fontsize=8, frameon=False, loc="best")


@house_style()
def draw_exponents(axis: "Axes", table: Table, floor: float = -0.25) -> None:
    """Draw the largest exponent over the value of a sweep, with two standard errors; below ``floor`` it is cut off."""
    for way, width, line in (("up", 2.4, "-"), ("down", 1.0, (0, (4, 1.2)))):
        part, color = table["direction"] == way, WAYS[way]
        if part.any():
            exponent = np.maximum(table["exponent"][part], 2.0 * floor)  # minus infinity too
            spread = 2.0 * table["standard_error"][part]
            axis.plot(table["value"][part], exponent, color=color, linewidth=width, linestyle=line, label=way)
            axis.fill_between(table["value"][part], exponent - spread, exponent + spread, color=color, alpha=0.25)
    axis.axhline(0.0, color="0.45", linewidth=0.9)
    axis.set_ylim(bottom=floor)
    axis.set_ylabel(r"largest exponent $\lambda$")


@house_style()
def draw_section(axis: "Axes", section: Table) -> None:
    """Draw a stroboscopic section, :func:`forced.poincare_section`, its stuck states apart."""
    stuck = section["mode"] == 0
    for part, color, label in ((~stuck, VERMILION, "slip"), (stuck, BLUE, "stick")):
        _draw_dots(axis, section["x"][part], section["v"][part], 2.2, color, label)
    axis.set(xlabel="$x$", ylabel=r"$\dot x$")
    axis.legend(fontsize=8, frameon=False)
