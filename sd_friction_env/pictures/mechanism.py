"""The mechanism's panel: anchor, spring, mass and moving belt.

Shapes, not only colours, tell stick from slip: a mass that sticks is solid and grips the belt with teeth, a mass that
slips is hollow, with chevrons pointing the way it slips and streaks behind it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.pictures.canvas import (
    BLUE,
    GREEN,
    GROUND,
    INK,
    MUTED,
    PALE_BLUE,
    PAPER,
    SLATE,
    STEEL,
    VERMILION,
    Canvas,
    Frame,
    as_text,
    ticks,
)
from sd_friction_env.pictures.scene import Box, Point

TITLES = {
    "exact": "inclined spring",
    "cubic": "inclined spring, cubic law",
    "linear": "linear spring",
    "duffing": "stiffening spring",
}


def draw_fixtures(frame: Frame) -> None:
    """Draw what stays put while the view does: title, belt loop, anchor and the numbers of the ruler."""
    c, layout, view, scene = frame.canvas, frame.layout, frame.view, frame.scene
    u, belt = layout.unit, layout.belt
    title = scene.title or TITLES.get(scene.geometry, scene.geometry)
    c.write(title, (layout.mechanism.left + 16 * u, layout.mechanism.top + 22 * u), 21 * u, INK)

    outer = (belt.bottom - belt.top) / 2
    c.rounded(SLATE, belt, outer)
    c.rounded(GROUND, belt.grown(-9 * u), outer)

    x, y = view.anchor
    if scene.level:
        _hatched_bar(c, (x, y - 46 * u), (x, belt.top - 3 * u), (-1.0, 0.0), u)
    else:
        _hatched_bar(c, (x - 46 * u, layout.ceiling), (x + 46 * u, layout.ceiling), (0.0, -1.0), u)
        c.stroke(SLATE, ((x, layout.ceiling), (x, y)), 6 * u)
        for dot in np.arange(y + 12 * u, belt.top - 4 * u, 9 * u):
            c.stroke((186, 195, 205), ((x, dot), (x, dot + 4 * u)), 1.4 * u)
        if not layout.compact:
            text = f"\N{GREEK SMALL LETTER ALPHA} = {scene.alpha:.3g}" + ("" if view.true_height else ", not to scale")
            side = -1 if x > layout.mechanism.middle[0] else 1
            at = (x + side * 58 * u, layout.ceiling + 1 * u)
            c.write(text, at, 18 * u, MUTED, "midright" if side < 0 else "midleft")

    if not layout.compact:
        values, form = ticks(view.x_mechanism, 8)
        for value in values:
            c.write(as_text(value, form), (view.on_belt(value), layout.ruler + 16 * u), 17 * u, MUTED, "center")


def draw_mechanism(frame: Frame) -> None:
    """Draw what moves: belt marks, mass, spring and the arrow of the control force."""
    c, layout, scene = frame.canvas, frame.layout, frame.scene
    u, anchor = layout.unit, frame.view.anchor
    _draw_badge(frame)
    c.surface.set_clip(layout.mechanism.ltwh)
    _draw_belt(frame)
    _draw_ruler(frame)
    x = frame.view.on_belt(scene.x)
    pin = (x, layout.pin)
    if scene.mode != 0:
        _draw_streaks(frame, x)
    _draw_mass(frame, x)
    _draw_spring(c, anchor, (x - layout.mass, layout.pin) if scene.level else pin, u)
    for joint in [anchor] if scene.level else [anchor, pin]:
        with c.close_up(Box.around(joint, 7 * u)) as big:
            big.circle(SLATE, joint, 6.5 * u)
            big.circle(PAPER, joint, 3.2 * u)
    if scene.force_limit > 0.0 and abs(scene.force) > 1e-3 * scene.force_limit:
        side = math.copysign(1.0, scene.force)
        length = max(-1.0, min(1.0, scene.force / scene.force_limit)) * 84 * u + side * 12 * u
        c.arrow(GREEN, (x + side * (layout.mass + 4 * u), layout.pin - 19 * u), length, 7 * u)
    c.surface.set_clip(None)


def _draw_badge(frame: Frame) -> None:
    c, layout, mode = frame.canvas, frame.layout, frame.scene.mode
    u = layout.unit
    color, text = (BLUE, "STICK") if mode == 0 else (VERMILION, "SLIP")
    width = max(108 * u, c.lettering.image("STICK", 24 * u, color).get_width() + max(40 * u, 22.0))
    half = max(16 * u, 7.0)
    right, y = layout.mechanism.right - 14 * u, layout.mechanism.top + 10 * u + half
    box = Box(right - width, y - half, right, y + half)
    middle = (box.left + box.right) / 2
    with c.close_up(box) as big:
        big.rounded(color, box, half)
        if mode == 0:
            big.square(PAPER, (box.left + 20 * u, y), 6 * u)
        else:
            big.rounded(PAPER, box.grown(-2.5 * u), half - 2.5 * u)
            for k in (0, 1):
                tip = middle + mode * (width / 2 - (14 + 11 * k) * u)
                big.chevron(color, (tip, y), 7 * u, mode, 4.5 * u)
    shift = 10 * u if mode == 0 else -mode * 12 * u
    c.write(text, (middle + shift, y + 0.5 * u), 24 * u, PAPER if mode == 0 else color, "center")


def _draw_belt(frame: Frame) -> None:
    c, scene = frame.canvas, frame.scene
    u, belt = frame.layout.unit, frame.layout.belt
    outer = (belt.bottom - belt.top) / 2
    travel = scene.belt_travel * frame.view.scale
    loop = _on_loop(belt, 0.0, np.zeros(1))[1]
    # Every fourth mark is a long one, so that the eye can follow it round.
    count = 4 * max(2, round(loop / (27 * u) / 4))
    at = np.mod(travel, loop) + loop * np.arange(count) / count
    outside, inside = (_on_loop(belt, inset, at)[0] for inset in (1.5 * u, 7.5 * u))
    for k in range(count):
        color, width = (PAPER, 4.0) if k % 4 == 0 else ((150, 162, 176), 2.2)
        c.stroke(color, np.vstack((outside[k], inside[k])), max(1.0, width * u))
    y, radius = belt.top + outer, outer - 10.5 * u
    for hub in (belt.left + outer, belt.right - outer):
        with c.close_up(Box.around((hub, y), radius)) as big:
            big.circle(STEEL, (hub, y), radius)
            big.circle((203, 211, 220), (hub, y), radius - 2.5 * u)
        for spoke in range(3):
            angle = travel / outer + spoke * math.pi / 3
            dx, dy = (radius - 2 * u) * math.cos(angle), (radius - 2 * u) * math.sin(angle)
            c.stroke(STEEL, ((hub - dx, y - dy), (hub + dx, y + dy)), max(1.0, 1.8 * u))
    fastest = max(scene.belt_speed_nominal, *scene.belt_speed_limits, abs(scene.v_belt))
    if fastest > 0.0 and abs(scene.v_belt) > 1e-3 * fastest:
        middle = (belt.left + belt.right) / 2
        length = scene.v_belt / fastest * 150 * u
        driven = scene.belt_speed_limits[1] > scene.belt_speed_limits[0]
        c.arrow(GREEN if driven else STEEL, (middle - 75 * u, y), length, 7 * u)


def _draw_ruler(frame: Frame) -> None:
    """Draw the axis of positions, marked where the mass can stick (which moves with the belt's speed)."""
    c, view, stick = frame.canvas, frame.view, frame.scene.stick_interval
    u, y = frame.layout.unit, frame.layout.ruler
    left, right = (view.on_belt(end) for end in view.x_mechanism)
    if stick is not None:
        low, high = (min(max(view.on_belt(x), left), right) for x in stick)
        if high > low:
            c.rounded(PALE_BLUE, Box(low, y - 4 * u, high, y + 4 * u), 4 * u)
            if not frame.layout.compact:
                c.write("can stick here", (low + 2 * u, y - 13 * u), 16 * u, BLUE)
    width = max(1.0, 1.2 * u)
    c.stroke(STEEL, ((left, y), (right, y)), width)
    for value in ticks(view.x_mechanism, 8)[0]:
        x = view.on_belt(value)
        c.stroke(STEEL, ((x, y - 4 * u), (x, y + 4 * u)), width)


def _draw_streaks(frame: Frame, x: float) -> None:
    """Draw lines that the slipping mass leaves behind, longer the faster it slips."""
    layout, scene = frame.layout, frame.scene
    u = layout.unit
    unit_speed = max(scene.belt_speed_nominal, 0.05)
    reach = min(abs(scene.v - scene.v_belt) / unit_speed, 2.5) * 22 * u
    start = x - scene.mode * (layout.mass + 6 * u)
    for drop, share in ((6, 0.6), (15, 1.0), (24, 0.75)):
        y = layout.pin + drop * u
        if reach * share > 2 * u:
            frame.canvas.stroke(VERMILION, ((start, y), (start - scene.mode * reach * share, y)), max(1.0, 2.4 * u))


def _draw_mass(frame: Frame, x: float) -> None:
    layout, mode = frame.layout, frame.scene.mode
    u, half, floor, top = layout.unit, layout.mass, layout.belt.top, layout.pin - layout.mass
    with frame.canvas.close_up(Box(x - half - 8 * u, top, x + half + 8 * u, floor + 9 * u)) as big:
        if mode == 0:
            # Square and solid on a shoe whose teeth bite into the belt.
            big.rounded(BLUE, Box(x - half, top, x + half, floor - 1 * u), 3 * u)
            shoe = [(x - half, floor - 9 * u), (x + half, floor - 9 * u), (x + half + 6 * u, floor)]
            big.polygon(BLUE, [*shoe, (x - half - 6 * u, floor)])
            teeth, width = 5, (2 * half + 12 * u) / 5
            for color, wider in ((PAPER, 1.6 * u), (BLUE, 0.0)):
                for k in range(teeth):
                    left, right = x - half - 6 * u + k * width - wider, x - half - 6 * u + (k + 1) * width + wider
                    tip = ((left + right) / 2, floor + 6.5 * u + 1.2 * wider)
                    big.polygon(color, [(left, floor - 0.5 * u), (right, floor - 0.5 * u), tip])
        else:
            edge = 4.5 * u
            box = Box(x - half, top, x + half, floor - 1.5 * u)
            big.rounded(VERMILION, box, 13 * u)
            big.rounded((255, 243, 234), box.grown(-edge), 13 * u - edge)
            for k in (-1, 0, 1):
                tip = (x + mode * (4.5 + 11 * k) * u, layout.pin + 15 * u)
                big.chevron(VERMILION, tip, 6 * u, mode, 4 * u)


def _hatched_bar(c: Canvas, start: Point, end: Point, away: Point, unit: float) -> None:
    """Draw a fixed body's edge, with hatching on the side that ``away`` points to."""
    first, last = np.array(start), np.array(end)
    length = float(np.sqrt(((last - first) ** 2).sum()))
    along = (last - first) / length
    count = max(2, round(length / (9 * unit)))
    for k in range(count + 1):
        foot = first + along * (length * k / count)
        c.stroke(STEEL, np.vstack((foot, foot + (np.array(away) - 0.8 * along) * 9 * unit)), 1.2 * unit)
    c.stroke(SLATE, np.vstack((first, last)), 3.5 * unit)


def _on_loop(belt: Box, inset: float, distance: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the points at ``distance`` along the belt's loop, ``inset`` from its outside, and the loop's length.

    Distances are measured on the outside, clockwise from where the top run begins.
    """
    outer = (belt.bottom - belt.top) / 2
    run = belt.right - belt.left - 2 * outer
    turn = math.pi * outer
    length = 2 * (run + turn)
    s = np.mod(distance, length)
    y = belt.top + outer
    left, right = belt.left + outer, belt.right - outer
    angle = np.where(s < run + turn, (s - run) / outer, math.pi + (s - 2 * run - turn) / outer)
    angle = np.clip(angle, 0.0, np.where(s < run + turn, math.pi, 2 * math.pi))
    straight_top = s < run
    straight_bottom = (s >= run + turn) & (s < 2 * run + turn)
    px = np.where(straight_top, left + s, np.where(straight_bottom, right - (s - run - turn), 0.0))
    py = np.where(straight_top, -1.0, 1.0) * (outer - inset)
    on_turn = ~(straight_top | straight_bottom)
    hub = np.where(s < run + turn, right, left)
    px = np.where(on_turn, hub + (outer - inset) * np.sin(angle), px)
    py = np.where(on_turn, -(outer - inset) * np.cos(angle), py)
    return np.column_stack((px, y + py)), length


def _draw_spring(c: Canvas, start: Point, end: Point, unit: float) -> None:
    """Draw a coil between two points, its far side paler than its near side."""
    first, last = np.array(start), np.array(end)
    span = last - first
    length = float(np.sqrt((span * span).sum()))
    if length < unit:
        return
    along = span / length
    across = np.array((-along[1], along[0]))
    lead, tail = (min(share * unit, 0.2 * length) for share in (24, 46))  # the tail keeps the coil off the mass
    half_turns, half_turn = 21, 10  # an odd number: both ends of the coil face outward
    radius = 10.5 * unit
    turn = np.linspace(0.0, math.pi * half_turns, half_turns * half_turn + 1)
    tilt = min(0.35 * radius, 0.8 * (length - lead - tail) / half_turns)
    position = lead + tilt + (length - lead - tail - 2 * tilt) * turn / turn[-1] - tilt * np.cos(turn)
    points = first + position[:, None] * along + (radius * np.sin(turn))[:, None] * across
    # Seen from the side, a turn comes towards us over one half and goes away over the other, between its extremes.
    quarter = half_turn // 2
    halves = [points[k : k + half_turn + 1] for k in range(quarter, len(points) - half_turn, half_turn)]
    for half in halves[1::2]:
        c.stroke((163, 174, 188), half, 2.2 * unit)
    for half in halves[0::2]:
        c.stroke(SLATE, half, 2.8 * unit)
    c.stroke(SLATE, np.concatenate(([start], points[: quarter + 1])), 2.8 * unit)
    c.stroke(SLATE, np.concatenate((points[-quarter - 1 :], [end])), 2.8 * unit)
