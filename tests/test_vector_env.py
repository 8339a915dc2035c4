"""The batch is the single environment, many times: bit for bit."""

import tracemalloc

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from sd_friction_env import ENVIRONMENT_IDS, OscillatorParameters, SDFrictionVectorEnv, limit_cycle

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
        {"parameters": {"geometry": "cubic", "alpha": 0.5}},
        {"parameters": {"alpha": 0.05, "belt_speed": 0.1}},
        {"parameters": {"alpha": 0.001}},
        {"force_limit": 5.0},
        {"actuator": "belt_speed", "belt_acceleration_limit": 1e6, "belt_authority": 1.0},
        {"sensor_delay": 3, "sensor_noise": 0.01},
        {"sensor_delay": 2, "actuator": "belt_speed"},
        {"randomise": {"alpha": (0.2, 0.9), "v_m": (0.3, 0.6)}, "show_parameters": True, "sensor_noise": 0.1},
        {"randomise": {"belt_speed": (0.3, 0.5), "alpha": (0.1, 0.9)}},
        {"randomise": {"alpha": (0.2, 1.5)}, "start": "rest"},
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
    assert len(envs._works) == 1
    assert len(batch(num_envs=2048, threads=8).unwrapped._works) == 4


def mixed_steps(total, seed):
    """Compare batch and single environments over ``total`` steps of random tasks; return the steps and events met."""
    rng = np.random.default_rng(seed)
    done = events = 0
    while done < total:
        n = int(rng.choice([1, 2, 13, 61]))
        ranges = {"alpha": (0.15, 1.0), "belt_speed": (0.05, 0.5), "mu_s": (0.15, 0.3), "mu_m": (0.02, 0.15)}
        names = rng.choice(list(ranges), 2, replace=False)
        kwargs = {
            "parameters": {"geometry": str(rng.choice(["exact", "exact", "cubic", "linear"])), "alpha": 0.7},
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
    done, events = mixed_steps(60_000, seed=0)
    assert events > 1000


@pytest.mark.slow
def test_batch_and_single_environments_agree_over_a_million_mixed_steps():
    done, events = mixed_steps(1_000_000, seed=1)
    assert events > 20_000


def test_every_step_hands_out_new_arrays_unless_told_otherwise():
    for copy in (True, False):
        envs = batch(num_envs=3, copy=copy, info_keys=("x",))
        first, _ = envs.reset(seed=0)
        kept = first.copy()
        step = envs.step(np.ones((3, 1), np.float32))
        second = [step[0], step[1], step[4]["x"]]
        kept_second = [part.copy() for part in second]
        envs.step(-np.ones((3, 1), np.float32))
        assert np.array_equal(first, kept) == copy
        assert [np.array_equal(a, b) for a, b in zip(second, kept_second, strict=True)] == [copy] * 3


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
    held = sum(part.nbytes for part in vars(envs).values() if isinstance(part, np.ndarray))
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
        ({"render_mode": "ascii"}, "render_mode must be one of"),
        ({"render_mode": "rgb_array", "render_envs": [9]}, "render_envs must be"),
        ({"render_mode": "rgb_array", "render_envs": [1, 1]}, "render_envs must name each environment once"),
        ({"max_episode_steps": 10}, "use episode_steps"),
        ({"alpha": 0.2}, "unknown argument 'alpha'"),
        ({"parameters": {"alpha": -1}}, "alpha must be"),
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
        ({"options": 3}, "options must be a mapping"),
        ({"options": [{}]}, "options must be a mapping or 3"),
        ({"options": {"y": 1}}, "unknown option 'y'"),
        ({"options": {"x": [0.1, 0.2]}}, r"options\['x'\] must be one value or 3"),
        ({"options": {"x": [0.1, 0.2, 99.0]}}, r"options\['x'\] must be"),
        ({"options": {"parameters": {"alpha": [1.0]}}}, r"options\['parameters'\]\['alpha'\] must be one value or 3"),
        ({"options": {"parameters": {"alpha": [0.5, 0.5, -1.0]}}}, "alpha must be"),
        ({"options": {"parameters": [{}]}}, r"options\['parameters'\] must be a mapping or 3"),
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
        ("left", "actions must be"),
        (None, "actions must be"),
    ],
)
def test_bad_actions_are_refused_before_anything_is_stepped(actions, message):
    envs, twin = batch(num_envs=3), batch(num_envs=3)
    for each in (envs, twin):
        each.reset(seed=0)
    with pytest.raises((TypeError, ValueError), match=message):
        envs.step(actions)
    assert differences(*(each.step(np.ones((3, 1), np.float32)) for each in (envs, twin))) == []


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
            assert (info["status"][info["_status"]] == "ok").all()
            assert (info["normal_force"] > 0.0).all()
            v_rel = info["v"] - info["v_belt"]
            assert (np.sign(v_rel) == info["mode"]).all() or (v_rel[np.sign(v_rel) != info["mode"]] == 0.0).all()
            steps += n
