"""Passes over lanes: what many environments do in one interval, side by side in vector instructions.

In a block every environment takes one slip step over the whole interval, whether it slips or not; those that stick are
stepped side by side too, and so are those that turn, those that land, and those that leave the stick surface and slip
on. What is more involved (two events, a step that must be refined) is followed by the automaton, one by one. A pass
finishes a lane only where the automaton would have done the very same arithmetic, so that both give the same bits.
"""

from sd_friction_env.kernel.codes import (
    SIDE_ZERO,
    TOLERANCE,
    V_REL_ZERO,
)
from sd_friction_env.kernel.compilation import in_lanes
from sd_friction_env.kernel.events import (
    event_function,
    last_stretch,
    leaps_over_layer,
    taylor_step,
)
from sd_friction_env.kernel.forces import normal_force
from sd_friction_env.kernel.plant import Drive, State, select_field
from sd_friction_env.kernel.rows import *
from sd_friction_env.kernel.runge_kutta import slip_step_in_lanes
from sd_friction_env.kernel.stick import cone_excess, ride


@in_lanes
def state_in(w, i):
    return State(w[LANE_X * STRIDE + i], w[LANE_V * STRIDE + i])


@in_lanes
def drive_in(w, i):
    return Drive(w[LANE_BELT * STRIDE + i], w[LANE_A_BELT * STRIDE + i], w[LANE_U * STRIDE + i])


@in_lanes
def _stays_open(gap, slope, gap_end, slope_end, h):
    """Whether :func:`may_cross_twice` is sure to be false, without a division and with a margin for its rounding."""
    width = slope - slope_end
    meeting = gap * width + slope * (gap_end - gap - slope_end * h)
    return (slope >= 0.0) | (slope_end <= 0.0) | (meeting < 1e-12 * width)


@in_lanes
def stays_on_side(plant, x, x_end):
    """Whether both places are on the side of x = 0 to which the plant's field is frozen, if any."""
    if not plant.spring.switches():
        return True
    side = plant.spring.side()
    return (side * x > SIDE_ZERO) & (side * x_end > SIDE_ZERO)


@in_lanes
def slip_lane(plant, w, i, interval):
    """Slip one lane over the whole interval in one step; mark it done if there is nothing else to it."""
    state = state_in(w, i)
    drive = drive_in(w, i)
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
    done = done & (normal > 0.0) & (normal_force(plant, x) > 0.0) & stays_on_side(plant, x, x_end)
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
    holds = holds & _cone_side_holds(plant, -1.0, x, drive, t)
    holds = holds & _cone_side_holds(plant, 1.0, x, drive, t)
    dx, int_v2, int_fv = ride(plant, x, drive, t)
    holds = holds & stays_on_side(plant, x, x + dx)
    return holds, x + dx, int_v2, int_fv


@in_lanes
def stick_lane(plant, w, i, interval):
    """Let one lane ride with the belt over the whole interval; mark it done if it does so in one piece."""
    x = w[LANE_X * STRIDE + i]
    drive = drive_in(w, i)
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
    state = state_in(w, i)
    drive = drive_in(w, i)
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
    done = done & ((straight & (rest > 0.0)) | (not lands)) & stays_on_side(plant, x, x_event)
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
    done = done & _stays_open(side * v, side * a, side * v_end, side * a_end, rest) & stays_on_side(plant, x, x_end)
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
