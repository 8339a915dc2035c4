"""A motion with its tangents: the derivative of where it ends, and of its averages, by its start, drive and plant.

`follow` goes along the motion and lists its events; the slips and sticks between them are gone through again for the
tangents, so that the automaton stands in one place. At an event a tangent jumps: with f = (v, a) before and after, and
the event where h(x, v, t) = 0, it changes by (f- - f+) dt, dt = -dh/(dh/dt along f-) the change of the event's time.
Leine and Nijmeijer: Dynamics and Bifurcations of Non-Smooth Mechanical Systems (2004), ch. 7.
"""

import math
from typing import NamedTuple

import numpy as np

from sd_friction_env.kernel.automaton import follow
from sd_friction_env.kernel.codes import (
    BREAKAWAY,
    CROSSING,
    EVENT_LIMIT,
    GRAZING,
    MAX_EVENTS,
    MAX_SLIP_STEP,
    NO_EVENT,
    OK,
    RESTICK,
    SIDE_ZERO,
    SLIP_FORWARD,
    STEP_LIMIT,
    STICK,
    SWITCHING,
    UNKNOWN,
)
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.forces import (
    breakaway_mode,
    contact_and_acceleration,
    mode_at_zero_v_rel,
    mode_in_belt_frame,
    normal_slope,
    restoring_slope,
    stick_load,
)
from sd_friction_env.kernel.plant import State, at_time, drive_at, select_field, with_spring
from sd_friction_env.kernel.plant_gradients import contact_gradient, external_gradient, ripple_gradient
from sd_friction_env.kernel.runge_kutta import SlipStages, SlipStep, slip_stages
from sd_friction_env.kernel.slip import UNTRIED, Trial, select_field_in_slip
from sd_friction_env.kernel.stick import cone_excess
from sd_friction_env.kernel.variation import (
    TANGENT_A_BELT,
    TANGENT_BELT,
    TANGENT_FV,
    TANGENT_STICK,
    TANGENT_U,
    TANGENT_V,
    TANGENT_X,
    along,
    carry_in_slip,
    carry_in_stick,
    work_for,
)

_NO_STAGES = SlipStages(SlipStep(*(0.0,) * 7), *((0.0,) * 12,) * 3)
_MOST_CALLS = 256  # of the automaton in one motion, each of MAX_EVENTS events
_SECTION_TIME = 1e-8  # an event this close to the start or the end falls on it
_TOUCH = 1e-8  # a surface met at no more than this rate, or neared this closely, is touched, not passed

# Whether the derivative exists; of several reasons why not, the greatest.
SMOOTH, FROM_BELT, AT_BORDER, TOUCHED = 0, 1, 2, 3
DERIVATIVE_NAMES = {
    SMOOTH: "exists",
    FROM_BELT: "starts on the belt: exists along v = v_belt only",
    AT_BORDER: "one-sided: an event falls on the start or the end, or the belt accelerates just at its limit",
    TOUCHED: "does not exist: an event's surface is touched, not passed",
}


class TangentMotion(NamedTuple):
    """The end of a motion followed with its tangents, and what happened over it."""

    x: float
    v: float
    v_belt: float
    mode: int
    status: int
    time: float  # reached
    n_events: int
    int_v2: float
    stick_time: float
    int_fv: float
    x_min: float
    x_max: float
    sticks: int  # that began
    forward_arcs: int  # that began
    ever_stuck: bool  # the tangents of a steady belt then have one direction left
    touched: int  # events without a derivative
    derivative: int  # SMOOTH, or why there is none
    slowest: float  # rate at which an event's surface was passed


@compiled
def _on_side(plant, side):
    return with_spring(plant, plant.spring.on_side(side)) if plant.spring.switches() else plant


@compiled
def _side_of(plant, mode, x, v, drive):
    """Return the side of x = 0 to which the field of a motion is frozen, or 0."""
    if mode == STICK:
        return select_field(plant, x, drive.v_belt).spring.side()
    return select_field_in_slip(plant, mode, State(x, v), drive).spring.side()


@compiled
def _motion_in(plant, mode, side, x, v, drive):
    """Return the acceleration and the contact force in a mode, on a side of x = 0."""
    plant = _on_side(plant, side)
    if mode == STICK:
        return drive.a_belt, stick_load(plant, x, drive)
    contact, a = contact_and_acceleration(plant, mode, x, v, drive.v_belt, drive.u)
    return a, contact


@compiled
def _mode_after(plant, mode, kind, x, drive):
    """Return the mode in which an event at x leaves a mass."""
    if kind == RESTICK:
        return STICK
    if kind == CROSSING:
        return -mode
    if kind == BREAKAWAY:
        return breakaway_mode(plant, x, drive)
    if kind == SWITCHING and mode == STICK:
        return mode_at_zero_v_rel(plant, x, drive)
    return mode


@compiled
def pass_event(plant, mode, side, after, side_after, kind, x, v, drive, tangents, directions, work):
    """Carry tangents through an event; return the rate at which its surface is passed, 0 if it is touched."""
    a, contact = _motion_in(plant, mode, side, x, v, drive)
    a_after, contact_after = _motion_in(plant, after, side_after, x, v, drive)
    place = plant.excitation.lab_position(x)
    w = plant.excitation.lab_velocity(v)
    n = tangents.shape[1]
    unchanged = n if directions is None else n - len(directions)
    cone_side = -1.0 if after == SLIP_FORWARD else 1.0
    mu = plant.friction.breakaway_coefficient(after)
    if kind == BREAKAWAY:
        plant = _on_side(plant, side)
        rate = cone_excess(plant, cone_side, x, drive, 0.0)[1]
        rate = rate if rate > 0.0 else 0.0
        if directions is not None:
            external_gradient(plant, x, v, work.external)
            contact_gradient(plant, mu, plant.friction.breakaway_gradient(after), x, work.contact)
    elif kind == SWITCHING:
        rate = w
        if directions is not None:
            ripple_gradient(plant, work.shift, 1.0)
    else:
        rate = a - drive.a_belt
    longer = (1.0 if mode == STICK else 0.0) - (1.0 if after == STICK else 0.0)
    if kind == GRAZING or abs(rate) <= _TOUCH:
        rate = 0.0
    for j in range(n):
        dx, dv, d_belt = tangents[TANGENT_X, j], tangents[TANGENT_V, j], tangents[TANGENT_BELT, j]
        if kind == BREAKAWAY:
            d_load = tangents[TANGENT_A_BELT, j] + 2.0 * plant.beta * d_belt - tangents[TANGENT_U, j]
            d_load += restoring_slope(plant, place) * dx
            gap = cone_side * d_load - mu * normal_slope(plant, place) * dx
        elif kind == SWITCHING:
            gap = dx
        else:
            gap = dv - d_belt
        if directions is not None:
            if j >= unchanged:
                direction = directions[j - unchanged]
                if kind == BREAKAWAY:
                    gap += cone_side * along(direction, work.external) - along(direction, work.contact)
                elif kind == SWITCHING:
                    gap += along(direction, work.shift)
        if rate != 0.0:
            dt = -gap / rate
            tangents[TANGENT_V, j] += (a - a_after) * dt
            tangents[TANGENT_FV, j] += (contact - contact_after) * w * dt
            tangents[TANGENT_STICK, j] += longer * dt
        if after == STICK:
            tangents[TANGENT_V, j] = d_belt
    return abs(rate)


@compiled
def event_due(plant, mode, side, x, v, drive):
    """Whether a motion meets an event within _SECTION_TIME."""
    if plant.spring.switches():
        w = plant.excitation.lab_velocity(v)
        if side * w < 0.0 and side * plant.excitation.lab_position(x) <= _SECTION_TIME * abs(w):
            return True
    if mode == STICK:
        for cone_side in (-1.0, 1.0):
            excess, slope = cone_excess(plant, cone_side, x, drive, 0.0)
            if slope > 0.0 and excess >= -_SECTION_TIME * slope:
                return True
        return False
    rate = mode * (_motion_in(plant, mode, side, x, v, drive)[0] - drive.a_belt)
    return rate < 0.0 and mode * (v - drive.v_belt) <= -_SECTION_TIME * rate


@compiled
def to_frame_of_belt(plant, tangents, directions, work, sign):
    """Turn tangents of the lab into those of the belt's frame (``sign`` -1), or back (1)."""
    if directions is not None:
        unchanged = tangents.shape[1] - len(directions)
        for of_position in (1.0, 0.0):
            ripple_gradient(plant, work.shift, of_position)
            place = TANGENT_X if of_position == 1.0 else TANGENT_V
            for j in range(len(directions)):
                tangents[place, unchanged + j] += sign * along(directions[j], work.shift)


@compiled
def follow_with_tangents(plant, mode, state, drive, duration, tangents, directions, events, work):
    """:func:`advance_with_tangents` with scratch space: events (MAX_EVENTS, 4) and :func:`work_for` the tangents."""
    t, int_v2, stick_time, int_fv = 0.0, 0.0, 0.0, 0.0
    n_events, sticks, forward_arcs, touched = 0, 0, 0, 0
    slowest = math.inf
    x, v = state
    x_min, x_max = x, x
    ever_stuck = False
    derivative = SMOOTH
    status = EVENT_LIMIT
    there = drive
    to_frame_of_belt(plant, tangents, directions, work, -1.0)
    known = 0.0
    stages = _NO_STAGES
    trial = UNTRIED
    for call in range(_MOST_CALLS):
        now = at_time(plant, t)
        x_leg, v_leg = now.excitation.to_belt_frame(x, v, there.v_belt)
        if mode == UNKNOWN:
            mode = mode_in_belt_frame(now, State(x_leg, v_leg), there)
        if call == 0 and mode != STICK and duration <= MAX_SLIP_STEP and not plant.excitation.acts():
            # Most intervals are one step: it is taken once for the motion and its tangents.
            known = 1.0
            begin_state = State(x_leg, v_leg)
            stages = slip_stages(
                select_field_in_slip(now, mode, begin_state, there), mode, begin_state, there, duration
            )
            trial = Trial(1.0, stages.step, 0.0, UNTRIED.look)
        motion = follow(now, mode, State(x, v), there, duration - t, events, trial)
        trial = UNTRIED
        status = motion.status
        if motion.n_events > 0:
            known = 0.0
        if call == 0 and v_leg == there.v_belt:
            derivative = FROM_BELT
        side = _side_of(now, mode, x_leg, v_leg, there)
        begin = 0.0
        for n in range(motion.n_events + 1):
            end = events[n, 0] if n < motion.n_events else motion.time
            leg = at_time(now, begin)
            at_begin = drive_at(there, begin)
            if mode == STICK:
                ever_stuck = True
            if tangents.shape[1] == 0:
                pass
            elif mode == STICK:
                v_leg = at_begin.v_belt
                for j in range(tangents.shape[1]):
                    tangents[TANGENT_V, j] = tangents[TANGENT_BELT, j]
                x_leg, v_leg = carry_in_stick(leg, x_leg, at_begin, end - begin, tangents, directions, work)
            else:
                done, nearest, x_leg, v_leg = carry_in_slip(
                    leg, mode, State(x_leg, v_leg), at_begin, end - begin, tangents, directions, work, known, stages
                )
                if not done:
                    status = STEP_LIMIT
                if nearest <= _TOUCH:
                    touched += 1
            then = at_time(now, end)
            at_end = drive_at(there, end)
            if n < motion.n_events:
                kind = int(events[n, 1])
                x_leg, v_leg = then.excitation.to_belt_frame(events[n, 2], events[n, 3], at_end.v_belt)
                if kind not in (RESTICK, CROSSING, GRAZING, BREAKAWAY, SWITCHING):
                    break  # contact is lost, or the motion cannot be followed
                after = _mode_after(then, mode, kind, x_leg, at_end)
            else:
                # What the automaton does where a leg ends with the motion, it does not list.
                x_leg, v_leg = then.excitation.to_belt_frame(motion.x, motion.v, at_end.v_belt)
                after = motion.mode
                kind = NO_EVENT
                if after != mode:
                    kind = BREAKAWAY if mode == STICK else (RESTICK if after == STICK else CROSSING)
            side_after = side
            if plant.spring.switches():
                if kind == SWITCHING:
                    side_after = 1.0 if then.excitation.lab_velocity(v_leg) > 0.0 else -1.0
                elif kind == NO_EVENT and abs(then.excitation.lab_position(x_leg)) <= SIDE_ZERO:
                    side_after = _side_of(then, mode, x_leg, v_leg, at_end)
                    kind = SWITCHING if side_after != side else NO_EVENT
            if kind != NO_EVENT:
                rate = pass_event(
                    then, mode, side, after, side_after, kind, x_leg, v_leg, at_end, tangents, directions, work
                )
                slowest = min(slowest, rate)
                if rate == 0.0:
                    touched += 1
                if t + end < _SECTION_TIME or duration - (t + end) < _SECTION_TIME:
                    derivative = max(derivative, AT_BORDER)
                sticks += 1 if after == STICK and mode != STICK else 0
                forward_arcs += 1 if after == SLIP_FORWARD and mode != SLIP_FORWARD else 0
            mode, side = after, side_after
            begin = end
        n_events += motion.n_events
        int_v2 += motion.int_v2
        stick_time += motion.stick_time
        int_fv += motion.int_fv
        x, v = motion.x, motion.v
        x_min = min(x_min, motion.x_min)
        x_max = max(x_max, motion.x_max)
        t = duration if status == OK else t + motion.time
        there = drive_at(drive, t)
        if status != EVENT_LIMIT:
            break
    last = at_time(plant, t)
    x_leg, v_leg = last.excitation.to_belt_frame(x, v, there.v_belt)
    if status == OK and event_due(last, mode, _side_of(last, mode, x_leg, v_leg, there), x_leg, v_leg, there):
        derivative = max(derivative, AT_BORDER)
    if touched > 0:
        derivative = TOUCHED
    to_frame_of_belt(last, tangents, directions, work, 1.0)
    return TangentMotion(
        x,
        v,
        there.v_belt,
        mode,
        status,
        t,
        n_events,
        int_v2,
        stick_time,
        int_fv,
        x_min,
        x_max,
        sticks,
        forward_arcs,
        ever_stuck,
        touched,
        derivative,
        slowest,
    )


@entry
def advance_with_tangents(plant, mode, state, drive, duration, tangents, directions):
    """:func:`follow` a motion and carry tangents along it.

    ``tangents`` (TANGENT_ROWS, n) are changed from those of the start to those of the end; ``directions`` (m, numbers
    of the plant) are the changes of the plant that belong to the last m of them, or None.
    """
    numbers = 0 if directions is None else directions.shape[1]
    work = work_for(tangents.shape[1], numbers)
    events = np.empty((MAX_EVENTS, 4))
    return follow_with_tangents(plant, mode, state, drive, duration, tangents, directions, events, work)


@entry
def trace_with_tangents(plant, mode, state, drive, times, tangents, directions, samples):
    """Follow one held interval with tangents and write those of x and v at each of ``times`` (k,), counted from 0.

    ``samples`` (k, 2, n). Return the last motion, and how many events have no derivative.
    """
    work = work_for(tangents.shape[1], 0 if directions is None else directions.shape[1])
    events = np.empty((MAX_EVENTS, 4))
    t = 0.0
    touched = 0
    there = drive
    motion = follow_with_tangents(plant, mode, state, drive, 0.0, tangents, directions, events, work)
    for i in range(len(times)):
        now = at_time(plant, t)
        begin = State(motion.x, motion.v)
        motion = follow_with_tangents(now, motion.mode, begin, there, times[i] - t, tangents, directions, events, work)
        touched += motion.touched
        t = times[i]
        there = drive_at(drive, t)
        samples[i] = tangents[:2]
        if motion.status != OK:
            break
    return motion, touched
