"""Closed forms against hand-computed values, numeric roots and the oracle's integrations."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sd_friction_env.physics import theory
from tests import oracle
from tests.oracle import Plant

K1, K3 = theory.stribeck_coefficients(0.2, 0.05, 0.5)


def test_dimensional_forces_scale_to_the_dimensionless_ones():
    M, K, H, L, g = 2.0, 50.0, 0.3, 0.4, 9.81
    plant = Plant("exact", alpha=H / L, g1=g * M / (K * L))
    X = np.linspace(-0.9, 0.9, 13)
    assert theory.contact_normal_force(X, M, g, K, H, L) == pytest.approx(
        K * L * oracle.normal_force(plant, X / L), abs=1e-12
    )
    assert theory.horizontal_force(X, 0.0 * X, 0.0 * X, K, 1.0, H, L) == pytest.approx(
        -K * L * oracle.restoring(plant, X / L), abs=1e-12
    )


def test_forces_of_a_three_four_five_triangle_by_hand():
    # Spring 5 m long, free length 4 m: 10 N of tension, 3/5 of it sideways, 4/5 up.
    assert theory.spring_force(3.0, 10.0, 4.0, 4.0) == pytest.approx(10.0)
    assert theory.horizontal_force(3.0, 2.0, 1.0, 10.0, 0.5, 4.0, 4.0) == pytest.approx(1.0 - 6.0 - 1.0)
    assert theory.contact_normal_force(3.0, 2.0, 10.0, 10.0, 4.0, 4.0) == pytest.approx(20.0 - 8.0)


def test_springs_are_at_rest_in_their_wells():
    for alpha in (0.2, 0.8):
        for geometry, wells in (("exact", theory.exact_wells(alpha)), ("cubic", theory.cubic_wells(alpha))):
            assert len(wells) == 2
            for well in wells:
                assert oracle.restoring(Plant(geometry, alpha), well) == pytest.approx(0.0, abs=1e-15)
    assert theory.exact_wells(0.6) == pytest.approx((-0.8, 0.8))
    assert theory.exact_wells(1.0) == theory.cubic_wells(1.3) == (0.0,)


def test_friction_is_least_at_v_m():
    assert pytest.approx((0.45, 0.6)) == (K1, K3)
    assert theory.steady_friction(0.0, 0.2, K1, K3) == 0.2
    assert theory.steady_friction(0.5, 0.2, K1, K3) == pytest.approx(0.05)
    assert theory.friction_gradient(0.5, K1, K3) == pytest.approx(0.0, abs=1e-15)
    speeds = np.linspace(0.0, 0.6, 7)
    slope = np.gradient(theory.steady_friction(np.linspace(0.2 - 1e-6, 0.2 + 1e-6, 3), 0.2, K1, K3), 1e-6)[1]
    assert theory.friction_gradient(0.2, K1, K3) == pytest.approx(slope, abs=1e-9)
    assert theory.friction_gradient(speeds, K1, K3) == pytest.approx(oracle.friction_slope(Plant(), -speeds))


def test_the_printed_stick_condition_errs_both_ways():
    loads, normal_forces = np.array([-0.3, -0.1, 0.1, 0.19, 0.21, 0.3]), np.array([1.0, 1.0, 1.0, 0.9, 1.2, 1.2])
    assert theory.stick_condition(loads, 0.2, normal_forces).tolist() == [False, True, True, False, True, False]
    assert theory.stick_condition_printed(loads, 0.2).tolist() == [True, True, True, True, False, False]
    assert theory.stick_condition(0.2, 0.2, 1.0) is True


def test_the_taylor_expansion_is_good_to_fourth_order():
    alpha = 0.7
    errors = [theory.inverse_length_taylor(x, alpha) - 1.0 / math.hypot(x, alpha) for x in (0.02, 0.04)]
    assert errors[1] / errors[0] == pytest.approx(16.0, rel=5e-3)


@pytest.mark.parametrize("alpha", [0.1, 0.2, 0.3, 0.45, 0.55, 0.7, 0.8, 1.0, 1.2])
def test_the_corrected_closed_form_solves_equation_11(alpha):
    for g1 in (0.6, 1.0, 1.7):
        for D in (0.0, 0.05, 0.1148, 0.2, 0.5):
            x = theory.equilibrium_x(alpha, g1, D)
            assert theory.equilibrium_residual(x, alpha, g1, D) == pytest.approx(0.0, abs=2e-13)
            # Eq. 11 times 2 alpha^3 as a polynomial, solved by eigenvalues.
            cubed = 2.0 * alpha**3
            roots = np.roots([1.0, alpha * D, cubed * (1.0 - 1.0 / alpha), -cubed * D * (g1 - alpha + 1.0)])
            rightmost = max(root.real for root in roots if abs(root.imag) < 1e-4)
            assert x == pytest.approx(rightmost, abs=1e-4 if D == 0.0 else 1e-11)


def test_a_belt_running_backward_mirrors_the_equilibrium():
    assert theory.equilibrium_x(0.8, 1.0, -0.1148) == pytest.approx(-theory.equilibrium_x(0.8, 1.0, 0.1148), abs=1e-15)


def test_the_printed_closed_form_misses_equation_11():
    D = theory.steady_friction(0.2, 0.2, K1, K3)
    assert pytest.approx(0.1148) == D
    assert theory.equilibrium_x(0.8, 1.0, D) == pytest.approx(0.64467779, abs=1e-8)
    assert theory.equilibrium_x(0.8, 1.0, D) == pytest.approx(oracle.equilibria(Plant("cubic"))[-1].x, abs=1e-13)
    assert abs(theory.equilibrium_x_printed(0.8, 1.0, D).imag) > 0.1
    real = theory.equilibrium_x_printed(0.8, 1.0, D, principal=False)
    assert real == pytest.approx(-0.6499, abs=6e-5)
    assert abs(theory.equilibrium_residual(real.real, 0.8, 1.0, D)) == pytest.approx(0.2, abs=0.05)


def test_the_shifted_equation_is_the_printed_equation_14():
    plant, beta = Plant("cubic"), 0.05
    B = theory.equilibrium_x(0.8, 1.0, theory.steady_friction(0.2, 0.2, K1, K3))
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-0.3, 0.3, 50), rng.uniform(-0.4, 0.19, 50)
    mu = oracle.friction_coefficient(plant, v - plant.belt_speed)
    a, g1 = plant.alpha, plant.g1
    printed = B + 2.0 * beta * v - (u + B) / a - mu * (u + B) ** 2 / (2.0 * a**2)
    printed += (u + B) ** 3 / (2.0 * a**3) + mu * (g1 - a + 1.0)
    restoring, normal_force = oracle.restoring(plant, u + B), oracle.normal_force(plant, u + B)
    assert theory.shifted_nonlinearity(u, v, restoring, mu, normal_force, beta) == pytest.approx(printed, abs=1e-15)
    # At the equilibrium nothing accelerates.
    at_rest = -theory.steady_friction(0.2, 0.2, K1, K3)
    still = theory.shifted_nonlinearity(
        0.0, 0.0, oracle.restoring(plant, B), at_rest, oracle.normal_force(plant, B), beta
    )
    assert still == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("geometry", ["exact", "cubic", "linear"])
def test_the_trace_vanishes_at_the_hopf_point(geometry):
    v_b1 = oracle.hopf(Plant(geometry))
    plant = Plant(geometry, belt_speed=v_b1)
    N = oracle.normal_force(plant, oracle.equilibria(plant)[-1].x)
    assert theory.steady_slip_trace(plant.beta, N, theory.friction_gradient(v_b1, K1, K3)) == pytest.approx(
        0.0, abs=1e-14
    )


def test_the_linear_hopf_point_is_exact():
    assert theory.linear_hopf_belt_speed(0.2, 0.05, 0.5, 0.05) == pytest.approx(0.440959, abs=5e-7)
    for g1, beta, mu_m in ((1.0, 0.05, 0.05), (1.4, 0.02, 0.1), (0.7, 0.08, 0.0)):
        numeric = oracle.hopf(Plant("linear", g1=g1, beta=beta, mu_m=mu_m))
        assert theory.linear_hopf_belt_speed(0.2, mu_m, 0.5, beta, g1) == pytest.approx(numeric, abs=1e-14)


def test_nothing_oscillates_under_a_gentle_friction_slope():
    limit = theory.no_oscillation_limit(0.05, 1.0)
    assert limit == pytest.approx(1.0 / 15.0)
    for factor, stable in ((0.999, True), (1.001, False)):
        mu_m = 0.2 - factor * limit * 0.5
        assert math.isnan(theory.linear_hopf_belt_speed(0.2, mu_m, 0.5, 0.05)) is stable
        assert math.isnan(oracle.hopf(Plant("linear", mu_m=mu_m))) is stable
    assert math.isnan(theory.linear_hopf_belt_speed(0.2, 0.2, 0.5, 0.05))


def test_feedback_above_its_threshold_calms_steady_slip():
    for v_b, threshold in ((0.1, 0.27813), (0.2, 0.23985), (0.3, 0.16551), (0.4, 0.05223)):
        plant = Plant("exact", belt_speed=v_b)
        equilibrium = oracle.equilibria(plant)[-1]
        N = float(oracle.normal_force(plant, equilibrium.x))
        k = theory.velocity_feedback_threshold(v_b, plant.beta, N, K1, K3)
        assert k == pytest.approx(threshold, abs=6e-6)
        # u = -k v takes k off the trace.
        assert equilibrium.trace - k == pytest.approx(0.0, abs=1e-14)


def test_the_linear_spring_breaks_away_where_its_pull_meets_static_friction():
    assert theory.linear_breakaway_x(0.2, 0.2, 1.0, 0.05) == pytest.approx(0.18)
    plant = Plant("linear", g1=1.3, belt_speed=0.35)
    assert theory.linear_breakaway_x(0.35, 0.2, 1.3, 0.05) == pytest.approx(oracle.stick_intervals(plant)[-1][1])


def test_pure_slip_grows_as_a_square_root_below_the_hopf_point():
    v_b1 = theory.linear_hopf_belt_speed(0.2, 0.05, 0.5, 0.05)
    assert theory.pure_slip_amplitude(0.42, v_b1) == pytest.approx(
        oracle.cycle(Plant("linear", belt_speed=0.42)).amplitude, rel=2e-2
    )
    assert theory.pure_slip_amplitude(v_b1, v_b1) == theory.pure_slip_amplitude(0.6, v_b1) == 0.0


def test_pure_slip_of_the_sd_oscillator_scales_by_its_local_frequency():
    v_b1 = oracle.hopf(Plant("cubic"))
    plant = Plant("cubic", belt_speed=v_b1 - 2e-4)
    equilibrium = oracle.equilibria(plant)[-1]
    mu = -theory.steady_friction(plant.belt_speed, 0.2, K1, K3)
    slopes = oracle.restoring_slope(plant, equilibrium.x), oracle.normal_force_slope(plant, equilibrium.x)
    frequency = theory.local_frequency(slopes[0], mu, slopes[1])
    assert frequency**2 == pytest.approx(equilibrium.determinant, abs=1e-14)
    cycle = oracle.cycle(plant)
    assert 2.0 * math.pi / cycle.period == pytest.approx(frequency, rel=1e-2)
    # What the formula leaves out, the spring's and N's curvature, is worth 2% here.
    assert theory.pure_slip_amplitude(plant.belt_speed, v_b1, frequency) == pytest.approx(cycle.amplitude, rel=3e-2)


def test_stick_slip_on_the_linear_belt_ends_near_its_first_order_value():
    v_b1 = theory.linear_hopf_belt_speed(0.2, 0.05, 0.5, 0.05)
    first_order = theory.grazing_belt_speed_first_order(v_b1)
    assert theory.pure_slip_amplitude(first_order, v_b1) == pytest.approx(first_order)
    assert first_order / oracle.grazing(Plant("linear")) == pytest.approx(1.0 - 0.0035, abs=2e-4)


def test_the_upper_amplitude_of_stick_slip_is_good_to_six_per_mille():
    for v_b in (0.05, 0.2, 0.35):
        plant = Plant("linear", belt_speed=v_b)
        measured = oracle.cycle(plant).x_max - oracle.equilibria(plant)[0].x
        assert theory.stick_slip_upper_amplitude(v_b, 0.05, K1, K3) == pytest.approx(measured, rel=6e-3)


def test_friction_enters_the_upper_amplitude_through_the_weight():
    heavy = theory.stick_slip_upper_amplitude(0.2, 0.05, K1, K3, g1=1.5)
    assert heavy == pytest.approx(theory.stick_slip_upper_amplitude(0.2, 0.05, 1.5 * K1, 1.5 * K3))
    assert heavy == pytest.approx(
        oracle.cycle(Plant("linear", g1=1.5)).x_max - oracle.equilibria(Plant("linear", g1=1.5))[0].x, rel=2e-2
    )


def test_dither_has_to_be_as_fast_as_the_belt_until_the_slope_is_nearly_flat():
    v_b1 = 0.44
    assert theory.dither_threshold(0.2, v_b1) == 0.2
    meeting = math.sqrt(2.0 / 3.0) * v_b1
    assert theory.dither_threshold(meeting, v_b1) == pytest.approx(meeting)
    assert theory.dither_threshold(0.42, v_b1) == pytest.approx(math.sqrt(2.0 * (0.44**2 - 0.42**2)))
    assert theory.dither_threshold(0.5, v_b1) == 0.0


def test_the_two_level_coulomb_cycle_closes():
    v_b, difference = 0.3, 0.2
    period = theory.coulomb_two_level_period(v_b, difference)
    slip = solve_ivp(
        lambda t, y: [y[1], -y[0]], (0.0, period - 2.0 * difference / v_b), [difference, v_b], "DOP853", rtol=1e-13,
        atol=1e-14, max_step=0.05,
    )  # fmt: skip
    # Slip about the kinetic force: it lands at the belt's speed, as far behind as it broke away ahead.
    assert slip.y[:, -1] == pytest.approx([-difference, v_b], abs=1e-12)
    assert np.max(slip.y[0]) == pytest.approx(theory.coulomb_two_level_amplitude(v_b, difference), abs=1e-3)
    assert theory.coulomb_two_level_amplitude(0.3, 0.4) == pytest.approx(0.5)


@pytest.mark.parametrize(("x", "v"), [(12.0, 6.0), (-3.0, 0.5), (4.2, 0.0), (0.5, -0.1), (0.7, 0.0), (-2.5, 0.0)])
def test_coulomb_decay_ends_where_its_half_circles_do(x, v):
    plant = Plant("linear", mu_s=1.0, mu_m=1.0, beta=0.0, belt_speed=0.0)
    end = oracle.run(plant, x, v, [(60.0, 0.0, 0.0)])
    assert end.mode == 0
    assert theory.coulomb_rest_x(x, v) == pytest.approx(end.x, abs=1e-11)


def test_coulomb_decay_from_twelve_and_six():
    assert theory.coulomb_rest_x(12.0, 6.0) == pytest.approx(0.68217894, abs=1e-8)
    assert theory.coulomb_rest_x(6.0, 3.0, friction=0.5) == pytest.approx(0.34108947, abs=1e-8)
    with pytest.raises(ValueError, match="friction must be positive"):
        theory.coulomb_rest_x(1.0, 0.0, friction=0.0)


def test_the_exponential_law_has_its_hopf_point_at_half_the_logarithm_of_ten():
    assert theory.exponential_hopf_belt_speed(1.0, 0.5, 0.5, 0.05) == pytest.approx(0.5 * math.log(10.0))
    assert theory.exponential_hopf_belt_speed(1.0, 0.5, 0.5, 0.05) == pytest.approx(1.151293, abs=5e-7)
    assert theory.exponential_hopf_belt_speed(0.54, 0.5, 0.5, 0.05) == 0.0
    viscous = theory.exponential_hopf_belt_speed(1.0, 0.5, 0.5, 0.05, 1.2, 0.1)
    slope = -0.5 / 0.5 * math.exp(-viscous / 0.5) + 0.1
    assert 2.0 * 0.05 + 1.2 * slope == pytest.approx(0.0, abs=1e-15)


def test_arrays_give_what_their_numbers_give():
    speeds = np.array([0.1, 0.2, 0.3])
    for formula in (
        lambda v: theory.steady_friction(v, 0.2, K1, K3),
        lambda v: theory.friction_gradient(v, K1, K3),
        lambda v: theory.velocity_feedback_threshold(v, 0.05, 1.0, K1, K3),
        lambda v: theory.linear_breakaway_x(v, 0.2, 1.0, 0.05),
        lambda v: theory.pure_slip_amplitude(v, 0.25, 1.1),
        lambda v: theory.stick_slip_upper_amplitude(v, 0.05, K1, K3),
        lambda v: theory.dither_threshold(v, 0.25),
        lambda v: theory.coulomb_two_level_period(v, 0.2),
        lambda v: theory.coulomb_two_level_amplitude(v, 0.2),
    ):
        assert formula(speeds).tolist() == [formula(float(v)) for v in speeds]
        assert isinstance(formula(0.2), float)
