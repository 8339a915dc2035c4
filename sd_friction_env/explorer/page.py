"""One browser's page: its widgets, its figures, and what the user's changes do to the running oscillator."""

import contextlib
import dataclasses
import functools
import html
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.events import ButtonClick
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    ColumnDataSource,
    Div,
    InlineStyleSheet,
    RadioButtonGroup,
    Select,
    Slider,
    TabPanel,
    Tabs,
    Toggle,
)
from bokeh.palettes import Cividis
from bokeh.plotting import figure
from numpy.typing import NDArray

from sd_friction_env.environments.ids import TASKS
from sd_friction_env.explorer.model import (
    AT_REST,
    BASIN_VIEW,
    CHART_COLUMNS,
    COMPILATION,
    HAND,
    OFF,
    ChartPicture,
    Latest,
    Live,
    PlantPicture,
    Sign,
    basin_picture,
    chart_picture,
    controllers,
    is_loaded,
)
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import EXCITATIONS, FIELDS, FRICTIONS, GEOMETRIES, OscillatorParameters
from sd_friction_env.pictures.plotting import BLACK, BLUE, GREY

# Sliders by tab, and their ranges (parameters.RANGES allows more): first, last, step.
_SLIDERS = {
    "oscillator": {
        "belt_speed": (0.02, 0.6, 0.005),
        "alpha": (0.0, 1.2, 0.01),
        "linear_stiffness": (-2.0, 2.0, 0.05),
        "kappa": (0.0, 5.0, 0.1),
        "g1": (0.5, 2.0, 0.05),
        "beta": (0.0, 0.15, 0.005),
    },
    "friction": {
        "mu_s": (0.05, 0.5, 0.01),
        "mu_m": (0.0, 0.3, 0.01),
        "v_m": (0.2, 1.0, 0.05),
        "mu_k": (0.0, 0.3, 0.01),
        "delta": (0.0, 10.0, 0.1),
        "v_0": (0.05, 2.0, 0.05),
        "mu_v": (0.0, 0.5, 0.01),
    },
    "excitation": {
        "force_amplitude": (0.0, 0.5, 0.01),
        "force_frequency": (0.1, 5.0, 0.05),
        "ripple_amplitude": (0.0, 0.3, 0.01),
        "ripple_frequency": (0.1, 5.0, 0.05),
        "stiffness_amplitude": (0.0, 1.0, 0.02),
        "stiffness_frequency": (0.1, 5.0, 0.05),
    },
}
_TEMPLATE = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
_TICK = 60  # milliseconds between frames
_INTERVALS_A_TICK, _TICKS_A_READING = 4, 4
_IDLE_TICKS = 30_000  # half an hour in which nobody touches a page
_ANNOUNCED = 0.5  # seconds: work that takes longer is announced
_INK = "#404850"
_MASS_Y = -0.02  # of its centre in the picture of the machine
_ALONG = np.linspace(0.0, 1.0, 25)[:, None]
_COILS = 0.05 * np.where((_ALONG > 0.1) & (_ALONG < 0.85), (-1.0) ** np.arange(25)[:, None], 0.0)
_MARKS = np.arange(0.0, 3.5, 0.25)  # of the belt
_STYLE = """
:host { font: 14px/1.35 system-ui, sans-serif; color: #202020; }
.sign { font-size: 22px; font-weight: 650; }
.read { display: flex; gap: 22px; font-size: 13px; white-space: nowrap; }
table { border-collapse: collapse; } td { padding: 0 10px 0 0; }
.number { text-align: right; font-variant-numeric: tabular-nums; font-weight: 650; }
.bar { height: 9px; background: #8A8A8A; }
.warn { border-left: 4px solid #D55E00; padding-left: 8px; }
"""


class Controls:
    """The widgets, which hold what the user asks for.

    Args:
        parameters: shown at first.

    Attributes:
        plant: by parameter, the widgets that describe the oscillator. clicked: buttons clicked since it was emptied.
    """

    def __init__(self, parameters: OscillatorParameters) -> None:
        style = InlineStyleSheet(css=_STYLE)
        fill = {"sizing_mode": "stretch_width"}
        self.clicked: set[str] = set()
        self.task = RadioButtonGroup(labels=["push the mass (force)", "drive the belt"], active=1, name="task", **fill)
        self.controller = Select(options=controllers(), value=OFF, title="controller", name="controller", **fill)
        self.hand = Slider(title="action by hand", start=-1, end=1, step=0.05, value=0, name="hand", **fill)
        self.pause = Toggle(label="pause", name="pause", **fill)
        self.over = Select(title="over", name="over", options=["alpha"], value="alpha", **fill)
        self.message = Div(name="message", stylesheets=[style], **fill)
        self.plant: dict[str, Any] = {
            "geometry": Select(options=list(GEOMETRIES), title="spring", name="geometry", **fill),
            "friction": Select(options=list(FRICTIONS), title="friction law", name="friction", **fill),
        }
        for ranges in _SLIDERS.values():
            for name, (low, high, step) in ranges.items():
                title = FIELDS[name]["meaning"] if len(name) > 5 else f"{name}, {FIELDS[name]['meaning']}"
                places = "0.000" if step < 0.01 else "0.00"
                self.plant[name] = Slider(
                    title=title, start=low, end=high, step=step, format=places, name=name, value=low, **fill
                )
        self.show(parameters)
        laws = {"oscillator": [self.plant["geometry"]], "friction": [self.plant["friction"]], "excitation": []}
        tabs = [
            TabPanel(title=title, child=column(*laws[title], *(self.plant[name] for name in ranges), width=285))
            for title, ranges in _SLIDERS.items()
        ]
        pushes = [self._button(f"hand {value}", label) for value, label in ((-1, "◀ -1"), (0, "0"), (1, "+1 ▶"))]
        self.layout = column(
            self.task,
            self.controller,
            self.hand,
            row(*pushes, **fill),
            row(self._button("restart", "squeal again", button_type="primary"), self.pause, **fill),
            Tabs(tabs=tabs, **fill),
            row(
                self._button("nominal", "reset to nominal"),
                self._button("basins button", "basins of attraction"),
                **fill,
            ),
            self.message,
            name="controls",
            **fill,
        )

    def chart_tab(self, chart: Any) -> Any:
        """Return the chart with the widgets that ask for it."""
        button = self._button("chart button", "compute")
        button.align = "end"
        return column(row(self.over, button, sizing_mode="stretch_width"), chart, sizing_mode="stretch_both")

    def chart_range(self) -> tuple[str, float, float]:
        """Return the parameter across the chart, and its range."""
        name = self.over.value
        low, high, step = next(ranges[name] for ranges in _SLIDERS.values() if name in ranges)
        return name, max(low, step) if name == "alpha" else low, high

    def _button(self, name: str, label: str, **arguments: Any) -> Button:
        button = Button(label=label, name=name, sizing_mode="stretch_width", **arguments)
        button.on_event(ButtonClick, lambda: self.clicked.add(name))
        return button

    def requests(self) -> dict[str, Any]:
        """Return what the widgets ask for now."""
        asked = {name: widget.value for name, widget in self.plant.items()}
        return asked | {"task": self.task.active, "controller": self.controller.value, "hand": self.hand.value}

    def show(self, parameters: OscillatorParameters) -> None:
        """Set the widgets to a plant."""
        for name, widget in self.plant.items():
            widget.value = getattr(parameters, name)
        self.show_used()

    def show_used(self) -> None:
        """Show the sliders that the chosen laws use, and no other."""
        chosen = {"", self.plant["geometry"].value, self.plant["friction"].value, *EXCITATIONS}
        for name in self.plant.keys() & FIELDS.keys():
            used = bool(chosen & set(FIELDS[name]["law"].split(", ")))
            if self.plant[name].visible != used:
                self.plant[name].visible = used
        names = [name for tab in ("oscillator", "friction") for name in _SLIDERS[tab] if self.plant[name].visible]
        if self.over.options != names[1:]:  # the belt speed is the other axis
            self.over.options = names[1:]
            self.over.value = self.over.value if self.over.value in names[1:] else names[1]

    def say(self, text: str) -> None:
        """Show a text (HTML) below the widgets."""
        if self.message.text != text:
            self.message.text = text

    @contextlib.contextmanager
    def errors_shown(self) -> Iterator[None]:
        """Show what is refused on the page instead of raising it."""
        self.say("")
        try:
            yield
        except (ValueError, TypeError, OrbitError) as error:
            self.warn(str(error))

    def warn(self, text: str) -> None:
        """Show a warning."""
        self.say(f"<div class='warn'>{html.escape(text)}</div>")


class Drawing:
    """The figures and the readout."""

    def __init__(self) -> None:
        def source(name: str, columns: str) -> ColumnDataSource:
            return ColumnDataSource({key: [] for key in columns.split()}, name=name)

        self.path = source("path", "t x v v_belt action stick")
        self.mass = source("mass", "x v y color marker")
        self.cycle = source("cycle", "x v")
        self.line = ColumnDataSource({"x": [-5.0, 5.0], "v": [0.0, 0.0]}, name="line")
        self.curve = source("curve", "belt_speed amplitude")
        self.point = source("point", "belt_speed amplitude color marker")
        columns = " ".join(CHART_COLUMNS)
        self.regions, self.borders = source("regions", f"{columns} kind"), source("borders", f"{columns} curve")
        self.own = source("own", "x y")
        self.charted: ChartPicture | None = None
        self.basins = source("basins", "image x y dw dh")
        self.spring = source("spring", "x y size")
        self.marks = source("marks", "x y")
        self.tags = source("tags", "x0 x1 y text_x text_y text color")
        self.passive = float("nan")  # amplitude
        self.readout = Div(
            name="readout", stylesheets=[InlineStyleSheet(css=_STYLE)], sizing_mode="stretch_both", min_height=100
        )
        self._draw_machine()
        self._draw_portrait()
        self._draw_history()
        self._draw_amplitudes()
        self._draw_chart()
        self.figures = [self.machine, self.portrait, self.displacement, self.action, self.amplitudes]

    def _figure(self, name: str, title: str, x: str, y: str, **arguments: Any) -> Any:
        plot = figure(
            title=title,
            name=name,
            sizing_mode="stretch_both",
            min_width=150,
            min_height=80,
            toolbar_location=None,
            tools="",
            **arguments,
        )
        plot.xaxis.axis_label, plot.yaxis.axis_label = x, y
        plot.axis.axis_label_text_font_style = "normal"
        plot.grid.grid_line_alpha = 0.4
        plot.outline_line_color = None
        return plot

    def _place_legend(self, plot: Any, location: str) -> None:
        plot.legend.update(location=location, label_text_font_size="11px", padding=3, spacing=0, margin=5)
        plot.legend.update(glyph_height=14, label_height=14, background_fill_alpha=0.7)

    def _draw_machine(self) -> None:
        plot = self._figure("machine", "", "", "", x_range=(-1.6, 1.9), y_range=(-0.42, 1.25))
        plot.axis.visible = plot.grid.visible = False
        plot.line([-1.6, 1.9], [-0.16, -0.16], line_width=7, color=_INK)
        plot.scatter("x", "y", source=self.marks, marker="dash", angle=np.pi / 2, size=10, line_width=2, color="white")
        plot.line("x", "y", source=self.spring, line_width=2, color=BLACK)
        plot.scatter("x", "y", size="size", source=self.spring, marker="inverted_triangle", color=BLACK)
        plot.segment("x0", "y", "x1", "y", source=self.tags, color=_INK, line_width=3)
        plot.scatter("x1", "y", source=self.tags, size=8, color=_INK)
        plot.rect("x", "y", width=0.26, height=0.22, source=self.mass, color="color")  # opaque: hides the spring's end
        plot.text(
            "text_x", "text_y", "text", source=self.tags, color="color", text_font_size="13px", text_baseline="middle"
        )
        self.machine = plot

    def _draw_portrait(self) -> None:
        plot = self._figure(
            "portrait", "phase portrait", "displacement x", "velocity v", x_range=(-1.6, 1.6), y_range=(-0.9, 0.9)
        )
        plot.image("image", x="x", y="y", dw="dw", dh="dh", source=self.basins, palette=Cividis[11], alpha=0.5)
        for source, dash, color, width, label in (
            (self.line, "dotted", BLACK, 1.5, "belt speed"),
            (self.cycle, "dashed", GREY, 2.0, "without control"),
            (self.path, "solid", BLACK, 2.5, "now"),
        ):
            plot.line("x", "v", source=source, line_dash=dash, color=color, line_width=width, legend_label=label)
        plot.scatter("x", "v", source=self.mass, size=13, color="color", marker="marker", line_color="white")
        self._place_legend(plot, "bottom_left")
        self.portrait = plot

    def _draw_history(self) -> None:
        lasts = (-60.0, 0.0)
        above = self._figure("displacement", "displacement (blue: sticks)", "", "x", x_range=lasts, y_range=(0, 1))
        above.line("t", "x", source=self.path, color=BLACK, line_width=1.5)
        above.scatter("t", "x", source=self.path, size=4, color=BLUE, alpha="stick")
        below = self._figure("action", "action", "time, now at 0", "a", x_range=above.x_range, y_range=(-1.1, 1.1))
        below.step("t", "action", source=self.path, color=BLACK, line_width=1.5)
        above.min_border_left = below.min_border_left = 66
        self.displacement, self.action = above, below

    def _draw_amplitudes(self) -> None:
        plot = self._figure(
            "amplitudes",
            "amplitude",
            "belt speed v_b",
            "amplitude A",
            x_range=(0, 0.62),
            y_range=(-0.02, 0.6),
        )
        plot.line(
            "belt_speed", "amplitude", source=self.curve, color=GREY, line_width=2.5, legend_label="without control"
        )
        plot.scatter(
            "belt_speed",
            "amplitude",
            source=self.point,
            size=13,
            color="color",
            marker="marker",
            line_color="white",
            legend_label="now",
        )
        self._place_legend(plot, "top_left")
        self.amplitudes = plot

    def _draw_chart(self) -> None:
        plot = self._figure("chart", "", "", "belt speed v_b", x_range=(0, 1), y_range=(0, 1))
        plot.patches("x", "y", source=self.regions, color="color", line_width=0, legend_field="kind")
        plot.multi_line(
            "x", "y", source=self.borders, color="color", line_dash="dash", line_width=2.5, legend_field="curve"
        )
        plot.scatter("x", "y", source=self.own, size=13, marker="diamond", color=BLACK, legend_label="this plant")
        self._place_legend(plot, "bottom_right")
        self.chart = plot

    def show_chart(self, picture: ChartPicture | None, plant: OscillatorParameters) -> None:
        """Show a chart, or none, and where in it a plant lies."""
        if picture is not self.charted:
            self.charted = picture
            for source, name in ((self.regions, "regions"), (self.borders, "borders")):
                source.data = getattr(picture, name) if picture else {key: [] for key in source.data}
            if picture:
                self.chart.xaxis.axis_label = f"{picture.name}, {FIELDS[picture.name]['meaning']}"
                for shown, (low, high) in zip((self.chart.x_range, self.chart.y_range), picture.reach, strict=True):
                    shown.update(start=low, end=high)
        place = {"x": [getattr(plant, picture.name)], "y": [plant.belt_speed]} if picture else {"x": [], "y": []}
        self.own.data = place

    def look(self, centre: float, x_reach: float, v_reach: float) -> None:
        """Set the ranges of x and v that are shown."""
        self.portrait.x_range.update(start=centre - x_reach, end=centre + x_reach)
        self.portrait.y_range.update(start=-v_reach, end=v_reach)
        self.displacement.y_range.update(start=centre - x_reach, end=centre + x_reach)

    def show_plant(self, picture: PlantPicture) -> None:
        """Show the curve and the cycle of a plant."""
        cycle = picture.cycle
        self.curve.data = picture.curve
        self.passive = cycle.amplitude if cycle is not None else float("nan")
        low, high = (cycle.x_min, cycle.x_max) if cycle is not None else (-0.8, 0.8)
        reach = 0.5 * (high - low) + 0.35
        self.look(round(0.5 * (high + low), 1), round(reach, 1), round(0.7 * reach, 1))
        highest = np.nanmax(picture.curve["amplitude"], initial=0.4)
        self.amplitudes.y_range.end = 0.2 * np.ceil(highest / 0.2 + 0.1)
        shape = cycle.points if cycle is not None and cycle.amplitude > 0.0 else np.empty((0, 2))
        closed = np.concatenate([shape, shape[:1]])
        self.cycle.data = {"x": closed[:, 0], "v": closed[:, 1]}
        self.basins.data = {name: [] for name in self.basins.data}

    def show_basins(self, image: NDArray[np.float64]) -> None:
        """Show which attractor each start reaches."""
        (x, x_end), (v, v_end) = BASIN_VIEW
        self.look(0.0, x_end, v_end)
        self.basins.data = {"image": [image], "x": [x], "y": [v], "dw": [x_end - x], "dh": [v_end - v]}

    def show_motion(self, live: Live) -> None:
        """Show where the mass is now, and its past."""
        now = AT_REST if live.regime(self.passive) == AT_REST else live.mode
        # Time runs from the right: axes that stay as they are need no new layout, most of the work of a frame.
        past = {name: np.array(values) for name, values in live.past.items()}
        self.path.data = past | {"t": past["t"] - past["t"][-1]}
        info = live.loop.info
        x, v, v_belt = (float(info[name]) for name in ("x", "v", "v_belt"))
        self.mass.data = {"x": [x], "v": [v], "y": [_MASS_Y], "color": [now.color], "marker": [now.marker]}
        if self.line.data["v"][0] != v_belt:
            self.line.data = {"x": [-5.0, 5.0], "v": [v_belt, v_belt]}
        self._move_machine(live, x, v_belt, now)

    def _move_machine(self, live: Live, x: float, v_belt: float, now: Sign) -> None:
        level = live.parameters.geometry in ("linear", "duffing")  # from a wall, not from an anchor above
        start = np.array([-1.55, _MASS_Y] if level else [0.0, live.parameters.alpha])
        reach = np.array([x, _MASS_Y]) - start
        across = np.array([-reach[1], reach[0]]) / max(np.hypot(*reach), 1e-9)
        spring_x, spring_y = (start + _ALONG * reach + _COILS * across).T
        self.spring.data = {"x": spring_x, "y": spring_y, "size": [11] + 24 * [0]}
        # A force at its limit, and the nominal belt speed, make arrows of the same length.
        force = float(live.loop.info["force"])
        push = 0.4 * force / live.loop.env.task.force_limit
        pull = 0.4 * v_belt / OscillatorParameters().belt_speed
        tags = [
            (x, x, _MASS_Y, x + 0.2, _MASS_Y, "at rest" if now == AT_REST else now.words, now.color),
            (-1.4, -1.4 + pull, -0.3, max(pull, 0.0) - 1.3, -0.3, f"belt speed {v_belt:.2f}", _INK),
        ]
        if push:
            tags.append((x, x + push, 0.2, min(x, 0.9), 0.36, f"force {force:+.3f}", _INK))
        self.tags.data = dict(zip(self.tags.data, map(list, zip(*tags, strict=True)), strict=True))
        belt = -1.6 + (_MARKS + live.loop.env.get_state().belt_travel) % 3.5
        self.marks.data = {"x": belt, "y": np.full(len(belt), -0.16)}

    def read(self, live: Live) -> None:
        """Say in words and numbers what the mass does."""

        def shown(value: float, form: str) -> str:
            return format(value, form) if np.isfinite(value) else "-"

        sign, amplitude, costs = live.regime(self.passive), live.amplitude, live.costs()
        point = (live.parameters.belt_speed, amplitude, sign.color, sign.marker)
        self.point.data = {
            name: [part] if np.isfinite(amplitude) else [] for name, part in zip(self.point.data, point, strict=True)
        }
        longest = max(*costs.values(), 1e-9)
        rows = "".join(
            f"<tr><td>{name}</td><td class='number'>{cost:.3f}</td>"
            f"<td><div class='bar' style='width:{70 * max(cost, 0.0) / longest:.0f}px'></div></td></tr>"
            for name, cost in costs.items()
        )
        self.readout.text = (
            f"<div class='sign' style='color:{sign.color}'>{sign.symbol} {sign.words}</div><div class='read'>"
            f"<div>amplitude <b>{shown(amplitude, '.3f')}</b><br>without control {shown(self.passive, '.3f')}<br>"
            f"score <b>{shown(100 * live.score(), '.0f')}</b><br>(no control 0, agent 100)</div>"
            f"<table><tr><td colspan='3'>mean cost per step, from the same start</td></tr>{rows}</table></div>"
        )


class Page:
    """A running oscillator in a document: a tick advances and shows it, and does what the widgets ask for by then.

    Of many moves of a widget between two ticks the last one counts. What takes longer than a frame is done in the
    background, one piece of each kind at a time. A slider of the plant, and a result, are followed at once.

    Args:
        document: that the page is drawn into. on_idle: is called when nobody has touched the page for half an hour.
    """

    def __init__(self, document: Any, on_idle: Callable[[], None] = lambda: None) -> None:
        self.document, self.on_idle = document, on_idle
        self.live = Live()
        self.plant = self.live.parameters  # asked for; that of the oscillator as soon as its picture is there
        self.controls, self.drawing = Controls(self.plant), Drawing()
        self.plant_work = Latest(self._show_plant, self._wake)
        self.basin_work = Latest(self._show_basins, self._wake)
        # In another process: following curves is mostly Python, which would hold up this one's frames.
        processes = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        self.chart_work = Latest(self._show_chart, self._wake, processes)
        self.ended = False
        self.ticks = self.idle_ticks = 0
        self.requests = self.controls.requests()
        self.drawing.show_plant(PlantPicture.of(self.plant))
        for widget in self.controls.plant.values():
            widget.on_change("value", lambda attr, old, new: self._wake())
        *figures, amplitudes = self.drawing.figures
        panels = {"amplitude": amplitudes, "where it squeals": self.controls.chart_tab(self.drawing.chart)}
        curves = Tabs(
            tabs=[TabPanel(title=title, child=child) for title, child in panels.items()],
            name="curves",
            sizing_mode="stretch_both",
        )
        roots = [*figures, curves]
        for root in (self.controls.layout, self.drawing.readout, *roots):
            document.add_root(root)
        document.title = "sd_friction_env explorer"
        document.template = _TEMPLATE
        document.template_variables["figures"] = [root.name for root in roots]
        document.add_periodic_callback(self.tick, _TICK)
        document.on_session_destroyed(lambda context: self.end())

    def _wake(self) -> None:
        """Have the plant followed as soon as the server is free; may be called from any thread."""
        if not self.ended:
            self.document.add_next_tick_callback(self._follow_plant)

    def _follow_plant(self) -> None:
        """Show the plant that the widgets ask for, once its picture is computed."""
        if self.ended:
            return
        asked = self.controls.requests()
        if any(asked[name] != self.requests[name] for name in self.controls.plant):
            self.idle_ticks = 0
            self.controls.show_used()
            with self.controls.errors_shown():
                # All that the widgets show, for what was refused before may now fit.
                self.plant = self.plant.replace(**{name: asked[name] for name in self.controls.plant})
                self.plant_work.ask(functools.partial(PlantPicture.after_compilation, self.plant))
            self.requests |= {name: asked[name] for name in self.controls.plant}
        for work in (self.plant_work, self.basin_work, self.chart_work):
            work.poll()

    def _follow_control(self) -> None:
        """Do what else the widgets ask for now, and not what they asked for in between."""
        controls, live = self.controls, self.live
        clicked = set(controls.clicked)
        controls.clicked.clear()
        for name in clicked & {"hand -1", "hand 0", "hand 1"}:
            controls.controller.value, controls.hand.value = HAND, float(name.split()[1])
        before, self.requests = (
            self.requests,
            controls.requests() | {name: self.requests[name] for name in controls.plant},
        )
        changed = {name for name, value in self.requests.items() if value != before[name]}
        self.idle_ticks = 0 if changed or clicked else self.idle_ticks + 1
        if "nominal" in clicked:
            controls.show(OscillatorParameters())
        if "task" in changed:
            with controls.errors_shown():
                live.choose_task(dict(enumerate(TASKS)).get(controls.task.active, live.task))
        if "hand" in changed:
            controls.controller.value = self.requests["controller"] = HAND
            with controls.errors_shown():
                live.steer(controls.hand.value)
        if controls.controller.value != live.controller:
            with controls.errors_shown():
                live.choose_controller(controls.controller.value)
        if changed & {"task", "controller"} and live.controller in live.missing:
            controls.warn(live.missing[live.controller])
        if "restart" in clicked:
            with controls.errors_shown():
                live.restart()
        if "basins button" in clicked:
            controls.say("Computing the basins of attraction ...")
            plant = self.plant
            self.basin_work.ask(lambda: (plant, *basin_picture(plant)))

        if "chart button" in clicked:
            controls.say("Computing where it squeals ...")
            self.chart_work.ask(functools.partial(chart_picture, self.plant, controls.chart_range()))

    def _show_plant(self, work: Future[PlantPicture]) -> None:
        with self.controls.errors_shown():
            picture = work.result()
            self.live.change(**dataclasses.asdict(picture.parameters))
            self.drawing.show_plant(picture)
            charted = self.drawing.charted
            holds = charted is not None and charted.holds_for(self.plant)
            self.drawing.show_chart(charted if holds else None, self.plant)

    def _show_basins(self, work: Future[tuple[OscillatorParameters, NDArray[np.float64], str]]) -> None:
        with self.controls.errors_shown():
            plant, image, words = work.result()
            if plant == self.plant:  # else it has been changed meanwhile
                self.drawing.show_basins(image)
                self.controls.say(words)

    def _show_chart(self, work: Future[ChartPicture]) -> None:
        with self.controls.errors_shown():
            picture = work.result()
            if picture.holds_for(self.plant):  # else it has been changed meanwhile
                self.drawing.show_chart(picture, self.plant)
                self.controls.say(html.escape(picture.words))

    def end(self) -> None:
        """Stop all work: the browser has left, or nobody has touched the page for long."""
        self.ended = True
        for work in (self.plant_work, self.basin_work, self.chart_work):
            work.end()

    def tick(self) -> None:
        """Do what the user asks for; advance a little, and show it."""
        if self.ended:
            if self.idle_ticks > _IDLE_TICKS:  # a tick later, so that the browser has got the message
                self.on_idle()
            return
        self._follow_control()
        self._follow_plant()
        if self.plant_work.seconds > _ANNOUNCED and not is_loaded(self.plant):
            excited = ", excitation" if self.plant.excited else ""
            self.controls.say(
                f"Compiling ({self.plant.geometry} spring, {self.plant.friction} friction{excited}): about "
                f"{COMPILATION} s at the first use, {self.plant_work.seconds:.0f} s so far. Meanwhile the oscillator "
                "runs on as it was."
            )
        if self.idle_ticks > _IDLE_TICKS:
            self.controls.say("Ended: nobody has touched this page for half an hour. To go on, reload it.")
            self.end()
        elif not self.controls.pause.active and self.live.advance(_INTERVALS_A_TICK)["t"]:
            self.drawing.show_motion(self.live)
            self.ticks += 1
            if self.ticks % _TICKS_A_READING == 1:
                self.drawing.read(self.live)
