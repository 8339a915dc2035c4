"""The map from one maximum of x to the next in slip, and its fixed points: the pure-slip cycles."""

import bisect
import functools
import itertools
import math
from typing import NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.orbits.balance import (
    SMALLEST_RADIUS,
    Equilibrium,
    conserves_energy,
    equilibria,
    find_root,
    is_centre,
    search_radius,
    slip_dissipates,
    traps_of,
)
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters

_STILL_SHARE = 0.01
_FINEST_RATIO = 1.15  # of neighbouring radii at which the map is sampled
_SAMPLES_OF_A_GAP = (15, 7)
_LAP_ERROR = 1e-13  # of the map, relative to max(1, |x|): less is rounding
_STEP_ERROR = 1e-9  # promised of the steps, per unit of time
_LARGEST_DOUBTED = 1e-5  # radius up to which that error may hide what a lap does
_LARGEST_SMALL = 1e-2  # radius about an equilibrium up to which its Hopf normal form holds
_MOST_LAPS = 2000


class NoLapError(Exception):
    """An orbit of this radius has no lap; the return map is not defined there."""

    def __init__(self, radius: float) -> None:
        super().__init__(radius)
        self.radius = radius


LapKind = tuple[int, int]  # number of equilibria left of the orbit, and of its forward arcs
Shift = tuple[float, float]  # a radius, and how much a lap adds to it


class LapRange(NamedTuple):
    """Radii between which the return map is continuous.

    Attributes:
        ends: the first radius and the last; the first is 0 where the range begins at the equilibrium.
        after: radii of the maxima that follow the ends.
        cycles: radii of the fixed points between, ascending.
        tendencies: direction of the maxima between consecutive radii: 1 outwards, -1 inwards, 0 not resolved.
        kind: of its laps.
        neutral: whether every lap closes up to rounding.
    """

    ends: tuple[float, float]
    after: tuple[float, float]
    cycles: tuple[float, ...]
    tendencies: tuple[int, ...]
    kind: LapKind
    neutral: bool = False


class _Sample(NamedTuple):
    radius: float
    kind: LapKind | None
    shift: float


class ReturnMap:
    """The map from one maximum of x to the next in slip, by the radius: the distance of the maximum from a centre.

    The maximum lies between the centre, an equilibrium, and the next equilibrium to its right, and so does the next.
    """

    def __init__(self, parameters: OscillatorParameters, equilibrium: Equilibrium) -> None:
        self.parameters, self.equilibrium, self.centre = parameters, equilibrium, equilibrium.x
        self.equilibrium_places = [e.x for e in equilibria(parameters)]
        right = [x for x in self.equilibrium_places if x > self.centre]
        if parameters.discontinuous and self.centre < 0.0:
            right.insert(0, 0.0)  # the spring's switch separates the wells
        self.farthest = right[0] - self.centre if right else math.inf
        self.traps = traps_of(parameters)

    def lap(self, radius: float) -> tuple[LapKind | None, float]:
        """Return the kind of a lap and how much it adds to a radius: None and NaN where there is no lap."""
        plant = self.parameters.plant
        event, following, low, _, _, forward_arcs = kernel.next_maximum(
            plant, self.parameters.belt_speed, self.centre + radius, self.traps
        )
        if event != kernel.TURNING or not 0.0 < following - self.centre < self.farthest or not low <= self.centre:
            return None, math.nan
        # Without friction the belt's speed separates nothing.
        arcs = 0 if plant.friction.breakaway_coefficient(-1) == 0.0 else forward_arcs
        return (bisect.bisect_left(self.equilibrium_places, low), arcs), float(following - self.centre - radius)

    def shift(self, radius: float, kind: LapKind | None) -> float:
        """Return how much one lap of this kind (None: of any) adds to a radius, NaN if there is none."""
        found, change = self.lap(radius)
        return change if kind in (None, found) else math.nan

    def is_resolved(self, radius: float, shift: float) -> bool:
        """Return whether a shift is more than rounding."""
        return abs(shift) > _LAP_ERROR * max(1.0, abs(self.centre + radius))

    def edge(self, kind: LapKind | None, inside: float, outside: float) -> float:
        """Return the last radius with a lap of this kind, between one that has it and one that has not."""
        while True:
            middle = 0.5 * (inside + outside)
            if middle in (inside, outside) or abs(outside - inside) < 1e-15:
                return inside
            if math.isnan(self.shift(middle, kind)):
                outside = middle
            else:
                inside = middle

    def root(self, kind: LapKind | None, low: float, high: float) -> float:
        """Return the radius of the cycle between two radii whose shifts differ in sign.

        Raises:
            NoLapError: if a radius between, met on the way, has no lap of this kind.
        """

        def shift(radius: float) -> float:
            change = self.shift(radius, kind)
            if math.isnan(change):
                raise NoLapError(radius)
            return change

        return find_root(shift, low, high)

    def small_cycle_radius(self, radius: float, kind: LapKind | None) -> float:
        """Return the radius of a cycle so small that rounding hides what a lap does to it.

        Near a Hopf point a lap changes a radius r by r (a - b r^2); a is known from the linearisation, and b from an
        orbit, from ``radius`` outwards, that is large enough.
        """
        e = self.equilibrium
        a = math.expm1(-math.pi * e.damping / math.sqrt(max(e.stiffness - 0.25 * e.damping**2, 1e-300)))
        shift = self.shift(radius, kind)
        while not self.is_resolved(radius, 1e-3 * shift) and radius < _LARGEST_SMALL:
            radius *= 2.0
            shift = self.shift(radius, kind)
        ratio = a / (a - shift / radius)
        return radius * math.sqrt(ratio) if 0.0 < ratio < 1.0 else radius

    def first_without_lap(self, radius: float, kind: LapKind) -> float | None:
        """Return the first radius without a lap of this kind that laps from ``radius`` reach, None after too many."""
        for _ in range(_MOST_LAPS):
            change = self.shift(radius, kind)
            if math.isnan(change):
                return radius
            radius += change
        return None

    def first_resolved_shift(self, radius: float, kind: LapKind | None) -> float:
        """Return the shift of the first orbit from a radius outwards that exceeds rounding, NaN if there is none."""
        shift = self.shift(radius, kind)
        while not (math.isnan(shift) or self.is_resolved(radius, shift)):
            radius *= 1.5
            shift = self.shift(radius, kind)
        return shift

    def samples(self) -> list[_Sample]:
        """Return laps at ascending radii, up to beyond what any accepted start can reach."""
        top = 0.05
        while top < 2.0 * STATE_LIMIT and not math.isnan(self.shift(top, None)):
            top *= 1.5
        grid = np.concatenate((np.geomspace(SMALLEST_RADIUS, 0.01, 24), np.linspace(0.01, top, 80)[1:])).tolist()
        fine = [grid[0]]
        for radius in [*grid[1:], max(top, search_radius(self.parameters, self.equilibrium))]:
            more = math.ceil(math.log(radius / fine[-1]) / math.log(_FINEST_RATIO)) if radius > fine[-1] else 0
            fine += [*np.geomspace(fine[-1], radius, max(more, 1) + 1)[1:-1].tolist(), radius]
        if math.isfinite(self.farthest):
            edge = self.farthest * (1.0 - np.geomspace(1e-6, 0.1, 12))
            fine = sorted(radius for radius in {*fine, *edge.tolist()} if 0.0 < radius < self.farthest)
        smallest = 1.5 * self.equilibrium.capture_radius
        found = [_Sample(radius, *self.lap(radius)) for radius in fine if radius > smallest]
        for count in _SAMPLES_OF_A_GAP:  # where the kind of lap changes there may be laps of a third kind between
            between = [
                radius
                for low, high in itertools.pairwise(found)
                if low.kind != high.kind
                for radius in np.linspace(low.radius, high.radius, count + 2)[1:-1].tolist()
            ]
            found = [*found, *(_Sample(radius, *self.lap(radius)) for radius in between)]
            found.sort(key=lambda sample: sample.radius)
        return found

    def ranges(self) -> list[LapRange]:
        """Return where the map is continuous, with its cycles, ascending.

        Where samples come near zero without crossing it, the extremum is searched, so that a pair of cycles about to
        merge is not stepped over.
        """
        groups = [list(group) for _, group in itertools.groupby(self.samples(), key=lambda sample: sample.kind)]
        found: list[LapRange] = []
        for before, group, after in zip([None, *groups[:-1]], groups, [*groups[1:], None], strict=True):
            kind = group[0].kind
            if kind is None:
                continue
            low = 0.0
            inside = [(sample.radius, sample.shift) for sample in group]
            if before is not None:
                low = self.edge(kind, inside[0][0], before[-1].radius)
                inside.insert(0, (low, self.shift(low, kind)))
            if after is not None:
                high = self.edge(kind, inside[-1][0], after[0].radius)
                inside.append((high, self.shift(high, kind)))
            found += self.continuous_parts(kind, low, inside)
        return found

    def continuous_parts(self, kind: LapKind, low: float, inside: list[Shift]) -> list[LapRange]:
        """Return the ranges that samples of one kind of lap belong to: one, unless gaps are met between the samples.

        ``low`` is where the first begins.
        """
        high = inside[-1][0]
        ends, after = (low, high), (low + inside[0][1], high + inside[-1][1])
        conserved = conserves_energy(self.parameters)
        if conserved or slip_dissipates(self.parameters):
            neutral = conserved and (kind[1] == 0 or _is_frictionless(self.parameters))
            return [LapRange(ends, after, (), (0 if neutral else -1,), kind, neutral)]
        known = [(radius, shift) for radius, shift in inside if self.is_resolved(radius, shift)]
        weak = self.equilibrium.has_roundoff_damping
        if low == 0.0 and weak:
            begin = known[0][0] if known else math.inf
            still = max((radius for radius, _ in inside if radius < begin), default=0.0)
            if still > _STILL_SHARE * high:  # too many for a curvature to decide: friction so level that none moves
                core = LapRange((low, still), (low, still), (), (0,), kind, neutral=True)
                rest = [lap for lap in inside if lap[0] >= still]
                return [core, *(self.continuous_parts(kind, still, rest) if len(rest) > 1 else [])]
        first = 0
        if low == 0.0 and not weak:
            # The equilibrium is a fixed point too: its linearisation decides what rounding hides of small orbits.
            first = -1 if self.equilibrium.damping > 0.0 else 1
            known = self._drop_doubtful(known, first)
        try:
            cycles = self._cycle_radii(kind, known)
            if known and known[0][1] * first < 0.0:
                like = [radius for radius, shift in inside if radius < known[0][0] and shift * first > 0.0]
                cycles = [self.root(kind, like[-1], known[0][0]), *cycles] if like else cycles
        except NoLapError as gap:
            return self._parts_around(gap.radius, kind, low, inside)
        tendencies = []
        for inner, outer in itertools.pairwise([low, *cycles, high]):
            between = [shift for radius, shift in known if inner <= radius <= outer]
            if not between and inner in cycles and outer in cycles:  # a pair close together
                between = [self.shift(0.5 * (inner + outer), kind)]
            tendencies.append(int(np.sign(max(between, key=abs, default=0.0))))
        if tendencies[0] == 0:
            tendencies[0] = first
        return [LapRange(ends, after, tuple(cycles), tuple(tendencies), kind)]

    def _parts_around(self, gap: float, kind: LapKind, low: float, inside: list[Shift]) -> list[LapRange]:
        """Return the ranges on both sides of a radius without a lap."""
        inner = max(radius for radius, _ in inside if radius < gap)
        outer = min(radius for radius, _ in inside if radius > gap)
        end, begin = self.edge(kind, inner, gap), self.edge(kind, outer, gap)
        below = [*(lap for lap in inside if lap[0] < gap), (end, self.shift(end, kind))]
        above = [(begin, self.shift(begin, kind)), *(lap for lap in inside if lap[0] > gap)]
        return self.continuous_parts(kind, low, below) + self.continuous_parts(kind, begin, above)

    def _drop_doubtful(self, known: list[Shift], first: int) -> list[Shift]:
        """Return the samples without the smallest orbits that contradict the sign ``first`` of the linearisation
        within the steps' error, where larger ones agree with it again."""
        error = _STEP_ERROR * 2.0 * math.pi / math.sqrt(self.equilibrium.stiffness)
        begin = next((i for i, (_, shift) in enumerate(known) if shift * first > 0.0), 0)
        small = all(radius < _LARGEST_DOUBTED and abs(shift) <= error for radius, shift in known[:begin])
        return known[begin:] if small else known

    def _cycle_radii(self, kind: LapKind | None, known: list[Shift]) -> list[float]:
        """Return the radii of cycles among samples of one kind of lap.

        Raises:
            NoLapError: if a radius between, met on the way, has no lap of this kind.
        """
        from scipy.optimize import minimize_scalar

        radii = [self.root(kind, r0, r1) for (r0, s0), (r1, s1) in itertools.pairwise(known) if s0 * s1 < 0.0]
        for (r0, s0), (_, s1), (r2, s2) in zip(known, known[1:], known[2:], strict=False):
            if s0 * s1 > 0.0 and s1 * s2 > 0.0 and abs(s1) < min(abs(s0), abs(s2)):
                side = math.copysign(1.0, s1)

                def height(radius: float, side: float = side) -> float:
                    return side * self.shift(radius, kind)

                nearest = minimize_scalar(height, bounds=(r0, r2), method="bounded")
                if nearest.fun < 0.0 and self.is_resolved(nearest.x, nearest.fun):
                    radii += [self.root(kind, r0, nearest.x), self.root(kind, nearest.x, r2)]
        return sorted(radii)


def _is_frictionless(parameters: OscillatorParameters) -> bool:
    """Return whether level friction is zero, so that a lap on both sides of the belt's speed conserves energy too."""
    return bool(parameters.plant.friction.coefficient(kernel.SLIP_BACKWARD, -parameters.belt_speed) == 0.0)


class Section(NamedTuple):
    """The maxima of x right of one equilibrium: whether it attracts those next to it, and its map's ranges."""

    equilibrium: Equilibrium
    attracts: bool
    ranges: list[LapRange]


@functools.lru_cache(maxsize=64)
def sections(parameters: OscillatorParameters) -> list[Section]:
    """Return the section of every equilibrium that slip can circle, in ascending order."""
    found = []
    for equilibrium in equilibria(parameters):
        if not is_centre(parameters, equilibrium):
            continue
        ranges = ReturnMap(parameters, equilibrium).ranges()
        attracts = equilibrium.damping > 0.0
        if equilibrium.has_roundoff_damping:
            attracts = bool(ranges) and ranges[0].ends[0] == 0.0 and ranges[0].tendencies[0] < 0
        found.append(Section(equilibrium, attracts, ranges))
    return found
