"""Optimal control: the score-1 yardstick, computed on the environment's own step.

An optimum is found in three stages, over the whole episode and without discount:

1. dynamic programming on a grid (:func:`value_iteration`): the best action in every state, but for interpolation;
2. greedy rollouts on the true dynamics (:func:`greedy_actions`), one per grid: a feasible action sequence per start;
3. local refinement of the best sequence per start (:func:`refine`: differential dynamic programming on derivatives of
   the event-exact step), restarted from what neighbouring starts found (:func:`exchange`) until nothing improves.

Every number of the reference is the return of an action sequence that the environment really takes, hence a lower
bound on the true optimum. The sequences are stored beside the returns, so that anyone can replay them.

On the randomised tier every episode has a plant of its own, and the optimum knows it: an upper bound on what a
controller can reach that does not. The sensed tier has the nominal plant, starts and reward, hence the nominal optimum:
again an upper bound, for it sees the state.

Computing needs no compiled code of its own: all dynamics go through ``kernel.control_intervals``.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

import sd_friction_env
from sd_friction_env import kernel
from sd_friction_env.control.policies import PolicyFileError, Readings, State
from sd_friction_env.control.pretrained import close
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.environments.task import ACTUATOR_CODES, Task, passive_motion
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import (
    AGENTS,
    file_digest,
    load_arrays,
    parse_json,
    predecessor_hint,
    read_json,
    save_arrays,
    write_json,
)

Array = NDArray[np.float64]
Progress = Callable[[range, str], Iterable[int]]

OPTIMUM_DIRECTORY = AGENTS / "optimum"
TASKS = {"force": "SDFriction/Force-v0", "belt": "SDFriction/BeltSpeed-v0"}
RANDOMISED = {"force": "SDFriction/ForceRandomised-v0", "belt": "SDFriction/BeltSpeedRandomised-v0"}
SENSED = {"force": "SDFriction/ForceSensed-v0", "belt": "SDFriction/BeltSpeedSensed-v0"}
# The files' names; the sensed tier differs from the nominal one only in what a controller sees.
_FILES = {
    **{env_id: task for tier in (TASKS, SENSED) for task, env_id in tier.items()},
    **{env_id: f"{task}-randomised" for task, env_id in RANDOMISED.items()},
}

ACTION_LEVELS = 32767  # stored actions are whole numbers of 1/32767: half the size, and far finer than it matters
SPAN = 1e-6  # of a whole episode's return: at most 5e-4
GOLDEN_STEPS = 60
GOLDEN_TOLERANCE = 1e-7  # other builds round differently, and stick-slip may amplify that; a changed law moves 1e-3
_UNSEEN = ("sensor", "sensor_noise", "sensor_delay", "observation_limit", "x_offset", "x_scale", "v_scale")

_DIFFERENCE = 3e-4  # half-width of central differences: the step is exact to about 1e-11
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01, 0.001)


class DamagedStudyError(RuntimeError):
    """A file of a stored optimum is not what it should be."""


def _silent(steps: range, label: str) -> Iterable[int]:
    return steps


# The problem ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """A task's dynamics and the starts to be steered from, each with the plant of its episode.

    Attributes:
        env_id: the environment's registered id.
        task: its configuration.
        parameters: of the plant of each episode, n of them.
        starts: states (x, v, v_belt), shape (n, 3).
    """

    env_id: str
    task: Task
    parameters: tuple[OscillatorParameters, ...]
    starts: Array

    @property
    def belt_moves(self) -> bool:
        """Whether the belt speed is a state (else it stays at its nominal value)."""
        return self.task.actuator == "belt_speed"

    @property
    def steps(self) -> int:
        """Control intervals in an episode."""
        return self.task.episode_steps

    @property
    def dimensions(self) -> int:
        """Number of state variables that change: 2 or 3."""
        return 3 if self.belt_moves else 2

    @functools.cached_property
    def plants(self) -> dict[OscillatorParameters, NDArray[np.int64]]:
        """The different plants, and the starts that belong to each."""
        found: dict[OscillatorParameters, list[int]] = {}
        for i, parameters in enumerate(self.parameters):
            found.setdefault(parameters, []).append(i)
        return {parameters: np.array(rows) for parameters, rows in found.items()}

    def select(self, rows: NDArray[np.int64]) -> "Problem":
        """Return the problem of some of the starts (which may be repeated)."""
        return dataclasses.replace(
            self, parameters=tuple(self.parameters[row] for row in rows), starts=self.starts[rows]
        )

    def step(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """Return the states one control interval later, shape (..., 3), and the rewards, shape (...).

        Args:
            states: shape (..., 3). actions: in [-1, 1], shape (...). With several plants, the first axis is that of the
                starts.

        Raises:
            RuntimeError: if a mass loses contact with the belt or the integrator gives up.
        """
        if len(self.plants) == 1:
            return _step(self.task, self.parameters[0], states, actions)
        ends, rewards = np.empty_like(states), np.empty(actions.shape)
        for parameters, rows in self.plants.items():
            ends[rows], rewards[rows] = _step(self.task, parameters, states[rows], actions[rows])
        return ends, rewards

    def rollout(self, actions: Array) -> tuple[Array, Array]:
        """Return the states met, shape (n, steps + 1, 3), and the rewards, shape (n, steps), of action sequences.

        Args:
            actions: one sequence per start, shape (n, steps).
        """
        states = np.empty((len(self.starts), self.steps + 1, 3))
        rewards = np.empty(actions.shape)
        states[:, 0] = self.starts
        for t in range(self.steps):
            states[:, t + 1], rewards[:, t] = self.step(states[:, t], actions[:, t])
        return states, rewards

    def returns(self, actions: Array) -> Array:
        """Return the undiscounted sum of rewards of each sequence, shape (n,)."""
        returns: Array = self.rollout(actions)[1].sum(axis=1)
        return returns


def _step(task: Task, parameters: OscillatorParameters, states: Array, actions: Array) -> tuple[Array, Array]:
    """Do what :meth:`Problem.step` says, for one plant."""
    columns = np.ascontiguousarray(states.reshape(-1, 3).T)
    ends = np.empty_like(columns)
    rewards = np.empty(columns.shape[1])
    failures = kernel.control_intervals(
        parameters.plant,
        _actuator(task, parameters),
        *columns,
        np.ascontiguousarray(actions.reshape(-1)),
        *ends,
        rewards,
    )
    if failures:
        raise RuntimeError(f"{failures} of {rewards.size} states lost contact or were not integrated")
    return ends.T.reshape(*actions.shape, 3), rewards.reshape(actions.shape)


def make_problem(env_id: str, seeds: Sequence[int]) -> Problem:
    """Return the problem that an environment poses from the starts, and with the plants, of ``reset(seed=...)``."""
    env = _make(env_id)
    starts = np.empty((len(seeds), 3))
    parameters = []
    for i, seed in enumerate(seeds):
        _, info = env.reset(seed=int(seed))
        starts[i] = info["x"], info["v"], info["v_belt"]
        parameters.append(env.parameters)
    return Problem(env_id, env.task, tuple(parameters), starts)


def _actuator(task: Task, parameters: OscillatorParameters) -> kernel.Actuator:
    return kernel.Actuator(
        ACTUATOR_CODES[task.actuator],
        task.authority,
        task.belt_acceleration_limit,
        parameters.belt_speed,
        task.control_interval,
        task.w_effort,
        task.w_stick,
    )


def _make(env_id: str) -> SDFrictionEnv:
    env = gym.make(env_id).unwrapped
    assert isinstance(env, SDFrictionEnv)
    return env


# Dynamic programming on a grid ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """An even grid over (x, v_rel[, v_belt]), with linear interpolation between its nodes.

    The relative velocity is an axis, with a node at zero, because a mass that sticks has v_rel = 0 exactly and the
    value has a kink there: on a grid over v, the kink would run across the cells and be smeared at every step.
    """

    lows: tuple[float, ...]
    highs: tuple[float, ...]
    sizes: tuple[int, ...]

    def nodes(self, belt_speed: float) -> Array:
        """Return all nodes as states (x, v, v_belt), shape (prod(sizes), 3); ``belt_speed`` where it is no axis."""
        axes = [np.linspace(*axis) for axis in zip(self.lows, self.highs, self.sizes, strict=True)]
        if len(axes) == 2:
            axes.append(np.array([belt_speed]))
        x, v_rel, v_belt = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        return np.stack([x, v_rel + v_belt, v_belt], axis=1)

    def weights(self, states: Array) -> tuple[NDArray[np.int32], Array]:
        """Return the nodes around states and their weights, both of shape (n, 2^dimensions).

        States outside the grid count as the nearest point on its border.
        """
        indices = np.zeros((len(states), 1), np.int32)
        weights = np.ones((len(states), 1))
        coordinates = (states[:, 0], states[:, 1] - states[:, 2], states[:, 2])
        for value, low, high, size in zip(coordinates, self.lows, self.highs, self.sizes, strict=False):
            place = np.clip((value - low) * ((size - 1) / (high - low)), 0.0, size - 1.0)
            cell = np.minimum(place.astype(np.int32), size - 2)
            share = place - cell
            indices = (indices * size)[:, :, None] + np.stack([cell, cell + 1], axis=1)[:, None, :]
            weights = weights[:, :, None] * np.stack([1.0 - share, share], axis=1)[:, None, :]
            indices, weights = indices.reshape(len(states), -1), weights.reshape(len(states), -1)
        return indices, weights

    def interpolate(self, values: Array, states: Array) -> Array:
        """Return ``values`` (one per node) at states of shape (..., 3), shape (...)."""
        indices, weights = self.weights(states.reshape(-1, 3))
        interpolated: Array = np.sum(values[indices] * weights, axis=1)
        return interpolated.reshape(states.shape[:-1])


def make_grid(problem: Problem, sizes: Sequence[int]) -> Grid:
    """Return a grid with room around the passive motion, on which contact is never lost.

    Args:
        problem: of one plant. sizes: nodes along x, v_rel and, where the belt moves, v_belt.

    Raises:
        ValueError: if the number of sizes or one of them does not fit, or the problem has several plants.
    """
    env_id, belt_moves = problem.env_id, problem.belt_moves
    if len(sizes) != 2 + belt_moves or min(sizes) < 3:
        raise ValueError(f"{env_id} needs {2 + belt_moves} grid sizes of at least 3, got {tuple(sizes)!r}")
    if len(problem.plants) != 1:
        raise ValueError(f"a grid is for one plant, got a problem with {len(problem.plants)}")
    parameters = problem.parameters[0]
    cycle = passive_motion(parameters)
    assert cycle is not None
    belt_speed = parameters.belt_speed
    x_min, x_max = min(cycle.x_min, problem.starts[:, 0].min()), max(cycle.x_max, problem.starts[:, 0].max())
    # Above v_b1 passive motion dies out, and an episode starts with a kick.
    amplitude = max(cycle.amplitude, 0.5 * (x_max - x_min), -problem.starts[:, 1].min())
    margin = 0.4 * amplitude
    swing = problem.task.belt_authority * belt_speed if belt_moves else 0.0
    v_rel_low = -(belt_speed + swing + 1.3 * amplitude)
    v_rel_high = 2.0 * swing + 0.05  # a belt that brakes from its highest to its lowest speed is outrun by so much
    # The upper end moves a little, so that a node falls on zero.
    below = min(round((sizes[1] - 1) * v_rel_low / (v_rel_low - v_rel_high)), sizes[1] - 2)
    v_rel_high = -v_rel_low * (sizes[1] - 1 - below) / below
    lows, highs = [x_min - margin, v_rel_low], [x_max + margin, v_rel_high]
    if belt_moves:
        lows.append(belt_speed - swing)
        highs.append(belt_speed + swing)
    return Grid(tuple(lows), tuple(highs), tuple(sizes))


@dataclass(frozen=True)
class ValueFunction:
    """What a grid knows: the best return from each node over a whole episode, and over all but its first step."""

    grid: Grid
    whole: Array
    after_first: Array


def value_iteration(problem: Problem, grid: Grid, actions: Array, progress: Progress = _silent) -> ValueFunction:
    """Return V_t = max_a (r_a + T_a V_(t+1)) at t = 0 and 1, from V = 0 after the last step.

    Once a step lowers all values alike (their changes differ by less than ``SPAN``), so does every earlier one, and the
    rest is extrapolated (M. L. Puterman, Markov Decision Processes (1994), section 8.5: the span criterion).

    Args:
        actions: what is tried in every node, shape (n,). On belt the grid's own belt speeds should be among the
            targets: the belt then moves from node to node, and interpolation does not blur its speed.
    """
    nodes = grid.nodes(float(problem.starts[0, 2]))
    corners = 2**problem.dimensions
    row_starts = np.arange(len(nodes) + 1, dtype=np.int32) * corners
    transitions, rewards = [], []
    for i in progress(range(len(actions)), "transitions"):
        ends, reward = problem.step(nodes, np.full(len(nodes), actions[i]))
        indices, weights = grid.weights(ends)
        shape = (len(nodes), len(nodes))
        transitions.append(scipy.sparse.csr_array((weights.ravel(), indices.ravel(), row_starts), shape=shape))
        rewards.append(reward)
    value = np.zeros(len(nodes))
    previous = value
    for left in progress(range(problem.steps - 1, -1, -1), "backward induction"):
        previous, value = value, np.full(len(nodes), -np.inf)
        for transition, reward in zip(transitions, rewards, strict=True):
            np.maximum(value, reward + transition @ previous, out=value)
        change = value - previous
        if np.ptp(change) < SPAN:
            return ValueFunction(grid, value + left * change, previous + left * change)
    return ValueFunction(grid, value, previous)


def grid_actions(problem: Problem, grid: Grid, count: int = 21) -> Array:
    """Return the actions to try: ``count`` even ones, or on belt those that ask for a belt speed of the grid."""
    if not problem.belt_moves:
        return np.linspace(-1.0, 1.0, count)
    return np.union1d(np.linspace(-1.0, 1.0, grid.sizes[2]), 0.0)


def greedy_actions(
    problem: Problem,
    value: ValueFunction,
    progress: Progress = _silent,
    count: int = 41,
    prefix: Array | None = None,
) -> Array:
    """Return the action sequences that look one step ahead on the true dynamics, shape (n, steps).

    The value with a whole episode to go stands for the later ones too: they differ only close to the end, where nothing
    is left to win. Each step tries ``count`` even actions, then narrows in around the best.

    Args:
        prefix: actions already decided, shape (n, m).
    """
    n = len(problem.starts)
    states = problem.starts
    sequences = np.empty((n, problem.steps))
    decided = 0 if prefix is None else prefix.shape[1]
    for t in progress(range(problem.steps), "greedy rollout"):
        if prefix is not None and t < decided:
            sequences[:, t] = prefix[:, t]
        else:
            sequences[:, t] = _look_ahead(problem.step, value.grid, value.after_first, states, count)
        states, _ = problem.step(states, sequences[:, t])
    return sequences


def _look_ahead(
    step: Callable[[Array, Array], tuple[Array, Array]], grid: Grid, values: Array, states: Array, count: int
) -> Array:
    """Return the actions, shape (n,), that are best one step ahead in states of shape (n, 3)."""
    n = len(states)
    centre, width = np.zeros(n), 1.0
    for _ in range(3):
        tried = np.clip(centre[:, None] + width * np.linspace(-1.0, 1.0, count), -1.0, 1.0)
        ends, rewards = step(np.repeat(states[:, None], count, axis=1), tried)
        best = np.argmax(rewards + grid.interpolate(values, ends), axis=1)
        centre = tried[np.arange(n), best]
        width *= 4.0 / count
    return centre


def beam_actions(
    problem: Problem, value: ValueFunction, width: int, steps: int, progress: Progress = _silent, count: int = 21
) -> Array:
    """Return the action sequences found by a beam search with the value as its estimate of what is to come.

    Along the beam, states are exact: interpolation errs once at its tip, where dynamic programming errs at every step.
    That counts on belt, where the best play is many short touches of the belt, each within a cell of the grid.

    Args:
        width: states kept per start at each step, no two of which lie in the same quarter of a cell's edge.
        steps: length of the search; :func:`greedy_actions` finishes the sequences.
        count: even actions tried in each state kept.

    Returns:
        shape (n, problem.steps).
    """
    n = len(problem.starts)
    tried = np.linspace(-1.0, 1.0, count)
    spacing = (np.array(value.grid.highs) - value.grid.lows) / (np.array(value.grid.sizes) - 1) / 4.0
    states = np.repeat(problem.starts[:, None], width, axis=1)
    totals = np.full((n, width), -np.inf)
    totals[:, 0] = 0.0
    parents, choices = np.empty((steps, n, width), np.int64), np.empty((steps, n, width))
    rows = np.arange(n)[:, None]
    for t in progress(range(steps), "beam search"):
        ends, rewards = problem.step(
            np.repeat(states[:, :, None], count, axis=2), np.broadcast_to(tried, (n, width, count))
        )
        sums = totals[:, :, None] + rewards
        scores = (sums + value.grid.interpolate(value.after_first, ends)).reshape(n, -1)
        # The best of each bucket, then the best buckets of each start: sort by score, stably by bucket, take firsts.
        buckets = np.zeros((n, width * count), np.int64)
        coordinates = (ends[..., 0], ends[..., 1] - ends[..., 2], ends[..., 2])
        for coordinate, edge in zip(coordinates, spacing, strict=False):
            buckets = buckets * 8192 + np.round(coordinate.reshape(n, -1) / edge).astype(np.int64) + 4096
        order = np.argsort(-scores, axis=1, kind="stable")
        by_bucket = np.take_along_axis(order, np.argsort(buckets[rows, order], axis=1, kind="stable"), axis=1)
        sorted_buckets = buckets[rows, by_bucket]
        repeated = np.zeros(sorted_buckets.shape, bool)
        repeated[:, 1:] = sorted_buckets[:, 1:] == sorted_buckets[:, :-1]
        np.put_along_axis(scores, by_bucket, np.where(repeated, -np.inf, scores[rows, by_bucket]), axis=1)
        kept = np.argpartition(-scores, width - 1, axis=1)[:, :width]
        parents[t], choices[t] = kept // count, tried[kept % count]
        totals = sums.reshape(n, -1)[rows, kept]
        totals[np.isneginf(scores[rows, kept])] = -np.inf
        states = ends.reshape(n, -1, 3)[rows, kept]
    place = np.argmax(totals + value.grid.interpolate(value.after_first, states), axis=1)
    sequences = np.empty((n, steps))
    for t in reversed(range(steps)):
        sequences[:, t] = choices[t, np.arange(n), place]
        place = parents[t, np.arange(n), place]
    return greedy_actions(problem, value, progress, prefix=sequences)


# Local refinement -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Derivatives:
    """The step linearised along sequences: next state f and cost c over z = (state, action), d = dimensions + 1.

    Attributes:
        f_z: shape (n, steps, dimensions, d). f_zz: shape (n, steps, dimensions, d, d).
        c_z: shape (n, steps, d). c_zz: shape (n, steps, d, d).
    """

    f_z: Array
    f_zz: Array
    c_z: Array
    c_zz: Array


def _derivatives(problem: Problem, states: Array, actions: Array) -> _Derivatives:
    """Return central differences of the step around states (n, steps, 3) and actions (n, steps)."""
    size = problem.dimensions
    d = size + 1
    h = _DIFFERENCE

    def at(*moves: tuple[int, float]) -> Array:
        """Return next state and cost, shape (n, steps, d), with some of the variables moved."""
        moved, moved_actions = states.copy(), actions.copy()
        for i, by in moves:
            if i < size:
                moved[..., i] += by
            else:
                moved_actions += by
        ends, rewards = problem.step(moved, moved_actions)
        return np.concatenate([ends[..., :size], -rewards[..., None]], axis=-1)

    middle = at()
    up = [at((i, h)) for i in range(d)]
    down = [at((i, -h)) for i in range(d)]
    first = np.stack([(up[i] - down[i]) / (2.0 * h) for i in range(d)], axis=-1)
    second = np.empty((*first.shape, d))
    for i in range(d):
        second[..., i, i] = (up[i] - 2.0 * middle + down[i]) / (h * h)
        for j in range(i):
            both = at((i, h), (j, h)) + at((i, -h), (j, -h)) - up[i] - down[i] - up[j] - down[j] + 2.0 * middle
            second[..., i, j] = second[..., j, i] = both / (2.0 * h * h)
    return _Derivatives(first[:, :, :size], second[:, :, :size], first[:, :, size], second[:, :, size])


def _backward(problem: Problem, actions: Array, at: _Derivatives, damping: Array, curved: bool) -> tuple[Array, Array]:
    """Return the change of action, shape (n, steps), and its gain on a change of state, shape (n, steps, dimensions),
    that minimise the quadratic model of the cost to go.

    Args:
        damping: added to the curvature in the action, shape (n,).
        curved: whether the curvature of the dynamics counts (differential dynamic programming; else Gauss and Newton).
    """
    n, steps = actions.shape
    size = problem.dimensions
    changes, gains = np.zeros((n, steps)), np.zeros((n, steps, size))
    v_s, v_ss = np.zeros((n, size)), np.zeros((n, size, size))
    for t in reversed(range(steps)):
        f_z = at.f_z[:, t]
        f_z_transposed = f_z.transpose(0, 2, 1)
        q_z = at.c_z[:, t] + (f_z_transposed @ v_s[:, :, None])[:, :, 0]
        q_zz = at.c_zz[:, t] + f_z_transposed @ v_ss @ f_z
        if curved:
            q_zz = q_zz + np.einsum("ni,nijk->njk", v_s, at.f_zz[:, t])
        q_a, q_s = q_z[:, size], q_z[:, :size]
        q_aa, q_as, q_ss = q_zz[:, size, size], q_zz[:, size, :size], q_zz[:, :size, :size]
        curvature = np.maximum(np.abs(q_aa), 1e-4) + damping
        wanted = -q_a / curvature
        change = np.clip(wanted, -1.0 - actions[:, t], 1.0 - actions[:, t])
        gain = np.where((change == wanted)[:, None], -q_as / curvature[:, None], 0.0)
        changes[:, t], gains[:, t] = change, gain
        v_s = q_s + gain * (q_aa * change + q_a)[:, None] + q_as * change[:, None]
        cross = gain[:, :, None] * q_as[:, None, :]
        v_ss = q_ss + q_aa[:, None, None] * gain[:, :, None] * gain[:, None, :] + cross + cross.transpose(0, 2, 1)
        # A kink of the step (an event that enters or leaves the interval) can give a curvature that means nothing.
        np.clip(v_ss, -1e4, 1e4, out=v_ss)
        np.clip(v_s, -1e4, 1e4, out=v_s)
    return changes, gains


def _follow(problem: Problem, states: Array, actions: Array, changes: Array, gains: Array) -> tuple[Array, Array]:
    """Return the actions taken, shape (n, m, steps), and the returns, shape (n, m), of changed sequences that are
    steered back to their quadratic model along the way.

    Args:
        states: (n, steps + 1, 3). actions: (n, steps). changes: (n, m, steps). gains: (n, m, steps, dimensions).
    """
    n, m, steps = changes.shape
    size = problem.dimensions
    taken, returns = np.empty((n, m, steps)), np.zeros((n, m))
    now = np.repeat(states[:, None, 0], m, axis=1)
    for t in range(steps):
        off = now[..., :size] - states[:, None, t, :size]
        wanted = actions[:, None, t] + changes[..., t] + np.sum(gains[..., t, :] * off, axis=-1)
        taken[..., t] = np.clip(wanted, -1.0, 1.0)
        now, rewards = problem.step(now, taken[..., t])
        returns += rewards
    return taken, returns


def refine(
    problem: Problem, actions: Array, iterations: int = 40, progress: Progress = _silent, tolerance: float = 1e-7
) -> Array:
    """Return sequences that differential dynamic programming made better (never worse), shape (n, steps).

    Every iteration tries both quadratic models of :func:`_backward` at several step lengths and keeps the best rollout
    per start. A start whose relative gain stays under ``tolerance`` at the strongest damping is left alone.
    """
    actions = actions.copy()
    damping = np.full(len(actions), 1e-2)
    active = np.arange(len(actions))
    lengths = np.array(_STEP_LENGTHS)[:, None]
    for _ in progress(range(iterations), "refinement"):
        part = problem.select(active)
        mine = actions[active]
        states, rewards = part.rollout(mine)
        before = rewards.sum(axis=1)
        at = _derivatives(part, states[:, :-1], mine)
        all_changes, all_gains = [], []
        for curved in (True, False):
            changes, gains = _backward(part, mine, at, damping[active], curved)
            all_changes.append(lengths * changes[:, None])
            all_gains.append(np.repeat(gains[:, None], len(lengths), axis=1))
        taken, returns = _follow(part, states, mine, np.concatenate(all_changes, 1), np.concatenate(all_gains, 1))
        best = np.argmax(returns, axis=1)
        after = returns[np.arange(len(active)), best]
        better = after > before
        actions[active[better]] = taken[np.arange(len(active)), best][better]
        worthwhile = after - before > tolerance * np.abs(before)
        damping[active] *= np.where(worthwhile, 0.3, 10.0)
        damping = np.maximum(damping, 1e-6)
        active = active[worthwhile | (damping[active] < 1e2)]
        if not active.size:
            break
    return actions


def exchange(problem: Problem, actions: Array, offers: int = 3, reach: int = 40) -> Array:
    """Return what other starts' sequences are worth here, shape (offers, n, steps): starting points for :func:`refine`.

    All starts lie on one cycle, so the path of one passes close by the next. A start takes over the rest of a path that
    it lies beside, steered onto it by that path's feedback gains.

    Args:
        reach: how many intervals into another path are looked at.
    """
    n, size = len(actions), problem.dimensions
    states, _ = problem.rollout(actions)
    _, gains = _backward(problem, actions, _derivatives(problem, states[:, :-1], actions), np.full(n, 1e-2), True)
    distances = np.linalg.norm(states[None, :, :reach, :size] - problem.starts[:, None, None, :size], axis=-1)
    distances[np.arange(n), np.arange(n)] = np.inf
    joins, nearest = distances.argmin(axis=2), distances.min(axis=2)
    offers = min(offers, n - 1)
    guests = np.argsort(nearest, axis=1)[:, : 4 * offers]
    found, worth = [], []
    for column in guests.T:
        shift = np.minimum(np.arange(problem.steps) + joins[np.arange(n), column][:, None], problem.steps - 1)
        paths, path_actions = states[column[:, None], shift], actions[column[:, None], shift]
        path_gains = gains[column[:, None], shift]
        now = problem.starts
        taken, total = np.empty_like(actions), np.zeros(n)
        for t in range(problem.steps):
            off = now[:, :size] - paths[:, t, :size]
            taken[:, t] = np.clip(path_actions[:, t] + np.sum(path_gains[:, t] * off, axis=1), -1.0, 1.0)
            now, rewards = problem.step(now, taken[:, t])
            total += rewards
        found.append(taken)
        worth.append(total)
    best = np.argsort(-np.array(worth), axis=0)[:offers]
    offered: Array = np.array(found)[best, np.arange(n)]
    return offered


def settle(problem: Problem, actions: Array, gains: Sequence[float] = (0.1, 0.25, 0.5, 1.0, 2.0)) -> Array:
    """Return sequences that end in velocity feedback where that is better (never worse), shape (n, steps).

    A policy from a coarse grid may let the belt rest at a node beside its nominal speed, which costs little and for
    ever. A force works against the velocity, a belt follows it: near the equilibrium, both damp.
    """
    n, m = len(actions), len(gains)
    states, rewards = problem.rollout(actions)
    authority = problem.task.authority * (problem.starts[:, 2] if problem.belt_moves else -np.ones(n))
    factors = np.array(gains) / authority[:, None]
    candidates = [actions]
    for first in range(problem.steps // 5, problem.steps, max(1, problem.steps // 20)):
        ends, totals = np.repeat(actions[:, None], m, axis=1), np.zeros((n, m))
        now = np.repeat(states[:, None, first], m, axis=1)
        for t in range(first, problem.steps):
            ends[..., t] = np.clip(factors * now[..., 1], -1.0, 1.0)
            now, reward = problem.step(now, ends[..., t])
            totals += reward
        candidates.append(ends[np.arange(n), totals.argmax(axis=1)])
    return best_of(problem, candidates)


def best_of(problem: Problem, candidates: Iterable[Array]) -> Array:
    """Return the best sequence per start of several arrays of shape (n, steps)."""
    stacked = list(candidates)
    returns = np.array([problem.returns(actions) for actions in stacked])
    best: Array = np.array(stacked)[returns.argmax(axis=0), np.arange(len(problem.starts))]
    return best


def improve(problem: Problem, actions: Array, rounds: int, iterations: int = 30, progress: Progress = _silent) -> Array:
    """Return sequences after rounds of :func:`exchange` and :func:`refine`, never worse, shape (n, steps)."""
    actions = refine(problem, actions, iterations, progress)
    for _ in range(rounds if len(actions) > 1 else 0):
        offers = exchange(problem, actions)
        everyone = problem.select(np.tile(np.arange(len(actions)), len(offers)))
        offers = refine(everyone, offers.reshape(-1, problem.steps), iterations, progress).reshape(offers.shape)
        actions = best_of(problem, [actions, *offers])
    return actions


# Storage --------------------------------------------------------------------------------------------------------------


def encode(actions: Array) -> NDArray[np.int16]:
    """Return actions in [-1, 1] as whole numbers of 1/32767."""
    return np.round(actions * ACTION_LEVELS).astype(np.int16)


def decode(levels: NDArray[np.int16]) -> NDArray[np.float32]:
    """Return stored actions as the environment takes them."""
    return (levels / ACTION_LEVELS).astype(np.float32)


def fingerprint(env_id: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return what a stored optimum depends on: configuration, starts (x, v) and a golden rollout, all JSON values.

    Where parameters are randomised, ``draws`` holds those of each seed, in the order of their names.
    """
    env = _make(env_id)
    task = {name: value for name, value in dataclasses.asdict(env.task).items() if name not in _UNSEEN}
    configuration = {"task": task, "parameters": dataclasses.asdict(env.nominal)}
    problem = make_problem(env_id, seeds)
    names = sorted(env.task.randomise or ())
    draws = {"draws": [[getattr(plant, name) for name in names] for plant in problem.parameters]} if names else {}
    env.reset(options={"x": 0.0}, seed=0)
    golden = []
    for t in range(GOLDEN_STEPS):
        # Three intervals of push, then another: crosses, sticks and breaks away, on both actuators.
        action = np.array([(7 * (t // 3) % 11) / 5.0 - 1.0], np.float32)
        _, reward, _, _, info = env.step(action)
        golden.append([info["x"], info["v"], info["v_belt"], float(reward)])
    starts = problem.starts[:, :2].tolist()
    return {"configuration": json.loads(json.dumps(configuration)), "starts": starts, **draws, "golden": golden[4::5]}


def check_fingerprint(stored: dict[str, Any], env_id: str, seeds: Sequence[int]) -> None:
    """Raise unless the environment still is the one that a stored optimum was computed for.

    Raises:
        RuntimeError: naming what changed.
    """
    now = fingerprint(env_id, seeds)
    changed = []
    for part, values in now["configuration"].items():
        # An argument that is new since then has a default; whether that changes anything, the golden rollout tells.
        configuration = stored.get("configuration")
        before = configuration.get(part) if isinstance(configuration, dict) else None
        if not isinstance(before, dict) or not before:
            changed.append(f"{part}: nothing is stored of it")
            continue
        names = sorted(name for name in before if before[name] != values.get(name))
        changed += [f"{part} {name}: {before.get(name)!r} -> {values.get(name)!r}" for name in names]
    for part, what in (
        ("starts", "the starts of the evaluation seeds"),
        ("draws", "the parameters of the evaluation seeds"),
        ("golden", "the dynamics or the reward"),
    ):
        if not close(stored.get(part, []), now.get(part, []), GOLDEN_TOLERANCE):
            changed.append(what)
    if changed:
        raise RuntimeError(
            f"the stored optimum of {env_id} was computed for another environment ({'; '.join(changed)}): "
            f"recompute it with `{_command(env_id)}`"
        )


def _paths(env_id: str, directory: Path) -> tuple[Path, Path]:
    return directory / f"{_FILES[env_id]}.json", directory / f"{_FILES[env_id]}.npz"


def save_optimum(
    problem: Problem, seeds: Sequence[int], actions: Array, about: dict[str, Any], directory: Path = OPTIMUM_DIRECTORY
) -> Array:
    """Store sequences, the returns of what is stored, and the fingerprint. Return those returns, shape (n,).

    Files that are there are kept as their predecessors, "NAME.previous".

    Args:
        actions: shape (n, steps). about: JSON values that say how they were found.
    """
    levels = encode(actions)
    returns = problem.returns(decode(levels).astype(np.float64))
    table, sequences = _paths(problem.env_id, directory)
    directory.mkdir(parents=True, exist_ok=True)
    save_arrays(sequences, {"levels": levels}, compress=True, keep=True)
    content = {
        "env_id": problem.env_id,
        "mean_return": float(returns.mean()),
        **about,
        "seeds": [int(seed) for seed in seeds],
        "returns": returns.tolist(),
        "fingerprint": fingerprint(problem.env_id, seeds),
        "sequences": f"sha256:{file_digest(sequences)}",
    }
    write_json(table, content, indent=None, keep=True)  # one number list per line: small, and a change shows as one
    return returns


def stored_study(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> dict[str, Any]:
    """Return all that the table of a stored optimum says, among it ``command``, ``stages`` (mean return by stage) and
    ``value_estimates`` (mean by grid).

    Raises:
        FileNotFoundError: if nothing is stored for the id.
        DamagedStudyError: if the file is not such a table.
    """
    env_id = _bare_id(env_id)
    if env_id not in _FILES or not _paths(env_id, directory)[0].exists():
        there = [name for name in _FILES if _paths(name, directory)[0].exists()]
        raise FileNotFoundError(f"no optimum is stored for {env_id!r}; stored: {', '.join(there) or 'none'}")
    path = _paths(env_id, directory)[0]
    try:
        content: dict[str, Any] = read_json(path)
        of, seeds, returns = content["env_id"], content["seeds"], np.array(content["returns"], dtype=float)
        if _FILES.get(of) != _FILES[env_id]:
            raise ValueError(f"it is of {of!r}")
        if not seeds or returns.shape != (len(seeds),) or any(type(seed) is not int for seed in seeds):
            raise ValueError("it must hold one return for each of one or more seeds")
        if not np.isfinite(returns).all():
            raise ValueError("a return is not finite")
        if not isinstance(content["fingerprint"], dict):
            raise ValueError("its fingerprint is none")
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DamagedStudyError(_damaged(path, env_id, error)) from None
    return content


def _damaged(path: Path, env_id: str, error: Exception) -> str:
    return (
        f"{str(path)!r} does not hold the optimum of {env_id}, or is damaged ({type(error).__name__}: {error})"
        f"{predecessor_hint(path)}: recompute it with `{_command(env_id)}`"
    )


def _command(env_id: str) -> str:
    task, _, randomised = _FILES[env_id].partition("-")
    return f"sd-friction optimum --task {task}" + (" --tier randomised" if randomised else "")


@functools.lru_cache(maxsize=8)
def _checked_table(env_id: str, directory: Path) -> dict[int, float]:
    stored = stored_study(env_id, directory)
    check_fingerprint(stored["fingerprint"], env_id, stored["seeds"])
    return dict(zip(stored["seeds"], stored["returns"], strict=True))


def stored_returns(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> dict[int, float] | None:
    """Return the best known returns that are stored for an id, by seed; None if there are none. See
    :func:`optimal_returns`.

    Raises:
        RuntimeError: if the environment has changed since they were computed, or (DamagedStudyError) the file cannot be
            read.
    """
    env_id = _bare_id(env_id)
    if env_id not in _FILES or not _paths(env_id, directory)[0].exists():
        return None
    return dict(_checked_table(env_id, directory))


def _bare_id(env_id: str) -> str:
    return env_id.rpartition(":")[2]


def optimal_returns(
    env_id: str, seeds: Sequence[int], directory: Path = OPTIMUM_DIRECTORY
) -> NDArray[np.float64] | None:
    """Return the best known undiscounted return from the starts of ``reset(seed=...)``, shape (n,).

    On the randomised tier it is that of a controller which knows each episode's parameters, on the sensed tier that of
    one which sees the state (the nominal optimum: plant, starts and reward are the same): upper bounds on what those
    can reach that do not. None if the id has no reference.

    Raises:
        ValueError: if a seed is not among those stored.
        RuntimeError: if the environment has changed since the reference was computed, or (DamagedStudyError) its file
            cannot be read.
    """
    env_id = _bare_id(env_id)
    table = stored_returns(env_id, directory)
    if table is None:
        return None
    missing = [int(seed) for seed in seeds if int(seed) not in table]
    if missing:
        raise ValueError(
            f"no optimum is stored for seed {missing[0]} of {env_id}; stored: {min(table)} to {max(table)} "
            f"({len(table)} seeds)"
        )
    return np.array([table[int(seed)] for seed in seeds])


def optimal_actions(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> tuple[list[int], NDArray[np.float32]]:
    """Return the stored seeds and their action sequences, shape (n, steps).

    Raises:
        FileNotFoundError: if nothing is stored for the id.
        DamagedStudyError: if a file is not what it should be.
    """
    stored = stored_study(env_id, directory)
    path = _paths(_bare_id(env_id), directory)[1]
    if not path.exists():
        raise FileNotFoundError(f"there is no file of actions {str(path)!r}")
    try:
        digest = f"sha256:{file_digest(path)}"
        if stored.get("sequences", digest) != digest:
            raise ValueError("it is not the file that was stored with the table of returns")
        levels = load_arrays(path, "i")["levels"]
        if levels.ndim != 2 or len(levels) != len(stored["seeds"]) or levels.dtype != np.int16:
            raise ValueError(f"levels {levels.dtype} {levels.shape} are not those of {len(stored['seeds'])} seeds")
    except (OSError, KeyError, ValueError) as error:
        raise DamagedStudyError(_damaged(path, _bare_id(env_id), error)) from None
    return stored["seeds"], decode(levels)


# A controller that acts on a value function ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """Looks one control interval ahead on the nominal plant and takes the action with the best reward and value.

    It offers what :mod:`policies` says of all controllers, and needs to see the velocity. States
    outside of the grid count as the nearest on its border.

    Attributes:
        task, parameters: of the environment the value was computed for.
        readings: how its observations are turned back into x, v and v_belt.
        grid: of the value function. values: best return still to come from each node, shape (prod(sizes),).
        count: even actions tried, three times, ever closer to the best.

    Raises:
        ValueError: if there is not one finite value for each node.
    """

    task: Task
    parameters: OscillatorParameters
    readings: Readings
    grid: Grid
    values: Array
    count: int = 41

    def __post_init__(self) -> None:
        nodes = math.prod(self.grid.sizes)
        if self.values.shape != (nodes,) or not np.isfinite(self.values).all():
            raise ValueError(f"values must be {nodes} finite numbers, got shape {self.values.shape}")

    @classmethod
    def load(cls, env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> Self:
        """Return the stored policy of a nominal task; it runs on the randomised tier too, and takes its plant there to
        be the nominal one.

        Raises:
            FileNotFoundError: if none is stored for the id.
            RuntimeError: if the environment has changed since its value function was computed.
            PolicyFileError: if the file cannot be read.
        """
        env_id = _bare_id(env_id)
        path = _value_path(env_id, directory) if env_id in TASKS.values() else None
        if path is None or not path.exists():
            raise FileNotFoundError(f"no value function is stored for {env_id!r}; allowed: {', '.join(TASKS.values())}")
        env = _make(env_id)
        try:
            arrays = load_arrays(path, "f", texts=("fingerprint",))
            lows, highs, values = arrays["lows"], arrays["highs"], arrays["values"]
            stored = parse_json(str(arrays["fingerprint"]))
            if not isinstance(stored, dict):
                raise ValueError("its fingerprint is none")
            dimensions = 2 + (env.task.actuator == "belt_speed")
            if not values.ndim == dimensions == lows.size == highs.size or min(values.shape) < 2:
                raise ValueError(f"values {values.shape} and bounds {lows.shape}, {highs.shape} do not fit")
            if not (lows < highs).all():
                raise ValueError(f"bounds {lows.tolist()} to {highs.tolist()} cannot be")
            grid = Grid(tuple(lows.tolist()), tuple(highs.tolist()), values.shape)
            policy = cls(env.task, env.nominal, Readings.from_env(env), grid, values.ravel().astype(np.float64))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise PolicyFileError(
                f"{str(path)!r} is no value function, or is damaged ({type(error).__name__}: {error})"
                f"{predecessor_hint(path)}: compute it again with `{_command(env_id)} --policy`"
            ) from None
        check_fingerprint(stored, env_id, [])
        return policy

    def actions(self, states: Array) -> Array:
        """Return the best actions in states (x, v, v_belt) of shape (n, 3), shape (n,)."""
        lows, highs = self.grid.lows, self.grid.highs
        x = np.clip(states[:, 0], lows[0], highs[0])  # beyond the grid the mass may lose contact on the way
        v_belt = np.clip(states[:, 2], lows[2], highs[2]) if len(lows) == 3 else states[:, 2]
        v = np.clip(states[:, 1] - v_belt, lows[1], highs[1]) + v_belt
        # The reading of a stuck mass is rounded: it is put back on the belt.
        v = np.where(np.abs(v - v_belt) < 1e-7, v_belt, v)
        step = functools.partial(_step, self.task, self.parameters)
        return _look_ahead(step, self.grid, self.values, np.stack([x, v, v_belt], axis=1), self.count)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], State]:
        """Return the best actions for one observation or a batch of them; see :mod:`policies`.

        Raises:
            ValueError: if an observation is not finite or too short.
        """
        values = self.readings.read(observation)
        if not np.isfinite(values).all():
            raise ValueError("observation must be finite")
        states = np.full((*values.shape[:-1], 3), self.parameters.belt_speed)
        states[..., 0] = values[..., 0] + self.readings.x_equilibrium
        states[..., 1] = values[..., 1]
        if self.task.actuator == "belt_speed":
            states[..., 2] += self.readings.authority * values[..., 2]
        actions = self.actions(states.reshape(-1, 3))
        return actions.astype(np.float32).reshape(*values.shape[:-1], 1), None


def _value_path(env_id: str, directory: Path) -> Path:
    return directory / f"{_FILES[env_id]}-value.npz"


def save_value(problem: Problem, value: ValueFunction, directory: Path = OPTIMUM_DIRECTORY) -> Path:
    """Store a value function of a nominal task for :meth:`OptimalPolicy.load`, in single precision; return its path.

    Raises:
        ValueError: if the problem is not that of a nominal task.
        OSError: if the file cannot be written.
    """
    if problem.env_id not in TASKS.values():
        raise ValueError(f"env_id must be one of {', '.join(TASKS.values())}, got {problem.env_id!r}")
    path = _value_path(problem.env_id, directory)
    directory.mkdir(parents=True, exist_ok=True)
    content = {
        "values": value.after_first.reshape(value.grid.sizes).astype(np.float32),
        "lows": np.array(value.grid.lows),
        "highs": np.array(value.grid.highs),
        "fingerprint": np.array(json.dumps(fingerprint(problem.env_id, []))),
    }
    save_arrays(path, content, compress=True, keep=True)
    return path


# All of it ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Study:
    """An optimum and how it was arrived at.

    Attributes:
        actions: the best sequences, shape (n, steps).
        stages: mean return by stage, in order.
        estimates: the value functions' own mean estimates by grid.
    """

    actions: Array
    stages: dict[str, float]
    estimates: dict[str, float]


def find_optimum(
    problem: Problem,
    grids: Sequence[Sequence[int]],
    *,
    beam: int,
    rounds: int,
    known: Array | None = None,
    progress: Progress = _silent,
    report: Callable[[str, float], None] = lambda stage, value: None,
) -> Study:
    """Return the best sequences that several grids, beam searches and refinement find.

    Args:
        grids: sizes along x, v_rel and, on belt, v_belt. beam: width of the beam searches. rounds: of exchange.
        known: sequences to start from as well. report: told each stage's name and mean return.
    """
    stages: dict[str, float] = {}
    estimates: dict[str, float] = {}
    candidates = [np.zeros((len(problem.starts), problem.steps))]

    def note(stage: str, actions: Array) -> None:
        candidates.append(actions)
        stages[stage] = float(problem.returns(actions).mean())
        report(stage, stages[stage])

    note("passive", candidates.pop())
    if known is not None:
        note("stored before", known)
    for sizes in grids:
        name = "x".join(map(str, sizes))
        estimate = np.empty(len(problem.starts))
        greedy, searched = np.empty_like(candidates[0]), np.empty_like(candidates[0])
        plants = list(problem.plants.values())
        for i in progress(range(len(plants)), f"plants on {name}") if len(plants) > 1 else (0,):
            rows = plants[i]
            part = problem.select(rows)
            grid = make_grid(part, sizes)
            value = value_iteration(part, grid, grid_actions(part, grid), progress)
            estimate[rows] = grid.interpolate(value.whole, part.starts)
            greedy[rows] = greedy_actions(part, value, progress)
            if beam:
                searched[rows] = beam_actions(part, value, beam, min(200, problem.steps), progress)
        estimates[name] = float(estimate.mean())
        report(f"value function's estimate {name}", estimates[name])
        note(f"greedy {name}", greedy)
        if beam:
            note(f"beam {beam} {name}", searched)
            note(f"beam {beam} {name}, refined", refine(problem, searched, 30, progress))
    note("best of these per start", best_of(problem, candidates))
    note("ended in velocity feedback where that is better", settle(problem, candidates[-1]))
    note(f"refined, {rounds} rounds of exchange", improve(problem, candidates[-1], rounds, progress=progress))
    return Study(candidates[-1], stages, estimates)


def versions() -> dict[str, str]:
    """Return the versions of what computes an optimum."""
    return {"sd_friction_env": sd_friction_env.__version__, "numpy": np.__version__, "scipy": scipy.__version__}
