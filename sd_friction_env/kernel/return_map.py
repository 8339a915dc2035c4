"""Attractors of the passive motion under a steady belt: stick-slip laps, maps of maxima, rest and equilibria."""

import math
from typing import NamedTuple

from sd_friction_env.kernel.automaton import mode_of
from sd_friction_env.kernel.codes import (
    CONTACT_LOSS,
    CONTACT_LOST,
    EVENT_LIMIT,
    LANDING,
    MAX_EVENTS,
    NO_EVENT,
    OK,
    SLIP_BACKWARD,
    SLIP_FORWARD,
    STEP_LIMIT,
    STICK,
    TIME_ZERO,
    TURNING,
)
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.forces import breakaway_mode, mode_at_zero_v_rel, normal_force, slip_acceleration
from sd_friction_env.kernel.plant import State, steady
from sd_friction_env.kernel.slip import TO_EVENT, TO_TURNING, slip_across
from sd_friction_env.kernel.stick import ride_across
from sd_friction_env.kernel.traps import TRAP_SLOPE, TRAP_X, trap_of

REPEATED_BREAKAWAY, STILL_SLIPPING, AT_REST, ORBIT_LOST_CONTACT, ORBIT_UNDECIDED, AT_EQUILIBRIUM = 0, 1, 2, 3, 4, 5

SAME_PLACE = 1e-9  # breakaway points closer than this are one
STICK_PATIENCE = 1e12  # a belt this slow never brings a stuck mass to breakaway
# Slip that takes longer from one turning point or landing to the next passes a fold, and is not decided.
SLIP_PATIENCE = 2000.0
FIRST_PIECE, CREEP_PIECE = 1e-3, 30.0  # of slip, after which it is seen whether it creeps into a node
STEPS_OF_A_PIECE, MOST_PIECES = 3e4, 400
SETTLING_LAPS, SETTLING_EXITS = 8, 64  # before a passive motion that still slips is looked at more closely


class Section(NamedTuple):
    """Where a slip turned, landed, lost contact or was held by a trap."""

    time: float
    x: float
    v: float
    event: int  # NO_EVENT: held, or not decided
    trap: int  # its number, or -1
    int_v2: float  # integral of v^2


class Settled(NamedTuple):
    """What a passive motion came to."""

    outcome: int
    x: float  # the breakaway point, the last maximum, or the place of rest or of the equilibrium
    previous_max: float
    last_min: float  # between the two maxima


class Lap(NamedTuple):
    """A lap from a breakaway to the same one."""

    outcome: int  # REPEATED_BREAKAWAY if it closed
    period: float
    stick_time: float
    x_min: float
    x_max: float
    x_restick: float  # the last one
    sticks: int
    forward_arcs: int
    int_v2: float


class NextMaximum(NamedTuple):
    """A slip from one maximum of x to the next."""

    event: int  # that ended it: TURNING if a maximum was reached
    x: float  # the maximum
    x_min: float  # between
    time: float
    int_v2: float
    forward_arcs: int


@compiled
def slip_to_section(plant, mode, x, v, v_belt, traps):
    """Slip with a steady belt until v changes sign, v_rel returns to zero, contact is lost or one of the ``traps``
    holds the motion. Return the time spent, x, v, the event (NO_EVENT: held, or not decided), the trap or -1, and the
    integral of v^2."""
    belt = steady(v_belt)
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
            return Section(t, x, v, NO_EVENT, trap, int_v2)
        rate = abs(2.0 * plant.beta + normal_force(plant, x) * plant.friction.slope(mode, v - v_belt))
        piece = min(patience, STEPS_OF_A_PIECE / max(rate, 1.0))
        leg = slip_across(plant, mode, State(x, v), belt, piece, TO_TURNING)
        x, v, event = leg.x, leg.v, leg.event
        t += leg.time
        int_v2 += leg.int_v2
        patience = min(2.0 * patience, longest)
        if event != NO_EVENT:
            return Section(t, x, v, event, -1, int_v2)
        if t >= SLIP_PATIENCE:
            break
    return Section(t, x, v, NO_EVENT, trap_of(traps, mode, x, v), int_v2)


@entry
def iterate_to_attractor(plant, v_belt, x, v, turnings, exits, traps):
    """Follow the passive motion until it breaks away where it did before, slips through ``turnings`` maxima of x, or
    one of the ``traps`` (m, TRAP_ROW) holds it.

    A mass that sticks forgets its past, so a repeated breakaway point closes a stick-slip cycle. ``exits`` is scratch
    space of shape (n,) for the breakaway points met. Return the outcome, x (the breakaway point, the last maximum or
    the place of rest or of the equilibrium), the maximum before the last, and the minimum between.
    """
    belt = steady(v_belt)
    mode = mode_of(plant, State(x, v), belt)
    n_exits = 0
    maxima = 0
    last_max = math.nan
    previous_max = math.nan
    last_min = math.nan
    if normal_force(plant, x) <= 0.0:
        return Settled(ORBIT_LOST_CONTACT, x, math.nan, math.nan)
    for _ in range(100 * turnings):
        if mode == STICK:
            dt, event = ride_across(plant, x, v_belt, STICK_PATIENCE)
            if event == NO_EVENT:
                return Settled(AT_REST, x, math.nan, math.nan)
            x = x + v_belt * dt
            for i in range(n_exits):
                if abs(exits[i] - x) < SAME_PLACE:
                    return Settled(REPEATED_BREAKAWAY, x, math.nan, math.nan)
            if n_exits == len(exits):
                return Settled(ORBIT_UNDECIDED, x, math.nan, math.nan)
            exits[n_exits] = x
            n_exits += 1
            v = v_belt
            mode = breakaway_mode(plant, x, belt)
            maxima = 0
            last_max = math.nan
            continue
        _, x, v, event, trap, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
        if event == LANDING:
            mode = mode_at_zero_v_rel(plant, x, belt)
        elif event == TURNING:
            acceleration = slip_acceleration(plant, mode, State(x, 0.0), belt)
            if acceleration < 0.0:
                previous_max = last_max
                last_max = x
                maxima += 1
                if maxima >= turnings or abs(last_max - previous_max) < TIME_ZERO:
                    return Settled(STILL_SLIPPING, last_max, previous_max, last_min)
            else:
                last_min = x
        elif event == CONTACT_LOSS:
            return Settled(ORBIT_LOST_CONTACT, x, math.nan, math.nan)
        elif trap >= 0:
            return Settled(AT_EQUILIBRIUM, traps[trap, TRAP_X], math.nan, math.nan)
        else:
            return Settled(ORBIT_UNDECIDED, x, math.nan, math.nan)
    return Settled(ORBIT_UNDECIDED, x, math.nan, math.nan)


@entry
def stick_slip_lap(plant, v_belt, x_exit):
    """Follow a stick-slip cycle from the breakaway point ``x_exit`` until it breaks away there again.

    Return the outcome (REPEATED_BREAKAWAY if it closed), the period, the time stuck, the least and greatest x, the
    place of the last re-stick, the number of sticks, the number of forward-slip arcs and the integral of v^2.
    """
    belt = steady(v_belt)
    x = x_exit
    v = v_belt
    mode = breakaway_mode(plant, x, belt)
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
                return Lap(REPEATED_BREAKAWAY, t, stick_time, x_min, x_max, x_restick, sticks, forward_arcs, int_v2)
            mode = breakaway_mode(plant, x, belt)
            if mode == SLIP_FORWARD:
                forward_arcs += 1
            v = v_belt
            continue
        leg = slip_across(plant, mode, State(x, v), belt, SLIP_PATIENCE, TO_EVENT)
        x, v, event = leg.x, leg.v, leg.event
        t += leg.time
        int_v2 += leg.int_v2
        x_min = min(x_min, leg.x_min)
        x_max = max(x_max, leg.x_max)
        if event != LANDING:
            break
        mode = mode_at_zero_v_rel(plant, x, belt)
        if mode == STICK:
            x_restick = x
        elif mode == SLIP_FORWARD:
            forward_arcs += 1
    return Lap(ORBIT_UNDECIDED, t, stick_time, x_min, x_max, x_restick, sticks, forward_arcs, int_v2)


@entry
def next_maximum(plant, v_belt, x, traps):
    """Return map of slip: from a maximum of x (v = 0) to the next one, without a stick between.

    Return the event that ended it (TURNING if a maximum was reached), the next maximum, the minimum between, the
    time taken, the integral of v^2 and the number of forward arcs. A first arc that rises (x is no maximum), or that
    one of the ``traps`` (m, TRAP_ROW) holds, is not followed: the event is NO_EVENT.
    """
    belt = steady(v_belt)
    mode = mode_of(plant, State(x, 0.0), belt)
    acceleration = slip_acceleration(plant, mode, State(x, 0.0), belt)
    if mode != SLIP_BACKWARD or acceleration >= 0.0 or normal_force(plant, x) <= 0.0:
        return NextMaximum(NO_EVENT, math.nan, math.nan, math.nan, math.nan, 0)
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
            mode = mode_at_zero_v_rel(plant, x, belt)
            if mode == STICK:
                return NextMaximum(event, math.nan, x_low, t, int_v2, forward_arcs)
            if mode == SLIP_FORWARD:
                forward_arcs += 1
        elif event == TURNING and slip_acceleration(plant, mode, State(x, 0.0), belt) >= 0.0:
            x_low = x
        else:
            return NextMaximum(event, x if event == TURNING else math.nan, x_low, t, int_v2, forward_arcs)
    return NextMaximum(NO_EVENT, math.nan, x_low, t, int_v2, forward_arcs)


@entry
def slip_returns_to_stick(plant, v_belt, x, traps):
    """Whether a mass that breaks away at x sticks again before it has slipped through one more full lap, or is held by
    one of the ``traps``."""
    belt = steady(v_belt)
    v = v_belt
    mode = breakaway_mode(plant, x, belt)
    maxima = 0
    for _ in range(MAX_EVENTS):
        _, x, v, event, _, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
        if event == LANDING:
            mode = mode_at_zero_v_rel(plant, x, belt)
            if mode == STICK:
                return True
        elif event == TURNING:
            if slip_acceleration(plant, mode, State(x, 0.0), belt) < 0.0:
                maxima += 1
                if maxima == 2:
                    return False
        else:
            return False
    return False


@entry
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
    belt = steady(v_belt)
    for n in range(len(xs)):
        x = xs[n]
        v = vs[n]
        label = -2
        mode = mode_of(plant, State(x, v), belt)
        if normal_force(plant, x) <= 0.0:
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
                mode = mode_at_zero_v_rel(plant, x, belt)
            elif event == TURNING:
                if mode == SLIP_BACKWARD and slip_acceleration(plant, mode, State(x, 0.0), belt) < 0.0:
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


@entry
def maxima(plant, x, v, v_belt, places, traps):
    """Follow a motion without excitation and write its maxima of x into ``places`` (n,); one that comes to rest on the
    belt, or in slip where one of the ``traps`` (m, TRAP_ROW) holds it, fills what is left with its place. Return the
    status and how many were written."""
    belt = steady(v_belt)
    mode = mode_of(plant, State(x, v), belt)
    if normal_force(plant, x) <= 0.0:
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
            mode = STICK if rests else breakaway_mode(plant, x, belt)
        else:
            _, x, v, event, trap, _ = slip_to_section(plant, mode, x, v, v_belt, traps)
            rests = trap >= 0
            x = traps[trap, TRAP_X] if rests else x
            if event == LANDING:
                mode = mode_at_zero_v_rel(plant, x, belt)
            elif event == TURNING:
                if slip_acceleration(plant, mode, State(x, 0.0), belt) < 0.0:
                    places[n] = x
                    n += 1
            elif not rests:
                return CONTACT_LOST if event == CONTACT_LOSS else STEP_LIMIT, n
        if rests:
            places[n:] = x
            return OK, len(places)
    return EVENT_LIMIT, n
