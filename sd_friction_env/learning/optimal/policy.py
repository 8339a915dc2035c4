"""A controller that acts on a stored value function."""

import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies import PolicyFileError, Readings, State
from sd_friction_env.environments.task import Task
from sd_friction_env.learning.optimal.grid import Grid, ValueFunction
from sd_friction_env.learning.optimal.problem import TASKS, Array, Problem, make_bare_env, step_plant
from sd_friction_env.learning.optimal.search import look_ahead
from sd_friction_env.learning.optimal.stored import (
    OPTIMUM_DIRECTORY,
    bare_id,
    check_fingerprint,
    command_of,
    fingerprint,
    value_path,
)
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import (
    load_arrays,
    parse_json,
    predecessor_hint,
    save_arrays,
)


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """A controller that looks one control interval ahead on the nominal plant and takes the best action.

    Best is the sum of the reward and the value of the next state. The policy has the methods of all controllers (see
    :mod:`policies`) and must observe the velocity. States outside the grid count as the nearest on its border.

    Attributes:
        task, parameters: of the environment the value was computed for.
        readings: conversion of its observations to x, v and v_belt.
        grid: of the value function. values: best return still to come from each node, shape (prod(sizes),).
        count: evenly spaced actions tried, three times, each time closer to the best.

    Raises:
        ValueError: if there is not one finite value for each node.
    """

    task: Task
    parameters: OscillatorParameters
    readings: Readings
    grid: Grid
    values: Array
    count: int = 41

    def __post_init__(self) -> None:
        nodes = math.prod(self.grid.sizes)
        if self.values.shape != (nodes,) or not np.isfinite(self.values).all():
            raise ValueError(f"values must be {nodes} finite numbers, got shape {self.values.shape}")

    @classmethod
    def load(cls, env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> Self:
        """Return the stored policy of a nominal task.

        It runs on the randomised tier too, where it assumes the nominal plant.

        Raises:
            FileNotFoundError: if none is stored for the id.
            RuntimeError: if the environment has changed since its value function was computed.
            PolicyFileError: if the file cannot be read.
        """
        env_id = bare_id(env_id)
        path = value_path(env_id, directory) if env_id in TASKS.values() else None
        if path is None or not path.exists():
            raise FileNotFoundError(f"no value function is stored for {env_id!r}; allowed: {', '.join(TASKS.values())}")
        env = make_bare_env(env_id)
        try:
            arrays = load_arrays(path, "f", texts=("fingerprint",))
            lows, highs, values = arrays["lows"], arrays["highs"], arrays["values"]
            stored = parse_json(str(arrays["fingerprint"]))
            if not isinstance(stored, dict):
                raise ValueError("it has no fingerprint")
            dimensions = 2 + (env.task.actuator == "belt_speed")
            if not values.ndim == dimensions == lows.size == highs.size or min(values.shape) < 2:
                raise ValueError(f"values {values.shape} and bounds {lows.shape}, {highs.shape} do not fit")
            if not (lows < highs).all():
                raise ValueError(f"bounds {lows.tolist()} to {highs.tolist()} are not in order")
            grid = Grid(tuple(lows.tolist()), tuple(highs.tolist()), values.shape)
            policy = cls(env.task, env.nominal, Readings.from_env(env), grid, values.ravel().astype(np.float64))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise PolicyFileError(
                f"{str(path)!r} is not a value function, or is damaged ({type(error).__name__}: {error})"
                f"{predecessor_hint(path)}: compute it again with `{command_of(env_id)} --policy`"
            ) from None
        check_fingerprint(stored, env_id, [])
        return policy

    def actions(self, states: Array) -> Array:
        """Return the best actions in states (x, v, v_belt) of shape (n, 3), shape (n,)."""
        lows, highs = self.grid.lows, self.grid.highs
        x = np.clip(states[:, 0], lows[0], highs[0])  # beyond the grid the mass may lose contact
        v_belt = np.clip(states[:, 2], lows[2], highs[2]) if len(lows) == 3 else states[:, 2]
        v = np.clip(states[:, 1] - v_belt, lows[1], highs[1]) + v_belt
        # The observation of a stuck mass is rounded: put it back on the belt.
        v = np.where(np.abs(v - v_belt) < 1e-7, v_belt, v)
        step = functools.partial(step_plant, self.task, self.parameters)
        return look_ahead(step, self.grid, self.values, np.stack([x, v, v_belt], axis=1), self.count)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], State]:
        """Return the best actions for one observation or a batch of them; see :mod:`policies`.

        Raises:
            ValueError: if an observation is not finite or too short.
        """
        values = self.readings.read(observation)
        if not np.isfinite(values).all():
            raise ValueError("observation must be finite")
        states = np.full((*values.shape[:-1], 3), self.parameters.belt_speed)
        states[..., 0] = values[..., 0] + self.readings.x_equilibrium
        states[..., 1] = values[..., 1]
        if self.task.actuator == "belt_speed":
            states[..., 2] += self.readings.authority * values[..., 2]
        actions = self.actions(states.reshape(-1, 3))
        return actions.astype(np.float32).reshape(*values.shape[:-1], 1), None


def save_value(problem: Problem, value: ValueFunction, directory: Path = OPTIMUM_DIRECTORY) -> Path:
    """Store a value function of a nominal task for :meth:`OptimalPolicy.load`, in single precision; return its path.

    Raises:
        ValueError: if the problem is not that of a nominal task.
        OSError: if the file cannot be written.
    """
    if problem.env_id not in TASKS.values():
        raise ValueError(f"env_id must be one of {', '.join(TASKS.values())}, got {problem.env_id!r}")
    path = value_path(problem.env_id, directory)
    directory.mkdir(parents=True, exist_ok=True)
    content = {
        "values": value.after_first.reshape(value.grid.sizes).astype(np.float32),
        "lows": np.array(value.grid.lows),
        "highs": np.array(value.grid.highs),
        "fingerprint": np.array(json.dumps(fingerprint(problem.env_id, []))),
    }
    save_arrays(path, content, compress=True, keep=True)
    return path
