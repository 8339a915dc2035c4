"""The threshold follower on what a recurrent network estimates from positions, in NumPy, and its .npz files."""

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.follower import ThresholdFollower
from sd_friction_env.control.policies.network import PolicyFileError
from sd_friction_env.control.policies.policy import Actions, State, remembered
from sd_friction_env.storage import StoredFileError, checked_ending, load_arrays, parse_json, save_arrays

_Floats = NDArray[np.float64]
_KIND = "sd_friction_env recurrent follower"


@dataclass(frozen=True, eq=False)
class RecurrentFollower:
    """:class:`ThresholdFollower` for a sensor of x alone, on a network's estimates of velocity and nominal belt speed.

    The network sees readings and its own actions only: a gated recurrent unit (K. Cho et al., Learning phrase
    representations using RNN encoder-decoder, EMNLP 2014, in PyTorch's form) and a linear map. It was trained on
    simulated episodes with the true velocity and belt speed as targets.

    Attributes:
        weights: arrays by PyTorch's names: weight_ih_l0 (3h, 2), weight_hh_l0 (3h, h), bias_ih_l0 and bias_hh_l0 (3h,),
            and of the linear map weight (2, h) and bias (2,).
        rule: acts on the estimates; its belt speed and half of it are the estimates' zero and scale.
        speeds: smallest and largest nominal belt speed.
        metadata: origin of the network as JSON values.

    Raises:
        ValueError: if the weights have other names or shapes, or are not finite.
    """

    weights: Mapping[str, _Floats]
    rule: ThresholdFollower
    speeds: tuple[float, float]
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        h = np.shape(self.weights.get("weight_hh_l0", ()))[-1:] or (0,)
        three, one = (3 * h[0],), (h[0],)
        shapes = {
            "weight_ih_l0": (*three, 2),
            "weight_hh_l0": (*three, *one),
            "bias_ih_l0": three,
            "bias_hh_l0": three,
            "weight": (2, *one),
            "bias": (2,),
        }
        found = {name: np.shape(value) for name, value in self.weights.items()}
        if found != shapes or not all(np.isfinite(value).all() for value in self.weights.values()):
            raise ValueError(f"weights must be finite, of the shapes {shapes}, got {found}")
        as_floats = {name: np.asarray(value, np.float64) for name, value in self.weights.items()}
        object.__setattr__(self, "weights", as_floats)

    @property
    def size(self) -> int:
        """Size h of the network's memory."""
        return len(self.weights["weight"][0])

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the actions and the memory; see :mod:`sd_friction_env.control.policies`.

        Raises:
            ValueError: if an observation is not finite, or not x alone.
        """
        x = np.asarray(observation, np.float64)
        if x.ndim not in (1, 2) or x.shape[-1] != 1 or not np.isfinite(x).all():
            raise ValueError(f"observation must be finite, of shape (1,) or (n, 1), got {np.shape(observation)}")
        shape = x.shape[:-1]
        last, hidden = remembered(state, episode_start, np.zeros(shape), np.zeros((self.size, *shape)))
        hidden = self._remember(np.stack([x[..., 0], last]), hidden)
        v, belt_speed = self.estimate(hidden)
        action = np.clip(self.rule.follow(v, belt_speed), -1.0, 1.0).astype(np.float32)
        return action[..., None], (action.astype(np.float64), hidden)

    def _remember(self, seen: _Floats, hidden: _Floats) -> _Floats:
        """Return the memory (h, ...) after readings and actions (2, ...)."""
        w, tail = self.weights, (slice(None), *[None] * (seen.ndim - 1))
        given = np.tensordot(w["weight_ih_l0"], seen, 1) + w["bias_ih_l0"][tail]
        kept = np.tensordot(w["weight_hh_l0"], hidden, 1) + w["bias_hh_l0"][tail]
        reset, update = 1.0 / (1.0 + np.exp(-(given + kept)[: 2 * self.size].reshape(2, self.size, *seen.shape[1:])))
        new = np.tanh(given[2 * self.size :] + reset * kept[2 * self.size :])
        after: _Floats = new + update * (hidden - new)
        return after

    def estimate(self, hidden: _Floats) -> tuple[_Floats, _Floats]:
        """Return velocity and nominal belt speed, each (...), as a memory (h, ...) has them."""
        out = np.tensordot(self.weights["weight"], hidden, 1)
        out += self.weights["bias"].reshape(2, *[1] * (hidden.ndim - 1))
        scale = 0.5 * self.rule.belt_speed
        return scale * out[0], np.clip(self.rule.belt_speed + scale * out[1], *self.speeds)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to an .npz file atomically, with weights in float32 as trained.

        Raises:
            ValueError: if the name does not end in .npz. OSError: if the file cannot be written.
        """
        checked_ending(path, (".npz",))
        header = {"kind": _KIND, "metadata": dict(self.metadata)}
        arrays = {name: value.astype(np.float32) for name, value in self.weights.items()}
        save_arrays(path, {"header": np.array(json.dumps(header)), **arrays})

    @classmethod
    def load(cls, path: str | os.PathLike[str], env: Any) -> Self:
        """Return the policy of a file for an environment with the sensor "position" and the belt actuator.

        Raises:
            FileNotFoundError: if there is no such file. PolicyFileError: if it is damaged or of another kind.
            TypeError, ValueError: if the environment is another one.
        """
        task, nominal = env.unwrapped.task, env.unwrapped.nominal
        if task.sensor != "position":
            raise ValueError(f"a recurrent follower needs the sensor 'position', got {task.sensor!r}")
        rule = ThresholdFollower.seeing_all(env)
        speeds = task.randomise.get("belt_speed", (nominal.belt_speed, nominal.belt_speed))
        try:
            arrays = load_arrays(path, kinds="f", texts=("header",))
            header = parse_json(str(arrays.pop("header")))
            if not isinstance(header, dict) or header.get("kind") != _KIND:
                raise ValueError("it has another header")
            return cls(arrays, rule, speeds, header["metadata"])
        except (StoredFileError, KeyError, ValueError) as error:
            raise PolicyFileError(f"{os.fspath(path)!r} is not a recurrent follower, or is damaged: {error}") from None
