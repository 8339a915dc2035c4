"""The picture of the rates."""

from pathlib import Path

import numpy as np

from scripts.benchmark.batches import panel
from scripts.benchmark.measuring import Row, Rows
from sd_friction_env.pictures import plotting


@plotting.house_style()
def draw(rows: Rows, path: Path) -> None:
    """Draw the rates as bars, one panel for what can be compared, ours in another colour."""
    from matplotlib.figure import Figure

    panels: dict[str, list[tuple[str, Row]]] = {}
    for measured in rows.values():
        for label, row in measured.items():
            if row.panel and row.values:
                panels.setdefault(row.panel, []).append((label, row))
    sizes = [len(every) for every in panels.values()]
    figure = Figure(figsize=(10.0, 1.0 + 0.24 * sum(sizes) + 0.45 * len(sizes)), layout="constrained")
    axes = figure.subplots(len(sizes), 1, sharex=True, squeeze=False, height_ratios=[size + 0.6 for size in sizes])
    for ax, (title, every) in zip(axes[:, 0], panels.items(), strict=True):
        every.sort(key=lambda entry: entry[1].median)
        places = np.arange(len(every))
        medians = np.array([row.median for _, row in every])
        low, high = np.array([row.quartiles for _, row in every]).T
        colours = ["#c1440e" if row.ours else "#9aa5b1" for _, row in every]
        ax.barh(places, medians, color=colours, xerr=[medians - low, high - medians], error_kw={"lw": 1.0})
        size = title.removeprefix(panel(0)[:-1])  # stands in the panel's title already
        ax.set_yticks(places, [label.replace(f", {size}", "", 1) for label, _ in every], fontsize=8)
        ax.set_ylim(-0.6, len(every) - 0.4)
        for place, (value, end) in enumerate(zip(medians, high, strict=True)):
            ax.text(1.06 * end, place, _rate(value), va="center", fontsize=7)
        ax.set_xscale("log")
        ax.set_title(title, loc="left", fontsize=9, fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
    last = axes[-1, 0]
    low, high = last.get_xlim()
    last.set_xlim(min(3e3, low), 4.0 * high)
    last.set_xlabel("environment steps per second (median; lines: quartiles); ours in red")
    plotting.save_figure(figure, path)


def _rate(value: float) -> str:
    for size, unit in ((1e6, " million"), (1e3, " thousand")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"
