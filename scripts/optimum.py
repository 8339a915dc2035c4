"""Compute the optimal-control reference of a nominal task and store it in agents/optimum/.

    python scripts/optimum.py --task force
    python scripts/optimum.py --task belt --grid 201x161x17 --grid 101x241x33
    python scripts/optimum.py --task belt --quick

Prints the mean return of every stage beside the value functions' own estimates. ``--quick`` takes one small grid and
few starts, to see that it works, and stores nothing unless ``--output`` says where.
"""

import argparse
import shlex
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from agents.evaluation import EVALUATION_SEEDS
from agents.optimal import (
    OPTIMUM_DIRECTORY,
    TASKS,
    find_optimum,
    make_problem,
    optimal_actions,
    save_optimum,
    versions,
)

GRIDS = {
    "force": ["121x101", "241x201", "481x401"],
    "belt": ["101x81x9", "201x161x17", "61x401x17", "101x241x33"],
}
QUICK_GRIDS = {"force": ["61x51"], "belt": ["41x41x9"]}


def grid_sizes(text: str) -> tuple[int, ...]:
    """Return (121, 101) for "121x101"."""
    try:
        return tuple(int(size) for size in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"a grid is given as 121x101 or 101x81x9, got {text!r}") from None


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=sorted(TASKS), required=True)
    parser.add_argument(
        "--grid", type=grid_sizes, action="append", help="nodes along x, v_rel[, v_belt]; may be repeated"
    )
    parser.add_argument("--beam", type=int, default=100, help="width of the beam searches; 0 for none")
    parser.add_argument("--rounds", type=int, default=4, help="rounds of exchange between starts and refinement")
    parser.add_argument("--improve", action="store_true", help="start from the stored sequences as well")
    parser.add_argument("--quick", action="store_true", help="one small grid, 10 starts, nothing stored by default")
    parser.add_argument("--output", type=Path, help="folder to store in (default: agents/optimum, unless --quick)")
    options = parser.parse_args(arguments)
    env_id = TASKS[options.task]
    seeds = list(EVALUATION_SEEDS)[: 10 if options.quick else None]
    grids = options.grid or [grid_sizes(text) for text in (QUICK_GRIDS if options.quick else GRIDS)[options.task]]
    dimensions = 3 if options.task == "belt" else 2
    if any(len(sizes) != dimensions or min(sizes) < 3 for sizes in grids):
        parser.error(f"--task {options.task} takes grids of {dimensions} sizes, each at least 3")
    if options.beam < 0 or options.rounds < 0:
        parser.error("--beam and --rounds must not be negative")
    output = options.output or (None if options.quick else OPTIMUM_DIRECTORY)

    start = time.perf_counter()
    problem = make_problem(env_id, seeds)
    known = None
    if options.improve:
        stored_seeds, sequences = optimal_actions(env_id)
        known = sequences[[stored_seeds.index(seed) for seed in seeds]].astype(np.float64)

    def report(stage: str, value: float) -> None:
        tqdm.write(f"{time.perf_counter() - start:7.1f} s  {value:10.4f}  {stage}", file=sys.stdout)
        sys.stdout.flush()  # a log file shows it too, while it runs

    study = find_optimum(
        problem,
        grids,
        beam=min(options.beam, 20) if options.quick else options.beam,
        rounds=min(options.rounds, 1) if options.quick else options.rounds,
        known=known,
        progress=lambda steps, label: tqdm(steps, desc=label, leave=False, mininterval=0.5),
        report=report,
    )
    if output is None:
        return
    about = {
        "command": shlex.join(["python", "scripts/optimum.py", *(sys.argv[1:] if arguments is None else arguments)]),
        "versions": versions(),
        "stages": study.stages,
        "value_estimates": study.estimates,
    }
    returns = save_optimum(problem, seeds, study.actions, about, output)
    report(f"stored in {output} ({len(seeds)} starts, {returns.min():.2f} to {returns.max():.2f})", returns.mean())


if __name__ == "__main__":
    main()
