"""Plans: everything that determines the result of a training run, checked before anything is written."""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.controllers import check_teacher
from sd_friction_env.learning.runs import CONFIG, RunFolderError
from sd_friction_env.learning.settings import (
    ALGORITHMS,
    NOISES,
    check_hyperparameter,
    check_hyperparameters,
    checked_whole,
    one_line,
    read_hyperparameters,
)
from sd_friction_env.physics.parameters import checked_choice

LARGEST_SEED = 2**32 - 1
FAST, PLAIN = IMPLEMENTATIONS = ("fast", "stable-baselines3")
_FAST_FOR = ("ppo", "cpu")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Everything that determines the result of a run.

    Attributes:
        env_id, env_kwargs: of the environment (JSON values).
        algorithm: one of ``ALGORITHMS``.
        hyperparameters: checked; ``n_envs`` and ``n_timesteps`` are among them.
        seed: of everything random, in [0, 2**32 - 1].
        eval_freq: environment steps between two evaluations.
        eval_episodes: episodes of each, from ``evaluation.VALIDATION_SEEDS``.
        device: as torch names it. threads: of torch.
        implementation: of the algorithm: "fast" (:class:`FastPPO`: PPO on the CPU) or "stable-baselines3".
        start_from: the controller whose clone PPO starts with (see :func:`teacher_of`); None: random weights.
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
    implementation: str = PLAIN
    start_from: str | None = None

    @property
    def steps(self) -> int:
        """Environment steps to train for (at least)."""
        return int(self.hyperparameters["n_timesteps"])

    @property
    def frames(self) -> int:
        """Observations that the agent sees at once."""
        return int(self.hyperparameters.get("frame_stack", 1))

    @property
    def validation_seeds(self) -> range:
        """Seeds of the episodes by which a run chooses its best model."""
        return evaluation.VALIDATION_SEEDS[: self.eval_episodes]

    def configuration(self) -> dict[str, Any]:
        """Return the plan as a run's config.json stores it (JSON values)."""
        more = {"implementation": self.implementation, "start_from": self.start_from}  # left out: as before they were
        return {name: value for name, value in more.items() if value not in (None, PLAIN)} | {
            "environment": {"id": self.env_id, "kwargs": dict(self.env_kwargs), "frame_stack": self.frames},
            "algorithm": self.algorithm,
            "hyperparameters": dict(self.hyperparameters),
            "seed": self.seed,
            "evaluation": {
                "freq": self.eval_freq,
                "episodes": self.eval_episodes,
                "first_seed": self.validation_seeds[0],
            },
            "device": self.device,
            "threads": self.threads,
        }


def training_seed(seed: int, index: int = 0) -> int:
    """Return the seed of a run's environment: at least 2**32, so that no evaluation seed and no other run has it."""
    return (1 + seed) * 2**32 + index


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
    implementation: str | None = None,
    start_from: str | None = None,
) -> Plan:
    """Return a checked plan; nothing is written.

    Args:
        overrides: hyperparameters that replace those of the file.
        timesteps, envs: replace ``n_timesteps`` and ``n_envs``.
        eval_freq: None: a twentieth of the steps.
        implementation: None: "fast" where it is possible.
        The others are those of :class:`Plan`.

    Raises:
        TypeError, ValueError: naming the argument, its value and what is allowed.
    """
    checked_choice("env-id", env_id, ENVIRONMENT_IDS)
    settings = read_hyperparameters(algorithm, env_id, hyperparameter_file, warm=start_from is not None)
    settings |= check_hyperparameters(algorithm, dict(overrides or {}))
    for name, shown, value in (("n_timesteps", "timesteps", timesteps), ("n_envs", "envs", envs)):
        if value is not None:
            settings[name] = check_hyperparameter(name, value, shown)
    plan = Plan(
        env_id=env_id,
        env_kwargs=env_kwargs or {},
        algorithm=algorithm,
        hyperparameters=settings,
        seed=seed,
        eval_freq=max(1, settings.get("n_timesteps", 1) // 20) if eval_freq is None else eval_freq,
        eval_episodes=eval_episodes,
        device=device,
        threads=threads,
        implementation=implementation or (FAST if (algorithm, device) == _FAST_FOR else PLAIN),
        start_from=start_from,
    )
    return checked_plan(plan)


def plan_of(config: Mapping[str, Any]) -> Plan:
    """Return the plan that a run's config.json describes.

    Raises:
        RunFolderError: if it describes none.
    """
    try:
        environment, algorithm = config["environment"], checked_choice("algorithm", config["algorithm"], ALGORITHMS)
        settings = check_hyperparameters(algorithm, config["hyperparameters"])
        plan = Plan(
            env_id=checked_choice("environment", environment["id"], ENVIRONMENT_IDS),
            env_kwargs=environment["kwargs"],
            algorithm=algorithm,
            hyperparameters=settings,
            seed=config["seed"],
            eval_freq=config["evaluation"]["freq"],
            eval_episodes=config["evaluation"]["episodes"],
            device=config["device"],
            threads=config["threads"],
            implementation=config.get("implementation", PLAIN),
            start_from=config.get("start_from"),
        )
        return checked_plan(plan)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunFolderError(f"the run's {CONFIG} cannot be used: {one_line(error)}") from None


def checked_plan(plan: Plan) -> Plan:
    """Return a plan whose hyperparameters are checked one by one already, after checking the rest."""
    kwargs = _checked_environment(plan.env_id, plan.env_kwargs)
    _check_device(plan.device)
    checked_choice("implementation", plan.implementation, IMPLEMENTATIONS)
    if plan.implementation == FAST and (plan.algorithm, plan.device) != _FAST_FOR:
        raise ValueError(f"implementation {FAST!r} is for ppo on the cpu, got {plan.algorithm} on {plan.device!r}")
    if (plan.start_from is None) != ("warm_start" not in plan.hyperparameters):
        raise ValueError("start-from and the hyperparameter warm_start go together: give both or none")
    if plan.start_from is not None:
        if plan.implementation != FAST:
            raise ValueError(f"start-from is for the implementation {FAST!r}, got {plan.implementation!r}")
        check_teacher(plan.start_from, plan.env_id, kwargs)
    return dataclasses.replace(
        plan,
        env_kwargs=kwargs,
        hyperparameters=_checked_together(plan.algorithm, dict(plan.hyperparameters)),
        seed=checked_whole("seed", plan.seed, 0, LARGEST_SEED),
        eval_freq=checked_freq("eval-freq", plan.eval_freq),
        eval_episodes=checked_whole("eval-episodes", plan.eval_episodes, 1, len(evaluation.VALIDATION_SEEDS)),
        threads=checked_whole("threads", plan.threads, 1, 1024),
    )


def checked_freq(name: str, value: Any) -> int:
    """Return a number of environment steps between two events.

    Raises:
        TypeError, ValueError: if it is not a whole number in [1, 1e12].
    """
    return checked_whole(name, value, 1, 10**12)


def _checked_together(algorithm: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Return hyperparameters with the values that follow from one another."""
    settings.setdefault("n_envs", 1)
    if "n_timesteps" not in settings:
        raise ValueError("n_timesteps must be in the hyperparameters or given as timesteps")
    if "noise_std" in settings and "noise_type" not in settings:
        raise ValueError(f"noise_std needs a noise_type: {', '.join(NOISES)}")
    if algorithm == "ppo":
        rollout = settings["n_envs"] * settings.get("n_steps", 2048)
        if rollout < 2:
            raise ValueError(f"n_envs x n_steps must be at least 2, got {rollout}")
        # A batch larger than the rollout, or one that does not divide it, would leave a small remainder.
        settings["batch_size"] = math.gcd(rollout, settings.get("batch_size", 64))
        if settings["batch_size"] < 2:
            settings["batch_size"] = rollout
    return settings


def _checked_environment(env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    try:
        kwargs: dict[str, Any] = json.loads(json.dumps(dict(env_kwargs), allow_nan=False))
    except (TypeError, ValueError):
        raise ValueError(f"environment arguments must be plain finite values, got {env_kwargs!r}") from None
    try:
        make_env(env_id, kwargs).close()  # the environment checks its own arguments
    except (TypeError, ValueError) as error:
        reason = str(error).partition(" was raised from")[0]  # which Gymnasium adds
        raise ValueError(f"the environment refuses its arguments: {reason}") from None
    return kwargs


def _check_device(device: str) -> None:
    if device in ("cpu", "auto"):
        return
    import torch

    has_cuda = torch.cuda.is_available()
    if not (has_cuda and str(device).partition(":")[0] == "cuda"):
        allowed = "cpu, auto, cuda" if has_cuda else "cpu, auto (no CUDA device is available)"
        raise ValueError(f"device must be one of {allowed}, got {device!r}")


def check_same(config: Mapping[str, Any], plan: Plan, place: Path) -> None:
    """Raise unless a plan is the one of the run at ``place``, whose configuration is given.

    Raises:
        RunFolderError: naming the first difference.
    """
    here = plan.configuration()
    ours, theirs = _flat(here), _flat({name: config.get(name) for name in here})
    for name in [*theirs, *ours]:
        if ours.get(name, ours) != theirs.get(name, theirs):
            was, now = (repr(part[name]) if name in part else "not given" for part in (theirs, ours))
            raise RunFolderError(
                f"{str(place)!r} is a run with another configuration: {name} is {was} there and {now} here; "
                "resume it with --run-folder and --resume alone, or replace it with --force and without --resume"
            )


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(values)).items():
        parts |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return parts
