"""A controller that acts on a stored value function."""

import functools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies import Feedback, PolicyFileError, Readings, State
from sd_friction_env.control.policies.planning import base_controller
from sd_friction_env.environments.ids import bare_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.environments.task import Task
from sd_friction_env.learning.optimal.grid import Grid, ValueFunction
from sd_friction_env.learning.optimal.problem import TASKS, Array, Problem, step_plant
from sd_friction_env.learning.optimal.search import deeper, look_ahead
from sd_friction_env.learning.optimal.stored import (
    OPTIMUM_DIRECTORY,
    check_fingerprint,
    command_of,
    fingerprint,
    value_path,
)
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count, checked_number
from sd_friction_env.storage import load_arrays, parse_json, predecessor_hint, save_arrays


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """A controller that looks a few control intervals ahead on the nominal plant and takes the best action.

    Best is the sum of the rewards and the value of the last state. The policy has the methods of all controllers (see
    :mod:`policies`) and must observe the velocity. States outside the grid count as the nearest on its border.

    Attributes:
        task, parameters: of the environment the value was computed for.
        readings: conversion of its observations to x, v and v_belt.
        grid: of the value function. values: best return still to come from each node, shape (prod(sizes),).
        count: evenly spaced first actions tried, three times, each time closer to the best.
        depth: control intervals looked ahead, in [1, 3]. branches: actions tried in each but the first, in [2, 1000].
        base: None, or the controller without memory that acts within ``radius`` of rest, in the plane of x and v: there
            the grid is too coarse, and its interpolation may hold the belt beside its nominal speed (dual-mode control:
            H. Michalska and D. Q. Mayne, IEEE Trans. Autom. Control 38 (1993) 1623).

    Raises:
        TypeError, ValueError: if there is not one finite value for each node, or a number is not as said.
    """

    task: Task
    parameters: OscillatorParameters
    readings: Readings
    grid: Grid
    values: Array
    count: int = 41
    depth: int = 1
    branches: int = 11
    base: Feedback | None = None
    radius: float = 0.05

    def __post_init__(self) -> None:
        for name, low, high in (("count", 2, 10_000), ("depth", 1, 3), ("branches", 2, 1000)):
            object.__setattr__(self, name, checked_count(name, getattr(self, name), low, high))
        object.__setattr__(self, "radius", checked_number("radius", self.radius, 0.0, 1e9))
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
        env = make_env(env_id)
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

    @classmethod
    def from_env(cls, env: Any, depth: int = 2) -> Self:
        """Return the stored policy of an environment as registered, with its base controller near rest.

        Args:
            env: wrapped or not. depth: control intervals looked ahead, in [1, 3].

        Raises:
            ValueError: if no value function is stored for its id, task and nominal plant. Others: as :meth:`load`.
        """
        bare = env.unwrapped
        try:
            policy = cls.load(bare.spec.id)
        except FileNotFoundError as error:
            raise ValueError(str(error)) from None
        if (policy.task, policy.parameters) != (bare.task, bare.nominal):
            raise ValueError(f"the value function of {bare.spec.id} is stored for its own arguments: leave others out")
        return replace(policy, depth=depth, base=base_controller(env))

    def actions(self, states: Array) -> Array:
        """Return the best actions in states (x, v, v_belt) of shape (n, 3), shape (n,)."""
        lows, highs = self.grid.lows, self.grid.highs
        x = np.clip(states[:, 0], lows[0], highs[0])  # beyond the grid the mass may lose contact
        v_belt = np.clip(states[:, 2], lows[2], highs[2]) if len(lows) == 3 else states[:, 2]
        v = np.clip(states[:, 1] - v_belt, lows[1], highs[1]) + v_belt
        # The observation of a stuck mass is rounded: put it back on the belt.
        v = np.where(np.abs(v - v_belt) < 1e-7, v_belt, v)
        step = functools.partial(step_plant, self.task, self.parameters)
        value: Callable[[Array], Array] = functools.partial(self.grid.interpolate, self.values)
        for _ in range(self.depth - 1):
            value = functools.partial(deeper, step, value, count=self.branches)
        return look_ahead(step, value, np.stack([x, v, v_belt], axis=1), self.count)

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
        states = self.readings.states(values, self.parameters.belt_speed)
        actions = self.actions(states.reshape(-1, 3)).reshape(values.shape[:-1])
        if self.base is not None:
            near = values[..., 0] ** 2 + values[..., 1] ** 2 <= self.radius**2
            actions = np.where(near, self.base.predict(observation)[0][..., 0], actions)
        return actions.astype(np.float32)[..., None], None


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
