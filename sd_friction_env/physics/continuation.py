"""Curves of solutions of n equations in n + 1 unknowns, by pseudo-arclength continuation.

A problem gives the residual F(y) and its Jacobian; the curve F(y) = 0 is followed by its arc length, so that it may
turn in any unknown. Special points are zeros of test functions on the curve. Keller: Numerical solution of bifurcation
and nonlinear eigenvalue problems (1977); Kuznetsov: Elements of Applied Bifurcation Theory (2004), ch. 10.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

RESIDUAL = 1e-12  # of each equation, to which a point is corrected
_MOST_CORRECTIONS = 12
_SHORTEST = 1e-5  # step, in longest ones, at which a curve is given up
_LEAST_COSINE = 0.98  # of the angle between successive tangents
_FIRST_STEP = 0.1  # in longest ones


class BranchEndError(ArithmeticError):
    """The equations have no meaning beyond here; the message says why."""


class Problem(Protocol):
    """n equations in n + 1 unknowns y; ``scale`` (n + 1,) is the size of each unknown."""

    scale: FloatArray

    def residual(self, y: FloatArray) -> FloatArray:
        """Return F(y), (n,), or raise BranchEndError."""

    def jacobian(self, y: FloatArray) -> FloatArray:
        """Return dF/dy, (n, n + 1), or raise BranchEndError."""


class Point(NamedTuple):
    """A point of a curve: unknowns, scaled unit tangent, largest residual, values of the tests, what is special."""

    y: FloatArray
    tangent: FloatArray
    residual: float
    values: dict[str, float]
    kind: str = "point"


class Branch(NamedTuple):
    """Points of a curve in their order, and why it ends at the last."""

    points: list[Point]
    reason: str


Test = Callable[[FloatArray, FloatArray], float]  # of the unknowns and the tangent


def correct(problem: Problem, guess: FloatArray, row: FloatArray, jacobian: FloatArray | None = None) -> FloatArray:
    """Return the solution near ``guess`` in the plane through it that is normal to ``row`` in scaled unknowns.

    The Jacobian, that of a point nearby, is renewed where it does not reduce the residual well.

    Raises:
        BranchEndError: if the iteration does not converge.
    """
    y: FloatArray = guess.copy()
    before = np.inf
    for _ in range(_MOST_CORRECTIONS):
        residual = problem.residual(y)
        size = float(np.abs(residual).max())
        if size <= RESIDUAL:
            return y
        if jacobian is None or size > 0.1 * before:
            jacobian = problem.jacobian(y)
        before = size
        matrix = np.vstack((jacobian * problem.scale, row))
        y = y + problem.scale * _solved(matrix, np.append(-residual, row @ ((guess - y) / problem.scale)))
    raise BranchEndError("the correction does not converge")


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise BranchEndError("the curve is singular here") from None


def _point(
    problem: Problem, y: FloatArray, along: FloatArray, tests: Mapping[str, Test], jacobian: FloatArray | None = None
) -> Point:
    """Return a solution as a point whose tangent leads the way of ``along``."""
    jacobian = problem.jacobian(y) if jacobian is None else jacobian
    tangent = _solved(np.vstack((jacobian * problem.scale, along)), np.append(np.zeros(len(jacobian)), 1.0))
    tangent = tangent / np.linalg.norm(tangent)
    residual = float(np.abs(problem.residual(y)).max())
    return Point(y, tangent, residual, {kind: test(y, tangent) for kind, test in tests.items()})


def follow(
    problem: Problem,
    start: FloatArray,
    along: FloatArray,
    *,
    longest: float,
    limits: Mapping[int, tuple[float, float, str]],
    tests: Mapping[str, Test],
    most_points: int = 20_000,
) -> Branch:
    """Follow a curve from a solution until it ends.

    Args:
        problem: its equations.
        start: a solution, (n + 1,).
        along: (n + 1,), of which the scaled tangent first leads the way.
        longest: step, in scaled unknowns.
        limits: of unknowns, by index: low, high and a name; the last point lies on the limit.
        tests: functions whose zeros on the curve are located, by the kind of point that they mark.
        most_points: after which the curve is left.
    """
    jacobian = problem.jacobian(start)
    point = _point(problem, start, along, tests, jacobian)._replace(kind="start")
    points = [point]
    bend, step = np.zeros_like(along), _FIRST_STEP * longest
    while len(points) < most_points:

        def at(length: float, point: Point = point, bend: FloatArray = bend, near: FloatArray = jacobian) -> FloatArray:
            guess = point.y + problem.scale * length * (point.tangent + 0.5 * length * bend)
            return correct(problem, guess, point.tangent, near)

        try:
            y, reason, length = at(step), "", float(step)
            for index, (low, high, name) in limits.items():
                if not low <= y[index] <= high:
                    y = solution_at(problem, point.y, y, index, low if y[index] < low else high)
                    reason, length = (
                        f"{name} reaches {y[index]:g}",
                        float(point.tangent @ ((y - point.y) / problem.scale)),
                    )
            after = problem.jacobian(y)
            following = _point(problem, y, point.tangent, tests, after)
            if following.tangent @ point.tangent < _LEAST_COSINE:
                raise BranchEndError("the curve has a corner")
            points += [
                _located(problem, at, length, tests, kind, point)
                for kind, value in following.values.items()
                if value * point.values[kind] < 0.0
            ]
        except BranchEndError as error:
            step *= 0.5
            if step < _SHORTEST * longest:
                return Branch([*points[:-1], points[-1]._replace(kind="end")], str(error))
            continue
        if not reason and len(points) > 3 and np.linalg.norm((y - start) / problem.scale) < 0.5 * step:
            reason = "the curve is closed"
        if reason:
            return Branch([*points, following._replace(kind="end")], reason)
        points.append(following)
        bend = (following.tangent - point.tangent) / step
        point, jacobian = following, after
        step = min(longest, 1.5 * step)
    return Branch([*points[:-1], points[-1]._replace(kind="end")], f"left after {most_points} points")


def _located(
    problem: Problem,
    at: Callable[[float], FloatArray],
    step: float,
    tests: Mapping[str, Test],
    kind: str,
    before: Point,
) -> Point:
    """Return the zero of a test within a step; its residual includes that of the test."""
    from scipy.optimize import brentq  # deferred: environments start without it

    def point(length: float) -> Point:
        return _point(problem, at(length), before.tangent, tests)

    try:
        length = brentq(lambda length: point(length).values[kind], 0.0, step, xtol=1e-15, rtol=1e-14)
    except ValueError:
        raise BranchEndError(f"the test of a {kind} changes sign at the end of a step only") from None
    found = point(float(length))
    return found._replace(kind=kind, residual=max(found.residual, abs(found.values[kind])))


def solution_at(problem: Problem, y0: FloatArray, y1: FloatArray, index: int, value: float) -> FloatArray:
    """Return the solution between two where an unknown has a value.

    Raises:
        BranchEndError: if the iteration does not converge.
    """
    guess = y0 + (value - y0[index]) / (y1[index] - y0[index]) * (y1 - y0) if y1[index] != y0[index] else y0.copy()
    guess[index] = value
    return correct(problem, guess, np.eye(len(guess))[index])
