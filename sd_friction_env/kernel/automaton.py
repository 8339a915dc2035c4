"""The slip/stick automaton: a state advanced under a held drive, its events included."""

from typing import NamedTuple

from sd_friction_env.kernel.codes import (
    BREAKAWAY,
    CONTACT_LOSS,
    CONTACT_LOST,
    CROSSING,
    EVENT_LIMIT,
    GRAZING,
    LANDING,
    MAX_EVENTS,
    NO_EVENT,
    OK,
    RESTICK,
    SLIP_TRIALS,
    STEP_DOUBLING,
    STEP_LIMIT,
    STEP_SIZE_UNDERFLOW,
    STICK,
    SWITCHING,
    UNKNOWN,
)
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.forces import breakaway_mode, mode_at_zero_v_rel, mode_in_belt_frame, normal_force
from sd_friction_env.kernel.plant import Drive, Plant, State, at_time, drive_at
from sd_friction_env.kernel.slip import TO_EVENT, UNTRIED, slip_until_event
from sd_friction_env.kernel.stick import NODES, WEIGHTS, stick_leg

WORK_TOLERANCE = 1e-8  # of the excitation's work over a piece, relative to its greatest power there
SHORTEST_PIECE = 1.0 / 4096.0  # of the motion over which that work is found, relative to the longest


class Motion(NamedTuple):
    """The end of a motion, and what happened over it."""

    x: float
    v: float
    v_belt: float
    mode: int
    status: int
    time: float  # reached: less than asked for only if the status is not OK
    n_events: int
    int_v2: float  # integral of v^2
    stick_time: float
    int_fv: float  # integral of the contact force's power
    x_min: float
    x_max: float


class Trace(NamedTuple):
    """How far a motion was sampled, and what happened over it."""

    samples: int
    events: int
    status: int
    time: float
    int_v2: float
    stick_time: float
    int_fv: float


@compiled
def mode_of(plant, state, drive):
    """Return the mode of a state: the sign of v_rel, or what the stick cone says where v_rel is zero."""
    x, v = plant.excitation.to_belt_frame(state.x, state.v, drive.v_belt)
    return mode_in_belt_frame(plant, State(x, v), drive)


@compiled
def with_clock_at_zero(plant):
    """Move the plant's time into its phases."""
    return Plant(plant.spring, plant.friction, plant.excitation.with_clock_at_zero(), plant.g1, plant.beta)


@compiled
def follow(plant, mode, state, drive, duration, events, trial):
    """:func:`advance` of a motion in this mode (UNKNOWN: that of the state).

    ``trial`` is of the slip it begins with, if it does.
    """
    t = 0.0
    n_events = 0
    int_v2 = 0.0
    int_fv = 0.0
    stick_time = 0.0
    x_min = state.x
    x_max = state.x
    there = drive
    status = OK
    trials = SLIP_TRIALS
    x, v = plant.excitation.to_belt_frame(state.x, state.v, drive.v_belt)
    if mode == UNKNOWN:
        mode = mode_in_belt_frame(plant, State(x, v), drive)
    elif mode == STICK:
        v = drive.v_belt
    if normal_force(plant, state.x) <= 0.0:
        return Motion(state.x, state.v, drive.v_belt, mode, CONTACT_LOST, 0.0, 0, 0.0, 0.0, 0.0, state.x, state.x)
    plant = with_clock_at_zero(plant)
    while t < duration:
        remaining = duration - t
        now = at_time(plant, t)
        if mode == STICK:
            leg = stick_leg(now, x, there, remaining)
            stick_time += leg.time
        else:
            leg = slip_until_event(now, mode, State(x, v), there, remaining, TO_EVENT, trials, trial)
            trials = leg.trials
            trial = UNTRIED
        x, v, event = leg.x, leg.v, leg.event
        int_v2 += leg.int_v2
        int_fv += leg.int_fv
        x_min = min(x_min, leg.x_min)
        x_max = max(x_max, leg.x_max)
        t = duration if event == NO_EVENT or leg.time >= remaining else t + leg.time
        there = drive_at(drive, t)
        then = at_time(plant, t)
        kind = event
        if mode == STICK:
            v = there.v_belt
            if event == BREAKAWAY:
                mode = breakaway_mode(then, x, there)
            elif event == SWITCHING:
                mode = mode_at_zero_v_rel(then, x, there)
        elif event == LANDING:
            v = there.v_belt
            landed = mode_at_zero_v_rel(then, x, there)
            kind = RESTICK if landed == STICK else (GRAZING if landed == mode else CROSSING)
            mode = landed
        elif event == NO_EVENT and v == there.v_belt:
            mode = mode_at_zero_v_rel(then, x, there)
        if event != NO_EVENT:
            if events is not None:
                if n_events < len(events):
                    events[n_events, 0] = t
                    events[n_events, 1] = kind
                    events[n_events, 2] = then.excitation.lab_position(x)
                    events[n_events, 3] = then.excitation.lab_velocity(v)
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
    at_end = plant.excitation.at_time(t)
    x = at_end.lab_position(x)
    v = at_end.lab_velocity(v)
    # A ripple's phase is rounded otherwise there.
    return Motion(
        x, v, there.v_belt, mode, status, t, n_events, int_v2, stick_time, int_fv, min(x_min, x), max(x_max, x)
    )


@entry
def advance(plant, state, drive, duration, events):
    """Advance a state by ``duration`` under a held force and a uniformly accelerating belt, events included.

    ``events`` is None, or an array of shape (n, 4) that takes time, kind, x and v of as many events as it has rows.
    """
    return follow(plant, UNKNOWN, state, drive, duration, events, UNTRIED)


@entry
def trace(plant, mode, state, drive, times, samples, events):
    """Follow one held interval and keep samples: x, v, v_belt and mode at each of ``times`` (n,), counted from 0.

    ``mode``: the mode so far, under the same drive; UNKNOWN where the drive has jumped.
    ``samples`` (n, 4) and ``events`` (m, 4) are filled; the sampling stops early while there is still room for
    another sample's events.
    """
    taken = 0
    n_events = 0
    int_v2 = 0.0
    stick_time = 0.0
    int_fv = 0.0
    status = OK
    t = 0.0
    x, v = state
    while taken < len(times) and status == OK and len(events) - n_events >= MAX_EVENTS:
        now = at_time(plant, t)
        motion = follow(now, mode, State(x, v), drive_at(drive, t), times[taken] - t, events[n_events:], UNTRIED)
        x, v, mode, status = motion.x, motion.v, motion.mode, motion.status
        for i in range(n_events, n_events + motion.n_events):
            events[i, 0] += t
        n_events += motion.n_events
        int_v2 += motion.int_v2
        stick_time += motion.stick_time
        int_fv += motion.int_fv
        with_belt = v == with_clock_at_zero(now).excitation.at_time(motion.time).lab_velocity(motion.v_belt)
        t = times[taken] if status == OK else t + motion.time
        belt = drive.v_belt + drive.a_belt * t  # by one formula, however the motion is cut into pieces
        if with_belt:
            v = plant.excitation.at_time(t).lab_velocity(belt)
        samples[taken, 0] = x
        samples[taken, 1] = v
        samples[taken, 2] = belt
        samples[taken, 3] = mode
        taken += 1
    return Trace(taken, n_events, status, t, int_v2, stick_time, int_fv)


@compiled
def _work_over(plant, state, drive, length):
    """Return the work of the excitation over a piece of the motion by Gauss's formula, and the greatest power met.

    Each node is reached from the beginning, so that no error adds up.
    """
    work = 0.0
    greatest = 0.0
    for j in range(5):
        motion = advance(plant, state, drive, NODES[j] * length, None)
        then = plant.excitation.at_time(NODES[j] * length)
        power = then.power(motion.v, plant.spring.potential(motion.x))
        work += WEIGHTS[j] * length * power
        greatest = max(greatest, abs(power))
    return work, greatest


@entry
def excitation_work(plant, state, drive, duration, events):
    """Return the work of the excitation over a motion that :func:`trace` has followed for ``duration``.

    It is that of the exciting force, and of what modulates the spring. ``events`` (m, 4) are the motion's events.
    Between them a piece is halved until its halves give the same work as the whole.
    """
    work = 0.0
    t = 0.0 if plant.excitation.has_power() else duration
    longest = plant.excitation.shortened(0.5, 0.05)
    for n in range(len(events) + 1):
        end = events[n, 0] if n < len(events) else duration
        piece = longest
        first = -1.0
        power = -1.0
        while t < end:
            last = end - t <= piece
            length = end - t if last else piece
            half = 0.5 * length
            now = at_time(plant, t)
            whole, greatest = first, power
            if power < 0.0:
                whole, greatest = _work_over(now, state, drive, length)
            first, power = _work_over(now, state, drive, half)
            middle = advance(now, state, drive, half, None)
            then = at_time(now, half)
            state_then = State(middle.x, middle.v)
            drive_then = Drive(middle.v_belt, drive.a_belt, drive.u)
            second, _ = _work_over(then, state_then, drive_then, half)
            error = abs(first + second - whole)
            allowed = WORK_TOLERANCE * length * max(greatest, power)
            if error > allowed and length > SHORTEST_PIECE * longest:
                piece = half
                continue
            work += first + second
            power = -1.0
            motion = advance(then, state_then, drive_then, half, None)
            state = State(motion.x, motion.v)
            drive = Drive(motion.v_belt, drive.a_belt, drive.u)  # to the bit, so that a stuck mass stays stuck
            if error < STEP_DOUBLING * allowed:
                piece = min(2.0 * piece, longest)
            t = end if last else t + length
    return work
