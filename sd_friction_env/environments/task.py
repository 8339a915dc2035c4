"""The control task: actuator, start, sensing, randomisation and reward weights."""

import dataclasses
import functools
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.orbits import LimitCycle, OrbitError, equilibria, limit_cycle, rest_place
from sd_friction_env.physics.parameters import (
    EXCITATIONS,
    FIELDS,
    RANGES,
    SMALLEST_ALPHA,
    STATE_LIMIT,
    Kind,
    OscillatorParameters,
    checked_choice,
    checked_count,
    checked_number,
)

Actuator = Literal["force", "belt_speed"]
Start = Literal["cycle", "rest", "random"]
Sensor = Literal["state", "position"]

FloatArray: TypeAlias = NDArray[np.float64]
IntegerArray: TypeAlias = NDArray[np.int64]

ACTUATOR_CODES = {"force": kernel.FORCE, "belt_speed": kernel.BELT_SPEED}
RANDOMISABLE = (  # the position in this list selects a parameter's random numbers
    *("alpha", "g1", "beta", "mu_s", "mu_m", "v_m", "belt_speed", "mu_k", "delta", "v_0", "mu_v", "kappa"),
    *(f"{kind}_{what}" for kind in EXCITATIONS for what in ("amplitude", "frequency", "phase")),
    "linear_stiffness",
)

# Slots of the counter-based generator at step 0 of an episode; sensor noise uses steps from 1 on.
PHASE_SLOT, _X_SLOT, _V_SLOT, _PARAMETER_SLOT = 0, 1, 2, 8
_LAW_SLOT = 1024  # first slot of the parameters of user-defined laws

_RANGES: dict[str, tuple[float, float]] = {
    "force_limit": (0.0, 100.0),
    "belt_authority": (0.0, 1.0),
    "belt_acceleration_limit": (0.0, 1e6),
    "control_interval": (1e-4, 10.0),
    "w_effort": (0.0, 1e6),
    "w_stick": (0.0, 1e6),
    "kick": (-STATE_LIMIT, STATE_LIMIT),
    "sensor_noise": (0.0, STATE_LIMIT),
    "contact_loss_cost": (0.0, 1e6),
    "observation_limit": (1e-3, 1e6),
}
EPISODE_STEPS = (1, 10**9)
_COUNTS: dict[str, tuple[int, int]] = {"episode_steps": EPISODE_STEPS, "sensor_delay": (0, 1000)}
_SCALES: dict[str, tuple[float, float]] = {"x_offset": (-1e12, 1e12), "x_scale": (1e-9, 1e12), "v_scale": (1e-9, 1e12)}


@dataclass(frozen=True, kw_only=True)
class Task:
    """Control task on an oscillator (dimensionless).

    Attributes:
        actuator: "force" (u = force_limit * action) or "belt_speed" (the target of the belt speed is
            (1 + belt_authority * action) * belt_speed).
        force_limit: largest control force, in [0, 100].
        belt_authority: largest relative change of the belt speed, in [0, 1].
        belt_acceleration_limit: largest acceleration of the belt, in [0, 1e6].
        control_interval: time for which an action is held, in [1e-4, 10].
        episode_steps: control intervals after which an episode is truncated, in [1, 1e9].
        w_effort, w_stick: weights of the squared action and of the stick fraction, in [0, 1e6].
        start: "cycle" (random phase of the passive limit cycle, or, without a cycle, the equilibrium with ``kick``),
            "rest" (equilibrium of the unloaded spring, v = 0) or "random" (x within 3 x_scale of x_offset, v within
            4 v_scale of 0).
        kick: initial velocity of a mass that starts at its equilibrium, in [-10, 10].
        randomise: ranges (low, high) of parameters drawn uniformly at each reset, by name; parameters of a user-defined
            law as ``friction.NAME`` or ``geometry.NAME``.
        drift: ranges (low, high) of the values that parameters reach at the end of an episode, drawn uniformly at each
            reset, by name as in ``randomise`` but for ``belt_speed``. A parameter changes linearly from its value at
            the reset, in steps at the control intervals.
        show_parameters: whether the observation ends with the randomised parameters, each scaled to [-1, 1].
        show_phases: whether the observation has the cosine and sine of the phase of each excitation (force, ripple,
            stiffness).
        sensor: "state" (x, v and, with the belt actuator, the belt modulation) or "position" (x only).
        sensor_noise: standard deviation of the noise on x (and v), in [0, 10].
        sensor_delay: delay of the sensor in control intervals, in [0, 1000].
        contact_loss_cost: smallest cost of each remaining step when contact is lost, in [0, 1e6]; the largest cost per
            step of the episode replaces it if that is larger.
        observation_limit: observations are clipped to [-observation_limit, observation_limit], in [1e-3, 1e6].
        x_offset, x_scale, v_scale: observations are (x - x_offset)/x_scale and v/v_scale. None: equilibrium, half the
            amplitude and half the belt speed of the nominal plant's passive motion. An episode's own parameters never
            enter, because the scales would reveal them.

    Raises:
        TypeError, ValueError: if an argument has the wrong type or is out of range.
    """

    actuator: Actuator = "force"
    force_limit: float = 0.05
    belt_authority: float = 0.5
    belt_acceleration_limit: float = 0.5
    control_interval: float = 0.1
    episode_steps: int = 500
    w_effort: float = 0.1
    w_stick: float = 0.5
    start: Start = "cycle"
    kick: float = 0.1
    randomise: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    drift: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    show_parameters: bool = False
    show_phases: bool = False
    sensor: Sensor = "state"
    sensor_noise: float = 0.0
    sensor_delay: int = 0
    contact_loss_cost: float = 10.0
    observation_limit: float = 10.0
    x_offset: float | None = None
    x_scale: float | None = None
    v_scale: float | None = None

    def __post_init__(self) -> None:
        checked_choice("actuator", self.actuator, get_args(Actuator))
        checked_choice("start", self.start, get_args(Start))
        checked_choice("sensor", self.sensor, get_args(Sensor))
        for name, (low, high) in _RANGES.items():
            object.__setattr__(self, name, checked_number(name, getattr(self, name), low, high))
        for name, (first, last) in _COUNTS.items():
            object.__setattr__(self, name, checked_count(name, getattr(self, name), first, last))
        for name, (low, high) in _SCALES.items():
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, checked_number(name, value, low, high))
        for name in ("show_parameters", "show_phases"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name} must be True or False, got {getattr(self, name)!r}")
        object.__setattr__(self, "randomise", _checked_ranges("randomise", self.randomise))
        object.__setattr__(self, "drift", _checked_ranges("drift", self.drift))
        if "belt_speed" in self.drift:
            raise ValueError("drift cannot change 'belt_speed': actions and rewards are relative to it")

    @classmethod
    def field_names(cls) -> tuple[str, ...]:
        """Return the names of all fields."""
        return tuple(field.name for field in dataclasses.fields(cls))

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any]) -> Self:
        """Return a task from keyword arguments.

        Raises:
            TypeError: if a name is unknown.
        """
        unknown = sorted(set(arguments) - set(cls.field_names()))
        if unknown:
            # Gymnasium looks for Python's own wording when it tries optional arguments.
            allowed = ", ".join(("parameters", "reward", "render_mode", "render_size", *cls.field_names()))
            hint = f"; pass parameters={{{unknown[0]!r}: ...}}" if unknown[0] in FIELDS else ""
            raise TypeError(f"__init__() got an unexpected keyword argument {unknown[0]!r}{hint}; allowed: {allowed}")
        return cls(**arguments)

    @property
    def authority(self) -> float:
        """Actuator command at an action of 1: ``force_limit`` or ``belt_authority``."""
        return self.force_limit if self.actuator == "force" else self.belt_authority

    @property
    def sees_belt(self) -> bool:
        """Whether the observation has the belt modulation."""
        return self.sensor == "state" and self.actuator == "belt_speed"

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the parameters that the observation shows."""
        return tuple(self.randomise) if self.show_parameters else ()

    @property
    def observation_size(self) -> int:
        """Number of entries of an observation."""
        phases = 2 * len(EXCITATIONS) if self.show_phases else 0
        return 1 + (self.sensor == "state") + self.sees_belt + phases + len(self.shown)

    @property
    def always_excited(self) -> bool:
        """Whether plants count as excited even at amplitude 0: phases are shown, or an amplitude drifts."""
        return self.show_phases or any(f"{means}_amplitude" in self.drift for means in EXCITATIONS)

    def kind_of(self, parameters: OscillatorParameters) -> Kind:
        """Return the kind of an episode's plant."""
        kind = parameters.kind
        return kind._replace(excited=kind.excited or self.always_excited)

    def actuator_of(self, parameters: OscillatorParameters) -> kernel.Actuator:
        """Return what an action does to this plant, as the kernel takes it."""
        return kernel.Actuator(
            ACTUATOR_CODES[self.actuator],
            self.authority,
            self.belt_acceleration_limit,
            parameters.belt_speed,
            self.control_interval,
            self.w_effort,
            self.w_stick,
        )

    def arrays(self) -> tuple[FloatArray, IntegerArray]:
        """Return the task as the kernel takes it: its floats and its codes (:mod:`sd_friction_env.kernel.rows`)."""
        numbers = np.zeros(kernel.TASK_NUMBERS)
        numbers[kernel.TASK_AUTHORITY] = self.authority
        numbers[kernel.TASK_A_LIMIT] = self.belt_acceleration_limit
        numbers[kernel.TASK_INTERVAL] = self.control_interval
        numbers[kernel.TASK_W_EFFORT] = self.w_effort
        numbers[kernel.TASK_W_STICK] = self.w_stick
        numbers[kernel.TASK_CONTACT_LOSS_COST] = self.contact_loss_cost
        numbers[kernel.TASK_LIMIT] = self.observation_limit
        numbers[kernel.TASK_X_OFFSET] = self.x_offset
        numbers[kernel.TASK_X_SCALE] = self.x_scale
        numbers[kernel.TASK_V_SCALE] = self.v_scale
        numbers[kernel.TASK_BELT_AUTHORITY] = self.belt_authority or 1.0
        numbers[kernel.TASK_SENSOR_NOISE] = self.sensor_noise
        codes = np.zeros(kernel.TASK_CODES, np.int64)
        codes[kernel.TASK_ACTUATOR] = ACTUATOR_CODES[self.actuator]
        codes[kernel.TASK_EPISODE_STEPS] = self.episode_steps
        codes[kernel.TASK_LATE_STEPS] = steps_before_last_quarter(self.episode_steps)
        codes[kernel.TASK_FULL_STATE] = self.sensor == "state"
        codes[kernel.TASK_SEES_BELT] = self.sees_belt
        codes[kernel.TASK_SENSOR_DELAY] = self.sensor_delay
        codes[kernel.TASK_SEES_PHASES] = self.show_phases
        codes[kernel.TASK_TRAVEL] = True
        codes[kernel.TASK_SHOWS] = len(self.shown)
        return numbers, codes

    def with_scales(self, nominal: OscillatorParameters) -> Self:
        """Return the task with each observation scale that is None set from the nominal plant's unexcited motion."""
        if None not in (self.x_offset, self.x_scale, self.v_scale):
            return self
        nominal = nominal.unexcited
        cycle = passive_motion(nominal)
        places = equilibria(nominal)
        place = 0.5 * (cycle.x_max + cycle.x_min) if cycle else 0.0
        if places:
            place = min((e.x for e in places), key=lambda x: abs(x - place))
        size = 0.5 * cycle.amplitude if cycle and cycle.amplitude > 1e-3 else 0.25
        return dataclasses.replace(
            self,
            x_offset=place if self.x_offset is None else self.x_offset,
            x_scale=size if self.x_scale is None else self.x_scale,
            v_scale=0.5 * nominal.belt_speed if self.v_scale is None else self.v_scale,
        )

    @property
    def scales(self) -> tuple[float, float, float]:
        """``x_offset``, ``x_scale`` and ``v_scale`` of an environment's task, where none is None."""
        assert self.x_offset is not None
        assert self.x_scale is not None
        assert self.v_scale is not None
        return self.x_offset, self.x_scale, self.v_scale

    def draws(self, keys: IntegerArray, episodes: IntegerArray) -> dict[str, FloatArray]:
        """Return the values drawn for the randomised parameters of n episodes, by name, each (n,).

        Args:
            keys, episodes: (n,), whole numbers; the values of an episode depend on its own key and number only.
        """
        return {name: _drawn(name, limits, keys, episodes) for name, limits in self.randomise.items()}

    def drift_ends(self, keys: IntegerArray, episodes: IntegerArray) -> dict[str, FloatArray]:
        """Return the values that drifting parameters reach at the end of n episodes, by name, each (n,)."""
        return {name: _drawn(f"drift {name}", limits, keys, episodes) for name, limits in self.drift.items()}

    def phases(self, keys: IntegerArray, episodes: IntegerArray) -> FloatArray:
        """Return the phases of the passive cycle at which n episodes start, (n,)."""
        phases: FloatArray = kernel.random_uniforms(keys, episodes, 0, PHASE_SLOT)
        return phases

    def random_states(self, keys: IntegerArray, episodes: IntegerArray) -> tuple[FloatArray, FloatArray]:
        """Return the states x and v, each (n,), at which n episodes with the start "random" begin."""
        x_offset, x_scale, v_scale = self.scales
        x_share = 2.0 * kernel.random_uniforms(keys, episodes, 0, _X_SLOT) - 1.0
        v_share = 2.0 * kernel.random_uniforms(keys, episodes, 0, _V_SLOT) - 1.0
        return x_offset + 3.0 * x_scale * x_share, 4.0 * v_scale * v_share

    def drawn_parameters(self, nominal: OscillatorParameters, key: int, episode: int) -> OscillatorParameters:
        """Return an episode's parameters: the nominal ones with the randomised ones drawn."""
        if not self.randomise:
            return nominal
        drawn = self.draws(np.array([key]), np.array([episode]))
        return nominal.replace(**{name: float(values[0]) for name, values in drawn.items()})

    def shown_parameters(self, values: Mapping[str, Any]) -> FloatArray:
        """Return the randomised parameters as observations show them, (p, n) or (p,).

        Args:
            values: of all parameters, by name, arrays (n,) or numbers.
        """
        rows = []
        for name, (low, high) in self.randomise.items():
            own = np.asarray(values[name])
            scaled = 2.0 * (own - low) / (high - low) - 1.0 if high > low else np.zeros_like(own)
            rows.append(np.clip(scaled, -self.observation_limit, self.observation_limit))
        return np.array(rows)

    def start_state(self, parameters: OscillatorParameters, key: int, episode: int) -> tuple[float, float]:
        """Return the (x, v) at which an episode starts."""
        if self.start == "rest":
            return rest_place(parameters), 0.0
        keys, episodes = np.array([key]), np.array([episode])
        if self.start == "random":
            x, v = self.random_states(keys, episodes)
            return float(x[0]), float(v[0])
        return self.cycle_state(parameters, float(self.phases(keys, episodes)[0]))

    def cycle_state(self, parameters: OscillatorParameters, phase: float) -> tuple[float, float]:
        """Return the state at a phase in [0, 1] of the passive cycle, or, without a cycle, the kicked equilibrium."""
        parameters = parameters.unexcited
        cycle = passive_motion(parameters)
        if cycle is None:
            places = equilibria(parameters)
            return (places[-1].x if places else rest_place(parameters)), self.kick
        if cycle.amplitude == 0.0:
            return cycle.x_phase0, self.kick
        return cycle.state(phase)


def _drawn(name: str, limits: tuple[float, float], keys: IntegerArray, episodes: IntegerArray) -> FloatArray:
    low, high = limits
    shares: FloatArray = kernel.random_uniforms(keys, episodes, 0, _slot_of(name))
    return low + (high - low) * shares


def drifted(start: Any, end: Any, steps: Any, episode_steps: int) -> Any:
    """Return a drifting parameter after some steps of an episode, from its values at the episode's start and end."""
    return start + (end - start) * (steps / episode_steps)


def _slot_of(name: str) -> int:
    """Return a parameter's slot of the random numbers."""
    if name in RANDOMISABLE:
        return _PARAMETER_SLOT + RANDOMISABLE.index(name)
    return _LAW_SLOT + zlib.crc32(name.encode())


def steps_before_last_quarter(episode_steps: int) -> int:
    """Return the number of an episode's steps before its last quarter."""
    return episode_steps - max(1, episode_steps // 4)


def _checked_ranges(argument: str, ranges: Any) -> dict[str, tuple[float, float]]:
    if not isinstance(ranges, Mapping):
        raise TypeError(f"{argument} must map parameter names to (low, high), got {ranges!r}")
    checked = {}
    for name, interval in ranges.items():
        user_defined = isinstance(name, str) and name.startswith(("friction.", "geometry."))
        if name not in RANDOMISABLE and not user_defined:
            allowed = f"{', '.join(RANDOMISABLE)}, and friction.NAME or geometry.NAME of a user-defined law"
            raise ValueError(f"{argument} has no parameter {name!r}; allowed: {allowed}")
        try:
            low, high = interval
        except (TypeError, ValueError):
            raise ValueError(f"{argument}[{name!r}] must be a pair (low, high), got {interval!r}") from None
        range_of = RANGES.get(name, (-1e12, 1e12))
        low = checked_number(f"{argument}[{name!r}] low", low, *range_of)
        high = checked_number(f"{argument}[{name!r}] high", high, *range_of)
        if low > high:
            raise ValueError(f"{argument}[{name!r}] must have low <= high, got {interval!r}")
        if name == "alpha" and low < SMALLEST_ALPHA and high > 0.0:
            raise ValueError(
                f"{argument}['alpha'] low must be at least {SMALLEST_ALPHA:g} where alpha varies, got {low!r}"
            )
        checked[name] = (low, high)
    return dict(sorted(checked.items()))


@functools.lru_cache(maxsize=4096)
def passive_motion(parameters: OscillatorParameters) -> LimitCycle | None:
    """Return the attractor of the unexcited motion from x = 0, v = v_belt; None if contact is lost or none is found."""
    try:
        return limit_cycle(parameters.unexcited)
    except OrbitError:
        return None


def rig_arguments(
    parameters: OscillatorParameters,
    *,
    sampling_time: float,
    force_limit: float | None = None,
    belt_acceleration_limit: float | None = None,
) -> dict[str, Any]:
    """Convert task arguments from SI units to dimensionless ones.

    Args:
        parameters: of the rig, from :meth:`OscillatorParameters.from_physical`.
        sampling_time: of the controller, s. force_limit: largest control force, N.
        belt_acceleration_limit: of the belt, m/s^2.

    Returns:
        ``control_interval`` and, where given, ``force_limit`` and ``belt_acceleration_limit``, dimensionless.
    """
    arguments = {"control_interval": checked_number("sampling_time", sampling_time, 0.0, 1e9) / parameters.time_scale}
    if force_limit is not None:
        arguments["force_limit"] = checked_number("force_limit", force_limit, 0.0, 1e18) / parameters.force_scale
    if belt_acceleration_limit is not None:
        scale = parameters.length_scale / (parameters.time_scale * parameters.time_scale)
        limit = checked_number("belt_acceleration_limit", belt_acceleration_limit, 0.0, 1e18)
        arguments["belt_acceleration_limit"] = limit / scale
    return arguments
