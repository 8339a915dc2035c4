"""Forced dynamics: the stroboscopic map of motions of a steady belt, with the growth of their tangents."""

import math
from typing import NamedTuple

import numpy as np

from sd_friction_env.kernel.codes import CONTACT_LOST, MAX_EVENTS, OK, UNKNOWN
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.plant import State, at_time, steady
from sd_friction_env.kernel.sensitivity import follow_with_tangents
from sd_friction_env.kernel.variation import TANGENT_ROWS, TANGENT_V, TANGENT_X, work_for

# What `stroboscope` writes of a cycle.
(
    (CYCLE_X, CYCLE_V, CYCLE_MODE, CYCLE_STICK_TIME, CYCLE_STICKS, CYCLE_FORWARD_ARCS, CYCLE_X_MIN, CYCLE_X_MAX),
    CYCLE_ROW,
) = range(8), 8


class Cycles(NamedTuple):
    """The end of several cycles of the excitation."""

    x: float
    v: float
    status: int
    written: int  # rows
    singular_events: int  # events without a derivative


@compiled
def _renormalise(tangents, stuck):
    """Make two tangents orthonormal; return the logarithms of the length and of the height that they had."""
    dx, dv = tangents[TANGENT_X, 0], tangents[TANGENT_V, 0]
    size = math.sqrt(dx * dx + dv * dv)
    height = 0.0
    if size == 0.0:
        dx, dv = 1.0, 0.0
    else:
        dx, dv = dx / size, dv / size
        height = abs(dx * tangents[TANGENT_V, 1] - dv * tangents[TANGENT_X, 1])
    tangents[:] = 0.0
    tangents[TANGENT_X, 0], tangents[TANGENT_V, 0], tangents[TANGENT_X, 1], tangents[TANGENT_V, 1] = dx, dv, -dv, dx
    if size == 0.0:
        return -math.inf, -math.inf
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
    tangents = np.zeros((TANGENT_ROWS, 2 if len(growth) > 0 else 0))
    for i in range(tangents.shape[1]):
        tangents[TANGENT_X + i, i] = 1.0
    work = work_for(tangents.shape[1], 0)
    belt = steady(v_belt)
    mode = UNKNOWN
    singular = 0
    status = OK
    for n in range(skipped + len(rows)):
        now = at_time(plant, n * period)
        motion = follow_with_tangents(now, mode, State(x, v), belt, period, tangents, None, events, work)
        x, v, mode, status = motion.x, motion.v, motion.mode, motion.status
        if status != OK:
            return Cycles(x, v, status, max(n - skipped, 0), singular)
        first, second = 0.0, 0.0
        if tangents.shape[1] > 0:
            first, second = _renormalise(tangents, motion.ever_stuck)
        i = n - skipped
        if i < 0:
            continue
        singular += motion.touched
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
    none = np.empty((TANGENT_ROWS, 0))
    work = work_for(0, 0)
    belt = steady(v_belt)
    for i in range(len(xs)):
        labels[i] = -2
        x = xs[i]
        v = vs[i]
        for n in range(cycles):
            now = at_time(plant, n * period)
            motion = follow_with_tangents(now, UNKNOWN, State(x, v), belt, period, none, None, events, work)
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
