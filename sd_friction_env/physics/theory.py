"""Closed forms: what can be solved by hand, one function per numbered equation.

Nothing here integrates, and nothing here is a law: R(x), N(x) and mu(v_rel), Eqs. 4 to 10, live in the kernel, and the
functions below take their *values*. Everything is dimensionless (time in 1/omega0, length in L, force in K L) unless a
docstring gives units. Where the paper's print is wrong both readings are here, one with `printed` in its name.

Symbols: alpha = H/L, g1 the weight, beta the damping ratio, v_b the belt's speed; mu_s the static coefficient of
friction, mu_m its least value, met at the relative speed v_m.
"""

import cmath
import math
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
# A number in, a number out; an array in, an array out.
Real = TypeVar("Real", float, FloatArray)


def spring_force(X: Real, K: float, H: float, L: float) -> Real:
    """F' = K (sqrt(X^2 + H^2) - L), before Eq. 1: the tension of the inclined spring.

    X [m] the mass's place, K [N/m] stiffness, H [m] the anchor's height, L [m] the free length; in N. The paper drops
    its preload K delta_0.
    """
    force: Real = K * (np.sqrt(X * X + H * H) - L)
    return force


def horizontal_force(X: Real, velocity: Real, friction: Real, K: float, C: float, H: float, L: float) -> Real:
    """M X'' = F_f - F' sin(gamma) - C X', Eq. 1, with sin(gamma) = X / sqrt(X^2 + H^2); in N.

    velocity [m/s], friction F_f [N], C [N s/m]; the rest as in `spring_force`.
    """
    force: Real = friction - spring_force(X, K, H, L) * X / np.sqrt(X * X + H * H) - C * velocity
    return force


def contact_normal_force(X: Real, M: float, g: float, K: float, H: float, L: float) -> Real:
    """F_n = M g - F' cos(gamma), Eq. 2, with cos(gamma) = H / sqrt(X^2 + H^2); in N.

    M [kg], g [m/s^2]; the rest as in `spring_force`.
    """
    force: Real = M * g - spring_force(X, K, H, L) * H / np.sqrt(X * X + H * H)
    return force


def exact_wells(alpha: float) -> tuple[float, ...]:
    """Rest positions of Eq. 4's spring: +-sqrt(1 - alpha^2) below alpha = 1, else 0."""
    well = math.sqrt(max(0.0, 1.0 - alpha * alpha))
    return (-well, well) if well > 0.0 else (0.0,)


def cubic_wells(alpha: float) -> tuple[float, ...]:
    """Rest positions of Eq. 9's spring: +-alpha sqrt(2 (1 - alpha)) below alpha = 1, else 0."""
    well = alpha * math.sqrt(max(0.0, 2.0 * (1.0 - alpha)))
    return (-well, well) if well > 0.0 else (0.0,)


def stribeck_coefficients(mu_s: float, mu_m: float, v_m: float) -> tuple[float, float]:
    """k1 = 3/2 (mu_s - mu_m)/v_m and k3 = 1/2 (mu_s - mu_m)/v_m^3, below Eq. 6: mu is least, mu_m, at v_m."""
    difference = mu_s - mu_m
    return 1.5 * difference / v_m, 0.5 * difference / (v_m * v_m * v_m)


def steady_friction(v_b: Real, mu_s: float, k1: float, k3: float) -> Real:
    """D = mu_s - k1 v_b + k3 v_b^3, Appendix: the belt's pull on a mass at rest, over N. For v_b > 0."""
    return mu_s - k1 * v_b + k3 * v_b * v_b * v_b


def friction_gradient(v_rel: Real, k1: float, k3: float) -> Real:
    """mu'(v_rel) = -k1 + 3 k3 v_rel^2, from Eq. 5, away from v_rel = 0: negative (it feeds energy in) up to v_m."""
    return 3.0 * k3 * v_rel * v_rel - k1


def stick_condition(load: Real, mu_s: float, normal_force: Real) -> bool | npt.NDArray[np.bool_]:
    """|load| <= mu_s N, what Eqs. 8, 10 and 15 must say for the friction to be one law.

    load = 2 beta v_b + R(x), and + a_belt - u where there are any: the contact force that stick needs.
    """
    return abs(load) <= mu_s * normal_force


def stick_condition_printed(load: Real, mu_s: float) -> bool | npt.NDArray[np.bool_]:
    """load <= mu_s, Eqs. 8, 10 and 15 as printed.

    Without N the force jumps at release; without the modulus the belt holds against any push along its motion.
    """
    return load <= mu_s


def inverse_length_taylor(x: Real, alpha: float) -> Real:
    """1/sqrt(x^2 + alpha^2) ~ 1/alpha - x^2/(2 alpha^3), the expansion before Eq. 9: good for |x| well below alpha."""
    return 1.0 / alpha - x * x / (2.0 * alpha * alpha * alpha)


def equilibrium_residual(x: Real, alpha: float, g1: float, D: float) -> Real:
    """x - x/alpha + x^2 D/(2 alpha^2) + x^3/(2 alpha^3) - D (g1 - alpha + 1), Eq. 11: zero at steady slip x = x_bar."""
    a = alpha
    return x - x / a + x * x * D / (2.0 * a * a) + x * x * x / (2.0 * a * a * a) - D * (g1 - a + 1.0)


def equilibrium_x(alpha: float, g1: float, D: float) -> float:
    """x_bar, the root of Eq. 11, by the Appendix's formula with A's first sign put right; see `equilibrium_x_printed`.

        A = -alpha^3 D (D^2 - 27 g1 - 18) - 18 alpha^4 D

    Below alpha about 0.5 the radicand is negative: there are three equilibria, the cube root is complex, and its
    principal value gives the rightmost one.
    """
    a = alpha
    A = -(a**3) * D * (D * D - 27.0 * g1 - 18.0) - 18.0 * a**4 * D
    radicand = a**6 * ((6.0 * (a - 1.0) - D * D) ** 3 + D * D * (18.0 * (a - 1.0) + D * D - 27.0 * g1) ** 2)
    product = a * a * (D * D + 6.0 - 6.0 * a)
    if radicand >= 0.0:
        # Of the two square roots the one that does not cancel A: the sum of the two terms below is the same.
        root = math.cbrt(A + math.copysign(math.sqrt(radicand), A))
        terms = root + product / root if root != 0.0 else 0.0
    else:
        complex_root = complex(A, math.sqrt(-radicand)) ** (1.0 / 3.0)
        terms = (complex_root + product / complex_root).real
    return (terms - a * D) / 3.0


def equilibrium_x_printed(alpha: float, g1: float, D: float, principal: bool = True) -> complex:
    """x_bar by the Appendix as printed, with A = alpha^3 D (D^2 - 27 g1 - 18) - 18 alpha^4 D. It does not solve Eq. 11.

    The print calls both x_bar and the square root in it B. `principal` takes the principal cube root, complex for a
    negative number; otherwise the real one, where the sum under it is real.
    """
    a = alpha
    A = a**3 * D * (D * D - 27.0 * g1 - 18.0) - 18.0 * a**4 * D
    radicand = a**6 * ((6.0 * (a - 1.0) - D * D) ** 3 + D * D * (18.0 * (a - 1.0) + D * D - 27.0 * g1) ** 2)
    total = A + cmath.sqrt(radicand)
    root = complex(math.cbrt(total.real)) if not principal and total.imag == 0.0 else total ** (1.0 / 3.0)
    return (a * a * (-6.0 * a + D * D + 6.0) / root + root - a * D) / 3.0


def shifted_nonlinearity(
    shift: Real, velocity: Real, restoring: Real, friction: Real, normal_force: Real, beta: float
) -> Real:
    """h = 2 beta u' + R(u + x_bar) + mu N(u + x_bar) - u, Eq. 14: u'' + u + h = 0, Eq. 13, is Eq. 9 about x_bar.

    shift u = x - x_bar (Eq. 12), velocity u' = x'; restoring R, friction mu(u' - v_b), normal_force N: values at x.
    """
    return 2.0 * beta * velocity + restoring + friction * normal_force - shift


def steady_slip_trace(beta: float, normal_force: float, gradient: float) -> float:
    """-(2 beta + N(x_bar) mu'(-v_b)): the Jacobian's trace at steady slip, twice the growth rate; 0 at v_b1 (Hopf)."""
    return -(2.0 * beta + normal_force * gradient)


def local_frequency(restoring_slope: float, friction: float, normal_force_slope: float) -> float:
    """omega = sqrt(R' + mu N') at steady slip, mu = mu(-v_b), in rad per unit time: the cycle's frequency at v_b1."""
    return math.sqrt(restoring_slope + friction * normal_force_slope)


def no_oscillation_limit(beta: float, normal_force: float) -> float:
    """4 beta/(3 N): steady slip is stable at every belt speed while (mu_s - mu_m)/v_m stays at or below it.

    Exact for a constant N. Otherwise N is the greatest met in steady slip: it grows with v_b as x_bar moves in, so its
    value at rest alone leaves a narrow band of belt speeds unstable.
    """
    return 4.0 * beta / (3.0 * normal_force)


def velocity_feedback_threshold(v_b: Real, beta: float, normal_force: Real, k1: float, k3: float) -> Real:
    """N (k1 - 3 k3 v_b^2) - 2 beta: u = -k v makes steady slip stable for any k above it."""
    return normal_force * (k1 - 3.0 * k3 * v_b * v_b) - 2.0 * beta


def linear_breakaway_x(v_b: Real, mu_s: float, g1: float, beta: float) -> Real:
    """mu_s g1 - 2 beta v_b, exact: where the linear spring pulls the mass off the belt."""
    return mu_s * g1 - 2.0 * beta * v_b


def linear_hopf_belt_speed(mu_s: float, mu_m: float, v_m: float, beta: float, g1: float = 1.0) -> float:
    """v_b1 = v_m sqrt(1 - 4 beta v_m/(3 g1 (mu_s - mu_m))), exact on the linear belt; NaN where nothing oscillates.

    Source: Thomsen and Fidlin (2003), also for the three functions below.
    """
    difference = mu_s - mu_m
    square = 1.0 - 4.0 * beta * v_m / (3.0 * g1 * difference) if difference > 0.0 else -1.0
    return v_m * math.sqrt(square) if square >= 0.0 else math.nan


def pure_slip_amplitude(v_b: Real, v_b1: float, frequency: float = 1.0) -> Real:
    """A1 = 2 sqrt(v_b1^2 - v_b^2)/omega, first order: pure slip between v_b0 and v_b1; 0 past v_b1.

    omega = 1 on the linear belt. The slope of friction bounds the velocity, so for the SD oscillator the amplitude is
    that over `local_frequency`.
    """
    amplitude: Real = 2.0 / frequency * np.sqrt(np.maximum(v_b1 * v_b1 - v_b * v_b, 0.0))
    return amplitude


def grazing_belt_speed_first_order(v_b1: float) -> float:
    """v_b0 ~ sqrt(4/5) v_b1, where A1's velocity reaches the belt's: first order, 0.35% low on the nominal one."""
    return math.sqrt(0.8) * v_b1


def stick_slip_upper_amplitude(v_b: Real, beta: float, k1: float, k3: float, g1: float = 1.0) -> Real:
    """A+ = v_b [1 + pi/4 (g1 k1 - 2 beta)] - g1 k3 v_b^3 (3 pi/4 - 2 + 3 pi/16), first order.

    The upper half-amplitude of stick-slip, x_max - x_bar.
    """
    linear = 1.0 + math.pi / 4.0 * (g1 * k1 - 2.0 * beta)
    cubic = g1 * k3 * (3.0 * math.pi / 4.0 - 2.0 + 3.0 * math.pi / 16.0)
    return v_b * linear - cubic * v_b * v_b * v_b


def dither_threshold(v_b: Real, v_b1: float) -> Real:
    """min(v_b, sqrt(2 (v_b1^2 - v_b^2))): the dither velocity f/Omega that quenches the linear belt; 0 past v_b1."""
    threshold: Real = np.minimum(v_b, np.sqrt(2.0 * np.maximum(v_b1 * v_b1 - v_b * v_b, 0.0)))
    return threshold


def coulomb_two_level_period(v_b: Real, difference: float) -> Real:
    """2 Dl/v_b + 2 (pi - atan(Dl/v_b)), Dl = F_s - F_k, exact: two-level Coulomb friction, m = k = 1, no damping."""
    ratio = difference / v_b
    period: Real = 2.0 * ratio + 2.0 * (math.pi - np.arctan(ratio))
    return period


def coulomb_two_level_amplitude(v_b: Real, difference: float) -> Real:
    """sqrt(Dl^2 + v_b^2), exact: the radius of the slip's circle about F_k, as in `coulomb_two_level_period`."""
    amplitude: Real = np.sqrt(difference * difference + v_b * v_b)
    return amplitude


def coulomb_rest_x(x: float, v: float, friction: float = 1.0) -> float:
    """Position at which x'' + x = -friction sgn(x') comes to rest, exact.

    Half circles about -+friction follow each other until one ends with |x| <= friction.
    """
    if friction <= 0.0:
        raise ValueError(f"friction must be positive for the mass to come to rest, got {friction!r}")
    if v != 0.0:
        sign = math.copysign(1.0, v)
        x = -sign * friction + sign * math.hypot(x + sign * friction, v)
    # Each half circle takes two frictions off the distance and changes the side.
    turns = max(0, math.ceil((abs(x) - friction) / (2.0 * friction)))
    return math.copysign(1.0, x) * (-1.0) ** turns * (abs(x) - 2.0 * friction * turns)


def exponential_hopf_belt_speed(
    mu_s: float, mu_d: float, v_0: float, beta: float, normal_force: float = 1.0, mu_v: float = 0.0
) -> float:
    """v_b1 = v_0 ln(N (mu_s - mu_d)/(v_0 (2 beta + N mu_v))), exact for a constant N: the exponential law's Hopf point.

    The law: (mu_d + (mu_s - mu_d) e^{-|w|/v_0}) sgn(w) + mu_v w. Zero where even its start is too flat to feed motion.
    """
    ratio = normal_force * (mu_s - mu_d) / (v_0 * (2.0 * beta + normal_force * mu_v))
    return v_0 * math.log(ratio) if ratio > 1.0 else 0.0
