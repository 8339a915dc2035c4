"""Trained networks as policies in NumPy, and their .npz files."""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.control.policies.policy import Actions, State, checked_memory
from sd_friction_env.storage import StoredFileError, checked_ending, load_arrays, naming, parse_json, save_arrays

NETWORK_FORMAT = 1
_NETWORK_KIND = "sd_friction_env network policy"

_ACTIVATIONS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "Tanh": np.tanh,
    "ReLU": lambda z: np.maximum(z, 0.0),
}
# Applied to the last layer's output.
_OUTPUTS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "clip": lambda z: np.clip(z, -1.0, 1.0),
    "tanh": np.tanh,
}


class PolicyFileError(ValueError):
    """A file cannot be read as a policy."""


@dataclass(frozen=True, eq=False)
class NetworkPolicy:
    """Deterministic action of a trained network, with a window of past observations if it was trained with one.

    It computes in double precision, so that the batch size and the linear algebra library hardly ever change the
    float32 action.

    Attributes:
        layers: pairs of a weight matrix, shape (inputs, outputs), and a bias, shape (outputs,), first layer first.
        activation: between layers, one of "Tanh", "ReLU".
        output: after the last layer, "clip" or "tanh".
        frames: number of observations in the window, oldest first; zeros stand for those before the episode.
        metadata: origin of the network as JSON values, such as ``env_id``.

    Raises:
        TypeError, ValueError: if a shape, a name or a value is not as said.
    """

    layers: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]
    activation: str = "Tanh"
    output: str = "clip"
    frames: int = 1
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.activation not in _ACTIVATIONS:
            raise ValueError(f"activation must be one of {', '.join(_ACTIVATIONS)}, got {self.activation!r}")
        if self.output not in _OUTPUTS:
            raise ValueError(f"output must be one of {', '.join(_OUTPUTS)}, got {self.output!r}")
        if not self.layers:
            raise ValueError("layers must not be empty")
        if isinstance(self.frames, bool) or not isinstance(self.frames, int | np.integer):
            raise TypeError(f"frames must be a whole number, got {self.frames!r}")
        if not isinstance(self.metadata, Mapping):
            raise TypeError(f"metadata must be a mapping, got {type(self.metadata).__name__}")
        layers = tuple(
            (_real_numbers(f"weights {i}", w), _real_numbers(f"bias {i}", b)) for i, (w, b) in enumerate(self.layers)
        )
        size: int | None = None
        for number, (weights, bias) in enumerate(layers):
            if weights.ndim != 2 or bias.shape != weights.shape[1:] or size not in (None, weights.shape[0]):
                raise ValueError(
                    f"layer {number}: weights {weights.shape} and bias {bias.shape} do not fit {size} inputs"
                )
            if not (np.isfinite(weights).all() and np.isfinite(bias).all()):
                raise ValueError(f"layer {number} has weights that are not finite")
            size = weights.shape[1]
        if size != 1:
            raise ValueError(f"the last layer must have 1 output, got {size}")
        inputs = layers[0][0].shape[0]
        if self.frames < 1 or inputs < 1 or inputs % self.frames:
            raise ValueError(f"{inputs} inputs cannot be {self.frames} observations")
        object.__setattr__(self, "layers", layers)

    def __repr__(self) -> str:
        sizes = "-".join(str(size) for size in (self.layers[0][0].shape[0], *(len(bias) for _, bias in self.layers)))
        window = f" of {self.frames} observations" if self.frames > 1 else ""
        origin = " ".join(str(self.metadata[key]) for key in ("algorithm", "env_id") if key in self.metadata)
        return f"NetworkPolicy({sizes}{window}, {self.activation}, {self.output}{', ' + origin if origin else ''})"

    @property
    def title(self) -> str:
        """Algorithm that trained it and, unless it began with random weights, the controller that it started from."""
        start = self.metadata.get("start_from")
        return str(self.metadata.get("algorithm", "trained")).upper() + (f" started from {start}" if start else "")

    @property
    def observation_size(self) -> int:
        """Entries of one observation."""
        return int(self.layers[0][0].shape[0]) // self.frames

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the network's actions and its window of observations.

        Raises:
            ValueError: if the observations have another size, or ``deterministic`` is False.
        """
        if not deterministic:
            raise ValueError("deterministic must be True: a network file holds only the deterministic action")
        values = np.asarray(observation, dtype=np.float32)
        if values.ndim not in (1, 2) or values.shape[-1] != self.observation_size:
            raise ValueError(
                f"observation must have shape ({self.observation_size},) or (n, {self.observation_size}), "
                f"got {values.shape}"
            )
        single = values.ndim == 1
        batch = values[None] if single else values
        if self.frames > 1:
            batch = self._window(batch, state, episode_start)
            state = (batch,)
        activation = _ACTIVATIONS[self.activation]
        hidden = batch.astype(np.float64)
        for weights, bias in self.layers[:-1]:
            hidden = activation(hidden @ weights + bias)
        weights, bias = self.layers[-1]
        action = _OUTPUTS[self.output](hidden @ weights + bias).astype(np.float32)
        return (action[0] if single else action), state

    def _window(self, batch: NDArray[np.float32], state: State, episode_start: ArrayLike | None) -> NDArray[np.float32]:
        size = self.observation_size
        window = np.zeros((len(batch), self.frames * size), np.float32)
        if state is not None:
            (before,) = checked_memory(state, window.shape)
            window[:, :-size] = before[:, size:]
            if episode_start is not None:
                window[np.broadcast_to(np.asarray(episode_start, dtype=bool), (len(batch),))] = 0.0
        window[:, -size:] = batch
        return window

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to an .npz file atomically, with weights in float32 as trained.

        Raises:
            ValueError: if the name does not end in .npz, or the metadata are not JSON values.
            OSError: if the file cannot be written.
        """
        target = Path(path)
        checked_ending(target, (".npz",))
        header = {
            "kind": _NETWORK_KIND,
            "format": NETWORK_FORMAT,
            "activation": self.activation,
            "output": self.output,
            "frames": self.frames,
            "layers": len(self.layers),
            "metadata": dict(self.metadata),
        }
        text = json.dumps(header)
        parse_json(text)
        arrays: dict[str, Any] = {"header": np.array(text)}
        for i, (weights, bias) in enumerate(self.layers):
            arrays[f"weights_{i}"] = weights.astype(np.float32)
            arrays[f"bias_{i}"] = bias.astype(np.float32)
        save_arrays(target, arrays)


def load_policy(path: str | os.PathLike[str]) -> NetworkPolicy:
    """Read a policy from an .npz file that :meth:`NetworkPolicy.save` wrote; nothing in the file is executed.

    Raises:
        FileNotFoundError: if there is no such file.
        PolicyFileError: if the file is damaged, of another kind, or of a newer format.
    """
    name = os.fspath(path)
    if Path(path).is_dir():
        raise PolicyFileError(f"{name!r} is a folder; name the policy.npz in it")
    try:
        arrays = load_arrays(path, kinds="f", texts=("header",))
        with naming(path):
            header = parse_json(str(arrays.pop("header")))
        if not isinstance(header, dict) or header.get("kind") != _NETWORK_KIND:
            raise PolicyFileError(f"{name!r} is not a policy of sd_friction_env")
        if header["format"] != NETWORK_FORMAT:
            raise PolicyFileError(
                f"{name!r} has policy format {header['format']!r}; this version reads {NETWORK_FORMAT}"
            )
        count = header["layers"]
        if type(count) is not int or 2 * count != len(arrays):
            raise ValueError(f"its header speaks of {count!r} layers, and it holds {len(arrays)} arrays")
        layers = tuple((arrays[f"weights_{i}"], arrays[f"bias_{i}"]) for i in range(count))
        return NetworkPolicy(layers, header["activation"], header["output"], header["frames"], header["metadata"])
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no policy file {name!r}") from None
    except PolicyFileError:
        raise
    except StoredFileError as error:
        raise PolicyFileError(f"{error}: it is not a policy of sd_friction_env, or is damaged") from None
    except (OSError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise PolicyFileError(
            f"{name!r} is not a policy of sd_friction_env, or is damaged: {type(error).__name__}: {error}"
        ) from None


def _real_numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {array.dtype}")
    return array.astype(np.float64)
