"""Hyperbolic friction: mu = mu_s sgn(v_rel)/(1 + delta |v_rel|) + mu_v v_rel."""

from typing import NamedTuple

from sd_friction_env.kernel.laws import friction_law


@friction_law
class Hyperbolic(NamedTuple):
    """A coefficient that halves at |v_rel| = 1/delta, and a viscous part."""

    mu_s: float
    delta: float
    mu_v: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_s / (1.0 + self.delta * (mode * v_rel)) + self.mu_v * v_rel

    def slope(self, mode, v_rel):
        # mode^2 = 1 in slip
        below = 1.0 + self.delta * (mode * v_rel)
        return -self.mu_s * self.delta / (below * below) + self.mu_v

    def curvature(self, mode, v_rel):
        below = 1.0 + self.delta * (mode * v_rel)
        return 2.0 * mode * self.mu_s * (self.delta * self.delta) / (below * below * below)

    def third_derivative(self, mode, v_rel):
        below = 1.0 + self.delta * (mode * v_rel)
        return -6.0 * self.mu_s * (self.delta * self.delta * self.delta) / (below * below * below * below)

    def layer_width(self, mode):
        return 1.0 / max(self.delta, 1e-300)

    def coefficient_gradient(self, mode, v_rel):
        below = 1.0 + self.delta * (mode * v_rel)
        return mode / below, -self.mu_s * v_rel / (below * below), v_rel

    def breakaway_gradient(self, mode):
        return 1.0, 0.0, 0.0
