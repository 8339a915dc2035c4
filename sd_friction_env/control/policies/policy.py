"""The interface of all controllers, constant actions, and the memory that controllers keep between calls."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.parameters import checked_number

Actions = NDArray[np.float32]
State = tuple[NDArray[Any], ...] | None


class Policy(Protocol):
    """Interface of every controller; see :mod:`sd_friction_env.control.policies`."""

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the actions for one observation or a batch, and the memory for the next call."""


@dataclass(frozen=True)
class ConstantPolicy:
    """Constant action.

    Attributes:
        value: the action, in [-1, 1].

    Raises:
        TypeError, ValueError: if ``value`` is not such a number.
    """

    value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", checked_number("value", self.value, -1.0, 1.0))

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the constant for every observation."""
        return np.full((*np.shape(observation)[:-1], 1), self.value, np.float32), None


class ZeroPolicy(ConstantPolicy):
    """No action: the passive oscillator."""

    def __init__(self) -> None:
        super().__init__(0.0)


def as_taken(actions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return actions as the environment takes them: clipped, in single precision."""
    return np.clip(actions, -1.0, 1.0).astype(np.float32).astype(np.float64)


def checked_memory(state: tuple[NDArray[Any], ...], *shapes: tuple[int, ...]) -> tuple[NDArray[Any], ...]:
    """Return a policy's memory after checking its shapes.

    Raises:
        ValueError: if the memory belongs to another number of observations; NumPy would broadcast it.
    """
    found = tuple(np.shape(part) for part in state)
    if found != shapes:
        raise ValueError(
            f"state must be what the last call returned for as many observations, of shapes "
            f"{', '.join(map(str, shapes))}; got {', '.join(map(str, found)) or 'nothing'}"
        )
    return state


def broadcast_starts(starts: ArrayLike | None, like: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return where an episode has just begun, in the shape of ``like``."""
    begun = np.asarray(False if starts is None else starts, dtype=bool)
    return np.broadcast_to(begun.reshape(()) if like.ndim == 0 and begun.size == 1 else begun, like.shape)


def remembered(state: State, starts: ArrayLike | None, *fresh: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return a policy's memory, the fresh values where there is none or an episode has just begun.

    Args:
        state, starts: as ``predict`` takes them. fresh: of each part, all of one shape.

    Raises:
        ValueError: as :func:`checked_memory`.
    """
    if state is None:
        return fresh
    begun = broadcast_starts(starts, fresh[0])
    memory = checked_memory(state, *(new.shape for new in fresh))
    return tuple(np.where(begun, new, old) for new, old in zip(fresh, memory, strict=True))
