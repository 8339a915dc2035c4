"""The inclined spring of the SD oscillator, Eq. 4.

R = x (1 - 1/l), N = g1 - alpha (1 - 1/l), l = sqrt(x^2 + alpha^2).
"""

import math
from typing import NamedTuple

from sd_friction_env.kernel.laws import spring_law


@spring_law
class Inclined(NamedTuple):
    """The spring of Eq. 4, its anchor at a height alpha over the belt."""

    alpha: float

    def restoring_force(self, x):
        return x * (1.0 - 1.0 / math.sqrt(x * x + self.alpha * self.alpha))

    def restoring_slope(self, x):
        length = math.sqrt(x * x + self.alpha * self.alpha)
        return 1.0 - 1.0 / length + x * x / (length * length * length)

    def restoring_curvature(self, x):
        square = self.alpha * self.alpha
        length = math.sqrt(x * x + square)
        return 3.0 * square * x / (length * length * length * length * length)

    def potential(self, x):
        length = math.sqrt(x * x + self.alpha * self.alpha)
        return 0.5 * (x * x) - x * x / (length + self.alpha)

    def normal_force(self, weight, x):
        return weight - self.alpha * (1.0 - 1.0 / math.sqrt(x * x + self.alpha * self.alpha))

    def normal_slope(self, x):
        length = math.sqrt(x * x + self.alpha * self.alpha)
        return -self.alpha * x / (length * length * length)

    def normal_curvature(self, x):
        square = self.alpha * self.alpha
        length = math.sqrt(x * x + square)
        return self.alpha * (2.0 * x * x - square) / (length * length * length * length * length)

    def length_scale(self):
        return 1.0 if self.alpha > 1.0 else self.alpha

    def may_be_stiff(self):
        return False

    def restoring_gradient(self, x):
        length = math.sqrt(x * x + self.alpha * self.alpha)
        return (x * self.alpha / (length * length * length),)

    def normal_gradient(self, weight, x):
        length = math.sqrt(x * x + self.alpha * self.alpha)
        return (x * x / (length * length * length) - 1.0,)
