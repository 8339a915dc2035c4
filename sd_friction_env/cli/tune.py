"""``sd-friction tune`` and ``sd-friction tune-classical``: hyperparameters of agents, gains of controllers."""

import argparse
from pathlib import Path

from sd_friction_env.cli.options import (
    Command,
    FailedError,
    UsageError,
    add_environment,
    add_overrides,
    assignments,
    check_at_least,
    command_line,
    environment_of,
    stop_requests,
)
from sd_friction_env.environments.ids import TASKS, TIERS, environment_id
from sd_friction_env.extras import extra
from sd_friction_env.learning import classical
from sd_friction_env.learning.settings import ALGORITHMS

TEXT = """\
The search is around the hyperparameters of agents/hyperparameters/ALGO.yml. A trial is worth the best credited return
on the validation episodes, never those of the evaluation: the mean return, where an episode that is not suppressed
counts no more than a passive one. Trial 0 is the file as it is.

Ctrl-C stops: running trials are queued again, and the same command continues, up to --trials in all. So it does after a
crash: a trial without a sign of life for a minute is tried again. On several machines, the same command works on one
study in a database that all of them reach, such as PostgreSQL: --storage postgresql+psycopg://USER:PASSWORD@HOST/NAME,
with the driver installed (pip install "psycopg[binary]")."""

CLASSICAL_TEXT = """\
SciPy's differential evolution maximises the mean return on the validation episodes. What is finished is kept at once in
agents/classical.json, unless the stored gains do better; Ctrl-C loses what is running. Several of these may run side by
side. All of them take a quarter of an hour."""


def _add_tune(parser: argparse.ArgumentParser) -> None:
    what = parser.add_argument_group("what is searched")
    add_environment(what)
    what.add_argument("--algo", choices=ALGORITHMS, required=True, help="algorithm")
    what.add_argument("--hyperparameters", type=Path, metavar="FILE", help="another file to search around")
    add_overrides(what, "fix one hyperparameter, which is then not searched")
    how = parser.add_argument_group("how")
    how.add_argument("--trials", type=int, required=True, metavar="N", help="of the study in all")
    how.add_argument("--timesteps", type=int, metavar="N", help="of each trial (default: the file's n_timesteps)")
    how.add_argument("--workers", type=int, default=1, metavar="N", help="processes, one thread each (default: 1)")
    how.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    how.add_argument(
        "--pruner", default="median", help="stops unpromising trials early: median, hyperband, none (default: median)"
    )
    how.add_argument("--evaluations", type=int, default=20, metavar="N", help="of each trial (default: 20)")
    how.add_argument("--eval-episodes", type=int, default=100, metavar="N", help="of each evaluation (default: 100)")
    out = parser.add_argument_group("what is written")
    out.add_argument("--storage", required=True, metavar="URL", help="database, such as sqlite:///study.db")
    out.add_argument("--study", required=True, metavar="NAME", help="in the database; continued if it is there")
    out.add_argument(
        "--out", type=Path, metavar="FILE.yml", help="write the best hyperparameters, for `sd-friction train`"
    )
    out.add_argument("--top", type=int, default=10, metavar="N", help="trials in the table (default: 10)")
    out.add_argument("--no-progress", action="store_true", help="no progress bar")


def _tune(options: argparse.Namespace) -> int:
    check_at_least(options, top=1)
    env_id = environment_of(options)
    with extra("train,tune"):
        from sd_friction_env.learning import tuning
    try:
        with stop_requests() as should_stop:
            if options.out is not None:
                tuning.check_out(options.out)
            search = tuning.make_search(
                env_id,
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
                should_stop=should_stop,
            )
            print(tuning.format_trials(study, options.top))
            if options.out is not None:
                tuning.write_best(study, options.out)
                print(
                    f"Train with the best: sd-friction train --env-id {env_id} --algo {options.algo} "
                    f"--hyperparameters {options.out}"
                )
    except tuning.InterruptedStudyError:
        raise KeyboardInterrupt from None
    except tuning.WorkersDiedError as error:
        raise FailedError(f"{error}; the same command continues the study") from None
    return 0


def _add_classical(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS), help="actuators (default: both)")
    parser.add_argument("--tier", nargs="+", choices=TIERS, default=list(TIERS), help="default: all")
    parser.add_argument("--controller", nargs="+", choices=classical.KINDS, help="default: all that fit")
    parser.add_argument("--seed", type=int, default=0, help="of the search (default: 0)")
    parser.add_argument("--generations", type=int, default=50, metavar="N", help="of the search (default: 50)")
    parser.add_argument("--population", type=int, default=12, metavar="N", help="per tuned value (default: 12)")


def _classical(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    check_at_least(options, seed=0, generations=1, population=2)
    classical.stored_gains()  # a damaged file is reported before anything is computed
    jobs = []
    for task in options.task:
        for tier in options.tier:
            env_id = environment_id(task, tier)
            allowed = classical.kinds_for(env_id)
            jobs += [(env_id, name) for name in options.controller or allowed if name in allowed]
    if not jobs:
        names, where = ", ".join(options.controller), f"--task {' '.join(options.task)} --tier {' '.join(options.tier)}"
        raise UsageError(f"--controller {names} is not for the actuator or the sensor of {where}")
    for env_id, name in jobs:
        with tqdm(total=100, desc=f"{env_id}: {name}", unit="%", dynamic_ncols=True, leave=False) as bar:

            def show(best: float, share: float, bar: "tqdm[None]" = bar) -> None:
                bar.set_postfix_str(f"return {best:.1f}")
                bar.update(round(100.0 * share) - bar.n)

            found = classical.tune(
                name,
                env_id,
                seed=options.seed,
                generations=options.generations,
                population=options.population,
                progress=show,
            )
        kept = classical.keep(env_id, name, {**found, "command": command_line(options)})
        result = f"return {found['validation_return']:8.2f}, suppressed {found['suppressed']:4.0%}"
        values = ", ".join(f"{key} {value:.4g}" for key, value in found["values"].items())
        print(f"{env_id:36} {name:38} {result}, {values}", flush=True)
        if kept["values"] != found["values"]:
            print(f"  not kept: the stored gains reach {kept['validation_return']:.2f}", flush=True)
        for value, what in kept["at_bound"].items():
            print(f"  {value} is at its bound: {what or 'a wider one may find better'}", flush=True)
    return 0


COMMANDS = {
    "tune": Command(
        _add_tune,
        _tune,
        ["--task belt --algo ppo --trials 40 --storage sqlite:///study.db --study belt-ppo --workers 2 --out best.yml"],
        TEXT,
        "the same command continues the study",
    ),
    "tune-classical": Command(
        _add_classical,
        _classical,
        ["", "--task belt --tier nominal", '--task force --controller LQR "sliding mode" --generations 60'],
        CLASSICAL_TEXT,
        "what was finished is kept",
    ),
}
