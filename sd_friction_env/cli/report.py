"""``sd-friction report``: every controller on every task and tier, as tables, pictures and one HTML page."""

import argparse
import shutil
import time
from pathlib import Path

import numpy as np
import scipy

import sd_friction_env
from sd_friction_env.cli.options import Command, FailedError, UsageError, check_at_least, command_line
from sd_friction_env.environments.ids import TASKS, TIERS
from sd_friction_env.extras import extra
from sd_friction_env.storage import AGENTS

PRETRAINED = AGENTS / "pretrained"
PUBLISHED = ("summary.md", "sweeps-belt.png", "sweeps-force.png")

TEXT = """\
Controllers: no control, constant actions, the tuned classical ones, the optimum where it is stored, and trained agents
(the seeds of one algorithm are one row). Nothing is written before all is computed; Ctrl-C leaves nothing behind."""


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS), help="actuators (default: both)")
    parser.add_argument("--tier", nargs="+", choices=TIERS, default=list(TIERS), help="tiers (default: all three)")
    text = "trained agents in folders TASK-TIER-ALGO-SEED (default: those of the package)"
    parser.add_argument("--agents", type=Path, metavar="FOLDER", help=text)
    text = "folder to write (default: report_output)"
    parser.add_argument("--out", type=Path, default=Path("report_output"), metavar="FOLDER", help=text)
    text = "copy summary and sweeps of the whole report into this folder, as control-..."
    parser.add_argument("--publish", type=Path, metavar="FOLDER", help=text)
    parser.add_argument("--quick", action="store_true", help="few episodes and points: no numbers to report")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstraps (default: 0)")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")


def _report(options: argparse.Namespace) -> int:
    partial = options.quick or options.agents is not None or {*options.task} != {*TASKS} or {*options.tier} != {*TIERS}
    if options.publish and partial:
        raise UsageError("--publish keeps the whole report: leave out --quick, --agents, --task and --tier")
    if options.publish and not options.publish.is_dir():
        raise UsageError(f"--publish must be a folder that exists, got {str(options.publish)!r}")
    check_at_least(options, seed=0)
    out: Path = options.out
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out must be a folder, and {str(out)!r} is a file")
    if not out.absolute().parent.is_dir():
        raise UsageError(f"--out must be in a folder that exists, got {str(out)!r}")
    with extra("report"):
        import jinja2  # noqa: F401
        import matplotlib as mpl  # noqa: F401
        from tqdm import tqdm

    from sd_friction_env.learning import classical, report

    begun = time.perf_counter()
    agents, notes = report.find_agents(options.agents or PRETRAINED)
    classical.stored_gains()  # a damaged file is reported before anything is computed
    keys = [(task, tier) for task in TASKS if task in options.task for tier in TIERS if tier in options.tier]
    agents = [agent for agent in agents if (agent.task, agent.tier) in keys]
    effort = report.QUICK if options.quick else report.FULL
    if options.quick:
        notes.insert(0, f"A quick look, not a result: {effort.episodes} episodes instead of {report.FULL.episodes}.")
    made = report.Report(agents, keys, effort, options.seed, notes)
    versions = f"sd_friction_env {sd_friction_env.__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"
    try:
        with tqdm(made.stages(), disable=options.no_progress, dynamic_ncols=True) as bar:
            for name, work in bar:
                bar.set_description(name)
                work()
        files = made.write(out, f"{command_line(options)}; {versions}")
        if options.publish:
            for name in PUBLISHED:
                shutil.copyfile(out / name, options.publish / f"control-{name}")
    except RuntimeError as error:  # a stored optimum of another environment
        raise FailedError(str(error)) from None
    for note in made.remarks():
        print(note)
    print(f"{len(files)} files in {time.perf_counter() - begun:.0f} s; look at {files[-1]}")
    return 0


COMMANDS = {
    "report": Command(
        _add,
        _report,
        ["", "--task belt --tier nominal --out elsewhere", "--agents runs", "--publish figures", "--quick"],
        TEXT,
    )
}
