"""Our environments with Gymnasium's wrappers and Minari. (RL Zoo and TensorBoard: test_training.py.)"""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.control.policies import VelocityFeedback

FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"


def play(env, steps, seed=0):
    """Play random actions; return observations, rewards and truncations."""
    env.action_space.seed(seed)
    seen = [env.reset(seed=seed)[0]]
    rewards, ends = [], []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        seen.append(observation)
        rewards.append(reward)
        ends.append(bool(terminated or truncated))
        if ends[-1]:
            break
    return np.array(seen), np.array(rewards), ends


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_frames_are_stacked_oldest_first(env_id):
    plain, rewards, _ = play(gym.make(env_id), 12)
    stacked, same, _ = play(wrappers.FrameStackObservation(gym.make(env_id), 4), 12)
    assert np.array_equal(rewards, same)
    assert np.array_equal(stacked[-1], plain[-4:])
    flat, _, _ = play(wrappers.FlattenObservation(wrappers.FrameStackObservation(gym.make(env_id), 4)), 12)
    assert np.array_equal(flat[-1], plain[-4:].ravel())


def test_normalised_rewards_are_the_rewards_over_a_running_scale():
    env = wrappers.NormalizeReward(gym.make(FORCE), gamma=0.9)
    _, rewards, _ = play(env, 500)
    _, plain, _ = play(gym.make(FORCE), 500)
    ratios = rewards[400:] / plain[400:]
    assert ratios.std() < 0.05 * ratios.mean()
    batch = vector_wrappers.NormalizeReward(gym.make_vec(FORCE, num_envs=4), gamma=0.9)
    batch.reset(seed=0)
    assert np.isfinite([batch.step(batch.action_space.sample())[1] for _ in range(20)]).all()


LIMITED = [
    (lambda: gym.make(BELT, max_episode_steps=7), 7),
    (lambda: gym.make(BELT, max_episode_steps=510), 510),
    (lambda: gym.make(BELT, max_episode_steps=7, episode_steps=9), 7),
    (lambda: gym.make(BELT, max_episode_steps=9, episode_steps=7), 7),
    (lambda: gym.make(BELT, max_episode_steps=-1, episode_steps=9), 9),
    (lambda: gym.make(BELT, episode_steps=510), 510),
    (lambda: gym.make(BELT), 500),
    (lambda: wrappers.TimeLimit(gym.make(BELT), 5), 5),
    (lambda: wrappers.TimeLimit(wrappers.RecordEpisodeStatistics(gym.make(BELT, max_episode_steps=6)), 8), 6),
]


@pytest.mark.parametrize(("make", "length"), LIMITED)
def test_an_episode_is_as_long_as_the_time_limit_around_it_and_ends_with_its_statistics(make, length):
    env, plain = make(), gym.make(BELT, episode_steps=length)
    came_to = []
    for each in (env, plain, env):  # a second episode too
        each.reset(seed=3)
        for _ in range(length):
            *result, info = each.step(np.full(1, 0.5, np.float32))
            assert ("statistics" in info) == bool(result[-1])
        assert result[-1]
        assert info["statistics"]["length"] == info["length"] == length
        assert info["late_amplitude"] == info["statistics"]["late_amplitude"] >= 0.0
        came_to.append(info["statistics"])
    assert came_to[0] == came_to[1] == came_to[2]


def test_a_time_limit_around_a_wrapper_that_repeats_steps_counts_that_wrappers():
    env = wrappers.TimeLimit(wrappers.RepeatAction(gym.make(BELT), 2), 5)
    env.reset(seed=0)
    ends = []
    while not any(ends):
        ends.append(env.step(np.full(1, 0.5, np.float32))[3])
    assert ends == [False] * 4 + [True]
    assert env.unwrapped.get_state().steps == 10


def test_lost_contact_costs_the_steps_that_a_time_limit_leaves():
    costs = []
    for limit in ({"max_episode_steps": 30}, {"episode_steps": 30}, {}):
        env = gym.make(FORCE, parameters={"geometry": "cubic", "alpha": 0.2}, **limit)
        env.reset(options={"x": 0.1, "v": 3.0})
        terminated = False
        while not terminated:
            *_, terminated, _, info = env.step(np.zeros(1, np.float32))
        costs.append(info["reward_contact_loss"])
    assert costs[0] == costs[1] > 10.0 * costs[2]


def test_a_time_limit_around_another_environment_is_not_ours():
    inner = gym.make(FORCE)

    class Shell(gym.Env):
        observation_space, action_space = inner.observation_space, inner.action_space

        def reset(self, **kwargs):
            return inner.reset(**kwargs)

    wrappers.TimeLimit(Shell(), 5).reset(seed=0)
    lengths = 0
    over = False
    while not over:
        over = inner.step(np.zeros(1, np.float32))[3]
        lengths += 1
    assert lengths == 500


def test_the_spec_says_how_long_an_episode_is_and_makes_the_environment_again():
    for arguments, length in (({}, 500), ({"episode_steps": 9}, 9), ({"max_episode_steps": 5}, 5)):
        env = gym.make(FORCE, **arguments)
        assert env.spec.max_episode_steps == length
        again = gym.make(env.spec)
        assert again.spec == env.spec
        assert len(play(again, 600)[1]) == length
        timed = wrappers.TimeAwareObservation(env)
        assert timed.observation_space.high[-1] == length
        assert play(timed, 600)[0][:, -1].tolist() == list(range(length + 1))


@pytest.mark.parametrize("env_id", [FORCE, "SDFriction/BeltSpeedSensed-v0"])
@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_a_client_that_tries_arguments_finds_pythons_words(make, env_id):
    """TorchRL gives every environment ``frameskip`` and takes it back if these words say so."""
    with pytest.raises(TypeError, match=r"__init__\(\) got an unexpected keyword argument 'frameskip'"):
        make(env_id, frameskip=1, render_mode=None)
    make(env_id, render_mode=None).reset(seed=0)


SINGLE_WRAPPERS = {
    "Autoreset": {},
    "ClipAction": {},
    "ClipReward": {"min_reward": -1.0},
    "DelayObservation": {"delay": 2},
    "DiscretizeAction": {"bins": 5},
    "DiscretizeObservation": {"bins": 5},
    "DtypeObservation": {"dtype": np.float64},
    "FlattenObservation": {},
    "FrameStackObservation": {"stack_size": 3},
    "MaxAndSkipObservation": {},
    "NormalizeObservation": {},
    "NormalizeReward": {},
    "OrderEnforcing": {},
    "PassiveEnvChecker": {},
    "RecordEpisodeStatistics": {},
    "RepeatAction": {"num_repeats": 2},
    "RescaleAction": {"min_action": np.float32(-2.0), "max_action": np.float32(2.0)},
    "RescaleObservation": {"min_obs": np.float32(-1.0), "max_obs": np.float32(1.0)},
    "ReshapeObservation": {"shape": (2, 1)},
    "StickyAction": {"repeat_action_probability": 0.3},
    "TimeAwareObservation": {},
    "TimeLimit": {"max_episode_steps": 4},
    "TransformReward": {"func": lambda reward: 2.0 * reward},
}


@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")  # of Gymnasium's Box
@pytest.mark.parametrize("name", SINGLE_WRAPPERS)
def test_gymnasiums_wrappers_take_the_environment(name):
    if not hasattr(wrappers, name):
        pytest.skip(f"this Gymnasium has no {name}")
    env = getattr(wrappers, name)(gym.make(FORCE, episode_steps=8), **SINGLE_WRAPPERS[name])
    env.action_space.seed(0)
    for _ in range(2):
        observation, _ = env.reset(seed=0)
        over = False
        while not over:
            assert env.observation_space.contains(observation)
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            over = terminated or truncated
        assert np.isfinite(float(reward))
        assert info["statistics"]["length"] <= 8


VECTOR_WRAPPERS = {
    "ClipAction": {},
    "ClipReward": {"min_reward": -1.0},
    "DictInfoToList": {},
    "DtypeObservation": {"dtype": np.float64},
    "FlattenObservation": {},
    "NormalizeObservation": {},
    "NormalizeReward": {},
    "RecordEpisodeStatistics": {},
    "RescaleAction": {"min_action": np.float32(-2.0), "max_action": np.float32(2.0)},
    "RescaleObservation": {"min_obs": np.float32(-1.0), "max_obs": np.float32(1.0)},
    "ReshapeObservation": {"shape": (2, 1)},
    "TransformAction": {"func": lambda actions: 0.5 * actions},
    "TransformReward": {"func": lambda rewards: 2.0 * rewards},
    "VectorizeTransformReward": {"wrapper": wrappers.TransformReward, "func": lambda reward: 2.0 * reward},
    "VectorizeTransformObservation": {"wrapper": wrappers.ReshapeObservation, "shape": (2, 1)},
}


@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")  # of Gymnasium's Box
@pytest.mark.parametrize("keys", ["all", ()])
@pytest.mark.parametrize("name", VECTOR_WRAPPERS)
def test_gymnasiums_vector_wrappers_take_the_batch(name, keys):
    envs = gym.make_vec(FORCE, num_envs=3, episode_steps=4, info_keys=keys)
    envs = getattr(vector_wrappers, name)(envs, **VECTOR_WRAPPERS[name])
    observations, _ = envs.reset(seed=0)
    ended = 0
    for _ in range(11):
        assert envs.observation_space.contains(observations)
        observations, rewards, _, truncated, infos = envs.step(envs.action_space.sample())
        assert np.isfinite(rewards).all()
        if truncated.all():
            last = infos[2]["statistics"]["length"] if isinstance(infos, list) else infos["statistics"]["length"][2]
            assert last == 4
            ended += 1
    assert ended == 2


def leaves(info, path=""):
    for name, value in info.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{path}{name}/")
        else:
            yield f"{path}{name}", value


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_whatever_info_holds_another_library_can_take(env_id, mode):
    """DLPack is the way of all converters of arrays; it knows numbers only, and nothing that cannot be written to."""
    envs = gym.make_vec(env_id, num_envs=3, episode_steps=3, autoreset_mode=mode, info_keys="all")
    infos = [envs.reset(seed=0)[1]]
    for _ in range(7):
        _, _, terminated, truncated, info = envs.step(np.zeros((3, 1), np.float32))
        infos.append(info)
        over = terminated | truncated
        if mode == "Disabled" and over.any():
            infos.append(envs.reset(options={"reset_mask": over})[1])
    seen = set()
    for info in infos:
        for path, value in leaves(info):
            taken = np.from_dlpack(value if value.flags.writeable else value.copy())
            assert len(taken) == 3
            if not path.endswith("final_obs") or path.endswith("_final_obs"):
                assert taken.tobytes() == value.tobytes()
            seen.add(path)
    assert {"status", "parameters/geometry", "statistics/return", "late_amplitude"} <= seen | {
        path.removeprefix("final_info/") for path in seen
    }
    assert ("final_obs" in seen) == (mode == "SameStep")


def test_last_observations_are_a_tensor_with_a_row_for_each_environment():
    envs = gym.make_vec(FORCE, num_envs=4, episode_steps=5, autoreset_mode="SameStep").unwrapped
    envs.reset(seed=0)
    states = envs.get_states()
    envs.set_states([dataclasses.replace(state, steps=4 * (i % 2)) for i, state in enumerate(states)])
    info = envs.step(np.zeros((4, 1), np.float32))[4]
    final = info["final_obs"]
    assert [row is None for row in final] == [True, False, True, False]
    taken = np.from_dlpack(final)
    assert (taken.shape, taken.dtype) == ((4, 2), np.float32)
    assert not taken[[0, 2]].any()
    assert np.array_equal(taken[[1, 3]], np.stack(final[[1, 3]]))
    assert np.array_equal(np.from_dlpack(info["_final_obs"].copy()), [False, True, False, True])


@pytest.mark.parametrize("vectorised", [{}, {"vectorization_mode": "sync"}])
def test_infos_become_tensors(vectorised):
    pytest.importorskip("array_api_compat")
    torch = pytest.importorskip("torch")
    single = wrappers.NumpyToTorch(gym.make(FORCE, episode_steps=4))
    single.reset(seed=0, options={"x": 0.5, "parameters": {"alpha": 0.7}})
    for _ in range(4):
        info = single.step(torch.zeros(1))[4]
    plain = gym.make_vec(FORCE, num_envs=3, episode_steps=4, **vectorised)
    envs = vector_wrappers.NumpyToTorch(gym.make_vec(FORCE, num_envs=3, episode_steps=4, **vectorised))
    results = [(envs.reset(seed=0), plain.reset(seed=0))]
    results += [(envs.step(torch.zeros(3, 1)), plain.step(np.zeros((3, 1), np.float32))) for _ in range(9)]
    for (*_, ours), (*_, theirs) in results:
        for (path, value), (name, expected) in zip(leaves(ours), leaves(theirs), strict=True):
            assert path == name
            assert isinstance(value, torch.Tensor)
            assert np.array_equal(value.numpy(), expected, equal_nan=True)
    assert all(isinstance(value, torch.Tensor) for _, value in leaves(info))


@pytest.mark.filterwarnings("ignore:.*Overwriting existing videos:UserWarning")
def test_an_episode_is_recorded(tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make(BELT, render_mode="rgb_array", episode_steps=4, render_size=(320, 240))
    env = wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda episode: True, disable_logger=True)
    play(env, 4)
    env.close()
    (film,) = tmp_path.glob("*.mp4")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert ffmpeg.count_frames_and_secs(str(film))[0] == 5  # the first before the first step


def test_statistics_of_a_batch_are_recorded():
    batch = vector_wrappers.RecordEpisodeStatistics(gym.make_vec(FORCE, num_envs=3, episode_steps=10))
    batch.reset(seed=0)
    total = np.zeros(3)
    for _ in range(10):
        _, rewards, _, truncations, infos = batch.step(batch.action_space.sample())
        total += rewards
    assert truncations.all()
    assert infos["episode"]["l"].tolist() == [10] * 3
    assert infos["episode"]["r"] == pytest.approx(total)


# Minari leaves its temporary folders to the garbage collector.
@pytest.mark.filterwarnings("ignore:Implicitly cleaning up:ResourceWarning")
@pytest.mark.slow
def test_a_minari_data_set_holds_the_episodes_and_makes_the_environment_again(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = minari.DataCollector(gym.make(FORCE, episode_steps=30, force_limit=0.08))
    policy = VelocityFeedback.from_env(env, 1.5)
    returns = []
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(policy.predict(observation)[0])
            total += float(reward)
            over = terminated or truncated
        returns.append(total)
    about = dict.fromkeys(("author", "author_email", "code_permalink", "description"), "a test")
    env.create_dataset("sd-friction/force-v0", algorithm_name="velocity feedback", eval_env=FORCE, **about)
    env.close()
    again = minari.load_dataset("sd-friction/force-v0")
    assert (again.total_episodes, again.total_steps) == (2, 60)
    assert [episode.rewards.sum() for episode in again] == pytest.approx(returns)
    made = again.recover_environment()
    assert made.unwrapped.task.force_limit == 0.08
    first = next(iter(again))
    observation, _ = made.reset(seed=0)
    assert np.array_equal(observation, first.observations[0])
    for action, expected in zip(first.actions, first.observations[1:], strict=True):
        assert np.array_equal(made.step(action)[0], expected)
