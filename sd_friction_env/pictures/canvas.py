"""Smooth shapes and letters on a pygame surface.

Coordinates are floats throughout: a motion rounded to whole pixels would tremble.
"""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.extras import extra
from sd_friction_env.pictures.scene import Box, Layout, Limits, Point, Scene, View

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # or pygame greets on standard output
with extra("render"):
    import pygame

Color = tuple[int, int, int]
# Where a text's given point lies on its box, in pygame's words.
Anchor = Literal["midleft", "center", "midright"]

# Okabe and Ito's colours, and greys.
BLUE: Color = (0, 114, 178)
VERMILION: Color = (213, 94, 0)
GREEN: Color = (0, 158, 115)
PALE_BLUE: Color = (166, 212, 240)
INK: Color = (31, 41, 51)
SLATE: Color = (62, 74, 89)
STEEL: Color = (116, 129, 145)
MUTED: Color = (92, 104, 118)
LINE: Color = (214, 220, 227)
GRID: Color = (236, 239, 243)
GROUND: Color = (238, 241, 245)
PAPER: Color = (255, 255, 255)

_ENLARGED = 4  # a shape's edges are drawn so many times larger, then averaged
_SHARES = {"midleft": 0.0, "center": 0.5, "midright": 1.0}


def ticks(limits: Limits, wanted: int) -> tuple[list[float], str]:
    """Return round numbers within ``limits``, at most ``wanted`` + 1 of them, and the format that shows them."""
    low, high = limits
    raw = (high - low) / wanted
    power = math.floor(math.log10(raw))
    step = next(m * 10.0**power for m in (1, 2, 5, 10) if m * 10.0**power >= raw * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [k * step for k in range(first, last + 1)], f".{decimals}f"


def as_text(value: float, form: str) -> str:
    """Return a number in a format, with a true minus sign and no negative zero."""
    return f"{value + 0.0:{form}}".replace("-", "\N{MINUS SIGN}")


class Lettering:
    """Texts as pictures, kept; in pygame's own font, which every machine has: frames do not depend on fonts."""

    def __init__(self) -> None:
        self._fonts: dict[int, pygame.font.Font] = {}
        self._texts: dict[tuple[str, int, Color], pygame.Surface] = {}

    def image(self, text: str, size: float, color: Color) -> pygame.Surface:
        """Return a text's picture; letters are at least 11 pixels high."""
        key = (text, max(11, round(size)), color)
        if key not in self._texts:
            if len(self._texts) > 500:
                self._texts.clear()
            if key[1] not in self._fonts:
                self._fonts[key[1]] = pygame.font.Font(None, _ENLARGED * key[1])
            # Small letters set at their own size stand unevenly, on whole pixels.
            big = self._fonts[key[1]].render(text, True, color)
            size_now = (max(1, round(big.get_width() / _ENLARGED)), max(1, round(big.get_height() / _ENLARGED)))
            self._texts[key] = pygame.transform.smoothscale(big, size_now)
        return self._texts[key]


@dataclass(frozen=True)
class Canvas:
    """A surface with what is drawn on it."""

    surface: pygame.Surface
    lettering: Lettering

    def write(
        self, text: str, at: Point, size: float, color: Color, anchor: Anchor = "midleft", turned: bool = False
    ) -> float:
        """Write a text and return its width."""
        image = self.lettering.image(text, size, color)
        if turned:
            image = pygame.transform.rotate(image, 90)
        width, height = image.get_size()
        self.surface.blit(image, (round(at[0] - _SHARES[anchor] * width), round(at[1] - height / 2)))
        return float(width)

    def stroke(self, color: Color, points: NDArray[np.float64] | Sequence[Point], width: float) -> None:
        """Draw a smooth line of any width: anti-aliased lines of one pixel, side by side."""
        spread = max(width - 1.0, 0.0) / 2
        count = math.ceil(4.0 * spread) + 1
        offsets = [spread * (2.0 * k / max(count - 1, 1) - 1.0) for k in range(count)]
        if len(points) == 2:
            (x0, y0), (x1, y1) = points
            length = math.sqrt((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)) or 1.0
            nx, ny = (y0 - y1) / length, (x1 - x0) / length
            for offset in offsets:
                dx, dy = offset * nx, offset * ny
                pygame.draw.aaline(self.surface, color, (x0 + dx, y0 + dy), (x1 + dx, y1 + dy))
            return
        line = np.asarray(points, dtype=np.float64)
        along = np.diff(line, axis=0)
        lengths = np.sqrt((along * along).sum(axis=1))
        along /= np.where(lengths > 0.0, lengths, 1.0)[:, None]
        # At a corner the parallels meet on the bisector, farther out the sharper it is.
        bisector = np.concatenate((2.0 * along[:1], along[:-1] + along[1:], 2.0 * along[-1:]))
        bisector *= (2.0 / np.maximum((bisector * bisector).sum(axis=1), 0.5))[:, None]
        normals = np.stack((-bisector[:, 1], bisector[:, 0]), axis=1)
        for offset in offsets:
            pygame.draw.aalines(self.surface, color, False, (line + offset * normals).tolist())

    def dashes(self, color: Color, left: float, right: float, y: float, unit: float) -> None:
        """Draw a level dashed line."""
        for k in range(math.ceil((right - left) / (12 * unit))):
            start = left + 12 * k * unit
            self.stroke(color, ((start, y), (min(start + 7 * unit, right), y)), max(1.0, 1.6 * unit))

    def close_up(self, box: Box) -> "CloseUp":
        """Return a context in which a part of the surface is drawn enlarged, for smooth edges."""
        return CloseUp(self.surface, box)

    def rounded(self, color: Color, box: Box, radius: float) -> None:
        """Fill a rectangle with rounded corners."""
        with self.close_up(box) as big:
            big.rounded(color, box, radius)

    def panel(self, box: Box, radius: float) -> None:
        """Draw an empty panel: white, with a thin edge and rounded corners."""
        area = pygame.Rect(box.ltwh)
        inner = area.inflate(-2, -2)
        pygame.draw.rect(self.surface, LINE, area)
        pygame.draw.rect(self.surface, PAPER, inner)
        # Close up, but only where it shows: a whole panel would take tens of milliseconds.
        size = math.ceil(radius) + 1
        for x in (area.left, area.right - size):
            for y in (area.top, area.bottom - size):
                self.surface.set_clip((x, y, size, size))
                self.surface.fill(GROUND)
                with self.close_up(Box(x, y, x + size, y + size)) as big:
                    for color, rect, bend in ((LINE, area, radius), (PAPER, inner, radius - 1)):
                        big.rounded(color, Box(rect.left, rect.top, rect.right, rect.bottom), bend)
        self.surface.set_clip(None)

    def arrow(self, color: Color, tail: Point, length: float, thickness: float) -> None:
        """Draw a level arrow to the right (length > 0) or left."""
        x, y = tail
        tip = x + length
        neck = tip - math.copysign(min(2.2 * thickness, abs(length)), length)
        half, wide = thickness / 2, 1.5 * thickness
        upper = [(x, y - half), (neck, y - half), (neck, y - wide), (tip, y)]
        lower = [(neck, y + wide), (neck, y + half), (x, y + half)]
        with self.close_up(Box(min(x, tip), y - wide, max(x, tip), y + wide)) as big:
            big.polygon(color, upper + lower)


class CloseUp:
    """A patch of the surface drawn enlarged and then averaged, which gives any shape smooth edges."""

    def __init__(self, surface: pygame.Surface, box: Box) -> None:
        corner = (math.floor(box.left) - 1, math.floor(box.top) - 1)
        area = pygame.Rect(corner, (math.ceil(box.right) + 1 - corner[0], math.ceil(box.bottom) + 1 - corner[1]))
        self._surface = surface
        self._area = area.clip(surface.get_clip())

    def __enter__(self) -> Self:
        size = (self._area.width * _ENLARGED, self._area.height * _ENLARGED)
        patch = self._surface.subsurface(self._area) if self._area.width and self._area.height else None
        self._big = pygame.transform.scale(patch, size) if patch else pygame.Surface((1, 1), 0, 32)
        return self

    def __exit__(self, *_: object) -> None:
        if self._area.width and self._area.height:
            self._surface.blit(pygame.transform.smoothscale(self._big, self._area.size), self._area)

    def _inside(self, point: Point) -> Point:
        return (point[0] - self._area.left) * _ENLARGED, (point[1] - self._area.top) * _ENLARGED

    def polygon(self, color: Color, points: Iterable[Point]) -> None:
        """Fill a polygon."""
        pygame.draw.polygon(self._big, color, [self._inside(point) for point in points])

    def square(self, color: Color, at: Point, half: float) -> None:
        """Fill a square about a point."""
        box = Box.around(at, half)
        corners = [(box.left, box.top), (box.right, box.top), (box.right, box.bottom), (box.left, box.bottom)]
        self.polygon(color, corners)

    def circle(self, color: Color, center: Point, radius: float) -> None:
        """Fill a circle."""
        pygame.draw.circle(self._big, color, self._inside(center), radius * _ENLARGED)

    def rounded(self, color: Color, box: Box, radius: float) -> None:
        """Fill a rectangle with rounded corners."""
        left, top = self._inside((box.left, box.top))
        right, bottom = self._inside((box.right, box.bottom))
        rect = pygame.Rect(round(left), round(top), round(right) - round(left), round(bottom) - round(top))
        pygame.draw.rect(self._big, color, rect, border_radius=round(radius * _ENLARGED))

    def chevron(self, color: Color, tip: Point, size: float, direction: int, thickness: float) -> None:
        """Draw a chevron that points to the right (direction 1) or left (-1)."""
        x, y = tip
        back, slant = direction * thickness, direction * size
        front = [(x, y), (x - slant, y - size), (x - slant - back, y - size)]
        behind = [(x - back, y), (x - slant - back, y + size), (x - slant, y + size)]
        self.polygon(color, front + behind)


@dataclass(frozen=True)
class Frame:
    """What the functions that draw a part of a frame are given."""

    canvas: Canvas
    layout: Layout
    view: View
    scene: Scene
