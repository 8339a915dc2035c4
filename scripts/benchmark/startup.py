"""Start-up time and memory."""

import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from scripts.benchmark.batches import FORCE
from scripts.benchmark.measuring import Bench, Contender

ROOT = Path(__file__).resolve().parents[2]

FIRST_STEP = f"import gymnasium as g; e = g.make('sd_friction_env:{FORCE}'); e.reset(seed=0); e.step([0.1])"
FIRST_BATCH_STEP = (
    f"import gymnasium as g; e = g.make_vec('sd_friction_env:{FORCE}', num_envs=1024); e.reset(seed=0); "
    "e.step(e.action_space.sample())"
)


def seconds_of(code: str, environment: Mapping[str, str] | None = None) -> float:
    """Return how long a fresh interpreter takes for code, less what an empty one takes."""

    def run(text: str) -> float:
        begin = time.perf_counter()
        environ = os.environ | dict(environment or {})
        subprocess.run([sys.executable, "-c", text], env=environ, check=True, capture_output=True, cwd=ROOT)
        return time.perf_counter() - begin

    return run(code) - run("pass")


def startup(bench: Bench) -> None:
    """Import and first steps, with a warm and (not with --quick) a cold cache of compiled code."""
    cases = {
        "import gymnasium": "import gymnasium",
        "import sd_friction_env": "import sd_friction_env",
        "first step, warm": FIRST_STEP,
        "first step of a batch of 1,024, warm": FIRST_BATCH_STEP,
    }
    contenders = [
        Contender(label, lambda code=code: seconds_of(code), "gymnasium" not in label, unit="s")  # type: ignore[misc]
        for label, code in cases.items()
    ]
    rounds = min(bench.rounds, 2 if bench.quick else 5)
    bench.measure("startup", "Start-up, seconds beyond the interpreter's own", contenders, rounds=rounds)
    if bench.quick:
        return
    for label, code in (("first step, cold", FIRST_STEP), ("first step of a batch of 1,024, cold", FIRST_BATCH_STEP)):
        bench.progress(f"startup: {label}: compiling", passing=True)
        with tempfile.TemporaryDirectory() as empty:
            seconds = seconds_of(code, {"NUMBA_CACHE_DIR": empty})
        bench.note("startup", label, seconds, f"{seconds:.1f} s")


def array_bytes(env: Any, n: int) -> int:
    """Return the bytes of the arrays that an object holds whose size goes with n."""
    arrays = {id(part): part for part in vars(env).values() if isinstance(part, np.ndarray) and part.size >= n}
    return sum(part.nbytes for part in arrays.values())


def memory(bench: Bench) -> None:
    """Memory per environment of a batch of 8,192, by its arrays and by what Python's allocators say."""

    def held(n: int) -> tuple[float, Any]:
        tracemalloc.start()
        env = gym.make_vec(FORCE, num_envs=n)
        env.reset(seed=0)
        actions = np.zeros((n, 1), np.float32)
        results = [env.step(actions) for _ in range(3)][-1]
        traced = tracemalloc.get_traced_memory()[0] - actions.nbytes
        tracemalloc.stop()
        return traced, (env.unwrapped, results)

    n = 8192
    held(n)  # what is loaded or compiled at first use is not the batch's
    few, _ = held(1)
    many, (inner, results) = held(n)
    observations, rewards, terminated, truncated, info = results
    handed = observations.nbytes + rewards.nbytes + terminated.nbytes + truncated.nbytes
    handed += sum(part.nbytes for name, part in info.items() if isinstance(part, np.ndarray) and name[0] != "_")
    print(f"\nMemory per environment, batch of {n:,}, bytes")
    by_arrays = array_bytes(inner, n) / n
    by_allocators = (many - few) / (n - 1)
    bench.note("memory", "arrays that the batch holds", by_arrays, f"{by_arrays:.0f}")
    bench.note("memory", "arrays that a step hands out", handed / n, f"{handed / n:.0f}")
    bench.note("memory", "both, and all else, by tracemalloc", by_allocators, f"{by_allocators:.0f}")
    bench.numbers["memory"]["bytes per environment"] = max(by_arrays + handed / n, by_allocators)
