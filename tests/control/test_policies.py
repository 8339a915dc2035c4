"""Controllers in plain NumPy: hand-computed actions, one interface, and files that cannot do harm."""

import io
import json
import pickle
import subprocess
import sys
import zipfile
import zlib

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env import equilibria
from sd_friction_env.control.policies import (
    ConstantPolicy,
    DelayedFeedback,
    FilteredFeedback,
    LinearFeedback,
    NetworkPolicy,
    PolicyFileError,
    Readings,
    SlidingMode,
    VelocityFeedback,
    ZeroPolicy,
    load_policy,
)


def make(env_id="SDFriction/Force-v0", **arguments):
    return gym.make(env_id, **arguments).unwrapped


def observe(env, x, v, v_belt=None):
    """What the environment would show of a state, by its documented scales."""
    task = env.task
    values = [(x - task.x_offset) / task.x_scale, v / task.v_scale]
    if v_belt is not None:
        values.append((v_belt / env.nominal.belt_speed - 1.0) / task.belt_authority)
    return np.array(values)


def small_network(frames=1, **arguments):
    rng = np.random.default_rng(3)
    layers = [(rng.normal(size=(2 * frames, 8)), rng.normal(size=8)), (rng.normal(size=(8, 1)), rng.normal(size=1))]
    return NetworkPolicy(
        tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers), frames=frames, **arguments
    )


def test_policies_need_no_torch_and_no_gymnasium():
    code = (
        "import sys, sd_friction_env.control.policies as p; p.ZeroPolicy().predict([0., 0.]);"
        "assert not {'torch', 'stable_baselines3', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(("policy", "value"), [(ZeroPolicy(), 0.0), (ConstantPolicy(-0.25), -0.25)])
def test_a_constant_is_constant_for_one_observation_and_for_many(policy, value):
    action, state = policy.predict(np.zeros(3))
    assert action.dtype == np.float32
    assert action.tolist() == [value]
    assert state is None
    assert policy.predict(np.zeros((4, 3)), None, np.ones(4, bool))[0].tolist() == [[value]] * 4


@pytest.mark.parametrize("value", [1.5, float("nan"), "1", True])
def test_a_constant_outside_the_box_is_refused(value):
    with pytest.raises((TypeError, ValueError), match="value must be"):
        ConstantPolicy(value)


def test_velocity_feedback_pushes_against_the_velocity_until_it_saturates():
    env = make()
    policy = VelocityFeedback.from_env(env, 0.5)
    # u = -.5 v = -.01, of a force limit of .05
    assert policy.predict(observe(env, 0.3, 0.02))[0] == pytest.approx(-0.2)
    assert policy.predict(observe(env, 0.3, 10.0))[0].tolist() == [-1.0]
    assert policy.predict(np.array([observe(env, 0.3, v) for v in (-9.0, -0.02, 0.0)]))[0].ravel() == pytest.approx(
        [1.0, 0.2, 0.0]
    )


def test_the_belt_follows_the_mass_under_velocity_feedback():
    env = make("SDFriction/BeltSpeed-v0")
    # a change of .2 x .1 = .02 of the belt's speed, of at most .5 x .2 = .1
    action, _ = VelocityFeedback.from_env(env, 0.2).predict(observe(env, 0.3, 0.1, 0.2))
    assert action == pytest.approx(0.2)


def test_linear_feedback_weighs_physical_distances_from_the_equilibrium():
    env = make("SDFriction/BeltSpeed-v0", x_offset=0.123, x_scale=0.7, v_scale=3.0)
    place = min((e.x for e in equilibria(env.nominal)), key=lambda x: abs(x - 0.123))
    policy = LinearFeedback.from_env(env, (2.0, -3.0, 0.5))
    action, _ = policy.predict(observe(env, place + 0.05, 0.04, 0.22))
    assert action == pytest.approx(2.0 * 0.05 - 3.0 * 0.04 + 0.5 * (0.1 / 0.5), abs=1e-6)
    assert policy.predict(observe(env, place + 5.0, 0.0, 0.2))[0].tolist() == [1.0]
    biased, _ = LinearFeedback.from_env(env, (2.0, -3.0, 0.5), -0.3).predict(observe(env, place + 0.05, 0.04, 0.22))
    assert biased == pytest.approx(action - 0.3, abs=1e-6)


def test_feedback_reads_the_environments_own_observations():
    env = make("SDFriction/BeltSpeed-v0")
    env.reset(seed=1)
    observation, _, _, _, info = env.step(np.array([0.7], np.float32))
    readings = Readings.from_env(gym.make("SDFriction/BeltSpeed-v0"))
    expected = [info["x"] - readings.x_equilibrium, info["v"], (info["v_belt"] / 0.2 - 1.0) / 0.5]
    assert readings.read(observation) == pytest.approx(expected, abs=1e-6)


def test_feedback_passes_over_shown_parameters():
    env = make("SDFriction/ForceRandomised-v0", show_parameters=True)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (5,)
    short, _ = VelocityFeedback.from_env(env, 1.0).predict(observation[:2])
    assert VelocityFeedback.from_env(env, 1.0).predict(observation)[0] == short


def test_feedback_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="sensor sees the position only"):
        VelocityFeedback.from_env(make("SDFriction/ForceSensed-v0"), 1.0)
    with pytest.raises(ValueError, match="force_limit > 0, got 0"):
        VelocityFeedback.from_env(make(force_limit=0.0), 1.0)
    with pytest.raises(ValueError, match="gains must be 2 numbers"):
        LinearFeedback.from_env(make(), (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="gain must be"):
        VelocityFeedback.from_env(make(), float("nan"))
    with pytest.raises(TypeError, match="must be an SDFrictionEnv"):
        Readings.from_env(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="at least 2 entries"):
        VelocityFeedback.from_env(make(), 1.0).predict([0.0])


def test_a_sliding_mode_pushes_towards_its_line_and_is_linear_within_its_layer():
    env = make()
    place = Readings.from_env(env).x_equilibrium
    policy = SlidingMode.from_env(env, slope=2.0, layer=0.1, amplitude=0.8)
    # the surface: v + 2 (x - place)
    for x, v, action in ((0.02, 0.01, -0.4), (0.02, -0.09, 0.4), (0.0, 0.1, -0.8), (0.0, 3.0, -0.8), (-5.0, 0.0, 0.8)):
        assert policy.predict(observe(env, place + x, v))[0] == pytest.approx(action, abs=1e-6)
    other_way = SlidingMode.from_env(env, slope=2.0, layer=0.1, amplitude=-0.8)
    assert other_way.predict(observe(env, place + 0.02, 0.01))[0] == pytest.approx(0.4, abs=1e-6)


def test_delayed_feedback_compares_with_the_reading_of_a_delay_ago():
    env = make()
    policy = DelayedFeedback.from_env(env, gain=2.0, delay=3)
    state, places, actions = None, [0.1, 0.2, 0.15, 0.3, 0.5, 0.9], []
    for t, x in enumerate(places):
        action, state = policy.predict(observe(env, x, 0.0), state, t == 0)
        actions.append(float(action[0]))
    # the first three compare with the first reading
    expected = [2.0 * (places[max(t - 3, 0)] - x) for t, x in enumerate(places)]
    assert actions == pytest.approx(np.clip(expected, -1.0, 1.0), abs=1e-6)
    again, _ = policy.predict(observe(env, 0.7, 0.0), state, np.array([True]))  # as Stable-Baselines3 gives it
    assert again == 0.0  # a new episode knows nothing of the last one


def test_filtered_feedback_estimates_the_velocity():
    env = make("SDFriction/ForceSensed-v0", control_interval=0.05)
    place = Readings.from_env(env).x_equilibrium
    policy = FilteredFeedback.from_env(env, x_gain=0.5, v_gain=-2.0, pole=0.75, bias=0.05, amplitude=0.9)
    state, x, estimate = None, 0.0, 0.0
    for t, speed in enumerate((0.0, 0.1, 0.1, -0.3, 0.2, 9.0)):
        x += 0.05 * speed
        estimate = 0.75 * estimate + 0.25 * speed
        action, state = policy.predict(observe(env, place + x, 0.0)[:1], state, t == 0)
        assert action == pytest.approx(max(-0.9, 0.05 + 0.5 * x - 2.0 * estimate), abs=1e-6)


@pytest.mark.parametrize("env_id", ["SDFriction/BeltSpeed-v0", "SDFriction/BeltSpeedSensed-v0"])
def test_controllers_with_memory_act_alike_alone_and_in_batches(env_id):
    env = make(env_id)
    policies = [
        DelayedFeedback.from_env(env, 3.0, 4),
        FilteredFeedback.from_env(env, x_gain=1.0, v_gain=-3.0, pole=0.6),
    ]
    rng = np.random.default_rng(0)
    observations = rng.normal(scale=0.3, size=(30, 5, env.observation_space.shape[0])).astype(np.float32)
    begins = rng.random((30, 5)) < 0.1
    begins[0] = True
    for policy in policies:
        state, singles = None, [None] * 5
        for t in range(30):
            together, state = policy.predict(observations[t], state, begins[t])
            for i in range(5):
                alone, singles[i] = policy.predict(observations[t, i], singles[i], begins[t, i])
                assert alone.shape == (1,)
                assert alone.tobytes() == together[i].tobytes()


@pytest.mark.parametrize(
    ("make_policy", "message"),
    [
        (lambda env: DelayedFeedback.from_env(env, 1.0, 0), r"delay must be .*\[1, 1000\].* got 0"),
        (lambda env: DelayedFeedback.from_env(env, 1.0, 2.5), r"delay must be a whole number, got 2.5"),
        (lambda env: FilteredFeedback.from_env(env, x_gain=0.0, v_gain=0.0, pole=1.0), r"pole must be .* got 1.0"),
        (lambda env: SlidingMode.from_env(env, slope=1.0, layer=0.0), r"layer must be .* got 0.0"),
        (lambda env: SlidingMode.from_env(env, slope=1.0, layer=1.0, amplitude=2.0), r"amplitude must be .* got 2.0"),
        (
            lambda env: SlidingMode.from_env(make("SDFriction/ForceSensed-v0"), slope=1.0, layer=1.0),
            "the position only",
        ),
    ],
)
def test_classical_controllers_refuse_what_cannot_be(make_policy, message):
    with pytest.raises(ValueError, match=message):
        make_policy(make())


def test_a_network_computes_what_is_written_down():
    # One hidden unit: tanh(1 x + 2 v + .5); action = 3 h - 1, clipped.
    layers = ((np.array([[1.0], [2.0]]), np.array([0.5])), (np.array([[3.0]]), np.array([-1.0])))
    policy = NetworkPolicy(layers)
    assert policy.observation_size == 2
    action, state = policy.predict(np.array([0.1, -0.2]))
    assert state is None
    assert action == pytest.approx([3.0 * np.tanh(0.2) - 1.0], abs=1e-7)
    assert policy.predict(np.array([[5.0, 5.0], [-5.0, -5.0]]))[0].tolist() == [[1.0], [-1.0]]
    squashed = NetworkPolicy(layers, "ReLU", "tanh")
    assert squashed.predict(np.array([0.1, -0.2]))[0] == pytest.approx([np.tanh(3.0 * 0.2 - 1.0)], abs=1e-7)


def test_a_window_of_frames_is_zero_before_the_episode_and_forgets_it_afterwards():
    policy = small_network(frames=3)
    flat = NetworkPolicy(policy.layers)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(5, 2, 2)).astype(np.float32)
    state = None
    for t, batch in enumerate(seen):
        starts = np.array([t == 0, t in (0, 3)])  # the second environment starts over at t = 3
        action, state = policy.predict(batch, state, starts)
        for i, begun in enumerate((0, 3 if t >= 3 else 0)):
            frames = [seen[s, i] if s >= begun else np.zeros(2, np.float32) for s in (t - 2, t - 1, t)]
            assert action[i] == flat.predict(np.concatenate(frames))[0]


def test_batches_and_single_observations_agree():
    policy = small_network()
    batch = np.random.default_rng(1).normal(size=(100, 2))
    assert np.array_equal(policy.predict(batch)[0], [policy.predict(one)[0] for one in batch])


def test_a_network_survives_its_file(tmp_path):
    policy = small_network(frames=2, output="tanh", metadata={"env_id": "SDFriction/Force-v0", "steps": 5})
    policy.save(tmp_path / "policy.npz")
    assert [file.name for file in tmp_path.iterdir()] == ["policy.npz"]
    again = load_policy(tmp_path / "policy.npz")
    assert (again.frames, again.output, again.activation, again.metadata) == (2, "tanh", "Tanh", policy.metadata)
    batch = np.random.default_rng(1).normal(size=(20, 2))
    assert np.array_equal(policy.predict(batch)[0], again.predict(batch)[0])


def test_a_network_refuses_what_does_not_fit():
    policy = small_network()
    with pytest.raises(ValueError, match=r"shape \(2,\) or \(n, 2\), got \(3,\)"):
        policy.predict(np.zeros(3))
    with pytest.raises(ValueError, match="deterministic must be True"):
        policy.predict(np.zeros(2), deterministic=False)
    with pytest.raises(ValueError, match="activation must be one of Tanh, ReLU, got 'Cos'"):
        NetworkPolicy(policy.layers, "Cos")
    with pytest.raises(ValueError, match="must have 1 output"):
        NetworkPolicy(policy.layers[:1])
    with pytest.raises(ValueError, match="do not fit"):
        NetworkPolicy((policy.layers[1], policy.layers[0]))
    with pytest.raises(ValueError, match="not finite"):
        NetworkPolicy(((np.full((2, 1), np.nan), np.zeros(1)),))
    with pytest.raises(ValueError, match="cannot be 3 observations"):
        NetworkPolicy(policy.layers, frames=3)
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        policy.save("policy.pkl")


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_foreign_and_malicious_files_are_refused_and_never_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no policy file '.*gone\.npz'"):
        load_policy(tmp_path / "gone.npz")
    with pytest.raises(PolicyFileError, match="is a folder"):
        load_policy(tmp_path)
    trap = tmp_path / "trap"
    small_network().save(tmp_path / "good.npz")
    good = (tmp_path / "good.npz").read_bytes()
    header = json.dumps({"kind": "sd_friction_env network policy", "format": 1, "layers": 1})
    with io.BytesIO() as buffer:
        np.savez(buffer, header=np.array(header), weights_0=np.array([Evil(trap)], dtype=object))
        evil_array = buffer.getvalue()
    with io.BytesIO() as buffer:
        np.savez(buffer, something=np.zeros(3))
        other_archive = buffer.getvalue()
    with io.BytesIO() as buffer:
        np.save(buffer, np.zeros(3))
        array = buffer.getvalue()
    with io.BytesIO() as buffer:
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("header.txt", "x")
        plain_zip = buffer.getvalue()
    newer = json.dumps({"kind": "sd_friction_env network policy", "format": 99})
    with io.BytesIO() as buffer:
        np.savez(buffer, header=np.array(newer))
        newer_format = buffer.getvalue()
    contents = [b"", b"text", good[: len(good) // 2], pickle.dumps(Evil(trap)), evil_array, other_archive, array]
    for content in [*contents, plain_zip, newer_format]:
        (tmp_path / "file.npz").write_bytes(content)
        with pytest.raises(PolicyFileError, match=r"file\.npz"):
            load_policy(tmp_path / "file.npz")
    assert not trap.exists()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_no_damage_to_a_file_comes_out_as_anything_but_a_policy_file_error(tmp_path, save):
    """Zip, deflate, NumPy's headers and JSON all fail in ways of their own; a flipped byte may also do no harm."""
    path = tmp_path / "policy.npz"
    small_network().save(path)
    with np.load(path) as archive:
        save(path, **archive)
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [good[:length] for length in range(0, len(good), 23)]
    for place in range(len(good)):
        flipped = bytearray(good)
        flipped[place] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    refused = []
    for content in damaged:
        path.write_bytes(content)
        try:
            load_policy(path)
        except PolicyFileError as error:
            refused.append(str(error))
    assert len(refused) > len(good) // 4
    assert all(repr(str(path)) in error for error in refused)


@pytest.mark.parametrize("error", [EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error])
def test_whatever_reading_trips_over_names_the_file(tmp_path, monkeypatch, error):
    small_network().save(tmp_path / "policy.npz")

    def trip(*arguments, **more):
        raise error("tripped")

    monkeypatch.setattr(zipfile.ZipFile, "open", trip)
    with pytest.raises(PolicyFileError, match=rf"policy\.npz.*{error.__name__}: tripped"):
        load_policy(tmp_path / "policy.npz")


def with_memory(env):
    return {
        "filtered": FilteredFeedback.from_env(env, x_gain=1.0, v_gain=-3.0, pole=0.6),
        "delayed": DelayedFeedback.from_env(env, 3.0, 4),
        "window": small_network(frames=3),
    }


@pytest.mark.parametrize("name", ["filtered", "delayed", "window"])
@pytest.mark.parametrize(("before", "now"), [((1, 2), (5, 2)), ((5, 2), (1, 2)), ((3, 2), (2,)), ((2,), (3, 2))])
def test_a_memory_of_another_batch_is_refused_and_not_stretched(name, before, now):
    policy = with_memory(make())[name]
    _, state = policy.predict(np.zeros(before))
    with pytest.raises(ValueError, match=r"state must be what the last call returned .*; got"):
        policy.predict(np.zeros(now), state)
    with pytest.raises(ValueError, match=r"state must be what the last call returned .*; got"):
        policy.predict(np.zeros(before), ())


def test_the_refusal_of_a_memory_names_both_sizes():
    policy = with_memory(make())["filtered"]
    _, state = policy.predict(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"of shapes \(7,\), \(7,\); got \(4,\), \(4,\)"):
        policy.predict(np.zeros((7, 2)), state)


def test_filtered_feedback_forgets_position_and_estimate_where_an_episode_begins():
    env = make("SDFriction/ForceSensed-v0")
    policy = FilteredFeedback.from_env(env, x_gain=0.5, v_gain=-2.0, pole=0.75)
    place = Readings.from_env(env).x_equilibrium
    seen = [
        np.array([observe(env, place + x, 0.0)[:1] for x in pair]) for pair in ((0.0, 0.0), (0.01, 0.01), (0.01, 0.03))
    ]
    _, state = policy.predict(seen[0])
    moving, state = policy.predict(seen[1], state, np.array([False, False]))
    assert (moving < 0.0).all()
    after, state = policy.predict(seen[2], state, np.array([False, True]))
    fresh, _ = policy.predict(seen[2])
    assert after[1] == fresh[1]  # as if nothing had been before
    assert after[0] < fresh[0]  # the other still believes that it moves
    assert state[1][1] == 0.0
