"""Basins of attraction: which attractor each start reaches, for millions of starts, and their shares."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.orbits import (
    ContactLossError,
    LimitCycle,
    OrbitError,
    SlipLimit,
    attractors,
    equilibria,
    limit_of_motion,
    limits_of_slip,
    same_motion,
    stick_intervals,
    traps_of,
)
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.physics.starts import checked_grid, in_threads, share_interval
from sd_friction_env.physics.tables import Table

LOST_CONTACT, UNDECIDED = -1, -2

_STARTS_WORTH_A_THREAD = 20_000
_MOST_TURNINGS, _SAMPLED_TURNINGS = 20_000, 400  # over which a start is followed, and a sampled maximum
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
        """Return the share p of starts with a label, and its standard error for uniform draws, sqrt(p (1 - p)/n)."""
        share = float((self.labels == label).mean())
        return share, math.sqrt(share * (1.0 - share) / self.labels.size)

    def fractions(self) -> Table:
        """Return the shares of the attractors, of loss of contact and of starts that are not decided: see
        :func:`fraction_table`."""
        labels = range(UNDECIDED, len(self.attractors))
        return fraction_table(self.attractors, [int(np.count_nonzero(self.labels == label)) for label in labels])


def fraction_table(found: Sequence[LimitCycle], counts: Sequence[int]) -> Table:
    """Return shares of starts as a table.

    Args:
        found: attractors.
        counts: numbers of starts with the labels -2, -1 (see :class:`Basins`), 0, 1, ...

    Returns:
        A table with a row for each attractor and for the labels -1 and -2: label, attractor (its kind and middle),
        amplitude, fraction, its standard_error for uniform draws, and its 95% interval fraction_low, fraction_high
        (Wilson).
    """
    rows = []
    total = sum(map(int, counts))
    for label in (*range(len(found)), LOST_CONTACT, UNDECIDED):
        cycle = found[label] if label >= 0 else None
        name = {LOST_CONTACT: "contact lost", UNDECIDED: "undecided"}.get(label, "")
        if cycle is not None:
            name = f"{cycle.kind} round x = {0.5 * (cycle.x_max + cycle.x_min):.4f}"
        count = int(counts[label - UNDECIDED])
        share, (low, high) = count / total, share_interval(count, total)
        row = {"label": label, "attractor": name, "amplitude": cycle.amplitude if cycle else math.nan}
        row |= {"fraction": share, "standard_error": math.sqrt(share * (1.0 - share) / total)}
        rows.append(row | {"fraction_low": low, "fraction_high": high})
    return Table.from_rows(rows)


def basins(parameters: OscillatorParameters, x: ArrayLike, v: ArrayLike, *, threads: int | None = None) -> Basins:
    """Return the attractor that each start reaches.

    A start is followed only until it sticks (the end of its stick interval decides the rest) or passes a maximum of x
    so near an equilibrium that the return map's fixed points, found beforehand, decide.

    Args:
        parameters: of the oscillator, with a moving belt.
        x, v: starts, broadcast against each other, each in [-10, 10].
        threads: maximum number; None: one per core, where there are enough starts.

    Raises:
        ValueError: if a start is not in its range, the belt stands still or the oscillator is excited.
    """
    xs, vs = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(v, dtype=np.float64))
    for name, values in (("x", xs), ("v", vs)):
        if not values.size:
            raise ValueError(f"{name} must hold at least one start, got shape {values.shape}")
        worst = values.flat[int(np.argmax(np.where(np.isfinite(values), np.abs(values), np.inf)))]
        checked_number(name, float(worst), -STATE_LIMIT, STATE_LIMIT)
    known = _labels_for(parameters)
    labels = np.empty(xs.size, dtype=np.int8)
    flat_x, flat_v = np.ascontiguousarray(xs).ravel(), np.ascontiguousarray(vs).ravel()

    def classify_part(part: slice) -> None:
        known.classify(flat_x[part], flat_v[part], labels[part])

    in_threads(classify_part, xs.size, _STARTS_WORTH_A_THREAD, threads)
    return Basins(attractors=known.found, labels=labels.reshape(xs.shape), parameters=parameters)


class _Labels:
    """Labels of all that a start can come to, and the compiled search that reads them.

    Attributes:
        found: the attractors.
    """

    def __init__(self, parameters: OscillatorParameters) -> None:
        self.parameters = parameters
        self.found = tuple(attractors(parameters))
        exits = [right for _, right in stick_intervals(parameters)]
        traps = traps_of(parameters)
        places = [e.x for e in equilibria(parameters)]
        limits = {places.index(centre): rows for centre, rows in limits_of_slip(parameters)}
        width = max(map(len, limits.values()), default=0) + 1
        self._bounds = np.full((len(places), width), np.inf)
        self._bound_labels = np.full((len(places), width), UNDECIDED, dtype=np.int64)
        for i, rows in limits.items():
            self._bounds[i, : len(rows)] = [row.radius for row in rows]
            self._bound_labels[i, : len(rows)] = [self._label_of(row.cycle) for row in rows]
        trap_labels = [
            self._label_of(limit_of_motion(parameters, place, 0.0)) for place in traps[:, kernel.TRAP_X].tolist()
        ]
        self._known = (
            np.array(exits, dtype=np.float64),
            np.array([self._label_of_exit(right) for right in exits], dtype=np.int64),
            traps,
            np.array(trap_labels, dtype=np.int64),
            np.array(places, dtype=np.float64),
            self._bounds,
            self._bound_labels,
        )
        self._label_ranges_that_are_left(places, limits)

    def _label_of(self, cycle: LimitCycle | None) -> int:
        alike = (i for i, known in enumerate(self.found) if cycle is not None and same_motion(cycle, known))
        return next(alike, UNDECIDED)

    def _label_of_exit(self, right: float) -> int:
        """Return the label of a mass that breaks away at the end of a stick interval."""
        try:
            return self._label_of(limit_of_motion(self.parameters, right, self.parameters.belt_speed))
        except ContactLossError:
            return LOST_CONTACT
        except OrbitError:
            return UNDECIDED

    def classify(
        self, x: NDArray[np.float64], v: NDArray[np.float64], labels: NDArray[np.int8], turnings: int = _MOST_TURNINGS
    ) -> None:
        """Write the labels of the starts (x, v), (n,) each."""
        kernel.classify(self.parameters.plant, self.parameters.belt_speed, x, v, *self._known, turnings, labels)

    def _label_between(self, low: float, high: float) -> int:
        """Return the label of all maxima between two places, UNDECIDED if they have several."""
        label = UNDECIDED
        for count in _SAMPLED_MAXIMA:
            reached = np.empty(count, dtype=np.int8)
            self.classify(np.linspace(low, high, count + 2)[1:-1], np.zeros(count), reached, _SAMPLED_TURNINGS)
            if (reached == UNDECIDED).any() or (reached != (reached[0] if label == UNDECIDED else label)).any():
                return UNDECIDED
            label = int(reached[0])
        return label

    def _label_ranges_that_are_left(self, places: list[float], limits: dict[int, list[SlipLimit]]) -> None:
        """Label the ranges of radii that all maxima leave.

        The label of such a range is known as soon as that of its neighbours is: those left outwards are examined from
        outside, the others from inside.
        """
        leaving = [
            (i, j, row.leaves) for i, rows in limits.items() for j, row in enumerate(rows) if row.leaves is not None
        ]
        outwards = [(i, j, leaves) for i, j, leaves in leaving if leaves[0] >= self._bounds[i, j]]
        order = [*reversed(outwards), *(entry for entry in leaving if entry not in outwards)]
        for _ in range(self._bounds.shape[1]):
            before = self._bound_labels.copy()
            for i, j, (low, high) in order:
                if self._bound_labels[i, j] == UNDECIDED:
                    self._bound_labels[i, j] = self._label_between(places[i] + low, places[i] + high)
            if np.array_equal(self._bound_labels, before):
                break


_labels_for = functools.lru_cache(maxsize=16)(_Labels)


def basin_grid(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float] = (-1.5, 1.5),
    v_limits: tuple[float, float] = (-1.0, 1.0),
    shape: tuple[int, int] = (400, 400),
) -> tuple[NDArray[np.float64], NDArray[np.float64], Basins]:
    """Return x of shape (n,), v of shape (m,) and the basins of their grid, labels of shape (m, n).

    Args:
        parameters: of the oscillator.
        x_limits, v_limits: of the grid, both ends included, in [-10, 10].
        shape: (n, m).

    Raises:
        ValueError: if limits are reversed or out of range, or the shape is not of whole numbers from 2 on.
    """
    x, v = checked_grid(x_limits, v_limits, shape)
    grid_x, grid_v = np.meshgrid(x, v)
    return x, v, basins(parameters, grid_x, grid_v)
