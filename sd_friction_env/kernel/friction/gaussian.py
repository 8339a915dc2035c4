"""Gaussian friction (exponent 2): mu = sgn(v_rel) (mu_k + (mu_s - mu_k) exp(-(v_rel/v_0)^2)) + mu_v v_rel."""

import math
from typing import NamedTuple

from sd_friction_env.kernel.laws import friction_law


@friction_law
class Gaussian(NamedTuple):
    """A coefficient that falls from mu_s to mu_k like a bell over a velocity v_0, and a viscous part."""

    mu_s: float
    mu_k: float
    v_0: float
    mu_v: float

    def coefficient(self, mode, v_rel):
        w = v_rel / self.v_0
        return mode * (self.mu_k + (self.mu_s - self.mu_k) * math.exp(-(w * w))) + self.mu_v * v_rel

    def slope(self, mode, v_rel):
        w = v_rel / self.v_0
        return -2.0 * mode * (self.mu_s - self.mu_k) / self.v_0 * w * math.exp(-(w * w)) + self.mu_v

    def curvature(self, mode, v_rel):
        w = v_rel / self.v_0
        return mode * (self.mu_s - self.mu_k) / (self.v_0 * self.v_0) * (4.0 * (w * w) - 2.0) * math.exp(-(w * w))

    def third_derivative(self, mode, v_rel):
        w = v_rel / self.v_0
        cube = self.v_0 * self.v_0 * self.v_0
        return mode * (self.mu_s - self.mu_k) / cube * w * (12.0 - 8.0 * (w * w)) * math.exp(-(w * w))

    def layer_width(self, mode):
        return self.v_0

    def coefficient_gradient(self, mode, v_rel):
        w = v_rel / self.v_0
        fall = math.exp(-(w * w))
        by_speed = 2.0 * mode * (self.mu_s - self.mu_k) * fall * (w * w) / self.v_0
        return mode * fall, mode * (1.0 - fall), by_speed, v_rel

    def breakaway_gradient(self, mode):
        return 1.0, 0.0, 0.0, 0.0
