"""Measure the speed, ours and others', interleaved in one run: medians and ratios, for timings vary.

    python scripts/benchmark.py                    all of it (a minute or two)
    python scripts/benchmark.py --quick            fewer repeats
    python scripts/benchmark.py --out result.json  keep the numbers too

What is not installed is skipped with a word.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sd_friction_env import OscillatorParameters, limit_cycle
from sd_friction_env.tables import atomic_file


def steps_per_second(env_id: str, steps: int) -> Callable[[], float]:
    """Return a measurement of one environment made by gym.make, random actions, resets included."""
    env = gym.make(env_id)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1000)]
    env.reset(seed=0)

    def measure() -> float:
        begin = time.perf_counter()
        for i in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[i % 1000])
            if terminated or truncated:
                env.reset()
        return steps / (time.perf_counter() - begin)

    measure()
    return measure


def single_environments(repeats: int, steps: int) -> dict[str, float]:
    """One environment through gym.make against Gymnasium's own."""
    import sd_friction_env

    ids = ["CartPole-v1", "Pendulum-v1", *sd_friction_env.ENVIRONMENT_IDS]
    measures = {env_id: steps_per_second(env_id, steps) for env_id in ids}
    rates: dict[str, list[float]] = {env_id: [] for env_id in ids}
    for _ in range(repeats):
        for env_id, measure in measures.items():
            rates[env_id].append(measure())
    print("\nOne environment through gym.make, steps/s (median of", repeats, "interleaved runs)")
    result = {}
    for env_id, values in rates.items():
        ratio = statistics.median(a / b for a, b in zip(values, rates["CartPole-v1"], strict=True))
        spread = (max(values) - min(values)) / statistics.median(values)
        print(f"  {env_id:36}{statistics.median(values):10.0f}   spread {spread:4.0%}   {ratio:5.2f} x CartPole-v1")
        result[env_id] = ratio
    return result


def seconds_of(code: str, environment: dict[str, str]) -> float:
    """Return how long a fresh interpreter takes for code, less what an empty one takes."""

    def run(text: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", text], env=os.environ | environment, check=True, capture_output=True)
        return time.perf_counter() - begin

    return run(code) - run("pass")


def start_up(repeats: int) -> dict[str, float]:
    """Import, and the first make + reset + step, with a warm and a cold cache of compiled code."""
    first = "import gymnasium as g; e = g.make('sd_friction_env:SDFriction/Force-v0'); e.reset(seed=0); e.step([0.1])"
    seconds_of(first, {})
    result = {
        "import": statistics.median(seconds_of("import sd_friction_env", {}) for _ in range(repeats)),
        "first step, warm": statistics.median(seconds_of(first, {}) for _ in range(repeats)),
    }
    with tempfile.TemporaryDirectory() as empty:
        result["first step, cold"] = seconds_of(first, {"NUMBA_CACHE_DIR": empty})
    print("\nStart-up, seconds beyond the interpreter's own")
    for name, value in result.items():
        print(f"  {name:36}{value:10.2f}")
    return result


def one_cycle(repeats: int) -> dict[str, float]:
    """One stick-slip cycle by our orbit solver and by programs that no one here wrote, who do the same work."""
    from tests import test_peers

    cycle = limit_cycle(OscillatorParameters())
    work: dict[str, Callable[[], Any]] = {"ours (settle and close)": lambda: limit_cycle(OscillatorParameters())}
    for parameter in test_peers.PROGRAMS:
        program = parameter.values[0]

        def solve(program: Any = program) -> tuple[Any, Any]:
            return test_peers.slip_then_stick(program, cycle)

        work[str(parameter.id)] = solve
    print("\nOne stick-slip cycle (exact, alpha .8, v_b .2), events included, milliseconds; gap of the period to ours")
    result = {}
    for name, solve_once in work.items():
        try:
            answer = solve_once()
        except BaseException as missing:  # pytest's skip is no Exception
            if type(missing).__name__ != "Skipped":
                raise
            print(f"  {name:36}{'skipped: ' + str(missing)}")
            continue
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            solve_once()
            times.append(1e3 * (time.perf_counter() - begin))
        period = answer.period if name.startswith("ours") else answer[0].t + answer[1].t
        gap = abs(period / cycle.period - 1.0)
        print(f"  {name:36}{statistics.median(times):10.3f}   {gap:.1e}")
        result[name] = statistics.median(times)
    return result


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the numbers as JSON")
    options = parser.parse_args(arguments)
    if options.out is not None and not options.out.parent.is_dir():
        parser.error(f"--out {str(options.out)!r} lies in no existing folder")
    repeats, steps = (3, 10_000) if options.quick else (9, 30_000)
    python = sys.version.split()[0]
    print(f"Python {python}, NumPy {np.__version__}, Gymnasium {gym.__version__}, {os.cpu_count()} cores")
    result = {
        "ratio to CartPole-v1": single_environments(repeats, steps),
        "start-up, s": start_up(3 if options.quick else 5),
        "one cycle, ms": one_cycle(3 if options.quick else 7),
    }
    if options.out is not None:
        with atomic_file(options.out) as file:
            json.dump(result, file, indent=1)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
