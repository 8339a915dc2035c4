"""PPO of Stable-Baselines3 with rollout and update written out: the same method in half the time."""

import math
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from sd_friction_env.learning.perceptrons import Adam, Perceptron

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class FastPPO(PPO):
    """PPO of Stable-Baselines3 for "MlpPolicy", vectors as observations, a box of actions, and the CPU.

    Differences: actions of a rollout come from noise that is drawn at its beginning; values and log-probabilities are
    computed for the whole rollout at once; the gradient is written out (:class:`Perceptron`). A seed gives other
    actions than with Stable-Baselines3's own class, and the same ones each time.

    Args: those of ``stable_baselines3.PPO`` without ``use_sde``.
    """

    policy: Any  # torch.nn.Module hides the types of its attributes

    def _setup_model(self) -> None:
        self.policy_kwargs = {"optimizer_class": Adam, **self.policy_kwargs}
        super()._setup_model()
        policy = self.policy
        self.optimizer: Adam = policy.optimizer
        self.actor = Perceptron([*policy.mlp_extractor.policy_net, policy.action_net])
        self.critic = Perceptron([*policy.mlp_extractor.value_net, policy.value_net])

    def log_probability(self, actions: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logarithm of the density of actions (n, k), shape (n,), and the actions in standard deviations."""
        log_std = self.policy.log_std.detach()
        z = (actions - means) * torch.exp(-log_std)
        return (-0.5 * z * z - log_std - _HALF_LOG_TWO_PI).sum(dim=1), z

    def _values(self, observations: Any) -> Tensor:
        return self.critic.forward(torch.from_numpy(observations))[-1][:, 0]

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with a rollout; return False if the callback ended it."""
        buffer, shape = rollout_buffer, (n_rollout_steps, env.num_envs)
        assert self._last_obs is not None
        buffer.reset()
        callback.on_rollout_start()
        noise = torch.randn(*shape, *env.action_space.shape)  # type: ignore[misc]
        noise *= torch.exp(self.policy.log_std.detach())
        ended: list[tuple[int, int]] = []  # by the time limit: step and environment
        last: list[np.ndarray[Any, Any]] = []  # their last observations
        for t in range(n_rollout_steps):
            actions = self.actor.forward(torch.from_numpy(self._last_obs))[-1].add_(noise[t]).numpy()
            buffer.observations[t], buffer.actions[t] = self._last_obs, actions
            buffer.episode_starts[t] = self._last_episode_starts
            clipped = np.clip(actions, env.action_space.low, env.action_space.high)  # type: ignore[attr-defined]
            self._last_obs, rewards, dones, infos = env.step(clipped)  # type: ignore[assignment]
            buffer.rewards[t] = rewards
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._last_episode_starts = dones
            if dones.any():
                self._update_info_buffer(infos, dones)
                which = [i for i in np.flatnonzero(dones).tolist() if infos[i].get("TimeLimit.truncated")]
                ended += [(t, i) for i in which]
                last += [infos[i]["terminal_observation"] for i in which]
        if ended:  # the time limit is no part of the task: what would follow is worth the critic's value
            buffer.rewards[tuple(zip(*ended, strict=True))] += self.gamma * self._values(np.stack(last)).numpy()
        observations, taken = (
            torch.from_numpy(part.reshape(-1, part.shape[-1])) for part in (buffer.observations, buffer.actions)
        )
        buffer.values[:] = self.critic.forward(observations)[-1].view(shape).numpy()
        buffer.log_probs[:] = self.log_probability(taken, self.actor.forward(observations)[-1])[0].view(shape).numpy()
        buffer.pos, buffer.full = n_rollout_steps, True
        buffer.compute_returns_and_advantage(self._values(self._last_obs), dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Update the policy with the rollout in the buffer (Schulman et al., 2017, equations 7 and 9)."""
        self._update_learning_rate(self.optimizer)  # type: ignore[arg-type]
        left = self._current_progress_remaining
        clip = self.clip_range(left)  # type: ignore[operator]
        clip_values = None if self.clip_range_vf is None else self.clip_range_vf(left)  # type: ignore[operator]
        buffer, policy = self.rollout_buffer, self.policy
        arrays = (buffer.observations, buffer.actions, buffer.advantages, buffer.returns, buffer.values)
        size = buffer.advantages.size
        whole = [torch.from_numpy(part.reshape(size, -1)) for part in (*arrays, buffer.log_probs)]
        logged: dict[str, list[float]] = {}
        for _ in range(self.n_epochs):
            order, divergences = torch.randperm(size), []
            for batch in torch.split(order, self.batch_size):
                losses = self._gradient([part[batch] for part in whole], clip, clip_values)
                divergences.append(losses.pop("approx_kl"))
                for name, value in losses.items():
                    logged.setdefault(name, []).append(value)
                if self.target_kl is not None and divergences[-1] > 1.5 * self.target_kl:
                    break
                self.optimizer.step(self.max_grad_norm)
            self._n_updates += 1
            logged["approx_kl"] = divergences  # of the last epoch alone
            if self.target_kl is not None and divergences[-1] > 1.5 * self.target_kl:
                break
        for name, values in logged.items():
            self.logger.record(f"train/{name}", float(np.mean(values)))
        found = explained_variance(buffer.values.ravel(), buffer.returns.ravel())
        self.logger.record("train/explained_variance", found)
        self.logger.record("train/std", float(torch.exp(policy.log_std.detach()).mean()))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip)

    def _gradient(self, batch: list[Tensor], clip: float, clip_values: float | None) -> dict[str, float]:
        """Write the gradient of the loss over a batch into the parameters; return what is logged.

        Args:
            batch: observations, actions, advantages, returns, and values and log-probabilities before the update, each
                of shape (n, ...). clip, clip_values: largest change of the probabilities' ratio and of the values.
        """
        observations, actions, advantages, returns, values_before, log_prob_before = batch
        n, log_std = len(observations), self.policy.log_std
        means, values = self.actor.forward(observations), self.critic.forward(observations)
        log_prob, z = self.log_probability(actions, means[-1])
        change = log_prob[:, None] - log_prob_before
        ratio = torch.exp(change)
        if self.normalize_advantage and n > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        is_clipped = torch.where(advantages > 0.0, ratio > 1.0 + clip, ratio < 1.0 - clip)
        gain = advantages * ratio
        slope = gain.masked_fill(is_clipped, 0.0).mul_(-1.0 / n)  # of the loss by the log-probabilities
        self.actor.backward(means, slope * z * torch.exp(-log_std.detach()))
        log_std.grad.copy_((slope * (z * z - 1.0)).sum(dim=0) - self.ent_coef)
        limit = math.inf if clip_values is None else clip_values
        move = values[-1] - values_before
        error = values_before + move.clamp(-limit, limit) - returns
        self.critic.backward(values, error.masked_fill(move.abs() > limit, 0.0) * (2.0 * self.vf_coef / n))
        return {
            "policy_gradient_loss": -float(torch.min(gain, advantages * ratio.clamp(1.0 - clip, 1.0 + clip)).mean()),
            "value_loss": float((error * error).mean()),
            "entropy_loss": -float((log_std.detach() + 0.5 + _HALF_LOG_TWO_PI).sum()),
            "approx_kl": float((ratio - 1.0 - change).mean()),
            "clip_fraction": float(((ratio - 1.0).abs() > clip).float().mean()),
        }
