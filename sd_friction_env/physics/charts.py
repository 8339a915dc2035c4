"""Charts of stability over two parameters: where stick-slip ends, where steady slip loses stability, what lies between.

The curves are followed by :mod:`sd_friction_env.physics.continuation`; the attractors of a point in each region name it.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from sd_friction_env.physics.chunks import Columns, Engine, run_chunks
from sd_friction_env.physics.continuation import Branch, BranchEndError, FloatArray, follow, solution_at
from sd_friction_env.physics.orbits import OrbitError, attractors
from sd_friction_env.physics.orbits.balance import check_unexcited
from sd_friction_env.physics.orbits.boundaries import Border, FoldBorder, GrazingBorder, HopfBorder, NoBorderError
from sd_friction_env.physics.parameters import RANGES, OscillatorParameters, brief_repr, checked_count, checked_number
from sd_friction_env.physics.tables import Table

BORDERS: dict[str, type[Border]] = {"v_b0": GrazingBorder, "v_b1": HopfBorder, "fold": FoldBorder}
_STARTS = 5  # values of the second parameter at which curves are looked for
_COLUMNS = 301  # values of it at which regions are told apart
_REGIONS = {"stick-slip": "stick-slip", "pure-slip": "pure slip", "steady-slip": "steady slip", "neutral": "neutral"}
_LEAST_BELT_SPEED = 1e-3


class Request(NamedTuple):
    """One curve of a chart."""

    parameters: OscillatorParameters
    curve: str
    name: str
    low: float
    high: float
    points: int
    starts: tuple[float, ...]


def stability_chart(
    parameters: OscillatorParameters,
    over: tuple[str, float, float] = ("alpha", 0.1, 1.2),
    against: str = "belt_speed",
    *,
    points: int = 200,
    engine: Engine | None = None,
) -> Table:
    """Return the curves v_b0 and v_b1 over a parameter, their special points, and the regions between them.

    Args:
        parameters: of the oscillator; the belt speed is not used.
        over: the second parameter (a number of a user-defined law is ``friction.name`` or ``geometry.name``), and its
            range.
        against: "belt_speed".
        points: least number on a curve from one end of the range to the other, in [10, 100000].
        engine: where the curves are followed, and the folder that keeps them.

    Returns:
        A table, one row a point, with the columns curve ("v_b0", "v_b1", "fold": of pure-slip cycles, or "region"),
        branch, kind, the second parameter, belt_speed, x (of breakaway, of the equilibrium, the greatest of the cycle),
        period, residual (of all the equations that the point solves), multiplier (of pure-slip cycles at v_b0),
        first_lyapunov_coefficient, crossings (of the belt's speed in a lap) and reason. Kinds: "start", "point", "end"
        (reason: why), "turn" (in the second parameter), "Bautin" (first Lyapunov coefficient 0), "grazing fold"
        (multiplier 1: the fold curve meets v_b0), "meeting" (v_b0 = v_b1), "none" (there is no such curve; reason:
        why), or of a region its name: "stick-slip", "pure slip", "steady slip", "neutral", "bistable" or "rest".

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or the oscillator is excited.
    """
    name, low, high = _checked(parameters, over, against)
    points = checked_count("points", points, 10, 100_000)
    starts = tuple(sorted({*np.linspace(low, high, _STARTS).tolist(), min(max(parameters.values[name], low), high)}))
    requests = [Request(parameters, curve, name, low, high, points, starts) for curve in ("v_b0", "v_b1")]
    description = {"what": "chart", "parameters": dataclasses.asdict(parameters), "over": [name, low, high]}
    description |= {"points": points}
    parts = run_chunks(_curve, requests, engine or Engine(), description=description)
    rows = [row for part in parts for row in Table(part).rows()]
    near = [row[name] + side * 0.01 * (high - low) for row in rows for side in (-1, 1) if row["kind"] in _FOLD_ENDS]
    candidates = tuple(p for p in (*starts, *near) if low <= p <= high)
    folds = list(Table(_curve(requests[0]._replace(curve="fold", starts=candidates))).rows())
    rows += [row for row in folds if row["kind"] != "none"]
    rows += _meetings(rows, requests[0])
    rows += _regions(rows, parameters, name)
    metadata = {"parameters": dataclasses.asdict(parameters), "over": name, "against": against}
    return Table({column: [row[column] for row in rows] for column in rows[0]}, metadata)


_FOLD_ENDS = ("Bautin", "grazing fold")


def _checked(parameters: Any, over: Any, against: Any) -> tuple[str, float, float]:
    if not isinstance(parameters, OscillatorParameters):
        raise TypeError(f"parameters must be OscillatorParameters, got {brief_repr(parameters)}")
    check_unexcited(parameters)
    if not isinstance(over, tuple | list) or len(over) != 3 or not isinstance(over[0], str):
        raise TypeError(f"over must be (name, low, high), got {brief_repr(over)}")
    if against != "belt_speed":
        raise ValueError(f"against must be 'belt_speed', got {brief_repr(against)}")
    name = over[0]
    allowed = [known for known in parameters.values if known != "belt_speed"]
    if name not in allowed:
        raise ValueError(f"over must name one of {', '.join(allowed)}, got {name!r}")
    least, most = RANGES.get(name, (-1e12, 1e12))
    low, high = (checked_number(f"over: {name}", value, least, most) for value in over[1:])
    if not low < high:
        raise ValueError(f"over must be (name, low, high) with low < high, got {over!r}")
    return name, low, high


# Curves ---------------------------------------------------------------------------------------------------------------


def _curve(request: Request) -> Columns:
    """Return the rows of a curve: all its branches that pass one of the starts."""
    parameters, curve, name = request.parameters, request.curve, request.name
    rows: list[dict[str, Any]] = []
    followed: list[tuple[Border, list[FloatArray]]] = []
    for value in request.starts:
        border = _border(request)
        y = np.array([parameters.belt_speed, value])
        try:
            border.oscillator(y)
            if not border.directions(y)[1].any():
                raise NoBorderError(f"the plant does not use the parameter {name!r}")
            y = border.start(y)
        except (NoBorderError, BranchEndError, OrbitError) as error:
            rows.append(_row(curve, name, y, "none", reason=str(error)))
            continue
        if any(_passes(other, places, y) for other, places in followed):
            continue
        back, forth = (_branch(request, border, y, way) for way in (-1.0, 1.0))
        reasons = {0: back.reason, len(back.points) + len(forth.points) - 2: forth.reason}
        places = [*reversed(back.points[1:]), *forth.points]
        followed.append((border, [point.y for point in places]))
        for i, point in enumerate(places):
            rows.append(
                _row(curve, name, point.y, point.kind, border, point.residual, reasons.get(i, ""), len(followed) - 1)
            )
    return {column: np.array([row[column] for row in rows]) for column in rows[0]}


def _border(request: Request) -> Any:
    scale = np.array([1.0, 10.0, 1.0, request.high - request.low])
    kind = BORDERS[request.curve]
    return kind(request.parameters, ("belt_speed", request.name), scale[[0, 2, 3]] if kind is HopfBorder else scale)


def _branch(request: Request, border: Any, start: FloatArray, way: float) -> Branch:
    def valid(y: FloatArray, tangent: FloatArray) -> float:
        border.oscillator(y)
        return 1.0

    tests = {"turn": lambda y, tangent: float(tangent[-1]), "valid": valid}
    if request.curve == "v_b0":
        tests["grazing fold"] = lambda y, tangent: border.multiplier(y) - 1.0
    elif request.curve == "v_b1":
        tests["Bautin"] = lambda y, tangent: border.lyapunov(y)
    least = 0.0 if request.curve == "v_b1" else _LEAST_BELT_SPEED
    limits = {-1: (request.low, request.high, request.name), -2: (least, RANGES["belt_speed"][1], "belt_speed")}
    along = way * np.eye(len(start))[-1]
    return follow(border, start, along, longest=1.0 / request.points, limits=limits, tests=tests)


def _passes(border: Any, places: list[FloatArray], y: FloatArray) -> bool:
    """Return whether a curve passes a solution."""
    for y0, y1 in itertools.pairwise(places):
        if (y0[-1] - y[-1]) * (y1[-1] - y[-1]) <= 0.0:
            try:
                found = solution_at(border, y0, y1, len(y) - 1, y[-1])
            except BranchEndError:
                continue
            if abs(found[-2] - y[-2]) < 1e-7 * max(1.0, y[-2]):
                return True
    return False


def _row(
    curve: str,
    name: str,
    y: FloatArray,
    kind: str,
    border: Any = None,
    residual: float = math.nan,
    reason: str = "",
    branch: int = -1,
) -> dict[str, Any]:
    is_hopf, is_graze = (isinstance(border, one) for one in (HopfBorder, GrazingBorder))
    if is_hopf:
        stiffness = border.jacobian(y)[0, 0]
        period = 2.0 * math.pi / math.sqrt(stiffness) if stiffness > 0.0 else math.nan
    return {
        "curve": curve,
        "branch": branch,
        "kind": kind,
        name: float(y[-1]),
        "belt_speed": float(y[-2]) if border is not None or curve == "region" else math.nan,
        "x": float(y[0]) if border is not None else math.nan,
        "period": period if is_hopf else float(y[1]) if border is not None else math.nan,
        "residual": residual,
        "multiplier": border.multiplier(y) if is_graze else math.nan,
        "first_lyapunov_coefficient": border.lyapunov(y) if is_hopf else math.nan,
        "crossings": getattr(border, "events", 0),
        "reason": reason,
    }


def _branches(rows: list[dict[str, Any]], name: str) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield each branch's curve and points."""
    on_curves = [row for row in rows if row["branch"] >= 0]
    for (curve, _), group in itertools.groupby(on_curves, key=lambda row: (row["curve"], row["branch"])):
        yield curve, list(group)


def _meetings(rows: list[dict[str, Any]], request: Request) -> list[dict[str, Any]]:
    """Return the points where v_b0 = v_b1."""
    name = request.name
    found = []
    branches = list(_branches(rows, name))
    for (one, grazing), (other, hopf) in itertools.product(branches, branches):
        if (one, other) != ("v_b0", "v_b1"):
            continue
        for a0, a1 in itertools.pairwise(grazing):
            for b0, b1 in _crossing(a0, a1, hopf, name):
                borders = _border(request), _border(request._replace(curve="v_b1"))
                borders[0].events = a0["crossings"]
                ends = [(np.array([r["x"], r["period"], r["belt_speed"], r[name]]) for r in (a0, a1))]
                ends.append(np.array([r["x"], r["belt_speed"], r[name]]) for r in (b0, b1))
                pairs = [tuple(pair) for pair in ends]

                def solutions(value: float, borders: Any = borders, pairs: Any = pairs) -> list[FloatArray]:
                    return [solution_at(b, *pair, -1, value) for b, pair in zip(borders, pairs, strict=True)]

                def apart(value: float, solutions: Any = solutions) -> float:
                    graze, hopf = solutions(value)
                    return float(graze[-2] - hopf[-2])

                low = max(min(a0[name], a1[name]), min(b0[name], b1[name]))
                high = min(max(a0[name], a1[name]), max(b0[name], b1[name]))
                value = float(brentq(apart, low, high, xtol=1e-15, rtol=1e-14))
                y = solutions(value)[0]
                found.append(_row("v_b0", name, y, "meeting", borders[0], abs(apart(value))))
    return found


def _crossing(
    a0: dict[str, Any], a1: dict[str, Any], hopf: list[dict[str, Any]], name: str
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield the pieces of one curve that cross a piece of another, over the values that they share."""
    for b0, b1 in itertools.pairwise(hopf):
        low = max(min(a0[name], a1[name]), min(b0[name], b1[name]))
        high = min(max(a0[name], a1[name]), max(b0[name], b1[name]))
        if low < high:
            gaps = [_between(a0, a1, value, name) - _between(b0, b1, value, name) for value in (low, high)]
            if gaps[0] * gaps[1] < 0.0:
                yield b0, b1


def _between(r0: dict[str, Any], r1: dict[str, Any], value: float, name: str) -> float:
    share = (value - r0[name]) / (r1[name] - r0[name])
    return float(r0["belt_speed"] + share * (r1["belt_speed"] - r0["belt_speed"]))


# Regions --------------------------------------------------------------------------------------------------------------


class Slab(NamedTuple):
    """Neighbouring values (n,) of the second parameter, at which the same curves bound regions: ``bounds`` (m, n)."""

    values: FloatArray
    bounds: FloatArray


def slabs_of(rows: list[dict[str, Any]], name: str) -> list[Slab]:
    """Return the chart cut where a curve begins, ends, turns or crosses another; the first bound is 0, the last the
    top of the chart."""
    branches = list(_branches(rows, name))
    if not branches:
        return []
    top = 1.15 * max(row["belt_speed"] for _, points in branches for row in points)
    every = [row[name] for row in rows if math.isfinite(row[name])]
    columns: list[tuple[tuple[str, ...], float, list[float]]] = []
    for value in np.linspace(min(every), max(every), _COLUMNS).tolist():
        met = []
        for curve, points in branches:
            for r0, r1 in itertools.pairwise(points):
                if (r0[name] - value) * (r1[name] - value) <= 0.0 and r0[name] != r1[name]:
                    at = _between(r0, r1, value, name)
                    if not any(abs(at - other) < 1e-9 for other, _ in met):
                        met.append((at, curve))
        met.sort()
        columns.append((tuple(curve for _, curve in met), value, [0.0, *(at for at, _ in met), top]))
    found = []
    for _, group in itertools.groupby(columns, key=lambda column: column[0]):
        _, values, bounds = zip(*group, strict=True)
        found.append(Slab(np.array(values), np.array(bounds).T))
    return found


def _regions(rows: list[dict[str, Any]], parameters: OscillatorParameters, name: str) -> list[dict[str, Any]]:
    """Return a row for each region: a point in it and its name."""
    found = []
    for slab in slabs_of(rows, name):
        middle = len(slab.values) // 2
        value = float(slab.values[middle])
        found.append(_row("region", name, np.array([math.nan, 0.0, value]), "rest", reason="the belt stands still"))
        for low, high in itertools.pairwise(slab.bounds[:, middle].tolist()):
            speed, kinds, reason = 0.5 * (low + high), ["none"], ""
            try:
                kinds = sorted({cycle.kind for cycle in attractors(parameters.replace(**{name: value}, belt_speed=speed))})
                reason = ", ".join(kinds) or "no attractor that keeps contact"
            except ValueError as error:
                reason = str(error)
            kind = "bistable" if len(kinds) > 1 else _REGIONS.get(kinds[0] if kinds else "", "none")
            found.append(_row("region", name, np.array([math.nan, speed, value]), kind, reason=reason))
    return found
