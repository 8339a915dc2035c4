"""Checks of what the single environment and the batch are given: parameters, reset options, seeds and actions."""

import dataclasses
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.environments.task import Task
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, brief_repr, checked_number

OPTIONS = ("parameters", "phase", "start", "v", "x")
SMALLEST_BELT_SPEED = 1e-6  # of an environment


# Parameters -----------------------------------------------------------------------------------------------------------


def as_parameters(parameters: OscillatorParameters | Mapping[str, Any] | None) -> OscillatorParameters:
    """Return :class:`OscillatorParameters`, from a mapping of its fields or None (the nominal plant) too."""
    if not isinstance(parameters, OscillatorParameters):
        given = {} if parameters is None else parameters
        _check_names("parameters", given)
        parameters = OscillatorParameters().replace(**given)
    check_belt(parameters)
    return parameters


def _check_names(name: str, parameters: Any) -> None:
    if not isinstance(parameters, Mapping):
        raise TypeError(f"{name} must be a mapping of parameter names to values, got {parameters!r}")
    for key in parameters:
        if not isinstance(key, str):
            raise TypeError(f"{name} must map parameter names to values, got the name {key!r}")


def check_belt(parameters: OscillatorParameters) -> None:
    """Raise ValueError if the belt is too slow for an environment."""
    if parameters.belt_speed < SMALLEST_BELT_SPEED:
        raise ValueError(
            f"belt_speed must be at least {SMALLEST_BELT_SPEED:g} in an environment, whose reward is relative to it, "
            f"got {parameters.belt_speed!r}"
        )


def check_ranges(task: Task, nominal: OscillatorParameters) -> None:
    """Raise ValueError if an episode could draw parameters that are not legal."""
    corner: dict[str, float] = {}
    for name, (low, high) in (*task.randomise.items(), *task.drift.items()):
        # The largest mu_m and mu_k with the smallest mu_s.
        corner[name] = (
            max(corner.get(name, high), high) if name in ("mu_m", "mu_k") else min(corner.get(name, low), low)
        )
    check_belt(nominal.replace(**corner))
    check_drift(task, nominal)


def check_drift(task: Task, parameters: OscillatorParameters) -> None:
    """Raise ValueError if a parameter cannot drift from its value."""
    if "alpha" in task.drift and parameters.alpha == 0.0:
        raise ValueError("alpha = 0 (the discontinuous limit) cannot drift: start at a positive alpha")


# Options of reset -----------------------------------------------------------------------------------------------------


def without_axes(value: Any) -> Any:
    """Return a value, or the number in a zero-dimensional array of any library, as array wrappers pass it."""
    return value.item() if getattr(value, "ndim", None) == 0 else value


def checked_options(options: Any) -> dict[str, Any]:
    """Return the options of one environment; raise TypeError or ValueError if one is not legal."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise TypeError(f"options must be a mapping or None, got {options!r}")
    unknown = sorted(str(name) for name in options if name not in OPTIONS)
    if unknown:
        raise ValueError(f"unknown option {unknown[0]!r}; allowed: {', '.join(OPTIONS)}")
    checked = {name: without_axes(value) for name, value in options.items()}
    if "parameters" in checked:
        given = checked["parameters"]
        given = dataclasses.asdict(given) if isinstance(given, OscillatorParameters) else given
        _check_names("options['parameters']", given)
        checked["parameters"] = {name: without_axes(value) for name, value in given.items()}
    for name in ("x", "v"):
        if name in checked:
            checked[name] = checked_number(f"options[{name!r}]", checked[name], -STATE_LIMIT, STATE_LIMIT)
    if "v" in checked and "x" not in checked:
        raise ValueError(f"options['v'] = {checked['v']!r} is allowed only together with options['x']")
    if "phase" in checked:
        checked["phase"] = checked_number("options['phase']", checked["phase"], 0.0, 1.0)
    if sum(name in checked for name in ("x", "phase", "start")) > 1:
        raise ValueError(f"options 'x', 'phase' and 'start' exclude one another, got {dict(options)!r}")
    return checked


def apply_options(
    task: Task, parameters: OscillatorParameters, options: Mapping[str, Any], key: int, episode: int
) -> tuple[OscillatorParameters, tuple[float, float] | None]:
    """Return an episode's parameters, and its (x, v) if the (checked) options set them."""
    if "parameters" in options:
        parameters = parameters.replace(**options["parameters"])
        check_belt(parameters)
        check_drift(task, parameters)
    if "x" in options:
        return parameters, (options["x"], options.get("v", parameters.first_belt_speed))
    if "phase" in options:
        return parameters, task.cycle_state(parameters, options["phase"])
    if "start" in options:
        return parameters, dataclasses.replace(task, start=options["start"]).start_state(parameters, key, episode)
    return parameters, None


def checked_batch_options(options: Any, num_envs: int) -> tuple[NDArray[np.bool_] | None, list[dict[str, Any]] | None]:
    """Return the mask of environments to be reset (None: all) and the checked options of each (None: no options)."""
    if options is None:
        return None, None
    if isinstance(options, Sequence) and not isinstance(options, str):
        if len(options) != num_envs:
            raise ValueError(f"options must be a mapping or {num_envs} of them, got {len(options)}")
        return None, [checked_options(single) for single in options]
    if not isinstance(options, Mapping):
        raise TypeError(f"options must be a mapping, {num_envs} of them or None, got {options!r}")
    given = dict(options)
    mask = given.pop("reset_mask", None)
    if mask is not None:
        expected = f"options['reset_mask'] must be a boolean array of shape ({num_envs},) with a True in it"
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"{expected}, got {mask!r}")
        if mask.shape != (num_envs,) or not mask.any():
            raise ValueError(f"{expected}, got shape {mask.shape} with {mask.sum()} True")
    if not given:
        return mask, None
    return mask, [checked_options(single) for single in _transposed("options", given, num_envs)]


def _transposed(name: str, values: Mapping[Any, Any], num_envs: int) -> list[dict[Any, Any]]:
    """Return a mapping for each environment, from a mapping to values for all or arrays of ``num_envs`` values."""
    columns = {key: _entries(f"{name}[{key!r}]", value, num_envs) for key, value in values.items()}
    return [{key: entries[i] for key, entries in columns.items()} for i in range(num_envs)]


def _entries(name: str, value: Any, num_envs: int) -> list[Any]:
    """Return an option's value for each environment: the entries of an array, or one value for all."""
    value = without_axes(value)
    if isinstance(value, Mapping):
        return _transposed(name, value, num_envs)
    if not isinstance(value, np.ndarray | list | tuple) or _is_law(value):
        return [value] * num_envs
    if isinstance(value, np.ndarray) and value.ndim > 1:
        raise ValueError(f"{name} must be one value or {num_envs}, got shape {value.shape}")
    if len(value) != num_envs:
        raise ValueError(f"{name} must be one value or {num_envs}, got {len(value)}")
    for entry in value:
        listed = isinstance(entry, list | tuple) and not _is_law(entry)
        if listed or (isinstance(entry, np.ndarray) and entry.ndim > 0):
            raise ValueError(f"{name} must be one value or {num_envs}, got {entry!r} among them")
    return [without_axes(entry) for entry in value]


def _is_law(value: Any) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields")


# Seeds and actions ----------------------------------------------------------------------------------------------------


def checked_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Return the seed of each environment, from None, a whole number or ``num_envs`` of these."""
    if seed is None:
        return [None] * num_envs
    listed = isinstance(seed, Sequence) and not isinstance(seed, str | bytes | bytearray | memoryview)
    if listed or (isinstance(seed, np.ndarray) and seed.ndim > 0):
        if len(seed) != num_envs:
            raise ValueError(f"seed must hold {num_envs} seeds, one per environment, got {len(seed)}")
        return [None if single is None else _checked_seed(single) for single in seed]
    first = _checked_seed(seed)
    return [first + i for i in range(num_envs)]


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer):
        raise TypeError(f"seed must be None, a whole number or a sequence of these, got {brief_repr(seed)}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {brief_repr(seed)}")
    return int(seed)


def real_array(expected: str, values: Any) -> NDArray[Any]:
    """Return real numbers as an array, float32 or float64.

    Raises:
        TypeError, ValueError: if they form no array, are text, complex numbers or times, or exceed the largest float;
            the message begins with ``expected``.
    """
    try:
        array = np.asarray(values)
    except (RuntimeError, TypeError, ValueError) as error:  # RuntimeError: a tensor that requires a gradient
        raise TypeError(f"{expected}, got {brief_repr(values)} ({error})") from None
    if array.dtype in (np.float32, np.float64):
        return array
    objects = array.dtype == object and all(isinstance(value, numbers.Real) for value in array.flat)
    if array.dtype.kind not in "biuf" and not objects:
        raise TypeError(f"{expected}, got {brief_repr(values)} of type {array.dtype}")
    try:
        with np.errstate(over="ignore"):  # a long double may become infinite; callers refuse infinity
            return array.astype(np.float64)
    except OverflowError:
        raise ValueError(f"{expected}, got {brief_repr(values)}") from None


def clipped_action(action: Any) -> float:
    """Return an action, any array or sequence of one finite number, clipped to [-1, 1]."""
    expected = "action must be one finite number in an array of shape (1,)"
    array = real_array(expected, action)
    if array.shape != (1,):
        raise ValueError(f"{expected}, got shape {array.shape}: {brief_repr(action)}")
    if not np.isfinite(array[0]):
        raise ValueError(f"{expected}; outside [-1, 1] it is clipped; got {brief_repr(action)}")
    return float(min(max(array[0], -1.0), 1.0))
