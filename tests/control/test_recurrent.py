"""Recurrent followers: the network is PyTorch's, its file is checked, and training brings it closer to the truth."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest
import torch

from sd_friction_env.control import pretrained
from sd_friction_env.control.policies import PolicyFileError, RecurrentFollower, ThresholdFollower
from sd_friction_env.control.pretrained import recurrent_follower
from sd_friction_env.learning import evaluation, recurrent

BLIND = "SDFriction/BeltSpeedBlind-v0"


def modules(size=7, seed=0):
    torch.manual_seed(seed)
    return torch.nn.GRU(2, size), torch.nn.Linear(size, 2)


def follower(size=7, seed=0, env_id=BLIND):
    weights = {
        name: value.detach().numpy() for module in modules(size, seed) for name, value in module.named_parameters()
    }
    return RecurrentFollower(weights, ThresholdFollower.seeing_all(gym.make(env_id)), (0.1, 0.35), {"origin": "a test"})


def test_the_estimates_are_those_of_pytorch():
    policy, (unit, linear) = follower(), modules()
    readings = np.random.default_rng(0).normal(size=(30, 4, 1)).astype(np.float32)
    inputs, state, estimates = [], None, []
    last = np.zeros(4)
    for reading in readings:
        inputs.append(np.stack([reading[:, 0], last], axis=-1))
        actions, state = policy.predict(reading, state)
        last = actions[:, 0]
        estimates.append(np.stack(policy.estimate(state[1]), axis=-1))
    with torch.no_grad():
        expected = linear(unit(torch.from_numpy(np.array(inputs, np.float32)))[0]).numpy()
    expected = np.stack([0.1 * expected[..., 0], np.clip(0.2 + 0.1 * expected[..., 1], 0.1, 0.35)], axis=-1)
    np.testing.assert_allclose(estimates, expected, atol=1e-6)


def test_one_as_many_and_an_episode_that_begins_forgets():
    policy = follower()
    readings = np.random.default_rng(1).normal(size=(10, 3, 1)).astype(np.float32)
    begins = np.zeros((10, 3), bool)
    begins[6, 1] = True
    state, singles = None, [None] * 3
    for reading, begin in zip(readings, begins, strict=True):
        together, state = policy.predict(reading, state, begin)
        for i in range(3):
            alone, singles[i] = policy.predict(reading[i], singles[i], begin[i])
            np.testing.assert_allclose(alone, together[i], atol=1e-6)
    fresh = None
    for reading in readings[6:, 1]:
        actions, fresh = policy.predict(reading, fresh)
    np.testing.assert_allclose(actions, together[1], atol=1e-6)


def test_a_file_holds_what_was_saved_and_anything_else_is_refused(tmp_path):
    policy, env = follower(), gym.make(BLIND)
    policy.save(tmp_path / "a.npz")
    again = RecurrentFollower.load(tmp_path / "a.npz", env)
    assert again.metadata == {"origin": "a test"}
    assert again.speeds == (0.1, 0.35)
    for name, value in policy.weights.items():
        np.testing.assert_array_equal(again.weights[name], value)
    np.savez(tmp_path / "b.npz", weight=np.ones(3, np.float32), header=np.array("{}"))
    with pytest.raises(PolicyFileError, match=r"b.npz' is not a recurrent follower"):
        RecurrentFollower.load(tmp_path / "b.npz", env)
    with pytest.raises(ValueError, match="needs the sensor 'position', got 'state'"):
        RecurrentFollower.load(tmp_path / "a.npz", gym.make("SDFriction/BeltSpeed-v0"))


@pytest.mark.parametrize(
    "wrong", [{"weight": np.ones((3, 7))}, {"bias": np.array([0.0, np.nan])}, {"more": np.ones(1)}]
)
def test_weights_that_do_not_fit_are_refused(wrong):
    policy = follower()
    with pytest.raises(ValueError, match="weights must be finite, of the shapes"):
        RecurrentFollower({**policy.weights, **wrong}, policy.rule, policy.speeds)


def test_readings_that_are_not_x_alone_are_refused():
    with pytest.raises(ValueError, match=r"of shape \(1,\) or \(n, 1\), got \(2, 3\)"):
        follower().predict(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="must be finite"):
        follower().predict(np.array([np.nan]))


def test_a_follower_of_another_version_of_the_environment_is_refused(tmp_path, monkeypatch):
    env = gym.make(BLIND)
    policy = recurrent_follower(env)
    changed = json.loads(json.dumps(dict(policy.metadata)))
    changed["fingerprint"]["golden"][0][0] += 1e-3
    dataclasses.replace(policy, metadata=changed).save(tmp_path / "SDFriction-BeltSpeedBlind-v0.npz")
    monkeypatch.setattr(pretrained, "RECURRENT", tmp_path)
    with pytest.raises(PolicyFileError, match=r"trained on another SDFriction/BeltSpeedBlind-v0 .*train_recurrent"):
        recurrent_follower(env)
    with pytest.raises(ValueError, match="a recurrent follower was trained for SDFriction/BeltSpeedBlind-v0, got"):
        recurrent_follower(gym.make("SDFriction/BeltSpeedSensed-v0"))


def test_training_with_a_seed_gives_the_same_network(monkeypatch):
    monkeypatch.setattr(recurrent, "EPISODES", 8)
    monkeypatch.setattr(recurrent, "BATCH", 4)
    monkeypatch.setattr(recurrent, "BATCHES", 2)
    first, again, other = (recurrent.train_follower(BLIND, seed=seed, rounds=2, size=8) for seed in (3, 3, 4))
    for name, value in first.weights.items():
        assert value.tobytes() == again.weights[name].tobytes() != other.weights[name].tobytes()


def test_an_error_of_the_velocity_costs_most_near_rest_where_it_is_an_action():
    rest, fast = (torch.tensor([[v, 0.0]]) for v in (0.0, 2.0))
    off = torch.tensor([[0.1, 0.0]])
    assert recurrent._error(fast + off, fast, 3.0).item() == pytest.approx(
        0.1**2 / 2, rel=1e-4
    )  # the action is at its limit
    assert recurrent._error(rest + off, rest, 3.0).item() == pytest.approx(0.1**2 / 2 + 0.3**2, rel=1e-4)


def test_the_shipped_followers_do_what_their_pages_say():
    """Other machines multiply matrices in another order, hence the margin."""
    leasts = {"Blind": 0.9, "BlindLate": 0.85, "BlindHard": 0.7, "Drifting": 0.85, "Excited": 0.4}
    for tier, least in leasts.items():
        env_id = f"SDFriction/BeltSpeed{tier}-v0"
        policy = recurrent_follower(gym.make(env_id))
        table = evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS)
        assert table["suppressed"].mean() >= least, env_id
