"""PPO with rollout and gradient written out against Stable-Baselines3's own, and PPO started from a controller."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sd_friction_env import Table
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import ConstantPolicy, ThresholdFollower
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import models, runs, training, warm_start
from sd_friction_env.learning.networks import network_policy
from sd_friction_env.learning.plan import make_plan, plan_of
from sd_friction_env.learning.ppo import FastPPO
from sd_friction_env.learning.settings import reward_scaling

BELT = "SDFriction/BeltSpeed-v0"
QUICK = {"n_envs": 16, "n_steps": 250, "samples": 4000, "batch_size": 256, "actor_steps": 1500, "critic_steps": 400}


def plan_for(implementation="fast", **overrides):
    settings = {"n_steps": 64, "batch_size": 512, "callback": [], **overrides}
    arguments = {"timesteps": 512, "envs": 8, "eval_freq": 512, "eval_episodes": 2, "env_kwargs": {"episode_steps": 40}}
    return make_plan(BELT, "ppo", overrides=settings, implementation=implementation, **arguments)


def warm_plan(**arguments):
    settings = arguments.pop("warm", {})
    plan = make_plan(BELT, "ppo", **{"start_from": "threshold-follower", "eval_episodes": 5, **arguments})
    numbers = {**plan.hyperparameters["warm_start"], **QUICK, **settings}
    return dataclasses.replace(plan, hyperparameters={**plan.hyperparameters, "warm_start": numbers})


def copied_rollout(source, target):
    """Give a model of Stable-Baselines3 another one's policy and rollout."""
    target.policy.load_state_dict(source.policy.state_dict())
    ours, theirs = source.rollout_buffer, target.rollout_buffer
    for name in (
        "observations",
        "actions",
        "rewards",
        "episode_starts",
        "values",
        "log_probs",
        "advantages",
        "returns",
    ):
        setattr(theirs, name, getattr(ours, name).copy())
    theirs.full, theirs.generator_ready = True, False


class KeepRollout(BaseCallback):
    """Ends training after a rollout, before the update."""

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        raise InterruptedError


# Rollout and update ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ["Tanh", "ReLU"])
def test_a_rollout_has_the_values_and_densities_that_torch_gives_and_the_rewards_of_its_actions(activation):
    """To 1e-5: both compute in single precision."""
    kwargs = {"net_arch": [32, 16], "activation_fn": activation, "log_std_init": -0.7}
    with models.model_of(plan_for(policy_kwargs=kwargs)) as model, pytest.raises(InterruptedError):
        model.learn(512, callback=KeepRollout())
    buffer = model.rollout_buffer
    flat = [torch.from_numpy(part.reshape(512, -1)) for part in (buffer.observations, buffer.actions)]
    with torch.no_grad():
        values, densities, _ = model.policy.evaluate_actions(*flat)
        last = model.policy.predict_values(torch.from_numpy(model._last_obs))
    assert np.abs(values.numpy().reshape(64, 8) - buffer.values).max() < 1e-5
    assert np.abs(densities.numpy().reshape(64, 8) - buffer.log_probs).max() < 1e-5
    # The same actions in environments of the same seeds: same observations; where the time limit ends an episode, the
    # reward has the discounted value of what would have followed.
    envs = models.make_training_envs(
        BELT, {"episode_steps": 40}, 8, 0, scaling=reward_scaling(plan_for().hyperparameters)
    )
    seen, cut = envs.reset(), 0
    starts = np.ones(8, bool)
    for t in range(64):
        assert np.array_equal(seen, buffer.observations[t])
        assert np.array_equal(starts, buffer.episode_starts[t])
        seen, rewards, starts, infos = envs.step(np.clip(buffer.actions[t], -1, 1))
        for i in np.flatnonzero(starts):
            with torch.no_grad():
                after = model.policy.predict_values(torch.from_numpy(infos[i]["terminal_observation"][None]))
            rewards[i] += model.gamma * float(after)
            cut += 1
        assert np.abs(rewards - buffer.rewards[t]).max() < 1e-6
    assert cut == 12
    expected = buffer.rewards[-1] + model.gamma * last.numpy()[:, 0] * ~starts - buffer.values[-1]
    assert np.abs(buffer.advantages[-1] - expected).max() < 1e-5


@pytest.mark.parametrize(
    "more", [{}, {"ent_coef": 0.02, "clip_range_vf": 0.05, "max_grad_norm": 0.05}, {"target_kl": 1e-6}]
)
def test_an_update_moves_the_weights_as_stable_baselines3_does(more):
    """One batch of the whole rollout, so that the order of the samples does not matter; within 1e-5 of weights that
    move by 1e-2: single precision.
    """
    settings = {"n_epochs": 6, "clip_range": 0.02, "learning_rate": 2e-3, **more}
    with (
        models.model_of(plan_for(**settings)) as ours,
        models.model_of(plan_for("stable-baselines3", **settings)) as theirs,
    ):
        assert isinstance(ours, FastPPO)
        assert not isinstance(theirs, FastPPO)
        for model in (ours, theirs):
            model.set_logger(Logger(None, []))
            model._setup_learn(512)
        with pytest.raises(InterruptedError):
            ours.learn(512, callback=KeepRollout())
        copied_rollout(ours, theirs)
        before = torch.cat([part.detach().flatten().clone() for part in theirs.policy.parameters()])
        ours.train()
        theirs.train()
        assert ours._n_updates == theirs._n_updates == (2 if "target_kl" in more else 6)
        weights = [
            torch.cat([part.detach().flatten() for part in model.policy.parameters()]) for model in (ours, theirs)
        ]
        assert float((weights[1] - before).abs().max()) > 1e-3
        assert float((weights[0] - weights[1]).abs().max()) < 1e-5
        logged = [model.logger.name_to_value for model in (ours, theirs)]
        names = ("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction", "std")
        assert logged[0]["train/clip_fraction"] > 0.0 or "target_kl" in more
        for name in (*names, "explained_variance"):
            assert logged[0][f"train/{name}"] == pytest.approx(logged[1][f"train/{name}"], rel=2e-3, abs=1e-5), name


def test_a_run_records_its_implementation_and_one_without_the_record_is_stable_baselines3s(tmp_path):
    plan = plan_for()
    assert plan.configuration()["implementation"] == "fast"
    config = json.loads(json.dumps(plan.configuration()))
    assert plan_of(config) == plan
    del config["implementation"]
    assert plan_of(config).implementation == "stable-baselines3"
    assert make_plan(BELT, "sac").implementation == "stable-baselines3"
    with pytest.raises(ValueError, match="implementation 'fast' is for ppo on the cpu, got td3 on 'cpu'"):
        make_plan(BELT, "td3", implementation="fast")
    with pytest.raises(ValueError, match="implementation must be one of 'fast', 'stable-baselines3', got 'slow'"):
        make_plan(BELT, "ppo", implementation="slow")


# Started from a controller --------------------------------------------------------------------------------------------


def test_the_clone_acts_as_its_teacher_and_its_critic_knows_its_returns():
    """On states of other episodes, away from the rule's jump at the threshold, which no smooth network has."""
    plan = warm_plan()
    with models.model_of(plan) as model:
        warm_start.clone(model, plan)
        warm_start.fit_critic(model, plan)
        clone = network_policy(model.policy)
        env = make_env(BELT)
        rule = ThresholdFollower.from_env(env)
        rng = np.random.default_rng(1)
        envs = models.make_training_envs(BELT, {}, 16, 77)
        seen, states = envs.reset(), []
        for _ in range(300):
            states.append(seen)
            seen = envs.step(np.clip(rule.predict(seen)[0] + rng.normal(0.0, 0.2, (16, 1)), -1, 1).astype(np.float32))[
                0
            ]
        states = np.concatenate(states)
        threshold = 1.1 * (1.0 - env.task.belt_authority) * env.nominal.belt_speed / env.task.v_scale
        error = np.abs(clone.predict(states)[0] - rule.predict(states)[0])[np.abs(states[:, 1] - threshold) > 0.1]
        assert np.sqrt(np.mean(error**2)) < 0.06
        assert training.validate(clone, plan)["suppressed"] == 1.0
        with pytest.raises(InterruptedError):
            model.learn(4096, callback=KeepRollout())
        buffer = model.rollout_buffer
        assert np.var(buffer.returns - buffer.values) < 0.5 * np.var(buffer.returns)
        assert abs(buffer.returns.mean() - buffer.values.mean()) < 0.1 * abs(buffer.returns.mean())


def test_a_run_clones_evaluates_and_then_fits_the_critic_before_its_first_step(tmp_path, monkeypatch):
    done = []
    for name in ("clone", "validate", "fit_critic"):
        monkeypatch.setattr(training, name, noting(done, name, getattr(training, name)))
    small = {"n_steps": 60, "samples": 200, "actor_steps": 50, "critic_steps": 20}
    plan = warm_plan(timesteps=64, envs=4, overrides={"n_steps": 16}, eval_freq=64, warm=small)
    training.train(plan, tmp_path / "run", progress=False)
    assert done == ["clone", "validate", "fit_critic", "validate"]


def noting(done, name, function):
    def noted(*arguments):
        done.append(name)
        return function(*arguments)

    return noted


def test_a_run_started_from_a_controller_says_so_and_resumes_to_the_same_weights(tmp_path, capsys):
    small = {"n_steps": 60, "samples": 200, "actor_steps": 50, "critic_steps": 20}
    overrides = {"n_steps": 32, "n_epochs": 2}
    plan = warm_plan(
        timesteps=512, envs=4, overrides=overrides, eval_freq=128, warm=small, env_kwargs={"episode_steps": 40}
    )
    training.train(plan, tmp_path / "whole", progress=False)
    config = runs.load_config(tmp_path / "whole")
    assert config["start_from"] == "threshold-follower"
    assert config["hyperparameters"]["warm_start"]["samples"] == 200
    assert runs.load_network(tmp_path / "whole").title == "PPO started from threshold-follower"
    # The clone is evaluated before the first step: what a run keeps is no worse than what it starts from.
    assert Table.from_csv(tmp_path / "whole" / "evaluations.csv")["steps"].tolist() == [0, 128, 256, 384, 512]
    assert main(["evaluate", str(tmp_path / "whole"), "--episodes", "2"]) == 0
    assert f"{tmp_path / 'whole'} (started from threshold-follower)" in capsys.readouterr().out
    calls = iter(range(1000))
    with pytest.raises(training.StoppedError):
        training.train(plan, tmp_path / "cut", progress=False, should_stop=lambda: next(calls) >= 70)
    training.train(plan, tmp_path / "cut", progress=False, resume=True)
    whole, cut = (
        torch.load(tmp_path / name / "checkpoints" / "step_000000000512.pt", weights_only=True)
        for name in ("whole", "cut")
    )
    for part in ("policy",):
        assert all(
            torch.equal(value, cut["parameters"][part][name]) for name, value in whole["parameters"][part].items()
        )
    ours, theirs = (saved["parameters"]["policy.optimizer"] for saved in (whole, cut))
    assert ours["steps"] == theirs["steps"] > 0
    assert torch.equal(ours["square"], theirs["square"])
    cold = dataclasses.replace(plan, start_from=None)
    assert cold.configuration() != plan.configuration()


class Silent:
    """A controller whose actions are no numbers."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 1), np.nan, np.float32), None


class Wide(Silent):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), None


half = ConstantPolicy(0.5)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (f"{__name__}:Silent", "must return actions (2, 1) in [-1, 1], got [nan nan]"),
        (f"{__name__}:Wide", "must return actions (2, 1) in [-1, 1], got shape (2, 2)"),
        (f"{__name__}:BELT", "must be or make a policy with a method predict, got 'SDFriction/BeltSpeed-v0'"),
        (f"{__name__}:Nothing", "has no attribute 'Nothing'"),
        ("no_such_module:Thing", "No module named 'no_such_module'"),
        ("magic", "start-from must be threshold-follower, rollout, "),
        ("gone.npz", "there is no policy file 'gone.npz'"),
    ],
)
def test_a_controller_that_cannot_be_a_teacher_is_refused_before_anything_is_written(name, message, tmp_path, capsys):
    command = ["train", "--task", "belt", "--algo", "ppo", "--start-from", name, "--run-folder", str(tmp_path / "run")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "belt", "--algo", "sac"], "start-from is for ppo, got 'sac'"),
        (["--task", "force", "--algo", "ppo"], "has no hyperparameters for 'SDFriction/Force-v0'"),
        (["--task", "belt", "--algo", "ppo", "--implementation", "stable-baselines3"], "start-from is for the implem"),
        (["--task", "belt", "--algo", "ppo", "--set", "warm_start={noise: 1}"], "warm_start must have the entries"),
    ],
)
def test_what_cannot_start_from_a_controller_is_refused(arguments, message, tmp_path, capsys):
    run = ["--start-from", "threshold-follower", "--run-folder", str(tmp_path / "run")]
    assert main(["train", *arguments, *run]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_object_with_predict_can_be_the_teacher():
    plan = warm_plan(start_from=f"{__name__}:half", warm={"actor_steps": 300, "critic_steps": 1, "n_steps": 50})
    with models.model_of(plan) as model:
        warm_start.clone(model, plan)
        seen = torch.randn(100, 3)
        assert float((model.actor.forward(seen)[-1] - 0.5).abs().mean()) < 0.1
