"""Report every controller on every task and tier: tables, pictures, and one HTML page that holds them all.

    python scripts/report.py                               writes report_output/
    python scripts/report.py --task belt --tier nominal --out elsewhere
    python scripts/report.py --agents runs                 other trained agents, in folders TASK-TIER-ALGO-SEED
    python scripts/report.py --publish                     and keep what the README shows of it in figures/
    python scripts/report.py --quick                       a few episodes and points: seconds, to see that it works

Controllers: no control, constant actions, the tuned classical ones, the optimum where it is stored, and trained agents
(the seeds of one algorithm are one row). Nothing is written before all is computed; Ctrl-C leaves nothing behind.
"""

import argparse
import importlib.util
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy

import sd_friction_env
from scripts.figures import commit
from scripts.train import TASKS, TIERS, Parser

ROOT = Path(__file__).parent.parent
AGENTS, FIGURES = ROOT / "agents" / "pretrained", ROOT / "figures"
PUBLISHED = ("summary.md", "sweeps-belt.png", "sweeps-force.png")


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="report.py"
    )
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS), help="actuators (default: both)")
    parser.add_argument("--tier", nargs="+", choices=TIERS, default=list(TIERS), help="tiers (default: all three)")
    parser.add_argument("--agents", type=Path, metavar="FOLDER", help="of trained agents (default: agents/pretrained)")
    parser.add_argument("--out", type=Path, default=Path("report_output"), metavar="FOLDER", help="folder to write")
    parser.add_argument("--publish", action="store_true", help="keep summary and sweeps in figures/ too")
    parser.add_argument("--quick", action="store_true", help="few episodes and points: no numbers to report")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstraps (default: 0)")
    parser.add_argument("--no-progress", action="store_true", help="no progress bar")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the report; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    partial = options.quick or options.agents is not None or {*options.task} != {*TASKS} or {*options.tier} != {*TIERS}
    if options.publish and partial:
        parser.error("--publish keeps the whole report: leave out --quick, --agents, --task and --tier")
    if options.seed < 0:
        parser.error(f"--seed must be a whole number >= 0, got {options.seed}")
    out: Path = options.out
    if out.exists() and not out.is_dir():
        parser.error(f"--out must be a folder, and {str(out)!r} is a file")
    if not out.absolute().parent.is_dir():
        parser.error(f"--out must be in a folder that exists, got {str(out)!r}")
    missing = [name for name in ("matplotlib", "jinja2", "tqdm") if importlib.util.find_spec(name) is None]
    if missing:
        parser.error(f'a report needs {" and ".join(missing)}: pip install "sd-friction-env[report]"')
    from tqdm import tqdm

    from sd_friction_env.learning import classical, report, runs

    begun = time.perf_counter()
    agents: list[report.Agent] = []
    notes = ["There are no trained agents in agents/pretrained: they are left out."]
    try:
        if options.agents is not None or AGENTS.is_dir():
            agents, notes = report.find_agents(options.agents or AGENTS)
        classical.stored_gains()  # a damaged file is told before anything is computed
    except (runs.RunFolderError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    keys = [(task, tier) for task in TASKS if task in options.task for tier in TIERS if tier in options.tier]
    agents = [agent for agent in agents if (agent.task, agent.tier) in keys]
    effort = report.QUICK if options.quick else report.FULL
    if options.quick:
        notes.insert(0, f"A quick look, not a result: {effort.episodes} episodes instead of {report.FULL.episodes}.")
    made = report.Report(agents, keys, effort, options.seed, notes)
    words = shlex.join(sys.argv[1:] if arguments is None else arguments)
    versions = f"sd_friction_env {sd_friction_env.__version__} ({commit()}), NumPy {np.__version__}"
    origin = f"python scripts/report.py {words}".rstrip() + f"; {versions}, SciPy {scipy.__version__}"
    try:
        with tqdm(made.stages(), disable=options.no_progress, dynamic_ncols=True) as bar:
            for name, work in bar:
                bar.set_description(name)
                work()
        files = made.write(out, origin)
        if options.publish:
            for name in PUBLISHED:
                shutil.copyfile(out / name, FIGURES / f"control-{name}")
    except KeyboardInterrupt:
        print("\nreport.py: interrupted: nothing was written", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"report.py: error: cannot write into --out {str(out)!r}: {error}", file=sys.stderr)
        return 1
    except RuntimeError as error:  # a stored optimum of another environment
        print(f"report.py: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    for note in made.remarks():
        print(note)
    print(f"{len(files)} files in {time.perf_counter() - begun:.0f} s; look at {files[-1]}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
