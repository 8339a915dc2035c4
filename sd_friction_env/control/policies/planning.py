"""Model-predictive control: at each decision plan a sequence of actions on a model, take its first, and plan again.

Every plan starts from the base controller's motion and from the last plan, shifted by a decision. The better of them is
kept where the search finds nothing: on a true model no plan is worse than the base controller over the horizon.
"""

import functools
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.feedback import Feedback, VelocityFeedback
from sd_friction_env.control.policies.follower import ThresholdFollower
from sd_friction_env.control.policies.lookahead import LookAhead, pick
from sd_friction_env.control.policies.policy import State, remembered
from sd_friction_env.control.shooting import descend

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Planner(LookAhead):
    """Base of the planning controllers. Their base controller is by default that of :func:`base_controller`."""

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, with its nominal plant as the model; see Feedback.from_env."""
        if not arguments and "base" not in named:
            arguments = (base_controller(env),)
        return super().from_env(env, *arguments, **named)


def base_controller(env: Any) -> Feedback:
    """Return feedback that suppresses on the nominal plant: the threshold follower, or on force velocity feedback.

    Raises:
        TypeError, ValueError: as :meth:`Feedback.from_env`.
    """
    if getattr(getattr(env.unwrapped, "task", None), "actuator", None) == "belt_speed":
        return ThresholdFollower.from_env(env)
    return VelocityFeedback.from_env(env, 1.5)


@dataclass(frozen=True)
class SamplingPolicy(Planner):
    """Sampling MPC: the cross-entropy method on what is added to the base controller's actions.

    A sample adds a number to the base controller's action in each interval of the horizon. The best eighth of the
    samples gives mean and spread of the next ones. The noise is drawn once, from the seed, and used at every decision:
    the same observations give the same actions, alone and in a batch. Sources: R. Y. Rubinstein and D. P. Kroese, The
    Cross-Entropy Method (2004); C. Pinneri et al., Sample-efficient cross-entropy method (2020).

    Attributes:
        samples: in each iteration, in [8, 100000]. iterations: in [1, 1000].
        hold: intervals for which a sample's noise stays the same, in [1, 10000].
        spread: standard deviation of the first samples, in [0, 10], in units of the action.
        seed: of the noise, in [0, 2^32).
    """

    samples: int = 32
    iterations: int = 2
    hold: int = 5
    spread: float = 0.5
    seed: int = 0

    _counts: ClassVar = {
        **LookAhead._counts,
        "samples": (8, 100_000),
        "iterations": (1, 1000),
        "hold": (1, 10_000),
        "seed": (0, 2**32 - 1),
    }
    _ranges: ClassVar = {"spread": (0.0, 10.0)}

    @functools.cached_property
    def _noise(self) -> _Floats:
        """Standard normal numbers, shape (iterations, horizon, samples)."""
        held = -(-self.horizon // self.hold)
        noise = np.random.default_rng(self.seed).standard_normal((self.iterations, held, self.samples))
        return np.repeat(noise, self.hold, axis=1)[:, : self.horizon]

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        states = self._states(values)
        shape = states.shape[:-1]
        (plan,) = remembered(state, starts, np.zeros((self.horizon, *shape)))
        many = np.repeat(states[..., None, :], self.samples, axis=-2)
        mean, spread = plan, np.full(plan.shape, self.spread)
        for noise in self._noise:
            tried = mean[..., None] + spread[..., None] * np.expand_dims(noise, tuple(range(1, plan.ndim)))
            tried[..., 0], tried[..., 1] = 0.0, plan
            taken, total = self._follow(many, functools.partial(_added, tried))
            order = np.argsort(-total, axis=-1, kind="stable")
            best = np.broadcast_to(order[..., : self.samples // 8], (*plan.shape, self.samples // 8))
            elite = np.take_along_axis(tried, best, axis=-1)
            mean, spread, plan = elite.mean(axis=-1), elite.std(axis=-1), elite[..., 0]
        return pick(taken[0], order[..., 0]), (np.append(plan[1:], np.zeros((1, *shape)), axis=0),)


def _added(tried: _Floats, t: int, own: _Floats) -> _Floats:
    added: _Floats = np.clip(own + tried[t], -1.0, 1.0)
    return added


@dataclass(frozen=True)
class GradientPolicy(Planner):
    """Gradient MPC: differential dynamic programming with the step's exact derivatives through stick and slip.

    An iteration solves a quadratic model of the return to go backwards, and tries its feedback at several step lengths
    (:func:`sd_friction_env.control.shooting.descend`).

    Attributes:
        iterations: at each decision, in [1, 1000].
        damping: added to the curvature of the return in the action, in [0, 1e9].
    """

    iterations: int = 2
    damping: float = 0.01

    _counts: ClassVar = {**LookAhead._counts, "iterations": (1, 1000)}
    _ranges: ClassVar = {"damping": (0.0, 1e9)}

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        states = self._states(values)
        unplanned = np.full((self.horizon, *states.shape[:-1]), np.nan)
        (plan,) = remembered(state, starts, unplanned)

        def choose(t: int, own: _Floats) -> _Floats:
            own[..., 1] = np.where(np.isnan(plan[t]), own[..., 1], plan[t])
            return own

        taken, total = self._follow(np.repeat(states[..., None, :], 2, axis=-2), choose)
        sequences = pick(taken, np.argmax(total, axis=-1)).reshape(self.horizon, -1).T
        for _ in range(self.iterations):
            damping = np.full(len(sequences), self.damping)
            sequences, _, _ = descend(self.model, states.reshape(-1, 3), sequences, damping)
        plan = sequences.T.reshape(plan.shape)
        return plan[0], (np.append(plan[1:], unplanned[:1], axis=0),)
