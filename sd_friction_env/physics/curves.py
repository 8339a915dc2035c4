"""Amplitude and frequency over the belt speed, as tidy tables."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.orbits import (
    LimitCycle,
    OrbitError,
    attractors,
    critical_belt_speeds,
    equilibria,
    limit_cycle,
)
from sd_friction_env.physics.parameters import RANGES, STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.physics.tables import Table

_CYCLE_COLUMNS = (
    *("kind", "amplitude", "period", "frequency", "angular_frequency", "stick_fraction", "x_max", "x_min"),
    *("x_breakaway", "x_restick", "sticks", "forward_arcs", "floquet_multiplier"),
)


def checked_belt_speeds(belt_speeds: ArrayLike) -> NDArray[np.float64]:
    """Return belt speeds as an array of shape (n,).

    Raises:
        TypeError: if they are not numbers.
        ValueError: if there is none, or one is not in [0, 10].
    """
    try:
        speeds = np.atleast_1d(np.asarray(belt_speeds, dtype=np.float64))
    except (TypeError, ValueError):
        raise TypeError(f"belt_speeds must be numbers, got {belt_speeds!r}") from None
    if speeds.ndim != 1 or not speeds.size:
        raise ValueError(f"belt_speeds must have shape (n,) with n >= 1, got shape {speeds.shape}")
    for speed in speeds:
        checked_number("belt_speeds", float(speed), *RANGES["belt_speed"])
    return speeds


def _row(cycle: LimitCycle) -> dict[str, Any]:
    """Return a table's row for a cycle and the start that reached it."""
    row = {name: getattr(cycle, name) for name in _CYCLE_COLUMNS}
    start = {"x_start": cycle.x_start, "v_start": cycle.v_start}
    return {"belt_speed": cycle.parameters.belt_speed} | row | start | {"note": ""}


def amplitude_curve(
    parameters: OscillatorParameters, belt_speeds: ArrayLike, *, x: float = 0.0, v: float | None = None
) -> Table:
    """Return the attractor at each belt speed: one row each, in the order given.

    Args:
        parameters: of the oscillator; their belt speed is not used.
        belt_speeds: of shape (n,), each in [0, 10].
        x, v: the start at every belt speed, in [-10, 10]; by default a mass set down at x = 0 that moves with the belt.

    Returns:
        A table with the columns belt_speed, kind ("stick-slip", "pure-slip", "steady-slip", "neutral", "rest" or
        "failed"), amplitude, period, frequency, angular_frequency, stick_fraction, x_max, x_min, x_breakaway,
        x_restick, sticks, forward_arcs, floquet_multiplier, x_start, v_start and note (why a row failed, else empty).

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    speeds = checked_belt_speeds(belt_speeds)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    if v is not None:
        v = checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    rows = []
    for speed in speeds.tolist():
        try:
            rows.append(_row(limit_cycle(parameters.replace(belt_speed=speed), x, v)))
        except OrbitError as error:
            rows.append(_failed_row(speed, x, speed if v is None else v, str(error)))
    return _table(rows, parameters)


def refined_curve(
    parameters: OscillatorParameters, belt_speeds: ArrayLike, *, x: float = 0.0, v: float | None = None
) -> Table:
    """Return :func:`amplitude_curve` with columns v_b0 and v_b1 and more points, in ascending order of belt speed.

    The points are v_b0 and v_b1, each from both sides, so that the branches meet there, and 25 between them, where the
    curve is steep; those outside the range of ``belt_speeds`` are left out. Arguments and errors are those of
    ``amplitude_curve``.
    """
    speeds = checked_belt_speeds(belt_speeds)
    v_b0, v_b1 = critical_belt_speeds(parameters)
    end = v_b1 if np.isfinite(v_b1) else v_b0
    edge = end - (end - v_b0) * np.linspace(0.0, 1.0, 25) ** 2
    added = np.concatenate((edge - 1e-9, [v_b0 + 1e-9, v_b1 + 1e-9]))
    added = added[(added > speeds.min()) & (added < speeds.max())]  # NaN, where there is none, is not
    curve = amplitude_curve(parameters, np.unique(np.concatenate((speeds, added))), x=x, v=v)
    return curve.labelled(v_b0=v_b0, v_b1=v_b1)


def attractor_curves(parameters: OscillatorParameters, belt_speeds: ArrayLike) -> Table:
    """Return all attractors at each belt speed, one row each; alpha < 1 has two wells and may have one in each.

    Args:
        parameters: of the oscillator; their belt speed is not used.
        belt_speeds: of shape (n,), each in (0, 10].

    Returns:
        The columns of :func:`amplitude_curve` and ``well``: "left" or "right" of the middle equilibrium, "only" where
        there is one equilibrium, "both" for a motion about all of them. A belt speed without an attractor that keeps
        contact is one row of kind "failed".

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    speeds = checked_belt_speeds(belt_speeds)
    rows = []
    for speed in speeds.tolist():
        plant = parameters.replace(belt_speed=speed)
        found = attractors(plant)
        places = [e.x for e in equilibria(plant)]
        rows += [_row(cycle) | {"well": _well(cycle, places)} for cycle in found]
        if not found:
            note = "no attractor that keeps contact was found"
            rows.append(_failed_row(speed, math.nan, math.nan, note) | {"well": ""})
    return _table(rows, parameters)


def _well(cycle: LimitCycle, places: list[float]) -> str:
    if len(places) < 3:
        return "only"
    middle = places[1]
    return "left" if cycle.x_max < middle else "right" if cycle.x_min > middle else "both"


def _failed_row(belt_speed: float, x: float, v: float, note: str) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(_CYCLE_COLUMNS, math.nan)
    row |= {"kind": "failed", "sticks": 0, "forward_arcs": 0}
    return row | {"belt_speed": belt_speed, "x_start": x, "v_start": v, "note": note}


def _table(rows: list[dict[str, Any]], parameters: OscillatorParameters) -> Table:
    names = ["belt_speed", *_CYCLE_COLUMNS, "x_start", "v_start", "note"]
    names += [name for name in rows[0] if name not in names]
    return cycle_table({name: [row[name] for row in rows] for name in names}, parameters)


def cycle_table(columns: Mapping[str, Any], parameters: OscillatorParameters) -> Table:
    """Return columns of cycles as a table with the oscillator in its metadata."""
    return Table(columns, {"parameters": dataclasses.asdict(parameters)})
