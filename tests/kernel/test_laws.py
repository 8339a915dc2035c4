"""The laws beyond the paper's, one by one and together, against SciPy's oracle, closed forms and the laws of mechanics:
other friction, Duffing's spring, the discontinuous limit alpha = 0, excitation by force, ripple and stiffness."""

import itertools
import math
import struct

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sd_friction_env import (
    OscillatorParameters,
    SDFrictionEnv,
    SDFrictionVectorEnv,
    attractors,
    critical_belt_speeds,
    equilibria,
    kernel,
    limit_cycle,
    simulate,
    stick_intervals,
)
from sd_friction_env.environments.info import numbers_of
from sd_friction_env.physics import theory
from sd_friction_env.physics.basins import basins
from sd_friction_env.physics.orbits import first_lyapunov_coefficient, grazing_belt_speed, hopf_belt_speed, slip_cycles
from sd_friction_env.physics.parameters import FRICTIONS
from tests import oracle

pytestmark = pytest.mark.usefixtures("either_way")
SPRINGS = ("exact", "cubic", "linear", "duffing", "discontinuous")


KINDS = {
    "stick": kernel.RESTICK,
    "cross": kernel.CROSSING,
    "breakaway": kernel.BREAKAWAY,
    "contact-loss": kernel.CONTACT_LOSS,
    "switch": kernel.SWITCHING,
}
DISCONTINUOUS = OscillatorParameters(alpha=0.0)
# Friction strong enough to hold a mass on either side of x = 0: mu_s g1 >= 1 + 2 beta v_b.
HELD = OscillatorParameters(alpha=0.0, friction="coulomb", mu_s=1.5, mu_k=0.5)
EXCITED = {
    "force_amplitude": 0.3,
    "force_frequency": 1.7,
    "force_phase": 0.4,
    "ripple_amplitude": 0.15,
    "ripple_frequency": 2.3,
    "ripple_phase": -1.1,
    "stiffness_amplitude": 0.2,
    "stiffness_frequency": 3.1,
    "stiffness_phase": 2.0,
}


def spring(name):
    return {"geometry": "exact", "alpha": 0.0} if name == "discontinuous" else {"geometry": name}


def excitation(rng, kinds, slowest=0.3, fastest=6.0):
    """Random excitation of some of the three kinds."""
    values = {}
    for kind in kinds:
        most = 0.6 if kind == "stiffness" else 0.5
        values[f"{kind}_amplitude"] = rng.uniform(0.05, most)
        values[f"{kind}_frequency"] = math.exp(rng.uniform(math.log(slowest), math.log(fastest)))
        values[f"{kind}_phase"] = rng.uniform(-4.0, 4.0)
    return values


def random_plant(rng, geometry, friction, kinds=(), **frequencies):
    mu_s = rng.uniform(0.05, 0.8)
    values = {
        "alpha": rng.uniform(0.15, 1.3),
        "g1": rng.uniform(0.5, 2.0),
        "beta": rng.uniform(0.0, 0.2),
        "mu_s": mu_s,
        "mu_m": mu_s * rng.uniform(0.1, 1.0),
        "mu_k": mu_s * rng.uniform(0.1, 1.0),
        "v_m": rng.uniform(0.2, 1.0),
        "delta": rng.uniform(0.0, 10.0),
        "v_0": rng.uniform(0.1, 1.0),
        "mu_v": max(0.0, rng.uniform(-0.3, 0.3)),
        "kappa": rng.uniform(0.0, 2.0),
        "belt_speed": rng.uniform(0.02, 0.6),
    }
    return OscillatorParameters(
        friction=friction, **{**values, **spring(geometry)}, **excitation(rng, kinds, **frequencies)
    )


def random_start(rng, parameters):
    """A start in contact; one in four on the switching surface, one in three on the belt."""
    x = 0.0 if rng.random() < 0.25 else rng.uniform(-1.5, 1.5)
    if parameters.normal_force(x) <= 0.0:
        x = 0.0
    if rng.random() < 0.33:
        return x, parameters.first_belt_speed
    return x, rng.uniform(-0.8, 0.8)


def agrees_with_oracle(parameters, x, v, duration, u=0.0, a_belt=0.0, v_belt=None, time=0.0, within=1e-8):
    """Follow one held interval with both, compare all that the kernel returns, and return the oracle's run."""
    v_belt = parameters.belt_speed if v_belt is None else v_belt
    events = np.full((kernel.MAX_EVENTS, 4), np.nan)
    plant = kernel.at_time(parameters.plant, time)
    x_end, v_end, belt, mode, status, t, n, int_v2, stick_time, int_fv, x_min, x_max = kernel.advance(
        plant, kernel.State(x, v), kernel.Drive(v_belt, a_belt, u), duration, events
    )
    theirs = oracle.run(parameters, x, v, [(duration, u, a_belt)], v_belt, time)
    case = f"{parameters}, x={x!r}, v={v!r}, u={u!r}, a_belt={a_belt!r}, v_belt={v_belt!r}, time={time!r}"
    assert events[:n, 1].astype(int).tolist() == [KINDS[event.kind] for event in theirs.events], case
    assert status == (kernel.CONTACT_LOST if theirs.contact_lost else kernel.OK), case
    assert theirs.contact_lost or mode == theirs.mode, case
    assert events[:n, 0] + time == pytest.approx([event.time for event in theirs.events], abs=within), case
    assert events[:n, 2] == pytest.approx([event.x for event in theirs.events], abs=within), case
    assert events[:n, 3] == pytest.approx([event.v for event in theirs.events], abs=within), case
    ours = [x_end, v_end, belt, t + time, int_v2, stick_time, int_fv, x_min, x_max]
    wanted = [
        theirs.x, theirs.v, theirs.v_belt, theirs.t, theirs.v_squared, theirs.time_stuck, theirs.contact_work,
        theirs.x_min, theirs.x_max,
    ]  # fmt: skip
    assert ours == pytest.approx(wanted, abs=within), case
    # Work in equals energy gained.
    gained = 0.5 * (v_end * v_end - v * v) + kernel.energy_in_spring(kernel.at_time(plant, t), x_end)
    gained -= kernel.energy_in_spring(plant, x)
    works = [-2.0 * parameters.beta * int_v2, int_fv, u * (x_end - x), theirs.excitation_work]
    assert gained == pytest.approx(sum(works), abs=within), case
    return theirs


# Reference numbers ----------------------------------------------------------------------------------------------------

COULOMB = OscillatorParameters(geometry="linear", friction="coulomb", beta=0.0)
LEINE = OscillatorParameters(geometry="linear", friction="hyperbolic", beta=0.0, mu_s=1.0, delta=3.0, belt_speed=0.2)
EXPONENTIAL = OscillatorParameters(geometry="linear", friction="exponential", mu_s=1.0, mu_k=0.5, v_0=0.5, beta=0.05)


@pytest.mark.parametrize("v_b", [0.05, 0.2, 0.6, 1.5])
@pytest.mark.parametrize(("static", "kinetic"), [(0.4, 0.2), (1.0, 0.3), (2.0, 1.9), (0.2, 0.0)])
def test_two_level_coulomb_friction_has_the_period_and_amplitude_solved_by_hand(v_b, static, kinetic):
    cycle = limit_cycle(COULOMB.replace(mu_s=static, mu_k=kinetic, belt_speed=v_b))
    assert cycle.kind == "stick-slip"
    assert cycle.period == pytest.approx(theory.coulomb_two_level_period(v_b, static - kinetic), abs=1e-12)
    assert cycle.amplitude == pytest.approx(theory.coulomb_two_level_amplitude(v_b, static - kinetic), abs=1e-12)
    assert cycle.stick_fraction * cycle.period == pytest.approx(2.0 * (static - kinetic) / v_b, abs=1e-11)


def test_leines_cycle():
    cycle = limit_cycle(LEINE)
    # The kernel's rule leaves 1e-10 per unit of time; the reference is SciPy's to its last digit (next test).
    assert cycle.period == pytest.approx(12.001031294826, abs=1e-9)
    assert cycle.x_max == pytest.approx(1.133944676443, abs=1e-9)


def taylor(x, v, v_b, delta, order=24):
    """Coefficients of x(t) and v(t) of x'' = -x + 1/(1 + delta (v_b - v)), by recurrence."""
    xs, vs, denominators, quotients = [x], [v], [1.0 + delta * (v_b - v)], []
    for k in range(order):
        convolved = sum(denominators[j] * quotients[k - j] for j in range(1, k + 1))
        quotients.append(((1.0 if k == 0 else 0.0) - convolved) / denominators[0])
        xs.append(vs[k] / (k + 1))
        vs.append((quotients[k] - xs[k]) / (k + 1))
        denominators.append(-delta * vs[k + 1])
    return xs, vs


def test_leines_reference_numbers_are_those_of_the_oracle_and_of_taylor_series():
    # With 30 digits the series gives 12.00103129483058 and 1.13394467644166: the reference is right to 5e-12.
    def value(coefficients, t):
        return math.fsum(c * t**k for k, c in enumerate(coefficients))

    x, v, t, step, highest = 1.0, 0.2, 0.0, 0.02, math.nan
    while True:
        xs, vs = taylor(x, v, 0.2, 3.0)
        if v > 0.0 >= value(vs, step):
            highest = value(xs, brentq(lambda s, vs=vs: value(vs, s), 0.0, step, xtol=1e-15))
        if t > 1.0 and value(vs, step) >= 0.2:
            landing = brentq(lambda s, vs=vs: value(vs, s) - 0.2, 0.0, step, xtol=1e-15)
            break
        x, v, t = value(xs, step), value(vs, step), t + step
    cycle = oracle.cycle(LEINE)
    for period, x_max in [(t + landing + (1.0 - value(xs, landing)) / 0.2, highest), (cycle.period, cycle.x_max)]:
        assert period == pytest.approx(12.001031294826, abs=1e-11)
        assert x_max == pytest.approx(1.133944676443, abs=1e-11)


@pytest.mark.parametrize(
    ("x", "v", "within"), [(12.0, 6.0, 1e-8), (10.0, -10.0, 1e-10), (-7.3, 2.0, 1e-10), (0.4, 0.9, 1e-10)]
)
def test_coulomb_friction_brings_a_spring_to_rest_where_half_circles_say(x, v, within):
    parameters = COULOMB.replace(mu_s=1.0, mu_k=1.0, belt_speed=0.0)
    end = kernel.advance(parameters.plant, kernel.State(x, v), kernel.Drive(0.0, 0.0, 0.0), 60.0, None)
    assert end[:2] == pytest.approx((theory.coulomb_rest_x(x, v), 0.0), abs=1e-10)
    assert end[3] == kernel.STICK
    if x > 10.0:
        assert end[0] == pytest.approx(0.68217894, abs=within)
    else:
        assert limit_cycle(parameters, x, v).kind == "rest"
        assert limit_cycle(parameters, x, v).x_max == pytest.approx(end[0], abs=1e-12)


def test_the_exponential_laws_hopf_point_and_the_end_of_its_cycle():
    speeds = critical_belt_speeds(EXPONENTIAL)
    assert speeds.v_b1 == pytest.approx(0.5 * math.log(10.0), abs=1e-9)
    assert speeds.v_b1 == hopf_belt_speed(EXPONENTIAL)
    assert speeds.v_b1 == pytest.approx(theory.exponential_hopf_belt_speed(1.0, 0.5, 0.5, 0.05), abs=1e-12)
    assert speeds.v_b0 == pytest.approx(1.8366, abs=1e-4)
    assert speeds.v_b0 == grazing_belt_speed(EXPONENTIAL)
    assert first_lyapunov_coefficient(EXPONENTIAL) > 0.0


def test_the_oracle_finds_the_same_critical_speeds_of_the_exponential_law():
    speeds = critical_belt_speeds(EXPONENTIAL)
    assert oracle.hopf(EXPONENTIAL) == pytest.approx(speeds.v_b1, abs=1e-10)
    assert oracle.grazing(EXPONENTIAL) == pytest.approx(speeds.v_b0, abs=1e-8)


def test_between_hopf_and_graze_the_exponential_law_has_two_attractors_and_an_unstable_cycle_between():
    between = EXPONENTIAL.replace(belt_speed=1.5)
    (place,) = equilibria(between)
    assert place.stable
    (ridge,) = slip_cycles(between)
    assert ridge.floquet_multiplier > 1.0
    below, above = (limit_cycle(between, ridge.x_max + by, 0.0) for by in (-1e-4, 1e-4))
    assert (below.kind, above.kind) == ("steady-slip", "stick-slip")


@pytest.mark.slow
@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_the_exponential_laws_attractors_below_between_and_above_its_critical_speeds():
    for speed, kinds in [(1.1, ["stick-slip"]), (1.5, ["steady-slip", "stick-slip"]), (1.84, ["steady-slip"])]:
        assert sorted(found.kind for found in attractors(EXPONENTIAL.replace(belt_speed=speed))) == kinds


def test_duffings_spring_stiffens_the_cycle_as_the_oracle_says():
    for kappa, friction in [(0.3, "stribeck"), (2.0, "hyperbolic"), (1.0, "coulomb"), (5.0, "exponential")]:
        parameters = OscillatorParameters(geometry="duffing", kappa=kappa, friction=friction, beta=0.0)
        ours, theirs = limit_cycle(parameters), oracle.cycle(parameters)
        assert (ours.kind, theirs.kind) == ("stick-slip", "stick-slip")
        wanted = [theirs.period, theirs.amplitude, theirs.x_max, theirs.x_restick, theirs.stick_fraction]
        reached = [ours.period, ours.amplitude, ours.x_max, ours.x_restick, ours.stick_fraction]
        assert reached == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("friction", ["coulomb", "hyperbolic", "exponential"])
@pytest.mark.parametrize("geometry", ["exact", "cubic", "linear", "discontinuous"])
def test_every_friction_law_has_the_oracles_cycle_on_every_spring(geometry, friction):
    parameters = OscillatorParameters(friction=friction, mu_s=0.3, mu_k=0.1, belt_speed=0.15, **spring(geometry))
    start = (1.0, 0.15)
    ours, theirs = limit_cycle(parameters, *start), oracle.cycle(parameters, *start)
    assert ours.kind == theirs.kind
    for name in ("amplitude", "x_max", "x_min"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), abs=1e-8), name
    if ours.kind == "stick-slip":
        assert ours.period == pytest.approx(theirs.period, abs=1e-8)


# Trajectories ---------------------------------------------------------------------------------------------------------


PAIRS = list(itertools.product(SPRINGS, FRICTIONS))


@pytest.mark.parametrize(("geometry", "friction"), PAIRS)
def test_random_motions_are_the_oracles(geometry, friction):
    rng = np.random.default_rng([11, SPRINGS.index(geometry), FRICTIONS.index(friction)])
    for _ in range(4):
        parameters = random_plant(rng, geometry, friction)
        x, v = random_start(rng, parameters)
        agrees_with_oracle(parameters, x, v, 5.0, rng.uniform(-0.1, 0.1), rng.uniform(-0.15, 0.15))


SETS = [kinds for n in (1, 2, 3) for kinds in itertools.combinations(("force", "ripple", "stiffness"), n)]


@pytest.mark.parametrize("friction", FRICTIONS)
@pytest.mark.parametrize("kinds", SETS, ids="+".join)
def test_random_excited_motions_are_the_oracles(kinds, friction):
    rng = np.random.default_rng([12, SETS.index(kinds), FRICTIONS.index(friction)])
    for geometry in ("exact", "linear", "discontinuous"):
        parameters = random_plant(rng, str(geometry), friction, kinds)
        x, v = random_start(rng, parameters)
        agrees_with_oracle(parameters, x, v, 4.0, rng.uniform(-0.1, 0.1), rng.uniform(-0.15, 0.15))


@pytest.mark.parametrize("kind", ["force", "ripple", "stiffness"])
def test_fast_excitation_is_followed(kind):
    rng = np.random.default_rng([13, len(kind)])
    for geometry in ("exact", "linear", "discontinuous"):
        parameters = random_plant(rng, geometry, "stribeck", [kind], slowest=20.0, fastest=60.0)
        agrees_with_oracle(parameters, *random_start(rng, parameters), 2.0)


@pytest.mark.parametrize(("geometry", "friction"), PAIRS)
def test_the_slopes_that_events_are_looked_for_with_are_those_of_the_motion(geometry, friction):
    # A wrong slope leaves found events right (they are bracketed) and loses pairs of crossings within one step.
    rng = np.random.default_rng([18, SPRINGS.index(geometry), FRICTIONS.index(friction)])
    plant = random_plant(rng, geometry, friction, ("force", "ripple", "stiffness")).plant
    x, v, a_belt, h = 0.7, -0.3, 0.05, 1e-4

    def acceleration(t):
        x_t, v_t = kernel.slip_step(plant, -1, kernel.State(x, v), kernel.Drive(0.2, a_belt, 0.03), t)[:2]
        return kernel.slip_acceleration(
            kernel.at_time(plant, t), -1, kernel.State(x_t, v_t), kernel.Drive(0.2 + a_belt * t, 0.0, 0.03)
        )

    jerk = kernel.slip_jerk(plant, -1, x, v, 0.2, a_belt, acceleration(0.0))
    assert jerk == pytest.approx((acceleration(h) - acceleration(-h)) / (2.0 * h), abs=1e-5)
    for side in (-1, 1):
        low, (_, slope), high = (
            kernel.cone_excess(plant, side, x, kernel.Drive(0.2, a_belt, 0.03), t) for t in (-h, 0.0, h)
        )
        assert slope == pytest.approx((high[0] - low[0]) / (2.0 * h), abs=1e-5)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_gap_to_the_belt_is_looked_at_with_its_own_slope_and_curvature(side):
    plant = random_plant(np.random.default_rng(19), "exact", "stribeck", ("force", "stiffness")).plant
    surface, h = kernel.Surface(side, 0.2, 0.05, False), 1e-4
    before, at, after = (
        kernel.look_at(plant, -1, kernel.State(0.7, -0.3), kernel.Drive(0.2, 0.05, 0.03), t, surface)
        for t in (-h, 0.0, h)
    )
    assert at.slope == pytest.approx((after.gap - before.gap) / (2.0 * h), abs=1e-5)
    assert at.curvature == pytest.approx((after.slope - before.slope) / (2.0 * h), abs=1e-5)


def test_time_zero_is_the_callers():
    rng = np.random.default_rng(14)
    for time in (0.7, 31.4, 500.0):
        parameters = random_plant(rng, "exact", "exponential", ("force", "ripple", "stiffness"))
        agrees_with_oracle(parameters, 0.3, -0.2, 3.0, time=time)


@pytest.mark.parametrize("geometry", SPRINGS)
def test_an_interval_cut_in_two_ends_as_the_whole(geometry):
    rng = np.random.default_rng([15, SPRINGS.index(geometry)])
    for friction in FRICTIONS:
        parameters = random_plant(rng, geometry, friction, ("force", "ripple", "stiffness"))
        x, v = random_start(rng, parameters)
        u, a_belt, plant = rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), parameters.plant
        whole = kernel.advance(plant, kernel.State(x, v), kernel.Drive(parameters.belt_speed, a_belt, u), 2.0, None)
        cut = rng.uniform(0.1, 1.9)
        first = kernel.advance(plant, kernel.State(x, v), kernel.Drive(parameters.belt_speed, a_belt, u), cut, None)
        second = kernel.advance(
            kernel.at_time(plant, cut), kernel.State(*first[:2]), kernel.Drive(first[2], a_belt, u), 2.0 - cut, None
        )
        # Other steps make other errors, each within the rule: 1e-10 per unit of time.
        assert second[:3] == pytest.approx(whole[:3], abs=2e-10), parameters
        assert first[7] + second[7] == pytest.approx(whole[7], abs=2e-10)
        assert min(first[10], second[10]) == pytest.approx(whole[10], abs=2e-10)
        assert max(first[11], second[11]) == pytest.approx(whole[11], abs=2e-10)


def test_a_ride_cut_in_two_ends_as_the_whole_to_rounding():
    parameters = OscillatorParameters(geometry="linear", mu_s=0.9, ripple_amplitude=0.05, ripple_frequency=3.0)
    plant, v = parameters.plant, parameters.first_belt_speed
    whole = kernel.advance(plant, kernel.State(-0.4, v), kernel.Drive(0.2, 0.0, 0.0), 3.0, None)
    assert whole[8] == 3.0
    for cut in np.linspace(0.05, 2.95, 59).tolist():
        first = kernel.advance(plant, kernel.State(-0.4, v), kernel.Drive(0.2, 0.0, 0.0), cut, None)
        second = kernel.advance(
            kernel.at_time(plant, cut), kernel.State(*first[:2]), kernel.Drive(first[2], 0.0, 0.0), 3.0 - cut, None
        )
        assert second[:2] == pytest.approx(whole[:2], abs=1e-14)
        assert first[6] + second[6] == 0
        assert first[7] + second[7] == pytest.approx(whole[7], abs=1e-14)


def test_an_excitation_that_is_not_there_changes_no_bit():
    rng = np.random.default_rng(16)
    for draw in range(300):
        geometry = ("exact", "cubic", "linear")[draw % 3]
        parameters = random_plant(rng, geometry, "stribeck")
        x, v = random_start(rng, parameters)
        v_belt = rng.uniform(-0.3, 0.6)
        state = kernel.State(x, v_belt if rng.random() < 0.3 else v)
        drive = kernel.Drive(v_belt, rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3))
        duration = (0.1, 1.0, 5.0)[draw % 7 % 3]
        plain = kernel.advance(parameters.plant, state, drive, duration, None)
        general = kernel.advance(parameters.excited_plant(0.0), state, drive, duration, None)
        assert struct.pack("<12d", *plain) == struct.pack("<12d", *general), (parameters, state, drive)


# The discontinuous limit ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x", "v"),
    [(0.0, 0.5), (0.0, -0.5), (0.0, 0.0), (0.0, 1e-9), (0.0, -1e-9), (0.0, 2.5), (0.0, 0.2), (1.0, 2.0), (0.5, -1.8),
     (-1.0, 3.0), (2.5, 0.0), (-2.5, 0.0)],
)  # fmt: skip
def test_at_alpha_zero_x_passes_zero_in_slip_as_the_oracle_says(x, v):
    agrees_with_oracle(DISCONTINUOUS, x, v, 9.0)


def test_a_mass_from_far_out_passes_zero_several_times_and_both_ways():
    parameters = DISCONTINUOUS.replace(beta=0.0, friction="coulomb", mu_s=0.05, mu_k=0.02)
    end = agrees_with_oracle(parameters, 4.0, 0.0, 14.0)
    passes = [event.v for event in end.events if event.kind == "switch"]
    assert len(passes) >= 4
    assert min(passes) < 0.0 < max(passes)


@pytest.mark.parametrize("miss", [1e-3, 1e-6, 1e-9, -1e-9, -1e-6, -1e-3])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_mass_that_turns_just_before_or_after_zero_stays_or_passes(side, miss):
    # Without friction and damping it turns where its energy says: the hill at x = 0 is .5 high above the wells.
    parameters = DISCONTINUOUS.replace(beta=0.0, mu_s=0.0, mu_m=0.0)
    speed = math.sqrt(2.0 * (0.5 - 0.5 * 0.25)) * (1.0 - miss)
    end = agrees_with_oracle(parameters, 0.5 * side, -side * speed, 4.0, within=1e-6)
    passes = [event for event in end.events if event.kind == "switch"]
    assert bool(passes) is (miss < 0.0)
    assert end.x * side < 0.0 if passes else end.x * side > 0.0


@pytest.mark.parametrize("push", [0.5, -0.5])
def test_a_mass_at_rest_on_the_hilltop_goes_where_the_other_forces_push(push):
    still = DISCONTINUOUS.replace(belt_speed=0.0)
    assert still.restoring_force(0.0) == 0.0
    pushed = agrees_with_oracle(still, 0.0, 0.0, 1.0, u=push)
    assert pushed.x * push > 0.0
    held = agrees_with_oracle(still, 0.0, 0.0, 1.0, u=0.3 * push)
    assert (held.x, held.v, held.mode) == (0.0, 0.0, 0)
    # The sliding belt pushes too.
    assert agrees_with_oracle(DISCONTINUOUS, 0.0, 0.0, 0.5).x > 0.0
    assert agrees_with_oracle(DISCONTINUOUS, 0.0, 0.0, 0.5, v_belt=-0.2).x < 0.0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_mass_held_on_both_sides_rides_through_zero(direction):
    ridden = agrees_with_oracle(HELD, -0.3 * direction, 0.2 * direction, 6.0, v_belt=0.2 * direction)
    assert [event.kind for event in ridden.events] == ["switch"]
    assert ridden.events[0].time == pytest.approx(1.5, abs=1e-14)
    assert ridden.mode == 0
    assert ridden.x == pytest.approx(0.9 * direction, abs=1e-14)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_where_the_cone_holds_on_one_side_of_zero_only_the_mass_leaves_there(direction):
    # Short of x = 0 the load is 1 + 2 beta v_b - |x|, past it that less 2; mu_s g1 lies between 1 - .02 and 1 + .02.
    weak = HELD.replace(mu_s=0.99)
    for start in (-0.2, -0.03, -0.3):
        agrees_with_oracle(weak, start * direction, 0.2 * direction, 3.0, v_belt=0.2 * direction)
    # A push forward lets the cone hold up to zero and not past it: breakaway is at x = 0, forward.
    out = agrees_with_oracle(weak, -0.02 * direction, 0.2 * direction, 0.5, u=0.05 * direction, v_belt=0.2 * direction)
    assert out.events[0].kind == "switch"
    assert out.events[0].time == pytest.approx(0.1, abs=1e-14)
    assert (out.v - 0.2 * direction) * direction > 0.0


@pytest.mark.parametrize("duration", [0.4, 0.9, 1.0])
def test_a_belt_that_turns_just_past_zero_loses_the_mass_there(duration):
    # Riding back would take a load of 1.2 past x = 0; mu_s g1 = .9 holds before it only.
    parameters = HELD.replace(mu_s=0.9, belt_speed=0.1)
    end = agrees_with_oracle(parameters, -0.02, 0.1, duration, a_belt=-0.2)
    assert end.events[0].kind == "switch"
    assert end.x > 0.0


@pytest.mark.parametrize("past", [1e-2, 1e-4, 1e-5, 1e-6])
def test_a_ripple_that_turns_just_past_zero_loses_the_mass_there(past):
    parameters = HELD.replace(mu_s=0.99, beta=0.0, belt_speed=0.0, ripple_amplitude=0.05)
    end = agrees_with_oracle(parameters, -0.05 + past, 0.05, 4.0)
    assert end.events[0].kind == "switch"


def test_as_alpha_falls_the_motion_tends_to_the_discontinuous_one_in_first_order():
    cycles = [limit_cycle(DISCONTINUOUS.replace(alpha=a), 1.0) for a in (4e-3, 2e-3, 1e-3, 0.0)]
    for name in ("amplitude", "period"):
        values = [getattr(cycle, name) for cycle in cycles]
        gaps = [abs(value - values[-1]) for value in values[:-1]]
        assert gaps[0] / gaps[1] == pytest.approx(2.0, abs=0.05), name
        assert gaps[1] / gaps[2] == pytest.approx(2.0, abs=0.03), name


@pytest.mark.slow
@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_as_alpha_falls_the_critical_speeds_tend_to_the_discontinuous_ones_in_first_order():
    speeds = [critical_belt_speeds(DISCONTINUOUS.replace(alpha=a)) for a in (4e-3, 2e-3, 1e-3, 0.0)]
    for values in zip(*speeds, strict=True):
        gaps = [abs(value - values[-1]) for value in values[:-1]]
        assert gaps[0] / gaps[1] == pytest.approx(2.0, abs=0.05)
        assert gaps[1] / gaps[2] == pytest.approx(2.0, abs=0.03)


def test_within_a_well_the_discontinuous_oscillator_is_the_linear_one_shifted():
    linear = OscillatorParameters(geometry="linear")
    shifted, level = limit_cycle(DISCONTINUOUS, 1.0), limit_cycle(linear)
    assert shifted.x_max - 1.0 == pytest.approx(level.x_max, abs=1e-12)
    assert shifted.period == pytest.approx(level.period, abs=1e-12)
    assert critical_belt_speeds(DISCONTINUOUS) == pytest.approx(critical_belt_speeds(linear), abs=1e-10)
    assert [place.x for place in equilibria(DISCONTINUOUS)] == pytest.approx(
        [equilibria(linear)[0].x - 1.0, equilibria(linear)[0].x + 1.0], abs=1e-14
    )
    ends = np.array([0.2 - 0.02 - 0.4, 0.2 - 0.02])
    assert np.ravel(stick_intervals(DISCONTINUOUS)) == pytest.approx(np.ravel([ends - 1.0, ends + 1.0]), abs=1e-14)


def test_at_alpha_zero_stick_intervals_meet_at_zero_where_the_cone_holds_on_both_sides():
    assert stick_intervals(HELD) == [pytest.approx((-2.52, 2.48), abs=1e-14)]
    # |.02 + x + 1| <= .99 left of zero, |.02 + x - 1| <= .99 right of it
    assert np.ravel(stick_intervals(HELD.replace(mu_s=0.99))) == pytest.approx([-2.01, -0.03, 0.0, 1.97], abs=1e-14)


def test_a_cycle_over_both_wells_crosses_zero_in_slip_both_ways():
    parameters = HELD.replace(mu_k=0.1, beta=0.0)
    cycle = limit_cycle(parameters)
    assert cycle.kind == "stick-slip"
    assert cycle.x_min < -1.0 < 1.0 < cycle.x_max
    end = agrees_with_oracle(parameters, cycle.x_phase0, cycle.v_phase0, cycle.period)
    assert sum(event.kind == "switch" for event in end.events) >= 2
    assert (end.x, end.v) == pytest.approx((cycle.x_phase0, cycle.v_phase0), abs=1e-9)
    assert (end.x_min, end.x_max) == pytest.approx((cycle.x_min, cycle.x_max), abs=1e-9)
    assert end.time_stuck == pytest.approx(cycle.stick_fraction * cycle.period, abs=1e-9)
    for phase in (0.1, 0.5, 0.83):
        there = kernel.advance(
            parameters.plant,
            kernel.State(cycle.x_phase0, cycle.v_phase0),
            kernel.Drive(0.2, 0.0, 0.0),
            phase * cycle.period,
            None,
        )
        assert cycle.state(phase) == pytest.approx(there[:2], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_the_attractors_at_alpha_zero_include_a_cycle_over_both_wells():
    parameters = HELD.replace(mu_k=0.1, beta=0.0)
    cycle = limit_cycle(parameters)
    assert any(found.x_max == pytest.approx(cycle.x_max, abs=1e-9) for found in attractors(parameters))


@pytest.mark.slow
@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_basins_at_alpha_zero_name_the_attractor_that_is_reached():
    parameters = DISCONTINUOUS
    rng = np.random.default_rng(17)
    x, v = rng.uniform(-2.0, 2.0, 12), rng.uniform(-1.0, 1.0, 12)
    found = basins(parameters, x, v)
    wells = {int(np.sign(found.attractors[label].x_max)) for label in found.labels.tolist()}
    assert wells == {-1, 1}
    for i, label in enumerate(found.labels.tolist()):
        end = oracle.run(parameters, float(x[i]), float(v[i]), [(60.0, 0.0, 0.0)])
        attractor = found.attractors[label]
        assert attractor.x_min - 1e-6 <= end.x <= attractor.x_max + 1e-6


# Excitation -----------------------------------------------------------------------------------------------------------


def test_a_mass_rides_a_rippling_belt_at_its_true_speed_until_the_load_is_too_great():
    parameters = OscillatorParameters(
        geometry="linear", beta=0.05, mu_s=0.4, ripple_amplitude=0.1, ripple_frequency=2.0, ripple_phase=0.6
    )

    def belt(t):
        return 0.2 + 0.1 * math.cos(2.0 * t + 0.6)

    def place(t):
        return -0.1 + 0.2 * t + 0.05 * (math.sin(2.0 * t + 0.6) - math.sin(0.6))

    def load(t):
        return -0.2 * math.sin(2.0 * t + 0.6) + 0.1 * belt(t) + place(t)

    leaves = brentq(lambda t: load(t) - 0.4, 1.0, 2.5, xtol=1e-15)
    assert max(load(t) for t in np.linspace(0.0, leaves - 1e-6, 2000)) < 0.4
    events = np.zeros((10, 4))
    kernel.advance(parameters.plant, kernel.State(-0.1, belt(0.0)), kernel.Drive(0.2, 0.0, 0.0), leaves + 0.01, events)
    assert events[0, 1] == kernel.BREAKAWAY
    assert events[0, [0, 2, 3]] == pytest.approx([leaves, place(leaves), belt(leaves)], abs=1e-12)
    for t in (0.3, 1.1, leaves - 0.01):
        end = kernel.advance(parameters.plant, kernel.State(-0.1, belt(0.0)), kernel.Drive(0.2, 0.0, 0.0), t, None)
        assert end[:4] == pytest.approx((place(t), belt(t), 0.2, kernel.STICK), abs=1e-14)


def test_a_ripple_larger_than_the_belts_speed_carries_the_mass_back_and_forth():
    parameters = OscillatorParameters(
        geometry="linear", friction="coulomb", mu_s=0.25, mu_k=0.1, belt_speed=0.05, ripple_amplitude=0.3
    )
    end = agrees_with_oracle(parameters, 0.0, parameters.first_belt_speed, 12.0)
    assert {"breakaway", "stick"} <= {event.kind for event in end.events}
    assert end.x_min < -0.2


@pytest.mark.parametrize("past", [1e-3, 3e-3, 6e-3, 1e-2, 0.1])
@pytest.mark.parametrize("rate", [1.0, 7.0])
def test_a_ride_that_ends_just_after_its_turn_knows_how_far_it_went(rate, past):
    parameters = OscillatorParameters(
        geometry="linear", friction="coulomb", mu_s=9.0, mu_k=1.0, belt_speed=0.0, ripple_amplitude=0.8, beta=0.0,
        ripple_frequency=rate,
    )  # fmt: skip
    duration = (0.5 * math.pi + past) / rate
    end = kernel.advance(parameters.plant, kernel.State(0.0, 0.8), kernel.Drive(0.0, 0.0, 0.0), duration, None)
    assert end[8] == pytest.approx(duration, abs=1e-15)
    assert end[11] == pytest.approx(0.8 / rate, abs=1e-12)


def test_a_stuck_mass_stays_stuck_however_many_calls_it_is_followed_in():
    # What the belt must give at most, 2 + .9, is less than mu_s g1: nothing ever frees it.
    parameters = OscillatorParameters(
        geometry="linear", friction="coulomb", mu_s=4.0, mu_k=0.3, beta=0.0, belt_speed=1e-3, ripple_amplitude=1.0,
        ripple_frequency=math.sqrt(2.0),
    )  # fmt: skip
    env = SDFrictionEnv(parameters=parameters, actuator="force", start="rest", episode_steps=1000)
    env.reset(options={"x": 0.0})
    for _ in range(1000):
        info = env.step(np.zeros(1, np.float32))[-1]
        assert (info["mode"], info["events"], info["stick_fraction"], info["v_rel"]) == (0, 0, 1.0, 0.0), info["time"]


def test_a_history_of_a_stuck_mass_on_a_rippling_belt_has_no_events():
    parameters = OscillatorParameters(
        geometry="linear", friction="coulomb", mu_s=4.0, mu_k=0.3, beta=0.0, belt_speed=1e-3, ripple_amplitude=0.2,
        ripple_frequency=7.0,
    )  # fmt: skip
    history = simulate(parameters, t_end=40.0, dt=0.1)
    assert history.events == ()
    assert history.stick_time == pytest.approx(40.0, abs=1e-9)
    assert history.v.tolist() == pytest.approx(history.v_belt.tolist(), abs=1e-12)


@pytest.mark.parametrize("phase", [2.0, 4.0])
@pytest.mark.parametrize("rate", [3.0, 10.0, 100.0])
@pytest.mark.parametrize("v", [0.0, 0.2])
def test_a_modulated_spring_lifts_the_mass_off_as_the_oracle_says(v, rate, phase):
    parameters = OscillatorParameters(
        g1=0.2, mu_s=0.3, stiffness_amplitude=0.9, stiffness_frequency=rate, stiffness_phase=phase
    )
    end = agrees_with_oracle(parameters, 1.0, v, 3.0)
    assert end.contact_lost


@pytest.mark.parametrize("rate", [4.0, 8.0, 16.0])
@pytest.mark.parametrize("dip", [3e-2, 3e-3, 3e-4])
def test_no_passing_loss_of_contact_goes_unseen(rate, dip):
    # No friction, so the weight does not change the motion: take one that leaves N a dip below zero, once.
    calm = OscillatorParameters(
        mu_s=0.0, mu_m=0.0, beta=0.0, stiffness_amplitude=0.5, stiffness_frequency=rate, stiffness_phase=2.0, g1=10.0
    )
    path = solve_ivp(
        lambda t, y: [y[1], -oracle.restoring(calm, y[0], t)], (0.0, 3.0), [2.2, 0.0], rtol=1e-10, atol=1e-12,
        max_step=0.002,
    )  # fmt: skip
    pulls = 10.0 - oracle.normal_force(calm, path.y[0], path.t)
    assert 0 < np.argmax(pulls) < len(pulls) - 1
    light = calm.replace(g1=float(pulls.max()) - dip)
    assert agrees_with_oracle(light, 2.2, 0.0, 3.0).contact_lost
    heavy = calm.replace(g1=float(pulls.max()) + dip)
    assert not agrees_with_oracle(heavy, 2.2, 0.0, 3.0).contact_lost


@pytest.mark.parametrize(
    "friction", [pytest.param(name, marks=() if name == "stribeck" else pytest.mark.slow) for name in FRICTIONS]
)
def test_a_history_under_excitation_balances_its_energy(friction):
    parameters = OscillatorParameters(friction=friction, alpha=0.6, **EXCITED)
    history = simulate(parameters, 0.2, t_end=10.0, dt=0.5, force=0.05)
    assert history.status == "ok"
    assert {"restick", "breakaway"} <= {event.kind for event in history.events}
    assert history.energy.relative_residual < 1e-9
    theirs = oracle.run(parameters, 0.2, parameters.first_belt_speed, [(10.0, 0.05, 0.0)])
    assert history.energy.excitation == pytest.approx(theirs.excitation_work, abs=1e-8)
    assert history.energy.contact == pytest.approx(theirs.contact_work, abs=1e-8)
    assert history.v_belt[-1] == pytest.approx(0.2 + 0.15 * math.cos(23.0 - 1.1), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_dither_quenches_the_linear_belt_within_5_percent_of_where_theory_says():
    linear = OscillatorParameters(geometry="linear")
    v_b1, rate = critical_belt_speeds(linear).v_b1, 30.0
    for v_b in (0.1, 0.35):
        calm = limit_cycle(linear.replace(belt_speed=v_b)).amplitude
        threshold = theory.dither_threshold(v_b, v_b1)
        quenched = []
        for share in (0.95, 1.05):
            shaken = linear.replace(belt_speed=v_b, force_amplitude=share * threshold * rate, force_frequency=rate)
            history = simulate(shaken, t_end=600.0, dt=0.02)
            left = history.amplitude(since=540.0) - shaken.force_amplitude / rate**2
            quenched.append(left < 0.01 * calm)
        assert quenched == [False, True], v_b


# Environments ---------------------------------------------------------------------------------------------------------

CONFIGURATIONS = [
    {"parameters": {"friction": "coulomb", "mu_s": 0.3, "mu_k": 0.1}},
    {"parameters": {"friction": "hyperbolic", "geometry": "linear"}},
    {"parameters": {"friction": "exponential", "geometry": "cubic", "mu_v": 0.02}},
    {"parameters": {"geometry": "duffing", "kappa": 0.7}},
    {"parameters": {"alpha": 0.0}},
    {"parameters": {"alpha": 0.0, "friction": "coulomb", "mu_s": 1.5, "mu_k": 0.4}, "start": "random"},
    {"parameters": {"force_amplitude": 0.2, "force_frequency": 1.3}, "show_phases": True},
    {"parameters": {"ripple_amplitude": 0.1, "ripple_frequency": 3.0}, "show_phases": True},
    {"parameters": {"stiffness_amplitude": 0.2, "geometry": "cubic"}, "show_phases": True, "sensor": "position"},
    {"parameters": {"friction": "exponential", **EXCITED}, "show_phases": True, "sensor_delay": 2, "sensor_noise": 0.1},
    {"parameters": {"friction": "hyperbolic", "alpha": 0.0, **EXCITED}, "start": "random"},
    {"randomise": {"kappa": (0.0, 1.0), "force_amplitude": (0.0, 0.4), "force_phase": (-3.0, 3.0)},
     "parameters": {"geometry": "duffing"}, "show_parameters": True, "show_phases": True},
    {"randomise": {"mu_k": (0.05, 0.2), "v_0": (0.2, 0.6), "mu_v": (0.0, 0.1), "ripple_amplitude": (0.0, 0.2),
                   "ripple_frequency": (1.0, 5.0), "ripple_phase": (0.0, 6.0)},
     "parameters": {"friction": "exponential"}, "show_parameters": True},
    {"randomise": {"delta": (0.5, 5.0), "stiffness_amplitude": (0.0, 0.3), "stiffness_frequency": (0.5, 4.0),
                   "stiffness_phase": (-1.0, 1.0), "force_frequency": (1.0, 2.0)},
     "parameters": {"friction": "hyperbolic", "force_amplitude": 0.2}, "show_parameters": True},
]  # fmt: skip


def assert_same_bits(ours, theirs, path=""):
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), path
        for key in theirs:
            assert_same_bits(ours[key], theirs[key], f"{path}/{key}")
    elif isinstance(theirs, tuple):
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            assert_same_bits(*pair, f"{path}/{i}")
    else:
        ours, theirs = np.asarray(ours), np.asarray(theirs)
        assert ours.dtype == theirs.dtype, path
        same = ours.tolist() == theirs.tolist() if ours.dtype == object else ours.tobytes() == theirs.tobytes()
        assert same, f"{path}: {ours} {theirs}"


def both(env_id, num_envs, **kwargs):
    """A batch and the same environments one by one."""
    ours = gym.make_vec(env_id, num_envs=num_envs, info_keys="all", autoreset_mode="NextStep", **kwargs)
    assert isinstance(ours.unwrapped, SDFrictionVectorEnv)
    single = [lambda: gym.make(env_id, **kwargs)] * num_envs
    return ours, SyncVectorEnv(single, autoreset_mode=AutoresetMode.NEXT_STEP)


def step_both(ours, theirs, steps, options=None):
    rng = np.random.default_rng(3)
    again = {} if options is None else {"options": options}
    assert_same_bits(ours.reset(seed=5, **again), theirs.reset(seed=5, **again))
    ended = 0
    for _ in range(steps):
        actions = rng.uniform(-1.2, 1.2, (ours.num_envs, 1)).astype(np.float32)
        mine = ours.step(actions)
        assert_same_bits(mine, theirs.step(actions))
        ended += int(np.sum(mine[2] | mine[3]))
    return ended


@pytest.mark.parametrize("which", range(len(CONFIGURATIONS)))
def test_a_batch_of_any_laws_is_the_single_environment_to_the_bit(which):
    env_id = ("SDFriction/Force-v0", "SDFriction/BeltSpeed-v0")[which % 2]
    ours, theirs = both(env_id, 3, episode_steps=25, **CONFIGURATIONS[which])
    assert step_both(ours, theirs, 60) >= 6


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_time_begins_anew_with_every_episode_in_every_mode_of_resetting(mode):
    kwargs = {"parameters": {"friction": "exponential", **EXCITED}, "show_phases": True, "episode_steps": 20}
    envs = gym.make_vec("SDFriction/Force-v0", num_envs=3, autoreset_mode=mode, info_keys=["time"], **kwargs)
    first = envs.reset(seed=1)[0]
    for _ in range(3):
        for _ in range(20):
            observations, _, _, truncated, _ = envs.step(np.zeros((3, 1), np.float32))
        assert truncated.all()
        if mode == "Disabled":
            observations = envs.reset(options={"reset_mask": truncated.copy()})[0]
        assert observations[:, -6:].tolist() == first[:, -6:].tolist()


def test_a_batch_goes_on_from_saved_states_to_the_bit():
    kwargs = {"num_envs": 4, "show_phases": True, "randomise": {"force_phase": (-3.0, 3.0), "kappa": (0.1, 2.0)}}
    parameters = {"geometry": "duffing", "friction": "hyperbolic", **EXCITED}
    envs, others = (gym.make_vec("SDFriction/Force-v0", parameters=parameters, **kwargs).unwrapped for _ in range(2))
    envs.reset(seed=1)
    others.reset(seed=8)
    rng = np.random.default_rng(8)
    for _ in range(23):
        envs.step(rng.uniform(-1.0, 1.0, (4, 1)).astype(np.float32))
    others.set_states(envs.get_states())
    for _ in range(20):
        actions = rng.uniform(-1.0, 1.0, (4, 1)).astype(np.float32)
        ours, theirs = others.step(actions), envs.step(actions)
        assert ours[0].tobytes() == theirs[0].tobytes()
        assert ours[1].tobytes() == theirs[1].tobytes()


def test_laws_can_differ_within_a_batch_by_options():
    changes = {
        "friction": ["stribeck", "coulomb", "stribeck", "stribeck", "hyperbolic", "exponential"],
        "geometry": ["exact", "cubic", "duffing", "exact", "linear", "exact"],
        "alpha": [0.7, 0.6, 0.8, 0.0, 0.8, 0.5],
        "kappa": [1.0, 1.0, 2.0, 1.0, 1.0, 1.0],
        "mu_k": [0.1, 0.05, 0.1, 0.1, 0.1, 0.02],
        "ripple_amplitude": [0.0, 0.0, 0.1, 0.0, 0.0, 0.05],
        "force_amplitude": [0.0, 0.1, 0.0, 0.0, 0.0, 0.2],
    }
    x = [0.3, 0.1, -0.2, 0.0, 0.5, 1.0]
    for env_id in ("SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"):
        batch = gym.make_vec(env_id, num_envs=6, info_keys="all")
        singles = [gym.make(env_id) for _ in range(6)]
        first, info = batch.reset(seed=4, options={"parameters": changes, "x": x})
        for i, env in enumerate(singles):
            own = {name: values[i] for name, values in changes.items()}
            shown = numbers_of(OscillatorParameters(**own))
            observation, single_info = env.reset(seed=4 + i, options={"parameters": own, "x": x[i]})
            assert first[i].tobytes() == observation.tobytes()
            assert {name: info["parameters"][name][i] for name in shown} == shown
            assert single_info["parameters"] == shown
        rng = np.random.default_rng(4)
        for _ in range(60):
            actions = rng.uniform(-1.0, 1.0, (6, 1)).astype(np.float32)
            observations, rewards, _, _, info = batch.step(actions)
            for i, env in enumerate(singles):
                observation, reward, _, _, single_info = env.step(actions[i])
                assert (observations[i].tobytes(), rewards[i]) == (observation.tobytes(), reward)
                for name in ("x", "v", "v_belt", "v_rel", "mode", "events", "normal_force"):
                    assert info[name][i] == single_info[name], (env_id, i, name)


@pytest.mark.parametrize("beside", [{"friction": "coulomb"}, {"ripple_amplitude": 0.1}, {"alpha": 0.0}])
def test_a_plain_oscillator_does_not_notice_other_laws_in_its_batch(beside):
    # Long intervals and soft springs, so that steps are halved and doubled on the way.
    kwargs = {"parameters": {"alpha": 0.15}, "control_interval": 1.0, "start": "random", "info_keys": ["x", "v"]}
    mixed, plain = (gym.make_vec("SDFriction/Force-v0", num_envs=12, **kwargs) for _ in range(2))
    ((name, value),) = beside.items()
    nominal = getattr(mixed.unwrapped.nominal, name)
    mixed.reset(seed=1, options={"parameters": {name: [nominal] * 11 + [value]}})
    plain.reset(seed=1)
    rng = np.random.default_rng(5)
    for _ in range(30):
        actions = rng.uniform(-1.0, 1.0, (12, 1)).astype(np.float32)
        infos = [envs.step(actions)[-1] for envs in (mixed, plain)]
        for key in ("x", "v"):
            assert infos[0][key][:11].tobytes() == infos[1][key][:11].tobytes()


@pytest.mark.parametrize("kwargs", CONFIGURATIONS, ids=range(len(CONFIGURATIONS)))
def test_an_episode_goes_on_from_a_saved_state_to_the_bit(kwargs):
    env, other = (gym.make("SDFriction/BeltSpeed-v0", **kwargs).unwrapped for _ in range(2))
    env.reset(seed=2)
    other.reset(seed=9)
    rng = np.random.default_rng(6)
    for _ in range(37):
        env.step(rng.uniform(-1.0, 1.0, 1).astype(np.float32))
    other.set_state(env.get_state())
    assert other.parameters == env.parameters
    for _ in range(30):
        action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
        assert_same_bits(other.step(action), env.step(action))


def test_the_environment_is_the_oracle_under_excitation():
    parameters = OscillatorParameters(friction="exponential", mu_s=0.3, **EXCITED)
    env = SDFrictionEnv(parameters=parameters, actuator="force")
    env.reset(options={"x": 0.4, "v": 0.1})
    rng = np.random.default_rng(7)
    infos = [env.step(action)[-1] for action in rng.uniform(-1.0, 1.0, (120, 1)).astype(np.float32)]
    theirs = oracle.run(parameters, 0.4, 0.1, [(0.1, info["force"], 0.0) for info in infos])
    assert (infos[-1]["x"], infos[-1]["v"]) == pytest.approx((theirs.x, theirs.v), abs=1e-8)
    true = [0.2 + 0.15 * math.cos(2.3 * info["time"] - 1.1) for info in infos]
    assert [info["v_belt"] for info in infos] == pytest.approx(true, abs=1e-13)
    assert all(info["v_rel"] == 0.0 for info in infos if info["mode"] == 0)
    assert 0.1 * sum(info["stick_fraction"] for info in infos) == pytest.approx(theirs.time_stuck, abs=1e-8)
    assert theirs.time_stuck > 0.0


def test_shown_phases_are_the_excitations_cosines_and_sines():
    parameters = OscillatorParameters(**EXCITED)
    env = SDFrictionEnv(parameters=parameters, actuator="belt_speed", show_phases=True)
    observations = [env.reset(seed=0)[0]]
    observations += [env.step(np.zeros(1, np.float32))[0] for _ in range(50)]
    assert env.observation_space.shape == (3 + 6,)
    for step, observation in enumerate(observations):
        angles = [
            getattr(parameters, f"{kind}_frequency") * 0.1 * step + getattr(parameters, f"{kind}_phase")
            for kind in ("force", "ripple", "stiffness")
        ]
        shown = [wave(angle) for angle in angles for wave in (math.cos, math.sin)]
        assert observation[3:].tolist() == pytest.approx(shown, abs=1e-6)
    hidden = SDFrictionEnv(parameters=parameters, actuator="belt_speed")
    assert hidden.reset(seed=0)[0].tolist() == observations[0][:3].tolist()


@pytest.mark.parametrize(
    "name",
    ["mu_k", "delta", "v_0", "mu_v", "kappa"]
    + [f"{kind}_{what}" for kind in ("force", "ripple", "stiffness") for what in ("amplitude", "frequency", "phase")],
)
def test_every_new_parameter_can_be_randomised(name):
    low, high = (0.02, 0.15) if name == "mu_k" else (0.3, 0.7)
    friction = {"mu_k": "coulomb", "delta": "hyperbolic", "v_0": "exponential", "mu_v": "exponential"}
    parameters = {"friction": friction.get(name, "stribeck"), "geometry": "duffing"}
    envs = gym.make_vec(
        "SDFriction/Force-v0",
        200,
        parameters=parameters,
        randomise={name: (low, high)},
        show_parameters=True,
        start="rest",
    )
    observations, info = envs.reset(seed=3)
    drawn = info["parameters"][name]
    assert low <= drawn.min() < low + 0.1 * (high - low)
    assert high - 0.1 * (high - low) < drawn.max() <= high
    scaled = 2.0 * (drawn - low) / (high - low) - 1.0
    assert observations[:, -1].tolist() == pytest.approx(scaled.tolist(), abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"friction": "coulomb", "mu_k": 0.3}, ("mu_k", "0.3", "0.2")),
        ({"friction": "exponential", "mu_k": 0.3}, ("mu_k", "0.3", "0.2")),
        ({"alpha": 5e-4}, ("alpha", "0.0005", "0.001", "0")),
        ({"alpha": 0.0, "geometry": "cubic"}, ("alpha", "0.0", "0.001")),
        ({"alpha": -0.1}, ("alpha", "-0.1")),
        ({"friction": "velvet"}, ("friction", "velvet", "stribeck", "coulomb", "hyperbolic", "exponential")),
        ({"geometry": "quintic"}, ("geometry", "quintic", "duffing")),
        ({"delta": -1.0}, ("delta", "-1.0", "[0, 1000]")),
        ({"v_0": 0.0}, ("v_0", "0.0", "[0.001, 100]")),
        ({"mu_v": 11.0}, ("mu_v", "11.0", "[0, 10]")),
        ({"kappa": math.nan}, ("kappa", "nan", "[-10, 10]")),
        ({"force_amplitude": -0.1}, ("force_amplitude", "-0.1", "[0, 100]")),
        ({"ripple_amplitude": -0.1}, ("ripple_amplitude", "-0.1", "[0, 10]")),
        ({"stiffness_amplitude": 1.1}, ("stiffness_amplitude", "1.1", "[0, 1]")),
        ({"force_frequency": 0.0}, ("force_frequency", "0.0", "[0.01, 1000]")),
        ({"ripple_phase": 11.0}, ("ripple_phase", "11.0", "[-10, 10]")),
    ],
)
def test_what_is_refused_is_named_with_its_value_and_range(arguments, said):
    with pytest.raises(ValueError, match=said[0]) as caught:
        OscillatorParameters(**arguments)
    for words in said:
        assert words in str(caught.value)
    envs = gym.make_vec("SDFriction/Force-v0", num_envs=2)
    with pytest.raises(ValueError, match=said[0]):
        envs.reset(options={"parameters": arguments})


def test_a_kinetic_coefficient_above_the_static_one_matters_only_where_it_is_used():
    assert OscillatorParameters(mu_k=0.3).mu_k == 0.3
    assert OscillatorParameters(friction="hyperbolic", mu_k=0.3).mu_k == 0.3


@pytest.mark.parametrize(
    ("parameters", "randomise"),
    [
        ({"friction": "coulomb"}, {"mu_k": (0.1, 0.3)}),
        ({"friction": "coulomb"}, {"mu_s": (0.05, 0.3)}),
        ({"friction": "coulomb", "mu_s": 1.0}, {"mu_s": (0.2, 1.0), "mu_k": (0.1, 0.5)}),
        ({}, {"alpha": (0.0, 0.5)}),
        ({}, {"alpha": (5e-4, 0.5)}),
        ({"geometry": "cubic"}, {"alpha": (0.0, 0.0)}),
        ({}, {"force_amplitude": (-0.1, 0.5)}),
    ],
)
def test_a_range_with_illegal_episodes_is_refused(parameters, randomise):
    with pytest.raises(ValueError, match=r"alpha|mu_k|mu_m|force_amplitude"):
        SDFrictionEnv(parameters=parameters, randomise=randomise)


def test_analysis_of_an_excited_oscillator_is_refused_and_says_what_to_do():
    for kind in ("force", "ripple", "stiffness"):
        excited = OscillatorParameters(**{f"{kind}_amplitude": 0.1})
        for analysis in (limit_cycle, equilibria, stick_intervals, attractors, critical_belt_speeds):
            with pytest.raises(ValueError, match="unexcited"):
                analysis(excited)
        calm, nominal = limit_cycle(excited.unexcited), limit_cycle(OscillatorParameters())
        assert (calm.period, calm.amplitude) == (nominal.period, nominal.amplitude)
