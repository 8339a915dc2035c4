"""Trained agents that come with the package, and the check that the environment still is the one they learned on."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sd_friction_env.control.policies.network import NetworkPolicy, PolicyFileError, load_policy
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.storage import AGENTS

PRETRAINED = AGENTS / "best"

_GOLDEN_STEPS = 60
# Where another build rounds differently, an observation's last digit in single precision may flip (2e-7); a friction
# coefficient changed by a thousandth moves 3e-4.
_GOLDEN_TOLERANCE = 1e-6


def bare_id(env_id: str) -> str:
    """Return an environment's id without the module that Gymnasium lets one put before it."""
    return env_id.rpartition(":")[2]


def pretrained_file(env_id: str) -> Path:
    """Return where the agent of an environment is kept, "SDFriction/Force-v0" in "SDFriction-Force-v0.npz"."""
    return PRETRAINED / f"{bare_id(env_id).replace('/', '-')}.npz"


def fingerprint(env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what a trained agent depends on, as JSON values.

    ``configuration``: spaces, task and nominal plant; ``golden``: observations and rewards under a fixed sequence of
    actions that slips, sticks and breaks away, with a fixed seed.
    """
    env = gym.make(env_id, **dict(env_kwargs or {})).unwrapped
    assert isinstance(env, SDFrictionEnv)
    configuration = {
        "observation": _described(env.observation_space),
        "action": _described(env.action_space),
        "task": dataclasses.asdict(env.task),
        "parameters": dataclasses.asdict(env.nominal),
    }
    observation, _ = env.reset(seed=0)
    golden = [[*observation.tolist(), 0.0]]
    for t in range(_GOLDEN_STEPS):
        action = np.array([(7 * (t // 3) % 11) / 5.0 - 1.0], np.float32)
        observation, reward, terminated, _, _ = env.step(action)
        golden.append([*observation.tolist(), float(reward)])
        if terminated:
            break
    return {"configuration": json.loads(json.dumps(configuration)), "golden": golden[::5]}


def _described(space: gym.Space[Any]) -> dict[str, Any]:
    assert isinstance(space, gym.spaces.Box)
    return {"shape": list(space.shape), "low": space.low.tolist(), "high": space.high.tolist()}


def changes_since(stored: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return what differs between two fingerprints, in words; nothing if the environment is the same.

    What a stored one lacks differs too: a foreign one does not pass for the same environment.
    """
    changed = []
    configuration = stored.get("configuration")
    parts = configuration if isinstance(configuration, Mapping) else {}
    for part, present in now["configuration"].items():
        values = parts.get(part)
        if not isinstance(values, Mapping) or not values:
            changed.append(f"{part}: nothing is stored of it")
            continue
        # An argument that is new since then has a default; whether that changes anything, the golden episode tells.
        names = sorted(name for name in values if values[name] != present.get(name))
        changed += [f"{part} {name}: {values[name]!r} -> {present.get(name)!r}" for name in names]
    changed += [f"{part}: it is unknown" for part in sorted(set(parts) - set(now["configuration"]))]
    if not close(stored.get("golden", []), now["golden"], _GOLDEN_TOLERANCE):
        changed.append("the dynamics, the observation or the reward")
    return changed


def close(stored: Any, now: Any, tolerance: float) -> bool:
    """Return whether what is stored are numbers of the same shape as those of now, none farther off than that."""
    try:
        before, after = np.array(stored, dtype=float), np.array(now, dtype=float)
    except (TypeError, ValueError):  # ragged, or no numbers
        return False
    return before.shape == after.shape and bool(np.allclose(before, after, rtol=0.0, atol=tolerance))


def load_pretrained(env_id: str) -> NetworkPolicy:
    """Return the agent that comes with the package for an environment; it needs NumPy alone.

    ``metadata`` of the policy says how it was trained and what it scored.

    Args:
        env_id: one of ``ENVIRONMENT_IDS``, with its default arguments.

    Raises:
        ValueError: if there is no agent for it.
        PolicyFileError: if the file is damaged, or was trained on another version of the environment.
    """
    known = sorted(path.stem.replace("SDFriction-", "SDFriction/", 1) for path in PRETRAINED.glob("*.npz"))
    if bare_id(env_id) not in known:
        raise ValueError(f"env_id must be one that an agent was trained for ({', '.join(known)}), got {env_id!r}")
    file = pretrained_file(env_id)
    policy = load_policy(file)
    stored = policy.metadata.get("fingerprint")
    if not isinstance(stored, dict) or policy.metadata.get("env_id") != bare_id(env_id):
        raise PolicyFileError(f"{str(file)!r} is not an agent for {bare_id(env_id)}")
    changed = changes_since(stored, fingerprint(bare_id(env_id)))
    if changed:
        raise PolicyFileError(
            f"the agent in {str(file)!r} was trained on another {bare_id(env_id)} ({'; '.join(changed)}): "
            "train it again with scripts/pretrain.py"
        )
    return policy
