"""Control intervals with their derivatives, one by one, and the gradient of a whole episode's return."""

import math

import numpy as np

from sd_friction_env.kernel.codes import FORCE, MAX_EVENTS, OK, UNKNOWN
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.interval import actuation, interval_averages
from sd_friction_env.kernel.plant import Drive, State, at_time
from sd_friction_env.kernel.sensitivity import AT_BORDER, SMOOTH, follow_with_tangents
from sd_friction_env.kernel.variation import (
    TANGENT_A_BELT,
    TANGENT_BELT,
    TANGENT_FV,
    TANGENT_ROWS,
    TANGENT_STICK,
    TANGENT_U,
    TANGENT_V,
    TANGENT_V2,
    TANGENT_X,
    work_for,
)

# What an interval comes to, and by what its derivatives are taken; after the action, by parameters of the plant.
OUTCOMES = (
    *("x", "v", "v_belt", "reward", "mean_v2", "stick_fraction", "friction_power", "control_power"),
    *("vibration", "effort", "stick"),
)
(OUT_X, OUT_V, OUT_V_BELT, OUT_REWARD, OUT_MEAN_V2, OUT_STICK_FRACTION, OUT_FRICTION_POWER, OUT_CONTROL_POWER) = range(
    8
)
(OUT_VIBRATION, OUT_EFFORT, OUT_STICK_COST), N_OUTCOMES = range(8, 11), 11
CAUSES = ("x", "v", "v_belt", "action")
BY_X, BY_V, BY_V_BELT, BY_ACTION, N_CAUSES = range(5)
_AT_LIMIT = 1e-12  # so close to the limit of the belt's acceleration, relative to it, rounding decides
_STATE = 3  # the first outcomes and causes are the state


@compiled
def _seed_tangents(actuator, v_belt, action, belt_speed_changes, tangents):
    """Write the tangents of an interval's start: by x, v, v_belt and action, and by the plant's parameters.

    Return whether the belt's acceleration is just at its limit, where they have two values.
    """
    kind, authority, a_limit, belt_speed, interval, _, _ = actuator
    tangents[:] = 0.0
    tangents[TANGENT_X, BY_X] = 1.0
    tangents[TANGENT_V, BY_V] = 1.0
    tangents[TANGENT_BELT, BY_V_BELT] = 1.0
    if kind == FORCE:
        tangents[TANGENT_U, BY_ACTION] = authority
        return False
    slope = ((1.0 + authority * action) * belt_speed - v_belt) / interval
    if abs(slope) < a_limit:
        tangents[TANGENT_A_BELT, BY_V_BELT] = -1.0 / interval
        tangents[TANGENT_A_BELT, BY_ACTION] = authority * belt_speed / interval
        for j in range(len(belt_speed_changes)):
            change = belt_speed_changes[j] / interval
            tangents[TANGENT_A_BELT, N_CAUSES + j] = (1.0 + authority * action) * change
    return abs(abs(slope) - a_limit) <= _AT_LIMIT * a_limit


@compiled
def _interval(plant, actuator, state, v_belt, action, directions, changes, tangents, events, work, row, jacobian):
    """Apply an action for one interval; write what it comes to and the derivatives.

    Return the motion, and whether its derivative exists.

    ``changes`` are those of the nominal belt speed with the parameters.
    """
    kind, authority, a_limit, belt_speed, interval, w_effort, w_stick = actuator
    u, a_belt = actuation(kind, authority, a_limit, belt_speed, interval, v_belt, action)
    drive = Drive(v_belt, a_belt, u)
    at_limit = _seed_tangents(actuator, v_belt, action, changes, tangents)
    end = follow_with_tangents(plant, UNKNOWN, state, drive, interval, tangents, directions, events, work)
    averages = interval_averages(
        state.x, end.x, end.int_v2, end.stick_time, end.int_fv, action, u, belt_speed, interval, w_effort, w_stick
    )
    row[OUT_X], row[OUT_V], row[OUT_V_BELT] = end.x, end.v, end.v_belt
    row[OUT_REWARD] = averages.vibration + averages.effort + averages.stick
    row[OUT_MEAN_V2], row[OUT_STICK_FRACTION] = averages.mean_v2, averages.stick_fraction
    row[OUT_FRICTION_POWER], row[OUT_CONTROL_POWER] = averages.friction_power, averages.control_power
    row[OUT_VIBRATION], row[OUT_EFFORT], row[OUT_STICK_COST] = averages.vibration, averages.effort, averages.stick
    for j in range(tangents.shape[1]):
        by_v2, by_stick = tangents[TANGENT_V2, j] / interval, tangents[TANGENT_STICK, j] / interval
        moved = tangents[TANGENT_X, j] - (1.0 if j == BY_X else 0.0)
        vibration = -by_v2 / (belt_speed * belt_speed)
        if j >= N_CAUSES:
            vibration -= 2.0 * averages.vibration / belt_speed * changes[j - N_CAUSES]
        effort = -2.0 * w_effort * action if j == BY_ACTION else 0.0
        jacobian[OUT_X, j] = tangents[TANGENT_X, j]
        jacobian[OUT_V, j] = tangents[TANGENT_V, j]
        jacobian[OUT_V_BELT, j] = tangents[TANGENT_BELT, j]
        jacobian[OUT_REWARD, j] = vibration + effort - w_stick * by_stick
        jacobian[OUT_MEAN_V2, j] = by_v2
        jacobian[OUT_STICK_FRACTION, j] = by_stick
        jacobian[OUT_FRICTION_POWER, j] = tangents[TANGENT_FV, j] / interval
        jacobian[OUT_CONTROL_POWER, j] = (tangents[TANGENT_U, j] * (end.x - state.x) + u * moved) / interval
        jacobian[OUT_VIBRATION, j] = vibration
        jacobian[OUT_EFFORT, j] = effort
        jacobian[OUT_STICK_COST, j] = -w_stick * by_stick
    return end, max(end.derivative, AT_BORDER) if at_limit else end.derivative


@entry
def control_intervals_with_tangents(plant, actuator, starts, directions, changes, outcomes, jacobians, codes):
    """Apply an action each to n independent states for one interval, with derivatives.

    ``starts`` (N_CAUSES, n): x, v, v_belt and action. ``directions`` (m, numbers of the plant): how its numbers change
    with m parameters, or None; ``changes`` (m,): how the nominal belt speed does. Written: ``outcomes``
    (n, N_OUTCOMES), ``jacobians`` (n, N_OUTCOMES, N_CAUSES + m; NaN where the motion cannot be followed), and
    ``codes`` (2, n): whether the derivative exists, and the status.
    """
    tangents = np.empty((TANGENT_ROWS, N_CAUSES + len(changes)))
    work = work_for(tangents.shape[1], 0 if directions is None else directions.shape[1])
    events = np.empty((MAX_EVENTS, 4))
    for i in range(starts.shape[1]):
        state = State(starts[BY_X, i], starts[BY_V, i])
        v_belt, action = starts[BY_V_BELT, i], starts[BY_ACTION, i]
        row, jacobian = outcomes[i], jacobians[i]
        end, derivative = _interval(
            plant, actuator, state, v_belt, action, directions, changes, tangents, events, work, row, jacobian
        )
        codes[0, i] = derivative
        codes[1, i] = end.status
        if end.status != OK:
            jacobian[:] = math.nan


@entry
def return_with_gradient(plant, actuator, state, v_belt, actions, directions, changes, by_actions, by_start):
    """Return the sum of rewards of an action sequence, the status, and the worst code of its derivatives.

    ``by_actions`` (steps,) and ``by_start`` (3 + m,) take its gradient by the actions, and by x, v, v_belt and the
    parameters: backwards through the intervals' Jacobians.
    """
    n, m = len(actions), len(changes)
    tangents = np.empty((TANGENT_ROWS, N_CAUSES + m))
    work = work_for(tangents.shape[1], 0 if directions is None else directions.shape[1])
    events = np.empty((MAX_EVENTS, 4))
    row = np.empty(N_OUTCOMES)
    jacobians = np.empty((n, N_OUTCOMES, N_CAUSES + m))
    total = 0.0
    worst = SMOOTH
    for t in range(n):
        now = at_time(plant, t * actuator.interval)
        end, derivative = _interval(
            now, actuator, state, v_belt, actions[t], directions, changes, tangents, events, work, row, jacobians[t]
        )
        worst = max(worst, derivative)
        total += row[OUT_REWARD]
        if end.status != OK:
            by_actions[:] = math.nan
            by_start[:] = math.nan
            return total, end.status, worst
        state, v_belt = State(end.x, end.v), end.v_belt
    by_start[:] = 0.0
    before = np.empty(_STATE)
    for back in range(n):
        jacobian = jacobians[n - 1 - back]
        for j in range(N_CAUSES + m):
            change = jacobian[OUT_REWARD, j]
            for i in range(_STATE):
                change += by_start[i] * jacobian[i, j]
            if j < _STATE:
                before[j] = change
            elif j == BY_ACTION:
                by_actions[n - 1 - back] = change
            else:
                by_start[j - 1] += change
        by_start[:_STATE] = before
    return total, OK, worst
