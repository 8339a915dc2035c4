"""``sd-friction evaluate`` and ``sd-friction grid``: agents and controllers on the protocol's episodes."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sd_friction_env import Table
from sd_friction_env.cli.agents import AGENTS_TEXT, agent_of, check_fit, stored_agent, velocity_feedback
from sd_friction_env.cli.options import (
    Command,
    FailedError,
    UsageError,
    add_engine,
    add_environment,
    assignments,
    check_file,
    command_line,
    engine_of,
    environment_of,
    named_environment,
    numbers,
)
from sd_friction_env.control.policies import ConstantPolicy, Policy, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical, evaluation, grids
from sd_friction_env.learning.controllers import MADE_FROM_ENV

CONTROLLERS = ("passive", "velocity-feedback", *MADE_FROM_ENV, "constant", "classical")

TEXT = """\
Passive always comes first. score: 0 passive, 1 the optimum where one is stored ("-" where none is), over the episodes
whose optimum is known; credited: the same with credit for suppressed episodes only, the others counted as passive;
suppressed: share of the episodes that end still (amplitude under 5% of passive), without stick, at nominal belt speed.
Score and suppressed have 95% intervals over the episodes. Amplitude, reduction, stick and belt speed are of the last
half of the episodes; settling is the mean time of those that settle; residual is the rms action of the last quarter; ms
is the wall time of one decision for one environment. --controller classical stands for all classical controllers that
were tuned for the environment. alpha-beta, luenberger, particle, ensemble and kalman are observers, with the
rule of threshold-follower, its rollout, or the trained agent that sees the state: luenberger knows the nominal model
and the sensor's delay, the last three also the ranges of the hidden parameters and the noise."""

GRID_TEXT = """\
The episodes of `sd-friction evaluate` for every plant of the grid. --backend and --address say where it runs; the
numbers are the same, bit for bit. With --folder, finished chunks are kept and the same command continues after a
kill."""


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "agents", nargs="*", type=Path, metavar="AGENT", help="run folder, or a policy's .npz file (needs --task)"
    )
    text = "classical controllers to compare with"
    parser.add_argument("--controller", nargs="+", default=[], choices=CONTROLLERS, help=text)
    parser.add_argument("--gain", type=float, help="of velocity-feedback (default: 1.5 on force, 1 on belt)")
    add_environment(parser)
    text = "episodes on plants whose alpha, mu_m and belt_speed differ by this share from what controllers know"
    parser.add_argument("--plant-error", type=float, metavar="SHARE", help=text)
    text = "the first N of the protocol's (default: all 100)"
    parser.add_argument("--episodes", type=int, default=100, metavar="N", help=text)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table")
    parser.add_argument("--episodes-csv", type=Path, metavar="FILE", help="write every episode of every controller")


def check_episodes(options: argparse.Namespace) -> None:
    """Check --episodes against the protocol's number."""
    if not 1 <= options.episodes <= len(evaluation.EVALUATION_SEEDS):
        raise UsageError(f"--episodes must be in [1, {len(evaluation.EVALUATION_SEEDS)}], got {options.episodes}")


def _controllers(
    names: Sequence[str], gain: float | None, env_id: str, env_kwargs: dict[str, Any]
) -> dict[str, Policy]:
    """Return the named classical controllers of an environment, by the names of their rows."""
    made: dict[str, Policy] = {}
    for name in names:
        if name == "constant":
            made |= {"constant -1": ConstantPolicy(-1.0), "constant +1": ConstantPolicy(1.0)}
        elif name == "classical":
            if env_kwargs:
                raise ValueError("--controller classical was tuned without --env-arg: leave one of them out")
            made |= classical.classical_controllers(env_id)
        elif name == "velocity-feedback":
            policy, used = velocity_feedback(env_id, env_kwargs, gain)
            made[f"velocity feedback {used:g}"] = policy
        elif name in MADE_FROM_ENV:
            env = make_env(env_id, env_kwargs)
            made[f"{name.replace('-', ' ')}, default numbers"] = MADE_FROM_ENV[name](env)
    return made


def _agents_by_environment(options: argparse.Namespace) -> dict[tuple[str, str], dict[str, Policy]]:
    """Return the agents to evaluate, one table per environment (id and arguments as JSON), as they first appear."""
    chosen = named_environment(options)
    chosen_kwargs = assignments("--env-arg", options.env_arg)
    if chosen_kwargs and chosen is None:
        raise UsageError("--env-arg needs --task or --env-id")
    tables: dict[tuple[str, str], dict[str, Policy]] = {}
    if chosen is not None:
        tables[chosen, json.dumps(chosen_kwargs, sort_keys=True)] = {}
    for path in options.agents:
        policy, trained_on = stored_agent(path)
        if chosen is not None:
            key = next(iter(tables))
        elif trained_on is not None:
            key = (trained_on["id"], json.dumps(trained_on["kwargs"], sort_keys=True))
        else:
            raise UsageError(f"{str(path)!r} alone does not say its environment: name it with --task or --env-id")
        check_fit(path, policy, key[0], json.loads(key[1]))
        start = policy.metadata.get("start_from")
        tables.setdefault(key, {})[f"{path} (started from {start})" if start else str(path)] = policy
    if not tables:
        raise UsageError("nothing to evaluate: name run folders, or --task and --controller")
    return tables


def _evaluate(options: argparse.Namespace) -> int:
    check_episodes(options)
    check_file("--csv", options.csv)
    check_file("--episodes-csv", options.episodes_csv)
    seeds = evaluation.EVALUATION_SEEDS[: options.episodes]
    all_rows, all_episodes = [], []
    try:
        for (env_id, kwargs_text), learned in _agents_by_environment(options).items():
            env_kwargs = json.loads(kwargs_text)
            beside = _controllers(options.controller, options.gain, env_id, env_kwargs)
            plants = None
            if options.plant_error is not None:
                env = make_env(env_id, env_kwargs)
                plants = evaluation.plants_off_nominal(env, len(seeds), options.plant_error)
            passive = evaluation.passive_episodes(env_id, seeds, env_kwargs, plants)
            passive_table = evaluation.metrics(passive, passive)
            optimal = None if plants else evaluation.optimal_returns(env_id, seeds, env_kwargs)
            rows = []
            for name, policy in {"passive": ZeroPolicy(), **beside, **learned}.items():
                table = evaluation.evaluate(policy, env_id, seeds, env_kwargs, passive=passive, options=plants)
                row = evaluation.summarise(name, table, passive_table, optimal)
                rows.append(row | {"ms": evaluation.decision_milliseconds(policy, env_id, env_kwargs)})
                all_episodes.append(table.labelled(env_id=env_id, controller=name))
            if optimal is not None:
                rows.append({"controller": "optimum", "return": float(np.nanmean(optimal)), "score": 1.0})
            shown = f" with {kwargs_text}" if env_kwargs else ""
            shown += f", plants {options.plant_error:.0%} off nominal" if plants else ""
            print(f"\n{env_id}{shown}, {len(seeds)} episodes")
            print(evaluation.format_summary(rows))
            all_rows += [{"env_id": env_id, **row} for row in rows]
    except RuntimeError as error:  # a stored optimum of another environment
        raise FailedError(str(error)) from None
    about = {"command": command_line(options)}
    if options.csv is not None:
        Table.from_rows(all_rows, about).to_csv(options.csv)
    if options.episodes_csv is not None:
        Table.stacked(all_episodes, about).to_csv(options.episodes_csv)
    return 0


def _add_grid(parser: argparse.ArgumentParser) -> None:
    add_environment(parser, arguments=False)
    text = f"{AGENTS_TEXT} (default: pretrained)"
    parser.add_argument("--agent", default="pretrained", help=text)
    text = "a parameter of the plant with its values or ranges from:to:step; several make a grid"
    parser.add_argument("--over", nargs="+", action="append", required=True, metavar=("NAME", "VALUE"), help=text)
    parser.add_argument("--episodes", type=int, default=10, metavar="N", help="on each plant (default: 10)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write FILE.csv (default: print)")
    add_engine(parser)


def _grid(options: argparse.Namespace) -> int:
    check_episodes(options)
    check_file("--out", options.out, ".csv")
    over: dict[str, list[float]] = {}
    for name, *texts in options.over:
        if name.replace("-", "_") in over:
            raise UsageError(f"--over {name} is given twice")
        try:
            over[name.replace("-", "_")] = [value for text in texts for value in numbers(text)]
        except argparse.ArgumentTypeError as error:
            raise UsageError(f"--over {name}: {error}") from None
    env_id = environment_of(options)
    seeds = evaluation.EVALUATION_SEEDS[: options.episodes]
    policy = agent_of(options.agent, env_id)
    table = grids.evaluation_grid(policy, env_id, over, engine_of(options), seeds=seeds)
    if options.out is None:
        table.write(sys.stdout)
    else:
        table.to_csv(options.out)
    return 0


COMMANDS = {
    "evaluate": Command(
        _add_evaluate,
        _evaluate,
        [
            "runs/force-nominal-ppo-0 --controller velocity-feedback",
            "runs/belt-nominal-ppo-0 runs/belt-nominal-ppo-1 --controller constant --csv table.csv",
            "--task belt --controller velocity-feedback --gain -1",
        ],
        TEXT,
    ),
    "grid": Command(
        _add_grid,
        _grid,
        [
            "--task belt --over alpha 0.6:1:0.05 --out alpha.csv",
            "--task force --agent runs/force-nominal-ppo-0 --over belt_speed 0.1:0.35:0.01 --backend loky",
        ],
        GRID_TEXT,
    ),
}
