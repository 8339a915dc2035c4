"""What a plan trains: seeded environments, and a model of Stable-Baselines3 with its callbacks."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack

from sd_friction_env.environments.callbacks import AnnealedExploration
from sd_friction_env.environments.sb3 import SDFrictionVecEnv
from sd_friction_env.environments.wrappers import scaled_reward
from sd_friction_env.learning.networks import ALGORITHM_CLASSES, policy_arguments
from sd_friction_env.learning.plan import Plan, training_seed
from sd_friction_env.learning.ppo import FastPPO
from sd_friction_env.learning.settings import OURS, SCHEDULED, annealing, reward_scaling

_NOISES = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}


class _ScaledRewards(VecEnvWrapper):
    def __init__(self, envs: VecEnv, scale: float, power: float) -> None:
        super().__init__(envs)
        self.scale, self.power = scale, power

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, scaled_reward(rewards, self.scale, self.power).astype(np.float32), dones, infos


def make_training_envs(
    env_id: str,
    env_kwargs: Mapping[str, Any],
    n_envs: int,
    seed: int,
    *,
    frame_stack: int = 1,
    scaling: tuple[float, float] = (1.0, 1.0),
    stagger: bool = True,
) -> VecEnv:
    """Return seeded environments to train on: a native batch, rewards scaled, observations stacked.

    Unless ``stagger`` is False, the first episodes are shortened, each by another share. The environments then never
    start over all at once, and every batch holds squealing, settling and settled motion.

    Args:
        seed: of the run; environment i is reset with ``training_seed(seed, i)``.
        frame_stack: observations seen at once. scaling: scale and power of the rewards that the algorithm sees.
    """
    envs: VecEnv = SDFrictionVecEnv(env_id, n_envs, stagger=stagger, **env_kwargs)
    if scaling != (1.0, 1.0):
        envs = _ScaledRewards(envs, *scaling)
    if frame_stack > 1:
        envs = VecFrameStack(envs, frame_stack)
    envs.seed(training_seed(seed))
    return envs


def make_model(plan: Plan, envs: VecEnv) -> BaseAlgorithm:
    """Return the untrained model of a plan."""
    arguments = {name: value for name, value in plan.hyperparameters.items() if name not in OURS}
    for name in SCHEDULED:
        if isinstance(arguments.get(name), str):
            arguments[name] = LinearSchedule(float(arguments[name].partition("_")[2]), 0.0, 1.0)
    noise = plan.hyperparameters.get("noise_type")
    if noise is not None:
        std = plan.hyperparameters.get("noise_std", 0.1)
        one: ActionNoise = _NOISES[noise](mean=np.zeros(1), sigma=np.full(1, std))
        arguments["action_noise"] = VectorizedActionNoise(one, envs.num_envs) if envs.num_envs > 1 else one
    is_fast = plan.implementation == "fast"
    model = (FastPPO if is_fast else ALGORITHM_CLASSES[plan.algorithm])(
        "MlpPolicy",
        envs,
        policy_kwargs=policy_arguments(plan.hyperparameters.get("policy_kwargs", {})),
        seed=plan.seed,
        device=plan.device,
        **arguments,
    )
    envs.seed(training_seed(plan.seed))  # the constructor has seeded them in its own way
    return model


def make_callbacks(settings: Mapping[str, Any]) -> list[BaseCallback]:
    """Return the callbacks that checked hyperparameters ask for."""
    arguments = annealing(settings)
    return [] if arguments is None else [AnnealedExploration(**arguments)]


@contextlib.contextmanager
def model_of(plan: Plan) -> Iterator[BaseAlgorithm]:
    """Make the untrained model of a plan on its environments and threads; close and restore them at the end."""
    threads = torch.get_num_threads()
    torch.set_num_threads(plan.threads)
    envs = make_training_envs(
        plan.env_id,
        plan.env_kwargs,
        plan.hyperparameters["n_envs"],
        plan.seed,
        frame_stack=plan.frames,
        scaling=reward_scaling(plan.hyperparameters),
    )
    try:
        yield make_model(plan, envs)
    finally:
        envs.close()
        torch.set_num_threads(threads)
