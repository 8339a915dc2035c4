"""Train an agent to suppress the oscillator's vibration, and write a run folder with all that is needed to use it.

    python scripts/train.py --task force --algo ppo
    python scripts/train.py --task belt --tier randomised --algo sac --seed 3 --run-folder runs/mine
    python scripts/train.py --task belt --algo ppo --set learning_rate=lin_1e-3 --set gamma=0.97
    python scripts/train.py --run-folder runs/mine --resume

Hyperparameters come from agents/hyperparameters/ALGO.yml; --set replaces single ones. Ctrl-C stops after the rollout
that is running and what is learnt from it, keeps a last checkpoint in NAME.partial, and exits with status 130; Ctrl-C
again does not wait. However a run ended, --resume goes on from its last checkpoint, with the same command again or the
run folder alone, and comes to the same weights as if nothing had happened. Watch a run: tensorboard --logdir runs
"""

import argparse
import shlex
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.learning import runs
from sd_friction_env.learning.settings import ALGORITHMS

TASKS = {"force": "Force", "belt": "BeltSpeed"}
TIERS = {"nominal": "", "randomised": "Randomised", "sensed": "Sensed"}


# What decides what a run gives; a run folder knows it, so --resume can do without.
_SETTINGS = (
    "task",
    "tier",
    "env_id",
    "env_arg",
    "algo",
    "seed",
    "timesteps",
    "envs",
    "hyperparameters",
    "overrides",
    "device",
    "threads",
    "eval_freq",
    "eval_episodes",
)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with status 2."""
        self.exit(2, f"{self.prog}: error: {message}\n")


def environment_id(task: str, tier: str) -> str:
    """Return the registered id of a task and tier."""
    return f"SDFriction/{TASKS[task]}{TIERS[tier]}-v0"


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="train.py"
    )
    what = parser.add_argument_group("what to train")
    what.add_argument("--task", choices=TASKS, help="actuator: a force on the mass, or the belt's speed")
    what.add_argument("--tier", choices=TIERS, help="what is hidden (default: nominal)")
    what.add_argument("--env-id", metavar="ID", help=f"instead of --task and --tier: {', '.join(ENVIRONMENT_IDS)}")
    what.add_argument(
        "--env-arg",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="argument of the environment, the value in YAML, such as w_effort=0.2; may be repeated",
    )
    how = parser.add_argument_group("how")
    how.add_argument("--algo", choices=ALGORITHMS, help="algorithm")
    how.add_argument("--seed", type=int, help="of everything random (default: 0)")
    how.add_argument("--timesteps", type=int, metavar="N", help="environment steps (default: the file's n_timesteps)")
    how.add_argument("--envs", type=int, metavar="N", help="environments side by side (default: the file's n_envs)")
    how.add_argument("--hyperparameters", type=Path, metavar="FILE", help="another file in RL Zoo's format")
    how.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="overrides",
        help="replace one hyperparameter, the value in YAML; may be repeated",
    )
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
    return parser


def assignments(option: str, given: Sequence[str]) -> dict[str, Any]:
    """Return NAME=VALUE arguments as a mapping, the values read as YAML (safely).

    Raises:
        ValueError: if one is not of that form.
    """
    from sd_friction_env.storage import StoredFileError, parse_yaml

    values: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            if not equals or not name.isidentifier():
                raise StoredFileError("it has no name")
            values[name] = parse_yaml(value)
        except StoredFileError as error:
            shown = repr(text[:200])
            raise ValueError(f"{option} must be NAME=VALUE with a value in YAML, got {shown} ({error})") from None
    return values


def _chosen_environment(parser: Parser, options: argparse.Namespace) -> str:
    """Return the id of the environment that the command line names, or exit with status 2."""
    if options.algo is None:
        parser.error("the following arguments are required: --algo (only --resume with --run-folder goes without)")
    if (options.task is None) == (options.env_id is None):
        parser.error(f"one of --task ({', '.join(TASKS)}) and --env-id is needed")
    env_id: str = options.env_id or environment_id(options.task, options.tier or "nominal")
    if env_id not in ENVIRONMENT_IDS:
        parser.error(f"--env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {env_id!r}")
    if options.env_id and options.tier not in (None, "nominal"):
        parser.error(f"--tier {options.tier} goes with --task, not with --env-id, which names its tier itself")
    return env_id


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning in one line."""
    print(f"train.py: warning: {' '.join(str(message).split())}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    settings = {name: getattr(options, name) for name in _SETTINGS if getattr(options, name) not in (None, [])}
    by_folder = options.resume and options.run_folder is not None and not settings
    env_id = "" if by_folder else _chosen_environment(parser, options)
    if options.run_folder is None:
        name = f"{options.task}-{options.tier or 'nominal'}" if options.task else env_id.rpartition("/")[2]
        options.run_folder = Path("runs") / f"{name}-{options.algo}-{options.seed or 0}"

    interrupted = False

    def note_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if interrupted:  # a second Ctrl-C does not wait for the step to end
            raise KeyboardInterrupt
        interrupted = True

    try:
        runs.check_free(options.run_folder, force=options.force or options.resume)
        partial = runs.partial_folder(options.run_folder)
        found = options.resume and (partial.is_dir() or options.run_folder.is_dir())
        finished = found and not partial.is_dir()
        config = runs.load_config(options.run_folder) if finished else {}
        if not finished and (found or by_folder):
            config = runs.load_unfinished(options.run_folder, force=options.force)
        env_kwargs = assignments("--env-arg", options.env_arg)
        overrides = assignments("--set", options.overrides)
        from sd_friction_env.learning import training
        from sd_friction_env.learning.plan import check_same, checked_freq, make_plan, plan_of

        if by_folder:
            plan = plan_of(config)
        else:
            same = ("timesteps", "envs", "seed", "eval_freq", "eval_episodes", "device", "threads")
            plan = make_plan(
                env_id,
                options.algo,
                env_kwargs=env_kwargs,
                overrides=overrides,
                hyperparameter_file=options.hyperparameters,
                **{name: settings[name] for name in same if name in settings},
            )
        if options.checkpoint_freq is not None:
            checked_freq("checkpoint-freq", options.checkpoint_freq)
        if finished:
            check_same(config, plan, options.run_folder)
            print(f"{options.run_folder} is finished: there is nothing to resume")
            return 0
    except (TypeError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    except KeyboardInterrupt:
        print("\ntrain.py: interrupted before training began; nothing was written", file=sys.stderr)
        return 130

    what = "Resuming" if found else "Training"
    print(f"{what} {plan.algorithm} on {plan.env_id}: {plan.steps:,} steps, seed {plan.seed}, in {options.run_folder}")
    before = signal.signal(signal.SIGINT, note_interrupt)
    go_on = f"go on with: python scripts/train.py --run-folder {shlex.quote(str(options.run_folder))} --resume"
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            result = training.train(
                plan,
                options.run_folder,
                force=options.force,
                resume=found,
                checkpoint_freq=options.checkpoint_freq,
                progress=not options.no_progress,
                command=" ".join(["python", "scripts/train.py", *(sys.argv[1:] if arguments is None else arguments)]),
                should_stop=lambda: interrupted,
            )
    except runs.RunFolderError as error:
        parser.error(" ".join(str(error).split()))
    except training.StoppedError as stop:
        print(f"\ntrain.py: interrupted: {stop}; {go_on}", file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print(f"\ntrain.py: interrupted; what was written is in {str(partial)!r}; {go_on}", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"train.py: error: the run cannot be written: {error}; with space to write, {go_on}", file=sys.stderr)
        return 1
    except MemoryError as error:
        print(f"train.py: error: the memory does not suffice for these hyperparameters: {error}", file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGINT, before)
    best = result.best
    print(
        f"{result.steps:,} steps in {result.seconds:.0f} s. Best after {best['steps']:,} steps: return "
        f"{best['mean_return']:.1f}, suppressed {best['suppressed']:.0%} of {plan.eval_episodes} validation episodes.\n"
        f"Compare it: python scripts/evaluate.py {result.folder} --controller velocity-feedback"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
