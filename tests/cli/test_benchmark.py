"""``sd-friction benchmark``: a stranger's controller entered, verified and ranked; nothing is lost or overwritten."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from sd_friction_env.cli.main import main
from sd_friction_env.learning import protocol
from sd_friction_env.storage import AGENTS, read_json

ROOT = Path(__file__).resolve().parents[2]
POLICY = '''
import numpy as np


class Mine:
    """Velocity feedback on the observation."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.clip(-1.5 * observation[:, 1:2], -1.0, 1.0), state


def strong(env):
    """Return a stronger one, for a force alone."""
    if env.task.actuator != "force" or env.task.sensor != "state":
        raise ValueError("it needs a force and the velocity")
    made = Mine()
    made.predict = lambda observation, *_, **__: (np.clip(-9.0 * observation[:, 1:2], -1.0, 1.0), None)
    return made


class Nan(Mine):
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 1), np.nan), state


ready, nothing = Mine(), 3
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return the name of a module with policies in the current folder."""
    name = f"policies_of_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield name
    sys.modules.pop(name, None)


def run(*arguments):
    return main(["benchmark", "run", *arguments])


FORCE = ["--task", "force", "--tier", "nominal", "randomised"]


def test_a_strangers_policy_is_run_verified_and_ranked(mine, tmp_path, capsys):
    assert run("--policy", f"{mine}:Mine", "--name", "mine", "--out", "a.json", *FORCE) == 0
    assert run("--policy", f"{mine}:strong", "--name", "strong", "--knows", "the force", "--out", "b.json") == 0
    said = capsys.readouterr()
    assert said.out.count("100 of 100 episodes suppressed") == 4
    assert "SDFriction/BeltSpeed-v0 is left out: it needs a force and the velocity" in said.err
    for path in ("a.json", "b.json"):
        assert main(["benchmark", "verify", path, "--episodes", "10"]) == 0
    assert "SDFriction/Force-v0: no differences in 10 episodes" in capsys.readouterr().out
    assert main(["benchmark", "verify", "a.json", "--tier", "randomised", "--episodes", "1"]) == 0
    assert capsys.readouterr().out == "SDFriction/ForceRandomised-v0: no differences in 1 episodes\n"
    assert main(["benchmark", "verify", "a.json", "--tier", "blind"]) == 2
    assert "'a.json' has no results for --task and --tier; it has SDFriction/Force-v0, " in capsys.readouterr().err
    assert main(["benchmark", "verify", "a.json", "--policy", f"{mine}:strong"]) == 1
    said = capsys.readouterr()
    assert "SDFriction/Force-v0: 101 differences in 100 episodes\n  seed 1000000: -" in said.out
    assert f"'a.json' is not what '{mine}:strong' reaches on SDFriction/Force-v0" in said.err
    assert main(["benchmark", "verify", "a.json", "--policy", f"{mine}:strong", "--allow", "101"]) == 0
    capsys.readouterr()
    assert main(["benchmark", "table", "a.json", "b.json", "--tier", "nominal", "--format", "csv"]) == 0
    header, first, second = capsys.readouterr().out.splitlines()
    assert header.startswith("block,environment,entry,knows,score,score_low,score_high,")
    assert first.startswith("knows the plant,SDFriction/Force-v0,strong,the force,0.9")
    assert second.startswith("does not know the plant,SDFriction/Force-v0,mine,-,0.9")
    assert main(["benchmark", "table", "a.json", "b.json"]) == 0
    assert capsys.readouterr().out.count("###") == 2


def test_the_commands_of_the_page_run_on_the_policy_that_it_shows(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "howto" / "benchmark.md").read_text(encoding="utf-8")
    (tmp_path / "mine.py").write_text(page.partition("```python\n")[2].partition("```")[0])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    entries = " ".join(map(str, (AGENTS / "entries").glob("*.json")))
    commands = re.findall("^sd-friction (benchmark .*mine.*)$", page, re.M)
    assert [command.split()[1] for command in commands] == ["run", "verify", "table", "off-nominal"]
    for command in commands[:3]:
        assert main(shlex.split(command.replace("agents/entries/*.json", entries))) == 0
    sys.modules.pop("mine")
    assert "| SDFriction/Force-v0 | my feedback | - | 0.9" in capsys.readouterr().out


def test_an_interrupted_run_goes_on_where_it_was(mine, monkeypatch, capsys):
    command = ["--policy", f"{mine}:ready", "--name", "mine", "--out", "a.json", *FORCE]
    measure, calls = protocol.measure, []

    def interrupted(policy, name, env_id, progress):
        calls.append(env_id)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return measure(policy, name, env_id, progress)

    monkeypatch.setattr(protocol, "measure", interrupted)
    assert run(*command) == 130
    assert "kept in --out: the same command goes on" in capsys.readouterr().err
    before = read_json("a.json")["environments"]
    assert list(before) == ["SDFriction/Force-v0"]
    assert main(["benchmark", "verify", "a.json", "--episodes", "2"]) == 0
    assert run(*command) == 0
    assert calls == ["SDFriction/Force-v0", *["SDFriction/ForceRandomised-v0"] * 2]
    assert read_json("a.json")["environments"]["SDFriction/Force-v0"] == before["SDFriction/Force-v0"]
    assert run(*command) == 0
    assert len(calls) == 3
    assert "a.json is complete: SDFriction/Force-v0, SDFriction/ForceRandomised-v0" in capsys.readouterr().out


def test_nothing_is_overwritten_without_being_asked(mine, tmp_path, capsys):
    one = [*FORCE[:3], "nominal"]
    assert run("--policy", "passive", "--name", "mine", "--out", "a.json", *one) == 0
    (tmp_path / "notes.json").write_text("[1, 2]")
    kept = {name: (tmp_path / name).read_bytes() for name in ("a.json", "notes.json")}
    other = ["--policy", f"{mine}:Mine", "--name", "mine"]
    for name in kept:
        assert run(*other, "--out", name, *one) == 2
        said = capsys.readouterr().err
        assert "--out is not overwritten without --overwrite" in said
        assert name in said
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    assert run(*other, "--out", "a.json", "--overwrite", *one) == 0
    assert read_json("a.json")["policy"] == f"{mine}:Mine"


def test_tampering_is_found(mine, tmp_path, capsys):
    assert run("--policy", f"{mine}:Mine", "--name", "mine", "--out", "a.json", *FORCE) == 0
    content = json.loads((tmp_path / "a.json").read_text())
    content["environments"]["SDFriction/Force-v0"]["returns"][7] += 5.0
    (tmp_path / "a.json").write_text(json.dumps(content))
    for command in (["verify", "a.json"], ["table", "a.json"]):
        assert main(["benchmark", *command]) == 2
        assert "'a.json': damaged, or changed since it was written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--policy", "MODULE:Nan"], "policy 'x' on SDFriction/Force-v0 must return actions in [-1, 1], got nan"),
        (["--policy", "MODULE:Gone"], "has no attribute 'Gone'"),
        (["--policy", "no_such_module:Gone"], "No module named 'no_such_module'"),
        (["--policy", "MODULE:nothing"], "must be or make a policy with a method predict, got 3"),
        (["--policy", "nonsense"], "pretrained, classical, velocity-feedback"),
        (["--policy", "no.npz"], "no policy file 'no.npz'"),
        (["--policy", "no.onnx"], "'no.onnx' is no agent of sd-friction export"),
        (["--policy", "passive", "--tier", "wild"], "'wild' (choose from"),
        (["--policy", "passive", "--out", "x.txt"], "--out must end in .json, got 'x.txt'"),
        (["--policy", "passive", "--name", "a|b"], "name must be one line of text without '|', got 'a|b'"),
        (
            ["--policy", "MODULE:Mine", "--tier", "sensed"],
            "actions of shape (100, 1) for 100 observations, got (100, 0)",
        ),
    ],
)
def test_what_cannot_be_run_is_refused_by_name_and_nothing_is_written(mine, tmp_path, capsys, arguments, said):
    given = [argument.replace("MODULE", mine) for argument in arguments]
    assert run("--name", "x", "--out", "x.json", *given) == 2
    error = capsys.readouterr().err
    assert said in error
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".json"] == []


def test_off_nominal_prints_a_line_for_each_plant(capsys):
    assert main(["benchmark", "off-nominal", "--policy", "passive@wild"]) == 2
    assert "excited, got 'passive@wild'" in capsys.readouterr().err
    assert main(["benchmark", "off-nominal", "--episodes", "0"]) == 2
    assert "--episodes must be in [1, 100], got 0" in capsys.readouterr().err


ENTRIES = sorted((AGENTS / "entries").glob("*.json"))
# The look-aheads simulate the plant at every step: of them one episode, and in the slow tests the others.
QUICK = {"rollout": ["1"], "ensemble-rollout": ["1", "--tier", "blind"]}
PARTS = [(path, QUICK.get(path.stem, ["20"])) for path in ENTRIES]
PARTS += [pytest.param(path, ["20"], marks=pytest.mark.slow) for path in ENTRIES if path.stem in QUICK]


@pytest.mark.parametrize(("path", "part"), PARTS, ids=lambda value: getattr(value, "stem", None))
def test_the_entries_of_the_package_are_what_their_controllers_reach(path, part):
    assert main(["benchmark", "verify", str(path), "--episodes", *part]) == 0
    assert path.stat().st_size < 15_000
