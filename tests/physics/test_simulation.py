"""Histories in time: ends, events, energy, and refusals."""

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, simulate

NOMINAL = OscillatorParameters()


def test_a_history_ends_exactly_at_t_end_and_becomes_a_dataframe():
    history = simulate(NOMINAL, t_end=7.123, dt=0.05)
    assert history.t[-1] == 7.123
    assert history.t[0] == 0.0
    assert np.all(np.diff(history.t) > 0.0)
    frame = history.to_dataframe()
    assert list(frame.columns) == ["t", "x", "v", "v_belt", "mode"]
    assert len(frame) == len(history.t)
    assert simulate(NOMINAL, t_end=0.0).t.tolist() == [0.0]


def test_the_samples_do_not_depend_on_how_often_they_are_taken():
    fine, coarse = (simulate(NOMINAL, x=0.3, v=-0.4, t_end=30.0, dt=dt) for dt in (0.05, 0.5))
    assert fine.x[::10] == pytest.approx(coarse.x, abs=1e-11)
    assert [e.kind for e in fine.events] == [e.kind for e in coarse.events]
    times = [e.time for e in fine.events]
    assert times == pytest.approx([e.time for e in coarse.events], abs=1e-10)


def test_events_alternate_and_carry_the_belt_speed():
    history = simulate(NOMINAL, t_end=60.0)
    kinds = [e.kind for e in history.events]
    assert kinds[:4] == ["breakaway", "restick", "breakaway", "restick"]
    assert all(e.v == NOMINAL.belt_speed for e in history.events)


def test_there_is_no_creep_in_stick():
    history = simulate(NOMINAL, t_end=60.0)
    stuck = history.mode == 0
    assert stuck.sum() > 1000
    assert np.all(history.v[stuck] == NOMINAL.belt_speed)
    edges = np.flatnonzero(np.diff(stuck.astype(int)))
    first, last = edges[1] + 1, edges[2]  # one whole stick phase
    assert history.x[last] - history.x[first] == pytest.approx(0.2 * (history.t[last] - history.t[first]), abs=1e-14)


@pytest.mark.parametrize("geometry", ["exact", "cubic", "linear"])
def test_energy_balances_over_a_thousand_time_units_of_random_forcing(geometry):
    rng = np.random.default_rng(3)
    history = simulate(
        OscillatorParameters(geometry=geometry), t_end=1000.0, dt=1.0, force=rng.uniform(-0.05, 0.05, 10_000), hold=0.1
    )
    assert history.status == "ok"
    assert len(history.events) > 50
    assert history.energy.relative_residual < 1e-8


def test_held_forces_and_belt_accelerations_change_the_motion_at_their_instants():
    history = simulate(NOMINAL, x=0.8, v=0.0, t_end=1.0, dt=0.1, belt_acceleration=[0.5, -0.5], hold=0.5)
    assert history.v_belt[5] == pytest.approx(0.45)
    assert history.v_belt[-1] == pytest.approx(0.2)
    pushed = simulate(NOMINAL, x=0.8, v=0.0, t_end=1.0, dt=0.1, force=[0.0, 0.05], hold=0.5)
    free = simulate(NOMINAL, x=0.8, v=0.0, t_end=1.0, dt=0.1)
    assert pushed.x[5] == pytest.approx(free.x[5], abs=1e-15)
    assert pushed.x[-1] > free.x[-1] + 1e-3


def test_a_history_that_loses_contact_ends_there_and_says_so():
    history = simulate(OscillatorParameters(geometry="cubic", alpha=0.2), x=0.1, v=3.0, t_end=5.0)
    assert history.status == "contact lost"
    assert history.events[-1].kind == "contact-loss"
    assert history.t[-1] == history.events[-1].time < 0.2
    assert history.x[-1] == pytest.approx(0.144**0.5, abs=1e-11)


def test_belt_speed_zero_ends_at_rest():
    history = simulate(NOMINAL.replace(belt_speed=0.0), x=0.3, v=0.5, t_end=100.0)
    assert history.v[-1] == 0.0
    assert history.mode[-1] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x": float("nan")}, "x must be a finite number"),
        ({"v": 11.0}, r"v must be a finite number in \[-10, 10\], got 11.0"),
        ({"t_end": -1.0}, "t_end must be"),
        ({"dt": 0.0}, "dt must be"),
        ({"dt": 1e-6, "t_end": 1e6}, "samples"),
        ({"force": [0.1, 0.2]}, "hold must be given"),
        ({"force": [0.1, 0.2], "hold": 0.1, "t_end": 1.0}, "too few"),
        ({"force": [[0.1]]}, "shape"),
        ({"force": float("inf")}, "force must be finite"),
        ({"force": []}, "shape"),
    ],
)
def test_bad_arguments_are_refused_with_their_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate(NOMINAL, **arguments)
    with pytest.raises(TypeError, match="force must be"):
        simulate(NOMINAL, force="strong")


def kinds_of(history):
    return [event.kind for event in history.events]


@pytest.mark.parametrize(
    ("plant", "start", "belt_acceleration", "events"),
    [
        (NOMINAL, (0.0, 0.2), -0.02, 0),
        (NOMINAL.replace(friction="coulomb", mu_s=0.5, mu_k=0.3), (0.0, 0.2), 0.03, 1),
        (NOMINAL.replace(geometry="linear", mu_s=0.5), (-0.3, 0.2), -0.1, 1),
        (NOMINAL.replace(mu_s=1.0, ripple_amplitude=0.1, ripple_frequency=2.0), (0.0, 0.3), 0.05, 1),
        (NOMINAL.replace(geometry="linear", mu_s=10.0, mu_m=9.0, g1=100.0), (0.0, 0.2), 70.0, 0),  # the belt gets fast
    ],
)
def test_sampling_a_mass_that_rides_an_accelerating_belt_makes_no_events(plant, start, belt_acceleration, events):
    x, v = start
    once = simulate(plant, x=x, v=v, t_end=5.0, dt=100.0, belt_acceleration=belt_acceleration)
    assert len(once.events) == events
    for dt in (0.1, 0.01, 0.001):  # the last in more than one chunk
        history = simulate(plant, x=x, v=v, t_end=5.0, dt=dt, belt_acceleration=belt_acceleration)
        assert kinds_of(history) == kinds_of(once)
        assert history.v[-1] == pytest.approx(once.v[-1], rel=1e-12)
        stuck = history.mode == 0
        assert np.all(abs(history.v[stuck] - history.v_belt[stuck]) <= 1e-14)


def around(time, bits):
    """Times up to so many bits before and after one."""
    times = [time]
    for direction in (0.0, np.inf):
        near = time
        for _ in range(bits):
            near = float(np.nextafter(near, direction))
            times.append(near)
    return times


@pytest.mark.parametrize(
    ("plant", "start", "kind"),
    [
        (NOMINAL, (0.6, 0.2), "restick"),
        (NOMINAL, (0.6, 0.2), "breakaway"),
        (NOMINAL.replace(belt_speed=0.05, mu_s=0.05, mu_m=0.01), (1.3, -0.3), "crossing"),
        (NOMINAL.replace(alpha=0.0, mu_s=0.3), (0.5, -2.0), "switching"),
        (NOMINAL.replace(alpha=0.0, mu_s=2.0, mu_m=1.0), (-0.05, 0.2), "switching"),  # a stuck mass crosses x = 0
        (NOMINAL.replace(geometry="cubic", alpha=0.2), (0.1, 3.0), "contact-loss"),
        (NOMINAL.replace(friction="coulomb", force_amplitude=0.3, force_frequency=1.3), (0.6, 0.2), "restick"),
        (NOMINAL.replace(ripple_amplitude=0.05, ripple_frequency=2.0), (0.6, 0.25), "restick"),
        (NOMINAL.replace(ripple_amplitude=0.05, ripple_frequency=2.0), (0.6, 0.25), "breakaway"),
    ],
)
def test_a_sample_or_a_hold_that_ends_at_an_event_neither_hides_nor_repeats_it(plant, start, kind):
    x, v = start
    once = simulate(plant, x=x, v=v, t_end=15.0, dt=100.0)
    time = next(event.time for event in once.events if event.kind == kind)
    for near in around(time, 30):
        cuts = (
            simulate(plant, x=x, v=v, t_end=15.0, dt=near),
            simulate(plant, x=x, v=v, t_end=15.0, dt=100.0, force=np.zeros(int(15.0 / near) + 2), hold=near),
        )
        for history in cuts:
            assert kinds_of(history) == kinds_of(once)
            assert [e.time for e in history.events] == pytest.approx([e.time for e in once.events], abs=1e-9)
