"""Compare trained agents and classical controllers with no control, on the protocol's 100 episodes.

    python scripts/evaluate.py runs/force-nominal-ppo-0 --controller velocity-feedback
    python scripts/evaluate.py runs/belt-nominal-ppo-0 runs/belt-nominal-ppo-1 --controller constant --csv table.csv
    python scripts/evaluate.py --task belt --controller velocity-feedback --gain -1

Passive always stands first. score: 0 passive, 1 the optimum where one is stored ("-" where none is), over the episodes
whose optimum is known; suppressed: share of the episodes that end still (amplitude under 5% of passive), without stick,
at nominal belt speed; both with 95% intervals over the episodes. Amplitude, reduction, stick and belt speed are of the
last half of the episodes; settling is the mean time of those that settle; residual is the rms action of the last
quarter. --controller classical stands for all classical controllers that were tuned for the environment.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.train import TASKS, TIERS, Parser, assignments, environment_id
from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.control.policies import (
    ConstantPolicy,
    Policy,
    PolicyFileError,
    VelocityFeedback,
    ZeroPolicy,
    load_policy,
)
from sd_friction_env.learning import classical, evaluation, runs

CONTROLLERS = ("passive", "velocity-feedback", "constant", "classical")
# Force: near the best there is. Belt: the belt follows the mass, which makes matters worse at any gain (negative gains
# help a little and suppress nothing).
VELOCITY_GAINS = {"force": 1.5, "belt_speed": 1.0}


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        prog="evaluate.py",
    )
    parser.add_argument(
        "agents", nargs="*", type=Path, metavar="AGENT", help="run folder, or a policy's .npz file (needs --task)"
    )
    parser.add_argument(
        "--controller", nargs="+", default=[], choices=CONTROLLERS, help="classical controllers to stand beside them"
    )
    parser.add_argument("--gain", type=float, help="of velocity-feedback (default: 1.5 on force, 1 on belt)")
    parser.add_argument("--task", choices=TASKS, help="actuator (default: that of the agents)")
    parser.add_argument("--tier", choices=TIERS, default="nominal", help="with --task (default: nominal)")
    parser.add_argument("--env-id", metavar="ID", help=f"instead of --task and --tier: {', '.join(ENVIRONMENT_IDS)}")
    parser.add_argument(
        "--env-arg", action="append", default=[], metavar="NAME=VALUE", help="argument of the environment, in YAML"
    )
    parser.add_argument(
        "--episodes", type=int, default=100, metavar="N", help="the first N of the protocol's (default: all 100)"
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table")
    parser.add_argument("--episodes-csv", type=Path, metavar="FILE", help="write every episode of every controller")
    return parser


def load_agent(path: Path) -> tuple[Policy, dict[str, Any] | None]:
    """Return the policy at a path and, from a run folder, the environment it was trained for.

    Raises:
        ValueError: if it is neither a finished run folder nor a policy file.
    """
    if path.suffix.lower() == ".npz":
        try:
            return load_policy(path), None
        except FileNotFoundError as error:
            raise PolicyFileError(str(error)) from None
    config = runs.load_config(path)
    return runs.load_network(path), dict(config["environment"])


def check_fit(path: Path, policy: Any, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Raise unless an agent fits an environment.

    Raises:
        ValueError: if its observations have another size or limit, or it was trained with another actuator.
    """
    env = evaluation.make_env(env_id, env_kwargs)
    size = env.observation_space.shape[0] if env.observation_space.shape else 0
    if policy.observation_size != size:
        raise ValueError(f"{str(path)!r} observes {policy.observation_size} values, and {env_id} gives {size}")
    trained = policy.metadata.get("env_id")
    if trained in ENVIRONMENT_IDS and evaluation.make_env(trained).task.actuator != env.task.actuator:
        raise ValueError(f"{str(path)!r} was trained on {trained}, whose actuator is not that of {env_id}")


def controllers(names: Sequence[str], gain: float | None, env_id: str, env_kwargs: dict[str, Any]) -> dict[str, Policy]:
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
            env = evaluation.make_env(env_id, env_kwargs)
            used = VELOCITY_GAINS[env.task.actuator] if gain is None else gain
            made[f"velocity feedback {used:g}"] = VelocityFeedback.from_env(env, used)
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate what the command line names; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.env_id is not None and options.env_id not in ENVIRONMENT_IDS:
        parser.error(f"--env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {options.env_id!r}")
    if options.task and options.env_id:
        parser.error("--task and --env-id exclude one another")
    if not 1 <= options.episodes <= len(evaluation.EVALUATION_SEEDS):
        parser.error(f"--episodes must be in [1, {len(evaluation.EVALUATION_SEEDS)}], got {options.episodes}")
    for option, path in (("--csv", options.csv), ("--episodes-csv", options.episodes_csv)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            parser.error(f"{option} must be a file in a folder that exists, got {str(path)!r}")
    chosen = options.env_id or (environment_id(options.task, options.tier) if options.task else None)
    try:
        chosen_kwargs = assignments("--env-arg", options.env_arg)
        if chosen_kwargs and chosen is None:
            raise ValueError("--env-arg needs --task or --env-id")
        # One table per environment, in the order in which they first appear.
        tables: dict[tuple[str, str], dict[str, Policy]] = {}
        if chosen is not None:
            tables[chosen, json.dumps(chosen_kwargs, sort_keys=True)] = {}
        for path in options.agents:
            policy, trained_on = load_agent(path)
            if chosen is not None:
                key = next(iter(tables))
            elif trained_on is not None:
                key = (trained_on["id"], json.dumps(trained_on["kwargs"], sort_keys=True))
            else:
                raise ValueError(f"{str(path)!r} alone does not say its environment: name it with --task or --env-id")
            check_fit(path, policy, key[0], json.loads(key[1]))
            tables.setdefault(key, {})[str(path)] = policy
        if not tables:
            raise ValueError("nothing to evaluate: name run folders, or --task and --controller")
        seeds = evaluation.EVALUATION_SEEDS[: options.episodes]
        all_rows, all_episodes = [], []
        for (env_id, kwargs_text), learned in tables.items():
            env_kwargs = json.loads(kwargs_text)
            classical = controllers(options.controller, options.gain, env_id, env_kwargs)
            passive = evaluation.passive_episodes(env_id, seeds, env_kwargs)
            passive_table = evaluation.metrics(passive, passive)
            optimal = evaluation.optimal_returns(env_id, seeds, env_kwargs)
            rows = []
            for name, policy in {"passive": ZeroPolicy(), **classical, **learned}.items():
                table = evaluation.evaluate(policy, env_id, seeds, env_kwargs, passive=passive)
                rows.append(evaluation.summarise(name, table, passive_table, optimal))
                all_episodes.append((env_id, name, table))
            if optimal is not None:
                rows.append({"controller": "optimum", "return": float(np.nanmean(optimal)), "score": 1.0})
            arguments_shown = f" with {kwargs_text}" if env_kwargs else ""
            print(f"\n{env_id}{arguments_shown}, {len(seeds)} episodes")
            print(evaluation.format_summary(rows))
            all_rows += [{"env_id": env_id, **row} for row in rows]
    except (TypeError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    except RuntimeError as error:  # a stored optimum of another environment
        print(f"evaluate.py: error: {error}", file=sys.stderr)
        return 1
    about = {
        "command": " ".join(["python", "scripts/evaluate.py", *(sys.argv[1:] if arguments is None else arguments)])
    }
    try:
        if options.csv is not None:
            names = list(all_rows[0])
            Table({name: [row.get(name, float("nan")) for row in all_rows] for name in names}, about).to_csv(
                options.csv
            )
        if options.episodes_csv is not None:
            columns: dict[str, Any] = {
                "env_id": [env_id for env_id, _, table in all_episodes for _ in range(table.n_rows)],
                "controller": [name for _, name, table in all_episodes for _ in range(table.n_rows)],
            }
            for name in all_episodes[0][2]:
                columns[name] = np.concatenate([table[name] for _, _, table in all_episodes])
            Table(columns, about).to_csv(options.episodes_csv)
    except OSError as error:
        print(f"evaluate.py: error: the table cannot be written: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
