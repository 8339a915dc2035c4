"""Friction oscillator as a Gymnasium environment."""

from collections.abc import Callable, Mapping
from typing import Any, Self, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.display import FRAMES_PER_SECOND, Display
from sd_friction_env.environments.info import PLAIN_STATISTICS, episode_statistics, new_step_info, numbers_of
from sd_friction_env.environments.limits import LengthInSpec, time_limits
from sd_friction_env.environments.options import (
    apply_options,
    as_parameters,
    check_ranges,
    checked_options,
    clipped_action,
)
from sd_friction_env.environments.states import EnvState, check_state, read_state, write_state
from sd_friction_env.environments.task import Task, drifted, rig_arguments, steps_before_last_quarter
from sd_friction_env.physics.parameters import OscillatorParameters, plant_of
from sd_friction_env.pictures.scene import RENDER_MODES, checked_size

RewardFunction = Callable[[Mapping[str, Any]], float]


class SDFrictionEnv(LengthInSpec, gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """
    ## Description

    A mass on an inclined spring rides on a moving belt. Its dry friction falls with the sliding speed (Stribeck effect)
    and excites stick-slip vibration: the mass sticks to the belt, breaks away, slips back and sticks again. The agent
    applies a small force to the mass, or varies the belt speed slightly, to hold the mass still on the sliding belt.
    Events are located exactly: while the mass sticks, its velocity equals the belt's bit for bit.

    All quantities are dimensionless: length in units of the free spring length, time in units of 1/omega0. The model is
    the self-excited smooth-and-discontinuous (SD) oscillator, Eqs. 4-8, with the stick condition
    |a_belt + 2 beta v_belt + R(x) - u| <= mu_s N(x).

    ## Action Space

    `Box(-1, 1, (1,), float32)`. A finite action outside the box is clipped; NaN and infinity raise an error.

    | actuator | meaning of action a |
    |---|---|
    | `force` | control force u = `force_limit` a, constant over the control interval |
    | `belt_speed` | target (1 + `belt_authority` a) v_b of the belt speed, approached by `belt_acceleration_limit` |

    ## Observation Space

    `Box(-observation_limit, observation_limit, (n,), float32)`, clipped to the box; raw values are in `info`.

    | entry | value | present |
    |---|---|---|
    | position | (x - x_offset) / x_scale | always |
    | velocity | v / v_scale | sensor `state` |
    | belt modulation | (v_belt / belt_speed - 1) / belt_authority | sensor `state` and actuator `belt_speed` |
    | phases | cosine and sine of each excitation's phase: force, ripple, stiffness | `show_phases` |
    | parameters | each randomised parameter, its range scaled to [-1, 1], by name | `show_parameters` |

    ## Rewards

    The reward is minus the cost averaged over the control interval,
    -( mean v^2 / belt_speed^2 + `w_effort` a^2 + `w_stick` (stick fraction) ), with the episode's nominal belt speed.
    `info` has the terms as `reward_vibration`, `reward_effort`, `reward_stick` and `reward_contact_loss`. A function
    `reward` of that dictionary replaces their sum.

    After an episode's last step, `info["statistics"]` has its `return`, `length`, `late_amplitude` and
    `late_stick_fraction` (over the last quarter of `episode_steps`; NaN if the episode ended before) and the sums of
    the four terms. The first four are also entries of `info` itself, where monitors look for them.

    ## Info

    All values are numbers, so that wrappers can convert them to tensors. Some stand for names:

    | entry | number | name |
    |---|---|---|
    | `mode` | -1, 0, 1 | slip slower than the belt, stick, slip faster than the belt |
    | `status` | 0, 1, 2, 3 | ok, contact lost, event limit, step limit (`kernel.STATUS_NAMES`) |
    | `parameters`: `geometry` | 0 to 3, -1 | position in `parameters.GEOMETRIES`; user-defined |
    | `parameters`: `friction` | 0 to 4, -1 | position in `parameters.FRICTIONS`; user-defined |

    `env.unwrapped.parameters` returns the episode's :class:`OscillatorParameters`.

    ## Starting State

    `start`: a random phase of the passive limit cycle (`cycle`), the equilibrium of the unloaded spring (`rest`) or a
    random state (`random`). `reset(options=...)` takes

    | option | meaning |
    |---|---|
    | `parameters` | mapping of parameter names to values for this episode; overrides randomisation |
    | `start` | as the argument |
    | `phase` | phase in [0, 1] of the passive limit cycle, from breakaway |
    | `x`, `v` | initial state, each in [-10, 10]; v defaults to the belt speed |

    ## Episode End

    Termination: the mass loses contact with the belt (N <= 0). It costs the remaining steps times the largest cost per
    step of the episode, which is taken to be at least `contact_loss_cost`. Truncation: after `episode_steps` control
    intervals, or if the integrator stops (`info["status"]`: event or step limit). `max_episode_steps` of `gym.make` (a
    `TimeLimit` wrapper) replaces `episode_steps`; if both are given, the smaller one applies.

    ## Arguments

    `parameters` (an :class:`OscillatorParameters` or a mapping of its fields), `render_mode`, `render_size` (width and
    height of a frame in pixels), `reward`, and every field of :class:`Task`: `actuator`, `force_limit`,
    `belt_authority`, `belt_acceleration_limit`, `control_interval`, `episode_steps`, `w_effort`, `w_stick`, `start`,
    `kick`, `randomise`, `drift`, `show_parameters`, `show_phases`, `sensor`, `sensor_noise`, `sensor_delay`,
    `contact_loss_cost`, `observation_limit`, `x_offset`, `x_scale`, `v_scale`.

    ```python
    import gymnasium as gym
    env = gym.make("sd_friction_env:SDFriction/Force-v0", parameters={"alpha": 0.7}, w_effort=0.2)
    ```

    ## Version History

    * v0: initial version
    """

    metadata = {"render_modes": [*RENDER_MODES], "render_fps": FRAMES_PER_SECOND}  # noqa: RUF012 (Gymnasium's form)
    title = ""  # of the pictures; an empty one shows the spring

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
        task = Task.from_arguments(task_arguments)
        self._own_limit = [task.episode_steps] if "episode_steps" in task_arguments else []
        if reward is not None and not callable(reward):
            raise TypeError(f"reward must be a function of the info dictionary or None, got {reward!r}")
        check_ranges(task, self.nominal)
        self.render_mode = render_mode
        self.render_size = checked_size(render_size)
        self.reward = reward
        self.task = task = task.with_scales(self.nominal)
        limit, size = task.observation_limit, task.observation_size
        self.observation_space = spaces.Box(-limit, limit, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self._display = None if render_mode is None else Display(task, render_mode, self.render_size)
        self._key: int | None = None
        self._drift_ends: dict[str, float] = {}  # of the running episode, once they are needed
        self._running = False
        self._observations = np.zeros((1, size), np.float32)
        # All arrays are views of one: each array passed to compiled code makes the call slower.
        self._head = kernel.memory_size(task.sensor_delay, len(task.shown))
        numbers, codes = task.arrays()
        zeros = np.zeros(self._head - len(numbers) - len(codes))
        self._memory = np.concatenate((numbers, codes.view(np.float64), zeros))
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
        """Return the environment of a rig given in SI units.

        Args:
            sampling_time: control interval, s.
            force_limit: largest control force, N. belt_acceleration_limit: of the belt, m/s^2.
            **arguments: the rig as in :meth:`OscillatorParameters.from_physical` (M, K, C, L, H, g, V0, the laws and
                their numbers), and any other argument of the class.

        ``env.unwrapped.nominal.time_scale`` (seconds), ``length_scale`` (metres) and ``force_scale`` (newtons) convert
        back to SI units.
        """
        names = {*Task.field_names(), "render_mode", "render_size", "reward"}
        own = {name: arguments.pop(name) for name in names & arguments.keys()}
        parameters = OscillatorParameters.from_physical(**arguments)
        limits = {"force_limit": force_limit, "belt_acceleration_limit": belt_acceleration_limit}
        return cls(parameters, **rig_arguments(parameters, sampling_time=sampling_time, **limits), **own)

    # Memory -----------------------------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        derived = ("_codes", "_state", "_counts", "_past", "_shown", "_seen", "_steppers", "_step_one")
        return {name: value for name, value in vars(self).items() if name not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._derive(kernel.steppers(self._plant()))  # a copied view would not be a view of the copied memory

    def _derive(self, steppers: kernel.Steppers) -> None:
        """Set what follows from the memory and the kind of plant: the views and the compiled code."""
        arrays = kernel.arrays_in(self._memory, 0)
        self._codes, self._counts, self._state = arrays.codes, arrays.counts, arrays.state
        self._past, self._shown = arrays.past, arrays.shown
        self._seen = self._observations[0]
        self._steppers, self._step_one = steppers, steppers.step_one

    def _plant(self) -> kernel.Plant:
        p = self._parameters
        kind = self.task.kind_of(p)
        return p.plant if kind == p.kind else plant_of(kind, p.values)

    def _drift(self) -> None:
        """Put the plant of the next control interval into the memory."""
        key, episode = self._counts[[kernel.COUNT_KEY, kernel.COUNT_EPISODE]]
        if not self._drift_ends:
            self._drift_ends = {name: float(end[0]) for name, end in self.task.drift_ends(key, episode).items()}
        steps, limit = int(self._counts[kernel.COUNT_STEPS, 0]), int(self._codes[kernel.TASK_EPISODE_STEPS])
        start = self._parameters.values
        now = {name: drifted(start[name], end, steps, limit) for name, end in self._drift_ends.items()}
        leaves = kernel.leaves_of(plant_of(self.task.kind_of(self._parameters), start | now))
        self._memory[self._head : self._head + len(leaves)] = leaves

    def _use(self, parameters: OscillatorParameters) -> None:
        """Begin an episode with these parameters, the belt at its nominal speed."""
        self._parameters = parameters
        self._drift_ends = {}
        plant = self._plant()
        numbers = (kernel.leaves_of(plant), kernel.tables_of(plant))
        self._memory = np.concatenate((self._memory[: self._head], *numbers))
        self._derive(kernel.steppers(plant))
        self._state[kernel.STATE_BELT_SPEED] = parameters.belt_speed
        kernel.blank_episodes(self._state, self._counts, (0,))
        if self.task.show_parameters:
            self._shown[0] = self.task.shown_parameters(parameters.values)

    @property
    def parameters(self) -> OscillatorParameters:
        """Parameters of the current episode, at its start where some drift."""
        return self._parameters

    # Episodes ---------------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see the class for ``options``.

        Raises:
            TypeError, ValueError: if an option is unknown or not legal; the running episode is then unchanged.
        """
        options = checked_options(options)
        key, episode = self._key, int(self._counts[kernel.COUNT_EPISODE, 0]) + 1
        if seed is not None or key is None:
            super().reset(seed=seed)
            key, episode = int(self.np_random.integers(2**62)), 0
        limit = min([*self._own_limit, *time_limits(self)], default=self.task.episode_steps)
        drawn = self.task.drawn_parameters(self.nominal, key, episode)
        parameters, placed = apply_options(self.task, drawn, options, key, episode)
        x, v = placed or self.task.start_state(parameters, key, episode)
        self._key = key
        self._codes[kernel.TASK_EPISODE_STEPS] = limit
        self._codes[kernel.TASK_LATE_STEPS] = steps_before_last_quarter(limit)
        self._use(parameters)
        self._counts[kernel.COUNT_KEY], self._counts[kernel.COUNT_EPISODE] = key, episode
        self._state[kernel.STATE_X], self._state[kernel.STATE_V] = x, v
        self._running = True
        mode, v_belt, v_rel, normal_force = kernel.left_alone(parameters.plant, x, v, parameters.belt_speed)
        if self._display is not None:
            self._display.clear()
        if self.render_mode == "human":
            self.render()
        self._steppers.observe_alone(self._memory, self._observations)
        return self._seen.copy(), {
            "x": x,
            "v": v,
            "v_belt": v_belt,
            "v_rel": v_rel,
            "mode": mode,
            "normal_force": normal_force,
            "time": 0.0,
            "parameters": numbers_of(parameters),
        }

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
                a = clipped_action(action)
        except (AttributeError, TypeError, ValueError):
            a = clipped_action(action)
        if self.task.drift:
            self._drift()
        info = new_step_info()
        (
            info["x"], info["v"], info["v_belt"], info["v_rel"], info["mode"], info["normal_force"], info["time"],
            info["force"], info["belt_acceleration"], info["x_min"], info["x_max"], info["mean_square_velocity"],
            info["stick_fraction"], info["friction_power"], info["control_power"], info["events"], status,
            info["reward_vibration"], info["reward_effort"], info["reward_stick"], info["reward_contact_loss"],
            reward, terminated, truncated,
        ) = self._step_one(self._memory, self._observations, a)  # fmt: skip
        info["action"] = a
        if status != kernel.OK:
            self._running = False
            info["status"] = status
        if self.reward is not None:
            reward = float(self.reward(info))
            self._state[kernel.STATE_RETURN] += reward
        if self._display is not None:
            self._display.note(info)
            if self.render_mode == "human":
                self.render()
        if terminated or truncated:
            self._add_statistics(info)
        return self._seen.copy(), reward, terminated, truncated, info

    def _add_statistics(self, info: dict[str, Any]) -> None:
        values = episode_statistics(self._state, self._counts, (0,), self.reward is not None)
        info["statistics"] = statistics = {name: value.item() for name, value in values.items()}
        info.update((name, statistics[name]) for name in PLAIN_STATISTICS)

    def get_state(self) -> EnvState:
        """Return the complete state of the running episode, for planning.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._key is None:
            raise gym.error.ResetNeeded("call reset() before get_state(): there is no state yet")
        return self._read()

    def _read(self) -> EnvState:
        return read_state(self._parameters, self._state, self._counts, self._past, 0)

    def set_state(self, state: EnvState) -> None:
        """Return to a state from :meth:`get_state`; what follows is bit-identical. The statistics begin anew.

        Raises:
            TypeError, ValueError: if it is not an :class:`EnvState` as :meth:`get_state` returns it.
        """
        check_state("state", state)
        self._use(state.parameters)
        write_state(state, self._state, self._counts, self._past, 0)
        self._key = state.key
        self._running = not state.ended
        if self._display is not None:
            self._display.mode = None

    def render(self) -> Any:
        """Draw the current state; return an array (height, width, 3), uint8, in mode "rgb_array"."""
        if self._display is None:
            gym.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array' or 'human'")
            return None
        return self._display.draw(self._read(), self.title)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._display is not None:
            self._display.close()


def make_env(env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> SDFrictionEnv:
    """Return a bare environment (without wrappers, which cost more time than the step)."""
    env = gym.make(env_id, **dict(env_kwargs or {})).unwrapped
    if not isinstance(env, SDFrictionEnv):
        raise TypeError(f"env_id must name an environment of sd_friction_env, got {env_id!r}")
    return env
