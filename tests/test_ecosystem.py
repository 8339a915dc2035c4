"""Our environments with Gymnasium's wrappers and Minari. (RL Zoo and TensorBoard: test_training.py.)"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.policies import VelocityFeedback

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


def test_a_time_limit_shortens_an_episode():
    _, rewards, ends = play(gym.make(BELT, max_episode_steps=7), 100)
    assert len(rewards) == 7
    assert ends == [False] * 6 + [True]
    _, rewards, _ = play(wrappers.TimeLimit(gym.make(BELT), 5), 100)
    assert len(rewards) == 5
    _, rewards, _ = play(gym.make(BELT, episode_steps=9), 100)  # the environment's own argument, longer too
    assert len(rewards) == 9


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
