"""Tuples of derivatives by the numbers of a law, in the order of its fields, inner laws one after the other."""

from typing import Any

from numba import literal_unroll
from numba.core import types
from numba.extending import overload


def zeros_of(law: Any) -> Any:
    """Return a zero for each number of a law, its parts' included."""
    return sum(
        (zeros_of(part) if isinstance(part, tuple) else (0.0,) * (not hasattr(part, "shape")) for part in law), ()
    )


def _count(law: Any) -> int:
    parts = (_count(part) if isinstance(part, types.BaseTuple) else isinstance(part, types.Float) for part in law)
    return sum(map(int, parts))


@overload(zeros_of, inline="always")
def _zeros_of(law):
    zeros = (0.0,) * _count(law)
    return lambda law: zeros


def scaled(derivatives: Any, factor: Any) -> Any:
    """Return a tuple of derivatives, each times a factor."""
    return tuple(factor * value for value in derivatives)


@overload(scaled)
def _scaled(derivatives, factor):
    if len(derivatives) == 0:
        return lambda derivatives, factor: derivatives
    if len(derivatives) == 1:
        return lambda derivatives, factor: (factor * derivatives[0],)
    return lambda derivatives, factor: (factor * derivatives[0], *scaled(derivatives[1:], factor))


def put(out: Any, first: Any, derivatives: Any, factor: Any) -> Any:
    """Write a tuple of derivatives, times a factor, from ``first`` on, and return the place after the last."""
    for i, value in enumerate(derivatives):
        out[first + i] = factor * value
    return first + len(derivatives)


@overload(put)
def _put(out, first, derivatives, factor):
    if len(derivatives) == 0:
        return lambda out, first, derivatives, factor: first

    def write(out, first, derivatives, factor):
        for value in literal_unroll(derivatives):
            out[first] = factor * value
            first += 1
        return first

    return write
