"""The compiled step of a batch on one core, next to the time that its arithmetic alone takes there."""

import importlib
import json
import math
import os
import statistics
import subprocess
import sys
import time
import types
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from scripts.benchmark.batches import EPISODE, FORCE, WAYS, Way, actions_for
from scripts.benchmark.measuring import Bench, Contender, Slice
from sd_friction_env import kernel

ROOT = Path(__file__).resolve().parents[2]


class Operations:
    """Counts distinct arithmetic operations: a compiler computes alpha * alpha once, however often it is written."""

    def __init__(self) -> None:
        self.distinct: Counter[str] = Counter()
        self._values: dict[tuple[Any, ...], int] = {}

    def number(self, kind: str, *key: Any) -> "Counted":
        """Return the number that a key stands for, and count it as a new operation if it is one."""
        if key not in self._values and kind:
            self.distinct[kind] += 1
        return Counted(self, self._values.setdefault(key, len(self._values)))


class Counted:
    """A number that has no value but is identified by how it was computed."""

    def __init__(self, operations: Operations, place: int) -> None:
        self.operations, self.place = operations, place

    def combined(self, kind: str, sign: str, *numbers: Any) -> "Counted":
        """Return the result of an operation; a b is b a, but a sum grouped otherwise is another sum."""
        places = [n.place if isinstance(n, Counted) else self.operations.number("", "=", n).place for n in numbers]
        return self.operations.number(kind, sign, *(sorted(places) if sign in "+*" else places))

    def __lt__(self, _: Any) -> bool:
        return True  # as for the numbers that a step accepts; a comparison is no arithmetic

    __le__ = __lt__

    def sqrt(self) -> "Counted":
        """Return the square root."""
        return self.combined("square root", "sqrt", self)


for _name, _kind, _sign in (
    ("add", "add", "+"),
    ("sub", "add", "-"),
    ("mul", "multiply", "*"),
    ("truediv", "divide", "/"),
):

    def _forward(self: Counted, other: Any, kind: str = _kind, sign: str = _sign) -> Counted:
        return self.combined(kind, sign, self, other)

    def _reflected(self: Counted, other: Any, kind: str = _kind, sign: str = _sign) -> Counted:
        return self.combined(kind, sign, other, self)

    setattr(Counted, f"__{_name}__", _forward)
    setattr(Counted, f"__r{_name}__", _reflected)
for _name in ("neg", "abs"):  # a change of sign costs next to nothing
    setattr(Counted, f"__{_name}__", lambda self, name=_name: self.combined("", name, self))


def count_operations(function: Callable[..., Any], count: int) -> Counter[str]:
    """Call a function of plain arithmetic with ``count`` numbers, and return its distinct operations by kind."""
    operations = Operations()
    function(*(operations.number("", "argument", i) for i in range(count)))
    return operations.distinct


def slip_step_operations() -> Counter[str]:
    """Count the operations of one slip step. Only where numba compiles nothing (NUMBA_DISABLE_JIT=1)."""
    for name in ("runge_kutta", "springs.inclined"):
        file: Any = importlib.import_module(f"sd_friction_env.kernel.{name}")
        file.math = types.SimpleNamespace(sqrt=Counted.sqrt, inf=math.inf)

    def step(alpha: Any, mu_s: Any, k1: Any, k3: Any, g1: Any, beta: Any, mode: Any, *motion: Any) -> Any:
        laws = kernel.Inclined(alpha), kernel.Stribeck(mu_s, k1, k3), kernel.Unexcited()
        x, v, v_belt, a_belt, u, h = motion
        plant, drive = kernel.Plant(*laws, g1, beta), kernel.Drive(v_belt, a_belt, u)
        return kernel.slip_step(plant, mode, kernel.State(x, v), drive, h)

    return count_operations(step, 13)


def kernel_operations() -> dict[str, int]:
    """Return the distinct operations of one slip step by kind, counted in an interpreter without numba's compiler."""
    code = "import json; from scripts.benchmark.arithmetic import *; print(json.dumps(slip_step_operations()))"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, check=True, capture_output=True)
    counts: dict[str, int] = json.loads(run.stdout)
    return counts


def arithmetic() -> dict[str, tuple[Callable[[Any, int], None], int, int]]:
    """Return loops of arithmetic in the first-level cache: functions of (memory, repeats), with the operations per
    element and the rows of memory. Chains are independent, so that a core runs as many at once as it can."""
    import numba

    compiled = numba.njit(error_model="numpy")

    @compiled
    def chains(memory: Any, repeats: int) -> None:
        p, q, r, s = memory[0], memory[1], memory[2], memory[3]
        for _ in range(repeats):
            for i in range(len(p)):
                a, b, c, d = p[i], q[i], r[i], s[i]
                for _ in range(6):
                    a = a * 0.9 + 0.1
                    b = b * 0.8 + 0.2
                    c = c * 0.7 + 0.3
                    d = d * 0.6 + 0.4
                p[i] = a
                q[i] = b
                r[i] = c
                s[i] = d

    @compiled
    def square_roots(memory: Any, repeats: int) -> None:
        p = memory[0]
        for _ in range(repeats):
            for i in range(len(p)):
                p[i] = math.sqrt(p[i])

    @compiled
    def quotients(memory: Any, repeats: int) -> None:
        p = memory[0]
        for _ in range(repeats):
            for i in range(len(p)):
                p[i] = 0.7 / p[i]

    return {"add and multiply": (chains, 48, 4), "square root": (square_roots, 1, 1), "divide": (quotients, 1, 1)}


def arithmetic_slice(run: Callable[[Any, int], None], per_element: int, rows: int, seconds: float) -> Slice:
    """Return slices of an arithmetic loop, in 1e9 operations per second."""
    data = np.full((rows, kernel.LANES), 0.9)

    def rate(repeats: int) -> float:
        begin = time.perf_counter()
        run(data, repeats)
        return 1e-9 * repeats * kernel.LANES * per_element / (time.perf_counter() - begin)

    rate(1)
    repeats = max(1, int(1e9 * seconds * rate(1000) / (kernel.LANES * per_element)))
    return lambda: rate(repeats)


def limit_of(operations: Mapping[str, int], rates: Mapping[str, float]) -> float:
    """Return the nanoseconds that operations take at rates (1e9 per second), kind after kind.

    rates: of "add and multiply" together, "square root" and "divide".
    """
    arithmetic_time = (operations.get("add", 0) + operations.get("multiply", 0)) / rates["add and multiply"]
    return arithmetic_time + sum(operations.get(kind, 0) / rates[kind] for kind in ("square root", "divide"))


def compiled_slice(way: Way, n: int, calls: int) -> Slice:
    """Return slices of the batch's compiled step alone, one thread, in nanoseconds per step of an environment."""
    env = gym.make_vec(FORCE, num_envs=n, episode_steps=10**6, **way.arguments)
    inner: Any = env.unwrapped
    drawn = actions_for(env, still=way.still)
    env.reset(seed=0)
    for k in range(EPISODE):
        env.step(drawn[k % 16])
    actions = [each[:, 0].astype(np.float64) for each in drawn]
    buffers = inner._buffers()

    def run() -> float:
        begin = time.perf_counter()
        for k in range(calls):
            inner._advance(actions[k % 16], buffers)
        return 1e9 * (time.perf_counter() - begin) / (calls * n)

    return run


def compiled_step(bench: Bench) -> None:
    """The compiled step of a batch on one core next to the limit of the core's arithmetic."""
    n = 8192
    print("\nOne slip step's operations (exact geometry)")
    counts = kernel_operations()
    for kind, value in counts.items():
        bench.note("kernel", f"operations, {kind}", value, f"{value}")
    seconds = 0.02 if bench.quick else 0.1
    loops = arithmetic()
    contenders = [Contender(name, arithmetic_slice(*loop, seconds), unit="1e9/s") for name, loop in loops.items()]
    calls = bench.length(200, 60)  # about 0.1 s
    contenders += [
        Contender(name, compiled_slice(way, n, calls), True, unit="ns per step") for name, way in WAYS.items()
    ]
    rows = bench.measure("kernel", f"The compiled step alone, batch of {n:,}, one core", contenders)
    rounds = zip(*(rows[name].values for name in loops), strict=True)
    limits = [limit_of(counts, dict(zip(loops, rates, strict=True))) for rates in rounds]
    limit = statistics.median(limits)
    bench.note("kernel", "limit, kind after kind", limit, f"{limit:.2f} ns per step")
    for label in WAYS:
        share = statistics.median(a / b for a, b in zip(limits, rows[label].values, strict=True))
        bench.note("kernel", f"share of the limit, {label}", share, f"{share:.1%}")
