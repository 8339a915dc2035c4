"""The friction oscillator as a Gymnasium environment."""

import collections
import dataclasses
import math
import numbers
import sys
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any, Self, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.task import FloatArray, IntegerArray, Task, rig_arguments, steps_before_last_quarter
from sd_friction_env.physics.orbits import stick_intervals
from sd_friction_env.physics.parameters import (
    EXCITATIONS,
    FRICTIONS,
    GEOMETRIES,
    STATE_LIMIT,
    OscillatorParameters,
    brief_repr,
    checked_choice,
    checked_number,
)
from sd_friction_env.physics.simulation import amplitude
from sd_friction_env.pictures.renderer import checked_size

RewardFunction = Callable[[Mapping[str, Any]], float]

ACTUATOR_CODES = {"force": kernel.FORCE, "belt_speed": kernel.BELT_SPEED}
OPTIONS = ("parameters", "phase", "start", "v", "x")
EPISODE_STATISTICS = (
    "return",
    "length",
    "late_amplitude",
    "late_stick_fraction",
    "reward_vibration",
    "reward_effort",
    "reward_stick",
    "reward_contact_loss",
)
# What a step's info always holds, in its order.
_STEP_INFO: dict[str, Any] = {
    **dict.fromkeys(("x", "v", "v_belt", "v_rel"), 0.0),
    "mode": 0,
    **dict.fromkeys(("normal_force", "time", "action", "force", "belt_acceleration", "x_min", "x_max"), 0.0),
    **dict.fromkeys(("mean_square_velocity", "stick_fraction", "friction_power", "control_power"), 0.0),
    "events": 0,
    "status": kernel.OK,
    **dict.fromkeys(("reward_vibration", "reward_effort", "reward_stick", "reward_contact_loss"), 0.0),
}
# Those statistics of an episode that its last info also holds by themselves, where monitors look for them; the others
# have the names of a step's terms.
PLAIN_STATISTICS = tuple(name for name in EPISODE_STATISTICS if name not in _STEP_INFO)
# The steps of wrappers that step the environment once: what a limit around others counts is not the environment's.
_STEPS_LIKE_OURS = {
    wrapper.step
    for wrapper in (
        *(gym.Wrapper, gym.ActionWrapper, gym.ObservationWrapper, gym.RewardWrapper),
        *(OrderEnforcing, PassiveEnvChecker, RecordEpisodeStatistics, TimeLimit),
    )
}
SMALLEST_BELT_SPEED = 1e-6  # of an environment
READOUT_INTERVALS = 100  # the window of the rendered amplitude and stick readouts


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvState:
    """All that an episode's future depends on, besides the actions (see :meth:`SDFrictionEnv.set_state`)."""

    parameters: OscillatorParameters
    x: float
    v: float
    v_belt: float
    belt_travel: float
    steps: int
    ended: bool
    worst_cost: float
    key: int
    episode: int
    past: tuple[tuple[float, float], ...]


class KnowsItsLength:
    """An environment whose ``spec`` says after how many steps it truncates an episode.

    ``gym.make`` and ``gym.make_vec`` write a ``spec`` that has the limits of Gymnasium's own wrappers alone.
    """

    task: Task
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How ``gym.make`` or ``gym.make_vec`` made the environment; None if they did not."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and dataclasses.replace(spec, max_episode_steps=self.task.episode_steps)


class SDFrictionEnv(KnowsItsLength, gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """
    ## Description

    A mass on an inclined spring rides on a moving belt. Dry friction that falls with speed (Stribeck) makes it squeal:
    it sticks to the belt, breaks away, slips back and sticks again. The controller pushes the mass with a small force,
    or changes the belt's speed a little, to make it stand still on the sliding belt. The motion is integrated
    event-exactly: while the mass sticks its velocity equals the belt's, to the bit.

    All quantities are dimensionless: lengths in units of the free spring length, time in units of 1/omega0. Source:
    the self-excited smooth-and-discontinuous (SD) oscillator, Eqs. 4-8, with the stick condition
    |a_belt + 2 beta v_belt + R(x) - u| <= mu_s N(x).

    ## Action Space

    `Box(-1, 1, (1,), float32)`. A finite action outside the box is clipped to it; NaN and infinity are refused.

    | actuator | meaning of action a |
    |---|---|
    | `force` | control force u = `force_limit` a, held over the control interval |
    | `belt_speed` | the belt heads for (1 + `belt_authority` a) v_b, at most `belt_acceleration_limit` fast |

    ## Observation Space

    `Box(-observation_limit, observation_limit, (n,), float32)`, clipped to it; raw values are in `info`.

    | entry | value | present |
    |---|---|---|
    | position | (x - x_offset) / x_scale | always |
    | velocity | v / v_scale | sensor `state` |
    | belt modulation | (v_belt / belt_speed - 1) / belt_authority | sensor `state` and actuator `belt_speed` |
    | phases | cosine and sine of each excitation's phase: force, ripple, stiffness | `show_phases` |
    | parameters | each randomised one, its range scaled to [-1, 1], by name | `show_parameters` |

    ## Rewards

    Minus the running cost, averaged over the control interval by the integrator:
    -( mean v^2 / belt_speed^2 + `w_effort` a^2 + `w_stick` (fraction of the interval stuck) ), where belt_speed is the
    episode's nominal one. The terms stand in `info` as `reward_vibration`, `reward_effort`, `reward_stick` and
    `reward_contact_loss`; `reward`, a function of that dictionary, replaces their sum.

    With an episode's last step `info["statistics"]` holds its `return`, its `length`, `late_amplitude` and
    `late_stick_fraction` (over the last quarter of the time an episode has; NaN if it did not come so far) and the sums
    of the four terms. The first four also stand in `info` itself, where monitors look for them.

    ## Info

    All values are numbers, so that wrappers can make tensors of them; where they stand for names:

    | entry | number | name |
    |---|---|---|
    | `mode` | -1, 0, 1 | slips slower than the belt, sticks, slips faster than the belt |
    | `status` | 0, 1, 2, 3 | ok, contact lost, event limit, step limit (`kernel.STATUS_NAMES`) |
    | `parameters`: `geometry` | 0 to 3, -1 | place in `parameters.GEOMETRIES`; one of your own |
    | `parameters`: `friction` | 0 to 4, -1 | place in `parameters.FRICTIONS`; one of your own |

    `env.unwrapped.parameters` are the episode's :class:`OscillatorParameters` themselves.

    ## Starting State

    `start`: a random phase of the passive limit cycle (`cycle`), the unloaded spring's place of rest (`rest`) or a
    random state (`random`). `reset(options=...)` takes

    | option | meaning |
    |---|---|
    | `parameters` | mapping of parameter names to values for this episode (wins over randomisation) |
    | `start` | as the argument |
    | `phase` | phase in [0, 1] of the passive limit cycle, from breakaway |
    | `x`, `v` | the state itself, each in [-10, 10]; v defaults to the belt speed |

    ## Episode End

    Terminated if the mass loses contact with the belt (N <= 0), at a cost of the steps left times the worst cost per
    step (at least `contact_loss_cost`). Truncated after `episode_steps` intervals, or if the integrator gives up
    (`info["status"]`: event or step limit). `max_episode_steps` of `gym.make` (a `TimeLimit` around the environment)
    takes the place of `episode_steps`; if both are given, the shorter holds.

    ## Arguments

    `parameters` (an :class:`OscillatorParameters` or a mapping of its fields), `render_mode`, `render_size` (width and
    height of a frame in pixels), `reward`, and every field of :class:`Task`: `actuator`, `force_limit`,
    `belt_authority`, `belt_acceleration_limit`, `control_interval`, `episode_steps`, `w_effort`, `w_stick`, `start`,
    `kick`, `randomise`, `show_parameters`, `show_phases`, `sensor`, `sensor_noise`, `sensor_delay`,
    `contact_loss_cost`, `observation_limit`, `x_offset`, `x_scale`, `v_scale`.

    ```python
    import gymnasium as gym
    env = gym.make("sd_friction_env:SDFriction/Force-v0", parameters={"alpha": 0.7}, w_effort=0.2)
    ```

    ## Version History

    * v0: initial version
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}  # noqa: RUF012 (Gymnasium's own form)
    title = ""  # of the pictures; without one they name the spring

    def __init__(
        self,
        parameters: OscillatorParameters | Mapping[str, Any] | None = None,
        *,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (960, 540),
        reward: RewardFunction | None = None,
        **task_arguments: Any,
    ) -> None:
        self.nominal = as_parameters(parameters)
        check_belt(self.nominal)
        task = Task.from_arguments(task_arguments)
        self._own_limit = task.episode_steps if "episode_steps" in task_arguments else None
        if render_mode is not None:
            checked_choice("render_mode", render_mode, tuple(self.metadata["render_modes"]))
        if reward is not None and not callable(reward):
            raise TypeError(f"reward must be a function of the info dictionary or None, got {reward!r}")
        if task.randomise:  # whatever an episode may draw must be legal
            corner = {name: low for name, (low, _) in task.randomise.items()}
            for name in {"mu_m", "mu_k"} & corner.keys():
                corner[name] = task.randomise[name][1]  # the greatest, beside the least mu_s
            check_belt(self.nominal.replace(**corner))
        self.render_mode = render_mode
        self.render_size = checked_size(render_size)
        self.reward = reward
        self.task = task.with_scales(self.nominal)
        sees = (task.sensor == "state") + (task.sensor == "state" and task.actuator == "belt_speed")
        sees += 2 * len(EXCITATIONS) if task.show_phases else 0
        shows = len(task.randomise) if task.show_parameters else 0
        limit = self.task.observation_limit
        self.observation_space = spaces.Box(-limit, limit, (1 + sees + shows,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._renderer: Any = None
        self._key: int | None = None
        self._running = False
        self._window: collections.deque[tuple[float, float, float]] = collections.deque(maxlen=READOUT_INTERVALS)
        self._mode = kernel.STICK
        self._force = 0.0
        self._memory = np.zeros(kernel.memory_size(task.sensor_delay, shows))
        self._observations = np.zeros((1, 1 + sees + shows), np.float32)
        numbers, codes = task_arrays(self.task)
        self._memory[: len(numbers)] = numbers
        self._memory[len(numbers) : len(numbers) + len(codes)].view(np.int64)[:] = codes
        self._look_into_memory()
        self._use(self.nominal)

    @classmethod
    def from_rig(
        cls,
        *,
        sampling_time: float,
        force_limit: float | None = None,
        belt_acceleration_limit: float | None = None,
        **arguments: Any,
    ) -> Self:
        """Return an environment made from a rig in SI units.

        Args:
            sampling_time: the control interval, s.
            force_limit: greatest control force, N. belt_acceleration_limit: of the belt, m/s^2.
            **arguments: the rig, as :meth:`OscillatorParameters.from_physical` takes it (M, K, C, L, H, g, V0, the
                laws and their numbers), and any other argument of the class.

        ``env.unwrapped.nominal.time_scale`` (seconds), ``length_scale`` (metres) and ``force_scale`` (newtons) lead
        back to SI units.
        """
        own = {*Task.field_names(), "render_mode", "render_size", "reward"}
        parameters = OscillatorParameters.from_physical(
            **{name: value for name, value in arguments.items() if name not in own}
        )
        rig = rig_arguments(
            parameters,
            sampling_time=sampling_time,
            force_limit=force_limit,
            belt_acceleration_limit=belt_acceleration_limit,
        )
        return cls(parameters, **rig, **{name: value for name, value in arguments.items() if name in own})

    def _look_into_memory(self) -> None:
        arrays = kernel.arrays_in(self._memory, 0)
        self._numbers, self._codes, self._counts = arrays.task, arrays.codes, arrays.counts
        self._state, self._past, self._shown = arrays.state, arrays.past, arrays.shown
        self._seen = self._observations[0]

    def __getstate__(self) -> dict[str, Any]:
        views = ("_numbers", "_codes", "_state", "_counts", "_past", "_shown", "_seen", "_steppers", "_step_one")
        return {name: value for name, value in vars(self).items() if name not in views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._look_into_memory()  # a copied view would look into no one's memory
        self._choose_stepper()

    @property
    def parameters(self) -> OscillatorParameters:
        """The parameters of the present episode."""
        return self._parameters

    def _use(self, parameters: OscillatorParameters) -> None:
        """Begin anew with these parameters, the belt at its nominal speed."""
        self._parameters = parameters
        self._choose_stepper()
        plant = self._plant()
        task = self.task
        head = kernel.memory_size(task.sensor_delay, len(task.randomise) if task.show_parameters else 0)
        self._memory = np.concatenate((self._memory[:head], kernel.leaves_of(plant), kernel.tables_of(plant)))
        self._look_into_memory()
        self._state[kernel.STATE_BELT_SPEED] = parameters.belt_speed
        kernel.blank_episodes(self._state, self._counts, (0,))
        if task.show_parameters:
            self._shown[0] = task.shown_parameters(parameters.values)

    def _plant(self) -> kernel.Plant:
        # Phases that are shown are those of an excitation, even of one that is too small to be seen.
        return self._parameters.excited_plant(0.0) if self.task.show_phases else self._parameters.plant

    def _choose_stepper(self) -> None:
        self._steppers = kernel.steppers(self._plant())
        self._step_one = self._steppers.step_one

    def _observe(self) -> NDArray[np.float32]:
        self._steppers.observe_alone(self._memory, self._observations)
        seen: NDArray[np.float32] = self._seen.copy()
        return seen

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see the class for ``options``.

        Raises:
            TypeError, ValueError: if an option is unknown or out of its range; the running episode is then untouched.
        """
        options = checked_options(options)
        key, episode = self._key, int(self._counts[kernel.COUNT_EPISODE, 0]) + 1
        if seed is not None or key is None:
            super().reset(seed=seed)
            key, episode = int(self.np_random.integers(2**62)), 0
        task = self.task
        limit = self._limit_of_callers()
        parameters = task.drawn_parameters(self.nominal, key, episode)
        if "parameters" in options:
            parameters = parameters.replace(**options["parameters"])
            check_belt(parameters)
        x, v = start_of(task, parameters, options, key, episode)
        self._key = key
        self._codes[kernel.TASK_EPISODE_STEPS] = limit
        self._codes[kernel.TASK_LATE_STEPS] = steps_before_last_quarter(limit)
        self._use(parameters)
        self._counts[kernel.COUNT_KEY], self._counts[kernel.COUNT_EPISODE] = key, episode
        self._state[kernel.STATE_X], self._state[kernel.STATE_V] = x, v
        self._running = True
        self._mode, v_belt, v_rel, normal_force = kernel.left_alone(parameters.plant, x, v, parameters.belt_speed)
        self.clear_picture()
        if self.render_mode == "human":
            self.render()
        return self._observe(), {
            "x": x,
            "v": v,
            "v_belt": v_belt,
            "v_rel": v_rel,
            "mode": self._mode,
            "normal_force": normal_force,
            "time": 0.0,
            "parameters": numbers_of(parameters),
        }

    def _limit_of_callers(self) -> int:
        """Return after how many steps the episode that begins is truncated.

        A :class:`TimeLimit` around the environment hands every reset on but tells its limit to nobody, and the cost of
        lost contact and the statistics depend on it. So it is looked for among those who are calling.
        """
        limits = [] if self._own_limit is None else [self._own_limit]
        frame: FrameType | None = sys._getframe()
        while frame is not None:
            if frame.f_code is TimeLimit.reset.__code__:
                inner = limiter = frame.f_locals["self"]
                while isinstance(inner, gym.Wrapper) and type(inner).step in _STEPS_LIKE_OURS:
                    inner = inner.env
                if inner is self:
                    limits.append(limiter._max_episode_steps)
            frame = frame.f_back
        return min(limits, default=self.task.episode_steps)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold an action for one control interval; see the class for what is returned.

        Raises:
            TypeError, ValueError: if the action is not one finite number in an array of shape (1,).
            gymnasium.error.ResetNeeded: before the first reset, and after contact was lost.
        """
        if not self._running:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        try:
            (a,) = action.tolist()
            if type(a) is not float or not -1.0 <= a <= 1.0:
                a = _clipped_action(action)
        except (AttributeError, TypeError, ValueError):
            a = _clipped_action(action)
        # A copy of what has all the names is much faster than a new dictionary.
        info = _STEP_INFO.copy()
        (
            info["x"],
            info["v"],
            info["v_belt"],
            info["v_rel"],
            info["mode"],
            info["normal_force"],
            info["time"],
            info["force"],
            info["belt_acceleration"],
            info["x_min"],
            info["x_max"],
            info["mean_square_velocity"],
            info["stick_fraction"],
            info["friction_power"],
            info["control_power"],
            info["events"],
            status,
            info["reward_vibration"],
            info["reward_effort"],
            info["reward_stick"],
            info["reward_contact_loss"],
            reward,
            terminated,
            truncated,
        ) = self._step_one(self._memory, self._observations, a)
        info["action"] = a
        if status != kernel.OK:
            self._running = False
            info["status"] = status
        if self.reward is not None:
            reward = float(self.reward(info))
            self._state[kernel.STATE_RETURN] += reward
        if self.render_mode is not None:
            self.note_mode(info["mode"])
            self.note_for_picture(info["x_min"], info["x_max"], info["stick_fraction"], info["force"])
            if self.render_mode == "human":
                self.render()
        if terminated or truncated:
            values = np.empty((len(EPISODE_STATISTICS), 1))
            kernel.episode_statistics(self._state, self._counts, (0,), self.reward is not None, values)
            statistics = {name: value.item() for name, value in named_statistics(values).items()}
            info["statistics"] = statistics
            info.update((name, statistics[name]) for name in PLAIN_STATISTICS)
        return self._seen.copy(), reward, terminated, truncated, info

    def get_state(self) -> EnvState:
        """Return all that the running episode's future depends on, for planning.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._key is None:
            raise gym.error.ResetNeeded("call reset() before get_state(): there is no state yet")
        return read_state(self._parameters, self._state, self._counts, self._past, 0)

    def set_state(self, state: EnvState) -> None:
        """Go back to a state that :meth:`get_state` returned: what follows is the same, bit for bit.

        The episode's statistics begin anew.

        Raises:
            TypeError, ValueError: if it is not an :class:`EnvState` whose values are as :meth:`get_state` returns them.
        """
        checked_state("state", state)
        self._use(state.parameters)
        write_state(state, self._state, self._counts, self._past, 0)
        self._key = state.key
        self._running = not state.ended
        plant = kernel.at_time(state.parameters.plant, state.steps * self.task.control_interval)
        self._mode = kernel.mode_of(plant, kernel.State(state.x, state.v), kernel.Drive(state.v_belt, 0.0, 0.0))

    def note_for_picture(self, x_min: float, x_max: float, stick_fraction: float, force: float) -> None:
        """Remember what an interval came to for the readouts of :meth:`render`."""
        self._window.append((x_min, x_max, stick_fraction))
        self._force = force

    def note_mode(self, mode: int) -> None:
        """Remember the mode that a step told, for :meth:`render`: a state alone does not know the drive."""
        self._mode = mode

    def clear_picture(self) -> None:
        """Begin the readouts and the trail of :meth:`render` anew."""
        self._window.clear()
        self._force = 0.0
        if self._renderer is not None:
            self._renderer.clear_trail()

    def twin(self) -> Self:
        """Return an environment of the same kind that draws in a picture of its own."""
        return type(self)(
            self.nominal,
            render_mode=self.render_mode,
            render_size=self.render_size,
            reward=self.reward,
            **{name: getattr(self.task, name) for name in Task.field_names()},
        )

    def render(self) -> Any:
        """Draw the present state; an array of shape (height, width, 3), uint8, in mode "rgb_array"."""
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array' or 'human'")
            return None
        from sd_friction_env.pictures.renderer import Renderer
        from sd_friction_env.pictures.scene import Scene

        if self._renderer is None:
            self._renderer = Renderer(self.render_mode, *self.render_size, fps=self.metadata["render_fps"])
        p, task = self._parameters, self.task
        x, v, v_belt, belt_travel = self._state[kernel.STATE_X : kernel.STATE_TRAVEL + 1, 0].tolist()
        intervals = stick_intervals(p.unexcited.replace(belt_speed=v_belt)) if v_belt >= 0.0 else []
        interval = min(intervals, key=lambda ends: abs(0.5 * (ends[0] + ends[1]) - x), default=None)
        lows, highs, sticks = zip(*self._window, strict=True) if self._window else ((x,), (x,), (0.0,))
        by_belt = task.belt_authority * p.belt_speed if task.actuator == "belt_speed" else 0.0
        return self._renderer.draw(
            Scene(
                time=int(self._counts[kernel.COUNT_STEPS, 0]) * task.control_interval,
                x=x,
                v=v,
                v_belt=v_belt,
                mode=self._mode,
                belt_travel=belt_travel,
                force=self._force,
                force_limit=task.force_limit if task.actuator == "force" else 0.0,
                belt_speed_nominal=p.belt_speed,
                belt_speed_limits=(p.belt_speed - by_belt, p.belt_speed + by_belt),
                alpha=p.alpha,
                geometry=p.geometry,
                stick_interval=interval,
                amplitude=amplitude(min(lows), max(highs)),
                stick_fraction=sum(sticks) / len(sticks),
                title=self.title,
            )
        )

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def task_arrays(task: Task) -> tuple[FloatArray, IntegerArray]:
    """Return what compiled code needs of a task: numbers and codes, as the kernel names their places."""
    numbers = np.zeros(kernel.TASK_NUMBERS)
    numbers[kernel.TASK_AUTHORITY] = task.authority
    numbers[kernel.TASK_A_LIMIT] = task.belt_acceleration_limit
    numbers[kernel.TASK_INTERVAL] = task.control_interval
    numbers[kernel.TASK_W_EFFORT] = task.w_effort
    numbers[kernel.TASK_W_STICK] = task.w_stick
    numbers[kernel.TASK_CONTACT_LOSS_COST] = task.contact_loss_cost
    numbers[kernel.TASK_LIMIT] = task.observation_limit
    numbers[kernel.TASK_X_OFFSET] = task.x_offset
    numbers[kernel.TASK_X_SCALE] = task.x_scale
    numbers[kernel.TASK_V_SCALE] = task.v_scale
    numbers[kernel.TASK_BELT_AUTHORITY] = task.belt_authority or 1.0
    numbers[kernel.TASK_SENSOR_NOISE] = task.sensor_noise
    codes = np.zeros(kernel.TASK_CODES, np.int64)
    codes[kernel.TASK_ACTUATOR] = ACTUATOR_CODES[task.actuator]
    codes[kernel.TASK_EPISODE_STEPS] = task.episode_steps
    codes[kernel.TASK_LATE_STEPS] = task.late_steps
    codes[kernel.TASK_FULL_STATE] = task.sensor == "state"
    codes[kernel.TASK_SEES_BELT] = task.sensor == "state" and task.actuator == "belt_speed"
    codes[kernel.TASK_SENSOR_DELAY] = task.sensor_delay
    codes[kernel.TASK_SEES_PHASES] = task.show_phases
    codes[kernel.TASK_TRAVEL] = True
    codes[kernel.TASK_SHOWS] = len(task.randomise) if task.show_parameters else 0
    return numbers, codes


def numbers_of(parameters: OscillatorParameters) -> dict[str, float]:
    """Return parameters as info has them: geometry and friction by their places in GEOMETRIES and FRICTIONS."""
    return parameters.values | {
        "geometry": place_of(parameters.geometry, GEOMETRIES),
        "friction": place_of(parameters.friction, FRICTIONS),
    }


def place_of(law: Any, names: tuple[str, ...]) -> int:
    """Return the place of a law among the names, -1 for one of a user's own."""
    return names.index(law) if isinstance(law, str) else -1


def named_statistics(values: FloatArray) -> dict[str, NDArray[Any]]:
    """Return what ``kernel.episode_statistics`` wrote (8, n) by name, each (n,)."""
    statistics: dict[str, NDArray[Any]] = dict(zip(EPISODE_STATISTICS, values, strict=True))
    statistics["length"] = statistics["length"].astype(np.int64)
    return statistics


def read_state(
    parameters: OscillatorParameters, state: FloatArray, integers: IntegerArray, past: FloatArray, i: int
) -> EnvState:
    """Return the state of environment ``i``; arrays as the kernel has them."""
    counts = integers[:, i].tolist()
    memory, seen = len(past), counts[kernel.COUNT_SEEN]
    return EnvState(
        parameters=parameters,
        x=float(state[kernel.STATE_X, i]),
        v=float(state[kernel.STATE_V, i]),
        v_belt=float(state[kernel.STATE_BELT, i]),
        belt_travel=float(state[kernel.STATE_TRAVEL, i]),
        steps=counts[kernel.COUNT_STEPS],
        ended=counts[kernel.COUNT_OVER] == kernel.ENDED,
        worst_cost=float(state[kernel.STATE_WORST, i]),
        key=counts[kernel.COUNT_KEY],
        episode=counts[kernel.COUNT_EPISODE],
        past=tuple(tuple(past[k % memory, :, i].tolist()) for k in range(max(0, seen - memory), seen)),
    )


def write_state(saved: EnvState, state: FloatArray, integers: IntegerArray, past: FloatArray, i: int) -> None:
    """Put what :func:`read_state` returned into the arrays of environment ``i``, an episode that has just begun."""
    state[kernel.STATE_X : kernel.STATE_WORST + 1, i] = (
        saved.x,
        saved.v,
        saved.v_belt,
        saved.belt_travel,
        saved.worst_cost,
    )
    integers[kernel.COUNT_KEY, i], integers[kernel.COUNT_EPISODE, i] = saved.key, saved.episode
    integers[kernel.COUNT_STEPS, i] = integers[kernel.COUNT_FIRST_STEP, i] = saved.steps
    integers[kernel.COUNT_OVER, i] = kernel.ENDED if saved.ended else kernel.RUNNING
    if len(past):
        integers[kernel.COUNT_SEEN, i] = min(len(saved.past), len(past))  # a longer memory's oldest are left out
        for k, pair in enumerate(saved.past[-len(past) :]):
            past[k, :, i] = pair


def checked_state(name: str, state: Any) -> None:
    """Refuse what :func:`read_state` cannot have returned.

    Raises:
        TypeError: if ``state`` is no :class:`EnvState`, or one of its values is not of its kind.
        ValueError: if one of its values is not finite (unless it has ended) or negative where it counts.
    """
    if not isinstance(state, EnvState):
        raise TypeError(f"{name} must be an EnvState as get_state() returns it, got {state!r}")
    if not isinstance(state.parameters, OscillatorParameters):
        raise TypeError(f"{name}.parameters must be OscillatorParameters, got {state.parameters!r}")
    check_belt(state.parameters)
    if not isinstance(state.ended, bool | np.bool_):
        raise TypeError(f"{name}.ended must be True or False, got {state.ended!r}")
    for field in ("x", "v", "v_belt", "belt_travel", "worst_cost"):
        value = getattr(state, field)
        if type(value) is float and math.isfinite(value):  # as a rule, and the quickest to ask
            continue
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(f"{name}.{field} must be a real number, got {brief_repr(value)}")
        try:
            legal = math.isfinite(value) or state.ended
        except OverflowError:
            legal = False
        if not legal:
            raise ValueError(f"{name}.{field} must be finite, got {brief_repr(value)}")
    for field in ("steps", "key", "episode"):
        value = getattr(state, field)
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(f"{name}.{field} must be a whole number, got {brief_repr(value)}")
        if not 0 <= value < 2**63:
            raise ValueError(f"{name}.{field} must be in [0, 2**63), got {brief_repr(value)}")
    if state.past == ():
        return
    try:
        shape = np.asarray(state.past, np.float64).shape
    except (OverflowError, TypeError, ValueError):
        shape = ()
    if len(shape) != 2 or shape[1] != 2:
        raise TypeError(f"{name}.past must be a tuple of pairs (x, v) of numbers, got {brief_repr(state.past)}")


def as_parameters(parameters: Any) -> OscillatorParameters:
    if parameters is None:
        return OscillatorParameters()
    if isinstance(parameters, OscillatorParameters):
        return parameters
    if isinstance(parameters, Mapping):
        _check_names("parameters", parameters)
        return OscillatorParameters().replace(**parameters)
    raise TypeError(f"parameters must be OscillatorParameters or a mapping of its fields, got {parameters!r}")


def _check_names(name: str, parameters: Mapping[Any, Any]) -> None:
    for key in parameters:
        if not isinstance(key, str):
            raise TypeError(f"{name} must map parameter names to values, got the name {key!r}")


def check_belt(parameters: OscillatorParameters) -> None:
    if parameters.belt_speed < SMALLEST_BELT_SPEED:
        raise ValueError(
            f"belt_speed must be at least {SMALLEST_BELT_SPEED:g} in an environment, for its reward is relative to it, "
            f"got {parameters.belt_speed!r}"
        )


def start_of(
    task: Task, parameters: OscillatorParameters, options: Mapping[str, Any], key: int, episode: int
) -> tuple[float, float]:
    """Return the (x, v) at which an episode starts that is reset with (checked) options."""
    if "x" in options:
        return options["x"], options.get("v", parameters.first_belt_speed)
    if "phase" in options:
        return task.cycle_state(parameters, options["phase"])
    if "start" in options:
        task = dataclasses.replace(task, start=options["start"])
    return task.start_state(parameters, key, episode)


def _clipped_action(action: Any) -> float:
    """Return a finite action clipped to [-1, 1], whatever kind of array or sequence of one number it came in."""
    expected = "action must be one finite number in an array of shape (1,)"
    array = real_array(expected, action)
    if array.shape != (1,):
        raise ValueError(f"{expected}, got shape {array.shape}: {brief_repr(action)}")
    if not np.isfinite(array[0]):
        raise ValueError(f"{expected}; outside [-1, 1] it is clipped; got {brief_repr(action)}")
    return float(min(max(array[0], -1.0), 1.0))


def real_array(expected: str, values: Any) -> NDArray[Any]:
    """Return real numbers as an array, float32 or float64.

    Raises:
        TypeError: if they are no real numbers (text, complex numbers and times are none), or no array can be made of
            them. ValueError: if one is beyond the greatest float. The message begins with what is ``expected``.
    """
    try:
        array = np.asarray(values)
    except (RuntimeError, TypeError, ValueError) as error:  # RuntimeError: of a tensor that requires a gradient
        raise TypeError(f"{expected}, got {brief_repr(values)} ({error})") from None
    if array.dtype in (np.float32, np.float64):
        return array
    objects = array.dtype == object and all(isinstance(value, numbers.Real) for value in array.flat)
    if array.dtype.kind not in "biuf" and not objects:
        raise TypeError(f"{expected}, got {brief_repr(values)} of type {array.dtype}")
    try:
        with np.errstate(over="ignore"):  # of a long double becomes infinite, which whoever asked will refuse
            return array.astype(np.float64)
    except OverflowError:
        raise ValueError(f"{expected}, got {brief_repr(values)}") from None


def checked_options(options: Any) -> dict[str, Any]:
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise TypeError(f"options must be a mapping or None, got {options!r}")
    unknown = sorted(str(name) for name in options if name not in OPTIONS)
    if unknown:
        raise ValueError(f"unknown option {unknown[0]!r}; allowed: {', '.join(OPTIONS)}")
    checked = {name: without_axes(value) for name, value in options.items()}
    if "parameters" in checked:
        given = checked["parameters"]
        if isinstance(given, OscillatorParameters):
            checked["parameters"] = dataclasses.asdict(given)
        elif not isinstance(given, Mapping):
            raise TypeError(f"options['parameters'] must map parameter names to values, got {given!r}")
        else:
            _check_names("options['parameters']", given)
            checked["parameters"] = {name: without_axes(value) for name, value in given.items()}
    for name in ("x", "v"):
        if name in checked:
            checked[name] = checked_number(f"options[{name!r}]", checked[name], -STATE_LIMIT, STATE_LIMIT)
    if "v" in checked and "x" not in checked:
        raise ValueError(f"options['v'] = {checked['v']!r} needs options['x'] beside it")
    if "phase" in checked:
        checked["phase"] = checked_number("options['phase']", checked["phase"], 0.0, 1.0)
    if sum(name in checked for name in ("x", "phase", "start")) > 1:
        raise ValueError(f"options 'x', 'phase' and 'start' exclude one another, got {dict(options)!r}")
    return checked


def without_axes(value: Any) -> Any:
    """Return a value, or the one in an array without axes (of any library): wrappers that convert arrays hand numbers
    over so."""
    return value.item() if getattr(value, "ndim", None) == 0 else value
