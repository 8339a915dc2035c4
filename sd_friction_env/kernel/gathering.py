"""Lanes that need another pass: gathered in a second work space ``sub``, and what comes of them scattered back."""

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
from sd_friction_env.kernel.events import Look, hermite_root_estimate, leaps_over_layer, may_cross_twice
from sd_friction_env.kernel.forces import breakaway_mode, mode_at_zero_v_rel, normal_force
from sd_friction_env.kernel.lanes import drive_in, state_in, stays_on_side
from sd_friction_env.kernel.plant import at_time, drive_at, select_field
from sd_friction_env.kernel.rows import *
from sd_friction_env.kernel.runge_kutta import SlipStep
from sd_friction_env.kernel.slip import UNTRIED, Trial
from sd_friction_env.kernel.stick import stick_leg


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
    """Copy the results of lane n of the second work space, which sticks, to lane i."""
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
    mode = mode_at_zero_v_rel(plant, x_event, drive_at(drive_in(w, i), t))
    if mode == STICK:
        return False
    int_v2 = sub[ONWARD_V2_THERE * STRIDE + j]
    int_fv = sub[ONWARD_FV_THERE * STRIDE + j]
    low = min(x, x_event)
    high = max(x, x_event)
    _queue_onward(w, i, sub, n, one_plant, interval, t, x_event, mode, 1.0, 0.0, int_v2, int_fv, low, high)
    return True


@compiled
def queue_breakaway(plant, w, i, sub, n, one_plant, interval):
    """Whether lane i, which moves with the belt, goes on slipping; if so, queue it in lane n.

    If it sticks to the end, its step is finished here. Nothing is done where contact is lost at once or nothing of the
    interval is left.
    """
    x = w[LANE_X * STRIDE + i]
    drive = drive_in(w, i)
    if normal_force(plant, x) <= 0.0:
        return False
    mode = mode_at_zero_v_rel(plant, x, drive)
    if mode != STICK:
        _queue_onward(w, i, sub, n, one_plant, interval, 0.0, x, mode, 0.0, 0.0, 0.0, 0.0, x, x)
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
            1.0,
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
    if not stays_on_side(select_field(plant, x, v), x, w[LANE_X_END * STRIDE + i]):
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
    return write_lane(
        plant, w, i, STRIDE, follow(plant, UNKNOWN, state_in(w, i), drive_in(w, i), interval, None, trial)
    )


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
