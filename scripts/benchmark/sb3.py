"""Environments under Stable-Baselines3: its VecEnv, and PPO in training."""

import importlib.util
import time
from typing import Any

import gymnasium as gym
import numpy as np

from scripts.benchmark.batches import FORCE
from scripts.benchmark.measuring import Bench, Contender, Slice, rate_of


def is_missing(bench: Bench, section: str) -> bool:
    """Return whether Stable-Baselines3 is missing, and record the section as skipped if it is."""
    if importlib.util.find_spec("stable_baselines3") is None:
        bench.skip(section, "Stable-Baselines3 is not installed")
        return True
    return False


def sb3(bench: Bench) -> None:
    """The VecEnvs of Stable-Baselines3."""
    if is_missing(bench, "sb3"):
        return
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

    from sd_friction_env.environments.sb3 import SDFrictionVecEnv

    calls = bench.length(1000, 500)

    def slice_of(env: VecEnv) -> Slice:
        space = env.action_space
        space.seed(0)
        actions = [np.stack([space.sample() for _ in range(env.num_envs)]) for _ in range(16)]
        env.seed(0)
        env.reset()

        def work() -> None:
            for i in range(calls):
                env.step(actions[i % 16])

        return lambda: rate_of(work, calls * env.num_envs)

    environments: dict[str, VecEnv] = {
        "DummyVecEnv of 16 Pendulum-v1": DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 16),
        f"DummyVecEnv of 16 {FORCE}": DummyVecEnv([lambda: gym.make(FORCE)] * 16),
        "SDFrictionVecEnv of 16": SDFrictionVecEnv(FORCE, 16),
        "SDFrictionVecEnv of 256": SDFrictionVecEnv(FORCE, 256),
    }
    title = "stepped through Stable-Baselines3's VecEnv"
    contenders = [
        Contender(label, slice_of(env), "Pendulum" not in label, title) for label, env in environments.items()
    ]
    bench.measure("sb3", "Stable-Baselines3's VecEnv, steps per second", contenders, contenders[0].label)


def ppo(bench: Bench) -> None:
    """PPO in training on our environments, against PPO on an environment that costs nothing."""
    if is_missing(bench, "ppo"):
        return
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

    from sd_friction_env.environments.sb3 import SDFrictionVecEnv

    class Nothing(SDFrictionVecEnv):
        """Returns the same arrays at every step."""

        def reset(self) -> Any:
            observations = np.zeros_like(super().reset())
            zeros = np.zeros(self.num_envs, np.float32)
            self._same = observations, zeros, zeros.astype(np.bool_), [dict[str, Any]() for _ in zeros]
            return observations

        def step_async(self, actions: Any) -> None:
            pass

        def step_wait(self) -> Any:
            return self._same

    n_steps = 64
    steps = bench.length(3, 1) * 256 * n_steps if bench.steps is None else bench.steps

    def slice_of(env: VecEnv) -> Slice:
        model = PPO("MlpPolicy", env, n_steps=n_steps, batch_size=2048, seed=0, device="cpu")

        def run() -> float:
            before, begin = model.num_timesteps, time.perf_counter()
            model.learn(steps, reset_num_timesteps=False)
            return (model.num_timesteps - before) / (time.perf_counter() - begin)

        return run

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # with more, on a busy machine, PyTorch's threads wait for each other
    try:
        title = "PPO in training, 256 environments"
        ours = SDFrictionVecEnv(FORCE, 256, stagger=True)
        contenders = [
            Contender("PPO, 256 environments that cost nothing", slice_of(Nothing(FORCE, 256)), panel=title),
            Contender(f"PPO, SDFrictionVecEnv of 256 {FORCE}", slice_of(ours), True, title),
        ]
        bench.measure("ppo", "PPO with 10 epochs, one thread, steps per second", contenders, contenders[0].label)
    finally:
        torch.set_num_threads(threads)
