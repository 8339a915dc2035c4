"""Action sequences from a value function: greedy rollouts and beam search on the true dynamics."""

import functools
from collections.abc import Callable

import numpy as np

from sd_friction_env.learning.optimal.grid import ValueFunction
from sd_friction_env.learning.optimal.problem import Array, Problem, Progress, silent


def greedy_actions(
    problem: Problem, value: ValueFunction, progress: Progress = silent, count: int = 41, prefix: Array | None = None
) -> Array:
    """Return the action sequences that look one step ahead on the true dynamics, shape (n, steps).

    The value with a whole episode to go is used at later steps too: they differ only close to the end, where little is
    left to gain. Each step tries ``count`` evenly spaced actions, then narrows in around the best.

    Args:
        prefix: actions already chosen, shape (n, m).
    """
    n = len(problem.starts)
    states = problem.starts
    sequences = np.empty((n, problem.steps))
    decided = 0 if prefix is None else prefix.shape[1]
    for t in progress(range(problem.steps), "greedy rollout"):
        if prefix is not None and t < decided:
            sequences[:, t] = prefix[:, t]
        else:
            sequences[:, t] = look_ahead(
                functools.partial(problem.step, t=t),
                functools.partial(value.grid.interpolate, value.after_first),
                states,
                count,
            )
        states, _ = problem.step(states, sequences[:, t], t)
    return sequences


def look_ahead(
    step: Callable[[Array, Array], tuple[Array, Array]], value: Callable[[Array], Array], states: Array, count: int
) -> Array:
    """Return the actions, shape (n,), that are best one step ahead in states of shape (n, 3)."""
    n = len(states)
    centre, width = np.zeros(n), 1.0
    for _ in range(3):
        tried = np.clip(centre[:, None] + width * np.linspace(-1.0, 1.0, count), -1.0, 1.0)
        ends, rewards = step(np.repeat(states[:, None], count, axis=1), tried)
        best = np.argmax(rewards + value(ends), axis=1)
        centre = tried[np.arange(n), best]
        width *= 4.0 / count
    return centre


def deeper(
    step: Callable[[Array, Array], tuple[Array, Array]], value: Callable[[Array], Array], states: Array, count: int
) -> Array:
    """Return what states (..., 3) are worth, shape (...), looking one step further than a value function does."""
    tried = np.broadcast_to(np.linspace(-1.0, 1.0, count), (*states.shape[:-1], count))
    ends, rewards = step(np.repeat(states[..., None, :], count, axis=-2), tried)
    worth: Array = (rewards + value(ends)).max(axis=-1)
    return worth


def beam_actions(
    problem: Problem, value: ValueFunction, width: int, steps: int, progress: Progress = silent, count: int = 21
) -> Array:
    """Return the action sequences found by a beam search with the value as its estimate of the return to come.

    States along the beam are exact: interpolation errs once at its tip, whereas dynamic programming errs at every step.
    That matters on belt, where the best control is many short touches of the belt, each within a cell of the grid.

    Args:
        width: states kept per start at each step, no two of which lie in the same quarter of a cell's edge.
        steps: length of the search; :func:`greedy_actions` finishes the sequences.
        count: evenly spaced actions tried in each state kept.

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
            np.repeat(states[:, :, None], count, axis=2), np.broadcast_to(tried, (n, width, count)), t
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
