"""Equilibria, limit cycles and critical belt speeds of the passive oscillator, found as roots and closed loops.

A trajectory that sticks forgets its past, so a stick-slip cycle closes as soon as a breakaway point repeats. A
pure-slip cycle is a fixed point of the map from one maximum of x to the next. Neither needs a long transient, which
matters near the end of oscillation, where transients decay ever more slowly.
"""

import bisect
import cmath
import contextlib
import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.parameters import EXCITATIONS, RANGES, STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.physics.simulation import amplitude
from sd_friction_env.physics.theory import FloatArray, cubic_wells, exact_wells

Kind = Literal["stick-slip", "pure-slip", "steady-slip", "neutral", "rest"]

_LONG_SETTLING_LAPS = 800
_STILL_SHARE = 0.01
_SMALLEST_RADIUS = 1e-7  # orbits smaller than this about an equilibrium are called the equilibrium
_FINEST_RATIO = 1.15  # of neighbouring radii at which a return map is sampled
_SAMPLES_OF_A_GAP = (15, 7)
_LAP_ERROR = 1e-13  # of a return map, relative to max(1, |x|): what is less is rounding
_STEP_ERROR = 1e-9  # promised of the steps, per unit of time
_LARGEST_DOUBTED = 1e-5  # radius up to which that error may hide what a lap does
_LARGEST_SMALL = 1e-2  # radius about an equilibrium up to which its Hopf normal form holds
_MOST_SETTLINGS, _MOST_LAPS = 200, 2000
_FRICTION_SPEEDS = np.geomspace(1e-6, 100.0, 200).tolist()  # at which it is seen whether friction falls
_LEAST_WIDTH = 0.1  # over which a law changes that names no width
_OWN_SPRING_REACH = 10.0  # |x| up to which balance points of a spring of one's own are looked for
_LEVEL, _LEVEL_STEP = 1e-9, 1e-4  # where a spring's stiffness is less, the force this far away says more
_BELT_SPEED_ERROR = 1e-11  # v_b0 is given this much too low: on the very graze rounding decides whether a cycle sticks


class OrbitError(ValueError):
    """The passive motion has no attractor that can be named: it loses contact, or does not settle."""


class ContactLossError(OrbitError):
    """The motion loses contact with the belt (N <= 0)."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """A steady-slip equilibrium: the mass stands still, the belt slides under it (Eq. 11).

    Attributes:
        x: where the mass stands.
        eigenvalues: those of the linearised slip motion.
        stable: whether both have negative real parts.
    """

    x: float
    eigenvalues: tuple[complex, complex]
    stable: bool

    @property
    def stiffness(self) -> float:
        """Of small deviations, the product of the eigenvalues."""
        return (self.eigenvalues[0] * self.eigenvalues[1]).real

    @property
    def damping(self) -> float:
        """Of small deviations, minus the sum of the eigenvalues."""
        return -(self.eigenvalues[0] + self.eigenvalues[1]).real

    @property
    def weak(self) -> bool:
        """Whether damping is lost in rounding, so that it decides nothing."""
        return abs(self.damping) <= 1e-13 * max(abs(value) for value in self.eigenvalues)


@dataclass(frozen=True, kw_only=True)
class LimitCycle:
    """An attractor of the passive oscillator (dimensionless; a steady state has amplitude 0 and no period).

    Attributes:
        kind: "stick-slip", "pure-slip", "steady-slip" (the mass stands on the sliding belt), "rest" (belt speed 0) or
            "neutral": one of a family of closed orbits, none of which attracts, for slip neither loses nor gains
            energy there (beta = 0 and level friction). :func:`limit_cycle` gives the start's own orbit,
            :func:`attractors` one entry for each family, its outermost orbit.
        amplitude: (x_max - x_min)/2.
        period, frequency, angular_frequency: T, 1/T and 2 pi/T; NaN for a steady state.
        stick_fraction: share of the period spent stuck.
        x_max, x_min: extremes of x.
        mean_square_velocity: mean of x'^2 over a period.
        x_phase0, v_phase0: the state counted as phase 0: breakaway in stick-slip, the maximum of x in pure slip.
        x_breakaway, x_restick: where stick ends and where it last began; NaN without stick.
        sticks, forward_arcs: how many sticks and forward-slip arcs one period has.
        floquet_multiplier: 0 for stick-slip (superstable), the return map's slope for pure slip, 1 for a neutral
            orbit, NaN otherwise.
        x_start, v_start: the start whose attractor this is.
        parameters: of the oscillator.
    """

    kind: Kind
    amplitude: float
    period: float
    frequency: float
    angular_frequency: float
    stick_fraction: float
    x_max: float
    x_min: float
    mean_square_velocity: float
    x_phase0: float
    v_phase0: float
    x_breakaway: float
    x_restick: float
    sticks: int
    forward_arcs: int
    floquet_multiplier: float
    x_start: float
    v_start: float
    parameters: OscillatorParameters

    def state(self, phase: float) -> tuple[float, float]:
        """Return (x, v) at ``phase`` in [0, 1) of the period, counted from ``x_phase0``; a steady state has but one."""
        phase = checked_number("phase", phase, 0.0, 1.0)
        if not self.period > 0.0:
            return self.x_phase0, self.v_phase0
        p = self.parameters
        state: tuple[float, float] = kernel.cycle_state(p.plant, self.points, p.belt_speed, self.period, phase)
        return state

    @functools.cached_property
    def points(self) -> FloatArray:
        """States (x, v) at evenly spaced phases from 0 on, (64, 2); a steady state has but one."""
        p, period = self.parameters, self.period if self.period > 0.0 else 0.0
        points: FloatArray = kernel.cycle_points(p.plant, self.x_phase0, self.v_phase0, p.belt_speed, period)
        return points


class CriticalBeltSpeeds(NamedTuple("_CriticalBeltSpeeds", [("v_b0", float), ("v_b1", float)])):
    """The pair (v_b0, v_b1), with ``reason`` saying why where a value is NaN (empty otherwise)."""

    reason: str

    def __new__(cls, v_b0: float, v_b1: float, reason: str = "") -> Self:
        pair = super().__new__(cls, v_b0, v_b1)
        pair.reason = reason
        return pair


def balance_points(parameters: OscillatorParameters, load: float, coefficient: float) -> list[float]:
    """Return every x with load + R(x) = coefficient N(x), in ascending order.

    With load 0 and the kinetic coefficient these are the steady-slip equilibria (Eq. 11); with load 2 beta v_b and
    +-mu_s they are the ends of the stick intervals (Eq. 8, corrected).
    """
    alpha, g1 = parameters.alpha, parameters.g1
    if parameters.geometry == "linear":
        return [coefficient * g1 - load]
    if parameters.discontinuous:
        # Where the jump of R at x = 0 passes the balance there is no place to stand on: see `stick_intervals` for that.
        push = coefficient * g1 - load
        return sorted(push + side for side in (-1.0, 1.0) if (push + side) * side > 0.0)
    if parameters.geometry == "duffing":
        polynomial = [parameters.kappa, 0.0, parameters.linear_stiffness, load - coefficient * g1]
    elif parameters.geometry == "cubic":
        square = alpha * alpha
        polynomial = [
            0.5 / (square * alpha),
            0.5 * coefficient / square,
            1.0 - 1.0 / alpha,
            load - coefficient * (g1 - alpha + 1.0),
        ]
    elif parameters.geometry != "exact":
        return _balance_points_of_own_spring(parameters.plant, load, coefficient)
    else:
        # (x - c) s = x + d with s = sqrt(x^2 + alpha^2); squared, a quartic with foreign roots among its own
        c, d, square = coefficient * (g1 - alpha) - load, coefficient * alpha, alpha * alpha
        polynomial = [1.0, -2.0 * c, c * c + square - 1.0, -2.0 * (c * square + d), c * c * square - d * d]
    spring = parameters.plant.spring
    points: list[float] = []
    for root in np.roots(polynomial).tolist():
        if abs(root.imag) > 1e-6 * max(1.0, abs(root.real)):
            continue
        x = root.real
        for _ in range(8):
            restoring, normal = spring.restoring_force(x), spring.normal_force(g1, x)
            error = load + restoring - coefficient * normal
            slope = spring.restoring_slope(x) - coefficient * spring.normal_slope(x)
            if slope == 0.0:
                break
            x -= error / slope
            if abs(error / slope) < 1e-15 * max(1.0, abs(x)):
                break
        # Squaring and a wandering Newton iteration can both bring in roots that are none, or one twice.
        size = 1.0 + abs(load) + abs(restoring) + abs(coefficient * normal)
        near = abs(x - root.real) < 1e-3 * max(1.0, abs(x))
        if abs(error) < 1e-9 * size and near and all(abs(x - other) > 1e-9 for other in points):
            points.append(x)
    return sorted(points)


def _balance_points_of_own_spring(plant: kernel.Plant, load: float, coefficient: float) -> list[float]:
    """Return the roots within ``_OWN_SPRING_REACH``, on an even grid: two that are closer than its step are missed."""

    def error(x: float) -> float:
        return float(load + plant.spring.restoring_force(x) - coefficient * plant.spring.normal_force(plant.g1, x))

    places = np.linspace(-_OWN_SPRING_REACH, _OWN_SPRING_REACH, 4001).tolist()
    values = [error(x) for x in places]
    points = [x for x, value in zip(places, values, strict=True) if value == 0.0]
    for (low, high), (first, last) in zip(itertools.pairwise(places), itertools.pairwise(values), strict=True):
        if first * last < 0.0:
            points.append(root(error, low, high))
    return sorted(points)


def rest_place(parameters: OscillatorParameters) -> float:
    """Return where the unloaded spring has its (right-hand) place of rest, R(x) = 0 with R'(x) > 0."""
    if parameters.geometry not in ("exact", "cubic", "linear"):
        spring = parameters.plant.spring
        return max((x for x in balance_points(parameters, 0.0, 0.0) if spring.restoring_slope(x) > 0.0), default=0.0)
    wells = {"exact": exact_wells, "cubic": cubic_wells}.get(parameters.geometry)  # alpha = 0 has its own at 1
    return wells(parameters.alpha)[-1] if wells else 0.0


def equilibria(parameters: OscillatorParameters) -> list[Equilibrium]:
    """Return the steady-slip equilibria (v_rel = -v_b), in ascending order of x, with contact and belt moving.

    Source: Eq. 11 for the cubic geometry; the same balance of forces for the others.
    """
    _check_unexcited(parameters)
    speed = parameters.belt_speed
    if speed == 0.0:
        return []
    plant = parameters.plant
    coefficient = -float(plant.friction.coefficient(kernel.SLIP_BACKWARD, -speed))
    slope = float(plant.friction.slope(kernel.SLIP_BACKWARD, -speed))
    found = []
    for x in balance_points(parameters, 0.0, coefficient):
        normal = kernel.normal_force(plant, x)
        if normal <= 0.0:
            continue
        stiffness = plant.spring.restoring_slope(x) - coefficient * plant.spring.normal_slope(x)
        damping = 2.0 * parameters.beta + normal * slope
        root = cmath.sqrt(damping * damping - 4.0 * stiffness)
        pair = (0.5 * (-damping + root), 0.5 * (-damping - root))
        found.append(Equilibrium(x=x, eigenvalues=pair, stable=damping > 0.0 and stiffness > 0.0))
    return found


def _check_unexcited(parameters: OscillatorParameters) -> None:
    if parameters.excited:
        amplitudes = {f"{kind}_amplitude": getattr(parameters, f"{kind}_amplitude") for kind in EXCITATIONS}
        acting = ", ".join(f"{name} = {value!r}" for name, value in amplitudes.items() if value > 0.0)
        raise ValueError(
            f"parameters must be without excitation here (all amplitudes 0), got {acting}: "
            "see sd_friction_env.physics.forced, or take parameters.unexcited"
        )


def conserves_energy(parameters: OscillatorParameters) -> bool:
    """Whether slip on one side of the belt's speed neither loses nor gains energy: beta = 0 and level friction."""
    return parameters.beta == 0.0 and _friction_is_level(parameters)


def _friction_slopes(parameters: OscillatorParameters) -> list[float]:
    friction = parameters.plant.friction
    return [friction.slope(mode, mode * speed) for mode in (-1, 1) for speed in _FRICTION_SPEEDS]


def _friction_is_level(parameters: OscillatorParameters) -> bool:
    """Whether friction in slip does not change with speed."""
    return all(slope == 0.0 for slope in _friction_slopes(parameters))


def _slip_dissipates(parameters: OscillatorParameters) -> bool:
    """Whether every slip contracts: damping, and friction that nowhere falls with speed. Then no slip is a cycle."""
    return all(slope >= 0.0 for slope in _friction_slopes(parameters)) and not conserves_energy(parameters)


@functools.lru_cache(maxsize=256)
def traps_of(parameters: OscillatorParameters) -> FloatArray:
    """Return a row for each equilibrium that attracts: which states are sure to end there, as ``kernel.trap_of`` reads.

    A node is crept into without a maximum of x, so that the return map has nothing to say of it; a line in its phase
    plane hems it in. Where slip conserves energy, the trap of a centre is only the ball that counts as it.
    """
    plant, rows = parameters.plant, []
    for e in equilibria(parameters):
        centre = is_centre(parameters, e)
        stable = centre and e.damping > 0.0 and not e.weak
        if not stable and not (centre and conserves_energy(parameters)):
            continue
        ball, level = ball_of(e), e.stiffness <= _LEVEL
        rows.append((e.x, ball, 0.0, 0.0, 0.0))
        if stable and e.eigenvalues[0].imag == 0.0:
            # Of all lines the first asks for the least damping far out, the second lets the spring grow stiffest.
            for slope in (math.sqrt(max(e.stiffness, 0.0)), 0.5 * e.damping)[level:]:
                nearest, farthest = _LEVEL_STEP if level else 0.1 * ball, 2.0 * reach_of(parameters, e)
                extents = (
                    kernel.trap_extent(plant, parameters.belt_speed, e.x, slope, side, nearest, farthest)
                    for side in (-1.0, 1.0)
                )
                rows.append((e.x, ball, slope, *extents))
    return np.array(rows, dtype=np.float64).reshape(len(rows), kernel.TRAP_ROW)


def ball_of(equilibrium: Equilibrium) -> float:
    """Return how small orbits about an equilibrium are that are called the equilibrium."""
    return _SMALLEST_RADIUS * max(1.0, abs(equilibrium.x))


def reach_of(parameters: OscillatorParameters, equilibrium: Equilibrium) -> float:
    """Return a distance from an equilibrium beyond all that starts in range can reach in slip."""
    return 4.0 * (2.0 * STATE_LIMIT + abs(equilibrium.x) + parameters.belt_speed)


def is_centre(parameters: OscillatorParameters, equilibrium: Equilibrium) -> bool:
    """Whether forces lead back to an equilibrium from both sides, so that slip can turn about it or creep into it."""
    if abs(equilibrium.stiffness) > _LEVEL:
        return equilibrium.stiffness > 0.0
    plant, belt, x = parameters.plant, parameters.belt_speed, equilibrium.x
    left, right = (
        kernel.slip_acceleration(
            plant, kernel.SLIP_BACKWARD, kernel.State(x + side * _LEVEL_STEP, 0.0), kernel.Drive(belt, 0.0, 0.0)
        )
        for side in (-1, 1)
    )
    return bool(left > 0.0 > right)


def limit_cycle(parameters: OscillatorParameters, x: float = 0.0, v: float | None = None) -> LimitCycle:
    """Return the attractor that the passive oscillator reaches from (x, v), or the neutral orbit that it is on.

    Args:
        parameters: of the oscillator.
        x, v: the start, in [-10, 10]; without them a mass set down at x = 0 moving with the belt.

    Raises:
        ContactLossError: an OrbitError, if the motion loses contact (N <= 0).
        OrbitError: if it does not settle.
        TypeError, ValueError: if x or v is not a number in its range, or the oscillator is excited.
    """
    _check_unexcited(parameters)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    v = parameters.belt_speed if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    return limit_of_motion(parameters, x, v)


def limit_of_motion(parameters: OscillatorParameters, x: float, v: float) -> LimitCycle:
    """Return what :func:`limit_cycle` does, from any state."""
    at_x, at_v = x, v
    laps = kernel.SETTLING_LAPS
    conserved, traps = conserves_energy(parameters), traps_of(parameters)
    for _ in range(_MOST_SETTLINGS):
        outcome, place, previous, lowest = kernel.iterate_to_attractor(
            parameters.plant, parameters.belt_speed, at_x, at_v, laps, np.empty(kernel.SETTLING_EXITS), traps
        )
        if outcome == kernel.REPEATED_BREAKAWAY:
            return _stick_slip(parameters, place, x, v)
        if outcome == kernel.AT_REST:
            return _steady(parameters, "rest", place, x, v)
        if outcome == kernel.ORBIT_LOST_CONTACT:
            raise ContactLossError(f"the mass loses contact with the belt at x = {place:.6g} (N <= 0); {parameters}")
        if outcome == kernel.AT_EQUILIBRIUM:
            return _steady(parameters, "neutral" if conserved else "steady-slip", place, x, v)
        if outcome == kernel.ORBIT_UNDECIDED:
            break
        if _is_neutral(parameters, place):
            return _pure_slip(parameters, place, x, v, "neutral")
        around = [e for e in equilibria(parameters) if lowest <= e.x <= place]
        repeats = abs(place - previous) < kernel.TIME_ZERO and place - lowest > _SMALLEST_RADIUS
        if repeats and not (around and _drifts_past(parameters, place, around[-1])):
            return _pure_slip(parameters, place, x, v)
        if not around:
            at_x, at_v, laps = place, 0.0, _LONG_SETTLING_LAPS
            if abs(place - previous) < _SMALLEST_RADIUS:
                return _steady(parameters, "steady-slip", place, x, v)
            continue
        verdict, place = _limit_of_slip(parameters, previous, around)
        if verdict == "pure-slip":
            return _pure_slip(parameters, place, x, v)
        if verdict == "steady-slip":
            return _steady(parameters, "steady-slip", place, x, v)
        at_x, at_v = place, 0.0
    raise OrbitError(f"the motion from x = {x!r}, v = {v!r} does not settle; {parameters}")


def _is_frictionless(parameters: OscillatorParameters) -> bool:
    """Whether level friction is none at all, so that a lap on both sides of the belt's speed loses nothing either."""
    return bool(parameters.plant.friction.coefficient(kernel.SLIP_BACKWARD, -parameters.belt_speed) == 0.0)


def _is_neutral(parameters: OscillatorParameters, x_max: float) -> bool:
    """Whether a maximum of x is of a neutral orbit."""
    if not (conserves_energy(parameters) or any(e.weak for e in equilibria(parameters))):
        return False
    left = [(centre, limits) for centre, limits in limits_of_slip(parameters) if centre < x_max]
    for limit in left[-1][1] if left else ():
        if x_max - left[-1][0] < limit.radius:
            return limit.cycle is not None and limit.cycle.kind == "neutral"
    return False


def root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function changes sign between two arguments (Brent's method)."""
    from scipy.optimize import brentq  # not at the top: environments start without it

    return float(brentq(function, low, high, xtol=1e-15, rtol=1e-14))


class _NoLapError(Exception):
    """An orbit of this radius has no lap; the return map is not defined there."""

    def __init__(self, radius: float) -> None:
        super().__init__(radius)
        self.radius = radius


LapKind = tuple[int, int]  # how many equilibria are left of the orbit, and how many forward arcs it has


@dataclass(frozen=True, kw_only=True)
class LapRange:
    """Radii between which the return map is continuous.

    Attributes:
        ends: the first radius and the last; the first is 0 where the range begins at the equilibrium.
        after: the radii of the maxima that follow on these.
        cycles: its fixed points between, ascending.
        tendencies: of the maxima between one of these radii and the next: 1 outwards, -1 inwards, 0 not resolved.
        kind: of its laps.
        neutral: whether every lap closes, but for rounding.
    """

    ends: tuple[float, float]
    after: tuple[float, float]
    cycles: tuple[float, ...]
    tendencies: tuple[int, ...]
    kind: LapKind
    neutral: bool = False


def _radius(lap: tuple[float, LapKind | None, float]) -> float:
    return lap[0]


class ReturnMap:
    """The map from one maximum of x to the next in slip, by the radius: the distance of the maximum from a centre.

    The maximum is between the centre, an equilibrium, and the next equilibrium to its right, and so is the next one.
    """

    def __init__(self, parameters: OscillatorParameters, centre: Equilibrium) -> None:
        self.parameters, self.equilibrium, self.centre = parameters, centre, centre.x
        self.places = [e.x for e in equilibria(parameters)]
        right = [x for x in self.places if x > centre.x]
        if parameters.discontinuous and centre.x < 0.0:
            right.insert(0, 0.0)  # the spring's switch parts the wells
        self.farthest = right[0] - centre.x if right else math.inf
        self.traps = traps_of(parameters)

    def lap(self, radius: float) -> tuple[LapKind | None, float]:
        """Return the kind of a lap and how much it adds to a radius: None and NaN where there is no lap."""
        event, following, low, _, _, forward_arcs = kernel.next_maximum(
            self.parameters.plant, self.parameters.belt_speed, self.centre + radius, self.traps
        )
        if event != kernel.TURNING or not 0.0 < following - self.centre < self.farthest or not low <= self.centre:
            return None, math.nan
        arcs = (
            0 if self.parameters.plant.friction.breakaway_coefficient(-1) == 0.0 else forward_arcs
        )  # without friction the belt's speed parts nothing
        return (bisect.bisect_left(self.places, low), arcs), float(following - self.centre - radius)

    def shift(self, radius: float, kind: LapKind | None) -> float:
        """Return how much one lap of this kind (None: of any) adds to a radius, NaN if there is none."""
        found, change = self.lap(radius)
        return change if kind in (None, found) else math.nan

    def edge(self, kind: LapKind | None, inside: float, outside: float) -> float:
        """Return the last radius with a lap of this kind, between one that has it and one that has not."""
        while True:
            middle = 0.5 * (inside + outside)
            if middle in (inside, outside) or abs(outside - inside) < 1e-15:
                return inside
            if math.isnan(self.shift(middle, kind)):
                outside = middle
            else:
                inside = middle

    def root(self, kind: LapKind | None, low: float, high: float) -> float:
        """Return the radius of the cycle between two radii whose shifts differ in sign.

        Raises:
            _NoLapError: if a radius between, met on the way, has no lap of this kind.
        """

        def shift(radius: float) -> float:
            change = self.shift(radius, kind)
            if math.isnan(change):
                raise _NoLapError(radius)
            return change

        return root(shift, low, high)

    def resolved(self, radius: float, shift: float) -> bool:
        """Whether a shift is more than rounding."""
        return abs(shift) > _LAP_ERROR * max(1.0, abs(self.centre + radius))

    def small_cycle(self, radius: float, kind: LapKind | None) -> float:
        """Return the radius of a cycle so small that what a lap does to it is lost in rounding.

        Near a Hopf point a lap changes a radius r by r (a - b r^2); a is known from the linearisation, and b from an
        orbit, from ``radius`` outwards, that is large enough.
        """
        e = self.equilibrium
        a = math.expm1(-math.pi * e.damping / math.sqrt(max(e.stiffness - 0.25 * e.damping**2, 1e-300)))
        shift = self.shift(radius, kind)
        while not self.resolved(radius, 1e-3 * shift) and radius < _LARGEST_SMALL:
            radius *= 2.0
            shift = self.shift(radius, kind)
        ratio = a / (a - shift / radius)
        return radius * math.sqrt(ratio) if 0.0 < ratio < 1.0 else radius

    def leaving(self, radius: float, kind: LapKind) -> float | None:
        """Return the first radius without a lap of this kind that follows on one, None after too many laps."""
        for _ in range(_MOST_LAPS):
            change = self.shift(radius, kind)
            if math.isnan(change):
                return radius
            radius += change
        return None

    def first_resolved(self, radius: float, kind: LapKind | None) -> float:
        """Return the shift of the first orbit from a radius outwards of which it is more than rounding, or NaN."""
        shift = self.shift(radius, kind)
        while not (math.isnan(shift) or self.resolved(radius, shift)):
            radius *= 1.5
            shift = self.shift(radius, kind)
        return shift

    def samples(self) -> list[tuple[float, LapKind | None, float]]:
        """Return radii, ascending, with their laps: up to beyond all that starts can reach."""
        top = 0.05
        while top < 2.0 * STATE_LIMIT and not math.isnan(self.shift(top, None)):
            top *= 1.5
        grid = np.concatenate((np.geomspace(_SMALLEST_RADIUS, 0.01, 24), np.linspace(0.01, top, 80)[1:])).tolist()
        fine = [grid[0]]
        for radius in [*grid[1:], max(top, reach_of(self.parameters, self.equilibrium))]:
            more = math.ceil(math.log(radius / fine[-1]) / math.log(_FINEST_RATIO)) if radius > fine[-1] else 0
            fine += [*np.geomspace(fine[-1], radius, max(more, 1) + 1)[1:-1].tolist(), radius]
        if math.isfinite(self.farthest):
            edge = self.farthest * (1.0 - np.geomspace(1e-6, 0.1, 12))
            fine = sorted(radius for radius in {*fine, *edge.tolist()} if 0.0 < radius < self.farthest)
        found = [(radius, *self.lap(radius)) for radius in fine if radius > 1.5 * ball_of(self.equilibrium)]
        for count in _SAMPLES_OF_A_GAP:  # where the kind of lap changes there may be laps of a third kind between
            between = [
                np.linspace(low[0], high[0], count + 2)[1:-1].tolist()
                for low, high in itertools.pairwise(found)
                if low[1] != high[1]
            ]
            found = sorted([*found, *((radius, *self.lap(radius)) for part in between for radius in part)], key=_radius)
        return found

    def ranges(self) -> list[LapRange]:
        """Return where the map is continuous, with its cycles, ascending.

        Where samples come near zero without crossing it, the extremum is looked for, so that a pair of cycles about to
        merge is not stepped over.
        """
        samples = self.samples()
        found: list[LapRange] = []
        first = 0
        while first < len(samples):
            kind = samples[first][1]
            last = first
            while last + 1 < len(samples) and samples[last + 1][1] == kind:
                last += 1
            if kind is not None:
                inside = [(radius, shift) for radius, _, shift in samples[first : last + 1]]
                if first == 0:
                    low = 0.0
                else:
                    low = self.edge(kind, inside[0][0], samples[first - 1][0])
                    inside.insert(0, (low, self.shift(low, kind)))
                if last + 1 < len(samples):
                    high = self.edge(kind, inside[-1][0], samples[last + 1][0])
                    inside.append((high, self.shift(high, kind)))
                found += self.parted(kind, low, inside)
            first = last + 1
        return found

    def parted(self, kind: LapKind, low: float, inside: list[tuple[float, float]]) -> list[LapRange]:
        """Return the ranges that samples (radius, shift) of one kind of lap belong to: one, but for gaps met on the
        way. ``low`` is where the first begins."""
        high = inside[-1][0]
        ends, after = (low, high), (low + inside[0][1], high + inside[-1][1])
        if conserves_energy(self.parameters) or _slip_dissipates(self.parameters):
            neutral = conserves_energy(self.parameters) and (kind[1] == 0 or _is_frictionless(self.parameters))
            tendency = 0 if neutral else -1
            return [LapRange(ends=ends, after=after, cycles=(), tendencies=(tendency,), kind=kind, neutral=neutral)]
        known = [(radius, shift) for radius, shift in inside if self.resolved(radius, shift)]
        if low == 0.0 and self.equilibrium.weak:
            begin = known[0][0] if known else math.inf
            still = max((radius for radius, _ in inside if radius < begin), default=0.0)
            if still > _STILL_SHARE * high:  # too many for a curvature to decide: friction so level that none moves
                core = LapRange(
                    ends=(low, still), after=(low, still), cycles=(), tendencies=(0,), kind=kind, neutral=True
                )
                rest = [lap for lap in inside if lap[0] >= still]
                return [core, *(self.parted(kind, still, rest) if len(rest) > 1 else [])]
        first = 0
        if low == 0.0 and not self.equilibrium.weak:
            # The equilibrium is a fixed point too: its linearisation says what rounding hides of small orbits.
            first = -1 if self.equilibrium.damping > 0.0 else 1
            known = self.believed(known, first)
        try:
            cycles = self.cycles(kind, known)
            if known and known[0][1] * first < 0.0:
                like = [radius for radius, shift in inside if radius < known[0][0] and shift * first > 0.0]
                cycles = [self.root(kind, like[-1], known[0][0]), *cycles] if like else cycles
        except _NoLapError as gap:
            inner = max(radius for radius, _ in inside if radius < gap.radius)
            outer = min(radius for radius, _ in inside if radius > gap.radius)
            end, begin = self.edge(kind, inner, gap.radius), self.edge(kind, outer, gap.radius)
            below = [*(lap for lap in inside if lap[0] < gap.radius), (end, self.shift(end, kind))]
            above = [(begin, self.shift(begin, kind)), *(lap for lap in inside if lap[0] > gap.radius)]
            return self.parted(kind, low, below) + self.parted(kind, begin, above)
        tendencies = []
        for inner, outer in itertools.pairwise([low, *cycles, high]):
            between = [shift for radius, shift in known if inner <= radius <= outer]
            if not between and inner in cycles and outer in cycles:  # a pair close together
                between = [self.shift(0.5 * (inner + outer), kind)]
            tendencies.append(int(np.sign(max(between, key=abs, default=0.0))))
        if tendencies[0] == 0:
            tendencies[0] = first
        return [LapRange(ends=ends, after=after, cycles=tuple(cycles), tendencies=tuple(tendencies), kind=kind)]

    def believed(self, known: list[tuple[float, float]], first: int) -> list[tuple[float, float]]:
        """Return the samples (radius, shift) without the smallest orbits that contradict the sign ``first`` of the
        linearisation within the steps' error, where larger ones agree with it again."""
        error = _STEP_ERROR * 2.0 * math.pi / math.sqrt(self.equilibrium.stiffness)
        begin = next((i for i, (_, shift) in enumerate(known) if shift * first > 0.0), 0)
        small = all(radius < _LARGEST_DOUBTED and abs(shift) <= error for radius, shift in known[:begin])
        return known[begin:] if small else known

    def cycles(self, kind: LapKind | None, known: list[tuple[float, float]]) -> list[float]:
        """Return the radii of cycles among samples (radius, shift) of one kind of lap.

        Raises:
            _NoLapError: if a radius between, met on the way, has no lap of this kind.
        """
        from scipy.optimize import minimize_scalar

        radii = [self.root(kind, r0, r1) for (r0, s0), (r1, s1) in itertools.pairwise(known) if s0 * s1 < 0.0]
        for (r0, s0), (_, s1), (r2, s2) in zip(known, known[1:], known[2:], strict=False):
            if s0 * s1 > 0.0 and s1 * s2 > 0.0 and abs(s1) < min(abs(s0), abs(s2)):
                side = math.copysign(1.0, s1)

                def height(radius: float, side: float = side) -> float:
                    return side * self.shift(radius, kind)

                nearest = minimize_scalar(height, bounds=(r0, r2), method="bounded")
                if nearest.fun < 0.0 and self.resolved(nearest.x, nearest.fun):
                    radii += [self.root(kind, r0, nearest.x), self.root(kind, nearest.x, r2)]
        return sorted(radii)


class Section(NamedTuple):
    """The maxima of x right of one equilibrium: whether it attracts those next to it, and its map's ranges."""

    equilibrium: Equilibrium
    attracts: bool
    ranges: list[LapRange]


@functools.lru_cache(maxsize=64)
def sections(parameters: OscillatorParameters) -> list[Section]:
    """Return the section of every equilibrium that slip can turn about, in ascending order."""
    found = []
    for equilibrium in equilibria(parameters):
        if not is_centre(parameters, equilibrium):
            continue
        laps = ReturnMap(parameters, equilibrium)
        ranges = laps.ranges()
        attracts = equilibrium.damping > 0.0
        if equilibrium.weak:
            attracts = bool(ranges) and ranges[0].ends[0] == 0.0 and ranges[0].tendencies[0] < 0
        found.append(Section(equilibrium, attracts, ranges))
    return found


def _drifts_past(parameters: OscillatorParameters, place: float, centre: Equilibrium) -> bool:
    """Whether maxima on both sides of one that repeats but for rounding move the same way, so that it is no cycle."""
    if _slip_dissipates(parameters):
        return True
    laps = ReturnMap(parameters, centre)
    radii = [(place - centre.x) * (1.0 + part) for part in (-0.01, 0.01)]
    below, above = ((radius, laps.shift(radius, None)) for radius in radii)
    if math.isnan(below[1] + above[1]):  # one of them sticks: the cycle touches the belt's speed
        return False
    return not (below[1] * above[1] < 0.0 and laps.resolved(*below) and laps.resolved(*above))


def _limit_of_slip(parameters: OscillatorParameters, maximum: float, around: list[Equilibrium]) -> tuple[str, float]:
    """Return where successive maxima of x tend from ``maximum``, which has a next one: ("pure-slip", fixed point),
    ("steady-slip", x) or ("on", the first maximum on the way from which the motion sticks or circles other equilibria).
    """
    laps = ReturnMap(parameters, around[-1])
    centre = laps.centre
    first = radius = maximum - centre
    kind, shift = laps.lap(radius)
    if kind is None:
        return "on", maximum
    if not laps.resolved(radius, shift):
        # Of small orbits, lost in rounding, the equilibrium's linearisation says what they do, or greater ones.
        shift = laps.first_resolved(radius, kind) if around[-1].weak else -around[-1].damping
    contracts = _slip_dissipates(parameters)
    growing = shift > 0.0 and not contracts
    factor = 1.2 if growing else 0.5
    while (growing or factor * radius > 2.0 * ball_of(around[-1])) and radius < reach_of(parameters, around[-1]):
        following, last = factor * radius, False
        while True:
            change = laps.shift(following, kind)
            if math.isnan(change):
                # Up to the last orbit with a lap there can still be a cycle; if there is none, the motion passes it.
                following, last = laps.edge(kind, radius, following), True
                change = laps.shift(following, kind)
            if (change > 0.0) == growing or contracts or not laps.resolved(following, change):
                break
            if not laps.resolved(radius, laps.shift(radius, kind)):
                return "pure-slip", centre + laps.small_cycle(following, kind)
            try:
                return "pure-slip", centre + laps.root(kind, radius, following)
            except _NoLapError as gap:
                following = gap.radius
        if last:
            beyond = following * (1.0 + (1e-12 if growing else -1e-12))
            # With several wells it matters where the motion itself passes the edge.
            return "on", centre + (laps.leaving(first, kind) or beyond if len(laps.places) > 1 else beyond)
        radius = following
    if growing:
        return "on", centre + radius
    if (
        around[-1].damping < 0.0 and not contracts
    ):  # the equilibrium repels, so that a cycle is there that is too small to see
        return "pure-slip", centre + laps.small_cycle(radius, kind)
    return "steady-slip", centre


def slip_cycles(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every pure-slip cycle, stable (|multiplier| < 1) and unstable: by the equilibrium left of its maximum of
    x, then by size. The start recorded with each is its own maximum of x.
    """
    found = []
    for section in sections(parameters):
        places = [section.equilibrium.x + radius for part in section.ranges for radius in part.cycles]
        found += [_pure_slip(parameters, place, place, 0.0) for place in places]
    return found


class SlipLimit(NamedTuple):
    """What maxima of x tend to that are nearer to an equilibrium than ``radius``, but not nearer than the last limit's.

    Either ``cycle``, or they leave these radii, with a maximum between the two radii ``leaves``, or (both None) it is
    not known.
    """

    radius: float
    cycle: LimitCycle | None = None
    leaves: tuple[float, float] | None = None


@functools.lru_cache(maxsize=64)
def limits_of_slip(parameters: OscillatorParameters) -> list[tuple[float, list[SlipLimit]]]:
    """Return the limits of maxima of x right of each equilibrium that slip can turn about, by ascending radius."""
    found = []
    for section in sections(parameters):
        centre = section.equilibrium.x
        limits: list[SlipLimit] = []
        for part in section.ranges:
            low, high = part.ends
            if low > 0.0:
                limits.append(SlipLimit(low))
            if part.neutral:
                # A little inside: on the very edge, where the orbit touches the belt's speed, rounding decides.
                place = centre + high - 1e-9 * (high - low)
                limits.append(SlipLimit(high, _pure_slip(parameters, place, place, 0.0, "neutral")))
                continue
            orbits = [_pure_slip(parameters, centre + radius, centre + radius, 0.0) for radius in part.cycles]
            steady = _steady(parameters, "steady-slip", centre, centre, 0.0)
            # A range's first radius and its last are fixed points only where the first is the equilibrium.
            inmost = SlipLimit(
                high, *((steady, None) if low == 0.0 else (None, (part.after[0], min(low, part.after[1]))))
            )
            outmost = SlipLimit(high, None, (max(high, part.after[0]), part.after[1]))
            marks = [inmost, *(SlipLimit(high, orbit) for orbit in orbits), outmost]
            for radius, tendency, (inner, outer) in zip(
                (*part.cycles, high), part.tendencies, itertools.pairwise(marks), strict=True
            ):
                limit = (SlipLimit(radius), outer, inner)[tendency]
                limits.append(limit._replace(radius=radius))
        found.append((centre, limits))
    return found


def stick_intervals(parameters: OscillatorParameters) -> list[tuple[float, float]]:
    """Return the intervals of x in which a mass can stick, |2 beta v_b + R(x)| <= mu_s N(x), in ascending order."""
    _check_unexcited(parameters)
    load = 2.0 * parameters.beta * parameters.belt_speed
    plant, belt = parameters.plant, kernel.Drive(parameters.belt_speed, 0.0, 0.0)
    ends = [
        x
        for side in (-1, 1)
        for x in balance_points(parameters, load, side * plant.friction.breakaway_coefficient(-side))
    ]
    if parameters.discontinuous:
        ends.append(0.0)  # the stick load jumps there, and an interval may end or be passed through
    ends.sort()
    intervals: list[tuple[float, float]] = []
    for low, high in itertools.pairwise(ends):
        if kernel.mode_at_zero_v_rel(plant, 0.5 * (low + high), belt) == kernel.STICK:
            if intervals and intervals[-1][1] == low:
                low = intervals.pop()[0]
            intervals.append((low, high))
    return intervals


def attractors(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every attractor, each with a start that reaches it, in ascending order of the middle of its motion.

    A mass that sticks leaves from the right end of a stick interval, so the stick-slip cycles are found by following
    each of those ends once; what does not stick tends to a stable equilibrium or to a stable pure-slip cycle, or is
    one of a family of neutral orbits: each family is listed once, as its outermost orbit, of kind "neutral".

    Raises:
        ValueError: if the belt stands still: then every place in a stick interval is one of rest.
    """
    if parameters.belt_speed == 0.0:
        raise ValueError("belt_speed must be positive to list attractors, got 0.0: every stick interval is at rest")
    found: list[LimitCycle] = []

    def add(cycle: LimitCycle) -> None:
        if not any(same_motion(cycle, other) for other in found):
            found.append(cycle)

    of_slip = [limit.cycle for _, limits in limits_of_slip(parameters) for limit in limits if limit.cycle is not None]
    for cycle in of_slip:
        if cycle.kind == "neutral":
            add(cycle)
    for _, right in stick_intervals(parameters):
        with contextlib.suppress(OrbitError):
            add(limit_of_motion(parameters, right, parameters.belt_speed))
    for section in sections(parameters):
        if section.attracts:
            add(_steady(parameters, "steady-slip", section.equilibrium.x, section.equilibrium.x, 0.0))
    for cycle in of_slip:
        add(cycle)
    return sorted(found, key=lambda cycle: cycle.x_max + cycle.x_min)


def same_motion(a: LimitCycle, b: LimitCycle) -> bool:
    """Whether two attractors of one oscillator are the same, or two neutral orbits of one family."""
    if a.kind != b.kind:
        return False
    if a.kind == "neutral":
        places, arcs = (
            [e.x for e in equilibria(a.parameters)],
            a.parameters.plant.friction.breakaway_coefficient(-1) > 0.0,
        )
        first, second = (
            ([cycle.x_min <= x <= cycle.x_max for x in places], arcs and cycle.forward_arcs) for cycle in (a, b)
        )
        return first == second
    close = 1e-6 * min(1.0, max(1e-3, a.amplitude))
    return abs(a.x_max - b.x_max) < close and abs(a.x_min - b.x_min) < close


def _stick_slip(parameters: OscillatorParameters, x_exit: float, x: float, v: float) -> LimitCycle:
    lap = kernel.stick_slip_lap(parameters.plant, parameters.belt_speed, x_exit)
    if lap.outcome != kernel.REPEATED_BREAKAWAY:
        raise OrbitError(f"the stick-slip cycle from breakaway at x = {x_exit!r} does not close; {parameters}")
    return LimitCycle(
        kind="stick-slip",
        amplitude=amplitude(lap.x_min, lap.x_max),
        period=lap.period,
        frequency=1.0 / lap.period,
        angular_frequency=2.0 * math.pi / lap.period,
        stick_fraction=lap.stick_time / lap.period,
        x_max=lap.x_max,
        x_min=lap.x_min,
        mean_square_velocity=lap.int_v2 / lap.period,
        x_phase0=x_exit,
        v_phase0=parameters.belt_speed,
        x_breakaway=x_exit,
        x_restick=lap.x_restick,
        sticks=lap.sticks,
        forward_arcs=lap.forward_arcs,
        floquet_multiplier=0.0,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


def _pure_slip(
    parameters: OscillatorParameters, x_max: float, x: float, v: float, kind: Kind = "pure-slip"
) -> LimitCycle:
    plant, speed, traps = parameters.plant, parameters.belt_speed, traps_of(parameters)
    event, _, x_min, period, int_v2, forward_arcs = kernel.next_maximum(plant, speed, x_max, traps)
    if event != kernel.TURNING:
        raise OrbitError(f"the cycle of slip through x = {x_max!r} does not close; {parameters}")
    if x_max - x_min < _SMALLEST_RADIUS:
        return _steady(parameters, "steady-slip" if kind == "pure-slip" else kind, x_max, x, v)
    step = 1e-4 * (x_max - x_min)
    above = kernel.next_maximum(plant, speed, x_max + step, traps).x
    below = kernel.next_maximum(plant, speed, x_max - step, traps).x
    multiplier = (above - below) / (2.0 * step)
    if math.isnan(multiplier):  # the orbit just above sticks
        multiplier = (x_max - below) / step
    return LimitCycle(
        kind=kind,
        amplitude=amplitude(x_min, x_max),
        period=period,
        frequency=1.0 / period,
        angular_frequency=2.0 * math.pi / period,
        stick_fraction=0.0,
        x_max=x_max,
        x_min=x_min,
        mean_square_velocity=int_v2 / period,
        x_phase0=x_max,
        v_phase0=0.0,
        x_breakaway=math.nan,
        x_restick=math.nan,
        sticks=0,
        forward_arcs=forward_arcs,
        floquet_multiplier=multiplier if kind == "pure-slip" else 1.0,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


def _steady(parameters: OscillatorParameters, kind: Kind, place: float, x: float, v: float) -> LimitCycle:
    return LimitCycle(
        kind=kind,
        amplitude=0.0,
        period=math.nan,
        frequency=math.nan,
        angular_frequency=math.nan,
        stick_fraction=1.0 if kind == "rest" else 0.0,
        x_max=place,
        x_min=place,
        mean_square_velocity=0.0,
        x_phase0=place,
        v_phase0=0.0,
        x_breakaway=math.nan,
        x_restick=math.nan,
        sticks=0,
        forward_arcs=0,
        floquet_multiplier=math.nan,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


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
        normal = kernel.normal_force(plant, points[-1])
        return float(2.0 * parameters.beta + normal * plant.friction.slope(kernel.SLIP_BACKWARD, -speed))

    _check_unexcited(parameters)
    speeds = _belt_speeds_to_search(parameters)
    high = float(speeds[0])
    for low in speeds[1:].tolist():
        if damping(low) < 0.0:
            return root(damping, low, high) if damping(high) > 0.0 else high
        high = low
    return math.nan


def _belt_speeds_to_search(parameters: OscillatorParameters) -> FloatArray:
    """Return belt speeds, descending to 0 from one above which friction no longer falls as steeply as damping rises."""
    if parameters.friction == "stribeck":
        speeds: FloatArray = np.linspace(parameters.v_m, 0.0, 65)  # friction rises with speed from there on
        return speeds
    high = RANGES["belt_speed"][1]
    if parameters.friction == "coulomb":
        speeds = np.array([high, 0.0])  # level: it never feeds a motion
    else:
        width = parameters.plant.friction.layer_width(-1) or _LEAST_WIDTH
        speeds = np.append(np.geomspace(high, 1e-3 * min(width, 500.0 * high), 200), 0.0)
    return speeds


def first_lyapunov_coefficient(parameters: OscillatorParameters) -> float:
    """Return the first Lyapunov coefficient of the Hopf point at v_b1, NaN if there is none.

    Negative: supercritical, a stable cycle grows out of the equilibrium below v_b1. Positive: subcritical, an unstable
    one shrinks onto it, and oscillation outlives v_b1. ``belt_speed`` is not used. Source: Guckenheimer and Holmes,
    Nonlinear Oscillations, Eq. 3.4.11, for x'' = F(x, x').
    """
    speed = hopf_belt_speed(parameters)
    if math.isnan(speed):
        return math.nan
    at_hopf = parameters.replace(belt_speed=speed)
    plant, x = at_hopf.plant, equilibria(at_hopf)[-1].x
    mode, w = kernel.SLIP_BACKWARD, -speed
    friction, spring = plant.friction, plant.spring
    coefficient, slope = friction.coefficient(mode, w), friction.slope(mode, w)
    curvature, third = friction.curvature(mode, w), friction.third_derivative(mode, w)
    restoring_slope, normal_slope = spring.restoring_slope(x), spring.normal_slope(x)
    restoring_curvature, normal_curvature = spring.restoring_curvature(x), spring.normal_curvature(x)
    normal = spring.normal_force(plant.g1, x)
    square = restoring_slope + coefficient * normal_slope  # omega^2
    f_xx = -restoring_curvature - coefficient * normal_curvature
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

    _check_unexcited(parameters)
    if parameters.friction == "stribeck":
        speeds = np.linspace(1.5 * parameters.v_m, 0.0, 49)
    else:
        speeds = _belt_speeds_to_search(parameters)
        if parameters.friction == "coulomb":
            speeds = np.append(np.geomspace(speeds[0], 1e-3, 200), 0.0)
    high = float(speeds[0])
    if parameters.friction != "stribeck" and sticks_again(high):
        return high
    for low in speeds[1:-1]:
        if sticks_again(float(low)):
            inside, outside = float(low), high
            while True:
                middle = 0.5 * (inside + outside)
                if outside - inside < 0.1 * _BELT_SPEED_ERROR:
                    return inside - _BELT_SPEED_ERROR
                if sticks_again(middle):
                    inside = middle
                else:
                    outside = middle
        high = float(low)
    return math.nan


def critical_belt_speeds(parameters: OscillatorParameters) -> CriticalBeltSpeeds:
    """Return (v_b0, v_b1): the belt speeds at which stick-slip ends (grazing) and at which oscillation ends (Hopf).

    The result is a pair with an attribute ``reason``, which says why where a value is NaN. ``parameters.belt_speed``
    is not used. alpha < 1 has several wells: the speeds are those of the right-hand well, where the belt takes a mass.
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
