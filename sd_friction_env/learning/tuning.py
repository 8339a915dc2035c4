"""A search for hyperparameters with Optuna: a study in a database, any number of workers, continued at will.

A trial trains one model around the hyperparameters of a file and is worth the best *credited* return it reached on the
validation seeds (never the evaluation seeds): the mean return, where an episode that was not suppressed counts no more
than a passive one. It is what training keeps its best model by. Trial 0 is the file as it is, where the space holds it.

Random numbers of suggestions and of training follow from the search's seed and the trial's index alone (its number,
where trials that were tried again count once). So one worker gives the same trials twice, and a study that was stopped
and continued is the study that ran through (but for Hyperband, whose brackets go by the number). With several workers,
what a suggestion can learn from depends on which other trials have ended.
"""

import contextlib
import copy
import dataclasses
import math
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import sqlalchemy
import torch
import yaml
from optuna.distributions import BaseDistribution
from optuna.exceptions import ExperimentalWarning, TrialPruned, UpdateFinishedTrialError
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import BaseSampler, TPESampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.trial import FrozenTrial, Trial, TrialState
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from sd_friction_env.control.policies import Policy
from sd_friction_env.environments.callbacks import AnnealedExploration
from sd_friction_env.learning import evaluation, training
from sd_friction_env.storage import StoredFileError, atomic_file, content_digest, read_text

FORMAT = 1  # of what a study says of itself
HEARTBEAT = 10  # seconds between a running trial's signs of life; after six without one it is dead, and tried again
DATABASES = ("sqlite", "postgresql", "mysql")
PRUNERS = ("median", "hyperband", "none")
OUT_HEADER = "# The best hyperparameters of a study by sd-friction tune, in RL Zoo's format."

_GRACE = 6
_RETRIES = 3  # of a trial whose process dies; one that was interrupted is always tried again
_CONFIGURATION, _DIGEST = "configuration", "sha256"


# The search space -----------------------------------------------------------------------------------------------------


def _significant(value: float, digits: int = 4) -> float:
    """Return a value as a file shows it: what is written down is then exactly what was tried."""
    return float(f"{value:.{digits}g}")


# How a hyperparameter (right) is told from a parameter of the study (left), and the other way round.
_FORMS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "same": (lambda value: value, lambda setting: setting),
    "number": (_significant, float),
    "falling": (lambda value: f"lin_{value:.4g}", lambda setting: float(setting.removeprefix("lin_"))),
    "horizon": (lambda value: round(1.0 - 1.0 / value, 6), lambda setting: _significant(1.0 / (1.0 - setting))),
    "power of two": (lambda value: 2**value, lambda setting: round(math.log2(setting))),
    "layers": (lambda value: [int(width) for width in value.split("-")], lambda setting: "-".join(map(str, setting))),
}


@dataclass(frozen=True)
class Dimension:
    """One hyperparameter that is searched.

    Attributes:
        name: of the parameter in the study.
        setting: of the hyperparameter; "policy_kwargs.NAME" for one of the policy, "reward.scale", "reward.power",
            "callback.start" and "callback.end" for arguments of the reward's wrapper and of the annealed exploration.
        form: how the one becomes the other, a key of ``_FORMS``.
        low, high: ends of its range, both included; whole numbers are searched where both are whole numbers.
        log: whether it is searched on a logarithmic scale. choices: instead of a range.
    """

    name: str
    setting: str
    form: str = "number"
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    choices: tuple[str, ...] = ()

    def suggest(self, trial: Trial) -> Any:
        """Return the parameter's value in a trial."""
        if self.choices:
            return trial.suggest_categorical(self.name, self.choices)
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(self.name, self.low, self.high, log=self.log)
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def put(self, settings: dict[str, Any], value: Any) -> None:
        """Set the hyperparameter in ``settings`` to what a value of the parameter stands for."""
        part, _, name = self.setting.rpartition(".")
        made = _FORMS[self.form][0](value)
        if part == "reward":
            arguments = dict(zip(("scale", "power"), training.reward_scaling(settings), strict=True))
            settings["env_wrapper"] = [{training.WRAPPER: {**arguments, name: made}}]
        elif part == "callback":
            settings["callback"] = [{training.CALLBACK: {**_annealing(settings), name: made}}]
        else:
            (settings.setdefault(part, {}) if part else settings)[name] = made

    def value(self, settings: Mapping[str, Any]) -> Any:
        """Return the parameter's value that stands for the hyperparameter in ``settings``; None if there is none."""
        part, _, name = self.setting.rpartition(".")
        if part == "reward":
            setting: Any = training.reward_scaling(settings)[("scale", "power").index(name)]
        elif part == "callback":
            setting = _annealing(settings).get(name)
        else:
            setting = (settings.get(part, {}) if part else settings).get(name)
        try:
            to, back = _FORMS[self.form]
            value = back(setting)
            # "lin_2e-3" may be written in other ways too; everything else must be the very same.
            kept = back(to(value)) == value if self.form == "falling" else to(value) == setting
            return value if kept and self._holds(value) else None
        except (AttributeError, TypeError, ValueError, ZeroDivisionError):  # not there, or another kind of value
            return None

    def _holds(self, value: Any) -> bool:
        return value in self.choices if self.choices else bool(self.low <= value <= self.high)


def _annealing(settings: Mapping[str, Any]) -> dict[str, float]:
    """Return the arguments of the annealed exploration that hyperparameters ask for; none if they ask for none."""
    return {
        name: getattr(callback, name)
        for callback in training.make_callbacks(settings)
        if isinstance(callback, AnnealedExploration)
        for name in ("start", "end")
    }


_NETS = ("32-32", "64-64", "128-128", "256-256", "64-64-64")
_COMMON = (
    Dimension("net", "policy_kwargs.net_arch", "layers", choices=_NETS),
    Dimension("activation", "policy_kwargs.activation_fn", "same", choices=("Tanh", "ReLU")),
    Dimension("reward_power", "reward.power", low=0.3, high=1.0),
)
_OFF_POLICY = (
    Dimension("learning_rate", "learning_rate", "falling", low=1e-4, high=5e-3, log=True),
    Dimension("horizon", "gamma", "horizon", low=20.0, high=500.0, log=True),
    Dimension("tau", "tau", low=2e-3, high=5e-2, log=True),
    Dimension("log2_batch_size", "batch_size", "power of two", low=6, high=9),
    Dimension("log2_gradient_steps", "gradient_steps", "power of two", low=2, high=6),
    Dimension("reward_scale", "reward.scale", low=0.02, high=1.0, log=True),
    *_COMMON,
)
# Around what agents/hyperparameters holds. PPO's rewards need no scale: its advantages are normalised.
SPACES: dict[str, tuple[Dimension, ...]] = {
    "ppo": (
        Dimension("learning_rate", "learning_rate", "falling", low=2e-4, high=1e-2, log=True),
        Dimension("horizon", "gamma", "horizon", low=20.0, high=500.0, log=True),
        Dimension("gae_lambda", "gae_lambda", low=0.8, high=0.99),
        Dimension("log2_n_steps", "n_steps", "power of two", low=5, high=9),
        Dimension("log2_batch_size", "batch_size", "power of two", low=8, high=12),
        Dimension("n_epochs", "n_epochs", "same", low=4, high=16),
        Dimension("log_std_init", "policy_kwargs.log_std_init", low=-1.5, high=0.5),
        *_COMMON,
    ),
    "sac": _OFF_POLICY,
    "td3": (*_OFF_POLICY, Dimension("noise_std", "noise_std", low=0.05, high=0.5)),
    "tqc": (*_OFF_POLICY, Dimension("quantiles_dropped", "top_quantiles_to_drop_per_net", "same", low=0, high=5)),
}
# Where exploration is annealed, it begins where that says.
_ANNEALING = (
    Dimension("log_std_start", "callback.start", low=-1.5, high=0.5),
    Dimension("log_std_end", "callback.end", low=-4.0, high=-1.5),
)
_FRAMES = Dimension("frame_stack", "frame_stack", "same", low=2, high=16)


def search_space(algorithm: str, settings: Mapping[str, Any], fixed: Sequence[str] = ()) -> tuple[Dimension, ...]:
    """Return what is searched for an algorithm.

    Args:
        settings: hyperparameters around which it is; where they stack frames or anneal
            exploration, how many and between what is searched too.
        fixed: names of hyperparameters that are not searched.
    """
    space = SPACES[algorithm] + ((_FRAMES,) if settings.get("frame_stack", 1) > 1 else ())
    if "callback" in settings:
        space = tuple(dimension for dimension in space if dimension.name != "log_std_init") + _ANNEALING
    held = {"reward" if name == "env_wrapper" else name for name in fixed}
    return tuple(dimension for dimension in space if dimension.setting.partition(".")[0] not in held)


# The search -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Search:
    """All that decides what the trials of a study are.

    Attributes:
        plan: of the hyperparameters around which the search is, with the search's seed.
        evaluations: of a trial, evenly spread. space: what is searched. pruner: one of ``PRUNERS``.
        hyperparameter_file: that the plan was read from; None: the one shipped.
    """

    plan: training.Plan
    evaluations: int
    space: tuple[Dimension, ...]
    pruner: str
    hyperparameter_file: Path | None

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

    def trial_plan(self, values: Mapping[str, Any], index: int) -> training.Plan:
        """Return the plan of a trial.

        Args:
            values: of the parameters, by their names. index: of the trial (:func:`trial_index`).
        """
        settings = copy.deepcopy(dict(self.plan.hyperparameters))
        for dimension in self.space:
            dimension.put(settings, values[dimension.name])
        return training.make_plan(
            self.plan.env_id,
            self.plan.algorithm,
            env_kwargs=self.plan.env_kwargs,
            overrides=settings,
            hyperparameter_file=self.hyperparameter_file,
            seed=derived_seed(self.plan.seed, index, 1),
            eval_freq=self.plan.eval_freq,
            eval_episodes=self.plan.eval_episodes,
            device=self.plan.device,
            threads=self.plan.threads,
        )


def derived_seed(*words: int) -> int:
    """Return a seed in [0, 2**32 - 1] that follows from whole numbers, another one from any others."""
    return int(np.random.SeedSequence(words).generate_state(1)[0])


def make_search(
    env_id: str,
    algorithm: str,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    hyperparameter_file: Path | None = None,
    timesteps: int | None = None,
    evaluations: int = 20,
    eval_episodes: int = 100,
    pruner: str = "median",
    seed: int = 0,
) -> Search:
    """Return a checked search; nothing is written.

    Args:
        overrides: hyperparameters that replace those of the file and are not searched.
        timesteps: of each trial; None: the file's. evaluations: of each trial, at most one a step.
        eval_episodes: of each, from ``evaluation.VALIDATION_SEEDS``. The others as ``training.make_plan`` has them.

    Raises:
        TypeError, ValueError: naming the argument, its value and what is allowed.
    """
    if pruner not in PRUNERS:
        raise ValueError(f"pruner must be one of {', '.join(PRUNERS)}, got {pruner!r}")
    plan = training.make_plan(
        env_id,
        algorithm,
        env_kwargs=env_kwargs,
        overrides=overrides,
        hyperparameter_file=hyperparameter_file,
        timesteps=timesteps,
        seed=seed,
        eval_episodes=eval_episodes,
    )
    _check_whole("evaluations", evaluations, plan.steps)
    plan = dataclasses.replace(plan, eval_freq=plan.steps // evaluations)
    space = search_space(algorithm, plan.hyperparameters, list(overrides or {}))
    if not space:
        raise ValueError("nothing is left to be searched: every hyperparameter of the search space is fixed")
    return Search(
        plan=plan, evaluations=evaluations, space=space, pruner=pruner, hyperparameter_file=hyperparameter_file
    )


def _check_whole(name: str, value: Any, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise ValueError(f"{name} must be a whole number in [1, {most}], got {value!r}")


# The study ------------------------------------------------------------------------------------------------------------


class StudyError(ValueError):
    """A study cannot be used: its database cannot be opened, or it is of another configuration."""


class WorkersDiedError(RuntimeError):
    """All workers have ended before the study was complete."""


class InterruptedStudyError(Exception):
    """The study was asked to stop before its end; the same call continues it."""


class _InterruptedTrialError(Exception):
    """A trial was asked to stop before its end, or is one too many."""


def trial_index(study: optuna.Study, number: int) -> int:
    """Return which trial of a study a number is, from 0, where a trial that was tried again is still the same one."""
    with _quiet():
        origin = {
            trial.number: RetryHeartbeatStaleTrialCallback.retried_trial_number(trial)
            for trial in study.get_trials(deepcopy=False)
        }
    first = origin[number]
    first = number if first is None else first
    return first - sum(retried is not None and other < first for other, retried in origin.items())


class _IndexedSampler(BaseSampler):
    """Tree-structured Parzen estimator whose random numbers follow from the seed and the trial's index.

    One generator for all trials would draw the first trials again whenever a study is continued.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.sampler = TPESampler(seed=seed)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        self.sampler = TPESampler(seed=derived_seed(self.seed, trial_index(study, trial.number), 0))
        self.sampler.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return self.sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return self.sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        return self.sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        self.sampler.after_trial(study, trial, state, values)


def _pruner(search: Search) -> BasePruner:
    if search.pruner == "median":
        # On the belt, agents learn nothing that shows for the first third.
        return MedianPruner(n_startup_trials=5, n_warmup_steps=-(-search.evaluations // 3))
    if search.pruner == "hyperband":
        return HyperbandPruner(min_resource=max(1, search.evaluations // 9), max_resource=search.evaluations)
    return NopPruner()


def shown_url(storage: str) -> str:
    """Return the URL of a database without its password.

    Raises:
        StudyError: if it is none, or of a database that cannot be used.
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


def _open_storage(storage: str, heartbeat: int) -> RDBStorage:
    shown = shown_url(storage)
    wait = {"connect_args": {"timeout": 60}} if sqlalchemy.make_url(storage).get_backend_name() == "sqlite" else {}
    try:
        with _quiet():
            return RDBStorage(
                storage,
                engine_kwargs=wait,
                heartbeat_interval=heartbeat,
                grace_period=_GRACE * heartbeat,
                heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(max_retry=_RETRIES),
            )
    except ImportError:
        raise StudyError(f"storage {shown!r} needs its database's driver, which is not installed") from None
    except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.OptunaError, RuntimeError, OSError) as error:
        raise StudyError(f"storage {shown!r} cannot be opened: {_cause(error)}") from None


def _cause(error: BaseException) -> str:
    return str(error.__cause__ or error.__context__ or error).partition("\n")[0]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's warnings that heartbeats, and what belongs to them, may change with its next version."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        yield


def _load(search: Search, storage: RDBStorage, name: str) -> optuna.Study:
    sampler, pruner = _IndexedSampler(search.plan.seed), _pruner(search)
    return optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)


def open_study(search: Search, storage: str, name: str, *, heartbeat: int = HEARTBEAT) -> optuna.Study:
    """Return the study of that name; one that is not there is made.

    Args:
        storage: URL of its database. heartbeat: seconds between signs of life.

    Raises:
        StudyError: if the database cannot be used, or the study is of another configuration; nothing is then changed.
    """
    if not name.strip() or len(name) > 200:
        raise StudyError(f"study must be a name of 1 to 200 characters, got {name!r}")
    shown, opened = shown_url(storage), _open_storage(storage, heartbeat)
    here = search.configuration()
    try:
        study = _load(search, opened, name)
    except KeyError:
        study = optuna.create_study(study_name=name, storage=opened, direction="maximize", load_if_exists=True)
        if not study.user_attrs and not study.get_trials(deepcopy=False):
            study.set_user_attr(_CONFIGURATION, here)
            study.set_user_attr("versions", training.versions() | {"optuna": optuna.__version__})
            start = {dimension.name: dimension.value(search.plan.hyperparameters) for dimension in search.space}
            if None not in start.values():
                study.enqueue_trial(start)
        study = _load(search, opened, name)
    there = study.user_attrs.get(_CONFIGURATION)
    if not isinstance(there, dict):
        raise StudyError(f"study {name!r} in {shown!r} is not one of this program: choose another name")
    for key in here:
        if there.get(key) != here[key]:
            what = f"its {key} is {there.get(key)!r}, not {here[key]!r}"
            if isinstance(here[key], list | dict):
                what = f"its {key} is not that of this search"
            raise StudyError(f"study {name!r} in {shown!r} is of another configuration: {what}; choose another name")
    _check_trials(study)
    return study


def _is_finished(trial: FrozenTrial) -> bool:
    failed = trial.state == TrialState.FAIL and "error" in trial.user_attrs  # by itself: it counts, and stays
    return trial.state in (TrialState.COMPLETE, TrialState.PRUNED) or failed


def _trial_digest(trial: FrozenTrial | Trial, best: Mapping[str, Any]) -> str:
    """Return the digest of what a complete trial has found: parameters, hyperparameters, seed and best evaluation."""
    known = {name: trial.user_attrs.get(name) for name in ("hyperparameters", "seed")}
    return content_digest({"params": dict(trial.params), "best": dict(best), **known})


def _check_trials(study: optuna.Study) -> None:
    """Raise unless the complete trials of a study are what was stored of them; those of earlier versions have no
    digest."""
    for trial in study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
        digest, best = trial.user_attrs.get(_DIGEST), trial.user_attrs.get("best")
        found = best if isinstance(best, dict) else {}
        if trial.value != found.get("credited_return") or digest not in (None, _trial_digest(trial, found)):
            name = f"trial {trial.number} of study {study.study_name!r}"
            raise StudyError(f"{name} is damaged, or changed since it ended")


def finished_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that count: complete, pruned, or failed by themselves (user attribute "error")."""
    return [trial for trial in study.get_trials(deepcopy=False) if _is_finished(trial)]


def best_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the complete trials, best first: by credited return, then by mean return."""
    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    return sorted(
        complete, key=lambda trial: (-float(trial.value or 0.0), -float(trial.user_attrs["best"]["mean_return"]))
    )


# A trial --------------------------------------------------------------------------------------------------------------


def credited_return(policy: Policy, plan: training.Plan) -> dict[str, float]:
    """Return the means over a plan's validation episodes: ``credited_return``, ``mean_return``, ``suppressed``.

    Credited: an episode that was not suppressed counts no more than a passive one (as in training's choice of the best
    model).
    """
    seeds = training.validation_seeds(plan)
    passive = evaluation.passive_episodes(plan.env_id, seeds, plan.env_kwargs)
    table = evaluation.evaluate(policy, plan.env_id, seeds, plan.env_kwargs, passive=passive)
    returns = table["return"]
    credited = np.where(table["suppressed"], returns, np.minimum(returns, np.nansum(passive.reward, axis=1)))
    return {
        "credited_return": float(credited.mean()),
        "mean_return": float(returns.mean()),
        "suppressed": float(table["suppressed"].mean()),
    }


class _Watcher(BaseCallback):
    """Evaluates between rollouts, hands each row to ``report``, and stops when asked to."""

    def __init__(
        self, plan: training.Plan, report: Callable[[dict[str, float]], None], should_stop: Callable[[], bool]
    ) -> None:
        super().__init__()
        self.plan = plan
        self.report = report
        self.should_stop = should_stop
        self.stopped = False
        self.next_evaluation = plan.eval_freq

    def _on_step(self) -> bool:
        self.stopped = self.should_stop()
        return not self.stopped

    def _on_rollout_start(self) -> None:
        if self.next_evaluation <= self.num_timesteps < self.plan.steps:
            self.next_evaluation = (self.num_timesteps // self.plan.eval_freq + 1) * self.plan.eval_freq
            self.evaluate()

    def evaluate(self) -> None:
        policy = training.network_policy(self.model.policy, self.plan.hyperparameters.get("frame_stack", 1))
        self.report({"steps": self.num_timesteps, **credited_return(policy, self.plan)})


def run_plan(
    plan: training.Plan,
    report: Callable[[dict[str, float]], None],
    should_stop: Callable[[], bool] = lambda: False,
) -> bool:
    """Train as a plan says, without a run folder; return whether it came to its end.

    Args:
        report: is given each evaluation (:func:`credited_return`, and ``steps``), the last at the end; what it raises
            ends the training. should_stop: asked after every step.
    """
    torch.set_num_threads(plan.threads)
    envs = training.make_training_envs(
        plan.env_id,
        plan.env_kwargs,
        plan.hyperparameters["n_envs"],
        plan.seed,
        frame_stack=plan.hyperparameters.get("frame_stack", 1),
        scaling=training.reward_scaling(plan.hyperparameters),
    )
    try:
        model = training.make_model(plan, envs)
        watcher = _Watcher(plan, report, should_stop)
        model.learn(plan.steps, callback=[*training.make_callbacks(plan.hyperparameters), watcher])
        if not watcher.stopped:
            watcher.evaluate()
        return not watcher.stopped
    finally:
        envs.close()


def _objective(trial: Trial, search: Search, trials: int, should_stop: Callable[[], bool]) -> float:
    number = trial.number
    others = [other for other in trial.study.get_trials(deepcopy=False) if other.number < number]
    if sum(_is_finished(other) or other.state == TrialState.RUNNING for other in others) >= trials:
        raise _InterruptedTrialError  # another worker was faster
    values = {dimension.name: dimension.suggest(trial) for dimension in search.space}
    plan = search.trial_plan(values, trial_index(trial.study, number))
    trial.set_user_attr("hyperparameters", dict(plan.hyperparameters))
    trial.set_user_attr("seed", plan.seed)
    trial.set_user_attr("process", os.getpid())
    best: dict[str, float] = {}

    def report(row: dict[str, float]) -> None:
        nonlocal best
        key = ("credited_return", "mean_return")
        if not best or [row[name] for name in key] > [best[name] for name in key]:
            best = row
            trial.set_user_attr("best", row)
        # By the share of the budget: rollouts of other lengths are then compared at the same places.
        trial.report(row["credited_return"], min(search.evaluations, int(row["steps"] // plan.eval_freq)))
        if row["steps"] < plan.steps and trial.should_prune():
            raise TrialPruned

    try:
        if not run_plan(plan, report, should_stop):
            raise _InterruptedTrialError
    except UpdateFinishedTrialError:
        raise
    except (ValueError, RuntimeError, ArithmeticError) as error:  # a network that has diverged, memory that is full
        trial.set_user_attr("error", " ".join(f"{type(error).__name__}: {error}".split())[:500])
        raise
    trial.set_user_attr(_DIGEST, _trial_digest(trial, best))
    return best["credited_return"]


# Workers --------------------------------------------------------------------------------------------------------------


def work(
    search: Search,
    storage: str,
    name: str,
    trials: int,
    *,
    heartbeat: int = HEARTBEAT,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Run trials of a study that is there, one after another, until ``trials`` are finished.

    While others still run the last ones, it waits: should they die, it does their trials again. An interrupted trial is
    marked as failed and queued again.

    Args:
        should_stop: asked after every step of training. The others as :func:`tune` has them.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = _load(search, _open_storage(storage, heartbeat), name)
    begun: list[int] = []

    def objective(trial: Trial) -> float:
        begun.append(trial.number)
        return _objective(trial, search, trials, should_stop)

    while not should_stop():
        with _quiet():
            optuna.storages.fail_stale_trials(study)
        finished = len(finished_trials(study))
        if finished >= trials:
            return
        if finished + len(study.get_trials(deepcopy=False, states=[TrialState.RUNNING])) >= trials:
            time.sleep(0.2)
            continue
        expected = (_InterruptedTrialError, ValueError, RuntimeError, ArithmeticError)
        try:
            study.optimize(objective, n_trials=1, catch=expected)
        except UpdateFinishedTrialError:  # no sign of life for too long (a suspended machine): it is queued already
            continue
        trial = study.get_trials()[begun[-1]]
        if trial.state == TrialState.FAIL and not _is_finished(trial):
            with _quiet():
                RetryHeartbeatStaleTrialCallback()(study, trial)


def _process(search: Search, storage: str, name: str, trials: int, heartbeat: int, parent: Connection) -> None:
    """Work in a process of its own until the parent closes its end of the pipe, be it by dying."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent passes it on
    work(search, storage, name, trials, heartbeat=heartbeat, should_stop=parent.poll)


def tune(
    search: Search,
    storage: str,
    name: str,
    trials: int,
    *,
    workers: int = 1,
    heartbeat: int = HEARTBEAT,
    progress: bool = True,
    should_stop: Callable[[], bool] = lambda: False,
) -> optuna.Study:
    """Run a study until ``trials`` of it are finished in all, and return it.

    Several calls, on several machines, may work on one study.

    Args:
        storage: URL of the database. name: of the study in it; one that is there is continued.
        workers: processes, each with one thread of torch, in [1, 256].
        heartbeat: seconds between a trial's signs of life; one without any for six times as long is dead: it is marked
            as failed and tried again.
        progress: show a progress bar on standard error. should_stop: asked about ten times a second.

    Raises:
        StudyError: as :func:`open_study`; nothing is then changed.
        ValueError: if ``trials``, ``workers`` or ``heartbeat`` is out of range.
        InterruptedStudyError: if ``should_stop`` said so; the running trials are then queued again.
        WorkersDiedError: if no worker is left.
    """
    _check_whole("trials", trials, 10**6)
    _check_whole("workers", workers, 256)
    _check_whole("heartbeat", heartbeat, 3600)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = open_study(search, storage, name, heartbeat=heartbeat)
    if len(finished_trials(study)) >= trials:
        return study
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe(duplex=False) for _ in range(workers)]
    processes = [
        context.Process(
            target=_process, args=(search, storage, name, trials, heartbeat, reader), name=f"worker {i}", daemon=True
        )
        for i, (reader, _) in enumerate(pipes)
    ]
    bar = tqdm(total=trials, desc=name, disable=not progress, dynamic_ncols=True, bar_format=_BAR)
    shown = -math.inf
    try:
        _start(processes)
        for reader, _ in pipes:
            reader.close()
        while any(process.is_alive() for process in processes):
            if should_stop():
                raise InterruptedStudyError
            if time.monotonic() - shown > 1.0:
                _show(bar, study, search)
                shown = time.monotonic()
            connection.wait([process.sentinel for process in processes if process.is_alive()], timeout=0.1)
        _show(bar, study, search)
    except optuna.exceptions.StorageInternalError as error:
        raise StudyError(f"storage {shown_url(storage)!r} has failed: {_cause(error)}") from None
    finally:
        bar.close()
        try:
            for _, writer in pipes:
                writer.close()
            for process in processes:
                process.join()
        finally:  # whoever does not want to wait for that
            for process in processes:
                process.kill()
    dead = [f"{process.name}: exit code {process.exitcode}" for process in processes if process.exitcode]
    finished = len(finished_trials(study))
    if finished < trials:
        raise WorkersDiedError(f"no worker is left after {finished} of {trials} trials ({', '.join(dead)})")
    return study


def _start(processes: Sequence[Any]) -> None:
    """Start processes that ignore Ctrl-C from their first moment on: they inherit it."""
    if threading.current_thread() is not threading.main_thread():
        for process in processes:
            process.start()
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        for process in processes:
            process.start()
    finally:
        signal.signal(signal.SIGINT, before)


_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} trials [{elapsed}<{remaining}{postfix}]"


def _show(bar: Any, study: optuna.Study, search: Search) -> None:
    """Bring the progress bar up to date."""
    if bar.disable:
        return
    trials = study.get_trials(deepcopy=False)
    running = [trial for trial in trials if trial.state == TrialState.RUNNING]
    done = sum(_is_finished(trial) for trial in trials)
    bar.n = min(bar.total, done + sum((trial.last_step or 0) / search.evaluations for trial in running))
    best = best_trials(study)
    shown = f"best {best[0].value:.1f}, " if best else ""
    bar.set_postfix_str(f"{shown}{len(running)} running")


# What comes out -------------------------------------------------------------------------------------------------------


def format_trials(study: optuna.Study, most: int = 10) -> str:
    """Return the best trials as an aligned text table, one parameter a column, and a line on all of them."""
    finished, best = finished_trials(study), best_trials(study)
    names = list(dict.fromkeys(name for trial in best for name in trial.params))
    cells = [["trial", "credited", "return", "suppressed", "steps", "seconds", *names]]
    for trial in best[:most]:
        about = trial.user_attrs["best"]
        row = [f"{trial.number}", f"{trial.value:.2f}", f"{about['mean_return']:.2f}", f"{about['suppressed']:.0%}"]
        row += [f"{about['steps']:,}", f"{trial.duration.total_seconds() if trial.duration else 0.0:.0f}"]
        values = (trial.params.get(name, "-") for name in names)
        cells.append([*row, *(f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)])
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = ["  ".join(f"{cell:>{width}}" for cell, width in zip(line, widths, strict=True)) for line in cells]
    count = {state: sum(trial.state == state for trial in finished) for state in TrialState}
    lines.insert(1, "  ".join("-" * width for width in widths))
    lines.append(
        f"{len(finished)} trials: {count[TrialState.COMPLETE]} complete, {count[TrialState.PRUNED]} pruned, "
        f"{count[TrialState.FAIL]} failed"
    )
    return "\n".join(lines)


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


def check_out(path: Path) -> None:
    """Raise unless :func:`write_best` may write a file: one that is there must be one of its own.

    Raises:
        ValueError: if it may not.
    """
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"out must be a file in a folder that exists, got {str(path)!r}")
    try:
        is_ours = not path.exists() or read_text(path).startswith(OUT_HEADER)
    except StoredFileError:
        is_ours = False
    if not is_ours:
        raise ValueError(f"out {str(path)!r} is there and no file of this program: choose another name")


def write_best(study: optuna.Study, path: Path) -> None:
    """Write the best trial's hyperparameters for ``sd-friction train --hyperparameters``, whole or not at all.

    Raises:
        ValueError: if no trial is complete, or as :func:`check_out`. OSError: if it cannot be written.
    """
    check_out(path)
    _check_trials(study)
    best = best_trials(study)
    if not best:
        raise ValueError(f"study {study.study_name!r} has no complete trial")
    about = study.user_attrs[_CONFIGURATION]
    content = {about["env_id"]: zoo_settings(best[0].user_attrs["hyperparameters"])}
    value, suppressed = best[0].value, best[0].user_attrs["best"]["suppressed"]
    lines = [
        OUT_HEADER,
        f"# Study {study.study_name!r}, {about['algo']}: trial {best[0].number} of {len(finished_trials(study))},",
        f"# credited return {value:.2f}, suppressed {suppressed:.0%} of {about['eval_episodes']} validation episodes.",
        yaml.safe_dump(content, sort_keys=False, width=110),
    ]
    with atomic_file(path) as file:
        file.write("\n".join(lines))
