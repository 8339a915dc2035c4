"""The belt that follows the mass below a threshold: actions by hand, memory, and how well it suppresses."""

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env.control.observed import ObservedRule, threshold_follower
from sd_friction_env.control.observers import LuenbergerObserver
from sd_friction_env.control.policies import EstimatingFollower, ThresholdFollower, ZeroPolicy
from sd_friction_env.learning import evaluation

BELT, RANDOMISED, SENSED = (f"SDFriction/BeltSpeed{tier}-v0" for tier in ("", "Randomised", "Sensed"))
FOLLOWERS = {BELT: ThresholdFollower, RANDOMISED: EstimatingFollower, SENSED: ObservedRule}
STARTS = evaluation.VALIDATION_SEEDS[:24]


def make(env_id=BELT, **arguments):
    return gym.make(env_id, **arguments).unwrapped


def observe(env, v, modulation=0.0):
    """The observation of a velocity and a belt modulation, at the middle of the range of x."""
    return np.array([0.0, v / env.task.v_scale, modulation], np.float32)


def act(policy, observations):
    """The actions at observations that follow each other, the first of which begins an episode."""
    state, actions = None, []
    for t, observation in enumerate(observations):
        action, state = policy.predict(observation, state, t == 0)
        actions.append(float(action[0]))
    return actions


def test_the_belt_follows_the_mass_below_the_threshold_and_is_slow_above_it():
    env = make()  # belt speed .2, at least .1
    policy = ThresholdFollower.from_env(env, 6.0, 1.1)
    for v, action in (
        (0.01, 0.3),
        (-0.02, -0.6),
        (0.03, 0.9),
        (0.1099, 1.0),
        (0.1101, -1.0),
        (0.3, -1.0),
        (-0.3, -1.0),
    ):
        # of the velocity alone, whatever the belt does
        for modulation in (-1.0, 0.4):
            assert policy.predict(observe(env, v, modulation))[0] == pytest.approx([action], abs=1e-6)


def test_both_numbers_scale_with_the_belt():
    env = make(parameters={"belt_speed": 0.3}, belt_authority=0.4)
    policy = ThresholdFollower.from_env(env, 6.0, 1.1)
    threshold = 1.1 * 0.6 * 0.3
    for v, action in ((0.02, 0.4), (threshold - 1e-4, 1.0), (threshold + 1e-4, -1.0)):
        assert policy.predict(observe(env, v))[0] == pytest.approx([action], abs=1e-6)


def test_the_estimate_is_the_largest_ratio_until_one_repeats():
    env = make(RANDOMISED)
    policy = EstimatingFollower.from_env(env, 6.0, 1.1)
    faster = [(0.1, 0.0), (0.3, 0.0), (0.02, 0.0)]  # the estimate: .1, .3, .3
    assert act(policy, [observe(env, *one) for one in faster]) == pytest.approx([-1.0, -1.0, 0.4], abs=1e-6)
    # Then the mass sticks to a belt of nominal speed .24 while that slows down: .24 (1 + .5 m).
    sticks = [(0.24, 0.0), (0.192, -0.4), (0.02, 0.0)]
    assert act(policy, [observe(env, *one) for one in faster + sticks])[-1] == pytest.approx(0.5, abs=1e-6)
    # Repetitions at rest do not count, and a faster ratio no longer does.
    rests = [(0.9, 0.0), (1e-8, 0.0), (1e-8, 0.0), (1e-8, 0.0), (0.02, 0.0)]
    assert act(policy, [observe(env, *one) for one in faster + sticks + rests])[-1] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("env_id", FOLLOWERS)
def test_followers_act_alike_alone_and_in_batches_and_forget_an_episode_that_ended(env_id):
    env = make(env_id)
    policy = threshold_follower(env)
    assert type(policy) is FOLLOWERS[env_id]
    rng = np.random.default_rng(0)
    observations = rng.normal(scale=0.5, size=(40, 6, env.observation_space.shape[0])).astype(np.float32)
    begins = rng.random((40, 6)) < 0.1
    begins[0] = True
    state, singles, restarted = None, [None] * 6, [None] * 6
    for t in range(40):
        together, state = policy.predict(observations[t], state, begins[t])
        for i in range(6):
            alone, singles[i] = policy.predict(observations[t, i], singles[i], begins[t, i])
            fresh, restarted[i] = policy.predict(observations[t, i], None if begins[t, i] else restarted[i])
            assert alone.shape == (1,)
            assert alone.tobytes() == together[i].tobytes() == fresh.tobytes()


def test_a_follower_suppresses_every_start_of_the_nominal_belt():
    table = evaluation.evaluate(threshold_follower(make()), BELT, STARTS)
    assert table["suppressed"].all()
    assert table["return"].mean() > -55.0  # no control: -480


@pytest.mark.parametrize(("env_id", "least"), [(RANDOMISED, -60.0), (SENSED, -60.0)])
def test_followers_suppress_where_the_belt_speed_or_the_velocity_is_hidden(env_id, least):
    table = evaluation.evaluate(threshold_follower(make(env_id)), env_id, STARTS)
    assert table["suppressed"].mean() > 0.95
    assert table["return"].mean() > least


def test_a_start_faster_than_the_belt_does_not_deceive_a_follower_that_waits():
    options = {"x": 0.3, "v": 0.3}
    hasty, waiting = (EstimatingFollower.from_env(make(RANDOMISED), waits=waits) for waits in (False, True))
    passive, *others = (
        evaluation.run_episodes(policy, RANDOMISED, STARTS, options=options)
        for policy in (ZeroPolicy(), hasty, waiting)
    )
    shares = [evaluation.metrics(episodes, passive)["suppressed"].mean() for episodes in others]
    assert shares[0] < 0.8 < 0.9 < shares[1]  # 62% and 100%


@pytest.mark.parametrize(
    ("make_policy", "message"),
    [
        (
            lambda: ThresholdFollower.from_env(make("SDFriction/Force-v0")),
            "needs the actuator 'belt_speed', got 'force'",
        ),
        (lambda: threshold_follower(make("SDFriction/ForceSensed-v0")), "needs the actuator 'belt_speed', got 'force'"),
        (lambda: ThresholdFollower.from_env(make(SENSED)), "needs the velocity; this sensor sees the position only"),
        (lambda: EstimatingFollower.from_env(make(SENSED)), "needs the velocity; this sensor sees the position only"),
        (lambda: ThresholdFollower.from_env(make(), -1.0), r"gain must be .* got -1.0"),
        (lambda: ThresholdFollower.from_env(make(), 6.0, float("nan")), r"threshold must be .* got nan"),
        (lambda: ThresholdFollower.from_env(make(belt_authority=0.0)), r"belt_authority must be|belt_authority > 0"),
    ],
)
def test_a_follower_that_cannot_be_is_refused(make_policy, message):
    with pytest.raises(ValueError, match=message):
        make_policy()


def test_a_follower_that_waits_runs_the_belt_slow_until_the_mass_sticks():
    env = make(RANDOMISED)
    policy = EstimatingFollower.from_env(env, 6.0, 1.1, waits=True)
    seen = [(-0.1, 0.0), (0.3, 0.0), (0.02, 0.0), (0.24, 0.0), (0.192, -0.4), (0.02, 0.0)]
    assert act(policy, [observe(env, *one) for one in seen]) == pytest.approx(
        [-1.0, -1.0, -1.0, -1.0, -1.0, 0.5], abs=1e-6
    )
    with pytest.raises(TypeError, match="waits must be True or False, got 1"):
        EstimatingFollower.from_env(env, waits=1)


def test_a_follower_needs_one_of_our_environments():
    for build in (ThresholdFollower.from_env, LuenbergerObserver.from_env, threshold_follower):
        with pytest.raises(TypeError, match="must be an SDFrictionEnv"):
            build(gym.make("CartPole-v1"))


def test_a_follower_refuses_the_memory_of_another_number_of_environments():
    for env_id in (RANDOMISED, SENSED):
        policy, size = threshold_follower(make(env_id)), make(env_id).observation_space.shape[0]
        _, state = policy.predict(np.zeros((3, size)))
        with pytest.raises(ValueError, match="state must be what the last call returned"):
            policy.predict(np.zeros((4, size)), state)
