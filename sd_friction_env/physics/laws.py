"""User-defined laws: springs and friction laws as NamedTuple classes, friction tables, and checks of derivatives.

A law is a NamedTuple class with the methods that :func:`friction_law` or :func:`spring_law` name. An instance of it is
given to :class:`OscillatorParameters` as ``friction`` or ``geometry``, and works wherever a built-in law does.
"""

import csv
import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.kernel import (
    FRICTION,
    OPTIONAL,
    SPRING,
    Asymmetric,
    Coulomb,
    Exponential,
    Gaussian,
    Hyperbolic,
    Stribeck,
    Tabulated,
    friction_law,
    leaf_names,
    leaves_of,
    spring_law,
)

__all__ = [
    "Asymmetric",
    "Coulomb",
    "Exponential",
    "Gaussian",
    "Hyperbolic",
    "Stribeck",
    "Tabulated",
    "check_friction_law",
    "check_spring_law",
    "friction_law",
    "friction_table",
    "spring_law",
    "tabulated_friction",
]

_RELATIVE_ERROR = 1e-4  # of a derivative against a difference
_SPEEDS = np.geomspace(1e-2, 5.0, 12).tolist()
_PLACES = np.linspace(-2.03, 1.97, 12).tolist()
_FRICTION_CHAIN = ("coefficient", "slope", "curvature", "third_derivative")
_SPRING_CHAINS = (
    ("potential", "restoring_force", "restoring_slope", "restoring_curvature"),
    ("normal_force", "normal_slope", "normal_curvature"),
)
_KERNEL = FRICTION["coefficient"].__module__.rpartition(".")[0]


# A friction curve that was measured -----------------------------------------------------------------------------------


def tabulated_friction(speeds: ArrayLike, coefficients: ArrayLike) -> Tabulated:
    """Return the friction law that interpolates a measured curve.

    Between the points it is the monotone cubic interpolation of Fritsch and Carlson (1980), continuous with its slope;
    beyond the last it is level. Stick holds up to the first coefficient. For a curve that differs by direction, make
    ``Asymmetric(backward=..., forward=...)`` of two.

    Args:
        speeds: of the mass relative to the belt, without sign, (n,), ascending from 0; n >= 3.
        coefficients: of friction, (n,), none below 0.

    Raises:
        TypeError: if they are not numbers.
        ValueError: if they do not ascend from 0 or are negative; names the point.
    """
    w, mu = _column("speeds", speeds), _column("coefficients", coefficients)
    if len(w) != len(mu):
        raise ValueError(f"speeds and coefficients must have one length, got {len(w)} and {len(mu)}")
    if len(w) < 3:
        raise ValueError(f"speeds must have at least 3 points, got {len(w)}")
    if w[0] != 0.0:
        raise ValueError(f"speeds must begin with 0, the coefficient of stick, got {w[0]!r}")
    falls = np.flatnonzero(np.diff(w) <= 0.0)
    if falls.size:
        i = int(falls[0]) + 1
        raise ValueError(f"speeds must ascend, got {w[i].item()!r} after {w[i - 1].item()!r} at point {i}")
    below = np.flatnonzero(mu < 0.0)
    if below.size:
        raise ValueError(f"coefficients must not be below 0, got {mu[below[0]].item()!r} at point {int(below[0])}")
    from scipy.interpolate import PchipInterpolator  # deferred: environments start without it

    slopes = np.asarray(PchipInterpolator(w, mu).derivative()(w), np.float64)
    slopes[-1] = 0.0  # level from there on
    return Tabulated(w, mu, slopes)


def friction_table(path: str | Path) -> Tabulated:
    """Return :func:`tabulated_friction` of a CSV file: a speed and a coefficient in each line.

    Skipped: empty lines, lines that begin with ``#``, and one line of names at the top.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if a line is not two numbers, or the curve is no friction law.
    """
    rows: list[tuple[float, float]] = []
    with Path(path).open(newline="", encoding="utf-8") as file:
        for number, line in enumerate(csv.reader(file), 1):
            if not line or line[0].lstrip().startswith("#"):
                continue
            try:
                speed, coefficient = (float(cell) for cell in line)
            except ValueError:
                if not rows and not any(cell.strip()[:1].isdigit() for cell in line):
                    continue  # names
                raise ValueError(
                    f"line {number} of {str(path)!r} must be a speed and a coefficient, got {line}"
                ) from None
            rows.append((speed, coefficient))
    table = np.array(rows, np.float64).reshape(-1, 2)
    try:
        return tabulated_friction(table[:, 0], table[:, 1])
    except ValueError as fault:
        raise ValueError(f"{str(path)!r} holds no friction curve: {fault}") from None


def _column(name: str, values: ArrayLike) -> NDArray[np.float64]:
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be numbers in an array of shape (n,), got {values!r}") from None
    if array.ndim != 1:
        raise ValueError(f"{name} must be an array of shape (n,), got shape {array.shape}")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(f"{name} must be finite, got {array[bad[0]].item()!r} at point {int(bad[0])}")
    return array


# Checks ---------------------------------------------------------------------------------------------------------------


def checked_law(part: Literal["geometry", "friction"], value: Any, names: tuple[str, ...]) -> Any:
    """Return ``value`` if it is one of ``names``, or a spring ("geometry") or friction law whose derivatives are right.

    Raises:
        ValueError: if it is neither, or a number of the law is not finite.
    """
    if part == "geometry":
        protocol, check_values, check_all, decorator = SPRING, _check_numbers, check_spring_law, "spring_law"
    else:
        protocol, check_values, check_all, decorator = FRICTION, _check_stick, check_friction_law, "friction_law"
    if isinstance(value, str) and value in names:
        return value
    law = type(value)
    if not isinstance(value, tuple) or not all(callable(getattr(law, method, None)) for method in protocol):
        text = repr(value)
        text = text if len(text) <= 300 else f"{text[:100]}... ({len(text)} characters)"
        choices = ", ".join(map(repr, names))
        raise ValueError(f"{part} must be one of {choices}, or a law declared with @{decorator}, got {text}")
    (check_values if _is_built_in(value) else check_all)(value)
    return value


@functools.lru_cache(maxsize=1024)
def check_friction_law(law: Any) -> None:
    """Check that a friction law is finite, at v_rel = 0 no stronger in slip than in stick, and has right derivatives.

    Derivatives, by v_rel and those by the law's numbers that it offers, are compared with finite differences, in both
    modes, at speeds from 0.01 to 5.

    Raises:
        ValueError: names the law, the method, the place, the value and what it should be.
    """
    _check_stick(law)
    for mode in (-1, 1):
        for speed in _SPEEDS:
            _check_chain(law, _FRICTION_CHAIN, functools.partial(_friction_value, law, mode), mode * speed)
            _check_gradient(law, "coefficient_gradient", "coefficient", mode, mode * speed)
        _check_gradient(law, "breakaway_gradient", "breakaway_coefficient", mode)


@functools.lru_cache(maxsize=1024)
def check_spring_law(law: Any) -> None:
    """Check that a spring is finite and has right derivatives, by finite differences at |x| <= 2.

    They are those by x, those by the spring's numbers that it offers, and that of N by the weight.

    Raises:
        ValueError: names the law, the method, the place, the value and what it should be.
    """
    _check_numbers(law)
    for place in _PLACES:
        for chain in _SPRING_CHAINS:
            _check_chain(law, chain, functools.partial(_spring_value, law), place)
        _check_gradient(law, "restoring_gradient", "restoring_force", place)
        _check_gradient(law, "normal_gradient", "normal_force", 1.0, place)
        by_weight = 0.5 * (law.normal_force(2.0, place) - law.normal_force(0.0, place))
        if not math.isclose(law.normal_weight_slope(place), by_weight, rel_tol=_RELATIVE_ERROR, abs_tol=1e-7):
            raise ValueError(
                f"{_name(law)}.normal_weight_slope must be dN/d(weight): at {place:.6g} it is "
                f"{law.normal_weight_slope(place):.9g}, a difference gives {by_weight:.9g}"
            )


def _check_gradient(law: Any, gradient: str, method: str, *at: float) -> None:
    """Check the derivatives of a method by the numbers of a law, if the law offers them."""
    if getattr(type(law), gradient) is OPTIONAL[gradient]:
        return
    found, names = getattr(law, gradient)(*at), leaf_names(law)
    if not isinstance(found, tuple) or len(found) != len(names):
        raise ValueError(f"{_name(law)}.{gradient} must be a tuple, a derivative by each of {names}, got {found!r}")
    for i, (name, value) in enumerate(zip(names, found, strict=True)):
        h = 1e-5 * max(1e-2, abs(leaves_of(law)[i]))
        up, down = (getattr(_moved(law, i, by), method)(*at) for by in (h, -h))
        difference = (up - down) / (2.0 * h)
        if not math.isclose(value, difference, rel_tol=_RELATIVE_ERROR, abs_tol=1e-6 * (1.0 + abs(up))):
            raise ValueError(
                f"{_name(law)}.{gradient} must be the derivatives of {method}: by {name} at {at} it is {value:.9g}, a "
                f"difference gives {difference:.9g}"
            )


def missing_gradient(law: Any) -> str | None:
    """Return what a law, or one in it, lacks for derivatives by its numbers, in words, or None."""
    for part in law:
        if isinstance(part, tuple) and (lacks := missing_gradient(part)):
            return lacks
    methods = ["coefficient_gradient", "breakaway_gradient"]
    if hasattr(law, "restoring_force"):
        methods = ["restoring_gradient"]
        if type(law).normal_force is not OPTIONAL["normal_force"]:
            methods.append("normal_gradient")
    lacking = [name for name in methods if getattr(type(law), name) is OPTIONAL[name]]
    return f"the law {_name(law)} has no method {lacking[0]}" if lacking and leaf_names(law) else None


def _moved(law: Any, number: int, by: float) -> Any:
    """Return a law with one of its numbers, in the order of ``leaf_names``, greater."""
    places = itertools.count()

    def moved(part: Any) -> Any:
        if isinstance(part, tuple):
            return type(part)(*map(moved, part))
        return part if isinstance(part, np.ndarray) else part + by * (next(places) == number)

    return moved(law)


def _check_stick(law: Any) -> None:
    _check_numbers(law)
    for mode in (-1, 1):
        limit, slip = law.breakaway_coefficient(mode), mode * law.coefficient(mode, 0.0)
        if not 0.0 <= limit < math.inf:
            raise ValueError(
                f"{_name(law)}.breakaway_coefficient({mode}) must be finite and not below 0, got {limit!r}"
            )
        if not slip <= limit * (1.0 + 1e-12):
            raise ValueError(
                f"{_name(law)}.coefficient({mode}, 0.0) must not exceed breakaway_coefficient({mode}) = {limit!r} in "
                f"size, got {slip!r}: a slipping mass could not come to rest"
            )


def _name(law: Any) -> str:
    return type(law).__name__


def _check_numbers(law: Any) -> None:
    for name, value in zip(law._fields, law, strict=True):
        if isinstance(value, tuple):
            _check_numbers(value)
        elif not isinstance(value, np.ndarray) and not (isinstance(value, int | float) and math.isfinite(value)):
            raise ValueError(f"{_name(law)}.{name} must be a finite number, got {value!r}")


def _is_built_in(law: Any) -> bool:
    parts = (part for part in law if isinstance(part, tuple))
    return type(law).__module__.startswith(_KERNEL) and all(map(_is_built_in, parts))


def _friction_value(law: Any, mode: int, method: str, v_rel: float) -> float:
    value: float = getattr(law, method)(mode, v_rel)
    return value


def _spring_value(law: Any, method: str, x: float) -> float:
    value: float = law.normal_force(1.0, x) if method == "normal_force" else getattr(law, method)(x)
    return value


def _check_chain(law: Any, chain: tuple[str, ...], value: Callable[[str, float], float], at: float) -> None:
    h = 1e-4 * abs(at)
    for method in chain:
        found = value(method, at)
        if not math.isfinite(found):
            raise ValueError(f"{_name(law)}.{method} must be finite, got {found!r} at {at:.6g}")
    for method, derivative in itertools.pairwise(chain):
        far, near = ((value(method, at + step) - value(method, at - step)) / (2.0 * step) for step in (2.0 * h, h))
        difference = (4.0 * near - far) / 3.0
        found = value(derivative, at)
        # A kink between the points makes the two differences differ: then the comparison decides nothing.
        allowed = _RELATIVE_ERROR * (abs(difference) + abs(value(method, at))) + abs(near - far) + 1e-7
        if abs(found - difference) > allowed:
            raise ValueError(
                f"{_name(law)}.{derivative} must be the derivative of {method}: at {at:.6g} it is {found:.9g}, a "
                f"difference gives {difference:.9g}"
            )
