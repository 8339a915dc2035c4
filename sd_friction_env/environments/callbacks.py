"""Callbacks of Stable-Baselines3 that hyperparameter files can name."""

from typing import Any

from sd_friction_env.extras import extra
from sd_friction_env.physics.parameters import checked_number

with extra("train"):
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

LOWEST_LOG_STD, HIGHEST_LOG_STD = -20.0, 5.0


class AnnealedExploration(BaseCallback):
    """Let PPO's exploration die out: the logarithm of its actions' standard deviation falls linearly in training.

    Left to itself PPO keeps a spread of a few tenths for very long. What a small standing action costs is then hidden
    in the cost of the spread, and what is learned ends with a belt that runs a few percent slow.

    Args:
        start, end: logarithms of the standard deviation at the beginning and at the end, in [-20, 5].

    Raises:
        TypeError, ValueError: if they are not.
    """

    def __init__(self, start: float = 0.0, end: float = -2.5) -> None:
        super().__init__()
        self.start = checked_number("start", start, LOWEST_LOG_STD, HIGHEST_LOG_STD)
        self.end = checked_number("end", end, LOWEST_LOG_STD, HIGHEST_LOG_STD)

    def _on_training_start(self) -> None:
        if not isinstance(getattr(self.model.policy, "log_std", None), torch.nn.Parameter):
            raise TypeError(f"{type(self.model).__name__} has no log_std: AnnealedExploration is for PPO")

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        # Not Stable-Baselines3's own progress: that of the last learn() stands there until the first rollout is over.
        left = 1.0 - self.model.num_timesteps / self.model._total_timesteps
        with torch.no_grad():
            policy.log_std.fill_(left * self.start + (1.0 - left) * self.end)

    def _on_step(self) -> bool:
        return True
