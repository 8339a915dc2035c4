"""Asymmetric friction: one law for backward slip, another for forward slip."""

from typing import Any, NamedTuple

from sd_friction_env.kernel.laws import friction_law
from sd_friction_env.kernel.tuples import zeros_of


@friction_law
class Asymmetric(NamedTuple):
    """Two laws of any kinds; stick holds against slip each way up to that law's coefficient."""

    backward: Any
    forward: Any

    def coefficient(self, mode, v_rel):
        if mode > 0:
            return self.forward.coefficient(mode, v_rel)
        return self.backward.coefficient(mode, v_rel)

    def slope(self, mode, v_rel):
        if mode > 0:
            return self.forward.slope(mode, v_rel)
        return self.backward.slope(mode, v_rel)

    def curvature(self, mode, v_rel):
        if mode > 0:
            return self.forward.curvature(mode, v_rel)
        return self.backward.curvature(mode, v_rel)

    def third_derivative(self, mode, v_rel):
        if mode > 0:
            return self.forward.third_derivative(mode, v_rel)
        return self.backward.third_derivative(mode, v_rel)

    def breakaway_coefficient(self, mode):
        if mode > 0:
            return self.forward.breakaway_coefficient(mode)
        return self.backward.breakaway_coefficient(mode)

    def layer_width(self, mode):
        if mode > 0:
            return self.forward.layer_width(mode)
        return self.backward.layer_width(mode)

    def coefficient_gradient(self, mode, v_rel):
        if mode > 0:
            return zeros_of(self.backward) + self.forward.coefficient_gradient(mode, v_rel)
        return self.backward.coefficient_gradient(mode, v_rel) + zeros_of(self.forward)

    def breakaway_gradient(self, mode):
        if mode > 0:
            return zeros_of(self.backward) + self.forward.breakaway_gradient(mode)
        return self.backward.breakaway_gradient(mode) + zeros_of(self.forward)
