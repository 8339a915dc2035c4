"""Look-ahead on a model: the best of several first actions, and what it gains."""

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env.control.observed import rollout_follower
from sd_friction_env.control.policies import Model, RolloutPolicy, ThresholdFollower
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation

BELT, SENSED = "SDFriction/BeltSpeed-v0", "SDFriction/BeltSpeedSensed-v0"
STARTS = evaluation.VALIDATION_SEEDS[:12]


@pytest.fixture(scope="module")
def env():
    return gym.make(BELT).unwrapped


def observations(env, states):
    scaled = np.array(states, float)
    scaled[:, 0] = (scaled[:, 0] - env.task.x_offset) / env.task.x_scale
    scaled[:, 1] /= env.task.v_scale
    scaled[:, 2] = (scaled[:, 2] / env.nominal.belt_speed - 1.0) / env.task.belt_authority
    return scaled.astype(np.float32)


def followed(model, base, readings, state, first, horizon):
    """The return of a first action, then of the rule, step by step."""
    total, action = 0.0, first
    for _ in range(horizon):
        state, reward = model.step(state, np.array([action]))
        total += reward[0]
        values = np.array([state[0, 0] - readings.x_equilibrium, state[0, 1], (state[0, 2] / 0.2 - 1.0) / 0.5])
        action = float(np.clip(base._act(values, None, None)[0], -1.0, 1.0).astype(np.float32))
    return total


def test_the_first_action_with_the_greatest_return_is_taken(env):
    base = ThresholdFollower.from_env(env)
    policy = RolloutPolicy.from_env(env, base, horizon=25, candidates=5)
    states = [[0.5, -0.3, 0.2], [0.6, 0.12, 0.15], [1.1, -0.05, 0.3], [0.83, 0.0, 0.2]]
    found = policy.predict(observations(env, states))[0][:, 0]
    for state, observation, action in zip(states, observations(env, states), found, strict=True):
        own = float(base.predict(observation)[0][0])
        returns = {
            first: followed(policy.model, base, policy.readings, np.array([state]), first, 25)
            for first in (own, *np.linspace(-1.0, 1.0, 5))
        }
        assert returns[min(returns, key=lambda first: abs(first - action))] >= max(returns.values()) - 1e-5
        assert policy.predict(observation)[0] == action  # one as many


@pytest.mark.parametrize(("env_id", "least"), [(BELT, 3.0), (SENSED, 2.0)])
def test_it_suppresses_and_gains_on_the_rule_it_looks_ahead_with(env_id, least):
    made = make_env(env_id)
    table = evaluation.evaluate(rollout_follower(made), env_id, STARTS)
    rule = evaluation.evaluate(ThresholdFollower.from_env(make_env(BELT)), BELT, STARTS)
    assert table["suppressed"].all()
    assert table["return"].mean() > rule["return"].mean() + least


def test_the_model_may_be_of_another_plant(env):
    other = Model(env.nominal.replace(alpha=0.7), env.task.actuator_of(env.nominal))
    base = ThresholdFollower.from_env(env)
    state = observations(env, [[0.6, 0.05, 0.2]])
    rollouts = [RolloutPolicy.from_env(env, base, candidates=41, model=model) for model in (Model.from_env(env), other)]
    first, second = (policy.predict(state)[0][0, 0] for policy in rollouts)
    assert first != second


def test_bad_arguments_are_refused_by_name(env):
    base = ThresholdFollower.from_env(env)
    for arguments, message in (
        ({"horizon": 0}, "horizon must be a finite number in .1, 10000., got 0"),
        ({"candidates": 1}, "candidates must be a finite number in .2, 1000., got 1"),
        ({"horizon": 2.5}, "horizon must be a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            RolloutPolicy.from_env(env, base, **arguments)
    with pytest.raises(ValueError, match="RolloutPolicy needs the velocity"):
        RolloutPolicy.from_env(gym.make(SENSED), base)
    with pytest.raises(ValueError, match="needs the actuator 'belt_speed'"):
        rollout_follower(gym.make("SDFriction/Force-v0"))
