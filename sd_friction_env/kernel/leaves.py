"""A plant as a row of numbers, and back: its leaves are the floats of its laws, in order, then its own.

Arrays in a law (a friction table) are no leaves. They lie one after the other in the flat ``tables``, which begins with
the places where they begin and end.
"""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.kernel.compilation import reader


def _values(plant: Any, like: Any) -> Iterator[tuple[Any, bool]]:
    for value, model in zip(plant, like, strict=True):
        if isinstance(model, tuple):
            yield from _values(value, model)
        else:
            yield value, isinstance(model, np.ndarray)


def leaves_of(plant: Any, like: Any = None) -> list[Any]:
    """Return the leaves of a plant; of n plants side by side (arrays (n,)) if ``like`` is one of them alone."""
    return [value for value, is_table in _values(plant, plant if like is None else like) if not is_table]


def leaf_names(plant: Any) -> list[str]:
    """Return the names of the floats of a plant, as ``friction.mu_s``."""

    def names(value: Any, path: str) -> Iterator[str]:
        for name, part in zip(value._fields, value, strict=True):
            if isinstance(part, tuple):
                yield from names(part, f"{path}{name}.")
            elif not isinstance(part, np.ndarray):
                yield path + name

    return list(names(plant, ""))


def tables_of(plant: Any) -> NDArray[np.float64]:
    """Return the arrays of a plant in one, after the places where they begin and end."""
    arrays = [np.asarray(value, np.float64) for value, is_table in _values(plant, plant) if is_table]
    bounds = len(arrays) + 1 + np.cumsum([0, *(len(array) for array in arrays)])
    return np.concatenate([bounds.astype(np.float64), *arrays])


def shape_of(plant: Any) -> Any:
    """Return the classes of a plant and of its laws: plants of one shape are stepped by the same compiled code."""
    parts = tuple(shape_of(value) if isinstance(value, tuple) else type(value) is np.ndarray for value in plant)
    return type(plant), parts


@functools.cache
def reader_of(shape: Any) -> Any:
    """Return the compiled function (numbers, first, stride, i, tables) that reads a plant of this shape.

    Its leaves are ``numbers[(first + leaf) * stride + i]``.
    """
    classes: dict[str, type] = {}
    leaves, arrays = 0, 0

    def expression(shape: Any) -> str:
        nonlocal leaves, arrays
        law, parts = shape
        name = f"{law.__name__}_{len(classes)}"
        classes[name] = law
        values = []
        for part in parts:
            if isinstance(part, tuple):
                values.append(expression(part))
            elif part:
                values.append(f"tables[int(tables[{arrays}]):int(tables[{arrays + 1}])]")
                arrays += 1
            else:
                values.append(f"numbers[(first + {leaves}) * stride + i]")
                leaves += 1
        return f"{name}({', '.join(values)})"

    source = f"def read(numbers, first, stride, i, tables):\n    return {expression(shape)}\n"
    laws = list(classes.values())
    exec(source, classes)  # its names and numbers are those of the classes alone
    return reader(classes["read"], source, laws, leaves)
