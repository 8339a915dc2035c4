"""Classical feedback: linear, velocity, filtered, delayed and sliding-mode controllers with saturated actions."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.policy import Actions, State, broadcast_starts, checked_memory, remembered
from sd_friction_env.physics.orbits import equilibria
from sd_friction_env.physics.parameters import OscillatorParameters, checked_number

_Floats = NDArray[np.float64]
_Starts = ArrayLike | None
GAINS = (-1e9, 1e9)


def nearest_equilibrium(parameters: OscillatorParameters, x: float) -> float:
    """Return the steady-slip equilibrium, without excitation, that is nearest to x; x where there is none."""
    return min((place.x for place in equilibria(parameters.unexcited)), key=lambda place: abs(place - x), default=x)


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Conversion of an environment's observations to physical quantities (dimensionless).

    Attributes:
        actuator: "force" or "belt_speed".
        authority: force, or change of the belt's speed, that an action of 1 asks for.
        x_offset, x_scale, v_scale: scales of the observations, as in :class:`Task`.
        x_equilibrium: equilibrium position of the nominal plant on the sliding belt.
        sees_velocity: whether the observation has the velocity (sensor "state").
    """

    actuator: str
    authority: float
    x_offset: float
    x_scale: float
    v_scale: float
    x_equilibrium: float
    sees_velocity: bool

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """Return the readings of an :class:`SDFrictionEnv`, wrapped or not: of its nominal plant, not an episode's.

        Raises:
            TypeError: if it is another kind of environment.
            ValueError: if its actuator has no authority.
        """
        bare = getattr(env, "unwrapped", None)
        task, nominal = getattr(bare, "task", None), getattr(bare, "nominal", None)
        if task is None or nominal is None:
            raise TypeError(f"env must be an SDFrictionEnv, got {env!r}")
        by_force = task.actuator == "force"
        authority = task.force_limit if by_force else task.belt_authority * nominal.belt_speed
        if not authority > 0.0:
            name = "force_limit" if by_force else "belt_authority"
            raise ValueError(f"feedback needs {name} > 0, got {getattr(task, name)!r}")
        return cls(
            actuator=task.actuator,
            authority=authority,
            x_offset=task.x_offset,
            x_scale=task.x_scale,
            v_scale=task.v_scale,
            x_equilibrium=nearest_equilibrium(nominal, task.x_offset),
            sees_velocity=task.sensor == "state",
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Quantities that :meth:`read` returns, in order."""
        belt = ("belt modulation",) if self.sees_velocity and self.actuator == "belt_speed" else ()
        return ("x - x_equilibrium", *(("v",) if self.sees_velocity else ()), *belt)

    def read(self, observation: ArrayLike) -> _Floats:
        """Return the quantities :attr:`names`, shape (..., k), without shown phases and parameters.

        The belt modulation is (v_belt/belt_speed - 1)/belt_authority.

        Raises:
            ValueError: if the observations are too short.
        """
        values = np.asarray(observation, dtype=np.float64)
        size = len(self.names)
        if values.ndim < 1 or values.shape[-1] < size:
            raise ValueError(f"observation must have at least {size} entries ({', '.join(self.names)})")
        values = values[..., :size].copy()
        values[..., 0] = values[..., 0] * self.x_scale + (self.x_offset - self.x_equilibrium)
        if self.sees_velocity:
            values[..., 1] *= self.v_scale
        return values

    def states(self, values: _Floats, belt_speed: float) -> _Floats:
        """Return the states (x, v, v_belt), shape (..., 3), of readings (..., k) with the velocity.

        Args:
            values: as :meth:`read` returns them. belt_speed: nominal.

        Raises:
            ValueError: if one is not finite.
        """
        if not np.isfinite(values).all():
            raise ValueError("observation must be finite")
        states = np.full((*values.shape[:-1], 3), belt_speed)
        states[..., 0] = values[..., 0] + self.x_equilibrium
        states[..., 1] = values[..., 1]
        if values.shape[-1] > 2:
            states[..., 2] += self.authority * values[..., 2]
        return states


@dataclass(frozen=True)
class Feedback:
    """Base of the feedback controllers: checks their numbers, reads observations and clips actions to [-1, 1].

    Attributes:
        readings: of the environment to be controlled.

    Raises:
        TypeError, ValueError: if a number is not as said, the actuator is another one than needed, or the velocity is
            needed and not observed.
    """

    _: KW_ONLY
    readings: Readings = field(repr=False)

    _ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}  # of the controller's numbers, by name
    _needs_velocity: ClassVar[bool] = False
    _needs_belt: ClassVar[bool] = False  # as the actuator

    def __post_init__(self) -> None:
        if self._needs_belt and self.readings.actuator != "belt_speed":
            raise ValueError(f"{type(self).__name__} needs the actuator 'belt_speed', got {self.readings.actuator!r}")
        for name, (low, high) in self._ranges.items():
            object.__setattr__(self, name, checked_number(name, getattr(self, name), low, high))
        if self._needs_velocity and not self.readings.sees_velocity:
            raise ValueError(f"{type(self).__name__} needs the velocity; this sensor sees the position only")

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment; arguments are the class's own, without ``readings``."""
        return cls(*arguments, readings=Readings.from_env(env), **named)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated actions and the memory; see :mod:`sd_friction_env.control.policies`."""
        action, state = self._act(self.readings.read(observation), state, episode_start)
        return np.clip(action, -1.0, 1.0).astype(np.float32)[..., None], state

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        """Return the actions (...), not yet clipped, and the memory, from readings (..., k)."""
        raise NotImplementedError


@dataclass(frozen=True)
class LinearFeedback(Feedback):
    """Saturated linear feedback: action = bias + gains . (x - x_equilibrium, v, belt modulation).

    Attributes:
        gains: action per unit of each quantity in ``readings.names``, each in [-1e9, 1e9].
        bias: action at the equilibrium, in [-1e9, 1e9].
    """

    gains: tuple[float, ...]
    bias: float = 0.0

    _ranges: ClassVar = {"bias": GAINS}

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.readings.names
        if len(self.gains) != len(names):
            raise ValueError(f"gains must be {len(names)} numbers, for {', '.join(names)}; got {self.gains!r}")
        pairs = zip(names, self.gains, strict=True)
        gains = tuple(checked_number(f"gain for {name}", gain, *GAINS) for name, gain in pairs)
        object.__setattr__(self, "gains", gains)

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        action = np.full(values.shape[:-1], self.bias)
        # Term by term: the rounding of a matrix product may depend on the size of the batch.
        for i, gain in enumerate(self.gains):
            action += gain * values[..., i]
        return action, None


@dataclass(frozen=True)
class VelocityFeedback(Feedback):
    """Saturated velocity feedback: force u = -gain v, or belt speed belt_speed + gain v, which follows the mass.

    Attributes:
        gain: force, or change of belt speed, per velocity; in [-1e9, 1e9].
    """

    gain: float

    _ranges: ClassVar = {"gain": GAINS}
    _needs_velocity = True

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        sign = -1.0 if self.readings.actuator == "force" else 1.0
        return (sign * self.gain / self.readings.authority) * values[..., 1], None


@dataclass(frozen=True)
class FilteredFeedback(Feedback):
    """Saturated linear feedback of the position and a velocity estimated from it, for sensors that see x alone.

    The estimate is the difference of two readings over the control interval, smoothed by a first-order filter:
    w <- pole w + (1 - pole) (x - x_before)/control_interval; action = bias + x_gain (x - x_equilibrium) + v_gain w,
    clipped to [-amplitude, amplitude]. With a large ``v_gain`` it is a sliding mode with a boundary layer.

    Attributes:
        x_gain, v_gain: action per unit, in [-1e9, 1e9].
        pole: of the filter, in [0, 0.999]; 0: no smoothing.
        control_interval: time between two readings.
        bias: action at the equilibrium, in [-1e9, 1e9].
        amplitude: largest action, in [0, 1].
    """

    x_gain: float
    v_gain: float
    pole: float
    control_interval: float
    bias: float = 0.0
    amplitude: float = 1.0

    _ranges: ClassVar = {
        **dict.fromkeys(("x_gain", "v_gain", "bias"), GAINS),
        "pole": (0.0, 0.999),
        "amplitude": (0.0, 1.0),
    }

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, at its control interval; see :meth:`Feedback.from_env`."""
        return super().from_env(env, *arguments, control_interval=env.unwrapped.task.control_interval, **named)

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        x = values[..., 0]
        before, estimate = remembered(state, starts, x, np.zeros_like(x))
        estimate = self.pole * estimate + (1.0 - self.pole) * (x - before) / self.control_interval
        action = np.clip(self.bias + self.x_gain * x + self.v_gain * estimate, -self.amplitude, self.amplitude)
        return action, (x, estimate)


@dataclass(frozen=True)
class DelayedFeedback(Feedback):
    """Saturated delayed displacement feedback: action = gain (x(t - delay) - x(t)).

    Until the first delay has passed, it compares with the first reading. Sources: K. Pyragas, Phys. Lett. A 170 (1992)
    421; J. Das and A. K. Mallik, J. Sound Vib. 297 (2006) 578, for friction-driven vibration.

    Attributes:
        gain: action per unit of displacement, in [-1e9, 1e9].
        delay: whole number of control intervals, in [1, 1000].
    """

    gain: float
    delay: int

    _ranges: ClassVar = {"gain": GAINS, "delay": (1.0, 1000.0)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.delay != int(self.delay):
            raise ValueError(f"delay must be a whole number, got {self.delay!r}")
        object.__setattr__(self, "delay", int(self.delay))

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        x = values[..., 0]
        first = np.repeat(x[..., None], self.delay, axis=-1)
        past = first
        if state is not None:
            (past,) = checked_memory(state, first.shape)
            past = np.where(broadcast_starts(starts, x)[..., None], first, past)
        action = self.gain * (past[..., 0] - x)
        return action, (np.concatenate([past[..., 1:], x[..., None]], axis=-1),)


@dataclass(frozen=True)
class SlidingMode(Feedback):
    """Sliding mode with a boundary layer: action = -amplitude sat((v + slope (x - x_equilibrium))/layer).

    Source: J.-J. E. Slotine and W. Li, Applied Nonlinear Control (1991), section 7.2.

    Attributes:
        slope: of the sliding line in the phase plane, in [-1e9, 1e9].
        layer: half-width of the boundary layer in velocity, in [1e-6, 1e6].
        amplitude: largest action, in [-1, 1]; negative for a belt that follows the mass.
    """

    slope: float
    layer: float
    amplitude: float = 1.0

    _ranges: ClassVar = {"slope": GAINS, "layer": (1e-6, 1e6), "amplitude": (-1.0, 1.0)}
    _needs_velocity = True

    def _act(self, values: _Floats, state: State, starts: _Starts) -> tuple[_Floats, State]:
        surface = values[..., 1] + self.slope * values[..., 0]
        return -self.amplitude * np.clip(surface / self.layer, -1.0, 1.0), None
