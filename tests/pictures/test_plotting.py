"""Figures are ours whatever the user's matplotlibrc says, and files may end in capitals."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

import matplotlib
import numpy as np

from scripts.figures import paper
from sd_friction_env import OscillatorParameters, Table, amplitude_curve, load_pretrained, simulate
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import load_policy
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import checked_ending

ROOT = Path(__file__).parents[2]
# What a user may have asked for, and what may not be there: LaTeX, a font, a minus sign in a font, a backend.
WISHES = [
    {"text.usetex": True, "text.latex.preamble": r"\\usepackage{nowhere}"},
    {"font.family": "No Such Font", "mathtext.fontset": "cm"},
    {"font.family": "cmr10", "axes.unicode_minus": True},
    {"savefig.format": "tiff", "savefig.bbox": "tight", "savefig.dpi": 20, "figure.dpi": 20},
    {
        "axes.grid": True,
        "axes.facecolor": "black",
        "lines.linewidth": 9.0,
        "xtick.labelsize": 30,
        "svg.fonttype": "none",
    },
]


def drawn(path, rc):
    """Return a figure's file as it comes out under a user's settings."""
    history = simulate(OscillatorParameters(), t_end=20.0, dt=0.5)
    with matplotlib.rc_context(rc):
        plotting.save_figure(plotting.draw_history(history), path)
    return path.read_bytes()


@pytest.mark.parametrize("ending", plotting.FORMATS)
def test_a_figure_is_the_same_file_whatever_the_users_settings(ending, tmp_path):
    ours = drawn(tmp_path / f"ours{ending}", {})
    assert len(ours) > 5000
    for wish in WISHES:
        assert drawn(tmp_path / f"theirs{ending}", wish) == ours, wish


def test_so_are_those_that_are_put_together_from_parts_and_those_of_the_scripts(tmp_path):
    curve = amplitude_curve(OscillatorParameters(), np.linspace(0.05, 0.5, 12))
    table = Table.from_csv(ROOT / "figures" / "figure_3.csv")

    def files(rc):
        with matplotlib.rc_context(rc):
            figure, axes = plotting.new_figure(4.0, 3.0, 1, 1)
            plotting.draw_amplitude_curve(axes[0, 0], curve)
            plotting.mark_critical_speeds(axes[0, 0], 0.3, 0.4)
            plotting.save_figure(figure, tmp_path / "parts.png")
            paper.draw_3(table, tmp_path / "figure_3.png", {"exact": {"agent": ([0.2], [0.0])}})
        return (tmp_path / "parts.png").read_bytes(), (tmp_path / "figure_3.png").read_bytes()

    ours = files({})
    for wish in WISHES:
        assert files(wish) == ours, wish


@pytest.mark.parametrize("command", ["amplitude --belt-speed 0.2 0.3", "simulate --t-end 5", "basins --shape 20 20"])
def test_the_program_draws_without_the_latex_that_a_matplotlibrc_asks_for(command, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")  # no LaTeX for certain
    for rc, name in ((matplotlib.rcParams.copy(), "ours.png"), (WISHES[0], "theirs.png")):
        with matplotlib.rc_context(rc):
            assert main([*command.split(), "--plot", str(tmp_path / name)]) == 0, capsys.readouterr().err
    assert (tmp_path / "ours.png").read_bytes() == (tmp_path / "theirs.png").read_bytes()


def test_a_matplotlibrc_and_a_backend_for_windows_do_not_stop_the_program(tmp_path):
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfont.family: No Such Font\nbackend: TkAgg\n")
    command = [sys.executable, "-m", "sd_friction_env", "simulate", "--t-end", "5", "--plot", str(tmp_path / "a.PNG")]
    environment = {"PATH": "", "MATPLOTLIBRC": str(tmp_path), "MPLBACKEND": "TkAgg", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "a.PNG").read_bytes().startswith(b"\x89PNG")


def test_the_users_settings_are_left_as_they_are():
    with matplotlib.rc_context({"text.usetex": True, "font.size": 17.0}):
        before = dict(matplotlib.rcParams)
        drawn_on = plotting.new_figure(2.0, 2.0, 1, 1)[1][0, 0]
        assert not drawn_on.title.get_usetex()
        assert dict(matplotlib.rcParams) == before


def test_endings_in_capitals_are_endings(tmp_path, capsys):
    arguments = ["simulate", "--t-end", "3", "--dt", "0.5"]
    for out, plot, magic in (
        ("a.CSV", "a.PNG", b"\x89PNG"),
        ("a.Json", "a.Svg", b"<?xml"),
        ("b.Csv", "a.PDF", b"%PDF"),
    ):
        paths = [str(tmp_path / name) for name in (out, plot)]
        assert main([*arguments, "--out", paths[0], "--plot", paths[1]]) == 0, capsys.readouterr().err
        assert (tmp_path / plot).read_bytes().startswith(magic)
    assert Table.from_csv(tmp_path / "a.CSV").n_rows == 7
    assert len(json.loads((tmp_path / "a.Json").read_text())["rows"]) == 7
    policy = load_pretrained("SDFriction/Force-v0")
    policy.save(tmp_path / "agent.NPZ")
    assert load_policy(tmp_path / "agent.NPZ").metadata == policy.metadata
    assert {path.name for path in tmp_path.iterdir()} == {
        "a.CSV", "a.PNG", "a.Json", "a.Svg", "b.Csv", "a.PDF", "agent.NPZ",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["film.GIF", "film.Mp4"])
def test_so_are_those_of_videos(name, tmp_path, capsys):
    pytest.importorskip("imageio_ffmpeg")
    agent = tmp_path / "agent.NPZ"
    load_pretrained("SDFriction/Force-v0").save(agent)
    arguments = ["video", "--task", "force", "--agent", str(agent), "--steps", "2", "--size", "320", "240"]
    assert main([*arguments, "--out", str(tmp_path / name)]) == 0, capsys.readouterr().err
    assert (tmp_path / name).stat().st_size > 1000
    assert len(list(tmp_path.iterdir())) == 2


def test_another_ending_is_refused_by_name_with_what_is_allowed(tmp_path):
    assert checked_ending("A.b.CSV", (".csv",)) == ".csv"
    for name in ("a.txt", "csv", ".csv", "a.csv.gz", "a", "a."):
        with pytest.raises(ValueError, match=rf"--out must end in \.csv or \.json, got {name!r}"):
            checked_ending(name, (".csv", ".json"), "--out")
    figure, _ = plotting.new_figure(1.0, 1.0, 1, 1)
    with pytest.raises(ValueError, match=r"must end in \.png, \.svg or \.pdf"):
        plotting.save_figure(figure, tmp_path / "a.eps")
    assert list(tmp_path.iterdir()) == []
