"""Measure the speed, ours and others', interleaved in one run: medians, spreads and ratios, for timings vary.

    python scripts/benchmark.py                         all of it (about five minutes)
    python scripts/benchmark.py --quick                 fewer and shorter slices (a minute)
    python scripts/benchmark.py --only batch kernel     some sections
    python scripts/benchmark.py --out result.json --plot result.png

Each round times one slice of every contender, so what slows the machine slows them all, and a ratio is the median of
the rounds' ratios. EnvPool and gymnax run in an interpreter of their own (`make benchmark-peers` makes .venv-peers)
and wait while others are timed. What is not installed is skipped with a word. The exit status is 1 if a check fails
that the numbers stand for the promised work; a target that is missed is only told.
"""

import argparse
import contextlib
import dataclasses
import importlib
import importlib.metadata
import importlib.util
import itertools
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import tracemalloc
import types
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import sd_friction_env
from sd_friction_env import OscillatorParameters, kernel, limit_cycle
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import atomic_file, checked_ending

ROOT = Path(__file__).resolve().parent.parent
FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"
SIZES = (1, 16, 256, 1024, 8192)
EPISODE = 501  # calls from one reset of a batch to the next: 500 steps and the call that resets
BUSY = 0.5
AMPLITUDE_BOUND = 1e-7
SCIPY_BOUND = 1e-6
KIBIBYTE = 1024.0


class Way(NamedTuple):
    """A way to run a batch: arguments of the environment, and whether all actions are 0."""

    arguments: dict[str, Any]
    still: bool = False


WAYS = {
    "as it is": Way({}),
    # The belt is so fast that the squeal is a cycle without stick, which goes on when nobody acts ...
    "slip only": Way({"parameters": {"belt_speed": 0.42}}, still=True),
    # ... and here so fast that there is no cycle: the mass slips in one place, shaken by the actions.
    "slip only, random force": Way({"parameters": {"belt_speed": 1.2}}),
}

Slice = Callable[[], float]


# What is measured, and how --------------------------------------------------------------------------------------------


class Contender(NamedTuple):
    """One thing to time: ``slice()`` runs it for a while and returns its rate (or time) in ``unit``.

    panel: in which part of the plot it stands; "": in none.
    """

    label: str
    slice: Slice
    ours: bool = False
    panel: str = ""
    unit: str = "steps/s"


@dataclasses.dataclass
class Row:
    """What a contender reached, one value per round."""

    unit: str
    ours: bool
    panel: str
    values: list[float] = dataclasses.field(default_factory=list)

    @property
    def median(self) -> float:
        """The median over the rounds."""
        return statistics.median(self.values)

    @property
    def quartiles(self) -> tuple[float, float]:
        """The lower and the upper quartile over the rounds."""
        low, high = np.quantile(self.values, (0.25, 0.75)).tolist()
        return low, high


Rows = dict[str, dict[str, Row]]
Numbers = dict[str, dict[str, float]]


def ratio_of(row: Row, reference: Row) -> float:
    """Return the median over the rounds of one contender's value by another's in the same round."""
    return statistics.median(a / b for a, b in zip(row.values, reference.values, strict=False))


class Bench:
    """What one run has measured so far, and how long its slices are."""

    def __init__(self, *, quick: bool, rounds: int | None, steps: int | None, peers: Path | None) -> None:
        self.quick = quick
        self.rounds = rounds or (3 if quick else 15)
        self.steps = steps
        self.peers = peers
        self.rows: Rows = {}
        self.numbers: Numbers = {}
        self.checks: list[Check] = []
        self.skipped: dict[str, str] = {}
        self._began = time.perf_counter()

    def length(self, full: int, quick: int) -> int:
        """Return how many steps a slice has: what the command line says, or one of these."""
        return self.steps or (quick if self.quick else full)

    def progress(self, text: str, *, passing: bool = False) -> None:
        """Tell on stderr where the run is; what is ``passing`` is only shown on a terminal, and overwritten."""
        terminal = sys.stderr.isatty()
        if not passing or terminal:
            line = f"[{time.perf_counter() - self._began:5.0f} s] {text}"
            print(f"\r\x1b[K{line}" if terminal else line, end="" if passing else "\n", file=sys.stderr, flush=True)

    def measure(
        self, section: str, title: str, contenders: Sequence[Contender], reference: str = "", rounds: int | None = None
    ) -> dict[str, Row]:
        """Time the contenders, a slice of each per round after one that does not count, and print the table."""
        rounds = rounds or self.rounds
        every = {each.label: Row(each.unit, each.ours, each.panel) for each in contenders}
        self.rows.setdefault(section, {}).update(every)
        try:
            for place, each in enumerate(contenders, 1):
                self.progress(f"{section}: warming up {place}/{len(contenders)}, {each.label}", passing=True)
                each.slice()
            for k in range(rounds):
                self.progress(f"{section}: round {k + 1}/{rounds}", passing=True)
                # Back and forth: a drift of the machine then favours nobody.
                for each in contenders if k % 2 == 0 else reversed(contenders):
                    every[each.label].values.append(each.slice())
        finally:
            for label in [label for label, row in every.items() if not row.values]:
                del self.rows[section][label], every[label]
            print_rows(title, every, reference)
        return every

    def note(self, section: str, name: str, value: float, text: str) -> None:
        """Keep a number and print it."""
        self.numbers.setdefault(section, {})[name] = float(value)
        print(f"  {name:62} {text}", flush=True)

    def check(self, what: str, value: float, bound: float) -> None:
        """Check that a value is below a bound; the run's exit status is 1 if one is not."""
        self.checks.append(Check(what, float(value), bound))
        print(f"  {what:62} {value:.1e} (allowed {bound:.0e}){'' if self.checks[-1].met else '   FAILED'}", flush=True)

    def skip(self, section: str, why: str) -> None:
        """Say why something is left out."""
        self.skipped[section] = why
        print(f"\n{section}: skipped, {why}", flush=True)


class Check(NamedTuple):
    """A condition under which the timings mean what they say."""

    what: str
    value: float
    bound: float

    @property
    def met(self) -> bool:
        """Whether the value is below its bound."""
        return self.value < self.bound


def print_rows(title: str, rows: Mapping[str, Row], reference: str = "") -> None:
    """Print a table: the medians, the quartiles, and the ratio to the contender ``reference``."""
    if not rows:
        return
    to = rows.get(reference)
    head = f"x {reference}" if to is not None else ""
    print(f"\n{title}\n  {'':62}{'median':>14}{'quartiles':>27}   {'':14}{head}".rstrip())
    for label, row in rows.items():
        low, high = row.quartiles
        ratio = "" if to is None else f"{ratio_of(row, to):.3g}"
        spread = f"{_short(low)} .. {_short(high)}"
        name = f"{'*' if row.ours else ' '} {label:62}"
        print(f"{name}{_short(row.median):>14}{spread:>27}   {row.unit:14}{ratio}".rstrip())
    sys.stdout.flush()


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


# One environment, and batches -----------------------------------------------------------------------------------------


def single_slice(env_id: str, steps: int) -> Slice:
    """Return slices of one environment made by gym.make, random actions, resets included."""
    env = gym.make(env_id)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1000)]
    env.reset(seed=0)

    def run() -> float:
        begin = time.perf_counter()
        for i in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[i % 1000])
            if terminated or truncated:
                env.reset()
        return steps / (time.perf_counter() - begin)

    return run


def actions_for(env: gym.vector.VectorEnv[Any, Any, Any], *, still: bool = False) -> list[Any]:
    """Return 16 random actions of a batch, or nothing but zeros."""
    env.action_space.seed(0)
    return [env.action_space.sample() * (0 if still else 1) for _ in range(16)]


def batch_slice(
    env: gym.vector.VectorEnv[Any, Any, Any], steps: int, *, staggered: bool = False, still: bool = False
) -> Slice:
    """Return slices of ``steps`` calls of a batch, 16 drawn actions in turn, resets included; each call counts as one
    step of every environment."""
    actions = actions_for(env, still=still)
    env.reset(seed=0)
    if staggered:
        inner = env.unwrapped
        assert isinstance(inner, sd_friction_env.SDFrictionVectorEnv)
        inner.stagger()

    def run() -> float:
        begin = time.perf_counter()
        for i in range(steps):
            env.step(actions[i % 16])
        return steps * env.num_envs / (time.perf_counter() - begin)

    return run


def single(bench: Bench) -> None:
    """One environment through gym.make against Gymnasium's own."""
    steps = bench.length(30_000, 10_000)
    ids = ["CartPole-v1", "Pendulum-v1", *sd_friction_env.ENVIRONMENT_IDS]
    contenders = [
        Contender(env_id, single_slice(env_id, steps), "SDFriction" in env_id, "one environment, gym.make")
        for env_id in ids
    ]
    bench.measure("single", "One environment through gym.make, steps per second", contenders, "CartPole-v1")


def panel(n: int) -> str:
    """Return the name of the plot's panel for batches of this size."""
    return f"a batch of {n:,}"


def cartpoles(n: int) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Return Gymnasium's own batch of CartPoles."""
    return gym.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")


def our_label(env_id: str, n: int, threads: int, *, staggered: bool = False) -> str:
    """Return the name of a batch of ours in the tables."""
    return f"{env_id}, {n:,}, {threads} thread{'s' * (threads > 1)}{', staggered' * staggered}"


def batch(bench: Bench) -> None:
    """Batches through gym.make_vec against Gymnasium's own."""
    for n in SIZES:
        steps = bench.length(*{1024: (4 * EPISODE, EPISODE), 8192: (EPISODE, EPISODE)}.get(n, (6 * EPISODE, EPISODE)))
        contenders = [Contender(f"CartPole-v1, {n:,}", batch_slice(cartpoles(n), steps), panel=panel(n))]
        if n <= 16:
            pendulums = gym.make_vec("Pendulum-v1", num_envs=n, vectorization_mode="sync")
            contenders.append(Contender(f"Pendulum-v1 (sync), {n:,}", batch_slice(pendulums, steps), panel=panel(n)))
        variants = [(env_id, threads, False) for env_id in (FORCE, BELT) for threads in (1, 2)]
        if n >= 1024:
            variants += [(FORCE, threads, True) for threads in (1, 2)]
        for env_id, threads, staggered in variants:
            run = batch_slice(gym.make_vec(env_id, num_envs=n, threads=threads), steps, staggered=staggered)
            # Batches this small use one thread, whatever they are told: no bars for the same thing twice.
            plotted = "" if threads > 1 and n < 1024 else panel(n)
            contenders.append(Contender(our_label(env_id, n, threads, staggered=staggered), run, True, plotted))
        bench.measure(
            "batch", f"A batch of {n:,} through gym.make_vec, steps per second", contenders, f"CartPole-v1, {n:,}"
        )


class Watched(NamedTuple):
    """What a batch under random actions met: of each kind the mean over all steps of all environments."""

    events: float
    stick: float
    turns: float


def watched(env_id: str, n: int, calls: int, way: Way) -> Watched:
    """Step a batch, untimed, and count what happens in it.

    A turn is a step in which v changes its sign: no event, but it is located like one.
    """
    env = gym.make_vec(env_id, num_envs=n, info_keys=("events", "stick_fraction", "v"), **way.arguments)
    actions = actions_for(env, still=way.still)
    v = env.reset(seed=0)[1]["v"]
    events = stick = turns = steps = 0.0
    for k in range(calls):
        info = env.step(actions[k % 16])[4]
        if "events" in info:
            took = info["_events"]
            steps += np.count_nonzero(took)
            events += info["events"][took].sum()
            stick += info["stick_fraction"][took].sum()
            turns += np.count_nonzero((info["v"] * v)[took] < 0.0)
        v = info["v"]
    env.close()
    return Watched(events / steps, stick / steps, turns / steps)


def slip(bench: Bench) -> None:
    """Batches that only slip, and what events cost the others."""
    met = {name: watched(FORCE, 1024, bench.length(EPISODE, EPISODE), way) for name, way in WAYS.items()}
    for n in (1024, 8192):
        steps = bench.length(*{1024: (4 * EPISODE, EPISODE), 8192: (EPISODE, EPISODE)}[n])
        contenders = []
        for name, way in WAYS.items():
            run = batch_slice(gym.make_vec(FORCE, num_envs=n, **way.arguments), steps, still=way.still)
            plotted = panel(n) if name == "slip only" else ""
            contenders.append(Contender(f"{FORCE}, {n:,}, 1 thread, {name}", run, True, plotted))
        rows = bench.measure("slip", f"A batch of {n:,}: what events cost", contenders, contenders[0].label)
        for each, name in zip(contenders, WAYS, strict=True):
            rate = met[name].events * rows[each.label].median
            bench.note("slip", f"{n:,}, {name}: events/s", rate, f"{rate:,.0f}")
    for name, seen in met.items():
        bench.note("slip", f"{name}: events per step", seen.events, f"{seen.events:.4f}")
        bench.note("slip", f"{name}: turns per step", seen.turns, f"{seen.turns:.4f}")
        if name != "as it is":
            bench.check(f"{name}: events per step and share of time in stick", seen.events + seen.stick, 1e-300)


# Whether the numbers stand for the promised work ----------------------------------------------------------------------


def amplitude_gap(env_id: str) -> float:
    """Return how far the batch's settled amplitude is from the orbit solver's, the worst of 64 environments."""
    cycle = limit_cycle(OscillatorParameters())
    env = gym.make_vec(env_id, num_envs=64, episode_steps=10**6, info_keys=("x_min", "x_max"))
    inner = env.unwrapped
    assert isinstance(inner, sd_friction_env.SDFrictionVectorEnv)
    period = math.ceil(cycle.period / inner.task.control_interval)
    env.reset(seed=0)
    still = np.zeros((64, 1), np.float32)
    low, high = np.full(64, np.inf), np.full(64, -np.inf)
    for k in range(42 * period):
        info = env.step(still)[4]
        if k >= 40 * period:
            low, high = np.minimum(low, info["x_min"]), np.maximum(high, info["x_max"])
    env.close()
    return float(np.max(np.abs(0.5 * (high - low) - cycle.amplitude)))


def work(bench: Bench) -> None:
    """The work that a step stands for, and how accurately it is done."""
    print("\nThe work in a step")
    interval = sd_friction_env.Task().control_interval
    cycle = limit_cycle(OscillatorParameters())
    ours = cycle.period / interval
    bench.note("work", f"{FORCE}: control interval (natural frequency 1)", interval, f"{interval:g}")
    bench.note("work", f"{FORCE}: control intervals per period of its cycle", ours, f"{ours:.1f}")
    cartpole: Any = gym.make("CartPole-v1").unwrapped
    # Small swings of the pole about hanging straight down, cart and all.
    reach = cartpole.length * (4.0 / 3.0 - cartpole.masspole / cartpole.total_mass)
    swing = 2.0 * math.pi * math.sqrt(reach / cartpole.gravity)
    bench.note("work", "CartPole-v1: control interval", cartpole.tau, f"{cartpole.tau:g} s, one Euler step")
    bench.note("work", "CartPole-v1: control intervals per swing", swing / cartpole.tau, f"{swing / cartpole.tau:.1f}")
    pendulum: Any = gym.make("Pendulum-v1").unwrapped
    swing = 2.0 * math.pi * math.sqrt(2.0 * pendulum.l / (3.0 * pendulum.g))
    bench.note("work", "Pendulum-v1: control interval", pendulum.dt, f"{pendulum.dt:g} s, one Euler step")
    bench.note("work", "Pendulum-v1: control intervals per swing", swing / pendulum.dt, f"{swing / pendulum.dt:.1f}")
    for env_id in (FORCE, BELT):
        met = watched(env_id, 256, bench.length(2 * EPISODE, EPISODE), WAYS["as it is"])
        bench.note("work", f"{env_id}: events per step", met.events, f"{met.events:.4f}")
        bench.note("work", f"{env_id}: share of time in stick", met.stick, f"{met.stick:.4f}")
        run = batch_slice(gym.make_vec(env_id, num_envs=1024), bench.length(EPISODE, EPISODE))
        run()
        rate = met.events * statistics.median(run() for _ in range(3))
        bench.note("work", f"{env_id}, 1,024, 1 thread: events/s", rate, f"{rate:,.0f}")
    for env_id in (FORCE, BELT):
        bench.check(f"{env_id}: gap of the settled amplitude", amplitude_gap(env_id), AMPLITUDE_BOUND)


# Peers in an interpreter of their own ---------------------------------------------------------------------------------

# Answers "N\n" with the rate of a slice of N calls. What libraries print must not get into the answers.
WORKER = """
import json, os, sys, time

answers = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
program, n, threads = json.loads(sys.argv[1])
try:
    import numpy as np

    rng = np.random.default_rng(0)
    if program == "envpool":
        import envpool

        env = envpool.make("Pendulum-v1", "gymnasium", num_envs=n, num_threads=threads)
        env.reset()
        actions = [rng.uniform(-2.0, 2.0, (n, 1)).astype(np.float32) for _ in range(16)]

        def run(calls):
            for i in range(calls):
                env.step(actions[i % 16])

    else:
        import gymnax
        import jax

        env, parameters = gymnax.make("Pendulum-v1")
        # Random numbers are for resets only: drawn beforehand, they cost nothing here.
        keys = jax.random.split(jax.random.key(0), n)
        actions = [jax.device_put(rng.uniform(-2.0, 2.0, (n,)).astype(np.float32)) for _ in range(16)]
        state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, parameters)[1]
        every = jax.vmap(env.step, in_axes=(0, 0, 0, None))
        if program == "gymnax":
            step = jax.jit(every)

            def run(calls):
                global state
                for i in range(calls):
                    out = jax.block_until_ready(step(keys, state, actions[i % 16], parameters))
                    state = out[1]

        else:
            table = jax.numpy.stack(actions)

            def scanned(state, indices):
                def one(state, i):
                    out = every(keys, state, table[i], parameters)
                    return out[1], (out[0], out[2], out[3])

                return jax.lax.scan(one, state, indices)

            scan = jax.jit(scanned)

            def run(calls):
                global state
                state = jax.block_until_ready(scan(state, jax.numpy.arange(calls) % 16))[0]

    run(2)
except ImportError as error:
    print(json.dumps({"missing": str(error)}), file=answers)
    sys.exit()
print(json.dumps({"missing": ""}), file=answers)
for line in sys.stdin:
    calls = int(line)
    begin = time.perf_counter()
    run(calls)
    print(json.dumps({"rate": calls * n / (time.perf_counter() - begin)}), file=answers)
"""


class PeerError(Exception):
    """A peer cannot run here; says why."""


class Peer:
    """A peer's batch in another interpreter, asked for one slice at a time."""

    def __init__(self, python: Path, program: str, n: int, threads: int) -> None:
        self._stderr = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed by close()
        self._process = subprocess.Popen(
            [str(python), "-W", "ignore", "-c", WORKER, json.dumps([program, n, threads])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            text=True,
            cwd=tempfile.gettempdir(),
        )
        try:
            missing = self._answer()["missing"]
            if missing:
                raise PeerError(f"{python} cannot import it ({missing}); `make benchmark-peers` makes .venv-peers")
        except BaseException:
            self.close()
            raise

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._stderr.seek(0)
            last = self._stderr.read().strip().splitlines()[-1:] or ["no word"]
            raise PeerError(f"its process ended with: {last[0]}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def slice(self, calls: int) -> Slice:
        """Return slices of this many calls."""

        def run() -> float:
            assert self._process.stdin is not None
            self._process.stdin.write(f"{calls}\n")
            self._process.stdin.flush()
            return float(self._answer()["rate"])

        return run

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._stderr):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()


PEERS = {
    "EnvPool Pendulum-v1, 1,024, 1 thread": ("envpool", 1),
    "EnvPool Pendulum-v1, 1,024, 2 threads": ("envpool", 2),
    "gymnax Pendulum-v1, 1,024, call by call": ("gymnax", 0),
    "gymnax Pendulum-v1, 1,024, all calls compiled into one": ("gymnax scan", 0),
}


def peers(bench: Bench) -> None:
    """A batch of 1,024 against EnvPool and gymnax."""
    n = 1024
    python = bench.peers or Path(sys.executable)
    steps = bench.length(2 * EPISODE, EPISODE)
    contenders = []
    with contextlib.ExitStack() as stack:
        for label, (program, threads) in PEERS.items():
            bench.progress(f"peers: starting {label}", passing=True)
            try:
                peer = Peer(python, program, n, threads)
            except PeerError as error:
                bench.skip(f"peers: {label}", str(error))
                continue
            stack.callback(peer.close)
            contenders.append(Contender(label, peer.slice(steps), panel=panel(n)))
        if not contenders:
            return
        reference = contenders[0].label
        for threads in (1, 2):
            run = batch_slice(gym.make_vec(FORCE, num_envs=n, threads=threads), steps)
            contenders.append(Contender(our_label(FORCE, n, threads), run, True))
        bench.measure("peers", "A batch of 1,024 against EnvPool and gymnax, steps per second", contenders, reference)


# Stable-Baselines3 ----------------------------------------------------------------------------------------------------


def sb3(bench: Bench) -> None:
    """The VecEnvs of Stable-Baselines3."""
    if importlib.util.find_spec("stable_baselines3") is None:
        bench.skip("sb3", "Stable-Baselines3 is not installed")
        return
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

    from sd_friction_env.environments.sb3 import SDFrictionVecEnv

    def run_of(env: VecEnv, calls: int) -> Slice:
        space = env.action_space
        space.seed(0)
        actions = [np.stack([space.sample() for _ in range(env.num_envs)]) for _ in range(16)]
        env.seed(0)
        env.reset()

        def run() -> float:
            begin = time.perf_counter()
            for i in range(calls):
                env.step(actions[i % 16])
            return calls * env.num_envs / (time.perf_counter() - begin)

        return run

    calls = bench.length(1000, 500)
    title = "stepped through Stable-Baselines3's VecEnv"
    contenders = [
        Contender("DummyVecEnv of 16 Pendulum-v1", run_of(DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 16), calls)),
        Contender(f"DummyVecEnv of 16 {FORCE}", run_of(DummyVecEnv([lambda: gym.make(FORCE)] * 16), calls), True),
        Contender("SDFrictionVecEnv of 16", run_of(SDFrictionVecEnv(FORCE, 16), calls), True),
        Contender("SDFrictionVecEnv of 256", run_of(SDFrictionVecEnv(FORCE, 256), calls), True),
    ]
    contenders = [each._replace(panel=title) for each in contenders]
    bench.measure("sb3", "Stable-Baselines3's VecEnv, steps per second", contenders, contenders[0].label)


def ppo(bench: Bench) -> None:
    """What PPO loses to our environments: training on them and on an environment that costs nothing."""
    if importlib.util.find_spec("stable_baselines3") is None:
        bench.skip("ppo", "Stable-Baselines3 is not installed")
        return
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

    from sd_friction_env.environments.sb3 import SDFrictionVecEnv

    class Nothing(VecEnv):
        """Hands out the same arrays at every step."""

        def __init__(self, like: VecEnv) -> None:
            super().__init__(like.num_envs, like.observation_space, like.action_space)
            assert like.observation_space.shape is not None
            self._observations = np.zeros((like.num_envs, *like.observation_space.shape), np.float32)
            self._rewards = np.zeros(like.num_envs, np.float32)
            self._dones = np.zeros(like.num_envs, np.bool_)
            self._infos: list[dict[str, Any]] = [{} for _ in range(like.num_envs)]

        def reset(self) -> Any:
            return self._observations

        def step_async(self, actions: Any) -> None:
            pass

        def step_wait(self) -> Any:
            return self._observations, self._rewards, self._dones, self._infos

        def close(self) -> None:
            pass

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [None] * self.num_envs  # asked for render_mode

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            raise NotImplementedError

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [True] * self.num_envs

    n_steps = 64
    steps = bench.length(3, 1) * 256 * n_steps if bench.steps is None else bench.steps

    def run_of(env: VecEnv) -> Slice:
        model = PPO("MlpPolicy", env, n_steps=n_steps, batch_size=2048, seed=0, device="cpu")

        def run() -> float:
            before = model.num_timesteps
            begin = time.perf_counter()
            model.learn(steps, reset_num_timesteps=False)
            return (model.num_timesteps - before) / (time.perf_counter() - begin)

        return run

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # with more, on a busy machine, PyTorch's threads wait for each other
    try:
        ours = SDFrictionVecEnv(FORCE, 256, stagger=True)
        title = "PPO in training, 256 environments"
        contenders = [
            Contender("PPO, 256 environments that cost nothing", run_of(Nothing(ours)), panel=title),
            Contender(f"PPO, SDFrictionVecEnv of 256 {FORCE}", run_of(ours), True, title),
        ]
        bench.measure("ppo", "PPO with 10 epochs, one thread, steps per second", contenders, contenders[0].label)
    finally:
        torch.set_num_threads(threads)


# SciPy, and other programs --------------------------------------------------------------------------------------------


class WithSciPy:
    """The same oscillator stepped by scipy.integrate.solve_ivp and its events, as one would write it by hand.

    Plain Python throughout: solve_ivp calls its right-hand side with arrays of two numbers, where a compiled function
    costs more to call than this arithmetic.
    """

    def __init__(self, parameters: OscillatorParameters, x: float, v: float) -> None:
        from scipy.integrate import solve_ivp

        p = parameters
        plant = p.plant
        self._solve = solve_ivp
        self._belt = p.belt_speed
        self._limit, self._square = p.mu_s, p.alpha * p.alpha
        self._p, self._k1, self._k3 = p, plant.friction.k1, plant.friction.k3
        self.x, self.v = x, v

    def _spring(self, x: float) -> tuple[float, float]:
        stretch = 1.0 - 1.0 / math.sqrt(x * x + self._square)
        return x * stretch, self._p.g1 - self._p.alpha * stretch

    def _load(self, x: float, u: float) -> tuple[float, float]:
        """Return the force that friction has to bear in stick, and the most that it can."""
        restoring, normal = self._spring(x)
        return 2.0 * self._p.beta * self._belt + restoring - u, self._limit * normal

    def step(self, u: float, duration: float) -> None:
        """Go on for a while under a constant force."""
        t, just_slipped = 0.0, False
        while t < duration:
            load, most = self._load(self.x, u)
            stuck = self.v == self._belt and abs(load) <= most and not just_slipped
            mode = 0.0 if stuck else math.copysign(1.0, self.v - self._belt if self.v != self._belt else -load)

            def flow(_: float, y: Any, mode: float = mode) -> tuple[float, float]:
                x, v = y.tolist()
                if mode == 0.0:
                    return v, 0.0
                restoring, normal = self._spring(x)
                v_rel = v - self._belt
                mu = mode * self._limit - self._k1 * v_rel + self._k3 * v_rel * v_rel * v_rel
                return v, -mu * normal - 2.0 * self._p.beta * v - restoring + u

            def surface(_: float, y: Any, mode: float = mode) -> float:
                x, v = y.tolist()
                if mode == 0.0:
                    load, most = self._load(x, u)
                    return abs(load) - most
                return -mode * float(v - self._belt)

            surface.terminal = True  # type: ignore[attr-defined]
            surface.direction = 1.0  # type: ignore[attr-defined]
            start = np.array([self.x, self.v])
            run = self._solve(flow, (t, duration), start, events=surface, rtol=1e-9, atol=1e-10)
            t = float(run.t[-1])
            self.x, self.v = run.y[:, -1].tolist()
            if run.status == 1:
                self.v = self._belt
                # The event lies on the surface only to rounding: what has just broken away must not stick again.
                just_slipped = mode == 0.0
            else:
                just_slipped = False


def with_scipy(bench: Bench) -> None:
    """The same control interval by scipy.integrate.solve_ivp, called once per step."""
    calls = bench.length(500, 150)
    env = gym.make(FORCE)
    env.action_space.seed(0)
    actions = [float(env.action_space.sample()[0]) for _ in range(1000)]
    inner: Any = env.unwrapped
    info = env.reset(seed=0)[1]
    stepper = WithSciPy(inner.nominal, info["x"], info["v"])
    limit, interval = inner.task.force_limit, inner.task.control_interval
    worst = 0.0
    for k in range(min(calls, 200)):
        info = env.step(np.array([actions[k]]))[4]
        stepper.step(limit * actions[k], interval)
        worst = max(worst, abs(stepper.x - info["x"]))
    place = itertools.count()

    def run() -> float:
        begin = time.perf_counter()
        for _ in range(calls):
            stepper.step(limit * actions[next(place) % 1000], interval)
        return calls / (time.perf_counter() - begin)

    contenders = [
        Contender("scipy.integrate.solve_ivp with events", run, panel="one environment, gym.make"),
        Contender(f"{FORCE}, gym.make", single_slice(FORCE, bench.length(10_000, 3000)), True),
    ]
    bench.measure("scipy", "The same step by SciPy, steps per second", contenders, contenders[0].label)
    bench.check(f"largest gap of x between the two over {min(calls, 200)} steps", worst, SCIPY_BOUND)


def one_cycle(bench: Bench) -> None:
    """One stick-slip cycle by our orbit solver and by programs that no one here wrote, who do the same work."""
    if importlib.util.find_spec("pytest") is None:
        bench.skip("cycle", "pytest is not installed")
        return
    from tests.scripts import test_peers

    ours = limit_cycle(OscillatorParameters())

    def timed(solve: Callable[[], Any]) -> Slice:
        def run() -> float:
            begin = time.perf_counter()
            solve()
            return 1e3 * (time.perf_counter() - begin)

        return run

    unit = "ms"
    label = "ours (settle and close)"
    contenders = [Contender(label, timed(lambda: limit_cycle(OscillatorParameters())), True, unit=unit)]
    gaps = {}
    for parameter in test_peers.PROGRAMS:
        program: Any = parameter.values[0]
        name = str(parameter.id)
        try:
            slip_leg, stick_leg = test_peers.slip_then_stick(program, ours)
        except BaseException as missing:  # pytest's skip is no Exception
            if type(missing).__name__ != "Skipped":
                raise
            bench.skip(f"cycle: {name}", str(missing))
            continue
        gaps[name] = abs((slip_leg.t + stick_leg.t) / ours.period - 1.0)

        def solve(program: Any = program) -> Any:
            return test_peers.slip_then_stick(program, ours)

        contenders.append(Contender(name, timed(solve), unit=unit))
    title = "One stick-slip cycle (exact, alpha .8, v_b .2), events included, milliseconds"
    bench.measure("cycle", title, contenders, label)
    for name, gap in gaps.items():
        bench.note("cycle", f"{name}: gap of the period to ours", gap, f"{gap:.1e}")


# Start-up and memory --------------------------------------------------------------------------------------------------

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


# The kernel against this core's arithmetic ----------------------------------------------------------------------------


class Operations:
    """Counts arithmetic operations as they are done: all of them, and those that are not repetitions of another.

    A compiler computes alpha * alpha once, however often it is written: the distinct ones are the least work.
    """

    def __init__(self) -> None:
        self.written: Counter[str] = Counter()
        self.distinct: Counter[str] = Counter()
        self._values: dict[tuple[Any, ...], int] = {}

    def known(self, *key: Any) -> tuple["Counted", bool]:
        """Return the number that a key stands for, and whether it is a new one."""
        new = key not in self._values
        return Counted(self, self._values.setdefault(key, len(self._values))), new

    def done(self, kind: str, name: str, *numbers: Any) -> "Counted":
        """Take note of an operation of a kind and return its result."""
        places = [self.place(number) for number in numbers]
        if name in "+*":
            places.sort()
        result, new = self.known(name, *places)
        self.written[kind] += 1
        self.distinct[kind] += new
        return result

    def place(self, number: Any) -> int:
        """Return what identifies a number."""
        return number.place if isinstance(number, Counted) else self.known("constant", number)[0].place


class Counted:
    """A number that has no value but knows how it came about."""

    def __init__(self, operations: Operations, place: int) -> None:
        self.operations = operations
        self.place = place

    def __add__(self, other: Any) -> "Counted":
        return self.operations.done("add", "+", self, other)

    def __radd__(self, other: Any) -> "Counted":
        return self.operations.done("add", "+", other, self)

    def __sub__(self, other: Any) -> "Counted":
        return self.operations.done("add", "-", self, other)

    def __rsub__(self, other: Any) -> "Counted":
        return self.operations.done("add", "-", other, self)

    def __mul__(self, other: Any) -> "Counted":
        return self.operations.done("multiply", "*", self, other)

    def __rmul__(self, other: Any) -> "Counted":
        return self.operations.done("multiply", "*", other, self)

    def __truediv__(self, other: Any) -> "Counted":
        return self.operations.done("divide", "/", self, other)

    def __rtruediv__(self, other: Any) -> "Counted":
        return self.operations.done("divide", "/", other, self)

    def __neg__(self) -> "Counted":
        return self.operations.known("negative", self.place)[0]  # a change of sign costs next to nothing

    def __abs__(self) -> "Counted":
        return self.operations.known("absolute", self.place)[0]

    def __lt__(self, other: Any) -> bool:
        return True  # as of the numbers that a step accepts; a comparison is no arithmetic

    __le__ = __lt__

    def sqrt(self) -> "Counted":
        """Return the square root."""
        return self.operations.done("square root", "sqrt", self)


def count_operations(function: Callable[..., Any], names: Sequence[str]) -> Operations:
    """Call a function of plain arithmetic with numbers of these names, and return what it did with them."""
    operations = Operations()
    function(*(operations.known("argument", name)[0] for name in names))
    return operations


def slip_step_operations() -> Operations:
    """Count the operations of one slip step. Only where numba compiles nothing (NUMBA_DISABLE_JIT=1)."""
    for name in ("runge_kutta", "springs.inclined"):
        file: Any = importlib.import_module(f"sd_friction_env.kernel.{name}")
        file.math = types.SimpleNamespace(sqrt=Counted.sqrt, inf=math.inf)

    def step(alpha: Any, mu_s: Any, k1: Any, k3: Any, g1: Any, beta: Any, mode: Any, *motion: Any) -> Any:
        laws = kernel.Inclined(alpha), kernel.Stribeck(mu_s, k1, k3), kernel.Unexcited()
        x, v, v_belt, a_belt, u, h = motion
        return kernel.slip_step(
            kernel.Plant(*laws, g1, beta), mode, kernel.State(x, v), kernel.Drive(v_belt, a_belt, u), h
        )

    return count_operations(
        step, ["alpha", "mu_s", "k1", "k3", "g1", "beta", "mode", "x", "v", "v_belt", "a_belt", "u", "h"]
    )


def kernel_operations() -> dict[str, dict[str, int]]:
    """Return the operations of one slip step, "written" and "distinct", by kind."""
    code = (
        "import json; from scripts.benchmark import slip_step_operations; o = slip_step_operations(); "
        "print(json.dumps({'written': o.written, 'distinct': o.distinct}))"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True
    )
    counts: dict[str, dict[str, int]] = json.loads(run.stdout)
    return counts


def arithmetic() -> dict[str, tuple[Callable[[Any, int], None], int, int]]:
    """Return loops that do nothing but arithmetic, all in the first-level cache: each a function of (memory, repeats),
    the operations per element that it does, and the rows of memory that it works on.

    Each row is a chain of its own, so a core finds as much side by side as it can do. Not in the kernel, not cached:
    this is no law of ours.
    """
    import numba

    compiled = numba.njit(error_model="numpy")

    @compiled
    def four_chains(memory: Any, repeats: int) -> None:
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
    def one_chain(memory: Any, repeats: int) -> None:
        p = memory[0]
        for _ in range(repeats):
            for i in range(len(p)):
                a = p[i]
                for _ in range(8):
                    a = a * 0.9 + 0.1
                p[i] = a

    @compiled
    def sums(memory: Any, repeats: int) -> None:
        # As a Runge-Kutta stage has them: products side by side, one sum over them.
        p, q, r, s = memory[0], memory[1], memory[2], memory[3]
        for _ in range(repeats):
            for i in range(len(p)):
                a, b, c = q[i], r[i], s[i]
                d = a * 0.1 + b * 0.2 + c * 0.3 + 0.4
                e = b * 0.1 + c * 0.2 + d * 0.3 + 0.4
                f = c * 0.1 + d * 0.2 + e * 0.3 + 0.4
                g = a * 0.3 + b * 0.1 + c * 0.2 + 0.4
                p[i] = f * 0.5 + g * 0.5

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

    return {
        "add and multiply, four chains": (four_chains, 48, 4),
        "add and multiply, one chain": (one_chain, 16, 1),
        "add and multiply, sums": (sums, 27, 4),
        "square root": (square_roots, 1, 1),
        "divide": (quotients, 1, 1),
    }


def arithmetic_slice(run: Callable[[Any, int], None], per_element: int, rows: int, seconds: float) -> Slice:
    """Return slices of an arithmetic loop, in 1e9 operations per second."""
    data = np.full((rows, kernel.LANES), 0.9)
    run(data, 1)
    begin = time.perf_counter()
    run(data, 1000)
    repeats = max(1, int(1000 * seconds / (time.perf_counter() - begin)))

    def timed() -> float:
        begin = time.perf_counter()
        run(data, repeats)
        return 1e-9 * repeats * kernel.LANES * per_element / (time.perf_counter() - begin)

    return timed


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
    """The compiled step of a batch on one core beside what the core's arithmetic allows."""
    n = 8192
    print("\nOne slip step's operations (exact geometry)")
    counts = kernel_operations()
    for counted, kinds in counts.items():
        total = sum(kinds.values())
        text = ", ".join(f"{value} {kind}" for kind, value in kinds.items())
        bench.note("kernel", f"operations, {counted}", total, f"{total}: {text}")
        for kind, value in kinds.items():
            bench.numbers["kernel"][f"operations, {counted}, {kind}"] = value
    seconds = 0.02 if bench.quick else 0.1
    contenders = [
        Contender(name, arithmetic_slice(*loop, seconds), unit="1e9/s") for name, loop in arithmetic().items()
    ]
    calls = bench.length(200, 60)  # some 0.1 s
    for label, way in WAYS.items():
        contenders.append(Contender(label, compiled_slice(way, n, calls), True, unit="ns per step"))
    rows = bench.measure("kernel", f"The compiled step alone, batch of {n:,}, one core", contenders)
    # Of the loops that add and multiply the fastest is nearest to what the core can do.
    sums = max((row for name, row in rows.items() if name.startswith("add and")), key=lambda row: row.median)
    limits = [
        limit_of(counts["distinct"], {"add and multiply": a, "square root": s, "divide": d})
        for a, s, d in zip(sums.values, rows["square root"].values, rows["divide"].values, strict=True)
    ]
    limit = statistics.median(limits)
    bench.note("kernel", "limit, kind after kind", limit, f"{limit:.2f} ns per step")
    mixed = counts["distinct"]["add"] + counts["distinct"]["multiply"]
    at_once = mixed / sums.median
    bench.note("kernel", "of this to add and multiply", at_once, f"{at_once:.2f} ns per step")
    for label in WAYS:
        share = statistics.median(a / b for a, b in zip(limits, rows[label].values, strict=True))
        bench.note("kernel", f"share of the limit, {label}", share, f"{share:.1%}")
        rate = mixed / rows[label].median
        bench.note("kernel", f"add and multiply done, {label}", rate, f"{rate:.1f} 1e9/s")


# Targets --------------------------------------------------------------------------------------------------------------


class Target(NamedTuple):
    """What is wanted of a number. met: None where it was not measured."""

    what: str
    reached: float | None
    bound: float
    at_least: bool = True

    @property
    def met(self) -> bool | None:
        """Whether it is reached; None: unknown."""
        if self.reached is None or math.isnan(self.reached):
            return None
        return self.reached >= self.bound if self.at_least else self.reached < self.bound


def best_ratio(rows: Mapping[str, Row], ours: Sequence[str], others: Sequence[str]) -> float | None:
    """Return the best of our contenders' ratios, each to the fastest of the others; None if one side is missing."""
    here = [rows[label] for label in ours if label in rows]
    there = [rows[label] for label in others if label in rows]
    if not here or not there:
        return None
    return max(min(ratio_of(row, other) for other in there) for row in here)


def targets(rows: Rows, numbers: Numbers) -> list[Target]:
    """Return the targets and what was reached of them."""

    def ratio(section: str, ours: Sequence[str], others: Sequence[str]) -> float | None:
        return best_ratio(rows.get(section, {}), ours, others)

    result = [Target("one environment, CartPole-v1's speed times", ratio("single", [FORCE], ["CartPole-v1"]), 2.0)]
    for n, bound in ((1024, 1.5), (8192, 2.0)):
        ours = [our_label(FORCE, n, threads) for threads in (1, 2)]
        what = f"batch of {n:,} (1 or 2 threads), CartPole-v1's speed times"
        result.append(Target(what, ratio("batch", ours, [f"CartPole-v1, {n:,}"]), bound))
    ours = [our_label(FORCE, 1024, threads) for threads in (1, 2)]
    for name, program, bound in (("EnvPool's Pendulum", "envpool", 20.0), ("gymnax's Pendulum", "gymnax", 5.0)):
        others = [label for label, (which, _) in PEERS.items() if which == program]
        result.append(Target(f"batch of 1,024, {name}'s speed times", ratio("peers", ours, others), bound))
    share = numbers.get("kernel", {}).get("share of the limit, slip only")
    result.append(Target("kernel on one core, slip only, share of the arithmetic limit", share, 0.5))
    trained = ratio("ppo", [f"PPO, SDFrictionVecEnv of 256 {FORCE}"], ["PPO, 256 environments that cost nothing"])
    result.append(Target("PPO, speed with environments that cost nothing times", trained, 0.93))
    held = numbers.get("memory", {}).get("bytes per environment")
    result.append(
        Target("memory per environment of a batch, KiB", None if held is None else held / KIBIBYTE, 1.0, at_least=False)
    )
    return result


def print_targets(every: Sequence[Target]) -> None:
    """Print the table of targets."""
    print(f"\nTargets (median of the rounds' ratios)\n  {'':62}{'reached':>14}{'wanted':>16}")
    words = {True: "met", False: "NOT MET", None: "not measured"}
    for target in every:
        reached = "" if target.reached is None else f"{target.reached:.3g}"
        wanted = f"{'at least' if target.at_least else 'below'} {target.bound:g}"
        print(f"  {target.what:62}{reached:>14}{wanted:>16}   {words[target.met]}")
    sys.stdout.flush()


# The program ----------------------------------------------------------------------------------------------------------

SECTIONS: dict[str, Callable[[Bench], None]] = {
    "work": work,
    "single": single,
    "batch": batch,
    "slip": slip,
    "kernel": compiled_step,
    "peers": peers,
    "sb3": sb3,
    "ppo": ppo,
    "scipy": with_scipy,
    "cycle": one_cycle,
    "startup": startup,
    "memory": memory,
}


def machine() -> dict[str, Any]:
    """Return what the numbers were measured on."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    result: dict[str, Any] = {
        "cpu": name,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for package in ("numpy", "numba", "gymnasium", "scipy", "stable-baselines3", "torch"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            result[package] = importlib.metadata.version(package)
    result["sd_friction_env"] = sd_friction_env.__version__
    if hasattr(os, "getloadavg"):
        result["load"] = os.getloadavg()[0]
    return result


def print_machine(said: Mapping[str, Any]) -> None:
    """Print what the numbers were measured on, and a warning if it has other work."""
    print(", ".join(f"{name} {value:.2f}" if name == "load" else f"{name} {value}" for name, value in said.items()))
    if said.get("load", 0.0) > BUSY:
        print(f"WARNING: the machine is busy (load {said['load']:.2f}): ratios can be trusted, rates less")
    sys.stdout.flush()


def as_json(bench: Bench, said: Mapping[str, Any], *, interrupted: bool) -> dict[str, Any]:
    """Return all that was measured, ready for JSON."""
    rows = {
        section: {
            label: {
                "unit": row.unit,
                "ours": row.ours,
                "median": row.median,
                "quartiles": list(row.quartiles),
                "values": row.values,
            }
            for label, row in measured.items()
            if row.values
        }
        for section, measured in bench.rows.items()
    }
    return {
        "machine": dict(said),
        "settings": {"quick": bench.quick, "rounds": bench.rounds, "steps": bench.steps, "interrupted": interrupted},
        "rows": rows,
        "numbers": bench.numbers,
        "checks": [{**check._asdict(), "met": check.met} for check in bench.checks],
        "targets": [{**target._asdict(), "met": target.met} for target in targets(bench.rows, bench.numbers)],
        "skipped": bench.skipped,
    }


@plotting.house_style()
def draw(rows: Rows, path: Path) -> None:
    """Draw the rates as bars, one panel for what can be compared, ours in another colour."""
    from matplotlib.figure import Figure

    panels: dict[str, list[tuple[str, Row]]] = {}
    for measured in rows.values():
        for label, row in measured.items():
            if row.panel and row.values:
                panels.setdefault(row.panel, []).append((label, row))
    sizes = [len(every) for every in panels.values()]
    figure = Figure(figsize=(10.0, 1.0 + 0.24 * sum(sizes) + 0.45 * len(sizes)), layout="constrained")
    axes = figure.subplots(len(sizes), 1, sharex=True, squeeze=False, height_ratios=[size + 0.6 for size in sizes])
    for ax, (title, every) in zip(axes[:, 0], panels.items(), strict=True):
        every.sort(key=lambda entry: entry[1].median)
        places = np.arange(len(every))
        medians = np.array([row.median for _, row in every])
        low, high = np.array([row.quartiles for _, row in every]).T
        colours = ["#c1440e" if row.ours else "#9aa5b1" for _, row in every]
        ax.barh(places, medians, color=colours, xerr=[medians - low, high - medians], error_kw={"lw": 1.0})
        size = title.removeprefix(panel(0)[:-1])  # stands in the panel's title already
        ax.set_yticks(places, [label.replace(f", {size}", "", 1) for label, _ in every], fontsize=8)
        ax.set_ylim(-0.6, len(every) - 0.4)
        for place, (value, end) in enumerate(zip(medians, high, strict=True)):
            ax.text(1.06 * end, place, _rate(value), va="center", fontsize=7)
        ax.set_xscale("log")
        ax.set_title(title, loc="left", fontsize=9, fontweight="bold")
        ax.spines[["top", "right"]].set_visible(False)
    last = axes[-1, 0]
    low, high = last.get_xlim()
    last.set_xlim(min(3e3, low), 4.0 * high)
    last.set_xlabel("environment steps per second (median; lines: quartiles); ours in red")
    plotting.save_figure(figure, path)


def _rate(value: float) -> str:
    for size, unit in ((1e6, " million"), (1e3, " thousand")):
        if value >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def _default_peers() -> Path | None:
    folder = ROOT / ".venv-peers"
    return next((path for path in (folder / "bin/python", folder / "Scripts/python.exe") if path.is_file()), None)


def _parsed(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter slices, no cold start")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=f"some sections: {', '.join(SECTIONS)}"
    )
    parser.add_argument("--rounds", type=int, metavar="N", help="how many slices of each (default 15; --quick 3)")
    parser.add_argument("--steps", type=int, metavar="N", help="steps (of a batch: calls) in a slice, for a trial")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the numbers as JSON")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the rates: .png, .pdf or .svg")
    parser.add_argument(
        "--peers", metavar="PYTHON", help="interpreter that has EnvPool and gymnax (default: .venv-peers, or this one)"
    )
    options = parser.parse_args(arguments)
    for name in ("rounds", "steps"):
        value = getattr(options, name)
        if value is not None and value < 1:
            parser.error(f"--{name} must be a whole number of at least 1, got {value}")
    for name in ("out", "plot"):
        path = getattr(options, name)
        if path is not None and not path.parent.is_dir():
            parser.error(f"--{name} {str(path)!r} lies in no existing folder")
        if path is not None and path.is_dir():
            parser.error(f"--{name} {str(path)!r} is a folder; a file is wanted")
    try:
        for name, endings in (("out", (".json",)), ("plot", plotting.FORMATS)):
            if getattr(options, name) is not None:
                checked_ending(getattr(options, name), endings, f"--{name}")
    except ValueError as error:
        parser.error(str(error))
    if options.peers is None:
        options.peers = _default_peers()
    else:
        options.peers = Path(options.peers).absolute()  # not resolved: a virtual environment's Python is a link
        try:
            command = [str(options.peers), "-c", "import sys; print(sys.version_info[0])"]
            answer = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
        except (OSError, subprocess.SubprocessError):
            answer = ""
        if answer.strip() != "3":
            parser.error(f"--peers must be a Python 3 interpreter, such as .venv-peers/bin/python, got {options.peers}")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; return the exit status: 1 if a check failed, 130 if it was interrupted."""
    options = _parsed(arguments)
    bench = Bench(quick=options.quick, rounds=options.rounds, steps=options.steps, peers=options.peers)
    said = machine()
    print_machine(said)
    interrupted = False
    try:
        for name, section in SECTIONS.items():
            if options.only is None or name in options.only:
                bench.progress(f"{name}: {(section.__doc__ or '').splitlines()[0]}")
                section(bench)
    except KeyboardInterrupt:
        interrupted = True
        print("\nInterrupted: what follows is what was measured so far")
    print_targets(targets(bench.rows, bench.numbers))
    if options.out is not None:
        with atomic_file(options.out) as file:
            json.dump(as_json(bench, said, interrupted=interrupted), file, indent=1)
    if options.plot is not None:
        if importlib.util.find_spec("matplotlib") is None:
            print("--plot: skipped, matplotlib is not installed")
        elif not any(row.panel for measured in bench.rows.values() for row in measured.values()):
            print("--plot: skipped, nothing was measured that it shows")
        else:
            draw(bench.rows, options.plot)
    failed = [check.what for check in bench.checks if not check.met]
    if failed:
        print(f"FAILED: {'; '.join(failed)}", file=sys.stderr)
        return 1
    return 130 if interrupted else 0


if __name__ == "__main__":
    raise SystemExit(main())
