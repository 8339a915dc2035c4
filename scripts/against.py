"""Compare this working tree with another commit: results to the bit, speed, and the time to compile.

    python scripts/against.py 4c0ac23                        all of it (about five minutes)
    python scripts/against.py 4c0ac23 --only speed --rounds 9
    python scripts/against.py 4c0ac23 --only bits cold

Speeds are measured in turns, old and new, in processes that live side by side; a ratio is the median of the rounds'
ratios. Cold starts are CPU seconds of a process with an empty cache. The exit status is 1 if a digest differs.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Runs in either tree: what both have is the public interface.
WORKER = """
import hashlib, sys, time, warnings
warnings.filterwarnings("ignore")
import gymnasium as gym
import numpy as np
import sd_friction_env as sd

LAWS = {
    "coulomb": {"friction": "coulomb"}, "hyperbolic": {"friction": "hyperbolic"}, "duffing": {"geometry": "duffing"},
    "linear": {"geometry": "linear"}, "exponential": {"friction": "exponential"}, "alpha = 0": {"alpha": 0.0},
    "force": {"force_amplitude": 0.05},
}
made = {}

def digest(*parts):
    found = hashlib.sha256()
    for part in parts:
        found.update(np.ascontiguousarray(np.asarray(part, float)).tobytes())
    return found.hexdigest()[:16]

def bits_cycles():
    out = []
    for law in ({}, {"friction": "coulomb"}, {"friction": "hyperbolic"}, {"friction": "exponential", "mu_v": 0.01}):
        for spring in ({}, {"geometry": "cubic"}, {"geometry": "linear"}, {"geometry": "duffing"}, {"alpha": 0.0}):
            for speed in (0.05, 0.2, 0.35):
                try:
                    c = sd.limit_cycle(sd.OscillatorParameters(**law, **spring, belt_speed=speed))
                    out.append([c.amplitude, c.period, c.x_max, c.x_min, c.x_breakaway, c.floquet_multiplier])
                except sd.OrbitError:
                    out.append([-1.0] * 6)
    return digest(*out)

def bits_single():
    out = []
    for name in sd.ENVIRONMENT_IDS:
        env = gym.make(name)
        rng = np.random.default_rng(0)
        out.append(env.reset(seed=3)[0])
        for _ in range(20):
            observation, reward, *_ = env.step(rng.uniform(-1, 1, 1).astype(np.float32))
            out += [observation, [reward]]
    return digest(*out)

def bits_batch(threads, arguments={}):
    envs = gym.make_vec("SDFriction/BeltSpeed-v0", num_envs=1024, threads=threads, **arguments)
    rng = np.random.default_rng(1)
    out = [envs.reset(seed=5)[0]]
    for _ in range(60):
        out += envs.step(rng.uniform(-1, 1, (1024, 1)).astype(np.float32))[:2]
    return digest(*out)

def speed_single():
    env = gym.make("SDFriction/Force-v0")
    actions = np.random.default_rng(0).uniform(-1, 1, (400, 1)).astype(np.float32)
    env.reset(seed=1)
    begin = time.perf_counter()
    for _ in range(200):
        for action in actions:
            env.step(action)
        env.reset(seed=1)
    return 200 * 400 / (time.perf_counter() - begin)

def speed_batch(n, threads, law=None):
    key = n, threads, law
    if key not in made:
        arguments = {"parameters": LAWS[law]} if law else {}
        made[key] = gym.make_vec("SDFriction/Force-v0", num_envs=n, threads=threads, **arguments)
    envs, rng = made[key], np.random.default_rng(2)
    actions = [rng.uniform(-1, 1, (n, 1)).astype(np.float32) for _ in range(20)]
    envs.reset(seed=1)
    envs.step(actions[0])
    begin = time.perf_counter()
    steps = 0
    while time.perf_counter() - begin < 0.4:
        envs.step(actions[steps % 20])
        steps += 1
    return n * steps / (time.perf_counter() - begin)

def cold(what):
    law = {"parameters": LAWS["coulomb"]} if what == "coulomb" else {}
    if what == "batch":
        begin = time.process_time()
        envs = gym.make_vec("SDFriction/Force-v0", num_envs=300)
        envs.reset(seed=0)
        envs.step(np.zeros((300, 1), np.float32))
    else:
        if law:
            env = gym.make("SDFriction/Force-v0")
            env.reset(seed=0)
            env.step(np.zeros(1, np.float32))
        begin = time.process_time()
        env = gym.make("SDFriction/Force-v0", **law)
        env.reset(seed=0)
        env.step(np.zeros(1, np.float32))
    return time.process_time() - begin

for line in sys.stdin:
    print(eval(line), flush=True)
"""

BITS = {
    "cycles of all laws": "bits_cycles()",
    "20 steps of each id": "bits_single()",
    "batch of 1,024": "bits_batch(1)",
    "batch of 1,024, two threads": "bits_batch(2)",
}
SPEEDS = {
    "one environment": "speed_single()",
    "batch of 1,024": "speed_batch(1024, 1)",
    "batch of 8,192": "speed_batch(8192, 1)",
    "batch of 8,192, two threads": "speed_batch(8192, 2)",
    **{
        f"batch of 1,024, {law}": f"speed_batch(1024, 1, {law!r})"
        for law in ("coulomb", "hyperbolic", "duffing", "linear", "exponential", "alpha = 0", "force")
    },
}
COLD = {
    "gym.make and first step": "single",
    "first step of a batch": "batch",
    "first use of another law": "coulomb",
}


class Tree:
    """A process that imports the package from one tree."""

    def __init__(self, path: Path, cache: str | None = None) -> None:
        environment = {**os.environ, "PYTHONPATH": str(path)}
        if cache is not None:
            environment["NUMBA_CACHE_DIR"] = cache
        self._process = subprocess.Popen(
            [sys.executable, "-c", WORKER],
            cwd=path,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def ask(self, expression: str) -> str:
        """Return what an expression comes to there."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{expression}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        if not answer:
            raise RuntimeError(f"{expression} failed in {self._process.args!r}")
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """Yield a folder with the files of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "old"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "--quiet", str(path), commit], check=True)
        try:
            yield path
        finally:
            subprocess.run([*git, "remove", "--force", str(path)], check=True)


def compare_bits(old: Path) -> bool:
    """Print digests of results; return whether all are the same."""
    trees = Tree(old), Tree(ROOT)
    same = True
    for name, expression in BITS.items():
        theirs, ours = (tree.ask(expression) for tree in trees)
        same = same and theirs == ours
        print(f"{name:34} {theirs} {ours}  {'same' if theirs == ours else 'DIFFERENT'}", flush=True)
    for tree in trees:
        tree.close()
    return same


def compare_speeds(old: Path, rounds: int) -> None:
    """Print rates in steps per second and their ratio, new over old."""
    trees = Tree(old), Tree(ROOT)
    for name, expression in SPEEDS.items():
        for tree in trees:
            tree.ask(expression)
        found = []
        for turn in range(rounds):
            order = trees if turn % 2 else trees[::-1]
            rates = {id(tree): float(tree.ask(expression)) for tree in order}
            found.append((rates[id(trees[0])], rates[id(trees[1])]))
        theirs, ours = (statistics.median(pair[i] for pair in found) for i in (0, 1))
        ratio = statistics.median(new / before for before, new in found)
        print(f"{name:34} {theirs:10.4g} {ours:10.4g} steps/s, ratio {ratio:.3f}", flush=True)
    for tree in trees:
        tree.close()


def compare_cold(old: Path, rounds: int) -> None:
    """Print CPU seconds with an empty cache and their ratio, new over old."""
    for name, what in COLD.items():
        found = []
        for _ in range(rounds):
            seconds = []
            for path in (old, ROOT):
                with tempfile.TemporaryDirectory() as cache:
                    tree = Tree(path, cache)
                    seconds.append(float(tree.ask(f"cold({what!r})")))
                    tree.close()
            found.append(seconds)
        theirs, ours = (statistics.median(pair[i] for pair in found) for i in (0, 1))
        ratio = statistics.median(new / before for before, new in found)
        print(f"{name:34} {theirs:10.1f} {ours:10.1f} CPU s, ratio {ratio:.3f}", flush=True)


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="what to compare with")
    parser.add_argument("--only", nargs="+", choices=("bits", "speed", "cold"), default=("bits", "speed", "cold"))
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="of the speeds (default: 5); cold: N // 2")
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error(f"--rounds must be at least 1, got {options.rounds}")
    same = True
    with checkout(options.commit) as old:
        print(f"{'':34} {'old':>10} {'new':>10}")
        if "bits" in options.only:
            same = compare_bits(old)
        if "speed" in options.only:
            compare_speeds(old, options.rounds)
        if "cold" in options.only:
            compare_cold(old, max(1, options.rounds // 2))
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
