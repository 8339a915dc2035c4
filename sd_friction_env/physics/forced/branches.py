"""Periodic orbits under excitation as branches over a parameter: stable and unstable, with their bifurcations.

The fixed points of the stroboscopic map are followed by their arc length (:mod:`sd_friction_env.physics.continuation`)
at a section in slip, away from events. The map is smooth as long as the sequence of slips and sticks stays the same.
Where it changes, v_rel = 0 is met at the border of the stick cone: a sliding bifurcation. Which one, the arc that
vanishes there and its neighbours say (di Bernardo, Kowalczyk and Nordmark, 2003, Int. J. Bifurcation and Chaos 13).
"""

import contextlib
import dataclasses
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.continuation import BranchEndError, FloatArray, Point, correct, follow, solution_at
from sd_friction_env.physics.forced.orbits import ForcedOrbit, orbit_at
from sd_friction_env.physics.forced.sections import Stroboscope, active_excitations, at_phase
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import (
    RANGES,
    STATE_LIMIT,
    OscillatorParameters,
    brief_repr,
    checked_count,
    checked_number,
    checked_range,
)
from sd_friction_env.physics.tables import Table

_MOST_PIECES = 200  # of a branch, between changes of the sequence of arcs
_AHEAD = (1e-5, 3e-5, 1e-4, 1e-3)  # in longest steps: where a change of the sequence is looked for
_LOCATED = 1e-14  # in scaled arc length
_SHORTEST_SLIP = 1e-3  # half of the longest slip in an orbit, as a share of its duration
_ROUNDING = 1e-12  # of a parameter, in its range
_JUMP = 1e-3  # residual at a test function's change of sign that is no zero of it
_SAME = 1e-7  # distance of section points of one orbit
_CLOSED = "the curve is closed"
_HALVING = "the period is halved"
_HALF, _REPEATS = 1e-4, 1e-10  # distance of points half a period apart: near where it is halved, and beyond a graze
_NEAR = "an event nears the section"
_MISSED = 1e-6  # by more than this a sliding bifurcation's condition is not met: the map jumps
_FLIP = 1e-4  # distance from -1 of the multiplier of an orbit that is doubled
_AT_FLIP = 1e-3  # distance of section points within which a branch begins at an orbit, at a parameter this much nearer
_LETTERS = {kernel.SLIP_BACKWARD: "b", kernel.STICK: "s", kernel.SLIP_FORWARD: "f"}

MOST_DOUBLINGS = 10


class Arc(NamedTuple):
    """A slip or a stick of an orbit: its mode, when it begins and ends, and the excess over the stick cone there."""

    mode: int
    begin: float
    end: float
    excess: float
    slope: float  # of the excess, in time


class OrbitProblem:
    """Orbits of one duration at a section, in (x, v, a parameter): a :class:`continuation.Problem`.

    Args:
        orbit: at which it starts.
        name: of the parameter.
        limits: of the parameter; their distance is the unit of its scale.
        share: of the section, in the orbit's duration from t = 0.
    """

    def __init__(self, orbit: ForcedOrbit, name: str, limits: tuple[float, float], share: float) -> None:
        self.orbit, self.name, self.limits, self.share = orbit, name, limits, share
        self.scale = np.array([1.0, 1.0, limits[1] - limits[0]])
        self.rates = [f"{kind}_frequency" for kind in active_excitations(orbit.parameters)]
        self.modes: str | None = None  # to which the curve is kept
        self.margin = 0.0  # from the section to the next event, as a share of the duration: kept
        self._seen: tuple[FloatArray, FloatArray] | None = None

    def value(self, y: FloatArray) -> float:
        """Return the parameter at y: at most its limits, and where y is the start up to rounding the start's."""
        first = float(self.orbit.parameters.values[self.name])
        return first if abs(y[2] - first) < _ROUNDING * self.scale[2] else float(np.clip(y[2], *self.limits))

    def oscillator(self, y: FloatArray) -> OscillatorParameters:
        """Return the oscillator at y, or at the limit that it passes; BranchEndError if it is not valid."""
        try:
            return self.orbit.parameters.replace(**{self.name: self.value(y)})
        except ValueError as error:
            raise BranchEndError(str(error)) from None

    def duration(self, y: FloatArray) -> float:
        """Return the orbit's duration."""
        if self.name not in self.rates:
            return self.orbit.period
        return self.orbit.period * float(getattr(self.orbit.parameters, self.name) / self.value(y))

    def shifted(self, y: FloatArray) -> OscillatorParameters:
        """Return the oscillator at y whose excitation is at t = 0 what it is at the section."""
        return at_phase(self.oscillator(y), self.share * self.duration(y))

    def lap(self, y: FloatArray, tangents: FloatArray, changes: FloatArray | None, share: float = 1.0) -> Any:
        """Return a share of a lap (``kernel.TangentMotion``), and carry tangents along it in place."""
        if not np.abs(y[:2]).max() <= STATE_LIMIT:
            raise BranchEndError(f"the state leaves [-{STATE_LIMIT:g}, {STATE_LIMIT:g}]")
        p = self.shifted(y)
        state, belt = kernel.State(float(y[0]), float(y[1])), kernel.steady(p.belt_speed)
        plant = p.excited_plant(0.0)
        time = share * self.duration(y)
        motion = kernel.advance_with_tangents(plant, kernel.UNKNOWN, state, belt, time, tangents, changes)
        if motion.status != kernel.OK:
            raise BranchEndError(f"the orbit ends: {kernel.STATUS_NAMES[motion.status]}")
        return motion

    def residual(self, y: FloatArray) -> FloatArray:
        """Return where a lap ends minus where it begins; past a limit of the parameter, extended along a line."""
        past = 0.0 if self.limits[0] <= y[2] <= self.limits[1] else float(y[2]) - self.value(y)
        motion = self.lap(y, np.empty((kernel.TANGENT_ROWS, 0)), None)
        missed = np.array([motion.x - y[0], motion.v - y[1]])
        return missed + past * self.jacobian(y)[:, 2] if past else missed

    def jacobian(self, y: FloatArray) -> FloatArray:
        """Return its derivatives; BranchEndError where the arcs are not those kept or one ends near the section."""
        if self.modes is not None:
            arcs = self.arcs(y)
            if sequence(arcs) != self.modes:
                raise BranchEndError("the sequence of slips and sticks changes")
            if min(arcs[0].end, arcs[-1].end - arcs[-1].begin) < self.margin * self.duration(y):
                raise BranchEndError(_NEAR)
        tangents = np.zeros((kernel.TANGENT_ROWS, 3))
        tangents[kernel.TANGENT_X, 0] = tangents[kernel.TANGENT_V, 1] = 1.0
        changes = None
        if self.name == "belt_speed":
            tangents[kernel.TANGENT_BELT, 2] = 1.0
        else:
            changes = self.shifted(y).plant_change(self.name, excited=True)[None, :]
        motion = self.lap(y, tangents, changes)
        matrix = tangents[:2].copy()
        if self.name in self.rates:
            duration = self.duration(y)
            matrix[:, 2] -= duration / self.value(y) * np.array([motion.v, self._acceleration(y, motion, duration)])
        self._seen = y.copy(), matrix - np.eye(2, 3)
        return self._seen[1]

    def half(self, y: FloatArray) -> FloatArray:
        """Return where half a lap ends minus where it begins."""
        end = self.lap(y, np.empty((kernel.TANGENT_ROWS, 0)), None, 0.5)
        return np.array([end.x - y[0], end.v - y[1]])

    def _acceleration(self, y: FloatArray, motion: Any, time: float) -> float:
        """Return the acceleration at the end of a lap, in slip."""
        p = self.shifted(y)
        plant = kernel.at_time(p.excited_plant(0.0), time)
        x, v = plant.excitation.to_belt_frame(motion.x, motion.v, p.belt_speed)
        a = kernel.slip_acceleration(plant, motion.mode, kernel.State(x, v), kernel.steady(p.belt_speed))
        return float(plant.excitation.lab_acceleration(a))

    def slopes(self, y: FloatArray) -> FloatArray:
        """Return the Jacobian, kept from the last call."""
        return self._seen[1] if self._seen is not None and np.array_equal(self._seen[0], y) else self.jacobian(y)

    def map(self, y: FloatArray) -> FloatArray:
        """Return the derivative of the map by the state, (2, 2)."""
        return self.slopes(y)[:, :2] + np.eye(2)

    def arcs(self, y: FloatArray) -> list[Arc]:
        """Return the slips and sticks of a lap from the section on, the last of which goes on in the first."""
        p, duration = self.shifted(y), self.duration(y)
        events, belt = np.empty((kernel.MAX_EVENTS, 4)), kernel.steady(p.belt_speed)
        plant = p.excited_plant(0.0)
        motion = kernel.advance(plant, kernel.State(float(y[0]), float(y[1])), belt, duration, events)
        gap = float(y[1]) - float(plant.excitation.lab_velocity(p.belt_speed))
        mode = kernel.STICK if gap == 0.0 else int(math.copysign(1.0, gap))
        found = [Arc(mode, 0.0, duration, math.nan, math.nan)]
        for time, kind, x, v in events[: motion.n_events].tolist():
            then = kernel.at_time(plant, time)
            place = then.excitation.to_belt_frame(x, v, p.belt_speed)[0]
            if kind == kernel.RESTICK:
                mode = kernel.STICK
            elif kind == kernel.CROSSING:
                mode = -mode
            elif kind == kernel.BREAKAWAY:
                mode = int(kernel.breakaway_mode(then, place, belt))
            else:
                continue
            excess = max(kernel.cone_excess(then, side, place, belt, 0.0) for side in (-1.0, 1.0))
            found[-1] = found[-1]._replace(end=time)
            found.append(Arc(mode, time, duration, *map(float, excess)))
        return found

    def sequence(self, y: FloatArray) -> str:
        """Return the letters of a lap's arcs."""
        return sequence(self.arcs(y))

    def moved(self, y: FloatArray, along: FloatArray) -> tuple["OrbitProblem", FloatArray, FloatArray]:
        """Return the problem at the middle of the longest slip, with y and a direction there."""
        slips = [arc for arc in self.arcs(y) if arc.mode != kernel.STICK]
        if not slips:
            raise BranchEndError("the mass sticks all the time")
        longest = max(slips, key=lambda arc: arc.end - arc.begin)
        share = 0.5 * (longest.begin + longest.end) / self.duration(y)
        half = 0.5 * (longest.end - longest.begin) / self.duration(y)
        if half < _SHORTEST_SLIP:
            raise BranchEndError(f"the slips become shorter than {2.0 * _SHORTEST_SLIP:g} of the period")

        def there(y: FloatArray) -> FloatArray:
            end = self.lap(y, np.empty((kernel.TANGENT_ROWS, 0)), None, share)
            return np.array([end.x, end.v, y[2]])

        begin = there(y)
        small = 1e-7 * self.scale * along
        problem = OrbitProblem(self.orbit, self.name, self.limits, (self.share + share) % 1.0)
        problem.margin = 0.25 * half
        return problem, begin, (there(y + small) - begin) / (1e-7 * self.scale)

    def orbit_of(self, y: FloatArray) -> ForcedOrbit:
        """Return a solution as an orbit, at the section of the first."""
        n = self.orbit.multiple
        strobe = Stroboscope(self.oscillator(y), self.duration(y) / n, self.orbit.phase)
        found = orbit_at(strobe, strobe._replace(phase=self.share * n), (float(y[0]), float(y[1])), n)
        if found is None:
            raise BranchEndError("the orbit cannot be followed")
        return found


class Place(NamedTuple):
    """A point of a branch with its problem; ``condition``: residual of a sliding bifurcation."""

    problem: OrbitProblem
    point: Point
    sequence: str
    condition: float = math.nan
    reason: str = ""


class OrbitBranch(NamedTuple):
    """A branch of orbits: a table with a row for each, and the orbits.

    Columns: kind, the parameter, x and v (at the section of the first orbit), amplitude, x_min, x_max, period,
    stick_fraction, sequence (of arcs in a period: b, s, f), stable, multiplier and multiplier_imag (of the greatest
    modulus), second_multiplier, residual (of the equations that the point solves), condition (by how much a sliding
    bifurcation's condition is missed, in force or speed; nan where the map jumps, as with mu_k < mu_s), reason (of an
    end: why).
    """

    table: Table
    orbits: tuple[ForcedOrbit, ...]


def sequence(arcs: list[Arc]) -> str:
    """Return the arcs' letters: b(ackward slip), s(tick), f(orward slip)."""
    return "".join(_LETTERS[arc.mode] for arc in arcs[: max(1, len(arcs) - 1)])


def follow_orbit(start: ForcedOrbit, over: tuple[str, float, float], *, points: int = 100) -> OrbitBranch:
    """Follow a periodic orbit, stable or not, over a parameter both ways until it ends.

    Args:
        start: the orbit; its parameters' value is where the branch starts.
        over: the parameter (of a user-defined law ``friction.name`` or ``geometry.name``), and its range.
        points: least number from one end of the range to the other, in [10, 10000].

    Returns:
        The branch. Kinds of its rows: "start", "point", "end" (reason: why); "fold" (multiplier 1, the branch turns),
        "branch point" (multiplier 1: another branch crosses, as where symmetry is lost), "flip" (-1), "Neimark-Sacker"
        (a complex pair of modulus 1), "neutral saddle" (real, of product 1); and where the sequence of arcs changes,
        "grazing-sliding" (a slip touches v_rel = 0: a stick begins or ends to be in it), "crossing-sliding" (a
        crossing becomes a stick), "switching-sliding" (a crossing comes before a stick), "adding-sliding" (a slip cuts
        a stick in two), "grazing" (two crossings) or "other".

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, the oscillator does not use the
            parameter, or it is the frequency of one of several excitations.
        OrbitError: if the start is no orbit of its oscillator, or has no slip.
    """
    if not isinstance(start, ForcedOrbit):
        raise TypeError(f"start must be a ForcedOrbit, see forced_orbit, got {brief_repr(start)}")
    p = start.parameters
    (name, low, high), points = checked_branch(p, over, points)
    value = float(p.values[name])
    y, upwards = np.array([start.x, start.v, value]), np.array([0.0, 0.0, 1.0])
    try:
        at_start = OrbitProblem(start, name, (low, high), start.phase / start.multiple)
        problem, y, _ = at_start.moved(y, upwards)
        y = correct(problem, y, upwards)
        back, forth = [], _one_way(problem, y, upwards, 1.0 / points)
        if forth[-1].reason != _CLOSED:
            back = _one_way(problem, y, -upwards, 1.0 / points)
            if len(back) == 1:  # it ends where it starts
                forth[0] = forth[0]._replace(reason=back[0].reason)
        places = [*reversed(back[1:]), *forth]
        orbits = tuple(place.problem.orbit_of(place.point.y) for place in places)
    except BranchEndError as error:
        raise OrbitError(f"the orbit cannot be followed: {error}; {p}") from None
    rows = [_row(name, place, orbit) for place, orbit in zip(places, orbits, strict=True)]
    metadata = {"over": name, "range": [low, high], "multiple": start.multiple, "points": points}
    return OrbitBranch(Table({column: np.array([row[column] for row in rows]) for column in rows[0]}, metadata), orbits)


def checked_branch(parameters: OscillatorParameters, over: Any, points: Any) -> tuple[tuple[str, float, float], int]:
    """Return the arguments of :func:`follow_orbit` for an oscillator at the start, checked."""
    name, low, high = checked_range(over, tuple(parameters.values))
    _check_use(parameters, name)
    checked_number(f"{name} of the start", parameters.values[name], low, high)
    return (name, low, high), checked_count("points", points, 10, 10_000)


def _check_use(parameters: OscillatorParameters, name: str) -> None:
    acting = active_excitations(parameters)
    kind, _, what = name.partition("_")
    if what in ("frequency", "phase") and kind not in acting:
        raise ValueError(f"the plant does not use the parameter {name!r}: {kind}_amplitude is 0")
    if what == "frequency" and len(acting) > 1:
        raise ValueError(f"over {name!r} needs that no other excitation acts, got {', '.join(acting)}")
    if name != "belt_speed":
        parameters.plant_change(name, excited=True)


def _row(name: str, place: Place, orbit: ForcedOrbit) -> dict[str, Any]:
    first, second = orbit.multipliers
    return {
        "kind": place.point.kind,
        name: float(place.point.y[2]),
        **{column: getattr(orbit, column) for column in ("x", "v", "amplitude", "x_min", "x_max", "period")},
        "stick_fraction": orbit.stick_fraction,
        "sequence": place.sequence,
        "stable": orbit.stable,
        "multiplier": first.real,
        "multiplier_imag": first.imag,
        "second_multiplier": second.real,
        "residual": place.point.residual,
        "condition": place.condition,
        "reason": place.reason,
    }


def _one_way(problem: OrbitProblem, y: FloatArray, along: FloatArray, longest: float) -> list[Place]:
    """Return the places of a branch from a solution on, piece by piece with one sequence of arcs each."""
    places: list[Place] = []
    value, left = y[2], f"left after {_MOST_PIECES} changes of the section or of the sequence of slips and sticks"
    for piece in range(_MOST_PIECES):
        if problem.orbit.multiple % 2 == 0 and np.abs(problem.half(y)).max() < _REPEATS:
            reason = _HALVING
            break
        problem.modes = problem.sequence(y)
        limits = {2: (*problem.limits, problem.name)}
        try:
            branch = follow(problem, y, along, longest=longest, limits=limits, tests=_tests(problem, y))
        except BranchEndError as error:
            if not places:
                raise
            reason = str(error)
            break
        halved = _halved(problem, branch.points)
        listed = [point for point in halved or branch.points if point.kind != _HALVING and point.residual < _JUMP]
        found = [_named(problem, point) for point in listed[1 if piece else 0 :]]
        places += [Place(problem, point, problem.modes) for point in found]
        last, reason = branch.points[-1], branch.reason
        closing = _closing(problem, branch.points, value) if piece else None
        if closing is not None:
            places, reason = places[: len(places) - len(found) + closing], _CLOSED
        elif halved is not None:
            reason = _HALVING
        if reason.startswith((problem.name, _CLOSED, _HALVING, "left")):
            break
        near = reason == _NEAR
        change = None if near else _change(problem, last, longest)
        if change is None and not near:
            break
        places[-1] = places[-1]._replace(point=last._replace(kind="point"))
        try:
            if change is None:
                problem, y, along = problem.moved(last.y, last.tangent)
            else:
                places.append(change)
                problem, y, along = _beyond(problem, change.point, longest)
        except BranchEndError as error:
            reason = str(error)
            break
    else:
        reason = left
    end = places[-1].point
    places[-1] = places[-1]._replace(reason=reason, point=end._replace(kind="end") if end.kind == "point" else end)
    return places


def _closing(problem: OrbitProblem, points: list[Point], value: float) -> int | None:
    """Return how many of the points come before the branch passes the orbit that it began with, or None."""
    for i, (before, after) in enumerate(itertools.pairwise(point.y for point in points)):
        if (before[2] - value) * (after[2] - value) <= 0.0:
            with contextlib.suppress(BranchEndError):
                there = problem.orbit_of(solution_at(problem, before, after, 2, value))
                if np.abs(problem.orbit.points - (there.x, there.v)).max(axis=1).min() < _SAME:
                    return i
    return None


def _tests(problem: OrbitProblem, begin: FloatArray) -> dict[str, Any]:
    def bordered(y: FloatArray, tangent: FloatArray) -> float:
        return float(np.linalg.det(np.vstack((problem.slopes(y) * problem.scale, tangent))))

    tests: dict[str, Any] = {
        "fold": lambda _, tangent: float(tangent[2]),
        "branch point": bordered,
        "flip": lambda y, _: float(np.linalg.det(problem.map(y) + np.eye(2))),
        "Neimark-Sacker": lambda y, _: float(np.linalg.det(problem.map(y))) - 1.0,
    }
    if problem.orbit.multiple % 2 == 0:
        apart = problem.half(begin)
        tests[_HALVING] = lambda y, _: float(problem.half(y) @ apart)
    return tests


def _halved(problem: OrbitProblem, points: list[Point]) -> list[Point] | None:
    """Return the points up to an orbit of half the period, or None: beyond, all comes again half a period later."""
    for i, point in enumerate(points):
        if point.kind == _HALVING and np.abs(problem.half(point.y)).max() < _HALF:
            before = [j for j in range(i) if points[j].kind in ("start", "point")]
            return [*points[: before[-1] + 1], point._replace(kind="point")]
    return None


def _named(problem: OrbitProblem, point: Point) -> Point:
    if point.kind == "Neimark-Sacker" and abs(np.trace(problem.map(point.y))) > 2.0:
        return point._replace(kind="neutral saddle")
    return point


# Where the sequence of arcs changes -----------------------------------------------------------------------------------


def _change(problem: OrbitProblem, last: Point, longest: float) -> Place | None:
    """Return the place ahead of a point where the sequence of arcs changes, or None."""
    kept = problem.modes
    assert kept is not None
    matrix = problem.jacobian(last.y)

    def at(length: float) -> FloatArray:
        return last.y + problem.scale * length * last.tangent

    def solved(length: float) -> FloatArray | None:
        """Return the solution that keeps the sequence, or None."""
        try:
            y = correct(problem, at(length), last.tangent, matrix)
            return y if problem.sequence(y) == kept else None
        except BranchEndError:
            return None

    low, best = 0.0, last.y
    for high in (longest * part for part in _AHEAD):
        if solved(high) is None:
            break
    else:
        return None
    while high - low > _LOCATED:
        middle = 0.5 * (low + high)
        y = solved(middle)
        low, high, best = (low, middle, best) if y is None else (middle, high, y)
    for step in np.geomspace(1e-14, 1e-4 * longest, 40).tolist():
        beyond = best + problem.scale * step * last.tangent
        try:
            after = problem.sequence(beyond)
        except BranchEndError:  # the oscillator has no meaning there
            return None
        if after != kept:
            break
    else:
        return None
    longer = beyond if len(after) > len(kept) else best
    kind, condition = sliding_kind(problem.arcs(longer)) if len(after) != len(kept) else ("other", math.nan)
    residual = float(np.abs(problem.residual(best)).max())
    condition = condition if condition < _MISSED else math.nan
    return Place(problem, Point(best, last.tangent, residual, {}, kind), kept, condition)


def shortest_arc(arcs: list[Arc]) -> int:
    """Return the index of the shortest arc of a lap that neither begins nor ends at the section, or 0."""
    return min(range(1, len(arcs) - 1), key=lambda i: arcs[i].end - arcs[i].begin, default=0)


def sliding_kind(arcs: list[Arc]) -> tuple[str, float]:
    """Return the bifurcation at which the shortest of an orbit's arcs vanishes, and by how much it is missed.

    The excess over the cone grows linearly in time at its border: the depth by which a slip passes v_rel = 0 is
    excess * duration/2 where a stick begins, and the height by which a stick's load passes the cone slope * duration/6.
    """
    i = shortest_arc(arcs)
    if i == 0:
        return "other", math.nan
    before, arc, after = arcs[i - 1 : i + 2]
    duration = arc.end - arc.begin
    if arc.mode == kernel.STICK:
        if before.mode == after.mode:
            return "grazing-sliding", abs(0.5 * arc.excess * duration)
        return "crossing-sliding", abs(arc.excess)
    if before.mode == after.mode == kernel.STICK:
        return "adding-sliding", abs(arc.slope * duration / 6.0)
    if before.mode == -arc.mode and after.mode == kernel.STICK:
        return "switching-sliding", abs(arc.excess)
    if before.mode == after.mode == -arc.mode:
        return "grazing", abs(arc.slope * duration * duration / 8.0)
    return "other", math.nan


def _beyond(problem: OrbitProblem, place: Point, longest: float) -> tuple[OrbitProblem, FloatArray, FloatArray]:
    """Return a solution past a change of the sequence of arcs, and the direction in which its branch goes on."""
    kept, problem.modes = problem.modes, None
    assert kept is not None
    for step in (1e-6 * longest, 1e-5 * longest, 1e-4 * longest, 1e-3 * longest):
        for way in (1.0, -1.0):
            try:
                matrix = problem.jacobian(place.y + problem.scale * step * place.tangent)
                direction = np.linalg.svd(matrix * problem.scale)[2][-1]
                direction *= way * math.copysign(1.0, direction @ place.tangent)
                y = correct(problem, place.y + problem.scale * step * direction, direction)
                apart = float(np.linalg.norm((y - place.y) / problem.scale))
                if apart < 10.0 * step and problem.sequence(y) != kept:
                    return problem.moved(y, direction)
            except BranchEndError:
                continue
    raise BranchEndError(f"no orbit goes on beyond the {place.kind}")


def doubled_orbit(orbit: ForcedOrbit, name: str, *, step: float = 1e-3) -> ForcedOrbit:
    """Return an orbit of twice the period on the branch that begins where an orbit flips.

    Args:
        orbit: at a flip, as a branch lists it: one multiplier is -1.
        name: of the parameter in which the new branch is followed; the new orbit's value of it differs a little.
        step: distance of the new orbit from the old, in x and v along the critical eigenvector, in [1e-6, 0.1].

    Raises:
        ValueError: if the orbit has no multiplier near -1.
        OrbitError: if no such orbit is found.
    """
    step = checked_number("step", step, 1e-6, 0.1)
    p = orbit.parameters
    _check_use(p, name)
    value = p.values[name]
    low, high = RANGES.get(name, (-1e12, 1e12))
    width = max(abs(value), 1e-3)
    limits = max(low, value - 0.5 * width), min(high, value + 0.5 * width)
    try:
        y = np.array([orbit.x, orbit.v, value])
        problem, y, _ = OrbitProblem(orbit, name, limits, orbit.phase / orbit.multiple).moved(y, np.zeros(3))
        values, vectors = np.linalg.eig(problem.map(y))
        i = int(np.argmin(np.abs(values + 1.0)))
        if abs(values[i] + 1.0) > _FLIP:
            raise ValueError(f"orbit must be at a flip (a multiplier -1), its multipliers are {orbit.multipliers}")
        direction = np.append(np.real(vectors[:, i]), 0.0)
        longer = dataclasses.replace(orbit, multiple=2 * orbit.multiple, period=2.0 * orbit.period)
        twice = OrbitProblem(longer, name, problem.limits, 0.5 * problem.share)
        return twice.orbit_of(correct(twice, y + step * direction, direction))
    except BranchEndError as error:
        raise OrbitError(f"no orbit of twice the period: {error}; {p}") from None


def orbit_branches(
    start: ForcedOrbit, over: tuple[str, float, float], *, points: int = 100, doublings: int = 0
) -> Table:
    """Follow an orbit over a parameter and, from its flips on, the orbits of twice the period, and theirs.

    Args:
        start, over, points: as of :func:`follow_orbit`.
        doublings: times that the period is doubled, in [0, 10].

    Returns:
        A table with a row for each orbit and cycle of the excitation in it: branch (0: that of the start), multiple,
        cycle, and the columns of :class:`OrbitBranch` with x and v of this cycle. A flip at which no other orbit was
        found has the reason.

    Raises:
        TypeError, ValueError, OrbitError: as :func:`follow_orbit`.
    """
    doublings = checked_count("doublings", doublings, 0, MOST_DOUBLINGS)
    branches = [follow_orbit(start, over, points=points)]
    parts: list[dict[str, Any]] = []
    for branch in branches:  # which grow in number meanwhile
        reasons = branch.table["reason"].tolist()
        doubled = branch.table.metadata["multiple"] < start.multiple * 2**doublings
        for i in np.flatnonzero((branch.table["kind"] == "flip") & doubled).tolist():
            flip = branch.orbits[i]
            if any(begins_at(other, flip) for other in branches):
                continue
            try:
                branches.append(follow_orbit(doubled_orbit(flip, over[0]), over, points=points))
            except ValueError as error:
                reasons[i] = str(error)
        counts = [len(orbit.points) for orbit in branch.orbits]
        rows = np.repeat(np.arange(len(counts)), counts)
        columns: dict[str, Any] = {"branch": np.full(len(rows), len(parts))}
        columns["multiple"] = np.full(len(rows), branch.table.metadata["multiple"])
        columns["cycle"] = np.concatenate([np.arange(count) for count in counts])
        columns |= {name: column[rows] for name, column in branch.table.items()} | {"reason": np.array(reasons)[rows]}
        columns["x"], columns["v"] = np.concatenate([orbit.points for orbit in branch.orbits]).T
        parts.append(columns)
    metadata = {"over": over[0], "range": list(over[1:]), "points": points}
    return Table.stacked(parts, metadata)


def begins_at(branch: OrbitBranch, flip: ForcedOrbit) -> bool:
    """Return whether a branch of orbits of twice the period passes an orbit at a flip."""
    name, (low, high) = branch.table.metadata["over"], branch.table.metadata["range"]
    near = np.abs(branch.table[name] - flip.parameters.values[name]) < 1e-3 * _AT_FLIP * (high - low)
    return branch.table.metadata["multiple"] == 2 * flip.multiple and any(
        np.abs(branch.orbits[i].points - (flip.x, flip.v)).max(axis=1).min() < _AT_FLIP
        for i in np.flatnonzero(near).tolist()
    )


def without_branch(name: str, value: float, reason: str) -> Table:
    """Return the row, of kind "none", in place of those of :func:`orbit_branches` where there is no orbit to follow."""
    row: dict[str, Any] = {"branch": -1, "multiple": 0, "cycle": 0, "kind": "none", name: value}
    row |= dict.fromkeys(("x", "v", "amplitude", "x_min", "x_max", "period", "stick_fraction"), math.nan)
    row |= {"sequence": "", "stable": False, "multiplier": math.nan, "multiplier_imag": math.nan}
    row |= dict.fromkeys(("second_multiplier", "residual", "condition"), math.nan)
    return Table.from_rows([row | {"reason": reason}])
