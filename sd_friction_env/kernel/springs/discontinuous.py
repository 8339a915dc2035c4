"""The discontinuous limit of Eq. 4, alpha = 0: R = x - sgn(x), N = g1; x = 0 switches the field."""

from typing import NamedTuple

from sd_friction_env.kernel.codes import SIDE_ZERO
from sd_friction_env.kernel.laws import spring_law


@spring_law
class Discontinuous(NamedTuple):
    """The spring at alpha = 0; R(0) = 0 for a mass at rest there."""

    frozen_side: float = 0.0  # of x = 0 where the field is frozen; 0: by x

    def restoring_force(self, x):
        side = self.frozen_side
        if side == 0.0 and x != 0.0:
            side = 1.0 if x > 0.0 else -1.0
        return x - side

    def restoring_slope(self, x):
        return 1.0

    def restoring_curvature(self, x):
        return 0.0

    def potential(self, x):
        return 0.5 * (x * x) - abs(x)

    def switches(self):
        return True

    def side(self):
        return self.frozen_side

    def select_field(self, x, v):
        if self.frozen_side != 0.0:
            return self
        if abs(x) > SIDE_ZERO:
            return Discontinuous(1.0 if x > 0.0 else -1.0)
        if v == 0.0:
            return self
        return Discontinuous(1.0 if v > 0.0 else -1.0)

    def on_side(self, side):
        return Discontinuous(side)
