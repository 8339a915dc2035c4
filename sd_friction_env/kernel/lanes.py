"""Passes over lanes: what many environments do in one interval, side by side in vector instructions.

In a block every environment takes one slip step over the whole interval, whether it slips or not; those that stick are
stepped side by side too, and so are those that turn, those that land, and those that leave the stick surface and slip
on. What is more involved (two events, a step that must be refined) is followed by the automaton, one by one. A pass
finishes a lane only where the automaton would have done the very same arithmetic, so that both give the same bits.
"""

from sd_friction_env.kernel.automaton import follow
from sd_friction_env.kernel.codes import (
    BREAKAWAY,
    OK,
    SIDE_ZERO,
    STICK,
    STIFF,
    SWITCHING,
    TOLERANCE,
    UNKNOWN,
    V_REL_ZERO,
)
from sd_friction_env.kernel.compilation import compiled, in_lanes
from sd_friction_env.kernel.events import (
    Look,
    event_function,
    hermite_root_estimate,
    last_stretch,
    leaps_over_layer,
    may_cross_twice,
    taylor_step,
)
from sd_friction_env.kernel.forces import breakaway_mode, mode_at_zero_v_rel, normal_force
from sd_friction_env.kernel.plant import Drive, State, at_time, drive_at, select_field
from sd_friction_env.kernel.rows import (
    FINISHED,
    LANDED,
    LANE_A,
    LANE_A_BELT,
    LANE_A_END,
    LANE_BELT,
    LANE_BELT_END,
    LANE_DONE,
    LANE_ERROR,
    LANE_EVENTS,
    LANE_INT_FV,
    LANE_INT_V2,
    LANE_MODE,
    LANE_NORMAL,
    LANE_PLANT,
    LANE_STATUS,
    LANE_STICK_TIME,
    LANE_T_END,
    LANE_U,
    LANE_V,
    LANE_V_END,
    LANE_X,
    LANE_X_END,
    LANE_X_MAX,
    LANE_X_MIN,
    LOOK_A,
    LOOK_ACCELERATION,
    LOOK_CONTACT,
    LOOK_CURVATURE,
    LOOK_GAP,
    LOOK_INT_FV,
    LOOK_INT_V2,
    LOOK_LANDS,
    LOOK_LANE,
    LOOK_LEVEL,
    LOOK_MODE,
    LOOK_RATE,
    LOOK_SIDE,
    LOOK_SLOPE,
    LOOK_TIME,
    LOOK_V,
    LOOK_X,
    ONWARD_EVENTS,
    ONWARD_FV_THERE,
    ONWARD_INT_FV,
    ONWARD_INT_V2,
    ONWARD_NORMAL,
    ONWARD_OUTCOME,
    ONWARD_STICK_TIME,
    ONWARD_TIME,
    ONWARD_V2_THERE,
    ONWARD_V_END,
    ONWARD_X_END,
    ONWARD_X_EVENT,
    ONWARD_X_MAX,
    ONWARD_X_MIN,
    OPEN,
    STRIDE,
)
from sd_friction_env.kernel.runge_kutta import SlipStep, slip_step_in_lanes
from sd_friction_env.kernel.slip import UNTRIED, Trial
from sd_friction_env.kernel.stick import cone_excess, ride, stick_leg


@in_lanes
def _state(w, i):
    return State(w[LANE_X * STRIDE + i], w[LANE_V * STRIDE + i])


@in_lanes
def _drive(w, i):
    return Drive(w[LANE_BELT * STRIDE + i], w[LANE_A_BELT * STRIDE + i], w[LANE_U * STRIDE + i])


@in_lanes
def _stays_open(gap, slope, gap_end, slope_end, h):
    """Whether :func:`may_cross_twice` is sure to be false, without a division and with a margin for its rounding."""
    width = slope - slope_end
    meeting = gap * width + slope * (gap_end - gap - slope_end * h)
    return (slope >= 0.0) | (slope_end <= 0.0) | (meeting < 1e-12 * width)


@in_lanes
def _stays_on_side(plant, x, x_end):
    """Whether both places are on the side of x = 0 to which the plant's field is frozen, if any."""
    if not plant.spring.switches():
        return True
    side = plant.spring.side()
    return (side * x > SIDE_ZERO) & (side * x_end > SIDE_ZERO)


@in_lanes
def slip_lane(plant, w, i, interval):
    """Slip one lane over the whole interval in one step; mark it done if there is nothing else to it."""
    state = _state(w, i)
    drive = _drive(w, i)
    x, v = state
    belt, a_belt, _ = drive
    plant = select_field(plant, x, v)
    mode = 1.0 if v > belt else -1.0
    side = 1.0 if v > 0.0 else -1.0
    x_end, v_end, a, a_end, error, int_v2, int_fv = slip_step_in_lanes(plant, mode, state, drive, interval)
    belt_end = belt + a_belt * interval
    gap = mode * (v - belt)
    gap_end = mode * (v_end - belt_end)
    slope = mode * (a - a_belt)
    slope_end = mode * (a_end - a_belt)
    normal = normal_force(plant, x_end)
    done = (error <= TOLERANCE * interval) & (gap > V_REL_ZERO) & (gap_end > V_REL_ZERO) & (v * v_end > 0.0)
    done = done & _stays_open(gap, slope, gap_end, slope_end, interval)
    done = done & _stays_open(side * v, side * a, side * v_end, side * a_end, interval)
    done = done & (normal > 0.0) & (normal_force(plant, x) > 0.0) & _stays_on_side(plant, x, x_end)
    done = done & (not leaps_over_layer(plant.friction.layer_width(mode), gap, gap_end, slope, slope_end, interval))
    w[LANE_X_END * STRIDE + i] = x_end
    w[LANE_V_END * STRIDE + i] = v_end
    w[LANE_BELT_END * STRIDE + i] = belt_end
    w[LANE_MODE * STRIDE + i] = mode
    w[LANE_EVENTS * STRIDE + i] = 0.0
    w[LANE_STATUS * STRIDE + i] = 0.0
    w[LANE_INT_V2 * STRIDE + i] = int_v2
    w[LANE_STICK_TIME * STRIDE + i] = 0.0
    w[LANE_INT_FV * STRIDE + i] = 0.0 + int_fv
    w[LANE_X_MIN * STRIDE + i] = x_end if x_end < x else x
    w[LANE_X_MAX * STRIDE + i] = x_end if x_end > x else x
    w[LANE_NORMAL * STRIDE + i] = normal
    w[LANE_DONE * STRIDE + i] = 1.0 if done else 0.0
    w[LANE_A * STRIDE + i] = a
    w[LANE_A_END * STRIDE + i] = a_end
    w[LANE_ERROR * STRIDE + i] = error


@in_lanes
def _cone_side_holds(plant, side, x, drive, interval):
    excess, slope = cone_excess(plant, side, x, drive, 0.0)
    excess_end, slope_end = cone_excess(plant, side, x, drive, interval)
    return (excess <= 0.0) & (excess_end <= 0.0) & _stays_open(-excess, -slope, -excess_end, -slope_end, interval)


@in_lanes
def _rides(plant, x, drive, t):
    """Whether a mass at x that moves with the belt is sure to stick for a time t, seen in one piece.

    Return this, x after that time, and the integrals of v^2 and of the contact force's power over it.
    """
    belt, a_belt, _ = drive
    plant = select_field(plant, x, belt)
    belt_end = belt + a_belt * t
    reach = 0.124 * plant.spring.length_scale()
    holds = (abs(belt) * t <= reach) & (abs(belt_end) * t <= reach) & (belt * belt_end >= 0.0)
    holds = holds & _cone_side_holds(plant, -1, x, drive, t)
    holds = holds & _cone_side_holds(plant, 1, x, drive, t)
    dx, int_v2, int_fv = ride(plant, x, drive, t)
    holds = holds & _stays_on_side(plant, x, x + dx)
    return holds, x + dx, int_v2, int_fv


@in_lanes
def stick_lane(plant, w, i, interval):
    """Let one lane ride with the belt over the whole interval; mark it done if it does so in one piece."""
    x = w[LANE_X * STRIDE + i]
    drive = _drive(w, i)
    holds, x_end, int_v2, int_fv = _rides(plant, x, drive, interval)
    done = holds & (normal_force(plant, x) > 0.0)
    w[LANE_X_END * STRIDE + i] = x_end
    w[LANE_BELT_END * STRIDE + i] = drive.v_belt + drive.a_belt * interval
    w[LANE_INT_V2 * STRIDE + i] = int_v2
    w[LANE_INT_FV * STRIDE + i] = 0.0 + int_fv
    w[LANE_X_MIN * STRIDE + i] = x_end if x_end < x else x
    w[LANE_X_MAX * STRIDE + i] = x_end if x_end > x else x
    w[LANE_NORMAL * STRIDE + i] = normal_force(plant, x_end)
    w[LANE_DONE * STRIDE + i] = 1.0 if done else 0.0


@in_lanes
def look_lane(plant, w, i, interval):
    """Look at the place where one lane's slip step is thought to land or to turn, and finish what is plain."""
    state = _state(w, i)
    drive = _drive(w, i)
    x, v = state
    belt, a_belt, u = drive
    plant = select_field(plant, x, v)
    mode = w[LOOK_MODE * STRIDE + i]
    t = w[LOOK_TIME * STRIDE + i]
    surface_side = w[LOOK_SIDE * STRIDE + i]
    x_t, v_t, _, _, _, dv2, dfv = slip_step_in_lanes(plant, mode, state, drive, t)
    gap, slope, curvature, a_t, contact = event_function(
        plant, mode, x_t, v_t, drive, t, surface_side, w[LOOK_LEVEL * STRIDE + i], w[LOOK_RATE * STRIDE + i]
    )
    w[LOOK_GAP * STRIDE + i] = gap
    w[LOOK_SLOPE * STRIDE + i] = slope
    w[LOOK_CURVATURE * STRIDE + i] = curvature
    w[LOOK_X * STRIDE + i] = x_t
    w[LOOK_V * STRIDE + i] = v_t
    w[LOOK_ACCELERATION * STRIDE + i] = a_t
    w[LOOK_CONTACT * STRIDE + i] = contact
    w[LOOK_INT_V2 * STRIDE + i] = dv2
    w[LOOK_INT_FV * STRIDE + i] = dfv
    # What is plain to see from there is finished here, by the arithmetic of locate_event, slip_until_event and follow.
    near, dt = last_stretch(gap, slope, curvature, interval)
    event_time = t + dt
    inside = (event_time > (t if gap > 0.0 else 0.0)) & (event_time < (interval if gap > 0.0 else t))
    x_event, dv2, dfv = taylor_step(plant, surface_side, x_t, v_t, a_t, contact, curvature, dt, dv2, dfv)
    done = near & inside & (normal_force(plant, x) > 0.0) & (normal_force(plant, x_event) > 0.0)
    # It turns, or it lands (without having turned) and sticks for the rest of the interval.
    side = 1.0 if v > 0.0 else -1.0
    belt_event = belt + a_belt * event_time
    lands = w[LOOK_LANDS * STRIDE + i] == 1.0
    straight = v * belt_event > 0.0
    straight = straight & _stays_open(
        side * v, side * w[LOOK_A * STRIDE + i], side * belt_event, side * a_t, event_time
    )
    rest = interval - event_time
    holds, x_end, stick_v2, stick_fv = _rides(plant, x_event, Drive(belt_event, a_belt, u), rest)
    done = done & ((straight & (rest > 0.0)) | (not lands)) & _stays_on_side(plant, x, x_event)
    w[ONWARD_OUTCOME * STRIDE + i] = (FINISHED if holds | (not lands) else LANDED) if done else OPEN
    w[ONWARD_TIME * STRIDE + i] = event_time
    w[ONWARD_V2_THERE * STRIDE + i] = dv2
    w[ONWARD_FV_THERE * STRIDE + i] = dfv
    w[ONWARD_X_EVENT * STRIDE + i] = x_event
    w[ONWARD_X_END * STRIDE + i] = x_end
    w[ONWARD_INT_V2 * STRIDE + i] = dv2 + stick_v2
    w[ONWARD_STICK_TIME * STRIDE + i] = 0.0 + rest
    w[ONWARD_INT_FV * STRIDE + i] = 0.0 + dfv + stick_fv
    low = x_event if x_event < x else x
    high = x_event if x_event > x else x
    w[ONWARD_X_MIN * STRIDE + i] = x_end if x_end < low else low
    w[ONWARD_X_MAX * STRIDE + i] = x_end if x_end > high else high
    w[ONWARD_NORMAL * STRIDE + i] = normal_force(plant, x_end)


@in_lanes
def onward_lane(plant, w, i):
    """Slip one lane, which has just left the stick surface, over the rest of its interval in one step."""
    x = w[LANE_X * STRIDE + i]
    v = w[LANE_V * STRIDE + i]
    a_belt = w[LANE_A_BELT * STRIDE + i]
    plant = select_field(plant, x, v)
    mode = w[LOOK_MODE * STRIDE + i]
    rest = w[LOOK_TIME * STRIDE + i]
    x_end, v_end, a, a_end, error, int_v2, int_fv = slip_step_in_lanes(
        plant, mode, State(x, v), Drive(v, a_belt, w[LANE_U * STRIDE + i]), rest
    )
    gap_end = mode * (v_end - (v + a_belt * rest))
    slope = mode * (a - a_belt)
    slope_end = mode * (a_end - a_belt)
    normal = normal_force(plant, x_end)
    side = 1.0 if v > 0.0 else -1.0
    done = (error <= TOLERANCE * rest) & (gap_end > 2.0 * V_REL_ZERO) & (v * v_end > 0.0) & (normal > 0.0)
    done = done & _stays_open(0.0, slope, gap_end, slope_end, rest)
    done = done & _stays_open(side * v, side * a, side * v_end, side * a_end, rest) & _stays_on_side(plant, x, x_end)
    done = done & (not leaps_over_layer(plant.friction.layer_width(mode), 0.0, gap_end, slope, slope_end, rest))
    low = w[ONWARD_X_MIN * STRIDE + i]
    high = w[ONWARD_X_MAX * STRIDE + i]
    w[ONWARD_OUTCOME * STRIDE + i] = FINISHED if done else OPEN
    w[ONWARD_X_END * STRIDE + i] = x_end
    w[ONWARD_V_END * STRIDE + i] = v_end
    w[ONWARD_INT_V2 * STRIDE + i] = w[ONWARD_V2_THERE * STRIDE + i] + (0.0 + int_v2)
    w[ONWARD_INT_FV * STRIDE + i] = w[ONWARD_FV_THERE * STRIDE + i] + (0.0 + int_fv)
    w[ONWARD_X_MIN * STRIDE + i] = x_end if x_end < low else low
    w[ONWARD_X_MAX * STRIDE + i] = x_end if x_end > high else high
    w[ONWARD_NORMAL * STRIDE + i] = normal


# What goes to another pass, and what comes of it. The second work space is ``sub``. -----------------------------------


@compiled
def gather(w, i, sub, n, one_plant):
    """Copy what goes into lane i to lane n of the second work space."""
    rows = len(w) // STRIDE
    for row in range(LANE_U, LANE_BELT + 1):
        sub[row * STRIDE + n] = w[row * STRIDE + i]
    for row in range(rows if one_plant else LANE_PLANT, rows):
        sub[row * STRIDE + n] = w[row * STRIDE + i]


@compiled
def scatter_stuck(sub, n, w, i, interval):
    """Copy what came of a stuck lane n of the second work space to lane i."""
    for row in (LANE_X_END, LANE_BELT_END, LANE_INT_V2, LANE_INT_FV, LANE_X_MIN, LANE_X_MAX, LANE_NORMAL, LANE_DONE):
        w[row * STRIDE + i] = sub[row * STRIDE + n]
    w[LANE_V_END * STRIDE + i] = sub[LANE_BELT_END * STRIDE + n]
    w[LANE_MODE * STRIDE + i] = STICK
    w[LANE_EVENTS * STRIDE + i] = 0.0
    w[LANE_STATUS * STRIDE + i] = OK
    w[LANE_STICK_TIME * STRIDE + i] = interval


@in_lanes
def scatter_onward(w, i, sub, n):
    """Copy to lane i what lane n of the second work space came to."""
    w[LANE_X_END * STRIDE + i] = sub[ONWARD_X_END * STRIDE + n]
    w[LANE_INT_V2 * STRIDE + i] = sub[ONWARD_INT_V2 * STRIDE + n]
    w[LANE_STICK_TIME * STRIDE + i] = sub[ONWARD_STICK_TIME * STRIDE + n]
    w[LANE_INT_FV * STRIDE + i] = sub[ONWARD_INT_FV * STRIDE + n]
    w[LANE_X_MIN * STRIDE + i] = sub[ONWARD_X_MIN * STRIDE + n]
    w[LANE_X_MAX * STRIDE + i] = sub[ONWARD_X_MAX * STRIDE + n]
    w[LANE_NORMAL * STRIDE + i] = sub[ONWARD_NORMAL * STRIDE + n]


@in_lanes
def scatter_finished(w, i, sub, n):
    """Whether lane n of the second work space finished lane i's step; if so, copy what came out."""
    if sub[ONWARD_OUTCOME * STRIDE + n] != FINISHED:
        return False
    if sub[LOOK_LANDS * STRIDE + n] == 0.0:
        x_turn = sub[ONWARD_X_EVENT * STRIDE + n]
        w[LANE_X_MIN * STRIDE + i] = min(w[LANE_X_MIN * STRIDE + i], x_turn)
        w[LANE_X_MAX * STRIDE + i] = max(w[LANE_X_MAX * STRIDE + i], x_turn)
        return True
    scatter_onward(w, i, sub, n)
    w[LANE_V_END * STRIDE + i] = w[LANE_BELT_END * STRIDE + i]
    w[LANE_MODE * STRIDE + i] = STICK
    w[LANE_EVENTS * STRIDE + i] = 1.0
    return True


@compiled
def _queue_onward(w, i, sub, n, one_plant, interval, t, x, mode, n_events, stick_time, int_v2, int_fv, x_min, x_max):
    """Queue the rest of lane i's slip, from x at time t, in lane n, with what it has gathered."""
    belt = w[LANE_BELT * STRIDE + i] + w[LANE_A_BELT * STRIDE + i] * t
    gather(w, i, sub, n, one_plant)
    sub[LANE_X * STRIDE + n] = x
    sub[LANE_V * STRIDE + n] = belt
    sub[LOOK_TIME * STRIDE + n] = interval - t
    sub[LOOK_MODE * STRIDE + n] = mode
    sub[LOOK_LANE * STRIDE + n] = i
    sub[ONWARD_EVENTS * STRIDE + n] = n_events
    sub[ONWARD_STICK_TIME * STRIDE + n] = stick_time
    sub[ONWARD_V2_THERE * STRIDE + n] = 0.0 + int_v2
    sub[ONWARD_FV_THERE * STRIDE + n] = 0.0 + int_fv
    sub[ONWARD_X_MIN * STRIDE + n] = x_min
    sub[ONWARD_X_MAX * STRIDE + n] = x_max


@compiled
def queue_crossing(plant, w, i, sub, j, n, one_plant, interval):
    """Whether lane i, whose landing was looked at in lane j, goes on slipping; if so, queue it in lane n (<= j)."""
    if sub[ONWARD_OUTCOME * STRIDE + j] != LANDED:
        return False
    x = w[LANE_X * STRIDE + i]
    x_event = sub[ONWARD_X_EVENT * STRIDE + j]
    t = sub[ONWARD_TIME * STRIDE + j]
    mode = mode_at_zero_v_rel(plant, x_event, drive_at(_drive(w, i), t))
    if mode == STICK:
        return False
    int_v2 = sub[ONWARD_V2_THERE * STRIDE + j]
    int_fv = sub[ONWARD_FV_THERE * STRIDE + j]
    low = min(x, x_event)
    high = max(x, x_event)
    _queue_onward(w, i, sub, n, one_plant, interval, t, x_event, mode, 1, 0.0, int_v2, int_fv, low, high)
    return True


@compiled
def queue_breakaway(plant, w, i, sub, n, one_plant, interval):
    """Whether lane i, which moves with the belt, goes on slipping; if so, queue it in lane n.

    If it sticks to the end, its step is finished here. Nothing is done where contact is lost at once or nothing of the
    interval is left.
    """
    x = w[LANE_X * STRIDE + i]
    drive = _drive(w, i)
    if normal_force(plant, x) <= 0.0:
        return False
    mode = mode_at_zero_v_rel(plant, x, drive)
    if mode != STICK:
        _queue_onward(w, i, sub, n, one_plant, interval, 0.0, x, mode, 0, 0.0, 0.0, 0.0, x, x)
        return True
    leg = stick_leg(plant, x, drive, interval)
    if leg.event == BREAKAWAY:
        if leg.time >= interval:
            return False
        mode = breakaway_mode(plant, leg.x, drive_at(drive, leg.time))
        _queue_onward(
            w,
            i,
            sub,
            n,
            one_plant,
            interval,
            leg.time,
            leg.x,
            mode,
            1,
            leg.time,
            leg.int_v2,
            leg.int_fv,
            leg.x_min,
            leg.x_max,
        )
        return True
    if leg.event == SWITCHING:
        return False
    w[LANE_X_END * STRIDE + i] = leg.x
    w[LANE_V_END * STRIDE + i] = w[LANE_BELT_END * STRIDE + i]
    w[LANE_MODE * STRIDE + i] = STICK
    w[LANE_EVENTS * STRIDE + i] = 0.0
    w[LANE_STATUS * STRIDE + i] = OK
    w[LANE_INT_V2 * STRIDE + i] = 0.0 + leg.int_v2
    w[LANE_STICK_TIME * STRIDE + i] = interval
    w[LANE_INT_FV * STRIDE + i] = 0.0 + leg.int_fv
    w[LANE_X_MIN * STRIDE + i] = leg.x_min
    w[LANE_X_MAX * STRIDE + i] = leg.x_max
    w[LANE_NORMAL * STRIDE + i] = normal_force(plant, leg.x)
    w[LANE_DONE * STRIDE + i] = 1.0
    return False


@compiled
def queue_look(plant, w, i, sub, n, interval, one_plant):
    """Whether the slip step of lane i lands or turns in the plainest way; if so, queue a look at it in lane n.

    The tests are those of :func:`slip_until_event`.
    """
    x = w[LANE_X * STRIDE + i]
    v = w[LANE_V * STRIDE + i]
    belt = w[LANE_BELT * STRIDE + i]
    a_belt = w[LANE_A_BELT * STRIDE + i]
    a = w[LANE_A * STRIDE + i]
    a_end = w[LANE_A_END * STRIDE + i]
    v_end = w[LANE_V_END * STRIDE + i]
    mode = 1 if v > belt else -1
    gap = mode * (v - belt)
    gap_end = mode * (v_end - (belt + a_belt * interval))
    slope = mode * (a - a_belt)
    slope_end = mode * (a_end - a_belt)
    allowed = TOLERANCE * interval * max(1.0, abs(x), abs(v), STIFF * abs(a))
    if not w[LANE_ERROR * STRIDE + i] <= allowed or gap <= V_REL_ZERO:
        return False
    if leaps_over_layer(plant.friction.layer_width(mode), gap, gap_end, slope, slope_end, interval):
        return False
    if not _stays_on_side(select_field(plant, x, v), x, w[LANE_X_END * STRIDE + i]):
        return False
    lands = gap_end <= 0.0
    if lands:
        t = hermite_root_estimate(gap, slope, gap_end, slope_end, interval)
        side, level, rate = mode, belt, a_belt
    elif v * v_end < 0.0 and gap_end > V_REL_ZERO and not may_cross_twice(gap, slope, gap_end, slope_end, interval):
        side, level, rate = 1 if v > 0.0 else -1, 0.0, 0.0
        t = hermite_root_estimate(side * v, side * a, side * v_end, side * a_end, interval)
    else:
        return False
    gather(w, i, sub, n, one_plant)
    sub[LOOK_TIME * STRIDE + n] = t
    sub[LOOK_SIDE * STRIDE + n] = side
    sub[LOOK_LEVEL * STRIDE + n] = level
    sub[LOOK_RATE * STRIDE + n] = rate
    sub[LOOK_MODE * STRIDE + n] = mode
    sub[LOOK_LANE * STRIDE + n] = i
    sub[LOOK_LANDS * STRIDE + n] = 1.0 if lands else 0.0
    sub[LOOK_A * STRIDE + n] = a
    return True


@in_lanes
def write_lane(plant, w, i, stride, end):
    """Write the end of a motion to a lane. Return 1 if it has a status other than OK, else 0."""
    w[LANE_X_END * stride + i] = end.x
    w[LANE_V_END * stride + i] = end.v
    w[LANE_BELT_END * stride + i] = end.v_belt
    w[LANE_MODE * stride + i] = end.mode
    w[LANE_EVENTS * stride + i] = end.n_events
    w[LANE_STATUS * stride + i] = end.status
    w[LANE_INT_V2 * stride + i] = end.int_v2
    w[LANE_STICK_TIME * stride + i] = end.stick_time
    w[LANE_INT_FV * stride + i] = end.int_fv
    w[LANE_X_MIN * stride + i] = end.x_min
    w[LANE_X_MAX * stride + i] = end.x_max
    w[LANE_NORMAL * stride + i] = normal_force(at_time(plant, end.time), end.x)
    w[LANE_DONE * stride + i] = 1.0
    w[LANE_T_END * stride + i] = end.time
    return 0 if end.status == OK else 1


@compiled
def advance_lane(plant, w, i, interval, trial):
    """Let the automaton follow one lane. Return 1 if it ended with a status other than OK, else 0."""
    return write_lane(plant, w, i, STRIDE, follow(plant, UNKNOWN, _state(w, i), _drive(w, i), interval, None, trial))


@compiled
def advance_after_trial(plant, w, i, sub, n, interval, stage):
    """:func:`advance_lane` for lane i, whose first slip step is taken (stage 1), and its event looked at (stage 2)."""
    if plant.spring.switches() and abs(w[LANE_X * STRIDE + i]) <= SIDE_ZERO:
        return advance_lane(plant, w, i, interval, UNTRIED)
    step = SlipStep(
        w[LANE_X_END * STRIDE + i],
        w[LANE_V_END * STRIDE + i],
        w[LANE_A * STRIDE + i],
        w[LANE_A_END * STRIDE + i],
        w[LANE_ERROR * STRIDE + i],
        w[LANE_INT_V2 * STRIDE + i],
        w[LANE_INT_FV * STRIDE + i],
    )
    look = Look(
        sub[LOOK_GAP * STRIDE + n],
        sub[LOOK_SLOPE * STRIDE + n],
        sub[LOOK_CURVATURE * STRIDE + n],
        sub[LOOK_X * STRIDE + n],
        sub[LOOK_V * STRIDE + n],
        sub[LOOK_ACCELERATION * STRIDE + n],
        sub[LOOK_CONTACT * STRIDE + n],
        sub[LOOK_INT_V2 * STRIDE + n],
        sub[LOOK_INT_FV * STRIDE + n],
    )
    return advance_lane(plant, w, i, interval, Trial(stage, step, sub[LOOK_TIME * STRIDE + n], look))
