"""The level Duffing spring: R = s x + kappa x^3, N = g1."""

from typing import NamedTuple

from sd_friction_env.kernel.laws import spring_law


@spring_law
class Duffing(NamedTuple):
    """A spring that hardens (kappa > 0) or softens, with two wells where s < 0 < kappa."""

    linear_stiffness: float
    kappa: float

    def restoring_force(self, x):
        return self.linear_stiffness * x + self.kappa * (x * x * x)

    def restoring_slope(self, x):
        return self.linear_stiffness + 3.0 * self.kappa * (x * x)

    def restoring_curvature(self, x):
        return 6.0 * self.kappa * x

    def potential(self, x):
        return 0.5 * self.linear_stiffness * (x * x) + 0.25 * self.kappa * (x * x * x * x)

    def restoring_gradient(self, x):
        return x, x * x * x
