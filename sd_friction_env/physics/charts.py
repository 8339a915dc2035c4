"""Charts of stability over two parameters: where stick-slip ends, where steady slip loses stability, what lies between.

The curves are followed by :mod:`sd_friction_env.physics.continuation`; attractors at a point of each region name it.
"""

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env.physics.chunks import Columns, Engine, run_chunks
from sd_friction_env.physics.continuation import Branch, BranchEndError, FloatArray, Point, follow, solution_at
from sd_friction_env.physics.orbits import OrbitError, attractors
from sd_friction_env.physics.orbits.balance import check_unexcited
from sd_friction_env.physics.orbits.boundaries import Border, FoldBorder, GrazingBorder, HopfBorder, NoBorderError
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

BORDERS: dict[str, type[Border]] = {"v_b0": GrazingBorder, "v_b1": HopfBorder, "fold": FoldBorder}
_STARTS = 5  # values of the second parameter at which curves are looked for
_COLUMNS = 301  # values of it at which regions are distinguished
_NAMES = {"stick-slip": "stick-slip", "pure-slip": "pure slip", "steady-slip": "steady slip", "neutral": "neutral"}
_LEAST_BELT_SPEED = 1e-3
_SCAN = 20, 3  # least number of points of a curve on which a belt speed is looked for, and values where it starts


class Request(NamedTuple):
    """One curve of a chart."""

    parameters: OscillatorParameters
    curve: str
    name: str
    low: float
    high: float
    points: int
    starts: tuple[float, ...]
    against: tuple[str, float, float] = ("belt_speed", _LEAST_BELT_SPEED, RANGES["belt_speed"][1])


class Curve(NamedTuple):
    """A branch of a curve: its equations, its points, and why it ends at the first and at the last."""

    border: Any
    points: list[Point]
    reasons: tuple[str, str]


def stability_chart(
    parameters: OscillatorParameters,
    over: tuple[str, float, float] = ("alpha", 0.1, 1.2),
    against: str | tuple[str, float, float] = "belt_speed",
    *,
    points: int = 200,
    engine: Engine | None = None,
) -> Table:
    """Return the curves v_b0 and v_b1 over a parameter, their special points, and the regions between them.

    Args:
        parameters: of the oscillator; the values of the two parameters are not used.
        over: the second parameter (a number of a user-defined law is ``friction.name`` or ``geometry.name``), and its
            range.
        against: "belt_speed", or another parameter and its range: the belt speed is then that of the oscillator.
        points: least number on a curve from one end of the range to the other, in [10, 100000].
        engine: where the curves are followed, and the folder that keeps them.

    Returns:
        A table, one row a point, with the columns curve ("v_b0", "v_b1", "fold": of pure-slip cycles, or "region"),
        branch, kind, the second parameter, belt_speed or what takes its place, x (of breakaway, of the equilibrium, the
        greatest of the cycle), period, residual (of all the equations that the point solves), multiplier (of pure-slip
        cycles at v_b0), first_lyapunov_coefficient, crossings (of the belt's speed in a lap) and reason. Kinds:
        "start", "point", "end" (reason: why), "turn" (in the second parameter), "Bautin" (first Lyapunov coefficient
        0), "grazing fold" (multiplier 1: the fold curve meets v_b0), "meeting" (v_b0 = v_b1), "none" (there is no such
        curve; reason: why), or of a region its name: "stick-slip", "pure slip", "steady slip", "neutral", "bistable" or
        "rest".

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or the oscillator is excited.
    """
    name, low, high = _checked(parameters, over, against)
    points = checked_count("points", points, 10, 100_000)
    starts = _start_values(parameters, name, low, high)
    requests = [Request(parameters, curve, name, low, high, points, starts) for curve in ("v_b0", "v_b1")]
    metadata: dict[str, Any] = {"parameters": dataclasses.asdict(parameters), "over": name, "against": "belt_speed"}
    if against != "belt_speed":
        against = _checked_against(parameters, name, against)
        requests = [request._replace(against=against) for request in requests]
        metadata |= {"against": against[0], "against_range": list(against[1:])}
    description = {"what": "chart", **metadata, "range": [low, high], "points": points}
    parts = run_chunks(_curve, requests, engine or Engine(), description=description)
    near = [
        value + side * 0.01 * (high - low)
        for part in parts
        for value in part[name][np.isin(part["kind"], ("Bautin", "grazing fold"))].tolist()
        for side in (-1.0, 1.0)
    ]
    starts += tuple(value for value in near if low < value < high)
    folds = _curve(requests[0]._replace(curve="fold", starts=starts))
    parts.append({column: values[folds["kind"] != "none"] for column, values in folds.items()})
    curves = Table.stacked(parts, metadata)
    regions = _regions(curves, requests[0])
    return Table.stacked([curves, Table.from_rows(regions)], metadata) if regions else curves


def _checked(parameters: Any, over: Any, against: Any) -> tuple[str, float, float]:
    if not isinstance(parameters, OscillatorParameters):
        raise TypeError(f"parameters must be OscillatorParameters, got {brief_repr(parameters)}")
    check_unexcited(parameters)
    if isinstance(against, str) and against != "belt_speed":
        raise ValueError(f"against must be 'belt_speed' or (name, low, high), got {brief_repr(against)}")
    return checked_range(over, tuple(known for known in parameters.values if known != "belt_speed"))


def _checked_against(parameters: OscillatorParameters, name: str, against: Any) -> tuple[str, float, float]:
    others = tuple(known for known in parameters.values if known not in ("belt_speed", name))
    checked_number("belt_speed", parameters.belt_speed, _LEAST_BELT_SPEED, RANGES["belt_speed"][1])
    return checked_range(against, others, "against")


def _start_values(
    parameters: OscillatorParameters, name: str, low: float, high: float, count: int = _STARTS
) -> tuple[float, ...]:
    """Return the values of a parameter at which curves are looked for."""
    return tuple(sorted({*np.linspace(low, high, count).tolist(), min(max(parameters.values[name], low), high)}))


# Curves ---------------------------------------------------------------------------------------------------------------


def _curve(request: Request) -> Columns:
    """Return the rows of a curve: all its branches that pass one of the starts."""
    rows: list[dict[str, Any]] = []
    branches = 0
    for value, found in _branches(request):
        if isinstance(found, str):
            rows.append(_row(request, request.curve, "none", (math.nan, value), reason=found))
            continue
        border, places, reasons = found
        reason_at = {0: reasons[0], len(places) - 1: reasons[1]}
        for i, point in enumerate(places):
            row = _row(request, request.curve, point.kind, point.y[-2:], point.residual, reason_at.get(i, ""))
            row |= {"branch": branches, "x": float(point.y[0]), "crossings": getattr(border, "events", 0)}
            row["period"] = border.period(point.y) if isinstance(border, HopfBorder) else float(point.y[1])
            fold = isinstance(border, FoldBorder)
            row["multiplier"] = 1.0 if fold else 1.0 + point.values.get("grazing fold", math.nan)
            row["first_lyapunov_coefficient"] = point.values.get("Bautin", math.nan)
            rows.append(row)
        branches += 1
    return dict(Table.from_rows(rows))


def _branches(request: Request) -> Iterator[tuple[float, Curve | str]]:
    """Yield the branches of a curve from each of the starts, or why there is none."""
    followed: list[Curve] = []
    for value in request.starts:
        try:
            for border, y in _solutions(request, value):
                if any(_passes(other.border, other.points, y) for other in followed):
                    continue
                back, forth = (_branch(request, border, y, way) for way in (-1.0, 1.0))
                places = [*reversed(back.points[1:]), *forth.points]
                if len(places) > 1:  # a start on an end is not listed twice
                    ends = (places[0].y, places[-1].y)
                    places = [p for p in places if p.kind != "start" or not any(np.allclose(p.y, end) for end in ends)]
                followed.append(Curve(border, places, (back.reason, forth.reason)))
                yield value, followed[-1]
        except (NoBorderError, BranchEndError, OrbitError) as error:
            yield value, str(error)


def _solutions(request: Request, value: float) -> list[tuple[Any, FloatArray]]:
    """Return points of a curve at a value of the second parameter.

    Raises:
        NoBorderError, BranchEndError, OrbitError: if there is none.
    """
    (against, low, high), kind = request.against, BORDERS[request.curve]
    scale = np.array([1.0, 10.0, 1.0 if against == "belt_speed" else high - low, request.high - request.low])
    names, sizes = (against, request.name), scale[[0, 2, 3]] if kind is HopfBorder else scale

    def border(events: int = 0) -> Any:
        found: Any = kind(request.parameters, names, sizes)
        found.events = events
        return found

    first, own = border(), request.parameters.values[against]
    y = np.array([own if against == "belt_speed" else min(max(own, low), high), value])
    first.oscillator(y)
    for name, direction in zip(names, first.directions(y), strict=True):
        if name != "belt_speed" and not direction.any():
            raise NoBorderError(f"the plant does not use the parameter {name!r}")
    if against == "belt_speed":
        return [(first, first.start(y))]
    # Its curve over the first parameter passes the belt speed there.
    speed, plant = request.parameters.belt_speed, request.parameters.replace(**{request.name: value})
    points, count = _SCAN
    starts = _start_values(plant, against, low, high, count)
    found, why = [], ""
    for _, curve in _branches(Request(plant, request.curve, against, low, high, points, starts)):
        if isinstance(curve, str):
            why = f": {curve}"
            continue
        for before, after in itertools.pairwise(point.y for point in curve.points):
            if (before[-2] - speed) * (after[-2] - speed) <= 0.0:
                place = solution_at(curve.border, before, after, len(before) - 2, speed)
                found.append((border(getattr(curve.border, "events", 0)), np.array([*place[:-2], place[-1], value])))
    if not found:
        raise NoBorderError(f"belt_speed = {speed:g} is on the curve at no {against} in [{low:g}, {high:g}]{why}")
    return found


def _branch(request: Request, border: Any, start: FloatArray, way: float) -> Branch:
    tests: dict[str, Any] = {"turn": lambda y, tangent: float(tangent[-1])}
    if request.curve == "v_b0":
        tests |= {"grazing fold": lambda y, _: border.multiplier(y) - 1.0, "meeting": lambda y, _: border.damping(y)}
    elif request.curve == "v_b1":
        tests["Bautin"] = lambda y, _: border.lyapunov(y) if border.oscillator(y) else math.nan
    against, least, most = request.against
    if against == "belt_speed" and request.curve == "v_b1":
        least = 0.0
    limits = {-1: (request.low, request.high, request.name), -2: (least, most, against)}
    limits[0] = (-STATE_LIMIT, STATE_LIMIT, "x")
    along = way * np.eye(len(start))[-1]
    return follow(border, start, along, longest=1.0 / request.points, limits=limits, tests=tests)


def _passes(border: Any, places: list[Point], y: FloatArray) -> bool:
    """Return whether a curve passes a solution."""
    for before, after in itertools.pairwise(point.y for point in places):
        if (before[-1] - y[-1]) * (after[-1] - y[-1]) <= 0.0:
            with contextlib.suppress(BranchEndError):
                found = solution_at(border, before, after, len(y) - 1, y[-1])
                if abs(found[-2] - y[-2]) < 1e-7 * max(1.0, y[-2]):
                    return True
    return False


def _row(
    request: Request, curve: str, kind: str, place: Iterable[float], residual: float = math.nan, reason: str = ""
) -> dict[str, Any]:
    first, second = map(float, place)
    row: dict[str, Any] = {"curve": curve, "branch": -1, "kind": kind, request.name: second, request.against[0]: first}
    row |= dict.fromkeys(("x", "period", "residual", "multiplier", "first_lyapunov_coefficient"), math.nan)
    return row | {"residual": residual, "crossings": 0, "reason": reason}


# Regions --------------------------------------------------------------------------------------------------------------


class Slab(NamedTuple):
    """Neighbouring values (n,) of the second parameter, at which the same curves bound regions: ``bounds`` (m, n)."""

    values: FloatArray
    bounds: FloatArray


def slabs_of(chart: Table) -> list[Slab]:
    """Return a chart cut where a curve begins, ends, turns or crosses another, from belt speed 0 to the top or, against
    another parameter, over its range."""
    over, against = chart[chart.metadata["over"]], chart[chart.metadata.get("against", "belt_speed")]
    keys = [(str(curve), int(branch)) for curve, branch in zip(chart["curve"], chart["branch"], strict=True)]
    branches = []
    for key in dict.fromkeys(key for key in keys if key[1] >= 0):
        chosen = [i for i, other in enumerate(keys) if other == key]
        branches.append((key, over[chosen], against[chosen]))
    if not branches:
        return []
    above = 1.15 * max(float(speeds.max()) for _, _, speeds in branches)
    bottom, top = chart.metadata.get("against_range", (0.0, above))
    columns = []
    for value in np.linspace(over.min(), over.max(), _COLUMNS + 2)[1:-1].tolist():
        met = []
        for key, p, speeds in branches:
            for i in np.flatnonzero((p[:-1] <= value) != (p[1:] <= value)).tolist():
                share = (value - p[i]) / (p[i + 1] - p[i])
                met.append((float(speeds[i] + share * (speeds[i + 1] - speeds[i])), key))
        met.sort()
        columns.append((value, [bottom, *(speed for speed, _ in met), top], [key for _, key in met]))
    found, half = [], 0.5 * float(np.ptp(over)) / (_COLUMNS + 1)
    for _, group in itertools.groupby(columns, key=lambda column: column[2]):
        values, bounds, _ = zip(*group, strict=True)
        padded = np.pad(np.array(bounds).T, ((0, 0), (1, 1)), "edge")  # up to the next slab
        found.append(Slab(np.array([values[0] - half, *values, values[-1] + half]), padded))
    return found


def filled_regions(chart: Table) -> Iterator[tuple[str, FloatArray, FloatArray, FloatArray]]:
    """Yield each region of a chart: its name, values of the second parameter, and its lower and upper bound there."""
    kinds = iter(chart["kind"][(chart["curve"] == "region") & (chart["kind"] != "rest")].tolist())
    for slab in slabs_of(chart):
        for low, high in itertools.pairwise(slab.bounds):
            yield next(kinds), slab.values, low, high


def _regions(chart: Table, request: Request) -> list[dict[str, Any]]:
    """Return a row for each region: a point in it and its name."""
    found, against = [], request.against[0]
    for slab in slabs_of(chart):
        middle = len(slab.values) // 2
        value = float(slab.values[middle])
        if against == "belt_speed":
            found.append(_row(request, "region", "rest", (0.0, value), reason="the belt stands still"))
        for low, high in itertools.pairwise(slab.bounds[:, middle].tolist()):
            place, kind = 0.5 * (low + high), "none"
            try:
                cycles = attractors(request.parameters.replace(**{request.name: value, against: place}))
                kinds = sorted({cycle.kind for cycle in cycles})
                reason = " and ".join(kinds) or "no attractor that keeps contact"
                kind = "bistable" if len(kinds) > 1 else _NAMES.get(reason, "none")
            except ValueError as error:
                reason = str(error)
            found.append(_row(request, "region", kind, (place, value), reason=reason))
    return found
