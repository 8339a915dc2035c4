"""The batch is the single environment, many times: bit for bit."""

import copy
import dataclasses
import os
import pickle
import subprocess
import sys
import tracemalloc
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList

from sd_friction_env import ENVIRONMENT_IDS, OscillatorParameters, SDFrictionVectorEnv, kernel, limit_cycle
from sd_friction_env.environments.info import PLAIN_STATISTICS, REWARD_TERMS
from sd_friction_env.environments.task import Task
from sd_friction_env.physics.orbits import OrbitError

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


def test_a_list_of_seeds_and_seeds_left_out():
    ours, theirs = batch(num_envs=3, info_keys="all"), one_by_one(num_envs=3)
    for seed in ([5, 1, 5], [None, 9, None], None, 2):
        again = {"seed": seed}
        if seed is None or None in (seed if isinstance(seed, list) else []):
            assert differences(ours.reset(**again)[0], theirs.reset(**again)[0]) == []
        else:
            assert differences(ours.reset(**again), theirs.reset(**again)) == []
        assert ours.np_random_seed[1] == theirs.envs[1].unwrapped.np_random_seed
        for _ in range(20):
            actions = np.full((3, 1), 0.5, np.float32)
            assert differences(ours.step(actions), theirs.step(actions)) == []


def test_without_a_seed_no_two_environments_and_no_two_batches_are_alike():
    first, second = batch(num_envs=4).reset()[0], batch(num_envs=4).reset()[0]
    assert len(np.unique(np.concatenate((first, second)), axis=0)) == 8


@pytest.mark.parametrize(
    "options",
    [
        {"phase": 0.3},
        {"x": 0.1, "v": 0.4},
        {"start": "rest"},
        {"start": "random"},
        {"parameters": {"alpha": 0.3, "geometry": "cubic"}},
        {"parameters": {"alpha": 0.6, "belt_speed": 0.42, "mu_m": 0.1}, "phase": 0.9},
        {"parameters": {"belt_speed": 0.6}},
    ],
)
def test_options_reach_every_environment_as_they_reach_a_single_one(options):
    compare(batch(info_keys="all", episode_steps=30), one_by_one(episode_steps=30), 70, options=options)


def test_options_can_differ_from_environment_to_environment():
    rng = np.random.default_rng(3)
    n = 6
    x, alpha = rng.uniform(-0.5, 0.5, n), rng.uniform(0.2, 0.9, n)
    geometries = ["exact", "cubic", "linear"] * 2
    ours = batch(num_envs=n, info_keys="all", episode_steps=40)
    singles = [gym.make("SDFriction/Force-v0", episode_steps=40) for _ in range(n)]
    parameters = {"alpha": alpha, "geometry": geometries}
    batches = [
        {"x": x, "v": 0.1, "parameters": parameters},
        [{"x": x[i], "v": 0.1, "parameters": {"alpha": alpha[i], "geometry": geometries[i]}} for i in range(n)],
        {"x": x, "v": 0.1, "parameters": [{"alpha": alpha[i], "geometry": geometries[i]} for i in range(n)]},
    ]
    for options in batches:
        first = ours.reset(seed=0, options=options)[0]
        for i, env in enumerate(singles):
            own = {"alpha": float(alpha[i]), "geometry": geometries[i]}
            observation = env.reset(seed=i, options={"x": float(x[i]), "v": 0.1, "parameters": own})[0]
            assert differences(first[i], observation) == []
        for _ in range(39):
            actions = rng.uniform(-1.0, 1.0, (n, 1))
            observations, rewards, _, _, info = ours.step(actions)
            for i, env in enumerate(singles):
                observation, reward, _, _, single = env.step(actions[i])
                assert differences((observations[i], rewards[i]), (observation, reward)) == []
                assert all(info[name][i] == value for name, value in single.items())


def test_what_options_said_holds_for_one_episode():
    envs = batch(num_envs=3, info_keys=("parameters",), episode_steps=5)
    envs.reset(seed=0, options={"parameters": {"alpha": 0.5}})
    for _ in range(5):
        envs.step(np.zeros((3, 1), np.float32))
    info = envs.step(np.zeros((3, 1), np.float32))[4]
    assert info["parameters"]["alpha"].tolist() == [0.8] * 3


def test_a_mask_resets_some_and_leaves_the_others_alone():
    ours, theirs = batch(num_envs=5, info_keys="all"), one_by_one(num_envs=5)
    for envs in (ours, theirs):
        envs.reset(seed=1)
        for _ in range(10):
            envs.step(np.full((5, 1), 0.3, np.float32))
    mask = np.array([True, False, False, True, False])
    options = {"reset_mask": mask, "phase": 0.25}
    again = [envs.reset(seed=[7, 8, 9, 10, 11], options=dict(options)) for envs in (ours, theirs)]
    assert differences(*again) == []
    assert "reset_mask" in options
    for _ in range(30):
        actions = np.full((5, 1), -0.3, np.float32)
        assert differences(ours.step(actions), theirs.step(actions)) == []


@pytest.mark.usefixtures("either_way")
def test_contact_is_lost_as_in_a_single_environment():
    kwargs = {"parameters": {"geometry": "cubic", "alpha": 0.2}, "episode_steps": 100}
    for mode in ("NextStep", "SameStep"):
        ours = batch(num_envs=4, info_keys="all", autoreset_mode=mode, **kwargs)
        theirs = one_by_one(num_envs=4, autoreset_mode=mode, **kwargs)
        assert compare(ours, theirs, 120, options={"x": 0.1, "v": 3.0}) >= 8


@pytest.mark.parametrize(
    "kwargs",
    [
        {"control_interval": 0.5},
        {"control_interval": 0.01},
        {"parameters": {"geometry": "linear"}},
        {"parameters": {"geometry": "cubic", "friction": "exponential", "mu_v": 0.02}},
        {"parameters": {"alpha": 0.05, "belt_speed": 0.1}},
        {"parameters": {"alpha": 0.001}},
        {"force_limit": 5.0},
        {"actuator": "belt_speed", "belt_acceleration_limit": 1e6, "belt_authority": 1.0},
        {"sensor_delay": 3, "sensor_noise": 0.01},
        {"sensor_delay": 2, "actuator": "belt_speed"},
        {"randomise": {"alpha": (0.2, 0.9), "v_m": (0.3, 0.6)}, "show_parameters": True, "sensor_noise": 0.1},
        {"randomise": {"belt_speed": (0.3, 0.5), "alpha": (0.1, 0.9)}},
        {"randomise": {"alpha": (0.2, 1.5)}, "start": "rest"},
        {"drift": {"alpha": (0.2, 0.9), "v_m": (0.3, 0.6)}, "randomise": {"v_m": (0.3, 0.6)}},
        {"drift": {"ripple_amplitude": (0.0, 0.1), "ripple_frequency": (0.5, 2.0)}},
        {"start": "random", "observation_limit": 0.5},
        {"parameters": {"belt_speed": 0.42}},
        {"parameters": {"belt_speed": 0.6}},
        {"reward": lambda info: info["x"] - 0.1 * info["events"]},
        {"reward": lambda info: info["x"], "autoreset_mode": "SameStep"},
    ],
)
def test_every_task_is_the_single_environments(kwargs):
    kwargs = {"episode_steps": 60, **kwargs}
    single = {name: value for name, value in kwargs.items() if name != "autoreset_mode"}
    mode = kwargs.get("autoreset_mode", "NextStep")
    ours = batch(num_envs=17, info_keys="all", **kwargs)
    assert compare(ours, one_by_one(num_envs=17, autoreset_mode=mode, **single), 130) >= 17


def rollout(num_envs, steps, which=slice(None), seed=0, env_id="SDFriction/BeltSpeedRandomised-v0", **kwargs):
    """Return observations and rewards (steps, k, ...) of environments, seeded and driven by their places."""
    envs = batch(env_id, num_envs=num_envs, episode_steps=90, **kwargs)
    envs.reset(seed=seed)
    actions = np.random.default_rng(9).uniform(-1.0, 1.0, (steps, 8192, 1)).astype(np.float32)
    taken = [envs.step(actions[k, :num_envs])[:2] for k in range(steps)]
    return np.array([a[0][which] for a in taken]), np.array([a[1][which] for a in taken])


@pytest.mark.parametrize("num_envs", [1, 2, 64, 255, 257, 1009, 8192])
def test_what_an_environment_does_depends_neither_on_the_batch_nor_on_its_place(num_envs):
    reference = rollout(3, 100)
    few = min(3, num_envs)
    for ours, whole in zip(rollout(num_envs, 100, slice(0, few)), reference, strict=True):
        assert np.array_equal(ours, whole[:, :few])
    # the last one is the first of a batch that is seeded and driven as the last one was
    last = rollout(num_envs, 20, [num_envs - 1])
    envs = gym.make("SDFriction/BeltSpeedRandomised-v0", episode_steps=90)
    envs.reset(seed=num_envs - 1)
    actions = np.random.default_rng(9).uniform(-1.0, 1.0, (20, 8192, 1)).astype(np.float32)
    for k in range(20):
        observation, reward, *_ = envs.step(actions[k, num_envs - 1])
        assert np.array_equal(last[0][k, 0], observation)
        assert last[1][k, 0] == reward


@pytest.mark.parametrize("num_envs", [1009, 1537, 8192])
def test_threads_change_no_bit(num_envs):
    alone, together = rollout(num_envs, 100), rollout(num_envs, 100, threads=2)
    assert np.array_equal(alone[0], together[0])
    assert np.array_equal(alone[1], together[1])
    assert np.array_equal(rollout(num_envs, 30, threads=5)[0], alone[0][:30])


def test_a_small_batch_has_no_use_for_threads():
    envs = batch(num_envs=1000, threads=8).unwrapped
    assert len(envs._episodes._works) == 1
    assert len(batch(num_envs=2048, threads=8).unwrapped._episodes._works) == 4


def mixed_steps(total, seed, geometries):
    """Compare batch and single environments over ``total`` steps of random tasks; return the steps and events met."""
    rng = np.random.default_rng(seed)
    done = events = 0
    while done < total:
        n = int(rng.choice([1, 2, 13, 61]))
        ranges = {"alpha": (0.15, 1.0), "belt_speed": (0.05, 0.5), "mu_s": (0.15, 0.3), "mu_m": (0.02, 0.15)}
        names = rng.choice(list(ranges), 2, replace=False)
        kwargs = {
            "parameters": {"geometry": str(rng.choice(geometries)), "alpha": 0.7},
            "actuator": str(rng.choice(["force", "belt_speed"])),
            "force_limit": float(rng.choice([0.05, 0.5])),
            "belt_authority": float(rng.uniform(0.1, 1.0)),
            "control_interval": float(rng.choice([0.02, 0.1, 0.1, 0.2, 0.3])),
            "randomise": {str(name): ranges[str(name)] for name in names},
            "start": str(rng.choice(["cycle", "random"])),
            "episode_steps": int(rng.integers(20, 200)),
            "sensor_noise": float(rng.choice([0.0, 0.01])),
        }
        mode = str(rng.choice(["NextStep", "SameStep"]))
        ours = batch(num_envs=n, info_keys=("events", "x", "v"), autoreset_mode=mode, **kwargs)
        theirs = one_by_one(num_envs=n, autoreset_mode=mode, **kwargs)
        reset_seed = int(rng.integers(2**32))
        assert differences(ours.reset(seed=reset_seed)[0], theirs.reset(seed=reset_seed)[0]) == []
        push = rng.uniform(-1.0, 1.0, (n, 1))
        for _ in range(300):
            push = np.where(rng.random((n, 1)) < 0.1, rng.uniform(-1.2, 1.2, (n, 1)), push)
            mine, reference = ours.step(push), theirs.step(push)
            assert differences(mine[:4], reference[:4]) == [], kwargs
            if "events" in mine[4]:
                for name in ("events", "x", "v"):
                    assert differences(mine[4][name], reference[4][name]) == [], (name, kwargs)
                events += int(mine[4]["events"].sum())
            done += n
    return done, events


def test_batch_and_single_environments_agree_over_mixed_steps():
    done, events = mixed_steps(50_000, 0, ["exact", "exact", "linear"])
    assert events > 1000


@pytest.mark.slow
def test_batch_and_single_environments_agree_over_a_million_mixed_steps():
    done, events = mixed_steps(1_000_000, 1, ["exact", "exact", "cubic", "linear"])
    assert events > 20_000


def test_every_step_hands_out_new_arrays_unless_told_otherwise():
    for new in (True, False):
        envs = batch(num_envs=3, copy=new, info_keys=("x",))
        first, _ = envs.reset(seed=0)
        kept = first.copy()
        step = envs.step(np.ones((3, 1), np.float32))
        second = [step[0], step[1], step[4]["x"]]
        kept_second = [part.copy() for part in second]
        envs.step(-np.ones((3, 1), np.float32))
        assert np.array_equal(first, kept) == new
        assert [np.array_equal(a, b) for a, b in zip(second, kept_second, strict=True)] == [new] * 3


def test_the_statistics_are_sums_over_the_episode():
    envs = batch(num_envs=5, info_keys="all", episode_steps=40)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    rewards, sticks, lows, highs = [], [], [], []
    for _ in range(40):
        _, reward, _, truncated, info = envs.step(rng.uniform(-1.0, 1.0, (5, 1)))
        rewards.append(reward)
        sticks.append(info["stick_fraction"])
        lows.append(info["x_min"])
        highs.append(info["x_max"])
    assert truncated.all()
    statistics = info["statistics"]
    assert statistics["length"].tolist() == [40] * 5
    assert statistics["return"] == pytest.approx(np.sum(rewards, axis=0))
    assert statistics["late_stick_fraction"] == pytest.approx(np.mean(sticks[-10:], axis=0))
    assert statistics["late_amplitude"] == pytest.approx(0.5 * (np.max(highs[-10:], 0) - np.min(lows[-10:], 0)))
    terms = sum(statistics[f"reward_{name}"] for name in ("vibration", "effort", "stick", "contact_loss"))
    assert statistics["return"] == pytest.approx(terms)


def test_gymnasiums_vector_wrappers_work_on_it():
    from gymnasium.wrappers.vector import DictInfoToList, NormalizeObservation, RecordEpisodeStatistics, RescaleAction

    envs = DictInfoToList(NormalizeObservation(RecordEpisodeStatistics(batch(num_envs=3, episode_steps=10))))
    envs = RescaleAction(envs, np.float32(-2.0), np.float32(2.0))
    envs.reset(seed=0)
    for _ in range(10):
        observations, _, _, truncated, infos = envs.step(np.zeros((3, 1), np.float32))
    assert truncated.all()
    assert observations.shape == (3, 2)
    assert [info["episode"]["l"] for info in infos] == [10, 10, 10]
    assert infos[0]["episode"]["r"] == pytest.approx(infos[0]["statistics"]["return"])


def test_states_are_taken_and_given_back_to_the_bit():
    envs = batch("SDFriction/ForceSensed-v0", num_envs=4, sensor_delay=3).unwrapped
    envs.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 4, 1))
    for action in actions:
        envs.step(action)
    states = envs.get_states()
    first = [envs.step(action)[:2] for action in actions]
    envs.set_states(states)
    assert differences(tuple(envs.step(action)[:2] for action in actions), tuple(first)) == []
    # a single environment goes on from there as well
    single = gym.make("SDFriction/ForceSensed-v0", sensor_delay=3).unwrapped
    single.reset(seed=0)
    single.set_state(states[2])
    for k, action in enumerate(actions):
        observation, reward, *_ = single.step(action[2])
        assert differences((observation, reward), (first[k][0][2], first[k][1][2])) == []


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("parameters", [{}, {"geometry": "cubic", "alpha": 0.2}])
def test_a_state_knows_whether_its_episode_is_over(mode, parameters):
    envs = batch(num_envs=3, autoreset_mode=mode, episode_steps=6, parameters=parameters).unwrapped
    envs.reset(seed=0, options={"x": 0.1, "v": 3.0})
    actions = np.full((3, 1), 0.5, np.float32)
    states = []
    for _ in range(6):
        states.append(envs.get_states())
        *_, terminated, truncated, _ = envs.step(actions)
        over = terminated | truncated
        if over.any():
            break
    assert (terminated if parameters else truncated).all()
    final = envs.get_states()
    envs.set_states(states[0])  # they run again ...
    assert envs.call("get_state") == states[0]
    for _ in states:
        *_, again_terminated, again_truncated, _ = envs.step(actions)
    assert ((again_terminated | again_truncated) == over).all()
    assert envs.get_states() == final
    envs.reset(seed=1)
    envs.set_states(final)  # ... and are over again
    if mode == "Disabled":
        with pytest.raises(gym.error.ResetNeeded, match="environments 0, 1, 2 have ended"):
            envs.step(actions)
    else:
        envs.step(actions)
        after_reset = mode == "NextStep"  # with "SameStep" the reset is already behind them
        assert [state.steps for state in envs.get_states()] == [0 if after_reset else 1] * 3
        assert [state.episode for state in envs.get_states()] == [1] * 3


def test_a_call_that_ends_an_episode_lets_it_be_reset():
    envs = batch(num_envs=3, episode_steps=4).unwrapped
    envs.reset(seed=0)
    for _ in range(4):
        envs.call_at([1], "step", np.zeros(1, np.float32))
    *_, info = envs.step(np.zeros((3, 1), np.float32))
    assert [state.steps for state in envs.get_states()] == [1, 0, 1]
    assert info["_reward_effort"].tolist() == [True, False, True]


def test_a_batch_has_the_states_of_single_environments():
    ours, single = batch("SDFriction/BeltSpeed-v0", num_envs=2), gym.make("SDFriction/BeltSpeed-v0")
    ours.reset(seed=4)
    single.reset(seed=5)
    for _ in range(20):
        ours.step(np.ones((2, 1), np.float32))
        single.step(np.ones(1, np.float32))
    assert ours.unwrapped.get_states()[1] == single.unwrapped.get_state()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))])
@pytest.mark.parametrize("kwargs", [{}, {"copy": False}, {"threads": 2, "num_envs": 1024}, {"info_keys": "all"}])
def test_a_copy_steps_on_with_the_same_bits(kwargs, duplicate):
    envs = batch("SDFriction/BeltSpeedRandomised-v0", episode_steps=20, sensor_delay=2, **kwargs).unwrapped
    shape = (envs.num_envs, 1)
    envs.reset(seed=0)
    for _ in range(15):
        envs.step(np.full(shape, 0.4))
    twin = duplicate(envs)
    for _ in range(10):
        assert differences(twin.step(np.full(shape, 0.4)), envs.step(np.full(shape, 0.4))) == []
    masks = [value for name, value in twin.step(np.zeros(shape))[4].items() if name.startswith("_")]
    assert not any(mask.flags.writeable for mask in masks)
    assert twin.get_states() != envs.get_states()  # it has a state of its own


def test_calls_and_attributes_reach_every_environment():
    envs = batch(num_envs=3)
    assert envs.get_attr("nominal") == (OscillatorParameters(),) * 3
    envs.reset(seed=0)
    assert [state.steps for state in envs.call("get_state")] == [0, 0, 0]
    envs.call("reset", options={"x": 0.5, "v": 0.2})
    assert envs.get_states()[1].x == 0.5
    envs.set_attr("mark", [1, 2, 3])
    envs.set_attr("same", "one")
    assert envs.get_attr("mark") == (1, 2, 3)
    assert envs.get_attr("same") == ("one",) * 3
    with pytest.raises(AttributeError, match="cannot be set"):
        envs.set_attr("task", None)
    with pytest.raises(ValueError, match="values must be 3"):
        envs.set_attr("mark", [1])
    with pytest.raises(AttributeError):
        envs.call("nonsense")
    assert envs.get_attr("np_random_seed") == (0, 1, 2)
    envs.call("reset", seed=9)
    assert envs.get_attr("np_random_seed") == envs.np_random_seed == (9, 9, 9)
    assert envs.get_states()[0] == envs.get_states()[2]


@pytest.mark.parametrize("name", ["reset", "set_state", "step", "get_state"])
def test_a_call_before_the_first_reset_is_not_lost_in_silence(name):
    envs = batch(num_envs=2)
    envs.set_attr("mark", 1)
    single = gym.make("SDFriction/Force-v0").unwrapped
    single.reset(seed=0)
    arguments = {"set_state": [single.get_state()], "step": [np.zeros(1)]}.get(name, [])
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        envs.call(name, *arguments)
    assert envs.get_attr("mark") == (1, 1)
    assert envs.get_attr("render_mode") == (None, None)


def test_pictures_of_some_environments_are_those_of_single_ones():
    pytest.importorskip("pygame")
    envs = batch(num_envs=6, render_mode="rgb_array", render_envs=[4, 1])
    single = gym.make("SDFriction/Force-v0", render_mode="rgb_array")
    envs.reset(seed=10)
    single.reset(seed=14)
    for _ in range(30):
        envs.step(np.full((6, 1), 0.4, np.float32))
        single.step(np.full(1, 0.4, np.float32))
    frames = envs.render()
    assert len(frames) == 2
    assert np.array_equal(frames[0], single.render())
    assert not np.array_equal(frames[0], frames[1])
    envs.close()
    single.close()
    assert len(batch(num_envs=40, render_mode="rgb_array").render()) == 16


def test_a_picture_shows_the_mode_that_the_step_told(monkeypatch):
    pytest.importorskip("pygame")
    from sd_friction_env.pictures import renderer

    shown = []
    monkeypatch.setattr(renderer.Renderer, "draw", lambda self, scene: shown.append(scene))
    envs = batch(num_envs=3, render_mode="rgb_array", render_envs=[1], force_limit=0.3, info_keys=("mode",))
    envs.reset(seed=0, options={"phase": 0.9})
    envs.render()
    told, undriven = [shown[0].mode], [shown[0].mode]
    for _ in range(60):
        info = envs.step(np.ones((3, 1)))[4]  # the push holds the mass on the belt
        envs.render()
        assert envs.call_at([1], "render") == [None]
        state = envs.get_states()[1]
        told += [int(info["mode"][1])] * 2
        undriven += [
            kernel.mode_of(state.parameters.plant, kernel.State(state.x, state.v), kernel.Drive(state.v_belt, 0.0, 0.0))
        ] * 2
    assert [scene.mode for scene in shown] == told
    assert told != undriven
    with pytest.raises(ValueError, match=r"environment 0 is not drawn: render_envs names \[1\]"):
        envs.call("render")


def test_the_passive_batch_keeps_the_orbit_solvers_amplitude():
    envs = batch(num_envs=300, episode_steps=10**6, info_keys=("x_min", "x_max"))
    envs.reset(seed=0)
    low, high = np.full(300, np.inf), np.full(300, -np.inf)
    for _ in range(400):
        info = envs.step(np.zeros((300, 1), np.float32))[4]
        low, high = np.minimum(low, info["x_min"]), np.maximum(high, info["x_max"])
    assert 0.5 * (high - low) == pytest.approx(limit_cycle(OscillatorParameters()).amplitude, abs=1e-9)


def test_an_environment_of_the_batch_takes_less_than_a_kibibyte():
    n = 8192
    envs = batch(num_envs=n).unwrapped
    envs.reset(seed=0)
    tracemalloc.start()
    results = [envs.step(np.zeros((n, 1), np.float32)) for _ in range(2)]
    traced = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    parts = [*vars(envs).values(), *vars(envs._episodes).values()]
    held = sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
    assert held / n > 200  # the episodes' arrays are among them
    assert (held + traced) / n < 1024
    assert len(results) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, r"num_envs must be .* in \[1, 1\.67772e\+07\], got 0"),
        ({"num_envs": 2.5}, "num_envs must be a whole number"),
        ({"threads": 0}, "threads must be"),
        ({"threads": "two"}, "threads must be"),
        ({"autoreset_mode": "sometimes"}, "autoreset_mode must be one of 'NextStep'"),
        ({"copy": "no"}, "copy must be True or False"),
        ({"info_keys": "x"}, "info_keys must be 'all' or"),
        ({"info_keys": ["y"]}, "info_keys must be one of 'x'"),
        ({"info_keys": 5}, "info_keys must be 'all' or a sequence of names, got 5"),
        ({"info_keys": None}, "info_keys must be 'all' or a sequence of names, got None"),
        ({"info_keys": (name for name in ["x"])}, "info_keys must be 'all' or a sequence of names, got <generator"),
        ({"info_keys": [5]}, "info_keys must be 'all' or a sequence of names, got 5 among them"),
        ({"render_envs": 1}, r"render_envs must be None or a sequence of whole numbers in \[0, 2\], got 1"),
        ({"render_mode": "ascii"}, "render_mode must be one of"),
        ({"render_mode": "rgb_array", "render_envs": [9]}, "render_envs must be"),
        ({"render_mode": "rgb_array", "render_envs": [1, 1]}, "render_envs must name each environment once"),
        ({"max_episode_steps": 0}, r"max_episode_steps must be a finite number in \[1, 1e\+09\], got 0"),
        ({"max_episode_steps": 1.5}, "max_episode_steps must be a whole number"),
        ({"max_episode_steps": 10**400}, "max_episode_steps must be a finite number"),
        ({"max_episode_steps": 5, "episode_steps": "few"}, "episode_steps must be a real number"),
        ({"num_envs": 10**400}, "num_envs must be a finite number"),
        ({"threads": 10**5000}, "threads must be a finite number"),
        ({"render_mode": "rgb_array", "render_envs": [10**400]}, "render_envs must be a finite number"),
        ({"alpha": 0.2}, r"__init__\(\) got an unexpected keyword argument 'alpha'"),
        ({"parameters": {"alpha": -1}}, "alpha must be"),
        ({"parameters": {3: 1}}, "parameters must map parameter names to values, got the name 3"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        SDFrictionVectorEnv(**({"num_envs": 3} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed must be at least 0"),
        ({"seed": 1.5}, "seed must be None, a whole number"),
        ({"seed": [1, 2]}, "seed must hold 3 seeds"),
        ({"seed": [1, 2, "x"]}, "seed must be"),
        ({"seed": np.array(3)}, r"seed must be None, a whole number or a sequence of these, got array\(3\)"),
        ({"seed": b"123"}, "seed must be None, a whole number or a sequence of these, got b'123'"),
        ({"options": 3}, "options must be a mapping"),
        ({"options": [{}]}, "options must be a mapping or 3"),
        ({"options": {"y": 1}}, "unknown option 'y'"),
        ({"options": {"x": [0.1, 0.2]}}, r"options\['x'\] must be one value or 3"),
        ({"options": {"x": [0.1, 0.2, 99.0]}}, r"options\['x'\] must be"),
        (
            {"options": {"x": [[0.1], [0.1, 0.2], 0.3]}},
            r"options\['x'\] must be one value or 3, got \[0.1\] among them",
        ),
        ({"options": {"x": np.zeros((3, 1))}}, r"options\['x'\] must be one value or 3, got shape \(3, 1\)"),
        ({"options": {"parameters": {3: 1}}}, r"options\['parameters'\] must map parameter names .* got the name 3"),
        ({"options": {"parameters": {"alpha": [1.0]}}}, r"options\['parameters'\]\['alpha'\] must be one value or 3"),
        ({"options": {"parameters": {"alpha": [0.5, 0.5, -1.0]}}}, "alpha must be"),
        ({"options": {"parameters": [{}]}}, r"options\['parameters'\] must be one value or 3, got 1"),
        ({"options": {"x": 10**400}}, r"options\['x'\] must be a finite number in \[-10, 10\], got 1000"),
        (
            {"options": {"x": [0.1, 0.2, 10**5000]}},
            r"options\['x'\] must be a finite number in \[-10, 10\], got a value",
        ),
        ({"options": {"parameters": {"alpha": [0.5, 10**400, 0.5]}}}, "alpha must be a finite number in"),
        ({"seed": -(10**5000)}, "seed must be at least 0, got a value"),
        ({"seed": [1, 2, Fraction(10**400, 3)]}, "seed must be None, a whole number"),
        ({"options": {"reset_mask": [True, False, False]}}, "reset_mask"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "with a True in it"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, "reset_mask"),
    ],
)
def test_a_reset_that_is_refused_changes_nothing(arguments, message):
    envs, twin = batch(num_envs=3), batch(num_envs=3)
    for each in (envs, twin):
        each.reset(seed=0)
        each.step(np.ones((3, 1), np.float32))
    with pytest.raises((TypeError, ValueError), match=message):
        envs.reset(**arguments)
    for _ in range(5):
        assert differences(*(each.step(np.ones((3, 1), np.float32)) for each in (envs, twin))) == []


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros(3), "shape"),
        (np.zeros((2, 1)), r"shape \(3, 1\), got shape \(2, 1\)"),
        ([[0.0], [np.nan], [0.0]], "environment 1 got"),
        ([[0.0], [0.0], [-np.inf]], "environment 2 got"),
        ([[0.0], [10**400], [0.0]], "actions must be finite numbers"),
        (np.array([[0.0], [-(10**5000)], [0.0]], object), "actions must be finite numbers"),
        ([[0.0], [Fraction(10**400, 3)], [0.0]], "actions must be finite numbers"),
        ("left", "actions must be"),
        (None, "actions must be"),
        ([[0.0], [0.0, 1.0], 0.0], "actions must be finite numbers"),
        ([["1"], ["1"], ["1"]], "actions must be .* of type <U1"),
        (np.zeros((3, 1), complex), r"(?s)actions must be .* of type complex128"),
        (np.zeros((3, 1), "m8[s]"), r"(?s)actions must be .* of type timedelta64\[s\]"),
    ],
)
def test_bad_actions_are_refused_before_anything_is_stepped(actions, message):
    envs, twin = batch(num_envs=3), batch(num_envs=3)
    for each in (envs, twin):
        each.reset(seed=0)
    with pytest.raises((TypeError, ValueError), match=message):
        envs.step(actions)
    assert differences(*(each.step(np.ones((3, 1), np.float32)) for each in (envs, twin))) == []


def test_an_array_without_axes_is_one_value_for_all():
    envs = batch(num_envs=3)
    info = envs.reset(seed=0, options={"x": np.array(0.1), "v": [np.array(0.3), 0.2, np.float32(0.5)]})[1]
    assert info["x"].tolist() == [0.1] * 3
    assert info["v"].tolist() == [0.3, 0.2, 0.5]
    info = envs.reset(options={"parameters": {"alpha": np.array(0.5)}})[1]
    assert info["parameters"]["alpha"].tolist() == [0.5] * 3


def unplaceable(monkeypatch):
    """Let no episode that has parameters of its own find its start."""

    def refuse(*arguments):
        raise OrbitError("no start")

    steppers = kernel.steppers

    def without_starts(plant):
        return steppers(plant)._replace(own_cycle_starts=lambda state, counts, which, *_: np.ones(len(which)))

    monkeypatch.setattr(kernel, "steppers", without_starts)
    monkeypatch.setattr(Task, "start_state", refuse)


@pytest.mark.parametrize("arguments", [{"seed": 5}, {}, {"options": {"reset_mask": np.array([False, True, True])}}])
def test_a_reset_that_finds_no_start_changes_nothing(arguments, monkeypatch):
    envs, twin = (batch(num_envs=3, randomise={"alpha": (0.2, 0.9)}).unwrapped for _ in range(2))
    for each in (envs, twin):
        each.np_random = np.random.default_rng(4)
    with monkeypatch.context() as patched:
        unplaceable(patched)
        for again in ({}, {"seed": 3}):
            with pytest.raises(OrbitError):
                envs.reset(**again)
    with pytest.raises(gym.error.ResetNeeded):
        envs.get_states()
    assert differences(envs.reset(), twin.reset()) == []  # the stream of random numbers is where it was
    for each in (envs, twin):
        each.step(np.ones((3, 1), np.float32))
    with monkeypatch.context() as patched:
        unplaceable(patched)
        with pytest.raises(OrbitError):
            envs.reset(**arguments)
    assert envs.np_random_seed == twin.np_random_seed == (None,) * 3
    assert envs.get_states() == twin.get_states()
    for _ in range(5):
        assert differences(*(each.step(np.ones((3, 1), np.float32)) for each in (envs, twin))) == []
    assert differences(envs.reset(), twin.reset()) == []


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_step_that_finds_no_start_for_the_next_episodes_can_be_taken_again(mode, monkeypatch):
    kwargs = {"num_envs": 3, "episode_steps": 4, "randomise": {"alpha": (0.2, 0.9)}, "autoreset_mode": mode}
    envs, twin = batch(**kwargs).unwrapped, batch(**kwargs).unwrapped
    actions = np.ones((3, 1), np.float32)
    for each in (envs, twin):
        each.reset(seed=0)
        for _ in range(4 if mode == "NextStep" else 3):
            each.step(actions)
    before = envs.get_states()
    with monkeypatch.context() as patched:
        unplaceable(patched)
        for _ in range(2):
            with pytest.raises(OrbitError):
                envs.step(actions)
    if mode == "NextStep":
        assert envs.get_states() == before
        assert differences(envs.step(actions), twin.step(actions)) == []
    else:  # stepped, and waiting for the reset that now succeeds
        assert differences(envs.step(actions)[0], twin.step(actions)[0]) == []
    assert [state.episode for state in envs.get_states()] == [1] * 3


def states_with(envs, **changes):
    first, second, third = envs.get_states()
    return [first, dataclasses.replace(second, **changes), third]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"x": "a"}, r"states\[1\]\.x must be a real number in .*, got 'a'"),
        ({"x": np.zeros(2)}, r"states\[1\]\.x must be a real number in .*, got array"),
        ({"v": np.nan}, r"states\[1\]\.v must be a finite number in .*, got nan"),
        ({"x": 10**400}, r"states\[1\]\.x must be a finite number in .*, got 1000"),
        (
            {"worst_cost": -(10**5000), "ended": True},
            r"states\[1\]\.worst_cost must be a finite number in .*, got a value",
        ),
        ({"episode": 10**400}, r"states\[1\]\.episode must be in \[0, 2\*\*63\), got 1000"),
        ({"past": ((1.0, 10**400),)}, r"states\[1\]\.past must be a tuple of pairs"),
        ({"steps": 1.5}, r"states\[1\]\.steps must be a whole number, got 1\.5"),
        ({"key": -1}, r"states\[1\]\.key must be in \[0, 2\*\*63\), got -1"),
        ({"ended": 3}, r"states\[1\]\.ended must be True or False, got 3"),
        ({"parameters": {}}, r"states\[1\]\.parameters must be OscillatorParameters, got \{\}"),
        ({"past": ((1.0,),)}, r"states\[1\]\.past must be a tuple of pairs"),
        ({"past": ((1.0, 2.0), (1.0,))}, r"states\[1\]\.past must be a tuple of pairs"),
        ({"past": 3}, r"states\[1\]\.past must be a tuple of pairs"),
    ],
)
def test_a_state_made_by_hand_is_refused_before_any_is_taken(changed, message):
    envs = batch(num_envs=3, sensor_delay=2).unwrapped
    envs.reset(seed=0)
    bad = states_with(envs, **changed)
    envs.step(np.ones((3, 1)))
    before = envs.get_states()
    with pytest.raises((TypeError, ValueError), match=message):
        envs.set_states(bad)
    assert envs.get_states() == before


def test_of_environments_that_are_reset_within_a_step_info_tells_what_reset_tells():
    for mode in ("NextStep", "SameStep"):
        kwargs = {"num_envs": 4, "episode_steps": 6, "autoreset_mode": mode}
        ours = DictInfoToList(batch("SDFriction/ForceRandomised-v0", **kwargs))
        theirs = DictInfoToList(one_by_one("SDFriction/ForceRandomised-v0", **kwargs))
        names = [set(info) for info in ours.reset(seed=3)[1]]
        theirs.reset(seed=3)
        states = [dataclasses.replace(state, steps=i) for i, state in enumerate(ours.unwrapped.get_states())]
        ours.unwrapped.set_states(states)  # so that they end one after another
        for env, state in zip(theirs.unwrapped.envs, states, strict=True):
            env.unwrapped.set_state(state)
        resets, over = 0, np.zeros(4, bool)
        for _ in range(20):
            *_, terminated, truncated, mine = ours.step(np.zeros((4, 1), np.float32))
            reference = theirs.step(np.zeros((4, 1), np.float32))[4]
            is_reset = over if mode == "NextStep" else terminated | truncated
            over = terminated | truncated
            for i in np.flatnonzero(is_reset):
                final = {name: mine[i].pop(name) for name in ("final_obs", "final_info") if name in mine[i]}
                assert set(final) == ({"final_obs", "final_info"} if mode == "SameStep" else set())
                assert set(mine[i]) == names[i]
                assert {name: reference[i][name] for name in mine[i]} == mine[i]
                resets += 1
            for i in np.flatnonzero(~is_reset):
                assert set(mine[i]) - {"statistics", *PLAIN_STATISTICS} == set(REWARD_TERMS)
        assert resets >= 8


@pytest.mark.parametrize(
    ("arguments", "length"),
    [
        ({"max_episode_steps": 5}, 5),
        ({"max_episode_steps": 5, "episode_steps": 9}, 5),
        ({"max_episode_steps": 9, "episode_steps": 5}, 5),
        ({"max_episode_steps": 510}, 510),
        ({"max_episode_steps": -1, "episode_steps": 6}, 6),
        ({}, 500),
    ],
)
def test_a_time_limit_is_known_to_the_batch_and_to_its_spec(arguments, length):
    envs = batch(num_envs=2, **arguments)
    assert envs.spec.max_episode_steps == envs.unwrapped.task.episode_steps == length
    twin = batch(num_envs=2, episode_steps=length)
    assert differences(envs.reset(seed=0), twin.reset(seed=0)) == []
    for _ in range(length):
        step = envs.step(np.ones((2, 1), np.float32))
        assert differences(step, twin.step(np.ones((2, 1), np.float32))) == []
    assert step[3].all()
    assert step[4]["statistics"]["length"].tolist() == step[4]["length"].tolist() == [length] * 2
    again = gym.make_vec(envs.spec)
    assert (again.num_envs, again.unwrapped.task) == (2, envs.unwrapped.task)


def test_places_are_those_of_a_list():
    envs = batch(num_envs=300).unwrapped
    for indices, places in (
        (None, list(range(300))),
        (-1, [299]),
        (np.int64(-300), [0]),
        (np.array(7), [7]),
        ((2, -2), [2, 298]),
        (np.array([5, -5], np.int8), [5, 295]),
        ((i for i in (1, 1)), [1, 1]),
        (range(3), [0, 1, 2]),
        ([], []),
        (True, [1]),
    ):
        assert envs.places(indices) == places
    for indices in (300, -301, [0, 300], np.array([-301]), 10**400):
        with pytest.raises(IndexError, match=r"indices must be in \[-300, 299\], got "):
            envs.places(indices)
    for indices in (1.0, "ab", [None], np.array([True, False]), [[1]]):
        with pytest.raises(TypeError, match="indices must be None, a whole number or several of them, got "):
            envs.places(indices)


# What the cases below run in a process of their own: threads, once started, stay in a process.
FORKING = """
import hashlib, multiprocessing, os, sys, threading
import gymnasium as gym, numba, numpy as np, sd_friction_env

def steps(envs, count=5):
    digest = hashlib.sha256()
    for k in range(count):
        for part in envs.step(np.full((envs.num_envs, 1), 0.1 * k))[:4]:
            digest.update(part.tobytes())
    return digest.hexdigest()

def made(threads):
    envs = gym.make_vec("SDFriction/Force-v0", num_envs=2048, threads=threads)
    envs.reset(seed=0)
    return envs

@numba.njit(parallel=True)
def total(values):
    result = 0.0
    for i in numba.prange(len(values)):
        result += values[i]
    return result

def in_fork(function):
    reading, writing = os.pipe()
    if (child := os.fork()) == 0:
        os.write(writing, function().encode())
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == 0, f"the child ended with {status}"
    return os.read(reading, 100).decode()

def in_process(function):
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=lambda: queue.put(function()))
    child.start()
    child.join()
    assert child.exitcode == 0, f"the child ended with {child.exitcode}"
    return queue.get()

def twice(function):
    return lambda: in_fork(function)

def stepped_on(envs):
    steps(envs)
    return envs
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.parametrize(
    "case",
    [
        "envs, twin = stepped_on(made(2)), stepped_on(made(1)); run = lambda: steps(envs)",
        "stepped_on(made(2)); twin = made(1); run = lambda: steps(made(2))",
        "total(np.ones(9)); envs, twin = made(2), made(1); run = lambda: steps(envs)",
        "envs, twin = made(2), made(1); run = lambda: steps(envs)",
        # a child of the child
        "envs, twin = stepped_on(made(2)), stepped_on(made(1)); run = twice(lambda: steps(envs))",
    ],
)
def test_a_forked_process_steps_the_same_bits_whoever_has_started_threads(case):
    code = f"{FORKING}\n{case}\nfound = [in_fork(run), in_process(run)]\nassert found == [steps(twin)] * 2\n"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=300)


def test_states_are_as_many_as_environments_and_in_order():
    envs = batch(num_envs=3).unwrapped
    envs.reset(seed=0)
    for bad, message in (
        (5, "states must be a sequence of 3, .* got 5"),
        ((state for state in envs.get_states()), "states must be a sequence of 3, .* got <generator"),
        (envs.get_states()[:2], "states must be 3, one per environment, got 2"),
        ([1, 2, 3], r"states\[0\] must be an EnvState as get_state\(\) returns it, got 1"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            envs.set_states(bad)


def test_stepping_without_an_episode_is_refused():
    envs = batch(num_envs=3, autoreset_mode="Disabled", episode_steps=4)
    with pytest.raises(gym.error.ResetNeeded, match="before step"):
        envs.step(np.zeros((3, 1)))
    with pytest.raises(gym.error.ResetNeeded, match="reset all environments once"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=0)
    for _ in range(4):
        envs.step(np.zeros((3, 1)))
    with pytest.raises(gym.error.ResetNeeded, match="environments 0, 1, 2 have ended"):
        envs.step(np.zeros((3, 1)))


@pytest.mark.slow
def test_a_thousand_million_steps_leave_nothing_broken():
    n = 8192
    rng = np.random.default_rng(0)
    kwargs = {"randomise": {"alpha": (0.3, 0.95), "belt_speed": (0.05, 0.5), "mu_m": (0.02, 0.12)}}
    every = [
        batch(env_id, num_envs=n, threads=2, info_keys=("x", "v", "v_belt", "mode", "normal_force", "status"), **kwargs)
        for env_id in ("SDFriction/Force-v0", "SDFriction/BeltSpeed-v0")
    ]
    for seed, envs in enumerate(every):
        envs.reset(seed=seed)
        envs.unwrapped.stagger()
    steps = 0
    while steps < 10**9:
        actions = rng.uniform(-1.0, 1.0, (n, 1))
        for envs in every:
            observations, rewards, terminated, _, info = envs.step(actions)
            assert np.isfinite(observations).all()
            assert (rewards <= 0.0).all()
            assert not terminated.any()
            assert (info["status"] == kernel.OK).all()
            assert (info["normal_force"] > 0.0).all()
            v_rel = info["v"] - info["v_belt"]
            assert (np.sign(v_rel) == info["mode"]).all() or (v_rel[np.sign(v_rel) != info["mode"]] == 0.0).all()
            steps += n
