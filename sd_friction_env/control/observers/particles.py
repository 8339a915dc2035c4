"""Observers of many guesses, each stepped as a plant of its own."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.observers.prior import FromPrior

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ParticleFilter(FromPrior):
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

    _ranges: ClassVar = {**FromPrior._ranges, "jitter": (0.0, 1.0)}
    _counts: ClassVar = {**FromPrior._counts, "particles": (8, 100_000)}
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
