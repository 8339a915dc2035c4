"""Controllers that an agent can start from, as `sd-friction train --start-from` names them."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.policies import FOLLOWERS, Policy, State, load_policy
from sd_friction_env.learning import evaluation

RULE = f"start-from must be {', '.join(FOLLOWERS)}, a policy's .npz or MODULE:NAME"


def teacher_of(name: str, env: Any) -> Policy:
    """Return a controller for a bare environment.

    Args:
        name: threshold-follower, rollout, a policy's .npz, or MODULE:NAME: a class with ``from_env``, a function or
            class that is called with the environment, or an object with ``predict``.

    Raises:
        ValueError: if there is no such controller, or it does not fit the environment.
    """
    if name in FOLLOWERS:
        return FOLLOWERS[name](env)
    if Path(name).suffix.lower() == ".npz":
        return load_policy(name)
    module, colon, attribute = name.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), attribute) if colon else None
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{RULE}, got {name!r}: {error}") from None
    if hasattr(found, "from_env"):
        found = found.from_env(env)
    elif callable(found) and (isinstance(found, type) or not hasattr(found, "predict")):
        found = found(env)
    if not callable(getattr(found, "predict", None)):
        raise ValueError(f"{RULE}, got {name!r}" + (f": {type(found).__name__} has no predict" if colon else ""))
    policy: Policy = found
    return policy


def taught(
    teacher: Policy, observations: NDArray[np.float32], state: State, starts: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], State]:
    """Return a teacher's actions (n, 1) for observations (n, d), and its memory.

    Raises:
        ValueError: if the actions have another shape, or are not numbers in [-1, 1].
    """
    actions, state = teacher.predict(observations, state, starts, deterministic=True)
    actions, shape = np.asarray(actions), (len(observations), 1)
    if actions.shape != shape or actions.dtype.kind not in "fiu" or not (np.abs(actions) <= 1.0).all():
        shown = f"shape {actions.shape}" if actions.shape != shape else f"{actions[~(np.abs(actions) <= 1.0)][:3]}"
        raise ValueError(f"the controller to start from must return actions {shape} in [-1, 1], got {shown}")
    return actions.astype(np.float32), state


def check_teacher(name: str, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Check that a controller can be made for an environment and acts on it.

    Raises:
        ValueError: naming the controller and what is wrong.
    """
    env = evaluation.make_env(env_id, env_kwargs)
    try:
        seen = np.repeat(env.reset(seed=evaluation.VALIDATION_SEEDS[0])[0][None], 2, axis=0)
        taught(teacher_of(name, env), seen, None, np.ones(2, bool))
    except Exception as error:
        raise ValueError(f"--start-from {name} cannot be used: {type(error).__name__}: {error}") from error
