"""Forces on the mass: slip acceleration (Eq. 7), stick load (Eq. 8) and the mode at zero relative velocity."""

from sd_friction_env.kernel.codes import ROUNDING, SLIP_BACKWARD, SLIP_FORWARD, STICK
from sd_friction_env.kernel.compilation import compiled, in_lanes
from sd_friction_env.kernel.plant import select_field


@in_lanes
def restoring_force(plant, x):
    """Return R(x) of the spring, modulated; x in the lab's frame."""
    return plant.excitation.modulated(plant.spring.restoring_force(x))


@in_lanes
def normal_force(plant, x):
    """Return N(x), the spring's part of it modulated; x in the lab's frame."""
    return plant.excitation.modulated_normal(plant.g1, plant.spring.normal_force(plant.g1, x))


@in_lanes
def restoring_slope(plant, x):
    """Return R'(x), modulated."""
    return plant.excitation.modulated(plant.spring.restoring_slope(x))


@in_lanes
def normal_slope(plant, x):
    """Return N'(x), modulated."""
    return plant.excitation.modulated(plant.spring.normal_slope(x))


@in_lanes
def energy_in_spring(plant, x):
    """Return V(x) at the plant's time: that of a modulated spring is as many times as great as its force."""
    return plant.excitation.modulated(plant.spring.potential(x))


@in_lanes
def contact_and_acceleration(plant, mode, x, v, v_belt, u):
    """Return the contact force -mu N in slip, and the acceleration (Eq. 7 with a control force u)."""
    place = plant.excitation.lab_position(x)
    contact = -plant.friction.coefficient(mode, v - v_belt) * normal_force(plant, place)
    damping = 2.0 * plant.beta * plant.excitation.lab_velocity(v)
    return contact, contact - damping - restoring_force(plant, place) + plant.excitation.drive_force(u)


@in_lanes
def slip_acceleration(plant, mode, state, drive):
    """Return the acceleration in slip (Eq. 7 with a control force)."""
    return contact_and_acceleration(plant, mode, state.x, state.v, drive.v_belt, drive.u)[1]


@in_lanes
def stick_load(plant, x, drive):
    """Return the force that the contact must bear in stick.

    Eq. 8 as it must read: -mu_s N(x) <= a_belt + 2 beta v_belt + R(x) - u <= mu_s N(x).
    """
    plant = select_field(plant, x, drive.v_belt)
    excitation = plant.excitation
    damping = 2.0 * plant.beta * excitation.lab_velocity(drive.v_belt)
    restoring = restoring_force(plant, excitation.lab_position(x))
    return drive.a_belt + damping + restoring - excitation.drive_force(drive.u)


@in_lanes
def stick_limit(plant, mode, x):
    """Return the greatest load, in size, that stick bears before it gives way to slip in a mode: mu_s N."""
    return plant.friction.breakaway_coefficient(mode) * normal_force(plant, plant.excitation.lab_position(x))


@in_lanes
def mode_at_zero_v_rel(plant, x, drive):
    """Return the mode of a mass that moves with the belt: stick inside the cone, else slip the way the load pulls."""
    load = stick_load(plant, x, drive)
    mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
    return STICK if abs(load) <= stick_limit(plant, mode, x) else mode


@compiled
def breakaway_mode(plant, x, drive):
    """Return the mode in which a mass leaves stick: slip the way the load pulls."""
    return SLIP_BACKWARD if stick_load(plant, x, drive) > 0.0 else SLIP_FORWARD


@compiled
def mode_in_belt_frame(plant, state, drive):
    """Return the mode of a state in the belt's frame."""
    if state.v < drive.v_belt:
        return SLIP_BACKWARD
    if state.v > drive.v_belt:
        return SLIP_FORWARD
    return mode_at_zero_v_rel(plant, state.x, drive)


@compiled
def partial_time_derivatives(plant, place):
    """Return how fast the drive force, R and N grow with time at a place (in the lab's frame)."""
    rate = plant.excitation.stiffness_rate()
    spring = plant.spring
    normal = rate * (spring.normal_force(plant.g1, place) - plant.g1)
    return plant.excitation.drive_force_rate(), rate * spring.restoring_force(place), normal


@compiled
def normal_force_rate(plant, x, v):
    """Return the rate of change of the normal force."""
    place = plant.excitation.lab_position(x)
    rate = normal_slope(plant, place) * plant.excitation.lab_velocity(v)
    return rate + partial_time_derivatives(plant, place)[2]


@in_lanes
def slip_jerk(plant, mode, x, v, v_belt, a_belt, a):
    """Return the rate of change of the acceleration a in slip, under a held force."""
    v_rel = v - v_belt
    excitation = plant.excitation
    place = excitation.lab_position(x)
    w = excitation.lab_velocity(v)
    contact = plant.friction.slope(mode, v_rel) * (a - a_belt) * normal_force(plant, place)
    contact = contact + plant.friction.coefficient(mode, v_rel) * normal_slope(plant, place) * w
    jerk = -contact - 2.0 * plant.beta * excitation.lab_acceleration(a) - restoring_slope(plant, place) * w
    if excitation.acts():
        drive, restoring, normal_part = partial_time_derivatives(plant, place)
        jerk = jerk + drive - restoring - plant.friction.coefficient(mode, v_rel) * normal_part
    return jerk


@compiled
def roundoff_floor(plant, mode, x, v, v_belt):
    """Return an error per unit of time below which rounding hides the estimate: of large forces in balance."""
    if not (plant.friction.may_be_steep() or plant.spring.may_be_stiff() or plant.excitation.acts()):
        return 0.0
    place = plant.excitation.lab_position(x)
    normal = normal_force(plant, place)
    forces = abs(restoring_force(plant, place)) + abs(plant.friction.coefficient(mode, v - v_belt) * normal)
    places = (abs(x) + abs(place)) * abs(restoring_slope(plant, place))
    return ROUNDING * (forces + 0.1 * (places + plant.excitation.roundoff()))
