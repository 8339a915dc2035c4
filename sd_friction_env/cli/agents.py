"""Agents and controllers as commands name them."""

from pathlib import Path
from typing import Any

from sd_friction_env import ENVIRONMENT_IDS, load_pretrained
from sd_friction_env.cli.options import UsageError
from sd_friction_env.control.policies import (
    ConstantPolicy,
    NetworkPolicy,
    Policy,
    VelocityFeedback,
    ZeroPolicy,
    load_policy,
)
from sd_friction_env.environments.single import make_env
from sd_friction_env.extras import extra
from sd_friction_env.learning import classical, runs
from sd_friction_env.learning.controllers import MADE_FROM_ENV, imported_policy

# On force near the best there is. On belt the belt follows the mass, which makes matters worse at any gain.
VELOCITY_GAINS = {"force": 1.5, "belt_speed": 1.0}
CONSTANTS = {"passive": ZeroPolicy(), "constant-1": ConstantPolicy(-1.0), "constant+1": ConstantPolicy(1.0)}
NAMED = ("pretrained", "classical", "velocity-feedback", *MADE_FROM_ENV, *CONSTANTS)
AGENTS_TEXT = f"{', '.join(NAMED)}, a run folder, a policy's .npz, an .onnx, or module:NAME"


def stored_agent(path: Path) -> tuple[NetworkPolicy, dict[str, Any] | None]:
    """Return the agent at a path and, from a run folder, the environment that it was trained for: id and kwargs."""
    if path.suffix.lower() == ".npz":
        try:
            return load_policy(path), None
        except OSError as error:
            raise UsageError(f"{str(path)!r} cannot be read: {error}") from None
    config = runs.load_config(path)
    return runs.load_network(path), dict(config["environment"])


def check_fit(path: Path, policy: NetworkPolicy, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Check that an agent fits an environment."""
    env = make_env(env_id, env_kwargs)
    size = env.observation_space.shape[0] if env.observation_space.shape else 0
    if policy.observation_size != size:
        raise UsageError(f"{str(path)!r} observes {policy.observation_size} values, and {env_id} gives {size}")
    trained = policy.metadata.get("env_id")
    if trained in ENVIRONMENT_IDS and make_env(trained).task.actuator != env.task.actuator:
        raise UsageError(f"{str(path)!r} was trained on {trained}, whose actuator is not that of {env_id}")


def velocity_feedback(env_id: str, env_kwargs: dict[str, Any], gain: float | None) -> tuple[VelocityFeedback, float]:
    """Return velocity feedback for an environment, and its gain (None: the default of the actuator)."""
    env = make_env(env_id, env_kwargs)
    used = VELOCITY_GAINS[env.task.actuator] if gain is None else gain
    return VelocityFeedback.from_env(env, used), used


def agent_of(name: str, env_id: str, *, gain: float | None = None, env_kwargs: dict[str, Any] | None = None) -> Policy:
    """Return the controller of an environment that --agent names: one of ``NAMED`` ("classical": the best tuned one), a
    run folder, a .npz or .onnx file, or module:NAME as :func:`imported_policy` takes it.
    """
    if gain is not None and name != "velocity-feedback":
        raise UsageError(f"--gain goes with --agent velocity-feedback, not with {name!r}")
    if name in CONSTANTS:
        return CONSTANTS[name]
    if name == "pretrained":
        return load_pretrained(env_id)
    if name == "classical":
        return classical.best_controller(env_id)[1]
    if name == "velocity-feedback":
        return velocity_feedback(env_id, env_kwargs or {}, gain)[0]
    if name in MADE_FROM_ENV:
        return MADE_FROM_ENV[name](make_env(env_id, env_kwargs))
    path = Path(name)
    if path.suffix.lower() == ".onnx":
        with extra("export"):
            from sd_friction_env.learning import export
        return export.ExportedPolicy.load(path, make_env(env_id, env_kwargs))
    if ":" in name and not path.exists():
        return imported_policy(name, make_env(env_id, env_kwargs))
    if path.suffix.lower() != ".npz" and not path.is_dir():
        raise UsageError(f"the agent must be {AGENTS_TEXT}, got {name!r}")
    policy, _ = stored_agent(path)
    check_fit(path, policy, env_id, env_kwargs or {})
    return policy


def title_of(name: str, policy: Policy) -> str:
    """Return what a picture calls the controller that --agent names."""
    titles = {"passive": "no control", "rollout": "rollout of the threshold follower"}
    if isinstance(policy, NetworkPolicy):
        return f"{policy.title} agent"
    return titles.get(name, name.replace("-", " "))
