"""Warm start of PPO from a controller: behaviour cloning of the actor, then the clone's returns for the critic."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sd_friction_env.control.policies import State
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning.controllers import taught, teacher_of
from sd_friction_env.learning.models import make_training_envs
from sd_friction_env.learning.perceptrons import Perceptron
from sd_friction_env.learning.plan import Plan, training_seed
from sd_friction_env.learning.ppo import FastPPO
from sd_friction_env.learning.settings import reward_scaling

_SEEDS = 2**20  # the episodes of the clone are none of those that PPO trains on
_TAIL = 5.0  # of the returns, in units of 1/(1 - gamma)


def clone(model: FastPPO, plan: Plan) -> None:
    """Fit a model's actor to the controller that its plan names; the numbers are its hyperparameter ``warm_start``.

    The actor's mean is fitted to the controller's actions on states that it visits under exploration noise of 0 to
    ``noise``, and, where it has no memory and the agent sees one observation, on states scattered around these and
    uniformly between them.

    Raises:
        ValueError: if the controller returns anything but actions in [-1, 1].
    """
    assert plan.start_from is not None
    settings = plan.hyperparameters["warm_start"]
    teacher = teacher_of(plan.start_from, make_env(plan.env_id, plan.env_kwargs))
    n, size = settings["n_envs"], model.observation_space.shape[0] // plan.frames  # type: ignore[index]
    state: State = None

    def teach(seen: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        nonlocal state
        actions, state = taught(teacher, seen[:, -size:], state, np.full(n, t == 0))
        return actions

    noise = torch.linspace(0.0, settings["noise"], n)[:, None]
    seen, actions, _, _ = _episodes(plan, settings["n_steps"], teach, noise)
    if state is None and plan.frames == 1:
        count = settings["samples"]
        visited, scattered = (seen[torch.randint(len(seen), (count,))] for _ in range(2))
        scattered = scattered + settings["scatter"] * torch.randn(scattered.shape)
        low, high = seen.min(dim=0).values, seen.max(dim=0).values
        seen = torch.cat([visited, scattered, low + (high - low) * torch.rand(count // 4, size)])
        actions = torch.from_numpy(taught(teacher, seen.numpy(), None, np.ones(len(seen), bool))[0])
    _fit(model, model.actor, seen, actions, settings["actor_steps"], settings)


def fit_critic(model: FastPPO, plan: Plan) -> None:
    """Fit a model's critic to the discounted returns of its actor, with its exploration and without a time limit."""

    def act(seen: NDArray[np.float32], t: int) -> NDArray[np.float32]:
        return model.actor.forward(torch.from_numpy(seen))[-1].numpy()

    settings = plan.hyperparameters["warm_start"]
    n, steps = settings["n_envs"], settings["n_steps"]
    tail = int(_TAIL / max(1.0 - model.gamma, 1e-3))
    spread = torch.exp(model.policy.log_std.detach()).expand(n, 1)
    seen, _, rewards, dones = _episodes(plan, steps + tail, act, spread, episode_steps=steps + tail)
    returns = np.zeros((steps + tail + 1, n), np.float32)
    for t in reversed(range(steps + tail)):
        returns[t] = rewards[t] + model.gamma * (~dones[t]) * returns[t + 1]
    _fit(
        model, model.critic, seen[: steps * n], torch.from_numpy(returns[:steps].reshape(-1, 1)),
        settings["critic_steps"], settings,
    )  # fmt: skip


def _episodes(
    plan: Plan, steps: int, act: Any, noise: Tensor, **kwargs: Any
) -> tuple[Tensor, Tensor, NDArray[np.float32], NDArray[np.bool_]]:
    """Return observations (steps x n, d), actions before the noise, scaled rewards and ends (steps, n)."""
    envs = make_training_envs(
        plan.env_id,
        {**plan.env_kwargs, **kwargs},
        len(noise),
        plan.seed,
        frame_stack=plan.frames,
        scaling=reward_scaling(plan.hyperparameters),
        stagger=False,
    )
    envs.seed(training_seed(plan.seed, _SEEDS))
    observations: Any = envs.reset()
    kept: list[tuple[Any, ...]] = []
    for t in range(steps):
        actions = act(observations, t)
        moved = actions + (noise * torch.randn(noise.shape)).numpy()
        after, rewards, dones, _ = envs.step(np.clip(moved, -1.0, 1.0))
        kept.append((observations.copy(), actions, rewards, dones))
        observations = after
    envs.close()
    seen, acted, rewards, dones = (np.stack(part) for part in zip(*kept, strict=True))
    flat = [torch.from_numpy(part.reshape(-1, part.shape[-1])) for part in (seen, acted)]
    return flat[0], flat[1], rewards, dones


def _fit(
    model: FastPPO, network: Perceptron, inputs: Tensor, targets: Tensor, steps: int, settings: dict[str, Any]
) -> None:
    """Fit a network's output to targets (m, 1) by least squares, with a rate that falls to 0."""
    model.optimizer.reset()
    for i in range(steps):
        batch = torch.randint(len(inputs), (settings["batch_size"],))
        values = network.forward(inputs[batch])
        network.backward(values, (values[-1] - targets[batch]) * (2.0 / len(batch)))
        model.optimizer.param_groups[0]["lr"] = settings["learning_rate"] * (1.0 - i / steps)
        model.optimizer.step()
    model.optimizer.reset()
