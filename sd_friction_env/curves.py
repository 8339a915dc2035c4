"""Amplitude and frequency over the belt speed, as tidy tables."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.orbits import OrbitError, limit_cycle
from sd_friction_env.parameters import RANGES, STATE_LIMIT, OscillatorParameters, checked_number
from sd_friction_env.tables import Table

_CYCLE_COLUMNS = (
    "kind",
    "amplitude",
    "period",
    "frequency",
    "angular_frequency",
    "stick_fraction",
    "x_max",
    "x_min",
    "x_breakaway",
    "x_restick",
    "sticks",
    "forward_arcs",
    "floquet_multiplier",
)


def checked_belt_speeds(belt_speeds: ArrayLike) -> NDArray[np.float64]:
    """Return belt speeds as an array of shape (n,).

    Raises:
        TypeError: if they are no numbers.
        ValueError: if there are none, or one is not in its range.
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


def amplitude_curve(
    parameters: OscillatorParameters,
    belt_speeds: ArrayLike,
    *,
    x: float = 0.0,
    v: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Return the attractor at each belt speed: one row each, in the order given.

    Args:
        parameters: of the oscillator; their belt speed is not used.
        belt_speeds: of shape (n,), each in [0, 10].
        x, v: the start at every belt speed, in [-10, 10]; by default a mass set down at x = 0 moving with the belt.
        progress: called with the rows done and the rows in all after each row.

    Returns:
        A table with the columns belt_speed, kind ("stick-slip", "pure-slip", "steady-slip", "rest" or "failed"),
        amplitude, period, frequency, angular_frequency, stick_fraction, x_max, x_min, x_breakaway, x_restick, sticks,
        forward_arcs, floquet_multiplier, x_start, v_start and note (why a row failed, else empty).

    Raises:
        TypeError, ValueError: if an argument is not as said.
    """
    speeds = checked_belt_speeds(belt_speeds)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    if v is not None:
        v = checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    columns: dict[str, list[Any]] = {name: [] for name in ("belt_speed", *_CYCLE_COLUMNS, "x_start", "v_start", "note")}
    for done, speed in enumerate(speeds.tolist(), start=1):
        note = ""
        row: dict[str, Any] = dict.fromkeys(_CYCLE_COLUMNS, float("nan"))
        try:
            cycle = limit_cycle(parameters.replace(belt_speed=speed), x, v)
            row = {name: getattr(cycle, name) for name in _CYCLE_COLUMNS}
        except OrbitError as error:
            row |= {"kind": "failed", "sticks": 0, "forward_arcs": 0}
            note = str(error)
        row |= {"belt_speed": speed, "x_start": x, "v_start": speed if v is None else v, "note": note}
        for name, values in columns.items():
            values.append(row[name])
        if progress is not None:
            progress(done, len(speeds))
    return Table(columns, {"parameters": dataclasses.asdict(parameters)})
