"""Spectra, harmonics, envelopes and response curves against closed forms."""

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, attractors, equilibria, limit_cycle, simulate
from sd_friction_env.physics.forced import forced_orbit, response_curve
from sd_friction_env.physics.signals import envelope, harmonics, spectrum
from sd_friction_env.physics.sweeps import Engine, response_sweep

EXACT = OscillatorParameters()
CUBIC = EXACT.replace(geometry="cubic")
LINEAR = EXACT.replace(geometry="linear")
FREE = LINEAR.replace(mu_s=0.0, mu_m=0.0)  # no friction: the textbook's damped oscillator


@pytest.mark.parametrize("window", ["boxcar", "hann", "blackmanharris", "flattop"])
def test_a_sine_has_its_own_amplitude_and_its_level(window):
    t = 0.1 * np.arange(500)
    found = spectrum(0.3 + 0.02 * np.sin(2.0 * np.pi * t), 0.1, window=window, reference=0.02)
    line = int(np.argmin(np.abs(found["frequency"] - 1.0)))
    assert found["frequency"][line] == pytest.approx(1.0)
    assert found["amplitude"][line] == pytest.approx(0.02, rel=1e-6)
    assert found["level"][line] == pytest.approx(0.0, abs=1e-5)
    assert found["amplitude"][0] == pytest.approx(0.3)


@pytest.mark.parametrize("size", [400, 401])
def test_a_boxcar_spectrum_keeps_the_mean_square(size):  # Parseval, even and odd
    samples = np.random.default_rng(0).normal(size=size)
    amplitude = spectrum(samples, 1.0, window="boxcar")["amplitude"]
    halved = np.full(len(amplitude), 0.5)
    halved[0] = 1.0
    if size % 2 == 0:
        halved[-1] = 1.0
    assert halved @ amplitude**2 == pytest.approx(np.mean(samples**2))


def test_harmonics_are_the_fourier_coefficients_and_phases():
    t = 0.013 * np.arange(3000)
    samples = 0.5 + np.cos(2.0 * t + 0.4) + 0.1 * np.cos(4.0 * t - 1.0) + 0.02 * np.cos(6.0 * t + 2.0)
    found = harmonics(samples, 0.013, count=3)
    assert found["frequency"] == pytest.approx(np.arange(1, 4) / np.pi, rel=1e-6)
    assert found["amplitude"] == pytest.approx([1.0, 0.1, 0.02], rel=1e-3)
    assert found["phase"] == pytest.approx([0.4, -1.0, 2.0], abs=1e-3)


@pytest.mark.parametrize(
    "plant",
    [
        EXACT,
        EXACT.replace(belt_speed=0.01),
        EXACT.replace(alpha=0.2),
        CUBIC.replace(belt_speed=0.405),
        EXACT.replace(alpha=0.5, belt_speed=0.43),
        LINEAR.replace(friction="exponential", mu_s=1.0, mu_k=0.5, v_0=0.5, belt_speed=1.3),
    ],
)
@pytest.mark.parametrize("periods", [9.0, 31.7])
def test_the_fundamental_is_one_over_the_period_of_the_cycle(plant, periods):
    cycles = [cycle for cycle in attractors(plant) if cycle.period > 0.0]
    assert cycles
    for cycle in cycles:
        dt = cycle.period / 300.0
        motion = simulate(plant, cycle.x_phase0, cycle.v_phase0, periods * cycle.period, dt=dt)
        for samples in (motion.x, motion.v):
            assert harmonics(samples[:-1], dt)["frequency"][0] == pytest.approx(cycle.frequency, rel=1e-5)


def test_damped_free_vibration_decays_at_minus_beta_and_steady_slip_at_its_eigenvalue():
    motion = simulate(FREE, 1.0, 0.0, 60.0, dt=0.02)
    swings = envelope(motion.t, motion.x, motion.v)
    assert swings["rate"][1:] == pytest.approx(-FREE.beta, abs=1e-8)
    assert swings.metadata["rate"] == pytest.approx(-FREE.beta, abs=1e-8)
    period = 2.0 * np.pi / np.sqrt(1.0 - FREE.beta**2)
    assert np.diff(swings["t"]) == pytest.approx(0.5 * period)
    for speed in (0.3, 0.5):  # grows below v_b1, decays above, round an equilibrium that is not 0
        plant = LINEAR.replace(belt_speed=speed)
        place = equilibria(plant)[0]
        motion = simulate(plant, place.x + 1e-4, 0.0, 40.0, dt=0.02)
        rate = envelope(motion.t, motion.x, motion.v).metadata["rate"]
        assert rate == pytest.approx(place.eigenvalues[0].real, rel=1e-4)
        assert (rate > 0.0) == (speed < 0.44)


def test_an_envelope_of_rest_is_empty():
    motion = simulate(EXACT.replace(belt_speed=0.0), 0.8, 0.0, 5.0)
    swings = envelope(motion.t, motion.x, motion.v)
    assert swings.n_rows == 0
    assert np.isnan(swings.metadata["rate"])


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda: spectrum([1.0] * 7, 0.1), ValueError, "samples must be finite, of shape .n,. with n >= 8"),
        (lambda: spectrum([[1.0] * 9], 0.1), ValueError, "samples must"),
        (lambda: spectrum([1.0] * 8 + [np.nan], 0.1), ValueError, "NaN or infinity"),
        (lambda: spectrum(["a"] * 9, 0.1), TypeError, "samples must be an array of numbers"),
        (lambda: spectrum([1.0] * 9, 0.0), ValueError, "dt must be"),
        (lambda: spectrum([1.0] * 9, 0.1, window="hat"), ValueError, "window must be .* got 'hat'"),
        (lambda: spectrum([1.0] * 9, 0.1, reference=0.0), ValueError, "reference must be"),
        (lambda: harmonics(np.ones(100), 0.1), ValueError, "eight periods"),
        (lambda: harmonics(np.sin(np.arange(0.0, 12.0, 0.1)), 0.1), ValueError, "eight periods"),
        (lambda: harmonics(np.sin(np.arange(0.0, 90.0, 0.1)), 0.1, count=0), ValueError, "count must be"),
        (lambda: envelope([0.0, 1.0], [0.0, 1.0], [0.0]), ValueError, "v must be finite"),
        (lambda: envelope([0.0, 0.0], [0.0, 1.0], [0.0, 1.0]), ValueError, "t must increase"),
    ],
)
def test_signals_that_cannot_be_analysed_are_refused(call, error, named):
    with pytest.raises(error, match=named):
        call()


# Response -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [0.0, 1.1])
def test_the_response_of_a_linear_oscillator_is_its_transfer_function(phase):
    plant = FREE.replace(force_amplitude=0.1, force_phase=phase)
    rates = np.array([0.5, 0.9, 1.0, 1.1, 2.0])
    found = response_curve(plant, "force_frequency", rates, direction="up", transient=300)
    transfer = plant.force_amplitude / (1.0 - rates**2 + 2j * plant.beta * rates)
    assert found["first_harmonic"] == pytest.approx(np.abs(transfer), rel=1e-9)
    assert found["amplitude"] == pytest.approx(np.abs(transfer), rel=1e-9)
    assert found["phase"] == pytest.approx(np.angle(transfer), abs=1e-9)
    assert set(found["note"]) == {""}


def test_a_hardening_spring_has_hysteresis_and_both_branches_are_orbits():
    plant = FREE.replace(geometry="duffing", force_amplitude=0.2)
    found = response_curve(plant, "force_frequency", np.arange(0.8, 1.81, 0.1), transient=60, cycles=4)
    up, down = (found["amplitude"][found["direction"] == way] for way in ("up", "down"))
    jump = np.abs(up - down[::-1]) > 1e-3
    assert np.round(found["value"][: len(up)][jump], 1).tolist() == [1.3, 1.4, 1.5]
    assert (up > down[::-1])[jump].all()
    for row in range(len(up)):
        motion = forced_orbit(plant.replace(force_frequency=found["value"][row]), multiple=1, transient=60)
        assert np.isclose(motion.amplitude, [up[row], down[::-1][row]], rtol=1e-4).any()


def test_a_value_that_loses_contact_is_a_row_with_its_reason():
    found = response_curve(CUBIC.replace(force_frequency=1.0), "force_amplitude", [0.01, 50.0], direction="up")
    assert found["note"][0] == ""
    assert "loses contact" in found["note"][1]
    assert np.isnan(found["amplitude"]).tolist() == [False, True]
    assert np.isnan(found["phase"]).tolist() == [False, True]


def test_a_response_sweep_is_the_same_and_goes_on_from_its_folder(tmp_path):
    plants = [FREE.replace(force_amplitude=size) for size in (0.1, 0.2)]
    values = [0.9, 1.1]
    tables = response_sweep(plants, "force_frequency", values, Engine(folder=tmp_path / "kept"), transient=20)
    again = response_sweep(plants, "force_frequency", values, Engine(folder=tmp_path / "kept"), transient=20)
    for plant, table, kept in zip(plants, tables, again, strict=True):
        alone = response_curve(plant, "force_frequency", values, transient=20)
        assert all(np.array_equal(alone[name], table[name]) for name in alone)
        assert all(np.array_equal(alone[name], kept[name]) for name in alone)
        assert table.metadata == alone.metadata


@pytest.mark.parametrize(
    ("plant", "named"),
    [(EXACT, "one excitation that acts, got none"), (EXACT.replace(force_amplitude=0.1, ripple_amplitude=0.1), "one")],
)
def test_a_response_needs_one_excitation(plant, named):
    with pytest.raises(ValueError, match=named):
        response_curve(plant, "beta", [0.1])


def test_the_limit_cycle_swings_without_growth():
    cycle = limit_cycle(EXACT)
    motion = simulate(EXACT, cycle.x_phase0, cycle.v_phase0, 10.0 * cycle.period, dt=0.01)
    swings = envelope(motion.t, motion.x, motion.v)
    assert swings["amplitude"] == pytest.approx(cycle.amplitude, rel=1e-7)
    assert abs(swings.metadata["rate"]) < 1e-8
