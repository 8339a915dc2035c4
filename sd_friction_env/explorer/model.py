"""What the explorer shows, without any page: the running oscillator, the curves of its plant, work in the background.

Run as a program, ``python -m sd_friction_env.explorer.model PARAMETERS`` (JSON), it compiles what such a plant needs
into the cache on disk. Compilation holds Python's lock, so a server that compiled by itself would stop answering.
"""

import dataclasses
import importlib.metadata
import json
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.policies import (
    ConstantPolicy,
    EstimatingFollower,
    Policy,
    State,
    VelocityFeedback,
    ZeroPolicy,
)
from sd_friction_env.control.pretrained import load_pretrained
from sd_friction_env.environments.ids import environment_id
from sd_friction_env.environments.single import SDFrictionEnv, make_env
from sd_friction_env.environments.task import passive_motion
from sd_friction_env.physics.basins import basin_grid
from sd_friction_env.physics.charts import filled_regions, stability_chart
from sd_friction_env.physics.curves import amplitude_curve
from sd_friction_env.physics.orbits import LimitCycle
from sd_friction_env.physics.parameters import STATE_LIMIT, Kind, OscillatorParameters
from sd_friction_env.pictures.plotting import BLACK, BLUE, GREEN, GREY, REGIONS, VERMILION

OFF, FEEDBACK, FOLLOWER, HAND = "off", "velocity feedback", "threshold follower", "by hand"
AGENT, ROBUST = "trained agent", "trained agent, robust"
PLUGINS = "sd_friction_env.controllers"  # group of entry points: functions from an environment's id to a policy
BASIN_VIEW = ((-1.6, 1.6), (-1.2, 1.2))  # starts in x and in v
COMPILATION = 15  # seconds, roughly, on a quiet core
CHART_COLUMNS = ("x", "y", "color", "dash")
_CHART_POINTS = 30  # least number on a curve from one end to the other
_GAIN = 1.5
_LONGEST = 1_000_000  # steps of an episode, more than anybody watches
_HISTORY = 600  # control intervals remembered
_LAP = 100  # control intervals of which the amplitude is taken: a little more than a cycle of the nominal plant
_LEAST_SAVED = 0.02  # a step
_AT_REST, _REDUCED = 0.05, 0.5  # of the passive amplitude: below are rest, and a vibration that is reduced
_SMALLEST_PASSIVE = 0.02  # amplitude that these shares refer to at least
_CURVE_SPEEDS = np.linspace(0.005, 0.6, 48)


def plugins() -> importlib.metadata.EntryPoints:
    """Return the controllers that installed packages offer (entry points of the group ``PLUGINS``), by name."""
    return importlib.metadata.entry_points(group=PLUGINS)


def controllers() -> list[str]:
    """Return the names of all controllers, plugins included."""
    return [OFF, FEEDBACK, FOLLOWER, AGENT, ROBUST, *sorted(set(plugins().names)), HAND]


class Sign(NamedTuple):
    """A state in words, as a character, as a marker of Bokeh, and as a colour."""

    words: str
    symbol: str
    marker: str
    color: str


STICKS = Sign("sticks", "■", "square", BLUE)
SLIPS = Sign("slips", "▲", "triangle", VERMILION)
MEASURED = Sign("Measuring one cycle", "○", "circle_cross", GREY)
STICK_SLIP = Sign("Stick-slip vibration", "▲", "triangle", VERMILION)
PURE_SLIP = Sign("Vibration without sticking", "▲", "triangle", VERMILION)
REDUCED = Sign("Reduced vibration", "◆", "diamond", BLACK)
AT_REST = Sign("At rest on the sliding belt", "●", "circle", GREEN)
CARRIED = Sign("Stuck to the stopped belt", "■", "square", BLUE)


# The running oscillator -----------------------------------------------------------------------------------------------


@dataclass
class Loop:
    """An environment under a controller, and the reward so far."""

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
        """Advance one control interval; return whether the episode has ended."""
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

    Attributes:
        past: t, x, v, v_belt, action and stick (0 or 1) at the ends of the last control intervals.
        missing: why a controller is not available, by its name.
    """

    def __init__(self, task: str = "belt", parameters: OscillatorParameters | None = None) -> None:
        self.parameters = parameters or OscillatorParameters()
        self.controller = OFF
        self.hand = 0.0
        self.missing: dict[str, str] = {}
        names = ("t", "x", "v", "v_belt", "action", "stick")
        self.past: dict[str, deque[float]] = {name: deque(maxlen=_HISTORY) for name in names}
        self.choose_task(task)

    def choose_task(self, task: str) -> None:
        """Take another actuator and start again."""
        self.task = task
        self.env_id = environment_id(task)
        self.loop, self.uncontrolled, self.reference = (self._loop(policy) for policy in (OFF, OFF, AGENT))
        self.choose_controller(self.controller)
        self.restart()

    def _loop(self, controller: str) -> Loop:
        return Loop(make_env(self.env_id, {"episode_steps": _LONGEST}), self._policy(controller))

    def _policy(self, controller: str) -> Policy:
        """Return a controller by its name; one that is not available does nothing, and ``missing`` says why."""
        self.missing.pop(controller, None)
        try:
            if controller == FEEDBACK:
                return VelocityFeedback.from_env(make_env(self.env_id), _GAIN)
            if controller == FOLLOWER:
                return EstimatingFollower.from_env(make_env(self.env_id), waits=True)
            if controller == AGENT:
                return load_pretrained(self.env_id)
            if controller == ROBUST:
                return load_pretrained(self.env_id.replace("-v0", "Randomised-v0"))
            if controller in plugins().names:
                made: Policy = plugins()[controller].load()(self.env_id)
                return made
        except Exception as error:  # a plugin may raise anything
            self.missing[controller] = f"{controller} is not available: {error}"
            return ZeroPolicy()
        return ConstantPolicy(self.hand) if controller == HAND else ZeroPolicy()

    def choose_controller(self, controller: str) -> None:
        """Switch the controller while the mass moves on; the belt takes its nominal speed, the comparison restarts."""
        self.loop.policy, self.loop.state, self.loop.begins = self._policy(controller), None, True
        self.controller = controller
        if self.loop.observation is not None:
            self.restart(keep=True)

    def steer(self, action: float) -> None:
        """Set the action taken by hand, in [-1, 1].

        Raises:
            ValueError: if it is not a number.
        """
        if np.isnan(action):
            raise ValueError(f"action must be in [-1, 1], got {action!r}")
        self.hand = float(np.clip(action, -1.0, 1.0))
        if self.controller == HAND:
            self.loop.policy = ConstantPolicy(self.hand)

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
        """Start again on the passive cycle, or from where the mass is now."""
        options: dict[str, Any] = {"parameters": dataclasses.asdict(self.parameters)}
        info = self.loop.info
        if keep and info and max(abs(info["x"]), abs(info["v"])) <= STATE_LIMIT:
            options |= {"x": info["x"], "v": info["v"]}
        else:
            options["phase"] = 0.0
        for loop in (self.loop, self.uncontrolled, self.reference):
            loop.start(options)
        self.steps = 0
        for values in self.past.values():
            values.clear()

    def advance(self, intervals: int) -> dict[str, list[float]]:
        """Advance control intervals; return the new rows of ``past``.

        A mass that loses contact is put back on its cycle; there are then no rows.
        """
        rows: dict[str, list[float]] = {name: [] for name in self.past}
        for _ in range(intervals):
            ended = [loop.step() for loop in (self.loop, self.uncontrolled, self.reference)]
            if any(ended):
                self.restart()
                return {name: [] for name in rows}
            self.steps += 1
            info = self.loop.info
            rows["t"].append(self.steps * self.loop.env.task.control_interval)
            for name in ("x", "v", "v_belt", "action"):
                rows[name].append(float(info[name]))
            rows["stick"].append(float(info["stick_fraction"] > 0.5))
        for name, values in rows.items():
            self.past[name].extend(values)
        return rows

    @property
    def amplitude(self) -> float:
        """Amplitude of the last cycle; NaN while less than one has passed: of a part it would be too small."""
        lap = list(self.past["x"])[-_LAP:]
        return 0.5 * float(np.ptp(lap)) if len(lap) == _LAP else float("nan")

    @property
    def mode(self) -> Sign:
        """Whether the mass sticks or slips now."""
        return STICKS if self.loop.info["stick_fraction"] > 0.5 else SLIPS

    def regime(self, passive: float) -> Sign:
        """Return how the mass has moved during the last cycle, compared with the passive amplitude."""
        amplitude, sticks = self.amplitude, np.mean(list(self.past["stick"])[-_LAP:] or [0.0])
        share = amplitude / max(passive if np.isfinite(passive) else 0.0, _SMALLEST_PASSIVE)
        if np.isnan(amplitude):
            return MEASURED
        if share < _AT_REST:
            return CARRIED if sticks > 0.5 else AT_REST
        if share < _REDUCED:
            return REDUCED._replace(words=f"Vibration reduced to {share:.0%}")
        return STICK_SLIP if sticks else PURE_SLIP

    def costs(self) -> dict[str, float]:
        """Return the mean cost per step since the comparison began: now, without control, the trained agent's."""
        n = max(self.steps, 1)
        loops = {"now": self.loop, "without control": self.uncontrolled, AGENT: self.reference}
        return {name: -loop.earned / n for name, loop in loops.items()}

    def score(self) -> float:
        """Return the share of the trained agent's saving that is reached: 0 without control, 1 as the agent; NaN where
        the agent saves next to nothing."""
        now, without, agent = self.costs().values()
        return (without - now) / (without - agent) if without > agent + _LEAST_SAVED else float("nan")


# The plant's curves ---------------------------------------------------------------------------------------------------


def passive_curve(
    parameters: OscillatorParameters, speeds: NDArray[np.float64] = _CURVE_SPEEDS
) -> dict[str, NDArray[np.float64]]:
    """Return belt speeds and passive amplitudes, without excitation, NaN where there is none."""
    table = amplitude_curve(parameters.unexcited, speeds)
    return {"belt_speed": table["belt_speed"], "amplitude": table["amplitude"]}


def basin_picture(parameters: OscillatorParameters) -> tuple[NDArray[np.float64], str]:
    """Return the attractor's number for each start of a grid over ``BASIN_VIEW``, shape (80, 120), NaN where contact is
    lost or it is not decided; and what there is in words (HTML). Without excitation."""
    _, _, found = basin_grid(parameters.unexcited, *BASIN_VIEW, (120, 80))
    words = ["Without excitation:"] if parameters.excited else []
    for i, cycle in enumerate(found.attractors):
        place = 0.5 * (cycle.x_max + cycle.x_min)
        words.append(
            f"{found.fraction(i)[0]:.0%} of the starts: {cycle.kind} around x = {place:.2f}, A = {cycle.amplitude:.3f}"
        )
    return np.where(found.labels >= 0, found.labels, np.nan).astype(float), "<br>".join(words)


class ChartPicture(NamedTuple):
    """Where a plant squeals over a second parameter and the belt speed, without excitation.

    ``regions`` (polygons) and ``borders`` (lines) are columns x, y, color, dash, and kind or curve; ``reach``: (low,
    high) of the parameter and of the belt speed; ``words``: what is missing.
    """

    parameters: OscillatorParameters
    name: str
    regions: dict[str, list[Any]]
    borders: dict[str, list[Any]]
    reach: tuple[tuple[float, float], tuple[float, float]]
    words: str

    def holds_for(self, parameters: OscillatorParameters) -> bool:
        """Whether another plant lies in the same chart."""
        axes = {name: getattr(self.parameters, name) for name in (self.name, "belt_speed")}
        return parameters.replace(**axes).unexcited == self.parameters.unexcited


def chart_picture(parameters: OscillatorParameters, over: tuple[str, float, float]) -> ChartPicture:
    """Compute the chart of a plant over a parameter, (name, low, high)."""
    chart = stability_chart(parameters.unexcited, over, points=_CHART_POINTS)
    regions: list[tuple[Any, ...]] = [
        (np.append(values, values[::-1]), np.append(low, high[::-1]), REGIONS[kind], "solid", kind)
        for kind, values, low, high in filled_regions(chart)
    ]
    borders: list[tuple[Any, ...]] = []
    for curve, color, dash in (("v_b0", BLUE, "solid"), ("v_b1", VERMILION, "dashed"), ("fold", BLACK, "dotted")):
        for branch in np.unique(chart["branch"][(chart["curve"] == curve) & (chart["branch"] >= 0)]):
            part = (chart["curve"] == curve) & (chart["branch"] == branch)
            borders.append((chart[over[0]][part], chart["belt_speed"][part], color, dash, curve))
    why = dict.fromkeys(chart["reason"][chart["kind"] == "none"].tolist())
    words = "" if borders else "; ".join(why)
    top = max((float(high.max()) for _, _, _, high in filled_regions(chart)), default=1.0)
    columns = _chart_columns("kind", regions), _chart_columns("curve", borders)
    return ChartPicture(parameters, over[0], columns[0], columns[1], (over[1:], (0.0, top)), words)


def _chart_columns(label: str, rows: list[tuple[Any, ...]]) -> dict[str, list[Any]]:
    return {name: [row[i] for row in rows] for i, name in enumerate((*CHART_COLUMNS, label))}


@dataclass(frozen=True)
class PlantPicture:
    """What a page shows of a plant that does not move: the amplitude over the belt speed, and the limit cycle."""

    parameters: OscillatorParameters
    curve: dict[str, NDArray[np.float64]]
    cycle: LimitCycle | None

    @classmethod
    def of(cls, parameters: OscillatorParameters) -> "PlantPicture":
        """Compute it, and load the code that steps such a plant."""
        _load_steps(parameters.kind)
        return cls(parameters, passive_curve(parameters), passive_motion(parameters))

    @classmethod
    def after_compilation(cls, parameters: OscillatorParameters) -> "PlantPicture":
        """Compute it; laws that are new to this process are first compiled by another one."""
        if not is_loaded(parameters):
            values = json.dumps(dataclasses.asdict(parameters))
            subprocess.run([sys.executable, "-m", __name__, values], stderr=subprocess.DEVNULL, check=False)
        return cls.of(parameters)


_loaded: set[Kind] = set()


def is_loaded(parameters: OscillatorParameters) -> bool:
    """Whether this process has the compiled code of a plant's laws."""
    return parameters.kind in _loaded


def _load_steps(kind: Kind) -> None:
    if kind in _loaded:
        return
    geometry, alpha = ("exact", 0.0) if kind.geometry == "discontinuous" else (kind.geometry, 0.8)
    force = 0.1 if kind.excited else 0.0
    plant = OscillatorParameters(geometry=geometry, alpha=alpha, friction=kind.friction, force_amplitude=force)
    Live(parameters=plant).advance(1)
    _loaded.add(kind)


# Work in the background -----------------------------------------------------------------------------------------------


class Latest:
    """Background work of which at most one piece runs and one waits.

    A newer request replaces the one that waits. Results are
    shown by :meth:`poll` alone, so that only the server's own thread touches a page.

    Args:
        show: is given the future of each piece of work that is done.
        wake: called from any thread when work is done, to have :meth:`poll` called soon.
        executor: runs it (a thread of its own).
    """

    def __init__(
        self, show: Callable[[Future[Any]], None], wake: Callable[[], None], executor: Executor | None = None
    ) -> None:
        self.show, self.wake = show, wake
        self.executor = executor or ThreadPoolExecutor(1)  # compiled code lets the server go on meanwhile
        self.waiting: Callable[[], Any] | None = None
        self.running: Future[Any] | None = None
        self.begun = 0.0

    def ask(self, work: Callable[[], Any]) -> None:
        """Have this done next, and nothing that was asked for before and has not begun."""
        self.waiting = work

    def poll(self) -> None:
        """Show what is done, and begin what waits."""
        if self.running is not None and self.running.done():
            done, self.running = self.running, None
            self.show(done)
        if self.running is None and self.waiting is not None:
            work, self.waiting, self.begun = self.waiting, None, time.monotonic()
            self.running = self.executor.submit(work)
            self.running.add_done_callback(lambda _: self.wake())

    @property
    def seconds(self) -> float:
        """Time since the running work began; 0 if none runs."""
        return time.monotonic() - self.begun if self.running is not None else 0.0

    def end(self) -> None:
        """Forget what waits; the result of what runs is not shown any more."""
        self.waiting = self.running = None
        self.executor.shutdown(wait=False, cancel_futures=True)


if __name__ == "__main__":
    asked = OscillatorParameters(**json.loads(sys.argv[1]))
    PlantPicture.of(asked)
    basin_picture(asked)
