"""The level linear spring of Thomsen and Fidlin (2003): R = x, N = g1."""

from typing import NamedTuple

from sd_friction_env.kernel.laws import spring_law


@spring_law
class Linear(NamedTuple):
    """The unit spring."""

    stiffness: float = 1.0

    def restoring_force(self, x):
        return self.stiffness * x

    def restoring_slope(self, x):
        return self.stiffness

    def restoring_curvature(self, x):
        return 0.0

    def potential(self, x):
        return 0.5 * self.stiffness * (x * x)

    def may_be_stiff(self):
        return False

    def restoring_gradient(self, x):
        return (x,)
