"""Attractors of the passive oscillator: the one that a start reaches, and all of them."""

import contextlib
import functools
import itertools
import math
from typing import NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.orbits.balance import (
    SMALLEST_RADIUS,
    Equilibrium,
    check_unexcited,
    conserves_energy,
    equilibria,
    search_radius,
    slip_dissipates,
    stick_intervals,
    traps_of,
)
from sd_friction_env.physics.orbits.cycles import (
    ContactLossError,
    LimitCycle,
    OrbitError,
    slip_cycle,
    steady_state,
    stick_slip_cycle,
)
from sd_friction_env.physics.orbits.return_map import LapKind, LapRange, NoLapError, ReturnMap, sections
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_number

_LONG_SETTLING_LAPS = 800
_MOST_SETTLINGS = 200


def limit_cycle(parameters: OscillatorParameters, x: float = 0.0, v: float | None = None) -> LimitCycle:
    """Return the attractor that the passive oscillator reaches from (x, v), or the neutral orbit that it is on.

    Args:
        parameters: of the oscillator.
        x, v: the start, in [-10, 10]; by default a mass set down at x = 0 that moves with the belt.

    Raises:
        ContactLossError: an OrbitError, if the motion loses contact (N <= 0).
        OrbitError: if the motion does not settle.
        TypeError, ValueError: if x or v is not a number in its range, or the oscillator is excited.
    """
    check_unexcited(parameters)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    v = parameters.belt_speed if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    return limit_of_motion(parameters, x, v)


def limit_of_motion(parameters: OscillatorParameters, x: float, v: float) -> LimitCycle:
    """Return the attractor as :func:`limit_cycle` does, from a state in any range."""
    at_x, at_v = x, v
    laps = kernel.SETTLING_LAPS
    conserved, traps = conserves_energy(parameters), traps_of(parameters)
    for _ in range(_MOST_SETTLINGS):
        outcome, place, previous, lowest = kernel.iterate_to_attractor(
            parameters.plant, parameters.belt_speed, at_x, at_v, laps, np.empty(kernel.SETTLING_EXITS), traps
        )
        if outcome == kernel.REPEATED_BREAKAWAY:
            return stick_slip_cycle(parameters, place, x, v)
        if outcome == kernel.AT_REST:
            return steady_state(parameters, "rest", place, x, v)
        if outcome == kernel.ORBIT_LOST_CONTACT:
            raise ContactLossError(f"the mass loses contact with the belt at x = {place:.6g} (N <= 0); {parameters}")
        if outcome == kernel.AT_EQUILIBRIUM:
            return steady_state(parameters, "neutral" if conserved else "steady-slip", place, x, v)
        if outcome == kernel.ORBIT_UNDECIDED:
            break
        if _is_neutral(parameters, place):
            return slip_cycle(parameters, place, x, v, "neutral")
        circled = [e for e in equilibria(parameters) if lowest <= e.x <= place]
        repeats = abs(place - previous) < kernel.TIME_ZERO and place - lowest > SMALLEST_RADIUS
        if repeats and not (circled and _drifts_past(parameters, place, circled[-1])):
            return slip_cycle(parameters, place, x, v)
        if not circled:
            at_x, at_v, laps = place, 0.0, _LONG_SETTLING_LAPS
            if abs(place - previous) < SMALLEST_RADIUS:
                return steady_state(parameters, "steady-slip", place, x, v)
            continue
        limit, place = _limit_of_maxima(parameters, previous, circled[-1])
        if limit == "pure-slip":
            return slip_cycle(parameters, place, x, v)
        if limit == "steady-slip":
            return steady_state(parameters, "steady-slip", place, x, v)
        at_x, at_v = place, 0.0
    raise OrbitError(f"the motion from x = {x!r}, v = {v!r} does not settle; {parameters}")


def _is_neutral(parameters: OscillatorParameters, x_max: float) -> bool:
    """Return whether a maximum of x belongs to a neutral orbit."""
    if not (conserves_energy(parameters) or any(e.has_roundoff_damping for e in equilibria(parameters))):
        return False
    left = [(centre, limits) for centre, limits in limits_of_slip(parameters) if centre < x_max]
    for limit in left[-1][1] if left else ():
        if x_max - left[-1][0] < limit.radius:
            return limit.cycle is not None and limit.cycle.kind == "neutral"
    return False


def _drifts_past(parameters: OscillatorParameters, place: float, centre: Equilibrium) -> bool:
    """Return whether maxima on both sides of one that repeats up to rounding move the same way: then it is no cycle."""
    if slip_dissipates(parameters):
        return True
    laps = ReturnMap(parameters, centre)
    radii = [(place - centre.x) * (1.0 + part) for part in (-0.01, 0.01)]
    below, above = ((radius, laps.shift(radius, None)) for radius in radii)
    if math.isnan(below[1] + above[1]):  # one of them sticks: the cycle touches the belt's speed
        return False
    return not (below[1] * above[1] < 0.0 and laps.is_resolved(*below) and laps.is_resolved(*above))


def _limit_of_maxima(parameters: OscillatorParameters, maximum: float, centre: Equilibrium) -> tuple[str, float]:
    """Return the limit of successive maxima of x from ``maximum`` on, which has a next one.

    ("pure-slip", fixed point), ("steady-slip", x), or ("on", the first maximum on the way from which the motion sticks
    or circles other equilibria).
    """
    laps = ReturnMap(parameters, centre)
    first = radius = maximum - centre.x
    kind, shift = laps.lap(radius)
    if kind is None:
        return "on", maximum
    if not laps.is_resolved(radius, shift):
        # Rounding hides what small orbits do: the equilibrium's linearisation decides, or greater orbits.
        shift = laps.first_resolved_shift(radius, kind) if centre.has_roundoff_damping else -centre.damping
    contracts = slip_dissipates(parameters)
    growing = shift > 0.0 and not contracts
    factor = 1.2 if growing else 0.5
    while (growing or factor * radius > 2.0 * centre.capture_radius) and radius < search_radius(parameters, centre):
        following, at_edge, cycle = _next_radius(laps, kind, radius, factor, contracts)
        if cycle is not None:
            return "pure-slip", centre.x + cycle
        if at_edge:
            beyond = following * (1.0 + (1e-12 if growing else -1e-12))
            # With several wells it matters where the motion itself passes the edge.
            several = len(laps.equilibrium_places) > 1
            return "on", centre.x + (laps.first_without_lap(first, kind) or beyond if several else beyond)
        radius = following
    if growing:
        return "on", centre.x + radius
    if centre.damping < 0.0 and not contracts:  # the equilibrium repels: there is a cycle too small to resolve
        return "pure-slip", centre.x + laps.small_cycle_radius(radius, kind)
    return "steady-slip", centre.x


def _next_radius(
    laps: ReturnMap, kind: LapKind, radius: float, factor: float, contracts: bool
) -> tuple[float, bool, float | None]:
    """Return the next radius on the way to a limit, whether laps end there, and the radius of a cycle passed."""
    growing = factor > 1.0
    following, at_edge = factor * radius, False
    while True:
        change = laps.shift(following, kind)
        if math.isnan(change):
            # Up to the last orbit with a lap there can still be a cycle; if there is none, the motion passes it.
            following, at_edge = laps.edge(kind, radius, following), True
            change = laps.shift(following, kind)
        if (change > 0.0) == growing or contracts or not laps.is_resolved(following, change):
            return following, at_edge, None
        if not laps.is_resolved(radius, laps.shift(radius, kind)):
            return following, at_edge, laps.small_cycle_radius(following, kind)
        try:
            return following, at_edge, laps.root(kind, radius, following)
        except NoLapError as gap:
            following = gap.radius


def slip_cycles(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every pure-slip cycle, stable (|multiplier| < 1) and unstable.

    They are in ascending order of the equilibrium left of their maximum of x, then of size. The start recorded with
    each is its own maximum of x.
    """
    return [
        slip_cycle(parameters, section.equilibrium.x + radius)
        for section in sections(parameters)
        for part in section.ranges
        for radius in part.cycles
    ]


class SlipLimit(NamedTuple):
    """The limit of maxima of x nearer to an equilibrium than ``radius``, but not nearer than the last limit's radius.

    Either ``cycle``; or they leave these radii, with a maximum between the two radii ``leaves``; or, both None, it is
    unknown.
    """

    radius: float
    cycle: LimitCycle | None = None
    leaves: tuple[float, float] | None = None


@functools.lru_cache(maxsize=64)
def limits_of_slip(parameters: OscillatorParameters) -> list[tuple[float, list[SlipLimit]]]:
    """Return the limits of maxima of x right of each equilibrium that slip can circle, by ascending radius."""
    found = []
    for section in sections(parameters):
        centre = section.equilibrium.x
        limits: list[SlipLimit] = []
        for part in section.ranges:
            low, high = part.ends
            if low > 0.0:
                limits.append(SlipLimit(low))
            if part.neutral:
                # Slightly inside: on the edge itself, where the orbit touches the belt's speed, rounding decides.
                cycle = slip_cycle(parameters, centre + high - 1e-9 * (high - low), kind="neutral")
                limits.append(SlipLimit(high, cycle))
            else:
                limits += _limits_in(parameters, centre, part)
        found.append((centre, limits))
    return found


def _limits_in(parameters: OscillatorParameters, centre: float, part: LapRange) -> list[SlipLimit]:
    """Return the limits in one range: between its cycles maxima tend to the inner or to the outer one."""
    low, high = part.ends
    # A range's first radius and its last are fixed points only where the first is the equilibrium.
    if low == 0.0:
        inmost = SlipLimit(high, steady_state(parameters, "steady-slip", centre))
    else:
        inmost = SlipLimit(high, None, (part.after[0], min(low, part.after[1])))
    outmost = SlipLimit(high, None, (max(high, part.after[0]), part.after[1]))
    cycles = [SlipLimit(high, slip_cycle(parameters, centre + radius)) for radius in part.cycles]
    neighbours = itertools.pairwise([inmost, *cycles, outmost])
    return [
        (SlipLimit(radius), outer, inner)[tendency]._replace(radius=radius)
        for radius, tendency, (inner, outer) in zip((*part.cycles, high), part.tendencies, neighbours, strict=True)
    ]


def attractors(parameters: OscillatorParameters) -> list[LimitCycle]:
    """Return every attractor, each with a start that reaches it, in ascending order of the middle of its motion.

    A mass that sticks leaves from the right end of a stick interval, so the stick-slip cycles are found by following
    each of those ends once; what does not stick tends to a stable equilibrium or to a stable pure-slip cycle, or is
    one of a family of neutral orbits: each family is listed once, as its outermost orbit, of kind "neutral".

    Raises:
        ValueError: if the belt stands still (then every place in a stick interval is one of rest), or the oscillator
            is excited.
    """
    if parameters.belt_speed == 0.0:
        raise ValueError("belt_speed must be positive to list attractors, got 0.0: every stick interval is at rest")
    of_slip = [limit.cycle for _, limits in limits_of_slip(parameters) for limit in limits if limit.cycle is not None]
    candidates = [cycle for cycle in of_slip if cycle.kind == "neutral"]
    for _, right in stick_intervals(parameters):
        with contextlib.suppress(OrbitError):
            candidates.append(limit_of_motion(parameters, right, parameters.belt_speed))
    candidates += [
        steady_state(parameters, "steady-slip", section.equilibrium.x)
        for section in sections(parameters)
        if section.attracts
    ]
    found: list[LimitCycle] = []
    for cycle in candidates + of_slip:
        if not any(same_motion(cycle, other) for other in found):
            found.append(cycle)
    return sorted(found, key=lambda cycle: cycle.x_max + cycle.x_min)


def same_motion(a: LimitCycle, b: LimitCycle) -> bool:
    """Return whether two attractors of one oscillator are the same, or two neutral orbits of one family."""
    if a.kind != b.kind:
        return False
    if a.kind == "neutral":
        places = [e.x for e in equilibria(a.parameters)]
        arcs = a.parameters.plant.friction.breakaway_coefficient(-1) > 0.0
        first, second = (
            ([cycle.x_min <= x <= cycle.x_max for x in places], arcs and cycle.forward_arcs) for cycle in (a, b)
        )
        return first == second
    close = 1e-6 * min(1.0, max(1e-3, a.amplitude))
    return abs(a.x_max - b.x_max) < close and abs(a.x_min - b.x_min) < close
