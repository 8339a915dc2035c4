"""Picture of an environment: its readouts, and the frames or the window that show them."""

import collections
from collections.abc import Mapping
from typing import Any

from sd_friction_env import kernel
from sd_friction_env.environments.states import EnvState
from sd_friction_env.environments.task import Task
from sd_friction_env.physics.orbits import stick_intervals
from sd_friction_env.physics.parameters import checked_choice
from sd_friction_env.physics.simulation import amplitude
from sd_friction_env.pictures.scene import RENDER_MODES, Scene

FRAMES_PER_SECOND = 30
READOUT_INTERVALS = 100  # window of the amplitude and stick readouts, in control intervals


class Display:
    """Picture of one environment, in a window ("human") or as frames ("rgb_array") of a size in pixels."""

    def __init__(self, task: Task, render_mode: str, size: tuple[int, int]) -> None:
        self._task = task
        self._mode = checked_choice("render_mode", render_mode, RENDER_MODES)
        self._size = size
        self._renderer: Any = None
        self._window: collections.deque[tuple[float, float, float]] = collections.deque(maxlen=READOUT_INTERVALS)
        self._force = 0.0
        self.mode: int | None = kernel.STICK  # of the last step; None: that of the undriven mass

    def note(self, info: Mapping[str, Any]) -> None:
        """Add a control interval, by its step's info, to the readouts."""
        self._window.append((info["x_min"], info["x_max"], info["stick_fraction"]))
        self._force, self.mode = info["force"], info["mode"]

    def clear(self) -> None:
        """Begin the readouts and the trail anew."""
        self._window.clear()
        self._force, self.mode = 0.0, None
        if self._renderer is not None:
            self._renderer.clear_trail()

    def draw(self, state: EnvState, title: str) -> Any:
        """Draw a state; return an array (height, width, 3), uint8, in mode "rgb_array"."""
        from sd_friction_env.pictures.renderer import Renderer

        if self._renderer is None:
            self._renderer = Renderer(self._mode, *self._size, fps=FRAMES_PER_SECOND)
        p, task, x = state.parameters, self._task, state.x
        places = stick_intervals(p.unexcited.replace(belt_speed=state.v_belt)) if state.v_belt >= 0.0 else []
        lows, highs, sticks = zip(*self._window, strict=True) if self._window else ((x,), (x,), (0.0,))
        by_belt = task.belt_authority * p.belt_speed if task.actuator == "belt_speed" else 0.0
        return self._renderer.draw(
            Scene(
                time=state.steps * task.control_interval,
                x=x,
                v=state.v,
                v_belt=state.v_belt,
                mode=state.undriven_mode(task.control_interval) if self.mode is None else self.mode,
                belt_travel=state.belt_travel,
                force=self._force,
                force_limit=task.force_limit if task.actuator == "force" else 0.0,
                belt_speed_nominal=p.belt_speed,
                belt_speed_limits=(p.belt_speed - by_belt, p.belt_speed + by_belt),
                alpha=p.alpha,
                geometry=p.geometry,
                stick_interval=min(places, key=lambda ends: abs(0.5 * (ends[0] + ends[1]) - x), default=None),
                amplitude=amplitude(min(lows), max(highs)),
                stick_fraction=sum(sticks) / len(sticks),
                title=title,
            )
        )

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
