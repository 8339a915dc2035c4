"""Derivatives of the forces by the numbers of a plant.

Their order is that of ``leaf_names``: spring, friction, excitation, g1, beta.
"""

from sd_friction_env.kernel.compilation import compiled
from sd_friction_env.kernel.forces import normal_force, normal_slope, restoring_slope
from sd_friction_env.kernel.tuples import put, zeros_of


@compiled
def external_gradient(plant, x, v, out):
    """Write the derivatives of the force 2 beta w + R - F (F: the exciting and the inertial one) that acts against a
    mass, at x, v in the belt's frame."""
    excitation = plant.excitation
    place = excitation.lab_position(x)
    factor = excitation.modulated(1.0)
    i = put(out, 0, plant.spring.restoring_gradient(place), factor)
    i = put(out, i, zeros_of(plant.friction), 1.0)
    restoring = plant.spring.restoring_force(place)
    i = put(out, i, excitation.gradient(-1.0, restoring_slope(plant, place), 2.0 * plant.beta, 1.0, restoring), 1.0)
    out[i] = 0.0
    out[i + 1] = 2.0 * excitation.lab_velocity(v)


@compiled
def contact_gradient(plant, coefficient, by_friction, x, out):
    """Write the derivatives of a coefficient times N(x), given those of the coefficient by its law's numbers."""
    excitation = plant.excitation
    place = excitation.lab_position(x)
    factor = excitation.modulated(1.0)
    i = put(out, 0, plant.spring.normal_gradient(plant.g1, place), coefficient * factor)
    i = put(out, i, by_friction, normal_force(plant, place))
    of_spring = coefficient * (plant.spring.normal_force(plant.g1, place) - plant.g1)
    i = put(out, i, excitation.gradient(0.0, coefficient * normal_slope(plant, place), 0.0, 0.0, of_spring), 1.0)
    out[i] = coefficient * (1.0 - factor + factor * plant.spring.normal_weight_slope(place))
    out[i + 1] = 0.0


@compiled
def ripple_gradient(plant, out, of_position):
    """Write the derivatives of the ripple's displacement (``of_position`` 1), or of its speed (0)."""
    i = put(out, 0, zeros_of(plant.spring), 1.0)
    i = put(out, i, zeros_of(plant.friction), 1.0)
    i = put(out, i, plant.excitation.gradient(0.0, of_position, 1.0 - of_position, 0.0, 0.0), 1.0)
    out[i] = 0.0
    out[i + 1] = 0.0
