"""Steps of one environment and of many, and how their episodes begin: compiled for each shape of plant."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from sd_friction_env.kernel.automaton import follow
from sd_friction_env.kernel.codes import MAX_SLIP_STEP, OK, UNKNOWN
from sd_friction_env.kernel.compilation import compiled, entry, in_lanes, in_threads
from sd_friction_env.kernel.episodes import (
    CYCLE_POINTS,
    account,
    actuate,
    blank_episodes,
    cycle_state,
    episode_time,
    lab_belt,
    left_alone,
    observe_block,
    observe_one,
    point_before,
    unexcited,
)
from sd_friction_env.kernel.excitation import NO_PHASES, Excitation
from sd_friction_env.kernel.gathering import (
    advance_after_trial,
    advance_lane,
    gather,
    queue_breakaway,
    queue_crossing,
    queue_look,
    scatter_finished,
    scatter_onward,
    scatter_stuck,
    write_lane,
)
from sd_friction_env.kernel.lanes import look_lane, onward_lane, slip_lane, stick_lane
from sd_friction_env.kernel.leaves import reader_of, shape_of
from sd_friction_env.kernel.memory import arrays_in, without_refcount
from sd_friction_env.kernel.plant import Drive, State, at_time, steady
from sd_friction_env.kernel.random import random_uniform
from sd_friction_env.kernel.return_map import (
    REPEATED_BREAKAWAY,
    SETTLING_EXITS,
    SETTLING_LAPS,
    iterate_to_attractor,
    stick_slip_lap,
)
from sd_friction_env.kernel.rows import *
from sd_friction_env.kernel.slip import UNTRIED
from sd_friction_env.kernel.traps import TRAP_ROW


class Steppers(NamedTuple):
    """What runs environments whose plants are of one shape; arrays as in :mod:`sd_friction_env.kernel.rows`."""

    leaves: int  # numbers of a plant
    step_one: Callable[..., Any]
    step_many: Callable[..., int]
    step_in_threads: Callable[..., None]
    observe: Callable[..., None]
    observe_alone: Callable[..., None]
    place_on_cycle: Callable[..., None]
    own_cycle_starts: Callable[..., Any]
    restart: Callable[..., None]
    contact: Callable[..., None]

    @property
    def work_size(self) -> int:
        """How many numbers a call of ``step_many`` works on: two blocks, one for lanes that are gathered anew."""
        return 2 * (LANE_PLANT + self.leaves) * STRIDE


@in_lanes
def _whole(m):
    """Return m rounded up to whole vectors; what is computed in the lanes beyond m is not looked at."""
    return 8 * ((m + 7) // 8)


@compiled
def _fill(w, task, codes, state, actions, first, m):
    """Fill a block with what goes into its step (the plant is there already if all have the same)."""
    for row in range(3):
        source = state[STATE_X + row, first : first + m]
        for i in range(m):
            w[(LANE_X + row) * STRIDE + i] = source[i]
    if codes[TASK_ONE_PLANT] == 0:
        source = state[STATE_BELT_SPEED, first : first + m]
        for i in range(m):
            w[LANE_BELT_SPEED * STRIDE + i] = source[i]
        for leaf in range(len(w) // STRIDE - LANE_PLANT):
            source = state[STATE_PLANT + leaf, first : first + m]
            for i in range(m):
                w[(LANE_PLANT + leaf) * STRIDE + i] = source[i]
    action = actions[first : first + m]
    for i in range(m):
        w[LANE_ACTION * STRIDE + i] = min(max(action[i], -1.0), 1.0)
    for i in range(m):
        actuate(w, i, STRIDE, task, codes)


@compiled
def _report(w, wanted, report, report_codes, first, m):
    for j in range(len(wanted)):
        source = wanted[j] * STRIDE
        place = report[j, first : first + m]
        for i in range(m):
            place[i] = w[source + i]
    for row in range(len(report_codes)):
        code = report_codes[row, first : first + m]
        for i in range(m):
            code[i] = int(w[(LANE_MODE + row) * STRIDE + i])


def steppers(plant: Any) -> Steppers:
    """Return what runs environments whose plants have the shape of this one, compiled when first used."""
    return _steppers_of(shape_of(plant))


@functools.cache
def _steppers_of(shape: Any) -> Steppers:
    read = reader_of(shape)
    leaves = read.leaves
    excited = shape[1][2][0] is Excitation
    side_by_side = not excited  # an excited plant's lanes would not be vector instructions

    @compiled
    def plant_of(state, counts, i, time, tables):
        return at_time(read(state.reshape(-1), STATE_PLANT, state.shape[1], i, tables), time)

    @entry
    def observe(task, codes, state, counts, past, shown, tables, observations, which):
        """Write what the environments ``which`` (k,) observe; see :func:`observe_one`."""
        for i in which:
            plant = plant_of(state, counts, i, episode_time(state, counts, i, task[TASK_INTERVAL]), tables)
            phases = plant.excitation.phases() if codes[TASK_SEES_PHASES] else NO_PHASES
            observe_one(task, codes, state, counts, past, shown, phases, observations, i)

    @entry
    def observe_alone(memory, observations):
        """Write what the one environment whose arrays lie in ``memory`` observes."""
        task, codes, counts, state, _, past, shown, numbers, tables = arrays_in(memory, leaves)
        time = episode_time(state, counts, 0, task[TASK_INTERVAL])
        plant = at_time(read(numbers, 0, 1, 0, tables), time)
        phases = plant.excitation.phases() if codes[TASK_SEES_PHASES] else NO_PHASES
        observe_one(task, codes, state, counts, past, shown, phases, observations, 0)

    @entry
    def step_one(memory, observations, action):
        """Step the one environment whose arrays lie in ``memory`` (:func:`arrays_in`), with an action in [-1, 1].

        Write what it observes into ``observations`` (1, size). Return what ``SDFrictionEnv.step`` puts into info, in
        its order, then the reward and whether the episode was terminated or truncated.
        """
        task, codes, counts, state, w, past, shown, numbers, tables = arrays_in(without_refcount(memory), leaves)
        interval = task[TASK_INTERVAL]
        plant = at_time(read(numbers, 0, 1, 0, tables), counts[COUNT_STEPS, 0] * interval)
        for row in range(3):
            w[LANE_X + row] = state[STATE_X + row, 0]
        w[LANE_BELT_SPEED] = state[STATE_BELT_SPEED, 0]
        w[LANE_ACTION] = action
        actuate(w, 0, 1, task, codes)
        drive = Drive(w[LANE_BELT], w[LANE_A_BELT], w[LANE_U])
        end = follow(plant, UNKNOWN, State(w[LANE_X], w[LANE_V]), drive, interval, None, UNTRIED)
        failures = write_lane(plant, w, 0, 1, end)
        terminated = w[LANE_TERMINATED : LANE_TERMINATED + 1]
        truncated = w[LANE_TRUNCATED : LANE_TRUNCATED + 1]
        account(w, 1, task, codes, state, counts, 0, 1, failures, terminated, truncated)
        then = plant.excitation
        if excited:
            time = episode_time(state, counts, 0, interval)
            then = at_time(read(numbers, 0, 1, 0, tables), time).excitation
        phases = then.phases() if codes[TASK_SEES_PHASES] else NO_PHASES
        observe_one(task, codes, state, counts, past, shown, phases, observations, 0)
        mode = int(w[LANE_MODE])
        v_belt, v_rel = lab_belt(then, mode, state[STATE_V, 0], state[STATE_BELT, 0])
        return (
            w[LANE_X_END],
            w[LANE_V_END],
            v_belt,
            v_rel,
            mode,
            w[LANE_NORMAL],
            w[LANE_TIME],
            w[LANE_U],
            w[LANE_A_BELT],
            w[LANE_X_MIN],
            w[LANE_X_MAX],
            w[LANE_MEAN_V2],
            w[LANE_STICK_FRACTION],
            w[LANE_FRICTION_POWER],
            w[LANE_CONTROL_POWER],
            int(w[LANE_EVENTS]),
            int(w[LANE_STATUS]),
            w[LANE_VIBRATION],
            w[LANE_EFFORT],
            w[LANE_STICK],
            w[LANE_CONTACT_LOSS],
            w[LANE_REWARD],
            w[LANE_TERMINATED] != 0.0,
            w[LANE_TRUNCATED] != 0.0,
        )

    @in_lanes
    def advance_block(w, sub, m, interval, one_plant, tables):
        """Advance m lanes side by side; return how many of them ended with a status other than OK."""
        none = 0 * m  # 0, which numba does not know: it would compile what takes a known number once more
        stuck = 0
        for i in range(m):
            stuck += 1 if w[LANE_V * STRIDE + i] == w[LANE_BELT * STRIDE + i] else 0
        if m > stuck:
            for i in range(_whole(m)):
                slip_lane(read(w, LANE_PLANT, STRIDE, i, tables), w, i, interval)
        else:
            for i in range(m):
                w[LANE_DONE * STRIDE + i] = 0.0
        if stuck > 0:
            # Few or many, those that stick are gathered and stepped side by side.
            n = none
            for i in range(m):
                if w[LANE_V * STRIDE + i] == w[LANE_BELT * STRIDE + i]:
                    gather(w, i, sub, n, one_plant)
                    n += 1
            for i in range(_whole(n)):
                stick_lane(read(sub, LANE_PLANT, STRIDE, i, tables), sub, i, interval)
            n = none
            for i in range(m):
                if w[LANE_V * STRIDE + i] == w[LANE_BELT * STRIDE + i]:
                    scatter_stuck(sub, n, w, i, interval)
                    n += 1
        failures = 0
        n = none
        leaving = 0
        for i in range(m):
            if w[LANE_DONE * STRIDE + i] == 0.0:
                if w[LANE_V * STRIDE + i] == w[LANE_BELT * STRIDE + i]:
                    leaving += 1
                    continue
                plant = read(w, LANE_PLANT, STRIDE, i, tables)
                if queue_look(plant, w, i, sub, n, interval, one_plant):
                    n += 1
                else:
                    failures += advance_after_trial(plant, w, i, sub, n, interval, 1.0)
        if n > 0:
            # Events in the midst of a slip step are looked at side by side as well.
            for i in range(_whole(n)):
                look_lane(read(sub, LANE_PLANT, STRIDE, i, tables), sub, i, interval)
        onward = none
        for j in range(n):
            i = int(sub[LOOK_LANE * STRIDE + j])
            if scatter_finished(w, i, sub, j):
                continue
            plant = read(w, LANE_PLANT, STRIDE, i, tables)
            if queue_crossing(plant, w, i, sub, j, onward, one_plant, interval):
                onward += 1
            else:
                failures += advance_after_trial(plant, w, i, sub, j, interval, 2.0)
        if leaving > 0:
            for i in range(m):
                if w[LANE_DONE * STRIDE + i] == 0.0 and w[LANE_V * STRIDE + i] == w[LANE_BELT * STRIDE + i]:
                    plant = read(w, LANE_PLANT, STRIDE, i, tables)
                    if queue_breakaway(plant, w, i, sub, onward, one_plant, interval):
                        onward += 1
                    elif w[LANE_DONE * STRIDE + i] == 0.0:
                        failures += advance_lane(plant, w, i, interval, UNTRIED)
        if onward > 0:
            # What has left the stick surface slips over the rest of the interval side by side.
            for i in range(_whole(onward)):
                onward_lane(read(sub, LANE_PLANT, STRIDE, i, tables), sub, i)
            for j in range(onward):
                i = int(sub[LOOK_LANE * STRIDE + j])
                if sub[ONWARD_OUTCOME * STRIDE + j] == FINISHED:
                    scatter_onward(w, i, sub, j)
                    w[LANE_V_END * STRIDE + i] = sub[ONWARD_V_END * STRIDE + j]
                    w[LANE_MODE * STRIDE + i] = sub[LOOK_MODE * STRIDE + j]
                    w[LANE_EVENTS * STRIDE + i] = sub[ONWARD_EVENTS * STRIDE + j]
                    w[LANE_STATUS * STRIDE + i] = OK
                else:
                    plant = read(w, LANE_PLANT, STRIDE, i, tables)
                    failures += advance_lane(plant, w, i, interval, UNTRIED)
        return failures

    @entry
    def step_many(
        work,
        start,
        end,
        task,
        codes,
        state,
        counts,
        past,
        shown,
        tables,
        actions,
        wanted,
        observations,
        rewards,
        over,
        report,
        report_codes,
    ):
        """Step the environments from ``start`` to ``end``; return how many of them ended their episode.

        ``work`` (work_size,) is this call's own; with TASK_ONE_PLANT the plant and its belt speed stand in it already
        (:func:`fill_plant`). The belt's travel is only kept with TASK_TRAVEL. ``actions`` (n,) are finite; outside
        [-1, 1] they are clipped. ``wanted`` (k,) are the rows to report. Written are observations (n, size), rewards
        (n,), over (2, n) (terminated, truncated), report (k, n) and report_codes (2, n) or (0, n).
        """
        task, codes, work = without_refcount(task), without_refcount(codes), without_refcount(work)
        tables, state = without_refcount(tables), without_refcount(state)
        counts, past = without_refcount(counts), without_refcount(past)
        shown, actions, wanted = without_refcount(shown), without_refcount(actions), without_refcount(wanted)
        observations, rewards = without_refcount(observations), without_refcount(rewards)
        over, report, report_codes = without_refcount(over), without_refcount(report), without_refcount(report_codes)
        interval = task[TASK_INTERVAL]
        w = work[: len(work) // 2]
        sub = work[len(work) // 2 :]
        one_plant = codes[TASK_ONE_PLANT] == 1
        plain = task[TASK_SENSOR_NOISE] == 0.0 and codes[TASK_SENSOR_DELAY] == 0 and codes[TASK_SEES_PHASES] == 0
        ended = 0
        for first in range(start, end, LANES):
            m = min(LANES, end - first)
            _fill(w, task, codes, state, actions, first, m)
            if side_by_side and interval <= MAX_SLIP_STEP and m > 1:
                failures = advance_block(w, sub, m, interval, one_plant, tables)
            else:
                failures = 0
                for i in range(m):
                    plant = at_time(read(w, LANE_PLANT, STRIDE, i, tables), counts[COUNT_STEPS, first + i] * interval)
                    failures += advance_lane(plant, w, i, interval, UNTRIED)
            terminated = over[0, first : first + m]
            truncated = over[1, first : first + m]
            ended += account(w, STRIDE, task, codes, state, counts, first, m, failures, terminated, truncated)
            reward = rewards[first : first + m]
            for i in range(m):
                reward[i] = w[LANE_REWARD * STRIDE + i]
            _report(w, wanted, report, report_codes, first, m)
            if excited:
                for row in range(len(wanted)):
                    if wanted[row] == LANE_BELT_END or wanted[row] == LANE_V_REL:
                        for i in range(m):
                            j = first + i
                            time = episode_time(state, counts, j, interval)
                            excitation = plant_of(state, counts, j, time, tables).excitation
                            belt, v_rel = lab_belt(
                                excitation, w[LANE_MODE * STRIDE + i], state[STATE_V, j], state[STATE_BELT, j]
                            )
                            report[row, j] = belt if wanted[row] == LANE_BELT_END else v_rel
            if plain:
                observe_block(task, codes, w, STRIDE, shown, observations, first, m)
            else:
                observe(task, codes, state, counts, past, shown, tables, observations, range(first, first + m))
        return ended

    @in_threads
    def step_in_threads(works, bounds, ended, *arguments):
        """``step_many`` side by side: works (k, work_size), bounds (k + 1,) and ended (k,) for k threads."""
        for i in numba.prange(len(ended)):
            ended[i] = step_many(works[i], bounds[i], bounds[i + 1], *arguments)

    @entry
    def place_on_cycle(state, counts, which, points, period, slot, tables):
        """Put the environments ``which`` (k,) at random phases of the passive, unexcited motion with these points.

        ``points``: those of :func:`cycle_points`. ``slot``: that of the random numbers.
        """
        for i in which:
            phase = random_uniform(int(counts[COUNT_KEY, i]), int(counts[COUNT_EPISODE, i]), 0, slot)
            plant = unexcited(plant_of(state, counts, i, 0.0, tables))
            state[STATE_X, i], state[STATE_V, i] = cycle_state(plant, points, state[STATE_BELT_SPEED, i], period, phase)

    @entry
    def restart(task, codes, state, counts, past, shown, tables, observations, which, points, period, slot):
        """Begin the next episodes of the environments ``which`` (k,), with the parameters that they have; observe them.

        They begin where :func:`place_on_cycle` puts them.
        """
        for i in which:
            counts[COUNT_EPISODE, i] += 1
        blank_episodes(state, counts, which)
        place_on_cycle(state, counts, which, points, period, slot, tables)
        observe(task, codes, state, counts, past, shown, tables, observations, which)

    @entry
    def own_cycle_starts(state, counts, which, phases, tables):
        """Put the environments ``which`` (k,) at ``phases`` (k,) of the cycles that each reaches from x = 0.

        A mass is set down there with the belt. Return (k,) flags, 1 where that is no stick-slip cycle that is found at
        once: those states are left alone.
        """
        left = np.zeros(len(which), dtype=np.uint8)
        exits = np.empty(SETTLING_EXITS)
        no_traps = np.empty((0, TRAP_ROW))
        for j in range(len(which)):
            i = which[j]
            speed = state[STATE_BELT_SPEED, i]
            plant = unexcited(plant_of(state, counts, i, 0.0, tables))
            left[j] = 1
            settled = iterate_to_attractor(plant, speed, 0.0, speed, SETTLING_LAPS, exits, no_traps)
            if settled.outcome != REPEATED_BREAKAWAY:
                continue
            lap = stick_slip_lap(plant, speed, settled.x)
            if lap.outcome != REPEATED_BREAKAWAY:
                continue
            # The same steps as cycle_points and cycle_state take, but only as far as needed.
            x, v = settled.x, speed
            before = point_before(phases[j])
            for k in range(before + 1):
                duration = lap.period / CYCLE_POINTS
                if k == before:
                    duration = (phases[j] * CYCLE_POINTS - before) * (lap.period / CYCLE_POINTS)
                if duration > 0.0:
                    motion = follow(plant, UNKNOWN, State(x, v), steady(speed), duration, None, UNTRIED)
                    x, v = motion.x, motion.v
            state[STATE_X, i] = x
            state[STATE_V, i] = v
            left[j] = 0
        return left

    @entry
    def contact(state, counts, which, modes, v_belts, v_rels, normal_forces, tables):
        """Write the mode, the belt's speed, v_rel and the normal force of environments that have just been reset."""
        for j in range(len(which)):
            i = which[j]
            plant = plant_of(state, counts, i, 0.0, tables)
            modes[j], v_belts[j], v_rels[j], normal_forces[j] = left_alone(
                plant, state[STATE_X, i], state[STATE_V, i], state[STATE_BELT, i]
            )

    return Steppers(
        leaves,
        step_one,
        step_many,
        step_in_threads,
        observe,
        observe_alone,
        place_on_cycle,
        own_cycle_starts,
        restart,
        contact,
    )
