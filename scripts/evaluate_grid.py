"""Judge a controller on a grid of plants: the episodes of scripts/evaluate.py for every point, in chunks.

    python scripts/evaluate_grid.py --task belt --over alpha 0.6:1:0.05 --out alpha.csv
    python scripts/evaluate_grid.py --task force --agent runs/force-nominal-ppo-0 --over belt_speed 0.1:0.35:0.01 \\
        --over mu_s 0.15:0.25:0.01 --backend loky --folder grids/force --out grid.csv

--backend and --address alone say where it runs; the numbers are the same, bit for bit. With --folder finished chunks
are kept, and the same command goes on after a kill. --agent is a run folder, a policy's .npz, "pretrained" (the
package's own, the default) or "passive".
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from scripts.evaluate import check_fit, load_agent
from scripts.train import TASKS, TIERS, Parser, environment_id
from sd_friction_env import load_pretrained
from sd_friction_env.cli import main as cli
from sd_friction_env.control.policies import Policy, ZeroPolicy
from sd_friction_env.learning import evaluation, grids
from sd_friction_env.storage import checked_ending


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        prog="evaluate_grid.py",
    )
    parser.add_argument("--task", choices=TASKS, required=True, help="actuator")
    parser.add_argument("--tier", choices=TIERS, default="nominal", help="what is sensed (default: nominal)")
    parser.add_argument("--agent", default="pretrained", help="see above")
    parser.add_argument(
        "--over",
        nargs="+",
        action="append",
        required=True,
        metavar=("NAME", "VALUE"),
        help="a parameter of the plant with its values or ranges from:to:step; several make a grid",
    )
    parser.add_argument("--episodes", type=int, default=10, metavar="N", help="on each plant (default: 10)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write FILE.csv (default: print)")
    cli.add_engine(parser)
    return parser


def agent_of(name: str, env_id: str) -> Policy:
    """Return the controller that --agent names."""
    if name == "pretrained":
        return load_pretrained(env_id)
    if name == "passive":
        return ZeroPolicy()
    policy, _ = load_agent(Path(name))
    check_fit(Path(name), policy, env_id, {})
    return policy


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate what the command line names; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if not 1 <= options.episodes <= len(evaluation.EVALUATION_SEEDS):
        parser.error(f"--episodes must be in [1, {len(evaluation.EVALUATION_SEEDS)}], got {options.episodes}")
    if options.out is not None:
        try:
            checked_ending(options.out, (".csv",), "--out")
        except ValueError as error:
            parser.error(str(error))
    if options.out is not None and (options.out.is_dir() or not options.out.parent.is_dir()):
        parser.error(f"--out must be a file in a folder that exists, got {str(options.out)!r}")
    try:
        over = {}
        for name, *texts in options.over:
            if name.replace("-", "_") in over:
                raise ValueError(f"--over {name} is given twice")
            over[name.replace("-", "_")] = [value for text in texts for value in cli.numbers(text)]
        env_id = environment_id(options.task, options.tier)
        policy = agent_of(options.agent, env_id)
        seeds = evaluation.EVALUATION_SEEDS[: options.episodes]
        table = grids.evaluation_grid(policy, env_id, over, cli.engine_of(options), seeds=seeds)
    except (argparse.ArgumentTypeError, ImportError, TypeError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    except KeyboardInterrupt:
        kept = f": the same command goes on with what is in {str(options.folder)!r}" if options.folder else ""
        print(f"\nevaluate_grid.py: interrupted{kept}", file=sys.stderr)
        return cli.INTERRUPTED
    if options.out is None:
        table.write(sys.stdout)
    else:
        table.to_csv(options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
