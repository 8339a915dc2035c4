"""Observers: the state and the hidden parameters, estimated from readings and the actions taken.

An observer knows the nominal plant, the task (ranges of the hidden parameters, how episodes start, the sensor's noise
and delay) and the actions. Of an episode it gets the readings alone. All share two methods::

    belief, memory = observer.correct(observation, memory, episode_start)
    memory = observer.advance(memory, action)

``memory`` is None before the first call. Observations come as the environment returns them, one or a batch; each of a
batch is observed as it would be alone.
"""

import dataclasses
import functools
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.policy import broadcast_starts, checked_memory
from sd_friction_env.environments.batch import SDFrictionVectorEnv
from sd_friction_env.environments.ensemble import Ensemble
from sd_friction_env.environments.jacobian import step_with_jacobian
from sd_friction_env.environments.task import drifted
from sd_friction_env.physics.parameters import checked_count, checked_number

_Floats = NDArray[np.float64]
Memory = tuple[NDArray[Any], ...]

_LEAST_NOISE = 1e-3  # of a reading: more exact ones leave too few particles of weight
_LEAST_NUMBER = 1e-12
_ON_BELT = 1e-9  # a correction moves a mass off the belt by rounding alone


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
    prediction over the delay is needed.

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


@dataclass(frozen=True)
class AlphaBetaFilter(Observer):
    """Position and velocity by two constant gains, without a model of the plant, for a belt actuator.

    x += x_gain e and v += v_gain e / control_interval with the reading's deviation e; between readings x moves by v.
    The nominal belt speed is the largest of 0.9 v/(v_belt/belt_speed) so far, because a mass that sticks has the belt's
    speed; other hidden parameters are taken for nominal. Source: Y. Bar-Shalom, X. R. Li and T. Kirubarajan,
    Estimation with Applications to Tracking and Navigation (2001), section 6.5.

    Attributes:
        x_gain, v_gain: in [0, 2].
    """

    x_gain: float = 0.4
    v_gain: float = 0.2

    _ranges: ClassVar = {**Observer._ranges, "x_gain": (0.0, 2.0), "v_gain": (0.0, 2.0)}
    _SHARE: ClassVar = 0.9

    @property
    def velocity_may_be_biased(self) -> bool:
        """False: the velocity is from the readings alone."""
        return False

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        return np.zeros((n, 1, self._width)), np.zeros((n, 0))

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        nominal = self.ensemble.nominal
        now = np.zeros((len(reading), 1, self._first))
        now[..., 0] = reading[:, :1]
        for i, (name, (low, _)) in enumerate(self.ensemble.ranges):
            now[..., 3 + i] = low if name == "belt_speed" else nominal.values[name]
        now[..., 2] = self.belt_speed(now[..., 3:])
        return self._row(now), np.zeros((len(reading), 0))

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        error = reading[:, :1] - guesses[..., self._first]
        guesses[..., 0] += self.x_gain * error
        guesses[..., 1] += self.v_gain / self.ensemble.task.control_interval * error
        guesses[..., self._first :: self._seen] += self.x_gain * error[..., None]
        if "belt_speed" in self.ensemble.names:
            column = 3 + self.ensemble.names.index("belt_speed")
            low, high = self.ensemble.task.randomise["belt_speed"]
            ratio = guesses[..., 2] / guesses[..., column]
            found = np.maximum(guesses[..., column], self._SHARE * guesses[..., 1] / np.maximum(ratio, 0.1))
            guesses[..., column] = np.clip(found, low, high)
            guesses[..., 2] = ratio * guesses[..., column]
        return guesses, spread

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        task, now = self.ensemble.task, guesses[..., : self._first].copy()
        now[..., 0] += task.control_interval * now[..., 1]
        if task.actuator == "belt_speed":
            most = task.belt_acceleration_limit * task.control_interval
            target = (1.0 + task.belt_authority * actions) * self.belt_speed(now[..., 3:])
            now[..., 2] += np.clip(target - now[..., 2], -most, most)
        return self._row(now, guesses[..., self._first :]), spread


@dataclass(frozen=True)
class LuenbergerObserver(Observer):
    """State of the nominal plant, corrected by two constant gains; hidden parameters are taken for nominal.

    It keeps the state of the time at which the sensor took its reading. With the reading's deviation e, x moves by
    x_gain e and v by v_gain e; the actions since then advance the result over the delay. An episode begins at the
    belt's speed, because a squealing mass sticks for part of each cycle; a model that starts at rest takes longer to
    find the velocity. Source: D. G. Luenberger, An Introduction to Observers, IEEE Trans. Autom. Control 16 (1971) 596.

    Attributes:
        x_gain: share of the deviation, in [0, 2].
        v_gain: velocity per displacement, in [0, 1e6].
    """

    x_gain: float = 0.27
    v_gain: float = 0.18

    _ranges: ClassVar = {**Observer._ranges, "x_gain": (0.0, 2.0), "v_gain": (0.0, 1e6)}

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        """Return arrays for guesses, and for states at the readings' time with the actions since, oldest first."""
        return np.zeros((n, 1, self._width)), np.zeros((n, self._first + self.ensemble.task.sensor_delay))

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        nominal = self.ensemble.nominal
        now = np.full((len(reading), 1, self._first), nominal.belt_speed)
        now[..., : self._seen] = reading[:, None, : self._seen]
        now[..., 3:] = [nominal.values[name] for name, _ in self.ensemble.ranges]
        return self._row(now), np.pad(now[:, 0], ((0, 0), (0, self.ensemble.task.sensor_delay)))

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        error = reading[:, 0] - spread[:, 0]
        spread[:, 0] += self.x_gain * error
        spread[:, 1] += self.v_gain * error
        now, actions = spread[:, None, : self._first], spread[:, self._first :]
        for i, action in enumerate(actions.T):
            now = self._stepped(now, action[:, None], steps - len(actions.T) + i)
        guesses[..., : self._first] = now
        return guesses, spread

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        ends, _ = super()._step(guesses, actions, spread, steps)
        read, since = spread[:, : self._first], np.concatenate([spread[:, self._first :], actions], axis=-1)
        passed = steps - self.ensemble.task.sensor_delay
        moved = self._stepped(read[:, None], since[:, :1], np.maximum(passed, 0))[:, 0]
        return ends, np.concatenate([np.where(passed[:, None] < 0, read, moved), since[:, 1:]], axis=-1)


@dataclass(frozen=True)
class _FromPrior(Observer):
    """Base of the observers that begin with episodes as the task starts them.

    Attributes:
        seed: of all random numbers; the same for every observation of a batch.
        prior_size: number of such starts, in [2, 1e6].
    """

    seed: int = 0
    prior_size: int = 8192

    _counts: ClassVar = {"seed": (0, 2**62), "prior_size": (2, 10**6)}

    @functools.cached_property
    def prior(self) -> _Floats:
        """Guesses before the first reading, shape (prior_size, width): starts as the task draws them."""
        task = {each.name: getattr(self.ensemble.task, each.name) for each in dataclasses.fields(self.ensemble.task)}
        envs = SDFrictionVectorEnv(self.prior_size, self.ensemble.nominal, **task)
        envs.np_random = np.random.default_rng(self.seed)
        _, info = envs.reset()
        drawn = [info["parameters"][name] for name in self.ensemble.names]
        drift = self.ensemble.task.drift.values()
        drawn += [envs.np_random.uniform(low, high, self.prior_size) for low, high in drift]
        v_belt = info["parameters"]["belt_speed"]  # without its ripple
        return self._row(np.stack([info["x"], info["v"], v_belt, *drawn], axis=-1))

    def _reweighted(self, guesses: _Floats, weights: _Floats, reading: _Floats, least: float) -> _Floats:
        """Return weights (n, k) after readings: by their likelihood, to such a power that ``least`` guesses count.

        The number that count is 1 over the sum of squared weights (Kong, Liu and Wong, 1994); tempering keeps a
        reading that few guesses expected from deciding alone.
        """
        errors = (self._expected(guesses) - reading[:, None, :]) / self.noise
        likelihood = -0.5 * (errors * errors).sum(axis=-1)
        likelihood = np.maximum(likelihood - likelihood.max(axis=-1, keepdims=True), -1e3)

        def raised(power: _Floats) -> tuple[_Floats, NDArray[np.bool_]]:
            new = weights * np.exp(power[:, None] * likelihood)
            new /= new.sum(axis=-1, keepdims=True)
            return new, (new * new).sum(axis=-1) * least <= 1.0

        low, high = np.zeros(len(weights)), np.ones(len(weights))
        whole, enough = raised(high)
        if enough.all():
            return whole
        for _ in range(12):
            middle = 0.5 * (low + high)
            _, many = raised(middle)
            low, high = np.where(many, middle, low), np.where(many, high, middle)
        tempered, _ = raised(np.where(enough, 1.0, low))
        return tempered


@dataclass(frozen=True)
class ParticleFilter(_FromPrior):
    """Particle filter: every guess moves as its own plant, and readings decide which go on.

    The environment's own step advances all particles. Where fewer than half of them count, they are drawn anew
    (systematic resampling) and moved towards their mean and by differences of other particles, which keeps mean and
    covariance. Source: J. Liu and M. West, in Sequential Monte Carlo Methods in Practice (2001), chapter 10.

    Attributes:
        particles: in [8, 100000].
        jitter: share of the spread that is drawn anew, in [0, 1].
    """

    particles: int = 512
    jitter: float = 0.35

    _ranges: ClassVar = {**Observer._ranges, "jitter": (0.0, 1.0)}
    _counts: ClassVar = {**_FromPrior._counts, "particles": (8, 100_000)}
    _LEAST: ClassVar = 0.2  # share of the particles that a reading leaves of weight

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        return np.zeros((n, self.particles, self._width)), np.zeros((n, self.particles))

    def _weights(self, guesses: _Floats, spread: _Floats) -> _Floats:
        return spread

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        prior = np.broadcast_to(self.prior, (len(reading), *self.prior.shape))
        even = np.full(prior.shape[:2], 1.0 / self.prior_size)
        weights = self._reweighted(prior, even, reading, self._LEAST * self.particles)
        return self._resampled(prior, weights, np.zeros(len(reading), np.int64))

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        weights = self._reweighted(guesses, spread, reading, self._LEAST * self.particles)
        few = (weights * weights).sum(axis=-1) * 0.5 * self.particles > 1.0
        if few.any():
            guesses[few], weights[few] = self._resampled(guesses[few], weights[few], steps[few])
        return guesses, weights

    def _resampled(self, guesses: _Floats, weights: _Floats, steps: NDArray[np.int64]) -> tuple[_Floats, _Floats]:
        """Return particles of equal weight, with those weights."""
        n, k = len(guesses), self.particles
        drawn = np.empty((n, k, self._width))
        for i in range(n):
            rng = np.random.default_rng((self.seed, int(steps[i])))
            shares = (np.arange(k) + rng.random()) / k
            places = np.minimum(np.searchsorted(np.cumsum(weights[i]), shares), guesses.shape[1] - 1)
            own = guesses[i, places]
            mean, differences = own.mean(axis=0), own[rng.permutation(k)] - own[rng.permutation(k)]
            moved = mean + np.sqrt(1.0 - self.jitter**2) * (own - mean) + self.jitter * np.sqrt(0.5) * differences
            drawn[i] = self._admissible(moved, own[:, 1] == own[:, 2])
        return drawn, np.full((n, k), 1.0 / k)


@dataclass(frozen=True)
class EnsembleKalmanFilter(ParticleFilter):
    """:class:`ParticleFilter` in the first steps, until it is clear where on the cycle the mass is, then an ensemble
    Kalman filter: a reading moves all particles along their covariance with what they expected to read.

    No particle is lost, so that far fewer follow the hidden parameters. No random numbers are drawn for the moves.
    Source: J. S. Whitaker and T. M. Hamill, Mon. Weather Rev. 130 (2002) 1913, Eqs. 10 and 13.

    Attributes:
        particle_steps: steps with the particle filter, in [0, 1e9].
        inflation: factor on the particles' deviations at each reading, in [1, 2]. 1 takes the model for exact; more
            keeps the filter open to readings that contradict it.
    """

    particle_steps: int = 20
    inflation: float = 1.0

    _ranges: ClassVar = {**ParticleFilter._ranges, "inflation": (1.0, 2.0)}
    _counts: ClassVar = {**ParticleFilter._counts, "particle_steps": (0, 10**9)}

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        early = steps <= self.particle_steps
        if early.any():
            guesses[early], spread[early] = super()._update(reading[early], guesses[early], spread[early], steps[early])
        uneven = ~early & (spread.max(axis=-1) > spread.min(axis=-1))
        if uneven.any():
            guesses[uneven], spread[uneven] = self._resampled(guesses[uneven], spread[uneven], steps[uneven])
        if not early.all():
            guesses[~early] = self._moved(guesses[~early], reading[~early])
        return guesses, spread

    def _moved(self, guesses: _Floats, reading: _Floats) -> _Floats:
        stuck = guesses[..., 1] == guesses[..., 2]
        rows = np.concatenate([guesses, self._expected(guesses)], axis=-1)
        mean = rows.mean(axis=1)
        deviations = self.inflation * (rows - mean[:, None])
        variance = self.noise * self.noise
        for i in range(reading.shape[-1]):  # one number after the other
            expected = deviations[..., self._width + i]
            total = (expected * expected).mean(axis=-1) + variance
            gain = (deviations * expected[..., None]).mean(axis=1) / total[:, None]
            mean = mean + gain * (reading[:, i] - mean[:, self._width + i])[:, None]
            share = 1.0 / (1.0 + np.sqrt(variance / total))
            deviations = deviations - (share[:, None] * expected)[..., None] * gain[:, None]
        return self._admissible((mean[:, None] + deviations)[..., : self._width], stuck)


@dataclass(frozen=True)
class KalmanFilter(_FromPrior):
    """Extended Kalman filter with the exact step and its exact Jacobian, jumps at events (saltation) included.

    It begins with mean and covariance of the starts that the first reading leaves of weight. Between two readings the
    hidden parameters stay and the covariance grows by ``inflation``. Sources: A. H. Jazwinski, Stochastic Processes and
    Filtering Theory (1970), section 8.3; N. J. Kong, J. J. Payne, G. Council and A. M. Johnson, The Salted Kalman
    Filter, Automatica 131 (2021), for the events.

    Attributes:
        inflation: factor on the covariance in each interval, in [1, 2].
    """

    inflation: float = 1.005

    _ranges: ClassVar = {**Observer._ranges, "inflation": (1.0, 2.0)}

    def _blank(self, n: int) -> tuple[_Floats, _Floats]:
        return np.zeros((n, 1, self._width)), np.zeros((n, self._width, self._width))

    def _begin(self, reading: _Floats) -> tuple[_Floats, _Floats]:
        prior = np.broadcast_to(self.prior, (len(reading), *self.prior.shape))
        even = np.full(prior.shape[:2], 1.0 / self.prior_size)
        weights = self._reweighted(prior, even, reading, min(64.0, self.prior_size))[..., None]
        mean = (prior * weights).sum(axis=1, keepdims=True)
        deviations = (prior - mean) * np.sqrt(weights)
        return mean, np.stack([one.T @ one for one in deviations])

    def _update(
        self, reading: _Floats, guesses: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        for i in range(reading.shape[-1]):
            slope = self._slope(guesses[:, 0], i)
            expected = (spread * slope[:, None, :]).sum(axis=-1)
            gain = expected / ((expected * slope).sum(axis=-1) + self.noise * self.noise)[:, None]
            guesses[:, 0] += gain * (reading[:, i] - self._expected(guesses)[:, 0, i])[:, None]
            spread = spread - gain[:, :, None] * expected[:, None, :]
        return self._admissible(guesses, np.abs(guesses[..., 1] - guesses[..., 2]) < _ON_BELT), spread

    def _slope(self, guesses: _Floats, i: int) -> _Floats:
        """Return the derivatives of the i-th number that guesses (n, width) expect to read, by the guesses."""
        slope, names = np.zeros_like(guesses), self.ensemble.names
        if i < self._seen:
            slope[:, self._first + i] = 1.0
            return slope
        speed = self.belt_speed(guesses[:, 3 : self._first]) * self.ensemble.task.belt_authority
        slope[:, 2] = 1.0 / speed
        if "belt_speed" in names:
            slope[:, 3 + names.index("belt_speed")] = -guesses[:, 2] / (
                speed * self.belt_speed(guesses[:, 3 : self._first])
            )
        return slope

    def _step(
        self, guesses: _Floats, actions: _Floats, spread: _Floats, steps: NDArray[np.int64]
    ) -> tuple[_Floats, _Floats]:
        ends, grown = np.empty_like(guesses), np.empty_like(spread)
        first, seen, task = self._first, self._seen, self.ensemble.task
        by = tuple(dict.fromkeys(name for name, _ in self.ensemble.ranges))
        for i, (row, covariance, step) in enumerate(zip(guesses[:, 0], spread, steps.tolist(), strict=True)):
            values = self.ensemble.values(row[3:first], step)
            plant = self.ensemble.nominal.replace(**{name: float(values[name]) for name in by})
            found = step_with_jacobian(row[:3], actions[i, 0], plant, task, by=by, time=step * task.control_interval)
            known = bool(np.isfinite(found.jacobian[:3]).all())
            state = found.state if known else row[:3]
            ends[i, 0] = self._row(np.concatenate([state, row[3:first]]), row[first:])
            change = np.zeros_like(covariance)
            change[:first, :first] = np.eye(first)
            if known:
                change[:3, :3] = found.jacobian[:3, :3]
                for column, (name, _) in enumerate(self.ensemble.ranges, 3):
                    late = float(column >= 3 + len(self.ensemble.names))
                    share = drifted(1.0 - late, late, step, task.episode_steps) if name in task.drift else 1.0
                    change[:3, column] = share * found.jacobian[:3, 4 + by.index(name)]
            change[first:-seen, first + seen :] = np.eye(self._width - first - seen)
            change[-seen:] = change[:seen]
            grown[i] = self.inflation * (change @ covariance @ change.T)
        return ends, grown
