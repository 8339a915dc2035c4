"""Forced motion: the tangent flow against differences, exponents against multipliers, sweeps and basins."""

import math
import os
import struct
import subprocess
import sys

import numpy as np
import pytest

from sd_friction_env import OrbitError, OscillatorParameters, critical_belt_speeds, kernel, limit_cycle, simulate
from sd_friction_env.physics import theory
from sd_friction_env.physics.forced import (
    bifurcation_diagram,
    dithered_amplitude,
    drive_period,
    forced_basins,
    forced_orbit,
    lyapunov_exponent,
    poincare_section,
)

FORCED = OscillatorParameters(alpha=0.6, force_amplitude=0.3, force_frequency=1.1)
CHAOTIC = OscillatorParameters(alpha=0.6, belt_speed=0.2, force_amplitude=0.28, force_frequency=1.2)
ON_THE_CHAOS = (1.15, 0.2)
RIPPLE = {"ripple_amplitude": 0.15, "ripple_frequency": 1.7, "ripple_phase": 0.3}
STIFFNESS = {"stiffness_amplitude": 0.3, "stiffness_frequency": 2.1}
RESONANT = OscillatorParameters(geometry="linear", mu_s=0.0, mu_m=0.0, force_amplitude=0.3, force_frequency=1.3)
BENT = OscillatorParameters(geometry="duffing", mu_s=0.0, mu_m=0.0, force_amplitude=0.3)  # its resonance leans over


def general(p, time=0.0):
    return p.excited_plant(time)


def ends(p, x, v, duration, time=0.0):
    out = kernel.advance(general(p, time), kernel.State(x, v), kernel.Drive(p.belt_speed, 0.0, 0.0), duration, None)
    assert out[4] == kernel.OK
    return np.array(out[:2])


def differences(p, x, v, duration, time=0.0, h=1e-6):
    """The tangent map from the automaton alone."""
    columns = [
        (ends(p, x + dx, v + dv, duration, time) - ends(p, x - dx, v - dv, duration, time)) / (2.0 * h)
        for dx, dv in ((h, 0.0), (0.0, h))
    ]
    return np.column_stack(columns)


def tangents(p, x, v, duration, time=0.0):
    """The tangent map, and the kinds of the events on the way."""
    rows, events = np.zeros((kernel.TANGENT_ROWS, 2)), np.empty((kernel.MAX_EVENTS, 4))
    rows[kernel.TANGENT_X, 0] = rows[kernel.TANGENT_V, 1] = 1.0
    plant, state, belt = general(p, time), kernel.State(x, v), kernel.steady(p.belt_speed)
    assert kernel.advance_with_tangents(plant, kernel.UNKNOWN, state, belt, duration, rows, None).status == kernel.OK
    n = kernel.advance(plant, state, belt, duration, events).n_events
    return rows[:2], [int(kind) for kind in events[:n, 1]]


SALTATION = {
    "stribeck": (FORCED, (0.5, -0.3), {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY}),
    "two-level Coulomb": (
        FORCED.replace(friction="coulomb", mu_k=0.1),
        (0.5, -0.3),
        {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY},
    ),
    "hyperbolic": (
        FORCED.replace(friction="hyperbolic"),
        (0.5, -0.3),
        {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY},
    ),
    "exponential": (
        FORCED.replace(friction="exponential", mu_k=0.08, mu_v=0.03),
        (0.5, -0.3),
        {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY},
    ),
    "cubic": (
        FORCED.replace(geometry="cubic", alpha=0.8, force_amplitude=0.2),
        (0.5, -0.3),
        {kernel.RESTICK, kernel.BREAKAWAY},
    ),
    "duffing": (FORCED.replace(geometry="duffing"), (0.5, -0.3), {kernel.CROSSING}),
    "alpha = 0": (FORCED.replace(alpha=0.0, belt_speed=0.3), (0.4, -0.9), {kernel.CROSSING, kernel.SWITCHING}),
    "stuck across x = 0": (
        FORCED.replace(alpha=0.0, mu_s=1.5, friction="coulomb", belt_speed=0.3, force_amplitude=0.5),
        (-0.4, 0.3),
        {kernel.RESTICK, kernel.BREAKAWAY, kernel.SWITCHING},
    ),
    "ripple": (FORCED.replace(**RIPPLE), (0.5, -0.3), {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY}),
    "stiffness": (FORCED.replace(**STIFFNESS), (0.5, -0.3), {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY}),
    "all at once": (
        FORCED.replace(friction="coulomb", mu_k=0.1, **RIPPLE, **STIFFNESS),
        (0.5, -0.3),
        {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY},
    ),
    "all at once, alpha = 0": (
        FORCED.replace(alpha=0.0, friction="coulomb", mu_k=0.1, belt_speed=0.3, **RIPPLE, **STIFFNESS),
        (0.4, -0.9),
        {kernel.CROSSING, kernel.RESTICK, kernel.BREAKAWAY, kernel.SWITCHING},
    ),
}


# Each law alone is compiled in the slow tests; in the quick ones, some together.
ALONE = ("exponential", "hyperbolic", "cubic", "duffing", "alpha = 0")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in ALONE else name for name in SALTATION]
)
def test_the_tangent_map_is_what_differences_of_the_automaton_say(name):
    p, (x, v), wanted = SALTATION[name]
    rng = np.random.default_rng(1)
    met, smooth = set(), 0
    for _ in range(60):
        start = x + rng.uniform(-1.0, 1.0), v + rng.uniform(-0.7, 0.7), 2.0 * math.pi / 1.1, rng.uniform(0.0, 6.0)
        if (
            kernel.advance(
                general(p, start[3]), kernel.State(*start[:2]), kernel.Drive(p.belt_speed, 0.0, 0.0), start[2], None
            )[4]
            != kernel.OK
        ):
            continue  # contact lost
        exact, kinds = tangents(p, *start)
        found, coarser = differences(p, *start), differences(p, *start, h=3e-6)
        size = max(1.0, np.abs(found).max())
        # Where the quotient itself depends on its step a graze is near, and there is no derivative to compare with.
        if np.abs(found - coarser).max() > 1e-5 * size:
            continue
        smooth += 1
        met |= set(kinds)
        assert exact == pytest.approx(found, rel=1e-4, abs=1e-4 * size), (start, kinds)
    assert wanted <= met
    assert smooth > 40


def test_a_stick_leaves_one_direction_and_a_crossing_scales_by_the_accelerations():
    p = FORCED.replace(friction="coulomb", mu_k=0.1)
    plant, belt, work = general(p), kernel.steady(0.2), kernel.work_for(1, 0)
    tangent = np.zeros((kernel.TANGENT_ROWS, 1))

    def passed(mode, after, kind):
        tangent[:] = 0.0
        tangent[kernel.TANGENT_V, 0] = 1.0
        rate = kernel.pass_event(plant, mode, 0.0, after, 0.0, kind, 0.5, 0.2, belt, tangent, None, work)
        return rate, tangent[kernel.TANGENT_X, 0], tangent[kernel.TANGENT_V, 0]

    assert passed(-1, 0, kernel.RESTICK)[1:] == (0.0, 0.0)
    # by hand, mode -1: a = mu_k N - 2 beta v - R + f; mode 1 has -mu_k N
    restoring, normal = kernel.restoring_force(plant, 0.5), kernel.normal_force(plant, 0.5)
    rest = -2.0 * p.beta * 0.2 - restoring + p.force_amplitude
    ratio = (rest - 0.1 * normal) / (rest + 0.1 * normal)
    assert passed(-1, 1, kernel.CROSSING) == pytest.approx((abs(rest + 0.1 * normal), 0.0, ratio))
    # a graze has no derivative: it is told
    assert passed(-1, -1, kernel.GRAZING) == (0.0, 0.0, 1.0)


def test_the_drive_period_is_that_of_what_acts():
    assert drive_period(FORCED) == 2.0 * math.pi / 1.1
    both = FORCED.replace(stiffness_amplitude=0.1, stiffness_frequency=1.1)
    assert drive_period(both) == drive_period(FORCED)
    with pytest.raises(ValueError, match=r"period= must be given .* force_frequency = 1.1, stiffness_frequency = 2.1"):
        drive_period(FORCED.replace(**STIFFNESS))
    with pytest.raises(ValueError, match="parameters must be excited"):
        drive_period(FORCED.unexcited)
    # 1.1 and 2.1 meet after ten units of time times 2 pi, and not before
    orbit = forced_orbit(FORCED.replace(**STIFFNESS), period=20.0 * math.pi, transient=30)
    assert orbit.period == orbit.multiple * 20.0 * math.pi
    with pytest.raises(ValueError, match="period must be a multiple of 2 pi/stiffness_frequency"):
        forced_orbit(FORCED.replace(**STIFFNESS), period=drive_period(FORCED))


def test_without_friction_and_bends_the_orbit_is_the_textbook_resonance():
    orbit = forced_orbit(RESONANT)
    rate, beta = 1.3, RESONANT.beta
    assert orbit.amplitude == pytest.approx(0.3 / math.hypot(1.0 - rate * rate, 2.0 * beta * rate), rel=1e-9)
    assert orbit.multiple == 1
    # multipliers exp((-beta +- i sqrt(1 - beta^2)) T)
    exact = np.exp((-beta + 1j * math.sqrt(1.0 - beta * beta)) * orbit.period)
    assert min(abs(m - exact) for m in orbit.multipliers) < 1e-10
    assert orbit.multipliers[0] == orbit.multipliers[1].conjugate()
    exponent = lyapunov_exponent(RESONANT)
    assert exponent.exponents == pytest.approx((-beta, -beta), abs=1e-4)
    assert sum(exponent.exponents) == pytest.approx(-2.0 * beta, abs=1e-11)


STABLE = {
    "one stick a period": (CHAOTIC.replace(alpha=0.7, force_frequency=1.0, force_amplitude=0.12), 1, 1e-4),
    "period two": (CHAOTIC.replace(alpha=0.7, force_frequency=1.0, force_amplitude=0.1), 2, 1e-4),
    "period three": (CHAOTIC.replace(force_amplitude=0.06), 3, 1e-4),
    "Coulomb": (CHAOTIC.replace(friction="coulomb", force_amplitude=0.1, force_frequency=1.6), None, 1e-4),
    "ripple": (OscillatorParameters(ripple_amplitude=0.1, ripple_frequency=0.66), 1, 1e-4),
    "pure slip": (OscillatorParameters(belt_speed=0.5, force_amplitude=0.05, force_frequency=1.0), 1, 1e-4),
}


@pytest.mark.parametrize("name", STABLE)
def test_the_exponent_of_a_stable_orbit_is_the_logarithm_of_its_multiplier(name):
    p, multiple, error = STABLE[name]
    orbit = forced_orbit(p)
    assert orbit.stable
    assert multiple is None or orbit.multiple == multiple
    # Floquet's from differences of the automaton over the period; from within a stick only those along it mean anything
    stuck = orbit.v == p.belt_speed
    found = differences(p, orbit.x, orbit.v, orbit.period)
    multipliers = np.array([found[0, 0]]) if stuck else np.linalg.eigvals(found)
    largest = np.abs(multipliers).max()
    assert abs(orbit.multipliers[0]) == pytest.approx(largest, rel=1e-4)
    exponent = lyapunov_exponent(p, orbit.x, orbit.v, transient=200, cycles=600)
    assert exponent.largest == pytest.approx(math.log(largest) / orbit.period, abs=error)
    assert exponent.exponents[1] == -math.inf if orbit.stick_fraction > 0.0 else exponent.exponents[1] > -math.inf
    assert (orbit.multipliers[1] == 0.0) == (orbit.stick_fraction > 0.0)


@pytest.mark.parametrize("geometry", ["exact", "cubic", "linear"])
def test_without_excitation_the_exponent_is_that_of_the_attractor(geometry):
    p = OscillatorParameters(geometry=geometry)
    start = (1.0, 0.0)
    v_b0, v_b1 = critical_belt_speeds(p)
    between = p.replace(belt_speed=0.5 * (v_b0 + v_b1))
    cycle = limit_cycle(between, *start)
    assert cycle.kind == "pure-slip"
    expected = math.log(cycle.floquet_multiplier) / cycle.period
    found = lyapunov_exponent(between, *start)
    assert found.largest == pytest.approx(expected, abs=1e-4)
    assert found.exponents == (0.0, found.largest)
    steady = lyapunov_exponent(p.replace(belt_speed=v_b1 + 0.02), *start)
    assert steady.largest < 0.0
    assert steady.largest == pytest.approx(steady.exponents[1])  # a focus
    assert lyapunov_exponent(p, *start).largest == -math.inf
    assert lyapunov_exponent(p.replace(belt_speed=0.0), *start).largest == 0.0


def test_the_chaotic_example_has_a_positive_exponent_with_a_small_error():
    found = lyapunov_exponent(CHAOTIC, *ON_THE_CHAOS, cycles=4000)
    assert found.largest > 20.0 * found.standard_error > 0.0
    assert found.exponents[1] == -math.inf
    assert found.singular_events == 0
    section = poincare_section(CHAOTIC, *ON_THE_CHAOS, cycles=2000)
    assert 0.2 < section["stick_fraction"].mean() < 0.5
    assert section["sticks"].max() == 2  # two stick phases in a cycle
    assert len(np.unique(np.round(section["x"], 6))) > 1000


def test_two_neighbours_part_as_fast_as_the_exponent_says():
    # Benettin's way, from the automaton alone: put the neighbour back to its distance after every cycle.
    period, plant, apart = drive_period(CHAOTIC), general(CHAOTIC), 1e-7
    (x, v), other = ON_THE_CHAOS, (ON_THE_CHAOS[0] + apart, ON_THE_CHAOS[1])
    logs = []
    for n in range(4200):
        now = kernel.at_time(plant, n * period)
        x, v = kernel.advance(now, kernel.State(x, v), kernel.Drive(CHAOTIC.belt_speed, 0.0, 0.0), period, None)[:2]
        beside = kernel.advance(
            now, kernel.State(other[0], other[1]), kernel.Drive(CHAOTIC.belt_speed, 0.0, 0.0), period, None
        )[:2]
        gap = np.array(beside) - (x, v)
        size = np.hypot(*gap)
        logs.append(math.log(size / apart))
        other = np.array((x, v)) + apart / size * gap
    means = np.array(logs[200:]).reshape(20, -1).mean(axis=1) / period
    found = lyapunov_exponent(CHAOTIC, *ON_THE_CHAOS, cycles=4000)
    error = math.hypot(found.standard_error, means.std(ddof=1) / math.sqrt(20))
    assert means.mean() == pytest.approx(found.largest, abs=4.0 * error)


def test_the_section_of_a_periodic_orbit_is_its_points():
    p = STABLE["period two"][0]
    orbit = forced_orbit(p)
    section = poincare_section(p, orbit.x, orbit.v, transient=2, cycles=10)
    points = np.column_stack((section["x"], section["v"]))
    assert points[1::2] == pytest.approx(np.tile(orbit.points[0], (5, 1)), abs=1e-9)
    assert points[::2] == pytest.approx(np.tile(orbit.points[1], (5, 1)), abs=1e-9)
    assert section["stick_fraction"].mean() == pytest.approx(orbit.stick_fraction, abs=1e-9)
    assert section["sticks"].sum() == 5 * orbit.sticks
    # another phase of the same orbit
    there = ends(p, orbit.x, orbit.v, 0.25 * drive_period(p))
    later = forced_orbit(p, *there, phase=0.25)
    assert min(np.abs(later.points - there).max(axis=1)) < 1e-8
    assert later.multipliers[0] == pytest.approx(orbit.multipliers[0], rel=1e-5)


def test_an_unstable_orbit_is_found_from_a_start_near_by():
    orbit = forced_orbit(CHAOTIC, 0.95, 0.2, multiple=2, transient=0)
    assert not orbit.stable
    assert ends(CHAOTIC, orbit.x, orbit.v, orbit.period) == pytest.approx((orbit.x, orbit.v), abs=1e-9)
    with pytest.raises(OrbitError, match="does not settle on an orbit of multiple up to 32"):
        forced_orbit(CHAOTIC, *ON_THE_CHAOS)


def test_the_bent_resonance_jumps_elsewhere_on_the_way_up_than_on_the_way_down():
    rates = np.linspace(0.9, 2.1, 25)
    diagram = bifurcation_diagram(BENT, "force_frequency", rates, direction="both", cycles=2, transient=150)
    up, down = (diagram["x"][diagram["direction"] == way].reshape(-1, 2)[:, 0] for way in ("up", "down"))
    apart = rates[np.abs(up - down[::-1]) > 1e-3]
    assert 1.3 < apart.min() < 1.4
    assert 1.7 < apart.max() < 1.8
    # Harmonic balance of x'' + 2 beta x' + x + kappa x^3 = f cos w t, exact to a few percent here: the upper amplitude
    # A at w = 1.5 solves ((1 + 3/4 A^2 - w^2)^2 + (2 beta w)^2) A^2 = f^2.
    upper = forced_orbit(
        BENT.replace(force_frequency=1.5), *[diagram[name][diagram["value"] == 1.5][0] for name in "xv"]
    )
    squares = np.roots([0.5625, 1.5 * (1.0 - 2.25), (1.0 - 2.25) ** 2 + 0.0225, -0.09])
    assert upper.amplitude == pytest.approx(math.sqrt(max(squares.real[np.abs(squares.imag) < 1e-9])), rel=0.02)


def test_a_sweep_without_excitation_shows_the_maxima_of_x():
    speeds = [0.1, 0.2, 0.5]
    diagram = bifurcation_diagram(OscillatorParameters(), "belt_speed", speeds, cycles=3, transient=600)
    for speed in speeds:
        x_max = limit_cycle(OscillatorParameters(belt_speed=speed), 1.0, 0.0).x_max
        assert diagram["x"][diagram["value"] == speed] == pytest.approx([x_max] * 3, abs=1e-6)


def test_a_sweep_of_the_amplitude_may_begin_at_none():
    p = CHAOTIC.replace(force_amplitude=0.0)
    diagram = bifurcation_diagram(p, "force_amplitude", [0.0, 0.28], cycles=400, lyapunov=True, direction="down")
    assert diagram["value"][[0, -1]].tolist() == [0.28, 0.0]
    still = diagram["value"] == 0.0
    assert diagram["exponent"][still][0] == pytest.approx(0.0, abs=0.01)  # the phase of the free cycle is neutral
    assert diagram["direction"][0] == "down"


def test_basins_hold_what_starts_reach():
    found = forced_basins(CHAOTIC, (-1.6, 1.6), (-1.2, 1.2), (12, 10), cycles=150)
    assert [orbit.multiple for orbit in found.attractors] == [1, 1]
    assert found.chaos is not None
    assert found.chaos.largest > 0.03
    assert sum(found.fraction(label) for label in range(3)) == 1.0
    for i, j in ((0, 0), (3, 5), (5, 4), (8, 9), (9, 2)):
        start = found.x[j], found.v[i]
        label = found.labels[i, j]
        if label == 2:
            with pytest.raises(OrbitError):
                forced_orbit(CHAOTIC, *start)
        else:
            orbit = forced_orbit(CHAOTIC, *start)
            assert orbit.points[0] == pytest.approx(found.attractors[label].points[0], abs=1e-6)


def test_a_start_off_the_belt_is_told():
    p = OscillatorParameters(geometry="cubic", alpha=0.3, force_amplitude=0.5)
    with pytest.raises(OrbitError, match="loses contact"):
        poincare_section(p, 2.0, 0.0)
    diagram = bifurcation_diagram(p, "belt_speed", [0.1, 0.2], x=2.0, v=0.0)
    assert np.isnan(diagram["x"]).all()
    found = forced_basins(p, (1.5, 2.0), (-0.1, 0.1), (2, 2), cycles=20)
    assert (found.labels == -1).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: poincare_section(FORCED, 11.0), r"x must be a finite number in \[-10, 10\], got 11.0"),
        (lambda: poincare_section(FORCED, cycles=0), r"cycles must be a finite number in \[1, 1e\+07\], got 0.0"),
        (lambda: poincare_section(FORCED, cycles=1.5), "cycles must be a whole number"),
        (lambda: poincare_section(FORCED, phase=1.0), r"phase must be in \[0, 1\)"),
        (lambda: poincare_section(FORCED, period=0.0), "period must be a finite number in"),
        (lambda: forced_orbit(FORCED, multiple=0), "multiple must be a finite number in"),
        (lambda: lyapunov_exponent(FORCED, cycles=19), "cycles must be a finite number in"),
        (lambda: bifurcation_diagram(FORCED, "geometry", [1.0]), "name must be one of 'alpha', .* got 'geometry'"),
        (lambda: bifurcation_diagram(FORCED, "beta", [-1.0]), r"beta must be a finite number in \[0, 10\], got -1.0"),
        (lambda: bifurcation_diagram(FORCED, "beta", []), "values must have shape"),
        (lambda: bifurcation_diagram(FORCED, "beta", [0.1], direction="left"), "direction must be one of 'up'"),
        (lambda: forced_basins(FORCED, (1.0, -1.0), (0.0, 1.0)), "x_limits must have low < high"),
        (lambda: forced_basins(FORCED, (0.0, 1.0), (0.0, 1.0), tolerance=0.0), "tolerance must be a finite number in"),
        (lambda: dithered_amplitude(FORCED.unexcited), "parameters must have force_amplitude over 0"),
    ],
)
def test_what_is_not_allowed_is_named_before_anything_is_computed(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_values_that_are_no_numbers_are_refused():
    with pytest.raises(TypeError, match="values must be numbers"):
        bifurcation_diagram(FORCED, "beta", ["much"])
    with pytest.raises(TypeError, match="cycles must be a real number"):
        poincare_section(FORCED, cycles="many")


@pytest.mark.parametrize(("v_b", "transient"), [(0.1, 4000), (0.2, 4000), (0.4, 20_000)])  # at .4 it dies out slowly
def test_fast_dither_quenches_the_linear_belt_where_theory_says(v_b, transient):
    rate = 30.0
    p = OscillatorParameters(geometry="linear", belt_speed=v_b, force_frequency=rate)
    allowed = 0.01 * limit_cycle(p).amplitude
    threshold = theory.dither_threshold(v_b, theory.linear_hopf_belt_speed(p.mu_s, p.mu_m, p.v_m, p.beta))

    def quenched(speed):
        return dithered_amplitude(p.replace(force_amplitude=speed * rate), cycles=400, transient=transient) < allowed

    low, high = 0.8 * threshold, 1.2 * threshold
    assert not quenched(low)
    assert quenched(high)
    for _ in range(6):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if quenched(middle) else (middle, high)
    assert 0.5 * (low + high) == pytest.approx(threshold, rel=0.05)


_BITS = """
import struct
import numpy as np
from sd_friction_env import OscillatorParameters, kernel
p = OscillatorParameters(alpha=0.6, friction="coulomb", belt_speed=0.3, force_amplitude=0.3, force_frequency=1.1,
                         ripple_amplitude=0.1, ripple_frequency=1.1, stiffness_amplitude=0.2, stiffness_frequency=1.1)
rows, growth = np.empty((3, kernel.CYCLE_ROW)), np.empty((3, 2))
out = kernel.stroboscope(p.plant, 0.5, -0.3, 0.3, 5.711986642890533, 0, rows, growth)
assert rows[:, kernel.CYCLE_STICKS].sum() > 0
print(struct.pack("20d", *out[:2], *rows[:, [0, 1, 3, 6]].ravel(), *growth.ravel()).hex())
"""


def test_the_interpreted_kernel_gives_the_same_bits():
    runs = [
        subprocess.run(
            [sys.executable, "-c", _BITS],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
            env={**os.environ, "NUMBA_DISABLE_JIT": flag},
        ).stdout
        for flag in ("0", "1")
    ]
    assert runs[0] == runs[1]
    assert len(bytes.fromhex(runs[0].strip())) == struct.calcsize("20d")


ON_EVENTS = {
    "crossing at v = 0": (
        {"geometry": "linear", "friction": "coulomb", "mu_s": 0.3, "mu_k": 0.3, "belt_speed": 0.0},
        {"force_amplitude": 1.0, "force_frequency": 1.3},
        {"crossing"},
    ),
    "landing and breakaway": (
        {"geometry": "linear", "friction": "coulomb", "mu_s": 0.4, "mu_k": 0.2, "belt_speed": 0.0},
        {"force_amplitude": 0.5, "force_frequency": 0.7},
        {"restick", "breakaway"},
    ),
    "the switch at x = 0": (
        {"alpha": 0.0, "mu_s": 0.1, "beta": 0.3, "belt_speed": 1.0},
        {"force_amplitude": 3.0, "force_frequency": 0.9},
        {"switching", "crossing"},
    ),
    "a ripple": (
        {"geometry": "linear", "friction": "coulomb", "mu_s": 0.3, "mu_k": 0.3, "belt_speed": 0.1},
        {"ripple_amplitude": 0.5, "ripple_frequency": 1.3},
        {"restick", "breakaway"},
    ),
}


@pytest.mark.parametrize("name", ON_EVENTS)
def test_a_section_on_an_event_loses_and_doubles_no_saltation(name):
    numbers, drive, wanted = ON_EVENTS[name]
    p = OscillatorParameters(**numbers, **drive)
    (rate,) = [value for key, value in drive.items() if key.endswith("frequency")]
    (kind,) = [key.split("_")[0] for key in drive if key.endswith("frequency")]
    orbit = forced_orbit(p, 1.5, 0.0)
    sizes = sorted(abs(m) for m in orbit.multipliers)
    events = simulate(p, orbit.x, orbit.v, orbit.period, dt=0.1).events
    assert wanted == {event.kind for event in events}
    for event in events:
        for late in (0.0, 1e-13, -1e-13, 1e-10, -1e-10, 1e-6, -1e-6):
            shifted = p.replace(**{f"{kind}_phase": math.remainder(rate * (event.time + late), 2.0 * math.pi)})
            found = forced_orbit(shifted, event.x, event.v, multiple=orbit.multiple, transient=0)
            assert sorted(abs(m) for m in found.multipliers) == pytest.approx(sizes, abs=1e-9), (event, late)
            assert (found.sticks, found.forward_arcs) == (orbit.sticks, orbit.forward_arcs)
            assert found.singular_events == 0
            if late == 0.0 and sizes[0] > 1e-3:
                exponent = lyapunov_exponent(shifted, found.x, found.v, cycles=40, transient=0)
                assert sum(exponent.exponents) == pytest.approx(math.log(sizes[0] * sizes[1]) / orbit.period, abs=1e-9)
    if name == "crossing at v = 0":
        # Both multipliers have the size sqrt(det): the damping, and at each crossing the ratio of the accelerations.
        squared = math.exp(-2.0 * p.beta * orbit.period)
        for event in events:
            rest, slope = math.cos(rate * event.time) - event.x, -rate * math.sin(rate * event.time)
            friction = math.copysign(0.3, slope if rest == 0.0 else rest)
            squared *= (rest - friction) / (rest + friction)
        assert sizes == pytest.approx([math.sqrt(squared)] * 2, abs=1e-9)
