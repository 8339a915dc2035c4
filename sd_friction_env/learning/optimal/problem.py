"""The optimal control problem of a task: its dynamics, starts and plants."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.shooting import rollout
from sd_friction_env.environments import ids
from sd_friction_env.environments.ids import environment_id
from sd_friction_env.environments.jacobian import control_jacobians, control_steps
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.environments.task import Task
from sd_friction_env.physics.parameters import OscillatorParameters

Array = NDArray[np.float64]
Progress = Callable[[range, str], Iterable[int]]
TASKS, RANDOMISED, SENSED = ({task: environment_id(task, tier) for task in ids.TASKS} for tier in ids.TIERS)


def silent(steps: range, label: str) -> Iterable[int]:
    """Report no progress."""
    return steps


@dataclass(frozen=True)
class Problem:
    """A task's dynamics and its starts, each with the plant of its episode.

    Attributes:
        env_id: the environment's registered id.
        task: its configuration.
        parameters: of the plant of each episode, n of them.
        starts: states (x, v, v_belt), shape (n, 3).
    """

    env_id: str
    task: Task
    parameters: tuple[OscillatorParameters, ...]
    starts: Array

    @property
    def belt_moves(self) -> bool:
        """Whether the belt speed is a state (otherwise it stays at its nominal value)."""
        return self.task.actuator == "belt_speed"

    @property
    def steps(self) -> int:
        """Control intervals in an episode."""
        return self.task.episode_steps

    @property
    def dimensions(self) -> int:
        """Number of state variables that change: 2 or 3."""
        return 3 if self.belt_moves else 2

    @functools.cached_property
    def plants(self) -> dict[OscillatorParameters, NDArray[np.int64]]:
        """The different plants, and the starts that belong to each."""
        found: dict[OscillatorParameters, list[int]] = {}
        for i, parameters in enumerate(self.parameters):
            found.setdefault(parameters, []).append(i)
        return {parameters: np.array(rows) for parameters, rows in found.items()}

    def select(self, rows: NDArray[np.int64]) -> "Problem":
        """Return the problem of some of the starts (which may be repeated)."""
        return dataclasses.replace(
            self, parameters=tuple(self.parameters[row] for row in rows), starts=self.starts[rows]
        )

    def step(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """Return the states one control interval later, shape (..., 3), and the rewards, shape (...).

        Args:
            states: shape (..., 3). actions: in [-1, 1], shape (...). With several plants, the first axis is that of
                the starts.

        Raises:
            RuntimeError: if a mass loses contact with the belt or the integrator gives up.
        """
        if len(self.plants) == 1:
            return step_plant(self.task, self.parameters[0], states, actions)
        ends, rewards = np.empty_like(states), np.empty(actions.shape)
        for parameters, rows in self.plants.items():
            ends[rows], rewards[rows] = step_plant(self.task, parameters, states[rows], actions[rows])
        return ends, rewards

    def jacobians(self, states: Array, actions: Array) -> Array:
        """Return the derivatives of (x, v, v_belt, reward) by (x, v, v_belt, action), shape (..., 4, 4).

        Args: as of :meth:`step`; where a step cannot be followed they are NaN.
        """
        found = np.empty((*actions.shape, 4, 4))
        for parameters, rows in self.plants.items():
            part = slice(None) if len(self.plants) == 1 else rows
            actuator = self.task.actuator_of(parameters)
            found[part] = control_jacobians(parameters.plant, actuator, states[part], actions[part])
        return found

    def rollout(self, actions: Array) -> tuple[Array, Array]:
        """Return the states, shape (n, steps + 1, 3), and the rewards, shape (n, steps), of action sequences.

        Args:
            actions: one sequence per start, shape (n, steps).
        """
        return rollout(self, self.starts, actions)

    def returns(self, actions: Array) -> Array:
        """Return the undiscounted sum of rewards of each sequence, shape (n,)."""
        returns: Array = self.rollout(actions)[1].sum(axis=1)
        return returns


def step_plant(task: Task, parameters: OscillatorParameters, states: Array, actions: Array) -> tuple[Array, Array]:
    """Return what :meth:`Problem.step` returns, for one plant."""
    ends, rewards, failures = control_steps(parameters.plant, task.actuator_of(parameters), states, actions)
    if failures:
        raise RuntimeError(f"{failures} of {rewards.size} states lost contact or were not integrated")
    return ends, rewards


def make_problem(env_id: str, seeds: Sequence[int]) -> Problem:
    """Return the problem of an environment with the starts and the plants of ``reset(seed=...)``."""
    env = make_bare_env(env_id)
    starts = np.empty((len(seeds), 3))
    parameters = []
    for i, seed in enumerate(seeds):
        _, info = env.reset(seed=int(seed))
        starts[i] = info["x"], info["v"], info["v_belt"]
        parameters.append(env.parameters)
    return Problem(env_id, env.task, tuple(parameters), starts)


def make_bare_env(env_id: str) -> SDFrictionEnv:
    """Return an environment without wrappers."""
    env = gym.make(env_id).unwrapped
    assert isinstance(env, SDFrictionEnv)
    return env
