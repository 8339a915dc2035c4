"""Dynamic programming on a grid: the best action in every state, up to interpolation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from sd_friction_env.environments.task import passive_motion
from sd_friction_env.learning.optimal.problem import Array, Problem, Progress, silent

SPAN = 1e-6  # of a whole episode's return: at most 5e-4


@dataclass(frozen=True)
class Grid:
    """An even grid over (x, v_rel[, v_belt]), with linear interpolation between its nodes.

    The relative velocity is an axis, with a node at zero, because a mass that sticks has v_rel = 0 exactly and the
    value has a kink there: on a grid over v the kink would cross the cells and be blurred at every step.
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
        ValueError: if the number of sizes or one of them does not fit, or the problem has not one plant that stays.
    """
    env_id, belt_moves = problem.env_id, problem.belt_moves
    if len(sizes) != 2 + belt_moves or min(sizes) < 3:
        raise ValueError(f"{env_id} needs {2 + belt_moves} grid sizes of at least 3, got {tuple(sizes)!r}")
    if len(problem.plants) != 1 or problem.changes:
        raise ValueError(f"a grid is for one plant that does not change, got a problem with {len(problem.plants)}")
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
    v_rel_high = 2.0 * swing + 0.05  # a belt that brakes from its highest to its lowest speed is outrun by that much
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
    """The best return from each node of a grid, over a whole episode and over all but its first step."""

    grid: Grid
    whole: Array
    after_first: Array


def value_iteration(problem: Problem, grid: Grid, actions: Array, progress: Progress = silent) -> ValueFunction:
    """Return V_t = max_a (r_a + T_a V_(t+1)) at t = 0 and 1, from V = 0 after the last step.

    Once a step lowers all values alike (their changes differ by less than ``SPAN``), so does every earlier one, and the
    rest is extrapolated (M. L. Puterman, Markov Decision Processes (1994), section 8.5: the span criterion).

    Args:
        actions: to be tried in every node, shape (n,). On belt the grid's own belt speeds should be among the
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
    """Return the actions to try: evenly spaced ones, or on belt those whose target is a belt speed of the grid."""
    if not problem.belt_moves:
        return np.linspace(-1.0, 1.0, count)
    return np.union1d(np.linspace(-1.0, 1.0, grid.sizes[2]), 0.0)
