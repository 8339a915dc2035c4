"""Equilibria, limit cycles and critical belt speeds of the passive oscillator, found as roots and closed loops.

A trajectory that sticks forgets its past, so a stick-slip cycle closes as soon as a breakaway point repeats. A
pure-slip cycle is a fixed point of the map from one maximum of x to the next. Neither needs a long transient, which
matters near the end of oscillation, where transients decay ever more slowly.
"""

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
from sd_friction_env.parameters import EXCITATIONS, RANGES, STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.simulation import amplitude
from sd_friction_env.theory import FloatArray, cubic_wells, exact_wells

Kind = Literal["stick-slip", "pure-slip", "steady-slip", "rest"]

_LONG_SETTLING_LAPS = 800
_SMALLEST_RADIUS = 1e-7  # orbits smaller than this about an equilibrium are called the equilibrium
_BELT_SPEED_ERROR = 1e-11  # v_b0 is given this much too low: on the very graze rounding decides whether a cycle sticks


class OrbitError(ValueError):
    """The passive motion has no attractor that can be named: it loses contact, or does not settle."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """A steady-slip equilibrium: the mass stands still, the belt slides under it (Eq. 11).

    Attributes:
        x: its place. eigenvalues: of the linearised slip motion. stable: whether both have negative real parts.
    """

    x: float
    eigenvalues: tuple[complex, complex]
    stable: bool


@dataclass(frozen=True, kw_only=True)
class LimitCycle:
    """An attractor of the passive oscillator (dimensionless; a steady state has amplitude 0 and no period).

    Attributes:
        kind: "stick-slip", "pure-slip", "steady-slip" (the mass stands on the sliding belt) or "rest" (belt speed 0).
        amplitude: (x_max - x_min)/2.
        period, frequency, angular_frequency: T, 1/T and 2 pi/T; NaN for a steady state.
        stick_fraction: share of the period spent stuck.
        x_max, x_min: extremes of x.
        mean_square_velocity: mean of x'^2 over a period.
        x_phase0, v_phase0: the state counted as phase 0: breakaway in stick-slip, the maximum of x in pure slip.
        x_breakaway, x_restick: where stick ends and where it last began; NaN without stick.
        sticks, forward_arcs: how many sticks and forward-slip arcs one period has.
        floquet_multiplier: 0 for stick-slip (superstable), the return map's slope for pure slip, NaN otherwise.
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
    if parameters.geometry_code == kernel.DISCONTINUOUS:
        # Where the jump of R at x = 0 passes the balance there is no place to stand on: see `stick_intervals` for that.
        push = coefficient * g1 - load
        return sorted(push + side for side in (-1.0, 1.0) if (push + side) * side > 0.0)
    if parameters.geometry == "duffing":
        polynomial = [parameters.kappa, 0.0, 1.0, load - coefficient * g1]
    elif parameters.geometry == "cubic":
        square = alpha * alpha
        polynomial = [
            0.5 / (square * alpha),
            0.5 * coefficient / square,
            1.0 - 1.0 / alpha,
            load - coefficient * (g1 - alpha + 1.0),
        ]
    else:
        # (x - c) s = x + d with s = sqrt(x^2 + alpha^2); squared, a quartic with foreign roots among its own
        c, d, square = coefficient * (g1 - alpha) - load, coefficient * alpha, alpha * alpha
        polynomial = [1.0, -2.0 * c, c * c + square - 1.0, -2.0 * (c * square + d), c * c * square - d * d]
    plant = parameters.plant
    points: list[float] = []
    for root in np.roots(polynomial).tolist():
        if abs(root.imag) > 1e-6 * max(1.0, abs(root.real)):
            continue
        x = root.real
        for _ in range(8):
            restoring, normal = kernel.spring(plant, x)
            error = load + restoring - coefficient * normal
            restoring_slope, normal_slope = kernel.spring_slopes(plant, x)
            slope = restoring_slope - coefficient * normal_slope
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


def rest_place(parameters: OscillatorParameters) -> float:
    """Return where the unloaded spring has its (right-hand) place of rest, R(x) = 0 with R'(x) > 0."""
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
    coefficient = -float(kernel.friction_coefficient(plant, kernel.SLIP_BACKWARD, -speed))
    slope = float(kernel.friction_slope(plant, kernel.SLIP_BACKWARD, -speed))
    found = []
    for x in balance_points(parameters, 0.0, coefficient):
        normal = kernel.spring(plant, x)[1]
        if normal <= 0.0:
            continue
        restoring_slope, normal_slope = kernel.spring_slopes(plant, x)
        stiffness = restoring_slope - coefficient * normal_slope
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
            "see sd_friction_env.forced, or take parameters.unexcited"
        )


def limit_cycle(parameters: OscillatorParameters, x: float = 0.0, v: float | None = None) -> LimitCycle:
    """Return the attractor that the passive oscillator reaches from (x, v).

    Args:
        parameters: of the oscillator.
        x, v: the start, in [-10, 10]; without them a mass set down at x = 0 moving with the belt.

    Raises:
        OrbitError: if the motion loses contact (N <= 0) or does not settle.
        TypeError, ValueError: if x or v is not a number in its range, or the oscillator is excited.
    """
    _check_unexcited(parameters)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    v = parameters.belt_speed if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    at_x, at_v = x, v
    laps = kernel.SETTLING_LAPS
    for _ in range(40):
        outcome, place, previous, lowest = kernel.settle(
            parameters.plant, parameters.belt_speed, at_x, at_v, laps, np.empty(kernel.SETTLING_EXITS)
        )
        if outcome == kernel.REPEATED_BREAKAWAY:
            return _stick_slip(parameters, place, x, v)
        if outcome == kernel.AT_REST:
            return _steady(parameters, "rest", place, x, v)
        if outcome == kernel.ORBIT_LOST_CONTACT:
            raise OrbitError(f"the mass loses contact with the belt at x = {place:.6g} (N <= 0); {parameters}")
        if outcome == kernel.AT_EQUILIBRIUM:
            nearest = min((e.x for e in equilibria(parameters)), key=lambda e: abs(e - place), default=place)
            return _steady(parameters, "steady-slip", nearest, x, v)
        if outcome == kernel.ORBIT_UNDECIDED:
            break
        around = [e for e in equilibria(parameters) if lowest <= e.x <= place]
        if abs(place - previous) < kernel.TIME_ZERO and place - lowest > _SMALLEST_RADIUS:
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


def root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function changes sign between two arguments (Brent's method)."""
    from scipy.optimize import brentq  # not at the top: environments start without it

    return float(brentq(function, low, high, xtol=1e-15, rtol=1e-14))


class _NoLapError(Exception):
    """An orbit of this radius has no lap; the return map is not defined there."""

    def __init__(self, radius: float) -> None:
        super().__init__(radius)
        self.radius = radius


class ReturnMap:
    """The map from one maximum of x to the next in slip, by the radius: the distance of the maximum from a centre.

    ``centre`` is the right-most equilibrium circled, ``innermost`` the left-most.
    """

    def __init__(self, parameters: OscillatorParameters, innermost: float, centre: float) -> None:
        self.plant, self.speed = parameters.plant, parameters.belt_speed
        self.innermost, self.centre = innermost, centre

    def shift(self, radius: float) -> float:
        """Return how much one lap adds to a radius; NaN if the lap sticks or does not circle just these equilibria."""
        event, following, low = kernel.next_maximum(self.plant, self.speed, self.centre + radius)[:3]
        if event != kernel.TURNING or not low <= self.innermost:
            return math.nan
        return float(following - self.centre - radius)

    def edge(self, inside: float, outside: float) -> float:
        """Return the last radius with a lap, between one that has it and one that has not."""
        while True:
            middle = 0.5 * (inside + outside)
            if middle in (inside, outside) or abs(outside - inside) < 1e-15:
                return inside
            if math.isnan(self.shift(middle)):
                outside = middle
            else:
                inside = middle

    def root(self, low: float, high: float) -> float:
        """Return the radius of the cycle between two radii whose shifts differ in sign.

        Raises:
            _NoLapError: if a radius between, met on the way, has no lap.
        """

        def shift(radius: float) -> float:
            change = self.shift(radius)
            if math.isnan(change):
                raise _NoLapError(radius)
            return change

        return root(shift, low, high)

    def roots(self, low: float, high: float) -> list[float]:
        """Return the radii of cycles between two radii that have laps: none where their shifts have the same sign."""
        if self.shift(low) * self.shift(high) >= 0.0:
            return []
        try:
            return [self.root(low, high)]
        except _NoLapError as gap:
            return self.roots(low, self.edge(low, gap.radius)) + self.roots(self.edge(high, gap.radius), high)

    def cycles(self) -> tuple[list[float], float]:
        """Return the radii of all cycles, ascending, and the largest radius with a lap.

        The map is sampled on some hundred radii; where it comes near zero without crossing it, its extremum is looked
        for, so that a pair of cycles about to merge is not stepped over.
        """
        top = 0.05
        while top < 2.0 * STATE_LIMIT and not math.isnan(self.shift(top)):
            top *= 1.5
        grid = np.concatenate((np.geomspace(_SMALLEST_RADIUS, 0.01, 24), np.linspace(0.01, top, 80)[1:])).tolist()
        laps = [(radius, self.shift(radius)) for radius in grid]
        samples = [(radius, shift) for radius, shift in laps if not math.isnan(shift)]
        if not samples:
            return [], 0.0
        beyond = [radius for radius, shift in laps if math.isnan(shift) and radius > samples[-1][0]]
        if beyond:
            last = self.edge(samples[-1][0], beyond[0])
            samples.append((last, self.shift(last)))
        from scipy.optimize import minimize_scalar

        radii = [radius for (r0, _), (r1, _) in itertools.pairwise(samples) for radius in self.roots(r0, r1)]
        for (r0, s0), (_, s1), (r2, s2) in zip(samples, samples[1:], samples[2:], strict=False):
            if s0 * s1 > 0.0 and s1 * s2 > 0.0 and abs(s1) < min(abs(s0), abs(s2)):
                side = math.copysign(1.0, s1)
                nearest = minimize_scalar(lambda r, side=side: side * self.shift(r), bounds=(r0, r2), method="bounded")
                if nearest.fun < 0.0:
                    radii += self.roots(r0, nearest.x) + self.roots(nearest.x, r2)
        return sorted(radii), samples[-1][0]


def _limit_of_slip(parameters: OscillatorParameters, maximum: float, around: list[Equilibrium]) -> tuple[str, float]:
    """Return where successive maxima of x tend from ``maximum``, which has a next one: ("pure-slip", fixed point),
    ("steady-slip", x) or ("on", the first maximum on the way from which the motion sticks or circles other equilibria).
    """
    laps = ReturnMap(parameters, around[0].x, around[-1].x)
    centre = laps.centre
    radius = maximum - centre
    shift = laps.shift(radius)
    if math.isnan(shift):
        return "on", maximum
    growing = shift > 0.0
    factor = 1.2 if growing else 0.5
    while _SMALLEST_RADIUS < radius < 2.0 * STATE_LIMIT:
        following, last = factor * radius, False
        while True:
            change = laps.shift(following)
            if math.isnan(change):
                # Up to the last orbit with a lap there can still be a cycle; if there is none, the motion passes it.
                following, last = laps.edge(radius, following), True
                change = laps.shift(following)
            if (change > 0.0) == growing:
                break
            try:
                return "pure-slip", centre + laps.root(radius, following)
            except _NoLapError as gap:
                following = gap.radius
        if last:
            return "on", centre + following * (1.0 + (1e-12 if growing else -1e-12))
        radius = following
    return ("on", centre + radius) if growing else ("steady-slip", centre)


def slip_cycles(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every pure-slip cycle that circles one steady-slip equilibrium, stable (|multiplier| < 1) and unstable.

    The start recorded with each is its own maximum of x.
    """
    found = []
    for equilibrium in equilibria(parameters):
        radii, _ = ReturnMap(parameters, equilibrium.x, equilibrium.x).cycles()
        places = [equilibrium.x + radius for radius in radii]
        found += [_pure_slip(parameters, place, place, 0.0) for place in places]
    return found


def stick_intervals(parameters: OscillatorParameters) -> list[tuple[float, float]]:
    """Return the intervals of x in which a mass can stick, |2 beta v_b + R(x)| <= mu_s N(x), in ascending order."""
    _check_unexcited(parameters)
    load = 2.0 * parameters.beta * parameters.belt_speed
    ends = [x for side in (-1.0, 1.0) for x in balance_points(parameters, load, side * parameters.mu_s)]
    if parameters.geometry_code == kernel.DISCONTINUOUS:
        ends.append(0.0)  # the stick load jumps there, and an interval may end or be passed through
    ends.sort()
    intervals: list[tuple[float, float]] = []
    for low, high in itertools.pairwise(ends):
        force, limit = kernel.stick_load(parameters.plant, 0.5 * (low + high), parameters.belt_speed, 0.0, 0.0)
        if abs(force) <= limit:
            if intervals and intervals[-1][1] == low:
                low = intervals.pop()[0]
            intervals.append((low, high))
    return intervals


def attractors(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every attractor, each with a start that reaches it, in ascending order of the middle of its motion.

    A mass that sticks leaves from the right end of a stick interval, so the stick-slip cycles are found by following
    each of those ends once; what does not stick tends to a stable equilibrium or to a stable pure-slip cycle. (Cycles
    of pure slip round several equilibria are found only if a stick interval's end leads there.)

    Raises:
        ValueError: if the belt stands still: then every place in a stick interval is one of rest.
    """
    if parameters.belt_speed == 0.0:
        raise ValueError("belt_speed must be positive to list attractors, got 0.0: every stick interval is at rest")
    found: list[LimitCycle] = []

    def add(cycle: LimitCycle) -> None:
        if not any(same_motion(cycle, other) for other in found):
            found.append(cycle)

    for _, right in stick_intervals(parameters):
        with contextlib.suppress(OrbitError):
            add(limit_cycle(parameters, right, parameters.belt_speed))
    for equilibrium in equilibria(parameters):
        if equilibrium.stable:
            add(_steady(parameters, "steady-slip", equilibrium.x, equilibrium.x, 0.0))
    for cycle in slip_cycles(parameters):
        if abs(cycle.floquet_multiplier) < 1.0:
            add(cycle)
    return sorted(found, key=lambda cycle: cycle.x_max + cycle.x_min)


def same_motion(a: LimitCycle, b: LimitCycle) -> bool:
    """Whether two attractors of one oscillator are the same."""
    return a.kind == b.kind and abs(a.x_max - b.x_max) < 1e-6 and abs(a.x_min - b.x_min) < 1e-6


def _stick_slip(parameters: OscillatorParameters, x_exit: float, x: float, v: float) -> LimitCycle:
    outcome, period, stick_time, x_min, x_max, x_restick, sticks, arcs, int_v2 = kernel.stick_slip_lap(
        parameters.plant, parameters.belt_speed, x_exit
    )
    if outcome != kernel.REPEATED_BREAKAWAY:
        raise OrbitError(f"the stick-slip cycle from breakaway at x = {x_exit!r} does not close; {parameters}")
    return LimitCycle(
        kind="stick-slip",
        amplitude=amplitude(x_min, x_max),
        period=period,
        frequency=1.0 / period,
        angular_frequency=2.0 * math.pi / period,
        stick_fraction=stick_time / period,
        x_max=x_max,
        x_min=x_min,
        mean_square_velocity=int_v2 / period,
        x_phase0=x_exit,
        v_phase0=parameters.belt_speed,
        x_breakaway=x_exit,
        x_restick=x_restick,
        sticks=sticks,
        forward_arcs=arcs,
        floquet_multiplier=0.0,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


def _pure_slip(parameters: OscillatorParameters, x_max: float, x: float, v: float) -> LimitCycle:
    plant, speed = parameters.plant, parameters.belt_speed
    event, _, x_min, period, int_v2, forward_arcs = kernel.next_maximum(plant, speed, x_max)
    if event != kernel.TURNING:
        raise OrbitError(f"the cycle of slip through x = {x_max!r} does not close; {parameters}")
    if x_max - x_min < _SMALLEST_RADIUS:
        return _steady(parameters, "steady-slip", x_max, x, v)
    step = 1e-4 * (x_max - x_min)
    above = kernel.next_maximum(plant, speed, x_max + step)[1]
    below = kernel.next_maximum(plant, speed, x_max - step)[1]
    multiplier = (above - below) / (2.0 * step)
    if math.isnan(multiplier):  # the orbit just above sticks
        multiplier = (x_max - below) / step
    return LimitCycle(
        kind="pure-slip",
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
        floquet_multiplier=multiplier,
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
        coefficient = -kernel.friction_coefficient(plant, kernel.SLIP_BACKWARD, -speed)
        points = balance_points(parameters, 0.0, coefficient)
        if not points:
            return math.nan
        normal = kernel.spring(plant, points[-1])[1]
        return float(2.0 * parameters.beta + normal * kernel.friction_slope(plant, kernel.SLIP_BACKWARD, -speed))

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
        low = 1e-3 * (parameters.v_0 if parameters.friction == "exponential" else 1.0 / max(parameters.delta, 1e-3))
        speeds = np.append(np.geomspace(high, min(low, 0.5 * high), 200), 0.0)
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
    coefficient = float(kernel.friction_coefficient(plant, kernel.SLIP_BACKWARD, -speed))
    slope = float(kernel.friction_slope(plant, kernel.SLIP_BACKWARD, -speed))
    curvature, third = _friction_derivatives(at_hopf)
    restoring_slope, normal_slope = kernel.spring_slopes(plant, x)
    restoring_curvature, normal_curvature = kernel.spring_curvatures(plant, x)
    normal = kernel.spring(plant, x)[1]
    square = restoring_slope + coefficient * normal_slope  # omega^2
    f_xx = -restoring_curvature - coefficient * normal_curvature
    f_xv = -slope * normal_slope
    f_vv = -curvature * normal
    f_xxv = -slope * normal_curvature
    f_vvv = -third * normal
    return float((f_xxv + square * f_vvv + f_xv * f_xx / square + f_xv * f_vv) / 16.0)


def _friction_derivatives(parameters: OscillatorParameters) -> tuple[float, float]:
    """Return the second and third derivatives of mu at the relative velocity of steady slip, -v_b."""
    speed = parameters.belt_speed
    if parameters.friction == "stribeck":
        return -6.0 * parameters.k3 * speed, 6.0 * parameters.k3
    if parameters.friction == "hyperbolic":
        delta, below = parameters.delta, 1.0 + parameters.delta * speed
        return -2.0 * parameters.mu_s * delta**2 / below**3, -6.0 * parameters.mu_s * delta**3 / below**4
    if parameters.friction == "exponential":
        v_0 = parameters.v_0
        fall = (parameters.mu_s - parameters.mu_k) * math.exp(-speed / v_0)
        return -fall / v_0**2, -fall / v_0**3
    return 0.0, 0.0


def grazing_belt_speed(parameters: OscillatorParameters) -> float:
    """Return v_b0, the largest belt speed at which a mass that breaks away sticks again, or NaN if it never does.

    The mass breaks away at the right end of the right-most stick interval. ``belt_speed`` is not used. With a friction
    law other than Stribeck's the search ends at 10, the greatest belt speed that is accepted.
    """
    plant = parameters.plant

    def sticks_again(speed: float) -> bool:
        ends = balance_points(parameters, 2.0 * parameters.beta * speed, parameters.mu_s)
        if not ends or kernel.spring(plant, ends[-1])[1] <= 0.0:
            return False
        return bool(kernel.slip_returns_to_stick(plant, speed, ends[-1]))

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
