"""A leg of stick, up to breakaway."""

from sd_friction_env.kernel.codes import (
    BREAKAWAY,
    NO_EVENT,
    SIDE_ZERO,
    STICK,
    SWITCHING,
    TIME_ZERO,
)
from sd_friction_env.kernel.compilation import compiled, in_lanes
from sd_friction_env.kernel.events import may_cross_twice
from sd_friction_env.kernel.forces import (
    mode_at_zero_v_rel,
    normal_slope,
    partial_time_derivatives,
    restoring_slope,
    stick_limit,
    stick_load,
)
from sd_friction_env.kernel.plant import Drive, at_time, drive_at, select_field
from sd_friction_env.kernel.slip import Leg

# Gauss and Legendre's five nodes and weights on [0, 1]
NODES = (0.04691007703066802, 0.23076534494715845, 0.5, 0.7692346550528415, 0.9530899229693319)
WEIGHTS = (0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454)


@in_lanes
def ridden(x, drive, t):
    """Return where a mass stuck since t = 0 at x is at time t, in the belt's frame."""
    return x + (drive.v_belt + 0.5 * drive.a_belt * t) * t


@in_lanes
def cone_excess(plant, side, x, drive, t):
    """Return by how much a mass stuck since t = 0 at x exceeds one side of the stick cone at time t, and the slope."""
    x_t = ridden(x, drive, t)
    then = at_time(plant, t)
    there = drive_at(drive, t)
    place = then.excitation.lab_position(x_t)
    w = then.excitation.lab_velocity(there.v_belt)
    load_slope = 2.0 * plant.beta * then.excitation.lab_acceleration(drive.a_belt) + restoring_slope(then, place) * w
    mu = plant.friction.breakaway_coefficient(-side)
    slope = side * load_slope - mu * normal_slope(then, place) * w
    if then.excitation.acts():
        force, restoring, normal = partial_time_derivatives(then, place)
        slope = slope + side * (restoring - force) - mu * normal
    return side * stick_load(then, x_t, there) - stick_limit(then, -side, x_t), slope


@compiled
def _breakaway_time(plant, side, x, drive, low, high):
    """Return a time in (low, high], just outside the cone, at which one side of it is left: Newton in a bracket."""
    t = high
    nudge = 1e-16 * max(1.0, high)
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle <= low or middle >= high:
            break
        excess, slope = cone_excess(plant, side, x, drive, t)
        if excess > 0.0:
            high = t
        else:
            low = t
        following = t - excess / slope if slope > 0.0 else middle
        if abs(following - t) < TIME_ZERO:
            # There, but for rounding: step over the place until it is hemmed in.
            nudge = 2.0 * nudge
            if high - low <= 2.0 * nudge:
                break
            following = following + nudge if excess <= 0.0 else following - nudge
        if not low < following < high:
            following = 0.5 * (low + high)
        t = following
    return high


@compiled
def stick_until_event(plant, x, drive, duration):
    """Ride with the belt for ``duration``, until breakaway, or until x is where that switches the field (SWITCHING).

    Return the time spent and the event. The cone is walked in pieces no longer than an eighth of the spring's length
    scale and of a radian of excitation, each side of it on its own; a side that rises and falls again within a piece is
    followed to its top. The time returned lies just outside the cone.
    """
    fastest = max(abs(drive.v_belt), abs(drive.v_belt + drive.a_belt * duration))
    plant = select_field(plant, x, drive.v_belt)
    piece = duration
    if fastest > 0.0:
        piece = min(duration, 0.125 * plant.spring.length_scale() / fastest)
    piece = plant.excitation.shortened(0.125, piece)
    t = 0.0
    while t < duration:
        t_end = t + piece
        if t_end >= duration or t_end <= t:
            t_end = duration
        switches, t_end = _find_switching_in_stick(plant, x, drive, t, t_end)
        first = t_end
        found = False
        for side in (-1.0, 1.0):
            excess, slope = cone_excess(plant, side, x, drive, t)
            excess_end, slope_end = cone_excess(plant, side, x, drive, t_end)
            high = t_end
            outside = excess_end > 0.0
            if not outside and may_cross_twice(-excess, -slope, -excess_end, -slope_end, t_end - t):
                low = t
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if cone_excess(plant, side, x, drive, middle)[1] > 0.0:
                        low = middle
                    else:
                        high = middle
                outside = cone_excess(plant, side, x, drive, high)[0] > 0.0
            if outside:
                high = _breakaway_time(plant, side, x, drive, t, high)
                first = min(first, high)
                found = True
        if found:
            return first, BREAKAWAY
        if switches:
            return t_end, SWITCHING
        t = t_end
    return duration, NO_EVENT


@in_lanes
def _lab_speed(plant, drive, t):
    return plant.excitation.at_time(t).lab_velocity(drive.v_belt + drive.a_belt * t)


@in_lanes
def _lab_place(plant, x, drive, t):
    return plant.excitation.at_time(t).lab_position(ridden(x, drive, t))


@compiled
def _find_switching_in_stick(plant, x, drive, t, t_end):
    """Whether a stuck mass passes x = 0 in (t, t_end] where that switches the field, and the time if so, else t_end."""
    if not plant.spring.switches():
        return False, t_end
    side = plant.spring.side()
    low = t
    high = t_end
    if side * _lab_speed(plant, drive, low) < 0.0 and side * _lab_speed(plant, drive, high) > 0.0:
        # The belt turns in between: as deep as there it comes nowhere.
        first = low
        for _ in range(60):
            middle = 0.5 * (first + high)
            if side * _lab_speed(plant, drive, middle) < 0.0:
                first = middle
            else:
                high = middle
    leaving = side * _lab_speed(plant, drive, high) < 0.0
    if side * _lab_place(plant, x, drive, high) > (SIDE_ZERO if leaving else -SIDE_ZERO):
        return False, t_end
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle <= low or middle >= high:
            break
        if side * _lab_place(plant, x, drive, middle) > 0.0:
            low = middle
        else:
            high = middle
    return True, high


@compiled
def ride_across(plant, x, v_belt, duration):
    """:func:`stick_until_event` with a steady belt and no force, which goes on where only the field switches.

    Return the time spent and the event.
    """
    drive = Drive(v_belt, 0.0, 0.0)
    t, event = stick_until_event(plant, x, drive, duration)
    if event == SWITCHING:
        if mode_at_zero_v_rel(plant, 0.0, drive) != STICK:
            return t, BREAKAWAY
        dt, event = stick_until_event(plant, 0.0, drive, duration - t)
        t += dt
    return t, event


@in_lanes
def ride(plant, x, drive, t):
    """Return how far a stuck mass rides in a time t, and the integrals of v^2 and of the contact force's power.

    That force is a_belt + 2 beta v_belt + R - u: its power integrates in closed form.
    """
    v_belt, a_belt, u = drive
    dx = (v_belt + 0.5 * a_belt * t) * t
    int_v2 = (v_belt * v_belt + a_belt * t * (v_belt + a_belt * t / 3.0)) * t
    work = (a_belt - u) * dx + 2.0 * plant.beta * int_v2 + plant.spring.potential(x + dx) - plant.spring.potential(x)
    return dx, int_v2, work


@compiled
def stick_leg(plant, x, drive, duration):
    """Ride with the belt for ``duration``, or until breakaway."""
    v_belt, a_belt, _ = drive
    dt, event = stick_until_event(plant, x, drive, duration)
    dx, int_v2, int_fv = ride(plant, x, drive, dt)
    x_end = x + dx
    if event == SWITCHING:
        x_end = plant.excitation.at_time(dt).belt_frame_origin()
    x_min = min(x, x_end)
    x_max = max(x, x_end)
    if v_belt * (v_belt + a_belt * dt) < 0.0:  # the belt reverses
        x_turn = x - 0.5 * v_belt * v_belt / a_belt
        x_min = min(x_min, x_turn)
        x_max = max(x_max, x_turn)
    if plant.excitation.acts():
        int_v2, int_fv, x_min, x_max = _excited_ride(plant, x, drive, dt)
    return Leg(dt, event, x_end, v_belt + a_belt * dt, int_v2, int_fv, x_min, x_max, 0.0)


@compiled
def _excited_ride(plant, x, drive, duration):
    """Integrate v^2 and the contact force's power over a ride under excitation by quadrature.

    Return them, and the extremes of x: where v changes sign between two nodes, or at an end.
    """
    piece = plant.excitation.shortened(0.125, 0.5)
    fastest = max(abs(drive.v_belt), abs(drive.v_belt + drive.a_belt * duration)) + plant.excitation.ripple_speed()
    if fastest > 0.0:
        piece = min(piece, 0.125 * plant.spring.length_scale() / fastest)
    pieces = int(duration / piece) + 1
    length = duration / pieces
    int_v2 = 0.0
    int_fv = 0.0
    x_min = plant.excitation.lab_position(x)
    x_max = x_min
    place = _lab_place(plant, x, drive, duration)
    x_min = min(x_min, place)
    x_max = max(x_max, place)
    frozen = select_field(plant, x, drive.v_belt)
    before = 0.0
    w_before = plant.excitation.lab_velocity(drive.v_belt)
    for piece in range(pieces):
        for j in range(6):  # the sixth is the piece's end
            t = (piece + NODES[j]) * length if j < 5 else (piece + 1) * length
            w = _lab_speed(frozen, drive, t)
            if j < 5:
                load = stick_load(at_time(frozen, t), ridden(x, drive, t), drive_at(drive, t))
                int_v2 += WEIGHTS[j] * length * (w * w)
                int_fv += WEIGHTS[j] * length * (load * w)
            if w * w_before < 0.0:
                low = before
                high = t
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if _lab_speed(plant, drive, middle) * w_before > 0.0:
                        low = middle
                    else:
                        high = middle
                place = _lab_place(plant, x, drive, high)
                x_min = min(x_min, place)
                x_max = max(x_max, place)
            before = t
            w_before = w
    return int_v2, int_fv, x_min, x_max
