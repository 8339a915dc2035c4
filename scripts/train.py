"""Train an agent to suppress the oscillator's vibration, and write a run folder with all that is needed to use it.

    python scripts/train.py --task force --algo ppo
    python scripts/train.py --task belt --tier randomised --algo sac --seed 3 --run-folder runs/mine
    python scripts/train.py --task belt --algo ppo --set learning_rate=lin_1e-3 --set gamma=0.97

Hyperparameters come from agents/hyperparameters/ALGO.yml; --set replaces single ones. Ctrl-C stops after the step that
is running, keeps a last checkpoint in NAME.partial, and exits with status 130. Watch a run: tensorboard --logdir runs
"""

import argparse
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from agents import runs
from sd_friction_env import ENVIRONMENT_IDS

TASKS = {"force": "Force", "belt": "BeltSpeed"}
TIERS = {"nominal": "", "randomised": "Randomised", "sensed": "Sensed"}


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
    what.add_argument("--tier", choices=TIERS, default="nominal", help="what is hidden (default: nominal)")
    what.add_argument("--env-id", metavar="ID", help=f"instead of --task and --tier: {', '.join(ENVIRONMENT_IDS)}")
    what.add_argument(
        "--env-arg",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="argument of the environment, the value in YAML, such as w_effort=0.2; may be repeated",
    )
    how = parser.add_argument_group("how")
    how.add_argument("--algo", choices=runs.ALGORITHMS, required=True, help="algorithm")
    how.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
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
    how.add_argument("--device", default="cpu", help="of torch: cpu, cuda or auto (default: cpu)")
    how.add_argument("--threads", type=int, default=1, help="of torch; more than 1 seldom pays here (default: 1)")
    out = parser.add_argument_group("what is written")
    out.add_argument("--run-folder", type=Path, metavar="FOLDER", help="default: runs/TASK-TIER-ALGO-SEED")
    out.add_argument("--force", action="store_true", help="replace a run that is there")
    out.add_argument(
        "--eval-freq", type=int, metavar="N", help="steps between evaluations (default: a twentieth of all)"
    )
    out.add_argument("--eval-episodes", type=int, default=50, metavar="N", help="of each evaluation (default: 50)")
    out.add_argument("--no-progress", action="store_true", help="no progress bar")
    return parser


def assignments(option: str, given: Sequence[str]) -> dict[str, Any]:
    """Return NAME=VALUE arguments as a mapping, the values read as YAML (safely).

    Raises:
        ValueError: if one is not of that form.
    """
    import yaml

    values: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            if not equals or not name.isidentifier():
                raise ValueError
            values[name] = yaml.safe_load(value)
        except (ValueError, yaml.YAMLError):
            raise ValueError(f"{option} must be NAME=VALUE with a value in YAML, got {text!r}") from None
    return values


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if (options.task is None) == (options.env_id is None):
        parser.error(f"one of --task ({', '.join(TASKS)}) and --env-id is needed")
    env_id = options.env_id or environment_id(options.task, options.tier)
    if env_id not in ENVIRONMENT_IDS:
        parser.error(f"--env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {env_id!r}")
    if options.env_id and options.tier != "nominal":
        parser.error(f"--tier {options.tier} goes with --task, not with --env-id, which names its tier itself")
    if options.run_folder is None:
        name = f"{options.task}-{options.tier}" if options.task else env_id.rpartition("/")[2]
        options.run_folder = Path("runs") / f"{name}-{options.algo}-{options.seed}"

    interrupted = False

    def note_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if interrupted:  # a second Ctrl-C does not wait for the step to end
            raise KeyboardInterrupt
        interrupted = True

    try:
        runs.check_free(options.run_folder, force=options.force)
        env_kwargs = assignments("--env-arg", options.env_arg)
        overrides = assignments("--set", options.overrides)
        from agents import training  # with it comes torch: two seconds

        plan = training.make_plan(
            env_id,
            options.algo,
            env_kwargs=env_kwargs,
            overrides=overrides,
            hyperparameter_file=options.hyperparameters,
            timesteps=options.timesteps,
            envs=options.envs,
            seed=options.seed,
            eval_freq=options.eval_freq,
            eval_episodes=options.eval_episodes,
            device=options.device,
            threads=options.threads,
        )
    except (TypeError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    except KeyboardInterrupt:
        print("\ntrain.py: interrupted before training began; nothing was written", file=sys.stderr)
        return 130

    print(f"Training {plan.algorithm} on {env_id}: {plan.steps:,} steps, seed {plan.seed}, in {options.run_folder}")
    before = signal.signal(signal.SIGINT, note_interrupt)
    begun = time.perf_counter()
    try:
        result = training.train(
            plan,
            options.run_folder,
            force=options.force,
            progress=not options.no_progress,
            command=" ".join(["python", "scripts/train.py", *(sys.argv[1:] if arguments is None else arguments)]),
            should_stop=lambda: interrupted,
        )
    except training.StoppedError as stop:
        print(f"\ntrain.py: interrupted: {stop}", file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        left = runs.partial_folder(options.run_folder)
        print(f"\ntrain.py: interrupted; what was written is in {str(left)!r}", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"train.py: error: the run cannot be written: {error}", file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGINT, before)
    best = result.best
    print(
        f"{result.steps:,} steps in {time.perf_counter() - begun:.0f} s. Best after {best['steps']:,} steps: return "
        f"{best['mean_return']:.1f}, suppressed {best['suppressed']:.0%} of {plan.eval_episodes} validation episodes.\n"
        f"Compare it: python scripts/evaluate.py {result.folder} --controller velocity-feedback"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
