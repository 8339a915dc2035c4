"""Diagrams over a parameter, each value continued from the one before: section points, response of a forced motion."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from sd_friction_env import kernel
from sd_friction_env.physics.forced.exponents import BATCHES, LyapunovExponent, exponent_of, lyapunov_exponent
from sd_friction_env.physics.forced.sections import (
    MOST_CYCLES,
    Stroboscope,
    active_excitations,
    checked_period,
    common_period,
    lost_motion,
)
from sd_friction_env.physics.orbits import OrbitError, traps_of
from sd_friction_env.physics.parameters import RANGES, OscillatorParameters, checked_choice, checked_count
from sd_friction_env.physics.simulation import amplitude, simulate
from sd_friction_env.physics.tables import Table
from sd_friction_env.physics.theory import FloatArray

Direction = Literal["up", "down", "both"]
State: TypeAlias = tuple[float, float]

_SAMPLES_A_CYCLE = 512


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
) -> Table:
    """Return section points over a parameter, each value starting from the last state of the one before.

    Under excitation the section is stroboscopic, at phase 0. Without it, it is the maxima of x (v = 0 there), each
    counted as one cycle; a motion that comes to rest fills its rows with that place.

    Args:
        parameters: of the oscillator; the value of ``name`` is not used.
        name: of a number among the parameters.
        values: of shape (n,), in any order.
        direction: "up" takes them ascending, "down" descending, "both" up and then, from there, down.
        cycles: rows of each value, from 1 on (20 with ``lyapunov``).
        transient: cycles followed before, from 0 on.
        x, v: the start at the first value, and again after a value at which the mass loses contact.
        lyapunov: whether to add the largest exponent of each value.
        period: time between sections; by default that of the excitation at each value.

    Returns:
        A table with the columns value, direction ("up" or "down"), cycle, x, v, stick_fraction (NaN without
        excitation), and with ``lyapunov`` exponent and standard_error. A value at which the mass loses contact is one
        row with x = v = NaN.

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    checked_choice("name", name, tuple(RANGES))
    cycles = checked_count("cycles", cycles, BATCHES if lyapunov else 1, MOST_CYCLES)
    transient = checked_count("transient", transient, 0, MOST_CYCLES)
    points = _points(parameters, name, values, period)

    def measured(strobe: Stroboscope, state: State) -> tuple[dict[str, Any], State | None]:
        return _section_at(strobe, state, transient, cycles, lyapunov)

    columns = _continued(points, direction, measured, (x, v))
    section = "stroboscopic" if points[0][1].period > 0.0 else "maxima of x"
    return Table(columns, {"parameters": dataclasses.asdict(parameters), "swept": name, "section": section})


def response_curve(
    parameters: OscillatorParameters,
    name: str,
    values: ArrayLike,
    *,
    direction: Direction = "both",
    cycles: int = 32,
    transient: int = 200,
    x: float = 0.0,
    v: float | None = None,
) -> Table:
    """Return the response of a forced motion over a parameter, each value starting from the last state of the one
    before: where the ways up and down differ there is hysteresis.

    Args:
        parameters: of the oscillator, with one of the excitations acting.
        name: of a number among the parameters, such as "force_frequency".
        values, direction, transient, x, v: as of :func:`bifurcation_diagram`.
        cycles: of the excitation, over which each response is measured, from 1 on.

    Returns:
        A table with the columns value, direction, amplitude (half the distance between the extremes of x),
        first_harmonic (amplitude of x at the excitation's frequency), phase (of that harmonic after the excitation, in
        radians in (-pi, pi]; below 0 it lags), stick_fraction and note (why a row is NaN, else empty).

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above, or not one excitation acts.
    """
    checked_choice("name", name, tuple(RANGES))
    acting = active_excitations(parameters, swept=name)
    if len(acting) != 1:
        raise ValueError(f"parameters must have one excitation that acts, got {acting or 'none'}: {parameters!r}")
    cycles = checked_count("cycles", cycles, 1, MOST_CYCLES // _SAMPLES_A_CYCLE)
    transient = checked_count("transient", transient, 0, MOST_CYCLES)
    phase_name = f"{acting[0]}_phase"

    def measured(strobe: Stroboscope, state: State) -> tuple[dict[str, Any], State | None]:
        try:
            begin = strobe.follow(state, transient - 1, 1).end if transient else state
            recorded = strobe.follow(begin, 0, cycles)
        except OrbitError as error:
            row = dict.fromkeys(("amplitude", "first_harmonic", "phase", "stick_fraction"), math.nan)
            return {key: [cell] for key, cell in (row | {"note": str(error)}).items()}, None
        dt = strobe.period / _SAMPLES_A_CYCLE
        samples = simulate(strobe.parameters, *begin, cycles * strobe.period, dt=dt).x[:-1]
        # Sums over whole cycles: the trapezium rule, which a periodic integrand makes exact to high order.
        turns = np.exp(-2j * math.pi / _SAMPLES_A_CYCLE * np.arange(len(samples)))
        harmonic = 2.0 * np.mean(samples * turns) * np.exp(-1j * getattr(strobe.parameters, phase_name))
        extremes = recorded.rows[:, kernel.CYCLE_X_MIN].min(), recorded.rows[:, kernel.CYCLE_X_MAX].max()
        row = {"amplitude": amplitude(*map(float, extremes)), "first_harmonic": abs(harmonic)}
        row["phase"] = float(np.angle(harmonic))
        row["stick_fraction"] = recorded.rows[:, kernel.CYCLE_STICK_TIME].mean() / strobe.period
        return {key: [cell] for key, cell in (row | {"note": ""}).items()}, recorded.end

    columns = _continued(_points(parameters, name, values, None), direction, measured, (x, v))
    return Table(columns, {"parameters": dataclasses.asdict(parameters), "swept": name, "excitation": acting[0]})


def _points(
    parameters: OscillatorParameters, name: str, values: ArrayLike, period: float | None
) -> list[tuple[float, Stroboscope]]:
    """Return the checked values, ascending, each with its stroboscope (of period 0 without excitation)."""
    try:
        numbers = np.unique(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise TypeError(f"values must be numbers, got {values!r}") from None
    if np.ndim(values) != 1 or not numbers.size:
        raise ValueError(f"values must have shape (n,) with n >= 1, got shape {np.shape(values)}")
    plants = [parameters.replace(**{name: value}) for value in numbers.tolist()]
    acting = active_excitations(parameters, swept=name)
    if not acting:
        periods = [0.0 for _ in plants]
    elif period is None:
        periods = [common_period(plant, acting) for plant in plants]
    else:
        periods = [checked_period(plant, period, repeats=False) for plant in plants]
    return list(zip(numbers.tolist(), map(Stroboscope, plants, periods), strict=True))


def _continued(
    points: list[tuple[float, Stroboscope]],
    direction: Direction,
    measured: Callable[[Stroboscope, State], tuple[dict[str, Any], State | None]],
    start: tuple[float, float | None],
) -> Table:
    """Return the columns that ``measured`` gives at each value, from the state in which it left the one before."""
    checked_choice("direction", direction, get_args(Direction))
    points[0][1].checked_start(*start)
    ways = {"up": ["up"], "down": ["down"], "both": ["up", "down"]}[direction]
    parts: list[dict[str, Any]] = []
    state: State | None = None
    for way in ways:
        for value, strobe in points if way == "up" else points[::-1]:
            part, state = measured(strobe, state or strobe.checked_start(*start))
            rows = len(next(iter(part.values())))
            parts.append({"value": np.full(rows, value), "direction": np.full(rows, way), **part})
    return Table.stacked(parts)


def _section_at(
    strobe: Stroboscope, state: State, transient: int, cycles: int, lyapunov: bool
) -> tuple[dict[str, Any], State | None]:
    """Return one value's columns, and the state to continue from, None after a loss of contact."""
    exponent: LyapunovExponent | None = None
    try:
        if strobe.period > 0.0:
            recorded = strobe.follow(state, transient, cycles, growing=lyapunov)
            exponent = exponent_of(strobe, recorded) if lyapunov else None
            xs, vs = recorded.rows[:, kernel.CYCLE_X], recorded.rows[:, kernel.CYCLE_V]
            stuck = recorded.rows[:, kernel.CYCLE_STICK_TIME] / strobe.period
        else:
            xs, vs, stuck = _maxima(strobe, state, transient, cycles), np.zeros(cycles), np.full(cycles, math.nan)
            exponent = lyapunov_exponent(strobe.parameters, float(xs[-1]), 0.0) if lyapunov else None
    except OrbitError:
        cycles = 1
        xs = vs = stuck = np.full(1, math.nan)
    part: dict[str, Any] = {"cycle": np.arange(transient, transient + cycles), "x": xs, "v": vs}
    part["stick_fraction"] = stuck
    if lyapunov:
        part["exponent"] = np.full(cycles, exponent.largest if exponent else math.nan)
        part["standard_error"] = np.full(cycles, exponent.standard_error if exponent else math.nan)
    return part, (float(xs[-1]), float(vs[-1])) if np.isfinite(xs[-1]) else None


def _maxima(strobe: Stroboscope, state: State, transient: int, cycles: int) -> FloatArray:
    """Return the maxima of x of an unexcited motion that follow ``transient`` of them."""
    parameters = strobe.parameters
    places = np.empty(transient + cycles)
    status, written = kernel.maxima(strobe.plant, *state, parameters.belt_speed, places, traps_of(parameters))
    if status != kernel.OK:
        raise lost_motion(parameters, state, status, written)
    return places[transient:]
