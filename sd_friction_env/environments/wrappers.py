"""Gymnasium wrappers for hyperparameter files."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from sd_friction_env.physics.parameters import checked_number

SMALLEST_SCALE, LARGEST_SCALE = 1e-6, 1e6
SMALLEST_POWER, LARGEST_POWER = 0.1, 1.0


def scaled_reward(reward: Any, scale: float, power: float) -> Any:
    """Return scale sign(r) |r|^power for a reward or an array of them."""
    return scale * np.sign(reward) * np.abs(reward) ** power


class ScaledReward(gym.RewardWrapper[Any, Any]):
    """Shape the rewards that a learning algorithm sees: r becomes scale sign(r) |r|^power.

    Args:
        env: the environment.
        scale: factor, in [1e-6, 1e6]. Algorithms work best with returns of order one.
        power: exponent, in [0.1, 1]. Less than 1 gives the small costs near standstill more weight against the
            thousandfold costs of squealing, so that residual motion and constant actions die out.

    Raises:
        TypeError, ValueError: if ``scale`` or ``power`` is not such a number.
    """

    def __init__(self, env: gym.Env[Any, Any], scale: float = 1.0, power: float = 1.0) -> None:
        super().__init__(env)
        self.scale = checked_number("scale", scale, SMALLEST_SCALE, LARGEST_SCALE)
        self.power = checked_number("power", power, SMALLEST_POWER, LARGEST_POWER)

    def reward(self, reward: SupportsFloat) -> float:
        """Return the shaped reward."""
        return float(scaled_reward(float(reward), self.scale, self.power))
