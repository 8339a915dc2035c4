"""Pictures of the oscillator: spring, mass and moving belt beside the phase portrait; needs pygame-ce."""

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.extras import extra
from sd_friction_env.physics.parameters import checked_choice
from sd_friction_env.pictures.canvas import GROUND, Canvas, Frame, Lettering
from sd_friction_env.pictures.gauges import draw_captions, draw_readouts
from sd_friction_env.pictures.mechanism import draw_fixtures, draw_mechanism
from sd_friction_env.pictures.portrait import TRAIL_POINTS, draw_axes, draw_portrait
from sd_friction_env.pictures.scene import HEIGHTS, RENDER_MODES, WIDTHS, Layout, Scene, View, checked_whole

with extra("render"):
    import pygame.font

RATES = (1, 1000)
_SURFACES = ("_window", "_clock", "_canvas", "_backdrop", "_backdrop_key")


class Renderer:
    """Draws scenes into arrays ("rgb_array", never touching a display) or into a window ("human").

    Args:
        render_mode: "human" or "rgb_array".
        width, height: of the frame in pixels; the window can be resized.
        fps: frames a second that the window keeps to.

    Attributes:
        dismissed: whether the user closed the window; drawing then does nothing more.

    The axes fit the motion: they grow as it needs and start afresh with :meth:`clear_trail`.

    Raises:
        ValueError: if an argument is not as said above.
    """

    def __init__(self, render_mode: str, width: int = 960, height: int = 540, fps: int = 30) -> None:
        self.render_mode = checked_choice("render_mode", render_mode, RENDER_MODES)
        self.width = checked_whole("width", width, WIDTHS)
        self.height = checked_whole("height", height, HEIGHTS)
        self.fps = checked_whole("fps", fps, RATES)
        self.dismissed = False
        self._drop_surfaces()
        self.clear_trail()

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
        pygame.font.init()  # needs no display; does nothing the second time
        if self.render_mode == "human":
            window = self._opened_window()
            if window is not None:
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

    def _opened_window(self) -> pygame.Surface | None:
        """Return the window after its events, or None once the user has closed it."""
        if self.dismissed:
            return None
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
                self.dismissed = True
        if self.dismissed:
            self.close()
            return None
        self._window = pygame.display.get_surface()  # another one after a resize
        return self._window

    def _painted(self, scene: Scene, size: tuple[int, int]) -> pygame.Surface:
        size = (max(size[0], WIDTHS[0]), max(size[1], HEIGHTS[0]))
        if self._canvas is None or self._canvas.surface.get_size() != size:
            # 32 bits without alpha need no display to convert to.
            self._canvas = Canvas(pygame.Surface(size, 0, 32), Lettering())
            self._backdrop = None
        self._remember(scene)
        layout = Layout.of(size)
        view = self._view = View.of(scene, layout, self._view)
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
