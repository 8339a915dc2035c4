"""Classical controllers: gains by theory, and tuned gains that do what is stored with them."""

import json

import gymnasium as gym
import numpy as np
import pytest

from agents import classical, evaluation
from scripts import tune_classical
from sd_friction_env import ENVIRONMENT_IDS, equilibria, theory
from sd_friction_env.policies import ConstantPolicy, LinearFeedback, VelocityFeedback

FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"


def closed_loop(env, gains):
    """Largest modulus of the eigenvalues of the step under linear feedback."""
    a, b = classical.linearised(env)
    return float(np.abs(np.linalg.eigvals(a + b @ np.array([gains]))).max())


# The sampled controller holds its action: with short intervals that comes to the continuous law.
@pytest.mark.parametrize(
    "parameters",
    [{}, {"alpha": 0.7, "belt_speed": 0.25}, {"geometry": "cubic", "mu_m": 0.08}, {"beta": 0.01, "v_m": 0.7}],
)
def test_velocity_feedback_stabilises_from_the_theoretical_gain_on(parameters):
    """k > N (k1 - 3 k3 v_b^2) - 2 beta, the trace of the Jacobian at steady slip."""
    interval = 0.01
    env = gym.make(FORCE, parameters=parameters, control_interval=interval, episode_steps=100_000).unwrapped
    plant = env.nominal
    readings = VelocityFeedback.from_env(env, 1.0).readings
    normal_force = float(plant.normal_force(readings.x_equilibrium))
    k1, k3 = theory.stribeck_coefficients(plant.mu_s, plant.mu_m, plant.v_m)
    threshold = theory.velocity_feedback_threshold(plant.belt_speed, plant.beta, normal_force, k1, k3)
    assert threshold > 0.02  # it does squeal without control
    for share, grows in ((0.97, True), (1.03, False)):
        gain = share * threshold
        modulus = closed_loop(env, (0.0, -gain / readings.authority))
        rate = np.log(modulus) / interval
        # half the trace, the growth rate, is half of what the gain is short of the threshold
        assert rate == pytest.approx(0.5 * (threshold - gain), abs=2e-4)
        assert (modulus > 1.0) == grows
    # and the environment itself, from a start so small that nothing saturates or sticks
    for share, grows in ((0.7, True), (1.3, False)):
        policy = VelocityFeedback.from_env(env, share * threshold)
        observation, info = env.reset(seed=0, options={"x": readings.x_equilibrium + 1e-3, "v": 0.0})
        low, high = [], []
        for _ in range(3000):
            observation, _, _, _, info = env.step(policy.predict(observation)[0])
            low.append(info["x_min"])
            high.append(info["x_max"])
        lap = 700  # intervals, longer than a period of any of these
        first, last = (np.ptp([*low[part], *high[part]]) for part in (slice(None, lap), slice(-lap, None)))
        assert last > 1.2 * first if grows else last < 0.8 * first


@pytest.mark.parametrize("env_id", [FORCE, BELT])
def test_the_linearised_step_is_that_of_the_theory(env_id):
    env = evaluation.make_env(env_id)
    a, b = classical.linearised(env)
    eigenvalues = np.exp(np.array(equilibria(env.nominal)[-1].eigenvalues) * env.task.control_interval)
    found = np.linalg.eigvals(a[:2, :2])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(eigenvalues), abs=1e-6)
    assert np.abs(found).max() > 1.0  # it squeals
    if env_id == FORCE:  # a force moves the velocity by authority x interval, the position by half its square
        h = env.task.control_interval
        assert b[:, 0] == pytest.approx([0.5 * 0.05 * h * h, 0.05 * h], rel=0.02)
    else:  # the belt comes to its target within the interval if that is not far
        assert a[2] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
        assert b[2, 0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("nominal", "randomised"), [(FORCE, "ForceRandomised"), (BELT, "BeltSpeedRandomised")])
def test_the_linearised_plant_is_the_nominal_one_also_where_episodes_draw_theirs(nominal, randomised):
    expected = classical.linearised(evaluation.make_env(nominal))
    for found, wanted in zip(
        classical.linearised(evaluation.make_env(f"SDFriction/{randomised}-v0")), expected, strict=True
    ):
        assert np.array_equal(found, wanted)


@pytest.mark.parametrize("env_id", [FORCE, BELT])
@pytest.mark.parametrize("weights", [(0.0, 1.0), (10.0, 0.01), (0.0, 1000.0)])
def test_lqr_is_stable_and_optimal_for_small_deviations(env_id, weights):
    env = evaluation.make_env(env_id)
    gains = classical.lqr_gains(env, *weights)
    assert closed_loop(env, gains) < 1.0
    a, b = classical.linearised(env)
    k = len(a)
    q = np.diag([weights[0], 1.0 / env.nominal.belt_speed**2, 0.0][:k])
    r = weights[1] * env.task.w_effort

    def cost(tried):
        total, state = 0.0, np.array([0.01, -0.02, 0.0][:k])
        for _ in range(5000):
            action = float(np.dot(tried, state))
            total += float(state @ q @ state) + r * action * action
            state = a @ state + b[:, 0] * action
        return total

    best = cost(gains)
    rng = np.random.default_rng(0)
    for _ in range(10):
        other = np.array(gains) * (1.0 + 0.05 * rng.normal(size=k))
        assert cost(other) >= best * (1.0 - 1e-9)


def test_lqr_needs_the_velocity():
    with pytest.raises(ValueError, match="LQR needs the velocity"):
        classical.lqr_gains(evaluation.make_env("SDFriction/ForceSensed-v0"), 1.0, 1.0)


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_stored_gains_do_what_is_stored_with_them(env_id):
    stored = classical.stored_gains()[env_id]
    controllers = classical.classical_controllers(f"sd_friction_env:{env_id}")
    assert list(controllers) == list(stored)
    assert set(controllers) == set(classical.kinds_for(env_id))
    for name, policy in controllers.items():
        table = evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS)
        # A bang-bang controller amplifies what other machines round differently.
        assert table["return"].mean() == pytest.approx(stored[name]["validation_return"], rel=0.02), name
        assert table["suppressed"].mean() == pytest.approx(stored[name]["suppressed"], abs=0.03), name
        assert stored[name]["command"].startswith("python scripts/tune_classical.py")


def test_tuned_feedback_is_near_the_optimum_on_force_and_every_controller_is_better_than_none():
    for env_id in ENVIRONMENT_IDS:
        passive = evaluation.metrics(*[evaluation.passive_episodes(env_id, evaluation.VALIDATION_SEEDS)] * 2)
        for entry in classical.stored_gains()[env_id].values():
            assert entry["validation_return"] > passive["return"].mean()
    assert classical.stored_gains()[FORCE]["linear state feedback"]["suppressed"] == 1.0


def test_tuning_improves_repeats_itself_and_sees_no_evaluation_episode(monkeypatch):
    seen = []
    run = evaluation.run_episodes

    def note(policy, env_id, seeds, *others):
        seen.extend(seeds)
        return run(policy, env_id, seeds, *others)

    monkeypatch.setattr(evaluation, "run_episodes", note)
    told = []
    few = {"generations": 3, "population": 4}
    found = classical.tune("velocity feedback", FORCE, seed=1, progress=lambda *now: told.append(now), **few)
    assert found["tuning_return"] > -200.0  # passive: -478
    assert [share for _, share in told] == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert told[-1][0] == found["tuning_return"]
    assert not set(seen) & set(evaluation.EVALUATION_SEEDS)
    assert classical.tune("velocity feedback", FORCE, seed=1, **few) == found


def test_the_script_keeps_what_is_finished(tmp_path, monkeypatch, capsys):
    file = tmp_path / "gains.json"
    monkeypatch.setattr(classical, "GAINS_FILE", file)
    monkeypatch.setattr(classical, "tune", lambda name, env_id, **how: interrupted_after_one(name))
    done = []

    def interrupted_after_one(name):
        if done:
            raise KeyboardInterrupt
        done.append(name)
        return {"values": {"gain": 1.0}, "validation_return": -1.0, "suppressed": 1.0}

    command = ["--task", "force", "--tier", "nominal", "--controller", "velocity feedback", "LQR"]
    assert tune_classical.main(command) == 130
    assert "interrupted; what was finished is kept" in capsys.readouterr().err
    assert list(classical.stored_gains(file)[FORCE]) == ["velocity feedback"]
    assert isinstance(classical.classical_controllers(FORCE, file)["velocity feedback"], VelocityFeedback)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "rope"], "invalid choice: 'rope'"),
        (["--generations", "0"], "--generations must be at least 1, got 0"),
        (["--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--tier", "sensed", "--controller", "LQR"], "LQR"),
    ],
)
def test_the_script_refuses_what_cannot_be(arguments, message, capsys):
    with pytest.raises(SystemExit) as stop:
        tune_classical.main(arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_foreign_or_missing_gains_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no tuned controllers are stored for .*: run scripts/tune_classical.py"):
        classical.classical_controllers(FORCE, tmp_path / "none.json")
    file = tmp_path / "gains.json"
    entry = {"values": {"gain": 1.0}}
    for content in (
        "no json",
        "[]",
        json.dumps({"gains": {"CartPole-v1": {"LQR": entry}}}),
        json.dumps({"gains": {FORCE: {"magic": entry}}}),
        json.dumps({"gains": {FORCE: {"LQR": entry}}}),
        json.dumps({"gains": {FORCE: {"velocity feedback": {}}}}),
    ):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"gains\.json"):
            classical.stored_gains(file)


def test_the_policies_are_of_the_kinds_that_they_are_called():
    made = classical.classical_controllers(FORCE)
    assert isinstance(made["LQR"], LinearFeedback)
    assert isinstance(made["linear state feedback"], LinearFeedback)
    assert not any(isinstance(policy, ConstantPolicy) for policy in made.values())
