"""Pictures of the oscillator: spring, mass and moving belt beside the phase portrait; needs pygame-ce."""

import math
import operator
import os
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.extras import extra
from sd_friction_env.physics.parameters import brief_repr
from sd_friction_env.pictures.canvas import GROUND, Canvas, Frame, Lettering
from sd_friction_env.pictures.gauges import draw_captions, draw_readouts
from sd_friction_env.pictures.mechanism import draw_fixtures, draw_mechanism
from sd_friction_env.pictures.portrait import TRAIL_POINTS, draw_axes, draw_portrait
from sd_friction_env.pictures.scene import Layout, Limits, Scene, View

if TYPE_CHECKING:
    import pygame

RENDER_MODES = ("human", "rgb_array")
WIDTHS = (240, 7680)
HEIGHTS = (135, 4320)
RATES = (1, 1000)
_SURFACES = ("_window", "_clock", "_canvas", "_backdrop", "_backdrop_key")


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
        self._view: View | None = None

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
            window.blit(self._painted(scene, window.get_size()), (0, 0))
            pygame.display.flip()
            self._clock.tick(self.fps)
            return None
        painted = self._painted(scene, (self.width, self.height))
        # A surface on the array's own memory: SDL's conversion is several times faster than NumPy's strided copy.
        pixels = bytearray(3 * self.width * self.height)
        pygame.image.frombuffer(pixels, (self.width, self.height), "RGB").blit(painted, (0, 0))
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
        self._canvas: Canvas | None = None
        self._backdrop: pygame.Surface | None = None
        self._backdrop_key: object = None

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

    def _painted(self, scene: Scene, size: tuple[int, int]) -> "pygame.Surface":
        import pygame

        size = (max(size[0], WIDTHS[0]), max(size[1], HEIGHTS[0]))
        if self._canvas is None or self._canvas.surface.get_size() != size:
            # 32 bits without alpha need no display to convert to.
            self._canvas = Canvas(pygame.Surface(size, 0, 32), Lettering())
            self._backdrop = None
        self._remember(scene)
        layout = Layout.of(size)
        view = self._view = View.of(scene, layout, self._view, self.x_limits, self.v_limits)
        actuators = (scene.force_limit, scene.belt_speed_nominal, scene.belt_speed_limits)
        key = (size, view, scene.title, scene.geometry, scene.alpha, actuators)
        if self._backdrop is None or key != self._backdrop_key:
            self._backdrop, self._backdrop_key = pygame.Surface(size, 0, 32), key
            _draw_backdrop(Frame(Canvas(self._backdrop, self._canvas.lettering), layout, view, scene))
        self._canvas.surface.blit(self._backdrop, (0, 0))
        frame = Frame(self._canvas, layout, view, scene)
        draw_mechanism(frame)
        draw_portrait(frame, self._trail)
        draw_readouts(frame)
        return self._canvas.surface

    def _remember(self, scene: Scene) -> None:
        if scene.time < self._last_time:  # set back to an earlier state: another history
            self.clear_trail()
        elif scene.time == self._last_time:  # drawn twice
            self._trail.pop()
        self._last_time = scene.time
        self._trail.append((scene.x, scene.v, scene.mode))


def _draw_backdrop(frame: Frame) -> None:
    """Draw what stays put while the view does."""
    layout = frame.layout
    frame.canvas.surface.fill(GROUND)
    for box in (layout.mechanism, layout.portrait, layout.strip):
        frame.canvas.panel(box, 10 * layout.unit)
    draw_fixtures(frame)
    draw_axes(frame)
    draw_captions(frame)


def _require_pygame() -> None:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # or pygame greets on standard output
    with extra("render"):
        import pygame.font
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
