"""The optimal control problem of a task: its dynamics, starts and plants."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.control.shooting import rollout
from sd_friction_env.environments import ids
from sd_friction_env.environments.ids import environment_id
from sd_friction_env.environments.jacobian import control_jacobians, control_steps
from sd_friction_env.environments.single import make_env
from sd_friction_env.environments.task import Task, drifted
from sd_friction_env.physics.parameters import OscillatorParameters

Array = NDArray[np.float64]
Progress = Callable[[range, str], Iterable[int]]
TASKS, RANDOMISED, SENSED = ({task: environment_id(task, tier) for task in ids.TASKS} for tier in ids.TIERS)
OPEN = {tier: {"belt": environment_id("belt", tier)} for tier in ids.OPEN_TIERS}


def silent(steps: range, label: str) -> Iterable[int]:
    """Report no progress."""
    return steps


@dataclass(frozen=True)
class Problem:
    """A task's dynamics and its starts, each with the plant of its episode.

    Attributes:
        env_id: the environment's registered id.
        task: its configuration.
        parameters: of the plant of each episode at its start, n of them.
        starts: states (x, v, v_belt), shape (n, 3).
        ends: values of the drifting parameters at the episodes' ends, in the order of their names, n tuples.
    """

    env_id: str
    task: Task
    parameters: tuple[OscillatorParameters, ...]
    starts: Array
    ends: tuple[tuple[float, ...], ...]

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
    def plants(self) -> dict[tuple[OscillatorParameters, tuple[float, ...]], NDArray[np.int64]]:
        """The different plants, by their parameters at the start and what drifts to, and the starts of each."""
        found: dict[tuple[OscillatorParameters, tuple[float, ...]], list[int]] = {}
        for i, plant in enumerate(zip(self.parameters, self.ends, strict=True)):
            found.setdefault(plant, []).append(i)
        return {plant: np.array(rows) for plant, rows in found.items()}

    @property
    def changes(self) -> bool:
        """Whether a plant changes during an episode, by drift or excitation."""
        return bool(self.task.drift) or any(parameters.kind.excited for parameters in self.parameters)

    @property
    def frozen(self) -> "Problem":
        """The problem whose plants stay as they are at the start, without excitation."""
        parameters = tuple(parameters.unexcited for parameters in self.parameters)
        return (
            dataclasses.replace(
                self, task=dataclasses.replace(self.task, drift={}), parameters=parameters, ends=((),) * len(parameters)
            )
            if self.changes
            else self
        )

    def parameters_at(self, t: int, start: OscillatorParameters, ends: tuple[float, ...]) -> OscillatorParameters:
        """Return the parameters of a plant of :attr:`plants` in the control interval ``t`` of an episode."""
        return _parameters_at(t, self.steps, start, tuple(zip(self.task.drift, ends, strict=True)))

    def select(self, rows: NDArray[np.int64]) -> "Problem":
        """Return the problem of some of the starts (which may be repeated)."""
        parameters, ends = tuple(self.parameters[row] for row in rows), tuple(self.ends[row] for row in rows)
        return dataclasses.replace(self, parameters=parameters, starts=self.starts[rows], ends=ends)

    def step(self, states: Array, actions: Array, t: int = 0) -> tuple[Array, Array]:
        """Return the states one control interval later, shape (..., 3), and the rewards, shape (...).

        Args:
            states: shape (..., 3). actions: in [-1, 1], shape (...). With several plants, the first axis is that of
                the starts.
            t: the control interval of the episode; matters to plants that change.

        Raises:
            RuntimeError: if a mass loses contact with the belt or the integrator gives up.
        """
        ends, rewards = np.empty_like(states), np.empty(actions.shape)
        for plant, rows in self.plants.items():
            part, parameters = self._part(rows), self.parameters_at(t, *plant)
            ends[part], rewards[part] = step_plant(self.task, parameters, states[part], actions[part], t)
        return ends, rewards

    def jacobians(self, states: Array, actions: Array) -> Array:
        """Return the derivatives of (x, v, v_belt, reward) by (x, v, v_belt, action), shape (n, steps, 4, 4).

        Args:
            states, actions: of all steps, (n, steps, 3) and (n, steps); where a step cannot be followed they are NaN.
        """
        found = np.empty((*actions.shape, 4, 4))
        for plant, rows in self.plants.items():
            part = self._part(rows)
            for t in range(actions.shape[1]) if self.changes else (0,):
                here = (part, t) if self.changes else part
                parameters = self.parameters_at(t, *plant)
                now = kernel.at_time(parameters.plant, t * self.task.control_interval)
                found[here] = control_jacobians(now, self.task.actuator_of(parameters), states[here], actions[here])
        return found

    def _part(self, rows: NDArray[np.int64]) -> Any:
        return slice(None) if len(self.plants) == 1 else rows

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


@functools.lru_cache(maxsize=2**16)
def _parameters_at(
    t: int, steps: int, start: OscillatorParameters, ends: tuple[tuple[str, float], ...]
) -> OscillatorParameters:
    return start.replace(**{name: drifted(start.values[name], end, t, steps) for name, end in ends}) if ends else start


def step_plant(
    task: Task, parameters: OscillatorParameters, states: Array, actions: Array, t: int = 0
) -> tuple[Array, Array]:
    """Return what :meth:`Problem.step` returns, for one plant."""
    plant = kernel.at_time(parameters.plant, t * task.control_interval)
    ends, rewards, failures = control_steps(plant, task.actuator_of(parameters), states, actions)
    if failures:
        raise RuntimeError(f"{failures} of {rewards.size} states lost contact or were not integrated")
    return ends, rewards


def make_problem(env_id: str, seeds: Sequence[int]) -> Problem:
    """Return the problem of an environment with the starts and the plants of ``reset(seed=...)``."""
    env = make_env(env_id)
    starts = np.empty((len(seeds), 3))
    parameters, ends = [], []
    for i, seed in enumerate(seeds):
        _, info = env.reset(seed=int(seed))
        starts[i] = info["x"], info["v"], info["v_belt"]
        parameters.append(env.parameters)
        state = env.get_state()
        drifts = env.task.drift_ends(np.array([state.key]), np.array([state.episode]))
        ends.append(tuple(float(end[0]) for end in drifts.values()))
    return Problem(env_id, env.task, tuple(parameters), starts, tuple(ends))
