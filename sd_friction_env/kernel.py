# All compiled code of the project stands in this one file. numba's on-disk cache watches only the file that defines a
# function: a law changed in another file would leave the old force in use, silently.
"""The oscillator's laws, its slip/stick automaton and the event-exact step, compiled once and cached.

Everything is dimensionless (physics of the paper's Eqs. 4-10). Plain scalars go in and come out, nothing is raised:
functions return a status. The same text runs interpreted with ``NUMBA_DISABLE_JIT=1`` and gives the same bits, so
powers are written as products and step sizes change by factors of two only.

The slip phase is integrated by the eighth-order Runge-Kutta formula of Dormand and Prince (Hairer, Norsett, Wanner:
Solving Ordinary Differential Equations I, sec. II.10) under one rule for every caller: the estimated error of a step of
length h stays under ``TOLERANCE`` h. A step is first tried over all of what is asked for, then halved until the
rule holds. In slip the sign of the relative velocity is frozen, so that the vector field is smooth up to and across
the surface v = v_belt, and events are located by repeating the last step with another length.
"""

import math
from typing import NamedTuple

import numba

compiled = numba.njit(cache=True, error_model="numpy", nogil=True)

EXACT, CUBIC, LINEAR = 0, 1, 2

# The mode is the sign of v_rel, frozen until an event.
SLIP_BACKWARD, STICK, SLIP_FORWARD = -1, 0, 1

OK, CONTACT_LOST, EVENT_LIMIT, STEP_LIMIT = 0, 1, 2, 3

NO_EVENT, RESTICK, CROSSING, GRAZING, BREAKAWAY, CONTACT_LOSS, TURNING, LANDING, STUCK_STEP = 0, 1, 2, 3, 4, 5, 6, 7, 8

STATUS_NAMES = {OK: "ok", CONTACT_LOST: "contact lost", EVENT_LIMIT: "event limit", STEP_LIMIT: "step limit"}
EVENT_NAMES = {
    RESTICK: "restick",
    CROSSING: "crossing",
    GRAZING: "grazing",
    BREAKAWAY: "breakaway",
    CONTACT_LOSS: "contact-loss",
    STUCK_STEP: "step-limit",
}

FORCE, BELT_SPEED = 0, 1

# Estimated error per unit of time, relative to max(1, |x|, |v|, STIFF |x''|); the estimate can be ten times too low.
TOLERANCE = 1e-10
MAX_SLIP_STEP = 0.2
MIN_SLIP_STEP = 1e-16
STIFF = 1e-4  # where friction is so steep that v changes by |a| h, no estimate gets below 1e-14 of that change
MAX_EVENTS = 256  # in one call of advance
V_REL_ZERO = 1e-14  # relative velocities this small cannot be told from zero after one step's rounding
TIME_ZERO = 1e-13  # events are located this closely in time
STEP_DOUBLING = 1.0 / 1024.0  # a step this far inside the rule doubles: the error falls as h^8, four times the margin


class Plant(NamedTuple):
    """What the equations of motion need: Eq. 4's geometry and damping, Eq. 5's friction law."""

    geometry: int
    alpha: float
    g1: float
    beta: float
    mu_s: float
    k1: float
    k3: float


# Laws -------------------------------------------------------------------------------------------------------------


@compiled
def spring(plant, x):
    """Return the restoring force R(x) and the normal force N(x)."""
    if plant.geometry == EXACT:
        # Eq. 4: R = x (1 - 1/sqrt(x^2 + alpha^2)), N = g1 - alpha (1 - 1/sqrt(x^2 + alpha^2))
        stretch = 1.0 - 1.0 / math.sqrt(x * x + plant.alpha * plant.alpha)
        return x * stretch, plant.g1 - plant.alpha * stretch
    if plant.geometry == CUBIC:
        # Eq. 9: R = x - x/alpha + x^3/(2 alpha^3), N = g1 - alpha + 1 - x^2/(2 alpha^2)
        y = x / plant.alpha
        return x - y + 0.5 * (y * y * y), plant.g1 - plant.alpha + 1.0 - 0.5 * (y * y)
    # Reference [1] of the paper: R = x, N = g1
    return x, plant.g1


@compiled
def spring_slopes(plant, x):
    """Return R'(x) and N'(x)."""
    if plant.geometry == EXACT:
        length = math.sqrt(x * x + plant.alpha * plant.alpha)
        cube = length * length * length
        return 1.0 - 1.0 / length + x * x / cube, -plant.alpha * x / cube
    if plant.geometry == CUBIC:
        y = x / plant.alpha
        return 1.0 - (1.0 - 1.5 * (y * y)) / plant.alpha, -y / plant.alpha
    return 1.0, 0.0


@compiled
def spring_curvatures(plant, x):
    """Return R''(x) and N''(x)."""
    if plant.geometry == EXACT:
        square = plant.alpha * plant.alpha
        length = math.sqrt(x * x + square)
        fifth = length * length * length * length * length
        return 3.0 * square * x / fifth, plant.alpha * (2.0 * x * x - square) / fifth
    if plant.geometry == CUBIC:
        square = plant.alpha * plant.alpha
        return 3.0 * x / (square * plant.alpha), -1.0 / square
    return 0.0, 0.0


@compiled
def potential(plant, x):
    """Return V(x), the integral of R from 0 to x."""
    if plant.geometry == EXACT:
        length = math.sqrt(x * x + plant.alpha * plant.alpha)
        return 0.5 * (x * x) - x * x / (length + plant.alpha)
    if plant.geometry == CUBIC:
        y = x / plant.alpha
        return 0.5 * (x * x) - 0.5 * (x * y) + 0.125 * (x * y * y * y)
    return 0.5 * (x * x)


@compiled
def friction_coefficient(plant, mode, v_rel):
    """Return mu(v_rel) with its sign frozen to ``mode``, Eq. 5 (with x' - v_b in the linear term, as Eq. 6 has it)."""
    return mode * plant.mu_s - plant.k1 * v_rel + plant.k3 * (v_rel * v_rel * v_rel)


@compiled
def friction_slope(plant, mode, v_rel):
    """Return mu'(v_rel)."""
    return -plant.k1 + 3.0 * plant.k3 * (v_rel * v_rel)


@compiled
def slip_forces(plant, mode, x, v, v_belt, u):
    """Return the acceleration in slip (Eq. 7 with a control force u) and the contact force -mu N in it."""
    restoring, normal = spring(plant, x)
    contact = -friction_coefficient(plant, mode, v - v_belt) * normal
    return contact - 2.0 * plant.beta * v - restoring + u, contact


@compiled
def stick_load(plant, x, v_belt, a_belt, u):
    """Return the force the contact must bear in stick, and the most that it can, mu_s N.

    Eq. 8 as it must read: |a_belt + 2 beta v_belt + R(x) - u| <= mu_s N(x).
    """
    restoring, normal = spring(plant, x)
    return a_belt + 2.0 * plant.beta * v_belt + restoring - u, plant.mu_s * normal


@compiled
def mode_at_zero_v_rel(plant, x, v_belt, a_belt, u):
    """Return the mode of a mass that moves with the belt: stick inside the cone, else slip the way the load pulls."""
    load, limit = stick_load(plant, x, v_belt, a_belt, u)
    if abs(load) <= limit:
        return STICK
    return SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD


@compiled
def mode_of(plant, x, v, v_belt, a_belt, u):
    """Return the mode of a state: the sign of v_rel, or what the stick cone says where v_rel is zero."""
    if v < v_belt:
        return SLIP_BACKWARD
    if v > v_belt:
        return SLIP_FORWARD
    return mode_at_zero_v_rel(plant, x, v_belt, a_belt, u)


# One Runge-Kutta step of slip ---------------------------------------------------------------------------------------

_C2 = 0.05260015195876773
_C3 = 0.0789002279381516
_C4 = 0.1183503419072274
_C5 = 0.2816496580927726
_C6 = 0.3333333333333333
_C7 = 0.25
_C8 = 0.3076923076923077
_C9 = 0.6512820512820513
_C10 = 0.6
_C11 = 0.8571428571428571
_C12 = 1.0
_A2_1 = 0.05260015195876773
_A3_1 = 0.0197250569845379
_A3_2 = 0.0591751709536137
_A4_1 = 0.02958758547680685
_A4_3 = 0.08876275643042054
_A5_1 = 0.2413651341592667
_A5_3 = -0.8845494793282861
_A5_4 = 0.924834003261792
_A6_1 = 0.037037037037037035
_A6_4 = 0.17082860872947386
_A6_5 = 0.12546768756682242
_A7_1 = 0.037109375
_A7_4 = 0.17025221101954405
_A7_5 = 0.06021653898045596
_A7_6 = -0.017578125
_A8_1 = 0.03709200011850479
_A8_4 = 0.17038392571223998
_A8_5 = 0.10726203044637328
_A8_6 = -0.015319437748624402
_A8_7 = 0.008273789163814023
_A9_1 = 0.6241109587160757
_A9_4 = -3.3608926294469414
_A9_5 = -0.868219346841726
_A9_6 = 27.59209969944671
_A9_7 = 20.154067550477894
_A9_8 = -43.48988418106996
_A10_1 = 0.47766253643826434
_A10_4 = -2.4881146199716677
_A10_5 = -0.590290826836843
_A10_6 = 21.230051448181193
_A10_7 = 15.279233632882423
_A10_8 = -33.28821096898486
_A10_9 = -0.020331201708508627
_A11_1 = -0.9371424300859873
_A11_4 = 5.186372428844064
_A11_5 = 1.0914373489967295
_A11_6 = -8.149787010746927
_A11_7 = -18.52006565999696
_A11_8 = 22.739487099350505
_A11_9 = 2.4936055526796523
_A11_10 = -3.0467644718982196
_A12_1 = 2.273310147516538
_A12_4 = -10.53449546673725
_A12_5 = -2.0008720582248625
_A12_6 = -17.9589318631188
_A12_7 = 27.94888452941996
_A12_8 = -2.8589982771350235
_A12_9 = -8.87285693353063
_A12_10 = 12.360567175794303
_A12_11 = 0.6433927460157636
_B1 = 0.054293734116568765
_B6 = 4.450312892752409
_B7 = 1.8915178993145003
_B8 = -5.801203960010585
_B9 = 0.3111643669578199
_B10 = -0.1521609496625161
_B11 = 0.20136540080403034
_B12 = 0.04471061572777259
_E5_1 = 0.01312004499419488
_E5_6 = -1.2251564463762044
_E5_7 = -0.4957589496572502
_E5_8 = 1.6643771824549864
_E5_9 = -0.35032884874997366
_E5_10 = 0.3341791187130175
_E5_11 = 0.08192320648511571
_E5_12 = -0.022355307863886294
_E3_1 = -0.18980075407240762
_E3_6 = 4.450312892752409
_E3_7 = 1.8915178993145003
_E3_8 = -5.801203960010585
_E3_9 = -0.4226823213237919
_E3_10 = -0.1521609496625161
_E3_11 = 0.20136540080403034
_E3_12 = 0.02265179219836082


@compiled
def slip_step(plant, mode, x, v, v_belt, dv_belt, u, h):
    """Take one step of length h in slip, over which the belt speed grows linearly by dv_belt.

    Return x, v, the acceleration at the start and (to a few digits fewer) at the end, the error estimate, and the
    integrals of v^2 and of the contact force's power over the step.
    """
    v1 = v
    a1, f1 = slip_forces(plant, mode, x, v, v_belt, u)
    v2 = v + h * (_A2_1 * a1)
    x2 = x + h * (_A2_1 * v1)
    a2, f2 = slip_forces(plant, mode, x2, v2, v_belt + _C2 * dv_belt, u)
    v3 = v + h * (_A3_1 * a1 + _A3_2 * a2)
    x3 = x + h * (_A3_1 * v1 + _A3_2 * v2)
    a3, f3 = slip_forces(plant, mode, x3, v3, v_belt + _C3 * dv_belt, u)
    v4 = v + h * (_A4_1 * a1 + _A4_3 * a3)
    x4 = x + h * (_A4_1 * v1 + _A4_3 * v3)
    a4, f4 = slip_forces(plant, mode, x4, v4, v_belt + _C4 * dv_belt, u)
    v5 = v + h * (_A5_1 * a1 + _A5_3 * a3 + _A5_4 * a4)
    x5 = x + h * (_A5_1 * v1 + _A5_3 * v3 + _A5_4 * v4)
    a5, f5 = slip_forces(plant, mode, x5, v5, v_belt + _C5 * dv_belt, u)
    v6 = v + h * (_A6_1 * a1 + _A6_4 * a4 + _A6_5 * a5)
    x6 = x + h * (_A6_1 * v1 + _A6_4 * v4 + _A6_5 * v5)
    a6, f6 = slip_forces(plant, mode, x6, v6, v_belt + _C6 * dv_belt, u)
    v7 = v + h * (_A7_1 * a1 + _A7_4 * a4 + _A7_5 * a5 + _A7_6 * a6)
    x7 = x + h * (_A7_1 * v1 + _A7_4 * v4 + _A7_5 * v5 + _A7_6 * v6)
    a7, f7 = slip_forces(plant, mode, x7, v7, v_belt + _C7 * dv_belt, u)
    v8 = v + h * (_A8_1 * a1 + _A8_4 * a4 + _A8_5 * a5 + _A8_6 * a6 + _A8_7 * a7)
    x8 = x + h * (_A8_1 * v1 + _A8_4 * v4 + _A8_5 * v5 + _A8_6 * v6 + _A8_7 * v7)
    a8, f8 = slip_forces(plant, mode, x8, v8, v_belt + _C8 * dv_belt, u)
    v9 = v + h * (_A9_1 * a1 + _A9_4 * a4 + _A9_5 * a5 + _A9_6 * a6 + _A9_7 * a7 + _A9_8 * a8)
    x9 = x + h * (_A9_1 * v1 + _A9_4 * v4 + _A9_5 * v5 + _A9_6 * v6 + _A9_7 * v7 + _A9_8 * v8)
    a9, f9 = slip_forces(plant, mode, x9, v9, v_belt + _C9 * dv_belt, u)
    v10 = v + h * (_A10_1 * a1 + _A10_4 * a4 + _A10_5 * a5 + _A10_6 * a6 + _A10_7 * a7 + _A10_8 * a8 + _A10_9 * a9)
    x10 = x + h * (_A10_1 * v1 + _A10_4 * v4 + _A10_5 * v5 + _A10_6 * v6 + _A10_7 * v7 + _A10_8 * v8 + _A10_9 * v9)
    a10, f10 = slip_forces(plant, mode, x10, v10, v_belt + _C10 * dv_belt, u)
    v11 = v + h * (
        _A11_1 * a1 + _A11_4 * a4 + _A11_5 * a5 + _A11_6 * a6 + _A11_7 * a7 + _A11_8 * a8 + _A11_9 * a9 + _A11_10 * a10
    )
    x11 = x + h * (
        _A11_1 * v1 + _A11_4 * v4 + _A11_5 * v5 + _A11_6 * v6 + _A11_7 * v7 + _A11_8 * v8 + _A11_9 * v9 + _A11_10 * v10
    )
    a11, f11 = slip_forces(plant, mode, x11, v11, v_belt + _C11 * dv_belt, u)
    v12 = v + h * (
        _A12_1 * a1
        + _A12_4 * a4
        + _A12_5 * a5
        + _A12_6 * a6
        + _A12_7 * a7
        + _A12_8 * a8
        + _A12_9 * a9
        + _A12_10 * a10
        + _A12_11 * a11
    )
    x12 = x + h * (
        _A12_1 * v1
        + _A12_4 * v4
        + _A12_5 * v5
        + _A12_6 * v6
        + _A12_7 * v7
        + _A12_8 * v8
        + _A12_9 * v9
        + _A12_10 * v10
        + _A12_11 * v11
    )
    a12, f12 = slip_forces(plant, mode, x12, v12, v_belt + _C12 * dv_belt, u)
    v_end = v + h * (_B1 * a1 + _B6 * a6 + _B7 * a7 + _B8 * a8 + _B9 * a9 + _B10 * a10 + _B11 * a11 + _B12 * a12)
    x_end = x + h * (_B1 * v1 + _B6 * v6 + _B7 * v7 + _B8 * v8 + _B9 * v9 + _B10 * v10 + _B11 * v11 + _B12 * v12)
    int_v2 = h * (
        _B1 * (v1 * v1)
        + _B6 * (v6 * v6)
        + _B7 * (v7 * v7)
        + _B8 * (v8 * v8)
        + _B9 * (v9 * v9)
        + _B10 * (v10 * v10)
        + _B11 * (v11 * v11)
        + _B12 * (v12 * v12)
    )
    int_fv = h * (
        _B1 * (f1 * v1)
        + _B6 * (f6 * v6)
        + _B7 * (f7 * v7)
        + _B8 * (f8 * v8)
        + _B9 * (f9 * v9)
        + _B10 * (f10 * v10)
        + _B11 * (f11 * v11)
        + _B12 * (f12 * v12)
    )
    e5x = _E5_1 * v1 + _E5_6 * v6 + _E5_7 * v7 + _E5_8 * v8 + _E5_9 * v9 + _E5_10 * v10 + _E5_11 * v11 + _E5_12 * v12
    e5v = _E5_1 * a1 + _E5_6 * a6 + _E5_7 * a7 + _E5_8 * a8 + _E5_9 * a9 + _E5_10 * a10 + _E5_11 * a11 + _E5_12 * a12
    e3x = _E3_1 * v1 + _E3_6 * v6 + _E3_7 * v7 + _E3_8 * v8 + _E3_9 * v9 + _E3_10 * v10 + _E3_11 * v11 + _E3_12 * v12
    e3v = _E3_1 * a1 + _E3_6 * a6 + _E3_7 * a7 + _E3_8 * a8 + _E3_9 * a9 + _E3_10 * a10 + _E3_11 * a11 + _E3_12 * a12
    # Hairer's blend of a fifth- and a third-order estimate; the tiny term only keeps 0/0 away.
    square5 = e5x * e5x + e5v * e5v
    square3 = e3x * e3x + e3v * e3v
    error = h * square5 / math.sqrt(2.0 * (square5 + 0.01 * square3) + 1e-200)
    return x_end, v_end, a1, a12, error, int_v2, int_fv


# Events in slip -----------------------------------------------------------------------------------------------------


@compiled
def _dips(gap, slope, gap_end, slope_end, h):
    """Whether a gap that is open at both ends of a step can close in between: it falls, then rises, and the two end
    tangents meet below zero."""
    if slope < 0.0 and slope_end > 0.0:
        t = (gap_end - gap - slope_end * h) / (slope - slope_end)
        return gap + slope * t < -V_REL_ZERO
    return False


@compiled
def _bottom_time(plant, mode, x, v, v_belt, a_belt, u, h, side, rate):
    """Return the time in (0, h) at which side (v - rate t) is least, where its slope changes sign once."""
    low = 0.0
    high = h
    for _ in range(60):
        t = 0.5 * (low + high)
        if high - low < TIME_ZERO:
            break
        _, _, _, a, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
        if side * (a - rate) < 0.0:
            low = t
        else:
            high = t
    return 0.5 * (low + high)


@compiled
def _closing_time(plant, mode, x, v, v_belt, a_belt, u, low, high, side, level, rate):
    """Return the time in (low, high] at which side (v - level - rate t) falls through zero: Newton in a bracket."""
    t = 0.5 * (low + high)
    if low == 0.0:
        start = side * (v - level)
        _, v_high, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * high, u, high)
        end = side * (v_high - level - rate * high)
        if start > V_REL_ZERO and end < start:
            t = min(high, high * start / (start - end))
    for _ in range(80):
        _, v_t, _, a_t, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
        gap = side * (v_t - level - rate * t)
        slope = side * (a_t - rate)
        if gap > 0.0:
            low = t
        else:
            high = t
        if high - low < TIME_ZERO:
            break
        t_next = t - gap / slope if slope < 0.0 else 0.5 * (low + high)
        if abs(t_next - t) < TIME_ZERO:
            break
        if not low < t_next < high:
            t_next = 0.5 * (low + high)
        t = t_next
    return t


@compiled
def _contact_loss_time(plant, mode, x, v, v_belt, a_belt, u, high):
    """Return the time in (0, high] at which the normal force falls to zero."""
    low = 0.0
    for _ in range(60):
        if high - low < TIME_ZERO:
            break
        t = 0.5 * (low + high)
        x_t, _, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
        if spring(plant, x_t)[1] > 0.0:
            low = t
        else:
            high = t
    return high


@compiled
def slip_until_event(plant, mode, x, v, v_belt, a_belt, u, duration, stop_at_turning):
    """Slip for ``duration``, or until v_rel returns to zero (LANDING), contact is lost (CONTACT_LOSS), v changes
    sign (TURNING, if asked for) or the error rule cannot be met (STUCK_STEP).

    Return the time spent, x, v, the event, the integrals of v^2 and of the contact force's power, and the least and
    greatest x met. After LANDING v equals the belt speed exactly, after TURNING it is exactly zero.
    """
    t = 0.0
    h = min(duration, MAX_SLIP_STEP)
    x_min = x
    x_max = x
    int_v2 = 0.0
    int_fv = 0.0
    event = NO_EVENT
    while t < duration:
        remaining = duration - t
        h = min(h, remaining)
        belt = v_belt + a_belt * t
        x_end, v_end, a, a_end, error, dv2, dfv = slip_step(plant, mode, x, v, belt, a_belt * h, u, h)
        allowed = TOLERANCE * h * max(1.0, abs(x), abs(v), STIFF * abs(a))
        if not error <= allowed:  # "not" lets a NaN shrink the step too
            h = 0.5 * h
            if h < MIN_SLIP_STEP:
                event = STUCK_STEP
                break
            continue
        length = h

        gap = mode * (v - belt)
        gap_end = mode * (v_end - (belt + a_belt * h))
        if gap > V_REL_ZERO:
            lands = gap_end <= 0.0
        else:  # it has just left the stick surface
            lands = gap_end < -V_REL_ZERO
        bracket = h
        if not lands and _dips(gap, mode * (a - a_belt), gap_end, mode * (a_end - a_belt), h):
            bracket = _bottom_time(plant, mode, x, v, belt, a_belt, u, h, mode, a_belt)
            _, v_low, _, _, _, _, _ = slip_step(plant, mode, x, v, belt, a_belt * bracket, u, bracket)
            lands = mode * (v_low - (belt + a_belt * bracket)) < -V_REL_ZERO
        if lands:
            length = _closing_time(plant, mode, x, v, belt, a_belt, u, 0.0, bracket, mode, belt, a_belt)
            x_end, v_end, a, a_end, error, dv2, dfv = slip_step(plant, mode, x, v, belt, a_belt * length, u, length)
            v_end = belt + a_belt * length
            event = LANDING

        turns = False
        low = 0.0
        bracket = length
        if v * v_end < 0.0:
            turns = True
        elif v != 0.0:
            side = 1 if v > 0.0 else -1
            if _dips(side * v, side * a, side * v_end, side * a_end, length):
                bracket = _bottom_time(plant, mode, x, v, belt, a_belt, u, length, side, 0.0)
                x_low, v_low, _, _, _, _, _ = slip_step(plant, mode, x, v, belt, a_belt * bracket, u, bracket)
                turns = side * v_low < -V_REL_ZERO
        if turns:
            side = 1 if v > 0.0 else -1
            t_turn = _closing_time(plant, mode, x, v, belt, a_belt, u, low, bracket, side, 0.0, 0.0)
            x_turn, v_turn, a_turn, a_turn_end, error_turn, dv2_turn, dfv_turn = slip_step(
                plant, mode, x, v, belt, a_belt * t_turn, u, t_turn
            )
            x_min = min(x_min, x_turn)
            x_max = max(x_max, x_turn)
            if stop_at_turning or spring(plant, x_turn)[1] <= 0.0:
                length, x_end, v_end, dv2, dfv = t_turn, x_turn, 0.0, dv2_turn, dfv_turn
                event = TURNING

        # N falls with |x|: it is least at a turning point or at the end of the step.
        if spring(plant, x_end)[1] <= 0.0:
            length = _contact_loss_time(plant, mode, x, v, belt, a_belt, u, length)
            x_end, v_end, a, a_end, error, dv2, dfv = slip_step(plant, mode, x, v, belt, a_belt * length, u, length)
            event = CONTACT_LOSS

        t = duration if event == NO_EVENT and h == remaining else t + length
        x = x_end
        v = v_end
        x_min = min(x_min, x)
        x_max = max(x_max, x)
        int_v2 += dv2
        int_fv += dfv
        if event != NO_EVENT:
            break
        if error < STEP_DOUBLING * allowed:
            h = min(2.0 * h, MAX_SLIP_STEP)
    if event == NO_EVENT:
        belt = v_belt + a_belt * duration
        if mode * (v - belt) <= V_REL_ZERO:
            v = belt
    return t, x, v, event, int_v2, int_fv, x_min, x_max


# Stick --------------------------------------------------------------------------------------------------------------


@compiled
def _cone_excess(plant, side, x, v_belt, a_belt, u, t):
    """Return by how much a mass stuck since t = 0 at x exceeds one side of the stick cone at time t, and the slope."""
    speed = v_belt + a_belt * t
    x_t = x + (v_belt + 0.5 * a_belt * t) * t
    load, limit = stick_load(plant, x_t, speed, a_belt, u)
    restoring_slope, normal_slope = spring_slopes(plant, x_t)
    load_slope = 2.0 * plant.beta * a_belt + restoring_slope * speed
    return side * load - limit, side * load_slope - plant.mu_s * normal_slope * speed


@compiled
def stick_until_event(plant, x, v_belt, a_belt, u, duration):
    """Ride with the belt for ``duration``, or until breakaway; return the time spent and the event.

    The cone is walked in pieces no longer than an eighth of the spring's length scale, each side of it on its own; a
    side that rises and falls again within a piece is followed to its top. The time returned lies just outside the
    cone.
    """
    scale = 1.0 if plant.geometry == LINEAR else min(1.0, plant.alpha)
    fastest = max(abs(v_belt), abs(v_belt + a_belt * duration))
    piece = duration
    if fastest > 0.0:
        piece = min(duration, 0.125 * scale / fastest)
    t = 0.0
    while t < duration:
        t_end = t + piece
        if t_end >= duration or t_end <= t:
            t_end = duration
        first = t_end
        found = False
        for side in (-1, 1):
            excess, slope = _cone_excess(plant, side, x, v_belt, a_belt, u, t)
            excess_end, slope_end = _cone_excess(plant, side, x, v_belt, a_belt, u, t_end)
            high = t_end
            outside = excess_end > 0.0
            if not outside and _dips(-excess, -slope, -excess_end, -slope_end, t_end - t):
                low = t
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if _cone_excess(plant, side, x, v_belt, a_belt, u, middle)[1] > 0.0:
                        low = middle
                    else:
                        high = middle
                outside = _cone_excess(plant, side, x, v_belt, a_belt, u, high)[0] > 0.0
            if outside:
                low = t
                for _ in range(80):
                    middle = 0.5 * (low + high)
                    if middle <= low or middle >= high:
                        break
                    if _cone_excess(plant, side, x, v_belt, a_belt, u, middle)[0] > 0.0:
                        high = middle
                    else:
                        low = middle
                first = min(first, high)
                found = True
        if found:
            return first, BREAKAWAY
        t = t_end
    return duration, NO_EVENT


# The automaton ------------------------------------------------------------------------------------------------------


@compiled
def advance(plant, x, v, v_belt, a_belt, u, duration, events):
    """Advance a state by ``duration`` under a held force u and a uniformly accelerating belt, events included.

    ``events`` is None, or an array of shape (n, 4) that takes time, kind, x and v of as many events as it has rows.
    Return x, v, v_belt, mode, status, the time reached (less than ``duration`` only if status is not OK), the number
    of events, the integral of v^2, the time stuck, the integral of the contact force's power, and the least and
    greatest x met.
    """
    t = 0.0
    n_events = 0
    int_v2 = 0.0
    int_fv = 0.0
    stick_time = 0.0
    x_min = x
    x_max = x
    belt = v_belt
    status = OK
    mode = mode_of(plant, x, v, v_belt, a_belt, u)
    if spring(plant, x)[1] <= 0.0:
        return x, v, v_belt, mode, CONTACT_LOST, 0.0, 0, 0.0, 0.0, 0.0, x, x
    while t < duration:
        remaining = duration - t
        if mode == STICK:
            dt, event = stick_until_event(plant, x, belt, a_belt, u, remaining)
            dx = (belt + 0.5 * a_belt * dt) * dt
            dv2 = (belt * belt + a_belt * dt * (belt + a_belt * dt / 3.0)) * dt
            # The contact force in stick is a_belt + 2 beta v_belt + R - u; its power integrates in closed form.
            int_fv += (a_belt - u) * dx + 2.0 * plant.beta * dv2 + potential(plant, x + dx) - potential(plant, x)
            int_v2 += dv2
            stick_time += dt
            if belt * (belt + a_belt * dt) < 0.0:  # the belt reverses
                x_turn = x - 0.5 * belt * belt / a_belt
                x_min = min(x_min, x_turn)
                x_max = max(x_max, x_turn)
            x = x + dx
            x_min = min(x_min, x)
            x_max = max(x_max, x)
        else:
            dt, x, v, event, dv2, dfv, low, high = slip_until_event(
                plant, mode, x, v, belt, a_belt, u, remaining, False
            )
            int_v2 += dv2
            int_fv += dfv
            x_min = min(x_min, low)
            x_max = max(x_max, high)
        t = duration if event == NO_EVENT else t + dt
        belt = v_belt + a_belt * t
        kind = event
        if mode == STICK:
            v = belt
            if event == BREAKAWAY:
                load, _ = stick_load(plant, x, belt, a_belt, u)
                mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
        elif event == LANDING:
            v = belt
            landed = mode_at_zero_v_rel(plant, x, belt, a_belt, u)
            kind = RESTICK if landed == STICK else (GRAZING if landed == mode else CROSSING)
            mode = landed
        elif event == NO_EVENT and v == belt:
            mode = mode_at_zero_v_rel(plant, x, belt, a_belt, u)
        if event != NO_EVENT:
            if events is not None:
                if n_events < len(events):
                    events[n_events, 0] = t
                    events[n_events, 1] = kind
                    events[n_events, 2] = x
                    events[n_events, 3] = v
            n_events += 1
            if event == CONTACT_LOSS:
                status = CONTACT_LOST
                break
            if event == STUCK_STEP:
                status = STEP_LIMIT
                break
            if n_events >= MAX_EVENTS:
                status = EVENT_LIMIT
                break
    return x, v, belt, mode, status, t, n_events, int_v2, stick_time, int_fv, x_min, x_max


@compiled
def trace(plant, x, v, v_belt, a_belt, u, times, samples, events):
    """Follow one held interval and keep samples: x, v, v_belt and mode at each of ``times`` (n,), counted from 0.

    ``samples`` (n, 4) and ``events`` (m, 4) are filled; the sampling stops early while there is still room for
    another sample's events. Return the samples taken, the events kept, the status, the time reached, and the integrals
    of v^2, of the stick indicator and of the contact force's power.
    """
    taken = 0
    n_events = 0
    int_v2 = 0.0
    stick_time = 0.0
    int_fv = 0.0
    status = OK
    t = 0.0
    while taken < len(times) and status == OK and len(events) - n_events >= MAX_EVENTS:
        x, v, belt, mode, status, dt, n, dv2, dstick, dfv, _, _ = advance(
            plant, x, v, v_belt + a_belt * t, a_belt, u, times[taken] - t, events[n_events:]
        )
        for i in range(n_events, n_events + n):
            events[i, 0] += t
        n_events += n
        int_v2 += dv2
        stick_time += dstick
        int_fv += dfv
        t = times[taken] if status == OK else t + dt
        samples[taken, 0] = x
        samples[taken, 1] = v
        samples[taken, 2] = belt
        samples[taken, 3] = mode
        taken += 1
    return taken, n_events, status, t, int_v2, stick_time, int_fv


# Passive orbits: pieces of the analysis that run many times ---------------------------------------------------------

REPEATED_BREAKAWAY, STILL_SLIPPING, AT_REST, ORBIT_LOST_CONTACT, ORBIT_UNDECIDED, AT_EQUILIBRIUM = 0, 1, 2, 3, 4, 5

SAME_PLACE = 1e-9  # breakaway points closer than this are one
STICK_PATIENCE = 1e12  # a belt this slow never brings a stuck mass to breakaway
# Slip that takes longer from one turning point or landing to the next creeps into a node or past a fold.
SLIP_PATIENCE = 2000.0
STANDSTILL = 1e-9


@compiled
def settle(plant, v_belt, x, v, turnings, exits):
    """Follow the passive motion until it breaks away where it did before, or slips through ``turnings`` maxima of x.

    A mass that sticks forgets its past, so a repeated breakaway point closes a stick-slip cycle. ``exits`` is scratch
    space of shape (n,) for the breakaway points met. Return the outcome, x (the breakaway point, the last maximum or
    the place of rest), the maximum before the last, and the minimum between.
    """
    mode = mode_of(plant, x, v, v_belt, 0.0, 0.0)
    n_exits = 0
    maxima = 0
    last_max = math.nan
    previous_max = math.nan
    last_min = math.nan
    if spring(plant, x)[1] <= 0.0:
        return ORBIT_LOST_CONTACT, x, math.nan, math.nan
    for _ in range(100 * turnings):
        if mode == STICK:
            dt, event = stick_until_event(plant, x, v_belt, 0.0, 0.0, STICK_PATIENCE)
            if event == NO_EVENT:
                return AT_REST, x, math.nan, math.nan
            x = x + v_belt * dt
            for i in range(n_exits):
                if abs(exits[i] - x) < SAME_PLACE:
                    return REPEATED_BREAKAWAY, x, math.nan, math.nan
            if n_exits == len(exits):
                return ORBIT_UNDECIDED, x, math.nan, math.nan
            exits[n_exits] = x
            n_exits += 1
            v = v_belt
            load, _ = stick_load(plant, x, v_belt, 0.0, 0.0)
            mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
            maxima = 0
            last_max = math.nan
            continue
        _, x, v, event, _, _, _, _ = slip_until_event(plant, mode, x, v, v_belt, 0.0, 0.0, SLIP_PATIENCE, True)
        if event == LANDING:
            mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
        elif event == TURNING:
            acceleration, _ = slip_forces(plant, mode, x, 0.0, v_belt, 0.0)
            if acceleration < 0.0:
                previous_max = last_max
                last_max = x
                maxima += 1
                if maxima >= turnings or abs(last_max - previous_max) < TIME_ZERO:
                    return STILL_SLIPPING, last_max, previous_max, last_min
            else:
                last_min = x
        elif event == CONTACT_LOSS:
            return ORBIT_LOST_CONTACT, x, math.nan, math.nan
        elif event == NO_EVENT and abs(v) < STANDSTILL:
            return AT_EQUILIBRIUM, x, math.nan, math.nan
        else:
            return ORBIT_UNDECIDED, x, math.nan, math.nan
    return ORBIT_UNDECIDED, x, math.nan, math.nan


@compiled
def stick_slip_lap(plant, v_belt, x_exit):
    """Follow a stick-slip cycle from the breakaway point ``x_exit`` until it breaks away there again.

    Return the outcome (REPEATED_BREAKAWAY if it closed), the period, the time stuck, the least and greatest x, the
    place of the last re-stick, the number of sticks, the number of forward-slip arcs and the integral of v^2.
    """
    x = x_exit
    v = v_belt
    load, _ = stick_load(plant, x, v_belt, 0.0, 0.0)
    mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
    t = 0.0
    stick_time = 0.0
    x_min = x
    x_max = x
    x_restick = math.nan
    sticks = 0
    forward_arcs = 1 if mode == SLIP_FORWARD else 0
    int_v2 = 0.0
    for _ in range(MAX_EVENTS):
        if mode == STICK:
            dt, event = stick_until_event(plant, x, v_belt, 0.0, 0.0, STICK_PATIENCE)
            t += dt
            stick_time += dt
            int_v2 += v_belt * v_belt * dt
            x = x + v_belt * dt
            x_max = max(x_max, x)
            sticks += 1
            if abs(x - x_exit) < SAME_PLACE:
                return REPEATED_BREAKAWAY, t, stick_time, x_min, x_max, x_restick, sticks, forward_arcs, int_v2
            load, _ = stick_load(plant, x, v_belt, 0.0, 0.0)
            mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
            if mode == SLIP_FORWARD:
                forward_arcs += 1
            v = v_belt
            continue
        dt, x, v, event, dv2, _, low, high = slip_until_event(plant, mode, x, v, v_belt, 0.0, 0.0, SLIP_PATIENCE, False)
        t += dt
        int_v2 += dv2
        x_min = min(x_min, low)
        x_max = max(x_max, high)
        if event != LANDING:
            break
        mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
        if mode == STICK:
            x_restick = x
        elif mode == SLIP_FORWARD:
            forward_arcs += 1
    return ORBIT_UNDECIDED, t, stick_time, x_min, x_max, x_restick, sticks, forward_arcs, int_v2


@compiled
def next_maximum(plant, v_belt, x):
    """Return map of slip: from a maximum of x (v = 0) to the next one, without a stick between.

    Return the event that ended it (TURNING if a maximum was reached), the next maximum, the minimum between, the
    time taken and the integral of v^2. A first arc that rises (x is no maximum) is not followed: the event is NO_EVENT.
    """
    mode = mode_of(plant, x, 0.0, v_belt, 0.0, 0.0)
    acceleration, _ = slip_forces(plant, mode, x, 0.0, v_belt, 0.0)
    if mode != SLIP_BACKWARD or acceleration >= 0.0:
        return NO_EVENT, math.nan, math.nan, math.nan, math.nan
    t, x_low, v, event, int_v2, _, _, _ = slip_until_event(plant, mode, x, 0.0, v_belt, 0.0, 0.0, SLIP_PATIENCE, True)
    if event != TURNING:
        return event, math.nan, x_low, t, int_v2
    dt, x_high, v, event, dv2, _, _, _ = slip_until_event(
        plant, mode, x_low, 0.0, v_belt, 0.0, 0.0, SLIP_PATIENCE, True
    )
    return event, x_high, x_low, t + dt, int_v2 + dv2


@compiled
def slip_returns_to_stick(plant, v_belt, x):
    """Whether a mass that breaks away at x sticks again before it has slipped through one more full lap."""
    v = v_belt
    load, _ = stick_load(plant, x, v_belt, 0.0, 0.0)
    mode = SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD
    maxima = 0
    for _ in range(MAX_EVENTS):
        _, x, v, event, _, _, _, _ = slip_until_event(plant, mode, x, v, v_belt, 0.0, 0.0, SLIP_PATIENCE, True)
        if event == LANDING:
            mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
            if mode == STICK:
                return True
        elif event == TURNING:
            if slip_forces(plant, mode, x, 0.0, v_belt, 0.0)[0] < 0.0:
                maxima += 1
                if maxima == 2:
                    return False
        else:
            return False
    return False


@compiled
def classify(plant, v_belt, xs, vs, exits, exit_labels, centres, bounds, bound_labels, labels):
    """Write the label of the attractor that each start (xs, vs) of shape (n,) reaches into ``labels``.

    A start that sticks is carried to one of the ``exits`` and has its label. A start that slips round the equilibrium
    ``centres[i]`` alone, from a maximum of x less than ``bounds[i, j]`` to its right, has ``bound_labels[i, j]`` for
    the first such j (rows end with infinite bounds labelled below zero, "not decided yet"). -1: lost contact, -2: not
    decided.
    """
    for n in range(len(xs)):
        x = xs[n]
        v = vs[n]
        label = -2
        mode = mode_of(plant, x, v, v_belt, 0.0, 0.0)
        if spring(plant, x)[1] <= 0.0:
            labels[n] = -1
            continue
        for _ in range(2000):
            if mode == STICK:
                dt, event = stick_until_event(plant, x, v_belt, 0.0, 0.0, STICK_PATIENCE)
                x = x + v_belt * dt
                best = 1e-6
                for i in range(len(exits)):
                    if abs(exits[i] - x) < best:
                        best = abs(exits[i] - x)
                        label = exit_labels[i]
                break
            _, x, v, event, _, _, _, _ = slip_until_event(plant, mode, x, v, v_belt, 0.0, 0.0, SLIP_PATIENCE, True)
            if event == LANDING:
                mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
            elif event == TURNING:
                if mode == SLIP_BACKWARD and slip_forces(plant, mode, x, 0.0, v_belt, 0.0)[0] < 0.0:
                    nearest = -1
                    for i in range(len(centres)):
                        if centres[i] < x:
                            nearest = i
                    if nearest >= 0:
                        j = 0
                        while x - centres[nearest] >= bounds[nearest, j]:
                            j += 1
                        if bound_labels[nearest, j] >= 0:
                            label = bound_labels[nearest, j]
                            break
            elif event == NO_EVENT and abs(v) < STANDSTILL:
                nearest = 0
                for i in range(len(centres)):
                    if abs(centres[i] - x) < abs(centres[nearest] - x):
                        nearest = i
                label = bound_labels[nearest, 0]
                break
            else:
                label = -1 if event == CONTACT_LOSS else -2
                break
        labels[n] = label


# One control interval -----------------------------------------------------------------------------------------------


@compiled
def control_interval(
    geometry,
    alpha,
    g1,
    beta,
    mu_s,
    k1,
    k3,
    actuator,
    authority,
    a_limit,
    belt_speed,
    interval,
    w_effort,
    w_stick,
    x,
    v,
    v_belt,
    action,
):
    """Apply an action in [-1, 1] for one control interval and weigh what came of it.

    FORCE: u = authority * action. BELT_SPEED: the belt heads for (1 + authority * action) * belt_speed at no more than
    a_limit, evenly over the interval. The reward terms (all <= 0) are averages over the interval.
    Return x, v, v_belt, mode, status, events, u, a_belt, the three reward terms (vibration, effort, stick), the
    means over the interval of v^2, of the stick indicator, of the contact force's and the control force's power, the
    least and greatest x, and the normal force at the end.
    """
    plant = Plant(geometry, alpha, g1, beta, mu_s, k1, k3)
    u = 0.0
    a_belt = 0.0
    if actuator == FORCE:
        u = authority * action
    else:
        target = (1.0 + authority * action) * belt_speed
        a_belt = min(max((target - v_belt) / interval, -a_limit), a_limit)
    x_start = x
    x, v, v_belt, mode, status, _, n_events, int_v2, stick_time, int_fv, x_min, x_max = advance(
        plant, x, v, v_belt, a_belt, u, interval, None
    )
    mean_v2 = int_v2 / interval
    stick_fraction = stick_time / interval
    return (
        x,
        v,
        v_belt,
        mode,
        status,
        n_events,
        u,
        a_belt,
        -mean_v2 / (belt_speed * belt_speed),
        -w_effort * (action * action),
        -w_stick * stick_fraction,
        mean_v2,
        stick_fraction,
        int_fv / interval,
        u * (x - x_start) / interval,
        x_min,
        x_max,
        spring(plant, x)[1],
    )


@compiled
def control_intervals(
    geometry,
    alpha,
    g1,
    beta,
    mu_s,
    k1,
    k3,
    actuator,
    authority,
    a_limit,
    belt_speed,
    interval,
    w_effort,
    w_stick,
    x,
    v,
    v_belt,
    action,
    x_end,
    v_end,
    v_belt_end,
    reward,
):
    """Apply :func:`control_interval` to n independent states: arrays of shape (n,), of which the last four take what
    comes out. Return how many of them ended with a status other than OK."""
    failures = 0
    for i in range(len(x)):
        end = control_interval(
            geometry,
            alpha,
            g1,
            beta,
            mu_s,
            k1,
            k3,
            actuator,
            authority,
            a_limit,
            belt_speed,
            interval,
            w_effort,
            w_stick,
            x[i],
            v[i],
            v_belt[i],
            action[i],
        )
        x_end[i] = end[0]
        v_end[i] = end[1]
        v_belt_end[i] = end[2]
        reward[i] = end[8] + end[9] + end[10]
        if end[4] != OK:
            failures += 1
    return failures


# Random numbers by counting -----------------------------------------------------------------------------------------
#
# 32-bit arithmetic in 64-bit signed integers: the low 32 bits of a product are the same whether it wraps (compiled) or
# not (interpreted). The finaliser is that of MurmurHash3.

_LOW_32 = 0xFFFFFFFF


@compiled
def _mix(h, word):
    h = ((h ^ (word & _LOW_32)) * 0x9E3779B1 + 0x7F4A7C15) & _LOW_32
    h ^= h >> 16
    h = (h * 0x85EBCA6B) & _LOW_32
    h ^= h >> 13
    h = (h * 0xC2B2AE35) & _LOW_32
    return h ^ (h >> 16)


@compiled
def random_uniform(key, episode, step, slot):
    """Return a number in [0, 1) that depends on nothing but a key (below 2^62), an episode, a step and a slot."""
    base = _mix(_mix(_mix(_mix(_mix(0x2545F491, key), key >> 32), episode), step), slot)
    high = _mix(base, 1)
    low = _mix(base ^ 0x5BD1E995, high)
    return ((high >> 5) * 67108864 + (low >> 6)) * (1.0 / 9007199254740992.0)


@compiled
def random_normal(key, episode, step, slot):
    """Return a standard normal number by Box and Muller's formula, from slots 2 slot and 2 slot + 1."""
    radius = math.sqrt(-2.0 * math.log(1.0 - random_uniform(key, episode, step, 2 * slot)))
    return radius * math.cos(2.0 * math.pi * random_uniform(key, episode, step, 2 * slot + 1))
