"""Look-ahead: try first actions on a model of the plant, go on by a controller, and take the best."""

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.control.policies.feedback import Feedback
from sd_friction_env.control.policies.policy import State
from sd_friction_env.environments.jacobian import control_steps
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A plant that a controller knows, advanced by the environment's own step.

    Attributes:
        parameters: of the plant; they may differ from the true ones.
        actuator: what an action does in a control interval.
    """

    parameters: OscillatorParameters
    actuator: kernel.Actuator

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """Return the model of an environment's nominal plant, without excitation."""
        nominal = env.unwrapped.nominal.unexcited
        return cls(nominal, env.unwrapped.task.actuator_of(nominal))

    def step(self, states: _Floats, actions: _Floats) -> tuple[_Floats, _Floats]:
        """Return the states (x, v, v_belt), shape (..., 3), a control interval later, and the rewards, shape (...)."""
        return control_steps(self.parameters.plant, self.actuator, states, actions)[:2]


@dataclass(frozen=True)
class RolloutPolicy(Feedback):
    """Rollout of a base controller: of several first actions, each followed by the base controller, take the best.

    No random numbers are drawn, and the base controller's own action is among those tried: on a true model the result
    is no worse than the base controller's over the horizon. Source: rollout, D. P. Bertsekas, Reinforcement Learning
    and Optimal Control (2019).

    Attributes:
        base: the controller; it must observe the whole state and have no memory.
        model: of the plant.
        horizon: control intervals that are looked ahead, in [1, 10000].
        candidates: evenly spaced first actions, in [2, 1000].

    Raises:
        TypeError, ValueError: if a number is not as said, or the velocity is not observed.
    """

    base: Feedback
    _: KW_ONLY
    model: Model = field(repr=False)
    horizon: int = 100
    candidates: int = 7

    _needs_velocity: ClassVar = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "horizon", checked_count("horizon", self.horizon, 1, 10_000))
        object.__setattr__(self, "candidates", checked_count("candidates", self.candidates, 2, 1000))

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, with its nominal plant as the model; see Feedback.from_env."""
        return super().from_env(env, *arguments, **({"model": Model.from_env(env)} | named))

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        belt_speed = self.model.parameters.belt_speed
        states = np.full((*values.shape[:-1], 3), belt_speed)
        states[..., 0] = values[..., 0] + self.readings.x_equilibrium
        states[..., 1] = values[..., 1]
        if values.shape[-1] > 2:
            states[..., 2] += self.readings.authority * values[..., 2]
        # A mass that sticks has the belt's speed exactly, but for the observation's single precision.
        rides = np.abs(states[..., 1] - states[..., 2]) <= 1e-6 * max(belt_speed, 1.0)
        states[..., 1] = np.where(rides, states[..., 2], states[..., 1])
        return self.best_actions(states), None

    def best_actions(self, states: _Floats) -> _Floats:
        """Return the best first actions in states (x, v, v_belt), shape (..., 3), shape (...)."""
        first = np.empty((*states.shape[:-1], self.candidates + 1))
        first[..., 0] = self._base_actions(states)
        first[..., 1:] = np.linspace(-1.0, 1.0, self.candidates)
        now, total = self.model.step(np.repeat(states[..., None, :], self.candidates + 1, axis=-2), first)
        for _ in range(self.horizon - 1):
            now, rewards = self.model.step(now, self._base_actions(now))
            total += rewards
        best = np.argmax(np.nan_to_num(total, nan=-np.inf), axis=-1)
        chosen: _Floats = np.take_along_axis(first, best[..., None], axis=-1)[..., 0]
        return chosen

    def _base_actions(self, states: _Floats) -> _Floats:
        """Return the base controller's actions as the environment takes them: clipped, in single precision."""
        values = np.empty((*states.shape[:-1], len(self.readings.names)))
        values[..., 0] = states[..., 0] - self.readings.x_equilibrium
        values[..., 1] = states[..., 1]
        if values.shape[-1] > 2:
            values[..., 2] = (states[..., 2] - self.model.parameters.belt_speed) / self.readings.authority
        action, _ = self.base._act(values, None, None)
        return np.clip(action, -1.0, 1.0).astype(np.float32).astype(np.float64)
