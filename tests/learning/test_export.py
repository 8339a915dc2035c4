"""ONNX: the exported agent does what the agent does, from what is measured to what is commanded."""

import dataclasses
import itertools
import json

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import onnx

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.control.pretrained import pretrained_file
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation, export

RANDOMISED = "SDFriction/BeltSpeedRandomised-v0"
FORCE, BELT, SENSED = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0", "SDFriction/BeltSpeedSensed-v0"


def network(env_id, frames=1, activation="Tanh", output="clip"):
    rng = np.random.default_rng(5)
    inputs = frames * make_env(env_id).observation_space.shape[0]
    sizes = [inputs, 16, 8, 1]
    layers = [(rng.normal(size=(a, b)) / np.sqrt(a), 0.1 * rng.normal(size=b)) for a, b in itertools.pairwise(sizes)]
    return NetworkPolicy(tuple(layers), activation=activation, output=output, frames=frames)


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
@pytest.mark.parametrize(("frames", "activation", "output"), [(1, "Tanh", "clip"), (8, "ReLU", "tanh")])
def test_the_model_acts_as_the_agent_on_ten_thousand_measurements(env_id, frames, activation, output):
    policy = network(env_id, frames, activation, output)
    model = export.build(policy, make_env(env_id))
    measurements = export.trial_measurements(policy, env_id, 10_000)
    assert measurements.shape == (10_000, frames, policy.observation_size)
    assert measurements.dtype == np.float32
    assert export.worst_difference(model, policy, env_id, measurements) < export.TOLERANCE
    observations = export.Interface.of(make_env(env_id)).observe(measurements)
    limit = make_env(env_id).task.observation_limit
    assert (np.abs(observations) == limit).any()  # clipping is tried
    if frames > 1:
        # and young windows, zero but for what single precision makes of the measurements at rest
        assert (np.abs(observations[: 10_000 // 2, 0]) < 1e-7).all(axis=-1).any()


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_measurements_and_commands_mean_what_the_environment_means_by_them(env_id):
    assert export.map_difference(env_id, 2000) < export.TOLERANCE


@pytest.mark.parametrize("wrong", [{"offsets": (0.82, 0.0, 0.2), "scales": (0.39, 0.1, 0.1)}, {"command_scale": 0.1}])
def test_a_wrong_map_is_noticed(wrong, monkeypatch):
    right = export.Interface.of(make_env(RANDOMISED))
    monkeypatch.setattr(export.Interface, "of", lambda env: dataclasses.replace(right, **wrong))
    assert export.map_difference(RANDOMISED, 500) > 1e-3


def test_where_the_plants_belt_speed_is_drawn_the_belt_is_told_relative_to_it():
    model = export.build(network(RANDOMISED), make_env(RANDOMISED))
    said = {prop.key: prop.value for prop in model.metadata_props}
    assert json.loads(said["measurements"]) == ["x", "v", "v_belt/belt_speed"]
    assert said["command"] == "target of the belt's speed, over its nominal speed"
    assert json.loads(said["young_window_is_filled_with"])[2] == 1.0


def test_a_wrong_model_is_noticed():
    policy, other = network(BELT), network(BELT, output="tanh")
    model = export.build(policy, make_env(BELT))
    measurements = export.trial_measurements(policy, BELT, 1000)
    assert export.worst_difference(model, other, BELT, measurements) > 1e-3


@pytest.mark.parametrize("env_id", [FORCE, BELT])
def test_it_controls_from_what_is_measured_to_what_is_commanded(env_id):
    """Fed with the true state, it drives the environment as the agent does, and its command is what is applied."""
    policy = network(env_id, frames=3)
    env, twin = make_env(env_id), make_env(env_id)
    model = export.build(policy, env)
    run = export.session(model).run
    said = {prop.key: prop.value for prop in model.metadata_props}
    window = np.tile(np.array(json.loads(said["young_window_is_filled_with"]), np.float32), (3, 1))
    names = json.loads(said["measurements"])
    observation, info = env.reset(seed=4)
    twin.reset(seed=4)
    state = None
    for t in range(60):
        window = np.concatenate([window[1:], np.array([[info[name] for name in names]], np.float32)])
        action, command = run(None, {"measurements": window[None]})
        expected, state = policy.predict(observation, state, t == 0)
        assert action[0] == pytest.approx(expected, abs=1e-5)  # measured in single precision
        if env_id == FORCE:
            assert command[0, 0] == pytest.approx(env.task.force_limit * action[0, 0], rel=1e-6)
        else:
            assert command[0, 0] == pytest.approx(0.2 * (1.0 + 0.5 * action[0, 0]), rel=1e-6)
        observation, *_, info = env.step(expected)
        twin.step(action[0])
        if env_id == BELT and abs(command[0, 0] - window[-1, 2]) < 0.04:  # within what its acceleration allows
            assert twin.get_state().v_belt == pytest.approx(command[0, 0], abs=1e-6)


def test_the_model_says_what_it_wants():
    model = export.build(network(SENSED, 8), make_env(SENSED), {"environment": SENSED})
    said = {prop.key: prop.value for prop in model.metadata_props}
    assert json.loads(said["measurements"]) == ["x"]
    assert said["environment"] == SENSED
    assert said["command"] == "target of the belt's speed"
    assert float(said["control_interval"]) == 0.1
    assert "the last 8 measurements" in said["window"]
    (shape,) = [one.type.tensor_type.shape for one in model.graph.input]
    assert [dim.dim_value or dim.dim_param for dim in shape.dim] == ["n", 8, 1]


def test_what_cannot_be_measured_or_does_not_fit_is_refused():
    shown = gym.make("SDFriction/ForceRandomised-v0", show_parameters=True).unwrapped
    with pytest.raises(ValueError, match="shown parameters cannot be exported"):
        export.build(network(FORCE), shown)
    with pytest.raises(ValueError, match="the agent observes 2 values, and the environment gives 3"):
        export.build(network(FORCE), make_env(BELT))


def test_the_script_writes_the_packages_agent_and_a_run(tmp_path, capsys):
    out = tmp_path / "agent.onnx"
    small = ["--trials", "300"]
    assert main(["export", "--task", "belt", "--tier", "sensed", "--out", str(out), *small]) == 0
    text = capsys.readouterr().out
    assert "largest difference of actions over 300 measurements" in text
    assert "by onnxruntime" in text
    model = onnx.load(out)
    said = {prop.key: prop.value for prop in model.metadata_props}
    assert said["environment"] == SENSED
    assert json.loads(said["origin"])["env_id"] == SENSED
    before = out.read_bytes()
    assert main(["export", "--task", "force", "--out", str(out), *small]) == 2
    assert "exists: replace it with --force" in capsys.readouterr().err
    assert out.read_bytes() == before
    file = str(pretrained_file(FORCE))
    assert main(["export", file, "--task", "force", "--out", str(out), "--force", *small]) == 0
    assert main(["export", "agents/pretrained/force-nominal-ppo-0", "--out", str(tmp_path / "b.ONNX"), *small]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent.onnx", "b.ONNX"]


def test_a_model_that_differs_is_not_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "worst_difference", lambda *arguments: float("nan"))
    out = tmp_path / "agent.onnx"
    assert main(["export", "--task", "force", "--out", str(out), "--trials", "100"]) == 1
    assert "nothing was written" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "a.onnx"], "name a run folder or a policy.npz, or --task"),
        (["--task", "force", "--out", "a.txt"], "--out must end in .onnx"),
        (["--task", "force", "--out", "nowhere/a.onnx"], "lies in no existing folder"),
        (["--task", "force", "--out", "a.onnx", "--trials", "1"], "--trials must be at least 2, got 1"),
        (["nothing.npz", "--task", "force", "--out", "a.onnx"], "nothing.npz"),
        (["nothing.npz", "--out", "a.onnx"], "nothing.npz"),
        (["runs/nothing", "--out", "a.onnx"], "there is no run folder"),
        (["--task", "rope", "--out", "a.onnx"], "invalid choice: 'rope'"),
        (["--tier", "sensed", "--out", "a.onnx"], "--tier sensed needs --task"),
        (["--env-id", "SDFriction/Rope-v0", "--out", "a.onnx"], "--env-id must be one of"),
        (["--env-id", FORCE, "--task", "force", "--out", "a.onnx"], "leave out --task and --tier"),
    ],
)
def test_the_script_refuses_what_cannot_be(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_agent_of_another_task_is_refused(tmp_path, capsys):
    out = str(tmp_path / "a.onnx")
    for command in (
        ["agents/pretrained/force-nominal-ppo-0", "--task", "belt", "--out", out],
        [str(pretrained_file(FORCE)), "--task", "belt", "--out", out],
        [str(pretrained_file(SENSED)), "--task", "force", "--tier", "sensed", "--out", out],
        [str(pretrained_file(FORCE)), "--env-id", "SDFriction/ForceRandomised-v0", "--out", out],
    ):
        assert main(["export", *command]) == 2
        assert "was trained on" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("env_id", "frames"), [(BELT, 1), (SENSED, 8)])
def test_a_file_acts_in_episodes_as_its_agent_does(env_id, frames, tmp_path):
    policy, env = network(env_id, frames), make_env(env_id)
    export.write(export.build(policy, env), tmp_path / "agent.onnx")
    exported = export.ExportedPolicy.load(tmp_path / "agent.onnx", env)
    seeds = evaluation.VALIDATION_SEEDS[:3]
    ours, theirs = (evaluation.run_episodes(acts, env_id, seeds) for acts in (policy, exported))
    early = slice(0, 50)  # the rounding of measurements grows later
    assert np.abs(ours.action[:, early]).max() > 0.1
    assert theirs.action[:, early] == pytest.approx(ours.action[:, early], abs=1e-4)
    observation, _ = env.reset(seed=3)
    action, state = exported.predict(observation)
    assert action.shape == (1,)
    again, _ = exported.predict(observation, state, True)  # a new episode: the window is empty again
    assert again == action


def test_a_file_is_refused_where_it_does_not_fit(tmp_path):
    path = tmp_path / "agent.onnx"
    export.write(export.build(network(BELT), make_env(BELT)), path)
    for env_id in (FORCE, SENSED, RANDOMISED):
        with pytest.raises(ValueError, match=r"agent\.onnx' is for x, v, v_belt, target of the belt's speed, and"):
            export.ExportedPolicy.load(path, make_env(env_id))
    path.write_bytes(b"no model")
    with pytest.raises(ValueError, match=r"agent\.onnx' is no agent of sd-friction export"):
        export.ExportedPolicy.load(path, make_env(BELT))
