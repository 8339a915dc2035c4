"""Hyperparameters as data: one table of what each may be, and RL Zoo's files read without running what is in them.

RL Zoo evaluates some strings of its files as Python; here the same strings are parsed.
"""

import ast
import copy
import itertools
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sd_friction_env.environments.wrappers import LARGEST_POWER, LARGEST_SCALE, SMALLEST_POWER, SMALLEST_SCALE
from sd_friction_env.physics.parameters import brief_repr, checked_choice, checked_number
from sd_friction_env.storage import HYPERPARAMETERS, StoredFileError, read_yaml

OFF_POLICY = ("sac", "td3", "tqc")
ALGORITHMS = ("ppo", *OFF_POLICY)
ACTIVATIONS = ("Tanh", "ReLU")  # names in torch.nn
NOISES = ("normal", "ornstein-uhlenbeck")
MOST_WEIGHTS = 2**25  # between the layers of a network: stored files are bounded
WRAPPER = "sd_friction_env.ScaledReward"
CALLBACK = "sd_friction_env.AnnealedExploration"

Check = Callable[[str, Any], Any]  # from a name and a value to the value as JSON has it; raises TypeError, ValueError


# Checks ---------------------------------------------------------------------------------------------------------------


def checked_whole(name: str, value: Any, low: int, high: int) -> int:
    """Return ``value`` as an int.

    Raises:
        TypeError, ValueError: if it is not a whole number in [low, high].
    """
    message = f"{name} must be a whole number in [{low}, {high}], got {brief_repr(value)}"
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(message)
    number: Any = value
    if not low <= number <= high or number != int(number):
        raise ValueError(message)
    return int(number)


def _number(low: float, high: float) -> Check:
    return lambda name, value: checked_number(name, value, low, high)


def _whole(low: int, high: int) -> Check:
    return lambda name, value: checked_whole(name, value, low, high)


def _one_of(*choices: str) -> Check:
    return lambda name, value: checked_choice(name, value, choices)


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be true or false, got {brief_repr(value)}")
    return value


def _scheduled(low: float, high: float) -> Check:
    """Return the check of a number or "lin_START"."""

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, str):
            return checked_number(name, value, low, high)
        kind, _, start = value.partition("_")
        if kind != "lin":
            raise ValueError(f'{name} must be a number or "lin_START" (falling linearly to 0), got {value!r}')
        checked_number(name, _float(start), low, high)
        return value

    return check


def _entropy(name: str, value: Any) -> Any:
    if not isinstance(value, str):
        return checked_number(name, value, 0.0, 1e6)
    kind, _, start = value.partition("_")
    if kind == "auto" and (not start or _float(start) > 0.0):
        return value
    raise ValueError(f'{name} must be a number in [0, 1e+06], "auto" or "auto_START" with START > 0, got {value!r}')


def _target_entropy(name: str, value: Any) -> Any:
    return value if value == "auto" else checked_number(name, value, -1e6, 1e6)


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _arguments(value: Any, class_name: str) -> list[Any]:
    """Return the arguments that each entry of an ``env_wrapper`` or ``callback`` gives a class; None: another class."""
    entries = value if isinstance(value, list) else [value]
    return [entry[class_name] if isinstance(entry, dict) and list(entry) == [class_name] else None for entry in entries]


def _wrapper(name: str, value: Any) -> Any:
    """Check that only rewards are wrapped: an agent must observe in training what its policy file is run on."""
    found = _arguments(value, WRAPPER)
    for arguments in found:
        if not isinstance(arguments, dict) or not {"scale"} <= set(arguments) <= {"scale", "power"} or len(found) > 1:
            raise ValueError(f"{name} must be one {WRAPPER} with its scale (and power), got {brief_repr(value)}")
        checked_number(f"{name}'s scale", arguments["scale"], SMALLEST_SCALE, LARGEST_SCALE)
        checked_number(f"{name}'s power", arguments.get("power", 1.0), SMALLEST_POWER, LARGEST_POWER)
    return value


def _callback(name: str, value: Any) -> Any:
    from sd_friction_env.environments.callbacks import AnnealedExploration

    found = _arguments(value, CALLBACK)
    for arguments in found:
        if not isinstance(arguments, dict) or not set(arguments) <= {"start", "end"} or len(found) > 1:
            raise ValueError(f"{name} must be one {CALLBACK} with its start and end, got {brief_repr(value)}")
        AnnealedExploration(**arguments)
    return value


def _warm_start(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping) or set(value) != set(_WARM_START):
        raise ValueError(f"{name} must have the entries {', '.join(_WARM_START)}, got {brief_repr(value)}")
    return {part: _WARM_START[part](f"{name}'s {part}", value[part]) for part in _WARM_START}


def reward_scaling(settings: Mapping[str, Any]) -> tuple[float, float]:
    """Return scale and power of the rewards in checked hyperparameters (see :class:`ScaledReward`)."""
    arguments = (_arguments(settings.get("env_wrapper", []), WRAPPER) or [{"scale": 1.0}])[0]
    return float(arguments["scale"]), float(arguments.get("power", 1.0))


def annealing(settings: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the arguments of :class:`AnnealedExploration` in checked hyperparameters; None if they have none."""
    found: list[dict[str, float]] = _arguments(settings.get("callback", []), CALLBACK)
    return found[0] if found else None


# The policy -----------------------------------------------------------------------------------------------------------


def parse_policy_kwargs(value: Any) -> dict[str, Any]:
    """Return RL Zoo's ``policy_kwargs``, such as "dict(net_arch=[64, 64], activation_fn=nn.Tanh)", as JSON values.

    The string is parsed and never executed: it may hold calls of ``dict``, literals and the names in ``ACTIVATIONS``.
    A mapping (as run folders store it) is checked in the same way.

    Raises:
        TypeError, ValueError: if it holds anything else.
    """
    if isinstance(value, str):
        try:
            value = _literal(ast.parse(value.strip(), mode="eval").body)
        except (SyntaxError, RecursionError, MemoryError):
            raise ValueError(f"policy_kwargs is not an expression: {brief_repr(value)}") from None
    if not isinstance(value, Mapping):
        raise ValueError(f"policy_kwargs must be dict(...), got {brief_repr(value)}")
    unknown = [name for name in value if name not in _POLICY]
    if unknown:
        raise ValueError(f"policy_kwargs has no {unknown[0]!r}; allowed: {', '.join(_POLICY)}")
    return {name: _POLICY[name](name, part) for name, part in value.items()}


def _net_arch(name: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        if not set(value) <= {"pi", "vf", "qf"}:
            raise ValueError(f"{name} must have parts pi, vf or qf, got {brief_repr(value)}")
        return {part: _net_arch(name, widths) for part, widths in value.items()}
    if not isinstance(value, list) or len(value) > 32:
        raise ValueError(f"{name} must be a list of at most 32 layer widths, got {brief_repr(value)}")
    widths = [checked_whole(f"a width in {name}", width, 1, 8192) for width in value]
    weights = sum(before * after for before, after in itertools.pairwise(widths))
    if weights > MOST_WEIGHTS:
        raise ValueError(f"{name} must have at most {MOST_WEIGHTS:,} weights between its layers, got {weights:,}")
    return widths


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords):
            if any(keyword.arg is None for keyword in keywords):
                raise ValueError("policy_kwargs may not hold **")
            return {keyword.arg: _literal(keyword.value) for keyword in keywords}
        case ast.Dict(keys=keys, values=values):
            if not all(isinstance(key, ast.Constant) and isinstance(key.value, str) for key in keys):
                raise ValueError("policy_kwargs may only have strings as keys")
            return {ast.literal_eval(key): _literal(part) for key, part in zip(keys, values, strict=True) if key}
        case ast.List(elts=elements):
            return [_literal(part) for part in elements]
        case ast.Attribute(value=ast.Name(id="nn"), attr=name):
            return checked_choice("activation_fn", name, ACTIVATIONS)
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        names = ", ".join(f"nn.{name}" for name in ACTIVATIONS)
        raise ValueError(f"policy_kwargs may hold literals and {names}; got {brief_repr(ast.unparse(node))}") from None


_POLICY: dict[str, Check] = {
    "net_arch": _net_arch,
    "activation_fn": _one_of(*ACTIVATIONS),
    "ortho_init": _flag,
    "log_std_init": _number(-20.0, 5.0),
    "n_critics": _whole(1, 100),
    "n_quantiles": _whole(1, 1000),
}


# The table ------------------------------------------------------------------------------------------------------------

_POSITIVE, _SHARE = _whole(1, 10**12), _number(0.0, 1.0)
_WARM_START: dict[str, Check] = {
    **dict.fromkeys(("n_envs", "n_steps", "samples", "batch_size"), _whole(2, 10**6)),
    **dict.fromkeys(("actor_steps", "critic_steps"), _whole(0, 10**9)),
    **dict.fromkeys(("noise", "scatter"), _number(0.0, 10.0)),
    "learning_rate": _SHARE,
}
# Who takes each hyperparameter, and its check. Those of the first block are this package's and RL Zoo's, the others are
# arguments of Stable-Baselines3's classes.
_SETTINGS: dict[str, tuple[Sequence[str], Check]] = {
    "callback": (("ppo",), _callback),
    "env_wrapper": (ALGORITHMS, _wrapper),
    "frame_stack": (ALGORITHMS, _whole(1, 1000)),
    "n_envs": (ALGORITHMS, _whole(1, 65536)),
    "n_timesteps": (ALGORITHMS, _POSITIVE),
    "noise_std": (OFF_POLICY, _number(0.0, 10.0)),
    "noise_type": (OFF_POLICY, _one_of(*NOISES)),
    "policy": (ALGORITHMS, _one_of("MlpPolicy")),
    "policy_kwargs": (ALGORITHMS, lambda _, value: parse_policy_kwargs(value)),
    "warm_start": (("ppo",), _warm_start),
    #
    "batch_size": (ALGORITHMS, _whole(2, 10**9)),
    "buffer_size": (OFF_POLICY, _POSITIVE),
    "clip_range": (("ppo",), _scheduled(1e-6, 1e6)),
    "clip_range_vf": (("ppo",), _scheduled(1e-6, 1e6)),
    "ent_coef": (("ppo", "sac", "tqc"), _entropy),
    "gae_lambda": (("ppo",), _SHARE),
    "gamma": (ALGORITHMS, _SHARE),
    "gradient_steps": (OFF_POLICY, _whole(-1, 10**9)),
    "learning_rate": (ALGORITHMS, _scheduled(0.0, 1.0)),
    "learning_starts": (OFF_POLICY, _whole(0, 10**12)),
    "max_grad_norm": (("ppo",), _number(0.0, 1e12)),
    "n_epochs": (("ppo",), _POSITIVE),
    "n_steps": (ALGORITHMS, _POSITIVE),
    "normalize_advantage": (("ppo",), _flag),
    "policy_delay": (("td3",), _POSITIVE),
    "target_entropy": (("sac", "tqc"), _target_entropy),
    "target_kl": (("ppo",), _number(1e-12, 1e6)),
    "target_noise_clip": (("td3",), _number(0.0, 1e6)),
    "target_policy_noise": (("td3",), _number(0.0, 1e6)),
    "target_update_interval": (("sac", "tqc"), _POSITIVE),
    "tau": (OFF_POLICY, _SHARE),
    "top_quantiles_to_drop_per_net": (("tqc",), _whole(0, 1000)),
    "train_freq": (OFF_POLICY, _POSITIVE),
    "vf_coef": (("ppo",), _number(0.0, 1e6)),
}
OURS = tuple(itertools.takewhile(lambda name: name != "batch_size", _SETTINGS))  # what no constructor takes
SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")


def allowed_hyperparameters(algorithm: str) -> tuple[str, ...]:
    """Return the names of an algorithm's hyperparameters."""
    return tuple(sorted(name for name, (algorithms, _) in _SETTINGS.items() if algorithm in algorithms))


def check_hyperparameter(name: str, value: Any, shown: str | None = None) -> Any:
    """Return the value of one hyperparameter as JSON has it; messages call it ``shown``.

    Raises:
        TypeError, ValueError: naming the hyperparameter, its value and what is allowed.
    """
    return _SETTINGS[name][1](shown or name, value)


def check_hyperparameters(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as JSON values (``policy_kwargs`` as a mapping), after checking every one.

    Raises:
        TypeError, ValueError: naming the hyperparameter, its value and what is allowed.
    """
    allowed = allowed_hyperparameters(algorithm)
    unknown = sorted(str(name) for name in settings if name not in allowed)
    if unknown:
        raise ValueError(f"{algorithm} has no hyperparameter {unknown[0]!r}; allowed: {', '.join(allowed)}")
    return {name: check_hyperparameter(name, value) for name, value in settings.items()}


def read_hyperparameters(
    algorithm: str, env_id: str, path: Path | None = None, *, warm: bool = False
) -> dict[str, Any]:
    """Return the checked hyperparameters of an environment from an RL Zoo file.

    Args:
        algorithm: one of ``ALGORITHMS``. env_id: a key of the file. path: of the file; None: the one shipped.
        warm: whether the one shipped is that of agents that start from a controller.

    Raises:
        ValueError: if the algorithm is unknown or cannot start from a controller, the file cannot be read or a value is
            not allowed, naming it.
    """
    checked_choice("algo", algorithm, ALGORITHMS)
    if warm and algorithm != "ppo":
        raise ValueError(f"start-from is for ppo, got {algorithm!r}")
    file = HYPERPARAMETERS / f"{algorithm}{'_warm_start' if warm else ''}.yml" if path is None else path
    try:
        content = read_yaml(file)
    except (OSError, StoredFileError) as error:
        raise ValueError(f"hyperparameters cannot be read from {str(file)!r}: {one_line(error)}") from None
    if not isinstance(content, dict) or not isinstance(content.get(env_id), dict):
        known = ", ".join(map(str, content)) if isinstance(content, dict) else "nothing"
        raise ValueError(f"{str(file)!r} has no hyperparameters for {env_id!r}; it has: {known}")
    try:
        return check_hyperparameters(algorithm, content[env_id])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{str(file)!r} has hyperparameters for {env_id} that cannot be used: {error}") from None


def zoo_settings(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return checked hyperparameters as RL Zoo's files have them: ``policy_kwargs`` as a string of Python."""
    settings = {"policy": "MlpPolicy", **copy.deepcopy(dict(hyperparameters))}
    if "policy_kwargs" in settings:
        parts = [
            f"{name}=nn.{value}" if name == "activation_fn" else f"{name}={value!r}"
            for name, value in settings["policy_kwargs"].items()
        ]
        settings["policy_kwargs"] = f"dict({', '.join(parts)})"
    return settings


def one_line(error: BaseException) -> str:
    """Return an error's message in one line."""
    return " ".join(str(error).split())
