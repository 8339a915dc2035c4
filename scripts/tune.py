"""Search for hyperparameters with Optuna, around those of agents/hyperparameters/ALGO.yml.

    python scripts/tune.py --task belt --algo ppo --trials 40 --timesteps 300000 --storage sqlite:///study.db \\
        --study belt-ppo --workers 2 --out best.yml
    python scripts/train.py --task belt --algo ppo --hyperparameters best.yml

A trial is worth the best credited return on the validation episodes, never those of the evaluation: the mean return,
where an episode that is not suppressed counts no more than a passive one. Trial 0 is the file as it is.

Ctrl-C stops: what runs is queued again, and the same command continues, up to --trials in all. So it does after a
crash: a trial without a sign of life for a minute is tried again. On several machines, the same command works on one
study in a database that all of them reach, such as PostgreSQL: --storage postgresql+psycopg://USER:PASSWORD@HOST/NAME,
with the driver installed (pip install "psycopg[binary]").
"""

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from scripts.train import TASKS, TIERS, Parser, assignments, environment_id
from sd_friction_env.learning.settings import ALGORITHMS


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="tune.py"
    )
    what = parser.add_argument_group("what is searched")
    what.add_argument("--task", choices=TASKS, required=True, help="actuator: a force on the mass, or the belt's speed")
    what.add_argument("--tier", choices=TIERS, default="nominal", help="what is hidden (default: nominal)")
    what.add_argument("--env-arg", action="append", default=[], metavar="NAME=VALUE", help="as train.py takes it")
    what.add_argument("--algo", choices=ALGORITHMS, required=True, help="algorithm")
    what.add_argument("--hyperparameters", type=Path, metavar="FILE", help="another file to search around")
    what.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        dest="overrides",
        help="fix one hyperparameter, which is then not searched, the value in YAML; may be repeated",
    )
    how = parser.add_argument_group("how")
    how.add_argument("--trials", type=int, required=True, metavar="N", help="of the study in all")
    how.add_argument("--timesteps", type=int, metavar="N", help="of each trial (default: the file's n_timesteps)")
    how.add_argument("--workers", type=int, default=1, metavar="N", help="processes, one thread each (default: 1)")
    how.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    how.add_argument("--pruner", default="median", help="of hopeless trials: median, hyperband, none (default: median)")
    how.add_argument("--evaluations", type=int, default=20, metavar="N", help="of each trial (default: 20)")
    how.add_argument("--eval-episodes", type=int, default=100, metavar="N", help="of each evaluation (default: 100)")
    out = parser.add_argument_group("what is written")
    out.add_argument("--storage", required=True, metavar="URL", help="database, such as sqlite:///study.db")
    out.add_argument("--study", required=True, metavar="NAME", help="in the database; continued if it is there")
    out.add_argument("--out", type=Path, metavar="FILE.yml", help="write the best hyperparameters, for train.py")
    out.add_argument("--top", type=int, default=10, metavar="N", help="trials in the table (default: 10)")
    out.add_argument("--no-progress", action="store_true", help="no progress bar")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Tune as the command line says; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.top < 1:
        parser.error(f"--top must be a whole number >= 1, got {options.top}")
    try:
        from sd_friction_env.learning import tuning
    except ModuleNotFoundError as error:
        parser.error(f'{error.name} is not installed: pip install "sd-friction-env[train,tune]"')
    except KeyboardInterrupt:
        print("\ntune.py: interrupted before anything was written", file=sys.stderr)
        return 130
    interrupted = False

    def note_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if interrupted:  # a second Ctrl-C does not wait for the steps to end
            raise KeyboardInterrupt
        interrupted = True

    before = signal.signal(signal.SIGINT, note_interrupt)
    try:
        if options.out is not None:
            tuning.check_out(options.out)
        search = tuning.make_search(
            environment_id(options.task, options.tier),
            options.algo,
            env_kwargs=assignments("--env-arg", options.env_arg),
            overrides=assignments("--set", options.overrides),
            hyperparameter_file=options.hyperparameters,
            timesteps=options.timesteps,
            evaluations=options.evaluations,
            eval_episodes=options.eval_episodes,
            pruner=options.pruner,
            seed=options.seed,
        )
        study = tuning.tune(
            search,
            options.storage,
            options.study,
            options.trials,
            workers=options.workers,
            progress=not options.no_progress,
            should_stop=lambda: interrupted,
        )
        print(tuning.format_trials(study, options.top))
        if options.out is not None:
            tuning.write_best(study, options.out)
            print(
                f"Train with the best: python scripts/train.py --task {options.task} --tier {options.tier} "
                f"--algo {options.algo} --hyperparameters {options.out}"
            )
    except (TypeError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    except (tuning.InterruptedStudyError, KeyboardInterrupt):
        print("\ntune.py: interrupted; the same command continues the study", file=sys.stderr)
        return 130
    except tuning.WorkersDiedError as error:
        print(f"tune.py: error: {error}; the same command continues the study", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"tune.py: error: {str(options.out)!r} cannot be written: {error}", file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGINT, before)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
