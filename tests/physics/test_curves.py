"""Amplitude curves and the tables they come in."""

import math
import os

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, Table, amplitude_curve, critical_belt_speeds, limit_cycle
from sd_friction_env.physics.curves import refined_curve

CUBIC = OscillatorParameters(geometry="cubic")


def test_the_curve_rises_to_v_b0_falls_to_v_b1_and_ends():
    speeds = np.linspace(0.0, 0.5, 26)
    curve = amplitude_curve(CUBIC, speeds)
    v_b0, v_b1 = critical_belt_speeds(CUBIC)
    assert curve["belt_speed"].tolist() == speeds.tolist()
    expected = [
        "rest" if s == 0.0 else "stick-slip" if s < v_b0 else "pure-slip" if s < v_b1 else "steady-slip" for s in speeds
    ]
    assert curve["kind"].tolist() == expected
    rising = curve["amplitude"][(speeds > 0.0) & (speeds < 0.38)]
    assert np.all(np.diff(rising) > 0.0)
    assert 0.43 < curve["amplitude"].max() < 0.45  # Fig. 4a's axis ends at .45
    assert np.all(curve["amplitude"][speeds > v_b1] == 0.0)


def test_a_row_is_the_cycle_of_its_belt_speed():
    row = next(amplitude_curve(CUBIC, [0.3]).rows())
    cycle = limit_cycle(CUBIC.replace(belt_speed=0.3))
    for name in ("amplitude", "period", "stick_fraction", "x_max", "x_min", "x_breakaway", "kind"):
        assert row[name] == getattr(cycle, name)


def test_a_point_that_cannot_be_computed_is_a_row_that_says_why():
    curve = amplitude_curve(CUBIC.replace(alpha=0.1), [0.39, 0.39])
    assert curve["kind"].tolist() == ["failed", "failed"]
    assert all("loses contact" in note for note in curve["note"])
    assert np.isnan(curve["amplitude"]).all()


@pytest.mark.parametrize("speeds", [[], [[0.1]], [0.1, -0.2], [math.nan], [math.inf]])
def test_bad_belt_speeds_are_refused(speeds):
    with pytest.raises(ValueError, match="belt_speeds must"):
        amplitude_curve(CUBIC, speeds)
    with pytest.raises(TypeError, match="belt_speeds must be numbers"):
        amplitude_curve(CUBIC, ["slow"])


def test_a_table_survives_a_csv_file_with_its_metadata(tmp_path):
    table = Table({"a": [1.5, math.nan], "b": ['x,"y"', "plain"]}, {"made": "here", "n": 2})
    table.to_csv(tmp_path / "t.csv")
    back = Table.from_csv(tmp_path / "t.csv")
    assert back.metadata == {"made": "here", "n": "2"}
    assert back["b"].tolist() == table["b"].tolist()
    np.testing.assert_array_equal(back["a"], table["a"])
    assert os.listdir(tmp_path) == ["t.csv"]
    assert list(table.to_dataframe().columns) == ["a", "b"]


def test_a_table_is_written_whole_or_not_at_all(tmp_path):
    (tmp_path / "t.csv").write_text("before")
    with pytest.raises(TypeError):
        Table({"a": [1.0]}, {"bad": object()}).to_csv(tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == "before"
    assert os.listdir(tmp_path) == ["t.csv"]
    with pytest.raises(ValueError, match="one length"):
        Table({"a": [1.0], "b": [1.0, 2.0]})
    with pytest.raises(FileNotFoundError):
        Table({"a": [1.0]}).to_csv(tmp_path / "nowhere" / "t.csv")


def test_a_refined_curve_meets_at_the_critical_speeds_from_both_sides_and_has_the_points_asked_for():
    speeds = np.arange(0.3, 0.55, 0.05)
    curve = refined_curve(OscillatorParameters(), speeds)
    v_b0, v_b1 = critical_belt_speeds(OscillatorParameters())
    at, kind, size = (np.asarray(curve[name]) for name in ("belt_speed", "kind", "amplitude"))
    assert set(speeds) <= set(at)
    assert np.all(np.diff(at) > 0.0)
    for critical, kinds in ((v_b0, ("stick-slip", "pure-slip")), (v_b1, ("pure-slip", "steady-slip"))):
        below, above = np.flatnonzero(at < critical)[-1], np.flatnonzero(at > critical)[0]
        assert at[above] - at[below] < 1e-8
        assert (kind[below], kind[above]) == kinds
        assert abs(size[above] - size[below]) < 1e-3
    assert np.count_nonzero(kind == "pure-slip") >= 25
    plain = amplitude_curve(OscillatorParameters(), speeds)
    assert size[np.isin(at, speeds)].tolist() == np.asarray(plain["amplitude"]).tolist()
