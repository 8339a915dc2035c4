"""Info dictionaries: the names and numbers that a reset and a step report, of one environment and of a batch."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.task import FloatArray, IntegerArray
from sd_friction_env.physics.parameters import FRICTIONS, GEOMETRIES, OscillatorParameters, checked_choice

REWARD_TERMS = ("reward_vibration", "reward_effort", "reward_stick", "reward_contact_loss")
# Statistics of an episode, in the kernel's order. Its last info also has the plain ones at the top level, where
# monitors look for them; the others have the names of a step's reward terms.
PLAIN_STATISTICS = ("return", "length", "late_amplitude", "late_stick_fraction")
EPISODE_STATISTICS = (*PLAIN_STATISTICS, *REWARD_TERMS)
# Names of a step's info in its order, and the rows in which the kernel reports them.
_ROWS = {
    "x": kernel.LANE_X_END,
    "v": kernel.LANE_V_END,
    "v_belt": kernel.LANE_BELT_END,
    "v_rel": kernel.LANE_V_REL,
    "mode": kernel.LANE_MODE,
    "normal_force": kernel.LANE_NORMAL,
    "time": kernel.LANE_TIME,
    "action": kernel.LANE_ACTION,
    "force": kernel.LANE_U,
    "belt_acceleration": kernel.LANE_A_BELT,
    "x_min": kernel.LANE_X_MIN,
    "x_max": kernel.LANE_X_MAX,
    "mean_square_velocity": kernel.LANE_MEAN_V2,
    "stick_fraction": kernel.LANE_STICK_FRACTION,
    "friction_power": kernel.LANE_FRICTION_POWER,
    "control_power": kernel.LANE_CONTROL_POWER,
    "events": kernel.LANE_EVENTS,
    "status": kernel.LANE_STATUS,
    "reward_vibration": kernel.LANE_VIBRATION,
    "reward_effort": kernel.LANE_EFFORT,
    "reward_stick": kernel.LANE_STICK,
    "reward_contact_loss": kernel.LANE_CONTACT_LOSS,
}
_CODES = ("mode", "events")  # whole numbers that the kernel reports beside the floats
_FLOATS = tuple(name for name in _ROWS if name not in (*_CODES, "status"))
STEP_KEYS = (*_FLOATS, *_CODES, "status")
RESET_KEYS = ("x", "v", "v_belt", "v_rel", "mode", "normal_force", "time")
INFO_KEYS = (*STEP_KEYS, "parameters")
_STEP_INFO: dict[str, Any] = {name: 0.0 if name in _FLOATS else 0 for name in _ROWS}
new_step_info = _STEP_INFO.copy  # a copy is much faster than a new dictionary


def checked_info_keys(info_keys: Any) -> frozenset[str]:
    """Return the names that a step's info holds, from "all" or a sequence or set of names of ``INFO_KEYS``."""
    expected = "info_keys must be 'all' or a sequence of names"
    if isinstance(info_keys, str):
        if info_keys == "all":
            return frozenset(INFO_KEYS)
        raise ValueError(f"{expected}, got {info_keys!r}")
    if not isinstance(info_keys, Collection) or (isinstance(info_keys, np.ndarray) and info_keys.ndim != 1):
        raise TypeError(f"{expected}, got {info_keys!r}")
    for name in info_keys:
        if not isinstance(name, str):
            raise TypeError(f"{expected}, got {name!r} among them")
        checked_choice("info_keys", name, INFO_KEYS)
    return frozenset(map(str, info_keys))


def numbers_of(parameters: OscillatorParameters) -> dict[str, float]:
    """Return parameters as info holds them: geometry and friction by their positions in GEOMETRIES and FRICTIONS."""
    return parameters.values | law_codes(parameters.geometry, parameters.friction)


def law_codes(geometry: Any, friction: Any) -> dict[str, int]:
    """Return the positions of laws in GEOMETRIES and FRICTIONS; -1 for a user-defined law."""
    named = {"geometry": (geometry, GEOMETRIES), "friction": (friction, FRICTIONS)}
    return {name: names.index(law) if isinstance(law, str) else -1 for name, (law, names) in named.items()}


def episode_statistics(
    state: FloatArray, counts: IntegerArray, which: Any, custom_reward: bool, num_envs: int = 1
) -> dict[str, NDArray[Any]]:
    """Return the statistics (num_envs,) of the episodes of environments ``which``, by name; 0 for the others."""
    values = np.zeros((len(EPISODE_STATISTICS), num_envs))
    kernel.episode_statistics(state, counts, which, custom_reward, values)
    statistics: dict[str, NDArray[Any]] = dict(zip(EPISODE_STATISTICS, values, strict=True))
    statistics["length"] = statistics["length"].astype(np.int64)
    return statistics


class FinalObservations(np.ndarray[Any, np.dtype[Any]]):
    """Last observations of episodes as Gymnasium's vector environments return them: an array (num_envs,) of arrays, and
    None where no episode has ended. DLPack exports it as (num_envs, size), with 0 in place of None."""

    def __dlpack__(self, **kwargs: Any) -> Any:
        rows = [row for row in self if row is not None] if self.dtype == object else []
        if not rows:
            return super().__dlpack__(**kwargs)
        whole = np.zeros((len(self), *rows[0].shape), rows[0].dtype)
        whole[[row is not None for row in self]] = rows
        return whole.__dlpack__(**kwargs)


class Buffers(NamedTuple):
    """Arrays that a step of a batch writes and returns."""

    rewards: FloatArray
    over: NDArray[np.bool_]  # terminated, truncated
    report: FloatArray
    codes: IntegerArray


class BatchInfo:
    """Info of a batch: arrays (num_envs,) by name, and beside each "name" a mask "_name"."""

    def __init__(self, num_envs: int, width: int, keys: frozenset[str], needed: Collection[str]) -> None:
        self._arguments = (num_envs, width, keys, needed)
        self.num_envs, self._width = num_envs, width
        self.step_keys = tuple(name for name in STEP_KEYS if name in keys)
        reported = {*self.step_keys, *needed}
        self._floats = tuple(name for name in _FLOATS if name in reported)
        self.rows = np.array([_ROWS[name] for name in self._floats], np.int64)
        self._has_codes, self._has_status = not reported.isdisjoint(_CODES), "status" in reported
        self._hidden = (reported | set(_CODES if self._has_codes else ())) - set(self.step_keys)
        self._no_codes = np.empty((0, width), np.int64)
        self._all = np.ones(num_envs, np.bool_)  # the mask of all environments: one read-only array for all steps
        self._all.setflags(write=False)
        self._masks = {f"_{name}": self._all for name in self.step_keys}

    def __reduce__(self) -> Any:
        return type(self), self._arguments  # a copied array would be writable

    def buffers(self) -> Buffers:
        """Return new arrays for a step."""
        n = self.num_envs
        codes = np.empty((len(_CODES), self._width), np.int64) if self._has_codes else self._no_codes
        return Buffers(np.empty(n), np.empty((2, n), np.bool_), np.empty((len(self.rows), self._width)), codes)

    def report(self, out: Buffers, counts: IntegerArray) -> dict[str, Any]:
        """Return what the kernel reported of a step, by name."""
        n = self.num_envs
        report: dict[str, Any] = dict(zip(self._floats, out.report[:, :n], strict=True))
        if self._has_codes:
            report.update(zip(_CODES, out.codes[:, :n], strict=True))
        if self._has_status:
            report["status"] = counts[kernel.COUNT_STATUS, :n].copy()
        return report

    def step(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """Return the info of a step without resets and ends of episodes."""
        info = {**self._masks, **report}
        for name in self._hidden:
            del info[name]
        return info

    def reset(
        self, which: IntegerArray, start: Mapping[str, NDArray[Any]], parameters: Mapping[str, NDArray[Any]]
    ) -> dict[str, Any]:
        """Return the info of environments ``which`` (k,) that have been reset, from their values (k,)."""
        mask = self._mask(which)
        return self._spread(start, which) | {"parameters": self._spread(parameters, which), "_parameters": mask}

    def replace_restarted(self, info: dict[str, Any], which: IntegerArray, restarted: dict[str, Any]) -> None:
        """Replace in a step's info what environments ``which`` report by the info of their reset."""
        stepped = ~self._mask(which)
        for name in self.step_keys:
            if name in RESET_KEYS:
                info[name][which] = restarted.pop(name)[which]
                del restarted[f"_{name}"]
            elif len(which) == self.num_envs:
                del info[name], info[f"_{name}"]
            else:
                info[name][which] = 0
                info[f"_{name}"] = stepped
        info.update(restarted)

    def end(self, which: IntegerArray, statistics: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        """Return what the info of environments ``which`` also holds when their episodes end."""
        mask = self._mask(which)
        masked: dict[str, Any] = {}
        for name, values in statistics.items():
            masked[name], masked[f"_{name}"] = values, mask
        plain = {name: masked[name] for short in PLAIN_STATISTICS for name in (short, f"_{short}")}
        return {"statistics": masked, "_statistics": mask, **plain}

    def final(
        self, info: Mapping[str, Any], which: IntegerArray, ends: Mapping[str, Any], observations: NDArray[np.float32]
    ) -> dict[str, Any]:
        """Return the last observations and info of environments that are reset in the step that ends their episodes."""
        mask = self._mask(which)
        last = np.full(self.num_envs, None, object).view(FinalObservations)
        for i in which.tolist():
            last[i] = observations[i].copy()
        final_info = {**ends, **self._spread({name: info[name][which] for name in self.step_keys}, which)}
        return {"final_obs": last, "_final_obs": mask, "final_info": final_info, "_final_info": mask}

    def _mask(self, which: IntegerArray) -> NDArray[np.bool_]:
        if len(which) == self.num_envs:
            return self._all
        mask = np.zeros(self.num_envs, np.bool_)
        mask[which] = True
        return mask

    def _spread(self, columns: Mapping[str, NDArray[Any]], which: IntegerArray) -> dict[str, Any]:
        """Return values (k,) of environments ``which`` as arrays (num_envs,), 0 elsewhere, with their masks."""
        info: dict[str, Any] = dict.fromkeys((f"_{name}" for name in columns), self._mask(which))
        for dtype in dict.fromkeys(values.dtype for values in columns.values()):  # one block per type is much faster
            names = [name for name, values in columns.items() if values.dtype == dtype]
            block = np.zeros((len(names), self.num_envs), dtype)
            block[:, which] = [columns[name] for name in names]
            info.update(zip(names, block, strict=True))
        return info
