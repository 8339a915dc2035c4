"""Critical belt speeds: where stick-slip ends (grazing), where oscillation ends (Hopf), and how it begins there."""

import math
from typing import Any, NamedTuple, Self

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.orbits.balance import (
    balance_points,
    check_unexcited,
    equilibria,
    find_root,
    slip_slopes,
    traps_of,
)
from sd_friction_env.physics.parameters import RANGES, OscillatorParameters
from sd_friction_env.physics.theory import FloatArray

_LEAST_WIDTH = 0.1  # over which a law changes that names no width
_BELT_SPEED_ERROR = 1e-11  # v_b0 is returned this much too low: at the graze itself rounding decides


class CriticalBeltSpeeds(NamedTuple("_CriticalBeltSpeeds", [("v_b0", float), ("v_b1", float)])):
    """The pair (v_b0, v_b1), with ``reason`` saying why where a value is NaN (empty otherwise)."""

    reason: str

    def __new__(cls, v_b0: float, v_b1: float, reason: str = "") -> Self:
        pair = super().__new__(cls, v_b0, v_b1)
        pair.reason = reason
        return pair


def critical_belt_speeds(parameters: OscillatorParameters) -> CriticalBeltSpeeds:
    """Return (v_b0, v_b1): the belt speeds at which stick-slip ends (grazing) and at which oscillation ends (Hopf).

    The result is a pair with an attribute ``reason``, which says why where a value is NaN. ``parameters.belt_speed``
    is not used. alpha < 1 has several wells: the speeds are those of the right-hand well, to which the belt carries a
    mass.

    Raises:
        ValueError: if the oscillator is excited.
    """
    v_b1 = hopf_belt_speed(parameters)
    if math.isnan(v_b1) and parameters.friction == "stribeck":
        return CriticalBeltSpeeds(
            math.nan,
            math.nan,
            "nothing oscillates: damping outweighs the falling friction at every belt speed, "
            "2 beta + N mu'(-v_b) >= 0 (on a level spring: (mu_s - mu_m)/v_m <= 4 beta/(3 N))",
        )
    v_b0 = grazing_belt_speed(parameters)
    reasons = ["no breakaway is followed by another stick"] if math.isnan(v_b0) else []
    if math.isnan(v_b1):
        reasons.append("steady slip is stable at every belt speed, 2 beta + N mu'(-v_b) >= 0")
    return CriticalBeltSpeeds(v_b0, v_b1, "; ".join(reasons))


def hopf_belt_speed(parameters: OscillatorParameters) -> float:
    """Return v_b1, the largest belt speed at which steady slip loses its stability, or NaN if it never does.

    The root of 2 beta + N(x_bar) mu'(-v_b) = 0 at the right-most equilibrium x_bar(v_b). ``belt_speed`` is not used.
    """
    plant = parameters.plant

    def damping(speed: float) -> float:
        coefficient = -plant.friction.coefficient(kernel.SLIP_BACKWARD, -speed)
        points = balance_points(parameters, 0.0, coefficient)
        if not points:
            return math.nan
        return slip_slopes(plant, kernel.SLIP_BACKWARD, points[-1], -speed).damping

    check_unexcited(parameters)
    high, *lower = _belt_speeds_to_search(parameters).tolist()
    for low in lower:
        if damping(low) < 0.0:
            return find_root(damping, low, high) if damping(high) > 0.0 else high
        high = low
    return math.nan


def _belt_speeds_to_search(parameters: OscillatorParameters) -> FloatArray:
    """Return belt speeds, descending to 0 from one above which friction no longer falls as steeply as damping rises."""
    if parameters.friction == "stribeck":
        speeds: FloatArray = np.linspace(parameters.v_m, 0.0, 65)  # friction rises with speed from there on
        return speeds
    high = RANGES["belt_speed"][1]
    if parameters.friction == "coulomb":
        return np.array([high, 0.0])  # level: it never feeds a motion
    width = parameters.plant.friction.layer_width(-1) or _LEAST_WIDTH
    return np.append(np.geomspace(high, 1e-3 * min(width, 500.0 * high), 200), 0.0)


def first_lyapunov_coefficient(parameters: OscillatorParameters) -> float:
    """Return the first Lyapunov coefficient of the Hopf point at v_b1, NaN if there is none.

    Negative: supercritical, a stable cycle grows out of the equilibrium below v_b1. Positive: subcritical, an unstable
    one shrinks onto it, and oscillation outlives v_b1. ``belt_speed`` is not used. Source: Guckenheimer and Holmes
    (1983), Nonlinear Oscillations, Eq. 3.4.11, for x'' = F(x, x').
    """
    speed = hopf_belt_speed(parameters)
    if math.isnan(speed):
        return math.nan
    at_hopf = parameters.replace(belt_speed=speed)
    return lyapunov_coefficient(at_hopf.plant, speed, equilibria(at_hopf)[-1].x)


def lyapunov_coefficient(plant: Any, speed: float, x: float) -> float:
    """Return the first Lyapunov coefficient of a Hopf point at x."""
    mode, w = kernel.SLIP_BACKWARD, -speed
    friction, spring = plant.friction, plant.spring
    coefficient, slope = friction.coefficient(mode, w), friction.slope(mode, w)
    curvature, third = friction.curvature(mode, w), friction.third_derivative(mode, w)
    normal_slope, normal_curvature = spring.normal_slope(x), spring.normal_curvature(x)
    normal = spring.normal_force(plant.g1, x)
    square = slip_slopes(plant, mode, x, w).stiffness  # omega^2
    f_xx = -spring.restoring_curvature(x) - coefficient * normal_curvature
    f_xv = -slope * normal_slope
    f_vv = -curvature * normal
    f_xxv = -slope * normal_curvature
    f_vvv = -third * normal
    return float((f_xxv + square * f_vvv + f_xv * f_xx / square + f_xv * f_vv) / 16.0)


def grazing_belt_speed(parameters: OscillatorParameters) -> float:
    """Return v_b0, the largest belt speed at which a mass that breaks away sticks again, or NaN if it never does.

    The mass breaks away at the right end of the right-most stick interval. ``belt_speed`` is not used. With a friction
    law other than Stribeck's the search ends at 10, the greatest belt speed that is accepted.
    """
    plant = parameters.plant

    def sticks_again(speed: float) -> bool:
        ends = balance_points(parameters, 2.0 * parameters.beta * speed, plant.friction.breakaway_coefficient(-1))
        if not ends or kernel.normal_force(plant, ends[-1]) <= 0.0:
            return False
        traps = traps_of(parameters.replace(belt_speed=speed))
        return bool(kernel.slip_returns_to_stick(plant, speed, ends[-1], traps))

    check_unexcited(parameters)
    if parameters.friction == "stribeck":
        speeds = np.linspace(1.5 * parameters.v_m, 0.0, 49)
    elif parameters.friction == "coulomb":
        speeds = np.append(np.geomspace(RANGES["belt_speed"][1], 1e-3, 200), 0.0)
    else:
        speeds = _belt_speeds_to_search(parameters)
    outside, *lower = speeds[:-1].tolist()
    if parameters.friction != "stribeck" and sticks_again(outside):
        return float(outside)
    for inside in lower:
        if sticks_again(inside):
            while outside - inside >= 0.1 * _BELT_SPEED_ERROR:
                middle = 0.5 * (inside + outside)
                if sticks_again(middle):
                    inside = middle
                else:
                    outside = middle
            return float(inside - _BELT_SPEED_ERROR)
        outside = inside
    return math.nan
