"""What is typed in: ranges, messages, and the way from a rig in SI units and back."""

import dataclasses
import math

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, kernel

RIG = {
    "M": 2.0,
    "K": 800.0,
    "C": 4.0,
    "L": 0.5,
    "H": 0.4,
    "g": 9.81,
    "V0": 2.0,
    "mu_s": 0.3,
    "mu_m": 0.1,
    "V_m": 4.0,
}


def test_defaults_are_the_nominal_plant():
    p = OscillatorParameters()
    assert (p.geometry, p.alpha, p.g1, p.beta) == ("exact", 0.8, 1.0, 0.05)
    assert (p.mu_s, p.mu_m, p.v_m, p.belt_speed) == (0.2, 0.05, 0.5, 0.2)
    assert (p.k1, p.k3) == pytest.approx((0.45, 0.6))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("alpha", 5e-4),
        ("alpha", -0.5),
        ("alpha", math.nan),
        ("alpha", math.inf),
        ("g1", 0.0),
        ("beta", -1e-9),
        ("mu_s", 11.0),
        ("mu_m", -0.1),
        ("v_m", 0.0),
        ("belt_speed", -0.1),
        ("belt_speed", 1e9),
    ],
)
def test_a_value_out_of_range_is_named_with_what_is_allowed(name, value):
    with pytest.raises(ValueError, match=rf"{name} must be .*\[.*\], got {value!r}"):
        OscillatorParameters(**{name: value})


@pytest.mark.parametrize("value", ["0.8", None, [0.8], True, 1j, np.array([0.8])])
def test_a_value_of_the_wrong_type_is_refused(value):
    with pytest.raises(TypeError, match="alpha must be a real number"):
        OscillatorParameters(alpha=value)


def test_mu_m_above_mu_s_and_unknown_geometry_and_unknown_name_are_refused():
    with pytest.raises(ValueError, match=r"mu_m must not exceed mu_s = 0\.1, got 0\.2"):
        OscillatorParameters(mu_s=0.1, mu_m=0.2)
    with pytest.raises(
        ValueError,
        match=r"geometry must be one of 'exact', 'cubic', 'linear', 'duffing', or a law .* @spring_law, got 'round'",
    ):
        OscillatorParameters(geometry="round")
    with pytest.raises(ValueError, match="unknown parameter 'alfa'"):
        OscillatorParameters().replace(alfa=0.5)


def test_parameters_are_frozen_hashable_and_take_numpy_numbers():
    p = OscillatorParameters(alpha=np.float32(0.5), belt_speed=np.int64(1))
    assert type(p.alpha) is float
    assert p == OscillatorParameters(alpha=0.5, belt_speed=1)
    assert hash(p) == hash(p.replace())
    with pytest.raises(dataclasses.FrozenInstanceError):
        p.alpha = 0.6  # type: ignore[misc]


def test_a_rig_in_si_units_becomes_dimensionless_and_leads_back():
    p = OscillatorParameters.from_physical(**RIG)
    omega0 = 20.0
    assert p.alpha == pytest.approx(0.8)
    assert p.g1 == pytest.approx(9.81 / (0.5 * omega0**2))
    assert p.beta == pytest.approx(4.0 / (2 * 2.0 * omega0))
    assert p.belt_speed == pytest.approx(2.0 / (0.5 * omega0))
    assert p.v_m == pytest.approx(4.0 / (0.5 * omega0))
    assert p.time_scale == pytest.approx(1 / omega0)
    # the dimensional equation of motion, Eq. 3, at some state, equals the dimensionless one scaled back
    x, v = 0.9, -0.1
    X, V = x * p.length_scale, v * p.length_scale / p.time_scale
    length = math.hypot(X, RIG["H"])
    friction = -OscillatorParameters.friction_coefficient(p, v - p.belt_speed)
    normal = RIG["M"] * RIG["g"] - RIG["K"] * RIG["H"] * (1 - RIG["L"] / length)
    acceleration = (friction * normal - RIG["K"] * X * (1 - RIG["L"] / length) - RIG["C"] * V) / RIG["M"]
    steady = kernel.Drive(p.belt_speed, 0.0, 0.0)
    ours = kernel.slip_acceleration(p.plant, kernel.SLIP_BACKWARD, kernel.State(x, v), steady)
    assert ours * p.length_scale / p.time_scale**2 == pytest.approx(acceleration, rel=1e-12)
    assert normal == pytest.approx(p.normal_force(x) * p.force_scale, rel=1e-12)


@pytest.mark.parametrize("name", ["M", "K", "L", "g", "V_m"])
def test_a_rig_without_mass_stiffness_length_gravity_or_v_m_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be"):
        OscillatorParameters.from_physical(**{**RIG, name: 0.0})


@pytest.mark.parametrize(
    "values",
    [
        {"friction": "coulomb", "mu_s": 0.02, "mu_k": 0.02},  # below the default mu_m
        {"friction": "hyperbolic", "mu_s": 0.02},
        {"friction": "stribeck", "mu_s": 0.05, "mu_m": 0.02},  # below the default mu_k
        {"geometry": "linear", "alpha": 5e-4},
        {"geometry": "duffing", "alpha": 5e-4},
    ],
)
def test_a_value_that_the_laws_do_not_use_is_not_checked_against_theirs(values):
    parameters = OscillatorParameters(**values)
    assert math.isfinite(parameters.restoring_force(0.5) + parameters.friction_coefficient(-0.1))
    with pytest.raises(ValueError, match="mu_m must not exceed mu_s"):
        OscillatorParameters(mu_s=0.02)
    with pytest.raises(ValueError, match="mu_k must not exceed mu_s"):
        OscillatorParameters(friction="exponential", mu_s=0.02)
