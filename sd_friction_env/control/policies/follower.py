"""A belt that follows the mass below a threshold: a rule of two numbers found from the optimum, also for a hidden belt
speed.
"""

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.feedback import Feedback, Readings
from sd_friction_env.control.policies.policy import State, remembered

_Floats = NDArray[np.float64]

_REPEATS = 1e-6  # of the nominal belt speed: observations are float32, and a mass that sticks has the belt's speed
_AT_REST = 0.2  # of the nominal belt speed: slower repetitions are those of a mass that comes to rest


@dataclass(frozen=True)
class ThresholdFollower(Feedback):
    """Belt that follows the mass, unless a fast belt would catch it: for a known belt speed and an observed velocity.

    action = clip(gain v/belt_speed, -1, 1) while v < threshold (1 - belt_authority) belt_speed, otherwise -1.

    Friction falls with the sliding speed, so that a belt that follows the mass damps it. A belt that runs fast when the
    mass reaches its speed carries the mass along and throws it back faster; beyond the threshold, just above the
    slowest belt speed, the belt therefore slows down. Found from the optimum of ``sd-friction optimum``.

    Attributes:
        gain: action per v/belt_speed, in [0, 1e9].
        threshold: in units of the slowest belt speed, in [0, 1e6].
        belt_speed: nominal belt speed, in [1e-6, 1e9] (dimensionless, as v).
        belt_authority: largest relative change of the belt speed, in [1e-9, 1e9].

    Raises:
        TypeError, ValueError: if a number is not as said, the actuator is not the belt's speed, or the velocity is
            needed and not observed.
    """

    gain: float = 6.0
    threshold: float = 1.1
    _: KW_ONLY
    belt_speed: float
    belt_authority: float

    _ranges: ClassVar = {
        "gain": (0.0, 1e9),
        "threshold": (0.0, 1e6),
        "belt_speed": (1e-6, 1e9),
        "belt_authority": (1e-9, 1e9),
    }
    _needs_velocity = True
    _needs_belt = True

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, from its nominal plant; see :meth:`Feedback.from_env`."""
        bare = getattr(env, "unwrapped", None)
        if hasattr(bare, "task") and hasattr(bare, "nominal"):
            named = cls._known(bare) | named
        return super().from_env(env, *arguments, **named)

    @classmethod
    def seeing_all(cls, env: Any) -> Self:
        """Return the controller of an environment for a state that is known otherwise than by its sensor."""
        return cls(readings=replace(Readings.from_env(env), sees_velocity=True), **cls._known(env.unwrapped))

    @classmethod
    def _known(cls, env: Any) -> dict[str, Any]:
        """Return what the controller knows of a bare environment."""
        return {"belt_speed": env.nominal.belt_speed, "belt_authority": env.task.belt_authority}

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        return self.follow(values[..., 1], self.belt_speed), None

    def follow(self, v: _Floats, belt_speed: _Floats | float) -> _Floats:
        """Return the actions (...), not yet clipped, at velocities (...) and nominal belt speeds (...)."""
        follows = v < self.threshold * (1.0 - self.belt_authority) * belt_speed
        return np.where(follows, self.gain * v / belt_speed, -1.0)


@dataclass(frozen=True)
class EstimatingFollower(ThresholdFollower):
    """:class:`ThresholdFollower` that estimates the nominal belt speed from v and the belt modulation m.

    The ratio v/(1 + belt_authority m) is the nominal belt speed while the mass sticks, and smaller while the belt
    overtakes it. The estimate is the last ratio that repeated, which shows that the mass sticks. Until one repeats it
    is the largest ratio of the episode; a start faster than the belt makes that too large, and where the mass then
    never sticks it stays so. With sensor noise nothing repeats.

    Attributes:
        waits: whether the belt runs slow until the mass sticks, in place of following by the largest ratio: slower from
            the passive cycle, safe from any start.
        belt_speed: of the nominal plant: only a scale. Ratios within 1e-6 of it are equal, and repetitions below a
            fifth of it do not count: they belong to a mass that comes to rest.

    Raises:
        TypeError: if ``waits`` is not True or False.
    """

    threshold: float = 1.006
    waits: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.waits, bool):
            raise TypeError(f"waits must be True or False, got {self.waits!r}")

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        v = values[..., 1]
        relative_speed = 1.0 + self.belt_authority * values[..., 2]
        estimate, memory = estimate_belt_speed(v, relative_speed, self.belt_speed, state, starts, waits=self.waits)
        return self.follow(v, estimate), memory


def estimate_belt_speed(
    v: _Floats,
    relative_speed: _Floats | float,
    scale: float,
    state: State,
    starts: ArrayLike | None,
    *,
    waits: bool = False,
) -> tuple[_Floats, State]:
    """Return estimates (...) of nominal belt speeds as :class:`EstimatingFollower` makes them, and the memory.

    Args:
        v: velocities (...). relative_speed: of the belt, v_belt over the nominal belt speed.
        scale: the nominal plant's belt speed. state, starts: as ``predict`` takes them. waits: as the class has it.
    """
    least = _REPEATS * scale
    ratio = v / np.maximum(relative_speed, _REPEATS)
    fresh = np.full_like(v, np.inf), np.full_like(v, least), np.zeros(v.shape, bool)
    before, estimate, stuck = remembered(state, starts, *fresh)
    sticks = (np.abs(ratio - before) <= least) & (ratio > _AT_REST * scale)
    stuck = stuck | sticks
    if not waits:
        estimate = np.where(stuck, estimate, np.maximum(estimate, ratio))
    estimate = np.where(sticks, ratio, estimate)
    return estimate, (ratio, estimate, stuck)
