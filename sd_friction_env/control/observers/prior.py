"""Base of the observers that begin with starts as the task draws them."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.observers.observer import Observer
from sd_friction_env.environments.batch import SDFrictionVectorEnv

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FromPrior(Observer):
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
