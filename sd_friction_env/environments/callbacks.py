"""Stable-Baselines3 callbacks for hyperparameter files."""

from typing import Any

from sd_friction_env.extras import extra
from sd_friction_env.physics.parameters import checked_number

with extra("train"):
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

LOWEST_LOG_STD, HIGHEST_LOG_STD = -20.0, 5.0


class AnnealedExploration(BaseCallback):
    """Anneal PPO's exploration: the logarithm of its actions' standard deviation falls linearly during training.

    Without annealing PPO keeps a standard deviation of a few tenths for very long. Exploration noise then hides the
    cost of a small constant action, and the learned policy leaves the belt a few percent slow.

    Args:
        start, end: logarithm of the standard deviation at the beginning and at the end, in [-20, 5].

    Raises:
        TypeError, ValueError: if one is not such a number.
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
        # Stable-Baselines3's own progress is that of the last learn() until the first rollout is over.
        left = 1.0 - self.model.num_timesteps / self.model._total_timesteps
        with torch.no_grad():
            policy.log_std.fill_(left * self.start + (1.0 - left) * self.end)

    def _on_step(self) -> bool:
        return True
