# All compiled code of the project stands in this one file. The on-disk cache watches only the file that defines a
# function (and compilation.py): a law changed in another file would leave the old force in use, silently.
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
import numba.extending
import numpy as np

from sd_friction_env.compilation import compiled, in_lanes, in_threads

EXACT, CUBIC, LINEAR, DUFFING, DISCONTINUOUS = 0, 1, 2, 3, 4
STRIBECK, COULOMB, HYPERBOLIC, EXPONENTIAL = 0, 1, 2, 3

# The mode is the sign of v_rel, frozen until an event.
SLIP_BACKWARD, STICK, SLIP_FORWARD = -1, 0, 1
UNKNOWN = 2  # what the mode was before

OK, CONTACT_LOST, EVENT_LIMIT, STEP_LIMIT = 0, 1, 2, 3

NO_EVENT, RESTICK, CROSSING, GRAZING, BREAKAWAY, CONTACT_LOSS, TURNING, LANDING = range(8)
STEP_SIZE_UNDERFLOW, SWITCHING = 8, 9

STATUS_NAMES = {OK: "ok", CONTACT_LOST: "contact lost", EVENT_LIMIT: "event limit", STEP_LIMIT: "step limit"}
EVENT_NAMES = {
    RESTICK: "restick",
    CROSSING: "crossing",
    GRAZING: "grazing",
    BREAKAWAY: "breakaway",
    CONTACT_LOSS: "contact-loss",
    STEP_SIZE_UNDERFLOW: "step-limit",
    SWITCHING: "switching",
}

FORCE, BELT_SPEED = 0, 1

# Estimated error per unit of time, relative to max(1, |x|, |v|, STIFF |x''|); the estimate can be too low.
TOLERANCE = 1e-10
MAX_SLIP_STEP = 0.2
MIN_SLIP_STEP = 1e-16
# A motion that needs more trial steps than these is given up (STEP_LIMIT): so many at once, so many per unit of time.
SLIP_TRIALS, SLIP_TRIAL_RATE = 100000.0, 15000.0
FASTEST_DAMPING = 3.0  # a step times the rate at which friction and damping change v_rel: longer ones are doubted
STIFF = 1e-4  # where friction is so steep that v changes by |a| h, no estimate gets below 1e-14 of that change
MAX_EVENTS = 256  # in one call of advance
NOTHING_KNOWN = (0.0,) * 18  # of a slip that begins
V_REL_ZERO = 1e-14  # relative velocities this small cannot be told from zero after one step's rounding
TIME_ZERO = 1e-13  # events are located this closely in time
HUGE_EXPONENT = 700.0  # a trial step across the surface may ask for more, and is refused anyway
PHASE_ROUNDING = 1e-15  # of a phase, relative to itself
ROUNDING = 1e-14  # of a sum of forces, relative to the greatest of them
SIDE_ZERO = 1e-14  # x this small is on neither side of zero
LAYER_REACH = 4.0  # by so many times its distance and its width may a step change v_rel next to a friction layer
LAST_STRETCH = 1e-5  # of a step: a Taylor step of this length is exact to rounding
STEP_DOUBLING = 1.0 / 1024.0  # a step this far inside the rule doubles: the error falls as h^8, four times the margin


class Laws(NamedTuple):
    """What a plant has beyond the paper's: another friction law, the Duffing spring, the discontinuous limit alpha = 0,
    excitation. :class:`Plant` has it, or None: numba compiles the kernel for each, and what stands under ``is None``
    below is not there in the other.
    """

    side: float  # of x = 0 where the field is frozen, for alpha = 0; 0: by x
    friction: int
    mu_k: float  # kinetic (Coulomb) or least (exponential)
    decay: float  # delta of the hyperbolic law, v_0 of the exponential one
    mu_v: float
    kappa: float
    force: float  # excitation: force cos(force_rate time + force_phase)
    force_rate: float
    force_phase: float
    ripple: float  # the belt's speed is greater by ripple cos(ripple_rate time + ripple_phase)
    ripple_rate: float
    ripple_phase: float
    depth: float  # the spring's force is 1 + depth cos(depth_rate time + depth_phase) times as great
    depth_rate: float
    depth_phase: float
    time: float  # at the beginning of a call


NO_LAWS = Laws(0.0, STRIBECK, *(0.0,) * 14)


class Plant(NamedTuple):
    """What the equations of motion need: Eq. 4's geometry and damping, Eq. 5's friction law, and what is beyond."""

    geometry: int
    alpha: float
    g1: float
    beta: float
    mu_s: float
    k1: float
    k3: float
    laws: Laws | None = None


# What a plant may have beyond the paper's ---------------------------------------------------------------------------
#
# Time is the plant's: `later` gives the plant as it is after a time t. With a ripple on the belt, slip and stick are
# reckoned in the frame that moves with the ripple: x - integral of it, v - ripple. There the belt's motion is the plain
# one, and v_rel is what it was. `room_x` and `room_v` lead back. Without laws all these are the identity, and cost
# nothing.


@compiled
def _later(plant, laws, t):
    if laws is None:
        return plant
    return _with_laws(plant, laws, laws.side, laws.time + t)


@compiled
def _with_laws(plant, laws, side, time):
    return _with_phases(plant, laws, side, laws.force_phase, laws.ripple_phase, laws.depth_phase, time)


@compiled
def _with_phases(plant, laws, side, force_phase, ripple_phase, depth_phase, time):
    new = Laws(
        side,
        laws.friction,
        laws.mu_k,
        laws.decay,
        laws.mu_v,
        laws.kappa,
        laws.force,
        laws.force_rate,
        force_phase,
        laws.ripple,
        laws.ripple_rate,
        ripple_phase,
        laws.depth,
        laws.depth_rate,
        depth_phase,
        time,
    )
    return Plant(plant.geometry, plant.alpha, plant.g1, plant.beta, plant.mu_s, plant.k1, plant.k3, new)


@compiled
def _phase_of(rate, phase, time):
    angle = rate * time + phase
    return angle % (2.0 * math.pi) if abs(angle) > 2.0 * math.pi else angle


@compiled
def _from_now(plant, laws):
    """Return the plant with its clock set to zero: small phases are rounded less while a motion is followed."""
    if laws is None:
        return plant
    if laws.force == 0.0 and laws.ripple == 0.0 and laws.depth == 0.0:
        return plant
    force_phase = _phase_of(laws.force_rate, laws.force_phase, laws.time)
    ripple_phase = _phase_of(laws.ripple_rate, laws.ripple_phase, laws.time)
    depth_phase = _phase_of(laws.depth_rate, laws.depth_phase, laws.time)
    return _with_phases(plant, laws, laws.side, force_phase, ripple_phase, depth_phase, 0.0)


@compiled
def later(plant, t):
    """Return the plant as it is after a time t."""
    return _later(plant, plant.laws, t)


@compiled
def _ripple(laws):
    """Return the ripple's way, speed, acceleration and jerk."""
    if laws.ripple == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    rate = laws.ripple_rate
    angle = rate * laws.time + laws.ripple_phase
    c = laws.ripple * math.cos(angle)
    s = laws.ripple * math.sin(angle)
    return s / rate, c, -rate * s, -rate * rate * c


@compiled
def _excitation(laws):
    """Return the exciting force and its rate of change."""
    if laws.force == 0.0:
        return 0.0, 0.0
    angle = laws.force_rate * laws.time + laws.force_phase
    return laws.force * math.cos(angle), -laws.force * laws.force_rate * math.sin(angle)


@compiled
def _stiffness(laws):
    """Return the factor of the spring's force and its rate of change."""
    if laws.depth == 0.0:
        return 1.0, 0.0
    angle = laws.depth_rate * laws.time + laws.depth_phase
    return 1.0 + laws.depth * math.cos(angle), -laws.depth * laws.depth_rate * math.sin(angle)


@compiled
def _room_x(laws, x):
    if laws is None:
        return x
    return x + _ripple(laws)[0] if laws.ripple != 0.0 else x


@compiled
def _room_v(laws, v):
    if laws is None:
        return v
    return v + _ripple(laws)[1] if laws.ripple != 0.0 else v


@compiled
def _room_a(laws, a):
    if laws is None:
        return a
    return a + _ripple(laws)[2] if laws.ripple != 0.0 else a


@compiled
def room_x(plant, x):
    """Return where a mass at x in the ripple's frame is."""
    return _room_x(plant.laws, x)


@compiled
def room_v(plant, v):
    """Return how fast a mass of velocity v in the ripple's frame is."""
    return _room_v(plant.laws, v)


@compiled
def _v_rel_zero(laws, v_belt):
    """Return which relative velocities cannot be told from zero where a state is left and taken up again."""
    if laws is None:
        return V_REL_ZERO
    if laws.ripple == 0.0:
        return V_REL_ZERO
    # Where a state was left, its time was rounded otherwise, and so was the ripple's phase.
    phase = laws.ripple_rate * laws.time + abs(laws.ripple_phase)
    return V_REL_ZERO + PHASE_ROUNDING * (laws.ripple * phase + abs(v_belt))


@compiled
def _into_frame(laws, x, v, v_belt):
    if laws is None:
        return x, v
    if laws.ripple == 0.0:
        return x, v
    way, speed, _, _ = _ripple(laws)
    v = v - speed
    return x - way, v_belt if abs(v - v_belt) <= _v_rel_zero(laws, v_belt) else v


@compiled
def _frame_v(laws, v):
    if laws is None:
        return v
    return v - _ripple(laws)[1] if laws.ripple != 0.0 else v


@compiled
def _driven(laws, u):
    if laws is None:
        return u
    if laws.force != 0.0:
        u = u + _excitation(laws)[0]
    if laws.ripple != 0.0:
        u = u - _ripple(laws)[2]
    return u


@compiled
def _faced(plant, laws, x, v):
    if laws is None:
        return plant
    if plant.geometry != DISCONTINUOUS or laws.side != 0.0:
        return plant
    if abs(x) > SIDE_ZERO:
        return _with_laws(plant, laws, 1.0 if x > 0.0 else -1.0, laws.time)
    if v == 0.0:
        return plant
    return _with_laws(plant, laws, 1.0 if v > 0.0 else -1.0, laws.time)


@compiled
def faced(plant, x, v):
    """Return the plant with its field frozen to the side of x = 0 on which a mass is, or, from 0, to which it moves."""
    return _faced(plant, plant.laws, room_x(plant, x), room_v(plant, v))


# Laws -------------------------------------------------------------------------------------------------------------


@compiled
def _spring_beyond(plant, laws, x):
    if laws is None:
        return x, plant.g1
    if plant.geometry == DUFFING:
        # Reference [8] of the paper: R = x + kappa x^3, N = g1
        return x + laws.kappa * (x * x * x), plant.g1
    if plant.geometry == DISCONTINUOUS:
        # Eq. 4 with alpha = 0: R = x - sgn(x), N = g1; R(0) = 0 for a mass that does not move
        side = laws.side
        if side == 0.0 and x != 0.0:
            side = 1.0 if x > 0.0 else -1.0
        return x - side, plant.g1
    return x, plant.g1


@compiled
def _modulated(plant, laws, restoring, normal):
    if laws is None:
        return restoring, normal
    if laws.depth == 0.0:
        return restoring, normal
    factor = _stiffness(laws)[0]
    return restoring * factor, plant.g1 + (normal - plant.g1) * factor


@compiled
def spring(plant, x):
    """Return the restoring force R(x) and the normal force N(x)."""
    restoring, normal = _spring(plant, x)
    return _modulated(plant, plant.laws, restoring, normal)


@compiled
def _spring(plant, x):
    if plant.geometry == EXACT:
        # Eq. 4: R = x (1 - 1/sqrt(x^2 + alpha^2)), N = g1 - alpha (1 - 1/sqrt(x^2 + alpha^2))
        stretch = 1.0 - 1.0 / math.sqrt(x * x + plant.alpha * plant.alpha)
        return x * stretch, plant.g1 - plant.alpha * stretch
    if plant.geometry == CUBIC:
        # Eq. 9: R = x - x/alpha + x^3/(2 alpha^3), N = g1 - alpha + 1 - x^2/(2 alpha^2)
        y = x / plant.alpha
        return x - y + 0.5 * (y * y * y), plant.g1 - plant.alpha + 1.0 - 0.5 * (y * y)
    # Reference [1] of the paper: R = x, N = g1
    return _spring_beyond(plant, plant.laws, x)


@compiled
def _slopes_beyond(plant, laws, x):
    if laws is None:
        return 1.0, 0.0
    return (1.0 + 3.0 * laws.kappa * (x * x) if plant.geometry == DUFFING else 1.0), 0.0


@compiled
def _modulated_pair(laws, first, second):
    if laws is None:
        return first, second
    if laws.depth == 0.0:
        return first, second
    factor = _stiffness(laws)[0]
    return first * factor, second * factor


@compiled
def spring_slopes(plant, x):
    """Return R'(x) and N'(x)."""
    restoring_slope, normal_slope = _spring_slopes(plant, x)
    return _modulated_pair(plant.laws, restoring_slope, normal_slope)


@compiled
def _spring_slopes(plant, x):
    if plant.geometry == EXACT:
        length = math.sqrt(x * x + plant.alpha * plant.alpha)
        cube = length * length * length
        return 1.0 - 1.0 / length + x * x / cube, -plant.alpha * x / cube
    if plant.geometry == CUBIC:
        y = x / plant.alpha
        return 1.0 - (1.0 - 1.5 * (y * y)) / plant.alpha, -y / plant.alpha
    return _slopes_beyond(plant, plant.laws, x)


@compiled
def spring_curvatures(plant, x):
    """Return R''(x) and N''(x), the stiffness unmodulated."""
    if plant.geometry == EXACT:
        square = plant.alpha * plant.alpha
        length = math.sqrt(x * x + square)
        fifth = length * length * length * length * length
        return 3.0 * square * x / fifth, plant.alpha * (2.0 * x * x - square) / fifth
    if plant.geometry == CUBIC:
        square = plant.alpha * plant.alpha
        return 3.0 * x / (square * plant.alpha), -1.0 / square
    return _curvature_beyond(plant, plant.laws, x), 0.0


@compiled
def _curvature_beyond(plant, laws, x):
    if laws is None:
        return 0.0
    return 6.0 * laws.kappa * x if plant.geometry == DUFFING else 0.0


@compiled
def potential(plant, x):
    """Return V(x), the integral of R from 0 to x."""
    if plant.geometry == EXACT:
        length = math.sqrt(x * x + plant.alpha * plant.alpha)
        return 0.5 * (x * x) - x * x / (length + plant.alpha)
    if plant.geometry == CUBIC:
        y = x / plant.alpha
        return 0.5 * (x * x) - 0.5 * (x * y) + 0.125 * (x * y * y * y)
    return _potential_beyond(plant, plant.laws, x)


@compiled
def _potential_beyond(plant, laws, x):
    if laws is None:
        return 0.5 * (x * x)
    if plant.geometry == DUFFING:
        return 0.5 * (x * x) + 0.25 * laws.kappa * (x * x * x * x)
    if plant.geometry == DISCONTINUOUS:
        return 0.5 * (x * x) - abs(x)
    return 0.5 * (x * x)


@compiled
def friction_coefficient(plant, mode, v_rel):
    """Return mu(v_rel) with its sign frozen to ``mode``, Eq. 5 (with x' - v_b in the linear term, as Eq. 6 has it), or
    that of another law."""
    return _friction_coefficient(plant, plant.laws, mode, v_rel)


@compiled
def _friction_coefficient(plant, laws, mode, v_rel):
    if laws is None:
        return mode * plant.mu_s - plant.k1 * v_rel + plant.k3 * (v_rel * v_rel * v_rel)
    if laws.friction == COULOMB:
        return mode * laws.mu_k
    if laws.friction == HYPERBOLIC:
        return mode * plant.mu_s / (1.0 + laws.decay * (mode * v_rel))
    if laws.friction == EXPONENTIAL:
        fall = math.exp(min(-(mode * v_rel) / laws.decay, HUGE_EXPONENT))
        return mode * (laws.mu_k + (plant.mu_s - laws.mu_k) * fall) + laws.mu_v * v_rel
    return mode * plant.mu_s - plant.k1 * v_rel + plant.k3 * (v_rel * v_rel * v_rel)


@compiled
def friction_slope(plant, mode, v_rel):
    """Return mu'(v_rel)."""
    return _friction_slope(plant, plant.laws, mode, v_rel)


@compiled
def _friction_slope(plant, laws, mode, v_rel):
    if laws is None:
        return -plant.k1 + 3.0 * plant.k3 * (v_rel * v_rel)
    if laws.friction == COULOMB:
        return 0.0
    if laws.friction == HYPERBOLIC:
        # mode^2 = 1 in slip
        below = 1.0 + laws.decay * (mode * v_rel)
        return -plant.mu_s * laws.decay / (below * below)
    if laws.friction == EXPONENTIAL:
        fall = math.exp(min(-(mode * v_rel) / laws.decay, HUGE_EXPONENT))
        return -(plant.mu_s - laws.mu_k) / laws.decay * fall + laws.mu_v
    return -plant.k1 + 3.0 * plant.k3 * (v_rel * v_rel)


@compiled
def slip_forces(plant, mode, x, v, v_belt, u):
    """Return the acceleration in slip (Eq. 7 with a control force u) and the contact force -mu N in it."""
    restoring, normal = spring(plant, room_x(plant, x))
    contact = -friction_coefficient(plant, mode, v - v_belt) * normal
    return contact - 2.0 * plant.beta * room_v(plant, v) - restoring + _driven(plant.laws, u), contact


@compiled
def stick_load(plant, x, v_belt, a_belt, u):
    """Return the force the contact must bear in stick, and the most that it can, mu_s N.

    Eq. 8 as it must read: |a_belt + 2 beta v_belt + R(x) - u| <= mu_s N(x).
    """
    plant = faced(plant, x, v_belt)
    restoring, normal = spring(plant, room_x(plant, x))
    load = a_belt + 2.0 * plant.beta * room_v(plant, v_belt) + restoring - _driven(plant.laws, u)
    return load, plant.mu_s * normal


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
    x, v = _into_frame(plant.laws, x, v, v_belt)
    return _mode_of(plant, x, v, v_belt, a_belt, u)


@compiled
def _mode_of(plant, x, v, v_belt, a_belt, u):
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


def _slip_step(plant, mode, x, v, v_belt, dv_belt, u, h):
    """Take one step of length h in slip, over which the belt speed grows linearly by dv_belt.

    Return x, v, the acceleration at the start and (to a few digits fewer) at the end, the error estimate, and the
    integrals of v^2 and of the contact force's power over the step.
    """
    v1 = v
    a1, f1 = slip_forces(plant, mode, x, v, v_belt, u)
    v2 = v + h * (_A2_1 * a1)
    x2 = x + h * (_A2_1 * v1)
    a2, f2 = slip_forces(later(plant, _C2 * h), mode, x2, v2, v_belt + _C2 * dv_belt, u)
    v3 = v + h * (_A3_1 * a1 + _A3_2 * a2)
    x3 = x + h * (_A3_1 * v1 + _A3_2 * v2)
    a3, f3 = slip_forces(later(plant, _C3 * h), mode, x3, v3, v_belt + _C3 * dv_belt, u)
    v4 = v + h * (_A4_1 * a1 + _A4_3 * a3)
    x4 = x + h * (_A4_1 * v1 + _A4_3 * v3)
    a4, f4 = slip_forces(later(plant, _C4 * h), mode, x4, v4, v_belt + _C4 * dv_belt, u)
    v5 = v + h * (_A5_1 * a1 + _A5_3 * a3 + _A5_4 * a4)
    x5 = x + h * (_A5_1 * v1 + _A5_3 * v3 + _A5_4 * v4)
    a5, f5 = slip_forces(later(plant, _C5 * h), mode, x5, v5, v_belt + _C5 * dv_belt, u)
    v6 = v + h * (_A6_1 * a1 + _A6_4 * a4 + _A6_5 * a5)
    x6 = x + h * (_A6_1 * v1 + _A6_4 * v4 + _A6_5 * v5)
    a6, f6 = slip_forces(later(plant, _C6 * h), mode, x6, v6, v_belt + _C6 * dv_belt, u)
    v7 = v + h * (_A7_1 * a1 + _A7_4 * a4 + _A7_5 * a5 + _A7_6 * a6)
    x7 = x + h * (_A7_1 * v1 + _A7_4 * v4 + _A7_5 * v5 + _A7_6 * v6)
    a7, f7 = slip_forces(later(plant, _C7 * h), mode, x7, v7, v_belt + _C7 * dv_belt, u)
    v8 = v + h * (_A8_1 * a1 + _A8_4 * a4 + _A8_5 * a5 + _A8_6 * a6 + _A8_7 * a7)
    x8 = x + h * (_A8_1 * v1 + _A8_4 * v4 + _A8_5 * v5 + _A8_6 * v6 + _A8_7 * v7)
    a8, f8 = slip_forces(later(plant, _C8 * h), mode, x8, v8, v_belt + _C8 * dv_belt, u)
    v9 = v + h * (_A9_1 * a1 + _A9_4 * a4 + _A9_5 * a5 + _A9_6 * a6 + _A9_7 * a7 + _A9_8 * a8)
    x9 = x + h * (_A9_1 * v1 + _A9_4 * v4 + _A9_5 * v5 + _A9_6 * v6 + _A9_7 * v7 + _A9_8 * v8)
    a9, f9 = slip_forces(later(plant, _C9 * h), mode, x9, v9, v_belt + _C9 * dv_belt, u)
    v10 = v + h * (_A10_1 * a1 + _A10_4 * a4 + _A10_5 * a5 + _A10_6 * a6 + _A10_7 * a7 + _A10_8 * a8 + _A10_9 * a9)
    x10 = x + h * (_A10_1 * v1 + _A10_4 * v4 + _A10_5 * v5 + _A10_6 * v6 + _A10_7 * v7 + _A10_8 * v8 + _A10_9 * v9)
    a10, f10 = slip_forces(later(plant, _C10 * h), mode, x10, v10, v_belt + _C10 * dv_belt, u)
    v11 = v + h * (
        _A11_1 * a1 + _A11_4 * a4 + _A11_5 * a5 + _A11_6 * a6 + _A11_7 * a7 + _A11_8 * a8 + _A11_9 * a9 + _A11_10 * a10
    )
    x11 = x + h * (
        _A11_1 * v1 + _A11_4 * v4 + _A11_5 * v5 + _A11_6 * v6 + _A11_7 * v7 + _A11_8 * v8 + _A11_9 * v9 + _A11_10 * v10
    )
    a11, f11 = slip_forces(later(plant, _C11 * h), mode, x11, v11, v_belt + _C11 * dv_belt, u)
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
    a12, f12 = slip_forces(later(plant, _C12 * h), mode, x12, v12, v_belt + _C12 * dv_belt, u)
    v_end = v + h * (_B1 * a1 + _B6 * a6 + _B7 * a7 + _B8 * a8 + _B9 * a9 + _B10 * a10 + _B11 * a11 + _B12 * a12)
    x_end = x + h * (_B1 * v1 + _B6 * v6 + _B7 * v7 + _B8 * v8 + _B9 * v9 + _B10 * v10 + _B11 * v11 + _B12 * v12)
    w1 = room_v(plant, v1)
    w6 = room_v(later(plant, _C6 * h), v6)
    w7 = room_v(later(plant, _C7 * h), v7)
    w8 = room_v(later(plant, _C8 * h), v8)
    w9 = room_v(later(plant, _C9 * h), v9)
    w10 = room_v(later(plant, _C10 * h), v10)
    w11 = room_v(later(plant, _C11 * h), v11)
    w12 = room_v(later(plant, _C12 * h), v12)
    int_v2 = h * (
        _B1 * (w1 * w1)
        + _B6 * (w6 * w6)
        + _B7 * (w7 * w7)
        + _B8 * (w8 * w8)
        + _B9 * (w9 * w9)
        + _B10 * (w10 * w10)
        + _B11 * (w11 * w11)
        + _B12 * (w12 * w12)
    )
    int_fv = h * (
        _B1 * (f1 * w1)
        + _B6 * (f6 * w6)
        + _B7 * (f7 * w7)
        + _B8 * (f8 * w8)
        + _B9 * (f9 * w9)
        + _B10 * (f10 * w10)
        + _B11 * (f11 * w11)
        + _B12 * (f12 * w12)
    )
    e5x = _E5_1 * v1 + _E5_6 * v6 + _E5_7 * v7 + _E5_8 * v8 + _E5_9 * v9 + _E5_10 * v10 + _E5_11 * v11 + _E5_12 * v12
    e5v = _E5_1 * a1 + _E5_6 * a6 + _E5_7 * a7 + _E5_8 * a8 + _E5_9 * a9 + _E5_10 * a10 + _E5_11 * a11 + _E5_12 * a12
    e3x = _E3_1 * v1 + _E3_6 * v6 + _E3_7 * v7 + _E3_8 * v8 + _E3_9 * v9 + _E3_10 * v10 + _E3_11 * v11 + _E3_12 * v12
    e3v = _E3_1 * a1 + _E3_6 * a6 + _E3_7 * a7 + _E3_8 * a8 + _E3_9 * a9 + _E3_10 * a10 + _E3_11 * a11 + _E3_12 * a12
    # Hairer's blend of a fifth- and a third-order estimate; the tiny term only keeps 0/0 away.
    square5 = e5x * e5x + e5v * e5v
    square3 = e3x * e3x + e3v * e3v
    blend = 2.0 * (square5 + 0.01 * square3) + 1e-200
    # Where friction damps faster than the stages can follow, the fifth-order estimate may be small by accident.
    rate = abs(friction_slope(plant, mode, v - v_belt) * spring(plant, room_x(plant, x))[1]) + 2.0 * plant.beta
    followed = h * rate <= FASTEST_DAMPING
    numerator = square5 if followed else square3
    blend = blend if followed else square3 + 1e-200
    # Where the stages overflow, a finite number over an infinite one would read as no error at all.
    error = h * numerator / math.sqrt(blend) if blend < math.inf else math.inf
    return x_end, v_end, a1, a12, error, int_v2, int_fv


slip_step = compiled(_slip_step)


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
def slip_jerk(plant, mode, x, v, v_belt, a_belt, a):
    """Return the rate of change of the acceleration a in slip, under a held force."""
    v_rel = v - v_belt
    x = room_x(plant, x)
    w = room_v(plant, v)
    restoring_slope, normal_slope = spring_slopes(plant, x)
    contact = friction_slope(plant, mode, v_rel) * (a - a_belt) * spring(plant, x)[1]
    contact = contact + friction_coefficient(plant, mode, v_rel) * normal_slope * w
    jerk = -contact - 2.0 * plant.beta * _room_a(plant.laws, a) - restoring_slope * w
    return _aging_jerk(plant, plant.laws, mode, x, v_rel, jerk)


@compiled
def _aging(plant, laws, x):
    """Return how fast, at a place x, the drive grows (less the ripple's part), and R and N."""
    drive = _excitation(laws)[1]
    if laws.ripple != 0.0:
        drive = drive - _ripple(laws)[3]
    factor_rate = _stiffness(laws)[1]
    restoring, normal = _spring(plant, x)
    return drive, factor_rate * restoring, factor_rate * (normal - plant.g1)


@compiled
def _aging_jerk(plant, laws, mode, x, v_rel, jerk):
    if laws is None:
        return jerk
    drive, restoring, normal = _aging(plant, laws, x)
    return jerk + drive - restoring - _friction_coefficient(plant, laws, mode, v_rel) * normal


@compiled
def _without_aging(plant, laws, x, slope):
    """Take from the rate of change of a sum of forces what the drive and the modulated spring have in it."""
    if laws is None:
        return slope
    drive, restoring, _ = _aging(plant, laws, room_x(plant, x))
    return slope - drive + restoring


@compiled
def _of_turning(laws, side, gap, slope, curvature):
    """Turn a gap between v in the ripple's frame and zero into one between v in the room and zero."""
    if laws is None:
        return gap, slope, curvature
    if laws.ripple == 0.0:
        return gap, slope, curvature
    _, speed, acceleration, jerk = _ripple(laws)
    return gap + side * speed, slope + side * acceleration, curvature + side * jerk


@in_lanes
def _gap_there(plant, mode, x_t, v_t, v_belt, a_belt, u, t, side, level, rate, dv2, dfv):
    belt = v_belt + a_belt * t
    a_t, f_t = slip_forces(plant, mode, x_t, v_t, belt, u)
    gap = side * (v_t - (level + rate * t))
    curvature = side * slip_jerk(plant, mode, x_t, v_t, belt, a_belt, a_t)
    return gap, side * (a_t - rate), curvature, x_t, v_t, a_t, f_t, dv2, dfv


@compiled
def _gap_at(plant, mode, x, v, v_belt, a_belt, u, t, side, level, rate, turning):
    """Slip for a time t; return the gap side (v - level - rate t), its slope and curvature, x, v, a, the contact force
    and the integrals of v^2 and of that force's power. With ``turning`` the gap is to rest in the room."""
    x_t, v_t, _, _, _, dv2, dfv = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
    then = later(plant, t)
    gap, slope, curvature, x_t, v_t, a_t, f_t, dv2, dfv = _gap_there(
        then, mode, x_t, v_t, v_belt, a_belt, u, t, side, level, rate, dv2, dfv
    )
    if turning:
        gap, slope, curvature = _of_turning(then.laws, side, gap, slope, curvature)
    return gap, slope, curvature, x_t, v_t, a_t, f_t, dv2, dfv


@compiled
def _dip(plant, mode, x, v, v_belt, a_belt, u, h, side, level, rate, slope, slope_end, turning):
    """Look for a time in (0, h) at which a gap that falls at 0 and rises at h is below zero: Newton on its slope.

    Return whether there is one, and the time.
    """
    low = 0.0
    high = h
    t = h * slope / (slope - slope_end)
    for _ in range(60):
        gap, slope, curvature, _, _, _, _, _, _ = _gap_at(
            plant, mode, x, v, v_belt, a_belt, u, t, side, level, rate, turning
        )
        if gap < -V_REL_ZERO:
            return True, t
        if slope < 0.0:
            low = t
        else:
            high = t
        dt = -slope / curvature if curvature > 0.0 else h
        # As far from the bottom as this, a parabola tells how deep it is, with as much again to spare.
        if abs(dt) < 0.125 * h and gap > abs(slope * dt) + V_REL_ZERO:
            return False, t
        if abs(dt) < 1e-9 * h or high - low < TIME_ZERO:
            break
        t = t + dt
        if not low < t < high:
            t = 0.5 * (low + high)
    return False, t


@compiled
def _closing_guess(gap, slope, gap_end, slope_end, h):
    """Return where the cubic with these values and slopes at 0 and h falls through zero, to a few digits."""
    m0 = slope * h
    m1 = slope_end * h
    c2 = 3.0 * (gap_end - gap) - 2.0 * m0 - m1
    c3 = m0 + m1 - 2.0 * (gap_end - gap)
    low = 0.0
    high = 1.0
    s = gap / (gap - gap_end) if gap > V_REL_ZERO and gap_end < gap else 0.5
    for _ in range(20):
        value = gap + s * (m0 + s * (c2 + s * c3))
        if value > 0.0:
            low = s
        else:
            high = s
        rate = m0 + s * (2.0 * c2 + 3.0 * s * c3)
        following = s - value / rate if rate < 0.0 else 0.5 * (low + high)
        if not low < following < high:
            following = 0.5 * (low + high)
        change = abs(following - s)
        s = following
        if change < 1e-4:  # Newton: the error is then of the order of its square
            break
    return h * s


@in_lanes
def _last_stretch(gap, slope, curvature, h):
    """Return whether a gap's zero is so near that a Taylor step there is exact to rounding, and the time to it."""
    falling = slope < 0.0
    first = -gap / (slope if falling else -1.0)
    bend = first * curvature / (slope if falling else -1.0)
    # What is left out is of the order of the bend's square and of the third power of the time.
    near = falling & (abs(first) <= LAST_STRETCH * h) & (bend * bend * abs(first) <= 0.1 * TIME_ZERO)
    return near, first - 0.5 * bend * first if near else first


@in_lanes
def _stretch(plant, side, x, v, a, contact, curvature, dt, int_v2, int_fv):
    """Return x, the integral of v^2 and that of the contact force's power after a Taylor step of length dt in slip."""
    w = room_v(plant, v)
    b = _room_a(plant.laws, a)
    contact_slope = side * curvature + 2.0 * plant.beta * b + spring_slopes(plant, room_x(plant, x))[0] * w
    contact_slope = _without_aging(plant, plant.laws, x, contact_slope)
    int_v2 = int_v2 + dt * (w * (w + b * dt))
    int_fv = int_fv + dt * (contact * w + 0.5 * dt * (contact * b + contact_slope * w))
    return x + dt * (v + 0.5 * a * dt), int_v2, int_fv


@compiled
def _closing(plant, mode, x, v, v_belt, a_belt, u, h, t, side, level, rate, turning, looked, look):
    """Find where in (0, h] the gap of :func:`_gap_at` falls through zero: Newton in a bracket, from a guess t.

    If ``looked`` is true, ``look`` is what :func:`_gap_at` gives there.

    Return that time, x, the acceleration, and the integrals of v^2 and of the contact force's power up to it. The last
    tiny part of the way is a Taylor step.
    """
    low = 0.0
    high = h
    for _ in range(80):
        if not looked:
            look = _gap_at(plant, mode, x, v, v_belt, a_belt, u, t, side, level, rate, turning)
        looked = False
        gap, slope, curvature, x_t, v_t, a_t, f_t, dv2, dfv = look
        if gap > 0.0:
            low = t
        else:
            high = t
        near, following = _last_stretch(gap, slope, curvature, h)
        dt = 0.5 * (low + high) - t
        if slope < 0.0 and low < t + following < high:
            dt = following
        elif near:
            dt = min(max(t + following, low), high) - t
        if near or high - low < TIME_ZERO:
            break
        t = t + dt
    now = later(plant, t)
    if turning:
        curvature = _of_turning(now.laws, -side, 0.0, 0.0, curvature)[2]
    x_t, dv2, dfv = _stretch(now, side, x_t, v_t, a_t, f_t, curvature, dt, dv2, dfv)
    return t + dt, x_t, a_t, dv2, dfv


@compiled
def _contact_loss_time(plant, mode, x, v, v_belt, a_belt, u, high):
    """Return the time in (0, high] at which the normal force falls to zero."""
    low = 0.0
    for _ in range(60):
        if high - low < TIME_ZERO:
            break
        t = 0.5 * (low + high)
        x_t, _, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
        then = later(plant, t)
        if spring(then, room_x(then, x_t))[1] > 0.0:
            low = t
        else:
            high = t
    return high


@compiled
def _normal_rate(plant, laws, x, v):
    """Return the rate of change of the normal force."""
    place = room_x(plant, x)
    return spring_slopes(plant, place)[1] * room_v(plant, v) + _aging(plant, laws, place)[2]


@compiled
def _thin_contact(plant, laws, mode, x, v, v_belt, a_belt, u, x_end, v_end, h):
    """Whether a modulated stiffness lets the normal force dip to zero within a step at whose ends it is above, and the
    time by which contact is lost if so, else h."""
    if laws is None:
        return False, h
    if laws.depth == 0.0:
        return False, h
    if not (
        _normal_rate(plant, laws, x, v) < 0.0
        and _normal_rate(later(plant, h), later(plant, h).laws, x_end, v_end) > 0.0
    ):
        return False, h
    low = 0.0
    high = h
    for _ in range(50):
        middle = 0.5 * (low + high)
        x_t, v_t, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * middle, u, middle)
        then = later(plant, middle)
        if spring(then, room_x(then, x_t))[1] <= 0.0:
            return True, middle
        if _normal_rate(then, then.laws, x_t, v_t) < 0.0:
            low = middle
        else:
            high = middle
    return False, h


@compiled
def _switching(plant, laws, mode, x, v, v_belt, a_belt, u, x_end, v_end, h):
    """Look for the first time in a step of length h at which x falls through zero, where the field is frozen to one
    side of it: whether there is one, the time, v, and the integrals of v^2 and of the contact force's power."""
    if laws is None:
        return False, h, v_end, 0.0, 0.0
    side = laws.side
    if plant.geometry != DISCONTINUOUS:
        return False, h, v_end, 0.0, 0.0
    end = later(plant, h)
    gap = side * room_x(plant, x)
    gap_end = side * room_x(end, x_end)
    rises = side * room_v(plant, v) > 0.0
    turned = side * room_v(end, v_end) > 0.0
    leaves = gap_end < -SIDE_ZERO or (gap > SIDE_ZERO and gap_end <= (0.0 if turned else SIDE_ZERO))
    low = 0.0
    high = h
    if (rises and not turned and leaves and gap <= SIDE_ZERO) or (not rises and turned and not leaves):
        # From zero up and back, or down and up again: it turns in between, at the gap's extreme.
        first = 0.0
        last = h
        for _ in range(60):
            middle = 0.5 * (first + last)
            _, v_t, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * middle, u, middle)
            if (side * room_v(later(plant, middle), v_t) > 0.0) == rises:
                first = middle
            else:
                last = middle
        if rises:
            low = last
        else:
            high = last
            x_t, _, _, _, _, _, _ = slip_step(plant, mode, x, v, v_belt, a_belt * high, u, high)
            leaves = side * room_x(later(plant, high), x_t) < -SIDE_ZERO
    if not leaves:
        return False, h, v_end, 0.0, 0.0
    t = 0.5 * (low + high)
    v_t = v_end
    dv2 = 0.0
    dfv = 0.0
    for _ in range(100):
        x_t, v_t, _, _, _, dv2, dfv = slip_step(plant, mode, x, v, v_belt, a_belt * t, u, t)
        then = later(plant, t)
        gap = side * room_x(then, x_t)
        slope = side * room_v(then, v_t)
        if gap > 0.0:
            low = t
        else:
            high = t
        if abs(gap) <= 0.1 * SIDE_ZERO or high - low < 0.01 * TIME_ZERO:
            break
        following = t - gap / slope if slope < 0.0 else 0.5 * (low + high)
        if not low < following < high:
            following = 0.5 * (low + high)
        t = following
    return True, t, v_t, dv2, dfv


@compiled
def _faced_in_slip(plant, laws, mode, x, v, v_belt, u):
    """Return the plant frozen to its side of x = 0; a mass at rest on it goes where the other forces push."""
    if laws is None:
        return plant
    plant = faced(plant, x, v)
    if plant.geometry == DISCONTINUOUS and plant.laws.side == 0.0:
        a, _ = slip_forces(plant, mode, x, v, v_belt, u)
        plant = _with_laws(plant, plant.laws, 1.0 if a >= 0.0 else -1.0, plant.laws.time)
    return plant


@compiled
def _rounding(plant, laws, mode, x, v, v_belt):
    """Return an error per unit of time below which rounding hides the estimate: of large forces in balance."""
    if laws is None:
        return 0.0
    calm_plant = laws.force == 0.0 and laws.ripple == 0.0 and laws.depth == 0.0
    if calm_plant and laws.friction == STRIBECK and plant.geometry <= LINEAR:
        return 0.0  # as without laws
    place = room_x(plant, x)
    restoring, normal = spring(plant, place)
    forces = abs(restoring) + abs(friction_coefficient(plant, mode, v - v_belt) * normal)
    places = (abs(x) + abs(place)) * abs(spring_slopes(plant, place)[0])
    drives = laws.force * (laws.force_rate * laws.time + abs(laws.force_phase))
    shake = laws.ripple * laws.ripple_rate
    drives += shake * (laws.ripple_rate * laws.time + abs(laws.ripple_phase))
    return ROUNDING * (forces + 0.1 * (places + drives))


@compiled
def _leaps_over_layer(plant, laws, gap, gap_end, slope, slope_end, h):
    """Whether a slip step is so long that its stages may miss how sharply friction falls next to the belt's speed.

    Both laws with such a layer change over a gap of its width, and further out over one as wide as the gap.
    """
    if laws is None:
        return False
    if laws.friction == HYPERBOLIC:
        width = 1.0 / max(laws.decay, 1e-300)
    elif laws.friction == EXPONENTIAL:
        width = laws.decay
    else:
        return False
    reach = h * max(abs(slope), abs(slope_end))
    nearest = min(gap, gap_end)
    if slope < 0.0 < slope_end:
        nearest = nearest - 0.25 * reach
    return reach > LAYER_REACH * (max(nearest, 0.0) + width)


@compiled
def _at_zero(laws, x):
    """Return x = 0, in the ripple's frame."""
    if laws is None:
        return x
    return -_ripple(laws)[0] if laws.ripple != 0.0 else 0.0


@compiled
def slip_until_event(plant, mode, x, v, v_belt, a_belt, u, duration, stop_at_turning, trials, known):
    """Slip for ``duration``, or until v_rel returns to zero (LANDING), contact is lost (CONTACT_LOSS), v changes
    sign (TURNING, if asked for), x does where that switches the field (SWITCHING) or the error rule cannot be met
    in the trial steps that are left: ``trials``, and SLIP_TRIAL_RATE more per unit of time (STEP_SIZE_UNDERFLOW).

    ``known`` are 18 numbers: whether the first step was tried already (0: no, 1: over ``duration``, 2: and the time at
    which it lands, or else turns, was guessed and looked at), what :func:`slip_step` gave, the time, and what
    :func:`_gap_at` gave there.
    Return the time spent, x, v, the event, the integrals of v^2 and of the contact force's power, the least and
    greatest x met, and the trial steps left. After LANDING v equals the belt speed exactly, after TURNING it is exactly
    zero.
    """
    plant = _faced_in_slip(plant, plant.laws, mode, x, v, v_belt, u)
    longest = _short_of_excitation(plant.laws, 1.0, MAX_SLIP_STEP)
    t = 0.0
    h = min(duration, longest)
    x_min = room_x(plant, x)
    x_max = x_min
    int_v2 = 0.0
    int_fv = 0.0
    event = NO_EVENT
    first = True
    while t < duration:
        remaining = duration - t
        h = min(h, remaining)
        belt = v_belt + a_belt * t
        now = later(plant, t)
        trials -= 1.0
        looked = first and known[0] == 2.0
        if first and known[0] > 0.0:
            trial = known[1:8]
        else:
            trial = slip_step(now, mode, x, v, belt, a_belt * h, u, h)
        first = False
        x_end, v_end, a, a_end, error, dv2, dfv = trial
        allowed = TOLERANCE * h * max(1.0, abs(x), abs(v), STIFF * abs(a))
        noise = h * _rounding(now, now.laws, mode, x, v, belt)
        if not error <= max(allowed, noise) or _leaps_over_layer(
            now,
            now.laws,
            mode * (v - belt),
            mode * (v_end - belt - a_belt * h),
            mode * (a - a_belt),
            mode * (a_end - a_belt),
            h,
        ):  # "not" lets a NaN shrink the step too
            h = 0.5 * h
            if h < MIN_SLIP_STEP or trials + SLIP_TRIAL_RATE * t < 0.0:
                event = STEP_SIZE_UNDERFLOW
                break
            continue
        length = h

        gap = mode * (v - belt)
        gap_end = mode * (v_end - (belt + a_belt * h))
        slope = mode * (a - a_belt)
        slope_end = mode * (a_end - a_belt)
        if gap > V_REL_ZERO:
            lands = gap_end <= 0.0
        else:  # it has just left the stick surface
            lands = gap_end < -V_REL_ZERO
        guess = known[8]
        zero = _v_rel_zero(now.laws, belt)
        away = gap > zero or slope_end < 0.0 <= slope
        if not lands and away and gap_end <= zero:
            v_end = belt + a_belt * h  # it lands with the step's end, but for rounding
            event = LANDING
        elif lands:
            if not looked:
                guess = _closing_guess(gap, slope, gap_end, slope_end, h)
        elif _dips(gap, slope, gap_end, slope_end, h):
            lands, length = _dip(now, mode, x, v, belt, a_belt, u, h, mode, belt, a_belt, slope, slope_end, False)
            guess = 0.5 * length
            length = length if lands else h
        if lands:
            length, x_end, a_end, dv2, dfv = _closing(
                now, mode, x, v, belt, a_belt, u, length, guess, mode, belt, a_belt, False, looked, known[9:]
            )
            v_end = belt + a_belt * length
            event = LANDING

        switches, t_switch, v_switch, dv2_switch, dfv_switch = _switching(
            now, now.laws, mode, x, v, belt, a_belt, u, x_end, v_end, length
        )
        if switches:
            length, v_end, dv2, dfv = t_switch, v_switch, dv2_switch, dfv_switch
            x_end = _at_zero(later(now, length).laws, x_end)
            a_end, _ = slip_forces(later(now, length), mode, x_end, v_end, belt + a_belt * length, u)
            event = SWITCHING

        turns = False
        bracket = length
        end = later(now, length)
        w = room_v(now, v)
        w_end = room_v(end, v_end)
        b = _room_a(now.laws, a)
        b_end = _room_a(end.laws, a_end)
        side = 1 if w > 0.0 else -1
        if w * w_end < 0.0:
            turns = True
            if lands or not looked:
                guess = _closing_guess(side * w, side * b, side * w_end, side * b_end, length)
        elif w != 0.0 and _dips(side * w, side * b, side * w_end, side * b_end, length):
            turns, bracket = _dip(
                now, mode, x, v, belt, a_belt, u, length, side, 0.0, 0.0, side * b, side * b_end, True
            )
            guess = 0.5 * bracket
        if turns:
            t_turn, x_turn, _, dv2_turn, dfv_turn = _closing(
                now, mode, x, v, belt, a_belt, u, bracket, guess, side, 0.0, 0.0, True, looked and not lands, known[9:]
            )
            then = later(now, t_turn)
            place = room_x(then, x_turn)
            x_min = min(x_min, place)
            x_max = max(x_max, place)
            if stop_at_turning or spring(then, place)[1] <= 0.0:
                length, x_end, v_end, dv2, dfv = t_turn, x_turn, _frame_v(then.laws, 0.0), dv2_turn, dfv_turn
                event = TURNING

        # N falls with |x|: it is least at a turning point or at the end of the step, unless the stiffness is modulated.
        end = later(now, length)
        thin, t_thin = _thin_contact(now, now.laws, mode, x, v, belt, a_belt, u, x_end, v_end, length)
        if thin or spring(end, room_x(end, x_end))[1] <= 0.0:
            length = _contact_loss_time(now, mode, x, v, belt, a_belt, u, t_thin)
            x_end, v_end, a, a_end, error, dv2, dfv = slip_step(now, mode, x, v, belt, a_belt * length, u, length)
            event = CONTACT_LOSS
            if (gap > V_REL_ZERO or slope > 0.0) and mode * (v_end - (belt + a_belt * length)) < 0.0:  # it lands before
                length, x_end, a_end, dv2, dfv = _closing(
                    now, mode, x, v, belt, a_belt, u, length, 0.5 * length, mode, belt, a_belt, False, False, known[9:]
                )
                v_end = belt + a_belt * length
                event = LANDING

        t = duration if event == NO_EVENT and h == remaining else t + length
        x = x_end
        v = v_end
        place = room_x(later(plant, t), x)
        x_min = min(x_min, place)
        x_max = max(x_max, place)
        int_v2 += dv2
        int_fv += dfv
        if event != NO_EVENT:
            break
        if trials + SLIP_TRIAL_RATE * t < 0.0:
            event = STEP_SIZE_UNDERFLOW
            break
        if error < max(STEP_DOUBLING * allowed, noise):
            h = min(2.0 * h, longest)
    if event == NO_EVENT:
        belt = v_belt + a_belt * duration
        if mode * (v - belt) <= V_REL_ZERO:
            v = belt
    return t, x, v, event, int_v2, int_fv, x_min, x_max, trials + SLIP_TRIAL_RATE * t


@compiled
def slip_across(plant, mode, x, v, v_belt, a_belt, u, duration, stop_at_turning):
    """:func:`slip_until_event` that goes on where only the field switches."""
    t = 0.0
    int_v2 = 0.0
    int_fv = 0.0
    x_min = room_x(plant, x)
    x_max = x_min
    event = SWITCHING
    trials = SLIP_TRIALS
    for _ in range(MAX_EVENTS):
        now = later(plant, t)
        dt, x, v, event, dv2, dfv, low, high, trials = slip_until_event(
            now, mode, x, v, v_belt + a_belt * t, a_belt, u, duration - t, stop_at_turning, trials, NOTHING_KNOWN
        )
        t += dt
        int_v2 += dv2
        int_fv += dfv
        x_min = min(x_min, low)
        x_max = max(x_max, high)
        if event != SWITCHING:
            break
    return t, x, v, event, int_v2, int_fv, x_min, x_max


# Stick --------------------------------------------------------------------------------------------------------------


@in_lanes
def _cone_excess(plant, side, x, v_belt, a_belt, u, t):
    """Return by how much a mass stuck since t = 0 at x exceeds one side of the stick cone at time t, and the slope."""
    speed = v_belt + a_belt * t
    x_t = x + (v_belt + 0.5 * a_belt * t) * t
    then = later(plant, t)
    load, limit = stick_load(then, x_t, speed, a_belt, u)
    place = room_x(then, x_t)
    restoring_slope, normal_slope = spring_slopes(then, place)
    w = room_v(then, speed)
    load_slope = 2.0 * plant.beta * _room_a(then.laws, a_belt) + restoring_slope * w
    slope = side * load_slope - plant.mu_s * normal_slope * w
    return side * load - limit, _aging_excess(then, then.laws, side, place, slope)


@compiled
def _aging_excess(plant, laws, side, x, slope):
    if laws is None:
        return slope
    drive, restoring, normal = _aging(plant, laws, x)
    return slope + side * (restoring - drive) - plant.mu_s * normal


@compiled
def _breakaway_time(plant, side, x, v_belt, a_belt, u, low, high):
    """Return a time in (low, high], just outside the cone, at which one side of it is left: Newton in a bracket."""
    t = high
    nudge = 1e-16 * max(1.0, high)
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle <= low or middle >= high:
            break
        excess, slope = _cone_excess(plant, side, x, v_belt, a_belt, u, t)
        if excess > 0.0:
            high = t
        else:
            low = t
        following = t - excess / slope if slope > 0.0 else middle
        if abs(following - t) < TIME_ZERO:
            # There, but for rounding: step over the place until it is hemmed in.
            nudge = 2.0 * nudge
            if high - low <= 2.0 * nudge:
                break
            following = following + nudge if excess <= 0.0 else following - nudge
        if not low < following < high:
            following = 0.5 * (low + high)
        t = following
    return high


@compiled
def stick_until_event(plant, x, v_belt, a_belt, u, duration):
    """Ride with the belt for ``duration``, until breakaway, or until x is where that switches the field (SWITCHING);
    return the time spent and the event.

    The cone is walked in pieces no longer than an eighth of the spring's length scale and of a radian of excitation,
    each side of it on its own; a side that rises and falls again within a piece is followed to its top. The time
    returned lies just outside the cone.
    """
    scale = _length_scale(plant)
    fastest = max(abs(v_belt), abs(v_belt + a_belt * duration))
    plant = faced(plant, x, v_belt)
    piece = duration
    if fastest > 0.0:
        piece = min(duration, 0.125 * scale / fastest)
    piece = _short_of_excitation(plant.laws, 0.125, piece)
    t = 0.0
    while t < duration:
        t_end = t + piece
        if t_end >= duration or t_end <= t:
            t_end = duration
        switches, t_end = _switches_in_stick(plant, plant.laws, x, v_belt, a_belt, t, t_end)
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
                high = _breakaway_time(plant, side, x, v_belt, a_belt, u, t, high)
                first = min(first, high)
                found = True
        if found:
            return first, BREAKAWAY
        if switches:
            return t_end, SWITCHING
        t = t_end
    return duration, NO_EVENT


@compiled
def _short_of_excitation(laws, angle, piece):
    """Return a length of time, or less: that in which the fastest excitation goes through this angle."""
    if laws is None:
        return piece
    fastest = 0.0
    if laws.force != 0.0:
        fastest = max(fastest, laws.force_rate)
    if laws.ripple != 0.0:
        fastest = max(fastest, laws.ripple_rate)
    if laws.depth != 0.0:
        fastest = max(fastest, laws.depth_rate)
    return min(piece, angle / fastest) if fastest > 0.0 else piece


@compiled
def _length_scale(plant):
    """Return the distance over which the spring's force bends."""
    return min(1.0, plant.alpha) if plant.geometry == EXACT or plant.geometry == CUBIC else 1.0


@compiled
def _switches_in_stick(plant, laws, x, v_belt, a_belt, t, t_end):
    """Whether a stuck mass passes x = 0 in (t, t_end] where that switches the field, and the time if so, else t_end."""
    if laws is None:
        return False, t_end
    if plant.geometry != DISCONTINUOUS:
        return False, t_end
    side = laws.side
    low = t
    high = t_end
    falls = side * room_v(later(plant, low), v_belt + a_belt * low) < 0.0
    rises = side * room_v(later(plant, high), v_belt + a_belt * high) > 0.0
    if falls and rises:  # the belt turns in between: as deep as there it comes nowhere
        first = low
        for _ in range(60):
            middle = 0.5 * (first + high)
            if side * room_v(later(plant, middle), v_belt + a_belt * middle) < 0.0:
                first = middle
            else:
                high = middle
    end = later(plant, high)
    leaving = side * room_v(end, v_belt + a_belt * high) < 0.0
    if side * room_x(end, x + (v_belt + 0.5 * a_belt * high) * high) > (SIDE_ZERO if leaving else -SIDE_ZERO):
        return False, t_end
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle <= low or middle >= high:
            break
        if side * room_x(later(plant, middle), x + (v_belt + 0.5 * a_belt * middle) * middle) > 0.0:
            low = middle
        else:
            high = middle
    return True, high


@compiled
def ride_across(plant, x, v_belt, duration):
    """:func:`stick_until_event` with a steady belt and no force, which goes on where only the field switches and stick
    holds. Return the time spent and the event."""
    t, event = stick_until_event(plant, x, v_belt, 0.0, 0.0, duration)
    if event == SWITCHING:
        if mode_at_zero_v_rel(plant, 0.0, v_belt, 0.0, 0.0) != STICK:
            return t, BREAKAWAY
        dt, event = stick_until_event(plant, 0.0, v_belt, 0.0, 0.0, duration - t)
        t += dt
    return t, event


@in_lanes
def _ride(plant, x, v_belt, a_belt, u, t):
    """Return how far a stuck mass rides in a time t, and the integrals of v^2 and of the contact force's power.

    That force is a_belt + 2 beta v_belt + R - u: its power integrates in closed form.
    """
    dx = (v_belt + 0.5 * a_belt * t) * t
    int_v2 = (v_belt * v_belt + a_belt * t * (v_belt + a_belt * t / 3.0)) * t
    work = (a_belt - u) * dx + 2.0 * plant.beta * int_v2 + potential(plant, x + dx) - potential(plant, x)
    return dx, int_v2, work


@compiled
def _stick_leg(plant, x, v_belt, a_belt, u, duration):
    """Ride with the belt for ``duration``, or until breakaway.

    Return the time spent, the event, x, the integrals of v^2 and of the contact force's power, and the least and
    greatest x met.
    """
    dt, event = stick_until_event(plant, x, v_belt, a_belt, u, duration)
    dx, int_v2, int_fv = _ride(plant, x, v_belt, a_belt, u, dt)
    x_end = x + dx
    if event == SWITCHING:
        x_end = _at_zero(later(plant, dt).laws, x_end)
    x_min = min(x, x_end)
    x_max = max(x, x_end)
    if v_belt * (v_belt + a_belt * dt) < 0.0:  # the belt reverses
        x_turn = x - 0.5 * v_belt * v_belt / a_belt
        x_min = min(x_min, x_turn)
        x_max = max(x_max, x_turn)
    int_v2, int_fv, x_min, x_max = _excited_ride(
        plant, plant.laws, x, v_belt, a_belt, u, dt, int_v2, int_fv, x_min, x_max
    )
    return dt, event, x_end, int_v2, int_fv, x_min, x_max


# Gauss and Legendre's five nodes and weights on [0, 1]
_NODES = (0.04691007703066802, 0.23076534494715845, 0.5, 0.7692346550528415, 0.9530899229693319)
_WEIGHTS = (0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454)


@compiled
def _excited_ride(plant, laws, x, v_belt, a_belt, u, duration, int_v2, int_fv, x_min, x_max):
    """Return what :func:`_stick_leg` does of a ride under excitation: the integrals by quadrature, the extremes of x
    where v changes sign between two nodes or at an end."""
    if laws is None:
        return int_v2, int_fv, x_min, x_max
    if laws.force == 0.0 and laws.ripple == 0.0 and laws.depth == 0.0:
        return int_v2, int_fv, x_min, x_max
    piece = _short_of_excitation(laws, 0.125, 0.5)
    fastest = max(abs(v_belt), abs(v_belt + a_belt * duration)) + laws.ripple
    if fastest > 0.0:
        piece = min(piece, 0.125 * _length_scale(plant) / fastest)
    pieces = int(duration / piece) + 1
    length = duration / pieces
    int_v2 = 0.0
    int_fv = 0.0
    x_min = room_x(plant, x)
    x_max = x_min
    then = later(plant, duration)
    place = room_x(then, x + (v_belt + 0.5 * a_belt * duration) * duration)
    x_min = min(x_min, place)
    x_max = max(x_max, place)
    faced_plant = faced(plant, x, v_belt)
    before = 0.0
    w_before = room_v(plant, v_belt)
    for piece in range(pieces):
        for j in range(6):  # the sixth is the piece's end
            t = (piece + _NODES[j]) * length if j < 5 else (piece + 1) * length
            then = later(faced_plant, t)
            speed = v_belt + a_belt * t
            w = room_v(then, speed)
            if j < 5:
                load, _ = stick_load(then, x + (v_belt + 0.5 * a_belt * t) * t, speed, a_belt, u)
                int_v2 += _WEIGHTS[j] * length * (w * w)
                int_fv += _WEIGHTS[j] * length * (load * w)
            if w * w_before < 0.0:
                low = before
                high = t
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if room_v(later(plant, middle), v_belt + a_belt * middle) * w_before > 0.0:
                        low = middle
                    else:
                        high = middle
                place = room_x(later(plant, high), x + (v_belt + 0.5 * a_belt * high) * high)
                x_min = min(x_min, place)
                x_max = max(x_max, place)
            before = t
            w_before = w
    return int_v2, int_fv, x_min, x_max


@compiled
def _breakaway_mode(plant, x, v_belt, a_belt, u):
    """Return the mode in which a mass leaves stick: slip the way the load pulls."""
    load, _ = stick_load(plant, x, v_belt, a_belt, u)
    return SLIP_BACKWARD if load > 0.0 else SLIP_FORWARD


# The automaton ------------------------------------------------------------------------------------------------------


@compiled
def advance(plant, x, v, v_belt, a_belt, u, duration, events):
    """Advance a state by ``duration`` under a held force u and a uniformly accelerating belt, events included.

    ``events`` is None, or an array of shape (n, 4) that takes time, kind, x and v of as many events as it has rows.
    Return x, v, v_belt, mode, status, the time reached (less than ``duration`` only if status is not OK), the number
    of events, the integral of v^2, the time stuck, the integral of the contact force's power, and the least and
    greatest x met.
    """
    return _advance(plant, UNKNOWN, x, v, v_belt, a_belt, u, duration, events, NOTHING_KNOWN)


@compiled
def _advance(plant, mode, x, v, v_belt, a_belt, u, duration, events, known):
    """:func:`advance` of a motion in this mode (UNKNOWN: that of the state), where ``known`` (see
    :func:`slip_until_event`) is of the slip it begins with, if it does."""
    t = 0.0
    n_events = 0
    int_v2 = 0.0
    int_fv = 0.0
    stick_time = 0.0
    x_min = x
    x_max = x
    belt = v_belt
    status = OK
    trials = SLIP_TRIALS
    x_room = x
    v_room = v
    x, v = _into_frame(plant.laws, x, v, v_belt)
    if mode == UNKNOWN:
        mode = _mode_of(plant, x, v, v_belt, a_belt, u)
    elif mode == STICK:
        v = v_belt
    if spring(plant, x_room)[1] <= 0.0:
        return x_room, v_room, v_belt, mode, CONTACT_LOST, 0.0, 0, 0.0, 0.0, 0.0, x_room, x_room
    plant = _from_now(plant, plant.laws)
    while t < duration:
        remaining = duration - t
        now = later(plant, t)
        if mode == STICK:
            dt, event, x, dv2, dfv, low, high = _stick_leg(now, x, belt, a_belt, u, remaining)
            stick_time += dt
        else:
            dt, x, v, event, dv2, dfv, low, high, trials = slip_until_event(
                now, mode, x, v, belt, a_belt, u, remaining, False, trials, known
            )
            known = NOTHING_KNOWN
        int_v2 += dv2
        int_fv += dfv
        x_min = min(x_min, low)
        x_max = max(x_max, high)
        t = duration if event == NO_EVENT or dt >= remaining else t + dt
        belt = v_belt + a_belt * t
        then = later(plant, t)
        kind = event
        if mode == STICK:
            v = belt
            if event == BREAKAWAY:
                mode = _breakaway_mode(then, x, belt, a_belt, u)
            elif event == SWITCHING:
                mode = mode_at_zero_v_rel(then, x, belt, a_belt, u)
        elif event == LANDING:
            v = belt
            landed = mode_at_zero_v_rel(then, x, belt, a_belt, u)
            kind = RESTICK if landed == STICK else (GRAZING if landed == mode else CROSSING)
            mode = landed
        elif event == NO_EVENT and v == belt:
            mode = mode_at_zero_v_rel(then, x, belt, a_belt, u)
        if event != NO_EVENT:
            if events is not None:
                if n_events < len(events):
                    events[n_events, 0] = t
                    events[n_events, 1] = kind
                    events[n_events, 2] = room_x(then, x)
                    events[n_events, 3] = room_v(then, v)
            n_events += 1
            if event == CONTACT_LOSS:
                status = CONTACT_LOST
                break
            if event == STEP_SIZE_UNDERFLOW:
                status = STEP_LIMIT
                break
            if n_events >= MAX_EVENTS:
                status = EVENT_LIMIT
                break
    end = later(plant, t)
    x = room_x(end, x)
    v = room_v(end, v)
    # A ripple's phase is rounded otherwise there.
    return x, v, belt, mode, status, t, n_events, int_v2, stick_time, int_fv, min(x_min, x), max(x_max, x)


@compiled
def trace(plant, mode, x, v, v_belt, a_belt, u, times, samples, events):
    """Follow one held interval and keep samples: x, v, v_belt and mode at each of ``times`` (n,), counted from 0.

    ``mode``: the mode so far, under the same drive; UNKNOWN where the drive has jumped.
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
        now = later(plant, t)
        x, v, belt, mode, status, dt, n, dv2, dstick, dfv, _, _ = _advance(
            now, mode, x, v, v_belt + a_belt * t, a_belt, u, times[taken] - t, events[n_events:], NOTHING_KNOWN
        )
        for i in range(n_events, n_events + n):
            events[i, 0] += t
        n_events += n
        int_v2 += dv2
        stick_time += dstick
        int_fv += dfv
        with_belt = v == room_v(later(_from_now(now, now.laws), dt), belt)
        t = times[taken] if status == OK else t + dt
        belt = v_belt + a_belt * t  # by one formula, however the motion is cut into pieces
        if with_belt:
            v = room_v(later(plant, t), belt)
        samples[taken, 0] = x
        samples[taken, 1] = v
        samples[taken, 2] = belt
        samples[taken, 3] = mode
        taken += 1
    return taken, n_events, status, t, int_v2, stick_time, int_fv


@compiled
def energy_in_spring(plant, x):
    """Return V(x) at the plant's time: that of a modulated spring is as many times as great as its force."""
    return _modulated_pair(plant.laws, potential(plant, x), 0.0)[0]


@compiled
def _has_power(laws):
    """Whether a force or a modulated stiffness is there to do work; the ripple's is the contact's."""
    if laws is None:
        return False
    return laws.force != 0.0 or laws.depth != 0.0


WORK_TOLERANCE = 1e-8  # of the excitation's work over a piece, relative to its greatest power there
SHORTEST_PIECE = 1.0 / 4096.0  # of the motion over which that work is found, relative to the longest


@compiled
def _excitation_power(plant, laws, x, w):
    if laws is None:
        return 0.0
    return _excitation(laws)[0] * w + _stiffness(laws)[1] * potential(plant, x)


@compiled
def _work_over(plant, x, v, v_belt, a_belt, u, length):
    """Return the work of the excitation over a piece of the motion by Gauss's formula, and the greatest power met.

    Each node is reached from the beginning, so that no error adds up.
    """
    work = 0.0
    greatest = 0.0
    for j in range(5):
        out = advance(plant, x, v, v_belt, a_belt, u, _NODES[j] * length, None)
        then = later(plant, _NODES[j] * length)
        power = _excitation_power(then, then.laws, out[0], out[1])
        work += _WEIGHTS[j] * length * power
        greatest = max(greatest, abs(power))
    return work, greatest


@compiled
def excitation_work(plant, x, v, v_belt, a_belt, u, duration, events):
    """Return the work of the excitation over a motion that :func:`trace` has followed for ``duration``: of the exciting
    force, and of what modulates the stiffness.

    ``events`` (m, 4) are its events. Between them a piece is halved until its halves give the same work as the whole.
    """
    work = 0.0
    t = 0.0 if _has_power(plant.laws) else duration
    belt = v_belt
    longest = _short_of_excitation(plant.laws, 0.5, 0.05)
    for n in range(len(events) + 1):
        end = events[n, 0] if n < len(events) else duration
        piece = longest
        first = -1.0
        power = -1.0
        while t < end:
            last = end - t <= piece
            length = end - t if last else piece
            now = later(plant, t)
            whole, greatest = first, power
            if power < 0.0:
                whole, greatest = _work_over(now, x, v, belt, a_belt, u, length)
            first, power = _work_over(now, x, v, belt, a_belt, u, 0.5 * length)
            out = advance(now, x, v, belt, a_belt, u, 0.5 * length, None)
            then = later(now, 0.5 * length)
            second, _ = _work_over(then, out[0], out[1], out[2], a_belt, u, 0.5 * length)
            error = abs(first + second - whole)
            allowed = WORK_TOLERANCE * length * max(greatest, power)
            if error > allowed and length > SHORTEST_PIECE * longest:
                piece = 0.5 * length
                continue
            work += first + second
            power = -1.0
            out = advance(then, out[0], out[1], out[2], a_belt, u, 0.5 * length, None)
            x = out[0]
            v = out[1]
            belt = out[2]  # to the bit, so that a stuck mass stays stuck
            if error < STEP_DOUBLING * allowed:
                piece = min(2.0 * piece, longest)
            t = end if last else t + length
    return work


# Passive orbits: pieces of the analysis that run many times ---------------------------------------------------------

REPEATED_BREAKAWAY, STILL_SLIPPING, AT_REST, ORBIT_LOST_CONTACT, ORBIT_UNDECIDED, AT_EQUILIBRIUM = 0, 1, 2, 3, 4, 5

SAME_PLACE = 1e-9  # breakaway points closer than this are one
STICK_PATIENCE = 1e12  # a belt this slow never brings a stuck mass to breakaway
# Slip that takes longer from one turning point or landing to the next passes a fold, and is not decided.
SLIP_PATIENCE = 2000.0
FIRST_PIECE, CREEP_PIECE = 1e-3, 30.0  # of slip, after which it is seen whether it creeps into a node
STEPS_OF_A_PIECE, MOST_PIECES = 3e4, 400
SETTLING_LAPS, SETTLING_EXITS = 8, 64  # before a passive motion that still slips is looked at more closely
TRAP_POINTS, TRAP_REFINEMENTS = 600, 5  # distances from a node at which its trap is seen to hold, and finer ones

# A row of `traps` says which states certainly tend to a stable equilibrium.
(TRAP_X, TRAP_BALL, TRAP_SLOPE, TRAP_LEFT, TRAP_RIGHT), TRAP_ROW = range(5), 5


@compiled
def _hems_in(plant, v_belt, centre, slope, side, s):
    """Whether, at a distance s to one side of a node, the line v = -slope (x - centre) hems in slip that nears it."""
    x = centre + side * s
    v = -side * slope * s
    if spring(plant, x)[1] <= 0.0 or side * slip_forces(plant, SLIP_BACKWARD, x, 0.0, v_belt, 0.0)[0] >= 0.0:
        return False
    if v >= v_belt:
        return slip_forces(plant, SLIP_BACKWARD, x, v_belt, v_belt, 0.0)[0] <= 0.0
    return slope * slope * s - side * slip_forces(plant, SLIP_BACKWARD, x, v, v_belt, 0.0)[0] <= 0.0


@compiled
def trap_extent(plant, v_belt, centre, slope, side, nearest, farthest):
    """Return how far to one side of a node the line v = -slope (x - centre) hems slip in.

    Below the line a mass that nears the node cannot pass it: there the flow crosses the line towards v = 0, and v = 0
    towards the line. Where the line is above the belt's speed, the mass must not land on the belt either.
    """
    low = 0.0
    high = nearest
    ratio = math.exp(math.log(farthest / nearest) / TRAP_POINTS)
    while high <= farthest and _hems_in(plant, v_belt, centre, slope, side, high):
        low = high
        high = high * ratio
    if low == 0.0 or high > farthest:
        return low
    for _ in range(TRAP_REFINEMENTS):
        step = (high - low) / 32.0
        for _ in range(31):
            if not _hems_in(plant, v_belt, centre, slope, side, low + step):
                break
            low = low + step
        high = low + step
    return low


@compiled
def trap_of(traps, mode, x, v):
    """Return which of the ``traps`` (m, TRAP_ROW) holds a state of slip, or -1."""
    if mode != SLIP_BACKWARD:
        return -1
    for i in range(len(traps)):
        ahead = traps[i, TRAP_X] - x
        ball = traps[i, TRAP_BALL]
        if abs(ahead) < ball and abs(v) < ball:
            return i
        extent = traps[i, TRAP_LEFT] if ahead > 0.0 else traps[i, TRAP_RIGHT]
        if abs(ahead) <= extent and v * ahead >= 0.0 and abs(v) <= traps[i, TRAP_SLOPE] * abs(ahead):
            return i
    return -1


@compiled
def slip_to_section(plant, mode, x, v, v_belt, traps):
    """Slip with a steady belt until v changes sign, v_rel returns to zero, contact is lost or one of the ``traps``
    holds the motion. Return the time spent, x, v, the event (NO_EVENT: held, or not decided), the trap or -1, and the
    integral of v^2."""
    t = 0.0
    int_v2 = 0.0
    longest = SLIP_PATIENCE
    for i in range(len(traps)):
        if traps[i, TRAP_SLOPE] > 0.0:
            longest = CREEP_PIECE
    # What creeps into a node may grow stiff on the way: the first pieces are short.
    patience = longest if longest == SLIP_PATIENCE else FIRST_PIECE
    for _ in range(MOST_PIECES):
        trap = trap_of(traps, mode, x, v)
        if trap >= 0:
            return t, x, v, NO_EVENT, trap, int_v2
        rate = abs(2.0 * plant.beta + spring(plant, x)[1] * friction_slope(plant, mode, v - v_belt))
        piece = min(patience, STEPS_OF_A_PIECE / max(rate, 1.0))
        dt, x, v, event, dv2, _, _, _ = slip_across(plant, mode, x, v, v_belt, 0.0, 0.0, piece, True)
        t += dt
        int_v2 += dv2
        patience = min(2.0 * patience, longest)
        if event != NO_EVENT:
            return t, x, v, event, -1, int_v2
        if t >= SLIP_PATIENCE:
            break
    return t, x, v, NO_EVENT, trap_of(traps, mode, x, v), int_v2


@compiled
def settle(plant, v_belt, x, v, turnings, exits, traps):
    """Follow the passive motion until it breaks away where it did before, slips through ``turnings`` maxima of x, or
    one of the ``traps`` (m, TRAP_ROW) holds it.

    A mass that sticks forgets its past, so a repeated breakaway point closes a stick-slip cycle. ``exits`` is scratch
    space of shape (n,) for the breakaway points met. Return the outcome, x (the breakaway point, the last maximum or
    the place of rest or of the equilibrium), the maximum before the last, and the minimum between.
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
            dt, event = ride_across(plant, x, v_belt, STICK_PATIENCE)
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
            mode = _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
            maxima = 0
            last_max = math.nan
            continue
        _, x, v, event, trap, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
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
        elif trap >= 0:
            return AT_EQUILIBRIUM, traps[trap, TRAP_X], math.nan, math.nan
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
    mode = _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
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
            dt, event = ride_across(plant, x, v_belt, STICK_PATIENCE)
            t += dt
            stick_time += dt
            int_v2 += v_belt * v_belt * dt
            x = x + v_belt * dt
            x_max = max(x_max, x)
            sticks += 1
            if abs(x - x_exit) < SAME_PLACE:
                return REPEATED_BREAKAWAY, t, stick_time, x_min, x_max, x_restick, sticks, forward_arcs, int_v2
            mode = _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
            if mode == SLIP_FORWARD:
                forward_arcs += 1
            v = v_belt
            continue
        dt, x, v, event, dv2, _, low, high = slip_across(plant, mode, x, v, v_belt, 0.0, 0.0, SLIP_PATIENCE, False)
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
def next_maximum(plant, v_belt, x, traps):
    """Return map of slip: from a maximum of x (v = 0) to the next one, without a stick between.

    Return the event that ended it (TURNING if a maximum was reached), the next maximum, the minimum between, the
    time taken, the integral of v^2 and the number of forward arcs. A first arc that rises (x is no maximum), or that
    one of the ``traps`` (m, TRAP_ROW) holds, is not followed: the event is NO_EVENT.
    """
    mode = mode_of(plant, x, 0.0, v_belt, 0.0, 0.0)
    acceleration, _ = slip_forces(plant, mode, x, 0.0, v_belt, 0.0)
    if mode != SLIP_BACKWARD or acceleration >= 0.0 or spring(plant, x)[1] <= 0.0:
        return NO_EVENT, math.nan, math.nan, math.nan, math.nan, 0
    v = 0.0
    t = 0.0
    int_v2 = 0.0
    x_low = math.nan
    forward_arcs = 0
    for _ in range(MAX_EVENTS):
        dt, x, v, event, _, dv2 = slip_to_section(plant, mode, x, v, v_belt, traps)
        t += dt
        int_v2 += dv2
        if event == LANDING:
            mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
            if mode == STICK:
                return event, math.nan, x_low, t, int_v2, forward_arcs
            if mode == SLIP_FORWARD:
                forward_arcs += 1
        elif event == TURNING and slip_forces(plant, mode, x, 0.0, v_belt, 0.0)[0] >= 0.0:
            x_low = x
        else:
            return event, x if event == TURNING else math.nan, x_low, t, int_v2, forward_arcs
    return NO_EVENT, math.nan, x_low, t, int_v2, forward_arcs


@compiled
def slip_returns_to_stick(plant, v_belt, x, traps):
    """Whether a mass that breaks away at x sticks again before it has slipped through one more full lap, or is held by
    one of the ``traps``."""
    v = v_belt
    mode = _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
    maxima = 0
    for _ in range(MAX_EVENTS):
        _, x, v, event, _, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
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
def classify(
    plant, v_belt, xs, vs, exits, exit_labels, traps, trap_labels, centres, bounds, bound_labels, turnings, labels
):
    """Write the label of the attractor that each start (xs, vs) of shape (n,) reaches into ``labels``.

    A start that sticks is carried to the next of the ``exits`` (ascending) and has its label; one that a trap holds
    has the trap's. A start that slips from a maximum of x less than ``bounds[i, j]`` to the right of ``centres[i]``,
    the next to its left, has ``bound_labels[i, j]`` for the first such j (rows end with infinite bounds labelled -2,
    "not decided yet"). -1: lost contact, -2: not decided after so
    many ``turnings`` and landings.
    """
    for n in range(len(xs)):
        x = xs[n]
        v = vs[n]
        label = -2
        mode = mode_of(plant, x, v, v_belt, 0.0, 0.0)
        if spring(plant, x)[1] <= 0.0:
            labels[n] = -1
            continue
        for _ in range(turnings):
            if mode == STICK:
                for i in range(len(exits)):
                    if x <= exits[i] + SAME_PLACE * max(1.0, abs(x)):
                        label = exit_labels[i]
                        break
                break
            _, x, v, event, trap, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
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
                        if bound_labels[nearest, j] != -2:
                            label = bound_labels[nearest, j]
                            break
            else:
                if trap >= 0:
                    label = trap_labels[trap]
                elif event == CONTACT_LOSS:
                    label = -1
                break
        labels[n] = label


# One control interval -----------------------------------------------------------------------------------------------


@in_lanes
def _actuation(actuator, authority, a_limit, belt_speed, interval, v_belt, action):
    """Return the force u and the belt's acceleration that an action in [-1, 1] means."""
    if actuator == FORCE:
        return authority * action, 0.0
    target = (1.0 + authority * action) * belt_speed
    return 0.0, min(max((target - v_belt) / interval, -a_limit), a_limit)


@in_lanes
def _weighed(x, x_end, int_v2, stick_time, int_fv, action, u, belt_speed, interval, w_effort, w_stick):
    """Return the means over an interval of v^2, of the stick indicator, of the contact force's and of the control
    force's power, and the three reward terms (vibration, effort, stick)."""
    mean_v2 = int_v2 / interval
    stick_fraction = stick_time / interval
    return (
        mean_v2,
        stick_fraction,
        int_fv / interval,
        u * (x_end - x) / interval,
        -mean_v2 / (belt_speed * belt_speed),
        -w_effort * (action * action),
        -w_stick * stick_fraction,
    )


@compiled
def control_interval(
    geometry,
    alpha,
    g1,
    beta,
    mu_s,
    k1,
    k3,
    laws,
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

    ``laws``: a :class:`Laws` or None.
    FORCE: u = authority * action. BELT_SPEED: the belt heads for (1 + authority * action) * belt_speed at no more than
    a_limit, evenly over the interval. The reward terms (all <= 0) are averages over the interval.
    Return x, v, v_belt, mode, status, events, u, a_belt, the three reward terms (vibration, effort, stick), the
    means over the interval of v^2, of the stick indicator, of the contact force's and the control force's power, the
    least and greatest x, the normal force at the end, and the time reached (that of the interval, if status is OK).
    """
    plant = Plant(geometry, alpha, g1, beta, mu_s, k1, k3, laws)
    u, a_belt = _actuation(actuator, authority, a_limit, belt_speed, interval, v_belt, action)
    x_end, v, v_belt, mode, status, t, n_events, int_v2, stick_time, int_fv, x_min, x_max = advance(
        plant, x, v, v_belt, a_belt, u, interval, None
    )
    mean_v2, stick_fraction, friction_power, control_power, vibration, effort, stick = _weighed(
        x, x_end, int_v2, stick_time, int_fv, action, u, belt_speed, interval, w_effort, w_stick
    )
    return (
        x_end,
        v,
        v_belt,
        mode,
        status,
        n_events,
        u,
        a_belt,
        vibration,
        effort,
        stick,
        mean_v2,
        stick_fraction,
        friction_power,
        control_power,
        x_min,
        x_max,
        spring(later(plant, t), x_end)[1],
        t,
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
    laws,
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
            laws,
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
def random_uniforms(keys, episodes, step, slot):
    """Return :func:`random_uniform` for arrays of keys and episodes, both (n,)."""
    numbers = np.empty(len(keys))
    for i in range(len(keys)):
        numbers[i] = random_uniform(int(keys[i]), int(episodes[i]), step, slot)
    return numbers


@compiled
def random_normal(key, episode, step, slot):
    """Return a standard normal number by Box and Muller's formula, from slots 2 slot and 2 slot + 1."""
    radius = math.sqrt(-2.0 * math.log(1.0 - random_uniform(key, episode, step, 2 * slot)))
    return radius * math.cos(2.0 * math.pi * random_uniform(key, episode, step, 2 * slot + 1))


# A batch of environments --------------------------------------------------------------------------------------------
#
# Environments are stepped in blocks of LANES. In a block every environment takes one slip step over the whole interval
# in vector instructions, whether it slips or not; those that stick are stepped side by side too, and so are those that
# turn, those that land, and those that leave the stick surface and slip on. What is more involved (two events, a step
# that must be refined) goes the way of control_interval, one by one. A lane is left on a fast path only where
# control_interval would have done the very same arithmetic, so that both give the same bits.
#
# A block works in one flat array whose rows are STRIDE apart. With such constant distances the compiler sees that rows
# do not overlap, which is what lets it use vector instructions.

LANES = 256
STRIDE = LANES + 8  # an odd number of cache lines, or rows would crowd into few places of the cache

# Rows of the work space: what goes in ...
_ALPHA, _G1, _BETA, _MU_S, _K1, _K3, _BELT_SPEED = 0, 1, 2, 3, 4, 5, 6
_X, _V, _BELT, _ACTION, _U, _A_BELT = 7, 8, 9, 10, 11, 12
# ... and what comes out.
_X_END, _V_END, _BELT_END, _MODE, _EVENTS, _STATUS = 13, 14, 15, 16, 17, 18
_INT_V2, _STICK_TIME, _INT_FV, _X_MIN, _X_MAX, _NORMAL = 19, 20, 21, 22, 23, 24
_DONE_FAST = 25  # 1 where the fast path gave the answer
_A, _A_END, _ERROR = 26, 27, 28
_T_END = 45  # time reached, written where the status is not OK
_WORK_ROWS = 46
WORK_SIZE = 2 * _WORK_ROWS * STRIDE  # a block's, and one for those of its environments that must be brought together
# Rows of the second one while the places of events are looked at.
_L_TIME, _L_SIDE, _L_LEVEL, _L_RATE, _L_MODE, _L_LANE = 13, 14, 15, 16, 17, 18
_LOOK = 19  # and the eight after it
_L_LANDS, _L_A = 29, 30
_F_WAY, _F_X_EVENT, _F_X_END, _F_INT_V2, _F_STICK_TIME, _F_INT_FV, _F_X_MIN, _F_X_MAX, _F_NORMAL = range(31, 40)
_F_TIME, _F_V2_THERE, _F_FV_THERE, _F_V_END, _F_EVENTS = range(40, 45)
_OPEN, _FINISHED, _LANDED = 0.0, 1.0, 2.0  # what _F_WAY says

# Rows of the environments' state, floats ...
(
    S_ALPHA,
    S_G1,
    S_BETA,
    S_MU_S,
    S_K1,
    S_K3,
    S_BELT_SPEED,
    S_X,
    S_V,
    S_BELT,
    S_TRAVEL,
    S_WORST,
    S_RETURN,
    S_VIBRATION,
    S_EFFORT,
    S_STICK,
    S_CONTACT_LOSS,
    S_LATE_LOW,
    S_LATE_HIGH,
    S_LATE_STICK,
    S_LATE_TIME,
    S_END_TIME,
    S_FRICTION,
    S_MU_K,
    S_DECAY,
    S_MU_V,
    S_KAPPA,
    S_FORCE,
    S_FORCE_RATE,
    S_FORCE_PHASE,
    S_RIPPLE,
    S_RIPPLE_RATE,
    S_RIPPLE_PHASE,
    S_DEPTH,
    S_DEPTH_RATE,
    S_DEPTH_PHASE,
) = range(36)
STATE_ROWS = 36
# ... and whole numbers.
I_GEOMETRY, I_STEPS, I_KEY, I_EPISODE, I_SEEN, I_OVER, I_FIRST_STEP, I_STATUS = 0, 1, 2, 3, 4, 5, 6, 7
INTEGER_ROWS = 8
RUNNING, TRUNCATED, ENDED = 0, 1, 2  # what I_OVER says

# What a step can report of each environment, floats ...
(
    O_X,
    O_V,
    O_BELT,
    O_NORMAL,
    O_ACTION,
    O_FORCE,
    O_A_BELT,
    O_X_MIN,
    O_X_MAX,
    O_V_REL,
    O_TIME,
    O_MEAN_V2,
    O_STICK_FRACTION,
    O_FRICTION_POWER,
    O_CONTROL_POWER,
    O_VIBRATION,
    O_EFFORT,
    O_STICK,
    O_CONTACT_LOSS,
) = range(19)
# ... and whole numbers.
C_MODE, C_EVENTS = 0, 1
# Rows of the second work space once it is free again, after what goes in: from O_V_REL on the report's, and two more.
_Q_V_REL, _Q_TIME, _Q_MEAN_V2, _Q_STICK_FRACTION, _Q_FRICTION_POWER, _Q_CONTROL_POWER = 13, 14, 15, 16, 17, 18
_Q_VIBRATION, _Q_EFFORT, _Q_STICK, _Q_CONTACT_LOSS, _Q_REWARD, _Q_WAY = 19, 20, 21, 22, 23, 24
# Where in both work spaces a reported row stands.
_REPORTED = (
    *(_X_END, _V_END, _BELT_END, _NORMAL, _ACTION, _U, _A_BELT, _X_MIN, _X_MAX),
    *(_WORK_ROWS + row for row in range(_Q_V_REL, _Q_CONTACT_LOSS + 1)),
)


# Numbers that hold for the whole batch.
(
    T_AUTHORITY,
    T_A_LIMIT,
    T_INTERVAL,
    T_W_EFFORT,
    T_W_STICK,
    T_CONTACT_LOSS_COST,
    T_LIMIT,
    T_X_OFFSET,
    T_X_SCALE,
    T_V_SCALE,
    T_BELT_AUTHORITY,
    T_SENSOR_NOISE,
) = range(12)
TASK_NUMBERS = 12
T_ACTUATOR, T_EPISODE_STEPS, T_LATE_STEPS, T_FULL_STATE, T_SEES_BELT, T_SENSOR_DELAY, T_ONE_PLANT = 0, 1, 2, 3, 4, 5, 6
T_TRAVEL, T_SEES_PHASES = 7, 8
TASK_CODES = 9


# The cache would take it for slip_step itself.
_slip_step_in_lanes = numba.njit(error_model="numpy", nogil=True, forceinline=True)(_slip_step)


@in_lanes
def _lane_plant(geometry, w, i):
    return Plant(
        geometry,
        w[_ALPHA * STRIDE + i],
        w[_G1 * STRIDE + i],
        w[_BETA * STRIDE + i],
        w[_MU_S * STRIDE + i],
        w[_K1 * STRIDE + i],
        w[_K3 * STRIDE + i],
        None,
    )


@in_lanes
def _stays_open(gap, slope, gap_end, slope_end, h):
    """Whether :func:`_dips` is sure to be false, told without a division and with a margin for its rounding."""
    width = slope - slope_end
    meeting = gap * width + slope * (gap_end - gap - slope_end * h)
    return (slope >= 0.0) | (slope_end <= 0.0) | (meeting < 1e-12 * width)


@in_lanes
def _slip_lane(geometry, w, i, interval):
    """Slip one lane over the whole interval in one step; mark it done if there is nothing else to it."""
    plant = _lane_plant(geometry, w, i)
    x = w[_X * STRIDE + i]
    v = w[_V * STRIDE + i]
    belt = w[_BELT * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    mode = 1.0 if v > belt else -1.0
    side = 1.0 if v > 0.0 else -1.0
    x_end, v_end, a, a_end, error, int_v2, int_fv = _slip_step_in_lanes(
        plant, mode, x, v, belt, a_belt * interval, w[_U * STRIDE + i], interval
    )
    belt_end = belt + a_belt * interval
    gap = mode * (v - belt)
    gap_end = mode * (v_end - belt_end)
    normal = spring(plant, x_end)[1]
    done = (error <= TOLERANCE * interval) & (gap > V_REL_ZERO) & (gap_end > V_REL_ZERO) & (v * v_end > 0.0)
    done = done & _stays_open(gap, mode * (a - a_belt), gap_end, mode * (a_end - a_belt), interval)
    done = done & _stays_open(side * v, side * a, side * v_end, side * a_end, interval)
    done = done & (normal > 0.0) & (spring(plant, x)[1] > 0.0)
    w[_X_END * STRIDE + i] = x_end
    w[_V_END * STRIDE + i] = v_end
    w[_BELT_END * STRIDE + i] = belt_end
    w[_MODE * STRIDE + i] = mode
    w[_EVENTS * STRIDE + i] = 0.0
    w[_STATUS * STRIDE + i] = 0.0
    w[_INT_V2 * STRIDE + i] = int_v2
    w[_STICK_TIME * STRIDE + i] = 0.0
    w[_INT_FV * STRIDE + i] = 0.0 + int_fv
    w[_X_MIN * STRIDE + i] = x_end if x_end < x else x
    w[_X_MAX * STRIDE + i] = x_end if x_end > x else x
    w[_NORMAL * STRIDE + i] = normal
    w[_DONE_FAST * STRIDE + i] = 1.0 if done else 0.0
    w[_A * STRIDE + i] = a
    w[_A_END * STRIDE + i] = a_end
    w[_ERROR * STRIDE + i] = error


@in_lanes
def _cone_side_holds(plant, side, x, belt, a_belt, u, interval):
    excess, slope = _cone_excess(plant, side, x, belt, a_belt, u, 0.0)
    excess_end, slope_end = _cone_excess(plant, side, x, belt, a_belt, u, interval)
    return (excess <= 0.0) & (excess_end <= 0.0) & _stays_open(-excess, -slope, -excess_end, -slope_end, interval)


@in_lanes
def _rides(geometry, plant, x, belt, a_belt, u, t):
    """Whether a mass at x that moves with the belt is sure to stick for a time t, told in one piece; x after that time,
    and the integrals of v^2 and of the contact force's power over it."""
    belt_end = belt + a_belt * t
    reach = 0.124 * (1.0 if geometry == LINEAR or plant.alpha > 1.0 else plant.alpha)
    holds = (abs(belt) * t <= reach) & (abs(belt_end) * t <= reach) & (belt * belt_end >= 0.0)
    holds = holds & _cone_side_holds(plant, -1, x, belt, a_belt, u, t)
    holds = holds & _cone_side_holds(plant, 1, x, belt, a_belt, u, t)
    dx, int_v2, int_fv = _ride(plant, x, belt, a_belt, u, t)
    return holds, x + dx, int_v2, int_fv


@in_lanes
def _stick_lane(geometry, w, i, interval):
    """Let one lane ride with the belt over the whole interval; mark it done if it does so in one piece."""
    plant = _lane_plant(geometry, w, i)
    x = w[_X * STRIDE + i]
    belt = w[_BELT * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    holds, x_end, int_v2, int_fv = _rides(geometry, plant, x, belt, a_belt, w[_U * STRIDE + i], interval)
    belt_end = belt + a_belt * interval
    done = holds & (spring(plant, x)[1] > 0.0)
    w[_X_END * STRIDE + i] = x_end
    w[_BELT_END * STRIDE + i] = belt_end
    w[_INT_V2 * STRIDE + i] = int_v2
    w[_INT_FV * STRIDE + i] = 0.0 + int_fv
    w[_X_MIN * STRIDE + i] = x_end if x_end < x else x
    w[_X_MAX * STRIDE + i] = x_end if x_end > x else x
    w[_NORMAL * STRIDE + i] = spring(plant, x_end)[1]
    w[_DONE_FAST * STRIDE + i] = 1.0 if done else 0.0


@in_lanes
def _look_lane(geometry, w, i, interval):
    """Look at the place where one lane's slip step is thought to land or to turn, and finish what is plain."""
    plant = _lane_plant(geometry, w, i)
    x = w[_X * STRIDE + i]
    v = w[_V * STRIDE + i]
    belt = w[_BELT * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    u = w[_U * STRIDE + i]
    mode = w[_L_MODE * STRIDE + i]
    t = w[_L_TIME * STRIDE + i]
    x_t, v_t, _, _, _, dv2, dfv = _slip_step_in_lanes(plant, mode, x, v, belt, a_belt * t, u, t)
    look = _gap_there(
        plant,
        mode,
        x_t,
        v_t,
        belt,
        a_belt,
        u,
        t,
        w[_L_SIDE * STRIDE + i],
        w[_L_LEVEL * STRIDE + i],
        w[_L_RATE * STRIDE + i],
        dv2,
        dfv,
    )
    gap, slope, curvature, x_t, v_t, a_t, f_t, dv2, dfv = look
    w[_LOOK * STRIDE + i] = gap
    w[(_LOOK + 1) * STRIDE + i] = slope
    w[(_LOOK + 2) * STRIDE + i] = curvature
    w[(_LOOK + 3) * STRIDE + i] = x_t
    w[(_LOOK + 4) * STRIDE + i] = v_t
    w[(_LOOK + 5) * STRIDE + i] = a_t
    w[(_LOOK + 6) * STRIDE + i] = f_t
    w[(_LOOK + 7) * STRIDE + i] = dv2
    w[(_LOOK + 8) * STRIDE + i] = dfv
    # What is plain to see from there is finished here, by the arithmetic of _closing, slip_until_event and _advance.
    near, dt = _last_stretch(gap, slope, curvature, interval)
    event_time = t + dt
    inside = (event_time > (t if gap > 0.0 else 0.0)) & (event_time < (interval if gap > 0.0 else t))
    x_event, dv2, dfv = _stretch(plant, w[_L_SIDE * STRIDE + i], x_t, v_t, a_t, f_t, curvature, dt, dv2, dfv)
    done = near & inside & (spring(plant, x)[1] > 0.0) & (spring(plant, x_event)[1] > 0.0)
    # It turns, or it lands (without having turned) and sticks for the rest of the interval.
    side = 1.0 if v > 0.0 else -1.0
    belt_event = belt + a_belt * event_time
    lands = w[_L_LANDS * STRIDE + i] == 1.0
    straight = v * belt_event > 0.0
    straight = straight & _stays_open(side * v, side * w[_L_A * STRIDE + i], side * belt_event, side * a_t, event_time)
    rest = interval - event_time
    holds, x_end, stick_v2, stick_fv = _rides(geometry, plant, x_event, belt_event, a_belt, u, rest)
    done = done & ((straight & (rest > 0.0)) | (not lands))
    w[_F_WAY * STRIDE + i] = (_FINISHED if holds | (not lands) else _LANDED) if done else _OPEN
    w[_F_TIME * STRIDE + i] = event_time
    w[_F_V2_THERE * STRIDE + i] = dv2
    w[_F_FV_THERE * STRIDE + i] = dfv
    w[_F_X_EVENT * STRIDE + i] = x_event
    w[_F_X_END * STRIDE + i] = x_end
    w[_F_INT_V2 * STRIDE + i] = dv2 + stick_v2
    w[_F_STICK_TIME * STRIDE + i] = 0.0 + rest
    w[_F_INT_FV * STRIDE + i] = 0.0 + dfv + stick_fv
    low = x_event if x_event < x else x
    high = x_event if x_event > x else x
    w[_F_X_MIN * STRIDE + i] = x_end if x_end < low else low
    w[_F_X_MAX * STRIDE + i] = x_end if x_end > high else high
    w[_F_NORMAL * STRIDE + i] = spring(plant, x_end)[1]


@in_lanes
def _onward_lane(geometry, w, i):
    """Slip one lane, which has just left the stick surface, over the rest of its interval in one step."""
    plant = _lane_plant(geometry, w, i)
    x = w[_X * STRIDE + i]
    v = w[_V * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    mode = w[_L_MODE * STRIDE + i]
    rest = w[_L_TIME * STRIDE + i]
    x_end, v_end, a, a_end, error, int_v2, int_fv = _slip_step_in_lanes(
        plant, mode, x, v, v, a_belt * rest, w[_U * STRIDE + i], rest
    )
    gap_end = mode * (v_end - (v + a_belt * rest))
    normal = spring(plant, x_end)[1]
    side = 1.0 if v > 0.0 else -1.0
    done = (error <= TOLERANCE * rest) & (gap_end > 2.0 * V_REL_ZERO) & (v * v_end > 0.0) & (normal > 0.0)
    done = done & _stays_open(0.0, mode * (a - a_belt), gap_end, mode * (a_end - a_belt), rest)
    done = done & _stays_open(side * v, side * a, side * v_end, side * a_end, rest)
    low = w[_F_X_MIN * STRIDE + i]
    high = w[_F_X_MAX * STRIDE + i]
    w[_F_WAY * STRIDE + i] = _FINISHED if done else _OPEN
    w[_F_X_END * STRIDE + i] = x_end
    w[_F_V_END * STRIDE + i] = v_end
    w[_F_INT_V2 * STRIDE + i] = w[_F_V2_THERE * STRIDE + i] + (0.0 + int_v2)
    w[_F_INT_FV * STRIDE + i] = w[_F_FV_THERE * STRIDE + i] + (0.0 + int_fv)
    w[_F_X_MIN * STRIDE + i] = x_end if x_end < low else low
    w[_F_X_MAX * STRIDE + i] = x_end if x_end > high else high
    w[_F_NORMAL * STRIDE + i] = normal


@in_lanes
def _finished(w, i, sub, n):
    """Whether lane n of the second work space finished lane i's step; if so, take what came out."""
    if sub[_F_WAY * STRIDE + n] != _FINISHED:
        return False
    if sub[_L_LANDS * STRIDE + n] == 0.0:
        x_turn = sub[_F_X_EVENT * STRIDE + n]
        w[_X_MIN * STRIDE + i] = min(w[_X_MIN * STRIDE + i], x_turn)
        w[_X_MAX * STRIDE + i] = max(w[_X_MAX * STRIDE + i], x_turn)
        return True
    _take(w, i, sub, n)
    w[_V_END * STRIDE + i] = w[_BELT_END * STRIDE + i]
    w[_MODE * STRIDE + i] = STICK
    w[_EVENTS * STRIDE + i] = 1.0
    return True


@in_lanes
def _take(w, i, sub, n):
    """Take for lane i what lane n of the second work space came to."""
    w[_X_END * STRIDE + i] = sub[_F_X_END * STRIDE + n]
    w[_INT_V2 * STRIDE + i] = sub[_F_INT_V2 * STRIDE + n]
    w[_STICK_TIME * STRIDE + i] = sub[_F_STICK_TIME * STRIDE + n]
    w[_INT_FV * STRIDE + i] = sub[_F_INT_FV * STRIDE + n]
    w[_X_MIN * STRIDE + i] = sub[_F_X_MIN * STRIDE + n]
    w[_X_MAX * STRIDE + i] = sub[_F_X_MAX * STRIDE + n]
    w[_NORMAL * STRIDE + i] = sub[_F_NORMAL * STRIDE + n]


@compiled
def _send_onward(w, i, sub, n, one_plant, interval, t, x, mode, n_events, stick_time, int_v2, int_fv, x_min, x_max):
    """Tell lane n of the second work space how lane i goes on slipping, from x at time t, and what it has gathered."""
    belt = w[_BELT * STRIDE + i] + w[_A_BELT * STRIDE + i] * t
    _bring(w, i, sub, n, one_plant)
    sub[_X * STRIDE + n] = x
    sub[_V * STRIDE + n] = belt
    sub[_L_TIME * STRIDE + n] = interval - t
    sub[_L_MODE * STRIDE + n] = mode
    sub[_L_LANE * STRIDE + n] = i
    sub[_F_EVENTS * STRIDE + n] = n_events
    sub[_F_STICK_TIME * STRIDE + n] = stick_time
    sub[_F_V2_THERE * STRIDE + n] = 0.0 + int_v2
    sub[_F_FV_THERE * STRIDE + n] = 0.0 + int_fv
    sub[_F_X_MIN * STRIDE + n] = x_min
    sub[_F_X_MAX * STRIDE + n] = x_max


@compiled
def _crosses(geometry, w, i, sub, j, n, one_plant, interval):
    """Whether lane i, whose landing was looked at in lane j of the second work space, goes on slipping from there; if
    so, make it lane n (not above j)."""
    if sub[_F_WAY * STRIDE + j] != _LANDED:
        return False
    x = w[_X * STRIDE + i]
    x_event = sub[_F_X_EVENT * STRIDE + j]
    t = sub[_F_TIME * STRIDE + j]
    a_belt = w[_A_BELT * STRIDE + i]
    belt = w[_BELT * STRIDE + i] + a_belt * t
    mode = mode_at_zero_v_rel(_lane_plant(geometry, w, i), x_event, belt, a_belt, w[_U * STRIDE + i])
    if mode == STICK:
        return False
    int_v2 = sub[_F_V2_THERE * STRIDE + j]
    int_fv = sub[_F_FV_THERE * STRIDE + j]
    low = min(x, x_event)
    high = max(x, x_event)
    _send_onward(w, i, sub, n, one_plant, interval, t, x_event, mode, 1, 0.0, int_v2, int_fv, low, high)
    return True


@compiled
def _breaks_away(geometry, w, i, sub, n, one_plant, interval):
    """Whether lane i, which moves with the belt, goes on slipping; if so, make it lane n of the second work space.

    If it sticks to the end, its step is finished here. Nothing is done where contact is lost at once or nothing of the
    interval is left.
    """
    plant = _lane_plant(geometry, w, i)
    x = w[_X * STRIDE + i]
    belt = w[_BELT * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    u = w[_U * STRIDE + i]
    if spring(plant, x)[1] <= 0.0:
        return False
    mode = mode_at_zero_v_rel(plant, x, belt, a_belt, u)
    if mode != STICK:
        _send_onward(w, i, sub, n, one_plant, interval, 0.0, x, mode, 0, 0.0, 0.0, 0.0, x, x)
        return True
    t, event, x_event, int_v2, int_fv, low, high = _stick_leg(plant, x, belt, a_belt, u, interval)
    if event == BREAKAWAY:
        if t >= interval:
            return False
        mode = _breakaway_mode(plant, x_event, belt + a_belt * t, a_belt, u)
        _send_onward(w, i, sub, n, one_plant, interval, t, x_event, mode, 1, t, int_v2, int_fv, low, high)
        return True
    w[_X_END * STRIDE + i] = x_event
    w[_V_END * STRIDE + i] = w[_BELT_END * STRIDE + i]
    w[_MODE * STRIDE + i] = STICK
    w[_EVENTS * STRIDE + i] = 0.0
    w[_STATUS * STRIDE + i] = OK
    w[_INT_V2 * STRIDE + i] = 0.0 + int_v2
    w[_STICK_TIME * STRIDE + i] = interval
    w[_INT_FV * STRIDE + i] = 0.0 + int_fv
    w[_X_MIN * STRIDE + i] = low
    w[_X_MAX * STRIDE + i] = high
    w[_NORMAL * STRIDE + i] = spring(plant, x_event)[1]
    w[_DONE_FAST * STRIDE + i] = 1.0
    return False


@compiled
def _bring(w, i, sub, n, one_plant):
    """Copy what goes into lane i to lane n of the second work space."""
    for row in range(_X if one_plant else 0, _ACTION):
        sub[row * STRIDE + n] = w[row * STRIDE + i]
    sub[_U * STRIDE + n] = w[_U * STRIDE + i]
    sub[_A_BELT * STRIDE + n] = w[_A_BELT * STRIDE + i]


@compiled
def _give_back(sub, n, w, i, interval):
    """Copy what came of a stuck lane n of the second work space to lane i."""
    w[_X_END * STRIDE + i] = sub[_X_END * STRIDE + n]
    w[_V_END * STRIDE + i] = sub[_BELT_END * STRIDE + n]
    w[_BELT_END * STRIDE + i] = sub[_BELT_END * STRIDE + n]
    w[_MODE * STRIDE + i] = STICK
    w[_EVENTS * STRIDE + i] = 0.0
    w[_STATUS * STRIDE + i] = OK
    w[_INT_V2 * STRIDE + i] = sub[_INT_V2 * STRIDE + n]
    w[_STICK_TIME * STRIDE + i] = interval
    w[_INT_FV * STRIDE + i] = sub[_INT_FV * STRIDE + n]
    w[_X_MIN * STRIDE + i] = sub[_X_MIN * STRIDE + n]
    w[_X_MAX * STRIDE + i] = sub[_X_MAX * STRIDE + n]
    w[_NORMAL * STRIDE + i] = sub[_NORMAL * STRIDE + n]
    w[_DONE_FAST * STRIDE + i] = sub[_DONE_FAST * STRIDE + n]


@compiled
def _wants_look(w, i, sub, n, interval, one_plant):
    """Whether the slip step of lane i lands or turns in the plainest way; if so, tell lane n of the second work space
    where. The tests are those of :func:`slip_until_event`."""
    x = w[_X * STRIDE + i]
    v = w[_V * STRIDE + i]
    belt = w[_BELT * STRIDE + i]
    a_belt = w[_A_BELT * STRIDE + i]
    a = w[_A * STRIDE + i]
    a_end = w[_A_END * STRIDE + i]
    v_end = w[_V_END * STRIDE + i]
    mode = 1 if v > belt else -1
    gap = mode * (v - belt)
    gap_end = mode * (v_end - (belt + a_belt * interval))
    slope = mode * (a - a_belt)
    slope_end = mode * (a_end - a_belt)
    allowed = TOLERANCE * interval * max(1.0, abs(x), abs(v), STIFF * abs(a))
    if not w[_ERROR * STRIDE + i] <= allowed or gap <= V_REL_ZERO:
        return False
    lands = gap_end <= 0.0
    if lands:
        t = _closing_guess(gap, slope, gap_end, slope_end, interval)
        side, level, rate = mode, belt, a_belt
    elif v * v_end < 0.0 and gap_end > V_REL_ZERO and not _dips(gap, slope, gap_end, slope_end, interval):
        side, level, rate = 1 if v > 0.0 else -1, 0.0, 0.0
        t = _closing_guess(side * v, side * a, side * v_end, side * a_end, interval)
    else:
        return False
    _bring(w, i, sub, n, one_plant)
    sub[_L_TIME * STRIDE + n] = t
    sub[_L_SIDE * STRIDE + n] = side
    sub[_L_LEVEL * STRIDE + n] = level
    sub[_L_RATE * STRIDE + n] = rate
    sub[_L_MODE * STRIDE + n] = mode
    sub[_L_LANE * STRIDE + n] = i
    sub[_L_LANDS * STRIDE + n] = 1.0 if lands else 0.0
    sub[_L_A * STRIDE + n] = a
    return True


@compiled
def _lane_by_events(geometry, w, i, interval, known):
    """Advance one lane as a single environment is; ``known``: see :func:`slip_until_event`."""
    return _plant_by_events(_lane_plant(geometry, w, i), w, i, interval, known)


@compiled
def _plant_by_events(plant, w, i, interval, known):
    x, v, belt, mode, status, t, n_events, int_v2, stick_time, int_fv, x_min, x_max = _advance(
        plant,
        UNKNOWN,
        w[_X * STRIDE + i],
        w[_V * STRIDE + i],
        w[_BELT * STRIDE + i],
        w[_A_BELT * STRIDE + i],
        w[_U * STRIDE + i],
        interval,
        None,
        known,
    )
    w[_X_END * STRIDE + i] = x
    w[_V_END * STRIDE + i] = v
    w[_BELT_END * STRIDE + i] = belt
    w[_MODE * STRIDE + i] = mode
    w[_EVENTS * STRIDE + i] = n_events
    w[_STATUS * STRIDE + i] = status
    w[_INT_V2 * STRIDE + i] = int_v2
    w[_STICK_TIME * STRIDE + i] = stick_time
    w[_INT_FV * STRIDE + i] = int_fv
    w[_X_MIN * STRIDE + i] = x_min
    w[_X_MAX * STRIDE + i] = x_max
    w[_NORMAL * STRIDE + i] = spring(later(plant, t), x)[1]
    w[_DONE_FAST * STRIDE + i] = 1.0
    w[_T_END * STRIDE + i] = t
    return 0 if status == OK else 1


@compiled
def _lane_after_trial(geometry, w, i, sub, n, interval, stage):
    """:func:`_lane_by_events` for lane i, whose first slip step is done (stage 1) and whose event was looked at in lane
    n (stage 2)."""
    known = (
        stage,
        w[_X_END * STRIDE + i],
        w[_V_END * STRIDE + i],
        w[_A * STRIDE + i],
        w[_A_END * STRIDE + i],
        w[_ERROR * STRIDE + i],
        w[_INT_V2 * STRIDE + i],
        w[_INT_FV * STRIDE + i],
        sub[_L_TIME * STRIDE + n],
        sub[_LOOK * STRIDE + n],
        sub[(_LOOK + 1) * STRIDE + n],
        sub[(_LOOK + 2) * STRIDE + n],
        sub[(_LOOK + 3) * STRIDE + n],
        sub[(_LOOK + 4) * STRIDE + n],
        sub[(_LOOK + 5) * STRIDE + n],
        sub[(_LOOK + 6) * STRIDE + n],
        sub[(_LOOK + 7) * STRIDE + n],
        sub[(_LOOK + 8) * STRIDE + n],
    )
    return _lane_by_events(geometry, w, i, interval, known)


@in_lanes
def _episode_time(state, integers, i, interval):
    """Return the time in environment i's episode; it stops where the motion did."""
    if integers[I_OVER, i] == ENDED:
        return state[S_END_TIME, i]
    return integers[I_STEPS, i] * interval


@in_lanes
def _whole(m):
    """Return m rounded up to whole vectors; what is computed in the lanes beyond m is not looked at."""
    return 8 * ((m + 7) // 8)


@in_lanes
def _observed(value, offset, scale, limit):
    """Return (value - offset)/scale, no further from zero than the limit."""
    scaled = (value - offset) / scale
    return scaled if abs(scaled) <= limit else math.copysign(limit, scaled)


@compiled
def _sense(task, codes, integers, past, x, v, i):
    """Return x and v of environment i as its sensor gives them: some intervals old, with the noise of that time."""
    if task[T_SENSOR_NOISE] > 0.0:
        key = int(integers[I_KEY, i])
        episode = int(integers[I_EPISODE, i])
        step = int(integers[I_STEPS, i]) + 1
        x += task[T_SENSOR_NOISE] * random_normal(key, episode, step, 0)
        if codes[T_FULL_STATE]:
            v += task[T_SENSOR_NOISE] * random_normal(key, episode, step, 1)
    delay = codes[T_SENSOR_DELAY]
    if delay == 0:
        return x, v
    seen = integers[I_SEEN, i]
    integers[I_SEEN, i] = seen + 1
    past[seen % (delay + 1), 0, i] = x
    past[seen % (delay + 1), 1, i] = v
    oldest = max(0, seen - delay) % (delay + 1)
    return past[oldest, 0, i], past[oldest, 1, i]


@compiled
def observe(task, codes, state, integers, past, shown, observations, which):
    """Write the observations of the environments ``which`` (k,) into rows of ``observations`` (n, size), float32.

    ``past`` (delay + 1, 2, n) is the sensor's memory, ``shown`` (n, p) the scaled parameters shown.
    """
    limit = task[T_LIMIT]
    for i in which:
        x, v = _sense(task, codes, integers, past, state[S_X, i], state[S_V, i], i)
        observations[i, 0] = _observed(x, task[T_X_OFFSET], task[T_X_SCALE], limit)
        place = 1
        if codes[T_FULL_STATE]:
            observations[i, 1] = _observed(v, 0.0, task[T_V_SCALE], limit)
            place = 2
        if codes[T_SEES_BELT]:
            modulation = state[S_BELT, i] / state[S_BELT_SPEED, i]
            observations[i, place] = _observed(modulation, 1.0, task[T_BELT_AUTHORITY], limit)
            place += 1
        if codes[T_SEES_PHASES]:
            time = _episode_time(state, integers, i, task[T_INTERVAL])
            for row in (S_FORCE, S_RIPPLE, S_DEPTH):
                angle = state[row + 1, i] * time + state[row + 2, i]
                observations[i, place] = math.cos(angle)
                observations[i, place + 1] = math.sin(angle)
                place += 2
        for j in range(shown.shape[1]):
            observations[i, place + j] = shown[i, j]


@compiled
def laws_of(state, i, time, beyond):
    """Return the laws of environment i at a time, or None if ``beyond`` is None (else it is any :class:`Laws`: by its
    type compiled code knows which of the two it is to be)."""
    if beyond is None:
        return beyond
    return Laws(
        0.0,
        int(state[S_FRICTION, i]),
        state[S_MU_K, i],
        state[S_DECAY, i],
        state[S_MU_V, i],
        state[S_KAPPA, i],
        state[S_FORCE, i],
        state[S_FORCE_RATE, i],
        state[S_FORCE_PHASE, i],
        state[S_RIPPLE, i],
        state[S_RIPPLE_RATE, i],
        state[S_RIPPLE_PHASE, i],
        state[S_DEPTH, i],
        state[S_DEPTH_RATE, i],
        state[S_DEPTH_PHASE, i],
        time,
    )


@compiled
def _plant_of(state, integers, i, time, beyond):
    return Plant(
        integers[I_GEOMETRY, i],
        state[S_ALPHA, i],
        state[S_G1, i],
        state[S_BETA, i],
        state[S_MU_S, i],
        state[S_K1, i],
        state[S_K3, i],
        laws_of(state, i, time, beyond),
    )


@compiled
def _calm(plant, laws):
    if laws is None:
        return plant
    still = Laws(
        laws.side,
        laws.friction,
        laws.mu_k,
        laws.decay,
        laws.mu_v,
        laws.kappa,
        0.0,
        laws.force_rate,
        laws.force_phase,
        0.0,
        laws.ripple_rate,
        laws.ripple_phase,
        0.0,
        laws.depth_rate,
        laws.depth_phase,
        laws.time,
    )
    return Plant(plant.geometry, plant.alpha, plant.g1, plant.beta, plant.mu_s, plant.k1, plant.k3, still)


@compiled
def calm(plant):
    """Return the plant without its excitation."""
    return _calm(plant, plant.laws)


@compiled
def _shown_belt(laws, mode, v, v_belt):
    """Return the belt's speed with its ripple, and the velocity relative to it."""
    if laws is not None:
        if laws.ripple != 0.0:
            v_belt = v_belt + _ripple(laws)[1]
            return v_belt, 0.0 if mode == STICK else v - v_belt
    return v_belt, v - v_belt


# One environment on its own keeps its arrays in a single one, for each that is handed over costs a call more time.


@compiled
def arrays_in(memory):
    """Return the arrays that lie in the flat ``memory`` of one environment, as a batch of one has them: task (12,),
    codes (9,), state (36, 1), integers (8, 1), past (delay + 1 or 0, 2, 1) and shown (1, p), in this order."""
    codes = memory[TASK_NUMBERS : TASK_NUMBERS + TASK_CODES].view(np.int64)
    first = TASK_NUMBERS + TASK_CODES
    integers = memory[first : first + INTEGER_ROWS].view(np.int64).reshape((INTEGER_ROWS, 1))
    first += INTEGER_ROWS
    state = memory[first : first + STATE_ROWS].reshape((STATE_ROWS, 1))
    first += STATE_ROWS
    kept = codes[T_SENSOR_DELAY] + 1 if codes[T_SENSOR_DELAY] > 0 else 0
    past = memory[first : first + 2 * kept].reshape((kept, 2, 1))
    shown = memory[first + 2 * kept :].reshape((1, len(memory) - first - 2 * kept))
    return memory[:TASK_NUMBERS], codes, state, integers, past, shown


@in_lanes
def _step_alone(memory, observations, action, beyond):
    task, codes, state, integers, past, shown = arrays_in(memory)
    interval = task[T_INTERVAL]
    v_belt_before = state[S_BELT, 0]
    laws = laws_of(state, 0, integers[I_STEPS, 0] * interval, beyond)
    (
        x,
        v,
        v_belt,
        mode,
        status,
        events,
        force,
        a_belt,
        vibration,
        effort,
        stick,
        mean_v2,
        stick_fraction,
        friction_power,
        control_power,
        x_min,
        x_max,
        normal_force,
        t,
    ) = control_interval(
        integers[I_GEOMETRY, 0],
        state[S_ALPHA, 0],
        state[S_G1, 0],
        state[S_BETA, 0],
        state[S_MU_S, 0],
        state[S_K1, 0],
        state[S_K3, 0],
        laws,
        codes[T_ACTUATOR],
        task[T_AUTHORITY],
        task[T_A_LIMIT],
        state[S_BELT_SPEED, 0],
        interval,
        task[T_W_EFFORT],
        task[T_W_STICK],
        state[S_X, 0],
        state[S_V, 0],
        v_belt_before,
        action,
    )
    state[S_X, 0] = x
    state[S_V, 0] = v
    state[S_BELT, 0] = v_belt
    state[S_TRAVEL, 0] += 0.5 * (v_belt_before + v_belt) * t
    state[S_VIBRATION, 0] += vibration
    state[S_EFFORT, 0] += effort
    state[S_STICK, 0] += stick
    reward = vibration + effort + stick
    state[S_WORST, 0] = max(state[S_WORST, 0], -reward)
    steps = integers[I_STEPS, 0] + 1
    integers[I_STEPS, 0] = steps
    if steps > codes[T_LATE_STEPS]:
        state[S_LATE_LOW, 0] = min(state[S_LATE_LOW, 0], x_min)
        state[S_LATE_HIGH, 0] = max(state[S_LATE_HIGH, 0], x_max)
        state[S_LATE_STICK, 0] += stick_fraction
        state[S_LATE_TIME, 0] += 1.0
    terminated = False
    truncated = steps >= codes[T_EPISODE_STEPS]
    contact_loss = 0.0
    if status != OK:
        integers[I_OVER, 0] = ENDED
        state[S_END_TIME, 0] = (steps - 1) * interval + t
        if status == CONTACT_LOST:
            terminated = True
            steps_left = max(0, codes[T_EPISODE_STEPS] - steps) + 1
            contact_loss = -steps_left * max(task[T_CONTACT_LOSS_COST], state[S_WORST, 0])
            state[S_CONTACT_LOSS, 0] += contact_loss
            reward += contact_loss
        else:
            truncated = True
    observe(task, codes, state, integers, past, shown, observations, (0,))
    time = _episode_time(state, integers, 0, interval)
    v_belt_shown, v_rel = _shown_belt(laws_of(state, 0, time, beyond), mode, v, v_belt)
    return (
        x,
        v,
        v_belt_shown,
        v_rel,
        mode,
        normal_force,
        time,
        force,
        a_belt,
        x_min,
        x_max,
        mean_v2,
        stick_fraction,
        friction_power,
        control_power,
        events,
        status,
        vibration,
        effort,
        stick,
        contact_loss,
        reward,
        terminated,
        truncated,
    )


@compiled
def step_alone(memory, observations, action):
    """Step the one environment whose arrays lie in ``memory`` (see :func:`arrays_in`), with an action in [-1, 1].

    Write what it observes into ``observations`` (1, size). Return x, v, v_belt, v_rel, mode, normal force, time, force,
    belt acceleration, least and greatest x, the means of v^2, of the stick indicator, of the contact force's and the
    control force's power, events, status, the four reward terms, the reward, and whether the episode was terminated
    or truncated. The law of the step is :func:`control_interval`'s, and :func:`_account` keeps the same accounts.
    """
    return _step_alone(memory, observations, action, None)


@compiled
def step_alone_beyond(memory, observations, action):
    """Do what :func:`step_alone` does for an environment with laws beyond the paper's."""
    beyond = Laws(0.0, STRIBECK, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return _step_alone(memory, observations, action, beyond)


@compiled
def first_bad(actions):
    """Return the place of the first value of ``actions`` (n,) that is not finite, or -1."""
    bad = 0
    for i in range(len(actions)):  # counting is done in vector instructions, adding numbers or leaving early is not
        bad += 0 if abs(actions[i]) < math.inf else 1
    if bad == 0:
        return -1
    for i in range(len(actions)):
        if not math.isfinite(actions[i]):
            return i
    return -1


@compiled
def _weigh_lanes(w, q, m, interval, w_effort, w_stick):
    for i in range(m):
        belt_end = w[_BELT_END * STRIDE + i]
        mean_v2, stick_fraction, friction_power, control_power, vibration, effort, stick = _weighed(
            w[_X * STRIDE + i],
            w[_X_END * STRIDE + i],
            w[_INT_V2 * STRIDE + i],
            w[_STICK_TIME * STRIDE + i],
            w[_INT_FV * STRIDE + i],
            w[_ACTION * STRIDE + i],
            w[_U * STRIDE + i],
            w[_BELT_SPEED * STRIDE + i],
            interval,
            w_effort,
            w_stick,
        )
        q[_Q_V_REL * STRIDE + i] = w[_V_END * STRIDE + i] - belt_end
        q[_Q_MEAN_V2 * STRIDE + i] = mean_v2
        q[_Q_STICK_FRACTION * STRIDE + i] = stick_fraction
        q[_Q_FRICTION_POWER * STRIDE + i] = friction_power
        q[_Q_CONTROL_POWER * STRIDE + i] = control_power
        q[_Q_VIBRATION * STRIDE + i] = vibration
        q[_Q_EFFORT * STRIDE + i] = effort
        q[_Q_STICK * STRIDE + i] = stick
        q[_Q_CONTACT_LOSS * STRIDE + i] = 0.0
        q[_Q_REWARD * STRIDE + i] = vibration + effort + stick
        q[_Q_WAY * STRIDE + i] = 0.5 * (w[_BELT * STRIDE + i] + belt_end) * interval


@compiled
def _account(task, codes, state, integers, work, wanted, rewards, over, report, report_codes, first, m, failures):
    """Write down what a block's step came to; return how many of its environments ended their episode."""
    # Every row is cut out first and then counted from 0, which is what vector instructions need.
    interval = task[T_INTERVAL]
    last_step = codes[T_EPISODE_STEPS]
    late_steps = codes[T_LATE_STEPS]
    w = work[: _WORK_ROWS * STRIDE]
    q = work[_WORK_ROWS * STRIDE :]
    _weigh_lanes(w, q, m, interval, task[T_W_EFFORT], task[T_W_STICK])
    if failures > 0:
        for i in range(m):
            if w[_STATUS * STRIDE + i] != OK:
                belts = w[_BELT * STRIDE + i] + w[_BELT_END * STRIDE + i]
                q[_Q_WAY * STRIDE + i] = 0.5 * belts * w[_T_END * STRIDE + i]
    for row in range(3):
        place = state[S_X + row, first : first + m]
        for i in range(m):
            place[i] = w[(_X_END + row) * STRIDE + i]
    for row in range(3):
        place = state[S_VIBRATION + row, first : first + m]
        for i in range(m):
            place[i] += q[(_Q_VIBRATION + row) * STRIDE + i]
    if codes[T_TRAVEL]:
        travel = state[S_TRAVEL, first : first + m]
        for i in range(m):
            travel[i] += q[_Q_WAY * STRIDE + i]
    worst = state[S_WORST, first : first + m]
    worse = 0
    for i in range(m):
        worse += 1 if -q[_Q_REWARD * STRIDE + i] > worst[i] else 0
    if worse > 0:  # seldom, and memory is slow
        for i in range(m):
            worst[i] = max(worst[i], -q[_Q_REWARD * STRIDE + i])
    steps = integers[I_STEPS, first : first + m]
    terminated = over[0, first : first + m]
    truncated = over[1, first : first + m]
    late = 0
    ended = 0
    for i in range(m):
        steps[i] += 1
        q[_Q_TIME * STRIDE + i] = steps[i] * interval
    for i in range(m):
        terminated[i] = False
    for i in range(m):
        truncated[i] = steps[i] >= last_step
    for i in range(m):
        late += 1 if steps[i] > late_steps else 0
    for i in range(m):
        ended += 1 if steps[i] >= last_step else 0
    if late > 0:
        for i in range(m):
            if steps[i] > late_steps:
                j = first + i
                state[S_LATE_LOW, j] = min(state[S_LATE_LOW, j], w[_X_MIN * STRIDE + i])
                state[S_LATE_HIGH, j] = max(state[S_LATE_HIGH, j], w[_X_MAX * STRIDE + i])
                state[S_LATE_STICK, j] += q[_Q_STICK_FRACTION * STRIDE + i]
                state[S_LATE_TIME, j] += 1.0
    if ended > 0:
        for i in range(m):
            if truncated[i]:
                integers[I_OVER, first + i] = TRUNCATED
    if failures > 0:
        for i in range(m):
            status = int(w[_STATUS * STRIDE + i])
            if status != OK:
                ended += 0 if truncated[i] else 1
                integers[I_OVER, first + i] = ENDED
                integers[I_STATUS, first + i] = status
                time = (steps[i] - 1) * interval + w[_T_END * STRIDE + i]
                state[S_END_TIME, first + i] = time
                q[_Q_TIME * STRIDE + i] = time
                if status != CONTACT_LOST:
                    truncated[i] = True
                    continue
                terminated[i] = True
                steps_left = max(0, last_step - steps[i]) + 1
                loss = -steps_left * max(task[T_CONTACT_LOSS_COST], worst[i])
                q[_Q_CONTACT_LOSS * STRIDE + i] = loss
                q[_Q_REWARD * STRIDE + i] += loss
                state[S_CONTACT_LOSS, first + i] += loss
    reward = rewards[first : first + m]
    for i in range(m):
        reward[i] = q[_Q_REWARD * STRIDE + i]
    for j in range(len(wanted)):
        source = _REPORTED[wanted[j]] * STRIDE
        place = report[j, first : first + m]
        for i in range(m):
            place[i] = work[source + i]
    for row in range(len(report_codes)):
        code = report_codes[row, first : first + m]
        for i in range(m):
            code[i] = int(w[(_MODE + row) * STRIDE + i])
    return ended


@compiled
def _observe_block(task, codes, w, shown, observations, first, m):
    """:func:`observe` for a block whose sensors neither wait nor err nor see phases."""
    limit = task[T_LIMIT]
    x_offset = task[T_X_OFFSET]
    x_scale = task[T_X_SCALE]
    v_scale = task[T_V_SCALE]
    authority = task[T_BELT_AUTHORITY]
    size = observations.shape[1]
    block = observations[first : first + m].reshape(-1)
    if size == 2 and codes[T_FULL_STATE]:
        for i in range(m):  # with both in one loop, and 2 in plain sight, these are vector instructions
            block[2 * i] = _observed(w[_X_END * STRIDE + i], x_offset, x_scale, limit)
            block[2 * i + 1] = _observed(w[_V_END * STRIDE + i], 0.0, v_scale, limit)
        return
    for i in range(m):
        block[size * i] = _observed(w[_X_END * STRIDE + i], x_offset, x_scale, limit)
    place = 1
    if codes[T_FULL_STATE]:
        for i in range(m):
            block[size * i + 1] = _observed(w[_V_END * STRIDE + i], 0.0, v_scale, limit)
        place = 2
    if codes[T_SEES_BELT]:
        for i in range(m):
            modulation = w[_BELT_END * STRIDE + i] / w[_BELT_SPEED * STRIDE + i]
            block[size * i + place] = _observed(modulation, 1.0, authority, limit)
        place += 1
    for i in range(m):
        for j in range(shown.shape[1]):
            block[size * i + place + j] = shown[first + i, j]


if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]

    def _bare(array):
        return array

else:

    @numba.extending.intrinsic
    def _bare(context, array):
        """Return the array without its count of references, which all threads would have to write to at every slice."""

        def generate(context, builder, signature, arguments):
            bare = context.make_array(array)(context, builder, arguments[0])
            bare.meminfo = bare.meminfo.type(None)
            bare.parent = bare.parent.type(None)
            return bare._getvalue()

        return array(array), generate


@compiled
def fill_plant(work, state):
    """Put one environment's plant and belt speed, from its column of the state, into all lanes of both work spaces."""
    for row in range(_X):
        for i in range(STRIDE):
            work[row * STRIDE + i] = state[row]
            work[(_WORK_ROWS + row) * STRIDE + i] = state[row]


@compiled
def _fill(w, task, codes, state, actions, first, m):
    """Fill a block's work space with what goes into its step (the plant is there already if all have the same)."""
    for row in range(_X if codes[T_ONE_PLANT] else 0, _ACTION):
        source = state[row, first : first + m]
        for i in range(m):
            w[row * STRIDE + i] = source[i]
    action = actions[first : first + m]
    for i in range(m):
        w[_ACTION * STRIDE + i] = min(max(action[i], -1.0), 1.0)
    actuator = codes[T_ACTUATOR]
    authority = task[T_AUTHORITY]
    a_limit = task[T_A_LIMIT]
    interval = task[T_INTERVAL]
    for i in range(m):
        u, a_belt = _actuation(
            actuator,
            authority,
            a_limit,
            w[_BELT_SPEED * STRIDE + i],
            interval,
            w[_BELT * STRIDE + i],
            w[_ACTION * STRIDE + i],
        )
        w[_U * STRIDE + i] = u
        w[_A_BELT * STRIDE + i] = a_belt


def _stepper(geometry):
    """Return the function that steps a batch most of whose environments have this geometry, compiled when first used.

    It takes

        work: (WORK_SIZE,), this call's own. start, end: which environments to step.
        task (12,), codes (9,): what holds for the whole batch. state (36, n), integers (8, n): of each environment;
            rows as named above. past, shown: see :func:`observe`. With T_ONE_PLANT the plant and its belt speed stand
            in both halves of ``work`` already; the belt's way is only kept with T_TRAVEL.
        actions: (n,), finite; outside [-1, 1] they are clipped.
        wanted: (k,), which rows of the report are.
        observations (n, size), rewards (n,), over (2, n) (terminated, truncated), report (k, n) and report_codes
            (2, n) or (0, n): written.

    and returns how many of them ended their episode. The law of a step is :func:`control_interval`'s.
    """

    @compiled
    def step_environments(
        work,
        start,
        end,
        task,
        codes,
        state,
        integers,
        past,
        shown,
        actions,
        wanted,
        observations,
        rewards,
        over,
        report,
        report_codes,
    ):
        task, codes, work = _bare(task), _bare(codes), _bare(work)
        state, integers, past, shown = _bare(state), _bare(integers), _bare(past), _bare(shown)
        actions, wanted, observations, rewards = _bare(actions), _bare(wanted), _bare(observations), _bare(rewards)
        over, report, report_codes = _bare(over), _bare(report), _bare(report_codes)
        interval = task[T_INTERVAL]
        w = work[: _WORK_ROWS * STRIDE]
        sub = work[_WORK_ROWS * STRIDE :]
        one_plant = codes[T_ONE_PLANT] == 1
        plain = task[T_SENSOR_NOISE] == 0.0 and codes[T_SENSOR_DELAY] == 0 and codes[T_SEES_PHASES] == 0
        ended = 0
        for first in range(start, end, LANES):
            m = min(LANES, end - first)
            _fill(w, task, codes, state, actions, first, m)
            geometries = integers[I_GEOMETRY, first : first + m]
            stuck = 0
            for i in range(m):
                stuck += 1 if w[_V * STRIDE + i] == w[_BELT * STRIDE + i] else 0
            fast = interval <= MAX_SLIP_STEP and m > 1
            if fast and m > stuck:
                for i in range(_whole(m)):
                    _slip_lane(geometry, w, i, interval)
            else:
                for i in range(m):
                    w[_DONE_FAST * STRIDE + i] = 0.0
            if fast and stuck > 0:
                # Few or many, those that stick are brought together and stepped side by side.
                n = 0
                for i in range(m):
                    if w[_V * STRIDE + i] == w[_BELT * STRIDE + i]:
                        _bring(w, i, sub, n, one_plant)
                        n += 1
                for i in range(_whole(n)):
                    _stick_lane(geometry, sub, i, interval)
                n = 0
                for i in range(m):
                    if w[_V * STRIDE + i] == w[_BELT * STRIDE + i]:
                        _give_back(sub, n, w, i, interval)
                        n += 1
            failures = 0
            n = 0
            leaving = 0
            for i in range(m):
                if not one_plant and geometries[i] != geometry:
                    failures += _lane_by_events(geometries[i], w, i, interval, NOTHING_KNOWN)
                elif w[_DONE_FAST * STRIDE + i] == 0.0:
                    if not fast:
                        failures += _lane_by_events(geometry, w, i, interval, NOTHING_KNOWN)
                    elif w[_V * STRIDE + i] == w[_BELT * STRIDE + i]:
                        leaving += 1
                    elif _wants_look(w, i, sub, n, interval, one_plant):
                        n += 1
                    else:
                        failures += _lane_after_trial(geometry, w, i, sub, 0, interval, 1.0)
            if n > 0:
                # Events in the midst of a slip step are looked at side by side as well.
                for i in range(_whole(n)):
                    _look_lane(geometry, sub, i, interval)
            onward = 0
            for j in range(n):
                i = int(sub[_L_LANE * STRIDE + j])
                if _finished(w, i, sub, j):
                    continue
                if _crosses(geometry, w, i, sub, j, onward, one_plant, interval):
                    onward += 1
                else:
                    failures += _lane_after_trial(geometry, w, i, sub, j, interval, 2.0)
            if leaving > 0:
                for i in range(m):
                    if w[_DONE_FAST * STRIDE + i] == 0.0 and w[_V * STRIDE + i] == w[_BELT * STRIDE + i]:
                        if _breaks_away(geometry, w, i, sub, onward, one_plant, interval):
                            onward += 1
                        elif w[_DONE_FAST * STRIDE + i] == 0.0:
                            failures += _lane_by_events(geometry, w, i, interval, NOTHING_KNOWN)
            if onward > 0:
                # What has left the stick surface slips over the rest of the interval side by side.
                for i in range(_whole(onward)):
                    _onward_lane(geometry, sub, i)
                for j in range(onward):
                    i = int(sub[_L_LANE * STRIDE + j])
                    if sub[_F_WAY * STRIDE + j] == _FINISHED:
                        _take(w, i, sub, j)
                        w[_V_END * STRIDE + i] = sub[_F_V_END * STRIDE + j]
                        w[_MODE * STRIDE + i] = sub[_L_MODE * STRIDE + j]
                        w[_EVENTS * STRIDE + i] = sub[_F_EVENTS * STRIDE + j]
                        w[_STATUS * STRIDE + i] = OK
                    else:
                        failures += _lane_by_events(geometry, w, i, interval, NOTHING_KNOWN)
            ended += _account(
                task, codes, state, integers, work, wanted, rewards, over, report, report_codes, first, m, failures
            )
            if plain:
                _observe_block(task, codes, w, shown, observations, first, m)
            else:
                observe(task, codes, state, integers, past, shown, observations, range(first, first + m))
        return ended

    return step_environments


_step_exact = _stepper(EXACT)
_step_cubic = _stepper(CUBIC)
_step_linear = _stepper(LINEAR)
STEPPERS = (_step_exact, _step_cubic, _step_linear)


@compiled
def step_beyond(
    work,
    start,
    end,
    task,
    codes,
    state,
    integers,
    past,
    shown,
    actions,
    wanted,
    observations,
    rewards,
    over,
    report,
    report_codes,
):
    """Do what the steppers do, for environments of any laws: one by one, as a single environment does."""
    task, codes, work = _bare(task), _bare(codes), _bare(work)
    state, integers, past, shown = _bare(state), _bare(integers), _bare(past), _bare(shown)
    actions, wanted, observations, rewards = _bare(actions), _bare(wanted), _bare(observations), _bare(rewards)
    over, report, report_codes = _bare(over), _bare(report), _bare(report_codes)
    beyond = Laws(0.0, STRIBECK, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    interval = task[T_INTERVAL]
    w = work[: _WORK_ROWS * STRIDE]
    ended = 0
    for first in range(start, end, LANES):
        m = min(LANES, end - first)
        _fill(w, task, codes, state, actions, first, m)
        failures = 0
        for i in range(m):
            j = first + i
            time = integers[I_STEPS, j] * interval
            plant = _plant_of(state, integers, j, time, beyond)
            failures += _plant_by_events(plant, w, i, interval, NOTHING_KNOWN)
        ended += _account(
            task, codes, state, integers, work, wanted, rewards, over, report, report_codes, first, m, failures
        )
        for row in range(len(wanted)):
            if wanted[row] == O_BELT or wanted[row] == O_V_REL:
                for i in range(m):
                    j = first + i
                    laws = laws_of(state, j, _episode_time(state, integers, j, interval), beyond)
                    belt, v_rel = _shown_belt(laws, w[_MODE * STRIDE + i], state[S_V, j], state[S_BELT, j])
                    report[row, j] = belt if wanted[row] == O_BELT else v_rel
        observe(task, codes, state, integers, past, shown, observations, range(first, first + m))
    return ended


@in_threads
def _step_exact_in_threads(works, bounds, ended, *arguments):
    for i in numba.prange(len(ended)):
        ended[i] = _step_exact(works[i], bounds[i], bounds[i + 1], *arguments)


@in_threads
def _step_cubic_in_threads(works, bounds, ended, *arguments):
    for i in numba.prange(len(ended)):
        ended[i] = _step_cubic(works[i], bounds[i], bounds[i + 1], *arguments)


@in_threads
def _step_linear_in_threads(works, bounds, ended, *arguments):
    for i in numba.prange(len(ended)):
        ended[i] = _step_linear(works[i], bounds[i], bounds[i + 1], *arguments)


@in_threads
def step_beyond_in_threads(works, bounds, ended, *arguments):
    for i in numba.prange(len(ended)):
        ended[i] = step_beyond(works[i], bounds[i], bounds[i + 1], *arguments)


# The same side by side: works (k, WORK_SIZE), bounds (k + 1,) and ended (k,) for k threads.
STEPPERS_IN_THREADS = (_step_exact_in_threads, _step_cubic_in_threads, _step_linear_in_threads)


CYCLE_POINTS = 64


@compiled
def cycle_points(plant, x, v, v_belt, period):
    """Return the states (CYCLE_POINTS, 2) at phases 0, 1/CYCLE_POINTS, ... of a passive motion with this state at
    phase 0: a start at any phase is then a short way. A period of 0 means a state and no more."""
    points = np.empty((CYCLE_POINTS, 2))
    for j in range(CYCLE_POINTS):
        points[j, 0] = x
        points[j, 1] = v
        if period > 0.0:
            end = advance(plant, x, v, v_belt, 0.0, 0.0, period / CYCLE_POINTS, None)
            x, v = end[0], end[1]
    return points


@compiled
def _point_before(phase):
    """Return the number of the last of CYCLE_POINTS that is not after a phase in [0, 1]."""
    return min(int(phase * CYCLE_POINTS), CYCLE_POINTS - 1)


@compiled
def cycle_state(plant, points, v_belt, period, phase):
    """Return (x, v) at a phase in [0, 1] of the motion whose :func:`cycle_points` are given."""
    j = _point_before(phase)
    x, v = points[j, 0], points[j, 1]
    duration = (phase * CYCLE_POINTS - j) * (period / CYCLE_POINTS)
    if duration > 0.0:
        end = advance(plant, x, v, v_belt, 0.0, 0.0, duration, None)
        x, v = end[0], end[1]
    return x, v


@compiled
def own_cycle_starts(state, integers, which, phases, beyond):
    """Put the environments ``which`` (k,) at ``phases`` (k,) of the cycles that a mass set down at x = 0 with the belt
    reaches, each of its own. Return (k,) flags, 1 where that is no stick-slip cycle that is found at once: those states
    are left alone."""
    left = np.zeros(len(which), dtype=np.uint8)
    exits = np.empty(SETTLING_EXITS)
    no_traps = np.empty((0, TRAP_ROW))
    for j in range(len(which)):
        i = which[j]
        speed = state[S_BELT_SPEED, i]
        plant = calm(_plant_of(state, integers, i, 0.0, beyond))
        left[j] = 1
        outcome, x, _, _ = settle(plant, speed, 0.0, speed, SETTLING_LAPS, exits, no_traps)
        if outcome != REPEATED_BREAKAWAY:
            continue
        lap = stick_slip_lap(plant, speed, x)
        if lap[0] != REPEATED_BREAKAWAY:
            continue
        # The same steps as cycle_points and cycle_state take, but only as far as needed.
        v, period = speed, lap[1]
        before = _point_before(phases[j])
        for _ in range(before):
            end = advance(plant, x, v, speed, 0.0, 0.0, period / CYCLE_POINTS, None)
            x, v = end[0], end[1]
        duration = (phases[j] * CYCLE_POINTS - before) * (period / CYCLE_POINTS)
        if duration > 0.0:
            end = advance(plant, x, v, speed, 0.0, 0.0, duration, None)
            x, v = end[0], end[1]
        state[S_X, i] = x
        state[S_V, i] = v
        left[j] = 0
    return left


@compiled
def blank_episodes(state, integers, which):
    """Set all that an episode counts and sums up to its beginning, and the belt to its nominal speed."""
    for i in which:
        for row in range(S_TRAVEL, S_FRICTION):
            state[row, i] = 0.0
        state[S_BELT, i] = state[S_BELT_SPEED, i]
        state[S_LATE_LOW, i] = math.inf
        state[S_LATE_HIGH, i] = -math.inf
        integers[I_STEPS, i] = 0
        integers[I_FIRST_STEP, i] = 0
        integers[I_SEEN, i] = 0
        integers[I_OVER, i] = RUNNING
        integers[I_STATUS, i] = OK


@compiled
def place_on_cycle(state, integers, which, points, period, slot, beyond):
    """Put the environments ``which`` (k,) at random phases (numbers of ``slot``) of the passive, unexcited motion with
    these :func:`cycle_points`."""
    for i in which:
        phase = random_uniform(int(integers[I_KEY, i]), int(integers[I_EPISODE, i]), 0, slot)
        plant = calm(_plant_of(state, integers, i, 0.0, beyond))
        state[S_X, i], state[S_V, i] = cycle_state(plant, points, state[S_BELT_SPEED, i], period, phase)


@compiled
def restart(task, codes, state, integers, past, shown, observations, which, points, period, slot, beyond):
    """Begin the next episodes of the environments ``which`` (k,), with the parameters that they have, where
    :func:`place_on_cycle` puts them; observe them."""
    for i in which:
        integers[I_EPISODE, i] += 1
    blank_episodes(state, integers, which)
    place_on_cycle(state, integers, which, points, period, slot, beyond)
    observe(task, codes, state, integers, past, shown, observations, which)


@compiled
def episode_statistics(state, integers, which, replaced, values):
    """Write what the episodes of the environments ``which`` (k,) came to into their columns of ``values`` (8, n).

    Rows: return, length, late amplitude, late stick fraction and the four reward terms. "Late" is the last quarter of
    an episode's time, NaN if it was not reached. ``replaced``: whether a function of the user's gave the rewards.
    """
    for i in which:
        vibration = state[S_VIBRATION, i]
        effort = state[S_EFFORT, i]
        stick = state[S_STICK, i]
        contact_loss = state[S_CONTACT_LOSS, i]
        late = state[S_LATE_TIME, i]
        values[0, i] = state[S_RETURN, i] if replaced else vibration + effort + stick + contact_loss
        values[1, i] = integers[I_STEPS, i] - integers[I_FIRST_STEP, i]
        values[2, i] = 0.5 * (state[S_LATE_HIGH, i] - state[S_LATE_LOW, i]) if late > 0.0 else math.nan
        values[3, i] = state[S_LATE_STICK, i] / late if late > 0.0 else math.nan
        values[4, i] = vibration
        values[5, i] = effort
        values[6, i] = stick
        values[7, i] = contact_loss


@compiled
def left_alone(plant, x, v, v_belt):
    """Return the mode, the belt's speed, the velocity relative to it and the normal force of a mass left alone."""
    mode = mode_of(plant, x, v, v_belt, 0.0, 0.0)
    speed, v_rel = _shown_belt(plant.laws, mode, v, v_belt)
    return mode, speed, v_rel, spring(plant, x)[1]


@compiled
def contact(state, integers, which, modes, v_belts, v_rels, normal_forces, beyond):
    """Write the mode, the belt's speed, the velocity relative to it and the normal force of the environments ``which``
    (k,), which have just been reset, (k,) each."""
    for j in range(len(which)):
        i = which[j]
        plant = _plant_of(state, integers, i, 0.0, beyond)
        modes[j], v_belts[j], v_rels[j], normal_forces[j] = left_alone(
            plant, state[S_X, i], state[S_V, i], state[S_BELT, i]
        )


# Forced dynamics ----------------------------------------------------------------------------------------------------
#
# Motions of a steady belt under excitation alone, their stroboscopic maps and their tangent flow. `advance` follows the
# motion and lists its events; the legs between them are gone through again for the tangents, so that the automaton
# stands in one place. Tangents (dx, dv) compare states at one time, so that the ripple's frame and the room have the
# same ones.

TANGENT_STEP = 0.1  # of the shortest time in which the linearised motion changes
TANGENT_BEND = 1e-4  # by so much a step's coefficients may depart from straight lines, times its length
TANGENT_SMALLEST_STEP = 1e-9
MOST_CALLS = 256  # of advance in one walk, each of MAX_EVENTS events
SECTION_TIME = 1e-8  # an event due within this time after a section is of the cycle that ends there

# What `stroboscope` writes of a cycle.
(R_X, R_V, R_MODE, R_STICK_TIME, R_STICKS, R_FORWARD_ARCS, R_X_MIN, R_X_MAX), CYCLE_ROW = range(8), 8


@compiled
def _linearised(plant, mode, x, v, v_belt):
    """Return the stiffness and the damping of small deviations in slip: dv' = -stiffness dx - damping dv."""
    place = room_x(plant, x)
    v_rel = v - v_belt
    restoring_slope, normal_slope = spring_slopes(plant, place)
    stiffness = restoring_slope + friction_coefficient(plant, mode, v_rel) * normal_slope
    return stiffness, 2.0 * plant.beta + spring(plant, place)[1] * friction_slope(plant, mode, v_rel)


@compiled
def _tangent_step(h, k_0, c_0, k_1, c_1, k_2, c_2, dx, dv):
    """Take a classical Runge-Kutta step of a deviation; stiffness and damping are given at 0, h/2 and h."""
    p1, q1 = dv, -k_0 * dx - c_0 * dv
    p2 = dv + 0.5 * h * q1
    q2 = -k_1 * (dx + 0.5 * h * p1) - c_1 * p2
    p3 = dv + 0.5 * h * q2
    q3 = -k_1 * (dx + 0.5 * h * p2) - c_1 * p3
    p4 = dv + h * q3
    q4 = -k_2 * (dx + h * p3) - c_2 * p4
    return dx + h / 6.0 * (p1 + 2.0 * p2 + 2.0 * p3 + p4), dv + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)


@compiled
def _carry_in_slip(plant, mode, x, v, v_belt, duration, vectors):
    """Carry tangents (n, 2) along a slip of this length, in which nothing happens."""
    plant = _faced_in_slip(plant, plant.laws, mode, x, v, v_belt, 0.0)
    t = 0.0
    h = duration
    while t < duration:
        remaining = duration - t
        now = later(plant, t)
        k_0, c_0 = _linearised(now, mode, x, v, v_belt)
        h = min(h, remaining, TANGENT_STEP / max(1.0, math.sqrt(abs(k_0)), abs(c_0)))
        x_1, v_1, _, _, _, _, _ = slip_step(now, mode, x, v, v_belt, 0.0, 0.0, 0.5 * h)
        middle = later(now, 0.5 * h)
        k_1, c_1 = _linearised(middle, mode, x_1, v_1, v_belt)
        x_2, v_2, _, _, _, _, _ = slip_step(middle, mode, x_1, v_1, v_belt, 0.0, 0.0, 0.5 * h)
        k_2, c_2 = _linearised(later(now, h), mode, x_2, v_2, v_belt)
        bend = h * (abs(k_0 - 2.0 * k_1 + k_2) + abs(c_0 - 2.0 * c_1 + c_2))
        if bend > TANGENT_BEND and h > TANGENT_SMALLEST_STEP:
            h = 0.5 * h
            continue
        for i in range(len(vectors)):
            vectors[i, 0], vectors[i, 1] = _tangent_step(h, k_0, c_0, k_1, c_1, k_2, c_2, vectors[i, 0], vectors[i, 1])
        x = x_2
        v = v_2
        t = duration if h == remaining else t + h
        if bend < 0.1 * TANGENT_BEND:
            h = 2.0 * h


@compiled
def _mode_after(plant, mode, kind, x, v_belt):
    """Return the mode in which an event at x leaves a mass."""
    if kind == RESTICK:
        return STICK
    if kind == CROSSING:
        return -mode
    if kind == BREAKAWAY:
        return _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
    if kind == SWITCHING and mode == STICK:
        return mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
    return mode


@compiled
def _acceleration(plant, mode, x, v, v_belt):
    """Return the acceleration in any mode of a mass that has just entered it."""
    if mode == STICK:
        return 0.0
    plant = _faced_in_slip(plant, plant.laws, mode, x, v, v_belt, 0.0)
    return slip_forces(plant, mode, x, v, v_belt, 0.0)[0]


@compiled
def _acceleration_before_switch(plant, laws, mode, x, v, v_belt):
    if laws is None:
        return 0.0
    if mode == STICK:
        return 0.0
    before = _with_laws(plant, laws, -1.0 if room_v(plant, v) > 0.0 else 1.0, laws.time)
    return slip_forces(before, mode, x, v, v_belt, 0.0)[0]


@compiled
def saltation(plant, mode, after, kind, x, v, v_belt):
    """Return what an event does to tangents, dv+ = of_x dx + of_v dv (dx stays, for v is continuous): of_x, of_v, and
    whether the derivative does not exist there (the event is touched, not passed).

    With f = (v, a) before and after and the event at h(x, v, t) = 0 it is 1 + (f+ - f-) grad h / (dh/dt along f-);
    Leine and Nijmeijer: Dynamics and Bifurcations of Non-Smooth Mechanical Systems (2004), ch. 7.
    """
    if kind == RESTICK:
        return 0.0, 0.0, False
    if kind == CROSSING:
        a = _acceleration(plant, mode, x, v, v_belt)
        if a == 0.0:
            return 0.0, 1.0, True
        return 0.0, _acceleration(plant, after, x, v, v_belt) / a, False
    if kind == BREAKAWAY:
        side = -after
        _, slope = _cone_excess(plant, side, x, v_belt, 0.0, 0.0, 0.0)
        if not slope > 0.0:
            return 0.0, 0.0, True
        restoring_slope, normal_slope = spring_slopes(plant, room_x(plant, x))
        of_x = (side * restoring_slope - plant.mu_s * normal_slope) / slope
        return of_x * _acceleration(plant, after, x, v, v_belt), 0.0, False
    if kind == SWITCHING:
        w = room_v(plant, v)
        if w == 0.0:
            return 0.0, 1.0, True
        jump = _acceleration(plant, after, x, v, v_belt)
        jump = jump - _acceleration_before_switch(plant, plant.laws, mode, x, v, v_belt)
        return jump / w, 1.0, False
    return 0.0, 1.0, kind == GRAZING


@compiled
def _side_of(plant, x, v):
    """Return the side of x = 0 on which a mass is, or, from a section on it, to which it moves."""
    place = room_x(plant, x)
    w = room_v(plant, v)
    ahead = w if abs(place) <= SECTION_TIME * abs(w) else place
    return 1.0 if ahead > 0.0 else -1.0


@compiled
def _event_due(plant, mode, side, x, v, v_belt):
    """Return the kind of event that a motion in this mode, on this side of x = 0, meets within SECTION_TIME, or
    NO_EVENT."""
    w = room_v(plant, v)
    if plant.geometry == DISCONTINUOUS and side * w < 0.0 and side * room_x(plant, x) <= SECTION_TIME * abs(w):
        return SWITCHING
    if mode == STICK:
        for cone_side in (-1, 1):
            excess, slope = _cone_excess(plant, cone_side, x, v_belt, 0.0, 0.0, 0.0)
            if slope > 0.0 and excess >= -SECTION_TIME * slope:
                return BREAKAWAY
        return NO_EVENT
    a = mode * _acceleration(plant, mode, x, v, v_belt)
    if a < 0.0 and mode * (v - v_belt) <= -SECTION_TIME * a:
        landed = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
        return RESTICK if landed == STICK else (GRAZING if landed == mode else CROSSING)
    return NO_EVENT


@compiled
def _pass_event(plant, mode, after, kind, x, v, v_belt, vectors):
    """Carry tangents (n, 2) through an event. Return 1 or 0 each: for a stick and a forward arc that begins, and for
    an event without a derivative."""
    of_x, of_v, touched = saltation(plant, mode, after, kind, x, v, v_belt)
    for i in range(len(vectors)):
        vectors[i, 1] = of_x * vectors[i, 0] + of_v * vectors[i, 1]
    arcs = 1 if after == SLIP_FORWARD and mode != SLIP_FORWARD else 0
    return 1 if kind == RESTICK else 0, arcs, 1 if touched else 0


@compiled
def walk(plant, x, v, v_belt, duration, events, vectors, in_sections=True):
    """Follow a motion under excitation alone and carry tangents (n, 2) along it, if there are any.

    ``in_sections``: an event on the section at either end, or due just after it, belongs to the motion that ends there:
    its saltation is applied at the end, and not once more at the beginning of the motion that goes on from it. Without
    it the tangents are the derivative of the end by the start.
    ``events`` (MAX_EVENTS, 4) is scratch space. Return x, v, the mode, the status, the time reached, the time stuck,
    the sticks and the forward-slip arcs that began, the least and greatest x, whether it ever stuck (the tangents then
    have one direction left) and the number of events without a derivative.
    """
    t = 0.0
    stick_time = 0.0
    sticks = 0
    forward_arcs = 0
    singular = 0
    x_min = x
    x_max = x
    ever_stuck = False
    x_leg, v_leg = _into_frame(plant.laws, x, v, v_belt)
    mode = _mode_of(plant, x_leg, v_leg, v_belt, 0.0, 0.0)
    side = _side_of(plant, x_leg, v_leg)
    due = NO_EVENT
    if in_sections:
        due = _event_due(plant, mode, 1.0 if room_x(plant, x_leg) > 0.0 else -1.0, x_leg, v_leg, v_belt)
    status = EVENT_LIMIT
    for _ in range(MOST_CALLS):
        now = later(plant, t)
        x_end, v_end, _, mode_end, status, dt, n_events, _, stuck, _, low, high = advance(
            now, x, v, v_belt, 0.0, 0.0, duration - t, events
        )
        x_leg, v_leg = _into_frame(now.laws, x, v, v_belt)
        mode = _mode_of(now, x_leg, v_leg, v_belt, 0.0, 0.0)
        begin = 0.0
        for n in range(n_events + 1):
            end = events[n, 0] if n < n_events else dt
            if mode == STICK:
                ever_stuck = True
                for i in range(len(vectors) if due != BREAKAWAY else 0):
                    vectors[i, 1] = 0.0
            elif len(vectors) > 0:
                _carry_in_slip(later(now, begin), mode, x_leg, v_leg, v_belt, end - begin, vectors)
            if n == n_events:
                break
            then = later(now, end)
            kind = int(events[n, 1])
            x_leg, v_leg = _into_frame(then.laws, events[n, 2], events[n, 3], v_belt)
            after = _mode_after(then, mode, kind, x_leg, v_belt)
            if kind == due and t + end <= 2.0 * SECTION_TIME:
                due = NO_EVENT
            else:
                begun, arcs, touched = _pass_event(then, mode, after, kind, x_leg, v_leg, v_belt, vectors)
                sticks += begun
                forward_arcs += arcs
                singular += touched
            if kind == SWITCHING:
                side = 1.0 if room_v(then, v_leg) > 0.0 else -1.0
            mode = after
            begin = end
        if status == OK and in_sections:
            then = later(now, dt)
            x_leg, v_leg = _into_frame(then.laws, x_end, v_end, v_belt)
            kind = _event_due(then, mode, side, x_leg, v_leg, v_belt)
            if kind != NO_EVENT:
                x_leg = _at_zero(then.laws, x_leg) if kind == SWITCHING else x_leg
                after = _mode_after(then, mode, kind, x_leg, v_belt)
                begun, arcs, touched = _pass_event(then, mode, after, kind, x_leg, v_leg, v_belt, vectors)
                sticks += begun
                forward_arcs += arcs
                singular += touched
                ever_stuck = ever_stuck or kind == RESTICK
        x = x_end
        v = v_end
        mode = mode_end
        stick_time += stuck
        x_min = min(x_min, low)
        x_max = max(x_max, high)
        t = duration if status == OK else t + dt
        if status != EVENT_LIMIT:
            break
    return x, v, mode, status, t, stick_time, sticks, forward_arcs, x_min, x_max, ever_stuck, singular


@compiled
def _renormalise(vectors, stuck):
    """Make two tangents orthonormal; return the logarithms of the length and of the height that they had."""
    dx, dv = vectors[0, 0], vectors[0, 1]
    size = math.sqrt(dx * dx + dv * dv)
    if size == 0.0:
        vectors[0, 0], vectors[0, 1], vectors[1, 0], vectors[1, 1] = 1.0, 0.0, 0.0, 1.0
        return -math.inf, -math.inf
    dx = dx / size
    dv = dv / size
    height = abs(dx * vectors[1, 1] - dv * vectors[1, 0])
    vectors[0, 0], vectors[0, 1], vectors[1, 0], vectors[1, 1] = dx, dv, -dv, dx
    return math.log(size), -math.inf if stuck or height == 0.0 else math.log(height)


@compiled
def stroboscope(plant, x, v, v_belt, period, skipped, rows, growth):
    """Follow a motion over ``skipped`` cycles of the excitation, then over as many as ``rows`` (n, CYCLE_ROW) has,
    written down one each: the state and the mode at its end, and the time stuck, the sticks and the forward-slip arcs
    that began, and the least and greatest x in it.

    ``growth`` (n, 2) takes the logarithms by which two tangents, made orthonormal after each cycle, grow; without rows
    there are no tangents.
    Return x, v, the status, how many rows were written and the number of events without a derivative.
    """
    events = np.empty((MAX_EVENTS, 4))
    vectors = np.zeros((2 if len(growth) > 0 else 0, 2))
    for i in range(len(vectors)):
        vectors[i, i] = 1.0
    singular = 0
    status = OK
    for n in range(skipped + len(rows)):
        now = later(plant, n * period)
        x, v, mode, status, _, stick_time, sticks, forward_arcs, x_min, x_max, stuck, touched = walk(
            now, x, v, v_belt, period, events, vectors
        )
        if status != OK:
            return x, v, status, max(n - skipped, 0), singular
        first, second = 0.0, 0.0
        if len(vectors) > 0:
            first, second = _renormalise(vectors, stuck)
        i = n - skipped
        if i < 0:
            continue
        singular += touched
        rows[i, R_X] = x
        rows[i, R_V] = v
        rows[i, R_MODE] = mode
        rows[i, R_STICK_TIME] = stick_time
        rows[i, R_STICKS] = sticks
        rows[i, R_FORWARD_ARCS] = forward_arcs
        rows[i, R_X_MIN] = x_min
        rows[i, R_X_MAX] = x_max
        if len(growth) > 0:
            growth[i, 0] = first
            growth[i, 1] = second
    return x, v, status, len(rows), singular


@compiled
def reach(plant, xs, vs, v_belt, period, cycles, points, point_labels, tolerance, labels):
    """Follow each start (xs, vs) of shape (n,) until, at the end of a cycle, it is within ``tolerance`` of one of the
    ``points`` (m, 2), and write the label of that, -1 if it lost contact and -2 if ``cycles`` did not do. The starts
    are moved to where they were followed to."""
    events = np.empty((MAX_EVENTS, 4))
    none = np.empty((0, 2))
    for i in range(len(xs)):
        labels[i] = -2
        x = xs[i]
        v = vs[i]
        for n in range(cycles):
            out = walk(later(plant, n * period), x, v, v_belt, period, events, none)
            x = out[0]
            v = out[1]
            if out[3] != OK:
                labels[i] = -1 if out[3] == CONTACT_LOST else -2
                break
            for j in range(len(points)):
                if abs(x - points[j, 0]) <= tolerance and abs(v - points[j, 1]) <= tolerance:
                    labels[i] = point_labels[j]
                    break
            if labels[i] != -2:
                break
        xs[i] = x
        vs[i] = v


@compiled
def maxima(plant, x, v, v_belt, places, traps):
    """Follow a motion without excitation and write its maxima of x into ``places`` (n,); one that comes to rest on the
    belt, or in slip where one of the ``traps`` (m, TRAP_ROW) holds it, fills what is left with its place. Return the
    status and how many were written."""
    mode = mode_of(plant, x, v, v_belt, 0.0, 0.0)
    if spring(plant, x)[1] <= 0.0:
        return CONTACT_LOST, 0
    n = 0
    for _ in range(100 * len(places)):
        if n == len(places):
            return OK, n
        if mode == STICK:
            dt, event = ride_across(plant, x, v_belt, STICK_PATIENCE)
            rests = event == NO_EVENT
            x = x if rests else x + v_belt * dt
            v = v_belt
            mode = STICK if rests else _breakaway_mode(plant, x, v_belt, 0.0, 0.0)
        else:
            _, x, v, event, trap, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
            rests = trap >= 0
            x = traps[trap, TRAP_X] if rests else x
            if event == LANDING:
                mode = mode_at_zero_v_rel(plant, x, v_belt, 0.0, 0.0)
            elif event == TURNING:
                if slip_forces(plant, mode, x, 0.0, v_belt, 0.0)[0] < 0.0:
                    places[n] = x
                    n += 1
            elif not rests:
                return CONTACT_LOST if event == CONTACT_LOSS else STEP_LIMIT, n
        if rests:
            places[n:] = x
            return OK, len(places)
    return EVENT_LIMIT, n
