"""Exploration that dies out: the spread at each rollout, by the closed form."""

import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sd_friction_env.environments.callbacks import AnnealedExploration
from sd_friction_env.environments.sb3 import SDFrictionVecEnv


class Watch(BaseCallback):
    """Note the spread that each rollout begins and acts with."""

    def __init__(self):
        super().__init__()
        self.seen = {}

    def _on_step(self):
        rollout = (self.num_timesteps - 1) // (self.model.n_envs * self.model.n_steps)
        self.seen.setdefault(rollout, set()).add(self.model.policy.log_std.item())
        return True


def make_model(**arguments):
    envs = SDFrictionVecEnv("SDFriction/Force-v0", num_envs=2)
    return PPO("MlpPolicy", envs, n_steps=8, batch_size=8, n_epochs=1, device="cpu", **arguments)


def test_the_spread_falls_linearly_in_training_from_start_to_end():
    watch = Watch()
    model = make_model(seed=0)
    model.learn(64, callback=CallbackList([AnnealedExploration(start=-0.5, end=-2.5), watch]))
    # After 0, 16, 32 and 48 of 64 steps; within a rollout it stays, whatever the optimiser made of it before.
    assert [min(values) for values in watch.seen.values()] == pytest.approx([-0.5, -1.0, -1.5, -2.0], abs=1e-6)
    assert all(len(values) == 1 for values in watch.seen.values())


def test_it_goes_on_where_training_goes_on():
    watch = Watch()
    model = make_model(seed=0)
    annealed = AnnealedExploration(start=0.0, end=-2.0)
    model.learn(32, callback=annealed)
    model.learn(32, callback=CallbackList([annealed, watch]), reset_num_timesteps=False)
    assert [min(values) for values in watch.seen.values()] == pytest.approx([-1.0, -1.5], abs=1e-6)


def test_by_default_it_dies_out():
    exploration = AnnealedExploration()
    assert exploration.start > exploration.end + 2.0  # to a tenth of what it was, and less
    assert np.exp(exploration.end) < 0.1


@pytest.mark.parametrize("arguments", [{"start": 5.1}, {"end": -20.1}, {"start": float("nan")}, {"end": "low"}])
def test_spreads_that_cannot_be_are_refused(arguments):
    (name,) = arguments
    with pytest.raises((TypeError, ValueError), match=f"{name} must be"):
        AnnealedExploration(**arguments)


def test_an_algorithm_without_such_a_spread_is_refused():
    envs = SDFrictionVecEnv("SDFriction/Force-v0", num_envs=1)
    with pytest.raises(TypeError, match="SAC has no log_std: AnnealedExploration is for PPO"):
        SAC("MlpPolicy", envs, device="cpu", buffer_size=100).learn(1, callback=AnnealedExploration())
