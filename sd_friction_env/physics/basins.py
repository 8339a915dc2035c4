"""Which attractor a start reaches: starts by the million, fractions of them, and grids to draw."""

import functools
import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.orbits import (
    ContactLossError,
    LimitCycle,
    OrbitError,
    attractors,
    equilibria,
    limit_of_motion,
    limits_of_slip,
    same_motion,
    stick_intervals,
    traps_of,
)
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_number

LOST_CONTACT, UNDECIDED = -1, -2

_Classify = Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.int8]], None]

_STARTS_WORTH_A_THREAD = 20_000
_MOST_TURNINGS, _SAMPLED_TURNINGS = 20_000, 400  # that a start is followed for, and one of those below
_SAMPLED_MAXIMA = (3, 16, 240)  # first few, then many, among those with which motions leave a range of radii


@dataclass(frozen=True, kw_only=True, eq=False)
class Basins:
    """The attractors of an oscillator and the starts that reach each.

    Attributes:
        attractors: as :func:`orbits.attractors` lists them.
        labels: index into ``attractors`` of each start, of the shape of the starts; -1: the mass loses contact,
            -2: not decided. A start on a neutral orbit has the index of its family, an entry of kind "neutral".
        parameters: of the oscillator.
    """

    attractors: tuple[LimitCycle, ...]
    labels: NDArray[np.int8]
    parameters: OscillatorParameters

    def fraction(self, label: int) -> tuple[float, float]:
        """Return the share of starts with a label and its standard error were they drawn evenly, sqrt(p (1 - p)/n)."""
        share = float((self.labels == label).mean())
        return share, math.sqrt(share * (1.0 - share) / self.labels.size)


def basins(parameters: OscillatorParameters, x: ArrayLike, v: ArrayLike, *, threads: int | None = None) -> Basins:
    """Return the attractor that each start reaches.

    A start is followed only until it sticks (the end of its stick interval tells the rest) or passes a maximum of x
    so near an equilibrium that the return map's fixed points, found beforehand, decide.

    Args:
        parameters: of the oscillator, with a moving belt.
        x, v: starts, broadcast against each other, each in [-10, 10].
        threads: at most so many; None: as many as there are cores, where there are enough starts.

    Raises:
        ValueError: if a start is not in its range, the belt stands still or the oscillator is excited.
    """
    xs, vs = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(v, dtype=np.float64))
    for name, values in (("x", xs), ("v", vs)):
        if not values.size:
            raise ValueError(f"{name} must hold at least one start, got shape {values.shape}")
        worst = values.flat[int(np.argmax(np.where(np.isfinite(values), np.abs(values), np.inf)))]
        checked_number(name, float(worst), -STATE_LIMIT, STATE_LIMIT)
    found, classify = _classifier(parameters)
    labels = np.empty(xs.size, dtype=np.int8)
    flat_x, flat_v = np.ascontiguousarray(xs).ravel(), np.ascontiguousarray(vs).ravel()

    def classify_part(part: slice) -> None:
        classify(flat_x[part], flat_v[part], labels[part])

    # Starts do not know of each other: any number of threads gives the same labels. Few starts are not worth one.
    threads = min(threads or os.cpu_count() or 1, xs.size // _STARTS_WORTH_A_THREAD)
    if threads < 2:
        classify_part(slice(None))
    else:
        edges = np.linspace(0, xs.size, 8 * threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(classify_part, itertools.starmap(slice, itertools.pairwise(edges))))
    return Basins(attractors=found, labels=labels.reshape(xs.shape), parameters=parameters)


@functools.lru_cache(maxsize=16)
def _classifier(parameters: OscillatorParameters) -> tuple[tuple[LimitCycle, ...], _Classify]:
    """Return the attractors, and the function that writes which of them the starts (x, v), (n,) each, reach."""
    found = tuple(attractors(parameters))

    def label_of(cycle: LimitCycle | None) -> int:
        alike = (i for i, known in enumerate(found) if cycle is not None and same_motion(cycle, known))
        return next(alike, UNDECIDED)

    exits, exit_labels = [], []
    for _, right in stick_intervals(parameters):
        exits.append(right)
        try:
            exit_labels.append(label_of(limit_of_motion(parameters, right, parameters.belt_speed)))
        except ContactLossError:
            exit_labels.append(LOST_CONTACT)
        except OrbitError:
            exit_labels.append(UNDECIDED)
    traps = traps_of(parameters)
    trap_labels = [label_of(limit_of_motion(parameters, place, 0.0)) for place in traps[:, kernel.TRAP_X].tolist()]
    places = [place.x for place in equilibria(parameters)]
    limits = {places.index(centre): rows for centre, rows in limits_of_slip(parameters)}
    width = max(map(len, limits.values()), default=0) + 1
    bounds = np.full((len(places), width), np.inf)
    bound_labels = np.full((len(places), width), UNDECIDED, dtype=np.int64)
    for i, rows in limits.items():
        bounds[i, : len(rows)] = [row.radius for row in rows]
        bound_labels[i, : len(rows)] = [label_of(row.cycle) for row in rows]
    known = (
        np.array(exits, dtype=np.float64),
        np.array(exit_labels, dtype=np.int64),
        traps,
        np.array(trap_labels, dtype=np.int64),
        np.array(places, dtype=np.float64),
        bounds,
        bound_labels,
    )

    def classify(
        x: NDArray[np.float64], v: NDArray[np.float64], into: NDArray[np.int8], turnings: int = _MOST_TURNINGS
    ) -> None:
        kernel.classify(parameters.plant, parameters.belt_speed, x, v, *known, turnings, into)

    def label_from(low: float, high: float) -> int:
        """Return the label of all maxima between two places, UNDECIDED if they have not one."""
        label = UNDECIDED
        for count in _SAMPLED_MAXIMA:
            reached = np.empty(count, dtype=np.int8)
            classify(np.linspace(low, high, count + 2)[1:-1], np.zeros(count), reached, _SAMPLED_TURNINGS)
            if (reached == UNDECIDED).any() or (reached != (reached[0] if label == UNDECIDED else label)).any():
                return UNDECIDED
            label = int(reached[0])
        return label

    # Where all maxima drift out of a range of radii, what follows is known as soon as that of its neighbours is: those
    # that drift outwards are looked at from outside, the others from inside.
    leaving = [(i, j, row.leaves) for i, rows in limits.items() for j, row in enumerate(rows) if row.leaves is not None]
    outwards = [(i, j, leaves) for i, j, leaves in leaving if leaves[0] >= bounds[i, j]]
    order = [*reversed(outwards), *(entry for entry in leaving if entry not in outwards)]
    for _ in range(width):
        before = bound_labels.copy()
        for i, j, (low, high) in order:
            if bound_labels[i, j] == UNDECIDED:
                bound_labels[i, j] = label_from(places[i] + low, places[i] + high)
        if np.array_equal(bound_labels, before):
            break
    return found, classify


def basin_grid(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float] = (-1.5, 1.5),
    v_limits: tuple[float, float] = (-1.0, 1.0),
    shape: tuple[int, int] = (400, 400),
) -> tuple[NDArray[np.float64], NDArray[np.float64], Basins]:
    """Return x of shape (n,), v of shape (m,) and the basins of their grid, labels of shape (m, n).

    Args:
        parameters: of the oscillator. x_limits, v_limits: of the grid, both ends included. shape: (n, m).

    Raises:
        ValueError: if limits are reversed or out of range, or the shape is not of whole numbers from 2 on.
    """
    x, v = checked_grid(x_limits, v_limits, shape)
    grid_x, grid_v = np.meshgrid(x, v)
    return x, v, basins(parameters, grid_x, grid_v)


def checked_grid(
    x_limits: tuple[float, float], v_limits: tuple[float, float], shape: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the axes of a grid, x of shape (n,) and v of shape (m,).

    Raises:
        ValueError: if limits are reversed or out of range, or the shape is not of whole numbers from 2 on.
    """
    axes = []
    for name, (low, high), count in zip(("x_limits", "v_limits"), (x_limits, v_limits), shape, strict=True):
        low = checked_number(f"{name} low", low, -STATE_LIMIT, STATE_LIMIT)
        high = checked_number(f"{name} high", high, -STATE_LIMIT, STATE_LIMIT)
        if not low < high:
            raise ValueError(f"{name} must have low < high, got {(low, high)}")
        if count != int(count) or count < 2:
            raise ValueError(f"shape must hold whole numbers from 2 on, got {shape}")
        axes.append(np.linspace(low, high, int(count)))
    return axes[0], axes[1]
