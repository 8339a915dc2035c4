"""Derivatives of a simulated motion: against differences, what they are refused for, and a fit with them."""

import numpy as np
import pytest

from scripts import identification
from sd_friction_env import OscillatorParameters, simulate

NOMINAL = OscillatorParameters()
DRIVEN = NOMINAL.replace(
    alpha=0.9,
    force_amplitude=0.08,
    force_frequency=1.3,
    ripple_amplitude=0.05,
    ripple_frequency=0.7,
    ripple_phase=0.4,
    stiffness_amplitude=0.1,
    stiffness_frequency=2.1,
)
RNG = np.random.default_rng(4)
FORCES = {"force": RNG.uniform(-0.03, 0.03, 70), "hold": 0.3}
ACCELERATIONS = {"belt_acceleration": RNG.uniform(-0.02, 0.02, 70), "hold": 0.3}
COULOMB = NOMINAL.replace(friction="coulomb", mu_k=0.05)
START, DRIVES = ("x", "v"), ("force", "belt_acceleration")
PLANT = ("alpha", "g1", "beta", "mu_s", "mu_m", "v_m", "belt_speed")
EXCITED = [name for name, value in DRIVEN.values.items() if name.startswith(("force_a", "force_f", "ripple", "stiff"))]


def moved(parameters, start, drive, name, change):
    """Return a motion with one thing changed, seen at every 0.25."""
    start, drive = dict(start), dict(drive)
    if name in start:
        start[name] += change
    elif name in DRIVES:
        drive[name] = np.asarray(drive.get(name, 0.0)) + change
    else:
        parameters = parameters.replace(**{name: parameters.values[name] + change})
    return simulate(parameters, **start, t_end=20.0, dt=0.25, **drive)


@pytest.mark.parametrize(
    ("parameters", "start", "drive", "names", "met"),
    [
        (NOMINAL, {"x": 0.5, "v": -0.3}, {}, (*START, *PLANT, *DRIVES), "restick"),
        (NOMINAL, {"x": 1.5, "v": 0.6}, {}, (*START, *PLANT, *DRIVES), "crossing"),
        (DRIVEN, {"x": 0.4, "v": -0.2}, {}, (*START, *PLANT, *DRIVES, *EXCITED), "restick"),
        (NOMINAL, {"x": 0.5, "v": -0.3}, FORCES, (*START, *PLANT, *DRIVES), "restick"),
        (NOMINAL, {"x": 0.5, "v": -0.3}, ACCELERATIONS, (*START, *PLANT, *DRIVES), "restick"),
        (DRIVEN, {"x": 0.4, "v": -0.2}, FORCES, (*START, *PLANT, *DRIVES, *EXCITED), "restick"),
        # On the belt at first: at its speed, ripple included, whatever that is.
        (NOMINAL, {"x": 0.6}, {}, ("x", *PLANT), "breakaway"),
        (DRIVEN, {"x": 0.3}, {}, ("x", *PLANT, *EXCITED), "breakaway"),
        # Friction falls at once where stick ends.
        (COULOMB, {"x": 0.6}, {}, ("x", *PLANT[:4], "mu_k", "belt_speed", *DRIVES), "breakaway"),
    ],
    ids=[
        *("nominal", "crossing", "excited", "forces", "accelerations", "excited, with forces"),
        *("riding", "riding on a ripple", "coulomb"),
    ],
)
def test_sensitivities_agree_with_differences_of_fourth_order(parameters, start, drive, names, met):
    motion = simulate(parameters, **start, t_end=20.0, dt=0.25, **drive, sensitivities=names)
    assert motion.singular_events == 0
    assert met in {event.kind for event in motion.events}
    assert tuple(motion.sensitivities) == names
    for name, found in motion.sensitivities.items():
        step = 1e-3 / max(10.0, np.abs(found).max())
        sides = {k: moved(parameters, start, drive, name, k * step) for k in (-2, -1, 1, 2)}
        # Where an event passes a sample, the differences are taken across its kink.
        same = np.all([side.mode == motion.mode for side in sides.values()], axis=0)
        assert same.mean() > 0.9
        difference = sum(
            weight * np.column_stack((sides[k].x, sides[k].v)) for k, weight in {-2: 1, -1: -8, 1: 8, 2: -1}.items()
        ) / (12.0 * step)
        assert found.shape == (motion.t.size, 2)
        assert np.abs(found - difference)[same].max() < 1e-9 * np.abs(found).max(), name


def test_sensitivities_leave_the_motion_as_it_is():
    plain, followed = (simulate(DRIVEN, x=0.4, t_end=30.0, sensitivities=names) for names in ((), ("alpha", "x")))
    assert np.array_equal(plain.x, followed.x)
    assert plain.events == followed.events
    assert plain.sensitivities == {}


def test_a_motion_that_rides_has_the_sensitivity_of_the_belt():
    riding = simulate(NOMINAL, x=0.3, t_end=2.0, dt=0.5, sensitivities=("belt_speed", "x", "alpha"))
    assert np.all(riding.mode == 0)
    assert riding.sensitivities["belt_speed"] == pytest.approx(np.column_stack((riding.t, np.ones(5))), abs=1e-14)
    assert riding.sensitivities["x"] == pytest.approx(np.tile([1.0, 0.0], (5, 1)), abs=1e-14)
    assert not riding.sensitivities["alpha"].any()
    caught = simulate(NOMINAL, x=0.3, v=NOMINAL.belt_speed, t_end=2.0, dt=0.5, sensitivities=("belt_speed",))
    assert caught.sensitivities["belt_speed"][0].tolist() == [0.0, 0.0]  # v was given: it stays


def test_sensitivities_end_where_contact_is_lost():
    lost = simulate(OscillatorParameters(geometry="cubic", alpha=0.2), x=0.1, v=3.0, t_end=5.0, sensitivities=("v",))
    assert lost.status == "contact lost"
    assert lost.sensitivities["v"].shape == (lost.t.size, 2)
    assert np.isfinite(lost.sensitivities["v"]).all()


def test_a_motion_of_more_samples_than_a_piece_keeps_its_sensitivities():
    fine, coarse = (
        simulate(NOMINAL, x=0.5, v=-0.3, t_end=50.0, dt=dt, sensitivities=("mu_m",)).sensitivities["mu_m"]
        for dt in (0.005, 0.5)
    )
    assert fine[::100] == pytest.approx(coarse, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("alpha", "alpha"), "sensitivities must be different names"),
        ("alpha", "sensitivities must be different names, got 'alpha'"),
        (5, "sensitivities must be different names, got 5"),
        (("wobble",), "unknown parameter 'wobble'; allowed: alpha, "),
        (("v_belt",), "unknown parameter 'v_belt'"),
        (("kappa",), "the plant does not use the parameter 'kappa'"),
        (("force_amplitude",), "the plant does not use the parameter 'force_amplitude'"),
    ],
)
def test_names_that_cannot_be_differentiated_by_are_refused(names, said):
    with pytest.raises(ValueError, match=said):
        simulate(NOMINAL, t_end=1.0, sensitivities=names)


def test_a_short_noisy_record_gives_its_parameters_back():
    """Two cycles of growth: a fifth of the script's record, so five standard deviations are up to a tenth."""
    t, x, noise = identification.record("stribeck", "growth")
    t, x = t[:400], x[:400]
    rng = np.random.default_rng(0)
    found = identification.fit(t, x + noise * rng.standard_normal(t.size), identification.TRUTH * [0.85, 1.2, 1.15])
    errors = np.abs(found.values[:3] - identification.TRUTH)
    assert np.all(errors < 3.0 * found.half_widths[:3])
    assert np.all(errors < [0.01, 0.005, 0.05])
    assert found.noise == pytest.approx(noise, rel=0.1)
    assert abs(found.autocorrelation) < 0.2
