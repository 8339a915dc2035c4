"""Tuning on tiny budgets: the space holds what is shipped; studies repeat, continue, survive crashes, are not mixed."""

import dataclasses
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml
from optuna.trial import FixedTrial, TrialState

from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.cli.main import main
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation, runs, settings, training, tuning
from sd_friction_env.learning.plan import make_plan
from sd_friction_env.learning.tuning import trial

ROOT = Path(__file__).parents[2]
FORCE = "SDFriction/Force-v0"
TINY = {"n_envs": 4, "n_steps": 32, "n_epochs": 2}


def tiny_search(**arguments):
    arguments = {
        "env_kwargs": {"episode_steps": 40},
        "overrides": TINY,
        "timesteps": 512,
        "evaluations": 4,
        "eval_episodes": 2,
    } | arguments
    return tuning.make_search(arguments.pop("env_id", FORCE), arguments.pop("algorithm", "ppo"), **arguments)


def small_search(**arguments):
    """A search of two hyperparameters: a database takes its time over each."""
    search = tiny_search(**arguments)
    space = [dimension for dimension in search.space if dimension.name in ("learning_rate", "net")]
    return dataclasses.replace(search, space=tuple(space))


@pytest.fixture
def storage(tmp_path):
    return f"sqlite:///{tmp_path / 'study.db'}"


def study_of(search, storage, trials, name="study", **arguments):
    """Run a study in this process."""
    study = tuning.open_study(search, storage, name)
    tuning.work(search, storage, name, trials, **arguments)
    return study


def outcome(study):
    """What the trials that count were and gave."""
    trials = tuning.finished_trials(study)
    return [(trial.params, trial.user_attrs["seed"], trial.intermediate_values, trial.value) for trial in trials]


def scripted(monkeypatch, *rows_of_trials):
    """Let trials report these credited returns, or pairs of a credited and a mean one, instead of training."""
    plans, left = [], [list(rows) for rows in rows_of_trials]

    def run_plan(plan, report, should_stop=lambda: False):
        plans.append(plan)
        for i, value in enumerate(left.pop(0)):
            if isinstance(value, Exception):
                raise value
            credited, mean = value if isinstance(value, tuple) else (value, value)
            steps = (i + 1) * plan.eval_freq
            report({"steps": steps, "credited_return": credited, "mean_return": mean, "suppressed": 0.5})
        return True

    monkeypatch.setattr(trial, "run_plan", run_plan)
    return plans


def same(*plans):
    """Tell whether plans have the same hyperparameters, however their learning rates are written."""
    return all(
        dict(plan.hyperparameters) | {"learning_rate": plans[0].hyperparameters["learning_rate"]}
        == plans[0].hyperparameters
        and float(plan.hyperparameters["learning_rate"].removeprefix("lin_"))
        == float(plans[0].hyperparameters["learning_rate"].removeprefix("lin_"))
        for plan in plans
    )


# The space ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_the_space_holds_the_hyperparameters_that_are_shipped(algorithm, env_id):
    search = tuning.make_search(env_id, algorithm)
    values = {dimension.name: dimension.value(search.plan.hyperparameters) for dimension in search.space}
    assert None not in values.values()
    assert same(search.trial_plan(values, 0), search.plan)
    assert ("frame_stack" in values) == ("frame_stack" in search.plan.hyperparameters)


@pytest.mark.parametrize("algorithm", settings.ALGORITHMS)
def test_every_corner_of_the_space_is_a_plan_that_its_file_gives_again(algorithm, tmp_path):
    search = tuning.make_search("SDFriction/BeltSpeedSensed-v0", algorithm)
    for corner in range(2):
        values = {
            dimension.name: dimension.choices[-corner] if dimension.choices else (dimension.low, dimension.high)[corner]
            for dimension in search.space
        }
        assert {d.name: d.suggest(FixedTrial(values)) for d in search.space} == values  # in its range
        plan = search.trial_plan(values, 0)
        file = tmp_path / "best.yml"
        file.write_text(yaml.safe_dump({plan.env_id: settings.zoo_settings(plan.hyperparameters)}))
        again = make_plan(plan.env_id, algorithm, hyperparameter_file=file)
        assert again.hyperparameters == {"policy": "MlpPolicy", **plan.hyperparameters}


def test_a_horizon_is_that_of_the_discount():
    search = tuning.make_search(FORCE, "ppo")
    values = {dimension.name: dimension.value(search.plan.hyperparameters) for dimension in search.space}
    plan = search.trial_plan(values | {"horizon": 80.0}, 0)
    assert np.sum(plan.hyperparameters["gamma"] ** np.arange(10**4)) == pytest.approx(80.0)


def test_what_is_fixed_is_not_searched():
    names = {dimension.name for dimension in tiny_search().space}
    assert "log2_n_steps" not in names
    assert "n_epochs" not in names
    assert {"learning_rate", "net", "reward_power", "log_std_end"} <= names
    assert "log_std_init" not in names  # exploration is annealed, and begins at log_std_start
    overrides = {"env_wrapper": [{settings.WRAPPER: {"scale": 0.2}}], "policy_kwargs": "dict(net_arch=[8])"}
    overrides["callback"] = []
    names = {dimension.name for dimension in tiny_search(overrides=overrides).space}
    assert not names & {"reward_power", "net", "activation", "log_std_init", "log_std_start", "log_std_end"}


# A trial --------------------------------------------------------------------------------------------------------------


def test_a_trial_is_worth_what_training_chooses_its_best_model_by(tmp_path):
    plan = tiny_search().plan
    rows = []
    assert tuning.run_plan(plan, rows.append)
    training.train(plan, tmp_path / "run", progress=False)
    table = Table.from_csv(tmp_path / "run" / "evaluations.csv")
    for name in ("steps", "credited_return", "mean_return", "suppressed"):
        assert [row[name] for row in rows] == table[name].tolist(), name
    assert len(rows) == 4


def test_an_episode_that_is_not_suppressed_counts_no_more_than_a_passive_one():
    from sd_friction_env.control.policies import ConstantPolicy, VelocityFeedback, ZeroPolicy

    def values(policy, env_id):
        plan = make_plan(env_id, "ppo", eval_episodes=5)
        return training.validate(policy, plan)

    slow = values(ConstantPolicy(-1.0), "SDFriction/BeltSpeed-v0")  # a slow belt pays, and suppresses nothing
    passive = values(ZeroPolicy(), "SDFriction/BeltSpeed-v0")
    assert slow["mean_return"] > 0.9 * passive["mean_return"]
    assert slow["credited_return"] == pytest.approx(passive["mean_return"])
    good = values(VelocityFeedback.from_env(make_env(FORCE), 1.5), FORCE)
    assert good["suppressed"] == 1.0
    assert good["credited_return"] == good["mean_return"]


def test_no_evaluation_seed_is_ever_used(storage, monkeypatch):
    used, run_episodes = set(), evaluation.run_episodes

    def watched(policy, env_id, seeds, *more):
        used.update(seeds)
        return run_episodes(policy, env_id, seeds, *more)

    monkeypatch.setattr(evaluation, "run_episodes", watched)
    study_of(tiny_search(eval_episodes=7), storage, 1)
    assert used <= set(evaluation.VALIDATION_SEEDS)
    assert not used & set(evaluation.EVALUATION_SEEDS)


def test_a_trial_keeps_its_best_evaluation_and_ties_go_to_the_mean_return(storage, monkeypatch):
    scripted(monkeypatch, [-9.0, -5.0, -7.0, -8.0], [(-5.0, -5.0), (-5.0, -4.0)], [-6.0])
    study = study_of(small_search(), storage, 3)
    best = tuning.best_trials(study)
    assert [trial.number for trial in best] == [1, 0, 2]
    assert [trial.value for trial in best] == [-5.0, -5.0, -6.0]
    assert best[0].user_attrs["best"]["mean_return"] == -4.0
    assert best[1].user_attrs["best"]["steps"] == 256


def test_a_hopeless_trial_is_pruned(storage, monkeypatch):
    rows = [[-3.0] * 4] * 5 + [[-9.0] * 4, [-1.0] * 4]
    scripted(monkeypatch, *rows)
    study = study_of(small_search(), storage, 7)
    states = [trial.state for trial in study.trials]
    assert states == [TrialState.COMPLETE] * 5 + [TrialState.PRUNED, TrialState.COMPLETE]
    assert list(study.trials[5].intermediate_values) == [1, 2]  # not before a third of its evaluations
    scripted(monkeypatch, *rows)
    unpruned = study_of(small_search(pruner="none"), storage, 7, name="unpruned")
    assert {trial.state for trial in unpruned.trials} == {TrialState.COMPLETE}


def test_hyperband_prunes_too(storage, monkeypatch):
    scripted(monkeypatch, *[[-float(i)] * 9 for i in range(8)])
    study = study_of(small_search(pruner="hyperband", evaluations=9, timesteps=9 * 128), storage, 8)
    assert {trial.state for trial in study.trials} == {TrialState.COMPLETE, TrialState.PRUNED}


def test_a_training_that_fails_counts_says_why_and_is_not_tried_again(storage, monkeypatch):
    scripted(monkeypatch, [-3.0, ValueError("weights\nthat are not finite")], [-2.0])
    study = study_of(small_search(), storage, 2)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL, TrialState.COMPLETE]
    assert study.trials[0].user_attrs["error"] == "ValueError: weights that are not finite"
    assert "2 trials: 1 complete, 0 pruned, 1 failed" in tuning.format_trials(study)


# The study ------------------------------------------------------------------------------------------------------------


def test_one_worker_gives_the_same_trials_twice_and_another_seed_gives_others(storage, monkeypatch):
    """Training is a formula here: for its first ten trials the sampler draws at random, then it learns."""

    def run_plan(plan, report, should_stop=lambda: False):
        rate = float(plan.hyperparameters["learning_rate"].removeprefix("lin_"))
        value = -abs(np.log(rate / 1e-3)) - 1e-10 * plan.seed
        report({"steps": plan.eval_freq, "credited_return": value, "mean_return": value, "suppressed": 1.0})
        return True

    monkeypatch.setattr(trial, "run_plan", run_plan)
    first, again = (study_of(small_search(), storage, 14, name=name) for name in ("first", "again"))
    assert outcome(again) == outcome(first)
    assert len({str(params) for params, *_ in outcome(first)}) == 14
    assert outcome(study_of(small_search(seed=1), storage, 1, name="other"))[0] != outcome(first)[0]


def test_a_continued_study_and_another_worker_draw_other_trials(storage, monkeypatch):
    scripted(monkeypatch, *[[-1.0]] * 5)
    study = study_of(small_search(), storage, 2)
    tuning.work(small_search(), storage, "study", 4)
    assert len({str(params) for params, *_ in outcome(study)}) == 4
    tuning.work(small_search(), storage, "study", 5, worker=1)
    assert len({str(params) for params, *_ in outcome(study)}) == 5


def test_a_trial_that_is_stopped_in_its_midst_is_queued_and_repeated(storage):
    search = tiny_search()
    through = study_of(search, storage, 2, name="through")
    stopped = tuning.open_study(search, storage, "stopped")
    asked = iter(range(10**6))
    tuning.work(search, storage, "stopped", 2, should_stop=lambda: next(asked) >= 200)
    assert len(tuning.finished_trials(stopped)) == 1  # 128 steps of each, and some questions between them
    assert len(stopped.get_trials(states=[TrialState.WAITING])) == 1
    assert not stopped.get_trials(states=[TrialState.RUNNING])
    tuning.work(search, storage, "stopped", 2)
    assert outcome(stopped) == outcome(through)


def test_the_first_trial_is_the_file_itself(storage, monkeypatch):
    plans = scripted(monkeypatch, [-1.0], [-1.0])
    search = tuning.make_search(FORCE, "sac")
    study_of(search, storage, 2)
    assert same(plans[0], search.plan)
    assert not same(plans[1], search.plan)
    assert plans[0].seed != plans[1].seed


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"env_id": "SDFriction/BeltSpeed-v0"}, "env_id"),
        ({"env_id": "SDFriction/ForceSensed-v0"}, "env_id"),
        ({"algorithm": "td3", "overrides": {"n_envs": 4}}, "algo"),
        ({"timesteps": 1024}, "timesteps"),
        ({"seed": 1}, "seed"),
        ({"pruner": "none"}, "pruner"),
        ({"env_kwargs": {"episode_steps": 41}}, "env_kwargs"),
        ({"overrides": {**TINY, "n_epochs": 3}}, "hyperparameters"),
    ],
)
def test_a_study_of_another_configuration_is_refused_and_left_alone(change, named, storage, monkeypatch):
    scripted(monkeypatch, [-1.0])
    study = study_of(tiny_search(), storage, 1)
    before = [list(sqlite3.connect(storage.removeprefix("sqlite:///")).iterdump())]
    with pytest.raises(tuning.StudyError, match=rf"of another configuration: its {named} is") as caught:
        tuning.tune(tiny_search(**change), storage, "study", 5, progress=False)
    assert "\n" not in str(caught.value)
    assert [list(sqlite3.connect(storage.removeprefix("sqlite:///")).iterdump())] == before
    assert len(study.trials) == 1


def test_another_search_space_and_another_programs_study_are_refused(storage):
    search = tiny_search()
    tuning.open_study(search, storage, "study")
    with pytest.raises(tuning.StudyError, match="its search space is not that of this search"):
        tuning.open_study(dataclasses.replace(search, space=search.space[1:]), storage, "study")
    foreign = optuna.create_study(storage=storage, study_name="foreign", direction="maximize")
    foreign.add_trial(optuna.create_trial(value=1.0))
    with pytest.raises(tuning.StudyError, match="was not made by this program"):
        tuning.open_study(search, storage, "foreign")
    assert not foreign.user_attrs


@pytest.mark.slow
def test_two_workers_share_a_study_and_one_may_be_killed(storage):
    search = tiny_search(timesteps=16384, evaluations=8, pruner="none")
    opened = tuning.open_study(search, storage, "study")
    killed = []

    def kill_one():
        if not killed:
            running = opened.get_trials(states=[TrialState.RUNNING])
            begun = [trial for trial in running if "process" in trial.user_attrs and (trial.last_step or 0) < 6]
            if begun:
                killed.append(begun[0].number)
                os.kill(begun[0].user_attrs["process"], signal.SIGKILL)
        return False

    study = tuning.tune(search, storage, "study", 4, workers=2, heartbeat=1, progress=False, should_stop=kill_one)
    assert len(killed) == 1
    assert [trial.state for trial in tuning.finished_trials(study)] == [TrialState.COMPLETE] * 4
    failed = study.get_trials(states=[TrialState.FAIL])
    assert len(failed) == 1  # the killed one, which was tried again with the same hyperparameters and seed
    again = [trial for trial in study.get_trials() if trial.system_attrs.get("failed_trial") == failed[0].number]
    assert [trial.state for trial in again] == [TrialState.COMPLETE]
    assert again[0].params == failed[0].params
    assert again[0].user_attrs["seed"] == failed[0].user_attrs["seed"]
    assert not study.get_trials(states=[TrialState.RUNNING, TrialState.WAITING])


# The program ----------------------------------------------------------------------------------------------------------


def command(storage, *more):
    fixed = [f"--set={name}={value}" for name, value in TINY.items()]
    size = ["--timesteps", "512", "--evaluations", "4", "--eval-episodes", "2", "--env-arg", "episode_steps=40"]
    return ["--task", "force", "--algo", "ppo", "--storage", storage, "--study", "study", *size, *fixed, *more]


@pytest.mark.slow
def test_ctrl_c_leaves_a_study_that_the_same_command_continues_and_training_takes_its_best(storage, tmp_path, capsys):
    out = tmp_path / "best.yml"
    endless = [sys.executable, "-W", "error", "-m", "sd_friction_env", "tune", *command(storage, "--trials", "100000")]
    search = tiny_search()
    with subprocess.Popen(endless, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True) as program:
        try:
            begun = time.monotonic()
            while program.poll() is None and time.monotonic() - begun < 60.0:
                time.sleep(0.3)
                if (tmp_path / "study.db").exists() and "complete" in _states(tmp_path / "study.db"):
                    break
            os.killpg(program.pid, signal.SIGINT)  # as a terminal sends it: to all processes
            _, errors = program.communicate(timeout=60)
        finally:
            program.kill()
    assert program.returncode == 130, errors
    assert "Traceback" not in errors
    assert "the same command continues" in errors
    study = tuning.open_study(search, storage, "study")
    finished = len(tuning.finished_trials(study))
    assert finished >= 1
    assert not study.get_trials(states=[TrialState.RUNNING])
    # With all trials done, the same command says what came out.
    assert main(["tune", *command(storage, "--trials", str(finished), "--out", str(out))]) == 0
    assert f"{finished} trials:" in capsys.readouterr().out
    best = tuning.best_trials(study)[0]
    assert settings.read_hyperparameters("ppo", FORCE, out).items() >= best.user_attrs["hyperparameters"].items()
    folder = tmp_path / "run"
    words = ["--task", "force", "--algo", "ppo", "--hyperparameters", str(out), "--run-folder", str(folder)]
    assert main(["train", *words, "--no-progress", "--env-arg", "episode_steps=40"]) == 0
    assert runs.load_config(folder)["hyperparameters"].items() >= best.user_attrs["hyperparameters"].items()


def _states(database):
    with sqlite3.connect(database) as opened:
        try:
            return {state.lower() for (state,) in opened.execute("select state from trials")}
        except sqlite3.OperationalError:  # no tables yet
            return set()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--algo", "a2c"], r"--algo: invalid choice: 'a2c'"),
        (["--tier", "hard"], r"--tier: invalid choice: 'hard'"),
        (["--storage", "study.db"], r"storage must be a database's URL such as sqlite:///study.db.*, got 'study.db'"),
        (["--storage", "mongo://x"], r"storage must be"),
        (["--storage", "sqlite://"], r"which is in memory"),
        (["--storage", "sqlite:////no/such/folder/study.db"], r"folder that exists, got 'sqlite:////no/such/folder"),
        (["--storage", "postgresql+pg8000://me:secret@here/db"], r"needs its database's driver"),
        (["--trials", "0"], r"trials must be a whole number in \[1, \d+\], got 0"),
        (["--workers", "-1"], r"workers must be a whole number in \[1, 256\], got -1"),
        (["--evaluations", "513"], r"evaluations must be a whole number in \[1, 512\], got 513"),
        (["--pruner", "rose"], r"pruner must be one of 'median', 'hyperband', 'none', got 'rose'"),
        (["--seed", "-1"], r"seed must be a whole number in \[0, 4294967295\], got -1"),
        (["--timesteps", "0"], r"timesteps must be a whole number"),
        (["--study", " "], r"study must be a name of 1 to 200 characters"),
        (["--top", "0"], r"--top must be at least 1, got 0"),
        (["--set", "gama=1"], r"ppo has no hyperparameter 'gama'"),
        (["--hyperparameters", "nowhere.yml"], r"hyperparameters cannot be read from 'nowhere.yml'"),
        (["--out", "/no/such/folder/best.yml"], r"out must be a file in a folder that exists"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(more, said, storage, tmp_path, capsys):
    assert main(["tune", *command(storage, "--trials", "1", *more)]) == 2
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 1
    assert re.search(said, errors)
    assert "secret" not in errors
    assert not list(tmp_path.iterdir())


def test_files_of_others_are_left_alone(storage, tmp_path, capsys):
    mine = tmp_path / "mine.yml"
    mine.write_text("precious: 1\n")
    (tmp_path / "study.db").write_text("no database, " * 100)
    for more, said in ((["--out", str(mine)], "was not written by this program"), ([], "file is not a database")):
        assert main(["tune", *command(storage, "--trials", "1", *more)]) == 2
        errors = capsys.readouterr().err
        assert len(errors.splitlines()) == 1
        assert said in errors
    assert mine.read_text() == "precious: 1\n"
    assert (tmp_path / "study.db").read_text() == "no database, " * 100


@pytest.mark.parametrize("what", ["hyperparameters", "best", "value"])
def test_a_trial_changed_since_it_ended_is_refused_by_name(what, storage, monkeypatch):
    scripted(monkeypatch, [-100.0, -50.0], [-80.0, -70.0])
    search = tiny_search()
    study_of(search, storage, 2)
    with sqlite3.connect(storage.removeprefix("sqlite:///")) as database:
        if what == "value":
            changed = database.execute("UPDATE trial_values SET value = value + 1 WHERE trial_id = 2")
        else:
            where = "WHERE key = ? AND trial_id = 2"
            edited = "UPDATE trial_user_attributes SET value_json = replace(value_json, '0', '1') "
            changed = database.execute(edited + where, (what,))
        assert changed.rowcount == 1
    database.close()
    with pytest.raises(tuning.StudyError, match="trial 1 of study 'study' is damaged, or changed since it ended"):
        tuning.open_study(search, storage, "study")
