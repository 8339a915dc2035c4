"""The yardsticks: metrics of episodes with known answers, and the score."""

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from sd_friction_env import OscillatorParameters, Table, limit_cycle
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import ConstantPolicy, NetworkPolicy, VelocityFeedback, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical, evaluation, optimal, scores
from sd_friction_env.learning.evaluation import Episodes, evaluate, metrics, run_episodes, summarise
from sd_friction_env.learning.scores import score
from sd_friction_env.physics.starts import share_interval
from sd_friction_env.storage import AGENTS

STEPS = 40
FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"


def synthetic(amplitude, *, stick=0.0, belt=1.0, action=0.0, centre=0.3, completed=True):
    """One episode of which each control interval swings by ``amplitude`` about ``centre``; all may be sequences."""
    shape = (1, STEPS)
    amplitude, stick, belt, action = (
        np.broadcast_to(np.asarray(a, float), shape) for a in (amplitude, stick, belt, action)
    )
    return Episodes(
        seeds=np.array([5]),
        control_interval=0.1,
        belt_speed=np.array([0.2]),
        reward=np.full(shape, -2.0),
        reward_terms=np.stack([np.full(shape, -1.5), np.full(shape, -0.3), np.full(shape, -0.2), np.zeros(shape)]),
        x_min=centre - amplitude,
        x_max=centre + amplitude,
        stick_fraction=stick,
        mean_belt_speed=0.2 * belt,
        action=action,
        completed=np.array([completed]),
    )


PASSIVE = synthetic(0.4, stick=0.25)
QUIET_FROM_20 = np.where(np.arange(STEPS) < 20, 0.4, 0.001)


def one(episodes, passive=PASSIVE):
    return next(metrics(episodes, passive).rows())


def test_passive_motion_is_as_large_as_itself():
    row = one(PASSIVE)
    assert row["amplitude"] == pytest.approx(0.4)
    assert row["passive_amplitude"] == pytest.approx(0.4)
    assert row["amplitude_reduction"] == pytest.approx(0.0)
    assert row["stick_fraction"] == 0.25
    assert not row["suppressed"]
    assert np.isnan(row["settling_time"])
    assert row["return"] == pytest.approx(-80.0)
    assert row["return_vibration"] == pytest.approx(-60.0)
    assert row["return_effort"] == pytest.approx(-12.0)
    assert row["return_stick"] == pytest.approx(-8.0)


def test_an_episode_that_quietens_settles_when_it_does():
    row = one(synthetic(QUIET_FROM_20))
    assert row["suppressed"]
    assert row["settling_time"] == pytest.approx(2.0)  # 20 intervals of .1
    assert row["amplitude"] == pytest.approx(0.001)
    assert row["amplitude_reduction"] == pytest.approx(1.0 - 0.001 / 0.4)
    assert one(synthetic(0.001))["settling_time"] == 0.0


def test_the_amplitude_is_taken_from_extremes_within_intervals():
    # Samples at the ends of the intervals would show nothing of a single interval's excursion.
    amplitude = np.full(STEPS, 0.001)
    amplitude[35] = 0.3
    row = one(synthetic(amplitude))
    assert row["late_amplitude"] == pytest.approx(0.3)
    assert not row["suppressed"]


@pytest.mark.parametrize(
    ("changes", "suppressed"),
    [
        ({"amplitude": 0.0199}, True),
        ({"amplitude": 0.0201}, False),  # 5% of .4 is .02
        ({"stick": np.eye(1, STEPS, 39)[0] * 1e-3}, False),
        ({"stick": np.eye(1, STEPS, 29)[0]}, True),  # before the last quarter
        ({"belt": 1.019}, True),
        ({"belt": 1.021}, False),
        ({"belt": 0.979}, False),
        ({"belt": np.where(np.arange(STEPS) % 2, 1.5, 0.5)}, True),  # the mean counts
        ({"completed": False}, False),
    ],
)
def test_suppressed_means_still_slipping_and_at_nominal_belt_speed(changes, suppressed):
    assert one(synthetic(**({"amplitude": 0.001} | changes)))["suppressed"] == suppressed


def test_a_mass_that_drifts_has_not_settled():
    centre = np.linspace(0.0, 0.4, STEPS)
    assert not one(synthetic(0.001, centre=centre))["suppressed"]


def test_actions_are_counted_over_all_of_it_and_once_settled():
    row = one(synthetic(0.001, action=np.where(np.arange(STEPS) < 30, 0.8, -0.1)))
    assert row["peak_action"] == pytest.approx(0.8)
    assert row["rms_action"] == pytest.approx(np.sqrt(0.75 * 0.64 + 0.25 * 0.01))
    assert row["residual_action"] == pytest.approx(0.1)


def test_an_episode_that_ends_early_has_no_late_metrics():
    ended = synthetic(0.001, completed=False)
    cut = {
        name: np.where(np.arange(STEPS) < 10, getattr(ended, name), np.nan)
        for name in ("reward", "reward_terms", "x_min", "x_max", "stick_fraction", "mean_belt_speed", "action")
    }
    row = one(dataclasses.replace(ended, **cut))
    assert row["return"] == pytest.approx(-20.0)
    assert row["steps"] == 10
    assert np.isnan(row["amplitude"])
    assert not row["suppressed"]


def test_metrics_refuse_to_compare_different_episodes():
    with pytest.raises(ValueError, match="same seeds and length"):
        metrics(PASSIVE, dataclasses.replace(PASSIVE, seeds=np.array([6])))


def test_the_score_is_a_ratio_of_means():
    # not the mean of the ratios, which is .75
    assert score([-50.0, -100.0], [-100.0, -200.0], [-50.0, 0.0]) == pytest.approx(75.0 / 125.0)
    assert score([1.0], [1.0], [2.0]) == 0.0
    assert score([2.0], [1.0], [2.0]) == 1.0
    # an episode whose optimum nobody knows does not count
    assert score([-50.0, -9.0], [-100.0, -1.0], [-50.0, np.nan]) == 1.0
    with pytest.raises(ValueError, match="same episodes"):
        score([1.0, 2.0], [1.0], [1.0])
    with pytest.raises(ValueError, match="optimal must hold"):
        score([1.0], [0.0], [np.nan])
    with pytest.raises(ValueError, match="better than passive"):
        score([1.0], [1.0], [1.0])


def test_the_interval_of_a_score_is_the_paired_bootstrap():
    rng = np.random.default_rng(1)
    passive = rng.normal(-500.0, 30.0, 60)
    optimal = -40.0 + 0.2 * (passive + 500.0)
    returns = optimal - rng.gamma(2.0, 20.0, 60)
    low, high = scores.score_interval(returns, passive, optimal, resamples=20_000)

    def statistic(mine, without, best, axis):
        base = without.mean(axis=axis)
        return (mine.mean(axis=axis) - base) / (best.mean(axis=axis) - base)

    oracle = scipy.stats.bootstrap(
        (returns, passive, optimal), statistic, paired=True, method="percentile", n_resamples=20_000
    ).confidence_interval
    assert (low, high) == pytest.approx((oracle.low, oracle.high), abs=0.03 * (high - low))
    assert low < score(returns, passive, optimal) < high
    assert scores.score_interval(returns, passive, optimal, seed=3) == scores.score_interval(
        returns, passive, optimal, seed=3
    )
    # what is always halfway is so in every resample; one episode tells nothing of the next
    assert scores.score_interval(0.5 * (passive + optimal), passive, optimal) == pytest.approx((0.5, 0.5))
    assert np.isnan(scores.score_interval([2.0], [1.0], [3.0])).all()


def test_only_suppressed_episodes_are_credited():
    returns, passive, optimal = [-40.0, -50.0, -300.0], [-400.0, -450.0, -500.0], [-40.0, -50.0, -60.0]
    assert scores.credited_score(returns, [True] * 3, passive, optimal) == score(returns, passive, optimal)
    assert scores.credited_score(returns, [False] * 3, passive, optimal) == 0.0
    # The third episode counts as passive: 200 of the 1,200 that it could gain are not credited.
    assert scores.credited_score(returns, [True, True, False], passive, optimal) == pytest.approx(760 / 1200)
    assert scores.credited_score(returns, [True, True, False], passive, [*optimal[:2], np.nan]) == 1.0


def test_a_slow_belt_has_a_score_and_no_credit():
    seeds = evaluation.VALIDATION_SEEDS[:3]
    passive = evaluation.passive_episodes(BELT, seeds)
    table, baseline = evaluate(ConstantPolicy(-1.0), BELT, seeds), metrics(passive, passive)
    row = summarise("constant -1", table, baseline, np.full(3, -40.0))
    assert row["score"] > 0.3
    assert row["credited"] == 0.0
    assert "credited" in evaluation.format_summary([row]).splitlines()[0]


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    assert scores.interquartile_mean([-100.0, 1.0, 2.0, 3.0, 1000.0]) == 2.0
    assert scores.interquartile_mean(np.array([[0.0, 1.0], [5.0, 90.0]])) == 3.0
    assert scores.interquartile_mean([4.0, 8.0]) == 6.0


def test_the_interval_over_runs_is_the_bootstrap_over_all_resamples():
    runs = [0.1, 0.5, 0.6]
    every = [np.mean(drawn) for drawn in itertools.product(runs, repeat=3)]  # of three, none is cut off
    low, high = scores.run_interval([runs], resamples=40_000)
    for end, share in ((low, 0.025), (high, 0.975)):
        assert end == pytest.approx(np.quantile(every, share, method="inverted_cdf"))
    assert np.isnan(scores.run_interval([[0.3]])).all()
    with pytest.raises(ValueError, match="scores must be"):
        scores.run_interval([[0.3], []])


def test_runs_are_resampled_within_their_task():
    # Were they mixed, the share of ones would vary between resamples.
    assert scores.run_interval([[0.0] * 4, [1.0] * 4]) == (0.5, 0.5)
    assert scores.run_interval([[0.0, 1.0] * 4]) != (0.5, 0.5)


def test_the_interval_of_a_share_is_wilsons():
    z = scipy.stats.norm.ppf(0.975)
    hits, n = 7, 20
    centre, half = (hits + z * z / 2) / (n + z * z), z / (n + z * z) * np.sqrt(hits * (n - hits) / n + z * z / 4)
    assert share_interval(hits, n) == pytest.approx((centre - half, centre + half))
    assert share_interval(100, 100)[0] == pytest.approx(100 / (100 + z * z))


def test_each_episode_may_have_parameters_of_its_own():
    speeds = [0.1, 0.2, 0.3]
    options = {"parameters": {"belt_speed": np.array(speeds)}}
    episodes = run_episodes(ZeroPolicy(), FORCE, [1, 2, 3], options=options)
    table = metrics(episodes, episodes)
    cycles = [limit_cycle(OscillatorParameters(belt_speed=speed)).amplitude for speed in speeds]
    assert table["amplitude"] == pytest.approx(cycles, rel=1e-6)
    assert episodes.belt_speed.tolist() == speeds
    with pytest.raises(ValueError, match="unknown option 'wind'"):
        run_episodes(ZeroPolicy(), FORCE, [1], options={"wind": 1.0})


def test_the_passive_oscillator_is_the_limit_cycle():
    table = evaluate(ZeroPolicy(), FORCE, range(1_000_000, 1_000_003))
    cycle = limit_cycle(OscillatorParameters())
    assert table["amplitude"] == pytest.approx(cycle.amplitude, rel=1e-6)
    assert np.array_equal(table["amplitude"], table["passive_amplitude"])
    assert not table["suppressed"].any()
    assert set(table["steps"]) == {500}


def test_velocity_feedback_suppresses_by_force_and_does_harm_by_belt():
    seeds = evaluation.VALIDATION_SEEDS[:4]
    for env_id in (FORCE, BELT):
        policy = VelocityFeedback.from_env(make_env(env_id), 1.5)
        table = evaluate(policy, env_id, seeds)
        assert table["suppressed"].all() == (env_id == FORCE)
        if env_id == BELT:
            assert (table["amplitude"] > 1.1 * table["passive_amplitude"]).all()


def test_episodes_are_those_of_an_environment_stepped_alone():
    policy = VelocityFeedback.from_env(make_env(BELT), 0.3)
    seeds = [7, 8]
    episodes = run_episodes(policy, BELT, seeds, {"episode_steps": 30})
    for i, seed in enumerate(seeds):
        env = make_env(BELT, {"episode_steps": 30})
        observation, info = env.reset(seed=seed)
        before = info["v_belt"]
        for t in range(30):
            observation, reward, _, _, info = env.step(policy.predict(observation)[0])
            assert episodes.reward[i, t] == reward
            assert episodes.x_max[i, t] == info["x_max"]
            assert episodes.action[i, t] == info["action"]
            assert episodes.mean_belt_speed[i, t] == 0.5 * (before + info["v_belt"])
            before = info["v_belt"]
        assert episodes.reward_terms[:, i].sum() == pytest.approx(episodes.reward[i].sum())
    assert episodes.completed.all()


def test_lost_contact_ends_an_episode_for_good():
    # A heavy push on a light mass lifts it off.
    arguments = {"force_limit": 5.0, "parameters": {"g1": 0.3}, "episode_steps": 50}
    table = evaluate(ConstantPolicy(1.0), FORCE, range(3), arguments)
    assert not table["completed"].any()
    assert (table["steps"] < 50).all()
    assert (table["return_contact_loss"] < 0.0).all()
    assert not table["suppressed"].any()


def test_foreign_environments_and_missing_seeds_are_refused():
    with pytest.raises(TypeError, match="must name an environment"):
        run_episodes(ZeroPolicy(), "CartPole-v1", [1])
    with pytest.raises(ValueError, match="seeds must be"):
        run_episodes(ZeroPolicy(), FORCE, [])


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([1.7], r"got 1\.7 among them"),
        ([1, 2.0], r"got 2\.0 among them"),
        (["12"], "got '12' among them"),
        ("12", "got '12'"),
        ([None], "got None among them"),
        ([True], "got True among them"),
        (7, "got 7"),
        ([3, -2], "got -2 among them"),
        ([], "got none"),
    ],
)
def test_seeds_that_are_no_whole_numbers_are_refused_by_name(seeds, message):
    for evaluated in (evaluation.checked_seeds, lambda seeds: evaluation.passive_episodes(FORCE, seeds)):
        with pytest.raises((TypeError, ValueError), match=f"seeds must be .*{message}"):
            evaluated(seeds)
    with pytest.raises((TypeError, ValueError), match=f"seeds must be .*{message}"):
        run_episodes(ZeroPolicy(), FORCE, seeds)


def test_seeds_may_be_of_any_kind_of_whole_number():
    assert evaluation.checked_seeds(np.array([3, 4])) == evaluation.checked_seeds(range(3, 5)) == [3, 4]
    assert all(type(seed) is int for seed in evaluation.checked_seeds([np.int64(3), np.uint8(4)]))


@pytest.mark.parametrize("damage", [lambda text: text[: len(text) // 2], lambda text: "", lambda text: "[]"])
def test_a_damaged_optimum_is_told_as_such_and_not_as_missing(tmp_path, monkeypatch, damage, capsys):
    whole = (optimal.OPTIMUM_DIRECTORY / "belt.json").read_text(encoding="utf-8")
    (tmp_path / "belt.json").write_text(damage(whole), encoding="utf-8")
    monkeypatch.setattr(optimal, "OPTIMUM_DIRECTORY", tmp_path)
    assert evaluation.optimal_returns(FORCE, [1_000_000]) is None  # here none is stored
    with pytest.raises(RuntimeError, match=r"belt\.json.* or is damaged .*sd-friction optimum --task belt`"):
        evaluation.optimal_returns(BELT, [1_000_000])
    assert main(["evaluate", "--task", "belt", "--episodes", "2"]) == 1
    error = capsys.readouterr().err
    assert "belt.json" in error
    assert error.count("\n") == 1


def test_no_optimum_is_claimed_where_none_is_known():
    seeds = evaluation.EVALUATION_SEEDS
    assert evaluation.optimal_returns(FORCE, seeds, {"w_effort": 0.2}) is None
    assert evaluation.optimal_returns("SDFriction/ForceSensed-v0", [3]) is None
    assert evaluation.optimal_returns(FORCE, [3]) is None
    some = evaluation.optimal_returns(FORCE, [3, seeds[7]])
    assert some is not None
    assert np.isnan(some[0])
    assert some[1] == evaluation.optimal_returns(FORCE, seeds)[7]
    table = evaluate(ZeroPolicy(), FORCE, [3], {"episode_steps": 20})
    assert np.isnan(summarise("x", table, table, None)["score"])
    assert summarise("x", table, table, table["return"] + 1.0)["score"] == 0.0


def test_evaluation_seeds_are_a_hundred_and_apart_from_all_others():
    seeds = evaluation.EVALUATION_SEEDS
    assert len(seeds) == 100
    assert not set(seeds) & set(evaluation.VALIDATION_SEEDS)
    assert max(*seeds, *evaluation.VALIDATION_SEEDS) < 2**32  # where training's begin


def test_the_script_prints_all_controllers_side_by_side_and_writes_tables(tmp_path, capsys):
    files = ["--csv", str(tmp_path / "a.csv"), "--episodes-csv", str(tmp_path / "b.csv")]
    command = ["--task", "force", "--episodes", "3", "--controller", "constant", "velocity-feedback", *files]
    assert main(["evaluate", *command]) == 0
    out = capsys.readouterr().out
    for name in ("passive", "constant -1", "constant +1", "velocity feedback 1.5"):
        assert name in out
    table = Table.from_csv(tmp_path / "a.csv")
    rows = {row["controller"]: row for row in table.rows()}
    assert rows["velocity feedback 1.5"]["suppressed"] == 1.0
    assert rows["passive"]["suppressed"] == 0.0
    assert Table.from_csv(tmp_path / "b.csv").n_rows == 4 * 3
    lines = [line for line in out.splitlines() if line][1:]
    assert len({len(line) for line in lines}) == 1  # aligned


def test_the_script_refuses_bad_arguments_in_one_line(tmp_path, capsys):
    (tmp_path / "x.npz").write_bytes(b"nothing")
    layers = ((np.zeros((7, 1)), np.zeros(1)),)
    NetworkPolicy(layers).save(tmp_path / "seven.npz")
    for command, message in (
        ([], "nothing to evaluate"),
        (["--task", "force", "--episodes", "101"], "[1, 100], got 101"),
        (["--task", "wheel"], "'wheel'"),
        (["--env-id", "CartPole-v1"], "'CartPole-v1'"),
        (["--controller", "magic"], "'magic'"),
        ([str(tmp_path / "gone")], "there is no run folder"),
        ([str(tmp_path / "gone.npz"), "--task", "force"], "no policy file"),
        ([str(tmp_path)], "not a run folder"),
        ([str(tmp_path / "x.npz"), "--task", "force"], "is not a policy"),
        ([str(tmp_path / "seven.npz")], "name it with --task"),
        ([str(tmp_path / "seven.npz"), "--task", "force"], "observes 7 values"),
        (["--task", "force", "--csv", str(tmp_path / "no" / "x.csv")], "lies in no existing folder"),
        (["--task", "force", "--env-arg", "w_effort=-1"], "w_effort"),
        (["--task", "force", "--tier", "sensed", "--controller", "velocity-feedback"], "sees the position only"),
        (["--task", "force", "--controller", "threshold-follower"], "needs the actuator 'belt_speed', got 'force'"),
        (
            [str(AGENTS / "best" / "SDFriction-ForceSensed-v0.npz"), "--task", "belt", "--tier", "sensed"],
            "whose actuator",
        ),
    ):
        assert main(["evaluate", *command]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_the_script_names_all_tuned_classical_controllers(tmp_path, monkeypatch, capsys):
    command = ["--task", "force", "--episodes", "2", "--controller", "classical"]
    made = {f"made for {FORCE}": ConstantPolicy(0.5)}
    monkeypatch.setattr(classical, "classical_controllers", {FORCE: made}.__getitem__)
    assert main(["evaluate", *command]) == 0
    assert f"made for {FORCE}" in capsys.readouterr().out
    assert main(["evaluate", *command, "--env-arg", "w_effort=0.2"]) == 2
    assert "leave one of them out" in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setattr(classical, "GAINS_FILE", tmp_path / "none.json")
    assert main(["evaluate", *command]) == 2
    assert "no tuned controllers are stored" in capsys.readouterr().err


def test_the_script_runs_as_a_program():
    root = Path(__file__).parents[2]
    command = [sys.executable, "-W", "error", "scripts/evaluate.py", "--task", "belt", "--episodes", "2"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120, check=True)
    assert "passive" in done.stdout
