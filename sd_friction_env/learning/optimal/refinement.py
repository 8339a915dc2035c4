"""Local refinement of action sequences: differential dynamic programming, restarted from neighbouring starts."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sd_friction_env.learning.optimal.problem import Array, Problem, Progress, silent

_DIFFERENCE = 1e-4  # half-width of central differences of the exact Jacobian
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01, 0.001)


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
    """Return the exact derivatives of the step along states (n, steps, 3) and actions (n, steps).

    The second ones are central differences of the first.
    """
    size, h = problem.dimensions, _DIFFERENCE
    rows, columns = [*range(size), -1], [*range(size), -1]  # the reward and the action are the last

    def at(moved: int, by: float) -> Array:
        """Return the Jacobian of next state and cost, shape (n, steps, d, d), with one of the variables moved."""
        actions_there, states_there = actions, states.copy()
        if moved < size:
            states_there[..., moved] += by
        else:
            actions_there = np.clip(actions, -1.0 + h, 1.0 - h) + by
        found = problem.jacobians(states_there, actions_there)[..., rows, :][..., columns]
        found[..., -1, :] *= -1.0
        return np.nan_to_num(found)  # next to a loss of contact: only the quadratic model is worse for it

    first = at(0, 0.0)
    second = np.stack([(at(i, h) - at(i, -h)) / (2.0 * h) for i in range(size + 1)], axis=-1)
    second = 0.5 * (second + np.swapaxes(second, -1, -2))
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
        # A kink of the step (an event that enters or leaves the interval) can give a meaningless curvature.
        np.clip(v_ss, -1e4, 1e4, out=v_ss)
        np.clip(v_s, -1e4, 1e4, out=v_s)
    return changes, gains


def _follow(
    problem: Problem, starts: Array, states: Array, actions: Array, changes: Array, gains: Array
) -> tuple[Array, Array]:
    """Return the actions taken, shape (n, m, steps), and the returns, shape (n, m), of changed sequences with feedback
    towards the states of their quadratic model.

    Args:
        starts: (n, 3). states, actions: of the model, (n, steps or more, 3) and (n, steps).
        changes: (n, m, steps). gains: (n, m, steps, dimensions).
    """
    n, m, steps = changes.shape
    size = problem.dimensions
    taken, returns = np.empty((n, m, steps)), np.zeros((n, m))
    now = np.repeat(starts[:, None], m, axis=1)
    for t in range(steps):
        off = now[..., :size] - states[:, None, t, :size]
        wanted = actions[:, None, t] + changes[..., t] + np.sum(gains[..., t, :] * off, axis=-1)
        taken[..., t] = np.clip(wanted, -1.0, 1.0)
        now, rewards = problem.step(now, taken[..., t], t)
        returns += rewards
    return taken, returns


def refine(
    problem: Problem, actions: Array, iterations: int = 40, progress: Progress = silent, tolerance: float = 1e-7
) -> Array:
    """Improve sequences by differential dynamic programming, never for the worse; return them, shape (n, steps).

    Every iteration tries both quadratic models of :func:`_backward` at several step lengths and keeps the best rollout
    per start. A start whose relative gain stays under ``tolerance`` at the strongest damping is finished.
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
        taken, returns = _follow(
            part, part.starts, states, mine, np.concatenate(all_changes, 1), np.concatenate(all_gains, 1)
        )
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
    """Return sequences from other starts, shape (offers, n, steps), as starting points for :func:`refine`.

    All starts lie on one cycle, so the path of one passes close to the next. A start takes over the rest of a path that
    passes near it, steered onto it by that path's feedback gains.

    Args:
        reach: how many intervals of another path are searched.
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
        path_gains, unchanged = gains[column[:, None], shift][:, None], np.zeros((n, 1, problem.steps))
        taken, total = _follow(problem, problem.starts, paths, path_actions, unchanged, path_gains)
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
