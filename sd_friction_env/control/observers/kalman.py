"""Extended Kalman filter with exact derivatives through stick and slip."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.observers.prior import FromPrior
from sd_friction_env.environments.jacobian import step_with_jacobian
from sd_friction_env.environments.task import drifted

_Floats = NDArray[np.float64]

_ON_BELT = 1e-9  # a correction moves a mass off the belt by rounding alone


@dataclass(frozen=True)
class KalmanFilter(FromPrior):
    """Extended Kalman filter with the exact step and its exact Jacobian, jumps at events (saltation) included.

    It begins with mean and covariance of the starts that the first reading leaves of weight. Between two readings the
    hidden parameters stay and the covariance grows by ``inflation``. Sources: A. H. Jazwinski, Stochastic Processes and
    Filtering Theory (1970), section 8.3; N. J. Kong, J. J. Payne, G. Council and A. M. Johnson, The Salted Kalman
    Filter, Automatica 131 (2021), for the events.

    Attributes:
        inflation: factor on the covariance in each interval, in [1, 2].
    """

    inflation: float = 1.005

    _ranges: ClassVar = {**FromPrior._ranges, "inflation": (1.0, 2.0)}

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
