"""One Runge-Kutta step of slip, with its error estimate and the integrals that rewards and energy need."""

import math
from typing import NamedTuple

from sd_friction_env.kernel import tableau as dp
from sd_friction_env.kernel.codes import FASTEST_DAMPING
from sd_friction_env.kernel.compilation import compiled, uncached_in_lanes
from sd_friction_env.kernel.forces import contact_and_acceleration, normal_force
from sd_friction_env.kernel.plant import at_time


class SlipStep(NamedTuple):
    """The end of a step, and what happened over it."""

    x: float
    v: float
    a: float  # acceleration at the start
    a_end: float  # and at the end, to a few digits fewer
    error: float  # estimate
    int_v2: float  # integral of v^2
    int_fv: float  # and of the contact force's power


class SlipStages(NamedTuple):
    """A step with its twelve stages."""

    step: SlipStep
    x: tuple[float, ...]
    v: tuple[float, ...]
    contact: tuple[float, ...]  # force


def _slip_stages(plant, mode, state, drive, h):
    """Take one step of length h in slip, over which the belt's speed grows linearly."""
    v_belt, a_belt, u = drive
    dv_belt = a_belt * h
    x, v1 = state
    v = v1
    f1, a1 = contact_and_acceleration(plant, mode, x, v, v_belt, u)
    v2 = v + h * (dp.A2_1 * a1)
    x2 = x + h * (dp.A2_1 * v1)
    f2, a2 = contact_and_acceleration(at_time(plant, dp.C2 * h), mode, x2, v2, v_belt + dp.C2 * dv_belt, u)
    v3 = v + h * (dp.A3_1 * a1 + dp.A3_2 * a2)
    x3 = x + h * (dp.A3_1 * v1 + dp.A3_2 * v2)
    f3, a3 = contact_and_acceleration(at_time(plant, dp.C3 * h), mode, x3, v3, v_belt + dp.C3 * dv_belt, u)
    v4 = v + h * (dp.A4_1 * a1 + dp.A4_3 * a3)
    x4 = x + h * (dp.A4_1 * v1 + dp.A4_3 * v3)
    f4, a4 = contact_and_acceleration(at_time(plant, dp.C4 * h), mode, x4, v4, v_belt + dp.C4 * dv_belt, u)
    v5 = v + h * (dp.A5_1 * a1 + dp.A5_3 * a3 + dp.A5_4 * a4)
    x5 = x + h * (dp.A5_1 * v1 + dp.A5_3 * v3 + dp.A5_4 * v4)
    f5, a5 = contact_and_acceleration(at_time(plant, dp.C5 * h), mode, x5, v5, v_belt + dp.C5 * dv_belt, u)
    v6 = v + h * (dp.A6_1 * a1 + dp.A6_4 * a4 + dp.A6_5 * a5)
    x6 = x + h * (dp.A6_1 * v1 + dp.A6_4 * v4 + dp.A6_5 * v5)
    f6, a6 = contact_and_acceleration(at_time(plant, dp.C6 * h), mode, x6, v6, v_belt + dp.C6 * dv_belt, u)
    v7 = v + h * (dp.A7_1 * a1 + dp.A7_4 * a4 + dp.A7_5 * a5 + dp.A7_6 * a6)
    x7 = x + h * (dp.A7_1 * v1 + dp.A7_4 * v4 + dp.A7_5 * v5 + dp.A7_6 * v6)
    f7, a7 = contact_and_acceleration(at_time(plant, dp.C7 * h), mode, x7, v7, v_belt + dp.C7 * dv_belt, u)
    v8 = v + h * (dp.A8_1 * a1 + dp.A8_4 * a4 + dp.A8_5 * a5 + dp.A8_6 * a6 + dp.A8_7 * a7)
    x8 = x + h * (dp.A8_1 * v1 + dp.A8_4 * v4 + dp.A8_5 * v5 + dp.A8_6 * v6 + dp.A8_7 * v7)
    f8, a8 = contact_and_acceleration(at_time(plant, dp.C8 * h), mode, x8, v8, v_belt + dp.C8 * dv_belt, u)
    v9 = v + h * (dp.A9_1 * a1 + dp.A9_4 * a4 + dp.A9_5 * a5 + dp.A9_6 * a6 + dp.A9_7 * a7 + dp.A9_8 * a8)
    x9 = x + h * (dp.A9_1 * v1 + dp.A9_4 * v4 + dp.A9_5 * v5 + dp.A9_6 * v6 + dp.A9_7 * v7 + dp.A9_8 * v8)
    f9, a9 = contact_and_acceleration(at_time(plant, dp.C9 * h), mode, x9, v9, v_belt + dp.C9 * dv_belt, u)
    v10 = v + h * (
        dp.A10_1 * a1 + dp.A10_4 * a4 + dp.A10_5 * a5 + dp.A10_6 * a6 + dp.A10_7 * a7 + dp.A10_8 * a8 + dp.A10_9 * a9
    )
    x10 = x + h * (
        dp.A10_1 * v1 + dp.A10_4 * v4 + dp.A10_5 * v5 + dp.A10_6 * v6 + dp.A10_7 * v7 + dp.A10_8 * v8 + dp.A10_9 * v9
    )
    f10, a10 = contact_and_acceleration(at_time(plant, dp.C10 * h), mode, x10, v10, v_belt + dp.C10 * dv_belt, u)
    v11 = v + h * (
        dp.A11_1 * a1
        + dp.A11_4 * a4
        + dp.A11_5 * a5
        + dp.A11_6 * a6
        + dp.A11_7 * a7
        + dp.A11_8 * a8
        + dp.A11_9 * a9
        + dp.A11_10 * a10
    )
    x11 = x + h * (
        dp.A11_1 * v1
        + dp.A11_4 * v4
        + dp.A11_5 * v5
        + dp.A11_6 * v6
        + dp.A11_7 * v7
        + dp.A11_8 * v8
        + dp.A11_9 * v9
        + dp.A11_10 * v10
    )
    f11, a11 = contact_and_acceleration(at_time(plant, dp.C11 * h), mode, x11, v11, v_belt + dp.C11 * dv_belt, u)
    v12 = v + h * (
        dp.A12_1 * a1
        + dp.A12_4 * a4
        + dp.A12_5 * a5
        + dp.A12_6 * a6
        + dp.A12_7 * a7
        + dp.A12_8 * a8
        + dp.A12_9 * a9
        + dp.A12_10 * a10
        + dp.A12_11 * a11
    )
    x12 = x + h * (
        dp.A12_1 * v1
        + dp.A12_4 * v4
        + dp.A12_5 * v5
        + dp.A12_6 * v6
        + dp.A12_7 * v7
        + dp.A12_8 * v8
        + dp.A12_9 * v9
        + dp.A12_10 * v10
        + dp.A12_11 * v11
    )
    f12, a12 = contact_and_acceleration(at_time(plant, dp.C12 * h), mode, x12, v12, v_belt + dp.C12 * dv_belt, u)
    v_end = v + h * (
        dp.B1 * a1 + dp.B6 * a6 + dp.B7 * a7 + dp.B8 * a8 + dp.B9 * a9 + dp.B10 * a10 + dp.B11 * a11 + dp.B12 * a12
    )
    x_end = x + h * (
        dp.B1 * v1 + dp.B6 * v6 + dp.B7 * v7 + dp.B8 * v8 + dp.B9 * v9 + dp.B10 * v10 + dp.B11 * v11 + dp.B12 * v12
    )
    w1 = plant.excitation.lab_velocity(v1)
    w6 = plant.excitation.at_time(dp.C6 * h).lab_velocity(v6)
    w7 = plant.excitation.at_time(dp.C7 * h).lab_velocity(v7)
    w8 = plant.excitation.at_time(dp.C8 * h).lab_velocity(v8)
    w9 = plant.excitation.at_time(dp.C9 * h).lab_velocity(v9)
    w10 = plant.excitation.at_time(dp.C10 * h).lab_velocity(v10)
    w11 = plant.excitation.at_time(dp.C11 * h).lab_velocity(v11)
    w12 = plant.excitation.at_time(dp.C12 * h).lab_velocity(v12)
    int_v2 = h * (
        dp.B1 * (w1 * w1)
        + dp.B6 * (w6 * w6)
        + dp.B7 * (w7 * w7)
        + dp.B8 * (w8 * w8)
        + dp.B9 * (w9 * w9)
        + dp.B10 * (w10 * w10)
        + dp.B11 * (w11 * w11)
        + dp.B12 * (w12 * w12)
    )
    int_fv = h * (
        dp.B1 * (f1 * w1)
        + dp.B6 * (f6 * w6)
        + dp.B7 * (f7 * w7)
        + dp.B8 * (f8 * w8)
        + dp.B9 * (f9 * w9)
        + dp.B10 * (f10 * w10)
        + dp.B11 * (f11 * w11)
        + dp.B12 * (f12 * w12)
    )
    e5x = (
        dp.E5_1 * v1
        + dp.E5_6 * v6
        + dp.E5_7 * v7
        + dp.E5_8 * v8
        + dp.E5_9 * v9
        + dp.E5_10 * v10
        + dp.E5_11 * v11
        + dp.E5_12 * v12
    )
    e5v = (
        dp.E5_1 * a1
        + dp.E5_6 * a6
        + dp.E5_7 * a7
        + dp.E5_8 * a8
        + dp.E5_9 * a9
        + dp.E5_10 * a10
        + dp.E5_11 * a11
        + dp.E5_12 * a12
    )
    e3x = (
        dp.E3_1 * v1
        + dp.E3_6 * v6
        + dp.E3_7 * v7
        + dp.E3_8 * v8
        + dp.E3_9 * v9
        + dp.E3_10 * v10
        + dp.E3_11 * v11
        + dp.E3_12 * v12
    )
    e3v = (
        dp.E3_1 * a1
        + dp.E3_6 * a6
        + dp.E3_7 * a7
        + dp.E3_8 * a8
        + dp.E3_9 * a9
        + dp.E3_10 * a10
        + dp.E3_11 * a11
        + dp.E3_12 * a12
    )
    # Hairer's blend of a fifth- and a third-order estimate; the tiny term only keeps 0/0 away.
    square5 = e5x * e5x + e5v * e5v
    square3 = e3x * e3x + e3v * e3v
    blend = 2.0 * (square5 + 0.01 * square3) + 1e-200
    # Where friction damps faster than the stages can follow, the fifth-order estimate may be small by accident.
    normal = normal_force(plant, plant.excitation.lab_position(x))
    rate = abs(plant.friction.slope(mode, v - v_belt) * normal) + 2.0 * plant.beta
    followed = h * rate <= FASTEST_DAMPING
    numerator = square5 if followed else square3
    blend = blend if followed else square3 + 1e-200
    # Where the stages overflow, a finite number over an infinite one would read as no error at all.
    error = h * numerator / math.sqrt(blend) if blend < math.inf else math.inf
    return SlipStages(
        SlipStep(x_end, v_end, a1, a12, error, int_v2, int_fv),
        (x, x2, x3, x4, x5, x6, x7, x8, x9, x10, x11, x12),
        (v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12),
        (f1, f2, f3, f4, f5, f6, f7, f8, f9, f10, f11, f12),
    )


slip_stages = uncached_in_lanes(_slip_stages)


def _slip_step(plant, mode, state, drive, h):
    """Take one step of length h in slip, over which the belt's speed grows linearly."""
    return slip_stages(plant, mode, state, drive, h).step


slip_step = compiled(_slip_step)
# The cache would take it for slip_step itself.
slip_step_in_lanes = uncached_in_lanes(_slip_step)
