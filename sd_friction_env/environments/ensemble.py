"""Control steps of many states, each with parameters of its own, by the batch's compiled code."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.task import FloatArray, Task, drifted
from sd_friction_env.physics.parameters import EXCITATIONS, OscillatorParameters, plant_of


@dataclass(frozen=True)
class Ensemble:
    """Many oscillators under one task that differ in what it hides: what an observer of a hidden plant steps.

    Hidden are the parameters that the task draws at a reset, and then the values that its drift reaches at the end.

    Attributes:
        nominal: parameters of all oscillators but the hidden ones.
        task: what is drawn, actuator, control interval and reward weights.
    """

    nominal: OscillatorParameters
    task: Task

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are drawn, the first columns of the hidden ones."""
        return tuple(self.task.randomise)

    @property
    def ranges(self) -> tuple[tuple[str, tuple[float, float]], ...]:
        """Name and range of each hidden parameter: those that are drawn, then the ends of those that drift."""
        return (*self.task.randomise.items(), *self.task.drift.items())

    def values(self, parameters: FloatArray, steps: Any) -> dict[str, Any]:
        """Return the numbers of plants by name, (...) where hidden, from the hidden parameters (..., len(ranges))."""
        values: dict[str, Any] = dict(self.nominal.values)
        hidden = (parameters[..., i] for i in range(parameters.shape[-1]))
        values |= {name: next(hidden) for name in self.task.randomise}
        return values | {
            name: drifted(values[name], next(hidden), steps, self.task.episode_steps) for name in self.task.drift
        }

    def step(
        self, states: FloatArray, parameters: FloatArray, actions: FloatArray, steps: NDArray[np.int64] | int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states a control interval later, and the rewards; bit for bit those of the environment.

        Args:
            states: (x, v, v_belt), shape (..., 3); the belt's speed without a ripple. parameters: the hidden ones,
                shape (..., len(ranges)). actions: in [-1, 1], (...). steps: intervals since the episode began, (...):
                they matter to excitation and drift.

        Returns:
            States, (..., 3), and rewards, (...); both NaN where the mass loses contact or cannot be followed.
        """
        n, (kind, example, steppers, tables, numbers, codes) = actions.size, self._fixed
        count = np.broadcast_to(steps, actions.shape).reshape(n)
        values = self.values(parameters.reshape(n, -1), count)
        leaves = kernel.leaves_of(plant_of(kind, values), example)
        state = np.zeros((kernel.STATE_PLANT + len(leaves), n))
        state[kernel.STATE_X : kernel.STATE_X + 3] = states.reshape(n, 3).T
        state[kernel.STATE_BELT_SPEED] = values["belt_speed"]
        for row, leaf in enumerate(leaves):
            state[kernel.STATE_PLANT + row] = leaf
        counts = np.zeros((kernel.COUNT_ROWS, n), np.int64)
        counts[kernel.COUNT_STEPS] = count
        rewards, work = np.empty(n), np.ones(steppers.work_size)
        held = np.array(actions.reshape(n), np.float64)
        inputs = (np.zeros((0, 2, n)), np.zeros((n, 0)), tables, held, np.zeros(0, np.int64))
        outputs = (np.zeros((n, 1), np.float32), rewards, np.zeros((2, n), np.bool_))
        reports = (np.zeros((0, n)), np.zeros((0, n), np.int64))
        if steppers.step_many(work, 0, n, numbers, codes, state, counts, *inputs, *outputs, *reports):
            failed = counts[kernel.COUNT_STATUS] != kernel.OK
            state[:, failed], rewards[failed] = np.nan, np.nan
        ends = state[kernel.STATE_X : kernel.STATE_X + 3].T.reshape(states.shape)
        return ends, rewards.reshape(actions.shape)

    def __reduce__(self) -> tuple[Any, ...]:
        return Ensemble, (self.nominal, self.task)  # without the compiled code

    @functools.cached_property
    def _fixed(self) -> tuple[Any, ...]:
        """What all steps share: kind and example of the plants, their compiled code and tables, the task in arrays."""
        excited = any(f"{means}_amplitude" in self.task.randomise for means in EXCITATIONS)
        kind = self.task.kind_of(self.nominal)
        kind = kind._replace(excited=kind.excited or excited)
        example = plant_of(kind, self.nominal.values)
        numbers, codes = self.task.arrays()
        # The state is all that is read: no sensor, no statistics, no end of the episode.
        codes[kernel.TASK_EPISODE_STEPS] = codes[kernel.TASK_LATE_STEPS] = np.iinfo(np.int64).max
        codes[[kernel.TASK_SENSOR_DELAY, kernel.TASK_SEES_BELT, kernel.TASK_FULL_STATE, kernel.TASK_TRAVEL]] = False
        numbers[kernel.TASK_SENSOR_NOISE] = 0.0
        return kind, example, kernel.steppers(example), kernel.tables_of(example), numbers, codes
