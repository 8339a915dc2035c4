"""The agents that come with the package: each fits its environment, does what it says, and needs no torch."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from scripts import pretrain
from sd_friction_env import load_pretrained
from sd_friction_env.control import pretrained
from sd_friction_env.control.policies import PolicyFileError, load_policy
from sd_friction_env.environments.ids import SOLVED_IDS
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation, runs


@pytest.mark.parametrize("env_id", SOLVED_IDS)
def test_every_environment_has_an_agent_that_does_what_its_file_says(env_id):
    policy = load_pretrained(f"sd_friction_env:{env_id}")
    said = policy.metadata["evaluation"]
    table = evaluation.evaluate(policy, env_id)
    assert (said["first_seed"], said["episodes"]) == (evaluation.EVALUATION_SEEDS[0], len(evaluation.EVALUATION_SEEDS))
    # Other machines multiply matrices in another order, and near a breakaway that may tip an episode.
    assert table["return"].mean() == pytest.approx(said["mean_return"], rel=0.02)
    assert table["suppressed"].mean() == pytest.approx(said["suppressed"], abs=0.03)
    assert {"command", "seed", "versions", "run", "algorithm"} <= set(policy.metadata)


@pytest.mark.parametrize("env_id", SOLVED_IDS)
def test_the_packaged_agent_is_the_best_run_of_its_task(env_id):
    policy = load_pretrained(env_id)
    name = next(name for name in pretrain.NAMES if pretrain.environment_id(*name.split("-")) == env_id)
    best = pretrain.best_run(name)
    assert best is not None
    assert policy.metadata["run"] == best[0].name
    for (w, b), (w_kept, b_kept) in zip(policy.layers, runs.load_network(best[0]).layers, strict=True):
        assert np.array_equal(w, w_kept)
        assert np.array_equal(b, b_kept)


def test_every_kept_run_was_trained_on_the_environment_as_it_is_now():
    folders = sorted(pretrain.PRETRAINED.iterdir())
    assert folders
    for folder in folders:
        config = runs.load_config(folder)
        env = make_env(config["environment"]["id"], config["environment"]["kwargs"])
        space = runs.describe_space(env.observation_space)
        frames = config["environment"]["frame_stack"]
        assert [size * frames for size in space["shape"]] == config["spaces"]["observation"]["shape"]
        assert runs.describe_space(env.action_space) == config["spaces"]["action"]
        assert folder.name.endswith(f"-{config['algorithm']}-{config['seed']}")


def changed_file(tmp_path, monkeypatch, change):
    """Put a copy of the force agent, with a changed fingerprint, where agents are looked for."""
    policy = load_policy(pretrained.pretrained_file("SDFriction/Force-v0"))
    metadata = json.loads(json.dumps(dict(policy.metadata)))
    change(metadata)
    dataclasses.replace(policy, metadata=metadata).save(tmp_path / "SDFriction-Force-v0.npz")
    monkeypatch.setattr(pretrained, "PRETRAINED", tmp_path)


def shift_golden(metadata, by):
    metadata["fingerprint"]["golden"][5][1] += by


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m["fingerprint"]["configuration"]["task"].update(force_limit=0.1), "task force_limit: 0.1 -> 0.05"),
        (lambda m: m["fingerprint"]["configuration"]["parameters"].update(alpha=0.7), "parameters alpha: 0.7 -> 0.8"),
        (lambda m: m["fingerprint"]["configuration"]["observation"].update(shape=[3]), "observation shape"),
        (lambda m: m["fingerprint"]["golden"][5].__setitem__(1, 0.5), "the dynamics, the observation or the reward"),
        (lambda m: shift_golden(m, 2e-6), "the dynamics, the observation or the reward"),
        (lambda m: m["fingerprint"].update(golden=[]), "the dynamics, the observation or the reward"),
        (lambda m: m["fingerprint"].update(golden=[[1.0], [1.0, 2.0]]), "the dynamics, the observation or the reward"),
        (lambda m: m["fingerprint"].update(golden="none"), "the dynamics, the observation or the reward"),
        (lambda m: m["fingerprint"].clear(), "task: not stored"),
        (lambda m: m.update(fingerprint={"hash": "4f2a"}), "parameters: not stored"),
        (lambda m: m["fingerprint"].update(configuration={}), "observation: not stored"),
        (lambda m: m["fingerprint"]["configuration"].pop("task"), "task: not stored"),
        (lambda m: m["fingerprint"]["configuration"].update(task={}), "task: not stored"),
        (lambda m: m["fingerprint"]["configuration"].update(task="easy"), "task: not stored"),
        (lambda m: m["fingerprint"]["configuration"].update(weather={"rain": True}), "weather: unknown"),
        (lambda m: m.update(env_id="SDFriction/BeltSpeed-v0"), "is not an agent for SDFriction/Force-v0"),
        (lambda m: m.pop("fingerprint"), "is not an agent for SDFriction/Force-v0"),
    ],
)
def test_an_agent_of_another_environment_is_refused(change, said, tmp_path, monkeypatch):
    changed_file(tmp_path, monkeypatch, change)
    with pytest.raises(PolicyFileError, match=said):
        load_pretrained("SDFriction/Force-v0")


def test_a_fingerprint_allows_for_rounding_and_for_no_change_of_a_law():
    """The tolerance lies between what single precision rounds (6e-8 of an observation up to some units) and what the
    smallest change of a law does: a friction coefficient off by a thousandth."""
    now = pretrained.fingerprint("SDFriction/BeltSpeed-v0")
    rounded = json.loads(json.dumps(now))
    for row in rounded["golden"]:
        row[:] = [float(np.nextafter(np.float32(value), np.float32(9.0))) for value in row]
    assert rounded != now
    assert pretrained.changes_since(rounded, now) == []
    other = pretrained.fingerprint("SDFriction/BeltSpeed-v0", {"parameters": {"mu_m": 0.05 * 1.001}})
    assert pretrained.changes_since(now | {"golden": other["golden"]}, now) == [
        "the dynamics, the observation or the reward"
    ]
    assert np.abs(np.array(other["golden"]) - now["golden"]).max() > 10.0 * pretrained._GOLDEN_TOLERANCE


def test_an_environment_without_agent_is_named_with_those_that_have_one():
    with pytest.raises(ValueError, match=r"env_id must be one .*SDFriction/Force-v0.*, got 'CartPole-v1'"):
        load_pretrained("CartPole-v1")


def test_loading_and_running_an_agent_imports_no_torch():
    program = (
        "import sys, gymnasium as gym, sd_friction_env\n"
        "policy = sd_friction_env.load_pretrained('SDFriction/BeltSpeed-v0')\n"
        "env = gym.make('SDFriction/BeltSpeed-v0')\n"
        "observation, _ = env.reset(seed=1)\n"
        "action, _ = policy.predict(observation)\n"
        "env.step(action)\n"
        "print('torch' in sys.modules, 'stable_baselines3' in sys.modules)\n"
    )
    run = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, timeout=120)
    assert run.stdout.split() == ["False", "False"]
