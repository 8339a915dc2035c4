"""Look-ahead: try first actions on a model of the plant, go on by a controller, and take the best."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.control.policies.feedback import Feedback
from sd_friction_env.control.policies.policy import State, as_taken
from sd_friction_env.environments.jacobian import control_jacobians, control_steps
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A plant that a controller knows, advanced by the environment's own step.

    Attributes:
        parameters: of the plant; they may differ from the true ones.
        actuator: what an action does in a control interval.

    Raises:
        TypeError, ValueError: if the parameters are not of a plant, or a number of the actuator is not finite.
    """

    parameters: OscillatorParameters
    actuator: kernel.Actuator

    def __post_init__(self) -> None:
        if not isinstance(self.parameters, OscillatorParameters):
            raise TypeError(f"parameters must be OscillatorParameters, got {self.parameters!r}")
        if not np.isfinite(self.actuator).all():
            raise ValueError(f"actuator must be of finite numbers, got {self.actuator!r}")

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """Return the model of an environment's nominal plant, without excitation."""
        nominal = env.unwrapped.nominal.unexcited
        return cls(nominal, env.unwrapped.task.actuator_of(nominal))

    @property
    def dimensions(self) -> int:
        """Number of state variables that change: 3 where the belt moves, otherwise 2."""
        return 3 if self.actuator.kind == kernel.BELT_SPEED else 2

    def step(self, states: _Floats, actions: _Floats, t: int = 0) -> tuple[_Floats, _Floats]:
        """Return the states (x, v, v_belt), shape (..., 3), a control interval later, and the rewards, shape (...).

        The number of the interval, ``t``, does not matter: the plant stays as it is.
        """
        return control_steps(self.parameters.plant, self.actuator, states, actions)[:2]

    def jacobians(self, states: _Floats, actions: _Floats) -> _Floats:
        """Return the derivatives of (x, v, v_belt, reward) by (x, v, v_belt, action), shape (..., 4, 4)."""
        return control_jacobians(self.parameters.plant, self.actuator, states, actions)


@dataclass(frozen=True)
class LookAhead(Feedback):
    """Base of the controllers that try actions on a model and know a base controller that acts without it.

    Attributes:
        base: the controller; it must observe the whole state and have no memory.
        model: of the plant.
        horizon: control intervals that are looked ahead, in [1, 10000].

    Raises:
        TypeError, ValueError: if a number is not as said, or the velocity is not observed.
    """

    base: Feedback
    _: KW_ONLY
    model: Model = field(repr=False)
    horizon: int = 100

    _counts: ClassVar[dict[str, tuple[int, int]]] = {"horizon": (1, 10_000)}
    _needs_velocity: ClassVar = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in self._counts.items():
            object.__setattr__(self, name, checked_count(name, getattr(self, name), low, high))

    @classmethod
    def from_env(cls, env: Any, *arguments: Any, **named: Any) -> Self:
        """Return the controller of an environment, with its nominal plant as the model; see Feedback.from_env."""
        return super().from_env(env, *arguments, **({"model": Model.from_env(env)} | named))

    def _states(self, values: _Floats) -> _Floats:
        """Return the states (x, v, v_belt), shape (..., 3), of readings (..., k).

        Raises:
            ValueError: if one is not finite.
        """
        belt_speed = self.model.parameters.belt_speed
        states = self.readings.states(values, belt_speed)
        # A mass that sticks has the belt's speed exactly, but for the observation's single precision.
        rides = np.abs(states[..., 1] - states[..., 2]) <= 1e-6 * max(belt_speed, 1.0)
        states[..., 1] = np.where(rides, states[..., 2], states[..., 1])
        return states

    def _follow(self, states: _Floats, choose: Callable[[int, _Floats], _Floats]) -> tuple[_Floats, _Floats]:
        """Return the actions taken on the model, shape (horizon, ...), and their returns, shape (...).

        Args:
            states: (..., 3). choose: the actions (...) at a step, from its number and the base controller's actions.

        A motion that cannot be followed returns minus infinity.
        """
        taken, total = np.empty((self.horizon, *states.shape[:-1])), np.zeros(states.shape[:-1])
        for t in range(self.horizon):
            taken[t] = choose(t, self._base_actions(states))
            states, rewards = self.model.step(states, taken[t])
            total += rewards
        return taken, np.nan_to_num(total, nan=-np.inf)

    def _base_actions(self, states: _Floats) -> _Floats:
        """Return the base controller's actions as the environment takes them: clipped, in single precision."""
        values = np.empty((*states.shape[:-1], len(self.readings.names)))
        values[..., 0] = states[..., 0] - self.readings.x_equilibrium
        values[..., 1] = states[..., 1]
        if values.shape[-1] > 2:
            values[..., 2] = (states[..., 2] - self.model.parameters.belt_speed) / self.readings.authority
        action, _ = self.base._act(values, None, None)
        return as_taken(action)


@dataclass(frozen=True)
class RolloutPolicy(LookAhead):
    """Rollout of a base controller: of several first actions, each followed by the base controller, take the best.

    No random numbers are drawn, and the base controller's own action is among those tried: on a true model the result
    is no worse than the base controller's over the horizon. Source: rollout, D. P. Bertsekas, Reinforcement Learning
    and Optimal Control (2019).

    Attributes:
        candidates: evenly spaced first actions, in [2, 1000].
    """

    candidates: int = 7

    _counts: ClassVar = {**LookAhead._counts, "candidates": (2, 1000)}

    def _act(self, values: _Floats, state: State, starts: ArrayLike | None) -> tuple[_Floats, State]:
        return self.best_actions(self._states(values)), None

    def best_actions(self, states: _Floats) -> _Floats:
        """Return the best first actions in states (x, v, v_belt), shape (..., 3), shape (...)."""
        tried = np.linspace(-1.0, 1.0, self.candidates)
        many = np.repeat(states[..., None, :], self.candidates + 1, axis=-2)

        def choose(t: int, own: _Floats) -> _Floats:
            if t == 0:
                own[..., 1:] = tried
            return own

        taken, total = self._follow(many, choose)
        return pick(taken[0], np.argmax(total, axis=-1))


def pick(values: _Floats, best: NDArray[np.int64]) -> _Floats:
    """Return the best along the last axis, shape (...), of values (..., m) at places (...)."""
    chosen: _Floats = np.take_along_axis(values, np.broadcast_to(best, values.shape[:-1])[..., None], axis=-1)[..., 0]
    return chosen
