"""Controllers by name: made from an environment alone, or of a user's module, and those that an agent starts from."""

import functools
import os
import pkgutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.observed import (
    Observed,
    ObservedPolicy,
    ObservedRollout,
    ObservedRule,
    rollout_follower,
    threshold_follower,
)
from sd_friction_env.control.observers import (
    AlphaBetaFilter,
    EnsembleKalmanFilter,
    KalmanFilter,
    LuenbergerObserver,
    Observer,
    ParticleFilter,
)
from sd_friction_env.control.policies import (
    GradientPolicy,
    Policy,
    SamplingPolicy,
    State,
    load_policy,
)
from sd_friction_env.control.pretrained import load_pretrained, recurrent_follower
from sd_friction_env.environments.ids import environment_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.optimal import OptimalPolicy

_OBSERVERS: dict[str, type[Observer]] = {
    "alpha-beta": AlphaBetaFilter,
    "luenberger": LuenbergerObserver,
    "particle": ParticleFilter,
    "ensemble": EnsembleKalmanFilter,
    "kalman": KalmanFilter,
}


def _observed(observer: str, controller: str, env: Any) -> Observed:
    """Return the rule, its look-ahead or the trained agent ("rule", "rollout", "agent") on an observer of a name."""
    found = _OBSERVERS[observer].from_env(env)
    if controller == "agent":
        tier = "randomised" if "belt_speed" in found.ensemble.names else "nominal"
        return ObservedPolicy(found, load_pretrained(environment_id("belt", tier)))
    return (ObservedRule if controller == "rule" else ObservedRollout).from_env(env, found)


MADE_FROM_ENV: dict[str, Callable[[Any], Policy]] = {
    "threshold-follower": threshold_follower,
    "rollout": rollout_follower,
    "value-lookahead": OptimalPolicy.from_env,
    "sampling-mpc": SamplingPolicy.from_env,
    "gradient-mpc": GradientPolicy.from_env,
    "recurrent-rule": recurrent_follower,
    **{
        f"{observer}-{controller}": functools.partial(_observed, observer, controller)
        for observer in _OBSERVERS
        for controller in ("rule", *(() if observer == "alpha-beta" else ("rollout", "agent")))
    },
}


def imported_policy(name: str, env: Any) -> Policy:
    """Return the policy of a user for an environment: module:NAME, from the current folder or an installed package.

    NAME is a policy, a class of policies (made by its ``from_env(env)`` if it has one, otherwise without arguments), or
    a function of the environment that returns one.

    Raises:
        ValueError: if it cannot be imported, or gives no policy.
    """
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        made = pkgutil.resolve_name(name)
    except Exception as error:  # whatever the user's module raises
        raise ValueError(f"{name!r} cannot be imported: {type(error).__name__}: {error}") from error
    if isinstance(made, type):
        made = made.from_env(env) if hasattr(made, "from_env") else made()
    elif callable(made) and not hasattr(made, "predict"):
        made = made(env)
    if not callable(getattr(made, "predict", None)):
        raise ValueError(f"{name!r} must be or make a policy with a method predict, got {made!r}")
    policy: Policy = made
    return policy


def teacher_of(name: str, env: Any) -> Policy:
    """Return the controller that ``--start-from`` names, for a bare environment.

    Args:
        name: one of ``MADE_FROM_ENV``, a policy's .npz, or module:NAME as :func:`imported_policy` takes it.

    Raises:
        ValueError: if there is no such controller, or it does not fit the environment.
    """
    if name in MADE_FROM_ENV:
        return MADE_FROM_ENV[name](env)
    if Path(name).suffix.lower() == ".npz":
        return load_policy(name)
    if ":" not in name:
        raise ValueError(f"start-from must be {', '.join(MADE_FROM_ENV)}, a policy's .npz or module:NAME, got {name!r}")
    return imported_policy(name, env)


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
    env = make_env(env_id, env_kwargs)
    try:
        seen = np.repeat(env.reset(seed=evaluation.VALIDATION_SEEDS[0])[0][None], 2, axis=0)
        taught(teacher_of(name, env), seen, None, np.ones(2, bool))
    except Exception as error:
        raise ValueError(f"--start-from {name} cannot be used: {type(error).__name__}: {error}") from error
