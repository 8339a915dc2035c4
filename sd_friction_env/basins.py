"""Which attractor a start reaches: starts by the million, fractions of them, and grids to draw."""

import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.orbits import (
    LimitCycle,
    OrbitError,
    ReturnMap,
    attractors,
    equilibria,
    limit_cycle,
    same_motion,
    stick_intervals,
)
from sd_friction_env.parameters import STATE_LIMIT, OscillatorParameters, checked_number

LOST_CONTACT, UNDECIDED = -1, -2

_STARTS_WORTH_A_THREAD = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Basins:
    """The attractors of an oscillator and the starts that reach each.

    Attributes:
        attractors: as :func:`sd_friction_env.orbits.attractors` lists them.
        labels: index into ``attractors`` of each start, of the shape of the starts; -1: the mass loses contact,
            -2: not decided.
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
    found = list(attractors(parameters))

    def label_of(cycle: LimitCycle) -> int:
        for i, known in enumerate(found):
            if same_motion(cycle, known):
                return i
        found.append(cycle)
        return len(found) - 1

    exits, exit_labels = [], []
    for _, right in stick_intervals(parameters):
        exits.append(right)
        try:
            exit_labels.append(label_of(limit_cycle(parameters, right, parameters.belt_speed)))
        except OrbitError:
            exit_labels.append(LOST_CONTACT)
    places = equilibria(parameters)
    decided = [_decided_radii(parameters, place.x, found) for place in places]
    width = max((len(rows) for rows in decided), default=0) + 1
    bounds = np.full((len(places), width), np.inf)
    bound_labels = np.full((len(places), width), UNDECIDED, dtype=np.int64)
    for i, rows in enumerate(decided):
        for j, (bound, label) in enumerate(rows):
            bounds[i, j], bound_labels[i, j] = bound, label
    labels = np.empty(xs.size, dtype=np.int8)
    flat_x, flat_v = np.ascontiguousarray(xs).ravel(), np.ascontiguousarray(vs).ravel()
    known = (
        np.array(exits),
        np.array(exit_labels, dtype=np.int64),
        np.array([place.x for place in places]),
        bounds,
        bound_labels,
    )

    def classify(part: slice) -> None:
        kernel.classify(parameters.plant, parameters.belt_speed, flat_x[part], flat_v[part], *known, labels[part])

    # Starts do not know of each other: any number of threads gives the same labels. Few starts are not worth one.
    threads = min(threads or os.cpu_count() or 1, xs.size // _STARTS_WORTH_A_THREAD)
    if threads < 2:
        classify(slice(None))
    else:
        edges = np.linspace(0, xs.size, 8 * threads + 1).astype(int).tolist()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(classify, itertools.starmap(slice, itertools.pairwise(edges))))
    return Basins(attractors=tuple(found), labels=labels.reshape(xs.shape), parameters=parameters)


def _decided_radii(parameters: OscillatorParameters, centre: float, found: list[LimitCycle]) -> list[tuple[float, int]]:
    """Return (bound, label) pairs: maxima of x between the last bound and this, from the centre, tend there."""
    laps = ReturnMap(parameters, centre, centre)
    radii, last = laps.cycles()

    def label_at(radius: float) -> int:
        for i, cycle in enumerate(found):
            if cycle.kind in ("pure-slip", "steady-slip") and abs(cycle.x_max - centre - radius) < 1e-6:
                return i
        return UNDECIDED

    if last == 0.0:  # no lap: a saddle, or a node that is crept into
        return [(0.0, label_at(0.0))]
    # Between neighbouring fixed points (the equilibrium is one, of radius 0) all maxima move the same way.
    fixed = [0.0, *radii]
    rows = []
    for inner, outer in zip(fixed, [*radii, last], strict=True):
        if not outer > inner:
            continue
        grows = laps.shift(0.5 * (inner + outer)) > 0.0
        if not grows:
            rows.append((outer, label_at(inner)))
        elif outer != last or outer in radii:
            rows.append((outer, label_at(outer)))
        else:
            rows.append((outer, UNDECIDED))
    return rows


def basin_grid(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
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
