"""Where it squeals: the chart of the source paper's oscillator over the anchor height, exact geometry."""

from pathlib import Path

from PIL import Image

from scripts.figures.common import metadata
from sd_friction_env import OscillatorParameters, Table, stability_chart
from sd_friction_env.pictures import plotting

PLANT = OscillatorParameters()


def compute() -> Table:
    """Return the chart."""
    chart = stability_chart(PLANT, ("alpha", 0.1, 1.2), points=40)
    return Table(chart, metadata([PLANT]) | {"over": chart.metadata["over"]})


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw the chart, in few colours: a small file."""
    figure, axes = plotting.new_figure(6.4, 4.2, 1, 1)
    plotting.draw_chart(axes[0, 0], table)
    plotting.save_figure(figure, path, dpi=110)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(48)
    small.save(path, optimize=True)
