"""The program: commands, outputs, exit codes, and messages in one line."""

import json
import os
import subprocess
import sys

import pytest

from sd_friction_env import Table, __version__, limit_cycle
from sd_friction_env.cli import main, numbers
from sd_friction_env.parameters import OscillatorParameters


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
        ("amplitude --out curve.txt", "must end in .csv, .json"),
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
