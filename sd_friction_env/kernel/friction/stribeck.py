"""The Stribeck law, Eq. 5: mu = mu_s sgn(v_rel) - k1 v_rel + k3 v_rel^3."""

from typing import NamedTuple

from sd_friction_env.kernel.laws import friction_law


@friction_law
class Stribeck(NamedTuple):
    """The law of Eq. 5, with v_rel in the linear term as Eq. 6 has it."""

    mu_s: float
    k1: float
    k3: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_s - self.k1 * v_rel + self.k3 * (v_rel * v_rel * v_rel)

    def slope(self, mode, v_rel):
        return -self.k1 + 3.0 * self.k3 * (v_rel * v_rel)

    def curvature(self, mode, v_rel):
        return 6.0 * self.k3 * v_rel

    def third_derivative(self, mode, v_rel):
        return 6.0 * self.k3

    def may_be_steep(self):
        return False

    def coefficient_gradient(self, mode, v_rel):
        return float(mode), -v_rel, v_rel * v_rel * v_rel

    def breakaway_gradient(self, mode):
        return 1.0, 0.0, 0.0
