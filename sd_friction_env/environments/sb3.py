"""Batch of environments for Stable-Baselines3. Importing this module imports Stable-Baselines3."""

import time
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from sd_friction_env.environments.batch import SDFrictionVectorEnv
from sd_friction_env.environments.ids import bare_id
from sd_friction_env.environments.info import PLAIN_STATISTICS, RESET_KEYS, checked_info_keys
from sd_friction_env.extras import extra

with extra("train"):
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv

_ENTRY_POINT = f"{SDFrictionVectorEnv.__module__}:{SDFrictionVectorEnv.__name__}"


class SDFrictionVecEnv(VecEnv):
    """Batch of friction oscillators for Stable-Baselines3: ``PPO("MlpPolicy", SDFrictionVecEnv(env_id, 256))``.

    Environment i matches ``gym.make(env_id)`` in a ``DummyVecEnv`` with the same seed bit for bit, and the whole batch
    takes about the time of a few of those. An episode's last ``info`` has ``terminal_observation``,
    ``TimeLimit.truncated``, ``episode`` (return "r", length "l" and seconds since the start "t", as in ``Monitor``, so
    that no ``VecMonitor`` is needed), ``statistics`` and the first four of these as entries of their own (see
    :class:`SDFrictionEnv`). Methods take ``indices`` as ``DummyVecEnv`` does: None or whole numbers, negative ones from
    the end.

    Args:
        env_id: such as "SDFriction/Force-v0".
        num_envs: number of environments, in [1, 2**24].
        info_keys: "all", or the names of the single environment's info in every step's dictionaries. By default none,
            because a dictionary per environment costs more than the physics; ``batch_info`` has the reward terms as
            arrays.
        stagger: whether :meth:`reset` shortens the first episodes, each by another share, so that they do not all end
            in the same step.
        **kwargs: other arguments of :class:`SDFrictionVectorEnv`: those of the environment, ``threads``,
            ``render_mode``, ``render_envs``.

    Attributes:
        envs: the :class:`SDFrictionVectorEnv`.
        batch_info: its info of the last step, arrays.

    Raises:
        TypeError, ValueError: if an argument has the wrong type or is out of range.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        *,
        info_keys: Collection[str] | Literal["all"] = (),
        stagger: bool = False,
        **kwargs: Any,
    ) -> None:
        for name in ("autoreset_mode", "copy"):
            if name in kwargs:
                raise TypeError(f"{name} cannot be chosen: Stable-Baselines3 needs its own")
        if not isinstance(stagger, bool):
            raise TypeError(f"stagger must be True or False, got {stagger!r}")
        keys = checked_info_keys(info_keys)
        if keys:
            kwargs["info_keys"] = keys
        if not isinstance(env_id, str):
            raise TypeError(f"env_id must name an environment of this package, got {env_id!r}")
        name = bare_id(env_id)
        if name not in gym.registry or gym.registry[name].vector_entry_point != _ENTRY_POINT:
            raise ValueError(f"env_id must name an environment of this package, got {env_id!r}")
        envs = gym.make_vec(env_id, num_envs=num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **kwargs).unwrapped
        assert isinstance(envs, SDFrictionVectorEnv)
        self.envs = envs
        self.stagger = stagger
        self.batch_info: dict[str, Any] = {}
        self._info_keys = tuple(name for name in envs.step_keys if name in keys)
        self._actions: NDArray[np.float32] = np.zeros((envs.num_envs, 1), np.float32)
        self._began = time.monotonic()
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Start episodes with the seeds and options set before; return observations (num_envs, size), float32."""
        options = self._options if any(self._options) else None
        observations, info = self.envs.reset(seed=self._seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = _single_infos(info, self.num_envs)
        if self.stagger:
            self.envs.stagger()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions (num_envs, 1)."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step; return observations, rewards, dones and infos."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        self.batch_info = info
        dones = terminated | truncated
        cut = (truncated & ~terminated).tolist()
        infos: list[dict[str, Any]]
        if self._info_keys and not dones.all():
            present = [name for name in self._info_keys if name in info]  # fewer if all have only been reset
            infos = _rows(info, present, self.num_envs)
            for i, single in enumerate(infos):
                single["TimeLimit.truncated"] = cut[i]
        else:
            infos = [{} for _ in range(self.num_envs)]
        if "final_obs" in info:
            self._finish(info, cut, infos)
        return observations, rewards.astype(np.float32), dones, infos

    def _finish(self, info: dict[str, Any], cut: list[bool], infos: list[dict[str, Any]]) -> None:
        """Write the infos of environments whose episodes have ended."""
        final = info["final_info"]
        seconds = round(time.monotonic() - self._began, 6)
        which = np.flatnonzero(info["_final_obs"]).tolist()
        statistics = final["statistics"]
        names = [name for name in statistics if not name.startswith("_")]
        last = _rows(final, self._info_keys, self.num_envs, which)
        for i, values, single in zip(which, _rows(statistics, names, self.num_envs, which), last, strict=True):
            self.reset_infos[i] = _single_infos(info, self.num_envs, [i])[0]
            infos[i] = single
            single["TimeLimit.truncated"] = cut[i]
            single["terminal_observation"] = info["final_obs"][i]
            single["statistics"] = values
            single.update((name, values[name]) for name in PLAIN_STATISTICS)
            single["episode"] = {"r": round(values["return"], 6), "l": values["length"], "t": seconds}

    def close(self) -> None:
        """Close the windows, if there are any."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of environments; see :meth:`SDFrictionVectorEnv.attributes_at`."""
        return self.envs.attributes_at(indices, attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether the environments have an attribute of that name."""
        try:
            self.envs.attributes_at([0], attr_name)
        except AttributeError:
            return False
        return True

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of environments; see :meth:`SDFrictionVectorEnv.set_attr`."""
        self.envs.set_attr_at(indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of environments; see :meth:`SDFrictionVectorEnv.call`."""
        return self.envs.call_at(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Return True for ``Monitor``, whose statistics the environments keep, and False for other wrappers."""
        return [issubclass(wrapper_class, Monitor)] * len(self.envs.places(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a frame (height, width, 3) of each environment that is drawn."""
        return list(self.envs.render() or ())


def _rows(
    columns: dict[str, Any], names: Sequence[str], num_envs: int, which: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """Return one dictionary for each environment, or for ``which``, from arrays (num_envs,) by name."""
    if not names:
        return [{} for _ in (range(num_envs) if which is None else which)]
    listed = [(columns[name] if which is None else columns[name][which]).tolist() for name in names]
    return [dict(zip(names, values, strict=True)) for values in zip(*listed, strict=True)]


def _single_infos(info: dict[str, Any], num_envs: int, which: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """Return the info of each environment that has just been reset."""
    infos = _rows(info, [name for name in RESET_KEYS if name in info], num_envs, which)
    parameters = info["parameters"]
    inner = [name for name in parameters if not name.startswith("_")]
    for single, values in zip(infos, _rows(parameters, inner, num_envs, which), strict=True):
        single["parameters"] = values
    return infos
