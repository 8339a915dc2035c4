"""Pictures of a report."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sd_friction_env import Table
from sd_friction_env.environments.single import make_env
from sd_friction_env.pictures import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure
from sd_friction_env.learning.report.agents import ENV_IDS, Row
from sd_friction_env.learning.report.curves import SWEEPS

# Dashes differ as well as colours (Okabe and Ito's), for grey prints and colour-blind readers.
_LINES: tuple[dict[str, Any], ...] = (
    {"color": plotting.BLUE, "linestyle": "-", "marker": "o"},
    {"color": plotting.VERMILION, "linestyle": (0, (5, 1.5)), "marker": "s"},
    {"color": plotting.GREEN, "linestyle": (0, (3, 1, 1, 1)), "marker": "^"},
    {"color": "#CC79A7", "linestyle": (0, (1, 1)), "marker": "D"},
    {"color": "#E69F00", "linestyle": (0, (7, 2, 1, 2)), "marker": "v"},
    {"color": "#56B4E9", "linestyle": (0, (2, 2)), "marker": "P"},
)
_KINDS = {
    "baseline": {"color": plotting.GREY, "marker": "o"},
    "classical": {"color": plotting.VERMILION, "marker": "s"},
    "learned": {"color": plotting.BLUE, "marker": "D"},
    "optimum": {"color": plotting.BLACK, "marker": "*"},
}
_PASSIVE: dict[str, Any] = {"color": plotting.GREY, "linestyle": "-", "linewidth": 2.5}


@plotting.house_style()
def draw_scores(rows: Sequence[Row]) -> "Figure":
    """Draw scores and suppressed fractions of one task and tier with their intervals."""
    figure, axes = plotting.new_figure(9.0, 1.4 + 0.32 * len(rows), 1, 2, sharey=True)
    for axis, key in zip(axes[0], ("score", "suppressed"), strict=True):
        for place, row in enumerate(rows):
            value = row.get(key, float("nan"))
            if np.isfinite(value):
                ends = [row.get(f"{key}_low", value), row.get(f"{key}_high", value)]
                away = [[max(0.0, value - ends[0])], [max(0.0, ends[1] - value)]]
                style = _KINDS[row["kind"]]
                axis.errorbar([value], [place], xerr=away, fmt="none", ecolor=style["color"], capsize=3)
                axis.plot([value], [place], linestyle="none", markersize=7, **style)
    axes[0, 0].set_yticks(range(len(rows)), [row["controller"] for row in rows])
    axes[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    if not any(np.isfinite(row["score"]) for row in rows):
        axes[0, 0].text(0.5, 0.5, "no optimum is stored", transform=axes[0, 0].transAxes, ha="center")
    for reference in (0.0, 1.0):
        axes[0, 0].axvline(reference, color="0.6", linewidth=0.9, linestyle=(0, (4, 2)))
    axes[0, 0].set_xlabel("score (0 passive, 1 optimum)")
    axes[0, 1].set_xlabel("suppressed episodes")
    axes[0, 1].set_xlim(-0.04, 1.04)
    return figure


@plotting.house_style()
def draw_sweeps(rows: Sequence[Row], task: str) -> "Figure":
    """Draw the settled amplitudes of all sweeps of a task."""
    figure, axes = plotting.new_figure(8.0, 3.0 * len(SWEEPS) + 1.2, len(SWEEPS), 1)
    nominal = make_env(ENV_IDS[task, "nominal"]).nominal
    drawn = make_env(ENV_IDS[task, "randomised"]).task.randomise
    here = {"belt_speed": nominal.belt_speed, "alpha": nominal.alpha, "friction_drop": nominal.mu_s - nominal.mu_m}
    low, high = drawn["mu_m"]
    ranges = {**drawn, "friction_drop": (nominal.mu_s - high, nominal.mu_s - low)}
    for axis, (sweep, (label, *_)) in zip(axes[:, 0], SWEEPS.items(), strict=True):
        axis.axvspan(*ranges[sweep], color="0.95", zorder=0, label="drawn in the randomised tier")
        axis.axvline(here[sweep], color="0.6", linewidth=0.9, linestyle=(0, (4, 2)), label="nominal")
        names = list(dict.fromkeys(row["controller"] for row in rows))
        for name in names:
            mine = [row for row in rows if row["sweep"] == sweep and row["controller"] == name]
            style = _PASSIVE if name == "passive" else _LINES[(names.index(name) - 1) % len(_LINES)]
            axis.plot(
                [row["value"] for row in mine], [row["amplitude"] for row in mine], label=name, markersize=4, **style
            )
        axis.set(xlabel=label, ylabel="settled amplitude")
        axis.set_ylim(bottom=-0.01)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


@plotting.house_style()
def draw_learning(rows: Sequence[Row], references: Mapping[str, float]) -> "Figure":
    """Draw the learning curves of one task and tier: lines are means over runs, bands their ranges."""
    from matplotlib.ticker import EngFormatter

    figure, axes = plotting.new_figure(9.0, 6.2, 2, 2, sharex="col", sharey="row")
    algorithms = list(dict.fromkeys(row["algorithm"] for row in rows))
    for column, over in enumerate(("steps", "seconds")):
        for style, algorithm in zip(_LINES, algorithms, strict=False):
            mine = [row for row in rows if (row["algorithm"], row["over"]) == (algorithm, over)]
            table = Table.from_rows(mine)
            if not table.n_rows:
                continue
            label = f"{algorithm}, {mine[0]['runs']} run{'s' if mine[0]['runs'] > 1 else ''}"
            marker = {} if table.n_rows < 2 else {"marker": ""}
            for axis, name, sign in ((axes[0, column], "return", -1.0), (axes[1, column], "suppressed", 1.0)):
                axis.plot(table["at"], sign * table[name], label=label, **(style | marker))
                ends = (sign * table[f"{name}_low"], sign * table[f"{name}_high"])
                axis.fill_between(table["at"], *ends, color=style["color"], alpha=0.18, linewidth=0.0)
        for (name, value), dash in zip(references.items(), ((0, (1, 2)), (0, (6, 3))), strict=False):
            axes[0, column].axhline(-value, color="0.35", linewidth=1.0, linestyle=dash, label=name)
        axes[1, column].set_xlabel("environment steps" if over == "steps" else "seconds of training")
        axes[0, column].set_yscale("log")
        for formatter in (axes[0, column].yaxis.set_major_formatter, axes[0, column].yaxis.set_minor_formatter):
            formatter("{x:g}")
        axes[1, column].set_ylim(-0.04, 1.04)
    axes[1, 0].xaxis.set_major_formatter(EngFormatter(sep=""))
    axes[0, 0].set_ylabel("minus return (less is better)")
    axes[1, 0].set_ylabel("suppressed")
    axes[0, 0].legend(fontsize=8, frameon=True)
    return figure


@plotting.house_style()
def draw_histories(histories: Mapping[str, Table]) -> "Figure":
    """Draw displacement, velocity, action and phase portrait of histories from one start, passive first."""
    figure, axes = plotting.new_figure(11.0, 6.2, 2, 2, width_ratios=(1.6, 1.0))
    lines = [_PASSIVE | {"linewidth": 1.4}, *_LINES]
    for (name, path), style in zip(histories.items(), lines, strict=False):
        look = {"linewidth": 1.3} | style | {"marker": ""}
        axes[0, 0].plot(path["t"], path["x"], label=name, **look)
        axes[1, 0].plot(path["t"], path["v"], **look)
        axes[0, 1].plot(path["x"], path["v"], **look)
        axes[0, 1].plot(path["x"][-1:], path["v"][-1:], color=look["color"], marker=style.get("marker", "o"))
        axes[1, 1].plot(path["t"], path["action"], **look)
        if np.ptp(path["v_belt"]) > 0.0:
            axes[1, 0].plot(path["t"], path["v_belt"], color=look["color"], linewidth=0.8, alpha=0.6)
    passive = next(iter(histories.values()))
    axes[1, 0].axhline(passive["v_belt"][0], color="0.35", linewidth=0.9, linestyle=(0, (6, 3)), label="nominal belt")
    time, velocity = r"time $\tau$", r"velocity $\dot x$"
    labels = ((time, r"displacement $x$"), (r"$x$", velocity), (time, f"{velocity}; thin: belt"), (time, "action"))
    for axis, (x_label, y_label) in zip(axes.flat, labels, strict=True):
        axis.set(xlabel=x_label, ylabel=y_label)
    axes[0, 0].margins(x=0)
    axes[1, 0].margins(x=0)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure
