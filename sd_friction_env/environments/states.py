"""Complete states of episodes: read from the kernel's arrays, checked, and written back."""

import dataclasses
import math
import sys
from typing import Any

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.environments.options import check_belt
from sd_friction_env.environments.task import FloatArray, IntegerArray
from sd_friction_env.physics.parameters import OscillatorParameters, brief_repr, checked_number


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvState:
    """Complete state of an episode: with it, the actions determine the future (see :meth:`SDFrictionEnv.set_state`)."""

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

    def undriven_mode(self, control_interval: float) -> int:
        """Return the mode of the mass without a control force and on a belt at constant speed."""
        plant = kernel.at_time(self.parameters.plant, self.steps * control_interval)
        mode: int = kernel.mode_of(plant, kernel.State(self.x, self.v), kernel.Drive(self.v_belt, 0.0, 0.0))
        return mode


def read_state(
    parameters: OscillatorParameters, state: FloatArray, integers: IntegerArray, past: FloatArray, i: int
) -> EnvState:
    """Return the state of environment ``i`` from the kernel's arrays (:mod:`sd_friction_env.kernel.rows`)."""
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
    """Write a state into the arrays of environment ``i``, whose episode has just begun with its parameters."""
    values = (saved.x, saved.v, saved.v_belt, saved.belt_travel, saved.worst_cost)
    state[kernel.STATE_X : kernel.STATE_WORST + 1, i] = values
    integers[kernel.COUNT_KEY, i], integers[kernel.COUNT_EPISODE, i] = saved.key, saved.episode
    integers[kernel.COUNT_STEPS, i] = integers[kernel.COUNT_FIRST_STEP, i] = saved.steps
    integers[kernel.COUNT_OVER, i] = kernel.ENDED if saved.ended else kernel.RUNNING
    if len(past):
        integers[kernel.COUNT_SEEN, i] = min(len(saved.past), len(past))  # a shorter memory keeps the latest readings
        for k, pair in enumerate(saved.past[-len(past) :]):
            past[k, :, i] = pair


def check_state(name: str, state: Any) -> None:
    """Refuse a value that :func:`read_state` cannot have returned.

    Raises:
        TypeError: if ``state`` is not an :class:`EnvState`, or a field has the wrong type.
        ValueError: if a number is not finite in an episode that goes on, or a count is out of range.
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
        if not isinstance(value, float) or not (state.ended or math.isfinite(value)):
            checked_number(f"{name}.{field}", value, -sys.float_info.max, sys.float_info.max)
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
