"""A friction law in other units of velocity: mu(v_rel) = law(unit v_rel)."""

from typing import Any, NamedTuple

from sd_friction_env.kernel.laws import friction_law


@friction_law
class ScaledFriction(NamedTuple):
    """A law whose velocities are in units that are ``unit`` times smaller, as those of a rig in m/s."""

    law: Any
    unit: float

    def coefficient(self, mode, v_rel):
        return self.law.coefficient(mode, self.unit * v_rel)

    def slope(self, mode, v_rel):
        return self.unit * self.law.slope(mode, self.unit * v_rel)

    def curvature(self, mode, v_rel):
        return self.unit * self.unit * self.law.curvature(mode, self.unit * v_rel)

    def third_derivative(self, mode, v_rel):
        return self.unit * self.unit * self.unit * self.law.third_derivative(mode, self.unit * v_rel)

    def breakaway_coefficient(self, mode):
        return self.law.breakaway_coefficient(mode)

    def layer_width(self, mode):
        return self.law.layer_width(mode) / self.unit

    def coefficient_gradient(self, mode, v_rel):
        by_unit = v_rel * self.law.slope(mode, self.unit * v_rel)
        return (*self.law.coefficient_gradient(mode, self.unit * v_rel), by_unit)

    def breakaway_gradient(self, mode):
        return (*self.law.breakaway_gradient(mode), 0.0)
