"""Controllers that act on what an observer believes: the rule, its look-ahead, and any policy that sees the state. Then
the rule and its look-ahead as an environment's observations allow them.
"""

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.observers import Belief, LuenbergerObserver, Observer
from sd_friction_env.control.policies import (
    Actions,
    EstimatingFollower,
    Policy,
    RolloutPolicy,
    State,
    ThresholdFollower,
)
from sd_friction_env.control.policies.lookahead import pick
from sd_friction_env.control.policies.policy import as_taken
from sd_friction_env.physics.parameters import checked_count, checked_number

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Observed:
    """Base: corrects an observer by each observation, decides on its belief, and advances it by the action.

    Attributes:
        observer: of the environment.
    """

    observer: Observer

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the actions and the memory; see :mod:`sd_friction_env.control.policies`."""
        own, others = (None, None) if state is None else (state[:3], state[3:] or None)
        belief, own = self.observer.correct(observation, own, episode_start)
        actions, others = self._decide(belief, others, episode_start)
        actions = as_taken(actions)
        return actions.astype(np.float32)[..., None], (*self.observer.advance(own, actions), *(others or ()))

    def _decide(self, belief: Belief, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        """Return actions, shape (...), not yet clipped, and a memory of the controller's own."""
        raise NotImplementedError


@dataclass(frozen=True)
class ObservedRule(Observed):
    """:class:`ThresholdFollower` at the believed mean velocity and nominal belt speed.

    A velocity that is predicted by a plant which is itself estimated may have a bias. The rule would make it a steady
    action, and the belt would run off its speed. The believed position has no bias, since it is read. While the rule is
    within its limits, a complementary filter therefore takes the slow part of the velocity from the position's change::

        bias += (mean v of the last interval - change of x / interval - bias) interval / blend_time
        action = rule at v - bias

    Source: W. T. Higgins, A Comparison of Complementary and Kalman Filtering, IEEE Trans. Aerosp. Electron. Syst. 11
    (1975) 321.

    Attributes:
        rule: its numbers; its belt speed is replaced by the believed one.
        blend_time: time constant of the filter, in [1e-6, 1e9] (dimensionless, as all times); None: no filter.

    Raises:
        TypeError, ValueError: if ``blend_time`` is not as said.
    """

    rule: ThresholdFollower
    blend_time: float | None = None

    def __post_init__(self) -> None:
        if self.blend_time is not None:
            object.__setattr__(self, "blend_time", checked_number("blend_time", self.blend_time, 1e-6, 1e9))

    @classmethod
    def from_env(cls, env: Any, observer: Observer, **named: Any) -> Self:
        """Return the controller of an environment with an observer; ``named`` are numbers of the class.

        ``blend_time`` is 1.2 where the observer's velocity may be biased, None elsewhere.

        Raises:
            ValueError: if the actuator is not the belt's speed or has no authority.
        """
        blend_time = 1.2 if observer.velocity_may_be_biased else None
        return cls(observer, **({"rule": ThresholdFollower.seeing_all(env), "blend_time": blend_time} | named))

    def _decide(self, belief: Belief, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        states, parameters = belief.mean
        if self.blend_time is None:
            return self._follow(states, parameters), None
        now, belt_speed = states[..., :2], self.observer.belt_speed(parameters)
        bias, before = (np.zeros(belief.steps.shape), now) if state is None else state
        interval, v = self.observer.ensemble.task.control_interval, now[..., 1]
        error = 0.5 * (v + before[..., 1]) - (now[..., 0] - before[..., 0]) / interval
        is_small = (belief.steps > 0) & (self.rule.gain * np.abs(v) < belt_speed)
        bias = np.where(is_small, bias + (error - bias) * min(1.0, interval / self.blend_time), 0.0)
        return self.rule.follow(v - bias, belt_speed), (bias, now)

    def _follow(self, states: _Floats, parameters: _Floats) -> _Floats:
        return self.rule.follow(states[..., 1], self.observer.belt_speed(parameters))


@dataclass(frozen=True)
class ObservedRollout(ObservedRule):
    """Rollout of the rule on some of the guesses: of several first actions the one that gains most over the rule's own.

    As :class:`RolloutPolicy`, on plants and states that are believed possible; each goes on by the rule with its own
    velocity and belt speed. The gain of an action is its mean over the guesses minus ``caution`` standard errors, so
    that the rule's own action is kept where the guesses do not agree on a better one.

    Attributes:
        guesses: that are tried, in [1, 1000]: at even shares of the weights.
        candidates: evenly spaced first actions beside the rule's own, in [2, 1000].
        horizon: control intervals that are looked ahead, in [1, 10000].
        caution: standard errors by which another action must gain more than the rule's, in [0, 1000].
    """

    guesses: int = 24
    candidates: int = 7
    horizon: int = 100
    caution: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "caution", checked_number("caution", self.caution, 0.0, 1000.0))
        for name, bounds in (("guesses", (1, 1000)), ("candidates", (2, 1000)), ("horizon", (1, 10_000))):
            object.__setattr__(self, name, checked_count(name, getattr(self, name), *bounds))

    def _decide(self, belief: Belief, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        own, state = super()._decide(belief, state, starts)
        own = as_taken(own)
        first = np.empty((*own.shape, self.candidates + 1))
        first[..., 0], first[..., 1:] = own, np.linspace(-1.0, 1.0, self.candidates)
        shares = (np.arange(min(self.guesses, belief.weights.shape[-1])) + 0.5) / self.guesses
        before = np.cumsum(belief.weights, axis=-1)[..., None, :] < shares[:, None]
        places = np.minimum(before.sum(axis=-1), belief.weights.shape[-1] - 1)[..., None]
        # One row of candidates for each guess.
        now, parameters = (
            np.repeat(np.take_along_axis(each, places, axis=-2)[..., None, :], self.candidates + 1, axis=-2)
            for each in (belief.states, belief.parameters)
        )
        actions = np.broadcast_to(first[..., None, :], now.shape[:-1])
        total = np.zeros(now.shape[:-1])
        for t in range(self.horizon):
            steps = belief.steps[..., None, None] + t
            now, rewards = self.observer.ensemble.step(now, parameters, actions, steps)
            total += rewards
            actions = as_taken(self._follow(now, parameters))
        total = np.nan_to_num(total, nan=-1e9)
        gain = total - total[..., :1]
        error = gain.std(axis=-2) / np.sqrt(gain.shape[-2])
        return pick(first, np.argmax(gain.mean(axis=-2) - self.caution * error, axis=-1)), state


@dataclass(frozen=True)
class ObservedPolicy(Observed):
    """A policy that reads the whole state, such as a planner or a trained agent, on the believed mean.

    Attributes:
        policy: of an environment with the sensor "state" and the same scales.
    """

    policy: Policy = field(repr=False)

    def _decide(self, belief: Belief, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        task = self.observer.ensemble.task
        states, parameters = belief.mean
        x_offset, x_scale, v_scale = task.scales
        seen = [(states[..., 0] - x_offset) / x_scale, states[..., 1] / v_scale]
        if task.actuator == "belt_speed":
            seen.append((states[..., 2] / self.observer.belt_speed(parameters) - 1.0) / task.belt_authority)
        limit = task.observation_limit
        observation = np.clip(np.stack(seen, axis=-1), -limit, limit).astype(np.float32)
        actions, state = self.policy.predict(observation, state, starts)
        return np.asarray(actions, np.float64)[..., 0], state


def threshold_follower(env: Any) -> Policy:
    """Return the rule that an environment's observations allow, with the numbers of the package.

    Args:
        env: an :class:`SDFrictionEnv` with the belt actuator, wrapped or not. :class:`ObservedRule` on the nominal
            plant's :class:`LuenbergerObserver` is for the sensor "position", :class:`EstimatingFollower` for
            environments that draw ``belt_speed``, :class:`ThresholdFollower` for all others.

    Raises:
        TypeError: if it is another kind of environment.
        ValueError: if its actuator is not the belt's speed or has no authority.
    """
    task = getattr(getattr(env, "unwrapped", None), "task", None)
    if getattr(task, "sensor", None) == "position":
        return ObservedRule.from_env(env, LuenbergerObserver.from_env(env))
    if "belt_speed" in getattr(task, "randomise", {}):
        return EstimatingFollower.from_env(env)
    return ThresholdFollower.from_env(env)


def rollout_follower(env: Any) -> Policy:
    """Return the look-ahead controller of an environment: the rollout of the rule on the nominal plant.

    Where the sensor sees the position only, it acts on the state of the :class:`LuenbergerObserver`.

    Raises:
        TypeError, ValueError: as :func:`threshold_follower`.
    """
    if isinstance(threshold_follower(env), ObservedRule):
        return ObservedRollout.from_env(env, LuenbergerObserver.from_env(env))
    return RolloutPolicy.from_env(env, ThresholdFollower.from_env(env))
