"""Training with Stable-Baselines3: hyperparameters as data, and one folder per run (see :mod:`runs`)."""

import ast
import dataclasses
import inspect
import itertools
import json
import math
import numbers
import os
import platform
import random
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, unwrap_vec_wrapper
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import sd_friction_env
from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.environments.callbacks import AnnealedExploration
from sd_friction_env.environments.sb3 import SDFrictionVecEnv
from sd_friction_env.environments.wrappers import (
    LARGEST_POWER,
    LARGEST_SCALE,
    SMALLEST_POWER,
    SMALLEST_SCALE,
    scaled_reward,
)
from sd_friction_env.learning import evaluation, runs
from sd_friction_env.storage import HYPERPARAMETERS, StoredFileError, content_digest, read_yaml

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "ppo": stable_baselines3.PPO,
    "sac": stable_baselines3.SAC,
    "td3": stable_baselines3.TD3,
    "tqc": sb3_contrib.TQC,
}
ACTIVATIONS: dict[str, type[nn.Module]] = {"Tanh": nn.Tanh, "ReLU": nn.ReLU}

LARGEST_SEED, MOST_WEIGHTS = 2**32 - 1, 2**25
WRAPPER = "sd_friction_env.ScaledReward"
CALLBACK = "sd_friction_env.AnnealedExploration"
_CHECKPOINT_FORMAT = 2


# Hyperparameters ------------------------------------------------------------------------------------------------------
#
# RL Zoo evaluates some strings of its files as Python. We read the same strings without ever running them.


@dataclass(frozen=True)
class _Number:
    low: float
    high: float
    whole: bool = False

    def check(self, name: str, value: Any) -> float | int:
        kind = "whole number" if self.whole else "number"
        low, high = (f"{end:.0f}" if self.whole else f"{end:g}" for end in (self.low, self.high))
        said = f"{name} must be a {kind} in [{low}, {high}], got {_shown(value)}"
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise TypeError(said)
        try:
            number = float(value)
        except OverflowError:
            raise ValueError(said) from None
        if not self.low <= number <= self.high or (self.whole and number != int(number)):
            raise ValueError(said)
        return int(number) if self.whole else number


def _shown(value: Any) -> str:
    """Return a value for a message, cut short where it is long."""
    if isinstance(value, int) and abs(value) >= 10**100:
        return f"a whole number of {value.bit_length()} bits"
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


_POSITIVE = _Number(1, 10**12, whole=True)
_SHARE = _Number(0.0, 1.0)
_NUMBERS: dict[str, _Number] = {
    # ours and RL Zoo's
    "n_envs": _Number(1, 65536, whole=True),
    "n_timesteps": _POSITIVE,
    "frame_stack": _Number(1, 1000, whole=True),
    "noise_std": _Number(0.0, 10.0),
    # Stable-Baselines3's
    "batch_size": _Number(2, 10**9, whole=True),
    "buffer_size": _POSITIVE,
    "clip_range": _Number(1e-6, 1e6),
    "clip_range_vf": _Number(1e-6, 1e6),
    "ent_coef": _Number(0.0, 1e6),
    "gae_lambda": _SHARE,
    "gamma": _SHARE,
    "gradient_steps": _Number(-1, 10**9, whole=True),
    "learning_rate": _Number(0.0, 1.0),
    "learning_starts": _Number(0, 10**12, whole=True),
    "max_grad_norm": _Number(0.0, 1e12),
    "n_epochs": _POSITIVE,
    "n_steps": _POSITIVE,
    "policy_delay": _POSITIVE,
    "target_entropy": _Number(-1e6, 1e6),
    "target_kl": _Number(1e-12, 1e6),
    "target_noise_clip": _Number(0.0, 1e6),
    "target_policy_noise": _Number(0.0, 1e6),
    "target_update_interval": _POSITIVE,
    "tau": _SHARE,
    "top_quantiles_to_drop_per_net": _Number(0, 1000, whole=True),
    "train_freq": _POSITIVE,
    "vf_coef": _Number(0.0, 1e6),
}
_SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf")
_FLAGS = ("normalize_advantage",)
_OURS = (
    "n_envs",
    "n_timesteps",
    "frame_stack",
    "env_wrapper",
    "callback",
    "policy",
    "policy_kwargs",
    "noise_type",
    "noise_std",
)
_NOISES = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
_POLICY_NUMBERS = {
    "log_std_init": _Number(-20.0, 5.0),
    "n_critics": _Number(1, 100, whole=True),
    "n_quantiles": _Number(1, 1000, whole=True),
}
_WIDTH = _Number(1, 8192, whole=True)


def allowed_hyperparameters(algorithm: str) -> tuple[str, ...]:
    """Return the names that hyperparameters of an algorithm may have."""
    taken = set(inspect.signature(ALGORITHMS[algorithm]).parameters)
    names = {*_NUMBERS, *_FLAGS} & taken
    others = {"callback"} if "action_noise" in taken else {"noise_type", "noise_std"}  # what only the others take
    return tuple(sorted(names | set(_OURS) - others))


def read_hyperparameters(algorithm: str, env_id: str, path: Path | None = None) -> dict[str, Any]:
    """Return the checked hyperparameters of an environment from an RL Zoo file.

    Args:
        algorithm: one of ``ALGORITHMS``. env_id: a key of the file. path: of the file; None: the one shipped.

    Raises:
        ValueError: if the algorithm is unknown, the file cannot be read or a value is not allowed, naming it.
    """
    if algorithm not in ALGORITHMS:
        raise ValueError(f"algo must be one of {', '.join(ALGORITHMS)}, got {algorithm!r}")
    file = HYPERPARAMETERS / f"{algorithm}.yml" if path is None else path
    try:
        content = read_yaml(file)
    except (OSError, StoredFileError) as error:
        raise ValueError(f"hyperparameters cannot be read from {str(file)!r}: {_one_line(error)}") from None
    if not isinstance(content, dict) or not isinstance(content.get(env_id), dict):
        known = ", ".join(map(str, content)) if isinstance(content, dict) else "nothing"
        raise ValueError(f"{str(file)!r} has no hyperparameters for {env_id!r}; it has: {known}")
    try:
        return check_hyperparameters(algorithm, content[env_id])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{str(file)!r} has hyperparameters for {env_id} that cannot be used: {error}") from None


def check_hyperparameters(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as JSON values (``policy_kwargs`` as a mapping), after checking every one.

    Raises:
        TypeError, ValueError: naming the hyperparameter, its value and what is allowed.
    """
    allowed = allowed_hyperparameters(algorithm)
    unknown = sorted(str(name) for name in settings if name not in allowed)
    if unknown:
        raise ValueError(f"{algorithm} has no hyperparameter {unknown[0]!r}; allowed: {', '.join(allowed)}")
    return {str(name): _checked_hyperparameter(name, value) for name, value in settings.items()}


def _checked_hyperparameter(name: str, value: Any) -> Any:
    if name == "policy":
        return _checked_one_of(name, value, ("MlpPolicy",))
    if name == "noise_type":
        return _checked_one_of(name, value, tuple(_NOISES))
    if name == "policy_kwargs":
        return parse_policy_kwargs(value)
    if name == "env_wrapper":
        return _checked_wrapper(value)
    if name == "callback":
        return _checked_callback(value)
    if name in _FLAGS:
        if not isinstance(value, bool):
            raise TypeError(f"{name} must be true or false, got {value!r}")
        return value
    if name == "ent_coef" and isinstance(value, str):
        kind, _, start = value.partition("_")
        if kind == "auto" and (not start or _float(start) > 0.0):
            return value
        raise ValueError(
            f'ent_coef must be a number in [0, 1e+06], "auto" or "auto_START" with START > 0, got {value!r}'
        )
    if name == "target_entropy" and value == "auto":
        return value
    if name in _SCHEDULED and isinstance(value, str):
        kind, _, start = value.partition("_")
        if kind != "lin":
            raise ValueError(f'{name} must be a number or "lin_START" (falling linearly to 0), got {value!r}')
        _NUMBERS[name].check(name, _float(start))
        return value
    return _NUMBERS[name].check(name, value)


def _checked_one_of(name: str, value: Any, choices: Sequence[str]) -> str:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    return str(value)


def _checked_wrapper(value: Any) -> Any:
    """Only rewards may be wrapped: what an agent observes must be what its policy file is run on."""
    entries = value if isinstance(value, list) else [value]
    for entry in entries:
        arguments = entry.get(WRAPPER) if isinstance(entry, dict) and list(entry) == [WRAPPER] else None
        if not isinstance(arguments, dict) or not {"scale"} <= set(arguments) <= {"scale", "power"} or len(entries) > 1:
            raise ValueError(f"env_wrapper must be one {WRAPPER} with its scale (and power), got {value!r}")
        _Number(SMALLEST_SCALE, LARGEST_SCALE).check("env_wrapper's scale", arguments["scale"])
        _Number(SMALLEST_POWER, LARGEST_POWER).check("env_wrapper's power", arguments.get("power", 1.0))
    return value


def _checked_callback(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    for entry in entries:
        arguments = entry.get(CALLBACK) if isinstance(entry, dict) and list(entry) == [CALLBACK] else None
        if not isinstance(arguments, dict) or not set(arguments) <= {"start", "end"} or len(entries) > 1:
            raise ValueError(f"callback must be one {CALLBACK} with its start and end, got {value!r}")
        AnnealedExploration(**arguments)
    return value


def make_callbacks(settings: Mapping[str, Any]) -> list[BaseCallback]:
    """Return the callbacks that hyperparameters ask for."""
    value = settings.get("callback", [])
    entries = value if isinstance(value, list) else [value]
    return [AnnealedExploration(**entry[CALLBACK]) for entry in entries]


def reward_scaling(settings: Mapping[str, Any]) -> tuple[float, float]:
    """Return scale and power of the rewards that hyperparameters ask for (see :class:`ScaledReward`)."""
    value = settings.get("env_wrapper", [])
    entries = value if isinstance(value, list) else [value]
    arguments = entries[0][WRAPPER] if entries else {"scale": 1.0}
    return float(arguments["scale"]), float(arguments.get("power", 1.0))


def parse_policy_kwargs(value: Any) -> dict[str, Any]:
    """Return RL Zoo's ``policy_kwargs``, such as "dict(net_arch=[64, 64], activation_fn=nn.Tanh)", as JSON values.

    The string is parsed, never run: calls of ``dict``, literals and the activations in ``ACTIVATIONS`` are understood.
    A mapping (as :mod:`runs` stores it) is checked likewise.

    Raises:
        ValueError: if there is anything else in it.
    """
    if isinstance(value, str):
        try:
            value = _literal(ast.parse(value.strip(), mode="eval").body)
        except (SyntaxError, RecursionError, MemoryError):
            raise ValueError(f"policy_kwargs is not an expression: {_shown(value)}") from None
    if not isinstance(value, Mapping):
        raise ValueError(f"policy_kwargs must be dict(...), got {_shown(value)}")
    checked: dict[str, Any] = {}
    for name, part in value.items():
        if name == "activation_fn":
            checked[name] = _checked_one_of(name, part, tuple(ACTIVATIONS))
        elif name == "net_arch":
            checked[name] = _checked_net_arch(part)
        elif name == "ortho_init":
            if not isinstance(part, bool):
                raise ValueError(f"ortho_init must be True or False, got {part!r}")
            checked[name] = part
        elif name in _POLICY_NUMBERS:
            checked[name] = _POLICY_NUMBERS[name].check(name, part)
        else:
            names = ", ".join(["net_arch", "activation_fn", "ortho_init", *_POLICY_NUMBERS])
            raise ValueError(f"policy_kwargs has no {name!r}; allowed: {names}")
    return checked


def _checked_net_arch(value: Any) -> Any:
    if isinstance(value, Mapping):
        if not set(value) <= {"pi", "vf", "qf"}:
            raise ValueError(f"net_arch must have parts pi, vf or qf, got {value!r}")
        return {name: _checked_net_arch(part) for name, part in value.items()}
    if not isinstance(value, list) or len(value) > 32:
        raise ValueError(f"net_arch must be a list of at most 32 layer widths, got {_shown(value)}")
    widths = [int(_WIDTH.check("a width in net_arch", width)) for width in value]
    weights = sum(before * after for before, after in itertools.pairwise(widths))
    if weights > MOST_WEIGHTS:  # what is trained must be read again, and files are bounded
        raise ValueError(f"net_arch must have at most {MOST_WEIGHTS:,} weights between its layers, got {weights:,}")
    return widths


def _literal(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict" and not node.args:
        return {_keyword(keyword): _literal(keyword.value) for keyword in node.keywords}
    if isinstance(node, ast.Dict):
        return {_key(key): _literal(part) for key, part in zip(node.keys, node.values, strict=True)}
    if isinstance(node, ast.List):
        return [_literal(part) for part in node.elts]
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "nn":
        return _checked_one_of("activation_fn", node.attr, tuple(ACTIVATIONS))
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        raise ValueError(
            f"policy_kwargs may hold literals and nn.{', nn.'.join(ACTIVATIONS)}; got {_shown(ast.unparse(node))}"
        ) from None


def _keyword(keyword: ast.keyword) -> str:
    if keyword.arg is None:
        raise ValueError("policy_kwargs may not hold **")
    return keyword.arg


def _key(node: ast.expr | None) -> str:
    if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
        raise ValueError("policy_kwargs may only have strings as keys")
    return node.value


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _policy_arguments(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return checked policy keyword arguments as Stable-Baselines3 takes them."""
    arguments = dict(policy_kwargs)
    if "activation_fn" in arguments:
        arguments["activation_fn"] = ACTIVATIONS[arguments["activation_fn"]]
    return arguments


def build_policy(
    algorithm: str, observation_space: spaces.Box, action_space: spaces.Box, policy_kwargs: Mapping[str, Any]
) -> BasePolicy:
    """Return an untrained policy of Stable-Baselines3.

    Args:
        policy_kwargs: JSON values, as :func:`parse_policy_kwargs` returns them.

    Raises:
        TypeError, ValueError: if they are not.
    """
    policy_class = ALGORITHMS[algorithm].policy_aliases["MlpPolicy"]
    arguments = _policy_arguments(parse_policy_kwargs(policy_kwargs))
    return policy_class(observation_space, action_space, lambda _: 0.0, **arguments)


# The plan -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All that decides what a run gives.

    Attributes:
        env_id, env_kwargs: of the environment (JSON values).
        algorithm: one of ``ALGORITHMS``.
        hyperparameters: checked; ``n_envs`` and ``n_timesteps`` among them.
        seed: of everything random, in [0, 2**32 - 1].
        eval_freq: environment steps between two evaluations.
        eval_episodes: episodes of each, from ``evaluation.VALIDATION_SEEDS``.
        device: as torch names it. threads: of torch.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    algorithm: str
    hyperparameters: Mapping[str, Any]
    seed: int
    eval_freq: int
    eval_episodes: int
    device: str
    threads: int

    @property
    def steps(self) -> int:
        """Environment steps to train for (at least)."""
        return int(self.hyperparameters["n_timesteps"])


def make_plan(
    env_id: str,
    algorithm: str,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    hyperparameter_file: Path | None = None,
    timesteps: int | None = None,
    envs: int | None = None,
    seed: int = 0,
    eval_freq: int | None = None,
    eval_episodes: int = 50,
    device: str = "cpu",
    threads: int = 1,
) -> Plan:
    """Return a checked plan; nothing is written.

    Args:
        overrides: hyperparameters that replace those of the file.
        timesteps, envs: replace ``n_timesteps`` and ``n_envs``.
        eval_freq: None: a twentieth of the steps.
        The others as :class:`Plan` has them.

    Raises:
        TypeError, ValueError: naming the argument, its value and what is allowed.
    """
    if env_id not in ENVIRONMENT_IDS:
        raise ValueError(f"env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {env_id!r}")
    settings = read_hyperparameters(algorithm, env_id, hyperparameter_file)
    settings |= check_hyperparameters(algorithm, dict(overrides or {}))
    if timesteps is not None:
        settings["n_timesteps"] = _NUMBERS["n_timesteps"].check("timesteps", timesteps)
    if envs is not None:
        settings["n_envs"] = _NUMBERS["n_envs"].check("envs", envs)
    return _checked_plan(env_id, algorithm, settings, env_kwargs or {}, seed, eval_freq, eval_episodes, device, threads)


def plan_of(config: Mapping[str, Any]) -> Plan:
    """Return the plan of a run's config.json.

    Raises:
        runs.RunFolderError: if there is none in it.
    """
    try:
        environment, chosen = config["environment"], config["evaluation"]
        algorithm = _checked_one_of("algorithm", config["algorithm"], tuple(ALGORITHMS))
        return _checked_plan(
            _checked_one_of("environment", environment["id"], ENVIRONMENT_IDS),
            algorithm,
            check_hyperparameters(algorithm, config["hyperparameters"]),
            environment["kwargs"],
            config["seed"],
            chosen["freq"],
            chosen["episodes"],
            config["device"],
            config["threads"],
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise runs.RunFolderError(f"the run's {runs.CONFIG} cannot be used: {_one_line(error)}") from None


def _checked_plan(
    env_id: str,
    algorithm: str,
    settings: dict[str, Any],
    env_kwargs: Mapping[str, Any],
    seed: int,
    eval_freq: int | None,
    eval_episodes: int,
    device: str,
    threads: int,
) -> Plan:
    """Return a plan of hyperparameters that are checked one by one already."""
    settings.setdefault("n_envs", 1)
    if "n_timesteps" not in settings:
        raise ValueError("n_timesteps is given neither in the hyperparameters nor by timesteps")
    if "noise_std" in settings and "noise_type" not in settings:
        raise ValueError(f"noise_std needs a noise_type beside it: {', '.join(_NOISES)}")
    if algorithm == "ppo":
        rollout = settings["n_envs"] * settings.get("n_steps", 2048)
        # A batch larger than what there is to learn from, or one that does not divide it, leaves crumbs.
        settings["batch_size"] = math.gcd(rollout, settings.get("batch_size", 64))
        if settings["batch_size"] < 2:
            settings["batch_size"] = rollout
        if rollout < 2:
            raise ValueError(f"n_envs x n_steps must be at least 2, got {rollout}")
    try:
        kwargs = json.loads(json.dumps(dict(env_kwargs), allow_nan=False))
    except (TypeError, ValueError):
        raise ValueError(f"environment arguments must be plain finite values, got {env_kwargs!r}") from None
    try:
        evaluation.make_env(env_id, kwargs).close()  # the environment itself knows what it takes
    except (TypeError, ValueError) as error:
        reason = str(error).partition(" was raised from")[0]  # which Gymnasium adds
        raise ValueError(f"the environment refuses its arguments: {reason}") from None
    if device not in ("cpu", "auto") and not (device.partition(":")[0] == "cuda" and torch.cuda.is_available()):
        cuda = ", cuda" if torch.cuda.is_available() else " (no CUDA device is there)"
        raise ValueError(f"device must be one of cpu, auto{cuda}, got {device!r}")
    most = len(evaluation.VALIDATION_SEEDS)
    if eval_freq is None:
        eval_freq = max(1, settings["n_timesteps"] // 20)
    return Plan(
        env_id=env_id,
        env_kwargs=kwargs,
        algorithm=algorithm,
        hyperparameters=settings,
        seed=int(_Number(0, LARGEST_SEED, whole=True).check("seed", seed)),
        eval_freq=checked_freq("eval-freq", eval_freq),
        eval_episodes=int(_Number(1, most, whole=True).check("eval-episodes", eval_episodes)),
        device=device,
        threads=int(_Number(1, 1024, whole=True).check("threads", threads)),
    )


def checked_freq(name: str, value: Any) -> int:
    """Return a number of environment steps between two events.

    Raises:
        TypeError, ValueError: if it is no whole number in [1, 1e12].
    """
    return int(_POSITIVE.check(name, value))


def validation_seeds(plan: Plan) -> range:
    """Return the seeds of the episodes by which a run chooses its best model."""
    return evaluation.VALIDATION_SEEDS[: plan.eval_episodes]


def training_seed(seed: int, index: int = 0) -> int:
    """Return the seed of a run's environment: at least 2**32, where no evaluation seed is, and in no other run."""
    return (1 + seed) * 2**32 + index


# Environments ---------------------------------------------------------------------------------------------------------


class _ScaledRewards(VecEnvWrapper):
    def __init__(self, envs: VecEnv, scale: float, power: float) -> None:
        super().__init__(envs)
        self.scale, self.power = scale, power

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, scaled_reward(rewards, self.scale, self.power).astype(np.float32), dones, infos


def make_training_envs(
    env_id: str,
    env_kwargs: Mapping[str, Any],
    n_envs: int,
    seed: int,
    *,
    frame_stack: int = 1,
    scaling: tuple[float, float] = (1.0, 1.0),
) -> VecEnv:
    """Return seeded environments to train on, a native batch: rewards scaled, observations stacked.

    Args:
        seed: of the run; environment i is reset with ``training_seed(seed, i)``.
        frame_stack: observations seen at once. scaling: scale and power of the rewards that the algorithm sees.

    The first episodes are cut short, each by another share, so that the environments do not all start over at the same
    moment ever after: every batch then holds squealing, settling and settled motion in their due shares.
    """

    envs: VecEnv = SDFrictionVecEnv(env_id, n_envs, stagger=True, **env_kwargs)
    if scaling != (1.0, 1.0):
        envs = _ScaledRewards(envs, *scaling)
    if frame_stack > 1:
        envs = VecFrameStack(envs, frame_stack)
    envs.seed(training_seed(seed))
    return envs


# The agent ------------------------------------------------------------------------------------------------------------


def make_model(plan: Plan, envs: VecEnv) -> BaseAlgorithm:
    """Return the untrained model of a plan."""
    ours = set(_OURS)
    arguments = {name: value for name, value in plan.hyperparameters.items() if name not in ours}
    for name in _SCHEDULED:
        if isinstance(arguments.get(name), str):
            arguments[name] = LinearSchedule(float(arguments[name].partition("_")[2]), 0.0, 1.0)
    noise = plan.hyperparameters.get("noise_type")
    if noise is not None:
        std = plan.hyperparameters.get("noise_std", 0.1)
        one: ActionNoise = _NOISES[noise](mean=np.zeros(1), sigma=np.full(1, std))
        arguments["action_noise"] = VectorizedActionNoise(one, envs.num_envs) if envs.num_envs > 1 else one
    model = ALGORITHMS[plan.algorithm](
        "MlpPolicy",
        envs,
        policy_kwargs=_policy_arguments(plan.hyperparameters.get("policy_kwargs", {})),
        seed=plan.seed,
        device=plan.device,
        **arguments,
    )
    envs.seed(training_seed(plan.seed))  # the constructor has seeded them its own way
    return model


def network_policy(policy: BasePolicy, frames: int = 1, metadata: Mapping[str, Any] | None = None) -> NetworkPolicy:
    """Return the deterministic actor of a policy as one in plain NumPy.

    Args:
        policy: of PPO, SAC, TD3 or TQC, with a plain multilayer perceptron.
        frames: observations it sees at once. metadata: JSON values to go with it.

    Raises:
        TypeError: if the actor is something else.
    """
    agent: Any = policy  # torch.nn.Module hides the types of its attributes
    if hasattr(agent, "mlp_extractor"):  # PPO: no squashing, the action is clipped
        modules, output = [*agent.mlp_extractor.policy_net, agent.action_net], "clip"
    elif hasattr(agent.actor, "latent_pi"):  # SAC, TQC
        modules, output = [*agent.actor.latent_pi, agent.actor.mu], "tanh"
    else:  # TD3: its own last module is the tanh
        *modules, last = agent.actor.mu
        if not isinstance(last, nn.Tanh):
            raise TypeError(f"the actor must end in tanh, not {last!r}")
        output = "tanh"
    linear, between = modules[::2], modules[1::2]
    names = {name for name, kind in ACTIVATIONS.items() if any(type(module) is kind for module in between)}
    known = all(type(module) in ACTIVATIONS.values() for module in between) and len(names) <= 1
    if not known or not all(type(module) is nn.Linear for module in linear):
        raise TypeError(f"the actor must be linear layers with one activation between them, got {modules!r}")
    layers = tuple(
        (module.weight.detach().cpu().numpy().T.astype(float), module.bias.detach().cpu().numpy().astype(float))
        for module in linear
    )
    return NetworkPolicy(layers, names.pop() if names else "Tanh", output, frames, dict(metadata or {}))


# Checkpoints ----------------------------------------------------------------------------------------------------------
#
# They are taken between rollouts, where there is least to keep: PPO's last rollout has been learnt from, and nobody is
# within a step. What they hold is tensors and plain values, so nothing is executed on loading.


def _random_states(model: BaseAlgorithm) -> dict[str, Any]:
    numpy_state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002  Stable-Baselines3 draws from it
    inner = numpy_state["state"]
    return {
        "python": random.getstate(),
        "numpy": {
            **numpy_state,
            "state": {"key": torch.from_numpy(inner["key"].astype(np.int64)), "pos": inner["pos"]},
        },
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _restore_random_states(model: BaseAlgorithm, saved: Mapping[str, Any]) -> None:
    inner = saved["numpy"]["state"]
    model.action_space.np_random.bit_generator.state = saved["actions"]
    if model.device.type == "cuda":
        torch.cuda.set_rng_state_all(saved["cuda"])
    torch.set_rng_state(saved["torch"])
    np.random.set_state(  # noqa: NPY002
        {**saved["numpy"], "state": {"key": inner["key"].numpy().astype(np.uint32), "pos": inner["pos"]}}
    )
    random.setstate(saved["python"])


def _environment_arrays(envs: VecEnv) -> dict[str, NDArray[Any]]:
    """Return the very arrays that hold the state of :func:`make_training_envs`, statistics and random keys included."""
    base = envs.unwrapped
    assert isinstance(base, SDFrictionVecEnv)
    arrays = base.envs.arrays()
    stack = unwrap_vec_wrapper(envs, VecFrameStack)
    if isinstance(stack, VecFrameStack):
        arrays["stacked observations"] = stack.stacked_obs.stacked_obs
    return arrays


def _replay_arrays(buffer: ReplayBuffer, filled: int) -> dict[str, NDArray[Any]]:
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    return {name: getattr(buffer, name)[:filled] for name in names}


def _noise_arrays(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """Return what noises of actions remember, the arrays themselves."""
    noise: Any = getattr(model, "action_noise", None)
    parts = enumerate(getattr(noise, "noises", [noise]))
    return {str(i): part.noise_prev for i, part in parts if isinstance(part, OrnsteinUhlenbeckActionNoise)}


def _tensors(arrays: Mapping[str, NDArray[Any]]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _fill(arrays: Mapping[str, NDArray[Any]], saved: Mapping[str, torch.Tensor]) -> None:
    """Put saved values into arrays, which must be of the same names, shapes and types."""
    if set(arrays) != set(saved):
        raise ValueError(f"arrays {sorted(set(arrays) ^ set(saved))} are missing or unknown")
    for name, array in arrays.items():
        values = saved[name].numpy()
        if values.shape != array.shape or values.dtype != array.dtype:
            raise ValueError(f"{name} is {values.dtype} {values.shape}, not {array.dtype} {array.shape}")
        array[...] = values


_COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")


def _model_state(model: BaseAlgorithm, *, at_end: bool) -> dict[str, Any]:
    """Return all that the rest of a run depends on, as tensors (not copied) and plain values.

    Args:
        at_end: whether training is over, and nothing will be sampled from a replay buffer any more.
    """
    agent: Any = model
    assert agent.env is not None
    buffer = None if at_end else getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.buffer_size if buffer.full else buffer.pos
        buffer = {"pos": buffer.pos, "full": buffer.full, "arrays": _tensors(_replay_arrays(buffer, filled))}
    return {
        "parameters": model.get_parameters(),
        "variables": {name: recursive_getattr(model, name).detach() for name in agent._get_torch_save_params()[1]},
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "episodes": list(agent.ep_info_buffer),
        "environments": _tensors(_environment_arrays(agent.env)),
        "seen": _tensors({"observations": agent._last_obs, "starts": agent._last_episode_starts}),
        "noises": _tensors(_noise_arrays(model)),
        "replay": buffer,
        "random": _random_states(model),
    }


def _restore_model(model: BaseAlgorithm, saved: Mapping[str, Any], steps: int) -> None:
    """Put an untrained model and its environments where :func:`_model_state` saw them.

    Args:
        steps: that the run is to do in all.

    The noises of actions are reset when learning starts: they are to be filled again then.
    """
    agent: Any = model
    model.set_parameters(saved["parameters"])
    for name in agent._get_torch_save_params()[1]:
        part = recursive_getattr(model, name)
        recursive_setattr(model, f"{name}.data", saved["variables"][name].to(part.device).reshape(part.shape))
    for name in _COUNTERS:
        setattr(model, name, type(getattr(model, name))(saved["counters"][name]))
    agent.ep_info_buffer = deque(saved["episodes"], maxlen=agent._stats_window_size)
    agent.ep_success_buffer = deque(maxlen=agent._stats_window_size)  # our episodes tell no success
    agent._last_obs = agent.env.reset()
    agent._last_episode_starts = np.ones(agent.env.num_envs, np.bool_)
    _fill(_environment_arrays(agent.env), saved["environments"])
    _fill({"observations": agent._last_obs, "starts": agent._last_episode_starts}, saved["seen"])
    _fill(_noise_arrays(model), saved["noises"])
    buffer, kept = getattr(model, "replay_buffer", None), saved["replay"]
    if buffer is not None and model.num_timesteps < steps:
        buffer.pos, buffer.full = int(kept["pos"]), bool(kept["full"])
        if not 0 <= buffer.pos < buffer.buffer_size:
            raise ValueError(f"the replay buffer cannot go on at {buffer.pos}")
        _fill(_replay_arrays(buffer, buffer.buffer_size if buffer.full else buffer.pos), kept["arrays"])
    _restore_random_states(model, saved["random"])


# Training -------------------------------------------------------------------------------------------------------------


class StoppedError(Exception):
    """Training was asked to stop before its end.

    Attributes:
        steps: done so far. checkpoint: the file with the latest weights.
    """

    def __init__(self, steps: int, checkpoint: Path) -> None:
        super().__init__(f"stopped after {steps:,} steps; the last checkpoint is {str(checkpoint)!r}")
        self.steps = steps
        self.checkpoint = checkpoint


@dataclass(frozen=True)
class Result:
    """What a finished run came to.

    Attributes:
        folder: of the run. policy: the best model's actor. steps: done in all. seconds: wall time of training.
        best: the row of evaluations.csv that the best model gave. evaluations: all rows.
    """

    folder: Path
    policy: NetworkPolicy
    steps: int
    seconds: float
    best: Mapping[str, Any]
    evaluations: Table


def log_episodes(infos: Sequence[Mapping[str, Any]], dones: NDArray[np.bool_], logger: Logger) -> None:
    """Log what the episodes that have just ended came to."""
    for i in np.flatnonzero(dones).tolist():
        for name, value in infos[i]["statistics"].items():
            if name not in ("return", "length") and not math.isnan(value):  # SB3 logs these two itself
                logger.record_mean(f"episode/{name}", value)


class _TensorBoard(TensorBoardOutputFormat):
    """Event files; those of a resumed run tell readers to forget what was logged after its checkpoint."""

    def __init__(self, folder: Path, resumed_at: int | None) -> None:
        # Readers take the files in the order of their names, which begin with the second they were made in.
        seconds = [name.split(".")[3] for name in os.listdir(folder)] if folder.is_dir() else []
        last = max((int(second) for second in seconds if second.isdecimal()), default=0)
        time.sleep(min(max(0.0, last + 1.0 - time.time()), 1.0))
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=None if resumed_at is None else resumed_at + 1)
        self._is_closed = False


class _Supervisor(BaseCallback):
    """Watches a run: statistics, evaluation, the best model, checkpoints, progress, and the wish to stop."""

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        progress: bool,
        should_stop: Callable[[], bool],
        on_evaluation: Callable[[Mapping[str, Any]], None],
        checkpoint_freq: int,
    ) -> None:
        super().__init__()
        self.plan = plan
        self.folder = folder
        self.should_stop = should_stop
        self.on_evaluation = on_evaluation
        self.checkpoint_freq = checkpoint_freq
        self.stopped = False
        self.rows: list[dict[str, Any]] = []
        self.best: dict[str, Any] = {}
        self.best_weights: dict[str, torch.Tensor] = {}
        self.next_evaluation = self.next_checkpoint = 0
        self.seeds = validation_seeds(plan)
        self.seconds = 0.0  # of training in processes before this one
        self.noises: Mapping[str, torch.Tensor] = {}  # to go on with
        self.checkpoint: Path | None = None  # the last one that is whole
        self.started = time.perf_counter()
        self.bar = tqdm(
            total=plan.steps,
            desc=f"{plan.algorithm} {plan.env_id}",
            unit=" steps",
            unit_scale=True,
            disable=not progress,
            dynamic_ncols=True,
            mininterval=0.5,
        )

    def restore(
        self, checkpoint: Path, saved: Mapping[str, Any], noises: Mapping[str, torch.Tensor], logger: Logger
    ) -> None:
        """Go on from what a checkpoint holds, and make the folder's tables and best model those of that moment.

        Args:
            checkpoint: its file. saved: as :meth:`own_state` returned it. noises: as :func:`_model_state` has them.
        """
        self.checkpoint = checkpoint
        self.rows, self.best, self.best_weights = saved["rows"], saved["best"], saved["best_weights"]
        self.seconds, self.noises = saved["seconds"], noises
        for name, (value, count, excluded) in saved["logged"].items():
            logger.name_to_value[name], logger.name_to_excluded[name] = value, tuple(excluded)
            if count:
                logger.name_to_count[name] = count
        if self.rows:
            self.table().to_csv(self.folder / runs.EVALUATIONS)
            runs.save_tensors(self.folder / runs.WEIGHTS, self.best_weights)
        else:
            for name in (runs.EVALUATIONS, runs.WEIGHTS):
                (self.folder / name).unlink(missing_ok=True)

    def own_state(self) -> dict[str, Any]:
        """Return what is here, as tensors and plain values."""
        values, counts, excluded = self.logger.name_to_value, self.logger.name_to_count, self.logger.name_to_excluded
        return {
            "rows": self.rows,
            "best": self.best,
            "best_weights": self.best_weights,
            "seconds": time.perf_counter() - self.started,
            "logged": {name: (float(value), counts.get(name, 0), excluded[name]) for name, value in values.items()},
        }

    def _on_training_start(self) -> None:
        self.started = time.perf_counter() - self.seconds
        (self.folder / runs.CHECKPOINTS).mkdir(exist_ok=True)
        if self.noises:  # they have just been reset
            _fill(_noise_arrays(self.model), self.noises)
        self.next_evaluation = self._after_now(self.plan.eval_freq)
        self.next_checkpoint = self._after_now(self.checkpoint_freq)
        self.bar.initial = self.bar.n = min(self.num_timesteps, self.plan.steps)

    def _after_now(self, freq: int) -> int:
        return (self.num_timesteps // freq + 1) * freq

    def _on_step(self) -> bool:
        log_episodes(self.locals["infos"], self.locals["dones"], self.logger)
        self.bar.update(min(self.num_timesteps, self.plan.steps) - self.bar.n)
        self.stopped = self.stopped or self.should_stop()
        return True

    def _on_rollout_start(self) -> None:
        # Between rollouts: PPO's policy does not change during one, and a checkpoint in the middle could not be exact.
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation = self._after_now(self.plan.eval_freq)
            self.evaluate()
        if self.stopped or self.num_timesteps >= self.next_checkpoint:
            self.next_checkpoint = self._after_now(self.checkpoint_freq)
            checkpoint = self.save_checkpoint()
            if self.stopped:
                raise StoppedError(self.num_timesteps, checkpoint)

    def actor(self) -> NetworkPolicy:
        """Return the present actor."""
        plan = self.plan
        about = {
            "env_id": plan.env_id,
            "env_kwargs": dict(plan.env_kwargs),
            "algorithm": plan.algorithm,
            "seed": plan.seed,
            "steps": self.num_timesteps,
            "sd_friction_env": sd_friction_env.__version__,
        }
        return network_policy(self.model.policy, plan.hyperparameters.get("frame_stack", 1), about)

    def evaluate(self) -> None:
        """Evaluate the present actor; keep its weights if it is the best so far.

        Best is the highest mean of the returns, where an episode that was not suppressed counts no more than a
        passive one: a return alone would prefer a belt that runs slow for ever to one that is back at its speed.
        """
        plan = self.plan
        passive = evaluation.passive_episodes(plan.env_id, self.seeds, plan.env_kwargs)
        table = evaluation.evaluate(self.actor(), plan.env_id, self.seeds, plan.env_kwargs, passive=passive)
        passive_returns = np.nansum(passive.reward, axis=1)
        credited = np.where(table["suppressed"], table["return"], np.minimum(table["return"], passive_returns))
        row = {
            "steps": self.num_timesteps,
            "seconds": round(time.perf_counter() - self.started, 3),
            "mean_return": float(table["return"].mean()),
            "std_return": float(table["return"].std()),
            "credited_return": float(credited.mean()),
            "suppressed": float(table["suppressed"].mean()),
            "amplitude_reduction": float(table["amplitude_reduction"].mean()),
            "stick_fraction": float(table["stick_fraction"].mean()),
            "belt_speed_ratio": float(table["belt_speed_ratio"].mean()),
            "rms_action": float(table["rms_action"].mean()),
        }
        self.rows.append(row)
        self.table().to_csv(self.folder / runs.EVALUATIONS)
        for name, value in row.items():
            if name != "steps":
                self.logger.record(f"eval/{name}", value)
        names = ("credited_return", "mean_return")
        if not self.best or [row[name] for name in names] > [self.best[name] for name in names]:
            self.best = row
            self.best_weights = {name: part.detach().clone() for name, part in self.model.policy.state_dict().items()}
            runs.save_tensors(self.folder / runs.WEIGHTS, self.best_weights)
        self.bar.set_postfix_str(f"return {row['mean_return']:.1f}, suppressed {row['suppressed']:.0%}")
        self.on_evaluation(dict(row))

    def table(self) -> Table:
        """Return all evaluations so far."""
        return Table({name: [row[name] for row in self.rows] for name in self.rows[0]})

    def save_checkpoint(self, *, at_end: bool = False) -> Path:
        """Write all that is needed to go on from here, keep the checkpoint before it, and return the new file."""
        path = self.folder / runs.CHECKPOINTS / f"step_{self.num_timesteps:012d}.pt"
        content = {
            "format": _CHECKPOINT_FORMAT,
            "plan": content_digest(configuration(self.plan)),
            "steps": self.num_timesteps,
            "run": self.own_state(),
        }
        runs.save_tensors(path, content | _model_state(self.model, at_end=at_end))
        runs.keep_checkpoints(self.folder, path, self.checkpoint)
        self.checkpoint = path
        return path


def train(
    plan: Plan,
    folder: Path,
    *,
    force: bool = False,
    resume: bool = False,
    checkpoint_freq: int | None = None,
    progress: bool = True,
    command: str = "",
    should_stop: Callable[[], bool] = lambda: False,
    on_evaluation: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Result:
    """Train an agent and write its run folder (see :mod:`runs`).

    The global random states of random, NumPy and torch are seeded: Stable-Baselines3 draws from them.

    A run that was stopped or killed goes on from its last checkpoint, or begins anew if it had none yet. On the CPU the
    result is bit for bit that of a run which was not interrupted, but for wall times; rows of evaluations.csv and
    TensorBoard's events from after the checkpoint are dropped, for they come again. On CUDA it is as exact as two runs
    of the same seed are there. Should the last checkpoint be damaged, it goes on from the one before it.

    Args:
        folder: of the finished run. force: replace a run that is there.
        resume: go on with the unfinished run of this plan.
        checkpoint_freq: environment steps between two checkpoints, which are taken between rollouts; None: what an
            unfinished run had, or else as often as it is evaluated.
        progress: show a progress bar on standard error. command: what the user typed, for the record.
        should_stop: asked after every step; once it says True, training stops after the rollout that is running and
            what is learnt from it, with a last checkpoint.
        on_evaluation: called with every new row of evaluations.csv; it may raise to end the training.

    Warns:
        UserWarning: if a run is resumed with other versions than it was begun with, or its last checkpoint is damaged.

    Raises:
        TypeError, ValueError: if ``checkpoint_freq`` is no whole number in [1, 1e12].
        runs.RunFolderError: if the folder is taken, or there is nothing to resume, or what is there is damaged
            or of another plan, or another process works on it; nothing is then written.
        OSError: if something cannot be written; the last checkpoint is then as it was.
        StoppedError: if ``should_stop`` said so; the folder keeps its partial name, also if ``on_evaluation`` raises.
    """
    runs.check_free(folder, force=force or resume)
    begun = runs.load_unfinished(folder, force=force) if resume else None
    if checkpoint_freq is None:
        checkpoint_freq = (begun or {}).get("checkpoint_freq", plan.eval_freq)
    checkpoint_freq = checked_freq("checkpoint-freq", checkpoint_freq)
    with runs.only_here(folder):
        begun = runs.load_unfinished(folder, force=force) if resume else None  # another process may just have ended
        return _train(plan, folder, begun, force, checkpoint_freq, progress, command, should_stop, on_evaluation)


def _train(
    plan: Plan,
    folder: Path,
    begun: Mapping[str, Any] | None,
    force: bool,
    checkpoint_freq: int,
    progress: bool,
    command: str,
    should_stop: Callable[[], bool],
    on_evaluation: Callable[[Mapping[str, Any]], None],
) -> Result:
    """Train as :func:`train` says, from scratch or from the last checkpoint of the run that was begun."""
    frames = int(plan.hyperparameters.get("frame_stack", 1))
    threads = torch.get_num_threads()
    torch.set_num_threads(plan.threads)
    envs = make_training_envs(
        plan.env_id,
        plan.env_kwargs,
        plan.hyperparameters["n_envs"],
        plan.seed,
        frame_stack=frames,
        scaling=reward_scaling(plan.hyperparameters),
    )
    supervisor: _Supervisor | None = None
    logger: Logger | None = None
    try:
        model = make_model(plan, envs)
        config = configuration(plan) | {
            "spaces": {
                "observation": runs.describe_space(envs.observation_space),
                "action": runs.describe_space(envs.action_space),
            },
            "checkpoint_freq": checkpoint_freq,
            "versions": versions(),
            "command": command,
        }
        partial = runs.partial_folder(folder)
        saved: dict[str, Any] | None = None
        if begun is not None:
            check_same(begun, plan, partial)
            found = _last_whole_checkpoint(runs.checkpoints(partial))
            if found is not None:
                checkpoint, saved = found
                _restore_checkpoint(checkpoint, saved, model, plan)
        if saved is None:
            runs.begin(folder, config, force=force or begun is not None)
        else:
            assert begun is not None
            then = {**begun["versions"], **(begun.get("resumed") or [{}])[-1].get("versions", {})}
            changed = [f"{name} {then.get(name)} -> {now}" for name, now in versions().items() if then.get(name) != now]
            if changed:
                warnings.warn(f"the run was begun with other versions: {', '.join(changed)}", stacklevel=2)
            config |= {name: begun[name] for name in ("versions", "command") if name in begun}
            config["resumed"] = [*begun.get("resumed", []), {"steps": model.num_timesteps, "versions": versions()}]
            runs.write_unfinished(partial, config)
            runs.remove_leftovers(partial)
        resumed_at = None if saved is None else model.num_timesteps
        logger = Logger(None, [_TensorBoard(partial / runs.TENSORBOARD, resumed_at)])
        model.set_logger(logger)
        supervisor = _Supervisor(plan, partial, progress, should_stop, on_evaluation, checkpoint_freq)
        if saved is not None:
            supervisor.restore(checkpoint, saved["run"], saved["noises"], logger)
        # Off-policy algorithms log per episode, and all environments end theirs together.
        log_interval = 1 if plan.algorithm == "ppo" else plan.hyperparameters["n_envs"]
        model.learn(
            plan.steps - (resumed_at or 0),
            callback=[*make_callbacks(plan.hyperparameters), supervisor],
            log_interval=log_interval,
            reset_num_timesteps=saved is None,
        )
        if not supervisor.rows or supervisor.rows[-1]["steps"] < model.num_timesteps:  # else it was killed after this
            supervisor.evaluate()
            logger.dump(model.num_timesteps)
            supervisor.save_checkpoint(at_end=True)
        seconds = supervisor.rows[-1]["seconds"]
        model.policy.load_state_dict(supervisor.best_weights)
        actor = dataclasses.replace(
            supervisor.actor(), metadata={**supervisor.actor().metadata, "steps": supervisor.best["steps"]}
        )
        actor.save(partial / runs.NETWORK)
        logger.close()
        runs.keep_checkpoints(partial, supervisor.checkpoint)
        config |= {"steps": model.num_timesteps, "seconds": seconds, "best": supervisor.best}
        runs.finish(folder, config, force=force)
        return Result(folder, actor, model.num_timesteps, seconds, supervisor.best, supervisor.table())
    finally:
        if supervisor is not None:
            supervisor.bar.close()
        if logger is not None:
            logger.close()
        envs.close()
        torch.set_num_threads(threads)


def configuration(plan: Plan) -> dict[str, Any]:
    """Return a plan as a run's config.json has it (JSON values)."""
    return {
        "environment": {
            "id": plan.env_id,
            "kwargs": dict(plan.env_kwargs),
            "frame_stack": int(plan.hyperparameters.get("frame_stack", 1)),
        },
        "algorithm": plan.algorithm,
        "hyperparameters": dict(plan.hyperparameters),
        "seed": plan.seed,
        "evaluation": {
            "freq": plan.eval_freq,
            "episodes": plan.eval_episodes,
            "first_seed": validation_seeds(plan)[0],
        },
        "device": plan.device,
        "threads": plan.threads,
    }


def check_same(config: Mapping[str, Any], plan: Plan, place: Path) -> None:
    """Raise unless a plan is the one that the configuration of the run at ``place`` was made from.

    Raises:
        runs.RunFolderError: naming the first difference.
    """
    ours, theirs = (
        _flat(part) for part in (configuration(plan), {name: config.get(name) for name in configuration(plan)})
    )
    for name in [*theirs, *ours]:
        if ours.get(name) != theirs.get(name) or (name in ours) != (name in theirs):
            was, now = (repr(part[name]) if name in part else "not given" for part in (theirs, ours))
            raise runs.RunFolderError(
                f"{str(place)!r} is a run with another configuration: {name} is {was} there and {now} here; "
                "resume it with --run-folder and --resume alone, or replace it with --force and without --resume"
            )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(values)).items():
        parts |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return parts


def _last_whole_checkpoint(paths: Sequence[Path]) -> tuple[Path, dict[str, Any]] | None:
    """Return the first checkpoint that is not damaged and what it holds; None if there are none at all.

    Warns:
        UserWarning: naming those that are damaged.

    Raises:
        runs.RunFolderError: if all are damaged.
    """
    damaged = []
    for path in paths:
        try:
            saved = runs.load_tensors(path, sealed=True)
        except runs.RunFolderError as error:
            damaged.append(_one_line(error))
            continue
        if damaged:
            said = f"a checkpoint is damaged ({'; '.join(damaged)}): resumed from its predecessor {str(path)!r}"
            warnings.warn(said, stacklevel=4)
        return path, saved
    if damaged:
        raise runs.RunFolderError(
            f"no checkpoint can be used ({'; '.join(damaged)}): begin anew with --force and without --resume"
        )
    return None


def _restore_checkpoint(path: Path, saved: Mapping[str, Any], model: BaseAlgorithm, plan: Plan) -> None:
    """Restore a model from what a checkpoint holds.

    Raises:
        runs.RunFolderError: if it is of another format or of another run.
    """
    if saved.get("format") != _CHECKPOINT_FORMAT:
        raise runs.RunFolderError(
            f"checkpoint {str(path)!r} has format {saved.get('format')!r}, and this version resumes "
            f"{_CHECKPOINT_FORMAT}: begin anew with --force and without --resume"
        )
    try:
        if saved["plan"] != content_digest(configuration(plan)):
            raise ValueError("it was written with another configuration")
        _restore_model(model, saved, plan.steps)
        if not {"rows", "best", "best_weights", "seconds", "logged"} <= set(saved["run"]):
            raise ValueError("the record of the run is incomplete")
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise runs.RunFolderError(
            f"checkpoint {str(path)!r} is damaged or of another run: {_one_line(error)[:300]}"
        ) from None


def versions() -> dict[str, str]:
    """Return the versions of all that a result depends on."""
    return {
        "python": platform.python_version(),
        "sd_friction_env": sd_friction_env.__version__,
        "gymnasium": gym.__version__,
        "numpy": np.__version__,
        "torch": str(torch.__version__),
        "stable_baselines3": stable_baselines3.__version__,
        "sb3_contrib": sb3_contrib.__version__,
    }
