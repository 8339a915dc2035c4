"""The report: rows, intervals, other plants, histories and learning with known answers, and the page with them."""

import base64
import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, Table, limit_cycle
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import ConstantPolicy, NetworkPolicy, VelocityFeedback, ZeroPolicy
from sd_friction_env.environments.ids import TASKS, TIERS, environment_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical, evaluation, optimal, report, runs
from sd_friction_env.learning.report import ENV_IDS, QUICK, Effort, Replay, Report
from sd_friction_env.learning.report.agents import LEARNING, by_algorithm
from sd_friction_env.storage import file_digest, write_json

ROOT = Path(__file__).parents[2]
FEW = Effort(episodes=3, resamples=50, points=3, phases=2)


def make_run(folder, name, gain=-3.0, rows=((100, 1.0, -400.0, 0.0), (300, 3.0, -80.0, 1.0)), **changes):
    """Write a finished run whose agent is saturated velocity feedback (on the force task it suppresses)."""
    task, tier, algorithm, seed = name.split("-")
    config = {
        "algorithm": algorithm,
        "environment": {"id": ENV_IDS[task, tier], "kwargs": {}, "frame_stack": 1},
        "hyperparameters": {},
        "seed": int(seed),
        "spaces": {},
        "steps": 300,
        "versions": {},
    }
    size = make_env(ENV_IDS[task, tier]).observation_space.shape[0]
    weights = np.zeros((size, 1))
    weights[min(1, size - 1)] = gain
    partial = runs.begin(folder / name, config | changes)
    NetworkPolicy(((weights, np.zeros(1)),), metadata=config | changes).save(partial / runs.NETWORK)
    (partial / runs.WEIGHTS).write_bytes(b"not read here")
    columns = zip(*rows, strict=True)
    Table(dict(zip(LEARNING, columns, strict=True))).to_csv(partial / runs.EVALUATIONS)
    runs.finish(folder / name, config | changes)
    return folder / name


@pytest.fixture
def agents_folder(tmp_path):
    folder = tmp_path / "agents"
    folder.mkdir()
    for name in ("force-nominal-ppo-0", "force-nominal-ppo-10", "force-nominal-ppo-2", "force-nominal-sac-0"):
        make_run(folder, name)
    return folder


def test_the_ids_are_those_the_training_script_names():
    assert {(task, tier): environment_id(task, tier) for task in TASKS for tier in TIERS} == ENV_IDS


def test_runs_are_found_by_the_names_of_their_folders(agents_folder):
    (agents_folder / "notes").mkdir()
    (agents_folder / "README.md").write_text("not a run")
    found, left_out = report.find_agents(agents_folder)
    assert [(a.algorithm, a.seed) for a in found] == [("ppo", 0), ("ppo", 2), ("ppo", 10), ("sac", 0)]
    assert len(left_out) == 1
    assert "'notes'" in left_out[0]


def test_runs_that_started_from_a_controller_are_no_part_of_the_others(agents_folder):
    make_run(agents_folder, "force-nominal-ppo-1", start_from="mine:Rule")
    groups = {name: len(group) for name, group in by_algorithm(report.find_agents(agents_folder)[0])}
    assert groups == {"PPO": 3, "PPO started from mine:Rule": 1, "SAC": 1}


def test_a_run_that_is_not_what_its_name_says_or_is_damaged_is_refused(tmp_path):
    with pytest.raises(runs.RunFolderError, match="no folder of agents"):
        report.find_agents(tmp_path / "gone")
    other = make_run(
        tmp_path / "a", "force-nominal-ppo-0", environment={"id": ENV_IDS["belt", "nominal"], "kwargs": {}}
    )
    with pytest.raises(runs.RunFolderError, match="must hold"):
        report.find_agents(other.parent)
    damaged = make_run(tmp_path / "b", "force-nominal-ppo-0")
    (damaged / runs.EVALUATIONS).write_text("steps,seconds\n1,2\n")
    with pytest.raises(runs.RunFolderError, match=r"evaluations\.csv differs from its digest in config\.json"):
        report.find_agents(damaged.parent)
    (damaged / runs.EVALUATIONS).unlink()
    with pytest.raises(runs.RunFolderError, match=r"evaluations\.csv is missing or cannot be read"):
        report.find_agents(damaged.parent)
    strange = make_run(tmp_path / "c", "force-nominal-ppo-0")
    (strange / runs.EVALUATIONS).write_text("steps,seconds\n1,2\n")
    config = json.loads((strange / runs.CONFIG).read_text())
    config["files"][runs.EVALUATIONS] = file_digest(strange / runs.EVALUATIONS)
    write_json(strange / runs.CONFIG, config)
    with pytest.raises(runs.RunFolderError, match="must have columns of numbers"):
        report.find_agents(strange.parent)
    (damaged / runs.NETWORK).write_bytes(b"x")
    with pytest.raises(runs.RunFolderError, match="damaged"):
        report.find_agents(damaged.parent)


def test_several_runs_are_one_row_of_interquartile_means():
    summaries = [
        {"controller": str(i), "score": value, "score_low": -9.0, "score_high": 9.0, "suppressed": 1.0,
         "suppressed_low": 0.0, "suppressed_high": 1.0, "settling": settling, "episodes": 100, "scored_episodes": 32}
        for i, (value, settling) in enumerate([(0.1, np.nan), (0.8, 10.0), (0.9, 20.0), (1.0, 30.0), (5.0, np.nan)])
    ]  # fmt: skip
    row = report.over_runs("PPO", summaries, seed=0, resamples=500)
    assert row["score"] == pytest.approx(0.9)
    assert 0.1 <= row["score_low"] < 0.9 < row["score_high"] <= 5.0
    assert (row["suppressed_low"], row["suppressed_high"]) == (1.0, 1.0)  # all runs alike
    assert row["settling"] == 20.0  # of those that have one
    assert (row["runs"], row["episodes"], row["interval_over"]) == (5, 100, "runs")
    alone = report.over_runs("PPO", summaries[:1], seed=0, resamples=500)
    assert (alone["score_low"], alone["score_high"], alone["interval_over"]) == (-9.0, 9.0, "episodes")


def test_every_controller_has_its_row_and_exploits_show(agents_folder):
    agents, _ = report.find_agents(agents_folder)
    made = report.compare(("force", "nominal"), agents, FEW, 0)
    rows = {row["controller"]: row for row in made.rows}
    assert rows["passive"]["score"] == 0.0
    assert rows["PPO"]["runs"] == 3
    assert rows["PPO"]["score"] > 0.9
    assert rows["PPO"]["suppressed"] == 1.0
    assert rows["optimum"]["score"] == pytest.approx(1.0)
    assert rows["optimum"]["suppressed"] == 1.0  # its stored actions are replayed
    assert [row["controller"] for row in made.runs] == [agent.name for agent in agents]
    belt = {row["controller"]: row for row in report.compare(("belt", "nominal"), [], FEW, 0).rows}
    assert belt["constant -1"]["score"] > 0.3  # runs the belt slow ...
    assert belt["constant -1"]["suppressed"] == 0.0  # ... and suppresses nothing


def test_a_picture_shows_a_middling_run_and_not_the_best(tmp_path):
    for seed, gain in enumerate((-3.0, -0.1, -0.001)):
        make_run(tmp_path, f"force-nominal-ppo-{seed}", gain)
    agents, _ = report.find_agents(tmp_path)
    made = report.compare(("force", "nominal"), agents, FEW, 0)
    returns = [row["return"] for row in made.runs]
    assert returns[0] > returns[1] > returns[2]
    assert made.shown["PPO"] is agents[1].policy


def test_the_best_classical_controller_is_shown_and_what_is_missing_is_said(monkeypatch):
    feedback = VelocityFeedback.from_env(make_env(ENV_IDS["force", "nominal"]), 1.5)
    tuned = {"weak": VelocityFeedback(0.01, readings=feedback.readings), "good": feedback}
    known = evaluation.optimal_returns(ENV_IDS["force", "nominal"], evaluation.EVALUATION_SEEDS[:3])
    known[1] = np.nan
    monkeypatch.setattr(classical, "classical_controllers", lambda env_id: tuned)
    monkeypatch.setattr(evaluation, "optimal_returns", lambda *arguments: known)
    made = report.compare(("force", "nominal"), [], FEW, 0)
    assert made.shown == {"good": feedback}
    assert made.notes == []
    rows = {row["controller"]: row for row in made.rows}
    assert [rows[name]["kind"] for name in ("weak", "good")] == ["classical", "classical"]
    assert {row["scored_episodes"] for row in made.rows} == {2}
    assert rows["optimum"]["score"] == pytest.approx(1.0)
    assert rows["optimum"]["episodes"] == 2

    def none(env_id):
        raise classical.NotTunedError("none")

    monkeypatch.setattr(classical, "classical_controllers", none)
    monkeypatch.setattr(evaluation, "optimal_returns", lambda *arguments: None)
    made = Report([], [("force", "nominal"), ("force", "sensed")], FEW)
    stages = dict(made.stages())
    stages["controllers, force nominal"]()
    stages["controllers, force sensed"]()
    assert len(made.remarks()) == 2
    assert all(remark.endswith(": force nominal, force sensed.") for remark in made.remarks())
    assert "optimum" not in {row["kind"] for row in made.comparisons["force", "nominal"].rows}


def test_a_damaged_file_of_gains_or_optima_is_told_and_not_taken_for_a_missing_one(tmp_path, monkeypatch, capsys):
    (tmp_path / "classical.json").write_text('{"gains": {', encoding="utf-8")
    command = ["--quick", "--task", "belt", "--tier", "nominal", "--no-progress", "--out", str(tmp_path / "out")]
    with monkeypatch.context() as patch:
        patch.setattr(classical, "GAINS_FILE", tmp_path / "classical.json")
        with pytest.raises(ValueError, match=r"classical\.json"):
            report.compare(("belt", "nominal"), [], FEW, 0)
        assert main(["report", *command]) == 2
        assert "classical.json" in capsys.readouterr().err
    (tmp_path / "belt.json").write_text('{"env_id": ', encoding="utf-8")
    monkeypatch.setattr(optimal, "OPTIMUM_DIRECTORY", tmp_path)
    assert main(["report", *command]) == 1
    error = capsys.readouterr().err
    assert "belt.json" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def row_of(kind, name, score, runs=1, **more):
    return {"kind": kind, "controller": name, "score": score, "runs": runs, "suppressed": 0.5} | more


def test_the_summary_shows_the_best_of_each_kind_and_of_agents_the_best_of_those_with_most_runs():
    interval = {"score_low": 0.1, "score_high": 0.9}
    rows = [
        row_of("baseline", "passive", 0.0),
        row_of("baseline", "constant -1", 0.4),
        row_of("baseline", "constant +1", 0.95),
        row_of("classical", "unscored", float("nan")),
        row_of("classical", "worst", 0.2),
        row_of("classical", "best", 0.7, suppressed=0.25),
        row_of("classical", "middling", 0.5),
        row_of("learned", "LUCKY", 0.99, **interval),
        row_of("learned", "WORSE", 0.3, 5, **interval),
        row_of("learned", "BETTER", 0.6, 5, **interval),
        row_of("optimum", "optimum", 1.0),
    ]
    made = Report([], [])
    made.comparisons = {
        ("force", "nominal"): report.Comparison(rows, [], {}, []),
        ("belt", "sensed"): report.Comparison([*rows[:2], row_of("learned", "ALONE", 0.3, **interval)], [], {}, []),
    }
    assert made.summary().splitlines()[2:] == [
        "| force, nominal | 0.400, 50% | best: 0.700, 25% | BETTER (5 runs): 0.600 [0.100, 0.900], 50% |",
        "| belt, sensed | 0.400, 50% | - | ALONE (1 run): 0.300 [0.100, 0.900], 50% |",
    ]


@pytest.mark.parametrize(
    ("kind", "scored", "told"),
    [("optimum", 4, True), ("optimum", 3, False), ("learned", 4, False)],
)
def test_times_to_a_score_need_the_optimum_of_every_episode(tmp_path, kind, scored, told):
    """On the randomised tier the optimum of some of the episodes is known: its mean is of others than the agent's."""
    make_run(tmp_path, "force-nominal-ppo-0", -1.0)
    make_run(tmp_path, "force-sensed-ppo-0", -1.0)
    made = Report(report.find_agents(tmp_path)[0], [("force", "nominal")])
    passive = row_of("baseline", "passive", 0.0, **{"return": -500.0, "episodes": 4, "scored_episodes": scored})
    last = row_of(kind, kind, 1.0, **{"return": -50.0, "episodes": scored, "scored_episodes": scored})
    made.comparisons = {("force", "nominal"): report.Comparison([passive, last], [], {}, [])}
    made._learn()
    assert {row["tier"] for row in made.learning} == {"nominal"}  # what is not reported is left out
    assert [row["run"] for row in made.training] == (["force-nominal-ppo-0"] if told else [])
    for row in made.training:  # -400 and -80: of the way from -500 to -50, .22 and .93
        assert row["seconds_to_0.9"] == 3.0


def test_a_replay_gives_each_episode_its_own_actions():
    actions = np.array([[0.1, 0.2], [0.3, 0.4]], np.float32)
    policy, state, taken = Replay(actions), None, []
    for _ in range(2):
        action, state = policy.predict(np.zeros((2, 2)), state)
        taken.append(action[:, 0].tolist())
    assert np.array_equal(np.array(taken, np.float32).T, actions)


def test_scores_over_tasks_take_every_run_and_want_both_tasks():
    rows = [
        {"tier": "nominal", "algorithm": "PPO", "task": task, "score": score, "suppressed": 1.0}
        for task, scores in (("force", [1.0, 1.0]), ("belt", [0.0, 0.0]))
        for score in scores
    ]
    (overall,) = report.over_tasks(rows, seed=0, resamples=100)
    assert (overall["score"], overall["score_low"], overall["score_high"], overall["runs"]) == (0.5, 0.5, 0.5, 4)
    assert report.over_tasks(rows[:2], seed=0, resamples=100) == []
    assert report.over_tasks([rows[0] | {"score": np.nan}, *rows[1:]], seed=0, resamples=100) == []


@pytest.mark.parametrize("sweep", report.SWEEPS)
def test_a_sweep_moves_one_parameter_and_nothing_else(sweep):
    # The last controller sees the randomised tier, where nothing may be drawn.
    feedback = VelocityFeedback.from_env(make_env(ENV_IDS["force", "nominal"]), 1.5)
    policies = {
        "feedback": ("nominal", feedback),
        "nothing": ("nominal", ZeroPolicy()),
        "nothing too": ("randomised", ZeroPolicy()),
    }
    rows = report.sweep_plants("force", sweep, policies, FEW)
    by_name = {name: [row for row in rows if row["controller"] == name] for name in ("passive", *policies)}
    passive = {row["value"]: row["amplitude"] for row in by_name["passive"]}
    for row in by_name["nothing"]:
        changed = report.swept_parameters(sweep, row["value"], OscillatorParameters())
        cycle = limit_cycle(OscillatorParameters(**changed))
        assert passive[row["value"]] == cycle.amplitude
        # Where there is no cycle, a kick of .1 is still dying out when the episode ends.
        assert row["amplitude"] == pytest.approx(cycle.amplitude, rel=1e-5, abs=1e-9 if cycle.amplitude else 0.05)
    assert [row["amplitude"] for row in by_name["nothing too"]] == [row["amplitude"] for row in by_name["nothing"]]
    for row in by_name["feedback"]:
        assert row["amplitude"] < max(0.9 * passive[row["value"]], 1e-3)


def test_a_history_is_the_episode_of_the_environment():
    env_id = ENV_IDS["belt", "nominal"]
    path = report.history(ConstantPolicy(0.3), env_id, 7)
    env = make_env(env_id)
    env.reset(seed=7)
    for step in range(1, 501):
        *_, info = env.step(np.array([0.3], np.float32))
        if step % 50 == 0:
            (place,) = np.flatnonzero(np.isclose(path["t"], 0.1 * step, atol=1e-9))
            for name in ("x", "v", "v_belt"):
                assert path[name][place] == pytest.approx(info[name], abs=1e-6)
    assert path["action"] == pytest.approx(0.3)
    # what is shown of feedback is held over each interval, and changes between them
    feedback = VelocityFeedback.from_env(make_env(ENV_IDS["force", "nominal"]), 1.0)
    path = report.history(feedback, ENV_IDS["force", "nominal"], 7)
    at = np.isclose(np.mod(path["t"] + 0.05, 0.1), 0.0, atol=1e-6) | np.isclose(
        np.mod(path["t"] + 0.05, 0.1), 0.1, atol=1e-6
    )
    assert np.array_equal(path["action"][at], path["action"][np.flatnonzero(at) - 1])


def test_learning_curves_span_what_all_runs_have_been_evaluated_on(tmp_path):
    first = ((100, 1.0, -400.0, 0.0), (200, 2.0, -200.0, 0.5), (300, 3.0, -100.0, 1.0))
    second = ((100, 2.0, -300.0, 0.0), (200, 4.0, -100.0, 1.0))
    make_run(tmp_path, "force-nominal-ppo-0", rows=first)
    make_run(tmp_path, "force-nominal-ppo-1", rows=second)
    rows = report.learning_curves(report.find_agents(tmp_path)[0])
    steps = [row for row in rows if row["over"] == "steps"]
    assert [row["at"] for row in steps] == [100.0, 200.0]
    assert [row["return"] for row in steps] == [-350.0, -150.0]
    assert [(row["return_low"], row["return_high"]) for row in steps] == [(-400.0, -300.0), (-200.0, -100.0)]
    assert [row["suppressed"] for row in steps] == [0.0, 0.75]
    seconds = [row for row in rows if row["over"] == "seconds"]
    assert [row["at"] for row in seconds] == [2.0, 3.0]
    assert seconds[1]["return"] == -150.0  # -100 of the first, -200 on the second's way from -300 to -100


def test_the_page_holds_everything_and_needs_nothing(agents_folder, tmp_path, capsys):
    make_run(agents_folder, "belt-sensed-ppo-0")  # not asked for
    (agents_folder / "<b>odd & even").mkdir()
    out = tmp_path / "out"
    command = ["--quick", "--task", "force", "--tier", "nominal", "--agents", str(agents_folder), "--out", str(out)]
    assert main(["report", *command, "--no-progress"]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    pictures = sorted(out.glob("*.png"))
    assert {path.stem for path in pictures} == {
        "history-force-nominal", "learning-force-nominal", "scores-force-nominal", "sweeps-force"
    }  # fmt: skip
    inlined = [base64.b64decode(data) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', page)]
    assert sorted(inlined) == sorted(path.read_bytes() for path in pictures)
    assert all(data.startswith(b"\x89PNG") for data in inlined)
    references = re.findall(r'(?:src|href)="(.{5})|url\(|@import', page)
    assert all(start.startswith(("data:", "#")) for start in references)
    assert not re.search(r"https?:|<script|<b>odd", page)
    assert "&lt;b&gt;odd &amp; even" in page
    anchors = re.findall(r'href="#([^"]+)"', page)
    assert anchors
    assert all(f'id="{anchor}"' in page for anchor in anchors)
    table = Table.from_csv(out / "controllers.csv")
    assert "sd-friction report --quick" in table.metadata["made by"]
    shown = {row["controller"]: row for row in table.rows()}
    assert set(shown) >= {"passive", "constant -1", "constant +1", "PPO", "SAC", "optimum"}
    for name, row in shown.items():
        assert re.search(rf"<td>{re.escape(name)}</td><td>{row['score']:.3f}", page)
    summary = (out / "summary.md").read_text().splitlines()
    assert re.search(r"\| force, nominal \| -0\.\d+, 0% \| .+: 0\.\d+, \d+% \| .+: -?\d\.\d+", summary[2])
    assert "A quick look" in capsys.readouterr().out
    for name in ("runs", "sweeps", "learning", "histories", "training"):
        assert Table.from_csv(out / f"{name}.csv").n_rows >= 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agents", "out"]


def test_an_interrupted_report_leaves_nothing_behind(agents_folder, tmp_path, monkeypatch, capsys):
    def stop(*arguments):
        raise KeyboardInterrupt

    command = ["--quick", "--task", "force", "--tier", "nominal", "--agents", str(agents_folder), "--no-progress"]
    monkeypatch.setattr(Report, "_learn", stop)
    assert main(["report", *command, "--out", str(tmp_path / "out")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["agents"]


def test_a_report_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    out = tmp_path / "out"
    made = Report([], [("force", "nominal")], QUICK, notes=["first"])
    dict(made.stages())["controllers, force nominal"]()
    made.write(out, "test")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    made.notes = ["second"]

    def full(self, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Table, "to_csv", full)
    with pytest.raises(OSError, match="No space"):
        made.write(out, "test")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_bad_arguments_are_one_line_and_nothing_is_computed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Report, "stages", lambda self: pytest.fail("computed"))
    (tmp_path / "file").write_text("")
    make_run(tmp_path / "agents", "force-nominal-ppo-0", seed=4)
    for command, message in (
        (["--task", "wheel"], "'wheel'"),
        (["--tier", "easy"], "'easy'"),
        (["--seed", "-1"], "--seed must be at least 0, got -1"),
        (["--out", str(tmp_path / "file")], "is a file"),
        (["--out", str(tmp_path / "no" / "out")], "in a folder that exists"),
        (["--agents", str(tmp_path / "gone")], "no folder of agents"),
        (["--agents", str(tmp_path / "agents")], "must hold"),
    ):
        assert main(["report", "--out", str(tmp_path / "out"), *command]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_the_script_explains_itself():
    command = [sys.executable, "-W", "error", "scripts/report.py", "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert "--agents FOLDER" in done.stdout


def test_the_time_to_a_score_is_that_of_the_first_evaluation_that_reaches_it(tmp_path):
    make_run(tmp_path, "force-nominal-ppo-0", -1.0)
    (agent,) = report.find_agents(tmp_path)[0]
    curve = Table(
        {"steps": [10, 20, 30, 40], "seconds": [1.0, 2.5, 4.0, 5.0], "mean_return": [-100.0, -20.0, -60.0, -14.0]}
    )
    (row,) = report.training_times([dataclasses.replace(agent, evaluations=curve)], passive=-110.0, optimum=-10.0)
    assert row["seconds_to_0.9"] == 2.5  # -20 is .9 of the way, and what comes after does not matter
    assert row["seconds_to_0.95"] == 5.0
    assert (row["seconds"], row["steps"], row["run"]) == (5.0, 40.0, "force-nominal-ppo-0")
    (never,) = report.training_times([dataclasses.replace(agent, evaluations=curve)], passive=-110.0, optimum=-5.0)
    assert np.isnan(never["seconds_to_0.95"])


@pytest.mark.parametrize("part", [["--quick"], ["--task", "belt"], ["--tier", "nominal"], ["--agents", "runs"]])
def test_only_a_whole_report_is_published(part, tmp_path, capsys):
    assert main(["report", "--publish", str(tmp_path), "--out", str(tmp_path / "out"), *part]) == 2
    assert "--publish keeps the whole report" in capsys.readouterr().err
    assert main(["report", "--publish", str(tmp_path / "no"), "--out", str(tmp_path / "out")]) == 2
    assert "--publish must be a folder that exists" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
