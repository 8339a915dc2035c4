"""The program: commands, outputs, exit codes, and messages in one line."""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sd_friction_env import (
    Table,
    __version__,
    amplitude_curve,
    basin_grid,
    critical_belt_speeds,
    limit_cycle,
)
from sd_friction_env.cli import doctor
from sd_friction_env.cli.main import main
from sd_friction_env.cli.options import numbers, stop_requests
from sd_friction_env.control import pretrained
from sd_friction_env.control.pretrained import pretrained_file
from sd_friction_env.physics.charts import stability_chart
from sd_friction_env.physics.curves import refined_curve
from sd_friction_env.physics.forced import (
    bifurcation_diagram,
    forced_orbit,
    lyapunov_exponent,
    orbit_branches,
    poincare_section,
)
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import load_arrays


def test_the_published_command_writes_a_table_and_a_plot(tmp_path):
    curve, plot = tmp_path / "curve.csv", tmp_path / "curve.png"
    arguments = [
        "amplitude",
        "--alpha",
        "0.2",
        "0.5",
        "0.7",
        "0.8",
        "--belt-speed",
        "0:0.6:0.05",
        "--geometry",
        "cubic",
    ]
    assert main([*arguments, "--out", str(curve), "--plot", str(plot)]) == 0
    table = Table.from_csv(curve)
    assert table.n_rows == 4 * 13
    assert sorted(set(table["alpha"])) == [0.2, 0.5, 0.7, 0.8]
    assert "amplitude --alpha" in table.metadata["command"]
    cycle = limit_cycle(OscillatorParameters(geometry="cubic", alpha=0.7, belt_speed=0.3))
    row = next(r for r in table.rows() if r["alpha"] == 0.7 and r["belt_speed"] == 0.3)
    assert row["amplitude"] == cycle.amplitude
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path)) == ["curve.csv", "curve.png"]


def test_cycle_prints_json_and_text(capsys):
    assert main(["cycle", "--json"]) == 0
    row = json.loads(capsys.readouterr().out)["rows"][0]
    assert row["amplitude"] == limit_cycle(OscillatorParameters()).amplitude
    assert main(["cycle", "--belt-speed", "0.45"]) == 0
    assert "steady-slip" in capsys.readouterr().out


def test_critical_gives_a_reason_where_there_is_no_number(capsys):
    assert main(["critical", "--mu-m", "0.05", "0.2", "--json"]) == 0
    good, none = json.loads(capsys.readouterr().out)["rows"]
    assert good["hopf"] == "supercritical"
    assert none["v_b0"] is None
    assert "nothing oscillates" in none["reason"]


@pytest.mark.usefixtures("either_way")
def test_simulate_ends_at_t_end_and_loss_of_contact_is_a_failure(tmp_path, capsys):
    assert main(["simulate", "--t-end", "12.5", "--dt", "0.5", "--plot", str(tmp_path / "h.svg")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("12.5,")
    assert main(["simulate", "--geometry", "cubic", "--alpha", "0.2", "--start", "0.1", "3", "--t-end", "5"]) == 1
    assert "contact lost" in capsys.readouterr().err


def test_basins_prints_fractions_and_draws_them(tmp_path, capsys):
    plot = tmp_path / "b.png"
    assert main(["basins", "--alpha", "0.2", "--shape", "40", "30", "--plot", str(plot), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert sum(row["fraction"] for row in rows) == pytest.approx(1.0)
    assert plot.stat().st_size > 5000


@pytest.mark.usefixtures("either_way")
def test_other_laws_are_chosen_and_swept(capsys):
    assert main(["cycle", "--friction", "coulomb", "hyperbolic", "--delta", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["friction"] for row in rows] == ["coulomb", "hyperbolic"]
    assert rows[1]["amplitude"] == limit_cycle(OscillatorParameters(friction="hyperbolic", delta=2.0)).amplitude
    exponential = ["--friction", "exponential", "--geometry", "linear", "--mu-s", "1", "--mu-k", "0.5", "--v-0", "0.5"]
    assert main(["critical", *exponential, "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["v_b1"] == pytest.approx(0.5 * math.log(10.0), abs=1e-9)
    assert row["v_b0"] == pytest.approx(1.8366, abs=1e-4)
    assert row["hopf"] == "subcritical"
    assert main(["cycle", "--force-amplitude", "0.1"]) == 2
    assert "force_amplitude = 0.1" in capsys.readouterr().err


DRIVE = ["--force-amplitude", "0.28", "--force-frequency", "1.2", "--alpha", "0.6"]


def test_a_forced_motion_is_seen_in_its_section_its_exponent_and_its_diagram(tmp_path, capsys):
    parameters = OscillatorParameters(alpha=0.6, force_amplitude=0.28, force_frequency=1.2)
    start = ["--start", "1.15", "0.2"]
    out, plot = tmp_path / "section.csv", tmp_path / "section.png"
    assert main(["poincare", *DRIVE, *start, "--cycles", "40", "--out", str(out), "--plot", str(plot)]) == 0
    assert np.array_equal(Table.from_csv(out)["x"], poincare_section(parameters, 1.15, 0.2, cycles=40)["x"])
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert main(["lyapunov", *DRIVE, *start, "--cycles", "400", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["largest"] == lyapunov_exponent(parameters, 1.15, 0.2, cycles=400).largest > 0.0
    assert main(["lyapunov", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["largest"] is None  # minus infinity: it sticks
    out, plot = tmp_path / "diagram.csv", tmp_path / "diagram.png"
    over = ["--over", "force-amplitude", "0.1", "0.2", "0.3", "--cycles", "20", "--direction", "both"]
    command = ["bifurcation", *DRIVE[2:], *over, "--out", str(out), "--plot", str(plot)]
    assert main([*command, "--folder", str(tmp_path / "kept")]) == 0
    table, diagram = Table.from_csv(out), ["force_amplitude", [0.1, 0.2, 0.3]]
    wanted = bifurcation_diagram(parameters, *diagram, direction="both", cycles=20)
    assert np.array_equal(table["x"], wanted["x"])
    assert table["direction"].tolist() == wanted["direction"].tolist()
    assert table["force_amplitude"].tolist() == wanted["value"].tolist()
    assert plot.read_bytes().startswith(b"\x89PNG")
    for bad, said in (
        (["mass", "1"], "name must be one of"),
        (["force-amplitude", "x"], "'x' is no number"),
        (["force-amplitude", "-1"], "force_amplitude must be"),
        (["force-amplitude"], "values must"),
    ):
        assert main(["bifurcation", *DRIVE[2:], "--over", *bad, "--folder", str(tmp_path / "none")]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_chart_is_the_functions(tmp_path, capsys):
    out, plot = tmp_path / "chart.csv", tmp_path / "chart.png"
    command = ["chart", "--geometry", "linear", "--points", "10", "--over"]
    kept = ["--folder", str(tmp_path / "kept"), "--out", str(out), "--plot", str(plot)]
    assert main([*command, "beta", "0.02:0.1", *kept]) == 0
    wanted = stability_chart(OscillatorParameters(geometry="linear"), ("beta", 0.02, 0.1), points=10)
    table = Table.from_csv(out)
    assert np.array_equal(table["belt_speed"], wanted["belt_speed"])
    assert table["kind"].tolist() == wanted["kind"].tolist()
    assert plot.read_bytes().startswith(b"\x89PNG")
    fixed = ["g1", "1.0:1.2", "--against", "beta", "0.05:0.15", "--belt-speed", "0.3"]
    assert main([*command, *fixed, "--out", str(out), "--plot", str(plot)]) == 0
    assert Table.from_csv(out).metadata["against"] == "beta"
    for bad, said in (
        (["beta", "0.1"], "'0.1' must be LOW:HIGH"),
        (["beta", "0.1:0.02"], "low < high"),
        (["mass", "0:1"], "over must be one of"),
        (["beta", "0.02:0.1", "--against", "g1"], "--against must be belt_speed, or NAME LOW:HIGH, got 'g1'"),
        (["beta", "0.02:0.1", "--against", "g1", "1"], "--against g1: '1' must be LOW:HIGH"),
        (["beta", "0.02:0.1", "--against", "beta", "0:1"], "against must be one of"),
        (["beta", "0.02:0.1", "--belt-speed", "0.2"], "an axis of the chart"),
    ):
        assert main([*command, *bad]) == 2
        assert said in capsys.readouterr().err


def test_branches_are_the_functions_and_refused_before_anything_is_computed(tmp_path, capsys):
    out, plot = tmp_path / "branches.csv", tmp_path / "branches.png"
    over, drive = ["--over", "force-amplitude"], ["--force-amplitude", "0.12"]
    kept = ["--folder", str(tmp_path / "kept"), "--out", str(out), "--plot", str(plot)]
    command = ["branches", "--alpha", "0.7", "--points", "20"]
    assert main([*command, *drive, *over, "0.1:0.15", "--doubled", *kept]) == 0
    orbit = forced_orbit(OscillatorParameters(alpha=0.7, force_amplitude=0.12))
    wanted = orbit_branches(orbit, ("force_amplitude", 0.1, 0.15), points=20, doublings=1)
    table = Table.from_csv(out)
    assert list(table) == list(wanted)
    assert set(table["branch"]) == {0, 1}
    assert all(np.array_equal(table[name], wanted[name]) for name in ("x", "force_amplitude", "kind", "reason"))
    assert plot.read_bytes().startswith(b"\x89PNG")
    # A motion that does not settle has a row, too.
    assert main(["branches", "--geometry", "cubic", "--alpha", "0.1", *drive, *over, "0.1:0.15", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert row["kind"] == "none"
    assert "does not settle" in row["reason"]
    for bad, said in (
        ([*drive, *over, "0.1"], "'0.1' must be LOW:HIGH"),
        ([*drive, *over, "0.2:0.3"], "force_amplitude of the start must be"),
        ([*drive, "--over", "mass", "0:1"], "over must be one of"),
        ([*drive, "--over", "ripple-frequency", "0.5:1"], "does not use the parameter 'ripple_frequency'"),
        ([*over, "0:1"], "parameters must be excited"),
        (["--force-amplitude", "0.1", "0.2", *over, "0:1"], "where the branch starts: give one value"),
        ([*drive, *over, "0:1", "--doubled", "11"], "doublings must be"),
        ([*drive, *over, "0:1", "--transient", "-1"], "transient must be"),
        ([*drive, *over, "0:1", "--start", "nan", "0"], "x must be"),
    ):
        assert main(["branches", *bad, "--folder", str(tmp_path / "none")]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("text", "values"),
    [("0.3", [0.3]), ("0:0.6:0.2", [0.0, 0.2, 0.4, 0.6]), ("0.1:0.35:0.1", [0.1, 0.2, 0.3]), ("1:1:1", [1.0])],
)
def test_ranges_hold_both_ends(text, values):
    assert numbers(text) == values


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("amplitude --belt-speed 0.6:0:0.1", "is empty"),
        ("amplitude --belt-speed 0:1", "start:stop:step"),
        ("amplitude --belt-speed fast", "is no number"),
        ("amplitude --belt-speed -0.1:0.2:0.1", "belt_speed"),
        ("amplitude --alpha -1", "alpha must be"),
        ("amplitude --alpha nan", "alpha must be"),
        ("amplitude --out nowhere/curve.csv", "lies in no existing folder"),
        ("amplitude --out curve.txt", "--out must end in .csv or .json, got 'curve.txt'"),
        ("amplitude --out curve", "--out must end in .csv or .json, got 'curve'"),
        ("basins --plot curve.JPG", "--plot must end in .png, .svg or .pdf, got 'curve.JPG'"),
        ("amplitude --start 0 0 --attractors", "exclude each other"),
        ("amplitude --belt-speed 0 --attractors", "belt_speed must be positive"),
        ("cycle --start nan 0", "x must be"),
        ("critical --belt-speed 0.2", "leave it out"),
        ("simulate --alpha 0.5 0.6", "one oscillator is wanted"),
        ("simulate --t-end -1", "t_end must be"),
        ("basins --shape 1 5", "shape"),
        ("basins --x 1 -1", "x_limits must have low < high"),
        ("ampltude", "invalid choice"),
        ("", "required"),
    ],
)
def test_a_bad_argument_is_one_line_and_exit_code_2(arguments, message, capsys):
    try:
        code = main(arguments.split())
    except SystemExit as leaving:
        code = leaving.code
    captured = capsys.readouterr()
    assert code == 2
    assert captured.out == ""
    assert message in captured.err
    assert len(captured.err.splitlines()) == 1


def test_no_attractor_that_can_be_named_is_exit_code_1(capsys):
    assert main(["cycle", "--geometry", "cubic", "--alpha", "0.1", "--belt-speed", "0.39"]) == 1
    assert "loses contact" in capsys.readouterr().err


def test_the_module_runs_as_a_program():
    run = subprocess.run(
        [sys.executable, "-m", "sd_friction_env", "--version"], capture_output=True, text=True, check=True, timeout=60
    )
    assert run.stdout.strip() == f"sd_friction_env {__version__}"
    text = subprocess.run(
        [sys.executable, "-m", "sd_friction_env", "amplitude", "--help"], capture_output=True, text=True, check=True
    ).stdout
    assert "examples:" in text


def test_a_video_shows_the_passive_and_the_controlled_oscillator(tmp_path, capsys):
    imageio = pytest.importorskip("imageio.v3")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    small = ["--steps", "6", "--size", "320", "240", "--every", "2"]
    for name in ("pair.gif", "pair.mp4"):
        command = ["video", "--task", "belt", "--agent", "velocity-feedback", "--gain", "0.5"]
        assert main([*command, "--out", str(tmp_path / name), *small]) == 0
    pictures = imageio.imread(tmp_path / "pair.gif", index=None)
    assert pictures.shape == (4, 240, 2 * 320 + 8, 3)
    left, right = pictures[..., :320, :], pictures[..., -320:, :]
    first = np.abs(left[0].astype(int) - right[0]).mean()  # the titles differ, and nothing else
    assert np.abs(left[-1].astype(int) - right[-1]).mean() > first
    count, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "pair.mp4"))
    assert (count, seconds) == (4, pytest.approx(4 / 30, abs=0.01))
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["pair.gif", "pair.mp4"]
    alone = tmp_path / "alone.gif"
    assert main(["video", "--task", "force", "--agent", "passive", "--alone", "--out", str(alone), *small]) == 0
    assert imageio.imread(alone, index=None).shape == (4, 240, 320, 3)
    assert capsys.readouterr().err == ""


def test_a_video_shows_any_agent_that_fits(tmp_path, capsys):
    pytest.importorskip("imageio.v3")
    out, small = str(tmp_path / "out.gif"), ["--steps", "1", "--size", "320", "240"]
    agent = str(pretrained_file("SDFriction/ForceSensed-v0"))
    assert main(["video", "--task", "force", "--tier", "sensed", "--out", out, *small]) == 0
    assert main(["video", "--task", "force", "--tier", "sensed", "--agent", agent, "--out", out, *small]) == 0
    assert main(["video", "--task", "belt", "--agent", "threshold-follower", "--out", out, *small]) == 0
    assert main(["video", "--task", "force", "--agent", agent, "--out", out, *small]) == 2
    assert "observes 1 values, and SDFriction/Force-v0 gives 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--task force --out film.avi", "must end in .gif or .mp4"),
        ("--task force --out nowhere/film.gif", "in a folder that exists"),
        ("--task force --out film.gif --steps 0", "--steps must be in [1, 100000], got 0"),
        ("--task force --out film.gif --fps 61", "--fps must be in [1, 60], got 61"),
        ("--task force --out film.gif --fps 51", "fps must be in [1, 50] for a GIF, got 51"),
        ("--task force --out film.gif --size 10 10", "render_size width must be"),
        ("--task force --out film.mp4 --size 321 240", "--size must be even for .mp4, got 321 240"),
        ("--task force --out film.gif --seed -1", "--seed must be at least 0, got -1"),
        ("--task force --out film.gif --agent someone", "or module:NAME, got 'someone'"),
        ("--task force --out film.gif --agent none.npz", "none.npz"),
        ("--task force --out film.gif --gain 2", "--gain goes with --agent velocity-feedback"),
        ("--task force --tier sensed --agent velocity-feedback --out film.gif", "sees the position only"),
        ("--task force --agent threshold-follower --out film.gif", "needs the actuator 'belt_speed'"),
        ("--task rope --out film.gif", "invalid choice: 'rope'"),
        ("--task force", "required: --out"),
    ],
)
def test_a_video_that_cannot_be_is_refused_at_once(arguments, message, tmp_path, monkeypatch, capsys):
    pytest.importorskip("imageio.v3")
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["video", *arguments.split()])
    except SystemExit as leaving:
        code = leaving.code
    captured = capsys.readouterr()
    assert code == 2
    assert message in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_the_hyperparameters_are_where_it_says(capsys):
    assert main(["hyperparameters", "ppo"]) == 0
    file = Path(capsys.readouterr().out.strip())
    assert "SDFriction/Force-v0" in file.read_text()
    assert main(["hyperparameters"]) == 0
    assert Path(capsys.readouterr().out.strip()) == file.parent
    assert main(["hyperparameters", "ppo", "--show"]) == 0
    assert capsys.readouterr().out.strip() == file.read_text().strip()
    assert main(["hyperparameters", "magic"]) == 2
    assert "algorithm must be one of ppo, ppo_warm_start, sac, td3, tqc, got 'magic'" in capsys.readouterr().err


def test_the_doctor_finds_what_is_there_and_what_is_missing(monkeypatch, capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["versions"]["sd_friction_env"] == __version__
    assert found["kernel"]["amplitude"] == limit_cycle(OscillatorParameters()).amplitude
    assert found["features"]["render"]["missing"] == []
    assert set(found["agents"].values()) == {""}
    known = doctor.importlib.metadata.version

    def version(name):
        if name == "pygame-ce":
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return known(name)

    monkeypatch.setattr(doctor.importlib.metadata, "version", version)
    monkeypatch.setattr(pretrained, "PRETRAINED", Path("nowhere"))
    assert main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert 'missing pygame-ce: pip install "sd-friction-env[render]"' in text
    assert "env_id must be one that an agent was trained for" in text
    assert "\x1b" not in text  # not a terminal


def test_completion_is_a_script_for_the_shell(monkeypatch, capsys):
    pytest.importorskip("shtab")
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert "--belt-speed" in script
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert 'pip install "sd-friction-env[completion]"' in capsys.readouterr().err


def test_every_command_has_help_with_examples(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    for name in ("amplitude", "cycle", "critical", "simulate", "basins", "video", "doctor", "completion"):
        assert f"\n    {name} " in listed
        with pytest.raises(SystemExit) as leaving:
            main([name, "--help"])
        assert leaving.value.code == 0
        assert f"examples:\n  sd-friction {name}" in capsys.readouterr().out


def test_basins_writes_the_label_of_each_start(tmp_path, capsys):
    x, v, found = basin_grid(OscillatorParameters(alpha=0.2), shape=(6, 5))
    arguments = ["basins", "--alpha", "0.2", "--shape", "6", "5", "--out"]
    assert main([*arguments, str(tmp_path / "grid.npz")]) == 0
    assert "stick-slip round x = " in capsys.readouterr().out
    grid = load_arrays(tmp_path / "grid.npz", texts=("metadata",))
    assert np.array_equal(grid["labels"], found.labels)
    assert (grid["x"].tolist(), grid["v"].tolist()) == (x.tolist(), v.tolist())
    assert main([*arguments, str(tmp_path / "grid.csv")]) == 0
    table = Table.from_csv(tmp_path / "grid.csv")
    assert table["label"].reshape(5, 6).tolist() == found.labels.tolist()
    assert table["x"][:6].tolist() == x.tolist()
    assert table["v"][::6].tolist() == v.tolist()


def test_basins_of_any_size_go_to_disk_and_are_not_drawn(tmp_path, capsys):
    arguments = ["basins", "--alpha", "0.2", "--shape", "6", "5", "--out", str(tmp_path / "grid.npy")]
    assert main([*arguments, "--plot", str(tmp_path / "grid.png")]) == 2
    assert "leave it out with --out FILE.npy" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert main(arguments) == 0
    assert "fraction_low" in capsys.readouterr().out
    _, _, found = basin_grid(OscillatorParameters(alpha=0.2), shape=(6, 5))
    assert np.array_equal(np.load(tmp_path / "grid.npy"), found.labels)


def test_integrity_and_response_write_tables(tmp_path, capsys):
    out = tmp_path / "out.csv"
    assert (
        main(["integrity", "--alpha", "0.5", "0.8", "--belt-speed", "0.46", "--starts", "1000", "--out", str(out)]) == 0
    )
    table = Table.from_csv(out)
    assert table["alpha"].tolist() == [0.5, 0.5, 0.8]
    assert table["note"].tolist() == ["", "", "the only attractor"]
    linear = ["--geometry", "linear", "--mu-s", "0", "--mu-m", "0", "--force-amplitude", "0.1"]
    plot = tmp_path / "out.png"
    command = ["response", *linear, "--over", "force-frequency", "0.9:1.1:0.1", "--out", str(out), "--plot", str(plot)]
    assert main(command) == 0
    table = Table.from_csv(out)
    assert table["force_frequency"].tolist() == [0.9, 1.0, 1.1, 1.1, 1.0, 0.9]
    assert table["amplitude"][1] == pytest.approx(1.0, rel=1e-6)
    assert plot.stat().st_size > 1000
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "compiling" not in line] == []  # which a new machine says once


def test_a_refined_curve_has_the_critical_speeds_from_both_sides():
    plain = amplitude_curve(OscillatorParameters(), [0.2, 0.6])
    curve = refined_curve(OscillatorParameters(), [0.2, 0.6])
    v_b0, v_b1 = critical_belt_speeds(OscillatorParameters())
    for speed, kinds in ((v_b0, ["stick-slip", "pure-slip"]), (v_b1, ["pure-slip", "steady-slip"])):
        near = np.abs(curve["belt_speed"] - speed) < 2e-9
        assert curve["kind"][near].tolist() == kinds
    assert curve["amplitude"][[0, -1]].tolist() == plain["amplitude"].tolist()
    assert refined_curve(OscillatorParameters(), [0.1, 0.2]).n_rows == 2


def test_the_first_ctrl_c_asks_to_stop_and_the_second_interrupts():
    before = signal.getsignal(signal.SIGINT)
    with stop_requests() as should_stop:
        assert not should_stop()
        signal.raise_signal(signal.SIGINT)
        assert should_stop()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
