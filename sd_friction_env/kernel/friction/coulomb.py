"""Two-level Coulomb friction: mu_s in stick, mu_k in slip."""

from typing import NamedTuple

from sd_friction_env.kernel.laws import friction_law


@friction_law
class Coulomb(NamedTuple):
    """A static coefficient and a kinetic one."""

    mu_s: float
    mu_k: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_k

    def slope(self, mode, v_rel):
        return 0.0

    def curvature(self, mode, v_rel):
        return 0.0

    def third_derivative(self, mode, v_rel):
        return 0.0

    def coefficient_gradient(self, mode, v_rel):
        return 0.0, float(mode)

    def breakaway_gradient(self, mode):
        return 1.0, 0.0
