"""Forced dynamics: a motion with its tangents, and its stroboscopic map.

Motions of a steady belt under excitation alone. `follow` goes along the motion and lists its events; the legs between
them are gone through again for the tangents, so that the automaton stands in one place. Tangents (dx, dv) compare
states at one time, so that the belt's frame and the lab have the same ones.
"""

import math
from typing import NamedTuple

import numpy as np

from sd_friction_env.kernel.automaton import follow
from sd_friction_env.kernel.codes import (
    BREAKAWAY,
    CONTACT_LOST,
    CROSSING,
    EVENT_LIMIT,
    GRAZING,
    MAX_EVENTS,
    NO_EVENT,
    OK,
    RESTICK,
    SLIP_FORWARD,
    STICK,
    SWITCHING,
    UNKNOWN,
)
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.forces import (
    breakaway_mode,
    mode_at_zero_v_rel,
    mode_in_belt_frame,
    normal_force,
    normal_slope,
    restoring_slope,
    slip_acceleration,
)
from sd_friction_env.kernel.plant import State, at_time, steady, with_spring
from sd_friction_env.kernel.runge_kutta import slip_step
from sd_friction_env.kernel.slip import UNTRIED, select_field_in_slip
from sd_friction_env.kernel.stick import cone_excess

TANGENT_STEP = 0.1  # of the shortest time in which the linearised motion changes
TANGENT_BEND = 1e-4  # by so much a step's coefficients may depart from straight lines, times its length
TANGENT_SMALLEST_STEP = 1e-9
MOST_CALLS = 256  # of advance in one motion, each of MAX_EVENTS events
SECTION_TIME = 1e-8  # an event due within this time after a section is of the cycle that ends there

# What `stroboscope` writes of a cycle.
(
    (CYCLE_X, CYCLE_V, CYCLE_MODE, CYCLE_STICK_TIME, CYCLE_STICKS, CYCLE_FORWARD_ARCS, CYCLE_X_MIN, CYCLE_X_MAX),
    CYCLE_ROW,
) = range(8), 8


class TangentMotion(NamedTuple):
    """The end of a motion followed with its tangents, and what happened over it."""

    x: float
    v: float
    mode: int
    status: int
    time: float  # reached
    stick_time: float
    sticks: int  # that began
    forward_arcs: int  # that began
    x_min: float
    x_max: float
    ever_stuck: bool  # the tangents then have one direction left
    singular_events: int  # events without a derivative


class Cycles(NamedTuple):
    """The end of several cycles of the excitation."""

    x: float
    v: float
    status: int
    written: int  # rows
    singular_events: int  # events without a derivative


@compiled
def _linearised(plant, mode, x, v, v_belt):
    """Return the stiffness and the damping of small deviations in slip: dv' = -stiffness dx - damping dv."""
    place = plant.excitation.lab_position(x)
    v_rel = v - v_belt
    stiffness = restoring_slope(plant, place) + plant.friction.coefficient(mode, v_rel) * normal_slope(plant, place)
    return stiffness, 2.0 * plant.beta + normal_force(plant, place) * plant.friction.slope(mode, v_rel)


@compiled
def _tangent_step(h, k_0, c_0, k_1, c_1, k_2, c_2, dx, dv):
    """Take a classical Runge-Kutta step of a deviation; stiffness and damping are given at 0, h/2 and h."""
    p1, q1 = dv, -k_0 * dx - c_0 * dv
    p2 = dv + 0.5 * h * q1
    q2 = -k_1 * (dx + 0.5 * h * p1) - c_1 * p2
    p3 = dv + 0.5 * h * q2
    q3 = -k_1 * (dx + 0.5 * h * p2) - c_1 * p3
    p4 = dv + h * q3
    q4 = -k_2 * (dx + h * p3) - c_2 * p4
    return dx + h / 6.0 * (p1 + 2.0 * p2 + 2.0 * p3 + p4), dv + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)


@compiled
def _carry_in_slip(plant, mode, x, v, v_belt, duration, vectors):
    """Carry tangents (n, 2) along a slip of this length, in which nothing happens."""
    belt = steady(v_belt)
    plant = select_field_in_slip(plant, mode, State(x, v), belt)
    t = 0.0
    h = duration
    while t < duration:
        remaining = duration - t
        now = at_time(plant, t)
        k_0, c_0 = _linearised(now, mode, x, v, v_belt)
        h = min(h, remaining, TANGENT_STEP / max(1.0, math.sqrt(abs(k_0)), abs(c_0)))
        first = slip_step(now, mode, State(x, v), belt, 0.5 * h)
        middle = at_time(now, 0.5 * h)
        k_1, c_1 = _linearised(middle, mode, first.x, first.v, v_belt)
        second = slip_step(middle, mode, State(first.x, first.v), belt, 0.5 * h)
        k_2, c_2 = _linearised(at_time(now, h), mode, second.x, second.v, v_belt)
        bend = h * (abs(k_0 - 2.0 * k_1 + k_2) + abs(c_0 - 2.0 * c_1 + c_2))
        if bend > TANGENT_BEND and h > TANGENT_SMALLEST_STEP:
            h = 0.5 * h
            continue
        for i in range(len(vectors)):
            vectors[i, 0], vectors[i, 1] = _tangent_step(h, k_0, c_0, k_1, c_1, k_2, c_2, vectors[i, 0], vectors[i, 1])
        x, v = second.x, second.v
        t = duration if h == remaining else t + h
        if bend < 0.1 * TANGENT_BEND:
            h = 2.0 * h


@compiled
def _mode_after(plant, mode, kind, x, v_belt):
    """Return the mode in which an event at x leaves a mass."""
    if kind == RESTICK:
        return STICK
    if kind == CROSSING:
        return -mode
    if kind == BREAKAWAY:
        return breakaway_mode(plant, x, steady(v_belt))
    if kind == SWITCHING and mode == STICK:
        return mode_at_zero_v_rel(plant, x, steady(v_belt))
    return mode


@compiled
def _acceleration(plant, mode, x, v, v_belt):
    """Return the acceleration in any mode of a mass that has just entered it."""
    if mode == STICK:
        return 0.0
    plant = select_field_in_slip(plant, mode, State(x, v), steady(v_belt))
    return slip_acceleration(plant, mode, State(x, v), steady(v_belt))


@compiled
def _acceleration_before_switch(plant, mode, x, v, v_belt):
    if mode == STICK:
        return 0.0
    side = -1.0 if plant.excitation.lab_velocity(v) > 0.0 else 1.0
    return slip_acceleration(with_spring(plant, plant.spring.on_side(side)), mode, State(x, v), steady(v_belt))


@compiled
def saltation(plant, mode, after, kind, x, v, v_belt):
    """Return what an event does to tangents, dv+ = of_x dx + of_v dv (dx stays, for v is continuous): of_x, of_v, and
    whether the derivative does not exist there (the event is touched, not passed).

    With f = (v, a) before and after and the event at h(x, v, t) = 0 it is 1 + (f+ - f-) grad h / (dh/dt along f-);
    Leine and Nijmeijer: Dynamics and Bifurcations of Non-Smooth Mechanical Systems (2004), ch. 7.
    """
    if kind == RESTICK:
        return 0.0, 0.0, False
    if kind == CROSSING:
        a = _acceleration(plant, mode, x, v, v_belt)
        if a == 0.0:
            return 0.0, 1.0, True
        return 0.0, _acceleration(plant, after, x, v, v_belt) / a, False
    if kind == BREAKAWAY:
        side = float(-after)
        _, slope = cone_excess(plant, side, x, steady(v_belt), 0.0)
        if not slope > 0.0:
            return 0.0, 0.0, True
        place = plant.excitation.lab_position(x)
        mu = plant.friction.breakaway_coefficient(after)
        of_x = (side * restoring_slope(plant, place) - mu * normal_slope(plant, place)) / slope
        return of_x * _acceleration(plant, after, x, v, v_belt), 0.0, False
    if kind == SWITCHING:
        w = plant.excitation.lab_velocity(v)
        if w == 0.0:
            return 0.0, 1.0, True
        jump = _acceleration(plant, after, x, v, v_belt)
        jump = jump - _acceleration_before_switch(plant, mode, x, v, v_belt)
        return jump / w, 1.0, False
    return 0.0, 1.0, kind == GRAZING


@compiled
def _side_of(plant, x, v):
    """Return the side of x = 0 on which a mass is, or, from a section on it, to which it moves."""
    place = plant.excitation.lab_position(x)
    w = plant.excitation.lab_velocity(v)
    ahead = w if abs(place) <= SECTION_TIME * abs(w) else place
    return 1.0 if ahead > 0.0 else -1.0


@compiled
def _event_due(plant, mode, side, x, v, v_belt):
    """Return the kind of event that a motion in this mode, on this side of x = 0, meets within SECTION_TIME, or
    NO_EVENT."""
    w = plant.excitation.lab_velocity(v)
    if plant.spring.switches() and side * w < 0.0 and side * plant.excitation.lab_position(x) <= SECTION_TIME * abs(w):
        return SWITCHING
    if mode == STICK:
        for cone_side in (-1.0, 1.0):
            excess, slope = cone_excess(plant, cone_side, x, steady(v_belt), 0.0)
            if slope > 0.0 and excess >= -SECTION_TIME * slope:
                return BREAKAWAY
        return NO_EVENT
    a = mode * _acceleration(plant, mode, x, v, v_belt)
    if a < 0.0 and mode * (v - v_belt) <= -SECTION_TIME * a:
        landed = mode_at_zero_v_rel(plant, x, steady(v_belt))
        return RESTICK if landed == STICK else (GRAZING if landed == mode else CROSSING)
    return NO_EVENT


@compiled
def _pass_event(plant, mode, after, kind, x, v, v_belt, vectors):
    """Carry tangents (n, 2) through an event. Return 1 or 0 each: for a stick and a forward arc that begins, and for
    an event without a derivative."""
    of_x, of_v, touched = saltation(plant, mode, after, kind, x, v, v_belt)
    for i in range(len(vectors)):
        vectors[i, 1] = of_x * vectors[i, 0] + of_v * vectors[i, 1]
    arcs = 1 if after == SLIP_FORWARD and mode != SLIP_FORWARD else 0
    return 1 if kind == RESTICK else 0, arcs, 1 if touched else 0


@entry
def integrate_with_tangents(plant, x, v, v_belt, duration, events, vectors, in_sections=True):
    """Follow a motion under excitation alone and carry tangents (n, 2) along it, if there are any.

    ``in_sections``: an event on the section at either end, or due just after it, belongs to the motion that ends there:
    its saltation is applied at the end, and not once more at the beginning of the motion that goes on from it. Without
    it the tangents are the derivative of the end by the start.
    ``events`` (MAX_EVENTS, 4) is scratch space.
    """
    t = 0.0
    stick_time = 0.0
    sticks = 0
    forward_arcs = 0
    singular = 0
    x_min = x
    x_max = x
    ever_stuck = False
    x_leg, v_leg = plant.excitation.to_belt_frame(x, v, v_belt)
    mode = mode_in_belt_frame(plant, State(x_leg, v_leg), steady(v_belt))
    side = _side_of(plant, x_leg, v_leg)
    due = NO_EVENT
    if in_sections:
        due = _event_due(plant, mode, 1.0 if plant.excitation.lab_position(x_leg) > 0.0 else -1.0, x_leg, v_leg, v_belt)
    status = EVENT_LIMIT
    for _ in range(MOST_CALLS):
        now = at_time(plant, t)
        motion = follow(now, UNKNOWN, State(x, v), steady(v_belt), duration - t, events, UNTRIED)
        status, dt, n_events = motion.status, motion.time, motion.n_events
        x_leg, v_leg = now.excitation.to_belt_frame(x, v, v_belt)
        mode = mode_in_belt_frame(now, State(x_leg, v_leg), steady(v_belt))
        begin = 0.0
        for n in range(n_events + 1):
            end = events[n, 0] if n < n_events else dt
            if mode == STICK:
                ever_stuck = True
                for i in range(len(vectors) if due != BREAKAWAY else 0):
                    vectors[i, 1] = 0.0
            elif len(vectors) > 0:
                _carry_in_slip(at_time(now, begin), mode, x_leg, v_leg, v_belt, end - begin, vectors)
            if n == n_events:
                break
            then = at_time(now, end)
            kind = int(events[n, 1])
            x_leg, v_leg = then.excitation.to_belt_frame(events[n, 2], events[n, 3], v_belt)
            after = _mode_after(then, mode, kind, x_leg, v_belt)
            if kind == due and t + end <= 2.0 * SECTION_TIME:
                due = NO_EVENT
            else:
                begun, arcs, touched = _pass_event(then, mode, after, kind, x_leg, v_leg, v_belt, vectors)
                sticks += begun
                forward_arcs += arcs
                singular += touched
            if kind == SWITCHING:
                side = 1.0 if then.excitation.lab_velocity(v_leg) > 0.0 else -1.0
            mode = after
            begin = end
        if status == OK and in_sections:
            then = at_time(now, dt)
            x_leg, v_leg = then.excitation.to_belt_frame(motion.x, motion.v, v_belt)
            kind = _event_due(then, mode, side, x_leg, v_leg, v_belt)
            if kind != NO_EVENT:
                x_leg = then.excitation.belt_frame_origin() if kind == SWITCHING else x_leg
                after = _mode_after(then, mode, kind, x_leg, v_belt)
                begun, arcs, touched = _pass_event(then, mode, after, kind, x_leg, v_leg, v_belt, vectors)
                sticks += begun
                forward_arcs += arcs
                singular += touched
                ever_stuck = ever_stuck or kind == RESTICK
        x, v, mode = motion.x, motion.v, motion.mode
        stick_time += motion.stick_time
        x_min = min(x_min, motion.x_min)
        x_max = max(x_max, motion.x_max)
        t = duration if status == OK else t + dt
        if status != EVENT_LIMIT:
            break
    return TangentMotion(x, v, mode, status, t, stick_time, sticks, forward_arcs, x_min, x_max, ever_stuck, singular)


@compiled
def _renormalise(vectors, stuck):
    """Make two tangents orthonormal; return the logarithms of the length and of the height that they had."""
    dx, dv = vectors[0, 0], vectors[0, 1]
    size = math.sqrt(dx * dx + dv * dv)
    if size == 0.0:
        vectors[0, 0], vectors[0, 1], vectors[1, 0], vectors[1, 1] = 1.0, 0.0, 0.0, 1.0
        return -math.inf, -math.inf
    dx = dx / size
    dv = dv / size
    height = abs(dx * vectors[1, 1] - dv * vectors[1, 0])
    vectors[0, 0], vectors[0, 1], vectors[1, 0], vectors[1, 1] = dx, dv, -dv, dx
    return math.log(size), -math.inf if stuck or height == 0.0 else math.log(height)


@entry
def stroboscope(plant, x, v, v_belt, period, skipped, rows, growth):
    """Follow a motion over ``skipped`` cycles of the excitation, then over as many as ``rows`` (n, CYCLE_ROW) has,
    written down one each: the state and the mode at its end, and the time stuck, the sticks and the forward-slip arcs
    that began, and the least and greatest x in it.

    ``growth`` (n, 2) takes the logarithms by which two tangents, made orthonormal after each cycle, grow; without rows
    there are no tangents.
    """
    events = np.empty((MAX_EVENTS, 4))
    vectors = np.zeros((2 if len(growth) > 0 else 0, 2))
    for i in range(len(vectors)):
        vectors[i, i] = 1.0
    singular = 0
    status = OK
    for n in range(skipped + len(rows)):
        now = at_time(plant, n * period)
        motion = integrate_with_tangents(now, x, v, v_belt, period, events, vectors)
        x, v, status = motion.x, motion.v, motion.status
        if status != OK:
            return Cycles(x, v, status, max(n - skipped, 0), singular)
        first, second = 0.0, 0.0
        if len(vectors) > 0:
            first, second = _renormalise(vectors, motion.ever_stuck)
        i = n - skipped
        if i < 0:
            continue
        singular += motion.singular_events
        rows[i, CYCLE_X] = x
        rows[i, CYCLE_V] = v
        rows[i, CYCLE_MODE] = motion.mode
        rows[i, CYCLE_STICK_TIME] = motion.stick_time
        rows[i, CYCLE_STICKS] = motion.sticks
        rows[i, CYCLE_FORWARD_ARCS] = motion.forward_arcs
        rows[i, CYCLE_X_MIN] = motion.x_min
        rows[i, CYCLE_X_MAX] = motion.x_max
        if len(growth) > 0:
            growth[i, 0] = first
            growth[i, 1] = second
    return Cycles(x, v, status, len(rows), singular)


@entry
def label_attractors(plant, xs, vs, v_belt, period, cycles, points, point_labels, tolerance, labels):
    """Follow each start (xs, vs) of shape (n,) until, at the end of a cycle, it is within ``tolerance`` of one of the
    ``points`` (m, 2), and write the label of that, -1 if it lost contact and -2 if ``cycles`` did not do. The starts
    are moved to where they were followed to."""
    events = np.empty((MAX_EVENTS, 4))
    none = np.empty((0, 2))
    for i in range(len(xs)):
        labels[i] = -2
        x = xs[i]
        v = vs[i]
        for n in range(cycles):
            motion = integrate_with_tangents(at_time(plant, n * period), x, v, v_belt, period, events, none)
            x, v = motion.x, motion.v
            if motion.status != OK:
                labels[i] = -1 if motion.status == CONTACT_LOST else -2
                break
            for j in range(len(points)):
                if abs(x - points[j, 0]) <= tolerance and abs(v - points[j, 1]) <= tolerance:
                    labels[i] = point_labels[j]
                    break
            if labels[i] != -2:
                break
        xs[i] = x
        vs[i] = v
