"""Compute the optimal-control reference of a task and store it in agents/optimum/.

    python scripts/optimum.py --task force
    python scripts/optimum.py --task belt --grid 201x161x17 --grid 101x241x33
    python scripts/optimum.py --task belt --tier randomised --draws 32
    python scripts/optimum.py --task belt --quick
    python scripts/optimum.py --task belt --show
    python scripts/optimum.py --task belt --policy

Prints the mean return of every stage beside the value functions' own estimates. On the randomised tier every episode
has a plant of its own, and the optimum knows it (an upper bound). The sensed tier has the nominal optimum. ``--quick``
takes one small grid and few starts, to see that it works, and stores nothing unless ``--output`` says where. ``--show``
prints what is stored and computes nothing. ``--policy`` stores a value function for OptimalPolicy, which
acts on it. Ctrl-C stops; nothing is then stored.
"""

import argparse
import shlex
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from scripts.train import Parser
from sd_friction_env.learning import optimal
from sd_friction_env.learning.evaluation import EVALUATION_SEEDS, evaluate

TIERS = {"nominal": optimal.TASKS, "randomised": optimal.RANDOMISED}
GRIDS = {
    ("force", "nominal"): ["121x101", "241x201", "481x401"],
    ("belt", "nominal"): ["101x81x9", "201x161x17", "61x401x17", "101x241x33"],
    ("force", "randomised"): ["121x101", "201x161"],
    ("belt", "randomised"): ["101x81x9", "61x161x17"],
}
QUICK_GRIDS = {"force": ["61x51"], "belt": ["41x41x9"]}
POLICY_GRIDS = {"force": "241x201", "belt": "61x241x17"}
DRAWS = {"nominal": len(EVALUATION_SEEDS), "randomised": 32}


def grid_sizes(text: str) -> tuple[int, ...]:
    """Return (121, 101) for "121x101"."""
    try:
        return tuple(int(size) for size in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"a grid is given as 121x101 or 101x81x9, got {text!r}") from None


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="optimum.py"
    )
    parser.add_argument("--task", choices=sorted(optimal.TASKS), required=True)
    parser.add_argument("--tier", choices=TIERS, default="nominal")
    parser.add_argument("--draws", type=int, help="how many of the 100 evaluation seeds (default: 100; randomised: 32)")
    parser.add_argument(
        "--grid", type=grid_sizes, action="append", help="nodes along x, v_rel[, v_belt]; may be repeated"
    )
    parser.add_argument("--beam", type=int, default=100, help="width of the beam searches; 0 for none")
    parser.add_argument("--rounds", type=int, help="rounds of exchange between starts (default: 4; randomised: 1)")
    parser.add_argument("--improve", action="store_true", help="start from the stored sequences as well")
    parser.add_argument("--quick", action="store_true", help="one small grid, 10 starts, nothing stored by default")
    parser.add_argument("--show", action="store_true", help="print the stored study, and compute nothing")
    parser.add_argument("--policy", action="store_true", help="store a value function to act on (nominal tier)")
    parser.add_argument("--output", type=Path, help="folder to store in (default: agents/optimum, unless --quick)")
    return parser


def checked(parser: Parser, options: argparse.Namespace) -> None:
    """Fill in what depends on the task, or exit with an error that says what does not fit."""
    quick, task, tier = options.quick, options.task, options.tier
    if options.policy and tier != "nominal":
        parser.error("--policy is for --tier nominal: a value function is that of one plant")
    for name in ("show", "quick", "improve"):
        if options.policy and getattr(options, name):
            parser.error(f"--policy and --{name} exclude one another")
    if options.draws is None:
        options.draws = 10 if quick else DRAWS[tier]
    if not 1 <= options.draws <= len(EVALUATION_SEEDS):
        parser.error(f"--draws must be in [1, {len(EVALUATION_SEEDS)}], got {options.draws}")
    if options.grid is None:
        texts = [POLICY_GRIDS[task]] if options.policy else QUICK_GRIDS[task] if quick else GRIDS[task, tier]
        options.grid = [grid_sizes(text) for text in texts]
    dimensions = 3 if task == "belt" else 2
    for sizes in options.grid:
        if len(sizes) != dimensions or not 3 <= min(sizes) <= max(sizes) <= 2000:
            given = "x".join(map(str, sizes))
            parser.error(f"--grid of --task {task} must be {dimensions} sizes in [3, 2000], got {given}")
    if options.policy and len(options.grid) != 1:
        parser.error(f"--policy takes one --grid, got {len(options.grid)}")
    if options.rounds is None:
        options.rounds = 1 if quick or tier == "randomised" else 4
    for name, largest in (("beam", 10_000), ("rounds", 100)):
        if not 0 <= getattr(options, name) <= largest:
            parser.error(f"--{name} must be in [0, {largest}], got {getattr(options, name)}")
    if quick:
        options.beam = min(options.beam, 20)
    if options.output is None and (options.policy or options.show or not quick):
        options.output = optimal.OPTIMUM_DIRECTORY


def show(env_id: str, folder: Path) -> None:
    """Print the stored refinement study: each grid's own estimate beside what was realised, then all stages.

    Raises:
        FileNotFoundError: if nothing is stored.
    """
    study = optimal.stored_study(env_id, folder)
    print(f"{env_id}: mean return {study['mean_return']:.4f} over {len(study['seeds'])} starts")
    print(f"computed by: {study['command']}\n")
    print(f"{'grid':>14}  {'estimated':>10}  {'greedy':>10}  {'beam':>10}  {'refined':>10}")
    for grid, estimate in study["value_estimates"].items():
        cells = [estimate] + [
            next(
                (value for name, value in study["stages"].items() if name.startswith(start) and name.endswith(end)),
                None,
            )
            for start, end in (("greedy", f" {grid}"), ("beam", f" {grid}"), ("beam", f" {grid}, refined"))
        ]
        print(f"{grid:>14}  " + "  ".join(f"{'-':>10}" if cell is None else f"{cell:10.4f}" for cell in cells))
    print()
    for name, value in study["stages"].items():
        print(f"{value:10.4f}  {name}")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    checked(parser, options)
    try:
        return run(
            options, shlex.join(["python", "scripts/optimum.py", *(sys.argv[1:] if arguments is None else arguments)])
        )
    except KeyboardInterrupt:
        print("optimum.py: stopped; nothing was stored", file=sys.stderr)
        return 130
    except (OSError, RuntimeError, ValueError) as error:
        print(f"optimum.py: error: {error}", file=sys.stderr)
        return 1


def run(options: argparse.Namespace, command: str) -> int:
    """Do what the options say; return the exit status."""
    env_id = TIERS[options.tier][options.task]
    if options.show:
        show(env_id, options.output)
        return 0
    start = time.perf_counter()

    def report(stage: str, value: float) -> None:
        tqdm.write(f"{time.perf_counter() - start:7.1f} s  {value:10.4f}  {stage}", file=sys.stdout)
        sys.stdout.flush()  # a log file shows it too, while it runs

    def progress(steps: range, label: str) -> Iterable[int]:
        bar: Iterable[int] = tqdm(steps, desc=label, leave=False, mininterval=0.5)
        return bar

    seeds = list(EVALUATION_SEEDS)[: options.draws]
    problem = optimal.make_problem(env_id, seeds)
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
    if options.policy:
        grid = optimal.make_grid(problem, options.grid[0])
        value = optimal.value_iteration(problem, grid, optimal.grid_actions(problem, grid), progress)
        report("value function's estimate", float(grid.interpolate(value.whole, problem.starts).mean()))
        path = optimal.save_value(problem, value, options.output)
        table = evaluate(optimal.OptimalPolicy.load(env_id, options.output), env_id, seeds)
        report(f"stored in {path}; realised, {table['suppressed'].mean():.0%} suppressed", table["return"].mean())
        return 0
    about: dict[str, Any] = {"command": command, "versions": optimal.versions()}
    known = None
    if options.improve:
        stored_seeds, sequences = optimal.optimal_actions(env_id)
        missing = sorted(set(seeds) - set(stored_seeds))
        if missing:
            raise ValueError(
                f"--improve: no sequence is stored for seed {missing[0]}; take --draws {len(stored_seeds)}"
            )
        known = sequences[[stored_seeds.index(seed) for seed in seeds]].astype(np.float64)
    study = optimal.find_optimum(
        problem,
        options.grid,
        beam=options.beam,
        rounds=options.rounds,
        known=known,
        progress=progress,
        report=report,
    )
    if options.output is None:
        return 0
    about |= {"stages": study.stages, "value_estimates": study.estimates}
    if options.improve:  # what was found before is part of how this was found
        before = optimal.stored_study(env_id)
        about["command"] = f"{before['command']}; {command}"
        for part in ("stages", "value_estimates"):
            about[part] = {name: value for name, value in before[part].items() if name not in about[part]} | about[part]
    returns = optimal.save_optimum(problem, seeds, study.actions, about, options.output)
    where = f"stored in {options.output} ({len(seeds)} starts, {returns.min():.2f} to {returns.max():.2f})"
    report(where, returns.mean())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
