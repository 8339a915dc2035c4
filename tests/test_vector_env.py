"""The batch is the single environment, many times: bit for bit."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sd_friction_env import ENVIRONMENT_IDS, SDFrictionVectorEnv

MODES = [mode.value for mode in AutoresetMode]


def batch(env_id="SDFriction/Force-v0", num_envs=7, **kwargs):
    envs = gym.make_vec(env_id, num_envs=num_envs, **kwargs)
    assert isinstance(envs.unwrapped, SDFrictionVectorEnv)
    return envs


def one_by_one(env_id="SDFriction/Force-v0", num_envs=7, autoreset_mode="NextStep", **kwargs):
    return SyncVectorEnv([lambda: gym.make(env_id, **kwargs)] * num_envs, autoreset_mode=AutoresetMode(autoreset_mode))


def differences(ours, theirs, path=""):
    """Name every place at which two returned values are not the same to the bit."""
    if isinstance(theirs, dict):
        if set(ours) != set(theirs):
            return [f"{path}: keys {set(ours) ^ set(theirs)}"]
        return [found for key in theirs for found in differences(ours[key], theirs[key], f"{path}/{key}")]
    if isinstance(theirs, tuple):
        return [
            found
            for i, pair in enumerate(zip(ours, theirs, strict=True))
            for found in differences(*pair, f"{path}/{i}")
        ]
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    if ours.dtype != theirs.dtype or ours.shape != theirs.shape:
        return [f"{path}: {ours.dtype}{ours.shape} {theirs.dtype}{theirs.shape}"]
    if ours.dtype == object:
        same = all(np.array_equal(a, b) and type(a) is type(b) for a, b in zip(ours.flat, theirs.flat, strict=True))
    else:
        same = ours.tobytes() == theirs.tobytes()
    return [] if same else [f"{path}: {ours} {theirs}"]


def compare(ours, theirs, steps, seed=0, reset_seed=7, options=None):
    """Step both with the same actions, some of them out of range; return how many episodes ended."""
    rng = np.random.default_rng(seed)
    n = ours.num_envs
    again = {} if options is None else {"options": options}
    assert differences(ours.reset(seed=reset_seed, **again), theirs.reset(seed=reset_seed, **again)) == []
    ended = 0
    for _ in range(steps):
        actions = rng.uniform(-1.3, 1.3, (n, 1)).astype(np.float32)
        mine, reference = ours.step(actions), theirs.step(actions)
        assert differences(mine, reference) == []
        over = mine[2] | mine[3]
        ended += over.sum()
        if ours.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
            mine = ours.reset(options={"reset_mask": over.copy()})
            assert differences(mine, theirs.reset(options={"reset_mask": over.copy()})) == []
    return ended


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_a_batch_returns_what_single_environments_return_in_every_mode_of_resetting(env_id, mode):
    kwargs = {"episode_steps": 37, "autoreset_mode": mode}
    assert compare(batch(env_id, info_keys="all", **kwargs), one_by_one(env_id, **kwargs), 160) >= 21
