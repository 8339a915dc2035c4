"""Trained agents of the package, and the check that their environment has not changed since training."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.policies.network import NetworkPolicy, PolicyFileError, load_policy
from sd_friction_env.control.policies.recurrent import RecurrentFollower
from sd_friction_env.environments.ids import bare_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.storage import AGENTS

PRETRAINED = AGENTS / "best"
RECURRENT = AGENTS / "recurrent"

_GOLDEN_STEPS = 60
# Rounding on other builds may change the last digit of an observation in single precision (2e-7); a friction
# coefficient changed by 0.1% moves observations by 3e-4.
_GOLDEN_TOLERANCE = 1e-6


def pretrained_file(env_id: str) -> Path:
    """Return the path of an environment's agent: "SDFriction/Force-v0" is in "SDFriction-Force-v0.npz"."""
    return PRETRAINED / f"{bare_id(env_id).replace('/', '-')}.npz"


def recurrent_file(env_id: str) -> Path:
    """Return the path of an open tier's recurrent follower."""
    return RECURRENT / f"{bare_id(env_id).replace('/', '-')}.npz"


def recurrent_follower(env: Any) -> RecurrentFollower:
    """Return the package's recurrent follower for an environment of an open tier; it needs only NumPy.

    Raises:
        ValueError: if the package has none for it.
        PolicyFileError: if the file is damaged, or was trained on another version of the environment.
    """
    env_id = bare_id(env.unwrapped.spec.id) if getattr(env.unwrapped, "spec", None) else ""
    if not env_id or not recurrent_file(env_id).exists():
        known = sorted(path.stem.replace("-", "/", 1) for path in RECURRENT.glob("*.npz"))
        raise ValueError(f"a recurrent follower was trained for {', '.join(known)}, got {env_id or env!r}")
    policy = RecurrentFollower.load(recurrent_file(env_id), env)
    _check_environment(recurrent_file(env_id), policy.metadata, env_id, "scripts/train_recurrent.py")
    return policy


def fingerprint(env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a record of an environment as JSON values, to compare the one trained on with the one at hand.

    ``configuration``: spaces, task and nominal plant; ``golden``: observations and rewards of an episode with a fixed
    seed and fixed actions that slips, sticks and breaks away.
    """
    env = make_env(env_id, env_kwargs)
    configuration = {
        "observation": _described(env.observation_space),
        "action": _described(env.action_space),
        "task": dataclasses.asdict(env.task),
        "parameters": dataclasses.asdict(env.nominal),
    }
    observation, _ = env.reset(seed=0)
    golden = [[*observation.tolist(), 0.0]]
    for action in golden_actions():
        observation, reward, terminated, _, _ = env.step(action)
        golden.append([*observation.tolist(), float(reward)])
        if terminated:
            break
    return {"configuration": json.loads(json.dumps(configuration)), "golden": golden[::5]}


def golden_actions() -> Iterator[NDArray[np.float32]]:
    """Yield the actions of golden episodes: each lasts three intervals, so that the mass crosses, sticks and breaks
    away with both actuators."""
    for t in range(_GOLDEN_STEPS):
        yield np.array([(7 * (t // 3) % 11) / 5.0 - 1.0], np.float32)


def _described(space: gym.Space[Any]) -> dict[str, Any]:
    assert isinstance(space, gym.spaces.Box)
    return {"shape": list(space.shape), "low": space.low.tolist(), "high": space.high.tolist()}


def changes_since(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return descriptions of the differences between two fingerprints; none if the environment is the same.

    Parts that the stored one lacks are differences, too.
    """
    changed = configuration_changes(stored, now)
    if not close(stored.get("golden", []), now["golden"], _GOLDEN_TOLERANCE):
        changed.append("the dynamics, the observation or the reward")
    return changed


def configuration_changes(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return descriptions of the differences between the configurations of two fingerprints."""
    changed = []
    configuration = stored.get("configuration")
    parts = configuration if isinstance(configuration, Mapping) else {}
    for part, present in now["configuration"].items():
        values = parts.get(part)
        if not isinstance(values, Mapping) or not values:
            changed.append(f"{part}: not stored")
            continue
        # New arguments are left out: the golden episode shows whether their defaults change anything.
        names = sorted(name for name in values if values[name] != present.get(name))
        changed += [f"{part} {name}: {values[name]!r} -> {present.get(name)!r}" for name in names]
    return changed + [f"{part}: unknown" for part in sorted(set(parts) - set(now["configuration"]))]


def close(stored: Any, now: Any, tolerance: float) -> bool:
    """Return whether two arrays of numbers have the same shape and agree within a tolerance."""
    try:
        before, after = np.array(stored, dtype=float), np.array(now, dtype=float)
    except (TypeError, ValueError):  # ragged, or no numbers
        return False
    return before.shape == after.shape and bool(np.allclose(before, after, rtol=0.0, atol=tolerance))


def load_pretrained(env_id: str) -> NetworkPolicy:
    """Return the package's trained agent for an environment; it needs only NumPy.

    Its ``metadata`` record the training and the score.

    Args:
        env_id: that of a task and a tier that is not open, with its default arguments.

    Raises:
        ValueError: if the package has no agent for it.
        PolicyFileError: if the file is damaged, or was trained on another version of the environment.
    """
    known = sorted(path.stem.replace("SDFriction-", "SDFriction/", 1) for path in PRETRAINED.glob("*.npz"))
    if bare_id(env_id) not in known:
        raise ValueError(f"env_id must be one that an agent was trained for ({', '.join(known)}), got {env_id!r}")
    file = pretrained_file(env_id)
    policy = load_policy(file)
    _check_environment(file, policy.metadata, bare_id(env_id), "scripts/pretrain.py")
    return policy


def _check_environment(file: Path, metadata: Mapping[str, Any], env_id: str, script: str) -> None:
    """Raise PolicyFileError if an agent is not of an environment, or the environment has changed since its training."""
    stored = metadata.get("fingerprint")
    if not isinstance(stored, dict) or metadata.get("env_id") != env_id:
        raise PolicyFileError(f"{str(file)!r} is not an agent for {env_id}")
    changed = changes_since(stored, fingerprint(env_id))
    if changed:
        raise PolicyFileError(
            f"the agent in {str(file)!r} was trained on another {env_id} ({'; '.join(changed)}): "
            f"train it again with {script}"
        )
