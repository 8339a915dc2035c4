"""Lengths of episodes: an environment truncates itself, and a TimeLimit around it replaces its own limit."""

import dataclasses
import sys
from types import FrameType
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit

from sd_friction_env.environments.task import Task

# ``step`` of wrappers that step the environment exactly once; with others a TimeLimit counts something else.
_SINGLE_STEPS = {
    wrapper.step
    for wrapper in (
        *(gym.Wrapper, gym.ActionWrapper, gym.ObservationWrapper, gym.RewardWrapper),
        *(OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit),
    )
}


class LengthInSpec:
    """Environment whose ``spec`` has the number of steps after which it truncates an episode.

    ``gym.make`` and ``gym.make_vec`` write a ``spec`` that knows only the limits of Gymnasium's own wrappers.
    """

    task: Task
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Specification from ``gym.make`` or ``gym.make_vec``; None if neither made the environment."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=self.task.episode_steps)


def time_limits(env: gym.Env[Any, Any]) -> list[int]:
    """Return the limits of the :class:`TimeLimit` wrappers around an environment that are resetting it now.

    A TimeLimit does not pass its limit on, but the cost of lost contact and the statistics depend on it. So it is
    looked up among the callers of ``reset``.
    """
    limits = []
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if frame.f_code is TimeLimit.reset.__code__:
            inner = limiter = frame.f_locals["self"]
            while isinstance(inner, gym.Wrapper) and type(inner).step in _SINGLE_STEPS:
                inner = inner.env
            if inner is env:
                limits.append(limiter._max_episode_steps)
        frame = frame.f_back
    return limits
