"""Control steps of many states, each with parameters of its own, by the batch's compiled code."""

from dataclasses import dataclass

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.environments.task import FloatArray, Task
from sd_friction_env.physics.parameters import EXCITATIONS, OscillatorParameters, plant_of


@dataclass(frozen=True)
class Ensemble:
    """Many oscillators under one task that differ in some parameters: what an observer of a hidden plant steps.

    Attributes:
        nominal: parameters of all oscillators but those named; without excitation.
        task: actuator, control interval and reward weights.
        names: of the parameters that differ, those of the last axis of ``parameters``.

    Raises:
        ValueError: if there is no such parameter, or it is one of an excitation.
    """

    nominal: OscillatorParameters
    task: Task
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in self.nominal.values or name.partition("_")[0] in EXCITATIONS:
                raise ValueError(f"an ensemble cannot differ in {name!r}: it is no parameter of an unexcited plant")

    def step(self, states: FloatArray, parameters: FloatArray, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the states a control interval later, and the rewards; bit for bit those of the environment.

        Args:
            states: (x, v, v_belt), shape (..., 3). parameters: shape (..., len(names)). actions: in [-1, 1], (...).

        Returns:
            States, (..., 3), and rewards, (...); both NaN where the mass loses contact or cannot be followed.
        """
        n = actions.size
        kind, values = self.nominal.unexcited.kind, dict(self.nominal.values)
        example = plant_of(kind, values)
        values.update(zip(self.names, parameters.reshape(n, -1).T, strict=True))
        steppers, leaves = kernel.steppers(example), kernel.leaves_of(plant_of(kind, values), example)
        state = np.zeros((kernel.STATE_PLANT + len(leaves), n))
        state[kernel.STATE_X : kernel.STATE_X + 3] = states.reshape(n, 3).T
        state[kernel.STATE_BELT_SPEED] = values["belt_speed"]
        for row, leaf in enumerate(leaves):
            state[kernel.STATE_PLANT + row] = leaf
        counts = np.zeros((kernel.COUNT_ROWS, n), np.int64)
        numbers, codes = self.task.arrays()
        # The state is all that is read: no sensor, no statistics, no end of the episode.
        codes[kernel.TASK_EPISODE_STEPS] = codes[kernel.TASK_LATE_STEPS] = np.iinfo(np.int64).max
        codes[[kernel.TASK_SENSOR_DELAY, kernel.TASK_SEES_BELT, kernel.TASK_FULL_STATE, kernel.TASK_TRAVEL]] = False
        numbers[kernel.TASK_SENSOR_NOISE] = 0.0
        rewards, work = np.empty(n), np.ones(steppers.work_size)
        held = np.array(actions.reshape(n), np.float64)
        inputs = (np.zeros((0, 2, n)), np.zeros((n, 0)), kernel.tables_of(example), held, np.zeros(0, np.int64))
        outputs = (np.zeros((n, 1), np.float32), rewards, np.zeros((2, n), np.bool_))
        reports = (np.zeros((0, n)), np.zeros((0, n), np.int64))
        if steppers.step_many(work, 0, n, numbers, codes, state, counts, *inputs, *outputs, *reports):
            failed = counts[kernel.COUNT_STATUS] != kernel.OK
            state[:, failed], rewards[failed] = np.nan, np.nan
        ends = state[kernel.STATE_X : kernel.STATE_X + 3].T.reshape(states.shape)
        return ends, rewards.reshape(actions.shape)
