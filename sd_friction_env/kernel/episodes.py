"""Episodes of a batch: their accounts, what they observe, how they begin, and what they came to.

Arrays hold one column for each environment, with the rows of :mod:`sd_friction_env.kernel.rows`.
"""

import math

import numpy as np

from sd_friction_env.kernel.automaton import follow, mode_of
from sd_friction_env.kernel.codes import CONTACT_LOST, OK, STICK, UNKNOWN
from sd_friction_env.kernel.compilation import compiled, entry, in_lanes
from sd_friction_env.kernel.excitation import Unexcited
from sd_friction_env.kernel.forces import normal_force
from sd_friction_env.kernel.interval import actuation, interval_averages
from sd_friction_env.kernel.plant import Plant, State, steady
from sd_friction_env.kernel.random import random_normal
from sd_friction_env.kernel.rows import *
from sd_friction_env.kernel.slip import UNTRIED

CYCLE_POINTS = 64


# A step's accounts ----------------------------------------------------------------------------------------------------


@in_lanes
def actuate(w, i, stride, task, codes):
    """Write what the action in lane i means."""
    u, a_belt = actuation(
        codes[TASK_ACTUATOR],
        task[TASK_AUTHORITY],
        task[TASK_A_LIMIT],
        w[LANE_BELT_SPEED * stride + i],
        task[TASK_INTERVAL],
        w[LANE_BELT * stride + i],
        w[LANE_ACTION * stride + i],
    )
    w[LANE_U * stride + i] = u
    w[LANE_A_BELT * stride + i] = a_belt


@in_lanes
def _average(w, i, stride, interval, w_effort, w_stick):
    belt_end = w[LANE_BELT_END * stride + i]
    mean_v2, stick_fraction, friction_power, control_power, vibration, effort, stick = interval_averages(
        w[LANE_X * stride + i],
        w[LANE_X_END * stride + i],
        w[LANE_INT_V2 * stride + i],
        w[LANE_STICK_TIME * stride + i],
        w[LANE_INT_FV * stride + i],
        w[LANE_ACTION * stride + i],
        w[LANE_U * stride + i],
        w[LANE_BELT_SPEED * stride + i],
        interval,
        w_effort,
        w_stick,
    )
    w[LANE_V_REL * stride + i] = w[LANE_V_END * stride + i] - belt_end
    w[LANE_MEAN_V2 * stride + i] = mean_v2
    w[LANE_STICK_FRACTION * stride + i] = stick_fraction
    w[LANE_FRICTION_POWER * stride + i] = friction_power
    w[LANE_CONTROL_POWER * stride + i] = control_power
    w[LANE_VIBRATION * stride + i] = vibration
    w[LANE_EFFORT * stride + i] = effort
    w[LANE_STICK * stride + i] = stick
    w[LANE_CONTACT_LOSS * stride + i] = 0.0
    w[LANE_REWARD * stride + i] = vibration + effort + stick
    w[LANE_TRAVEL * stride + i] = 0.5 * (w[LANE_BELT * stride + i] + belt_end) * interval


@in_lanes
def account(w, stride, task, codes, state, counts, first, m, failures, terminated, truncated):
    """Write down what the step of m lanes came to; return how many of their episodes ended.

    ``terminated`` and ``truncated`` are (m,) and written.
    """
    # Every row is cut out first and then counted from 0, which is what vector instructions need.
    interval = task[TASK_INTERVAL]
    last_step = codes[TASK_EPISODE_STEPS]
    late_steps = codes[TASK_LATE_STEPS]
    w_effort = task[TASK_W_EFFORT]
    w_stick = task[TASK_W_STICK]
    for i in range(m):
        _average(w, i, stride, interval, w_effort, w_stick)
    if failures > 0:
        for i in range(m):
            if w[LANE_STATUS * stride + i] != OK:
                belts = w[LANE_BELT * stride + i] + w[LANE_BELT_END * stride + i]
                w[LANE_TRAVEL * stride + i] = 0.5 * belts * w[LANE_T_END * stride + i]
    for row in range(3):
        place = state[STATE_X + row, first : first + m]
        for i in range(m):
            place[i] = w[(LANE_X_END + row) * stride + i]
    for row in range(3):
        place = state[STATE_VIBRATION + row, first : first + m]
        for i in range(m):
            place[i] += w[(LANE_VIBRATION + row) * stride + i]
    if codes[TASK_TRAVEL]:
        travel = state[STATE_TRAVEL, first : first + m]
        for i in range(m):
            travel[i] += w[LANE_TRAVEL * stride + i]
    worst = state[STATE_WORST, first : first + m]
    worse = 0
    for i in range(m):
        worse += 1 if -w[LANE_REWARD * stride + i] > worst[i] else 0
    if worse > 0:  # seldom, and memory is slow
        for i in range(m):
            worst[i] = max(worst[i], -w[LANE_REWARD * stride + i])
    steps = counts[COUNT_STEPS, first : first + m]
    late = 0
    ended = 0
    for i in range(m):
        steps[i] += 1
        w[LANE_TIME * stride + i] = steps[i] * interval
    for i in range(m):
        terminated[i] = False
    for i in range(m):
        truncated[i] = steps[i] >= last_step
    for i in range(m):
        late += 1 if steps[i] > late_steps else 0
    for i in range(m):
        ended += 1 if steps[i] >= last_step else 0
    if late > 0:
        for i in range(m):
            if steps[i] > late_steps:
                j = first + i
                state[STATE_LATE_LOW, j] = min(state[STATE_LATE_LOW, j], w[LANE_X_MIN * stride + i])
                state[STATE_LATE_HIGH, j] = max(state[STATE_LATE_HIGH, j], w[LANE_X_MAX * stride + i])
                state[STATE_LATE_STICK, j] += w[LANE_STICK_FRACTION * stride + i]
                state[STATE_LATE_TIME, j] += 1.0
    if ended > 0:
        for i in range(m):
            if truncated[i]:
                counts[COUNT_OVER, first + i] = TRUNCATED
    if failures > 0:
        for i in range(m):
            status = int(w[LANE_STATUS * stride + i])
            if status != OK:
                ended += 0 if truncated[i] else 1
                counts[COUNT_OVER, first + i] = ENDED
                counts[COUNT_STATUS, first + i] = status
                time = (steps[i] - 1) * interval + w[LANE_T_END * stride + i]
                state[STATE_END_TIME, first + i] = time
                w[LANE_TIME * stride + i] = time
                if status != CONTACT_LOST:
                    truncated[i] = True
                    continue
                terminated[i] = True
                steps_left = max(0, last_step - steps[i]) + 1
                loss = -steps_left * max(task[TASK_CONTACT_LOSS_COST], worst[i])
                w[LANE_CONTACT_LOSS * stride + i] = loss
                w[LANE_REWARD * stride + i] += loss
                state[STATE_CONTACT_LOSS, first + i] += loss
    return ended


# What is observed -----------------------------------------------------------------------------------------------------


@in_lanes
def episode_time(state, counts, i, interval):
    """Return the time in environment i's episode; it stops where the motion did."""
    if counts[COUNT_OVER, i] == ENDED:
        return state[STATE_END_TIME, i]
    return counts[COUNT_STEPS, i] * interval


@in_lanes
def _observed(value, offset, scale, limit):
    """Return (value - offset)/scale, no further from zero than the limit."""
    scaled = (value - offset) / scale
    return scaled if abs(scaled) <= limit else math.copysign(limit, scaled)


@in_lanes
def _sense(task, codes, counts, past, x, v, i):
    """Return x and v of environment i as its sensor gives them: some intervals old, with the noise of that time."""
    if task[TASK_SENSOR_NOISE] > 0.0:
        key = int(counts[COUNT_KEY, i])
        episode = int(counts[COUNT_EPISODE, i])
        step = int(counts[COUNT_STEPS, i]) + 1
        x += task[TASK_SENSOR_NOISE] * random_normal(key, episode, step, 0)
        if codes[TASK_FULL_STATE]:
            v += task[TASK_SENSOR_NOISE] * random_normal(key, episode, step, 1)
    delay = codes[TASK_SENSOR_DELAY]
    if delay == 0:
        return x, v
    seen = counts[COUNT_SEEN, i]
    counts[COUNT_SEEN, i] = seen + 1
    past[seen % (delay + 1), 0, i] = x
    past[seen % (delay + 1), 1, i] = v
    oldest = max(0, seen - delay) % (delay + 1)
    return past[oldest, 0, i], past[oldest, 1, i]


@in_lanes
def observe_one(task, codes, state, counts, past, shown, phases, observations, i):
    """Write what environment i observes into its row of ``observations`` (n, size), float32.

    ``past`` (delay + 1, 2, n) is the sensor's memory, ``shown`` (n, p) the scaled parameters shown, ``phases`` the
    excitation's cosines and sines.
    """
    limit = task[TASK_LIMIT]
    x, v = _sense(task, codes, counts, past, state[STATE_X, i], state[STATE_V, i], i)
    observations[i, 0] = _observed(x, task[TASK_X_OFFSET], task[TASK_X_SCALE], limit)
    place = 1
    if codes[TASK_FULL_STATE]:
        observations[i, 1] = _observed(v, 0.0, task[TASK_V_SCALE], limit)
        place = 2
    if codes[TASK_SEES_BELT]:
        modulation = state[STATE_BELT, i] / state[STATE_BELT_SPEED, i]
        observations[i, place] = _observed(modulation, 1.0, task[TASK_BELT_AUTHORITY], limit)
        place += 1
    if codes[TASK_SEES_PHASES]:
        for j in range(len(phases)):
            observations[i, place + j] = phases[j]
        place += len(phases)
    for j in range(shown.shape[1]):
        observations[i, place + j] = shown[i, j]


@compiled
def observe_block(task, codes, w, stride, shown, observations, first, m):
    """:func:`observe_one` for a block whose sensors neither wait nor err nor see phases."""
    limit = task[TASK_LIMIT]
    x_offset = task[TASK_X_OFFSET]
    x_scale = task[TASK_X_SCALE]
    v_scale = task[TASK_V_SCALE]
    authority = task[TASK_BELT_AUTHORITY]
    size = observations.shape[1]
    block = observations[first : first + m].reshape(-1)
    if size == 2 and codes[TASK_FULL_STATE]:
        for i in range(m):  # with both in one loop, and 2 in plain sight, these are vector instructions
            block[2 * i] = _observed(w[LANE_X_END * stride + i], x_offset, x_scale, limit)
            block[2 * i + 1] = _observed(w[LANE_V_END * stride + i], 0.0, v_scale, limit)
        return
    for i in range(m):
        block[size * i] = _observed(w[LANE_X_END * stride + i], x_offset, x_scale, limit)
    place = 1
    if codes[TASK_FULL_STATE]:
        for i in range(m):
            block[size * i + 1] = _observed(w[LANE_V_END * stride + i], 0.0, v_scale, limit)
        place = 2
    if codes[TASK_SEES_BELT]:
        for i in range(m):
            modulation = w[LANE_BELT_END * stride + i] / w[LANE_BELT_SPEED * stride + i]
            block[size * i + place] = _observed(modulation, 1.0, authority, limit)
        place += 1
    for i in range(m):
        for j in range(shown.shape[1]):
            block[size * i + place + j] = shown[first + i, j]


@in_lanes
def lab_belt(excitation, mode, v, v_belt):
    """Return the belt's speed with its ripple, and the velocity relative to it."""
    speed = excitation.lab_velocity(v_belt)
    return speed, 0.0 if mode == STICK else v - speed


# How episodes begin ---------------------------------------------------------------------------------------------------


@in_lanes
def unexcited(plant):
    """Return the plant without its excitation."""
    return Plant(plant.spring, plant.friction, Unexcited(0.0), plant.g1, plant.beta)


@entry
def cycle_points(plant, x, v, v_belt, period):
    """Return the states (CYCLE_POINTS, 2) at phases 0, 1/CYCLE_POINTS, ... of a passive motion with this state at 0.

    A start at any phase is then a short way. A period of 0 means a state and no more.
    """
    points = np.empty((CYCLE_POINTS, 2))
    for j in range(CYCLE_POINTS):
        points[j, 0] = x
        points[j, 1] = v
        if period > 0.0:
            end = follow(plant, UNKNOWN, State(x, v), steady(v_belt), period / CYCLE_POINTS, None, UNTRIED)
            x, v = end.x, end.v
    return points


@in_lanes
def point_before(phase):
    """Return the number of the last of CYCLE_POINTS that is not after a phase in [0, 1]."""
    return min(int(phase * CYCLE_POINTS), CYCLE_POINTS - 1)


@entry
def cycle_state(plant, points, v_belt, period, phase):
    """Return (x, v) at a phase in [0, 1] of the motion whose :func:`cycle_points` are given."""
    j = point_before(phase)
    x, v = points[j, 0], points[j, 1]
    duration = (phase * CYCLE_POINTS - j) * (period / CYCLE_POINTS)
    if duration > 0.0:
        end = follow(plant, UNKNOWN, State(x, v), steady(v_belt), duration, None, UNTRIED)
        x, v = end.x, end.v
    return x, v


@entry
def blank_episodes(state, counts, which):
    """Set all that an episode counts and sums up to its beginning, and the belt to its nominal speed."""
    for i in which:
        for row in range(STATE_TRAVEL, STATE_PLANT):
            state[row, i] = 0.0
        state[STATE_BELT, i] = state[STATE_BELT_SPEED, i]
        state[STATE_LATE_LOW, i] = math.inf
        state[STATE_LATE_HIGH, i] = -math.inf
        counts[COUNT_STEPS, i] = 0
        counts[COUNT_FIRST_STEP, i] = 0
        counts[COUNT_SEEN, i] = 0
        counts[COUNT_OVER, i] = RUNNING
        counts[COUNT_STATUS, i] = OK


@entry
def left_alone(plant, x, v, v_belt):
    """Return the mode, the belt's speed, the velocity relative to it and the normal force of a mass left alone."""
    mode = mode_of(plant, State(x, v), steady(v_belt))
    speed, v_rel = lab_belt(plant.excitation, mode, v, v_belt)
    return mode, speed, v_rel, normal_force(plant, x)


# What episodes came to ------------------------------------------------------------------------------------------------


@entry
def episode_statistics(state, counts, which, replaced, values):
    """Write what the episodes of the environments ``which`` (k,) came to into their columns of ``values`` (8, n).

    Rows: return, length, late amplitude, late stick fraction and the four reward terms. "Late" is the last quarter of
    an episode's time, NaN if it was not reached. ``replaced``: whether a function of the user's gave the rewards.
    """
    for i in which:
        vibration = state[STATE_VIBRATION, i]
        effort = state[STATE_EFFORT, i]
        stick = state[STATE_STICK, i]
        contact_loss = state[STATE_CONTACT_LOSS, i]
        late = state[STATE_LATE_TIME, i]
        values[0, i] = state[STATE_RETURN, i] if replaced else vibration + effort + stick + contact_loss
        values[1, i] = counts[COUNT_STEPS, i] - counts[COUNT_FIRST_STEP, i]
        values[2, i] = 0.5 * (state[STATE_LATE_HIGH, i] - state[STATE_LATE_LOW, i]) if late > 0.0 else math.nan
        values[3, i] = state[STATE_LATE_STICK, i] / late if late > 0.0 else math.nan
        values[4, i] = vibration
        values[5, i] = effort
        values[6, i] = stick
        values[7, i] = contact_loss


@entry
def first_bad(actions):
    """Return the place of the first value of ``actions`` (n,) that is not finite, or -1."""
    bad = 0
    for i in range(len(actions)):  # counting is done in vector instructions, adding numbers or leaving early is not
        bad += 0 if abs(actions[i]) < math.inf else 1
    if bad == 0:
        return -1
    for i in range(len(actions)):
        if not math.isfinite(actions[i]):
            return i
    return -1
