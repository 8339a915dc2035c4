"""Controllers with a state of their own: soft belt, super-twisting sliding mode, dither, gain schedule."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.control.policies.feedback import GAINS, Feedback
from sd_friction_env.control.policies.follower import estimate_belt_speed
from sd_friction_env.control.policies.policy import State, remembered
from sd_friction_env.physics.parameters import checked_number

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SampledFeedback(Feedback):
    """Base of the controllers that count time.

    Attributes:
        control_interval: time between two decisions, in [1e-9, 1e9].
    """

    _: KW_ONLY
    control_interval: float

    _ranges: ClassVar = {"control_interval": (1e-9, 1e9)}

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, at its control interval; see :meth:`Feedback.from_env`."""
        task = getattr(getattr(env, "unwrapped", None), "task", None)
        if task is not None:
            named = {"control_interval": task.control_interval} | named
        return super().from_env(env, *arguments, **named)


@dataclass(frozen=True)
class SoftBelt(SampledFeedback):
    """Belt that yields to the load of the mass, as a drive with a given inertia, damper and spring would.

    With w the deviation of the belt's speed from nominal and s its integral: inertia dw/dt = -load - damping w -
    stiffness s. The load is the contact force's deviation from its value at rest, dv/dt + mount_stiffness (x -
    x_equilibrium), with dv/dt from two readings. It is the impedance control of N. Hogan (J. Dyn. Syst. Meas. Control
    107 (1985) 1), and the "soft torque" by which the drives of drill strings absorb torsional waves (J. D. Jansen and
    L. van den Steen, J. Sound Vib. 179 (1995) 647).

    Attributes:
        inertia, damping, stiffness: of the drive, in [1e-9, 1e9], [0, 1e9] and [0, 1e9].
        mount_stiffness: slope of the restoring force at the equilibrium, in [0, 1e9].

    Raises:
        TypeError, ValueError: if a number is not as said, the actuator is a force (which has no belt to yield), or the
            velocity is not observed.
    """

    inertia: float
    damping: float
    stiffness: float
    _: KW_ONLY
    mount_stiffness: float

    _ranges: ClassVar = {
        **SampledFeedback._ranges,
        "inertia": (1e-9, 1e9),
        **dict.fromkeys(("damping", "stiffness", "mount_stiffness"), (0.0, 1e9)),
    }
    _needs_velocity = True
    _needs_belt = True

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, with its nominal mount; see :meth:`Feedback.from_env`."""
        nominal = getattr(getattr(env, "unwrapped", None), "nominal", None)
        if nominal is not None:
            x = named.get("readings", Feedback.from_env(env).readings).x_equilibrium
            named = {"mount_stiffness": float(kernel.restoring_slope(nominal.plant, x))} | named
        return super().from_env(env, *arguments, **named)

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        x, v, w = values[..., 0], values[..., 1], self.readings.authority * values[..., 2]
        before, extension = remembered(state, starts, v, np.zeros_like(v))
        extension = extension + self.control_interval * w
        load = (v - before) / self.control_interval + self.mount_stiffness * x
        acceleration = -(load + self.damping * w + self.stiffness * extension) / self.inertia
        return (w + self.control_interval * acceleration) / self.readings.authority, (v, extension)


@dataclass(frozen=True)
class SuperTwisting(SampledFeedback):
    """Super-twisting sliding mode: action = w - proportional sqrt|s| sign s, dw/dt = -integral sign s.

    It steers s = v + slope (x - x_equilibrium) to 0 in finite time, against a disturbance whose rate is bounded, by an
    action without jumps. w stays in [-1, 1], so that it does not wind up. Sources: A. Levant, Int. J. Control 58 (1993)
    1247; J. A. Moreno and M. Osorio, IEEE Trans. Autom. Control 57 (2012) 1035.

    Attributes:
        slope: of the sliding line in the phase plane, in [-1e9, 1e9].
        proportional, integral: gains, in [-1e9, 1e9]; negative for a belt that follows the mass.
    """

    slope: float
    proportional: float
    integral: float

    _ranges: ClassVar = {**SampledFeedback._ranges, **dict.fromkeys(("slope", "proportional", "integral"), GAINS)}
    _needs_velocity = True

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        surface = values[..., 1] + self.slope * values[..., 0]
        (integrated,) = remembered(state, starts, np.zeros_like(surface))
        action = integrated - self.proportional * np.sqrt(np.abs(surface)) * np.sign(surface)
        step = self.integral * self.control_interval * np.sign(surface)
        return action, (np.clip(integrated - step, -1.0, 1.0),)


@dataclass(frozen=True)
class Dither(SampledFeedback):
    """Open-loop oscillation: action = amplitude cos(frequency t), whatever is observed.

    Fast dither smooths friction: J. J. Thomsen, J. Sound Vib. 228 (1999) 1079. Its force must exceed about frequency
    times belt speed.

    Attributes:
        amplitude: in [0, 1].
        frequency: angular, in [0, pi/control_interval]; faster ones cannot be held at the control interval.
    """

    amplitude: float
    frequency: float

    _ranges: ClassVar = {**SampledFeedback._ranges, "amplitude": (0.0, 1.0)}

    def __post_init__(self) -> None:
        super().__post_init__()
        highest = math.pi / self.control_interval
        object.__setattr__(self, "frequency", checked_number("frequency", self.frequency, 0.0, highest))

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        (decisions,) = remembered(state, starts, np.zeros(values.shape[:-1]))
        return self.amplitude * np.cos(self.frequency * self.control_interval * decisions), (decisions + 1.0,)


@dataclass(frozen=True)
class ScheduledFeedback(Feedback):
    """Saturated linear feedback whose gains and place of rest follow the belt speed.

    The belt speed is estimated as by :class:`EstimatingFollower`: it is known once the mass has stuck. Between the
    scheduled speeds gains and places are interpolated, beyond them the nearest ones hold.

    Attributes:
        belt_speeds: increasing, k >= 1 of them.
        gains: for each belt speed, action per unit of each quantity in ``readings.names``.
        places: equilibrium position for each belt speed.
        belt_speed: of the nominal plant: only a scale, as in :class:`EstimatingFollower`.
        belt_authority: largest relative change of the belt speed; 0 on force.

    Raises:
        TypeError, ValueError: if the tables do not fit, are not finite, or the velocity is not observed.
    """

    belt_speeds: tuple[float, ...]
    gains: tuple[tuple[float, ...], ...]
    places: tuple[float, ...]
    _: KW_ONLY
    belt_speed: float
    belt_authority: float

    _ranges: ClassVar = {"belt_speed": (1e-6, 1e9), "belt_authority": (0.0, 1e9)}
    _needs_velocity = True

    def __post_init__(self) -> None:
        super().__post_init__()
        speeds, gains, places = (np.asarray(table, float) for table in (self.belt_speeds, self.gains, self.places))
        k, size = len(np.atleast_1d(speeds)), len(self.readings.names)
        if speeds.shape != (k,) or gains.shape != (k, size) or places.shape != (k,):
            shapes = f"{speeds.shape}, {gains.shape} and {places.shape}"
            raise ValueError(
                f"belt_speeds, gains and places must be of shapes (k,), (k, {size}) and (k,), got {shapes}"
            )
        if not all(np.isfinite(table).all() for table in (speeds, gains, places)) or (np.diff(speeds) <= 0.0).any():
            raise ValueError(f"the tables must be finite and belt_speeds increasing, got {self.belt_speeds!r}")

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, from its nominal plant; see :meth:`Feedback.from_env`."""
        bare: Any = getattr(env, "unwrapped", None)
        if hasattr(bare, "task") and hasattr(bare, "nominal"):
            authority = bare.task.belt_authority if bare.task.actuator == "belt_speed" else 0.0
            named = {"belt_speed": bare.nominal.belt_speed, "belt_authority": authority} | named
        return super().from_env(env, *arguments, **named)

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        relative_speed = 1.0 + (self.belt_authority * values[..., 2] if values.shape[-1] > 2 else 0.0)
        speed, memory = estimate_belt_speed(values[..., 1], relative_speed, self.belt_speed, state, starts)
        place = np.interp(speed, self.belt_speeds, self.places)
        deviations = [values[..., 0] + self.readings.x_equilibrium - place, *np.moveaxis(values[..., 1:], -1, 0)]
        action = np.zeros_like(speed)
        for deviation, gains in zip(deviations, zip(*self.gains, strict=True), strict=True):
            action += np.interp(speed, self.belt_speeds, gains) * deviation
        return action, memory
