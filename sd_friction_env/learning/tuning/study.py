"""Studies: what is searched, in which database, and the checks before one is continued."""

import contextlib
import copy
import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import sqlalchemy
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, Trial, TrialState

from sd_friction_env.learning import training
from sd_friction_env.learning.plan import Plan, checked_plan, make_plan
from sd_friction_env.learning.settings import check_hyperparameters, checked_whole
from sd_friction_env.learning.tuning.space import Dimension, search_space
from sd_friction_env.physics.parameters import checked_choice
from sd_friction_env.storage import content_digest

FORMAT = 1  # of the configuration that a study stores
HEARTBEAT = 10  # seconds between a running trial's heartbeats
GRACE = 6  # heartbeats that a running trial may miss before it counts as dead and is run again
RETRIES = 3  # of a trial whose process dies
DATABASES = ("sqlite", "postgresql", "mysql")
PRUNERS = ("median", "hyperband", "none")

_CONFIGURATION, _DIGEST = "configuration", "sha256"


class StudyError(ValueError):
    """A study cannot be used: its database cannot be opened, or it is damaged or of another configuration."""


# The search -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Search:
    """Everything that determines the trials of a study.

    Attributes:
        plan: of the hyperparameters around which the search is, with the search's seed.
        evaluations: of a trial, evenly spread. space: what is searched. pruner: one of ``PRUNERS``.
    """

    plan: Plan
    evaluations: int
    space: tuple[Dimension, ...]
    pruner: str

    def configuration(self) -> dict[str, Any]:
        """Return the search as JSON values: two searches may share a study if these are the same."""
        return {
            "format": FORMAT,
            "env_id": self.plan.env_id,
            "env_kwargs": dict(self.plan.env_kwargs),
            "algo": self.plan.algorithm,
            "timesteps": self.plan.steps,
            "seed": self.plan.seed,
            "pruner": self.pruner,
            "evaluations": self.evaluations,
            "eval_episodes": self.plan.eval_episodes,
            "search space": [
                dataclasses.asdict(dimension) | {"choices": list(dimension.choices)} for dimension in self.space
            ],
            "hyperparameters": dict(self.plan.hyperparameters),
        }

    def trial_plan(self, values: Mapping[str, Any], seed: int) -> Plan:
        """Return the plan of a trial from the values of its parameters and its seed."""
        settings = copy.deepcopy(dict(self.plan.hyperparameters))
        for dimension in self.space:
            dimension.put(settings, values[dimension.name])
        settings = check_hyperparameters(self.plan.algorithm, settings)
        return checked_plan(dataclasses.replace(self.plan, hyperparameters=settings, seed=seed))


def derived_seed(*words: int) -> int:
    """Return a seed in [0, 2**32 - 1] that is determined by whole numbers, another one for any others."""
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def make_search(
    env_id: str, algorithm: str, *, evaluations: int = 20, eval_episodes: int = 100, pruner: str = "median", **plan: Any
) -> Search:
    """Return a checked search; nothing is written.

    Args:
        evaluations: of each trial, at most one a step. eval_episodes: of each, from ``evaluation.VALIDATION_SEEDS``.
        pruner: one of ``PRUNERS``.
        plan: other arguments of :func:`make_plan`; hyperparameters in ``overrides`` are not searched, and ``timesteps``
            are those of each trial.

    Raises:
        TypeError, ValueError: naming the argument, its value and what is allowed.
    """
    checked_choice("pruner", pruner, PRUNERS)
    centre = make_plan(env_id, algorithm, eval_episodes=eval_episodes, **plan)
    checked_whole("evaluations", evaluations, 1, centre.steps)
    space = search_space(algorithm, centre.hyperparameters, list(plan.get("overrides") or {}))
    if not space:
        raise ValueError("nothing is left to be searched: every hyperparameter of the search space is fixed")
    centre = dataclasses.replace(centre, eval_freq=centre.steps // evaluations)
    return Search(plan=centre, evaluations=evaluations, space=space, pruner=pruner)


def _pruner(search: Search) -> BasePruner:
    if search.pruner == "median":
        # On the belt, agents show no progress during the first third.
        return MedianPruner(n_startup_trials=5, n_warmup_steps=-(-search.evaluations // 3))
    if search.pruner == "hyperband":
        return HyperbandPruner(min_resource=max(1, search.evaluations // 9), max_resource=search.evaluations)
    return NopPruner()


# The database ---------------------------------------------------------------------------------------------------------


def shown_url(storage: str) -> str:
    """Return the URL of a database without its password.

    Raises:
        StudyError: if it is not a URL, or is that of a database that cannot be used.
    """
    allowed = "a database's URL such as sqlite:///study.db or postgresql+psycopg://USER@HOST/NAME"
    try:
        url = sqlalchemy.make_url(storage)
    except (sqlalchemy.exc.ArgumentError, ValueError):
        raise StudyError(f"storage must be {allowed}, got {storage.rpartition('@')[2]!r}") from None
    shown = url.render_as_string(hide_password=True)
    if url.get_backend_name() not in DATABASES:
        raise StudyError(f"storage must be {allowed} ({', '.join(DATABASES)}), got {shown!r}")
    if url.get_backend_name() == "sqlite":
        if url.database in (None, "", ":memory:"):
            raise StudyError(f"storage must be a file that all workers can open, got {shown!r}, which is in memory")
        place = Path(str(url.database))
        if place.is_dir() or not place.parent.is_dir():
            raise StudyError(f"storage must be a file in a folder that exists, got {shown!r}")
    return shown


def cause(error: BaseException) -> str:
    """Return the first line of a database's own error message."""
    return str(error.__cause__ or error.__context__ or error).partition("\n")[0]


@contextlib.contextmanager
def without_experimental_warnings() -> Iterator[None]:
    """Silence Optuna's warnings that its heartbeats may change with its next version."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        yield


def _open_storage(storage: str, heartbeat: int) -> RDBStorage:
    shown = shown_url(storage)
    wait = {"connect_args": {"timeout": 60}} if storage.startswith("sqlite") else {}
    try:
        with without_experimental_warnings():
            return RDBStorage(
                storage,
                engine_kwargs=wait,
                heartbeat_interval=heartbeat,
                grace_period=GRACE * heartbeat,
                heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(max_retry=RETRIES),
            )
    except ImportError:
        raise StudyError(f"storage {shown!r} needs its database's driver, which is not installed") from None
    except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.OptunaError, RuntimeError, OSError) as error:
        raise StudyError(f"storage {shown!r} cannot be opened: {cause(error)}") from None


def open_study(search: Search, storage: str, name: str, *, heartbeat: int = HEARTBEAT, worker: int = 0) -> optuna.Study:
    """Return the study of that name; make it if it does not exist.

    Args:
        storage: URL of its database. heartbeat: seconds between heartbeats of a running trial.
        worker: number of the process, so that each one suggests other hyperparameters.

    Raises:
        StudyError: if the database cannot be used, or the study is damaged or of another configuration; nothing is
            then changed.
    """
    if not name.strip() or len(name) > 200:
        raise StudyError(f"study must be a name of 1 to 200 characters, got {name!r}")
    opened = _open_storage(storage, heartbeat)
    study = optuna.create_study(
        study_name=name, storage=opened, direction="maximize", load_if_exists=True, pruner=_pruner(search)
    )
    here, trials = search.configuration(), study.get_trials(deepcopy=False)
    if not study.user_attrs and not trials:
        study.set_user_attr(_CONFIGURATION, here)
        study.set_user_attr("versions", training.versions() | {"optuna": optuna.__version__})
        start = {dimension.name: dimension.value(search.plan.hyperparameters) for dimension in search.space}
        if None not in start.values():
            study.enqueue_trial(start)
    # One seed for the whole study would draw the first trials again whenever it is continued.
    study.sampler = TPESampler(seed=derived_seed(search.plan.seed, len(trials), worker))
    what = f"study {name!r} in {shown_url(storage)!r}"
    stored = study.user_attrs.get(_CONFIGURATION)
    if not isinstance(stored, dict):
        raise StudyError(f"{what} was not made by this program: choose another name")
    for key, value in here.items():
        if stored.get(key) != value:
            is_long = isinstance(value, list | dict)
            change = "not that of this search" if is_long else f"{stored.get(key)!r}, not {value!r}"
            raise StudyError(f"{what} is of another configuration: its {key} is {change}; choose another name")
    check_trials(study)
    return study


def stored_configuration(study: optuna.Study) -> dict[str, Any]:
    """Return the configuration that a study stores (see :meth:`Search.configuration`)."""
    found: dict[str, Any] = study.user_attrs[_CONFIGURATION]
    return found


# Trials ---------------------------------------------------------------------------------------------------------------


def is_finished(trial: FrozenTrial) -> bool:
    """Return whether a trial counts: complete, pruned, or failed by itself (user attribute "error")."""
    has_failed = trial.state == TrialState.FAIL and "error" in trial.user_attrs
    return trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or has_failed


def finished_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that count (see :func:`is_finished`)."""
    return [trial for trial in study.get_trials(deepcopy=False) if is_finished(trial)]


def best_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the complete trials, best first: by credited return, then by mean return."""
    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    return sorted(
        complete, key=lambda trial: (-float(trial.value or 0.0), -float(trial.user_attrs["best"]["mean_return"]))
    )


def seal_trial(trial: Trial, best: Mapping[str, Any]) -> None:
    """Store the digest of a trial that is about to be complete."""
    trial.set_user_attr(_DIGEST, _digest(trial, best))


def _digest(trial: FrozenTrial | Trial, best: Mapping[str, Any]) -> str:
    known = {name: trial.user_attrs.get(name) for name in ("hyperparameters", "seed")}
    return content_digest({"params": dict(trial.params), "best": dict(best), **known})


def check_trials(study: optuna.Study) -> None:
    """Raise unless the complete trials of a study agree with their digests (those of earlier versions have none).

    Raises:
        StudyError: naming the first trial that does not.
    """
    for trial in study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
        digest, best = trial.user_attrs.get(_DIGEST), trial.user_attrs.get("best")
        found = best if isinstance(best, dict) else {}
        if trial.value != found.get("credited_return") or digest not in (None, _digest(trial, found)):
            raise StudyError(
                f"trial {trial.number} of study {study.study_name!r} is damaged, or changed since it ended"
            )
