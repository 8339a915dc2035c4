"""What a frame shows, where its parts stand, and which part of the plane they show."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.physics.parameters import brief_repr

RENDER_MODES = ("human", "rgb_array")
WIDTHS, HEIGHTS = (240, 7680), (135, 4320)  # of a frame, in pixels

Point = tuple[float, float]
Limits = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What one frame shows (dimensionless, like the model).

    Attributes:
        time: now. x, v: position and velocity of the mass. v_belt: speed of the belt.
        mode: -1 slip backward, 0 stick, 1 slip forward.
        belt_travel: integral of v_belt so far, which places the belt's marks.
        force: the control force u now. force_limit: its largest size; 0 where the actuator is the belt.
        belt_speed_nominal: belt speed without control. belt_speed_limits: what the actuator can reach; equal where the
            actuator is the force.
        alpha: height of the spring's anchor. geometry: "linear" and "duffing" draw a level spring from a wall.
        stick_interval: positions between which the mass can stick, if any.
        amplitude: of the last cycle; NaN where not known yet. stick_fraction: share of the time stuck, in [0, 1].
        title: a line above the picture.
    """

    time: float
    x: float
    v: float
    v_belt: float
    mode: int
    belt_travel: float
    force: float
    force_limit: float
    belt_speed_nominal: float
    belt_speed_limits: Limits
    alpha: float
    geometry: str
    stick_interval: Limits | None
    amplitude: float
    stick_fraction: float
    title: str = ""

    @property
    def level(self) -> bool:
        """Whether the spring lies level."""
        return self.geometry in ("linear", "duffing")


@dataclass(frozen=True)
class Box:
    """A rectangle in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def ltwh(self) -> tuple[int, int, int, int]:
        """Left, top, width and height in whole pixels."""
        left, top = round(self.left), round(self.top)
        return left, top, round(self.right) - left, round(self.bottom) - top

    @property
    def middle(self) -> Point:
        """The centre."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2

    def grown(self, by: float) -> "Box":
        """Return the box with every side moved out by this distance."""
        return Box(self.left - by, self.top - by, self.right + by, self.bottom + by)

    @staticmethod
    def around(at: Point, reach: float) -> "Box":
        """Return the square that reaches so far from its centre."""
        return Box(at[0] - reach, at[1] - reach, at[0] + reach, at[1] + reach)


@dataclass(frozen=True)
class Layout:
    """Where the parts of a frame stand, in pixels.

    One ``unit`` is a pixel of the 960 x 540 frame, for which every length in the drawing code is given. ``pin`` is the
    height of the mass's pin, which is the model's height 0; ``mass`` is half the width of the mass.
    """

    unit: float
    mechanism: Box
    portrait: Box
    plot: Box
    strip: Box
    ceiling: float
    pin: float
    belt: Box
    ruler: float
    mass: float

    @property
    def compact(self) -> bool:
        """Whether the frame is too small for most letters."""
        return self.unit < 0.6

    @staticmethod
    def of(size: tuple[int, int]) -> "Layout":
        """Return the layout of a frame of a size (width, height)."""
        width, height = size
        u = min(width / 960, height / 540)
        strip = Box(14 * u, height - 92 * u, width - 14 * u, height - 14 * u)
        split = 0.6 * width
        mechanism = Box(14 * u, 14 * u, split - 6 * u, strip.top - 12 * u)
        portrait = Box(split + 6 * u, 14 * u, width - 14 * u, strip.top - 12 * u)
        # Where letters cannot shrink with the frame, the margins that hold them do not either.
        letters = max(1.0, 0.55 / u)
        plot = Box(
            portrait.left + 50 * u * (1.0 if u < 0.6 else letters),
            portrait.top + 44 * u * letters,
            portrait.right - 18 * u,
            portrait.bottom - 46 * u,
        )
        mass = 30 * u
        belt_top = mechanism.bottom - (110 if u >= 0.6 else 100) * u
        return Layout(
            unit=u,
            mechanism=mechanism,
            portrait=portrait,
            plot=plot,
            strip=strip,
            ceiling=mechanism.top + 52 * u,
            pin=belt_top - mass,
            belt=Box(mechanism.left + 16 * u, belt_top, mechanism.right - 16 * u, belt_top + 50 * u),
            ruler=mechanism.bottom - (34 if u >= 0.6 else 26) * u,
            mass=mass,
        )


@dataclass(frozen=True)
class View:
    """The parts of the plane shown, and how they map to pixels.

    ``origin`` is the pixel of x = 0 on the mechanism, ``scale`` its pixels per unit of length, ``anchor`` the pixel of
    the spring's fixed end; ``true_height`` says whether the anchor's height is in scale.
    """

    x_mechanism: Limits
    x_plot: Limits
    v_plot: Limits
    origin: float
    scale: float
    anchor: Point
    true_height: bool

    def on_belt(self, x: float) -> float:
        """Return the pixel of a position along the belt."""
        return self.origin + self.scale * x

    def on_plot(self, plot: Box, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels, shape (..., 2), of points (x, v) on the phase portrait."""
        low = np.array((self.x_plot[0], self.v_plot[0]))
        span = np.array((self.x_plot[1], self.v_plot[1])) - low
        corner = np.array((plot.left, plot.bottom))
        size = np.array((plot.right - plot.left, plot.top - plot.bottom))
        return np.asarray(corner + (points - low) / span * size)

    @staticmethod
    def of(scene: Scene, layout: Layout, before: "View | None") -> "View":
        """Return the view of a scene: that of the frame before, grown as the motion needs."""
        speed = max(scene.belt_speed_nominal, scene.belt_speed_limits[1], 0.1)
        if before is not None:
            x_mechanism, x_plot, v_plot = before.x_mechanism, before.x_plot, before.v_plot
        else:
            if scene.level or scene.alpha >= 1.0:  # one well, at x = 0
                x_mechanism, x_plot = (-1.0, 1.0), (-0.75, 0.75)
            elif scene.x >= 0.0:  # the well that the mass is in
                x_mechanism, x_plot = (-0.5, 1.5), (0.0, 1.25)
            else:
                x_mechanism, x_plot = (-1.5, 0.5), (-1.25, 0.0)
            v_plot = (-2.5 * speed, 1.75 * speed)
        x_mechanism = _grown(x_mechanism, scene.x, 0.25, 0.1)
        x_plot = _grown(x_plot, scene.x, 0.25, 0.05)
        v_plot = _grown(_grown(v_plot, scene.v, 0.5 * speed, 0.1 * speed), scene.v_belt, 0.5 * speed, 0.0)

        left = layout.belt.left + (96 if scene.level else 34) * layout.unit
        right = layout.belt.right - 34 * layout.unit
        scale = (right - left) / (x_mechanism[1] - x_mechanism[0])
        room = layout.pin - layout.ceiling - 10 * layout.unit
        # A taller anchor makes the picture smaller, but only so far: then its height alone is drawn short.
        if not scene.level and scene.alpha * scale > room:
            scale = max(room / scene.alpha, 0.6 * scale)
        origin = (left + right) / 2 - scale * (x_mechanism[0] + x_mechanism[1]) / 2
        anchor, true_height = (layout.belt.left + 14 * layout.unit, layout.pin), True
        if not scene.level:
            anchor = (origin, layout.pin - min(scene.alpha * scale, room))
            true_height = scene.alpha * scale <= room * (1.0 + 1e-9)
        return View(x_mechanism, x_plot, v_plot, origin, scale, anchor, true_height)


def _grown(limits: Limits, value: float, step: float, margin: float) -> Limits:
    low, high = limits
    if value < low + margin:
        low = math.floor((value - margin) / step) * step
    if value > high - margin:
        high = math.ceil((value + margin) / step) * step
    return low, high


def checked_size(size: Any) -> tuple[int, int]:
    """Return the size of a frame (width, height) in pixels.

    Raises:
        TypeError: if it is no pair. ValueError: if one is not a whole number in ``WIDTHS`` or ``HEIGHTS``.
    """
    if not isinstance(size, Sequence) or isinstance(size, str) or len(size) != 2:
        raise TypeError(f"render_size must be a pair (width, height) of whole numbers, got {size!r}")
    width, height = size
    return checked_whole("render_size width", width, WIDTHS), checked_whole("render_size height", height, HEIGHTS)


def checked_whole(name: str, value: Any, limits: tuple[int, int]) -> int:
    """Return a whole number within limits.

    Raises:
        ValueError: if it is none.
    """
    low, high = limits
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = -1
    if not low <= number <= high:
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {brief_repr(value)}")
    return number
