"""Rigs in SI units, for every law: by arguments and from files."""

import math
import subprocess
import sys

import pytest

from sd_friction_env import OscillatorParameters, SDFrictionEnv, limit_cycle, simulate, tabulated_friction
from sd_friction_env.physics.laws import Exponential
from sd_friction_env.physics.rigs import read_rig

BLOCK = {"M": 2.0, "K": 800.0, "C": 1.5, "g": 9.81, "V0": 0.1, "geometry": "linear", "mu_s": 0.35}
EXPONENTIAL = {**BLOCK, "friction": "exponential", "mu_k": 0.22, "V_0": 0.05, "mu_v": 0.4}


def test_a_level_rig_needs_no_length_and_has_the_weight_one():
    p = OscillatorParameters.from_physical(**EXPONENTIAL)
    omega = math.sqrt(800.0 / 2.0)
    length = 2.0 * 9.81 / 800.0
    assert p.g1 == pytest.approx(1.0, rel=1e-15)
    assert p.length_scale == pytest.approx(length, rel=1e-15)
    assert (p.v_0, p.mu_v) == pytest.approx((0.05 / (length * omega), 0.4 * length * omega), rel=1e-14)


def test_the_unit_of_length_changes_nothing_that_can_be_measured():
    amplitudes = []
    for length in (None, 0.01, 0.3):
        p = OscillatorParameters.from_physical(**EXPONENTIAL, L=length)
        amplitudes.append(limit_cycle(p).amplitude * p.length_scale)
    assert amplitudes[1:] == pytest.approx([amplitudes[0]] * 2, rel=1e-9)


def test_a_law_of_ones_own_takes_metres_and_newtons():
    by_name = OscillatorParameters.from_physical(**EXPONENTIAL)
    own = OscillatorParameters.from_physical(**BLOCK, friction=Exponential(0.35, 0.22, 0.05, 0.4))
    assert limit_cycle(own).amplitude == pytest.approx(limit_cycle(by_name).amplitude, abs=1e-9)
    duffing = {**BLOCK, "geometry": "duffing", "mu_m": 0.2, "V_m": 0.3, "K3": 5e5}
    p = OscillatorParameters.from_physical(**duffing)
    # the restoring force at 4 mm, in newtons
    force = p.restoring_force(0.004 / p.length_scale) * p.force_scale
    assert force == pytest.approx(800.0 * 0.004 + 5e5 * 0.004**3, rel=1e-12)


def test_an_exciting_force_is_given_in_newtons_and_radians_a_second():
    p = OscillatorParameters.from_physical(**EXPONENTIAL, force_amplitude=3.0, force_frequency=18.0)
    assert p.force_amplitude * p.force_scale == pytest.approx(3.0, rel=1e-14)
    assert p.force_frequency / p.time_scale == pytest.approx(18.0, rel=1e-14)
    assert simulate(p, t_end=5.0).status == "ok"


def test_an_environment_is_made_from_any_rig():
    env = SDFrictionEnv.from_rig(**EXPONENTIAL, sampling_time=0.005, force_limit=4.0, episode_steps=20)
    assert env.task.episode_steps == 20
    assert env.task.force_limit * env.nominal.force_scale == pytest.approx(4.0, rel=1e-14)
    env.reset(seed=0)
    assert env.step([1.0])[4]["force"] * env.nominal.force_scale == pytest.approx(4.0, rel=1e-14)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"geometry": "exact"}, TypeError, "L must be given with geometry 'exact' and friction 'exponential'"),
        ({"geometry": "exact", "L": 0.2}, TypeError, "H must be given with geometry 'exact'"),
        ({"geometry": "duffing"}, TypeError, "K3 must be given with geometry 'duffing'"),
        ({"friction": "stribeck"}, TypeError, "mu_m must be given with geometry 'linear' and friction 'stribeck'"),
        ({"friction": "hyperbolic"}, TypeError, "delta must be given"),
        ({"mu_s": None}, TypeError, "mu_s must be given"),
        ({"V0": None}, TypeError, "V0 must be given"),
        ({"V_1": 0.1}, TypeError, "a rig has no number 'V_1'; allowed: mu_m, mu_k, "),
        ({"M": 0.0}, ValueError, "M must be a finite number"),
        ({"V_0": 0.0}, ValueError, "V_0 must be a finite number"),
        ({"mu_k": 0.5}, ValueError, "mu_k must not exceed mu_s = 0.35, got 0.5"),
        ({"friction": "wet"}, ValueError, "friction must be one of 'stribeck'"),
    ],
)
def test_what_makes_no_rig_is_refused(changes, error, message):
    with pytest.raises(error, match=message):
        OscillatorParameters.from_physical(**EXPONENTIAL | changes)


def test_a_rig_is_read_from_toml_and_yaml(tmp_path):
    toml, yaml = tmp_path / "block.toml", tmp_path / "block.yml"
    lines = [f"{name} = {value!r}" for name, value in EXPONENTIAL.items()]
    toml.write_text("\n".join(lines).replace("'", '"'))
    yaml.write_text("\n".join(f"{name}: {value}" for name, value in EXPONENTIAL.items()))
    assert read_rig(toml) == read_rig(yaml) == OscillatorParameters.from_physical(**EXPONENTIAL)


def test_a_rig_with_a_table_beside_it_works_from_the_command_line(tmp_path):
    (tmp_path / "pad.csv").write_text("v,mu\n0,0.35\n0.05,0.27\n0.2,0.23\n1.0,0.22\n")
    (tmp_path / "rig.toml").write_text(
        'M = 2\nK = 800\nC = 1.5\nV0 = 0.1\ngeometry = "linear"\nfriction_table = "pad.csv"\n'
    )
    table = tabulated_friction([0.0, 0.05, 0.2, 1.0], [0.35, 0.27, 0.23, 0.22])
    expected = OscillatorParameters.from_physical(M=2, K=800, C=1.5, V0=0.1, geometry="linear", friction=table)
    assert read_rig(tmp_path / "rig.toml") == expected
    command = [sys.executable, "-m", "sd_friction_env", "cycle", "--rig", str(tmp_path / "rig.toml"), "--json"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert f'"amplitude": {float(limit_cycle(expected).amplitude)!r}'[:30] in run.stdout.replace("\n", "")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rig.txt", "", "a rig file must end in .toml, .yaml or .yml, got"),
        ("rig.toml", "M = ", r"rig.toml' is no TOML file"),
        ("rig.yml", "M: [1", r"rig.yml' is no YAML file"),
        ("rig.yml", "- 1\n- 2\n", r"rig.yml' must hold names and values, got list"),
        ("rig.yml", "!!python/object/apply:os.system ['true']", r"rig.yml' is no YAML file"),
        ("rig.toml", "M = 1.0\nK = 2.0\n", r"rig.toml' describes no rig: .*'C'"),
        (
            "rig.toml",
            'M = 1.0\nK = 2.0\nC = 0.1\nL = 1.0\nmass = "a"\n',
            r"describes no rig: a rig has no number 'mass'",
        ),
        (
            "rig.toml",
            'friction = "coulomb"\nfriction_table = "a.csv"\n',
            "must have friction or friction_table, not both",
        ),
    ],
)
def test_a_file_that_is_no_rig_is_refused_by_name(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        read_rig(tmp_path / name)
