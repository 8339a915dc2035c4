"""``sd-friction train``: an agent that suppresses the oscillator's vibration, in a run folder."""

import argparse
import shlex
import sys
import warnings
from pathlib import Path
from typing import Any

from sd_friction_env.cli.options import (
    INTERRUPTED,
    Command,
    FailedError,
    UsageError,
    add_environment,
    add_overrides,
    assignments,
    command_line,
    environment_of,
    stop_requests,
)
from sd_friction_env.learning import runs
from sd_friction_env.learning.settings import ALGORITHMS

TEXT = """\
The hyperparameters are the tuned ones of agents/hyperparameters/ALGO.yml (sd-friction hyperparameters ALGO); --set
replaces single ones. Ctrl-C stops after the current rollout and update, keeps a checkpoint in NAME.partial, and exits
with status 130; a second Ctrl-C stops at once. However a run ended, --resume continues from its last checkpoint, given
the same command or the run folder alone, and reaches the same weights as an uninterrupted run.
Watch a run: tensorboard --logdir runs"""

# What determines a run's result; a run folder knows it, so --resume can do without.
_PLANNED = (
    *("start_from", "implementation", "timesteps", "envs", "seed", "eval_freq", "eval_episodes", "device", "threads"),
)
_SETTINGS = ("task", "tier", "env_id", "env_arg", "algo", "hyperparameters", "overrides", *_PLANNED)


def _add(parser: argparse.ArgumentParser) -> None:
    what = parser.add_argument_group("what to train")
    add_environment(what)
    how = parser.add_argument_group("how")
    how.add_argument("--algo", choices=ALGORITHMS, help="algorithm")
    text = (
        "start with a clone of a controller (PPO): threshold-follower, rollout, a policy's .npz, or MODULE:NAME, with "
        "the numbers of agents/hyperparameters/ppo_warm_start.yml"
    )
    how.add_argument("--start-from", metavar="CONTROLLER", help=text)
    text = "of the algorithm (default: fast, where it is possible: PPO on the CPU)"
    how.add_argument("--implementation", choices=("fast", "stable-baselines3"), help=text)
    how.add_argument("--seed", type=int, help="of everything random (default: 0)")
    how.add_argument("--timesteps", type=int, metavar="N", help="environment steps (default: the file's n_timesteps)")
    how.add_argument("--envs", type=int, metavar="N", help="environments side by side (default: the file's n_envs)")
    how.add_argument("--hyperparameters", type=Path, metavar="FILE", help="another file in RL Zoo's format")
    add_overrides(how, "replace one hyperparameter")
    how.add_argument("--device", help="of torch: cpu, cuda or auto (default: cpu)")
    how.add_argument("--threads", type=int, help="of torch; more than 1 seldom pays here (default: 1)")
    out = parser.add_argument_group("what is written")
    out.add_argument("--run-folder", type=Path, metavar="FOLDER", help="default: runs/TASK-TIER-ALGO-SEED")
    out.add_argument("--force", action="store_true", help="replace a run that is there")
    out.add_argument(
        "--resume",
        action="store_true",
        help="go on with the unfinished run of this command, or with that in --run-folder",
    )
    out.add_argument(
        "--eval-freq", type=int, metavar="N", help="steps between evaluations (default: a twentieth of all)"
    )
    out.add_argument("--eval-episodes", type=int, metavar="N", help="of each evaluation (default: 50)")
    out.add_argument(
        "--checkpoint-freq", type=int, metavar="N", help="steps between checkpoints (default: with each evaluation)"
    )
    out.add_argument("--no-progress", action="store_true", help="no progress bar")


def _planned(options: argparse.Namespace) -> tuple[Any, bool, bool]:
    """Return the plan, whether it goes on with a run, and whether that run is finished; sets ``options.run_folder``."""
    settings = {name: getattr(options, name) for name in _SETTINGS if getattr(options, name) not in (None, [])}
    by_folder = options.resume and options.run_folder is not None and not settings
    if not by_folder and options.algo is None:
        raise UsageError("--algo is required (only --resume with --run-folder goes without)")
    env_id = "" if by_folder else environment_of(options)
    if options.run_folder is None:
        name = f"{options.task}-{options.tier or 'nominal'}" if options.task else env_id.rpartition("/")[2]
        options.run_folder = Path("runs") / f"{name}-{options.algo}-{options.seed or 0}"
    runs.check_free(options.run_folder, force=options.force or options.resume)
    partial = runs.partial_folder(options.run_folder)
    found = options.resume and (partial.is_dir() or options.run_folder.is_dir())
    finished = found and not partial.is_dir()
    config = runs.load_config(options.run_folder) if finished else {}
    if not finished and (found or by_folder):
        config = runs.load_unfinished(options.run_folder, force=options.force)
    env_kwargs = assignments("--env-arg", options.env_arg)
    overrides = assignments("--set", options.overrides)
    from sd_friction_env.learning.plan import check_same, checked_freq, make_plan, plan_of

    if by_folder:
        plan = plan_of(config)
    else:
        plan = make_plan(
            env_id,
            options.algo,
            env_kwargs=env_kwargs,
            overrides=overrides,
            hyperparameter_file=options.hyperparameters,
            **{name: settings[name] for name in _PLANNED if name in settings},
        )
    if options.checkpoint_freq is not None:
        checked_freq("checkpoint-freq", options.checkpoint_freq)
    if finished:
        check_same(config, plan, options.run_folder)
    return plan, found, finished


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"sd-friction train: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _train(options: argparse.Namespace) -> int:
    plan, found, finished = _planned(options)
    folder = options.run_folder
    if finished:
        print(f"{folder} is finished: there is nothing to resume")
        return 0
    from sd_friction_env.learning import training

    what = "Resuming" if found else "Training"
    start = f", started from {plan.start_from}" if plan.start_from else ""
    print(f"{what} {plan.algorithm} on {plan.env_id}: {plan.steps:,} steps, seed {plan.seed}{start}, in {folder}")
    go_on = f"continue with: sd-friction train --run-folder {shlex.quote(str(folder))} --resume"
    try:
        with stop_requests() as should_stop, warnings.catch_warnings():
            warnings.showwarning = _show_warning
            result = training.train(
                plan,
                folder,
                force=options.force,
                resume=found,
                checkpoint_freq=options.checkpoint_freq,
                progress=not options.no_progress,
                command=command_line(options),
                should_stop=should_stop,
            )
    except (training.StoppedError, KeyboardInterrupt) as stop:
        text = str(stop) or f"what was written is in {str(runs.partial_folder(folder))!r}"
        print(f"\nsd-friction train: interrupted: {text}; {go_on}", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        raise FailedError(f"the run cannot be written: {error}; with space to write, {go_on}") from None
    except MemoryError as error:
        raise FailedError(f"the memory does not suffice for these hyperparameters: {error}") from None
    best = result.best
    print(
        f"{result.steps:,} steps in {result.seconds:.0f} s. Best after {best['steps']:,} steps: return "
        f"{best['mean_return']:.1f}, suppressed {best['suppressed']:.0%} of {plan.eval_episodes} validation episodes.\n"
        f"Compare it: sd-friction evaluate {result.folder} --controller velocity-feedback"
    )
    return 0


COMMANDS = {
    "train": Command(
        _add,
        _train,
        [
            "--task force --algo ppo",
            "--task belt --tier randomised --algo sac --seed 3 --run-folder runs/mine",
            "--task belt --algo ppo --set learning_rate=lin_1e-3 --set gamma=0.97",
            "--run-folder runs/mine --resume",
        ],
        TEXT,
    )
}
