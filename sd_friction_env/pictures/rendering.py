"""Pictures of the oscillator: spring, mass and moving belt beside the phase portrait; needs pygame-ce (extra "render").

Shapes, not only colours, tell stick from slip: a mass that sticks is solid and grips the belt with teeth, a mass that
slips is hollow, with chevrons pointing the way it slips and streaks behind it.
"""

import math
import operator
import os
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.physics.parameters import brief_repr

if TYPE_CHECKING:
    import pygame

Color = tuple[int, int, int]
Point = tuple[float, float]
Limits = tuple[float, float]
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

RENDER_MODES = ("human", "rgb_array")
WIDTHS = (240, 7680)
HEIGHTS = (135, 4320)
RATES = (1, 1000)
TRAIL_POINTS = 300
FADES = 12  # steps in which the trail fades
CLOSE_UP = 4  # a shape's edges are drawn so many times larger, then averaged
TITLES = {
    "exact": "inclined spring",
    "cubic": "inclined spring, cubic law",
    "linear": "linear spring",
    "duffing": "stiffening spring",
}
MINUS = "\N{MINUS SIGN}"
NOT_YET = "\N{EN DASH}"


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


class Renderer:
    """Draws scenes into arrays ("rgb_array", never touching a display) or into a window ("human").

    Args:
        render_mode: "human" or "rgb_array".
        width, height: of the frame in pixels; the window can be resized.
        fps: frames a second that the window keeps to.
        x_limits, v_limits: (low, high) of the axes. Without them they fit the motion: they grow as it needs and start
            afresh with :meth:`clear_trail`.

    Raises:
        ImportError: if pygame is not installed.
        ValueError: if an argument is not as said above.
    """

    def __init__(
        self,
        render_mode: str,
        width: int = 960,
        height: int = 540,
        fps: int = 30,
        x_limits: Limits | None = None,
        v_limits: Limits | None = None,
    ) -> None:
        if render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode must be one of {', '.join(map(repr, RENDER_MODES))}, got {render_mode!r}")
        self.render_mode = render_mode
        self.width = _checked_whole("width", width, WIDTHS)
        self.height = _checked_whole("height", height, HEIGHTS)
        self.fps = _checked_whole("fps", fps, RATES)
        self.x_limits = _checked_limits("x_limits", x_limits)
        self.v_limits = _checked_limits("v_limits", v_limits)
        self._dismissed = False
        self._drop_surfaces()
        self.clear_trail()
        _require_pygame()

    @property
    def dismissed(self) -> bool:
        """Whether the user closed the window; drawing then does nothing more."""
        return self._dismissed

    def clear_trail(self) -> None:
        """Forget the motion so far: call it when an episode begins."""
        self._trail: deque[tuple[float, float, int]] = deque(maxlen=TRAIL_POINTS)
        self._last_time = -math.inf
        self._view: _View | None = None

    def draw(self, scene: Scene) -> NDArray[np.uint8] | None:
        """Draw one frame; return it as an array of shape (height, width, 3) in mode "rgb_array".

        Raises:
            RuntimeError: if mode "human" finds no display.
            ValueError: if the state to draw is not finite.
        """
        for name in ("time", "x", "v", "v_belt", "belt_travel"):
            if not math.isfinite(getattr(scene, name)):
                raise ValueError(f"scene.{name} must be a finite number, got {getattr(scene, name)!r}")
        _require_pygame()
        import pygame

        if self.render_mode == "human":
            if self._dismissed:
                return None
            window = self._opened_window()
            if window is None:
                return None
            self._paint(scene, window.get_size())
            assert self._canvas is not None
            window.blit(self._canvas, (0, 0))
            pygame.display.flip()
            self._clock.tick(self.fps)
            return None
        self._paint(scene, (self.width, self.height))
        assert self._canvas is not None
        # A surface on the array's own memory: SDL's conversion is several times faster than NumPy's strided copy.
        pixels = bytearray(3 * self.width * self.height)
        pygame.image.frombuffer(pixels, (self.width, self.height), "RGB").blit(self._canvas, (0, 0))
        return np.frombuffer(pixels, dtype=np.uint8).reshape(self.height, self.width, 3)

    def close(self) -> None:
        """Close the window, if there is one, and let go of the surfaces."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
        self._drop_surfaces()

    def __getstate__(self) -> dict[str, Any]:
        # Surfaces, fonts and the window belong to this process; they are made again when next needed.
        return {name: value for name, value in self.__dict__.items() if name not in _SURFACES}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._drop_surfaces()

    def _drop_surfaces(self) -> None:
        self._window: pygame.Surface | None = None
        self._clock: Any = None
        self._canvas: pygame.Surface | None = None
        self._backdrop: pygame.Surface | None = None
        self._backdrop_key: object = None
        self._ink: _Lettering | None = None

    def _opened_window(self) -> "pygame.Surface | None":
        """Return the window after its events, or None once the user has closed it."""
        import pygame

        if self._window is None:
            try:
                pygame.display.init()
                self._window = pygame.display.set_mode((self.width, self.height), pygame.RESIZABLE)
            except pygame.error as error:
                pygame.display.quit()
                raise RuntimeError(
                    f"render_mode='human' needs a display ({error}); without one use render_mode='rgb_array'"
                ) from error
            pygame.display.set_caption("SD friction oscillator")
            self._clock = pygame.time.Clock()
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self._dismissed = True
        if self._dismissed:
            self.close()
            return None
        self._window = pygame.display.get_surface()  # another one after a resize
        return self._window

    def _paint(self, scene: Scene, size: tuple[int, int]) -> None:
        import pygame

        size = (max(size[0], WIDTHS[0]), max(size[1], HEIGHTS[0]))
        if self._canvas is None or self._canvas.get_size() != size:
            # 32 bits without alpha need no display to convert to.
            self._canvas = pygame.Surface(size, 0, 32)
            self._backdrop = None
            self._ink = _Lettering()
        assert self._ink is not None
        self._remember(scene)
        layout = _Layout.of(size)
        view = self._view = _view_of(scene, layout, self._view, self.x_limits, self.v_limits)
        actuators = (scene.force_limit, scene.belt_speed_nominal, scene.belt_speed_limits)
        key = (size, view, scene.title, scene.geometry, scene.alpha, actuators)
        if self._backdrop is None or key != self._backdrop_key:
            self._backdrop, self._backdrop_key = pygame.Surface(size, 0, 32), key
            _draw_backdrop(self._backdrop, self._ink, layout, view, scene)
        self._canvas.blit(self._backdrop, (0, 0))
        _draw_mechanism(self._canvas, self._ink, layout, view, scene)
        _draw_phase_portrait(self._canvas, self._ink, layout, view, scene, self._trail)
        _draw_readouts(self._canvas, self._ink, layout, scene)

    def _remember(self, scene: Scene) -> None:
        if scene.time < self._last_time:  # set back to an earlier state: another history
            self.clear_trail()
        elif scene.time == self._last_time:  # drawn twice
            self._trail.pop()
        self._last_time = scene.time
        self._trail.append((scene.x, scene.v, scene.mode))


_SURFACES = ("_window", "_clock", "_canvas", "_backdrop", "_backdrop_key", "_ink")


def _require_pygame() -> None:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # or pygame greets on standard output
    try:
        import pygame.font
    except ImportError as error:
        raise ImportError('rendering needs pygame-ce: pip install "sd-friction-env[render]"') from error
    pygame.font.init()  # needs no display; does nothing the second time


def checked_size(size: Any) -> tuple[int, int]:
    """Return the size of a frame (width, height) in pixels.

    Raises:
        TypeError: if it is no pair. ValueError: if one is not a whole number in ``WIDTHS`` or ``HEIGHTS``.
    """
    if not isinstance(size, Sequence) or isinstance(size, str) or len(size) != 2:
        raise TypeError(f"render_size must be a pair (width, height) of whole numbers, got {size!r}")
    width, height = size
    return _checked_whole("render_size width", width, WIDTHS), _checked_whole("render_size height", height, HEIGHTS)


def _checked_whole(name: str, value: Any, limits: tuple[int, int]) -> int:
    low, high = limits
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = -1
    if not low <= number <= high:
        raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {brief_repr(value)}")
    return number


def _checked_limits(name: str, value: Any) -> Limits | None:
    if value is None:
        return None
    try:
        low, high = (float(end) for end in value)
    except (TypeError, ValueError):
        low = high = math.nan
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"{name} must be None or two finite numbers (low, high) with low < high, got {value!r}")
    return low, high


# Where things stand on the frame, and which part of the plane they show.


@dataclass(frozen=True)
class _Box:
    left: float
    top: float
    right: float
    bottom: float

    @property
    def ltwh(self) -> tuple[int, int, int, int]:
        left, top = round(self.left), round(self.top)
        return left, top, round(self.right) - left, round(self.bottom) - top

    @property
    def middle(self) -> Point:
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2


@dataclass(frozen=True)
class _Layout:
    """Pixels. One ``unit`` is a pixel of the 960 x 540 frame, for which every length below is given."""

    unit: float
    mechanism: _Box
    portrait: _Box
    plot: _Box
    strip: _Box
    ceiling: float
    pin: float  # height of the mass's pin, which is the model's height 0
    belt: _Box
    ruler: float
    mass: float  # half its width

    @property
    def compact(self) -> bool:
        return self.unit < 0.6

    @staticmethod
    def of(size: tuple[int, int]) -> "_Layout":
        width, height = size
        u = min(width / 960, height / 540)
        strip = _Box(14 * u, height - 92 * u, width - 14 * u, height - 14 * u)
        split = 0.6 * width
        mechanism = _Box(14 * u, 14 * u, split - 6 * u, strip.top - 12 * u)
        portrait = _Box(split + 6 * u, 14 * u, width - 14 * u, strip.top - 12 * u)
        # Where letters cannot shrink with the frame, the margins that hold them do not either.
        letters = max(1.0, 0.55 / u)
        plot = _Box(
            portrait.left + 50 * u * (1.0 if u < 0.6 else letters),
            portrait.top + 44 * u * letters,
            portrait.right - 18 * u,
            portrait.bottom - 46 * u,
        )
        mass = 30 * u
        belt_top = mechanism.bottom - (110 if u >= 0.6 else 100) * u
        return _Layout(
            unit=u,
            mechanism=mechanism,
            portrait=portrait,
            plot=plot,
            strip=strip,
            ceiling=mechanism.top + 52 * u,
            pin=belt_top - mass,
            belt=_Box(mechanism.left + 16 * u, belt_top, mechanism.right - 16 * u, belt_top + 50 * u),
            ruler=mechanism.bottom - (34 if u >= 0.6 else 26) * u,
            mass=mass,
        )


@dataclass(frozen=True)
class _View:
    """The parts of the plane shown, and how they map to pixels."""

    x_mechanism: Limits
    x_plot: Limits
    v_plot: Limits
    origin: float  # pixel of x = 0 on the mechanism
    scale: float  # pixels per unit of length on the mechanism
    anchor: Point  # pixel of the spring's fixed end
    true_height: bool  # whether the anchor is at its height in scale

    def on_belt(self, x: float) -> float:
        return self.origin + self.scale * x

    def on_plot(self, plot: _Box, points: NDArray[np.float64]) -> NDArray[np.float64]:
        low = np.array((self.x_plot[0], self.v_plot[0]))
        span = np.array((self.x_plot[1], self.v_plot[1])) - low
        corner = np.array((plot.left, plot.bottom))
        size = np.array((plot.right - plot.left, plot.top - plot.bottom))
        return np.asarray(corner + (points - low) / span * size)


def _view_of(
    scene: Scene, layout: _Layout, before: _View | None, x_limits: Limits | None, v_limits: Limits | None
) -> _View:
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
    x_mechanism = x_limits or _grown(x_mechanism, scene.x, 0.25, 0.1)
    x_plot = x_limits or _grown(x_plot, scene.x, 0.25, 0.05)
    v_plot = v_limits or _grown(_grown(v_plot, scene.v, 0.5 * speed, 0.1 * speed), scene.v_belt, 0.5 * speed, 0.0)

    left = layout.belt.left + (96 if scene.level else 34) * layout.unit
    right = layout.belt.right - 34 * layout.unit
    scale = (right - left) / (x_mechanism[1] - x_mechanism[0])
    room = layout.pin - layout.ceiling - 10 * layout.unit
    # A taller anchor makes the picture smaller, but only so far: then its height alone is drawn short.
    if not scene.level and scene.alpha * scale > room:
        scale = max(room / scene.alpha, 0.6 * scale)
    origin = (left + right) / 2 - scale * (x_mechanism[0] + x_mechanism[1]) / 2
    if scene.level:
        anchor = (layout.belt.left + 14 * layout.unit, layout.pin)
        true_height = True
    else:
        anchor = (origin, layout.pin - min(scene.alpha * scale, room))
        true_height = scene.alpha * scale <= room * (1.0 + 1e-9)
    return _View(x_mechanism, x_plot, v_plot, origin, scale, anchor, true_height)


def _grown(limits: Limits, value: float, step: float, margin: float) -> Limits:
    low, high = limits
    if value < low + margin:
        low = math.floor((value - margin) / step) * step
    if value > high - margin:
        high = math.ceil((value + margin) / step) * step
    return low, high


def _ticks(limits: Limits, wanted: int) -> tuple[list[float], str]:
    """Return round numbers within ``limits``, at most ``wanted`` + 1 of them, and the format that shows them."""
    low, high = limits
    raw = (high - low) / wanted
    power = math.floor(math.log10(raw))
    step = next(m * 10.0**power for m in (1, 2, 5, 10) if m * 10.0**power >= raw * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [k * step for k in range(first, last + 1)], f".{decimals}f"


def _number(value: float, form: str) -> str:
    return f"{value + 0.0:{form}}".replace("-", MINUS)


# Drawing. Coordinates are floats throughout: a motion rounded to whole pixels would tremble.


class _Lettering:
    """Text in pygame's own font, which every machine has: frames do not depend on installed fonts."""

    def __init__(self) -> None:
        self._fonts: dict[int, pygame.font.Font] = {}
        self._texts: dict[tuple[str, int, Color], pygame.Surface] = {}

    def image(self, text: str, size: float, color: Color) -> "pygame.Surface":
        import pygame

        key = (text, max(11, round(size)), color)
        if key not in self._texts:
            if len(self._texts) > 500:
                self._texts.clear()
            if key[1] not in self._fonts:
                self._fonts[key[1]] = pygame.font.Font(None, CLOSE_UP * key[1])
            # Small letters set at their own size stand unevenly, on whole pixels.
            big = self._fonts[key[1]].render(text, True, color)
            size_now = (max(1, round(big.get_width() / CLOSE_UP)), max(1, round(big.get_height() / CLOSE_UP)))
            self._texts[key] = pygame.transform.smoothscale(big, size_now)
        return self._texts[key]

    def write(
        self,
        surface: "pygame.Surface",
        text: str,
        at: Point,
        size: float,
        color: Color,
        anchor: Anchor = "midleft",
        turned: bool = False,
    ) -> float:
        """Write ``text`` and return its width."""
        import pygame

        image = self.image(text, size, color)
        if turned:
            image = pygame.transform.rotate(image, 90)
        width, height = image.get_size()
        left = at[0] - {"midleft": 0.0, "center": 0.5, "midright": 1.0}[anchor] * width
        surface.blit(image, (round(left), round(at[1] - height / 2)))
        return float(width)


def _stroke(
    surface: "pygame.Surface", color: Color, points: NDArray[np.float64] | Sequence[Point], width: float
) -> None:
    """Draw a smooth line of any width: anti-aliased lines of one pixel, side by side."""
    import pygame

    spread = max(width - 1.0, 0.0) / 2
    count = math.ceil(4.0 * spread) + 1
    offsets = [spread * (2.0 * k / max(count - 1, 1) - 1.0) for k in range(count)]
    if len(points) == 2:
        (x0, y0), (x1, y1) = points
        length = math.sqrt((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)) or 1.0
        nx, ny = (y0 - y1) / length, (x1 - x0) / length
        for offset in offsets:
            dx, dy = offset * nx, offset * ny
            pygame.draw.aaline(surface, color, (x0 + dx, y0 + dy), (x1 + dx, y1 + dy))
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
        pygame.draw.aalines(surface, color, False, (line + offset * normals).tolist())


class _CloseUp:
    """A patch of the surface drawn enlarged and then averaged, which gives any shape smooth edges."""

    def __init__(self, surface: "pygame.Surface", left: float, top: float, right: float, bottom: float) -> None:
        import pygame

        corner = (math.floor(left) - 1, math.floor(top) - 1)
        area = pygame.Rect(corner, (math.ceil(right) + 1 - corner[0], math.ceil(bottom) + 1 - corner[1]))
        self._surface = surface
        self._area = area.clip(surface.get_clip())

    def __enter__(self) -> Self:
        import pygame

        size = (self._area.width * CLOSE_UP, self._area.height * CLOSE_UP)
        patch = self._surface.subsurface(self._area) if self._area.width and self._area.height else None
        self._big = pygame.transform.scale(patch, size) if patch else pygame.Surface((1, 1), 0, 32)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import pygame

        if self._area.width and self._area.height:
            self._surface.blit(pygame.transform.smoothscale(self._big, self._area.size), self._area)

    def _inside(self, point: Point) -> Point:
        return (point[0] - self._area.left) * CLOSE_UP, (point[1] - self._area.top) * CLOSE_UP

    def polygon(self, color: Color, points: Iterable[Point]) -> None:
        import pygame

        pygame.draw.polygon(self._big, color, [self._inside(point) for point in points])

    def circle(self, color: Color, center: Point, radius: float) -> None:
        import pygame

        pygame.draw.circle(self._big, color, self._inside(center), radius * CLOSE_UP)

    def rounded(self, color: Color, box: _Box, radius: float) -> None:
        import pygame

        left, top = self._inside((box.left, box.top))
        right, bottom = self._inside((box.right, box.bottom))
        rect = pygame.Rect(round(left), round(top), round(right) - round(left), round(bottom) - round(top))
        pygame.draw.rect(self._big, color, rect, border_radius=round(radius * CLOSE_UP))


def _rounded(surface: "pygame.Surface", color: Color, box: _Box, radius: float) -> None:
    with _CloseUp(surface, box.left, box.top, box.right, box.bottom) as big:
        big.rounded(color, box, radius)


def _panel(surface: "pygame.Surface", box: _Box, radius: float) -> None:
    import pygame

    area = pygame.Rect(box.ltwh)
    inner = area.inflate(-2, -2)
    pygame.draw.rect(surface, LINE, area)
    pygame.draw.rect(surface, PAPER, inner)
    # Close up, but only where it shows: a whole panel would take tens of milliseconds.
    size = math.ceil(radius) + 1
    for x in (area.left, area.right - size):
        for y in (area.top, area.bottom - size):
            surface.set_clip((x, y, size, size))
            surface.fill(GROUND)
            with _CloseUp(surface, x, y, x + size, y + size) as big:
                for color, rect, bend in ((LINE, area, radius), (PAPER, inner, radius - 1)):
                    big.rounded(color, _Box(rect.left, rect.top, rect.right, rect.bottom), bend)
    surface.set_clip(None)


def _level_arrow(surface: "pygame.Surface", color: Color, tail: Point, length: float, thickness: float) -> None:
    """Draw an arrow to the right (length > 0) or left."""
    x, y = tail
    tip = x + length
    head = math.copysign(min(2.2 * thickness, abs(length)), length)
    half, wide = thickness / 2, 1.5 * thickness
    points = [
        (x, y - half),
        (tip - head, y - half),
        (tip - head, y - wide),
        (tip, y),
        (tip - head, y + wide),
        (tip - head, y + half),
        (x, y + half),
    ]
    with _CloseUp(surface, min(x, tip), y - wide, max(x, tip), y + wide) as big:
        big.polygon(color, points)


def _chevron(big: _CloseUp, color: Color, tip: Point, size: float, direction: int, thickness: float) -> None:
    x, y = tip
    back, slant = direction * thickness, direction * size
    big.polygon(
        color,
        [
            (x, y),
            (x - slant, y - size),
            (x - slant - back, y - size),
            (x - back, y),
            (x - slant - back, y + size),
            (x - slant, y + size),
        ],
    )


def _hatched_bar(surface: "pygame.Surface", start: Point, end: Point, away: Point, unit: float) -> None:
    """Draw a fixed body's edge, with hatching on the side that ``away`` points to."""
    first, last = np.array(start), np.array(end)
    length = float(np.sqrt(((last - first) ** 2).sum()))
    along = (last - first) / length
    count = max(2, round(length / (9 * unit)))
    for k in range(count + 1):
        foot = first + along * (length * k / count)
        _stroke(surface, STEEL, np.vstack((foot, foot + (np.array(away) - 0.8 * along) * 9 * unit)), 1.2 * unit)
    _stroke(surface, SLATE, np.vstack((first, last)), 3.5 * unit)


def _on_loop(belt: _Box, inset: float, distance: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
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


def _spring(surface: "pygame.Surface", start: Point, end: Point, unit: float) -> None:
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
        _stroke(surface, (163, 174, 188), half, 2.2 * unit)
    for half in halves[0::2]:
        _stroke(surface, SLATE, half, 2.8 * unit)
    _stroke(surface, SLATE, np.concatenate(([start], points[: quarter + 1])), 2.8 * unit)
    _stroke(surface, SLATE, np.concatenate((points[-quarter - 1 :], [end])), 2.8 * unit)


def _draw_backdrop(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, view: _View, scene: Scene) -> None:
    """Draw what stays put while the view does."""
    u = layout.unit
    surface.fill(GROUND)
    for box in (layout.mechanism, layout.portrait, layout.strip):
        _panel(surface, box, 10 * u)
    _draw_fixtures(surface, ink, layout, view, scene)
    _draw_axes(surface, ink, layout, view)
    _draw_captions(surface, ink, layout, scene)


def _draw_fixtures(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, view: _View, scene: Scene) -> None:
    u = layout.unit
    header = layout.mechanism.top + 22 * u
    title = scene.title or TITLES.get(scene.geometry, scene.geometry)
    ink.write(surface, title, (layout.mechanism.left + 16 * u, header), 21 * u, INK)

    belt = layout.belt
    outer = (belt.bottom - belt.top) / 2
    _rounded(surface, SLATE, belt, outer)
    band = 9 * u
    _rounded(surface, GROUND, _Box(belt.left + band, belt.top + band, belt.right - band, belt.bottom - band), outer)

    if scene.level:
        x, y = view.anchor
        _hatched_bar(surface, (x, y - 46 * u), (x, belt.top - 3 * u), (-1.0, 0.0), u)
    else:
        x, y = view.anchor
        _hatched_bar(surface, (x - 46 * u, layout.ceiling), (x + 46 * u, layout.ceiling), (0.0, -1.0), u)
        _stroke(surface, SLATE, ((x, layout.ceiling), (x, y)), 6 * u)
        dots = np.arange(y + 12 * u, belt.top - 4 * u, 9 * u)
        for dot in dots:
            _stroke(surface, (186, 195, 205), ((x, dot), (x, dot + 4 * u)), 1.4 * u)
        if not layout.compact:
            text = f"\N{GREEK SMALL LETTER ALPHA} = {scene.alpha:.3g}" + ("" if view.true_height else ", not to scale")
            side = -1 if x > layout.mechanism.middle[0] else 1
            at = (x + side * 58 * u, layout.ceiling + 1 * u)
            ink.write(surface, text, at, 18 * u, MUTED, "midright" if side < 0 else "midleft")

    if not layout.compact:
        values, form = _ticks(view.x_mechanism, 8)
        for value in values:
            at = (view.on_belt(value), layout.ruler + 16 * u)
            ink.write(surface, _number(value, form), at, 17 * u, MUTED, "center")


def _draw_axes(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, view: _View) -> None:
    import pygame

    u, plot = layout.unit, layout.plot
    ink.write(surface, "phase portrait", (layout.portrait.left + 16 * u, layout.portrait.top + 22 * u), 21 * u, INK)
    size = 17 * u
    if not layout.compact:
        at = (layout.portrait.right - 18 * u, layout.portrait.top + 23 * u)
        end = at[0] - ink.write(surface, "v = belt speed", at, size, MUTED, "midright") - 7 * u
        _dashes(surface, end - 31 * u, end, at[1], u)
    columns, column_form = _ticks(view.x_plot, 5)
    rows, row_form = _ticks(view.v_plot, 6)
    for value in columns:
        x = float(view.on_plot(plot, np.array((value, 0.0)))[0])
        pygame.draw.line(
            surface, GRID, (round(x), round(plot.top)), (round(x), round(plot.bottom) - 1), max(1, round(u))
        )
        if not layout.compact:
            ink.write(surface, _number(value, column_form), (x, plot.bottom + 13 * u), size, MUTED, "center")
    for value in rows:
        y = float(view.on_plot(plot, np.array((0.0, value)))[1])
        shade = LINE if value == 0.0 else GRID
        pygame.draw.line(
            surface, shade, (round(plot.left), round(y)), (round(plot.right) - 1, round(y)), max(1, round(u))
        )
        if not layout.compact:
            ink.write(surface, _number(value, row_form), (plot.left - 7 * u, y), size, MUTED, "midright")
    pygame.draw.rect(surface, LINE, plot.ltwh, max(1, round(u)))
    if layout.compact:
        ink.write(surface, "x", ((plot.left + plot.right) / 2, plot.bottom + 20 * u), size, MUTED, "center")
        ink.write(surface, "v", (plot.left - 22 * u, (plot.top + plot.bottom) / 2), size, MUTED, "center")
    else:
        ink.write(surface, "position x", (plot.right, plot.bottom + 31 * u), size, MUTED, "midright")
        at = (layout.portrait.left + 14 * u, plot.top + ink.image("velocity v", size, MUTED).get_width() / 2)
        ink.write(surface, "velocity v", at, size, MUTED, "center", turned=True)


def _draw_mechanism(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, view: _View, scene: Scene) -> None:
    u = layout.unit
    _draw_badge(surface, ink, layout, scene.mode)
    surface.set_clip(layout.mechanism.ltwh)
    _draw_belt(surface, layout, view, scene)
    _draw_ruler(surface, ink, layout, view, scene)
    x = view.on_belt(scene.x)
    pin = (x, layout.pin)
    if scene.mode != 0:
        _draw_streaks(surface, layout, x, scene)
    _draw_mass(surface, layout, x, scene)
    start = view.anchor
    _spring(surface, start, (x - layout.mass, layout.pin) if scene.level else pin, u)
    joints = [start] if scene.level else [start, pin]
    for joint in joints:
        with _CloseUp(surface, joint[0] - 7 * u, joint[1] - 7 * u, joint[0] + 7 * u, joint[1] + 7 * u) as big:
            big.circle(SLATE, joint, 6.5 * u)
            big.circle(PAPER, joint, 3.2 * u)
    if scene.force_limit > 0.0 and abs(scene.force) > 1e-3 * scene.force_limit:
        side = math.copysign(1.0, scene.force)
        length = max(-1.0, min(1.0, scene.force / scene.force_limit)) * 84 * u + side * 12 * u
        _level_arrow(surface, GREEN, (x + side * (layout.mass + 4 * u), layout.pin - 19 * u), length, 7 * u)
    surface.set_clip(None)


def _draw_badge(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, mode: int) -> None:
    u = layout.unit
    color = BLUE if mode == 0 else VERMILION
    text = "STICK" if mode == 0 else "SLIP"
    width = max(108 * u, ink.image("STICK", 24 * u, color).get_width() + max(40 * u, 22.0))
    half = max(16 * u, 7.0)
    right, y = layout.mechanism.right - 14 * u, layout.mechanism.top + 10 * u + half
    box = _Box(right - width, y - half, right, y + half)
    middle = (box.left + box.right) / 2
    with _CloseUp(surface, box.left, box.top, box.right, box.bottom) as big:
        big.rounded(color, box, half)
        if mode == 0:
            side = 6 * u
            x = box.left + 20 * u
            big.polygon(PAPER, [(x - side, y - side), (x + side, y - side), (x + side, y + side), (x - side, y + side)])
        else:
            edge = 2.5 * u
            inner = _Box(box.left + edge, box.top + edge, box.right - edge, box.bottom - edge)
            big.rounded(PAPER, inner, half - edge)
            for k in (0, 1):
                tip = middle + mode * (width / 2 - (14 + 11 * k) * u)
                _chevron(big, color, (tip, y), 7 * u, mode, 4.5 * u)
    shift = 10 * u if mode == 0 else -mode * 12 * u
    ink.write(surface, text, (middle + shift, y + 0.5 * u), 24 * u, PAPER if mode == 0 else color, "center")


def _draw_belt(surface: "pygame.Surface", layout: _Layout, view: _View, scene: Scene) -> None:
    u, belt = layout.unit, layout.belt
    outer = (belt.bottom - belt.top) / 2
    travel = scene.belt_travel * view.scale
    loop = _on_loop(belt, 0.0, np.zeros(1))[1]
    # Every fourth mark is a long one, so that the eye can follow it round.
    count = 4 * max(2, round(loop / (27 * u) / 4))
    at = np.mod(travel, loop) + loop * np.arange(count) / count
    outside, inside = (_on_loop(belt, inset, at)[0] for inset in (1.5 * u, 7.5 * u))
    for k in range(count):
        strong = k % 4 == 0
        _stroke(
            surface,
            PAPER if strong else (150, 162, 176),
            np.vstack((outside[k], inside[k])),
            max(1.0, (4.0 if strong else 2.2) * u),
        )
    for hub in (belt.left + outer, belt.right - outer):
        y = belt.top + outer
        radius = outer - 10.5 * u
        with _CloseUp(surface, hub - radius, y - radius, hub + radius, y + radius) as big:
            big.circle(STEEL, (hub, y), radius)
            big.circle((203, 211, 220), (hub, y), radius - 2.5 * u)
        for spoke in range(3):
            angle = travel / outer + spoke * math.pi / 3
            dx, dy = (radius - 2 * u) * math.cos(angle), (radius - 2 * u) * math.sin(angle)
            _stroke(surface, STEEL, ((hub - dx, y - dy), (hub + dx, y + dy)), max(1.0, 1.8 * u))
    fastest = max(scene.belt_speed_nominal, *scene.belt_speed_limits, abs(scene.v_belt))
    if fastest > 0.0 and abs(scene.v_belt) > 1e-3 * fastest:
        middle = (belt.left + belt.right) / 2
        length = scene.v_belt / fastest * 150 * u
        driven = scene.belt_speed_limits[1] > scene.belt_speed_limits[0]
        _level_arrow(surface, GREEN if driven else STEEL, (middle - 75 * u, belt.top + outer), length, 7 * u)


def _draw_ruler(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, view: _View, scene: Scene) -> None:
    """Draw the axis of positions, marked where the mass can stick (which moves with the belt's speed)."""
    u, y = layout.unit, layout.ruler
    left, right = (view.on_belt(end) for end in view.x_mechanism)
    if scene.stick_interval is not None:
        low, high = (min(max(view.on_belt(x), left), right) for x in scene.stick_interval)
        if high > low:
            _rounded(surface, PALE_BLUE, _Box(low, y - 4 * u, high, y + 4 * u), 4 * u)
            if not layout.compact:
                ink.write(surface, "can stick here", (low + 2 * u, y - 13 * u), 16 * u, BLUE)
    width = max(1.0, 1.2 * u)
    _stroke(surface, STEEL, ((left, y), (right, y)), width)
    for value in _ticks(view.x_mechanism, 8)[0]:
        x = view.on_belt(value)
        _stroke(surface, STEEL, ((x, y - 4 * u), (x, y + 4 * u)), width)


def _draw_streaks(surface: "pygame.Surface", layout: _Layout, x: float, scene: Scene) -> None:
    """Draw lines that the slipping mass leaves behind, longer the faster it slips."""
    u = layout.unit
    unit_speed = max(scene.belt_speed_nominal, 0.05)
    reach = min(abs(scene.v - scene.v_belt) / unit_speed, 2.5) * 22 * u
    start = x - scene.mode * (layout.mass + 6 * u)
    for drop, share in ((6, 0.6), (15, 1.0), (24, 0.75)):
        y = layout.pin + drop * u
        if reach * share > 2 * u:
            _stroke(surface, VERMILION, ((start, y), (start - scene.mode * reach * share, y)), max(1.0, 2.4 * u))


def _draw_mass(surface: "pygame.Surface", layout: _Layout, x: float, scene: Scene) -> None:
    u, half = layout.unit, layout.mass
    floor = layout.belt.top
    with _CloseUp(surface, x - half - 8 * u, layout.pin - half, x + half + 8 * u, floor + 9 * u) as big:
        if scene.mode == 0:
            # Square and solid on a shoe whose teeth bite into the belt.
            big.rounded(BLUE, _Box(x - half, layout.pin - half, x + half, floor - 1 * u), 3 * u)
            big.polygon(
                BLUE,
                [
                    (x - half, floor - 9 * u),
                    (x + half, floor - 9 * u),
                    (x + half + 6 * u, floor),
                    (x - half - 6 * u, floor),
                ],
            )
            teeth, width = 5, (2 * half + 12 * u) / 5
            for color, wider in ((PAPER, 1.6 * u), (BLUE, 0.0)):
                for k in range(teeth):
                    left, right = x - half - 6 * u + k * width - wider, x - half - 6 * u + (k + 1) * width + wider
                    tip = ((left + right) / 2, floor + 6.5 * u + 1.2 * wider)
                    big.polygon(color, [(left, floor - 0.5 * u), (right, floor - 0.5 * u), tip])
        else:
            edge = 4.5 * u
            big.rounded(VERMILION, _Box(x - half, layout.pin - half, x + half, floor - 1.5 * u), 13 * u)
            inner = _Box(x - half + edge, layout.pin - half + edge, x + half - edge, floor - 1.5 * u - edge)
            big.rounded((255, 243, 234), inner, 13 * u - edge)
            for k in (-1, 0, 1):
                tip = (x + scene.mode * (4.5 + 11 * k) * u, layout.pin + 15 * u)
                _chevron(big, VERMILION, tip, 6 * u, scene.mode, 4 * u)


def _draw_phase_portrait(
    surface: "pygame.Surface",
    ink: _Lettering,
    layout: _Layout,
    view: _View,
    scene: Scene,
    trail: Sequence[tuple[float, float, int]],
) -> None:
    u, plot = layout.unit, layout.plot
    left, top, width, height = plot.ltwh
    surface.set_clip((left + 1, top + 1, width - 2, height - 2))
    y = float(view.on_plot(plot, np.array((0.0, scene.v_belt)))[1])
    if scene.stick_interval is not None:
        ends = view.on_plot(plot, np.array([(x, scene.v_belt) for x in scene.stick_interval]))[:, 0]
        low, high = max(float(ends[0]), plot.left), min(float(ends[1]), plot.right)
        if high > low:
            _rounded(surface, PALE_BLUE, _Box(low, y - 4.5 * u, high, y + 4.5 * u), 4.5 * u)
    _dashes(surface, plot.left + 2 * u, plot.right, y, u)
    points = view.on_plot(plot, np.array([point[:2] for point in trail], dtype=np.float64))
    modes = [point[2] for point in trail]
    _draw_trail(surface, points, modes, max(1.0, 2.4 * u))

    x, y = points[-1]
    with _CloseUp(surface, x - 10 * u, y - 10 * u, x + 10 * u, y + 10 * u) as big:
        if scene.mode == 0:
            for color, side in ((PAPER, 8.5 * u), (BLUE, 7 * u)):
                corners = [(x - side, y - side), (x + side, y - side), (x + side, y + side), (x - side, y + side)]
                big.polygon(color, corners)
        else:
            for color, radius in ((PAPER, 9.5 * u), (VERMILION, 8 * u), (PAPER, 4.5 * u)):
                big.circle(color, (x, y), radius)
    surface.set_clip(None)


def _dashes(surface: "pygame.Surface", left: float, right: float, y: float, unit: float) -> None:
    for k in range(math.ceil((right - left) / (12 * unit))):
        start = left + 12 * k * unit
        _stroke(surface, SLATE, ((start, y), (min(start + 7 * unit, right), y)), max(1.0, 1.6 * unit))


def _draw_trail(surface: "pygame.Surface", points: NDArray[np.float64], modes: Sequence[int], width: float) -> None:
    """Draw the path so far, older parts paler, in pieces of one colour."""
    last = len(points) - 1

    def style(k: int) -> tuple[int, bool]:
        return (last - k) * FADES // TRAIL_POINTS, modes[k] == 0

    start = 0
    for end in range(1, last + 1):
        if end == last or style(end) != style(end + 1):
            age, stuck = style(end)
            share = 0.85 * age / FADES
            color = BLUE if stuck else VERMILION
            red, green, blue = (round(c + (255 - c) * share) for c in color)
            _stroke(surface, (red, green, blue), points[start : end + 1], width)
            start = end


# The strip below: numbers, then the actuators.


def _gauges(scene: Scene) -> tuple[tuple[str, ...], tuple[tuple[float, float, float, float], ...]]:
    """Return the actuators' names, and for each (low, rest, high, now)."""
    names, values = [], []
    if scene.force_limit > 0.0:
        names.append("control force u")
        values.append((-scene.force_limit, 0.0, scene.force_limit, scene.force))
    low, high = scene.belt_speed_limits
    if high > low:
        names.append("belt speed")
        values.append((low, scene.belt_speed_nominal, high, scene.v_belt))
    return tuple(names), tuple(values)


def _readouts(scene: Scene) -> tuple[tuple[str, str, str], ...]:
    """Return name, short name and value of each number."""
    amplitude = f"{scene.amplitude:.3f}" if math.isfinite(scene.amplitude) else NOT_YET
    share = f"{100 * scene.stick_fraction:.0f} %" if math.isfinite(scene.stick_fraction) else NOT_YET
    cells = (("time", "t", f"{scene.time:.1f}"), ("amplitude", "A", amplitude), ("time stuck", "stuck", share))
    if "belt speed" in _gauges(scene)[0]:
        return cells
    return (*cells, ("belt speed", "belt", f"{scene.v_belt:.3f}"))


def _cell(layout: _Layout, index: int) -> float:
    return layout.strip.left + (18 + 124 * index) * layout.unit


def _gauge_boxes(layout: _Layout, scene: Scene) -> list[_Box]:
    u = layout.unit
    names = _gauges(scene)[0]
    if not names:
        return []
    first = _cell(layout, len(_readouts(scene))) + 10 * u
    pitch = (layout.strip.right - 28 * u - first + 40 * u) / len(names)
    middle = layout.strip.middle[1] + (9 if not layout.compact else 14) * u
    return [
        _Box(first + k * pitch + 14 * u, middle - 5 * u, first + (k + 1) * pitch - 40 * u, middle + 5 * u)
        for k in range(len(names))
    ]


def _draw_captions(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, scene: Scene) -> None:
    u = layout.unit
    y = layout.strip.top + 20 * u
    for index, (name, short, _) in enumerate(_readouts(scene)):
        ink.write(surface, short if layout.compact else name, (_cell(layout, index), y), 18 * u, MUTED)
    names, values = _gauges(scene)
    for name, (low, rest, high, _), box in zip(names, values, _gauge_boxes(layout, scene), strict=True):
        ink.write(surface, name, (box.left, y), 18 * u, MUTED)
        _rounded(surface, (226, 231, 237), box, 5 * u)
        if not layout.compact:
            span = box.right - box.left
            for value in (low, rest, high):
                x = box.left + span * (value - low) / (high - low)
                _stroke(surface, STEEL, ((x, box.bottom + 2 * u), (x, box.bottom + 6 * u)), 1.2 * u)
                ink.write(surface, _number(value, ".4g"), (x, box.bottom + 15 * u), 16 * u, MUTED, "center")


def _draw_readouts(surface: "pygame.Surface", ink: _Lettering, layout: _Layout, scene: Scene) -> None:
    u = layout.unit
    y = layout.strip.top + 50 * u
    for index, (_, _, value) in enumerate(_readouts(scene)):
        ink.write(surface, value, (_cell(layout, index), y), (34 if not layout.compact else 30) * u, INK)
    for (low, rest, high, now), box in zip(_gauges(scene)[1], _gauge_boxes(layout, scene), strict=True):
        span = box.right - box.left
        middle = box.middle[1]
        start, end = (box.left + span * (min(max(z, low), high) - low) / (high - low) for z in (rest, now))
        left, right = min(start, end), max(start, end)
        with _CloseUp(surface, left - 9 * u, middle - 9 * u, right + 9 * u, middle + 9 * u) as big:
            if right > left:
                big.rounded(GREEN, _Box(left, box.top, right, box.bottom), 0.0)
            big.circle(PAPER, (end, middle), 9 * u)
            big.circle(GREEN, (end, middle), 7.5 * u)
        if not layout.compact:
            ink.write(surface, _number(now, ".3f"), (box.right, layout.strip.top + 20 * u), 20 * u, INK, "midright")
