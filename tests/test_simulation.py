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
