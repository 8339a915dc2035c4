"""Classical controllers: gains by theory, and tuned gains that do what is stored with them."""

import contextlib
import errno
import itertools
import json
import subprocess
import sys
import time
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env import equilibria, storage
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import ConstantPolicy, LinearFeedback, VelocityFeedback
from sd_friction_env.environments.ids import SOLVED_IDS
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical, evaluation, scores
from sd_friction_env.physics import theory

ROOT = Path(__file__).parents[2]
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
    env = make_env(env_id)
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
    expected = classical.linearised(make_env(nominal))
    for found, wanted in zip(classical.linearised(make_env(f"SDFriction/{randomised}-v0")), expected, strict=True):
        assert np.array_equal(found, wanted)


@pytest.mark.parametrize("env_id", [FORCE, BELT])
@pytest.mark.parametrize("weights", [(0.0, 1.0), (10.0, 0.01), (0.0, 1000.0)])
def test_lqr_is_stable_and_optimal_for_small_deviations(env_id, weights):
    env = make_env(env_id)
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
        classical.lqr_gains(make_env("SDFriction/ForceSensed-v0"), 1.0, 1.0)


@pytest.mark.parametrize("env_id", SOLVED_IDS)
def test_stored_gains_do_what_is_stored_with_them(env_id):
    stored = classical.stored_gains()[env_id]
    controllers = classical.classical_controllers(f"sd_friction_env:{env_id}")
    assert list(controllers) == list(stored)
    assert set(controllers) == set(classical.kinds_for(env_id))
    for name, policy in controllers.items():
        table = evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS)
        # What brings the mass to rest makes rounding die out with the vibration; what goes on switching amplifies what
        # other machines round differently.
        rests = stored[name]["suppressed"] == 1.0
        came_to, said = table["return"].mean(), stored[name]["validation_return"]
        assert came_to == pytest.approx(said, rel=1e-9 if rests else 0.02), name
        assert table["suppressed"].mean() == pytest.approx(stored[name]["suppressed"], abs=0.0 if rests else 0.03), name
        assert stored[name]["command"].startswith(("python scripts/tune_classical.py", "sd-friction tune-classical"))
        assert set(stored[name]["versions"]) == set(classical.versions())


def test_tuned_feedback_is_near_the_optimum_on_force_and_every_controller_is_better_than_none():
    seeds = evaluation.EVALUATION_SEEDS
    for env_id in SOLVED_IDS:
        passive = evaluation.passive_episodes(env_id, seeds)
        without, best = evaluation.metrics(passive, passive)["return"], evaluation.optimal_returns(env_id, seeds)
        score = {}
        for name, policy in classical.classical_controllers(env_id).items():
            table = evaluation.evaluate(policy, env_id, seeds, passive=passive)
            score[name] = scores.score(table["return"], without, best)
            assert 0.0 < score[name] < 1.0, (env_id, name)
        assert max(score.values()) > (0.99 if env_id in (FORCE, "SDFriction/ForceRandomised-v0") else 0.5)


def test_no_stored_gain_lies_where_the_search_ended():
    """At a bound a better controller may stand outside, unless the bound is that of what can be built."""
    for env_id, controllers in classical.stored_gains().items():
        for name, entry in controllers.items():
            found = classical.at_bound(name, env_id, entry["values"])
            assert all(found.values()), (env_id, name, found, entry["values"])
            assert entry["at_bound"] == found, (env_id, name)


def test_the_bounds_are_wide_and_a_value_at_one_of_them_is_told():
    for env_id in SOLVED_IDS:
        env = make_env(env_id)
        for name in classical.kinds_for(env_id):
            for way in classical.KINDS[name].ranges(env).values():
                assert way.bound_at(way.low) == "low"
                assert way.bound_at(way.high) == "high"
                assert way.bound_at(way.from_scale(0.5 * (way.to_scale(way.low) + way.to_scale(way.high)))) is None
                for value in (way.low, 0.3 * way.high, way.high):
                    assert way.from_scale(way.to_scale(value)) == pytest.approx(value, rel=1e-12)
                if way.unit is not None:  # a gain: a hundred times what fills the action's range, and more
                    assert -way.low == way.high >= 100.0 * way.unit
                # The controller can be built at every corner.
            ranges = list(classical.KINDS[name].ranges(env).values())
            for corner in itertools.product(*((way.low, way.high) for way in ranges)):
                with contextlib.suppress(np.linalg.LinAlgError):
                    classical.build(name, env_id, corner)
    values = {"slope": 0.0, "log10 layer": -4.99, "amplitude": 0.5}
    assert classical.at_bound("sliding mode", FORCE, values) == {"log10 layer": "a switch"}
    assert classical.at_bound("velocity feedback", FORCE, {"gain": 1e9}) == {"gain": ""}


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


def test_candidates_side_by_side_come_to_what_each_comes_to_alone():
    for env_id in (BELT, "SDFriction/BeltSpeedSensed-v0"):
        controllers = list(classical.classical_controllers(env_id).values())
        if env_id != BELT:  # of one kind, with other delays: memories of other shapes
            controllers = [classical.build("delayed displacement feedback", env_id, (10.0, k)) for k in (1, 7, 40)]
        together = classical._mean_returns(controllers, env_id)
        for policy, mean in zip(controllers, together, strict=True):
            alone = evaluation.run_episodes(policy, env_id, classical.TUNING_SEEDS)
            assert np.nansum(alone.reward, axis=1).mean() == pytest.approx(mean, rel=1e-12)


GAIN = {"values": {"gain": 1.0}, "validation_return": -66.0, "suppressed": 1.0, "at_bound": {}}


def test_the_script_keeps_what_is_finished(tmp_path, monkeypatch, capsys):
    file = tmp_path / "gains.json"
    monkeypatch.setattr(classical, "GAINS_FILE", file)
    monkeypatch.setattr(classical, "tune", lambda name, env_id, **how: interrupted_after_one(name))
    done = []

    def interrupted_after_one(name):
        if done:
            raise KeyboardInterrupt
        done.append(name)
        return GAIN | {"at_bound": {"gain": ""}}

    command = ["--task", "force", "--tier", "nominal", "--controller", "velocity feedback", "LQR"]
    assert main(["tune-classical", *command]) == 130
    told = capsys.readouterr()
    assert "interrupted; what was finished is kept" in told.err
    assert "gain is at its bound: a wider one may find better" in told.out
    assert list(classical.stored_gains(file)[FORCE]) == ["velocity feedback"]
    assert isinstance(classical.classical_controllers(FORCE, file)["velocity feedback"], VelocityFeedback)
    assert [path.name for path in tmp_path.iterdir()] == ["gains.json"]


def test_each_entry_keeps_its_own_versions_and_a_worse_one_is_not_kept(tmp_path, monkeypatch, capsys):
    file = tmp_path / "gains.json"
    good = GAIN | classical.measured("velocity feedback", FORCE, {"gain": 1.5}) | {"values": {"gain": 1.5}}
    first = good | {"versions": {"scipy": "1.0"}, "command": "the first"}
    assert classical.keep(FORCE, "velocity feedback", first, file) == first
    other = GAIN | {"versions": {"scipy": "2.0"}, "command": "another"}
    classical.keep(BELT, "velocity feedback", other, file)
    stored = classical.stored_gains(file)
    assert stored[FORCE]["velocity feedback"]["versions"] == {"scipy": "1.0"}
    assert stored[BELT]["velocity feedback"]["versions"] == {"scipy": "2.0"}
    assert set(json.loads(file.read_text())) == {"gains", "sha256"}
    # A worse one leaves it; a better one does not; and it counts what the stored one comes to now, not what it says.
    worse = GAIN | classical.measured("velocity feedback", FORCE, {"gain": 0.3}) | {"values": {"gain": 0.3}}
    assert classical.keep(FORCE, "velocity feedback", worse, file) == first
    assert classical.stored_gains(file)[FORCE]["velocity feedback"] == first
    best = GAIN | classical.measured("velocity feedback", FORCE, {"gain": 1.57}) | {"values": {"gain": 1.57}}
    assert classical.keep(FORCE, "velocity feedback", best, file) == best
    content = json.loads(file.read_text())
    content["gains"][FORCE]["velocity feedback"] = worse | {"validation_return": 0.0}
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"gains\.json.*differs from its digest.*predecessor is kept in.*\.previous"):
        classical.keep(FORCE, "velocity feedback", best, file)
    storage.write_json(file, content)
    assert classical.keep(FORCE, "velocity feedback", best, file) == best
    monkeypatch.setattr(classical, "GAINS_FILE", file)
    monkeypatch.setattr(classical, "tune", lambda name, env_id, **how: worse)
    assert main(["tune-classical", "--task", "force", "--tier", "nominal", "--controller", "velocity feedback"]) == 0
    assert "not kept: the stored gains reach -62.67" in capsys.readouterr().out


def test_what_several_keep_at_once_is_all_kept(tmp_path, monkeypatch):
    file = tmp_path / "gains.json"
    read = classical.stored_gains

    def slow(path):
        gains = read(path)
        time.sleep(0.05)  # time for the others to read the same and to write over it
        return gains

    monkeypatch.setattr(classical, "stored_gains", slow)
    with ThreadPoolExecutor(len(SOLVED_IDS)) as pool:
        names = ["delayed displacement feedback"] * len(SOLVED_IDS)
        entry = GAIN | {"values": {"gain": 1.0, "delay": 3.0}}
        list(pool.map(classical.keep, SOLVED_IDS, names, [entry] * len(names), [file] * len(names)))
    assert set(read(file)) == set(SOLVED_IDS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gains.json", "gains.json.previous"]
    assert len(read(tmp_path / "gains.json.previous")) == len(SOLVED_IDS) - 1


def test_a_lock_that_another_process_left_behind_does_not_stop_anyone(tmp_path):
    program = (
        "import os, sys, pathlib\n"
        "from sd_friction_env import storage\n"
        "path = pathlib.Path(sys.argv[1])\n"
        "with storage.locked(path.with_name(f'.{path.name}.lock'), 'the gains'):\n"
        "    os._exit(1)\n"  # as if killed
    )
    file = tmp_path / "gains.json"
    subprocess.run([sys.executable, "-c", program, str(file)], cwd=ROOT, timeout=120, check=False)
    assert [path.name for path in tmp_path.iterdir()] == [".gains.json.lock"]
    classical.keep(FORCE, "velocity feedback", GAIN, file)
    assert [path.name for path in tmp_path.iterdir()] == ["gains.json"]


def test_where_there_is_no_fcntl_the_lock_is_that_of_windows(tmp_path, monkeypatch):
    """Where another process holds the lock the write is tried again; any other error is raised."""
    file, answers, asked = tmp_path / "gains.json", [errno.EACCES, None, errno.EIO], []

    def locking(descriptor, mode, size):
        asked.append((mode, size))
        answer = answers.pop(0)
        if answer is not None:
            raise OSError(answer, "no lock")

    monkeypatch.setitem(sys.modules, "msvcrt", types.SimpleNamespace(LK_NBLCK=2, locking=locking))
    monkeypatch.setattr(storage, "sys", types.SimpleNamespace(platform="win32"))
    classical.keep(FORCE, "velocity feedback", GAIN, file)
    assert asked == [(2, 1), (2, 1)]
    assert [path.name for path in tmp_path.iterdir()] == ["gains.json"]
    with pytest.raises(OSError, match="no lock"):
        classical.keep(BELT, "velocity feedback", GAIN, file)
    assert list(classical.stored_gains(file)) == [FORCE]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "rope"], "invalid choice: 'rope'"),
        (["--generations", "0"], "--generations must be at least 1, got 0"),
        (["--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--tier", "sensed", "--controller", "LQR"], "LQR is not for the actuator or the sensor of --task force belt"),
        (["--task", "force", "--controller", "threshold follower"], "threshold follower is not for the actuator"),
    ],
)
def test_the_script_refuses_what_cannot_be(arguments, message, capsys):
    assert main(["tune-classical", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_foreign_or_missing_gains_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no tuned controllers are stored for .*: run sd-friction tune-classical"):
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
