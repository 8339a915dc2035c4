"""A leg of slip, up to the event that ends it."""

from typing import NamedTuple

from sd_friction_env.kernel.codes import (
    CONTACT_LOSS,
    LANDING,
    MAX_EVENTS,
    MAX_SLIP_STEP,
    MIN_SLIP_STEP,
    NO_EVENT,
    SLIP_TRIAL_RATE,
    SLIP_TRIALS,
    STEP_DOUBLING,
    STEP_SIZE_UNDERFLOW,
    STIFF,
    SWITCHING,
    TOLERANCE,
    TURNING,
    V_REL_ZERO,
)
from sd_friction_env.kernel.compilation import compiled
from sd_friction_env.kernel.events import (
    Look,
    Surface,
    contact_loss_time,
    find_double_crossing,
    find_switching,
    hermite_root_estimate,
    leaps_over_layer,
    locate_event,
    may_cross_twice,
    normal_force_vanishes,
)
from sd_friction_env.kernel.forces import normal_force, roundoff_floor, slip_acceleration
from sd_friction_env.kernel.plant import State, at_time, drive_at, select_field, with_spring
from sd_friction_env.kernel.runge_kutta import SlipStep, slip_step


class Trial(NamedTuple):
    """What a slip's first step is known to be before it is taken."""

    stage: float  # 0: nothing, 1: the step over the whole duration, 2: the look at where it lands, or else turns, too
    step: SlipStep
    time: float  # of the look
    look: Look


# Where a slip ends; floats, for numba compiles one more function for each whole number.
TO_EVENT, TO_TURNING = 0.0, 1.0
UNTRIED = Trial(0.0, SlipStep(*(0.0,) * 7), 0.0, Look(*(0.0,) * 9))


class Leg(NamedTuple):
    """A leg of slip or stick up to its event, or to the end of the time asked for."""

    time: float
    event: int
    x: float
    v: float
    int_v2: float  # integral of v^2
    int_fv: float  # and of the contact force's power
    x_min: float
    x_max: float
    trials: float  # trial steps left


@compiled
def select_field_in_slip(plant, mode, state, drive):
    """Freeze the spring's field to a mass's side of x = 0; from rest on it goes where the other forces push."""
    plant = select_field(plant, state.x, state.v)
    if plant.spring.switches() and plant.spring.side() == 0.0:
        side = 1.0 if slip_acceleration(plant, mode, state, drive) >= 0.0 else -1.0
        plant = with_spring(plant, plant.spring.on_side(side))
    return plant


@compiled
def error_bounds(plant, mode, state, v_belt, a, h):
    """Return the estimated error below which a step of h from a state is accepted, and what rounding may amount to."""
    x, v = state
    return TOLERANCE * h * max(1.0, abs(x), abs(v), STIFF * abs(a)), h * roundoff_floor(plant, mode, x, v, v_belt)


@compiled
def slip_until_event(plant, mode, state, drive, duration, until, trials, trial):
    """Slip for ``duration``, or until an event.

    Events: v_rel returns to zero (LANDING), contact is lost (CONTACT_LOSS), v changes sign (TURNING, if ``until`` is
    TO_TURNING), x does where that switches the field (SWITCHING), or the error rule cannot be met in the trial steps
    that are left: ``trials``, and SLIP_TRIAL_RATE more per unit of time (STEP_SIZE_UNDERFLOW). After LANDING v equals
    the belt's speed exactly, after TURNING it is exactly zero.
    """
    plant = select_field_in_slip(plant, mode, state, drive)
    longest = plant.excitation.shortened(1.0, MAX_SLIP_STEP)
    side_of_belt = float(mode)
    layer = plant.friction.layer_width(mode)
    x, v = state
    t = 0.0
    h = min(duration, longest)
    x_min = plant.excitation.lab_position(x)
    x_max = x_min
    int_v2 = 0.0
    int_fv = 0.0
    event = NO_EVENT
    first = True
    while t < duration:
        remaining = duration - t
        h = min(h, remaining)
        here = drive_at(drive, t)
        belt = here.v_belt
        now = at_time(plant, t)
        begin = State(x, v)
        trials -= 1.0
        looked = first and trial.stage == 2.0
        if first and trial.stage > 0.0:
            step = trial.step
        else:
            step = slip_step(now, mode, begin, here, h)
        first = False
        a, a_end, error = step.a, step.a_end, step.error
        allowed, noise = error_bounds(now, mode, begin, belt, a, h)
        gap = mode * (v - belt)
        gap_end = mode * (step.v - (belt + here.a_belt * h))
        slope = mode * (a - here.a_belt)
        slope_end = mode * (a_end - here.a_belt)
        # "not" lets a NaN shrink the step too
        if not error <= max(allowed, noise) or leaps_over_layer(layer, gap, gap_end, slope, slope_end, h):
            h = 0.5 * h
            if h < MIN_SLIP_STEP or trials + SLIP_TRIAL_RATE * t < 0.0:
                event = STEP_SIZE_UNDERFLOW
                break
            continue
        length = h
        x_end, v_end, dv2, dfv = step.x, step.v, step.int_v2, step.int_fv

        to_belt = Surface(side_of_belt, belt, here.a_belt, False)
        if gap > V_REL_ZERO:
            lands = gap_end <= 0.0
        else:  # it has just left the stick surface
            lands = gap_end < -V_REL_ZERO
        guess = trial.time
        zero = now.excitation.v_rel_zero(belt)
        away = gap > zero or slope_end < 0.0 <= slope
        if not lands and away and gap_end <= zero:
            v_end = belt + here.a_belt * h  # it lands with the step's end, but for rounding
            event = LANDING
        elif lands:
            if not looked:
                guess = hermite_root_estimate(gap, slope, gap_end, slope_end, h)
        elif may_cross_twice(gap, slope, gap_end, slope_end, h):
            lands, length = find_double_crossing(now, mode, begin, here, h, to_belt, slope, slope_end)
            guess = 0.5 * length
            length = length if lands else h
        if lands:
            arrival = locate_event(now, mode, begin, here, length, to_belt, guess, 1.0 if looked else 0.0, trial.look)
            length, x_end, a_end, dv2, dfv = arrival
            v_end = belt + here.a_belt * length
            event = LANDING

        switches, t_switch, v_switch, dv2_switch, dfv_switch = find_switching(
            now, mode, begin, here, x_end, v_end, length
        )
        if switches:
            length, v_end, dv2, dfv = t_switch, v_switch, dv2_switch, dfv_switch
            then = at_time(now, length)
            x_end = then.excitation.belt_frame_origin()
            a_end = slip_acceleration(then, mode, State(x_end, v_end), drive_at(here, length))
            event = SWITCHING

        turns = False
        bracket = length
        at_end = now.excitation.at_time(length)
        w = now.excitation.lab_velocity(v)
        w_end = at_end.lab_velocity(v_end)
        b = now.excitation.lab_acceleration(a)
        b_end = at_end.lab_acceleration(a_end)
        side = 1.0 if w > 0.0 else -1.0
        to_rest = Surface(side, 0.0, 0.0, True)
        if w * w_end < 0.0:
            turns = True
            if lands or not looked:
                guess = hermite_root_estimate(side * w, side * b, side * w_end, side * b_end, length)
        elif w != 0.0 and may_cross_twice(side * w, side * b, side * w_end, side * b_end, length):
            turns, bracket = find_double_crossing(now, mode, begin, here, length, to_rest, side * b, side * b_end)
            guess = 0.5 * bracket
        if turns:
            turn = locate_event(
                now, mode, begin, here, bracket, to_rest, guess, 1.0 if looked and not lands else 0.0, trial.look
            )
            then = at_time(now, turn.time)
            place = then.excitation.lab_position(turn.x)
            x_min = min(x_min, place)
            x_max = max(x_max, place)
            if until == TO_TURNING or normal_force(then, place) <= 0.0:
                length, x_end, dv2, dfv = turn.time, turn.x, turn.int_v2, turn.int_fv
                v_end = then.excitation.belt_frame_velocity(0.0)
                event = TURNING

        # N falls with |x|: it is least at a turning point or at the end of the step, unless the spring is modulated.
        end = at_time(now, length)
        vanishes, t_contact = normal_force_vanishes(now, mode, begin, here, x_end, v_end, length)
        if vanishes or normal_force(end, end.excitation.lab_position(x_end)) <= 0.0:
            length = contact_loss_time(now, mode, begin, here, t_contact)
            step = slip_step(now, mode, begin, here, length)
            x_end, v_end, error, dv2, dfv = step.x, step.v, step.error, step.int_v2, step.int_fv
            event = CONTACT_LOSS
            if (gap > V_REL_ZERO or slope > 0.0) and mode * (v_end - (belt + here.a_belt * length)) < 0.0:
                # It lands before.
                arrival = locate_event(now, mode, begin, here, length, to_belt, 0.5 * length, 0.0, trial.look)
                length, x_end, a_end, dv2, dfv = arrival
                v_end = belt + here.a_belt * length
                event = LANDING

        t = duration if event == NO_EVENT and h == remaining else t + length
        x = x_end
        v = v_end
        place = plant.excitation.at_time(t).lab_position(x)
        x_min = min(x_min, place)
        x_max = max(x_max, place)
        int_v2 += dv2
        int_fv += dfv
        if event != NO_EVENT:
            break
        if trials + SLIP_TRIAL_RATE * t < 0.0:
            event = STEP_SIZE_UNDERFLOW
            break
        if error < max(STEP_DOUBLING * allowed, noise):
            h = min(2.0 * h, longest)
    if event == NO_EVENT:
        belt = drive.v_belt + drive.a_belt * duration
        if mode * (v - belt) <= V_REL_ZERO:
            v = belt
    return Leg(t, event, x, v, int_v2, int_fv, x_min, x_max, trials + SLIP_TRIAL_RATE * t)


@compiled
def slip_across(plant, mode, state, drive, duration, until):
    """:func:`slip_until_event` that goes on where only the field switches."""
    t = 0.0
    int_v2 = 0.0
    int_fv = 0.0
    x, v = state
    x_min = plant.excitation.lab_position(x)
    x_max = x_min
    event = SWITCHING
    trials = SLIP_TRIALS
    for _ in range(MAX_EVENTS):
        leg = slip_until_event(
            at_time(plant, t),
            mode,
            State(x, v),
            drive_at(drive, t),
            duration - t,
            until,
            trials,
            UNTRIED,
        )
        t += leg.time
        x, v, event, trials = leg.x, leg.v, leg.event, leg.trials
        int_v2 += leg.int_v2
        int_fv += leg.int_fv
        x_min = min(x_min, leg.x_min)
        x_max = max(x_max, leg.x_max)
        if event != SWITCHING:
            break
    return Leg(t, event, x, v, int_v2, int_fv, x_min, x_max, trials)
