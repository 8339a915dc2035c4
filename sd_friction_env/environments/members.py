"""Access to the single environments of a batch: their states, methods, attributes and pictures."""

import functools
import inspect
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from sd_friction_env.environments.display import Display
from sd_friction_env.environments.episodes import Episodes
from sd_friction_env.environments.limits import LengthInSpec
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.environments.states import EnvState, check_state
from sd_friction_env.environments.task import IntegerArray
from sd_friction_env.physics.parameters import brief_repr, checked_choice, checked_count
from sd_friction_env.pictures.scene import RENDER_MODES

_STATE_METHODS = ("reset", "set_state", "step")  # of the single environment; they need or change a state
_MOST_RENDERED = 16


class Members(LengthInSpec, VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """Batch whose environments can be accessed one by one; the base of :class:`SDFrictionVectorEnv`."""

    _single: SDFrictionEnv  # stands for each environment in turn
    _episodes: Episodes
    _displays: dict[int, Display]  # of the environments that are drawn
    _attributes: dict[str, list[Any]]  # set by the user
    _seeds: list[int | None]
    _over: IntegerArray  # environments whose episodes have ended, and that wait for a reset
    _is_reset: bool

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """Seeds of the environments; None where none was given."""
        return tuple(self._seeds)

    # States -----------------------------------------------------------------------------------------------------------

    def get_states(self) -> tuple[EnvState, ...]:
        """Return the state of every environment; see :meth:`SDFrictionEnv.get_state`.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before get_states(): there is no state yet")
        return tuple(self._episodes.read(i) for i in range(self.num_envs))

    def set_states(self, states: Sequence[EnvState]) -> None:
        """Return to states from :meth:`get_states`; what follows is bit-identical. The episodes' statistics begin anew.

        Raises:
            TypeError, ValueError: if ``states`` are not ``num_envs`` such states; nothing changes then.
        """
        if not isinstance(states, Sequence):
            raise TypeError(f"states must be a sequence of {self.num_envs}, as get_states() returns it, got {states!r}")
        if len(states) != self.num_envs:
            raise ValueError(f"states must be {self.num_envs}, one per environment, got {len(states)}")
        for i, state in enumerate(states):
            check_state(f"states[{i}]", state)
        self._put_states(np.arange(self.num_envs), states)
        self._is_reset = True

    def _put_states(self, which: IntegerArray, states: Sequence[EnvState]) -> None:
        self._episodes.write(which, states)
        self._clear_displays(which)
        over = np.array([saved.ended or saved.steps >= self.task.episode_steps for saved in states])
        self._over = np.union1d(self._over[~np.isin(self._over, which)], which[over])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the batch's state, not copies, by name: filled with saved values, they resume it."""
        return self._episodes.arrays()

    # Methods and attributes -------------------------------------------------------------------------------------------

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every environment, or read an attribute; return the results.

        A single environment takes the state of each in turn; changes of the state are kept.

        Raises:
            AttributeError: if there is nothing of that name. ValueError: if it draws an environment that is not drawn.
            gymnasium.error.ResetNeeded: before the first reset, if the call needs or changes a state.
        """
        return tuple(self.call_at(range(self.num_envs), name, *args, **kwargs))

    def call_at(self, indices: int | Iterable[int] | None, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """:meth:`call` for some of the environments; ``indices`` as in :meth:`places`."""
        return [self._call_one(name, i, *args, **kwargs) for i in self.places(indices)]

    def places(self, indices: int | Iterable[int] | None) -> list[int]:
        """Return the positions in the batch that ``indices`` name.

        Args:
            indices: one or several whole numbers in [-num_envs, num_envs), negative ones from the end; None: all.

        Raises:
            TypeError: if one is not a whole number. IndexError: if there is no such environment.
        """
        if indices is None:
            return list(range(self.num_envs))
        several: Any = indices if isinstance(indices, Iterable) and getattr(indices, "ndim", 1) > 0 else [indices]
        n, got = self.num_envs, f"got {brief_repr(indices)}"
        try:
            return [range(n)[operator.index(index)] for index in several]
        except TypeError:
            raise TypeError(f"indices must be None, a whole number or several of them, {got}") from None
        except IndexError:
            raise IndexError(f"indices must be in [{-n}, {n - 1}], {got}") from None

    def _call_one(self, name: str, i: int, /, *args: Any, **kwargs: Any) -> Any:
        if name == "render":
            return self._draw(i)
        found = self._attribute(name, i)
        if not callable(found):
            return found
        if name in _STATE_METHODS and not self._is_reset:
            raise gym.error.ResetNeeded(f"call reset() before call({name!r}): there is no state yet")
        result = found(*args, **kwargs)
        if name in _STATE_METHODS:
            self._put_states(np.array([i]), [self._single.get_state()])
        if name == "reset" and kwargs.get("seed") is not None:
            self._seeds[i] = kwargs["seed"]
        return result

    def _attribute(self, name: str, i: int) -> Any:
        """Return an attribute of an environment; methods are those of the single environment in its state."""
        if name in self._attributes:
            return self._attributes[name][i]
        if name in ("render_mode", "np_random_seed"):
            return self.render_mode if name == "render_mode" else self._seeds[i]
        if self._is_reset:
            self._single.set_state(self._episodes.read(i))
        return getattr(self._single, name)

    def attributes_at(self, indices: int | Iterable[int] | None, name: str) -> list[Any]:
        """Return an attribute of some of the environments; methods are not called and act on their own environment."""
        found = []
        for i in self.places(indices):
            value = self._attribute(name, i)
            own = inspect.ismethod(value) and value.__self__ is self._single
            found.append(functools.partial(self._call_one, name, i) if own else value)
        return found

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment: a list or tuple of ``num_envs`` values, or one value for all.

        Raises:
            ValueError: if there are not ``num_envs`` values.
            AttributeError: if environments have such an attribute already.
        """
        listed = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(listed) != self.num_envs:
            raise ValueError(f"values must be {self.num_envs}, one per environment, got {len(listed)}")
        for i, value in enumerate(listed):
            self.set_attr_at([i], name, value)

    def set_attr_at(self, indices: int | Iterable[int] | None, name: str, value: Any) -> None:
        """:meth:`set_attr` for some of the environments, with one value; a new attribute is None in the others."""
        places = self.places(indices)
        if hasattr(self._single, name):
            raise AttributeError(
                f"{name!r} cannot be set: parameters and tasks are given to the constructor or to reset(options=...)"
            )
        values = self._attributes.setdefault(name, [None] * self.num_envs)
        for i in places:
            values[i] = value

    # Pictures ---------------------------------------------------------------------------------------------------------

    def render(self) -> tuple[Any, ...] | None:
        """Draw the environments ``render_envs``; return arrays (height, width, 3), uint8, in mode "rgb_array"."""
        if self.render_mode is None:
            self._single.render()  # warns
            return None
        frames = tuple(self._draw(i) for i in self._displays)
        return frames if self.render_mode == "rgb_array" else None

    def _draw(self, i: int) -> Any:
        if self.render_mode is None:
            return self._single.render()
        if i not in self._displays:
            raise ValueError(f"environment {i} is not drawn: render_envs names {sorted(self._displays)!r}")
        return self._displays[i].draw(self._episodes.read(i), self._single.title)

    def _clear_displays(self, which: IntegerArray) -> None:
        if self._displays:
            for i in self._displays.keys() & set(which.tolist()):
                self._displays[i].clear()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the windows, if there are any."""
        for display in self._displays.values():
            display.close()


def displays(single: SDFrictionEnv, num_envs: int, render_mode: str | None, render_envs: Any) -> dict[int, Display]:
    """Return the pictures of a batch's environments by position: of ``render_envs``, or of the first ones if None."""
    if render_envs is None:
        render_envs = range(min(num_envs, _MOST_RENDERED if render_mode == "rgb_array" else 1))
    elif not isinstance(render_envs, Iterable):
        raise TypeError(
            f"render_envs must be None or a sequence of whole numbers in [0, {num_envs - 1}], got {render_envs!r}"
        )
    chosen = [checked_count("render_envs", i, 0, num_envs - 1) for i in render_envs]
    if len(set(chosen)) < len(chosen) or (render_mode == "human" and len(chosen) != 1):
        raise ValueError(f"render_envs must name each environment once, and one for 'human', got {chosen!r}")
    if render_mode is None:
        return {}
    checked_choice("render_mode", render_mode, RENDER_MODES)
    return {i: Display(single.task, render_mode, single.render_size) for i in chosen}
