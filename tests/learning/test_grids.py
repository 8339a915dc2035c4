"""A controller judged on a grid of plants: what it says of each is what an evaluation of that plant alone says."""

import numpy as np
import pytest

from sd_friction_env import Table, load_pretrained
from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import ZeroPolicy
from sd_friction_env.learning import evaluation, grids
from sd_friction_env.physics.sweeps import Engine

FORCE = "SDFriction/Force-v0"
OVER = {"alpha": [0.7, 0.8], "belt_speed": [0.15, 0.2, 0.25]}


@pytest.fixture(scope="module")
def table():
    return grids.evaluation_grid(load_pretrained(FORCE), FORCE, OVER, Engine(), seeds=[100, 101])


def test_a_grid_holds_what_evaluations_of_its_plants_hold(table):
    assert table["alpha"].tolist() == [0.7] * 3 + [0.8] * 3
    assert table["belt_speed"].tolist() == [0.15, 0.2, 0.25] * 2
    plant = {"alpha": 0.7, "belt_speed": 0.25}
    options = {"parameters": {name: [value] * 2 for name, value in plant.items()}}
    episodes = evaluation.run_episodes(load_pretrained(FORCE), FORCE, [100, 101], options=options)
    passive = evaluation.run_episodes(ZeroPolicy(), FORCE, [100, 101], options=options)
    alone = evaluation.metrics(episodes, passive)
    assert table["return"][2] == alone["return"].mean()
    assert table["worst_amplitude"][2] == alone["late_amplitude"].max()
    assert table["passive_return"][2] == evaluation.metrics(passive, passive)["return"].mean()
    assert table["suppressed"][4] == 1.0  # the nominal plant


@pytest.mark.parametrize("engine", [Engine(backend="loky", workers=2), Engine(backend="sequential")])
def test_it_is_the_same_whoever_computes_it_and_however_it_is_cut(engine, table):
    other = grids.evaluation_grid(load_pretrained(FORCE), FORCE, OVER, engine, seeds=[100, 101], plants_a_chunk=2)
    for name, values in table.items():
        assert np.array_equal(other[name], values), name


def test_the_program_writes_the_grid_and_keeps_its_chunks(tmp_path, table):
    over = ["--over", "alpha", "0.7:0.8:0.1", "--over", "belt-speed", "0.15:0.25:0.05"]
    out, folder = tmp_path / "grid.csv", tmp_path / "kept"
    command = ["--task", "force", *over, "--episodes", "2", "--out", str(out), "--folder", str(folder)]
    assert main(["grid", *command]) == 0
    written = Table.from_csv(out)
    assert written["belt_speed"] == pytest.approx(table["belt_speed"])
    assert (folder / "sweep.json").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--over", "mass", "1"], "unknown parameter 'mass'"),
        (["--over", "alpha", "99"], r"alpha must be .*\[0, 10\], got 99"),
        (["--over", "alpha", "x"], "'x' is no number"),
        (["--over", "alpha"], "at least one value"),
        (["--over", "alpha", "0.8", "--episodes", "0"], r"--episodes must be in \[1, 100\], got 0"),
        (["--over", "alpha", "0.8", "--agent", "nowhere"], "nowhere"),
        (["--over", "alpha", "0.8", "--address", "tcp://x:1"], "address goes with"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments, named, capsys):
    assert main(["grid", "--task", "force", *arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    import re

    assert re.search(named, said[-1])
