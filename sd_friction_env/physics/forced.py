"""Motion under excitation: stroboscopic sections, periodic orbits, Lyapunov exponents, bifurcation diagrams, basins.

A section is taken once a cycle of the excitation, at a fixed phase. The tangent flow behind exponents and multipliers
has the jumps (saltation) that landing, crossing, breakaway and the switch at x = 0 (alpha = 0) put into it; see Leine
and Nijmeijer: Dynamics and Bifurcations of Non-Smooth Mechanical Systems (2004). A stick leaves one direction of two:
the other's exponent is minus infinity. Where an event is touched and not passed (grazing) the derivative does not
exist: such events are counted in ``singular_events``, and passed over.
"""

import dataclasses
import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.orbits import OrbitError, equilibria, limit_cycle, traps_of
from sd_friction_env.physics.parameters import EXCITATIONS, RANGES, STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.physics.simulation import amplitude
from sd_friction_env.physics.tables import Table

FloatArray = NDArray[np.float64]
Direction = Literal["up", "down", "both"]

LOST_CONTACT, UNDECIDED = -1, -2  # labels of starts

_MOST_CYCLES = 10_000_000
_LONGEST_PERIOD = 1e4
_BATCHES = 20  # whose means give an exponent's standard error
_SAME_FREQUENCY = 1e-12
_SAME_POINT = 1e-6  # section points closer than this repeat, before Newton has its say
_CONVERGED = 1e-10
_NEWTON_STEPS = 25
_SETTLINGS = 8  # before a motion that repeats nothing is said not to settle
_SAMPLED_STARTS = 64
_LEFT_STARTS = 8  # looked at one by one in each round
_CHAOS_CYCLES = 400
_ERRORS_FOR_CHAOS = 3.0
_STARTS_WORTH_A_THREAD = 200


@dataclass(frozen=True, kw_only=True)
class LyapunovExponent:
    """How fast neighbouring motions part (per unit of time).

    Attributes:
        largest: the largest nontrivial exponent. Under excitation the phase is no state, and both exponents count;
            without, the one along the flow is 0 and left out. Minus infinity where sticking leaves no other direction.
        standard_error: of ``largest``, from the means of 20 batches; 0 where it follows from one period.
        exponents: both, the greater first; the second is minus infinity where the motion sticks.
        cycles: of the excitation that were averaged over; 0 without excitation.
        singular_events: events on the way without a derivative (grazing); they are passed over.
        x, v: the state at the end.
        parameters: of the oscillator.
    """

    largest: float
    standard_error: float
    exponents: tuple[float, float]
    cycles: int
    singular_events: int
    x: float
    v: float
    parameters: OscillatorParameters


@dataclass(frozen=True, kw_only=True, eq=False)
class ForcedOrbit:
    """A periodic motion under excitation.

    Attributes:
        multiple: how many cycles of the excitation one period takes. period: that time.
        x, v: the state at the section's phase. phase: that phase, a share of the excitation's cycle.
        points: the section points (x, v) of one period, (multiple, 2); the first is (x, v).
        amplitude, x_min, x_max: (x_max - x_min)/2 and the extremes of x.
        stick_fraction: share of the period spent stuck. sticks, forward_arcs: how many begin in a period.
        multipliers: Floquet multipliers, the greater modulus first; the second is 0 where the motion sticks.
        stable: whether both moduli are less than 1.
        singular_events: events in a period without a derivative; the multipliers mean nothing unless it is 0.
        parameters: of the oscillator.
    """

    multiple: int
    period: float
    x: float
    v: float
    phase: float
    points: FloatArray
    amplitude: float
    x_min: float
    x_max: float
    stick_fraction: float
    sticks: int
    forward_arcs: int
    multipliers: tuple[complex, complex]
    stable: bool
    singular_events: int
    parameters: OscillatorParameters


@dataclass(frozen=True, kw_only=True, eq=False)
class ForcedBasins:
    """Which attractor of the stroboscopic map the starts on a grid reach.

    Attributes:
        x, v: axes of the grid, shapes (n,) and (m,).
        labels: of each start, (m, n): index into ``attractors``; len(attractors) for chaos; -1 the mass loses contact,
            -2 not decided.
        attractors: the periodic ones, the left-most first. chaos: the exponent of the chaotic one, or None.
        parameters: of the oscillator.
    """

    x: FloatArray
    v: FloatArray
    labels: NDArray[np.int64]
    attractors: tuple[ForcedOrbit, ...]
    chaos: LyapunovExponent | None
    parameters: OscillatorParameters

    def fraction(self, label: int) -> float:
        """Return the share of starts with a label."""
        return float((self.labels == label).mean())


# What is asked for ----------------------------------------------------------------------------------------------------


def _acting(parameters: OscillatorParameters, swept: str = "") -> list[str]:
    """Return which excitations act, or will where an amplitude is swept."""
    names = [f"{kind}_amplitude" for kind in EXCITATIONS]
    return [name.split("_")[0] for name in names if getattr(parameters, name) > 0.0 or name == swept]


def drive_period(parameters: OscillatorParameters) -> float:
    """Return the period of the excitation, 2 pi/frequency.

    Raises:
        ValueError: without excitation, or if several act with different frequencies.
    """
    return _drive_period(parameters, _acting(parameters))


def _drive_period(parameters: OscillatorParameters, acting: list[str]) -> float:
    rates = {f"{kind}_frequency": float(getattr(parameters, f"{kind}_frequency")) for kind in acting}
    if not rates:
        raise ValueError(
            "parameters must be excited (force_amplitude, ripple_amplitude or stiffness_amplitude over 0), "
            f"got {parameters!r}; without, see sd_friction_env.physics.orbits"
        )
    low, high = min(rates.values()), max(rates.values())
    if high - low > _SAME_FREQUENCY * high:
        shown = ", ".join(f"{name} = {rate!r}" for name, rate in rates.items())
        raise ValueError(f"period= must be given where excitations have different frequencies, got {shown}")
    return 2.0 * math.pi / low


def _checked_period(parameters: OscillatorParameters, period: float | None, repeats: bool) -> float:
    """Return the time between sections; ``repeats``: the excitation must be the same after it."""
    if period is None:
        return drive_period(parameters)
    period = checked_number("period", period, 1e-3, _LONGEST_PERIOD)
    for kind in _acting(parameters) if repeats else ():
        turns = period * getattr(parameters, f"{kind}_frequency") / (2.0 * math.pi)
        if abs(turns - round(turns)) > 1e-9 * max(1.0, turns) or round(turns) < 1:
            raise ValueError(
                f"period must be a multiple of 2 pi/{kind}_frequency, so that the excitation repeats, got {period!r}"
            )
    return period


def _checked_count(name: str, value: Any, low: int, high: int = _MOST_CYCLES) -> int:
    number = checked_number(name, value, low, high)
    if number != int(number):
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {value!r}")
    return int(number)


def _checked_phase(phase: float) -> float:
    phase = checked_number("phase", phase, 0.0, 1.0)
    if phase == 1.0:
        raise ValueError("phase must be in [0, 1), a share of the excitation's cycle, got 1.0")
    return phase


def _checked_start(parameters: OscillatorParameters, x: float, v: float | None, time: float) -> tuple[float, float]:
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    if v is None:
        return x, float(_plant(parameters, time).excitation.lab_velocity(parameters.belt_speed))
    return x, checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)


def _plant(parameters: OscillatorParameters, time: float = 0.0) -> kernel.Plant:
    # Always the general form of the kernel, so that one form of what is here is compiled.
    return parameters.excited_plant(time)


def _lost(parameters: OscillatorParameters, x: float, v: float, status: int, cycle: int) -> OrbitError:
    reason = {kernel.CONTACT_LOST: "the mass loses contact with the belt (N <= 0)"}.get(
        status, f"the motion cannot be followed ({kernel.STATUS_NAMES[status]})"
    )
    return OrbitError(f"{reason} at x = {x:.6g}, v = {v:.6g} in cycle {cycle}; {parameters}")


def _followed(
    parameters: OscillatorParameters,
    state: tuple[float, float],
    period: float,
    phase: float,
    transient: int,
    cycles: int,
    growing: bool,
) -> tuple[FloatArray, FloatArray, int]:
    """Return what the kernel's stroboscope writes of ``cycles`` cycles after a transient, (n, 8), the logarithms of
    growth, (n, 2) or (0, 2), and the number of events without a derivative."""
    rows = np.empty((cycles, kernel.CYCLE_ROW))
    growth = np.empty((cycles if growing else 0, 2))
    x, v, status, written, singular = kernel.stroboscope(
        _plant(parameters, phase * period), *state, parameters.belt_speed, period, transient, rows, growth
    )
    if status != kernel.OK:
        raise _lost(parameters, x, v, status, transient + written)
    return rows, growth, int(singular)


# Sections and periodic orbits -----------------------------------------------------------------------------------------


def poincare_section(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 200,
    phase: float = 0.0,
    period: float | None = None,
) -> Table:
    """Return the states at one phase of the excitation's cycles.

    Args:
        parameters: of the oscillator.
        x, v: the start, in [-10, 10], at the section's phase; v defaults to the belt's speed, ripple included.
        cycles: how many are written down, from 1 on. transient: how many are followed before, from 0 on.
        phase: of the section, in [0, 1): a share of the cycle, counted from t = 0.
        period: time between sections; by default :func:`drive_period`.

    Returns:
        A table with a row for each cycle: cycle, x, v and mode at its end; stick_fraction, sticks and forward_arcs (how
        many begin), x_min and x_max in it.

    Raises:
        OrbitError: if the mass loses contact.
        TypeError, ValueError: if an argument is not as said.
    """
    cycles, transient = _checked_count("cycles", cycles, 1), _checked_count("transient", transient, 0)
    phase, period = _checked_phase(phase), _checked_period(parameters, period, repeats=False)
    state = _checked_start(parameters, x, v, phase * period)
    rows, _, _ = _followed(parameters, state, period, phase, transient, cycles, growing=False)
    columns: dict[str, Any] = {
        "cycle": np.arange(transient, transient + cycles),
        "x": rows[:, kernel.CYCLE_X],
        "v": rows[:, kernel.CYCLE_V],
        "mode": rows[:, kernel.CYCLE_MODE].astype(np.int8),
        "stick_fraction": rows[:, kernel.CYCLE_STICK_TIME] / period,
        "sticks": rows[:, kernel.CYCLE_STICKS].astype(np.int64),
        "forward_arcs": rows[:, kernel.CYCLE_FORWARD_ARCS].astype(np.int64),
        "x_min": rows[:, kernel.CYCLE_X_MIN],
        "x_max": rows[:, kernel.CYCLE_X_MAX],
    }
    return Table(columns, {"parameters": dataclasses.asdict(parameters), "period": period, "phase": phase})


def forced_orbit(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    multiple: int | None = None,
    most: int = 32,
    transient: int = 200,
    phase: float = 0.0,
    period: float | None = None,
) -> ForcedOrbit:
    """Return the periodic orbit that the motion from (x, v) settles on, or near which it starts.

    After the transient, Newton's method on the stroboscopic map with its tangent closes the orbit to 1e-10; a motion
    that sticks is there as soon as its sticks repeat.

    Args:
        parameters, x, v, phase: as in :func:`poincare_section`.
        multiple: period of the orbit in cycles of the excitation, from 1 on; by default the least that the settled
            motion repeats after. With it and transient = 0 unstable orbits are found too, from a start near by.
        most: the greatest multiple that is looked for.
        transient: cycles followed before, from 0 on.
        period: as in :func:`poincare_section`; the excitation must repeat after it.

    Raises:
        OrbitError: if the mass loses contact, or no such orbit is reached.
        TypeError, ValueError: if an argument is not as said.
    """
    if multiple is not None:
        multiple = _checked_count("multiple", multiple, 1, 10_000)
    most, transient = _checked_count("most", most, 1, 10_000), _checked_count("transient", transient, 0)
    phase, period = _checked_phase(phase), _checked_period(parameters, period, repeats=True)
    state = _checked_start(parameters, x, v, phase * period)
    if multiple is not None:
        if transient:
            rows, _, _ = _followed(parameters, state, period, phase, transient - 1, 1, growing=False)
            state = float(rows[-1, 0]), float(rows[-1, 1])
        found = _closed(parameters, state, multiple, period, phase)
        if found is None:
            raise OrbitError(
                f"no orbit of multiple {multiple} near x = {state[0]:.6g}, v = {state[1]:.6g}; {parameters}"
            )
        return found
    for _ in range(_SETTLINGS):
        rows, _, _ = _followed(parameters, state, period, phase, transient, 2 * most, growing=False)
        points = rows[:, :2]
        state = float(points[-1, 0]), float(points[-1, 1])
        for candidate in range(1, most + 1):
            if np.abs(points[candidate:] - points[:-candidate]).max() < _SAME_POINT:
                found = _closed(parameters, state, candidate, period, phase)
                if found is not None:
                    return found
                break
    raise OrbitError(f"the motion from x = {x!r} does not settle on an orbit of multiple up to {most}; {parameters}")


def _lap(
    parameters: OscillatorParameters,
    state: tuple[float, float],
    multiple: int,
    period: float,
    phase: float,
    in_sections: bool = True,
) -> tuple[Any, FloatArray]:
    """Return what the kernel's walk does over ``multiple`` cycles, and the tangent map (2, 2)."""
    vectors = np.eye(2)
    events = np.empty((kernel.MAX_EVENTS, 4))
    end = kernel.integrate_with_tangents(
        _plant(parameters, phase * period),
        *state,
        parameters.belt_speed,
        multiple * period,
        events,
        vectors,
        in_sections,
    )
    return end, vectors.T


def _closed(
    parameters: OscillatorParameters, state: tuple[float, float], multiple: int, period: float, phase: float
) -> ForcedOrbit | None:
    """Return the orbit of this multiple that Newton's method finds from a state, or None."""
    start = np.array(state)
    for _ in range(_NEWTON_STEPS):
        place = float(start[0]), float(start[1])
        end, tangent = _lap(parameters, place, multiple, period, phase, in_sections=False)
        if end.status != kernel.OK:
            return None
        error = np.array(end[:2]) - start
        if np.abs(error).max() < _CONVERGED:
            break
        try:
            step = np.linalg.solve(np.eye(2) - tangent, error)
        except np.linalg.LinAlgError:
            return None
        start = start + step
        if not np.abs(start).max() <= STATE_LIMIT:
            return None
    else:
        return None
    end, tangent = _lap(parameters, place, multiple, period, phase)
    rows, _, _ = _followed(parameters, place, period, phase, 0, multiple, growing=False)
    points = np.concatenate((start[None, :], rows[:-1, :2]))
    for divisor in range(1, multiple):
        if multiple % divisor == 0 and np.abs(points[divisor] - start).max() < 10.0 * _CONVERGED:
            return _closed(parameters, place, divisor, period, phase)
    if end.ever_stuck:
        first, second = complex(np.trace(tangent)), 0j
    else:
        first, second = sorted((complex(m) for m in np.linalg.eigvals(tangent)), key=abs, reverse=True)
    return ForcedOrbit(
        multiple=multiple,
        period=multiple * period,
        x=place[0],
        v=place[1],
        phase=phase,
        points=points,
        amplitude=amplitude(end.x_min, end.x_max),
        x_min=end.x_min,
        x_max=end.x_max,
        stick_fraction=end.stick_time / end.time,
        sticks=end.sticks,
        forward_arcs=end.forward_arcs,
        multipliers=(first, second),
        stable=abs(first) < 1.0,
        singular_events=end.singular_events,
        parameters=parameters,
    )


# Exponents ------------------------------------------------------------------------------------------------------------


def lyapunov_exponent(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 200,
    period: float | None = None,
) -> LyapunovExponent:
    """Return the Lyapunov exponents of the motion that starts at (x, v), from the tangent flow.

    Without excitation the attractor's own period or eigenvalues give them exactly: a steady state the greatest real
    part, a pure-slip cycle ln|Floquet multiplier|/period, a stick-slip cycle minus infinity, and a mass at rest on a
    belt that stands, which is neutral, 0.

    Args:
        parameters: of the oscillator.
        x, v: the start, as in :func:`poincare_section`, at t = 0.
        cycles: of the excitation to average over, from 20 on. transient: to follow before, from 0 on.
        period: of renormalisation; by default :func:`drive_period`.

    Raises:
        OrbitError: if the mass loses contact, or an unexcited motion does not settle.
        TypeError, ValueError: if an argument is not as said.
    """
    cycles, transient = _checked_count("cycles", cycles, _BATCHES), _checked_count("transient", transient, 0)
    if not parameters.excited:
        return _passive_exponent(parameters, x, v)
    period = _checked_period(parameters, period, repeats=False)
    state = _checked_start(parameters, x, v, 0.0)
    rows, growth, singular = _followed(parameters, state, period, 0.0, transient, cycles, growing=True)
    return _exponent_of(parameters, rows, growth, period, singular)


def _exponent_of(
    parameters: OscillatorParameters, rows: FloatArray, growth: FloatArray, period: float, singular: int
) -> LyapunovExponent:
    first, second = (float(rate) for rate in growth.mean(axis=0) / period)
    error = 0.0
    if math.isfinite(first):
        used = len(growth) // _BATCHES * _BATCHES
        means = growth[len(growth) - used :, 0].reshape(_BATCHES, -1).mean(axis=1) / period
        error = float(means.std(ddof=1)) / math.sqrt(_BATCHES)
    return LyapunovExponent(
        largest=max(first, second),
        standard_error=error,
        exponents=(max(first, second), min(first, second)),
        cycles=len(rows),
        singular_events=singular,
        x=float(rows[-1, kernel.CYCLE_X]),
        v=float(rows[-1, kernel.CYCLE_V]),
        parameters=parameters,
    )


def _passive_exponent(parameters: OscillatorParameters, x: float, v: float | None) -> LyapunovExponent:
    cycle = limit_cycle(parameters, x, v)
    at = cycle.x_phase0, cycle.v_phase0
    singular = 0
    if cycle.kind == "pure-slip":
        end, tangent = _lap(parameters, at, 1, cycle.period, 0.0)
        singular = int(end[-1])
        # One multiplier is 1, along the flow.
        largest = math.log(abs(float(np.linalg.det(tangent)))) / cycle.period
        exponents = (0.0, largest) if largest < 0.0 else (largest, 0.0)
    elif cycle.kind == "steady-slip":
        place = min(equilibria(parameters), key=lambda e: abs(e.x - cycle.x_max))
        parts = sorted((value.real for value in place.eigenvalues), reverse=True)
        largest, exponents = parts[0], (parts[0], parts[1])
    elif cycle.kind == "neutral":
        largest, exponents = 0.0, (0.0, 0.0)
    elif cycle.kind == "rest":
        largest, exponents = 0.0, (0.0, -math.inf)
    else:
        largest, exponents = -math.inf, (0.0, -math.inf)
    return LyapunovExponent(
        largest=largest,
        standard_error=0.0,
        exponents=exponents,
        cycles=0,
        singular_events=singular,
        x=at[0],
        v=at[1],
        parameters=parameters,
    )


# Sweeps ---------------------------------------------------------------------------------------------------------------


def bifurcation_diagram(
    parameters: OscillatorParameters,
    name: str,
    values: ArrayLike,
    *,
    direction: Direction = "up",
    cycles: int = 100,
    transient: int = 200,
    x: float = 0.0,
    v: float | None = None,
    lyapunov: bool = False,
    period: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Return section points over a parameter, each value starting from the last state of the one before.

    Under excitation the section is stroboscopic, at phase 0. Without it, it is the maxima of x (v = 0 there), one a
    cycle counted as such; a motion that comes to rest fills its rows with that place.

    Args:
        parameters: of the oscillator; what they say of ``name`` is not used.
        name: of a number among the parameters. values: of shape (n,), in any order.
        direction: "up" goes through them ascending, "down" descending, "both" up and then, from there, down.
        cycles: rows of each value, from 1 on (20 with ``lyapunov``). transient: cycles followed before, from 0 on.
        x, v: the start at the first value, and again after a value at which the mass loses contact.
        lyapunov: whether to tell the largest exponent of each value too.
        period: time between sections; by default that of the excitation at each value.
        progress: called with the values done and the values in all after each.

    Returns:
        A table with the columns value, direction ("up" or "down"), cycle, x, v, stick_fraction (NaN without
        excitation), and with ``lyapunov`` exponent and standard_error. A value at which the mass loses contact is one
        row with x = v = NaN.

    Raises:
        TypeError, ValueError: if an argument is not as said.
    """
    if name not in RANGES:
        raise ValueError(f"name must be one of {', '.join(map(repr, RANGES))}, got {name!r}")
    if direction not in get_args(Direction):
        raise ValueError(f"direction must be one of {', '.join(map(repr, get_args(Direction)))}, got {direction!r}")
    cycles = _checked_count("cycles", cycles, _BATCHES if lyapunov else 1)
    transient = _checked_count("transient", transient, 0)
    _checked_start(parameters, x, v, 0.0)
    try:
        numbers = np.unique(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise TypeError(f"values must be numbers, got {values!r}") from None
    if np.ndim(values) != 1 or not numbers.size:
        raise ValueError(f"values must have shape (n,) with n >= 1, got shape {np.shape(values)}")
    plants = [parameters.replace(**{name: value}) for value in numbers.tolist()]
    acting = _acting(parameters, swept=name)
    if acting and period is None:
        periods = [_drive_period(plant, acting) for plant in plants]
    elif acting:
        periods = [_checked_period(plant, period, repeats=False) for plant in plants]
    else:
        periods = [0.0 for _ in plants]
    ways = {"up": ["up"], "down": ["down"], "both": ["up", "down"]}[direction]
    points = list(zip(numbers.tolist(), plants, periods, strict=True))
    parts: list[dict[str, Any]] = []
    state: tuple[float, float] | None = None
    for way in ways:
        for value, plant, time in points if way == "up" else points[::-1]:
            part, state = _section_at(
                plant, state or _checked_start(plant, x, v, 0.0), time, transient, cycles, lyapunov
            )
            rows = len(part["x"])
            parts.append({"value": np.full(rows, value), "direction": np.full(rows, way), **part})
            if progress is not None:
                progress(len(parts), len(ways) * len(points))
    columns = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
    section = "stroboscopic" if acting else "maxima of x"
    return Table(columns, {"parameters": dataclasses.asdict(parameters), "swept": name, "section": section})


def _section_at(
    plant: OscillatorParameters,
    state: tuple[float, float],
    period: float,
    transient: int,
    cycles: int,
    lyapunov: bool,
) -> tuple[dict[str, Any], tuple[float, float] | None]:
    """Return one value's columns, and the state to go on from, None after a loss of contact."""
    try:
        if period > 0.0:
            rows, growth, singular = _followed(plant, state, period, 0.0, transient, cycles, growing=lyapunov)
            exponent = _exponent_of(plant, rows, growth, period, singular) if lyapunov else None
            xs, vs, stuck = rows[:, kernel.CYCLE_X], rows[:, kernel.CYCLE_V], rows[:, kernel.CYCLE_STICK_TIME] / period
        else:
            places = np.empty(transient + cycles)
            status, written = kernel.maxima(_plant(plant), *state, plant.belt_speed, places, traps_of(plant))
            if status != kernel.OK:
                raise _lost(plant, *state, status, written)
            xs, vs, stuck = places[transient:], np.zeros(cycles), np.full(cycles, math.nan)
            exponent = lyapunov_exponent(plant, float(xs[-1]), 0.0) if lyapunov else None
    except OrbitError:
        cycles, exponent = 1, None
        xs = vs = stuck = np.full(1, math.nan)
    part: dict[str, Any] = {
        "cycle": np.arange(transient, transient + cycles),
        "x": xs,
        "v": vs,
        "stick_fraction": stuck,
    }
    if lyapunov:
        part["exponent"] = np.full(cycles, exponent.largest if exponent else math.nan)
        part["standard_error"] = np.full(cycles, exponent.standard_error if exponent else math.nan)
    return part, (float(xs[-1]), float(vs[-1])) if np.isfinite(xs[-1]) else None


# Basins ---------------------------------------------------------------------------------------------------------------


def forced_basins(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
    shape: tuple[int, int] = (100, 100),
    *,
    cycles: int = 200,
    tolerance: float = 1e-4,
    most: int = 32,
    phase: float = 0.0,
    period: float | None = None,
) -> ForcedBasins:
    """Return which attractor of the stroboscopic map each start on a grid reaches.

    Attractors are looked for among the ends of a sample of the starts, and of starts that reach none of those known.
    A start has the label of the first periodic one of whose section points it is within ``tolerance`` at the end of a
    cycle. One that is near none after ``cycles`` cycles is counted to the chaotic attractor, if a positive exponent
    (by three standard errors) showed one, and is undecided if not: a slow transient beside chaos is told from it only
    by more cycles.

    Args:
        parameters: of the oscillator.
        x_limits, v_limits: of the grid, both ends included, in [-10, 10]. shape: (n, m), whole numbers from 2 on.
        cycles: after which a start is given up, from 1 on. tolerance: in x and in v, in [1e-9, 0.1].
        most: the greatest multiple of the excitation's period that counts as periodic.
        phase, period: as in :func:`forced_orbit`.

    Raises:
        TypeError, ValueError: if an argument is not as said.
    """
    axes = []
    for name, limits, count in zip(("x_limits", "v_limits"), (x_limits, v_limits), shape, strict=True):
        low, high = (checked_number(name, limit, -STATE_LIMIT, STATE_LIMIT) for limit in limits)
        if not low < high:
            raise ValueError(f"{name} must have low < high, got {tuple(limits)}")
        axes.append(np.linspace(low, high, _checked_count("shape", count, 2, 100_000)))
    cycles, most = _checked_count("cycles", cycles, 1), _checked_count("most", most, 1, 10_000)
    tolerance = checked_number("tolerance", tolerance, 1e-9, 0.1)
    phase, period = _checked_phase(phase), _checked_period(parameters, period, repeats=True)
    grid_x, grid_v = np.meshgrid(*axes)
    xs, vs = grid_x.ravel(), grid_v.ravel()
    found: list[ForcedOrbit] = []
    chaos: LyapunovExponent | None = None

    def follow(which: NDArray[np.intp]) -> NDArray[np.int64]:
        """Move starts on, each until its label is known, and return the labels."""
        points = np.concatenate([np.empty((0, 2)), *(orbit.points for orbit in found)])
        owners = np.repeat(np.arange(len(found)), [orbit.multiple for orbit in found])
        moved_x, moved_v, reached = xs[which], vs[which], np.empty(len(which), dtype=np.int64)
        plant = _plant(parameters, phase * period)

        def part(one: slice) -> None:
            kernel.label_attractors(
                plant,
                moved_x[one],
                moved_v[one],
                parameters.belt_speed,
                period,
                cycles,
                points,
                owners,
                tolerance,
                reached[one],
            )

        # Starts do not know of each other: any number of threads gives the same labels.
        threads = min(os.cpu_count() or 1, len(which) // _STARTS_WORTH_A_THREAD)
        if threads < 2:
            part(slice(None))
        else:
            edges = np.linspace(0, len(which), 8 * threads + 1).astype(int).tolist()
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, itertools.starmap(slice, itertools.pairwise(edges))))
        xs[which], vs[which] = moved_x, moved_v
        return reached

    def look(which: NDArray[np.intp]) -> bool:
        """Look for attractors where starts have got to; return whether one is new."""
        nonlocal chaos
        new = False
        for i in which.tolist():
            state = float(xs[i]), float(vs[i])
            known = [points for orbit in found for points in orbit.points]
            if any(np.abs(point - state).max() <= tolerance for point in known):
                continue
            try:
                orbit = forced_orbit(parameters, *state, most=most, transient=0, phase=phase, period=period)
            except (OrbitError, ValueError):  # a state past STATE_LIMIT is one that goes on without end
                orbit = None
            if orbit is None:
                chaos = chaos or _chaos_from(parameters, state, phase, period)
            elif all(np.abs(point - orbit.points[0]).max() > tolerance for point in known):
                found.append(orbit)
                new = True
        return new

    sample = np.unique(np.linspace(0, xs.size - 1, _SAMPLED_STARTS).astype(np.intp))
    first = follow(sample)
    look(sample[first == UNDECIDED])
    labels = np.full(xs.size, UNDECIDED, dtype=np.int64)
    left = np.arange(xs.size)
    while left.size:
        labels[left] = follow(left)
        left = left[labels[left] == UNDECIDED]
        spread = left[np.unique(np.linspace(0, left.size - 1, _LEFT_STARTS).astype(np.intp))] if left.size else left
        if not look(spread):
            break
    if chaos is not None:
        labels[labels == UNDECIDED] = len(found)
    order = sorted(range(len(found)), key=lambda i: found[i].x_min)
    for label, its_own in enumerate([labels == i for i in order]):
        labels[its_own] = label
    return ForcedBasins(
        x=axes[0],
        v=axes[1],
        labels=labels.reshape(grid_x.shape),
        attractors=tuple(found[i] for i in order),
        chaos=chaos,
        parameters=parameters,
    )


def _chaos_from(
    parameters: OscillatorParameters, state: tuple[float, float], phase: float, period: float
) -> LyapunovExponent | None:
    try:
        rows, growth, singular = _followed(parameters, state, period, phase, 0, _CHAOS_CYCLES, growing=True)
    except OrbitError:
        return None
    exponent = _exponent_of(parameters, rows, growth, period, singular)
    return exponent if exponent.largest > _ERRORS_FOR_CHAOS * exponent.standard_error else None


# Dither ---------------------------------------------------------------------------------------------------------------


def dithered_amplitude(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 20_000,
) -> float:
    """Return the amplitude under a fast exciting force less that of the fast motion itself, f/Omega^2.

    Fast dither smooths the friction that drives the vibration: on the linear belt what is left falls to nothing once
    f/Omega passes :func:`theory.dither_threshold` (Thomsen: J. Sound Vib. 228 (1999) 1079-1102).

    Args:
        parameters: of the oscillator, with force_amplitude over 0.
        x, v: the start, as in :func:`poincare_section`.
        cycles: of the force in which the extremes of x are taken, from 1 on.
        transient: followed before, from 0 on; near v_b1, where the vibration dies out slowly, it takes many.

    Raises:
        OrbitError: if the mass loses contact.
        TypeError, ValueError: if an argument is not as said.
    """
    if parameters.force_amplitude == 0.0:
        raise ValueError(f"parameters must have force_amplitude over 0, got {parameters!r}")
    rate = parameters.force_frequency
    section = poincare_section(parameters, x, v, cycles=cycles, transient=transient, period=2.0 * math.pi / rate)
    whole = amplitude(float(section["x_min"].min()), float(section["x_max"].max()))
    return whole - parameters.force_amplitude / (rate * rate)
