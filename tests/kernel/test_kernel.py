"""The laws, the Runge-Kutta step, the automaton and the random numbers, against hand-computed values."""

import hashlib
import math
import os
import struct
import subprocess
import sys

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sd_friction_env import kernel
from sd_friction_env.physics.parameters import (
    FRICTIONS,
    GEOMETRIES,
    RANGES,
    SMALLEST_ALPHA,
    STATE_LIMIT,
    OscillatorParameters,
)

EXACT = OscillatorParameters().plant
CUBIC = OscillatorParameters(geometry="cubic").plant
LINEAR = OscillatorParameters(geometry="linear").plant
WAVES = {"force_amplitude": 0.3, "ripple_amplitude": 0.2, "ripple_frequency": 1.5, "stiffness_amplitude": 0.2}
PLANTS = {"exact": EXACT, "cubic": CUBIC, "linear": LINEAR}


def spring(plant, x):
    return kernel.restoring_force(plant, x), kernel.normal_force(plant, x)


def test_spring_laws_agree_with_hand_computed_values():
    # exact at x = .6, alpha = .8: the spring has its free length, so it pulls nowhere
    assert spring(EXACT, 0.6) == pytest.approx((0.0, 1.0), abs=1e-16)
    # exact at x = 1.5: length 1.7, R = 1.5 (.7/1.7), N = 1 - .8 (.7/1.7)
    assert spring(EXACT, 1.5) == pytest.approx((1.05 / 1.7, 1.0 - 0.56 / 1.7), rel=1e-15)
    # cubic at x = .8 = alpha: R = .8 - 1 + 1/2, N = 1 - .8 + 1 - 1/2
    assert spring(CUBIC, 0.8) == pytest.approx((0.3, 0.7), rel=1e-15)
    assert spring(LINEAR, -0.7) == (-0.7, 1.0)


def test_friction_falls_from_mu_s_to_mu_m_at_v_m_and_rises_again():
    assert EXACT.friction.coefficient(1, 0.0) == 0.2
    assert EXACT.friction.coefficient(-1, 0.0) == -0.2
    assert EXACT.friction.coefficient(1, 0.5) == pytest.approx(0.05, abs=1e-16)
    assert EXACT.friction.slope(1, 0.5) == pytest.approx(0.0, abs=1e-15)
    # by hand: k1 = .45, k3 = .6, so mu(.2) = .2 - .09 + .0048
    assert EXACT.friction.coefficient(1, 0.2) == pytest.approx(0.1148, rel=1e-14)


@pytest.mark.parametrize("geometry", PLANTS)
@pytest.mark.parametrize("x", [-1.1, -0.3, 0.0, 0.45, 1.2])
def test_slopes_and_potential_are_those_of_the_forces(geometry, x):
    plant, h = PLANTS[geometry], 1e-5
    above, below = spring(plant, x + h), spring(plant, x - h)
    slopes = [(a - b) / (2.0 * h) for a, b in zip(above, below, strict=True)]
    assert (kernel.restoring_slope(plant, x), kernel.normal_slope(plant, x)) == pytest.approx(slopes, abs=1e-9)
    force = (plant.spring.potential(x + h) - plant.spring.potential(x - h)) / (2.0 * h)
    assert kernel.restoring_force(plant, x) == pytest.approx(force, abs=1e-9)


def test_a_slip_step_is_of_eighth_order():
    def end(steps, h):
        x, v = 0.9, 0.1
        for _ in range(steps):
            x, v, *_ = kernel.slip_step(CUBIC, -1, kernel.State(x, v), kernel.Drive(0.2, 0.0, 0.01), h)
        return x, v

    reference = end(128, 1.0 / 128)
    errors = [abs(end(n, 1.0 / n)[0] - reference[0]) for n in (2, 4)]
    assert 2.0**7 < errors[0] / errors[1] < 2.0**11


def test_the_estimate_does_not_promise_more_than_a_step_keeps():
    rng = np.random.default_rng(5)
    for _ in range(300):
        plant = OscillatorParameters(
            geometry=("exact", "cubic", "linear")[rng.integers(3)],
            alpha=rng.uniform(0.05, 1.5),
            v_m=rng.uniform(0.2, 1),
        ).plant
        x, v, h = rng.uniform(-1, 1), rng.uniform(-0.6, 0.15), 0.125
        while True:
            x_end, v_end, _, _, estimate, _, _ = kernel.slip_step(
                plant, -1, kernel.State(x, v), kernel.Drive(0.2, 0.0, 0.0), h
            )
            if estimate <= kernel.TOLERANCE * h * max(1.0, abs(x), abs(v)):
                break
            h *= 0.5
        fine = (x, v)
        for _ in range(8):
            fine = kernel.slip_step(plant, -1, kernel.State(*fine), kernel.Drive(0.2, 0.0, 0.0), h / 8)[:2]
        assert max(abs(x_end - fine[0]), abs(v_end - fine[1])) <= 1e-9 * h + 2e-15


@pytest.mark.slow
def test_no_corner_of_what_is_accepted_defeats_the_error_rule():
    rng = np.random.default_rng(0)
    corners = {name: ends for name, ends in RANGES.items() if not name.endswith(("scale", "linear_stiffness"))}
    corners["kappa"] = (0.0, 10.0)  # a spring that softens lets a mass escape in finite time
    for _ in range(1500):
        values = {}
        for name, (low, high) in corners.items():
            spread = math.exp(rng.uniform(math.log(max(low, 1e-4)), math.log(high)))
            values[name] = float(rng.choice([low, high, spread, spread]).clip(low, high))
        for name in ("mu_m", "mu_k"):
            values[name] = min(values[name], values["mu_s"])
        geometry = GEOMETRIES[rng.integers(4)]
        if values["alpha"] < SMALLEST_ALPHA:
            values["alpha"] = 0.0 if geometry != "cubic" else SMALLEST_ALPHA
        laws = {"geometry": geometry, "friction": FRICTIONS[rng.integers(len(FRICTIONS))]}
        p = OscillatorParameters(**laws, **values)
        if rng.integers(2):
            p = p.unexcited.replace(friction="stribeck")
        x, v = rng.uniform(-STATE_LIMIT, STATE_LIMIT, 2)
        out = kernel.advance(p.plant, kernel.State(x, v), kernel.Drive(p.belt_speed, 0.0, 0.0), 0.1, None)
        assert out[4] in (kernel.OK, kernel.CONTACT_LOST), (p, x, v)
        assert np.isfinite(out).all()


def test_a_stuck_mass_moves_with_an_accelerating_belt_exactly():
    v_belt, a_belt, t = 0.2, -0.1, 0.1
    x, v, belt, mode, status, *_ = kernel.advance(
        EXACT, kernel.State(0.5, v_belt), kernel.Drive(v_belt, a_belt, 0.0), t, None
    )
    assert (mode, status) == (kernel.STICK, kernel.OK)
    assert v == belt == v_belt + a_belt * t
    assert x == pytest.approx(0.5 + v_belt * t + 0.5 * a_belt * t * t, abs=2e-16)


def test_a_hard_braked_belt_sheds_the_mass_forward():
    # load = a_belt + 2 beta v_b + R(.6) = -1 + .02, beyond mu_s N = .2: the mass runs ahead
    _, _, _, mode, *_ = kernel.advance(EXACT, kernel.State(0.6, 0.2), kernel.Drive(0.2, -1.0, 0.0), 0.01, None)
    assert mode == kernel.SLIP_FORWARD
    assert kernel.mode_at_zero_v_rel(EXACT, 0.6, kernel.Drive(0.2, 1.0, 0.0)) == kernel.SLIP_BACKWARD
    assert kernel.mode_at_zero_v_rel(EXACT, 0.6, kernel.Drive(0.2, 1.0, 1.0)) == kernel.STICK


def test_breakaway_on_the_linear_belt_is_at_mu_s_minus_2_beta_v_b():
    events = np.empty((8, 4))
    _, _, _, _, status, _, n, *_ = kernel.advance(
        LINEAR, kernel.State(0.0, 0.2), kernel.Drive(0.2, 0.0, 0.0), 1.0, events
    )
    assert (status, n) == (kernel.OK, 1)
    assert events[0].tolist() == pytest.approx([0.9, kernel.BREAKAWAY, 0.18, 0.2], abs=1e-13)


def test_loss_of_contact_is_reported_where_the_normal_force_vanishes():
    # cubic alpha = .2: N = 1.8 - x^2/.08 vanishes at x = sqrt(.144)
    plant = OscillatorParameters(geometry="cubic", alpha=0.2).plant
    x, _, _, _, status, t, *_ = kernel.advance(plant, kernel.State(0.1, 3.0), kernel.Drive(0.2, 0.0, 0.0), 1.0, None)
    assert status == kernel.CONTACT_LOST
    assert x == pytest.approx(math.sqrt(0.144), abs=1e-12)
    assert 0.1 < t < 0.12  # 0.28 to go, a little slower than 3
    start = kernel.advance(plant, kernel.State(0.5, 0.0), kernel.Drive(0.2, 0.0, 0.0), 1.0, None)
    assert (start[4], start[5]) == (kernel.CONTACT_LOST, 0.0)


def test_a_dip_to_the_surface_within_one_step_is_not_missed():
    # On the linear belt a_rel = .18 - x at v_rel = 0: from a little before, v_rel rises by lead^2/.4 and falls again.
    for lead in (0.003, 0.004, 0.008, 0.012):
        events = np.empty((8, 4))
        _, v, belt, _, _, _, n, *_ = kernel.advance(
            LINEAR, kernel.State(0.18 - lead, 0.2 - 1e-5), kernel.Drive(0.2, 0.0, 0.0), 0.1, events
        )
        assert events[:n, 1].tolist() == [kernel.RESTICK, kernel.BREAKAWAY]
        assert v < belt
    *_, n, _, _, _, _, _ = kernel.advance(
        LINEAR, kernel.State(0.18 - 0.001, 0.2 - 1e-5), kernel.Drive(0.2, 0.0, 0.0), 0.1, None
    )
    assert n == 0


def test_no_event_is_invented_right_after_breakaway():
    for fraction in (1e-12, 1e-9, 1e-6, 1e-3):
        events = np.empty((64, 4))
        _, v, belt, mode, status, _, n, *_ = kernel.advance(
            LINEAR, kernel.State(0.18, 0.2), kernel.Drive(0.2, 0.0, 0.0), fraction, events
        )
        assert status == kernel.OK
        assert n <= 1
        assert v <= belt


def test_integrals_over_an_interval_are_those_of_its_motion():
    # stuck on a steady belt: v^2 = v_b^2, and the contact force does what spring and damper undo
    *_, int_v2, stick_time, int_fv, x_min, x_max = kernel.advance(
        LINEAR, kernel.State(0.0, 0.2), kernel.Drive(0.2, 0.0, 0.05), 0.5, None
    )
    assert int_v2 == pytest.approx(0.02, rel=1e-14)
    assert stick_time == 0.5
    assert int_fv == pytest.approx(-0.05 * 0.1 + 0.1 * 0.02 + 0.5 * 0.1**2, rel=1e-13)
    assert (x_min, x_max) == pytest.approx((0.0, 0.1))


def test_turning_points_inside_an_interval_are_found():
    # almost free oscillation: x = cos t from (1, 0) has its minimum -1 at t = pi
    plant = OscillatorParameters(geometry="linear", beta=0.0, mu_s=0.0, mu_m=0.0).plant
    *_, x_min, x_max = kernel.advance(plant, kernel.State(1.0, 0.0), kernel.Drive(5.0, 0.0, 0.0), 4.0, None)
    assert (x_min, x_max) == pytest.approx((-1.0, 1.0), abs=1e-10)


def test_random_numbers_are_even_and_depend_on_every_word():
    draws = np.array(
        [kernel.random_uniform(2**61 + 7, e, s, k) for e in range(20) for s in range(100) for k in range(5)]
    )
    assert 0.0 <= draws.min() < draws.max() < 1.0
    counts, _ = np.histogram(draws, bins=20, range=(0, 1))
    chi_square = float(((counts - 500.0) ** 2 / 500.0).sum())
    assert chi_square < 43.8  # 99.9th percentile of chi-square with 19 degrees of freedom
    assert len(set(draws.tolist())) == draws.size
    words = (5, 6, 7, 8)
    base = kernel.random_uniform(*words)
    for i in range(4):
        assert kernel.random_uniform(*(w + (j == i) for j, w in enumerate(words))) != base
    assert kernel.random_uniform(5 + 2**40, 6, 7, 8) != base
    lagged = np.corrcoef(draws[:-1], draws[1:])[0, 1]
    assert abs(lagged) < 0.035


def test_normal_numbers_have_mean_zero_and_variance_one():
    draws = np.array([kernel.random_normal(3, 1, step, 0) for step in range(20_000)])
    assert abs(draws.mean()) < 0.025
    assert abs(draws.var() - 1.0) < 0.04
    assert abs((np.abs(draws) < 1.0).mean() - 0.6827) < 0.012


SCENARIO = """
import math, struct, sys
import numpy as np
from sd_friction_env import kernel
from sd_friction_env.physics.parameters import RANGES, STATE_LIMIT, OscillatorParameters as P
out = bytearray()
for i, geometry in enumerate(("exact", "cubic", "linear")):
    p = P(geometry=geometry, alpha=0.5 + 0.15 * i)
    x, v, belt = 0.3, 0.2, 0.2
    for n in range(150):
        u = 0.05 * (2.0 * kernel.random_uniform(11, i, n, 0) - 1.0)
        a = 0.4 * (2.0 * kernel.random_uniform(11, i, n, 1) - 1.0)
        r = kernel.advance(p.plant, kernel.State(x, v), kernel.Drive(belt, a, u), 0.1, None)
        x, v, belt = r[:3]
        out += struct.pack("<7d", *r[:3], *r[7:10], r[11])
    actuator = kernel.Actuator(1, 0.5, 0.5, 0.2, 0.1, 0.1, 0.5)
    x, v, v_belt, action = (np.array([value]) for value in (0.4, 0.1, 0.21, -0.3))
    ends = np.empty((4, 1))
    kernel.control_intervals(p.plant, actuator, x, v, v_belt, action, *ends)
    out += ends.tobytes()
    out += struct.pack("<d", kernel.random_normal(1, 2, 3, 4))
sys.stdout.write(out.hex())
"""


STIFF = {
    "by v_m = .05": ({"v_m": 0.05, "mu_s": 0.5}, (0.734, -0.158)),
    "by v_m = .02": ({"v_m": 0.02, "mu_s": 1.0}, (0.899, -0.417)),
    "by a fast belt, linear": (
        {"geometry": "linear", "g1": 0.33, "beta": 0.42, "mu_s": 0.41, "mu_m": 0.02, "v_m": 0.096, "belt_speed": 7.8},
        (1.52, -0.39),
    ),
    "by a fast belt, exact": (
        {"alpha": 3.28, "g1": 13.8, "beta": 4.7, "mu_s": 1.472, "mu_m": 1.424, "v_m": 0.0975, "belt_speed": 9.44},
        (0.25955, 1.4087),
    ),
}


@pytest.mark.parametrize("case", STIFF)
def test_a_step_whose_stages_overflow_is_refused_and_not_taken_for_exact(case):
    # Radau's implicit formula has no such stages; friction slope and spring by hand.
    values, (x, v) = STIFF[case]
    p = OscillatorParameters(**values)

    def slip(_, state):
        w = state[1] - p.belt_speed
        stretch = 1.0 - 1.0 / math.hypot(state[0], p.alpha)
        linear = p.geometry == "linear"
        restoring, normal = (state[0], p.g1) if linear else (state[0] * stretch, p.g1 - p.alpha * stretch)
        return state[1], -2.0 * p.beta * state[1] - restoring - normal * (-p.mu_s - p.k1 * w + p.k3 * w**3)

    known = solve_ivp(slip, (0.0, 0.1), (x, v), method="Radau", rtol=1e-10, atol=1e-13).y[:, -1]
    assert known[1] < p.belt_speed  # it slips all the way
    end = kernel.advance(p.plant, kernel.State(x, v), kernel.Drive(p.belt_speed, 0.0, 0.0), 0.1, None)
    assert end[4] == kernel.OK
    assert end[:2] == pytest.approx(known, abs=1e-7)


def test_an_error_estimate_that_overflows_is_infinite():
    plant = OscillatorParameters(v_m=0.05, mu_s=0.5).plant
    for h in np.geomspace(1e-3, 0.2, 400).tolist():
        x, v, _, _, error, _, _ = kernel.slip_step(
            plant, -1, kernel.State(0.734, -0.158), kernel.Drive(0.2, 0.0, 0.0), h
        )
        assert error > kernel.TOLERANCE * h or (abs(x) < 1.0 and abs(v) < 0.2)


def test_a_motion_too_stiff_for_the_error_rule_is_given_up_within_a_bounded_number_of_steps():
    # Friction drags the mass along with a belt of acceleration 1e6, and rises 1e6 times as fast as v there.
    plant = OscillatorParameters(v_m=0.01).plant
    state, drive = kernel.State(0.0, 0.1), kernel.Drive(0.2, 1e6, 0.0)
    leg = kernel.slip_until_event(plant, -1, state, drive, 1.0, kernel.TO_EVENT, 500.0, kernel.UNTRIED)
    assert leg.event == kernel.STEP_SIZE_UNDERFLOW
    assert -1.0 <= leg.trials < 0.0
    assert 0.0 < leg.time < 0.1
    end = kernel.advance(plant, kernel.State(0.0, 0.1), kernel.Drive(0.2, 1e6, 0.0), 1.0, None)
    assert end[4] == kernel.STEP_LIMIT
    assert leg.time < end.time < 1.0
    leg = kernel.slip_until_event(
        plant, -1, state, drive._replace(a_belt=0.0), 1.0, kernel.TO_EVENT, 500.0, kernel.UNTRIED
    )
    assert leg.event != kernel.STEP_SIZE_UNDERFLOW
    assert leg.trials > 0.0


# Environments by themselves and in a batch: many of them slip, stick, meet events, lose contact and begin anew.
ENVIRONMENTS = """
import sys
import gymnasium as gym, numpy as np
import sd_friction_env
out = bytearray()
for env_id, arguments in (
    ("SDFriction/Force-v0", dict(force_limit=0.5, episode_steps=9)),
    ("SDFriction/BeltSpeedRandomised-v0", dict(parameters={"geometry": "cubic"}, start="random", sensor_delay=1)),
    ("SDFriction/BeltSpeedSensed-v0", dict(parameters={"geometry": "linear"})),
):
    batch = gym.make_vec(env_id, 21, info_keys="all", **arguments)
    env = gym.make(env_id, **arguments).unwrapped
    batch.reset(seed=5)
    env.reset(seed=6)
    rng = np.random.default_rng(7)
    for n in range(12):
        actions = rng.uniform(-1, 1, (21, 1)).astype(np.float32)
        obs, rewards, terminated, truncated, info = batch.step(actions)
        out += obs.tobytes() + rewards.tobytes() + terminated.tobytes() + truncated.tobytes()
        for name, values in sorted(info.items()):
            if isinstance(values, np.ndarray) and values.dtype != object:
                out += name.encode() + values.tobytes()
        obs, reward, over, cut, info = env.step(actions[1])
        out += obs.tobytes() + np.array([reward, over, cut]).tobytes()
        out += np.array([value for value in info.values() if isinstance(value, float)]).tobytes()
        if over or cut:
            env.reset()
sys.stdout.write(out.hex())
"""


@pytest.mark.parametrize("scenario", [SCENARIO, ENVIRONMENTS], ids=["kernel", "environments"])
def test_interpreted_and_compiled_text_give_the_same_bits(scenario):
    outputs = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled}
        run = subprocess.run(
            [sys.executable, "-c", scenario], env=environment, capture_output=True, text=True, timeout=300, check=True
        )
        outputs.append(run.stdout)
    assert len(outputs[0]) > 10_000
    digests = [hashlib.sha256(text.encode()).hexdigest() for text in outputs]
    assert digests[0] == digests[1]
    if scenario == SCENARIO:
        assert all(math.isfinite(value) for (value,) in struct.iter_unpack("<d", bytes.fromhex(outputs[0])))


def test_a_step_does_not_leap_over_a_sharp_friction_layer():
    # SciPy's DOP853 with events gives v = 9.929318769; a step of .1 that missed the layer gave 9.929318869.
    p = OscillatorParameters(
        geometry="duffing", friction="hyperbolic", g1=0.001, delta=801.61730657889, belt_speed=10.0
    )
    end = kernel.advance(
        p.plant, kernel.State(-0.8229819684921935, 10.0), kernel.Drive(10.0, 0.0, -0.14713030823428672), 0.1, None
    )
    assert end[4] == kernel.OK
    assert end[1] == pytest.approx(9.929318769, abs=1e-9)


@pytest.mark.parametrize(
    ("values", "rounding"),
    [
        # Each law once; exp and cos of numba and those of libm may differ in the last bit.
        ({"geometry": "duffing", "kappa": 0.6, "friction": "hyperbolic"}, 0.0),
        ({"alpha": 0.0, "friction": "coulomb", "mu_s": 1.5}, 0.0),
        ({"geometry": "cubic", "friction": "gaussian"}, 1e-13),
        ({"friction": "exponential", "mu_v": 0.01, **WAVES}, 1e-13),
        pytest.param({"alpha": 0.0, **WAVES}, 1e-13, marks=pytest.mark.slow),
        pytest.param({"friction": "coulomb"}, 0.0, marks=pytest.mark.slow),
        pytest.param({"geometry": "linear", **WAVES}, 1e-13, marks=pytest.mark.slow),
    ],
)
def test_each_law_gives_the_same_bits_compiled_and_interpreted(values, rounding):
    parameters = OscillatorParameters(**values)
    interpreted = getattr(kernel.advance, "py_func", kernel.advance)
    for x, v in ((0.3, 0.1), (0.0, parameters.first_belt_speed), (-1.1, -0.4)):
        case = parameters.plant, kernel.State(x, v), kernel.Drive(0.2, 0.02, 0.01), 6.0, None
        assert kernel.advance(*case) == pytest.approx(interpreted(*case), rel=rounding, abs=rounding)
