"""Training on tiny budgets: run folders that are whole, safe to load and repeatable; hyperparameters that are data."""

import ast
import contextlib
import dataclasses
import hashlib
import inspect
import json
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sd_friction_env import ENVIRONMENT_IDS, Table, storage
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import load_policy
from sd_friction_env.environments.single import make_env
from sd_friction_env.environments.wrappers import ScaledReward
from sd_friction_env.learning import evaluation, models, networks, runs, settings, tensors, training
from sd_friction_env.learning.plan import make_plan, training_seed

ROOT = Path(__file__).parents[2]
FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"
SHORT = {"episode_steps": 40}
TINY = {
    "ppo": {"n_steps": 32, "n_epochs": 2},
    "sac": {"learning_starts": 40, "buffer_size": 1000, "batch_size": 16},
    "td3": {"learning_starts": 40, "buffer_size": 1000, "batch_size": 16},
    "tqc": {"learning_starts": 40, "buffer_size": 1000, "batch_size": 16},
}


def tiny_plan(algorithm="ppo", env_id=FORCE, seed=0, **arguments):
    arguments = {"timesteps": 256, "envs": 4, "eval_freq": 128, "eval_episodes": 2, "env_kwargs": SHORT} | arguments
    overrides = TINY[algorithm] | arguments.pop("overrides", {})
    return make_plan(env_id, algorithm, overrides=overrides, seed=seed, **arguments)


def tiny_command(folder, *more, algorithm="ppo"):
    settings = [f"--set={name}={value}" for name, value in TINY[algorithm].items()]
    size = ["--timesteps", "256", "--envs", "4", "--eval-freq", "128", "--eval-episodes", "2"]
    what = ["--task", "force", "--algo", algorithm, "--env-arg", "episode_steps=40", "--run-folder", str(folder)]
    return [*what, *size, *settings, *more]


def program(*arguments):
    return [sys.executable, "-W", "error", "scripts/train.py", *arguments]


def observations(config, n=50):
    space = runs.described_space(config["spaces"]["observation"])
    return np.random.default_rng(2).normal(size=(n, *space.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that the program itself has written; tests copy what they change."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    done = subprocess.run(
        program(*tiny_command(folder)), cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "256 steps" in done.stdout
    assert "ppo SDFriction/Force-v0" in done.stderr  # the progress bar
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    import shutil

    return Path(shutil.copytree(finished, tmp_path / "copied"))


# The folder -----------------------------------------------------------------------------------------------------------


def test_a_run_folder_describes_itself(finished):
    assert sorted(path.name for path in finished.parent.iterdir()) == ["tiny"]
    config = runs.load_config(finished)
    assert config["environment"] == {"id": FORCE, "kwargs": SHORT, "frame_stack": 1}
    assert (config["algorithm"], config["seed"], config["steps"], config["status"]) == ("ppo", 0, 256, "finished")
    assert config["hyperparameters"]["policy_kwargs"]["activation_fn"] == "Tanh"
    assert config["command"].startswith("sd-friction train --task force")
    assert {"torch", "stable_baselines3", "gymnasium", "sd_friction_env"} <= set(config["versions"])
    table = Table.from_csv(finished / "evaluations.csv")
    assert table["steps"].tolist() == [128.0, 256.0]
    assert config["best"]["mean_return"] == table["mean_return"].max()
    assert [path.name for path in (finished / "checkpoints").iterdir()] == ["step_000000000256.pt"]
    assert config["checkpoint_freq"] == 128
    assert "resumed" not in config


def test_the_two_forms_of_an_agent_act_alike_after_loading(finished):
    config = runs.load_config(finished)
    network, policy = runs.load_network(finished), runs.load_torch_policy(finished)
    seen = observations(config)
    by_torch, _ = policy.predict(seen, deterministic=True)
    assert np.abs(network.predict(seen)[0] - by_torch).max() < 1e-6
    assert network.metadata["env_id"] == FORCE


def test_the_evaluation_script_takes_the_folder(finished, tmp_path, capsys):
    assert main(["evaluate", str(finished), "--episodes", "2", "--csv", str(tmp_path / "a.csv")]) == 0
    assert str(finished) in capsys.readouterr().out
    table = Table.from_csv(tmp_path / "a.csv")
    seeds = evaluation.EVALUATION_SEEDS[:2]
    expected = evaluation.evaluate(runs.load_network(finished), FORCE, seeds, SHORT)["return"].mean()
    assert table["return"][table["controller"] == str(finished)] == pytest.approx(expected)


def test_tensorboard_has_the_physics_of_the_episodes(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(finished / "tensorboard"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {"episode/late_amplitude", "episode/late_stick_fraction", "episode/reward_vibration"} <= tags
    assert {"episode/reward_effort", "episode/reward_stick", "eval/mean_return", "rollout/ep_rew_mean"} <= tags


@pytest.mark.parametrize("algorithm", ["sac", "td3", "tqc"])
def test_off_policy_runs_load_to_the_same_actions(algorithm, tmp_path):
    result = training.train(tiny_plan(algorithm, BELT), tmp_path / "run", progress=False)
    network = runs.load_network(tmp_path / "run")
    seen = observations(runs.load_config(tmp_path / "run"))
    assert np.array_equal(network.predict(seen)[0], result.policy.predict(seen)[0])
    by_torch, _ = runs.load_torch_policy(tmp_path / "run").predict(seen, deterministic=True)
    assert np.abs(network.predict(seen)[0] - by_torch).max() < 1e-6


def test_the_best_model_is_kept_not_the_last(tmp_path, monkeypatch):
    returns = iter([-10.0, -5.0, -20.0, -30.0])
    rate = evaluation.evaluate

    def rigged(*arguments, **keywords):
        table = rate(*arguments, **keywords)
        table["return"] = np.full(table.n_rows, next(returns))
        table["suppressed"] = np.ones(table.n_rows, dtype=bool)
        return table

    monkeypatch.setattr(evaluation, "evaluate", rigged)
    result = training.train(tiny_plan(timesteps=512), tmp_path / "run", progress=False)
    assert result.best["steps"] == 256
    best = torch.load(tmp_path / "run" / "policy.pt", weights_only=True)
    last = torch.load(tmp_path / "run" / "checkpoints" / "step_000000000512.pt", weights_only=True)
    assert last["steps"] == 512
    assert not torch.equal(best["action_net.weight"], last["parameters"]["policy"]["action_net.weight"])
    assert np.allclose(best["action_net.weight"].numpy().T, result.policy.layers[-1][0])


def test_one_seed_gives_the_same_weights_twice_and_another_gives_others(tmp_path):
    weights = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        training.train(tiny_plan(seed=seed), tmp_path / name, progress=False)
        weights.append(torch.load(tmp_path / name / "policy.pt", weights_only=True))
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert not all(torch.equal(weights[0][key], weights[2][key]) for key in weights[0])


def test_training_leaves_torchs_threads_as_they_were(tmp_path):
    before = torch.get_num_threads()
    training.train(tiny_plan(timesteps=128), tmp_path / "run", progress=False)
    assert torch.get_num_threads() == before


# Folders that are in the way, unfinished or harmful -------------------------------------------------------------------


def test_an_existing_run_is_refused_unless_forced(copied):
    before = (copied / "policy.pt").read_bytes()
    with pytest.raises(runs.RunFolderError, match="--force"):
        training.train(tiny_plan(seed=9), copied, progress=False)
    assert (copied / "policy.pt").read_bytes() == before
    training.train(tiny_plan(seed=9), copied, force=True, progress=False)
    assert runs.load_config(copied)["seed"] == 9
    assert [path.name for path in copied.parent.iterdir()] == ["copied"]


def test_what_is_no_run_is_never_replaced(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "thesis.txt").write_text("years")
    (tmp_path / "file").write_text("x")
    for place in ("work", "file"):
        with pytest.raises(runs.RunFolderError, match="is no run folder"):
            training.train(tiny_plan(), tmp_path / place, force=True, progress=False)
    with pytest.raises(runs.RunFolderError, match="is a file"):
        training.train(tiny_plan(), tmp_path / "file" / "run", progress=False)
    with pytest.raises(runs.RunFolderError, match="does not end in"):
        training.train(tiny_plan(), tmp_path / "run.partial", progress=False)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "thesis.txt", "work"]


def test_a_run_that_was_stopped_is_never_taken_for_a_finished_one(tmp_path):
    calls = iter(range(1000))
    plan = tiny_plan(timesteps=512)
    with pytest.raises(training.StoppedError, match="after 256 steps") as stop:  # the rollout is ended first
        training.train(plan, tmp_path / "run", progress=False, should_stop=lambda: next(calls) >= 39)
    partial = tmp_path / "run.partial"
    assert [path.name for path in tmp_path.iterdir()] == ["run.partial"]
    assert tensors.load_tensors(stop.value.checkpoint)["steps"] == 256
    with pytest.raises(runs.RunFolderError, match="did not finish"):
        runs.load_config(tmp_path / "run")
    with pytest.raises(runs.RunFolderError, match="is unfinished"):
        runs.load_config(partial)
    partial.rename(tmp_path / "looks_finished")
    with pytest.raises(runs.RunFolderError, match="is unfinished"):
        runs.load_network(tmp_path / "looks_finished")
    (tmp_path / "looks_finished").rename(partial)
    with pytest.raises(runs.RunFolderError, match="unfinished run"):
        training.train(tiny_plan(), tmp_path / "run", progress=False)
    training.train(tiny_plan(timesteps=128), tmp_path / "run", force=True, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def damage_config(folder, **changes):
    config = json.loads((folder / "config.json").read_text())
    storage.write_json(folder / "config.json", {**config, **changes})


def test_damaged_folders_are_refused(copied, tmp_path):
    with pytest.raises(runs.RunFolderError, match="there is no run folder"):
        runs.load_config(tmp_path / "gone")
    whole = {name: (copied / name).read_bytes() for name in ("config.json", "policy.pt", "policy.npz")}
    for name, content in whole.items():
        (copied / name).write_bytes(content[: len(content) // 2])
        with pytest.raises(runs.RunFolderError, match=r"damaged|cannot be read"):
            runs.load_network(copied)
        (copied / name).unlink()
        with pytest.raises(runs.RunFolderError, match=r"damaged|cannot be read"):
            runs.load_torch_policy(copied)
        (copied / name).write_bytes(content)
    runs.load_network(copied)
    for changes, message in (
        ({"format": 99}, "format 99"),
        ({"kind": "other"}, "not a run folder of"),
        ({"algorithm": "dqn"}, "values that are not allowed"),
        ({"status": "unfinished"}, "is unfinished"),
    ):
        damage_config(copied, **changes)
        with pytest.raises(runs.RunFolderError, match=message):
            runs.load_config(copied)
        (copied / "config.json").write_bytes(whole["config.json"])


@pytest.mark.parametrize("damage", ["complex", "double", "NaN", "huge", "not tensors"])
def test_weights_that_are_no_finite_numbers_of_their_type_are_refused(damage, copied):
    weights = torch.load(copied / "policy.pt", weights_only=True)
    change = {
        "complex": lambda part: part.to(torch.complex64),
        "double": lambda part: part.double(),
        "NaN": lambda part: part * torch.nan,
        "huge": lambda part: part.flatten()[:1].expand(10**14),
        "not tensors": lambda part: "x",
    }[damage]
    torch.save({name: change(part) for name, part in weights.items()}, copied / "policy.pt")
    files = json.loads((copied / "config.json").read_text())["files"]
    damage_config(copied, files=files | {"policy.pt": storage.file_digest(copied / "policy.pt")})
    with pytest.raises(runs.RunFolderError, match="is damaged"):
        runs.load_torch_policy(copied)


def test_a_network_larger_than_its_weights_is_not_even_built(copied, monkeypatch):
    monkeypatch.setattr(networks, "build_policy", None)
    kwargs = {"net_arch": [4096, 4096]}
    damage_config(copied, hyperparameters={"policy_kwargs": kwargs})
    with pytest.raises(runs.RunFolderError, match=r"policy\.pt does not fit config\.json: it has .* weights"):
        runs.load_torch_policy(copied)


@pytest.mark.parametrize("name", ["config.json", "evaluations.csv"])
def test_a_file_of_a_run_edited_by_hand_or_taken_from_another_is_refused(name, copied):
    text = (copied / name).read_text()
    (copied / name).write_text(text.replace("128", "129"))
    with pytest.raises(runs.RunFolderError, match=name.replace(".", r"\.")):
        runs.load_network(copied)


def test_weights_that_do_not_fit_are_refused(copied):
    config = json.loads((copied / "config.json").read_text())
    config["hyperparameters"]["policy_kwargs"]["net_arch"] = [32]
    storage.write_json(copied / "config.json", config)
    with pytest.raises(runs.RunFolderError, match="does not fit"):
        runs.load_torch_policy(copied)
    config["hyperparameters"]["policy_kwargs"]["activation_fn"] = "os.system"
    storage.write_json(copied / "config.json", config)
    with pytest.raises(runs.RunFolderError, match="activation_fn must be one of 'Tanh', 'ReLU'"):
        runs.load_torch_policy(copied)


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.mark.parametrize("form", ["pickle", "torch"])
def test_a_pickle_in_place_of_the_weights_is_refused_and_never_run(copied, tmp_path, form):
    trap = tmp_path / "trap"
    if form == "pickle":
        (copied / "policy.pt").write_bytes(pickle.dumps(Evil(trap)))
    else:
        torch.save({"weights": Evil(trap)}, copied / "policy.pt")
    digests = json.loads((copied / "config.json").read_text())["files"]
    digests["policy.pt"] = hashlib.sha256((copied / "policy.pt").read_bytes()).hexdigest()
    damage_config(copied, files=digests)
    with pytest.raises(runs.RunFolderError, match="not a table of tensors"):
        runs.load_torch_policy(copied)
    assert not trap.exists()


def test_no_code_here_unpickles_or_evaluates():
    programs = (ROOT / "sd_friction_env" / "cli").glob("*.py")
    for path in [*(ROOT / "sd_friction_env/learning").rglob("*.py"), *programs]:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            assert called not in {"eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "yaml.load"}
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            if called == "torch.load":
                assert keywords["weights_only"] == "True"
            if called == "np.load":
                assert keywords["allow_pickle"] == "False"


# The command line -----------------------------------------------------------------------------------------------------


def test_ctrl_c_keeps_the_last_checkpoint_and_exits_with_130(tmp_path):
    command = program(*tiny_command(tmp_path / "run"), "--timesteps", "10000000", "--eval-freq", "512")
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        checkpoints = tmp_path / "run.partial" / "checkpoints"
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not (checkpoints.is_dir() and any(checkpoints.glob("step_*.pt"))):
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors
    assert "Traceback" not in errors
    last = max(checkpoints.glob("step_*.pt"))
    assert str(last) in errors
    assert f"--run-folder {tmp_path / 'run'} --resume" in errors
    parameters = tensors.load_tensors(last)["parameters"]
    assert {"policy", "policy.optimizer"} <= set(parameters)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--algo", "a2c"], "'a2c'"),
        (["--task", "wheel"], "'wheel'"),
        (["--tier", "hidden"], "'hidden'"),
        (["--env-id", FORCE], "--env-id names task and tier itself"),
        (["--timesteps", "0"], "timesteps must be a whole number in [1, 1000000000000], got 0"),
        (["--timesteps", "many"], "'many'"),
        (["--envs", "-1"], "envs must be a whole number in [1, 65536], got -1"),
        (["--seed", "4294967296"], "seed must be a whole number in [0, 4294967295], got 4294967296"),
        (["--eval-freq", "0"], "eval-freq must be"),
        (["--checkpoint-freq", "0"], "checkpoint-freq must be a whole number in [1, 1000000000000], got 0"),
        (["--eval-episodes", "101"], "eval-episodes must be a whole number in [1, 100], got 101"),
        (["--threads", "0"], "threads must be"),
        (["--device", "abacus"], "device must be one of cpu, auto"),
        (["--set", "gamma=1.5"], "gamma must be a finite number in [0, 1], got 1.5"),
        (["--set", "gamma=.nan"], "gamma must be a finite number in [0, 1], got nan"),
        (["--set", "gama=0.9"], "no hyperparameter 'gama'"),
        (["--set", "gamma"], "--set must be NAME=VALUE"),
        (["--set", "tau=0.1"], "ppo has no hyperparameter 'tau'"),
        (["--set", "learning_rate=exp_1"], "learning_rate must be"),
        (["--set", "policy=CnnPolicy"], "policy must be one of 'MlpPolicy', got 'CnnPolicy'"),
        (["--set", "env_wrapper=os.system"], "env_wrapper must be"),
        (["--set", "policy_kwargs=dict(net_arch=open('x'))"], "policy_kwargs may hold literals"),
        (["--set", "policy_kwargs=dict(net_arch=[0])"], "a width in net_arch must be"),
        (["--set", "policy_kwargs=dict(activation_fn=nn.Module)"], "activation_fn must be one of 'Tanh', 'ReLU'"),
        (["--env-arg", "w_effort=-1"], "w_effort must be a finite number in [0, 1e+06], got -1"),
        (["--env-arg", "colour=red"], "unexpected keyword argument 'colour'"),
        (["--hyperparameters", "gone.yml"], "cannot be read from 'gone.yml'"),
        (["--hyperparameters", "/dev/zero"], "'/dev/zero' must be a file; it is a pipe or a device"),
        (["--hyperparameters", str(ROOT)], "must be a file; it is a folder"),
        (["--set", f"gamma={'9' * 5000}"], "a whole number of 5000 digits; at most 40 are read"),
        (["--set", "gamma=" + "[" * 5000], "5,000 brackets lie in one another"),
        (["--set", "gamma={a: &a [1], b: [*a, *a]}"], "gamma must be a real number in [0, 1], got"),
        (["--set", "policy_kwargs=dict(net_arch=[8192, 8192])"], "net_arch must have at most 33,554,432 weights"),
    ],
)
def test_bad_arguments_are_one_line_and_status_2_before_anything_is_written(change, message, tmp_path, capsys):
    assert main(["train", *tiny_command(tmp_path / "run"), *change]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_refuses_an_existing_folder(finished, capsys):
    assert main(["train", *tiny_command(finished)]) == 2
    assert "--force" in capsys.readouterr().err


# Hyperparameters ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
def test_every_environment_has_hyperparameters_that_are_read_as_rl_zoo_reads_them(algorithm, env_id):
    file = storage.HYPERPARAMETERS / f"{algorithm}.yml"
    raw = yaml.safe_load(file.read_text(encoding="utf-8"))[env_id]
    ours = settings.read_hyperparameters(algorithm, env_id)
    assert {name for name in raw if raw[name] == ours[name]} >= set(raw) - {"policy_kwargs"}
    zoo = eval(raw["policy_kwargs"], {"nn": torch.nn})  # as RL Zoo does, with a file of our own
    zoo["activation_fn"] = zoo["activation_fn"].__name__
    assert zoo == ours["policy_kwargs"]
    json.dumps(ours)
    assert make_plan(env_id, algorithm).steps == raw["n_timesteps"]


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
def test_rl_zoo_trains_from_the_same_files(algorithm, tmp_path):
    what = ["--algo", algorithm, "--env", BELT, "--gym-packages", "sd_friction_env", "-n", "500", "-f", str(tmp_path)]
    file = ["--conf-file", str(storage.HYPERPARAMETERS / f"{algorithm}.yml"), "--eval-freq", "-1", "--device", "cpu"]
    subprocess.run([sys.executable, "-m", "rl_zoo3.train", *what, *file], check=True, cwd=tmp_path, timeout=300)


@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
def test_every_hyperparameter_is_an_argument_of_its_algorithm(algorithm):
    taken = inspect.signature(networks.ALGORITHM_CLASSES[algorithm]).parameters
    assert set(settings.allowed_hyperparameters(algorithm)) - set(settings.OURS) <= set(taken)


@pytest.mark.parametrize("value", [10**400, -(10**5000), 1j], ids=["large", "larger", "complex"])
def test_numbers_beyond_floating_point_are_refused_by_name(value):
    with pytest.raises((TypeError, ValueError), match=r"gamma must be a (finite|real) number in \[0, 1\], got "):
        settings.check_hyperparameters("ppo", {"gamma": value})


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("dict(log_std_init=-1, net_arch=[64, 64])", {"log_std_init": -1.0, "net_arch": [64, 64]}),
        ("dict(net_arch=dict(pi=[8], vf=[16, 4]))", {"net_arch": {"pi": [8], "vf": [16, 4]}}),
        ("{'activation_fn': nn.ReLU, 'ortho_init': False}", {"activation_fn": "ReLU", "ortho_init": False}),
    ],
)
def test_policy_arguments_are_parsed_from_rl_zoos_strings(text, values):
    assert settings.parse_policy_kwargs(text) == values


@pytest.mark.parametrize(
    "text",
    [
        "dict(",
        "dict(**{})",
        "list()",
        "dict(net_arch=[x for x in y])",
        "dict(a=1)",
        "nn.Tanh",
        "dict([])",
        "1",
        "(" * 300,
    ],
)
def test_policy_arguments_that_are_more_than_data_are_refused(text):
    with pytest.raises(ValueError, match=r"policy_kwargs|activation_fn"):
        settings.parse_policy_kwargs(text)


def test_a_batch_is_made_to_fit_what_there_is_to_learn_from():
    assert tiny_plan(envs=4, overrides={"n_steps": 32}).hyperparameters["batch_size"] == 128
    assert tiny_plan(envs=3, overrides={"n_steps": 32, "batch_size": 64}).hyperparameters["batch_size"] == 32


# Environments ---------------------------------------------------------------------------------------------------------


def test_training_seeds_are_no_evaluation_seeds_and_differ_between_runs():
    assert training_seed(0) == 2**32
    assert training_seed(0, 65535) < training_seed(1)
    assert max(*evaluation.EVALUATION_SEEDS, *evaluation.VALIDATION_SEEDS) < training_seed(0)


def test_training_environments_are_the_environment_itself():
    envs = models.make_training_envs(FORCE, {"episode_steps": 20}, 3, 5)
    alone = [make_env(FORCE, {"episode_steps": 20}) for _ in range(3)]
    first = envs.reset()
    singles = [env.reset(seed=training_seed(5, i))[0] for i, env in enumerate(alone)]
    assert np.array_equal(first, singles)
    ends = []
    rng = np.random.default_rng(0)
    for t in range(45):
        actions = rng.uniform(-1, 1, (3, 1)).astype(np.float32)
        seen, rewards, dones, infos = envs.step(actions)
        for i, env in enumerate(alone):
            observation, reward, _, _, _ = env.step(actions[i])
            assert rewards[i] == np.float32(reward)
            if dones[i]:
                ends.append((t + 1, i))
                assert np.array_equal(infos[i]["terminal_observation"], observation)
                assert infos[i]["TimeLimit.truncated"]
                observation, _ = env.reset()
            assert np.array_equal(seen[i], observation)
    # The first episodes are staggered, all later ones are whole.
    assert sorted(ends) == [(7, 2), (14, 1), (20, 0), (27, 2), (34, 1), (40, 0)]
    envs.close()


def test_rewards_are_scaled_by_one_law_in_both_forms():
    scale, power = settings.reward_scaling(settings.read_hyperparameters("ppo", FORCE))
    envs = models.make_training_envs(FORCE, {}, 1, 0, scaling=(scale, power))
    envs.reset()
    _, rewards, _, _ = envs.step(np.array([[0.5]], np.float32))
    terms = envs.unwrapped.batch_info
    raw = sum(terms[f"reward_{term}"][0] for term in ("vibration", "effort", "stick", "contact_loss"))
    assert rewards[0] == pytest.approx(-scale * abs(raw) ** power, rel=1e-6)
    wrapped = ScaledReward(gym.make(FORCE), scale=scale, power=power)
    wrapped.reset(seed=training_seed(0))
    assert wrapped.step(np.array([0.5], np.float32))[1] == pytest.approx(rewards[0], rel=1e-6)
    with pytest.raises(ValueError, match="power must be"):
        ScaledReward(gym.make(FORCE), power=0.0)
    envs.close()


def test_a_network_sees_the_same_frames_as_in_training():
    frames = 3
    env_id = "SDFriction/BeltSpeedSensed-v0"
    envs = VecFrameStack(DummyVecEnv([lambda: make_env(env_id, {"episode_steps": 7})] * 2), frames)
    policy = networks.build_policy("ppo", envs.observation_space, envs.action_space, {"net_arch": [8]})
    network = networks.network_policy(policy, frames)
    envs.seed(3)
    stacked = envs.reset()
    state, starts = None, np.ones(2, dtype=bool)
    for _ in range(20):
        action, state = network.predict(stacked[:, -1:], state, starts)
        by_torch, _ = policy.predict(stacked, deterministic=True)
        assert np.abs(action - by_torch).max() < 1e-6
        stacked, _, starts, _ = envs.step(action)
    envs.close()


@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
@pytest.mark.parametrize("net_arch", [[], [16], [32, 8, 8]])
@pytest.mark.parametrize("activation", ["Tanh", "ReLU"])
def test_the_numpy_actor_equals_the_torch_actor(algorithm, net_arch, activation, tmp_path):
    space = make_env(BELT)
    arguments = {"net_arch": net_arch, "activation_fn": activation}
    torch.manual_seed(1)
    policy = networks.build_policy(algorithm, space.observation_space, space.action_space, arguments)
    network = networks.network_policy(policy)
    network.save(tmp_path / "policy.npz")
    seen = np.random.default_rng(0).normal(size=(500, 3)).astype(np.float32)
    by_torch, _ = policy.predict(seen, deterministic=True)
    assert np.abs(load_policy(tmp_path / "policy.npz").predict(seen)[0] - by_torch).max() < 1e-6


def test_plans_are_frozen():
    with contextlib.suppress(AttributeError):
        tiny_plan().seed = 1
        pytest.fail("a plan must not change")
    assert dataclasses.replace(tiny_plan(), seed=1).seed == 1
