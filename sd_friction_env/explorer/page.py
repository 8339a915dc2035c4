"""The explorer: a page in the browser that shows the oscillator live; ``sd-friction explore`` (extra "explore").

:class:`Live` is what moves, without any page; :class:`Page` puts it into a Bokeh document, and :func:`serve` offers
that to browsers: by Bokeh's own server, which streams points over one socket and loads nothing from elsewhere. Who may
ask it is decided in :mod:`server`.
"""

import contextlib
import dataclasses
import functools
import html
import importlib.metadata
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.policies import ConstantPolicy, Policy, State, VelocityFeedback, ZeroPolicy
from sd_friction_env.control.pretrained import load_pretrained
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.physics.basins import basin_grid
from sd_friction_env.physics.curves import amplitude_curve
from sd_friction_env.physics.orbits import LimitCycle, OrbitError, limit_cycle
from sd_friction_env.physics.parameters import (
    EXCITATIONS,
    FIELDS,
    FRICTIONS,
    GEOMETRIES,
    STATE_LIMIT,
    Kind,
    OscillatorParameters,
)
from sd_friction_env.pictures.plotting import BLACK, BLUE, GREEN, GREY, VERMILION

HOST = "127.0.0.1"
PORT = 5006
SESSIONS, MOST_SESSIONS = 8, 1000  # pages at a time, unless said otherwise, and at most
TASKS = {"force": "Force", "belt": "BeltSpeed"}
OFF, FEEDBACK, AGENT, ROBUST, HAND = "off", "velocity feedback", "trained agent", "trained agent, robust", "by hand"
PLUGINS = "sd_friction_env.controllers"  # group of entry points: functions from an environment's id to a policy

# Ranges of the sliders (parameters.RANGES allows more): first, last, step.
_SLIDERS = {
    "belt_speed": (0.02, 0.6, 0.005),
    "alpha": (0.0, 1.2, 0.01),
    "g1": (0.5, 2.0, 0.05),
    "beta": (0.0, 0.15, 0.005),
    "mu_s": (0.05, 0.5, 0.01),
    "mu_m": (0.0, 0.3, 0.01),
    "v_m": (0.2, 1.0, 0.05),
}
# On the second tab: what other laws use, and excitation.
_LAW_SLIDERS = {
    "mu_k": (0.0, 0.3, 0.01),
    "delta": (0.0, 10.0, 0.1),
    "v_0": (0.05, 2.0, 0.05),
    "mu_v": (0.0, 0.5, 0.01),
    "linear_stiffness": (-2.0, 2.0, 0.05),
    "kappa": (0.0, 5.0, 0.1),
    "force_amplitude": (0.0, 0.5, 0.01),
    "force_frequency": (0.1, 5.0, 0.05),
    "ripple_amplitude": (0.0, 0.3, 0.01),
    "ripple_frequency": (0.1, 5.0, 0.05),
    "stiffness_amplitude": (0.0, 1.0, 0.02),
    "stiffness_frequency": (0.1, 5.0, 0.05),
}


def _titled(ranges: dict[str, tuple[float, float, float]]) -> dict[str, tuple[str, float, float, float]]:
    """Return ranges with the sliders' titles before them, from the table of parameters."""
    titles = {}
    for name in ranges:
        meaning, law = FIELDS[name]["meaning"], FIELDS[name]["law"]
        titles[name] = f"{meaning} ({law})" if law and law not in EXCITATIONS and law != "stribeck" else meaning
    return {name: (titles[name], *ends) for name, ends in ranges.items()}


SLIDERS, LAW_SLIDERS = _titled(_SLIDERS), _titled(_LAW_SLIDERS)
_GAIN = 1.5
_LONGEST = 1_000_000  # steps of an episode: nobody looks on for so long
_TRAIL, _HISTORY = 200, 600  # control intervals shown
_LAP = 100  # control intervals of which the amplitude is taken: a little more than a cycle of the nominal plant
_TICK = 60  # milliseconds between frames
_TICKS_A_READING = 4
_IDLE_TICKS = 30_000  # half an hour in which nobody touches a page
_SLOW_TICKS = 10  # work that takes longer is announced
_LEAST_SAVED = 0.02  # a step
BASIN_VIEW = ((-1.6, 1.6), (-1.2, 1.2))  # starts in x and in v
_CURVE_SPEEDS = np.linspace(0.005, 0.6, 48)


def plugins() -> importlib.metadata.EntryPoints:
    """Return the controllers that installed packages offer (entry points of the group ``PLUGINS``), by name."""
    return importlib.metadata.entry_points(group=PLUGINS)


def controllers() -> list[str]:
    """Return the names of all controllers, plugins included."""
    return [OFF, FEEDBACK, AGENT, ROBUST, *sorted(set(plugins().names)), HAND]


# What moves -----------------------------------------------------------------------------------------------------------


@dataclass
class Rider:
    """An environment under a controller, and what it has earned."""

    env: SDFrictionEnv
    policy: Policy
    observation: NDArray[np.float32] | None = None
    state: State = None
    begins: bool = True
    earned: float = 0.0
    info: dict[str, Any] = field(default_factory=dict)

    def start(self, options: Mapping[str, Any]) -> None:
        """Begin an episode."""
        self.observation, self.info = self.env.reset(seed=0, options=dict(options))
        self.state, self.begins, self.earned = None, True, 0.0

    def step(self) -> bool:
        """Let one control interval pass; return whether the episode has ended."""
        assert self.observation is not None
        action, self.state = self.policy.predict(self.observation[None], self.state, np.array([self.begins]))
        self.observation, reward, terminated, truncated, self.info = self.env.step(action[0])
        self.begins = False
        self.earned += float(reward)
        return terminated or truncated


class Live:
    """A running oscillator with a controller that can be switched, and two others beside it from the same start: one
    without control, one under the trained agent, for comparison.

    Args:
        task: "force" or "belt". parameters: of the plant. Controllers know the nominal plant alone.
    """

    def __init__(self, task: str = "belt", parameters: OscillatorParameters | None = None) -> None:
        self.parameters = parameters or OscillatorParameters()
        self.controller = OFF
        self.hand = 0.0
        self.missing: dict[str, str] = {}
        self.choose_task(task)

    def choose_task(self, task: str) -> None:
        """Take another actuator, and begin anew."""
        self.task = task
        self.env_id = f"SDFriction/{TASKS[task]}-v0"
        self.rider, self.idle, self.rival = (self._rider(policy) for policy in (OFF, OFF, AGENT))
        self.choose_controller(self.controller)
        self.restart()

    def _rider(self, controller: str) -> Rider:
        env = gym.make(self.env_id, episode_steps=_LONGEST).unwrapped
        assert isinstance(env, SDFrictionEnv)
        return Rider(env, self._policy(controller))

    def _policy(self, controller: str) -> Policy:
        """Return a controller by its name; one that is not there does nothing, and ``missing`` says why."""
        self.missing.pop(controller, None)
        try:
            if controller == FEEDBACK:
                return VelocityFeedback.from_env(gym.make(self.env_id), _GAIN)
            if controller == AGENT:
                return load_pretrained(self.env_id)
            if controller == ROBUST:
                return load_pretrained(self.env_id.replace("-v0", "Randomised-v0"))
            if controller in plugins().names:
                made: Policy = plugins()[controller].load()(self.env_id)
                return made
        except Exception as error:  # a plugin may raise anything
            self.missing[controller] = f"{controller} is not there: {error}"
            return ZeroPolicy()
        return ConstantPolicy(self.hand) if controller == HAND else ZeroPolicy()

    def choose_controller(self, controller: str) -> None:
        """Switch the controller while the mass moves on; belt at its nominal speed, and the comparison begins anew."""
        self.rider.policy, self.rider.state, self.rider.begins = self._policy(controller), None, True
        self.controller = controller
        if self.rider.observation is not None:
            self.restart(keep=True)

    def steer(self, action: float) -> None:
        """Set what is done by hand, an action in [-1, 1].

        Raises:
            ValueError: if it is not a number.
        """
        if np.isnan(action):
            raise ValueError(f"action must be in [-1, 1], got {action!r}")
        self.hand = float(np.clip(action, -1.0, 1.0))
        if self.controller == HAND:
            self.rider.policy = ConstantPolicy(self.hand)

    def change(self, **values: Any) -> None:
        """Change parameters of the plant; the mass goes on from where it is, on a belt at its nominal speed.

        Raises:
            ValueError: if they do not fit together; nothing is then changed.
        """
        before, self.parameters = self.parameters, self.parameters.replace(**values)
        try:
            self.restart(keep=True)
        except ValueError:
            self.parameters = before
            raise

    def restart(self, *, keep: bool = False) -> None:
        """Begin again on the passive cycle, or from where the mass is now."""
        options: dict[str, Any] = {"parameters": dataclasses.asdict(self.parameters)}
        if keep and self.rider.info and max(abs(self.rider.info["x"]), abs(self.rider.info["v"])) <= STATE_LIMIT:
            options |= {"x": self.rider.info["x"], "v": self.rider.info["v"]}
        else:
            options["phase"] = 0.0
        for rider in (self.rider, self.idle, self.rival):
            rider.start(options)
        self.steps = 0

    def advance(self, intervals: int) -> dict[str, list[float]]:
        """Let control intervals pass; return t, x, v, v_belt, action and stick (0 or 1) at the end of each.

        A mass that loses contact is put back on its cycle; there is then nothing to return.
        """
        rows: dict[str, list[float]] = {name: [] for name in ("t", "x", "v", "v_belt", "action", "stick")}
        for _ in range(intervals):
            ended = [rider.step() for rider in (self.rider, self.idle, self.rival)]
            self.steps += 1
            info = self.rider.info
            rows["t"].append(self.steps * self.rider.env.task.control_interval)
            for name in ("x", "v", "v_belt", "action"):
                rows[name].append(float(info[name]))
            rows["stick"].append(float(info["stick_fraction"] > 0.5))
            if any(ended):
                self.restart()
                return {name: [] for name in rows}
        return rows

    def costs(self) -> dict[str, float]:
        """Return the mean cost per step since the comparison began: now, without control, the trained agent's."""
        n = max(self.steps, 1)
        earned = {"now": self.rider.earned, "without control": self.idle.earned, AGENT: self.rival.earned}
        return {name: -value / n for name, value in earned.items()}

    def share(self) -> float:
        """Return how much of what the trained agent saves is saved now: 0 as without control, 1 as the agent; NaN where
        it has next to nothing to save."""
        now, without, agent = self.costs().values()
        return (without - now) / (without - agent) if without > agent + _LEAST_SAVED else float("nan")


# What does not move ---------------------------------------------------------------------------------------------------


def passive_cycle(parameters: OscillatorParameters) -> LimitCycle | None:
    """Return the passive limit cycle, without excitation; None if there is none that can be named."""
    try:
        return limit_cycle(parameters.unexcited)
    except OrbitError:
        return None


def passive_curve(
    parameters: OscillatorParameters, speeds: NDArray[np.float64] = _CURVE_SPEEDS
) -> dict[str, NDArray[np.float64]]:
    """Return belt speeds and passive amplitudes, without excitation, NaN where there is none."""
    table = amplitude_curve(parameters.unexcited, speeds)
    return {"belt_speed": table["belt_speed"], "amplitude": table["amplitude"]}


@functools.cache
def _compile_steps(kind: Kind) -> None:
    """Compile what an episode of such plants calls, so that no page waits for it in the server's own thread."""
    geometry, alpha = ("exact", 0.0) if kind.geometry == "discontinuous" else (kind.geometry, 0.8)
    Live(parameters=OscillatorParameters(geometry=geometry, alpha=alpha, friction=kind.friction)).advance(1)


@dataclass(frozen=True)
class PlantPicture:
    """What the page shows of a plant that does not move: the amplitude over the belt speed, and the limit cycle."""

    parameters: OscillatorParameters
    curve: dict[str, NDArray[np.float64]]
    cycle: LimitCycle | None

    @classmethod
    def of(cls, parameters: OscillatorParameters) -> "PlantPicture":
        """Compute it."""
        _compile_steps(parameters.unexcited.kind)
        return cls(parameters, passive_curve(parameters), passive_cycle(parameters))


class Latest:
    """Work in the background of which only the newest request counts.

    At most one piece of work runs and at most one waits; a newer request takes the place of the one that waits.
    Nothing happens but in :meth:`poll`, so that a page is touched by the server's own thread alone.

    Args:
        show: is given the future of each piece of work that is done. executor: runs it (a thread of its own).
    """

    def __init__(self, show: Callable[[Future[Any]], None], executor: Executor | None = None) -> None:
        self.show = show
        self.executor = executor or ThreadPoolExecutor(1)  # compiled code lets the server go on meanwhile
        self.waiting: Callable[[], Any] | None = None
        self.running: Future[Any] | None = None
        self.polls = 0  # since the running work began

    def ask(self, work: Callable[[], Any]) -> None:
        """Have this done next, and nothing that was asked for before and has not begun."""
        self.waiting = work

    def poll(self) -> None:
        """Show what is done, and begin what waits."""
        self.polls += 1
        if self.running is not None and self.running.done():
            done, self.running = self.running, None
            self.show(done)
        if self.running is None and self.waiting is not None:
            work, self.waiting, self.polls = self.waiting, None, 0
            self.running = self.executor.submit(work)

    def end(self) -> None:
        """Forget what waits; what runs is not shown any more."""
        self.waiting = self.running = None
        self.executor.shutdown(wait=False, cancel_futures=True)


def basin_picture(parameters: OscillatorParameters) -> tuple[NDArray[np.float64], str]:
    """Return where each start of a grid over ``BASIN_VIEW`` ends, shape (80, 120): the number of its attractor, NaN
    where contact is lost or it is not decided; and in words what there is. Without excitation."""
    _, _, found = basin_grid(parameters.unexcited, *BASIN_VIEW, (120, 80))
    words = ["Without excitation:"] if parameters.excited else []
    for i, cycle in enumerate(found.attractors):
        place = 0.5 * (cycle.x_max + cycle.x_min)
        words.append(
            f"{found.fraction(i)[0]:.0%} of the starts: {cycle.kind} round {place:.2f}, A = {cycle.amplitude:.3f}"
        )
    return np.where(found.labels >= 0, found.labels, np.nan).astype(float), "<br>".join(words)


# The page -------------------------------------------------------------------------------------------------------------


def require_bokeh() -> None:
    """Raise unless Bokeh is installed.

    Raises:
        ImportError: saying what to install.
    """
    try:
        import bokeh  # noqa: F401
    except ImportError:
        raise ImportError('the explorer needs bokeh: pip install "sd-friction-env[explore]"') from None


_STYLE = """
:host { font: 14px/1.4 system-ui, sans-serif; color: #202020; }
b { font-weight: 650; } .big { font-size: 22px; font-weight: 650; }
.stick { color: #0072B2; } .slip { color: #D55E00; }
table { border-collapse: collapse; } td { padding: 1px 14px 1px 0; }
.number { text-align: right; font-variant-numeric: tabular-nums; }
.warn { border-left: 4px solid #D55E00; padding-left: 8px; }
"""


class Page:
    """One browser's page: its own oscillator, its widgets, and a tick that moves both on.

    The widgets are what the user asks for. Their events do no work: each tick looks at what they show by then, so
    that of many moves the last one counts. What takes longer than a frame is done in the background, one piece of each
    kind at a time.

    Args:
        document: that the page is drawn into. on_idle: is called when nobody has touched the page for half an hour.
    """

    def __init__(self, document: Any, on_idle: Callable[[], None] = lambda: None) -> None:
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

        self.document, self.on_idle = document, on_idle
        self.live = Live()
        self.plant = self.live.parameters  # asked for; that of the oscillator as soon as its picture is there
        self.plant_work = Latest(self._show_plant)
        self.basin_work = Latest(self._show_basins)
        self.ended = False
        self.idle_ticks = 0
        self.clicked: set[str] = set()  # buttons, since the last tick
        self.style = InlineStyleSheet(css=_STYLE)
        self.speed = 4  # control intervals a tick
        self.geometry = Select(options=list(GEOMETRIES), value=self.live.parameters.geometry, title="geometry")
        self.friction = Select(
            options=list(FRICTIONS), value=self.live.parameters.friction, title="friction law", name="friction"
        )
        empty: dict[str, list[float]] = {name: [] for name in ("t", "x", "v", "v_belt", "action", "stick")}
        self.past: dict[str, deque[float]] = {name: deque(maxlen=_HISTORY) for name in empty}
        self.ticks = 0
        self.path = ColumnDataSource(empty, name="path")
        self.trail = ColumnDataSource({"x": [], "v": []}, name="trail")
        self.mass = ColumnDataSource({"x": [0.0], "v": [0.0], "color": [VERMILION]}, name="mass")
        self.cycle = ColumnDataSource({"x": [], "v": []}, name="cycle")
        self.line = ColumnDataSource({"x": [-5.0, 5.0], "v": [0.0, 0.0]}, name="line")
        self.curve = ColumnDataSource({"belt_speed": [], "amplitude": []}, name="curve")
        self.point = ColumnDataSource({"belt_speed": [], "amplitude": [], "color": []}, name="point")
        self.basins = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []}, name="basins")
        self.spring = ColumnDataSource({"x": [], "y": []}, name="spring")
        self.marks = ColumnDataSource({"x": [], "y": []}, name="marks")
        self.anchor = ColumnDataSource({"x": [], "v": []})
        self.body = ColumnDataSource({"x": [], "y": [], "color": []})
        self.arrows = ColumnDataSource({"x0": [], "y0": [], "x1": [], "y1": [], "color": []})

        self.sliders = {
            name: Slider(
                title=title, start=low, end=high, step=step, value=getattr(self.live.parameters, name), name=name
            )
            for name, (title, low, high, step) in (SLIDERS | LAW_SLIDERS).items()
        }
        self.sliders["belt_speed"].format = "0.000"
        self.plant_widgets: dict[str, Any] = {**self.sliders, "geometry": self.geometry, "friction": self.friction}
        self.task = RadioButtonGroup(labels=["push the mass (force)", "drive the belt"], active=1, name="task")
        self.controller = Select(options=controllers(), value=OFF, title="controller", name="controller")
        self.hand = Slider(title="by hand: action", start=-1, end=1, step=0.05, value=0, name="hand")
        pushes = [Button(label=label, name=f"hand {value}") for label, value in (("◀ -1", -1), ("0", 0), ("+1 ▶", 1))]
        for button, value in zip(pushes, (-1.0, 0.0, 1.0), strict=True):
            button.on_click(lambda value=value: self._take_over(value))
        restart = Button(label="squeal again", button_type="primary", name="restart")
        restart.on_click(lambda: self.clicked.add("restart"))
        nominal = Button(label="nominal plant", name="nominal")
        nominal.on_click(self._nominal)
        basins = Button(label="basins", name="basins button")
        basins.on_click(lambda: self.clicked.add("basins"))
        self.pause = Toggle(label="pause", name="pause")
        self.readout = Div(name="readout", stylesheets=[self.style], width=330, height=160)
        self.message = Div(name="message", stylesheets=[self.style], width=500)
        title = Div(
            text="<span class='big'>Stick, slip, and what control does about it</span><br>A mass on a spring rides a "
            "moving belt. Friction that falls with speed makes it squeal. Stop it, by a small force or by the belt's "
            "speed.",
            stylesheets=[self.style],
            width=1330,
        )
        left = column(
            self.task,
            self.controller,
            self.hand,
            row(*pushes, width=330),
            row(restart, self.pause, width=330),
            self.readout,
            Tabs(
                tabs=[
                    TabPanel(
                        title="plant", child=column(*(self.sliders[name] for name in SLIDERS), self.geometry, width=330)
                    ),
                    TabPanel(
                        title="other friction, excitation",
                        child=column(self.friction, *(self.sliders[name] for name in LAW_SLIDERS), width=330),
                    ),
                ]
            ),
            row(nominal, basins, width=330),
            width=340,
        )
        middle = column(self._machine(), self._portrait(), self.message)
        right = column(self._history(), self._amplitudes())
        document.add_root(column(title, row(left, middle, right, spacing=12)))
        document.title = "sd_friction_env explorer"
        self.requests = self._requests()
        self._draw_plant(PlantPicture.of(self.plant))
        self.ticking = document.add_periodic_callback(self.tick, _TICK)
        document.on_session_destroyed(lambda context: self.end())

    # Figures

    def _figure(self, title: str, x: str, y: str, width: int, height: int, **arguments: Any) -> Any:
        from bokeh.plotting import figure

        plot = figure(title=title, width=width, height=height, toolbar_location=None, tools="", **arguments)
        plot.xaxis.axis_label, plot.yaxis.axis_label = x, y
        plot.grid.grid_line_alpha = 0.4
        plot.outline_line_color = None
        for axis in plot.axis:
            axis.axis_label_text_font_style = "normal"
        return plot

    def _machine(self) -> Any:
        plot = self._figure("", "", "", 500, 230, x_range=(-1.6, 1.9), y_range=(-0.35, 1.3), match_aspect=True)
        plot.axis.visible = False
        plot.grid.visible = False
        plot.line([-1.6, 1.9], [-0.16, -0.16], line_width=6, color="#404850")
        plot.scatter("x", "y", source=self.marks, marker="dash", angle=np.pi / 2, size=12, line_width=2, color="white")
        plot.line("x", "y", source=self.spring, line_width=2, color=BLACK)
        plot.scatter("x", "v", source=self.anchor, size=10, marker="inverted_triangle", color=BLACK)
        plot.rect("x", "y", width=0.24, height=0.2, source=self.body, color="color", fill_alpha=0.85)
        plot.segment("x0", "y0", "x1", "y1", source=self.arrows, color="color", line_width=4)
        plot.scatter("x1", "y1", source=self.arrows, size=9, color="color")
        return plot

    def _portrait(self) -> Any:
        from bokeh.palettes import Cividis

        plot = self._figure(
            "phase portrait", "displacement x", "velocity v", 500, 400, x_range=(-1.6, 1.6), y_range=(-0.9, 0.9)
        )
        plot.image("image", x="x", y="y", dw="dw", dh="dh", source=self.basins, palette=Cividis[11], alpha=0.5)
        plot.line(
            "x", "v", source=self.line, line_dash="dotted", color=BLACK, line_width=1.5, legend_label="stick line"
        )
        plot.line(
            "x", "v", source=self.cycle, line_dash="dashed", color=GREY, line_width=2, legend_label="passive cycle"
        )
        plot.line("x", "v", source=self.trail, color=GREEN, line_width=2.5, legend_label="now")
        plot.scatter("x", "v", source=self.mass, size=13, color="color", line_color="white")
        plot.legend.location = "bottom_left"
        plot.legend.background_fill_alpha = 0.8
        plot.legend.label_text_font_size = "9pt"
        self.portrait = plot
        return plot

    def _history(self) -> Any:
        from bokeh.layouts import column

        time = (-_HISTORY * 0.1, 0.0)
        above = self._figure("displacement (blue where it sticks)", "", "x", 470, 170, x_range=time, y_range=(0, 1))
        above.line("t", "x", source=self.path, color=GREEN, line_width=1.5)
        above.scatter("t", "x", source=self.path, size=4, color=BLUE, alpha="stick")
        below = self._figure("action", "time, now is 0", "a", 470, 130, x_range=above.x_range, y_range=(-1.08, 1.08))
        below.step("t", "action", source=self.path, color=VERMILION, line_width=1.5)
        self.history = above
        return column(above, below)

    def _amplitudes(self) -> Any:
        plot = self._figure(
            "amplitude over belt speed", "belt speed v_b", "amplitude A", 470, 330, x_range=(0, 0.62), y_range=(0, 0.6)
        )
        self.amplitudes = plot
        plot.line("belt_speed", "amplitude", source=self.curve, color=GREY, line_width=2.5, legend_label="passive")
        plot.scatter("belt_speed", "amplitude", source=self.point, size=13, color="color", line_color="white")
        plot.legend.location = "top_left"
        plot.legend.label_text_font_size = "9pt"
        return plot

    # What the user does

    def _requests(self) -> dict[str, Any]:
        """Return what the widgets ask for now."""
        shown = {name: widget.value for name, widget in self.plant_widgets.items()}
        return shown | {"task": self.task.active, "controller": self.controller.value, "hand": self.hand.value}

    def _follow(self) -> None:
        """Do what the widgets ask for now, and not what they asked for in between."""
        before, self.requests = self.requests, self._requests()
        changed = {name for name, value in self.requests.items() if value != before[name]}
        clicked, self.clicked = self.clicked, set()
        self.idle_ticks = 0 if changed or clicked else self.idle_ticks + 1
        if changed & self.plant_widgets.keys():
            with self._said():
                # All that the widgets show, for what was refused before may now fit.
                self.plant = self.plant.replace(**{name: self.requests[name] for name in self.plant_widgets})
                self.plant_work.ask(functools.partial(PlantPicture.of, self.plant))
        if "task" in changed:
            with self._said():
                self.live.choose_task(dict(enumerate(TASKS)).get(self.task.active, self.live.task))
                self._clear()
            self._tell_missing()
        if "hand" in changed:
            self.controller.value = self.requests["controller"] = HAND
            with self._said():
                self.live.steer(self.hand.value)
        if self.controller.value != self.live.controller:
            with self._said():
                self.live.choose_controller(self.controller.value)
                self._clear()
            self._tell_missing()
        if "restart" in clicked:
            with self._said():
                self.live.restart()
                self._clear()
        if "basins" in clicked:
            self.message.text = "The basins are being computed ..."
            plant = self.plant
            self.basin_work.ask(lambda: (plant, *basin_picture(plant)))

    @contextlib.contextmanager
    def _said(self) -> Any:
        """Show on the page what cannot be, instead of raising it."""
        self.message.text = ""
        try:
            yield
        except (ValueError, TypeError, OrbitError) as error:
            self._warn(str(error))

    def _warn(self, text: str) -> None:
        self.message.text = f"<div class='warn'>{html.escape(text)}</div>"

    def _tell_missing(self) -> None:
        chosen = self.live.controller
        if chosen in self.live.missing:
            self._warn(self.live.missing[chosen])

    def _take_over(self, value: float) -> None:
        self.controller.value, self.hand.value = HAND, value

    def _nominal(self) -> None:
        nominal = OscillatorParameters()
        for name, widget in self.plant_widgets.items():
            widget.value = getattr(nominal, name)

    def _show_plant(self, work: Future[PlantPicture]) -> None:
        with self._said():
            picture = work.result()
            self.live.change(**dataclasses.asdict(picture.parameters))
            self._draw_plant(picture)

    def _show_basins(self, work: Future[tuple[OscillatorParameters, NDArray[np.float64], str]]) -> None:
        with self._said():
            plant, image, words = work.result()
            if plant != self.plant:  # it has been changed meanwhile
                return
            (x, x_end), (v, v_end) = BASIN_VIEW
            self._look(0.0, x_end, v_end)
            self.basins.data = {"image": [image], "x": [x], "y": [v], "dw": [x_end - x], "dh": [v_end - v]}
            self.message.text = words

    def end(self) -> None:
        """Stop all work: the browser has left, or nobody has touched the page for long."""
        self.ended = True
        self.plant_work.end()
        self.basin_work.end()

    # What follows

    def _look(self, centre: float, x_reach: float, v_reach: float) -> None:
        self.portrait.x_range.update(start=centre - x_reach, end=centre + x_reach)
        self.portrait.y_range.update(start=-v_reach, end=v_reach)
        self.history.y_range.update(start=centre - x_reach, end=centre + x_reach)

    def _clear(self) -> None:
        for values in self.past.values():
            values.clear()

    def _draw_plant(self, picture: PlantPicture) -> None:
        """Show the curve and the cycle of a plant."""
        self.curve.data = picture.curve
        cycle = picture.cycle
        shape = cycle.points if cycle is not None and cycle.amplitude > 0.0 else np.empty((0, 2))
        place = cycle.x_max if cycle is not None else 0.8
        low = cycle.x_min if cycle is not None else -0.8
        reach = 0.5 * (place - low) + 0.35
        self._look(round(0.5 * (place + low), 1), round(reach, 1), round(0.7 * reach, 1))
        highest = np.nanmax(self.curve.data["amplitude"], initial=0.4)
        self.amplitudes.y_range.end = 0.2 * np.ceil(highest / 0.2 + 0.1)
        closed = np.concatenate([shape, shape[:1]])
        self.cycle.data = {"x": closed[:, 0], "v": closed[:, 1]}
        self.basins.data = {name: [] for name in self.basins.data}
        self.passive = cycle.amplitude if cycle is not None else float("nan")
        self._clear()

    def tick(self) -> None:
        """Do what the user asks for; let a little time pass, and show it."""
        if self.ended:
            if self.idle_ticks > _IDLE_TICKS:  # a tick later, so that the browser has got the message
                self.on_idle()
            return
        self._follow()
        for work in (self.plant_work, self.basin_work):
            work.poll()
        if self.plant_work.running is not None and self.plant_work.polls == _SLOW_TICKS:
            self.message.text = "This plant is being computed; a law that is used for the first time is compiled ..."
        if self.idle_ticks > _IDLE_TICKS:
            self.message.text = "Ended, for nobody has touched this page for half an hour: reload it to go on."
            self.end()
            return
        if self.pause.active:
            return
        live = self.live
        rows = live.advance(self.speed)
        if not rows["t"]:  # it has begun anew
            self._clear()
            return
        for name, values in rows.items():
            self.past[name].extend(values)
        # Time runs from the right: axes that stay as they are need no new layout, most of the work of a frame.
        shown = {name: np.array(values) for name, values in self.past.items()}
        self.path.data = shown | {"t": shown["t"] - live.steps * live.rider.env.task.control_interval}
        self.trail.data = {name: shown[name][-_TRAIL:] for name in ("x", "v")}
        info = live.rider.info
        sticks = info["stick_fraction"] > 0.5
        color = BLUE if sticks else VERMILION
        x, v, v_belt = (float(info[name]) for name in ("x", "v", "v_belt"))
        self.mass.data = {"x": [x], "v": [v], "color": [color]}
        self.line.data = {"x": [-5.0, 5.0], "v": [v_belt, v_belt]}
        self._draw_machine(x, v_belt, float(info["force"]), live.rider.env.get_state().belt_travel, color)
        lap = shown["x"][-_LAP:]
        whole = len(lap) == _LAP  # of a part of a cycle it would be too small: as if the vibration were suppressed
        amplitude = 0.5 * float(np.ptp(lap)) if whole else float("nan")
        speed = live.parameters.belt_speed
        point = {"belt_speed": [speed], "amplitude": [amplitude], "color": [GREEN]}
        self.point.data = point if whole else {name: [] for name in point}
        self.ticks += 1
        if self.ticks % _TICKS_A_READING:
            return

        def shown_as(value: float, form: str) -> str:
            return format(value, form) if np.isfinite(value) else "-"

        state = "<span class='stick'>■ sticks</span>" if sticks else "<span class='slip'>▲ slips</span>"
        costs = "".join(
            f"<tr><td>{name}</td><td class='number'>{cost:.3f}</td></tr>" for name, cost in live.costs().items()
        )
        passive, saved = shown_as(self.passive, ".3f"), shown_as(live.share(), ".0%")
        self.readout.text = (
            f"<span class='big'>{state}</span> &nbsp; t = {live.steps * 0.1:.0f}<br>"
            f"amplitude <b>{shown_as(amplitude, '.3f')}</b> (passive {passive})"
            f"<table><tr><td>mean cost of a step, from one start</td><td></td></tr>{costs}"
            f"<tr><td>saved, of what the agent saves</td><td class='number'>{saved}</td></tr></table>"
        )

    def _draw_machine(self, x: float, v_belt: float, force: float, travel: float, color: str) -> None:
        alpha = self.live.parameters.alpha
        self.anchor.data = {"x": [0.0], "v": [alpha]}
        along = np.linspace(0.0, 1.0, 25)
        length = max(np.hypot(x, alpha), 1e-9)
        wiggle = 0.05 * np.where((along > 0.1) & (along < 0.9), (-1.0) ** np.arange(25), 0.0)
        across = np.array([alpha, x]) / length  # normal to the spring
        self.spring.data = {"x": x * along + across[0] * wiggle, "y": alpha * (1.0 - along) + across[1] * wiggle}
        self.body.data = {"x": [x], "y": [0.0], "color": [color]}
        # A force at its limit, and the nominal belt speed, make arrows of the same length.
        push = 0.5 * force / self.live.rider.env.task.force_limit
        pull = 0.5 * v_belt / OscillatorParameters().belt_speed
        self.arrows.data = {
            "x0": [x if push else np.nan, -1.4],
            "y0": [0.22, -0.28],
            "x1": [x + push if push else np.nan, -1.4 + pull],
            "y1": [0.22, -0.28],
            "color": [GREEN, "#404850"],
        }
        places = np.arange(-1.6, 1.9, 0.25)
        self.marks.data = {"x": -1.6 + (places + 1.6 + travel) % 3.5, "y": np.full(len(places), -0.16)}


def serve(
    host: str = HOST,
    port: int = PORT,
    *,
    allowed: Iterable[str] = (),
    sessions: int = SESSIONS,
    browser: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Offer the explorer until interrupted.

    Args:
        host: address to listen at; others than this machine can come only if it is not a loopback address.
        port: 0: any that is free. allowed: further names that a request may be for, see
            :func:`server.served_hosts`. sessions: pages at a time, at least 1.
        browser: open one. say: receives the page's address.

    Raises:
        ImportError: if Bokeh is not installed. OSError: if the port is taken. ValueError: if a name is none.
    """
    require_bokeh()
    from sd_friction_env.explorer.server import make_server

    server, address = make_server(host, port, allowed, sessions)
    # Compiled before the first page asks for it.
    PlantPicture.of(OscillatorParameters())
    begun = time.perf_counter()
    passive_curve(OscillatorParameters())
    took = time.perf_counter() - begun
    server.start()
    say(f"The explorer is at {address} (a curve takes {1e3 * took:.0f} ms); Ctrl-C ends it.")
    if browser:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        say("")
    finally:
        server.stop()
