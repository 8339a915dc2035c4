"""Exponential friction: mu = sgn(v_rel) (mu_k + (mu_s - mu_k) exp(-|v_rel|/v_0)) + mu_v v_rel."""

import math
from typing import NamedTuple

from sd_friction_env.kernel.codes import HUGE_EXPONENT
from sd_friction_env.kernel.laws import friction_law


@friction_law
class Exponential(NamedTuple):
    """A coefficient that falls from mu_s to mu_k over a velocity v_0, and a viscous part."""

    mu_s: float
    mu_k: float
    v_0: float
    mu_v: float

    def coefficient(self, mode, v_rel):
        fall = math.exp(min(-(mode * v_rel) / self.v_0, HUGE_EXPONENT))
        return mode * (self.mu_k + (self.mu_s - self.mu_k) * fall) + self.mu_v * v_rel

    def slope(self, mode, v_rel):
        fall = math.exp(min(-(mode * v_rel) / self.v_0, HUGE_EXPONENT))
        return -(self.mu_s - self.mu_k) / self.v_0 * fall + self.mu_v

    def curvature(self, mode, v_rel):
        fall = math.exp(min(-(mode * v_rel) / self.v_0, HUGE_EXPONENT))
        return mode * (self.mu_s - self.mu_k) / (self.v_0 * self.v_0) * fall

    def third_derivative(self, mode, v_rel):
        fall = math.exp(min(-(mode * v_rel) / self.v_0, HUGE_EXPONENT))
        return -(self.mu_s - self.mu_k) / (self.v_0 * self.v_0 * self.v_0) * fall

    def layer_width(self, mode):
        return self.v_0

    def coefficient_gradient(self, mode, v_rel):
        fall = math.exp(min(-(mode * v_rel) / self.v_0, HUGE_EXPONENT))
        by_speed = (self.mu_s - self.mu_k) * fall * v_rel / (self.v_0 * self.v_0)
        return mode * fall, mode * (1.0 - fall), by_speed, v_rel

    def breakaway_gradient(self, mode):
        return 1.0, 0.0, 0.0, 0.0
