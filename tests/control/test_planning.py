"""Planning on a model: by gradients, by samples, and by a stored value."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import scipy.linalg

from sd_friction_env import equilibria
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import (
    GradientPolicy,
    Model,
    RolloutPolicy,
    SamplingPolicy,
    ThresholdFollower,
)
from sd_friction_env.control.shooting import descend, rollout
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.optimal import OptimalPolicy

FORCE, BELT, SENSED = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0", "SDFriction/BeltSpeedSensed-v0"
STARTS = evaluation.VALIDATION_SEEDS[:2]
PLANNERS = {
    "gradient": lambda env: GradientPolicy.from_env(env, horizon=20),
    "sampling": lambda env: SamplingPolicy.from_env(env, horizon=20, samples=16),
}


def observations(env, states):
    scaled = np.array(states, float)
    scaled[..., 0] = (scaled[..., 0] - env.task.x_offset) / env.task.x_scale
    scaled[..., 1] /= env.task.v_scale
    scaled[..., 2] = (scaled[..., 2] / env.nominal.belt_speed - 1.0) / env.task.belt_authority
    return scaled if env.task.actuator == "belt_speed" else scaled[..., :2]


def finite_horizon_gains(plant, task, steps):
    """Gains of the first action on small (x - x_rest, v): the Riccati recursion of the exactly sampled oscillator.

    The mean of v^2 over an interval is sampled exactly, too (C. F. Van Loan, 1978).
    """
    rest = equilibria(plant)[-1]
    a = np.array([[0.0, 1.0, 0.0], [-rest.stiffness, -rest.damping, task.force_limit], [0.0, 0.0, 0.0]])  # x, v, action
    cost = np.diag([0.0, 1.0 / plant.belt_speed**2, 0.0])
    h = task.control_interval
    block = scipy.linalg.expm(h * np.block([[-a.T, cost], [np.zeros((3, 3)), a]]))
    hold = block[3:, 3:]
    q = hold.T @ block[:3, 3:] / h + np.diag([0.0, 0.0, task.w_effort])
    p = np.zeros((2, 2))
    for _ in range(steps):
        whole = q + hold[:2].T @ p @ hold[:2]
        gains = -whole[2, :2] / whole[2, 2]
        p = whole[:2, :2] + np.outer(whole[:2, 2], gains)
    return gains


@pytest.mark.parametrize("steps", [1, 7, 60])
def test_for_small_deviations_gradient_mpc_is_the_finite_horizon_regulator(steps):
    """There the plant is linear, without events, and no bound is active."""
    env = gym.make(FORCE).unwrapped
    policy = GradientPolicy.from_env(env, horizon=steps, damping=0.0, iterations=1)
    gains = finite_horizon_gains(env.nominal, env.task, steps)
    at_rest = policy.readings.x_equilibrium
    for x, v in ((1e-4, 0.0), (0.0, 2e-4), (-1e-4, 1e-4)):
        action = policy.predict(observations(env, [at_rest + x, v, 0.2]))[0][0]
        assert action == pytest.approx(gains @ [x, v], rel=1e-3, abs=1e-7)


def test_the_models_jacobians_are_those_of_its_step():
    model = Model.from_env(gym.make(BELT))
    states, actions, h = np.array([[0.6, -0.1, 0.2], [0.9, 0.05, 0.17]]), np.array([0.03, -0.02]), 1e-6
    found = model.jacobians(states, actions)
    for column in range(4):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.column_stack([states, actions])
            moved[:, column] += sign * h
            ends.append(np.column_stack(model.step(moved[:, :3].copy(), moved[:, 3].copy())))
        assert found[..., column] == pytest.approx((ends[0] - ends[1]) / (2.0 * h), abs=1e-6)


def test_a_descent_is_never_worse_stays_in_bounds_and_returns_what_it_says():
    """Starts on the cycle, stuck and slipping: sequences through stick, breakaway and landing."""
    model = Model.from_env(gym.make(BELT))
    starts = np.array([[0.5, 0.2, 0.2], [0.9, 0.2, 0.2], [1.1, -0.1, 0.2], [0.5, -0.35, 0.2]])
    sequences = np.zeros((4, 60))
    passive = first = rollout(model, starts, sequences)[1].sum(axis=1)
    for _ in range(4):
        sequences, before, after = descend(model, starts, sequences, np.full(4, 0.01))
        assert before == pytest.approx(first, rel=1e-12)
        first = rollout(model, starts, sequences)[1].sum(axis=1)
        assert (first >= before).all()
        assert first == pytest.approx(np.maximum(before, after), rel=1e-12)
        assert np.abs(sequences).max() <= 1.0
    assert (first > passive + 2.0).all()


@pytest.mark.parametrize(
    ("env_id", "kind", "arguments", "least"),
    [
        (BELT, GradientPolicy, {"iterations": 1, "horizon": 60}, 1.2),
        (BELT, SamplingPolicy, {}, 2.0),
        (FORCE, GradientPolicy, {"iterations": 1, "horizon": 40}, 0.4),
        (FORCE, SamplingPolicy, {"horizon": 40}, 0.2),
    ],
)
def test_planning_gains_on_its_base_controller(env_id, kind, arguments, least):
    short = {"episode_steps": 110}
    policy = kind.from_env(make_env(env_id), **arguments)
    gain = [evaluation.evaluate(one, env_id, STARTS, short)["return"].mean() for one in (policy, policy.base)]
    assert gain[0] > gain[1] + least


@pytest.mark.parametrize("name", PLANNERS)
def test_plans_are_the_same_alone_and_in_a_batch_and_begin_anew_with_an_episode(name):
    env = gym.make(BELT).unwrapped
    policy = PLANNERS[name](env)
    states = np.array(
        [[[0.5, -0.3, 0.2], [0.6, 0.12, 0.15], [1.1, -0.05, 0.3]], [[0.5, 0.1, 0.2], [0.9, 0.2, 0.2], [0.83, 0.0, 0.2]]]
    )
    first, second = observations(env, states)
    together, memory = policy.predict(first, None, np.ones(3, bool))
    later, _ = policy.predict(second, memory, np.array([False, True, False]))
    for i in range(3):
        alone, mine = policy.predict(first[i])
        assert np.array_equal(alone, together[i])
        assert np.array_equal(policy.predict(second[i], mine, i == 1)[0], later[i])
    assert np.array_equal(policy.predict(second[1])[0], later[1])
    again = PLANNERS[name](gym.make(BELT)).predict(first)[0]
    assert np.array_equal(again, together)


def test_samples_come_from_the_seed_and_always_include_the_base_controller():
    env = gym.make(BELT).unwrapped
    seen = observations(env, [0.6, 0.02, 0.2])
    actions = {seed: SamplingPolicy.from_env(env, seed=seed, horizon=30).predict(seen)[0][0] for seed in (0, 1)}
    assert actions[0] != actions[1]
    still = SamplingPolicy.from_env(env, spread=0.0, horizon=30)
    rule = ThresholdFollower.from_env(env).predict(seen)[0]
    assert still.predict(seen)[0] == rule
    assert still.predict(seen, (np.full(30, 2.0),))[0] == rule  # after a plan that is worse


def test_a_value_two_steps_ahead_finds_the_best_pair_of_actions():
    policy = dataclasses.replace(OptimalPolicy.load(BELT), depth=2, branches=9, count=9)
    states = np.array([[0.5, -0.3, 0.2], [0.6, 0.12, 0.15], [1.1, -0.05, 0.25]])
    model = Model(policy.parameters, policy.task.actuator_of(policy.parameters))
    pairs = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9), indexing="ij"), -1).reshape(-1, 2)

    def worth(state, first):
        ends, reward = model.step(np.array([state]), np.array([first]))
        ends, rewards = model.step(np.repeat(ends, 9, axis=0), np.linspace(-1, 1, 9))
        return reward[0] + (rewards + policy.grid.interpolate(policy.values, ends)).max()

    for state, action in zip(states, policy.actions(states), strict=True):
        assert worth(state, action) >= max(worth(state, first) for first in np.unique(pairs[:, 0])) - 1e-12


@pytest.mark.parametrize(("env_id", "least"), [(BELT, 3.5), (FORCE, 1.0)])
def test_the_value_look_ahead_suppresses_and_leaves_rest_to_its_base_controller(env_id, least):
    env, short = make_env(env_id), {"episode_steps": 250}
    policy = OptimalPolicy.from_env(env)
    table = evaluation.evaluate(policy, env_id, STARTS, short)
    assert table["suppressed"].all()
    assert table["return"].mean() > evaluation.evaluate(policy.base, env_id, STARTS, short)["return"].mean() + least
    near = observations(env, [policy.readings.x_equilibrium + 0.02, 0.01, 0.2])
    assert np.array_equal(policy.predict(near)[0], policy.base.predict(near)[0])


def test_bad_arguments_are_refused_by_name():
    env = gym.make(BELT).unwrapped
    for kind, arguments, message in (
        (GradientPolicy, {"horizon": 0}, "horizon must be a finite number in .1, 10000., got 0"),
        (GradientPolicy, {"damping": float("nan")}, "damping must be"),
        (SamplingPolicy, {"samples": 7}, "samples must be a finite number in .8, 100000., got 7"),
        (SamplingPolicy, {"spread": -1.0}, "spread must be"),
        (SamplingPolicy, {"seed": -1}, "seed must be"),
    ):
        with pytest.raises(ValueError, match=message):
            kind.from_env(env, **arguments)
    model = Model.from_env(env)
    with pytest.raises(ValueError, match="actuator must be of finite numbers"):
        dataclasses.replace(model, actuator=model.actuator._replace(interval=float("nan")))
    with pytest.raises(TypeError, match="parameters must be OscillatorParameters"):
        Model({"alpha": 0.8}, model.actuator)
    for policy in (
        GradientPolicy.from_env(env, horizon=3),
        RolloutPolicy.from_env(env, ThresholdFollower.from_env(env)),
    ):
        with pytest.raises(ValueError, match="observation must be finite"):
            policy.predict([np.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="state must be what the last call returned"):
        GradientPolicy.from_env(env, horizon=3).predict([0.0, 0.0, 0.0], (np.zeros((4,)),))
    with pytest.raises(ValueError, match="sees the position only"):
        SamplingPolicy.from_env(gym.make(SENSED))
    with pytest.raises(ValueError, match="no value function is stored for 'SDFriction/BeltSpeedSensed-v0'"):
        OptimalPolicy.from_env(gym.make(SENSED))
    with pytest.raises(ValueError, match="leave others out"):
        OptimalPolicy.from_env(gym.make(BELT, w_effort=0.2))
    with pytest.raises(ValueError, match="depth must be"):
        OptimalPolicy.from_env(env, depth=4)


def test_evaluate_prints_the_time_of_a_decision_and_plants_off_nominal(tmp_path, capsys):
    file = tmp_path / "episodes.csv"
    command = ["evaluate", "--task", "belt", "--episodes", "8", "--controller", "velocity-feedback"]
    assert main([*command, "--plant-error", "0.1", "--episodes-csv", str(file)]) == 0
    out = capsys.readouterr().out
    assert "plants 10% off nominal, 8 episodes" in out
    assert out.splitlines()[2].endswith("   ms")
    plants = evaluation.plants_off_nominal(make_env(BELT), 8, 0.1)["parameters"]
    assert {tuple(np.round(row, 6)) for row in np.column_stack(list(plants.values()))} == {
        (alpha, mu_m, v_b) for alpha in (0.72, 0.88) for mu_m in (0.045, 0.055) for v_b in (0.18, 0.22)
    }
    assert main([*command, "--plant-error", "-0.1"]) == 2
    assert "plant error must be" in capsys.readouterr().err
