"""The batch as Stable-Baselines3 takes it, beside its own DummyVecEnv."""

import copy

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env import ENVIRONMENT_IDS

sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize  # noqa: E402

from sd_friction_env.environments.sb3 import SDFrictionVecEnv  # noqa: E402

FORCE = "SDFriction/Force-v0"


def dummy(env_id, num_envs, **kwargs):
    return DummyVecEnv([lambda: Monitor(gym.make(env_id, **kwargs))] * num_envs)


def same(ours, theirs):
    if isinstance(theirs, dict):
        return set(ours) == set(theirs) and all(same(ours[name], theirs[name]) for name in theirs if name != "t")
    if isinstance(theirs, np.ndarray):
        return ours.dtype == theirs.dtype and ours.shape == theirs.shape and ours.tobytes() == theirs.tobytes()
    return type(ours) is type(theirs) and (ours == theirs or (ours != ours and theirs != theirs))


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_it_returns_step_by_step_what_a_dummy_vec_env_returns(env_id):
    ours, theirs = SDFrictionVecEnv(env_id, 5, info_keys="all", episode_steps=23), dummy(env_id, 5, episode_steps=23)
    for envs in (ours, theirs):
        envs.seed(11)
    assert same(ours.reset(), theirs.reset())
    assert all(map(same, ours.reset_infos, theirs.reset_infos))
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(80):
        actions = rng.uniform(-1.0, 1.0, (5, 1)).astype(np.float32)
        mine, reference = ours.step(actions), theirs.step(actions)
        assert all(map(same, mine[:3], reference[:3]))
        assert all(map(same, mine[3], reference[3]))
        assert all(map(same, ours.reset_infos, theirs.reset_infos))
        ended += mine[2].sum()
    assert ended >= 15


def test_lost_contact_ends_an_episode_and_is_not_a_time_limit():
    envs = SDFrictionVecEnv(FORCE, 2, parameters={"geometry": "cubic", "alpha": 0.2}, episode_steps=100)
    envs.set_options([{"x": 0.1, "v": 3.0}, {}])
    envs.reset()
    for _ in range(100):
        _, rewards, dones, infos = envs.step(np.zeros((2, 1), np.float32))
        if dones.any():
            break
    assert dones.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["statistics"]["reward_contact_loss"] < -1000.0
    assert infos[0]["episode"]["r"] < -1000.0
    assert rewards[0] < -1000.0


def test_the_observations_kept_from_one_step_are_not_overwritten_by_the_next():
    envs = SDFrictionVecEnv(FORCE, 4)
    first = envs.reset()
    kept = first.copy()
    second = envs.step(np.ones((4, 1), np.float32))[0]
    kept_second = second.copy()
    envs.step(np.ones((4, 1), np.float32))
    assert np.array_equal(first, kept)
    assert np.array_equal(second, kept_second)


def test_ppo_learns_the_same_on_the_batch_as_on_single_environments():
    weights = []
    for envs in (SDFrictionVecEnv(FORCE, 4, episode_steps=30), dummy(FORCE, 4, episode_steps=30)):
        model = sb3.PPO("MlpPolicy", envs, n_steps=64, batch_size=64, n_epochs=2, seed=3, device="cpu")
        model.learn(600)
        assert model.ep_info_buffer[-1]["l"] == 30
        weights.append([part.numpy().copy() for part in model.policy.state_dict().values()])
    assert all(np.array_equal(a, b) for a, b in zip(*weights, strict=True))


def test_off_policy_learning_bootstraps_at_the_time_limit():
    envs = SDFrictionVecEnv(FORCE, 3, episode_steps=10)
    model = sb3.SAC("MlpPolicy", envs, learning_starts=60, train_freq=20, seed=0, device="cpu")
    model.learn(90)
    buffer = model.replay_buffer
    assert buffer.dones[:30].sum() == buffer.timeouts[:30].sum() == 9
    ends = np.flatnonzero(buffer.dones[:30, 0])
    # what follows an episode's end in the buffer is its last observation, not the next episode's first
    assert not any(np.array_equal(buffer.next_observations[k, 0], buffer.observations[k + 1, 0]) for k in ends[:-1])


def test_wrappers_attributes_and_methods_reach_the_environments():
    envs = SDFrictionVecEnv(FORCE, 3)
    envs.seed(5)
    envs.set_options([{"x": 0.1 * i, "v": 0.0} for i in range(3)])
    envs.reset()
    assert [info["x"] for info in envs.reset_infos] == [0.0, 0.1, 0.2]
    assert [state.x for state in envs.env_method("get_state", indices=[2, 0])] == [0.2, 0.0]
    assert envs.get_attr("nominal", 1)[0].alpha == 0.8
    envs.set_attr("label", "left", indices=[0])
    assert envs.get_attr("label") == ["left", None, None]
    assert not envs.has_attr("nonsense")
    assert envs.env_is_wrapped(Monitor) == [True] * 3
    stacked = VecNormalize(VecFrameStack(SDFrictionVecEnv(FORCE, 3), 4))
    assert stacked.reset().shape == (3, 8)
    assert stacked.step(np.zeros((3, 1), np.float32))[0].shape == (3, 8)


class Nothing(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1.0, 1.0, (1,))


def labels(envs, indices):
    """Return which environments a DummyVecEnv or a batch takes indices for, or the error that it raises."""
    envs.set_attr("label", None)
    try:
        envs.set_attr("label", "here", indices)
    except (IndexError, TypeError) as error:
        return type(error), envs.get_attr("label")
    return len(envs.get_attr("label", indices)), len(envs.env_is_wrapped(Monitor, indices)), envs.get_attr("label")


@pytest.mark.parametrize("num_envs", [3, 300])  # from 256 on there is padding behind the last
def test_indices_are_those_of_a_dummy_vec_env(num_envs):
    n = num_envs
    ours, theirs = SDFrictionVecEnv(FORCE, n), DummyVecEnv([Nothing] * n)
    lists = [[0, -1], (2, 2), [-n, 1], np.array([-2, 1]), np.array([2, 0], np.uint8), range(1, 3), [], {0, 2}]
    for indices in (None, 0, 1, n - 1, -1, -n, True, *lists, n, -n - 1, 10**30, [0, n], [-n - 1], 1.0, [1.0], ["a"]):
        assert labels(ours, indices) == labels(theirs, indices), indices


def test_the_last_environment_has_the_number_minus_one():
    envs = SDFrictionVecEnv(FORCE, 300)
    envs.seed(1)
    envs.reset()
    states = envs.env_method("get_state")
    assert envs.env_method("get_state", indices=-1) == envs.env_method("get_state", indices=299) == states[-1:]
    envs.env_method("set_state", states[5], indices=-300)
    envs.env_method("set_state", states[6], indices=[-1])
    assert envs.env_method("get_state") == [states[5], *states[1:-1], states[6]]
    first = envs.step(np.ones((300, 1), np.float32))[0]
    assert np.array_equal(first[[0, 299]], first[[5, 6]])
    for indices in (300, -301, [0, 300]):
        for call in (
            lambda indices: envs.env_method("reset", indices=indices),
            lambda indices: envs.get_attr("task", indices),
            lambda indices: envs.set_attr("mark", 1, indices),
            lambda indices: envs.env_is_wrapped(Monitor, indices),
        ):
            with pytest.raises(IndexError, match=r"indices must be in \[-300, 299\], got"):
                call(indices)
    assert not envs.has_attr("mark")
    assert [state.steps for state in envs.env_method("get_state")] == [1] * 300  # none was reset


PLAIN = ("late_amplitude", "late_stick_fraction", "length", "return")


@pytest.mark.parametrize(
    "make",
    [
        lambda **limit: VecMonitor(SDFrictionVecEnv(FORCE, 2, **limit), info_keywords=PLAIN),
        lambda **limit: VecMonitor(dummy(FORCE, 2, **limit), info_keywords=PLAIN),
        lambda **limit: DummyVecEnv([lambda: Monitor(gym.make(FORCE, **limit), info_keywords=PLAIN)] * 2),
    ],
)
@pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`:UserWarning")
def test_a_monitor_finds_the_statistics_that_it_is_asked_for(make):
    envs = make(max_episode_steps=8)
    envs.seed(3)
    envs.reset()
    for _ in range(8):
        infos = envs.step(np.zeros((2, 1), np.float32))[3]
    for info in infos:
        told = {name: info["episode"][name] for name in PLAIN}
        assert told == {name: info["statistics"][name] for name in PLAIN}
        assert told["length"] == info["episode"]["l"] == 8
        assert told["late_amplitude"] >= 0.0


def test_a_reset_within_a_step_leaves_the_infos_that_a_dummy_vec_env_leaves():
    ours, theirs = SDFrictionVecEnv(FORCE, 2, episode_steps=3), dummy(FORCE, 2, episode_steps=3)
    for envs in (ours, theirs):
        envs.seed(5)
        envs.reset()
    for _ in range(7):
        for envs in (ours, theirs):
            envs.step(np.zeros((2, 1), np.float32))
        assert all(map(same, ours.reset_infos, theirs.reset_infos))
    assert ours.reset_infos[0]["parameters"]["alpha"] == 0.8


def test_states_are_taken_and_given_back():
    envs = SDFrictionVecEnv("SDFriction/BeltSpeedSensed-v0", 3)
    envs.seed(5)
    envs.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3, 1)).astype(np.float32)
    for action in actions[:5]:
        envs.step(action)
    states = envs.env_method("get_state")
    first = [envs.step(action)[:2] for action in actions]
    for i, state in enumerate(states):
        envs.env_method("set_state", state, indices=i)
    second = [envs.step(action)[:2] for action in actions]
    assert all(same(a[0], b[0]) and same(a[1], b[1]) for a, b in zip(first, second, strict=True))


def test_attributes_are_looked_up_and_methods_not_called():
    envs = SDFrictionVecEnv(FORCE, 3)
    envs.seed(2)
    envs.reset()
    before = envs.env_method("get_state")
    assert all(envs.has_attr(name) for name in ("reset", "step", "get_state", "parameters", "render_mode"))
    ask = envs.get_attr("get_state")
    assert [method() for method in ask] == before
    envs.get_attr("reset", [1])[0](seed=9)
    after = envs.env_method("get_state")
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, False, True]
    envs.set_attr("notify", print)
    assert envs.get_attr("notify") == [print] * 3


def test_a_copy_steps_on_with_the_same_bits():
    envs = SDFrictionVecEnv(FORCE, 3, episode_steps=10)
    envs.reset()
    envs.step(np.zeros((3, 1), np.float32))
    twin = copy.deepcopy(envs)
    for _ in range(20):
        ours, theirs = twin.step(np.ones((3, 1), np.float32)), envs.step(np.ones((3, 1), np.float32))
        assert all(map(same, ours[:3], theirs[:3]))


def test_an_action_that_wants_a_gradient_is_refused_with_the_way_out():
    import torch

    envs = SDFrictionVecEnv(FORCE, 3)
    envs.reset()
    with pytest.raises(TypeError, match=r"(?s)actions must be finite numbers .* tensor.detach\(\)"):
        envs.step(torch.zeros(3, 1, requires_grad=True))
    assert envs.step(torch.zeros(3, 1))[0].shape == (3, 2)


def test_names_and_numbers_are_taken_in_every_form_that_the_batch_takes():
    envs = SDFrictionVecEnv(FORCE, 2.0, info_keys=np.array(["x", "v"]))
    assert envs.num_envs == 2
    envs.reset()
    assert {"x", "v"} <= set(envs.step(np.zeros((2, 1), np.float32))[3][0])


def test_states_at_an_episodes_end_are_followed_by_a_reset():
    single = gym.make(FORCE, episode_steps=5).unwrapped
    single.reset(seed=0)
    for _ in range(5):
        single.step(np.zeros(1))
    envs = SDFrictionVecEnv(FORCE, 2, episode_steps=5, info_keys="all")
    envs.reset()
    envs.env_method("set_state", single.get_state())
    _, rewards, dones, _ = envs.step(np.ones((2, 1), np.float32))
    assert (rewards.tolist(), dones.tolist()) == ([0.0, 0.0], [False, False])
    assert [state.steps for state in envs.env_method("get_state")] == [0, 0]
    assert envs.step(np.ones((2, 1), np.float32))[3][0]["time"] == pytest.approx(0.1)


def test_staggered_episodes_end_one_after_another():
    envs = SDFrictionVecEnv(FORCE, 5, episode_steps=50, stagger=True)
    envs.reset()
    ends = []
    for step in range(1, 101):
        dones = envs.step(np.zeros((5, 1), np.float32))[2]
        ends += [(step, i) for i in np.flatnonzero(dones).tolist()]
    assert ends == [(10, 4), (20, 3), (30, 2), (40, 1), (50, 0), (60, 4), (70, 3), (80, 2), (90, 1), (100, 0)]


def test_pictures_are_tiled():
    pytest.importorskip("pygame")
    envs = SDFrictionVecEnv(FORCE, 2, render_mode="rgb_array")
    envs.reset()
    frame = envs.render("rgb_array")
    assert frame.ndim == 3
    assert frame.std() > 1.0
    envs.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env_id": "CartPole-v1"}, "env_id must name"),
        ({"copy": False}, "copy cannot be chosen"),
        ({"stagger": 1}, "stagger must be"),
        ({"num_envs": 0}, r"num_envs must be .* in \[1, "),
        ({"info_keys": ["nonsense"]}, "info_keys must be one of"),
        ({"info_keys": None}, "info_keys must be 'all' or a sequence of names, got None"),
        ({"info_keys": (name for name in ["x"])}, "info_keys must be 'all' or"),
        ({"env_id": 3}, "env_id must name an environment of this package, got 3"),
        ({"num_envs": 2.5}, "num_envs must be a whole number"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        SDFrictionVecEnv(**({"env_id": FORCE, "num_envs": 2} | arguments))
