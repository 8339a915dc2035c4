"""Events in slip: where a gap closes (landing, turning), where x = 0 switches the field, where contact is lost."""

from typing import NamedTuple

from sd_friction_env.kernel.codes import LAST_STRETCH, LAYER_REACH, SIDE_ZERO, TIME_ZERO, V_REL_ZERO
from sd_friction_env.kernel.compilation import compiled, in_lanes
from sd_friction_env.kernel.forces import (
    contact_and_acceleration,
    normal_force,
    normal_force_rate,
    partial_time_derivatives,
    restoring_slope,
    slip_jerk,
)
from sd_friction_env.kernel.plant import at_time
from sd_friction_env.kernel.runge_kutta import slip_step


class Surface(NamedTuple):
    """The line side (v - level - rate t) = 0 that a slip meets: the belt's speed, or rest."""

    side: float
    level: float
    rate: float
    at_rest: bool  # of the mass in the lab's frame


class Look(NamedTuple):
    """What is found after slipping for a time: the gap to a surface with its derivatives, and the motion there."""

    gap: float
    slope: float
    curvature: float
    x: float
    v: float
    a: float
    contact: float  # force
    int_v2: float
    int_fv: float


class Arrival(NamedTuple):
    """Where a gap has closed."""

    time: float
    x: float
    a: float
    int_v2: float
    int_fv: float


@compiled
def may_cross_twice(gap, slope, gap_end, slope_end, h):
    """Whether a gap that is open at both ends of a step can close in between.

    It can if it falls, then rises, and the two end tangents meet below zero.
    """
    if slope < 0.0 and slope_end > 0.0:
        t = (gap_end - gap - slope_end * h) / (slope - slope_end)
        return gap + slope * t < -V_REL_ZERO
    return False


@in_lanes
def event_function(plant, mode, x, v, drive, t, side, level, rate):
    """Return the gap after a slip of time t that has led to x, v, its slope and curvature, a and the contact force."""
    belt = drive.v_belt + drive.a_belt * t
    contact, a = contact_and_acceleration(plant, mode, x, v, belt, drive.u)
    gap = side * (v - (level + rate * t))
    curvature = side * slip_jerk(plant, mode, x, v, belt, drive.a_belt, a)
    return gap, side * (a - rate), curvature, a, contact


@compiled
def look_at(plant, mode, state, drive, t, surface):
    """Slip for a time t and look at the gap to a surface there."""
    step = slip_step(plant, mode, state, drive, t)
    then = at_time(plant, t)
    gap, slope, curvature, a, contact = event_function(
        then, mode, step.x, step.v, drive, t, surface.side, surface.level, surface.rate
    )
    if surface.at_rest:
        gap, slope, curvature = then.excitation.lab_gap(surface.side, gap, slope, curvature)
    return Look(gap, slope, curvature, step.x, step.v, a, contact, step.int_v2, step.int_fv)


@compiled
def find_double_crossing(plant, mode, state, drive, h, surface, slope, slope_end):
    """Look for a time in (0, h) at which a gap that falls at 0 and rises at h is below zero: Newton on its slope.

    Return whether there is one, and the time.
    """
    low = 0.0
    high = h
    t = h * slope / (slope - slope_end)
    for _ in range(60):
        look = look_at(plant, mode, state, drive, t, surface)
        if look.gap < -V_REL_ZERO:
            return True, t
        if look.slope < 0.0:
            low = t
        else:
            high = t
        dt = -look.slope / look.curvature if look.curvature > 0.0 else h
        # As far from the bottom as this, a parabola tells how deep it is, with as much again to spare.
        if abs(dt) < 0.125 * h and look.gap > abs(look.slope * dt) + V_REL_ZERO:
            return False, t
        if abs(dt) < 1e-9 * h or high - low < TIME_ZERO:
            break
        t = t + dt
        if not low < t < high:
            t = 0.5 * (low + high)
    return False, t


@compiled
def hermite_root_estimate(gap, slope, gap_end, slope_end, h):
    """Return where the cubic with these values and slopes at 0 and h falls through zero, to a few digits."""
    m0 = slope * h
    m1 = slope_end * h
    c2 = 3.0 * (gap_end - gap) - 2.0 * m0 - m1
    c3 = m0 + m1 - 2.0 * (gap_end - gap)
    low = 0.0
    high = 1.0
    s = gap / (gap - gap_end) if gap > V_REL_ZERO and gap_end < gap else 0.5
    for _ in range(20):
        value = gap + s * (m0 + s * (c2 + s * c3))
        if value > 0.0:
            low = s
        else:
            high = s
        rate = m0 + s * (2.0 * c2 + 3.0 * s * c3)
        following = s - value / rate if rate < 0.0 else 0.5 * (low + high)
        if not low < following < high:
            following = 0.5 * (low + high)
        change = abs(following - s)
        s = following
        if change < 1e-4:  # Newton: the error is then of the order of its square
            break
    return h * s


@in_lanes
def last_stretch(gap, slope, curvature, h):
    """Return whether a gap's zero is so near that a Taylor step there is exact to rounding, and the time to it."""
    falling = slope < 0.0
    first = -gap / (slope if falling else -1.0)
    bend = first * curvature / (slope if falling else -1.0)
    # What is left out is of the order of the bend's square and of the third power of the time.
    near = falling & (abs(first) <= LAST_STRETCH * h) & (bend * bend * abs(first) <= 0.1 * TIME_ZERO)
    return near, first - 0.5 * bend * first if near else first


@in_lanes
def taylor_step(plant, side, x, v, a, contact, curvature, dt, int_v2, int_fv):
    """Return x, the integral of v^2 and that of the contact force's power after a Taylor step of length dt in slip."""
    excitation = plant.excitation
    place = excitation.lab_position(x)
    w = excitation.lab_velocity(v)
    b = excitation.lab_acceleration(a)
    contact_slope = side * curvature + 2.0 * plant.beta * b + restoring_slope(plant, place) * w
    if excitation.acts():
        drive, restoring, _ = partial_time_derivatives(plant, place)
        contact_slope = contact_slope - drive + restoring
    int_v2 = int_v2 + dt * (w * (w + b * dt))
    int_fv = int_fv + dt * (contact * w + 0.5 * dt * (contact * b + contact_slope * w))
    return x + dt * (v + 0.5 * a * dt), int_v2, int_fv


@compiled
def locate_event(plant, mode, state, drive, h, surface, t, looked, look):
    """Find where in (0, h] a gap falls through zero: Newton in a bracket, from a guess t.

    If ``looked`` is 1, ``look`` is what :func:`look_at` gives there. The last tiny part of the way is a Taylor step.
    """
    low = 0.0
    high = h
    dt = 0.0
    for _ in range(80):
        if looked == 0.0:
            look = look_at(plant, mode, state, drive, t, surface)
        looked = 0.0
        if look.gap > 0.0:
            low = t
        else:
            high = t
        near, following = last_stretch(look.gap, look.slope, look.curvature, h)
        dt = 0.5 * (low + high) - t
        if look.slope < 0.0 and low < t + following < high:
            dt = following
        elif near:
            dt = min(max(t + following, low), high) - t
        if near or high - low < TIME_ZERO:
            break
        t = t + dt
    then = at_time(plant, t)
    curvature = look.curvature
    if surface.at_rest:
        curvature = then.excitation.lab_gap(-surface.side, 0.0, 0.0, curvature)[2]
    x, int_v2, int_fv = taylor_step(
        then, surface.side, look.x, look.v, look.a, look.contact, curvature, dt, look.int_v2, look.int_fv
    )
    return Arrival(t + dt, x, look.a, int_v2, int_fv)


@compiled
def _normal_force_at(plant, x):
    return normal_force(plant, plant.excitation.lab_position(x))


@compiled
def contact_loss_time(plant, mode, state, drive, high):
    """Return the time in (0, high] at which the normal force falls to zero."""
    low = 0.0
    for _ in range(60):
        if high - low < TIME_ZERO:
            break
        t = 0.5 * (low + high)
        if _normal_force_at(at_time(plant, t), slip_step(plant, mode, state, drive, t).x) > 0.0:
            low = t
        else:
            high = t
    return high


@compiled
def normal_force_vanishes(plant, mode, state, drive, x_end, v_end, h):
    """Whether a modulated spring lets the normal force dip to zero within a step at whose ends it is above.

    Return this, and the time by which contact is lost if so, else h.
    """
    if not plant.excitation.modulates_spring():
        return False, h
    falls = normal_force_rate(plant, state.x, state.v) < 0.0
    if not (falls and normal_force_rate(at_time(plant, h), x_end, v_end) > 0.0):
        return False, h
    low = 0.0
    high = h
    for _ in range(50):
        middle = 0.5 * (low + high)
        step = slip_step(plant, mode, state, drive, middle)
        then = at_time(plant, middle)
        if _normal_force_at(then, step.x) <= 0.0:
            return True, middle
        if normal_force_rate(then, step.x, step.v) < 0.0:
            low = middle
        else:
            high = middle
    return False, h


@compiled
def find_switching(plant, mode, state, drive, x_end, v_end, h):
    """Look for the first time in a step of length h at which x falls through zero, where that switches the field.

    Return whether there is one, the time, v, and the integrals of v^2 and of the contact force's power.
    """
    if not plant.spring.switches():
        return False, h, v_end, 0.0, 0.0
    side = plant.spring.side()
    excitation = plant.excitation
    at_end = excitation.at_time(h)
    gap = side * excitation.lab_position(state.x)
    gap_end = side * at_end.lab_position(x_end)
    rises = side * excitation.lab_velocity(state.v) > 0.0
    turned = side * at_end.lab_velocity(v_end) > 0.0
    leaves = gap_end < -SIDE_ZERO or (gap > SIDE_ZERO and gap_end <= (0.0 if turned else SIDE_ZERO))
    low = 0.0
    high = h
    if (rises and not turned and leaves and gap <= SIDE_ZERO) or (not rises and turned and not leaves):
        # From zero up and back, or down and up again: it turns in between, at the gap's extreme.
        first = 0.0
        last = h
        for _ in range(60):
            middle = 0.5 * (first + last)
            step = slip_step(plant, mode, state, drive, middle)
            if (side * excitation.at_time(middle).lab_velocity(step.v) > 0.0) == rises:
                first = middle
            else:
                last = middle
        if rises:
            low = last
        else:
            high = last
            step = slip_step(plant, mode, state, drive, high)
            leaves = side * excitation.at_time(high).lab_position(step.x) < -SIDE_ZERO
    if not leaves:
        return False, h, v_end, 0.0, 0.0
    t = 0.5 * (low + high)
    step = slip_step(plant, mode, state, drive, t)
    for _ in range(100):
        then = excitation.at_time(t)
        gap = side * then.lab_position(step.x)
        slope = side * then.lab_velocity(step.v)
        if gap > 0.0:
            low = t
        else:
            high = t
        if abs(gap) <= 0.1 * SIDE_ZERO or high - low < 0.01 * TIME_ZERO:
            break
        following = t - gap / slope if slope < 0.0 else 0.5 * (low + high)
        if not low < following < high:
            following = 0.5 * (low + high)
        t = following
        step = slip_step(plant, mode, state, drive, t)
    return True, t, step.v, step.int_v2, step.int_fv


@in_lanes
def leaps_over_layer(width, gap, gap_end, slope, slope_end, h):
    """Whether a slip step is so long that its stages may miss how sharply friction falls next to the belt's speed.

    A law with such a layer changes over a gap of its width, and further out over one as wide as the gap.
    """
    reach = h * max(abs(slope), abs(slope_end))
    nearest = min(gap, gap_end)
    if slope < 0.0 < slope_end:
        nearest = nearest - 0.25 * reach
    return (width > 0.0) & (reach > LAYER_REACH * (max(nearest, 0.0) + width))
