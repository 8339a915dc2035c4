"""One trial: training without a run folder, evaluated, pruned, sealed."""

import os
from collections.abc import Callable

from optuna.exceptions import TrialPruned, UpdateFinishedTrialError
from optuna.trial import Trial
from stable_baselines3.common.callbacks import BaseCallback

from sd_friction_env.learning import training
from sd_friction_env.learning.models import make_callbacks, model_of
from sd_friction_env.learning.networks import network_policy
from sd_friction_env.learning.plan import Plan
from sd_friction_env.learning.tuning.study import Search, derived_seed, seal_trial

Report = Callable[[dict[str, float]], None]
FAILURES = (ValueError, RuntimeError, ArithmeticError)  # a network that diverges, a memory that is full


class InterruptedTrialError(Exception):
    """A trial was asked to stop before its end; it is queued to be run again."""


class _Watcher(BaseCallback):
    """Evaluates between rollouts, reports each evaluation, and stops on request."""

    def __init__(self, plan: Plan, report: Report, should_stop: Callable[[], bool]) -> None:
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
            self.next_evaluation = training.next_multiple(self.num_timesteps, self.plan.eval_freq)
            self.evaluate()

    def evaluate(self) -> None:
        actor = network_policy(self.model.policy, self.plan.frames)
        self.report({"steps": self.num_timesteps, **training.validate(actor, self.plan)})


def run_plan(plan: Plan, report: Report, should_stop: Callable[[], bool] = lambda: False) -> bool:
    """Train as a plan says, without a run folder; return whether training reached its end.

    Args:
        report: called with each evaluation (:func:`training.validate`, and ``steps``), the last at the end; what it
            raises ends the training. should_stop: called after every step.
    """
    with model_of(plan) as model:
        watcher = _Watcher(plan, report, should_stop)
        model.learn(plan.steps, callback=[*make_callbacks(plan.hyperparameters), watcher])
        if not watcher.stopped:
            watcher.evaluate()
        return not watcher.stopped


def run_trial(trial: Trial, search: Search, should_stop: Callable[[], bool]) -> float:
    """Run a trial and return its best credited return.

    Raises:
        InterruptedTrialError: if ``should_stop`` returned True. TrialPruned: if the pruner ended it.
        One of ``FAILURES``: if training failed; the user attribute "error" then says why.
    """
    values = {dimension.name: dimension.suggest(trial) for dimension in search.space}
    plan = search.trial_plan(values, trial.user_attrs.get("seed", derived_seed(search.plan.seed, trial.number)))
    attributes = {"hyperparameters": dict(plan.hyperparameters), "seed": plan.seed, "process": os.getpid()}
    for name, value in attributes.items():
        trial.set_user_attr(name, value)
    best: dict[str, float] = {}

    def report(row: dict[str, float]) -> None:
        nonlocal best
        if training.is_better(row, best):
            best = row
            trial.set_user_attr("best", row)
        # By the share of the budget: rollouts of different lengths are then compared at the same places.
        trial.report(row["credited_return"], min(search.evaluations, int(row["steps"] // plan.eval_freq)))
        if row["steps"] < plan.steps and trial.should_prune():
            raise TrialPruned

    try:
        is_complete = run_plan(plan, report, should_stop)
    except UpdateFinishedTrialError:  # it has missed its heartbeats and is queued again
        raise
    except FAILURES as error:
        trial.set_user_attr("error", " ".join(f"{type(error).__name__}: {error}".split())[:500])
        raise
    if not is_complete:
        trial.study.enqueue_trial(trial.params, user_attrs={"seed": plan.seed})
        raise InterruptedTrialError
    seal_trial(trial, best)
    return best["credited_return"]
