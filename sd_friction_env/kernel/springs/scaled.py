"""A spring in other units of length and force: R(x) = spring(length x)/force."""

from typing import Any, NamedTuple

from sd_friction_env.kernel.laws import spring_law
from sd_friction_env.kernel.tuples import scaled


@spring_law
class ScaledSpring(NamedTuple):
    """A spring whose lengths and forces are in smaller units, as those of a rig in m and N."""

    spring: Any
    length: float
    force: float

    def restoring_force(self, x):
        return self.spring.restoring_force(self.length * x) / self.force

    def restoring_slope(self, x):
        return self.spring.restoring_slope(self.length * x) * self.length / self.force

    def restoring_curvature(self, x):
        return self.spring.restoring_curvature(self.length * x) * self.length * self.length / self.force

    def potential(self, x):
        return self.spring.potential(self.length * x) / (self.length * self.force)

    def normal_force(self, weight, x):
        return self.spring.normal_force(self.force * weight, self.length * x) / self.force

    def normal_slope(self, x):
        return self.spring.normal_slope(self.length * x) * self.length / self.force

    def normal_curvature(self, x):
        return self.spring.normal_curvature(self.length * x) * self.length * self.length / self.force

    def length_scale(self):
        return self.spring.length_scale() / self.length

    def normal_weight_slope(self, x):
        return self.spring.normal_weight_slope(self.length * x)

    def restoring_gradient(self, x):
        by_length = self.spring.restoring_slope(self.length * x) * x / self.force
        by_force = -self.spring.restoring_force(self.length * x) / (self.force * self.force)
        return (*scaled(self.spring.restoring_gradient(self.length * x), 1.0 / self.force), by_length, by_force)

    def normal_gradient(self, weight, x):
        by_length = self.spring.normal_slope(self.length * x) * x / self.force
        by_force = self.spring.normal_weight_slope(self.length * x) * weight / self.force
        by_force = by_force - self.spring.normal_force(self.force * weight, self.length * x) / (self.force * self.force)
        of_spring = self.spring.normal_gradient(self.force * weight, self.length * x)
        return (*scaled(of_spring, 1.0 / self.force), by_length, by_force)
