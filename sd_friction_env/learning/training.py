"""Training with Stable-Baselines3: evaluation, best model, checkpoints and TensorBoard in one folder per run."""

import math
import os
import platform
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import sd_friction_env
from sd_friction_env import Table
from sd_friction_env.control.policies import NetworkPolicy, Policy
from sd_friction_env.learning import checkpoints, evaluation, runs
from sd_friction_env.learning.models import make_callbacks, model_of
from sd_friction_env.learning.networks import network_policy
from sd_friction_env.learning.plan import Plan, check_same, checked_freq
from sd_friction_env.learning.ppo import FastPPO
from sd_friction_env.learning.tensors import save_tensors
from sd_friction_env.learning.versions import versions as versions_of
from sd_friction_env.learning.warm_start import clone, fit_critic

Row = dict[str, Any]


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
    """Result of a finished run.

    Attributes:
        folder: of the run. policy: the best model's actor. steps: done in all. seconds: wall time of training.
        best: the row of evaluations.csv that belongs to the best model. evaluations: all rows.
    """

    folder: Path
    policy: NetworkPolicy
    steps: int
    seconds: float
    best: Mapping[str, Any]
    evaluations: Table


def versions() -> dict[str, str]:
    """Return the versions of everything that a trained agent depends on."""
    modules = (gymnasium, np, torch, stable_baselines3, sb3_contrib)
    return {"python": platform.python_version(), **versions_of(*modules)}


# Evaluation -----------------------------------------------------------------------------------------------------------


def validate(policy: Policy, plan: Plan) -> dict[str, float]:
    """Return the means over a plan's validation episodes, as the rows of evaluations.csv have them.

    ``credited_return`` is the mean of the returns in which an episode that is not suppressed counts no more than a
    passive one: by return alone, a belt that stays slow would beat one that returns to its speed.
    """
    seeds = plan.validation_seeds
    passive = evaluation.passive_episodes(plan.env_id, seeds, plan.env_kwargs)
    table = evaluation.evaluate(policy, plan.env_id, seeds, plan.env_kwargs, passive=passive)
    returns, suppressed = table["return"], table["suppressed"]
    credited = np.where(suppressed, returns, np.minimum(returns, np.nansum(passive.reward, axis=1)))
    names = ("suppressed", "amplitude_reduction", "stick_fraction", "belt_speed_ratio", "rms_action")
    return {
        "mean_return": float(returns.mean()),
        "std_return": float(returns.std()),
        "credited_return": float(credited.mean()),
        **{name: float(table[name].mean()) for name in names},
    }


def is_better(row: Mapping[str, float], best: Mapping[str, float]) -> bool:
    """Return whether an evaluation beats the best so far (which may be empty): by credited, then by mean return."""
    names = ("credited_return", "mean_return")
    return not best or [row[name] for name in names] > [best[name] for name in names]


def next_multiple(steps: int, freq: int) -> int:
    """Return the first multiple of ``freq`` beyond ``steps``."""
    return (steps // freq + 1) * freq


# Watching a run -------------------------------------------------------------------------------------------------------


def log_episodes(infos: Sequence[Mapping[str, Any]], dones: NDArray[np.bool_], logger: Logger) -> None:
    """Log the statistics of the episodes that have just ended."""
    for i in np.flatnonzero(dones).tolist():
        for name, value in infos[i]["statistics"].items():
            if name not in ("return", "length") and not math.isnan(value):  # SB3 logs these two itself
                logger.record_mean(f"episode/{name}", value)


class _TensorBoard(TensorBoardOutputFormat):
    """Event files; those of a resumed run make readers drop what was logged after its checkpoint."""

    def __init__(self, folder: Path, resumed_at: int | None) -> None:
        # Readers take the files in the order of their names, which begin with the second of their creation.
        seconds = [name.split(".")[3] for name in os.listdir(folder)] if folder.is_dir() else []
        last = max((int(second) for second in seconds if second.isdecimal()), default=0)
        time.sleep(min(max(0.0, last + 1.0 - time.time()), 1.0))
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=None if resumed_at is None else resumed_at + 1)
        self._is_closed = False


class _Supervisor(BaseCallback):
    """Watches a run: statistics, evaluation, best model, checkpoints, progress, and requests to stop."""

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        checkpoint_freq: int,
        progress: bool,
        should_stop: Callable[[], bool],
        on_evaluation: Callable[[Mapping[str, Any]], None],
    ) -> None:
        super().__init__()
        self.plan = plan
        self.folder = folder  # the partial one
        self.checkpoint_freq = checkpoint_freq
        self.progress = progress
        self.should_stop = should_stop
        self.on_evaluation = on_evaluation
        self.stopped = False
        self.rows: list[Row] = []
        self.best: Row = {}
        self.best_weights: dict[str, torch.Tensor] = {}
        self.next_evaluation = self.next_checkpoint = 0
        self.seconds = 0.0  # of training in processes before this one
        self.noises: Mapping[str, torch.Tensor] = {}  # of a checkpoint
        self.checkpoint: Path | None = None  # the last whole one
        self.started = time.perf_counter()
        self.bar: Any = None

    # State

    def restore(self, checkpoint: Path, saved: Mapping[str, Any], logger: Logger) -> None:
        """Continue from the content of a checkpoint; restore the folder's table and best model to that moment."""
        run = saved["run"]
        self.checkpoint, self.noises = checkpoint, saved["noises"]
        self.rows, self.best, self.best_weights = run["rows"], run["best"], run["best_weights"]
        self.seconds = run["seconds"]
        for name, (value, count, excluded) in run["logged"].items():
            logger.name_to_value[name], logger.name_to_excluded[name] = value, tuple(excluded)
            if count:
                logger.name_to_count[name] = count
        if self.rows:
            self.table().to_csv(self.folder / runs.EVALUATIONS)
            save_tensors(self.folder / runs.WEIGHTS, self.best_weights)
        else:
            for name in (runs.EVALUATIONS, runs.WEIGHTS):
                (self.folder / name).unlink(missing_ok=True)

    def _state(self) -> dict[str, Any]:
        values, counts, excluded = self.logger.name_to_value, self.logger.name_to_count, self.logger.name_to_excluded
        return {
            "rows": self.rows,
            "best": self.best,
            "best_weights": self.best_weights,
            "seconds": time.perf_counter() - self.started,
            "logged": {name: (float(value), counts.get(name, 0), excluded[name]) for name, value in values.items()},
        }

    def save_checkpoint(self, *, at_end: bool = False) -> Path:
        """Write a checkpoint, keep the one before it, and return the new file."""
        path = self.folder / runs.CHECKPOINTS / f"step_{self.num_timesteps:012d}.pt"
        checkpoints.save_checkpoint(path, self.plan, self.model, self._state(), at_end=at_end)
        runs.keep_checkpoints(self.folder, path, self.checkpoint)
        self.checkpoint = path
        return path

    # Hooks of Stable-Baselines3

    def _on_training_start(self) -> None:
        self.started = time.perf_counter() - self.seconds
        (self.folder / runs.CHECKPOINTS).mkdir(exist_ok=True)
        if self.noises:  # they have just been reset
            checkpoints.restore_noises(self.model, self.noises)
        self.next_evaluation = next_multiple(self.num_timesteps, self.plan.eval_freq)
        self.next_checkpoint = next_multiple(self.num_timesteps, self.checkpoint_freq)
        self.bar = tqdm(
            total=self.plan.steps,
            initial=min(self.num_timesteps, self.plan.steps),
            desc=f"{self.plan.algorithm} {self.plan.env_id}",
            unit=" steps",
            unit_scale=True,
            disable=not self.progress,
            dynamic_ncols=True,
            mininterval=0.5,
        )
        if isinstance(self.model, FastPPO) and self.plan.start_from is not None and not self.num_timesteps:
            clone(self.model, self.plan)
            self.evaluate()  # training may make it worse
            fit_critic(self.model, self.plan)

    def _on_step(self) -> bool:
        log_episodes(self.locals["infos"], self.locals["dones"], self.logger)
        if self.n_calls == 1:
            self.bar.unpause()  # the time left does not count what the first step compiled
        self.bar.update(min(self.num_timesteps, self.plan.steps) - self.bar.n)
        self.stopped = self.stopped or self.should_stop()
        return True

    def _on_rollout_start(self) -> None:
        # Between rollouts: PPO's policy does not change during one, and a checkpoint within one could not be exact.
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation = next_multiple(self.num_timesteps, self.plan.eval_freq)
            self.evaluate()
        if self.stopped or self.num_timesteps >= self.next_checkpoint:
            self.next_checkpoint = next_multiple(self.num_timesteps, self.checkpoint_freq)
            checkpoint = self.save_checkpoint()
            if self.stopped:
                raise StoppedError(self.num_timesteps, checkpoint)

    # Evaluation

    def evaluate(self) -> None:
        """Evaluate the present actor; keep its weights if it is the best so far (see :func:`is_better`)."""
        found = validate(self.actor(), self.plan)
        row: Row = {"steps": self.num_timesteps, "seconds": round(time.perf_counter() - self.started, 3), **found}
        self.rows.append(row)
        self.table().to_csv(self.folder / runs.EVALUATIONS)
        for name, value in row.items():
            if name != "steps":
                self.logger.record(f"eval/{name}", value)
        if is_better(row, self.best):
            self.best = row
            self.best_weights = {name: part.detach().clone() for name, part in self.model.policy.state_dict().items()}
            save_tensors(self.folder / runs.WEIGHTS, self.best_weights)
        self.bar.set_postfix_str(f"return {row['mean_return']:.1f}, suppressed {row['suppressed']:.0%}")
        self.on_evaluation(dict(row))

    def actor(self, steps: int | None = None) -> NetworkPolicy:
        """Return the present actor, which was trained for ``steps`` (None: all that are done)."""
        about = {
            "env_id": self.plan.env_id,
            "env_kwargs": dict(self.plan.env_kwargs),
            "algorithm": self.plan.algorithm,
            **({"start_from": self.plan.start_from} if self.plan.start_from else {}),
            "seed": self.plan.seed,
            "steps": self.num_timesteps if steps is None else steps,
            "sd_friction_env": sd_friction_env.__version__,
        }
        return network_policy(self.model.policy, self.plan.frames, about)

    def table(self) -> Table:
        """Return all evaluations so far."""
        return Table.from_rows(self.rows)


# Training -------------------------------------------------------------------------------------------------------------


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

    A run that was stopped or killed continues from its last checkpoint, or from the beginning if it has none. On the
    CPU the result is bit for bit that of an uninterrupted run, except for wall times; rows of evaluations.csv and
    TensorBoard's events from after the checkpoint are dropped and written again. On CUDA it is as repeatable as two
    runs of one seed are there. If the last checkpoint is damaged, the run continues from the one before it.

    Args:
        folder: of the finished run. force: replace an existing run.
        resume: continue the unfinished run of this plan.
        checkpoint_freq: environment steps between two checkpoints, which are taken between rollouts; None: that of the
            unfinished run, otherwise that of the evaluations.
        progress: show a progress bar on standard error. command: what the user typed, for the record.
        should_stop: called after every step; once it returns True, training stops after the present rollout and the
            update that follows it, with a last checkpoint.
        on_evaluation: called with every new row of evaluations.csv; it may raise to end the training.

    Warns:
        UserWarning: if a run is resumed with other versions than it was begun with, or its last checkpoint is damaged.

    Raises:
        TypeError, ValueError: if ``checkpoint_freq`` is not a whole number in [1, 1e12].
        runs.RunFolderError: if the folder is taken, there is nothing to resume, the unfinished run is damaged or of
            another plan, or another process works on it; nothing is then written.
        OSError: if something cannot be written; the last checkpoint is then unchanged.
        StoppedError: if ``should_stop`` returned True; the folder keeps its partial name.
    """
    runs.check_free(folder, force=force or resume)
    begun = runs.load_unfinished(folder, force=force) if resume else None
    if checkpoint_freq is None:
        checkpoint_freq = (begun or {}).get("checkpoint_freq", plan.eval_freq)
    checkpoint_freq = checked_freq("checkpoint-freq", checkpoint_freq)
    partial = runs.partial_folder(folder)
    supervisor = _Supervisor(plan, partial, checkpoint_freq, progress, should_stop, on_evaluation)
    with runs.only_here(folder), model_of(plan) as model:
        begun = runs.load_unfinished(folder, force=force) if resume else None  # another process may have ended it
        config = plan.configuration() | {
            "spaces": {
                "observation": runs.describe_space(model.observation_space),
                "action": runs.describe_space(model.action_space),
            },
            "checkpoint_freq": checkpoint_freq,
            "versions": versions(),
            "command": command,
        }
        checkpoint = None if begun is None else _resume(plan, partial, begun, model, config)
        if checkpoint is None:
            runs.begin(folder, config, force=force or begun is not None)
        _learn(supervisor, model, checkpoint)
        return _finish(supervisor, folder, config, force)


def _resume(
    plan: Plan, partial: Path, begun: Mapping[str, Any], model: BaseAlgorithm, config: dict[str, Any]
) -> tuple[Path, Mapping[str, Any]] | None:
    """Restore a model from the last checkpoint of the run that was begun, and return that; None if it has none yet."""
    check_same(begun, plan, partial)
    found = checkpoints.last_whole_checkpoint(runs.checkpoints(partial))
    if found is None:
        return None
    checkpoints.restore_checkpoint(*found, model, plan)
    now = versions()
    then = {**begun["versions"], **(begun.get("resumed") or [{}])[-1].get("versions", {})}
    changed = [f"{name} {then.get(name)} -> {version}" for name, version in now.items() if then.get(name) != version]
    if changed:
        warnings.warn(f"the run was begun with other versions: {', '.join(changed)}", stacklevel=3)
    config |= {name: begun[name] for name in ("versions", "command") if name in begun}
    config["resumed"] = [*begun.get("resumed", []), {"steps": model.num_timesteps, "versions": now}]
    runs.write_unfinished(partial, config)
    runs.remove_leftovers(partial)
    return found


def _learn(supervisor: _Supervisor, model: BaseAlgorithm, checkpoint: tuple[Path, Mapping[str, Any]] | None) -> None:
    """Train to the end of the plan, from the beginning or from a restored checkpoint."""
    plan = supervisor.plan
    resumed_at = None if checkpoint is None else model.num_timesteps
    logger = Logger(None, [_TensorBoard(supervisor.folder / runs.TENSORBOARD, resumed_at)])
    model.set_logger(logger)
    try:
        if checkpoint is not None:
            supervisor.restore(*checkpoint, logger)
        model.learn(
            plan.steps - (resumed_at or 0),
            callback=[*make_callbacks(plan.hyperparameters), supervisor],
            # Off-policy algorithms log per episode, and all environments end theirs together.
            log_interval=1 if plan.algorithm == "ppo" else plan.hyperparameters["n_envs"],
            reset_num_timesteps=checkpoint is None,
        )
        # A run that was killed after its last checkpoint has been evaluated already.
        if not supervisor.rows or supervisor.rows[-1]["steps"] < model.num_timesteps:
            supervisor.evaluate()
            logger.dump(model.num_timesteps)
            supervisor.save_checkpoint(at_end=True)
    finally:
        if supervisor.bar is not None:
            supervisor.bar.close()
        logger.close()


def _finish(supervisor: _Supervisor, folder: Path, config: Mapping[str, Any], force: bool) -> Result:
    """Store the best actor, give the folder its name and return the result."""
    model, best, seconds = supervisor.model, supervisor.best, supervisor.rows[-1]["seconds"]
    model.policy.load_state_dict(supervisor.best_weights)
    actor = supervisor.actor(best["steps"])
    actor.save(supervisor.folder / runs.NETWORK)
    runs.keep_checkpoints(supervisor.folder, supervisor.checkpoint)
    runs.finish(folder, {**config, "steps": model.num_timesteps, "seconds": seconds, "best": best}, force=force)
    return Result(folder, actor, model.num_timesteps, seconds, best, supervisor.table())
