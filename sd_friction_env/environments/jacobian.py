"""A control step, and the return of an action sequence, with exact derivatives through stick and slip."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.task import FloatArray, IntegerArray, Task
from sd_friction_env.physics.parameters import OscillatorParameters, checked_number

_NOMINAL, _TASK = OscillatorParameters(), Task()
_NO_CHANGES = np.empty(0)


class StepJacobian(NamedTuple):
    """A control step with its derivatives, of n states or (shapes without n) of one.

    Attributes:
        state: (x, v, v_belt) after the step, (n, 3).
        reward: of the step, (n,).
        outcomes: the values of ``rows``, (n, rows).
        jacobian: derivatives of ``rows`` by ``columns``, (n, rows, columns); NaN where the status is not "ok".
        rows: x, v, v_belt, reward; the means mean_v2, stick_fraction, friction_power and control_power; the terms of
            the reward: vibration, effort and stick.
        columns: x, v, v_belt, action, and the parameters asked for.
        derivative: whether the derivative exists, a code, (n,); :attr:`reasons` has it in words.
        status: how the step ended, a code of ``kernel.STATUS_NAMES``, (n,).
    """

    state: FloatArray
    reward: FloatArray
    outcomes: FloatArray
    jacobian: FloatArray
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    derivative: IntegerArray
    status: IntegerArray

    @property
    def smooth(self) -> NDArray[np.bool_]:
        """Where the derivative exists in every direction, (n,)."""
        return np.asarray((self.derivative == kernel.SMOOTH) & (self.status == kernel.OK))

    @property
    def reasons(self) -> list[str]:
        """Whether the derivative exists, in words, for each state."""
        codes = zip(np.atleast_1d(self.derivative), np.atleast_1d(self.status), strict=True)
        return [
            kernel.DERIVATIVE_NAMES[int(derivative)] if status == kernel.OK else kernel.STATUS_NAMES[int(status)]
            for derivative, status in codes
        ]

    def by(self, row: str, column: str) -> FloatArray:
        """Return the derivative of ``row`` by ``column``, (n,).

        Raises:
            ValueError: if there is no such row or column.
        """
        for kind, name, names in (("row", row, self.rows), ("column", column, self.columns)):
            if name not in names:
                raise ValueError(f"{kind} must be one of {', '.join(names)}, got {name!r}")
        found: FloatArray = self.jacobian[..., self.rows.index(row), self.columns.index(column)]
        return found

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.jacobian.shape))
        return f"StepJacobian({shape}: {', '.join(self.rows)} by {', '.join(self.columns)})"


class ReturnGradient(NamedTuple):
    """The return of an action sequence, with its gradient.

    Attributes:
        total: the undiscounted sum of rewards.
        by_actions: its derivatives by the actions, (steps,).
        by_state: by x, v and v_belt at the start, (3,).
        by_parameters: by the parameters asked for, in their order.
        smooth: whether the derivative of each step exists along the motion (on the belt counts as smooth).
    """

    total: float
    by_actions: FloatArray
    by_state: FloatArray
    by_parameters: dict[str, float]
    smooth: bool


def control_steps(
    plant: kernel.Plant, actuator: kernel.Actuator, states: FloatArray, actions: FloatArray
) -> tuple[FloatArray, FloatArray, int]:
    """Return states (x, v, v_belt) a control interval later, (..., 3), rewards, (...), and how many steps failed.

    Args:
        plant, actuator: as the kernel takes them.
        states, actions: (..., 3) and (...), not checked.
    """
    columns = np.ascontiguousarray(states.reshape(-1, 3).T)
    ends, rewards = np.empty_like(columns), np.empty(columns.shape[1])
    failures = kernel.control_intervals(
        plant, actuator, *columns, np.ascontiguousarray(actions.reshape(-1)), *ends, rewards
    )
    return ends.T.reshape(states.shape), rewards.reshape(actions.shape), failures


def control_jacobians(
    plant: kernel.Plant, actuator: kernel.Actuator, states: FloatArray, actions: FloatArray
) -> FloatArray:
    """Return the derivatives of (x, v, v_belt, reward) by (x, v, v_belt, action), (..., 4, 4).

    They are exact, the times of events included; NaN where a step cannot be followed.
    """
    n, rows = actions.size, len(kernel.OUTCOMES)
    starts = np.empty((4, n))
    starts[:3], starts[3] = states.reshape(-1, 3).T, actions.reshape(-1)
    outcomes, found, codes = np.empty((n, rows)), np.empty((n, rows, 4)), np.empty((2, n), np.int64)
    kernel.control_intervals_with_tangents(plant, actuator, starts, None, _NO_CHANGES, outcomes, found, codes)
    return found[:, :4].reshape(*actions.shape, 4, 4)


def step_with_jacobian(
    state: ArrayLike,
    action: ArrayLike,
    parameters: OscillatorParameters = _NOMINAL,
    task: Task = _TASK,
    *,
    by: Sequence[str] = (),
    time: float = 0.0,
) -> StepJacobian:
    """Take one control step with its exact derivatives: those of the computed step, the times of its events included.

    From a state on the belt (v = v_belt) the derivative is that of a change that keeps v = v_belt, and the column of v
    is what a mass pushed off the belt comes to: a stuck one is caught at once.

    Args:
        state: (x, v, v_belt), shape (3,) or (n, 3).
        action: in [-1, 1], a number or shape (n,).
        parameters: of the oscillator; the nominal ones by default.
        task: the actuator, control interval and reward weights; those of ``SDFriction/Force-v0`` by default.
        by: names of parameters to differentiate by, as ``mu_m``, ``belt_speed`` or ``friction.NAME``.
        time: at the start of the step; matters to an excited plant.

    Raises:
        TypeError, ValueError: if a value is not finite, an action is out of range, shapes differ, or the plant does not
            use a parameter, or its law offers no derivatives by its numbers.
    """
    starts, shape = starts_of(state, action)
    directions, changes = parameter_directions(parameters, by)
    n, rows = starts.shape[1], kernel.OUTCOMES
    outcomes = np.empty((n, len(rows)))
    jacobian = np.empty((n, len(rows), len(kernel.CAUSES) + len(changes)))
    codes = np.empty((2, n), np.int64)
    plant = plant_at(parameters, time)
    actuator = task.actuator_of(parameters)
    kernel.control_intervals_with_tangents(plant, actuator, starts, directions, changes, outcomes, jacobian, codes)
    pick = slice(None) if shape else 0
    columns = (*kernel.CAUSES, *by)
    return StepJacobian(
        outcomes[pick, :3],
        outcomes[pick, 3],
        outcomes[pick],
        jacobian[pick],
        rows,
        columns,
        codes[0, pick],
        codes[1, pick],
    )


def return_with_gradient(
    state: ArrayLike,
    actions: ArrayLike,
    parameters: OscillatorParameters = _NOMINAL,
    task: Task = _TASK,
    *,
    by: Sequence[str] = (),
) -> ReturnGradient:
    """Return the sum of rewards of an action sequence with its gradient, backwards through the steps' Jacobians.

    Args:
        state: (x, v, v_belt) at time 0, shape (3,).
        actions: in [-1, 1], shape (steps,).
        parameters, task, by: as in :func:`step_with_jacobian`.

    Raises:
        TypeError, ValueError: as :func:`step_with_jacobian`.
        RuntimeError: if the mass loses contact with the belt, or the motion cannot be followed.
    """
    sequence = np.asarray(actions)
    if sequence.ndim != 1 or not sequence.size:
        raise ValueError(f"actions must have shape (steps,) with steps >= 1, got {sequence.shape}")
    if np.shape(state) != (3,):
        raise ValueError(f"state must have shape (3,), got {np.shape(state)}")
    starts, _ = starts_of(np.broadcast_to(state, (sequence.size, 3)), sequence)
    directions, changes = parameter_directions(parameters, by)
    by_actions, by_start = np.empty(sequence.size), np.empty(3 + len(changes))
    x, v, v_belt = starts[:3, 0].tolist()
    start, held = kernel.State(x, v), np.ascontiguousarray(starts[3])
    total, status, worst = kernel.return_with_gradient(
        plant_at(parameters, 0.0),
        task.actuator_of(parameters),
        start,
        v_belt,
        held,
        directions,
        changes,
        by_actions,
        by_start,
    )
    if status != kernel.OK:
        raise RuntimeError(f"the motion cannot be followed to the end of the actions: {kernel.STATUS_NAMES[status]}")
    by_parameters = dict(zip(by, by_start[3:].tolist(), strict=True))
    return ReturnGradient(total, by_actions, by_start[:3], by_parameters, worst <= kernel.FROM_BELT)


def parameter_directions(parameters: OscillatorParameters, by: Sequence[str]) -> tuple[FloatArray | None, FloatArray]:
    """Return how the plant's numbers change with parameters, (m, numbers), None without, and how belt_speed does, (m,).

    Raises:
        ValueError: if a name comes twice, or as :meth:`OscillatorParameters.plant_change`.
    """
    if not by:
        return None, _NO_CHANGES
    if isinstance(by, str) or len(set(by)) < len(by):
        raise ValueError(f"by must be different names of parameters, got {by!r}")
    numbers = len(kernel.leaf_names(parameters.plant))
    changes = [np.zeros(numbers) if name == "belt_speed" else parameters.plant_change(name) for name in by]
    return np.array(changes), np.array([float(name == "belt_speed") for name in by])


def plant_at(parameters: OscillatorParameters, time: float) -> kernel.Plant:
    """Return the plant at a time in [0, 1e9].

    Raises:
        TypeError, ValueError: if it is not such a number.
    """
    time = checked_number("time", time, 0.0, 1e9)
    plant: kernel.Plant = kernel.at_time(parameters.plant, time) if parameters.excited else parameters.plant
    return plant


def starts_of(state: ArrayLike, action: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
    """Return x, v, v_belt and action as rows of a new array, (4, n), and the shape of the action.

    Raises:
        TypeError, ValueError: if one is not a number, not finite, or out of range, or shapes differ.
    """
    try:
        states, actions = (np.asarray(given).astype(np.float64, casting="same_kind") for given in (state, action))
    except (TypeError, ValueError):
        raise TypeError(f"state and action must be numbers, got {state!r} and {action!r}") from None
    shape = actions.shape
    if states.shape != (*shape, 3) or len(shape) > 1:
        raise ValueError(
            f"state and action must have shapes (3,) and (), or (n, 3) and (n,), got {states.shape} and {shape}"
        )
    starts = np.empty((4, actions.size))
    starts[:3], starts[3] = states.T.reshape(3, -1), actions
    finite = np.isfinite(starts)
    if not finite.all():
        which, i = np.argwhere(~finite)[0].tolist()
        raise ValueError(f"{kernel.CAUSES[which]} must be finite, got {starts[which, i].item()!r} at state {i}")
    if not np.abs(starts[3]).max(initial=0.0) <= 1.0:
        raise ValueError(f"action must be in [-1, 1], got {starts[3][np.abs(starts[3]) > 1.0][0].item()!r}")
    return starts, shape
