"""Training that is stopped or killed goes on from its last checkpoint as if nothing had happened."""

import dataclasses
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sd_friction_env import Table, storage
from sd_friction_env.cli.main import main
from sd_friction_env.learning import checkpoints, runs, tensors, training
from sd_friction_env.learning.plan import make_plan

ROOT = Path(__file__).parents[2]
FORCE, SENSED = "SDFriction/Force-v0", "SDFriction/BeltSpeedSensed-v0"
OFF_POLICY = {"learning_starts": 40, "buffer_size": 240, "batch_size": 16, "gradient_steps": 2}
OVERRIDES = {
    "ppo": {"n_steps": 16, "n_epochs": 2, "policy_kwargs": "dict(net_arch=[8])"},
    "sac": OFF_POLICY | {"policy_kwargs": "dict(net_arch=[8])"},
    "td3": OFF_POLICY | {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.2},
}


def tiny_plan(algorithm="ppo", env_id=FORCE, **changes):
    arguments = {"timesteps": 600, "envs": 4, "eval_freq": 128, "eval_episodes": 2, "seed": 7} | changes
    overrides = OVERRIDES[algorithm] | arguments.pop("overrides", {})
    return make_plan(env_id, algorithm, env_kwargs={"episode_steps": 40}, overrides=overrides, **arguments)


def stop_after(calls):
    counter = itertools.count(1)
    return lambda: next(counter) >= calls


def stopped(folder, plan=None, after=60, **arguments):
    with pytest.raises(training.StoppedError):
        training.train(plan or tiny_plan(), folder, progress=False, should_stop=stop_after(after), **arguments)
    return runs.partial_folder(folder)


class CrashError(Exception):
    pass


def crash_at(steps):
    def on_evaluation(row):
        if row["steps"] >= steps:
            raise CrashError

    return on_evaluation


def content(folder):
    """All that a finished run holds but for wall times and versions, comparable with ==."""

    def plain(value):
        if isinstance(value, torch.Tensor):
            return (str(value.dtype), value.tolist())
        if isinstance(value, dict):
            return {name: plain(part) for name, part in value.items() if name not in ("seconds", "t")}
        return [plain(part) for part in value] if isinstance(value, list | tuple) else value

    config = runs.load_config(folder)
    table = Table.from_csv(folder / "evaluations.csv")
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    scalars = {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
        if tag not in ("time/fps", "eval/seconds")
    }
    return {
        "checkpoint": plain(tensors.load_tensors(runs.checkpoints(folder)[0])),
        "best": plain(tensors.load_tensors(folder / "policy.pt")),
        "table": {name: values.tolist() for name, values in table.items() if name != "seconds"},
        "steps": config["steps"],
        "scalars": scalars,
        "files": sorted(path.name for path in folder.iterdir()),
    }


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What the tiny plan comes to when nothing interrupts it."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    training.train(tiny_plan(), folder, progress=False)
    return content(folder)


# As if nothing had happened -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [("ppo", SENSED), ("sac", "SDFriction/ForceRandomised-v0"), ("td3", FORCE)],
)
def test_a_run_stopped_and_crashed_ends_as_one_that_was_not(algorithm, env_id, tmp_path):
    plan = tiny_plan(algorithm, env_id)
    rows = []
    training.train(plan, tmp_path / "whole", progress=False, on_evaluation=rows.append)
    stopped(tmp_path / "cut", plan, after=30)
    with pytest.raises(CrashError):
        training.train(plan, tmp_path / "cut", resume=True, progress=False, on_evaluation=crash_at(380))
    result = training.train(plan, tmp_path / "cut", resume=True, progress=False)
    expected, got = content(tmp_path / "whole"), content(tmp_path / "cut")
    for part in expected:
        assert got[part] == expected[part], part
    assert len(rows) == len(result.evaluations["steps"]) == 5
    assert [row["mean_return"] for row in rows] == result.evaluations["mean_return"].tolist()
    resumed = [entry["steps"] for entry in runs.load_config(tmp_path / "cut")["resumed"]]
    assert len(resumed) == 2
    assert 0 < resumed[0] < resumed[1] < 380
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut", "whole"]


def test_how_often_checkpoints_are_taken_changes_nothing(whole, tmp_path):
    training.train(tiny_plan(), tmp_path / "run", checkpoint_freq=64, progress=False)
    assert content(tmp_path / "run") == whole
    assert runs.load_config(tmp_path / "run")["checkpoint_freq"] == 64


def test_a_callback_on_evaluations_is_told_every_row_and_may_end_the_training(tmp_path):
    with pytest.raises(CrashError):
        training.train(tiny_plan(), tmp_path / "run", progress=False, on_evaluation=crash_at(256))
    table = Table.from_csv(tmp_path / "run.partial" / "evaluations.csv")
    assert table["steps"].tolist() == [128.0, 256.0]


def test_what_came_after_the_checkpoint_is_forgotten(tmp_path):
    with pytest.raises(CrashError):
        training.train(tiny_plan(), tmp_path / "run", progress=False, on_evaluation=crash_at(256))
    counter = stop_after(1)
    with pytest.raises(training.StoppedError):
        training.train(tiny_plan(), tmp_path / "run", resume=True, progress=False, should_stop=counter)
    table = Table.from_csv(tmp_path / "run.partial" / "evaluations.csv")
    assert table["steps"].tolist() == [128.0]  # and not the one of the crash


def test_a_run_killed_before_its_first_checkpoint_begins_anew(whole, tmp_path):
    with pytest.raises(CrashError):
        training.train(tiny_plan(), tmp_path / "run", progress=False, on_evaluation=crash_at(1))
    assert runs.checkpoints(tmp_path / "run.partial") == []
    training.train(tiny_plan(), tmp_path / "run", resume=True, progress=False)
    assert content(tmp_path / "run") == whole


def test_a_replay_buffer_is_written_as_far_as_it_is_filled_and_not_after_the_end(tmp_path):
    plan = tiny_plan("sac", overrides={"buffer_size": 10**7})
    partial = stopped(tmp_path / "run", plan)
    checkpoint, _ = runs.checkpoints(partial)
    saved = tensors.load_tensors(checkpoint)
    assert len(saved["replay"]["arrays"]["actions"]) == saved["steps"] // 4
    assert checkpoint.stat().st_size < 500_000
    (partial / "checkpoints" / ".step_000000000999.pt.1.partial").write_bytes(b"half")
    training.train(plan, tmp_path / "run", resume=True, progress=False)
    (checkpoint,) = (tmp_path / "run" / "checkpoints").iterdir()
    assert tensors.load_tensors(checkpoint)["replay"] is None


# kill -9 --------------------------------------------------------------------------------------------------------------

# Trains in processes of their own, each of which kills itself just before its n-th change of the file system.
KILLER = """
import os, signal, sys
from pathlib import Path
import torch
from sd_friction_env.learning import runs, training
from tests.learning.test_runs import tiny_plan

def attempt(folder, last, resume):
    child = os.fork()
    if child == 0:
        count = 0
        def counted(function):
            def wrapped(*arguments, **keywords):
                nonlocal count
                count += 1
                if count == last:
                    os.kill(os.getpid(), signal.SIGKILL)
                return function(*arguments, **keywords)
            return wrapped
        for name in ("replace", "unlink", "mkdir", "rmdir"):
            setattr(os, name, counted(getattr(os, name)))
        try:
            training.train(tiny_plan(timesteps=384), folder, resume=resume, force=not resume, progress=False)
        except BaseException:
            import traceback
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

torch.set_num_threads(1)
base, mode = Path(sys.argv[1]), sys.argv[2]
folder = base / "run"
if mode == "chain":  # the same run is killed again and again, a little later every time
    last, kills = 5, 0
    while attempt(folder, last, runs.partial_folder(folder).is_dir()) == -signal.SIGKILL and last < 200:
        last, kills = last + 4, kills + 1
    print(kills)
else:  # a run is killed once, at every place there is
    expected = None
    for last in range(1, 200):
        folder = base / str(last)
        code = attempt(folder, last, False)
        if code == 0:
            break
        assert code == -signal.SIGKILL, (last, code)
        code = 0 if folder.is_dir() else attempt(folder, 0, runs.partial_folder(folder).is_dir())
        assert code == 0, (last, code)
    print(last)
"""


def killer(base, mode):
    done = subprocess.run(
        [sys.executable, "-c", KILLER, str(base), mode],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that can be forked and killed")
@pytest.mark.slow
def test_a_run_killed_again_and_again_ends_as_one_that_was_not(tmp_path):
    training.train(tiny_plan(timesteps=384), tmp_path / "whole", progress=False)
    assert killer(tmp_path, "chain") >= 4
    assert content(tmp_path / "run") == content(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that can be forked and killed")
def test_a_run_killed_before_any_change_of_the_file_system_can_be_resumed(tmp_path):
    training.train(tiny_plan(timesteps=384), tmp_path / "whole", progress=False)
    places = killer(tmp_path, "each")
    assert places > 25
    expected = content(tmp_path / "whole")
    for last in range(1, places + 1):
        assert content(tmp_path / str(last)) == expected, last


def command(folder, *more):
    settings = [f"--set={name}={value}" for name, value in OVERRIDES["ppo"].items()]
    size = ["--timesteps", "600", "--envs", "4", "--eval-freq", "128", "--eval-episodes", "2", "--seed", "7"]
    what = ["--task", "force", "--algo", "ppo", "--env-arg", "episode_steps=40", "--run-folder", str(folder)]
    return [*what, *size, *settings, "--no-progress", *more]


def test_the_program_killed_with_signal_9_is_resumed_by_its_folder_alone(tmp_path, capsys):
    size = ["--timesteps", "4000", "--checkpoint-freq", "64"]
    program = [sys.executable, "-W", "error", "scripts/train.py", *command(tmp_path / "run", *size)]
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not (tmp_path / "run.partial" / "evaluations.csv").exists():
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait(60) == -signal.SIGKILL
    assert main(["train", "--run-folder", str(tmp_path / "run"), "--resume", "--no-progress"]) == 0
    assert "4,000 steps" in capsys.readouterr().out
    training.train(tiny_plan(timesteps=4000), tmp_path / "whole", progress=False)
    assert content(tmp_path / "run") == content(tmp_path / "whole")
    assert runs.load_config(tmp_path / "run")["checkpoint_freq"] == 64


# The command line -----------------------------------------------------------------------------------------------------


def refused(capsys, *arguments):
    assert main(["train", *list(arguments)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_the_same_command_with_resume_begins_goes_on_and_says_when_it_is_finished(whole, tmp_path, capsys):
    folder = tmp_path / "run"
    assert "--run-folder" in refused(capsys, "--resume")
    assert "there is nothing to resume" in refused(capsys, "--resume", "--run-folder", str(folder))
    assert list(tmp_path.iterdir()) == []
    stopped(folder)
    assert "unfinished run" in refused(capsys, *command(folder))
    assert main(["train", *command(folder, "--resume")]) == 0
    assert "Resuming ppo on SDFriction/Force-v0: 600 steps, seed 7" in capsys.readouterr().out
    assert content(folder) == whole
    before = files(folder)
    for again in (command(folder), ["--run-folder", str(folder)]):
        assert main(["train", *again, "--resume"]) == 0
        assert "is finished: there is nothing to resume" in capsys.readouterr().out
    with pytest.raises(runs.RunFolderError, match="is finished"):
        training.train(tiny_plan(), folder, resume=True, progress=False)
    assert files(folder) == before
    assert main(["train", *command(tmp_path / "other", "--resume")]) == 0  # nothing there yet: it begins
    assert content(tmp_path / "other") == whole


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--seed", "8"], "seed is 7 there and 8 here"),
        (["--timesteps", "700"], "hyperparameters.n_timesteps is 600 there and 700 here"),
        (["--algo", "sac"], "algorithm is 'ppo' there and 'sac' here"),
        (["--task", "belt"], "environment.id is 'SDFriction/Force-v0' there and 'SDFriction/BeltSpeed-v0' here"),
        (["--env-arg", "w_effort=0.2"], "environment.kwargs.w_effort is not given there and 0.2 here"),
        (["--eval-episodes", "3"], "evaluation.episodes is 2 there and 3 here"),
        (["--set", "gamma=0.5"], "hyperparameters.gamma is"),
    ],
)
def test_a_run_is_not_resumed_with_another_configuration(change, message, tmp_path, capsys):
    partial = stopped(tmp_path / "run", after=1)
    before = files(partial)
    words = command(tmp_path / "run", "--resume")
    if change[0] == "--algo":
        words = [word for word in words if not word.startswith("--set")]
    assert message in refused(capsys, *words, *change)
    assert files(partial) == before


def test_part_of_a_command_is_not_enough_to_resume(tmp_path, capsys):
    stopped(tmp_path / "run", after=1)
    assert "--algo" in refused(capsys, "--resume", "--run-folder", str(tmp_path / "run"), "--seed", "7")


# Damage ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_checkpoints(tmp_path_factory):
    """A run that was stopped after two checkpoints, to be copied."""
    return stopped(tmp_path_factory.mktemp("two") / "run")


@pytest.fixture
def partial(two_checkpoints, tmp_path):
    return Path(shutil.copytree(two_checkpoints, tmp_path / "run.partial"))


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[place // 8] ^= 1 << place % 8
    path.write_bytes(data)


def cut_short(path, length):
    path.write_bytes(path.read_bytes()[:length])


def resealed(path, saved):
    tensors.save_tensors(path, saved)


DAMAGES = {
    "empty": lambda path: cut_short(path, 0),
    "half": lambda path: cut_short(path, path.stat().st_size // 2),
    "no digest": lambda path: cut_short(path, path.stat().st_size - 71),
    "one bit": lambda path: flip(path, 4 * path.stat().st_size),
    "one bit of the digest": lambda path: flip(path, 8 * path.stat().st_size - 100),
    "one bit of its mark": lambda path: flip(path, 8 * path.stat().st_size - 8 * 70),
    "pickle": lambda path: torch.save({"format": 1, "path": Path(".")}, path),
    "sealed pickle": lambda path: resealed(path, {"format": 2, "path": Path(".")}),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "an endless device": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes and devices in the file system")
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_its_predecessor_is_resumed_from(damage, partial):
    last, before = runs.checkpoints(partial)
    DAMAGES[damage](last)
    with pytest.warns(UserWarning, match=rf"{last.name}.*resumed from .*{before.name}"):
        path, saved = checkpoints.last_whole_checkpoint([last, before])
    assert (path, saved["steps"]) == (before, 128)
    DAMAGES[damage](before)
    with pytest.raises(runs.RunFolderError, match=rf"no checkpoint can be used .*{last.name}.*{before.name}.*--force"):
        checkpoints.last_whole_checkpoint([last, before])


def test_no_flipped_bit_and_no_cut_of_a_checkpoint_goes_unnoticed(partial):
    path = runs.checkpoints(partial)[0]
    good, rng = path.read_bytes(), np.random.default_rng(0)
    places = rng.choice(8 * len(good), 100, replace=False).tolist()
    for place in places:
        flip(path, place)
        with pytest.raises(storage.StoredFileError, match=path.name):
            tensors.load_tensors(path, sealed=True)
        path.write_bytes(good)
    for length in rng.choice(len(good), 20, replace=False).tolist():
        cut_short(path, length)
        with pytest.raises(storage.StoredFileError, match=path.name):
            tensors.load_tensors(path, sealed=True)
        path.write_bytes(good)
    assert tensors.load_tensors(path, sealed=True)["steps"] == 256


@pytest.mark.filterwarnings("always")
def test_a_run_resumed_from_the_predecessor_ends_as_one_that_was_not_damaged(whole, partial, tmp_path, capsys):
    last, before = runs.checkpoints(partial)
    flip(last, 5000)
    assert main(["train", "--run-folder", str(tmp_path / "run"), "--resume", "--no-progress"]) == 0
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert last.name in error
    assert before.name in error
    assert content(tmp_path / "run") == whole
    assert runs.load_config(tmp_path / "run")["resumed"][0]["steps"] == 128


def other_plan(partial):
    for path, other in zip(runs.checkpoints(partial), ("a", "b"), strict=True):
        saved = tensors.load_tensors(path)
        resealed(path, saved | {"plan": other})


def other_shapes(partial):
    saved = tensors.load_tensors(runs.checkpoints(partial)[0])
    saved["environments"]["state"] = saved["environments"]["state"][:, :2]
    resealed(runs.checkpoints(partial)[0], saved)


def other_format(partial):
    resealed(runs.checkpoints(partial)[0], {"format": 1})


def other_runs_checkpoint(partial):
    """That of a run of the same shapes and another seed."""
    folder = partial.parent.parent / f"{partial.parent.name}-other"
    other = stopped(folder / "run", tiny_plan(seed=8), after=20)
    shutil.copy(runs.checkpoints(other)[0], runs.checkpoints(partial)[0])


def edited_config(partial):
    text = (partial / "config.json").read_text()
    (partial / "config.json").write_text(text.replace('"seed": 7', '"seed": 8'))


def edited_and_resealed_config(partial):
    config = storage.read_json(partial / "config.json")
    storage.write_json(partial / "config.json", {**config, "hyperparameters": {"gamma": 7}})


def other_runs_config(partial):
    config = storage.read_json(partial / "config.json")
    storage.write_json(partial / "config.json", {**config, "seed": 8})


def all_damaged(partial):
    for path in runs.checkpoints(partial):
        flip(path, 1000)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (other_plan, "damaged or of another run: it was written with another configuration"),
        (other_shapes, "damaged or of another run"),
        (other_format, "has format 1"),
        (other_runs_checkpoint, "damaged or of another run: it was written with another configuration"),
        (edited_config, "config.json': damaged, or changed since it was written"),
        (edited_and_resealed_config, "gamma must be a finite number in [0, 1], got 7"),
        (other_runs_config, "damaged or of another run: it was written with another configuration"),
        (all_damaged, "no checkpoint can be used"),
    ],
)
def test_what_cannot_be_resumed_is_one_clear_error_and_nothing_is_written(damage, message, partial, tmp_path, capsys):
    damage(partial)
    before = files(partial)
    assert message in refused(capsys, "--run-folder", str(tmp_path / "run"), "--resume")
    assert files(partial) == before
    assert [path.name for path in tmp_path.iterdir()] == ["run.partial"]


# Writes fail from a checkpoint on as on a full disk: the files written until then stay, later ones hit the limit.
FULL = """
import errno, resource, sys
from sd_friction_env.learning import checkpoints, runs

save, count = checkpoints.save_tensors, 0

def limited(path, content):
    global count
    if path.parent.name == runs.CHECKPOINTS:
        count += 1
        if count == 2:
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
    save(path, content)

checkpoints.save_tensors = limited
from sd_friction_env.cli.main import main
sys.exit(main(["train", *sys.argv[2:]]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@pytest.mark.parametrize("room", [0, 3000, pytest.param(10000, marks=pytest.mark.slow)])
def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(whole, room, tmp_path, capsys):
    words = [sys.executable, "-c", FULL, str(room), *command(tmp_path / "run")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1, done.stderr
    assert "sd-friction train: the run cannot be written" in done.stderr
    assert "--resume" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("\n") == 1
    (checkpoint,) = (tmp_path / "run.partial" / "checkpoints").iterdir()
    assert tensors.load_tensors(checkpoint, sealed=True)["steps"] == 128
    assert main(["train", "--run-folder", str(tmp_path / "run"), "--resume", "--no-progress"]) == 0
    assert content(tmp_path / "run") == whole


# Two at once ----------------------------------------------------------------------------------------------------------


def test_a_second_process_on_one_run_is_refused_by_the_name_of_the_first(partial, tmp_path, capsys):
    before = files(partial)
    holder = (
        "import pathlib, sys\n"
        "from sd_friction_env.learning import runs\n"
        "with runs.only_here(pathlib.Path(sys.argv[1])):\n"
        "    print('held', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    words = [sys.executable, "-c", holder, str(tmp_path / "run")]
    with subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "held\n"
        for more in (["--resume"], command(tmp_path / "run", "--resume"), command(tmp_path / "run", "--force")):
            folder = [] if "--run-folder" in more else ["--run-folder", str(tmp_path / "run")]
            assert f"is in use by process {first.pid} on " in refused(capsys, *folder, *more)
        first.kill()  # what it leaves behind blocks nobody
    assert files(partial) == before
    assert (tmp_path / ".run.lock").exists()
    assert main(["train", "--run-folder", str(tmp_path / "run"), "--resume", "--no-progress"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_training_keeps_its_lock_until_it_ends(tmp_path):
    refusals = []

    def try_another(row):
        with pytest.raises(runs.RunFolderError, match=f"is in use by process {os.getpid()} on ") as refusal:
            training.train(tiny_plan(), tmp_path / "run", resume=True, progress=False)
        refusals.append(refusal)

    training.train(tiny_plan(), tmp_path / "run", progress=False, on_evaluation=try_another)
    assert len(refusals) == 5
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_other_versions_are_a_warning_and_a_line_in_the_record(whole, tmp_path):
    partial = stopped(tmp_path / "run")
    config = json.loads((partial / "config.json").read_text())
    config["versions"]["torch"] = "1.0"
    storage.write_json(partial / "config.json", config)
    with pytest.warns(UserWarning, match=r"torch 1\.0 -> "):
        training.train(tiny_plan(), tmp_path / "run", resume=True, progress=False)
    config = runs.load_config(tmp_path / "run")
    assert config["versions"]["torch"] == "1.0"
    assert config["resumed"][0]["versions"] == training.versions()
    assert content(tmp_path / "run") == whole


def test_a_finished_run_is_replaced_by_a_resumed_one_only_if_forced(whole, tmp_path):
    folder = tmp_path / "run"
    training.train(tiny_plan(seed=1), folder, progress=False)
    before = files(folder)
    stopped(folder, force=True)
    with pytest.raises(runs.RunFolderError, match="resume with --force"):
        training.train(tiny_plan(), folder, resume=True, progress=False)
    assert files(folder) == before
    training.train(tiny_plan(), folder, resume=True, force=True, progress=False)
    assert content(folder) == whole
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_global_random_states_are_taken_up_where_they_were(tmp_path):
    stopped(tmp_path / "run")
    ends = []
    for folder in ("run", "again"):
        training.train(tiny_plan(), tmp_path / folder, resume=folder == "run", progress=False)
        ends.append((np.random.random(), torch.rand(1).item()))  # noqa: NPY002  Stable-Baselines3 draws from it
    assert ends[0] == ends[1]


@pytest.mark.parametrize("folder", sorted(path.name for path in (storage.AGENTS / "pretrained").iterdir()))
def test_the_weights_of_every_shipped_run_can_be_read_and_act_as_its_network(folder):
    run = storage.AGENTS / "pretrained" / folder
    network, policy = dataclasses.replace(runs.load_network(run), frames=1), runs.load_torch_policy(run)
    observation = np.random.default_rng(0).uniform(-1.0, 1.0, (7, network.observation_size)).astype(np.float32)
    action, _ = policy.predict(observation, deterministic=True)
    np.testing.assert_allclose(action, network.predict(observation)[0], atol=1e-5)
