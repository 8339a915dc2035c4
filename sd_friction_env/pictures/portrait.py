"""The phase portrait's panel: axes, belt speed, and the path so far."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.extras import extra
from sd_friction_env.pictures.canvas import (
    BLUE,
    GRID,
    INK,
    LINE,
    MUTED,
    PALE_BLUE,
    PAPER,
    SLATE,
    VERMILION,
    Canvas,
    Frame,
    as_text,
    ticks,
)
from sd_friction_env.pictures.scene import Box

with extra("render"):
    import pygame

TRAIL_POINTS = 300
FADES = 12  # steps in which the trail fades


def draw_axes(frame: Frame) -> None:
    """Draw what stays put while the view does: title, grid and numbers."""
    c, layout, view = frame.canvas, frame.layout, frame.view
    u, plot, size = layout.unit, layout.plot, 17 * layout.unit
    thin = max(1, round(u))
    c.write("phase portrait", (layout.portrait.left + 16 * u, layout.portrait.top + 22 * u), 21 * u, INK)
    if not layout.compact:
        at = (layout.portrait.right - 18 * u, layout.portrait.top + 23 * u)
        end = at[0] - c.write("v = belt speed", at, size, MUTED, "midright") - 7 * u
        c.dashes(SLATE, end - 31 * u, end, at[1], u)
    columns, form = ticks(view.x_plot, 5)
    for value in columns:
        x = float(view.on_plot(plot, np.array((value, 0.0)))[0])
        ends = (round(x), round(plot.top)), (round(x), round(plot.bottom) - 1)
        pygame.draw.line(c.surface, GRID, *ends, thin)
        if not layout.compact:
            c.write(as_text(value, form), (x, plot.bottom + 13 * u), size, MUTED, "center")
    rows, form = ticks(view.v_plot, 6)
    for value in rows:
        y = float(view.on_plot(plot, np.array((0.0, value)))[1])
        ends = (round(plot.left), round(y)), (round(plot.right) - 1, round(y))
        pygame.draw.line(c.surface, LINE if value == 0.0 else GRID, *ends, thin)
        if not layout.compact:
            c.write(as_text(value, form), (plot.left - 7 * u, y), size, MUTED, "midright")
    pygame.draw.rect(c.surface, LINE, plot.ltwh, thin)
    if layout.compact:
        c.write("x", (plot.middle[0], plot.bottom + 20 * u), size, MUTED, "center")
        c.write("v", (plot.left - 22 * u, plot.middle[1]), size, MUTED, "center")
    else:
        c.write("position x", (plot.right, plot.bottom + 31 * u), size, MUTED, "midright")
        at = (layout.portrait.left + 14 * u, plot.top + c.lettering.image("velocity v", size, MUTED).get_width() / 2)
        c.write("velocity v", at, size, MUTED, "center", turned=True)


def draw_portrait(frame: Frame, trail: Sequence[tuple[float, float, int]]) -> None:
    """Draw the belt's speed, where the mass can stick, and the trail: (x, v, mode) of each frame so far."""
    c, view, scene = frame.canvas, frame.view, frame.scene
    u, plot = frame.layout.unit, frame.layout.plot
    left, top, width, height = plot.ltwh
    c.surface.set_clip((left + 1, top + 1, width - 2, height - 2))
    y = float(view.on_plot(plot, np.array((0.0, scene.v_belt)))[1])
    if scene.stick_interval is not None:
        ends = view.on_plot(plot, np.array([(x, scene.v_belt) for x in scene.stick_interval]))[:, 0]
        low, high = max(float(ends[0]), plot.left), min(float(ends[1]), plot.right)
        if high > low:
            c.rounded(PALE_BLUE, Box(low, y - 4.5 * u, high, y + 4.5 * u), 4.5 * u)
    c.dashes(SLATE, plot.left + 2 * u, plot.right, y, u)
    points = view.on_plot(plot, np.array([point[:2] for point in trail], dtype=np.float64))
    _draw_trail(c, points, [point[2] for point in trail], max(1.0, 2.4 * u))

    now = (points[-1][0], points[-1][1])
    with c.close_up(Box.around(now, 10 * u)) as big:
        if scene.mode == 0:
            big.square(PAPER, now, 8.5 * u)
            big.square(BLUE, now, 7 * u)
        else:
            for color, radius in ((PAPER, 9.5 * u), (VERMILION, 8 * u), (PAPER, 4.5 * u)):
                big.circle(color, now, radius)
    c.surface.set_clip(None)


def _draw_trail(c: Canvas, points: NDArray[np.float64], modes: Sequence[int], width: float) -> None:
    """Draw the path so far, older parts paler, in pieces of one colour."""
    last = len(points) - 1

    def style(k: int) -> tuple[int, bool]:
        return (last - k) * FADES // TRAIL_POINTS, modes[k] == 0

    start = 0
    for end in range(1, last + 1):
        if end == last or style(end) != style(end + 1):
            age, stuck = style(end)
            share = 0.85 * age / FADES
            red, green, blue = (round(part + (255 - part) * share) for part in (BLUE if stuck else VERMILION))
            c.stroke((red, green, blue), points[start : end + 1], width)
            start = end
