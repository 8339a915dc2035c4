"""Starts by the million: grids of them, threads that share them, and the interval of a share."""

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.physics.parameters import STATE_LIMIT, checked_count, checked_number

CONFIDENCE = 0.95
_MOST_STARTS = 10_000_000  # of one axis


def checked_grid(
    x_limits: tuple[float, float], v_limits: tuple[float, float], shape: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of a grid, x of shape (n,) and v of shape (m,).

    Raises:
        TypeError, ValueError: if limits are reversed or out of range, or the shape is not of whole numbers from 2 on.
    """
    axes = []
    for name, (low, high), count in zip(("x_limits", "v_limits"), (x_limits, v_limits), shape, strict=True):
        low, high = (checked_number(name, limit, -STATE_LIMIT, STATE_LIMIT) for limit in (low, high))
        if not low < high:
            raise ValueError(f"{name} must have low < high, got {(low, high)}")
        axes.append(np.linspace(low, high, checked_count("shape", count, 2, _MOST_STARTS)))
    return axes[0], axes[1]


def in_threads(work: Callable[[slice], None], count: int, per_thread: int, threads: int | None = None) -> None:
    """Call a function with slices of ``count`` starts, in threads where each gets at least ``per_thread`` of them.

    Starts are independent of each other: any number of threads gives the same labels.

    Args:
        threads: maximum number; None: one per core.
    """
    threads = min(threads or os.cpu_count() or 1, count // per_thread)
    if threads < 2:
        work(slice(None))
        return
    edges = np.linspace(0, count, 8 * threads + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, itertools.starmap(slice, itertools.pairwise(edges))))


def share_interval(hits: int, of: int) -> tuple[float, float]:
    """Return the 95% interval of a share by Wilson's score, which (unlike a bootstrap) is not empty at 0 and 1."""
    from scipy.stats import binomtest  # deferred: training starts without it

    found = binomtest(hits, of).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)
