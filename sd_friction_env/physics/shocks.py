"""Basin integrity: how large each attractor's basin is, and the smallest disturbance that leaves it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env.physics.basins import LOST_CONTACT, UNDECIDED, basins
from sd_friction_env.physics.orbits import LimitCycle, attractors
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_count, checked_number
from sd_friction_env.physics.starts import checked_grid, share_interval
from sd_friction_env.physics.tables import Table
from sd_friction_env.physics.theory import FloatArray

_PHASES = 1024  # of a cycle, from which shocks are drawn
_MISSES = 3  # rounds in a row without a smaller shock, after which the search ends
_RAYS = 9  # phases, and directions, of the local search
_NARROWEST = 1e-8  # its last width, in turns
_HALVINGS = 45  # of the shock's size along a ray


class Shock(NamedTuple):
    """The smallest disturbance found that leaves a basin.

    Attributes:
        size: sqrt((dx/scale_x)^2 + (dv/scale_v)^2); NaN if no start within the limit leaves.
        x, v: the state that is disturbed. dx, dv: the disturbance.
        reaches: label of the basin that it enters (-1: the mass loses contact).
    """

    size: float
    x: float
    v: float
    dx: float
    dv: float
    reaches: int


def smallest_shock(
    cycle: LimitCycle,
    *,
    point: tuple[float, float] | None = None,
    scales: tuple[float, float] = (1.0, 1.0),
    limit: float = 2.0,
    starts: int = 20_000,
    seed: int = 0,
) -> Shock:
    """Return the smallest sudden change of (x, v) after which a motion ends on another attractor (the minimal fatal
    shock; Halekotte and Feudel, 2020).

    Starts are drawn in the disc of the smallest shock found so far; from each smaller one a local search over phase,
    direction and, by bisection, size goes down to the boundary. It ends after three rounds with none smaller: a part of
    the other basin that is nearer, but covers less than about 1/(3 starts) of the disc, may be missed. Starts that are
    not decided count as not leaving.

    Args:
        cycle: an attractor.
        point: the state that is disturbed; by default the worst phase of the cycle.
        scales: of dx and dv in the shock's size, each in [1e-6, 1e6].
        limit: largest size searched, in [1e-6, 20].
        starts: drawn in each round, in [100, 1e7].
        seed: of the draws.

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or basins are not defined.
    """
    check_search(starts, scales, limit, seed)
    search = _Search(cycle, point, scales)
    rng = np.random.default_rng(int(seed))
    starts = int(starts)
    best = np.array([float(limit), 0.0, 0.0])  # size, phase and direction, both in turns
    found = False
    misses = 0
    while misses < _MISSES:
        rays = np.array([np.sqrt(rng.random(starts)) * best[0], rng.integers(_PHASES, size=starts), rng.random(starts)])
        rays[1] /= _PHASES
        leaving = np.flatnonzero(search.leaves(rays))
        if leaving.size:
            best, found, misses = search.descend(rays[:, leaving[np.argmin(rays[0, leaving])]]), True, 0
        else:
            misses += 1
    if not found:
        return Shock(math.nan, math.nan, math.nan, math.nan, math.nan, UNDECIDED)
    before, after = search.states(best[:, None])
    x, v, dx, dv = (float(part[0]) for part in (*before, *(after - before)))
    return Shock(float(best[0]), x, v, dx, dv, int(search.labels(best[:, None])[0]))


def check_search(starts: int, scales: Sequence[float], limit: float, seed: int) -> None:
    """Raise TypeError or ValueError if an argument of :func:`smallest_shock` is not of its type or in its range."""
    checked_count("starts", starts, 100, 10**7)
    if len(scales) != 2:
        raise ValueError(f"scales must be two numbers, of dx and of dv, got {scales!r}")
    for scale in scales:
        checked_number("scales", scale, 1e-6, 1e6)
    checked_number("limit", limit, 1e-6, 2.0 * STATE_LIMIT)
    checked_count("seed", seed, 0, 2**63 - 1)


class _Search:
    """Rays, (3, n): size, phase and direction of shocks, and whether they leave the basin of an attractor."""

    def __init__(self, cycle: LimitCycle, point: tuple[float, float] | None, scales: tuple[float, float]) -> None:
        self.parameters, self.cycle = cycle.parameters, cycle
        self.scales = np.array(scales, dtype=np.float64)[:, None]
        self.point = None if point is None else [checked_number("point", p, -STATE_LIMIT, STATE_LIMIT) for p in point]
        self.moves = self.point is None and cycle.period > 0.0
        self.table = np.array([cycle.state(i / _PHASES) for i in range(_PHASES)]).T if self.moves else None
        self.own = int(self.labels(np.zeros((3, 1)))[0])

    def states(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the states before and after each shock, (2, n) each."""
        before = np.empty((2, rays.shape[1]))
        if self.table is None:
            before.T[:] = self.cycle.state(0.0) if self.point is None else self.point
        else:
            phases, which = np.unique(rays[1] % 1.0, return_inverse=True)
            steps = phases * _PHASES
            stored = (steps == np.floor(steps)).all()
            exact = self.table[:, steps.astype(int)] if stored else np.array([*map(self.cycle.state, phases)]).T
            before[:] = exact[:, which]
        turn = 2.0 * math.pi * rays[2]
        return before, before + self.scales * rays[0] * np.array([np.cos(turn), np.sin(turn)])

    def labels(self, rays: FloatArray) -> Any:
        """Return the label of the start after each shock."""
        return basins(self.parameters, *np.clip(self.states(rays)[1], -STATE_LIMIT, STATE_LIMIT)).labels

    def leaves(self, rays: FloatArray) -> Any:
        """Return whether each shock leaves the basin."""
        labels = self.labels(rays)
        return (labels != self.own) & (labels != UNDECIDED)

    def descend(self, best: FloatArray) -> FloatArray:
        """Return the smallest shock near one that leaves."""
        best = self._shortened(best[:, None])[:, 0]
        width = 0.1
        while width > _NARROWEST:
            offsets = width * np.linspace(-1.0, 1.0, _RAYS)
            phases, turns = np.meshgrid(offsets if self.moves else offsets[:1] * 0.0, offsets)
            rays = best[:, None] + np.array([np.zeros(turns.size), phases.ravel(), turns.ravel()])
            rays[0] *= 1.0 - 1e-12
            rays = rays[:, self.leaves(rays)]
            if rays.size:
                rays = self._shortened(rays)
                best = rays[:, np.argmin(rays[0])]
            else:
                width *= 0.4
        return best

    def _shortened(self, rays: FloatArray) -> FloatArray:
        """Return shocks that leave, cut by bisection to where they just do."""
        low, high = np.zeros(rays.shape[1]), rays[0].copy()
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            leaving = self.leaves(np.array([middle, rays[1], rays[2]]))
            low, high = np.where(leaving, low, middle), np.where(leaving, middle, high)
        return np.array([high, rays[1], rays[2]])


def basin_integrity(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float] = (-1.5, 1.5),
    v_limits: tuple[float, float] = (-1.0, 1.0),
    *,
    starts: int = 20_000,
    scales: tuple[float, float] = (1.0, 1.0),
    limit: float = 2.0,
    seed: int = 0,
) -> Table:
    """Return the share of starts that reaches each attractor, and the smallest shock that leaves it.

    Args:
        parameters: of the oscillator, with a moving belt.
        x_limits, v_limits: between which starts are drawn uniformly, in [-10, 10].
        starts: number drawn for the shares, and in each round of :func:`smallest_shock`, in [100, 1e7].
        scales, limit: as of :func:`smallest_shock`; a cycle is disturbed at its worst phase.
        seed: of the draws.

    Returns:
        A table with a row for each attractor: attractor (its label), kind, amplitude, x_max, x_min; fraction with its
        95% interval fraction_low, fraction_high (Wilson); shock, x, v, dx, dv, reaches as of :class:`Shock`; and note
        (why there is no shock, else empty). Without an attractor it is one row with that note.

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or basins are not defined.
    """
    checked_grid(x_limits, v_limits, (2, 2))
    check_search(starts, scales, limit, seed)
    starts, rng = int(starts), np.random.default_rng(int(seed))
    labels = basins(parameters, rng.uniform(*x_limits, starts), rng.uniform(*v_limits, starts)).labels
    found = attractors(parameters)
    rows: list[dict[str, Any]] = []
    for label, cycle in enumerate(found):
        hits = int((labels == label).sum())
        low, high = share_interval(hits, starts)
        shock = smallest_shock(cycle, scales=scales, limit=limit, starts=starts, seed=seed)
        only = len(found) == 1 and not (labels == LOST_CONTACT).any()
        note = "" if shock.size > 0.0 else "the only attractor" if only else f"no shock up to {limit:g} leaves it"
        row: dict[str, Any] = {"attractor": label, "kind": cycle.kind, "amplitude": cycle.amplitude}
        row |= {"x_max": cycle.x_max, "x_min": cycle.x_min, "fraction": hits / starts}
        row |= {"fraction_low": low, "fraction_high": high, "shock": shock.size}
        rows.append(row | dict(zip(shock._fields[1:], shock[1:], strict=True)) | {"note": note})
    if not rows:
        return without_attractors("no attractor that keeps contact was found")
    metadata = {"parameters": dataclasses.asdict(parameters), "starts": starts, "scales": list(scales), "seed": seed}
    return Table.from_rows(rows, metadata)


def without_attractors(note: str) -> Table:
    """Return the table of :func:`basin_integrity` of an oscillator without attractors: one row with the reason."""
    row: dict[str, Any] = {"attractor": UNDECIDED, "kind": "none"}
    row |= dict.fromkeys(("amplitude", "x_max", "x_min", "fraction", "fraction_low", "fraction_high"), math.nan)
    row |= {"shock": math.nan} | dict.fromkeys(Shock._fields[1:5], math.nan) | {"reaches": UNDECIDED, "note": note}
    return Table.from_rows([row])
