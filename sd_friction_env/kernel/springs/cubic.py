"""Taylor polynomials of the inclined spring, Eq. 9.

R = x - x/alpha + x^3/(2 alpha^3), N = g1 - alpha + 1 - x^2/(2 alpha^2).
"""

from typing import NamedTuple

from sd_friction_env.kernel.laws import spring_law


@spring_law
class Cubic(NamedTuple):
    """The spring of Eq. 9, its anchor at a height alpha over the belt."""

    alpha: float

    def restoring_force(self, x):
        y = x / self.alpha
        return x - y + 0.5 * (y * y * y)

    def restoring_slope(self, x):
        y = x / self.alpha
        return 1.0 - (1.0 - 1.5 * (y * y)) / self.alpha

    def restoring_curvature(self, x):
        square = self.alpha * self.alpha
        return 3.0 * x / (square * self.alpha)

    def potential(self, x):
        y = x / self.alpha
        return 0.5 * (x * x) - 0.5 * (x * y) + 0.125 * (x * y * y * y)

    def normal_force(self, weight, x):
        y = x / self.alpha
        return weight - self.alpha + 1.0 - 0.5 * (y * y)

    def normal_slope(self, x):
        return -(x / self.alpha) / self.alpha

    def normal_curvature(self, x):
        return -1.0 / (self.alpha * self.alpha)

    def length_scale(self):
        return 1.0 if self.alpha > 1.0 else self.alpha

    def may_be_stiff(self):
        return False

    def restoring_gradient(self, x):
        y = x / self.alpha
        return ((y - 1.5 * (y * y * y)) / self.alpha,)

    def normal_gradient(self, weight, x):
        y = x / self.alpha
        return (y * y / self.alpha - 1.0,)
