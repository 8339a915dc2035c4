"""The score against the optimum, and intervals over episodes and over training runs."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.starts import CONFIDENCE

Array = NDArray[np.float64]
RESAMPLES = 2000  # of a bootstrap
Interval = tuple[float, float]
NO_INTERVAL: Interval = (float("nan"), float("nan"))


def _compared(returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike) -> Array:
    """Return the three, shape (3, n), for the episodes with a known optimum (not NaN).

    Raises:
        ValueError: if the three are not of one shape, or there is no such episode.
    """
    parts = [np.asarray(values, dtype=float) for values in (returns, passive, optimal)]
    if len({part.shape for part in parts}) > 1 or parts[0].ndim != 1:
        shapes = ", ".join(str(part.shape) for part in parts)
        raise ValueError(f"returns, passive and optimal must be of the same episodes, got shapes {shapes}")
    if not np.isfinite(parts[2]).any():
        raise ValueError(f"optimal must hold the return of one episode or more, got {optimal!r}")
    return np.stack(parts)[:, np.isfinite(parts[2])]


def score(returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike) -> float:
    """Return (mean return - mean passive)/(mean optimal - mean passive) over the same episodes: 0 passive, 1 optimal.

    Episodes without a known optimum (NaN) are left out.

    Raises:
        ValueError: if the three are not of one shape (n,), or the optimum is no better than passive.
    """
    mean, mean_passive, mean_optimal = _compared(returns, passive, optimal).mean(axis=1).tolist()
    gap = mean_optimal - mean_passive
    if not gap > 0.0:
        raise ValueError(f"the optimum must be better than passive, got means {mean_optimal} and {mean_passive}")
    return float((mean - mean_passive) / gap)


def credited_score(returns: ArrayLike, suppressed: ArrayLike, passive: ArrayLike, optimal: ArrayLike) -> float:
    """Return the score with credit for suppressed episodes only: the others count as if without control.

    Args:
        suppressed: whether each episode was suppressed, shape (n,); the others as :func:`score` takes them.
    """
    return score(np.where(suppressed, returns, passive), passive, optimal)


def score_interval(
    returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike, *, seed: int = 0, resamples: int = RESAMPLES
) -> Interval:
    """Return the 95% interval of a score: the percentile bootstrap over episodes, the three resampled together.

    Args:
        returns, passive, optimal: as :func:`score` takes them; fewer than two episodes have no interval (NaN).
        seed: of the resampling. resamples: how many.
    """
    compared = _compared(returns, passive, optimal)
    n = compared.shape[1]
    if n < 2:
        return NO_INTERVAL
    drawn = np.random.default_rng(seed).integers(n, size=(resamples, n))
    mean, mean_passive, mean_optimal = (values[drawn].mean(axis=1) for values in compared)
    return _middle((mean - mean_passive) / (mean_optimal - mean_passive))


def _middle(values: Array) -> Interval:
    low, high = np.quantile(values, (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)).tolist()
    return low, high


def _trimmed_mean(values: Array) -> Array | float:
    """Return the mean of the middle half of values along the last axis."""
    from scipy.stats import trim_mean  # deferred: training starts without it

    found: Array | float = trim_mean(values, 0.25, axis=-1)
    return found


def interquartile_mean(values: ArrayLike) -> float:
    """Return the mean of the middle half of all values: a quarter, rounded down, is cut at each end."""
    return float(_trimmed_mean(np.ravel(values)))


def run_interval(scores: Sequence[ArrayLike], *, seed: int = 0, resamples: int = RESAMPLES) -> Interval:
    """Return the 95% interval of the interquartile mean over training runs, by the stratified bootstrap.

    Runs are resampled with replacement within each task, and the interquartile mean is taken over all of them (Agarwal
    et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).

    Args:
        scores: of each task, those of its runs, shape (runs,). With one run for each task there is no interval (NaN).
        seed: of the resampling. resamples: how many.

    Raises:
        ValueError: if there is no task, or one has no runs.
    """
    tasks = [np.asarray(task, dtype=float) for task in scores]
    if not tasks or any(task.ndim != 1 or not task.size for task in tasks):
        raise ValueError(f"scores must be one or more sequences of one or more numbers, got {scores!r}")
    if max(task.size for task in tasks) < 2:
        return NO_INTERVAL
    rng = np.random.default_rng(seed)
    drawn = [task[rng.integers(task.size, size=(resamples, task.size))] for task in tasks]
    return _middle(np.asarray(_trimmed_mean(np.concatenate(drawn, axis=1))))
