"""What all observers share: the belief, the rows of guesses behind it, and the steps of an interval."""

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.policy import broadcast_starts, checked_memory
from sd_friction_env.environments.ensemble import Ensemble
from sd_friction_env.physics.parameters import checked_count, checked_number

_Floats = NDArray[np.float64]
Memory = tuple[NDArray[Any], ...]

_LEAST_NOISE = 1e-3  # of a reading: more exact ones leave too few particles of weight
_LEAST_NUMBER = 1e-12


class Belief(NamedTuple):
    """What an observer believes: k weighted guesses of the state and the hidden parameters, one for a mere estimate.

    Attributes:
        states: (x, v, v_belt), shape (..., k, 3).
        parameters: the hidden ones, shape (..., k, d).
        weights: of the guesses, shape (..., k); their sum is 1.
        steps: control intervals since the episode began, shape (...).
    """

    states: _Floats
    parameters: _Floats
    weights: _Floats
    steps: NDArray[np.int64]

    @property
    def mean(self) -> tuple[_Floats, _Floats]:
        """Mean state, shape (..., 3), and mean parameters, shape (..., d)."""
        weights = self.weights[..., None]
        return (self.states * weights).sum(axis=-2), (self.parameters * weights).sum(axis=-2)


@dataclass(frozen=True)
class Observer:
    """Base of the observers.

    A guess is one row: x, v, v_belt, the hidden parameters, and the x (and v, if it is read) of the last
    ``sensor_delay`` + 1 intervals, oldest first. A reading then corrects the whole row by its oldest part, so that no
    prediction over the delay is needed. (Only the Luenberger observer corrects the past and predicts.)

    Attributes:
        ensemble: of the plants that are possible, with the task.
        noise: standard deviation of the readings, in [1e-6, 10].

    Raises:
        TypeError, ValueError: if a number is not as said.
    """

    ensemble: Ensemble = field(repr=False)
    _: KW_ONLY
    noise: float

    _ranges: ClassVar[dict[str, tuple[float, float]]] = {"noise": (1e-6, 10.0)}
    _counts: ClassVar[dict[str, tuple[int, int]]] = {}

    def __post_init__(self) -> None:
        for name, (low, high) in self._ranges.items():
            object.__setattr__(self, name, checked_number(name, getattr(self, name), low, high))
        for name, (least, most) in self._counts.items():
            object.__setattr__(self, name, checked_count(name, getattr(self, name), least, most))

    @classmethod
    def from_env(cls, env: Any, **named: Any) -> Self:
        """Return the observer of an :class:`SDFrictionEnv`, wrapped or not; ``named`` are numbers of the class.

        Raises:
            TypeError: if it is another kind of environment.
        """
        bare: Any = getattr(env, "unwrapped", None)
        if not hasattr(bare, "task") or not hasattr(bare, "nominal"):
            raise TypeError(f"env must be an SDFrictionEnv, got {env!r}")
        ensemble = Ensemble(bare.nominal, bare.task)
        return cls(ensemble, **({"noise": max(bare.task.sensor_noise, _LEAST_NOISE)} | named))

    def correct(
        self, observation: ArrayLike, memory: Memory | None = None, episode_start: ArrayLike | None = None
    ) -> tuple[Belief, Memory]:
        """Return the belief after observations, shape (size,) or (n, size), and the memory.

        Raises:
            ValueError: if the observations are too short, or the memory belongs to another number of them.
        """
        reading = self.read(observation)
        shape, flat = reading.shape[:-1], reading.reshape(-1, reading.shape[-1])
        begun = np.ones(len(flat), bool)
        steps, guesses, spread = np.zeros(len(flat), np.int64), *self._blank(len(flat))
        if memory is not None:
            starts = np.broadcast_to(broadcast_starts(episode_start, reading[..., 0]), shape).reshape(-1)
            old = checked_memory(memory, steps.shape, guesses.shape, spread.shape)
            steps, guesses, spread = np.where(starts, 0, old[0]), old[1].copy(), old[2].copy()
            begun = steps == 0
        # Until the delay has passed, the sensor repeats its first reading.
        new = steps > self.ensemble.task.sensor_delay
        if begun.any():
            guesses[begun], spread[begun] = self._begin(flat[begun])
        if new.any():
            guesses[new], spread[new] = self._update(flat[new], guesses[new], spread[new], steps[new])
        found = guesses[..., :3], guesses[..., 3 : self._first], self._weights(guesses, spread), steps
        parts = (part.reshape((*shape, *part.shape[1:])) for part in found)
        return Belief(*parts), (steps, guesses, spread)

    def advance(self, memory: Memory, action: ArrayLike) -> Memory:
        """Return the memory a control interval later, after actions in [-1, 1], shape () or (n,)."""
        steps, guesses, spread = memory
        held = np.repeat(np.reshape(np.asarray(action, np.float64), (-1, 1)), guesses.shape[1], axis=1)
        ends, spread = self._step(guesses, held, spread, steps)
        return steps + 1, ends, spread

    def read(self, observation: ArrayLike) -> _Floats:
        """Return the readings of observations: x, and v and the belt modulation where they are seen, shape (..., s)."""
        task, values = self.ensemble.task, np.asarray(observation, dtype=np.float64)
        size = self._seen + task.sees_belt
        if values.ndim < 1 or values.shape[-1] < size:
            raise ValueError(f"observation must have at least {size} entries, got shape {values.shape}")
        values, (x_offset, x_scale, v_scale) = values[..., :size].copy(), task.scales
        values[..., 0] = values[..., 0] * x_scale + x_offset
        values[..., 1 : self._seen] *= v_scale
        return values

    def belt_speed(self, parameters: _Floats) -> _Floats:
        """Return the nominal belt speed, shape (...), among hidden parameters (..., d) or as it is known."""
        names = self.ensemble.names
        if "belt_speed" in names:
            return parameters[..., names.index("belt_speed")]
        return np.full(parameters.shape[:-1], self.ensemble.nominal.belt_speed)

    @property
    def velocity_may_be_biased(self) -> bool:
        """Whether the velocity is not read but predicted by a plant that is itself estimated."""
        return bool(self.ensemble.ranges) and self._seen == 1

    # Rows of guesses --------------------------------------------------------------------------------------------------

    @property
    def _seen(self) -> int:
        """How much of (x, v) the sensor sees."""
        return 2 if self.ensemble.task.sensor == "state" else 1

    @property
    def _first(self) -> int:
        """The first column of the past."""
        return 3 + len(self.ensemble.ranges)

    @property
    def _width(self) -> int:
        return self._first + self._seen * (self.ensemble.task.sensor_delay + 1)

    def _row(self, now: _Floats, past: _Floats | None = None) -> _Floats:
        """Return guesses from their present, shape (..., first column of the past), and the past before it, if any."""
        seen = now[..., : self._seen]
        if past is None:
            return np.concatenate([now, *[seen] * (self.ensemble.task.sensor_delay + 1)], axis=-1)
        return np.concatenate([now, past[..., self._seen :], seen], axis=-1)

    def _expected(self, guesses: _Floats) -> _Floats:
        """Return the readings that guesses expect, without noise, shape (..., k, s)."""
        seen = guesses[..., self._first : self._first + self._seen]
        if not self.ensemble.task.sees_belt:
            return seen
        ratio = guesses[..., 2] / self.belt_speed(guesses[..., 3 : self._first])
        return np.concatenate([seen, ((ratio - 1.0) / self.ensemble.task.belt_authority)[..., None]], axis=-1)

    def _admissible(self, guesses: _Floats, stuck: NDArray[np.bool_]) -> _Floats:
        """Put corrected guesses back into the ranges of the parameters, and those that stuck on the belt."""
        for i, (name, (low, high)) in enumerate(self.ensemble.ranges):
            values = guesses[..., 3 + i]
            if name.endswith("_phase"):  # to within half a turn of their mean direction
                middle = np.angle(np.exp(1j * values).mean(axis=-1, keepdims=True))
                values = middle + np.angle(np.exp(1j * (values - middle)))
            else:  # without an amplitude there is no derivative by frequency and phase
                values = np.clip(values, low or _LEAST_NUMBER, high)
            guesses[..., 3 + i] = values
        guesses[..., 1] = np.where(stuck, guesses[..., 2], guesses[..., 1])
        return guesses

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        now = self._stepped(guesses[..., : self._first], actions, steps)
        return self._row(now, guesses[..., self._first :]), spread

    def _stepped(self, now: _Floats, actions: _Floats, steps: NDArray[np.int64]) -> _Floats:
        """Return states and hidden parameters (n, k, d) a control interval after ``steps`` (n,) intervals."""
        ends, _ = self.ensemble.step(now[..., :3], now[..., 3:], actions, steps[:, None])
        # A guess that cannot be advanced stays where it is.
        ends = np.where(np.isfinite(ends).all(axis=-1, keepdims=True), ends, now[..., :3])
        return np.concatenate([ends, now[..., 3:]], axis=-1)

    # Of each observer -------------------------------------------------------------------------------------------------

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        """Return arrays for n beliefs: guesses (n, k, width), and what says how far they spread, (n, ...)."""
        raise NotImplementedError

    def _weights(self, guesses: _Floats, spread: _Floats) -> _Floats:
        return np.ones(guesses.shape[:2])

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        """Return guesses and spread after the first readings, shape (n, s)."""
        raise NotImplementedError

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        """Return guesses and spread after readings, shape (n, s)."""
        raise NotImplementedError
