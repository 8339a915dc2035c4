"""Tabulated friction: a measured curve mu(|v_rel|), interpolated by cubic Hermite polynomials (C1, monotone)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.kernel.compilation import compiled
from sd_friction_env.kernel.laws import friction_law


@friction_law
class Tabulated(NamedTuple):
    """Knots (n,) at ascending speeds from 0, the coefficients there and the slopes there; level beyond the last."""

    speeds: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    slopes: NDArray[np.float64]

    def __eq__(self, other: object) -> bool:
        return type(other) is Tabulated and all(map(np.array_equal, self, other))

    def __hash__(self) -> int:
        return hash(tuple(array.tobytes() for array in self))

    def coefficient(self, mode, v_rel):
        return mode * _polynomial(self, mode * v_rel)[0]

    def slope(self, mode, v_rel):
        return _polynomial(self, mode * v_rel)[1]

    def curvature(self, mode, v_rel):
        return mode * _polynomial(self, mode * v_rel)[2]

    def third_derivative(self, mode, v_rel):
        return _polynomial(self, mode * v_rel)[3]

    def breakaway_coefficient(self, mode):
        return self.coefficients[0]

    def layer_width(self, mode):
        return self.speeds[1]


@compiled
def _polynomial(table, speed):
    """Return the coefficient at a speed and its three derivatives."""
    last = len(table.speeds) - 1
    if speed >= table.speeds[last]:
        return table.coefficients[last], 0.0, 0.0, 0.0
    low = 0  # the first interval's polynomial holds below 0, too
    high = last
    while high - low > 1:
        middle = (low + high) // 2
        if speed < table.speeds[middle]:
            high = middle
        else:
            low = middle
    h = table.speeds[high] - table.speeds[low]
    t = speed - table.speeds[low]
    chord = (table.coefficients[high] - table.coefficients[low]) / h
    c_2 = (3.0 * chord - 2.0 * table.slopes[low] - table.slopes[high]) / h
    c_3 = (table.slopes[low] + table.slopes[high] - 2.0 * chord) / (h * h)
    value = table.coefficients[low] + t * (table.slopes[low] + t * (c_2 + t * c_3))
    return value, table.slopes[low] + t * (2.0 * c_2 + 3.0 * c_3 * t), 2.0 * c_2 + 6.0 * c_3 * t, 6.0 * c_3
