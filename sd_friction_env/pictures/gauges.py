"""The strip below: numbers, then the actuators."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from sd_friction_env.pictures.canvas import GREEN, INK, MUTED, PAPER, STEEL, Color, Frame, as_text
from sd_friction_env.pictures.scene import Box, Scene

NOT_YET = "\N{EN DASH}"
_TROUGH: Color = (226, 231, 237)


class Readout(NamedTuple):
    """A number of the strip."""

    name: str
    short: str
    value: str


class Gauge(NamedTuple):
    """An actuator of the strip: its range, its place at rest, its present value."""

    name: str
    low: float
    rest: float
    high: float
    now: float


def gauges(scene: Scene) -> list[Gauge]:
    """Return the actuators of a scene."""
    found = []
    if scene.force_limit > 0.0:
        found.append(Gauge("control force u", -scene.force_limit, 0.0, scene.force_limit, scene.force))
    low, high = scene.belt_speed_limits
    if high > low:
        found.append(Gauge("belt speed", low, scene.belt_speed_nominal, high, scene.v_belt))
    return found


def readouts(scene: Scene) -> list[Readout]:
    """Return the numbers of a scene; the belt's speed only where no gauge shows it."""
    amplitude = f"{scene.amplitude:.3f}" if math.isfinite(scene.amplitude) else NOT_YET
    share = f"{100 * scene.stick_fraction:.0f} %" if math.isfinite(scene.stick_fraction) else NOT_YET
    found = [
        Readout("time", "t", f"{scene.time:.1f}"),
        Readout("amplitude", "A", amplitude),
        Readout("time stuck", "stuck", share),
    ]
    if not any(gauge.name == "belt speed" for gauge in gauges(scene)):
        found.append(Readout("belt speed", "belt", f"{scene.v_belt:.3f}"))
    return found


def draw_captions(frame: Frame) -> None:
    """Draw what stays put while the scene's ranges do: names, troughs and their scales."""
    c, layout, u = frame.canvas, frame.layout, frame.layout.unit
    y = layout.strip.top + 20 * u
    for index, readout in enumerate(readouts(frame.scene)):
        c.write(readout.short if layout.compact else readout.name, (_cell(frame, index), y), 18 * u, MUTED)
    for gauge, box in _gauge_boxes(frame):
        c.write(gauge.name, (box.left, y), 18 * u, MUTED)
        c.rounded(_TROUGH, box, 5 * u)
        if not layout.compact:
            span = box.right - box.left
            for value in (gauge.low, gauge.rest, gauge.high):
                x = box.left + span * (value - gauge.low) / (gauge.high - gauge.low)
                c.stroke(STEEL, ((x, box.bottom + 2 * u), (x, box.bottom + 6 * u)), 1.2 * u)
                c.write(as_text(value, ".4g"), (x, box.bottom + 15 * u), 16 * u, MUTED, "center")


def draw_readouts(frame: Frame) -> None:
    """Draw the present values."""
    c, layout, u = frame.canvas, frame.layout, frame.layout.unit
    for index, readout in enumerate(readouts(frame.scene)):
        at = (_cell(frame, index), layout.strip.top + 50 * u)
        c.write(readout.value, at, (34 if not layout.compact else 30) * u, INK)
    for (_, low, rest, high, now), box in _gauge_boxes(frame):
        span, middle = box.right - box.left, box.middle[1]
        start, end = (box.left + span * (min(max(z, low), high) - low) / (high - low) for z in (rest, now))
        left, right = min(start, end), max(start, end)
        with c.close_up(Box(left - 9 * u, middle - 9 * u, right + 9 * u, middle + 9 * u)) as big:
            if right > left:
                big.rounded(GREEN, Box(left, box.top, right, box.bottom), 0.0)
            big.circle(PAPER, (end, middle), 9 * u)
            big.circle(GREEN, (end, middle), 7.5 * u)
        if not layout.compact:
            c.write(as_text(now, ".3f"), (box.right, layout.strip.top + 20 * u), 20 * u, INK, "midright")


def _cell(frame: Frame, index: int) -> float:
    return frame.layout.strip.left + (18 + 124 * index) * frame.layout.unit


def _gauge_boxes(frame: Frame) -> Iterator[tuple[Gauge, Box]]:
    """Yield each gauge with the trough it stands in."""
    layout, u, shown = frame.layout, frame.layout.unit, gauges(frame.scene)
    first = _cell(frame, len(readouts(frame.scene))) + 10 * u
    pitch = (layout.strip.right - 28 * u - first + 40 * u) / max(len(shown), 1)
    middle = layout.strip.middle[1] + (9 if not layout.compact else 14) * u
    for k, gauge in enumerate(shown):
        yield gauge, Box(first + k * pitch + 14 * u, middle - 5 * u, first + (k + 1) * pitch - 40 * u, middle + 5 * u)
