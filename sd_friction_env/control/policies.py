"""Controllers that need NumPy alone: constant actions, classical feedback, and trained networks read from .npz files.

All share one method, that of Stable-Baselines3's policies::

    action, state = policy.predict(observation, state, episode_start, deterministic=True)

``observation`` is what the environment returns, shape (d,), or a batch of them, shape (n, d); ``action`` is float32 of
shape (1,) or (n, 1), in [-1, 1]. ``state`` is what the policy remembers: None before the first step, then what the last
call returned. ``episode_start``, shape (n,) or a bool, tells where an episode has just begun and memory is cleared.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.orbits import equilibria
from sd_friction_env.physics.parameters import checked_number
from sd_friction_env.storage import StoredFileError, checked_ending, load_arrays, naming, parse_json, save_arrays

Actions = NDArray[np.float32]
State = tuple[NDArray[Any], ...] | None

NETWORK_FORMAT = 1
_NETWORK_KIND = "sd_friction_env network policy"
_LARGEST_GAIN = 1e9
_GAINS = (-_LARGEST_GAIN, _LARGEST_GAIN)

_ACTIVATIONS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "Tanh": np.tanh,
    "ReLU": lambda z: np.maximum(z, 0.0),
}
# What stands between the last layer and the action.
_OUTPUTS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "clip": lambda z: np.clip(z, -1.0, 1.0),
    "tanh": np.tanh,
}
ACTIVATIONS = tuple(_ACTIVATIONS)
OUTPUTS = tuple(_OUTPUTS)


class Policy(Protocol):
    """What every controller offers; see the module."""

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the actions for one observation or a batch of them, and what to remember."""


class PolicyFileError(ValueError):
    """A file is not a policy that can be read here."""


# Without feedback -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConstantPolicy:
    """Always the same action.

    Attributes:
        value: the action, in [-1, 1].

    Raises:
        TypeError, ValueError: if it is not.
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
        """Return the constant for every observation; see the module."""
        return np.full((*np.shape(observation)[:-1], 1), self.value, np.float32), None


class ZeroPolicy(ConstantPolicy):
    """No action at all: the passive oscillator."""

    def __init__(self) -> None:
        super().__init__(0.0)


# Classical feedback ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Readings:
    """How the observations of an environment are turned back into physical quantities (dimensionless).

    Attributes:
        actuator: "force" or "belt_speed".
        authority: what an action of 1 asks for: a force, or a change of the belt's speed.
        x_offset, x_scale, v_scale: of the observations, as in :class:`Task`.
        x_equilibrium: where the mass stands still on the sliding belt of the nominal plant.
        sees_velocity: whether the observation has the velocity (sensor "state").
    """

    actuator: str
    authority: float
    x_offset: float
    x_scale: float
    v_scale: float
    x_equilibrium: float
    sees_velocity: bool

    @classmethod
    def from_env(cls, env: Any) -> Self:
        """Return the readings of an :class:`SDFrictionEnv`, wrapped or not: its nominal plant, never an episode's own.

        Raises:
            TypeError: if it is another kind of environment.
            ValueError: if its actuator has no authority.
        """
        bare = getattr(env, "unwrapped", None)
        task, nominal = getattr(bare, "task", None), getattr(bare, "nominal", None)
        if task is None or nominal is None:
            raise TypeError(f"env must be an SDFrictionEnv, got {env!r}")
        by_force = task.actuator == "force"
        authority = task.force_limit if by_force else task.belt_authority * nominal.belt_speed
        if not authority > 0.0:
            name = "force_limit" if by_force else "belt_authority"
            raise ValueError(f"feedback needs {name} > 0, got {getattr(task, name)!r}")
        places = [place.x for place in equilibria(nominal)]
        return cls(
            actuator=task.actuator,
            authority=authority,
            x_offset=task.x_offset,
            x_scale=task.x_scale,
            v_scale=task.v_scale,
            x_equilibrium=min(places, key=lambda x: abs(x - task.x_offset)) if places else task.x_offset,
            sees_velocity=task.sensor == "state",
        )

    @property
    def names(self) -> tuple[str, ...]:
        """What :meth:`read` returns, in order."""
        belt = ("belt modulation",) if self.sees_velocity and self.actuator == "belt_speed" else ()
        return ("x - x_equilibrium", *(("v",) if self.sees_velocity else ()), *belt)

    def read(self, observation: ArrayLike) -> NDArray[np.float64]:
        """Return what :attr:`names` says, shape (..., k), without any shown parameters; the belt modulation is
        (v_belt/belt_speed - 1)/belt_authority.

        Raises:
            ValueError: if the observations are too short.
        """
        values = np.asarray(observation, dtype=np.float64)
        size = len(self.names)
        if values.ndim < 1 or values.shape[-1] < size:
            raise ValueError(f"observation must have at least {size} entries ({', '.join(self.names)})")
        values = values[..., :size].copy()
        values[..., 0] = values[..., 0] * self.x_scale + (self.x_offset - self.x_equilibrium)
        if self.sees_velocity:
            values[..., 1] *= self.v_scale
        return values


@dataclass(frozen=True)
class LinearFeedback:
    """Saturated linear feedback: action = bias + gains . (x - x_equilibrium, v, belt modulation), clipped to [-1, 1].

    Attributes:
        gains: action per unit of each quantity in ``readings.names``, each in [-1e9, 1e9].
        readings: of the environment to be controlled.
        bias: action at the equilibrium, in [-1e9, 1e9].

    Raises:
        TypeError, ValueError: if there is not one such gain for each quantity observed.
    """

    gains: tuple[float, ...]
    readings: Readings = dataclasses.field(repr=False)
    bias: float = 0.0

    def __post_init__(self) -> None:
        _check_numbers(self, {"bias": _GAINS})
        names = self.readings.names
        if len(self.gains) != len(names):
            raise ValueError(f"gains must be {len(names)} numbers, for {', '.join(names)}; got {self.gains!r}")
        limit = _LARGEST_GAIN
        gains = tuple(
            checked_number(f"gain for {name}", gain, -limit, limit)
            for name, gain in zip(names, self.gains, strict=True)
        )
        object.__setattr__(self, "gains", gains)

    @classmethod
    def from_env(cls, env: Any, gains: Sequence[float], bias: float = 0.0) -> Self:
        """Return the controller of an environment; see :class:`Readings`."""
        return cls(tuple(gains), Readings.from_env(env), bias)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated feedback; see the module."""
        values = self.readings.read(observation)
        action = np.full(values.shape[:-1], self.bias)
        # Summed one by one: a product of matrices may round differently for another size of the batch.
        for i, gain in enumerate(self.gains):
            action += gain * values[..., i]
        return np.clip(action, -1.0, 1.0).astype(np.float32)[..., None], None


@dataclass(frozen=True)
class VelocityFeedback:
    """Saturated velocity feedback: the force u = -gain v, or a belt that follows the mass (belt_speed + gain v).

    Attributes:
        gain: in [-1e9, 1e9]; force per velocity, or change of belt speed per velocity.
        readings: of the environment to be controlled.

    Raises:
        TypeError, ValueError: if the gain is not such a number, or the velocity is not observed.
    """

    gain: float
    readings: Readings = dataclasses.field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", checked_number("gain", self.gain, -_LARGEST_GAIN, _LARGEST_GAIN))
        if not self.readings.sees_velocity:
            raise ValueError(
                "velocity feedback needs the velocity, and this environment's sensor sees the position only"
            )

    @classmethod
    def from_env(cls, env: Any, gain: float) -> Self:
        """Return the controller of an environment; see :class:`Readings`."""
        return cls(gain, Readings.from_env(env))

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated feedback; see the module."""
        sign = -1.0 if self.readings.actuator == "force" else 1.0
        action = (sign * self.gain / self.readings.authority) * self.readings.read(observation)[..., 1]
        return np.clip(action, -1.0, 1.0).astype(np.float32)[..., None], None


@dataclass(frozen=True, kw_only=True)
class FilteredFeedback:
    """Saturated linear feedback of the position and of a velocity estimated from it, for sensors that see x alone.

    The estimate is the difference of two readings over the control interval, smoothed by a first-order filter:
    w <- pole w + (1 - pole) (x - x_before)/control_interval; action = bias + x_gain (x - x_equilibrium) + v_gain w,
    clipped to [-amplitude, amplitude]. With a large ``v_gain`` it is a sliding mode with a boundary layer.

    Attributes:
        x_gain, v_gain: action per unit, in [-1e9, 1e9]. bias: action at the equilibrium, in [-1e9, 1e9].
        pole: of the filter, in [0, 1); 0: no smoothing.
        amplitude: largest action, in [0, 1].
        control_interval: time between two readings.
        readings: of the environment to be controlled.

    Raises:
        TypeError, ValueError: if one is not such a number.
    """

    x_gain: float
    v_gain: float
    pole: float
    control_interval: float
    readings: Readings = dataclasses.field(repr=False)
    bias: float = 0.0
    amplitude: float = 1.0

    def __post_init__(self) -> None:
        _check_numbers(self, {"x_gain": _GAINS, "v_gain": _GAINS, "bias": _GAINS})
        _check_numbers(self, {"pole": (0.0, 0.999), "amplitude": (0.0, 1.0)})

    @classmethod
    def from_env(cls, env: Any, **parameters: float) -> Self:
        """Return the controller of an environment; see :class:`Readings`."""
        readings = Readings.from_env(env)
        return cls(control_interval=env.unwrapped.task.control_interval, readings=readings, **parameters)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated feedback; it remembers the last position and the estimate; see the module."""
        x = self.readings.read(observation)[..., 0]
        before, estimate = (x, np.zeros_like(x)) if state is None else _remembered(state, x.shape, x.shape)
        starts = _starts(episode_start, x)
        before, estimate = np.where(starts, x, before), np.where(starts, 0.0, estimate)
        estimate = self.pole * estimate + (1.0 - self.pole) * (x - before) / self.control_interval
        action = np.clip(self.bias + self.x_gain * x + self.v_gain * estimate, -self.amplitude, self.amplitude)
        return action.astype(np.float32)[..., None], (x, estimate)


@dataclass(frozen=True, kw_only=True)
class DelayedFeedback:
    """Delayed displacement feedback: action = gain (x(t - delay) - x(t)), clipped to [-1, 1].

    Source: K. Pyragas, Phys. Lett. A 170 (1992) 421; J. Das and A. K. Mallik, J. Sound Vib. 297 (2006) 578, for
    friction-driven vibration. Until the first delay has passed, it compares with the first reading.

    Attributes:
        gain: action per unit of displacement, in [-1e9, 1e9].
        delay: in control intervals, in [1, 1000].
        readings: of the environment to be controlled.

    Raises:
        TypeError, ValueError: if one is not such a number.
    """

    gain: float
    delay: int
    readings: Readings = dataclasses.field(repr=False)

    def __post_init__(self) -> None:
        _check_numbers(self, {"gain": _GAINS, "delay": (1.0, 1000.0)})
        if self.delay != int(self.delay):
            raise ValueError(f"delay must be a whole number, got {self.delay!r}")
        object.__setattr__(self, "delay", int(self.delay))

    @classmethod
    def from_env(cls, env: Any, gain: float, delay: int) -> Self:
        """Return the controller of an environment; see :class:`Readings`."""
        return cls(gain=gain, delay=delay, readings=Readings.from_env(env))

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated feedback; it remembers the positions within the delay; see the module."""
        x = self.readings.read(observation)[..., 0]
        first = np.repeat(x[..., None], self.delay, axis=-1)
        past = first
        if state is not None:
            (past,) = _remembered(state, first.shape)
            past = np.where(_starts(episode_start, x)[..., None], first, past)
        action = np.clip(self.gain * (past[..., 0] - x), -1.0, 1.0)
        return action.astype(np.float32)[..., None], (np.concatenate([past[..., 1:], x[..., None]], axis=-1),)


@dataclass(frozen=True, kw_only=True)
class SlidingMode:
    """Sliding mode with a boundary layer: action = -amplitude sat((v + slope (x - x_equilibrium))/layer).

    Source: J.-J. E. Slotine and W. Li, Applied Nonlinear Control (1991), section 7.2.

    Attributes:
        slope: of the sliding line in the phase plane, in [-1e9, 1e9].
        layer: half its width in velocity, in [1e-6, 1e6].
        amplitude: largest action, in [-1, 1]; negative: the other way, for a belt that is to follow the mass.
        readings: of the environment to be controlled.

    Raises:
        TypeError, ValueError: if one is not such a number, or the velocity is not observed.
    """

    slope: float
    layer: float
    readings: Readings = dataclasses.field(repr=False)
    amplitude: float = 1.0

    def __post_init__(self) -> None:
        _check_numbers(self, {"slope": _GAINS, "layer": (1e-6, 1e6), "amplitude": (-1.0, 1.0)})
        if not self.readings.sees_velocity:
            raise ValueError("a sliding mode needs the velocity, and this environment's sensor sees the position only")

    @classmethod
    def from_env(cls, env: Any, **parameters: float) -> Self:
        """Return the controller of an environment; see :class:`Readings`."""
        return cls(readings=Readings.from_env(env), **parameters)

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the saturated feedback; see the module."""
        values = self.readings.read(observation)
        surface = values[..., 1] + self.slope * values[..., 0]
        action = -self.amplitude * np.clip(surface / self.layer, -1.0, 1.0)
        return action.astype(np.float32)[..., None], None


def _check_numbers(controller: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    for name, (low, high) in ranges.items():
        object.__setattr__(controller, name, checked_number(name, getattr(controller, name), low, high))


def _remembered(state: tuple[NDArray[Any], ...], *shapes: tuple[int, ...]) -> tuple[NDArray[Any], ...]:
    """Return a state, if it is what the last call returned for as many observations: others would be broadcast."""
    found = tuple(np.shape(part) for part in state)
    if found != shapes:
        raise ValueError(
            f"state must be what the last call returned for as many observations, of shapes "
            f"{', '.join(map(str, shapes))}; got {', '.join(map(str, found)) or 'nothing'}"
        )
    return state


def _starts(episode_start: ArrayLike | None, like: NDArray[np.float64]) -> NDArray[np.bool_]:
    starts = np.asarray(False if episode_start is None else episode_start, dtype=bool)
    return np.broadcast_to(starts.reshape(()) if like.ndim == 0 and starts.size == 1 else starts, like.shape)


def _real_numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be real numbers, got {array.dtype}")
    return array.astype(np.float64)


# Networks -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class NetworkPolicy:
    """A trained network's deterministic action, with its window of past observations if it has one.

    Computed in double precision: the size of a batch, and the library that multiplies the matrices, then hardly ever
    show in the float32 action.

    Attributes:
        layers: pairs of a weight matrix, shape (inputs, outputs), and a bias, shape (outputs,), first layer first.
        activation: between layers, one of "Tanh", "ReLU".
        output: after the last layer, "clip" or "tanh".
        frames: observations seen at once, oldest first, zeros where the episode is younger than that.
        metadata: what the file says of its origin (JSON values), such as ``env_id``.

    Raises:
        ValueError: if shapes or names do not fit.
    """

    layers: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]
    activation: str = "Tanh"
    output: str = "clip"
    frames: int = 1
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.activation not in _ACTIVATIONS:
            raise ValueError(f"activation must be one of {', '.join(ACTIVATIONS)}, got {self.activation!r}")
        if self.output not in _OUTPUTS:
            raise ValueError(f"output must be one of {', '.join(OUTPUTS)}, got {self.output!r}")
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
            fits = weights.ndim == 2 and bias.shape == weights.shape[1:] and size in (None, weights.shape[0])
            if not fits:
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
        """Return the network's actions and the window of observations; see the module.

        Raises:
            ValueError: if the observations have another size, or ``deterministic`` is False.
        """
        if not deterministic:
            raise ValueError("deterministic must be True: a network file holds the deterministic action alone")
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
            (before,) = _remembered(state, window.shape)
            window[:, :-size] = before[:, size:]
            if episode_start is not None:
                window[np.broadcast_to(np.asarray(episode_start, dtype=bool), (len(batch),))] = 0.0
        window[:, -size:] = batch
        return window

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as an .npz file, whole or not at all (weights in float32, as they were trained).

        Raises:
            ValueError: if the name does not end in .npz, or the metadata cannot be read again.
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
    """Return the policy in an .npz file that :meth:`NetworkPolicy.save` wrote; nothing in the file is ever executed.

    Raises:
        FileNotFoundError: if there is no such file.
        PolicyFileError: if it is something else, or of a newer format.
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
