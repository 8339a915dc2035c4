"""``sd-friction optimum``: the optimal-control reference of a task."""

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sd_friction_env.cli.options import Command, FailedError, UsageError, command_line
from sd_friction_env.learning import optimal
from sd_friction_env.learning.evaluation import EVALUATION_SEEDS, evaluate

_OPEN = {tier: optimal.OPEN[tier] for tier in ("blind-hard", "drifting", "excited")}
_IDS = {"nominal": optimal.TASKS, "randomised": optimal.RANDOMISED} | _OPEN
GRIDS = {
    ("force", "nominal"): ["121x101", "241x201", "481x401"],
    ("belt", "nominal"): ["101x81x9", "201x161x17", "61x401x17", "101x241x33"],
    ("force", "randomised"): ["121x101", "201x161"],
    **{("belt", tier): ["101x81x9", "61x161x17"] for tier in ("randomised", *_OPEN)},
}
QUICK_GRIDS = {"force": ["61x51"], "belt": ["41x41x9"]}
POLICY_GRIDS = {"force": "241x201", "belt": "61x241x17"}
DRAWS = {tier: len(EVALUATION_SEEDS) if tier == "nominal" else 32 for tier in _IDS}


def grid_sizes(text: str) -> tuple[int, ...]:
    """Return (121, 101) for "121x101"."""
    try:
        return tuple(int(size) for size in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"a grid is given as 121x101 or 101x81x9, got {text!r}") from None


TEXT = """\
Prints the mean return of every stage beside the value functions' own estimates. On the randomised tier every episode
has a plant of its own, and the optimum knows it (an upper bound). The sensed tier has the nominal optimum, the tiers
blind and blind-late that of the randomised one. Where plants change, a grid is that of the plant at the start. --quick
takes one small grid and few starts, to see that it works, and stores nothing unless --out says where. --show prints
the stored study and computes nothing. --policy stores a value function for OptimalPolicy. Ctrl-C stops; nothing is then
stored."""


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", choices=sorted(optimal.TASKS), required=True)
    parser.add_argument("--tier", choices=_IDS, default="nominal")
    parser.add_argument(
        "--draws", type=int, help="how many of the 100 evaluation seeds (default: 100; other tiers: 32)"
    )
    parser.add_argument(
        "--grid", type=grid_sizes, action="append", help="nodes along x, v_rel[, v_belt]; may be repeated"
    )
    parser.add_argument("--beam", type=int, default=100, help="width of the beam searches; 0 for none")
    parser.add_argument("--rounds", type=int, help="rounds of exchange between starts (default: 4; other tiers: 1)")
    parser.add_argument("--improve", action="store_true", help="start from the stored sequences as well")
    parser.add_argument("--quick", action="store_true", help="one small grid, 10 starts, nothing stored by default")
    parser.add_argument("--show", action="store_true", help="print the stored study, and compute nothing")
    parser.add_argument("--policy", action="store_true", help="store a value function to act on (nominal tier)")
    parser.add_argument("--out", type=Path, help="folder to store in (default: agents/optimum, unless --quick)")


def _complete(options: argparse.Namespace) -> None:
    """Fill in what depends on the task, or raise UsageError that says what does not fit."""
    quick, task, tier = options.quick, options.task, options.tier
    if options.policy and tier != "nominal":
        raise UsageError("--policy is for --tier nominal: a value function is that of one plant")
    for name in ("show", "quick", "improve"):
        if options.policy and getattr(options, name):
            raise UsageError(f"--policy and --{name} exclude one another")
    if options.draws is None:
        options.draws = 10 if quick else DRAWS[tier]
    if not 1 <= options.draws <= len(EVALUATION_SEEDS):
        raise UsageError(f"--draws must be in [1, {len(EVALUATION_SEEDS)}], got {options.draws}")
    if task not in _IDS[tier]:
        raise UsageError(f"--tier {tier} is a tier of --task {', '.join(_IDS[tier])}, not of --task {task}")
    if options.grid is None:
        texts = [POLICY_GRIDS[task]] if options.policy else QUICK_GRIDS[task] if quick else GRIDS[task, tier]
        options.grid = [grid_sizes(text) for text in texts]
    dimensions = 3 if task == "belt" else 2
    for sizes in options.grid:
        if len(sizes) != dimensions or not 3 <= min(sizes) <= max(sizes) <= 2000:
            given = "x".join(map(str, sizes))
            raise UsageError(f"--grid of --task {task} must be {dimensions} sizes in [3, 2000], got {given}")
    if options.policy and len(options.grid) != 1:
        raise UsageError(f"--policy takes one --grid, got {len(options.grid)}")
    if options.rounds is None:
        options.rounds = 1 if quick or tier != "nominal" else 4
    for name, largest in (("beam", 10_000), ("rounds", 100)):
        if not 0 <= getattr(options, name) <= largest:
            raise UsageError(f"--{name} must be in [0, {largest}], got {getattr(options, name)}")
    if quick:
        options.beam = min(options.beam, 20)
    if options.out is None and (options.policy or options.show or not quick):
        options.out = optimal.OPTIMUM_DIRECTORY


def _show(env_id: str, folder: Path) -> None:
    """Print the stored refinement study: each grid's own estimate beside what was realised, then all stages."""
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


def _optimum(options: argparse.Namespace) -> int:
    _complete(options)
    env_id = _IDS[options.tier][options.task]
    if options.show:
        try:
            _show(env_id, options.out)
        except FileNotFoundError as error:
            raise FailedError(str(error)) from None
        return 0
    from tqdm import tqdm

    start = time.perf_counter()

    def report(stage: str, value: float) -> None:
        tqdm.write(f"{time.perf_counter() - start:7.1f} s  {value:10.4f}  {stage}", file=sys.stdout)
        sys.stdout.flush()  # a log file shows it too, while it runs

    def progress(steps: range, label: str) -> Iterable[int]:
        bar: Iterable[int] = tqdm(steps, desc=label, leave=False, mininterval=0.5)
        return bar

    seeds = list(EVALUATION_SEEDS)[: options.draws]
    problem = optimal.make_problem(env_id, seeds)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    if options.policy:
        grid = optimal.make_grid(problem, options.grid[0])
        value = optimal.value_iteration(problem, grid, optimal.grid_actions(problem, grid), progress)
        report("value function's estimate", float(grid.interpolate(value.whole, problem.starts).mean()))
        path = optimal.save_value(problem, value, options.out)
        table = evaluate(optimal.OptimalPolicy.load(env_id, options.out), env_id, seeds)
        report(f"stored in {path}; realised, {table['suppressed'].mean():.0%} suppressed", table["return"].mean())
        return 0
    about: dict[str, Any] = {"command": command_line(options), "versions": optimal.versions()}
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
        problem, options.grid, beam=options.beam, rounds=options.rounds, known=known, progress=progress, report=report
    )
    if options.out is None:
        return 0
    about |= {"stages": study.stages, "value_estimates": study.estimates}
    if options.improve:  # what was found before is part of how this was found
        before = optimal.stored_study(env_id)
        about["command"] = f"{before['command']}; {command_line(options)}"
        for part in ("stages", "value_estimates"):
            about[part] = {name: value for name, value in before[part].items() if name not in about[part]} | about[part]
    returns = optimal.save_optimum(problem, seeds, study.actions, about, options.out)
    where = f"stored in {options.out} ({len(seeds)} starts, {returns.min():.2f} to {returns.max():.2f})"
    report(where, returns.mean())
    return 0


COMMANDS = {
    "optimum": Command(
        _add,
        _optimum,
        [
            "--task force",
            "--task belt --grid 201x161x17 --grid 101x241x33",
            "--task belt --tier randomised --draws 32",
            "--task belt --quick",
            "--task belt --show",
            "--task belt --policy",
        ],
        TEXT,
        "nothing was stored",
    )
}
