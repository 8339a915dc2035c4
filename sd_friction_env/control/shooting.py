"""Shooting: action sequences of a known plant, improved by differential dynamic programming through events.

Source: D. H. Jacobson and D. Q. Mayne, Differential Dynamic Programming (1970); with the exact derivatives of stick and
slip, the times of their events included, it is also called hybrid iLQR.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Dynamics(Protocol):
    """What is known of a plant: how many of (x, v, v_belt) change, a control step, and its derivatives."""

    @property
    def dimensions(self) -> int:
        """2 or 3."""

    def step(self, states: Array, actions: Array, t: int) -> tuple[Array, Array]:
        """Return the states (x, v, v_belt) after control interval t, shape (..., 3), and the rewards, shape (...)."""

    def jacobians(self, states: Array, actions: Array) -> Array:
        """Return the derivatives of (x, v, v_belt, reward) by (x, v, v_belt, action), shape (n, steps, 4, 4)."""


_DIFFERENCE = 1e-4  # half-width of central differences of the exact Jacobian
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01, 0.001)


@dataclass(frozen=True)
class Derivatives:
    """The step linearised along sequences: next state f and cost c over z = (state, action), d = dimensions + 1.

    Attributes:
        f_z: shape (n, steps, dimensions, d). f_zz: shape (n, steps, dimensions, d, d).
        c_z: shape (n, steps, d). c_zz: shape (n, steps, d, d).
    """

    f_z: Array
    f_zz: Array
    c_z: Array
    c_zz: Array


def derivatives(dynamics: Dynamics, states: Array, actions: Array) -> Derivatives:
    """Return the exact derivatives of the step along states (n, steps, 3) and actions (n, steps).

    The second ones are central differences of the first.
    """
    size, h = dynamics.dimensions, _DIFFERENCE
    rows, columns = [*range(size), -1], [*range(size), -1]  # the reward and the action are the last

    def at(moved: int, by: float) -> Array:
        """Return the Jacobian of next state and cost, shape (n, steps, d, d), with one of the variables moved."""
        actions_there, states_there = actions, states.copy()
        if moved < size:
            states_there[..., moved] += by
        else:
            actions_there = np.clip(actions, -1.0 + h, 1.0 - h) + by
        found = dynamics.jacobians(states_there, actions_there)[..., rows, :][..., columns]
        found[..., -1, :] *= -1.0
        return np.nan_to_num(found)  # next to a loss of contact: only the quadratic model is worse for it

    first = at(0, 0.0)
    second = np.stack([(at(i, h) - at(i, -h)) / (2.0 * h) for i in range(size + 1)], axis=-1)
    second = 0.5 * (second + np.swapaxes(second, -1, -2))
    return Derivatives(first[:, :, :size], second[:, :, :size], first[:, :, size], second[:, :, size])


def backward(actions: Array, at: Derivatives, damping: Array, curved: bool) -> tuple[Array, Array]:
    """Return the change of action, shape (n, steps), and its gain on a change of state, shape (n, steps, dimensions),
    that minimise the quadratic model of the cost to go.

    Args:
        damping: added to the curvature in the action, shape (n,).
        curved: whether the curvature of the dynamics counts (differential dynamic programming; else Gauss and Newton).
    """
    n, steps = actions.shape
    size = at.c_z.shape[-1] - 1
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


def follow(
    dynamics: Dynamics, starts: Array, states: Array, actions: Array, changes: Array, gains: Array
) -> tuple[Array, Array]:
    """Return the actions taken, shape (n, m, steps), and the returns, shape (n, m), of changed sequences with feedback
    towards the states of their quadratic model.

    Args:
        starts: (n, 3). states, actions: of the model, (n, steps or more, 3) and (n, steps).
        changes: (n, m, steps). gains: (n, m, steps, dimensions).
    """
    n, m, steps = changes.shape
    size = dynamics.dimensions
    taken, returns = np.empty((n, m, steps)), np.zeros((n, m))
    now = np.repeat(starts[:, None], m, axis=1)
    for t in range(steps):
        off = now[..., :size] - states[:, None, t, :size]
        wanted = actions[:, None, t] + changes[..., t] + np.sum(gains[..., t, :] * off, axis=-1)
        taken[..., t] = np.clip(wanted, -1.0, 1.0)
        now, rewards = dynamics.step(now, taken[..., t], t)
        returns += rewards
    return taken, returns


def rollout(dynamics: Dynamics, starts: Array, actions: Array) -> tuple[Array, Array]:
    """Return the states, shape (n, steps + 1, 3), and the rewards, shape (n, steps), of action sequences.

    Args:
        starts: (n, 3). actions: one sequence per start, (n, steps).
    """
    n, steps = actions.shape
    states, rewards = np.empty((n, steps + 1, 3)), np.empty((n, steps))
    states[:, 0] = starts
    for t in range(steps):
        states[:, t + 1], rewards[:, t] = dynamics.step(states[:, t], actions[:, t], t)
    return states, rewards


def descend(dynamics: Dynamics, starts: Array, actions: Array, damping: Array) -> tuple[Array, Array, Array]:
    """Improve sequences once; return them, shape (n, steps), and their returns before and after, shape (n,).

    Both quadratic models of :func:`backward` are tried at several step lengths. The best rollout of each start is kept,
    its own sequence if none is better.

    Args:
        starts: (n, 3). actions: (n, steps). damping: as of :func:`backward`.
    """
    states, rewards = rollout(dynamics, starts, actions)
    before = rewards.sum(axis=1)
    at = derivatives(dynamics, states[:, :-1], actions)
    lengths = np.array(_STEP_LENGTHS)[:, None]
    all_changes, all_gains = [], []
    for curved in (True, False):
        changes, gains = backward(actions, at, damping, curved)
        all_changes.append(lengths * changes[:, None])
        all_gains.append(np.repeat(gains[:, None], len(lengths), axis=1))
    taken, returns = follow(
        dynamics, starts, states, actions, np.concatenate(all_changes, 1), np.concatenate(all_gains, 1)
    )
    best = np.argmax(np.nan_to_num(returns, nan=-np.inf), axis=1)
    after = returns[np.arange(len(best)), best]
    better = after > before
    return np.where(better[:, None], taken[np.arange(len(best)), best], actions), before, after
