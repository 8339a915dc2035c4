"""Limit cycles and critical speeds: the reference numbers, closed forms and the laws they obey."""

import math

import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sd_friction_env import OrbitError, OscillatorParameters, critical_belt_speeds, equilibria, limit_cycle, simulate
from sd_friction_env.physics.orbits import balance_points, rest_place

NOMINAL = OscillatorParameters()
CUBIC = OscillatorParameters(geometry="cubic")
LINEAR = OscillatorParameters(geometry="linear")


def test_nominal_cycle_has_the_reference_numbers():
    cycle = limit_cycle(NOMINAL)
    assert cycle.kind == "stick-slip"
    assert cycle.x_breakaway == pytest.approx(0.9003939483, abs=6e-11)
    assert cycle.x_restick == pytest.approx(0.4200879685, abs=6e-11)
    assert cycle.period == pytest.approx(9.473197823, abs=6e-10)
    assert cycle.amplitude == pytest.approx(0.393443261, abs=6e-10)
    assert cycle.x_max == pytest.approx(1.117131185, abs=6e-10)
    assert cycle.x_min == pytest.approx(0.330244663, abs=6e-10)
    assert cycle.period * (1.0 - cycle.stick_fraction) == pytest.approx(7.071667923, abs=6e-10)
    assert cycle.frequency * cycle.period == pytest.approx(1.0)
    assert cycle.angular_frequency == pytest.approx(2.0 * math.pi / cycle.period)


@pytest.mark.parametrize(
    ("parameters", "numbers"),
    [
        (NOMINAL.replace(belt_speed=0.05), {"period": 8.802095841, "amplitude": 0.102684647}),
        (
            CUBIC,
            {
                "x_breakaway": 0.6880088773,
                "x_restick": 0.3775786358,
                "period": 7.209157574,
                "amplitude": 0.277193387,
            },
        ),
        (LINEAR, {"x_breakaway": 0.18, "x_restick": -0.1459116890, "period": 6.799421444, "amplitude": 0.286208719}),
    ],
)
def test_other_cycles_have_the_reference_numbers(parameters, numbers):
    cycle = limit_cycle(parameters)
    for name, value in numbers.items():
        assert getattr(cycle, name) == pytest.approx(value, abs=6e-10), name


@pytest.mark.parametrize(
    ("belt_speed", "amplitude"),
    [
        (0.05, 0.08663),
        (0.1, 0.16566),
        (0.2, 0.28621),
        (0.3, 0.35930),
        (0.35, 0.38255),
        (0.39, 0.39634),
        (0.4, 0.37934),
        (0.42, 0.27199),
    ],
)
def test_linear_belt_has_the_reference_amplitudes(belt_speed, amplitude):
    cycle = limit_cycle(LINEAR.replace(belt_speed=belt_speed))
    assert cycle.amplitude == pytest.approx(amplitude, abs=6e-6)
    assert cycle.kind == ("stick-slip" if belt_speed < 0.3958 else "pure-slip")


def test_hopf_speeds_have_the_reference_numbers():
    assert critical_belt_speeds(CUBIC)[1] == pytest.approx(0.4363322339, abs=6e-11)
    assert critical_belt_speeds(NOMINAL)[1] == pytest.approx(0.4371980496, abs=6e-11)
    # linear: v_b1 = v_m sqrt(1 - 4 beta v_m/(3 g1 (mu_s - mu_m)))
    assert critical_belt_speeds(LINEAR)[1] == pytest.approx(0.5 * math.sqrt(1.0 - 0.1 / 0.45), rel=1e-12)


@pytest.mark.parametrize(
    ("ratio", "v_b0", "v_b1"),
    [(0.085, 0.0982, 0.1088), (0.12, 0.2658, 0.2929), (0.18, 0.3447, 0.3794), (0.25, 0.3834, 0.4200)],
)
def test_critical_speeds_of_the_papers_figure_5(ratio, v_b0, v_b1):
    speeds = critical_belt_speeds(CUBIC.replace(mu_m=0.2 - 0.5 * ratio))
    assert speeds.v_b1 == pytest.approx(v_b1, abs=6e-5)
    assert speeds.v_b0 == pytest.approx(v_b0, abs=6e-5)
    assert speeds.reason == ""


@pytest.mark.parametrize(
    ("parameters", "low", "high"),
    [(NOMINAL, 0.398, 0.4), (CUBIC, 0.4, 0.402), (CUBIC.replace(mu_m=0.2 - 0.5 * 0.085), 0.0975, 0.099)],
)
def test_the_graze_is_where_scipys_greatest_v_rel_after_breakaway_is_zero(parameters, low, high):
    # An event finder that waits for v_rel to change sign misses the two close crossings before a graze and puts v_b0
    # too low (exact: .3986 with SciPy's own step sizes); the root of the maximum has no such trap.
    def greatest_v_rel(speed):
        p = parameters.replace(belt_speed=speed)
        (start,) = [x for x in balance_points(p, 2.0 * p.beta * speed, p.mu_s) if x > 0.0][-1:]

        def slip(t, y):
            restoring, normal = p.restoring_force(y[0]), p.normal_force(y[0])
            w = y[1] - speed
            return [y[1], -2.0 * p.beta * y[1] - restoring + (p.mu_s + p.k1 * w - p.k3 * w**3) * normal]

        def top(t, y):
            return slip(t, y)[1] if t > 4.0 and y[1] > 0.0 else 1.0

        top.direction, top.terminal = -1, True
        run = solve_ivp(slip, (0.0, 14.0), [start, speed], "DOP853", rtol=1e-12, atol=1e-14, max_step=0.05, events=top)
        return run.y_events[0][0][1] - speed

    root = brentq(greatest_v_rel, low, high, xtol=1e-12)
    assert critical_belt_speeds(parameters).v_b0 == pytest.approx(root, rel=1e-8)


@pytest.mark.parametrize("parameters", [NOMINAL, CUBIC, LINEAR, NOMINAL.replace(alpha=0.5), CUBIC.replace(g1=0.8)])
def test_stick_slip_ends_at_v_b0_and_oscillation_at_v_b1(parameters):
    v_b0, v_b1 = critical_belt_speeds(parameters)

    def kind(belt_speed):
        return limit_cycle(parameters.replace(belt_speed=belt_speed)).kind

    assert kind(v_b0 - 1e-9) == "stick-slip"
    assert kind(v_b0 + 1e-9) == "pure-slip"
    assert kind(v_b1 - 1e-6) == "pure-slip"
    assert kind(v_b1 + 1e-6) == "steady-slip"


def test_amplitude_vanishes_at_v_b1_as_a_square_root():
    v_b1 = critical_belt_speeds(LINEAR).v_b1
    for lead in (1e-3, 1e-4, 1e-5):
        v_b = v_b1 - lead
        closed_form = 2.0 * math.sqrt(v_b1**2 - v_b**2)
        assert limit_cycle(LINEAR.replace(belt_speed=v_b)).amplitude == pytest.approx(closed_form, rel=0.02)


def test_nothing_oscillates_without_falling_friction_and_the_reason_says_so():
    speeds = critical_belt_speeds(NOMINAL.replace(mu_m=0.2))
    assert all(math.isnan(value) for value in speeds)
    assert "nothing oscillates" in speeds.reason
    v_b0, v_b1 = speeds
    assert limit_cycle(NOMINAL.replace(mu_m=0.2)).kind == "steady-slip"


def test_steady_slip_equilibria_have_the_reference_places():
    assert equilibria(CUBIC)[-1].x == pytest.approx(0.64467779, abs=6e-9)
    assert equilibria(NOMINAL)[-1].x == pytest.approx(0.81825172, abs=6e-9)
    assert not equilibria(NOMINAL)[-1].stable
    assert equilibria(NOMINAL.replace(belt_speed=0.45))[-1].stable


def test_every_equilibrium_balances_and_both_wells_have_theirs():
    p = NOMINAL.replace(alpha=0.2)
    places = [e.x for e in equilibria(p)]
    assert len(places) == 3
    coefficient = -p.friction_coefficient(-p.belt_speed)
    for x in places:
        assert p.restoring_force(x) == pytest.approx(coefficient * p.normal_force(x), abs=1e-12)


def test_two_wells_hold_two_attractors_and_the_start_decides():
    p = NOMINAL.replace(alpha=0.2)
    left, right = limit_cycle(p, -1.0, 0.0), limit_cycle(p, 1.0, 0.0)
    assert left.x_max < 0.0 < right.x_min
    assert (left.x_start, left.v_start) == (-1.0, 0.0)
    # and the default start is a mass set down at x = 0 moving with the belt
    default = limit_cycle(p)
    assert (default.x_start, default.v_start) == (0.0, p.belt_speed)
    assert default.amplitude == right.amplitude


def test_belt_speed_zero_is_rest():
    cycle = limit_cycle(NOMINAL.replace(belt_speed=0.0), 1.5, 0.0)
    assert (cycle.kind, cycle.amplitude) == ("rest", 0.0)
    assert abs(NOMINAL.restoring_force(cycle.x_max)) <= 0.2 * NOMINAL.normal_force(cycle.x_max)


@pytest.mark.parametrize("belt_speed", [0.3986, 0.399, 0.4])
def test_a_growing_slip_is_followed_no_further_out_than_it_goes(belt_speed):
    # A little outside of this cycle the mass would lose contact; the motion itself keeps it.
    parameters = CUBIC.replace(alpha=0.2, belt_speed=belt_speed)
    cycle = limit_cycle(parameters, rest_place(parameters), 0.0)
    history = simulate(parameters, rest_place(parameters), 0.0, 400.0, dt=0.005)
    assert history.status == "ok"
    assert history.amplitude(since=350.0) == pytest.approx(cycle.amplitude, rel=1e-4)


@pytest.mark.parametrize("ratio", [0.12, 0.15, 0.18, 0.25, 0.3])
@pytest.mark.parametrize("geometry", ["cubic", "exact", "linear"])
def test_the_cycle_at_v_b0_itself_is_the_end_of_both_branches(geometry, ratio):
    parameters = OscillatorParameters(geometry=geometry, mu_m=0.2 - 0.5 * ratio)
    v_b0 = critical_belt_speeds(parameters).v_b0
    at, before, after = (
        limit_cycle(parameters.replace(belt_speed=speed)).amplitude for speed in (v_b0, v_b0 - 1e-8, v_b0 + 1e-8)
    )
    assert at == pytest.approx(before, rel=1e-6)
    assert at == pytest.approx(after, rel=1e-6)


def test_an_overdamped_mass_creeps_to_its_equilibrium_and_is_not_followed_for_ever():
    p = NOMINAL.replace(beta=3.0, mu_m=0.2)
    cycle = limit_cycle(p, 0.5, -1.0)
    assert cycle.kind == "steady-slip"
    assert cycle.x_max == pytest.approx(equilibria(p)[-1].x, abs=1e-12)


def test_a_cycle_is_what_a_long_simulation_settles_to():
    for parameters in (NOMINAL, CUBIC.replace(belt_speed=0.41), NOMINAL.replace(alpha=0.5, belt_speed=0.3)):
        cycle = limit_cycle(parameters)
        history = simulate(parameters, t_end=600.0, dt=0.01)
        assert history.amplitude(since=500.0) == pytest.approx(cycle.amplitude, rel=2e-5)


def test_the_states_of_a_cycle_return_after_a_period():
    for parameters in (NOMINAL, NOMINAL.replace(belt_speed=0.41)):
        cycle = limit_cycle(parameters)
        x, v = cycle.state(0.3)
        later = simulate(parameters, x, v, cycle.period, dt=1.0)
        assert (later.x[-1], later.v[-1]) == pytest.approx((x, v), abs=1e-9)


def test_a_pure_slip_cycle_attracts_at_the_rate_of_its_floquet_multiplier():
    parameters = NOMINAL.replace(belt_speed=0.42)
    cycle = limit_cycle(parameters)
    off = 1e-4
    later = simulate(parameters, cycle.x_max + off, 0.0, cycle.period * 1.1, dt=1e-3)
    peak = later.x[later.t > 0.9 * cycle.period].max()
    assert (peak - cycle.x_max) / off == pytest.approx(cycle.floquet_multiplier, abs=2e-3)
    assert 0.0 < cycle.floquet_multiplier < 1.0


def test_an_orbit_that_loses_contact_is_an_error_that_says_where():
    with pytest.raises(OrbitError, match=r"loses contact .* x = "):
        limit_cycle(CUBIC.replace(alpha=0.1, belt_speed=0.39))


def test_bad_starts_are_refused():
    with pytest.raises(ValueError, match="x must be a finite number"):
        limit_cycle(NOMINAL, math.inf)
    with pytest.raises(TypeError, match="v must be a real number"):
        limit_cycle(NOMINAL, 0.0, "fast")


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        ("pure-slip", {"geometry": "linear", "beta": 0.0, "mu_s": 0.03789554834773526, "mu_m": 0.0}),
        (
            "stick-slip",
            {
                "geometry": "cubic",
                "alpha": 0.13698299743584144,
                "mu_s": 0.0295065127933634,
                "mu_m": 0.001723479274261927,
                "v_m": 0.15979574865857518,
                "belt_speed": 0.07431409383302855,
            },
        ),
    ],
)
def test_a_mass_that_overtakes_the_belt_without_sticking_is_followed(kind, arguments):
    parameters = OscillatorParameters(**arguments)
    cycle = limit_cycle(parameters)
    assert cycle.kind == kind
    late = simulate(parameters, x=0.0, v=parameters.belt_speed, t_end=3000.0)
    assert cycle.amplitude == pytest.approx(late.amplitude(since=2800.0), rel=5e-3)
    if kind == "pure-slip":
        assert cycle.forward_arcs == 1
        assert abs(cycle.floquet_multiplier) < 1.0


@pytest.mark.parametrize("geometry", ["exact", "cubic", "linear"])
def test_a_motion_that_neither_gains_nor_loses_is_a_closed_orbit_or_does_not_settle(geometry):
    parameters = OscillatorParameters(geometry=geometry, alpha=0.2, beta=0.0, mu_s=0.0, mu_m=0.0)
    try:
        cycle = limit_cycle(parameters)  # rounding decides whether one maximum equals the next
    except OrbitError as error:
        assert "does not settle" in str(error)  # noqa: PT017 - either is right
    else:
        assert cycle.floquet_multiplier == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("geometry", ["exact", "cubic"])
def test_the_multiplier_is_one_sided_where_the_orbit_just_above_touches_the_belt(geometry):
    parameters = OscillatorParameters(geometry=geometry)
    graze = critical_belt_speeds(parameters).v_b0
    at, beyond = (limit_cycle(parameters.replace(belt_speed=speed)) for speed in (graze + 1e-9, graze + 2e-3))
    assert at.kind == beyond.kind == "pure-slip"
    assert at.floquet_multiplier == pytest.approx(beyond.floquet_multiplier, abs=0.03)


@pytest.mark.parametrize("below", [1e-12, 1e-10, 1e-9, 1e-8, 1e-6])
@pytest.mark.parametrize("start", [(0.15, None), (0.1, 0.0)])
def test_a_cycle_too_small_for_a_lap_to_be_told_from_rounding_has_the_amplitude_of_theory(below, start):
    # Thomsen and Fidlin (2003): A = 2 sqrt(v_b1^2 - v_b^2) to first order.
    plant = OscillatorParameters(geometry="linear")
    v_b1 = critical_belt_speeds(plant).v_b1
    cycle = limit_cycle(plant.replace(belt_speed=v_b1 - below), *start)
    assert cycle.kind == "pure-slip"
    assert cycle.amplitude == pytest.approx(2.0 * math.sqrt(v_b1**2 - (v_b1 - below) ** 2), rel=3e-4)
    assert limit_cycle(plant.replace(belt_speed=v_b1 + 1e-9), *start).kind == "steady-slip"
