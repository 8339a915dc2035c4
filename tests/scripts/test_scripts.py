"""What the README tells people to run, as they would run it, on tiny budgets."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from sd_friction_env import Table

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def script(name, *arguments, code=0, cwd=ROOT):
    command = [sys.executable, str(ROOT / "scripts" / name), *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "100"}
    run = subprocess.run(command, check=False, cwd=cwd, capture_output=True, text=True, timeout=300, env=environment)
    assert run.returncode == code, run.stderr
    return run


def test_the_demo_trains_compares_and_draws(tmp_path):
    out = tmp_path / "demo"
    run = script("demo.py", "--out", out, "--timesteps", 2000)
    for name in ("figure_3.png", "figure_3_controlled.png", "before_and_after.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    table = Table.from_csv(out / "comparison.csv")
    assert table["controller"].tolist() == [
        f"{task}: {name}"
        for task, best in (("force", "linear state feedback"), ("belt", "threshold follower"))
        for name in ("passive", f"{best}, tuned", "PPO")
    ]
    assert table["score"][0] == 0.0
    assert table["score"][1] > 0.98  # linear feedback by force is near the optimum
    assert "suppressed" in run.stdout
    assert "steps/s" in run.stderr  # progress is shown


@pytest.mark.parametrize("number", [2, 3, 4, 5])
def test_a_figure_script_writes_its_picture_and_the_committed_table(number, tmp_path):
    script("figures", f"figure_{number}", "--out", tmp_path)
    assert (tmp_path / f"figure_{number}.png").stat().st_size > 20_000
    now, kept = (Table.from_csv(folder / f"figure_{number}.csv") for folder in (tmp_path, ROOT / "figures"))
    assert now.n_rows > 100
    assert "failed" not in now["kind"]
    assert {"sd_friction_env", "commit", "parameters 1"} <= set(now.metadata)
    assert list(now) == list(kept)
    for name in now:
        if now[name].dtype.kind == "f":
            assert now[name] == pytest.approx(kept[name], rel=1e-6, abs=1e-9, nan_ok=True), name
        elif name != "note":
            assert now[name].tolist() == kept[name].tolist(), name


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    run = script("figures", "figure_3", "--out", blocked / "below", code=1)
    assert len(run.stderr.splitlines()) == 1
    assert "cannot write into --out" in run.stderr


def test_the_numbers_that_verify_prints_are_within_their_bounds():
    assert "all within bounds" in script("verify.py").stdout


@pytest.mark.parametrize("block", re.findall(r"```python\n(.*?)```", README, re.S))
def test_the_readmes_python_runs_as_printed(block, tmp_path):
    subprocess.run(
        [sys.executable, "-W", "error", "-c", block], cwd=tmp_path, check=True, capture_output=True, timeout=120
    )


@pytest.mark.slow
def test_the_readmes_analysis_commands_run_as_printed(tmp_path):
    commands = re.findall(r"^    sd-friction (?!train|evaluate|export)(.*)$", README, re.M)
    assert len(commands) >= 4
    assert "explore" in commands  # test_explorer.py runs it
    for command in commands:
        if command == "explore":
            continue
        arguments = [sys.executable, "-m", "sd_friction_env", *command.split()]
        subprocess.run(arguments, cwd=tmp_path, check=True, capture_output=True, timeout=120)
    assert {"curve.csv", "curve.png", "basins.png", "suppressed.gif"} <= set(os.listdir(tmp_path))


def test_the_readmes_training_runs_as_printed_but_shorter(tmp_path):
    """Training, then what uses what was trained."""
    commands = re.findall(r"^    sd-friction (train|evaluate|export) (.+)$", README, re.M)
    shorter = {"train": ["--timesteps", "4096", "--no-progress"], "evaluate": ["--episodes", "2"], "export": []}
    assert {name for name, _ in commands} == set(shorter)
    for name, arguments in commands:
        script(f"{name}.py", *arguments.replace("runs/", f"{tmp_path}/").split(), *shorter[name], cwd=tmp_path)
    assert {"belt", "agent.onnx"} <= set(os.listdir(tmp_path))


def test_the_readmes_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert set(re.findall(r"(?:`|^    )make ([a-z]+)", README, re.M)) <= targets


def test_the_readme_is_short():
    assert len(README.splitlines()) < 120


def test_the_files_that_the_readme_links_to_exist():
    places = [place for place in re.findall(r"\]\(([^)#]+)", README) if not place.startswith("https://")]
    assert len(places) > 10
    assert [place for place in places if not (ROOT / place).is_file()] == []
