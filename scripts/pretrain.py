"""Train the agents that come with the project, several seeds of each, and put the best of each in the package.

    python scripts/pretrain.py                                   PPO, all tasks and tiers, five seeds (half an hour)
    python scripts/pretrain.py --only belt-nominal --algo td3    some of them
    python scripts/pretrain.py --package-only                    choose and package again, without training

Every run is one of `sd-friction train`, in agents/pretrained/TASK-TIER-ALGO-SEED without its checkpoints. Runs that are
there are kept, unfinished ones resumed: stop with Ctrl-C, start again with the same command. For each task and tier
the run with the best validation episodes goes to agents/best/, with what it did on the evaluation
episodes.
"""

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sd_friction_env.cli.options import Parser
from sd_friction_env.control.pretrained import fingerprint, pretrained_file
from sd_friction_env.environments.ids import TASKS, TIERS, environment_id
from sd_friction_env.learning import evaluation, runs
from sd_friction_env.learning.settings import ALGORITHMS

ROOT = Path(__file__).resolve().parent.parent
PRETRAINED = ROOT / "agents" / "pretrained"
NAMES = [f"{task}-{tier}" for task in TASKS for tier in TIERS]


def run_folder(name: str, algorithm: str, seed: int) -> Path:
    """Return where a run is kept."""
    return PRETRAINED / f"{name}-{algorithm}-{seed}"


def train(name: str, algorithm: str, seed: int) -> str:
    """Train one agent in a process of its own, or go on with one that is unfinished; return what went wrong, or ""."""
    folder = run_folder(name, algorithm, seed)
    if folder.is_dir():
        return ""
    task, _, tier = name.partition("-")
    command = ["--task", task, "--tier", tier, "--algo", algorithm, "--seed", str(seed), "--no-progress"]
    command += ["--run-folder", str(folder.relative_to(ROOT))]
    if algorithm == "ppo":  # the class that the stored runs were trained with
        command += ["--implementation", "stable-baselines3"]
    if runs.partial_folder(folder).is_dir():
        command += ["--resume"]
    run = subprocess.run(
        [sys.executable, "-m", "sd_friction_env", "train", *command],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    if run.returncode:
        return f"{folder.name}: {run.stderr.strip().splitlines()[-1] if run.stderr.strip() else run.returncode}"
    for part in (runs.CHECKPOINTS, runs.TENSORBOARD):
        shutil.rmtree(folder / part, ignore_errors=True)
    return ""


def best_run(name: str) -> tuple[Path, dict[str, Any]] | None:
    """Return the run of a task and tier that did best on its validation episodes, and its configuration."""
    folders = sorted(PRETRAINED.glob(f"{name}-*-[0-9]*"))
    found = [(folder, runs.load_config(folder)) for folder in folders if not folder.name.endswith(runs.PARTIAL)]
    return max(found, key=lambda entry: entry[1]["best"]["credited_return"], default=None)


def package(name: str) -> str:
    """Put the best run of a task and tier into the package; return a line that says what it is."""
    task, _, tier = name.partition("-")
    env_id = environment_id(task, tier)
    best = best_run(name)
    if best is None:
        return f"{name}: no run"
    folder, config = best
    policy = runs.load_network(folder)
    table = evaluation.evaluate(policy, env_id)
    passive = evaluation.passive_episodes(env_id)
    about = {
        "env_id": env_id,
        "run": folder.name,
        **{key: config[key] for key in ("algorithm", "seed", "steps", "seconds", "command", "versions")},
        "evaluation": {
            "first_seed": evaluation.EVALUATION_SEEDS[0],
            "episodes": table.n_rows,
            "mean_return": float(table["return"].mean()),
            "mean_passive_return": float(np.nansum(passive.reward, axis=1).mean()),
            "suppressed": float(table["suppressed"].mean()),
            "amplitude_reduction": float(np.nanmean(table["amplitude_reduction"])),
        },
        "fingerprint": fingerprint(env_id),
    }
    target = pretrained_file(env_id)
    target.parent.mkdir(exist_ok=True)
    dataclasses.replace(policy, metadata=json.loads(json.dumps(about))).save(target)
    said = about["evaluation"]
    return f"{env_id}: {folder.name}, return {said['mean_return']:.2f}, suppressed {said['suppressed']:.0%}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and package as the command line says; return the exit status."""
    parser = Parser(description=__doc__, prog="pretrain.py")
    parser.add_argument(
        "--only", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help=f"of {', '.join(NAMES)}"
    )
    parser.add_argument("--algo", nargs="+", choices=ALGORITHMS, default=["ppo"], help="default: ppo")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="train seeds 0 to N - 1 (default: 5)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="runs at a time (default: 2)")
    parser.add_argument("--package-only", action="store_true", help="train nothing")
    options = parser.parse_args(arguments)
    for option in ("seeds", "workers"):
        if getattr(options, option) < 1:
            parser.error(f"--{option} must be at least 1, got {getattr(options, option)}")
    failed: list[str] = []
    if not options.package_only:
        jobs = [(name, algo, seed) for seed in range(options.seeds) for algo in options.algo for name in options.only]
        PRETRAINED.mkdir(exist_ok=True)
        with ThreadPoolExecutor(options.workers) as pool:
            try:
                told = list(tqdm(pool.map(lambda job: train(*job), jobs), total=len(jobs), unit=" runs"))
            except KeyboardInterrupt:
                pool.shutdown(cancel_futures=True)
                print("\npretrain.py: interrupted; the same command goes on from here", file=sys.stderr)
                return 130
        failed = [line for line in told if line]
    for name in options.only:
        print(package(name))
    if failed:
        print("\n".join(["pretrain.py: these runs failed:", *failed]), file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
