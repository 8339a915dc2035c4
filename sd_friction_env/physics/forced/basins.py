"""Basins under excitation: which attractor of the stroboscopic map each start on a grid reaches."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.forced.exponents import LyapunovExponent, exponent_of
from sd_friction_env.physics.forced.orbits import ForcedOrbit, forced_orbit
from sd_friction_env.physics.forced.sections import MOST_CYCLES, Stroboscope, stroboscope
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count, checked_number
from sd_friction_env.physics.starts import checked_grid, in_threads
from sd_friction_env.physics.theory import FloatArray

LOST_CONTACT, UNDECIDED = -1, -2  # labels of starts

_SAMPLED_STARTS = 64
_LEFT_STARTS = 8  # examined one by one in each round
_CHAOS_CYCLES = 400
_ERRORS_FOR_CHAOS = 3.0
_STARTS_WORTH_A_THREAD = 200


@dataclass(frozen=True, kw_only=True, eq=False)
class ForcedBasins:
    """Which attractor of the stroboscopic map the starts on a grid reach.

    Attributes:
        x, v: axes of the grid, shapes (n,) and (m,).
        labels: of each start, (m, n): index into ``attractors``; len(attractors) for chaos; -1 the mass loses contact,
            -2 not decided.
        attractors: the periodic ones, the left-most first.
        chaos: the exponent of the chaotic one, or None.
        parameters: of the oscillator.
    """

    x: FloatArray
    v: FloatArray
    labels: NDArray[np.int64]
    attractors: tuple[ForcedOrbit, ...]
    chaos: LyapunovExponent | None
    parameters: OscillatorParameters

    def fraction(self, label: int) -> float:
        """Return the share of starts with a label."""
        return float((self.labels == label).mean())


def forced_basins(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
    shape: tuple[int, int] = (100, 100),
    *,
    cycles: int = 200,
    tolerance: float = 1e-4,
    most: int = 32,
    phase: float = 0.0,
    period: float | None = None,
) -> ForcedBasins:
    """Return which attractor of the stroboscopic map each start on a grid reaches.

    Attractors are searched among the ends of a sample of the starts, and of starts that reach none of those known. A
    start has the label of the first periodic one of whose section points it is within ``tolerance`` at the end of a
    cycle. One that is near none after ``cycles`` cycles is counted to the chaotic attractor, if a positive exponent
    (by three standard errors) showed one, and is undecided if not: only more cycles distinguish a slow transient from
    chaos.

    Args:
        parameters: of the oscillator.
        x_limits, v_limits: of the grid, both ends included, in [-10, 10].
        shape: (n, m), whole numbers from 2 on.
        cycles: after which a start is given up, from 1 on.
        tolerance: in x and in v, in [1e-9, 0.1].
        most: the greatest multiple of the excitation's period that counts as periodic.
        phase, period: as in :func:`forced_orbit`.

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    x, v = checked_grid(x_limits, v_limits, shape)
    search = _Search(
        stroboscope(parameters, period, phase, repeats=True),
        *np.meshgrid(x, v),
        cycles=checked_count("cycles", cycles, 1, MOST_CYCLES),
        tolerance=checked_number("tolerance", tolerance, 1e-9, 0.1),
        most=checked_count("most", most, 1, 10_000),
    )
    labels = search.label_all()
    order = sorted(range(len(search.found)), key=lambda i: search.found[i].x_min)
    for label, members in enumerate([labels == i for i in order]):
        labels[members] = label
    return ForcedBasins(
        x=x,
        v=v,
        labels=labels.reshape(len(v), len(x)),
        attractors=tuple(search.found[i] for i in order),
        chaos=search.chaos,
        parameters=parameters,
    )


class _Search:
    """Starts that are followed, and the attractors found so far."""

    def __init__(
        self, strobe: Stroboscope, x: FloatArray, v: FloatArray, *, cycles: int, tolerance: float, most: int
    ) -> None:
        self.strobe, self.cycles, self.tolerance, self.most = strobe, cycles, tolerance, most
        self.x, self.v = x.ravel(), v.ravel()
        self.found: list[ForcedOrbit] = []
        self.chaos: LyapunovExponent | None = None

    def label_all(self) -> NDArray[np.int64]:
        """Return the label of every start."""
        sample = _spread(np.arange(self.x.size), _SAMPLED_STARTS)
        self.find_attractors(sample[self.follow(sample) == UNDECIDED])
        labels = np.full(self.x.size, UNDECIDED, dtype=np.int64)
        left = np.arange(self.x.size)
        while left.size:
            labels[left] = self.follow(left)
            left = left[labels[left] == UNDECIDED]
            if not self.find_attractors(_spread(left, _LEFT_STARTS)):
                break
        if self.chaos is not None:
            labels[labels == UNDECIDED] = len(self.found)
        return labels

    def follow(self, which: NDArray[np.intp]) -> NDArray[np.int64]:
        """Advance starts, each until its label is known, and return the labels."""
        points = np.concatenate([np.empty((0, 2)), *(orbit.points for orbit in self.found)])
        owners = np.repeat(np.arange(len(self.found)), [orbit.multiple for orbit in self.found])
        x, v, labels = self.x[which], self.v[which], np.empty(len(which), dtype=np.int64)
        plant, belt_speed = self.strobe.plant, self.strobe.parameters.belt_speed
        fixed = belt_speed, self.strobe.period, self.cycles, points, owners, self.tolerance

        def label(part: slice) -> None:
            kernel.label_attractors(plant, x[part], v[part], *fixed, labels[part])

        in_threads(label, len(which), _STARTS_WORTH_A_THREAD)
        self.x[which], self.v[which] = x, v
        return labels

    def find_attractors(self, which: NDArray[np.intp]) -> bool:
        """Search for attractors where starts have arrived; return whether one is new."""
        parameters, period, phase = self.strobe
        new = False
        for i in which.tolist():
            state = float(self.x[i]), float(self.v[i])
            known = [point for orbit in self.found for point in orbit.points]
            if any(np.abs(point - state).max() <= self.tolerance for point in known):
                continue
            try:
                orbit = forced_orbit(parameters, *state, most=self.most, transient=0, phase=phase, period=period)
            except (OrbitError, ValueError):  # a state beyond STATE_LIMIT belongs to a motion without end
                self.chaos = self.chaos or self._chaos_from(state)
                continue
            if all(np.abs(point - orbit.points[0]).max() > self.tolerance for point in known):
                self.found.append(orbit)
                new = True
        return new

    def _chaos_from(self, state: tuple[float, float]) -> LyapunovExponent | None:
        try:
            exponent = exponent_of(self.strobe, self.strobe.follow(state, 0, _CHAOS_CYCLES, growing=True))
        except OrbitError:
            return None
        return exponent if exponent.largest > _ERRORS_FOR_CHAOS * exponent.standard_error else None


def _spread(which: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return at most ``count`` of some indices, evenly spread."""
    if not which.size:
        return which
    return which[np.unique(np.linspace(0, which.size - 1, count).astype(np.intp))]
