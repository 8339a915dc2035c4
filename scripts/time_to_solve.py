"""Measure how many CPU seconds PPO needs until it solves a task, from the start of the process, imports included.

    python scripts/time_to_solve.py                        belt, seeds 0 to 4: a quarter of an hour
    python scripts/time_to_solve.py --task force --seeds 2

Contenders: PPO of Stable-Baselines3 ("plain"), `sd-friction train`'s default ("fast") and, on belt, the default started
from the threshold follower ("rule"). Each training has a process of its own and one thread; seed by seed they follow
each other, so what slows the machine slows all, and a ratio is the median of the seeds' ratios to the first contender.
After every 8,192 steps the agent is scored on the 100 evaluation starts, as `sd-friction evaluate` does; the run keeps
its best by the 50 validation starts. CPU seconds of neither are counted: a run has twenty evaluations, about 1 s.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

CONTENDERS: dict[str, dict[str, Any]] = {
    "plain": {"implementation": "stable-baselines3"},
    "fast": {},
    "rule": {"start_from": "threshold-follower"},
}
TASKS = {
    "belt": ("SDFriction/BeltSpeed-v0", ("plain", "fast", "rule")),
    "force": ("SDFriction/Force-v0", ("plain", "fast")),
}
SCORES = (0.90, 0.95, 0.98, 0.99)
EVAL_FREQ = 8192


def measure(task: str, contender: str, seed: int) -> list[dict[str, float]]:
    """Train in this process; return steps, CPU seconds since its start, score and suppressed share per evaluation."""
    import numpy as np

    from sd_friction_env.learning import evaluation, training
    from sd_friction_env.learning.plan import make_plan

    env_id = TASKS[task][0]
    plan = make_plan(env_id, "ppo", seed=seed, eval_freq=EVAL_FREQ, **CONTENDERS[contender])
    rows: list[dict[str, float]] = []
    uncounted, validate, seeds = 0.0, training.validate, evaluation.EVALUATION_SEEDS

    def timed(policy: Any, plan: Any) -> dict[str, float]:
        nonlocal uncounted
        began = time.process_time()
        found = validate(policy, plan)
        table = evaluation.evaluate(policy, env_id, seeds, passive=evaluation.passive_episodes(env_id, seeds))
        uncounted += time.process_time() - began
        means = {name: float(table[name].mean()) for name in ("return", "suppressed")}
        rows.append({"cpu": time.process_time() - uncounted, "validation": found["credited_return"], **means})
        return found

    training.validate = timed
    with tempfile.TemporaryDirectory() as folder:
        result = training.train(plan, Path(folder) / "run", checkpoint_freq=plan.steps // 20, progress=False)
    passive = np.nansum(evaluation.passive_episodes(env_id, seeds).reward, axis=1).mean()
    optimal = evaluation.optimal_returns(env_id, seeds)
    assert optimal is not None
    gap = float(np.nanmean(optimal) - passive)
    steps = result.evaluations["steps"]
    return [
        {"steps": float(n), "score": (row["return"] - passive) / gap, **row} for n, row in zip(steps, rows, strict=True)
    ]


def first_at(rows: Sequence[Mapping[str, float]], score: float, name: str = "cpu") -> float:
    """Return a column's value at the first evaluation with a score; NaN if none has it."""
    return next((row[name] for row in rows if row["score"] >= score), float("nan"))


def print_table(found: Mapping[str, Sequence[Sequence[Mapping[str, float]]]]) -> None:
    """Print the CPU seconds until each score, seed by seed, and the median ratios to the first contender."""
    import numpy as np

    first = next(iter(found))
    for name, runs in found.items():
        print(f"\n{name}: CPU seconds until a score is first reached, seed by seed")
        for score in SCORES:
            seconds = np.array([first_at(rows, score) for rows in runs])
            steps = np.array([first_at(rows, score, "steps") for rows in runs])
            before = np.array([first_at(rows, score) for rows in found[first][: len(runs)]])
            listed = "  ".join(f"{value:6.1f}" for value in seconds)
            print(
                f"  {score:.2f}  {listed}   median {np.median(seconds):6.1f} s, {np.median(steps) / 1e3:6.0f} thousand "
                f"steps; {np.median(seconds / before):.2f} of {first}"
            )
        for what in ("score", "suppressed", "cpu"):
            print(f"  {'at the end, ' + what:24}", "  ".join(f"{rows[-1][what]:6.3f}" for rows in runs))
        best = [max(rows, key=lambda row: row["validation"]) for rows in runs]
        print(f"  {'best kept, score':24}", "  ".join(f"{row['score']:6.3f}" for row in best))
        print(f"  {'best kept, suppressed':24}", "  ".join(f"{row['suppressed']:6.3f}" for row in best), flush=True)


def main() -> int:
    """Measure as the command line says; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--task", choices=TASKS, default="belt", help="default: belt")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="seeds 0 to N - 1 (default: 5)")
    parser.add_argument("--contender", nargs="+", choices=CONTENDERS, help="default: all of the task")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write all evaluations")
    parser.add_argument("--one", type=int, metavar="SEED", help=argparse.SUPPRESS)  # what each process is started with
    options = parser.parse_args()
    if options.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {options.seeds}")
    contenders = options.contender or TASKS[options.task][1]
    if options.one is not None:
        print(json.dumps(measure(options.task, contenders[0], options.one)))
        return 0
    found: dict[str, list[list[dict[str, float]]]] = {name: [] for name in contenders}
    for seed in range(options.seeds):
        for name in contenders:
            command = [sys.executable, __file__, "--task", options.task, "--contender", name, "--one", str(seed)]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            found[name].append(json.loads(done.stdout))
        print(f"\nSeeds 0 to {seed}, {options.task}")
        print_table(found)
        if options.out is not None:
            options.out.write_text(json.dumps(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
