"""Controllers that need NumPy alone: constant actions, classical feedback, and trained networks read from .npz files.

All share one method, that of Stable-Baselines3's policies::

    action, state = policy.predict(observation, state, episode_start, deterministic=True)

``observation`` is what the environment returns, shape (d,), or a batch, shape (n, d); ``action`` is float32 of shape
(1,) or (n, 1), in [-1, 1]. ``state`` is the policy's memory: None before the first step, then what the last call
returned. ``episode_start``, shape (n,) or a bool, marks where an episode has just begun and clears the memory there.
"""

from sd_friction_env.control.policies.dynamic import Dither, ScheduledFeedback, SoftBelt, SuperTwisting
from sd_friction_env.control.policies.feedback import (
    DelayedFeedback,
    Feedback,
    FilteredFeedback,
    LinearFeedback,
    Readings,
    SlidingMode,
    VelocityFeedback,
)
from sd_friction_env.control.policies.follower import EstimatingFollower, ThresholdFollower
from sd_friction_env.control.policies.lookahead import LookAhead, Model, RolloutPolicy
from sd_friction_env.control.policies.network import NetworkPolicy, PolicyFileError, load_policy
from sd_friction_env.control.policies.planning import GradientPolicy, SamplingPolicy
from sd_friction_env.control.policies.policy import Actions, ConstantPolicy, Policy, State, ZeroPolicy
from sd_friction_env.control.policies.recurrent import RecurrentFollower

__all__ = [
    "Actions",
    "ConstantPolicy",
    "DelayedFeedback",
    "Dither",
    "EstimatingFollower",
    "Feedback",
    "FilteredFeedback",
    "GradientPolicy",
    "LinearFeedback",
    "LookAhead",
    "Model",
    "NetworkPolicy",
    "Policy",
    "PolicyFileError",
    "Readings",
    "RecurrentFollower",
    "RolloutPolicy",
    "SamplingPolicy",
    "ScheduledFeedback",
    "SlidingMode",
    "SoftBelt",
    "State",
    "SuperTwisting",
    "ThresholdFollower",
    "VelocityFeedback",
    "ZeroPolicy",
    "load_policy",
]
