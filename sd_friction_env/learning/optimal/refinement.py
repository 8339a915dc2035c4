"""Local refinement of action sequences: differential dynamic programming, restarted from neighbouring starts."""

from collections.abc import Iterable, Sequence

import numpy as np

from sd_friction_env.control.shooting import backward, derivatives, descend, follow
from sd_friction_env.learning.optimal.problem import Array, Problem, Progress, silent


def refine(
    problem: Problem, actions: Array, iterations: int = 40, progress: Progress = silent, tolerance: float = 1e-7
) -> Array:
    """Improve sequences by differential dynamic programming, never for the worse; return them, shape (n, steps).

    Every iteration is one of :func:`sd_friction_env.control.shooting.descend`. A start whose relative gain stays under
    ``tolerance`` at the strongest damping is finished.
    """
    actions = actions.copy()
    damping = np.full(len(actions), 1e-2)
    active = np.arange(len(actions))
    for _ in progress(range(iterations), "refinement"):
        part = problem.select(active)
        actions[active], before, after = descend(part, part.starts, actions[active], damping[active])
        worthwhile = after - before > tolerance * np.abs(before)
        damping[active] *= np.where(worthwhile, 0.3, 10.0)
        damping = np.maximum(damping, 1e-6)
        active = active[worthwhile | (damping[active] < 1e2)]
        if not active.size:
            break
    return actions


def exchange(problem: Problem, actions: Array, offers: int = 3, reach: int = 40) -> Array:
    """Return sequences from other starts, shape (offers, n, steps), as starting points for :func:`refine`.

    All starts lie on one cycle, so the path of one passes close to the next. A start takes over the rest of a path that
    passes near it, steered onto it by that path's feedback gains.

    Args:
        reach: how many intervals of another path are searched.
    """
    n, size = len(actions), problem.dimensions
    states, _ = problem.rollout(actions)
    _, gains = backward(actions, derivatives(problem, states[:, :-1], actions), np.full(n, 1e-2), True)
    distances = np.linalg.norm(states[None, :, :reach, :size] - problem.starts[:, None, None, :size], axis=-1)
    distances[np.arange(n), np.arange(n)] = np.inf
    joins, nearest = distances.argmin(axis=2), distances.min(axis=2)
    offers = min(offers, n - 1)
    guests = np.argsort(nearest, axis=1)[:, : 4 * offers]
    found, worth = [], []
    for column in guests.T:
        shift = np.minimum(np.arange(problem.steps) + joins[np.arange(n), column][:, None], problem.steps - 1)
        paths, path_actions = states[column[:, None], shift], actions[column[:, None], shift]
        path_gains, unchanged = gains[column[:, None], shift][:, None], np.zeros((n, 1, problem.steps))
        taken, total = follow(problem, problem.starts, paths, path_actions, unchanged, path_gains)
        found.append(taken[:, 0])
        worth.append(total[:, 0])
    best = np.argsort(-np.array(worth), axis=0)[:offers]
    offered: Array = np.array(found)[best, np.arange(n)]
    return offered


def settle(problem: Problem, actions: Array, gains: Sequence[float] = (0.1, 0.25, 0.5, 1.0, 2.0)) -> Array:
    """Replace the end of sequences by velocity feedback where that is better; return them, shape (n, steps).

    A policy from a coarse grid may hold the belt at a node next to its nominal speed, at a small constant cost. A force
    against the velocity, and a belt that follows it, both damp near the equilibrium.
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
            now, reward = problem.step(now, ends[..., t], t)
            totals += reward
        candidates.append(ends[np.arange(n), totals.argmax(axis=1)])
    return best_of(problem, candidates)


def best_of(problem: Problem, candidates: Iterable[Array]) -> Array:
    """Return the best sequence per start of several arrays of shape (n, steps)."""
    stacked = list(candidates)
    returns = np.array([problem.returns(actions) for actions in stacked])
    best: Array = np.array(stacked)[returns.argmax(axis=0), np.arange(len(problem.starts))]
    return best


def improve(problem: Problem, actions: Array, rounds: int, iterations: int = 30, progress: Progress = silent) -> Array:
    """Return sequences after rounds of :func:`exchange` and :func:`refine`, never worse, shape (n, steps)."""
    actions = refine(problem, actions, iterations, progress)
    for _ in range(rounds if len(actions) > 1 else 0):
        offers = exchange(problem, actions)
        everyone = problem.select(np.tile(np.arange(len(actions)), len(offers)))
        offers = refine(everyone, offers.reshape(-1, problem.steps), iterations, progress).reshape(offers.shape)
        actions = best_of(problem, [actions, *offers])
    return actions
