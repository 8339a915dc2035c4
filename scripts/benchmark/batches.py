"""Single environments and batches against Gymnasium's own, and the work that a step stands for."""

import itertools
import math
import statistics
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import sd_friction_env
from scripts.benchmark.measuring import Bench, Contender, Slice, rate_of
from sd_friction_env import OscillatorParameters, limit_cycle

FORCE, BELT = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0"
SIZES = (1, 16, 256, 1024, 8192)
EPISODE = 501  # calls from one reset of a batch to the next: 500 steps and the call that resets
AMPLITUDE_BOUND = 1e-7


class Way(NamedTuple):
    """A way to run a batch: arguments of the environment, and whether all actions are 0."""

    arguments: dict[str, Any]
    still: bool = False


WAYS = {
    "as it is": Way({}),
    # The belt is so fast that the squeal is a cycle without stick, which persists without control ...
    "slip only": Way({"parameters": {"belt_speed": 0.42}}, still=True),
    # ... and here so fast that there is no cycle: the mass slips in one place, shaken by the actions.
    "slip only, random force": Way({"parameters": {"belt_speed": 1.2}}),
}


def single_slice(env_id: str, steps: int) -> Slice:
    """Return slices of one environment made by gym.make, random actions, resets included."""
    env = gym.make(env_id)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1000)]
    env.reset(seed=0)

    def work() -> None:
        for i in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[i % 1000])
            if terminated or truncated:
                env.reset()

    return lambda: rate_of(work, steps)


def actions_for(env: Any, *, still: bool = False) -> list[Any]:
    """Return 16 random actions of a batch, or zeros."""
    env.action_space.seed(0)
    return [env.action_space.sample() * (0 if still else 1) for _ in range(16)]


def batch_slice(env: Any, steps: int, *, staggered: bool = False, still: bool = False) -> Slice:
    """Return slices of ``steps`` calls of a batch, resets included; a call counts as one step of each environment."""
    actions = actions_for(env, still=still)
    env.reset(seed=0)
    if staggered:
        env.unwrapped.stagger()

    def work() -> None:
        for i in range(steps):
            env.step(actions[i % 16])

    return lambda: rate_of(work, steps * env.num_envs)


def single(bench: Bench) -> None:
    """One environment through gym.make against Gymnasium's own."""
    steps = bench.length(30_000, 10_000)
    contenders = [
        Contender(env_id, single_slice(env_id, steps), "SDFriction" in env_id, "one environment, gym.make")
        for env_id in ["CartPole-v1", "Pendulum-v1", *sd_friction_env.ENVIRONMENT_IDS]
    ]
    bench.measure("single", "One environment through gym.make, steps per second", contenders, "CartPole-v1")


def panel(n: int) -> str:
    """Return the name of the plot's panel for batches of this size."""
    return f"a batch of {n:,}"


def our_label(env_id: str, n: int, threads: int, *, staggered: bool = False) -> str:
    """Return the name of a batch of ours in the tables."""
    return f"{env_id}, {n:,}, {threads} thread{'s' * (threads > 1)}{', staggered' * staggered}"


def calls_for(bench: Bench, n: int) -> int:
    """Return the number of calls in a slice of a batch."""
    return bench.length({1024: 4, 8192: 1}.get(n, 6) * EPISODE, EPISODE)


def batch(bench: Bench) -> None:
    """Batches through gym.make_vec against Gymnasium's own."""
    for n in SIZES:
        steps = calls_for(bench, n)
        cartpoles = gym.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
        contenders = [Contender(f"CartPole-v1, {n:,}", batch_slice(cartpoles, steps), panel=panel(n))]
        if n <= 16:
            pendulums = gym.make_vec("Pendulum-v1", num_envs=n, vectorization_mode="sync")
            contenders.append(Contender(f"Pendulum-v1 (sync), {n:,}", batch_slice(pendulums, steps), panel=panel(n)))
        variants = [*itertools.product((FORCE, BELT), (1, 2), (False,))]
        if n >= 1024:
            variants += [(FORCE, threads, True) for threads in (1, 2)]
        for env_id, threads, staggered in variants:
            run = batch_slice(gym.make_vec(env_id, num_envs=n, threads=threads), steps, staggered=staggered)
            # Batches this small use one thread in any case: no bars for the same thing twice.
            plotted = "" if threads > 1 and n < 1024 else panel(n)
            contenders.append(Contender(our_label(env_id, n, threads, staggered=staggered), run, True, plotted))
        bench.measure(
            "batch", f"A batch of {n:,} through gym.make_vec, steps per second", contenders, f"CartPole-v1, {n:,}"
        )


class Watched(NamedTuple):
    """Events, stick and turns in a batch under random actions: each the mean over all steps of all environments."""

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
    sums, steps = np.zeros(3), 0.0
    for k in range(calls):
        info = env.step(actions[k % 16])[4]
        if "events" in info:
            took = info["_events"]
            steps += float(np.count_nonzero(took))
            turned = np.count_nonzero((info["v"] * v)[took] < 0.0)
            sums += info["events"][took].sum(), info["stick_fraction"][took].sum(), turned
        v = info["v"]
    env.close()
    return Watched(*(sums / steps).tolist())


def slip(bench: Bench) -> None:
    """Batches that only slip, and what events cost the others."""
    met = {name: watched(FORCE, 1024, bench.length(EPISODE, EPISODE), way) for name, way in WAYS.items()}
    for n in (1024, 8192):
        contenders = []
        for name, way in WAYS.items():
            run = batch_slice(gym.make_vec(FORCE, num_envs=n, **way.arguments), calls_for(bench, n), still=way.still)
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


def amplitude_gap(env_id: str) -> float:
    """Return the gap between the batch's settled amplitude and the orbit solver's, the worst of 64 environments."""
    cycle = limit_cycle(OscillatorParameters())
    env = gym.make_vec(env_id, num_envs=64, episode_steps=10**6, info_keys=("x_min", "x_max"))
    inner: Any = env.unwrapped
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
    print("\nThe work in a step: control intervals per period of the motion")
    cartpole: Any = gym.make("CartPole-v1").unwrapped
    pendulum: Any = gym.make("Pendulum-v1").unwrapped
    # Small swings of CartPole's pole about hanging straight down, cart and all.
    reach = cartpole.length * (4.0 / 3.0 - cartpole.masspole / cartpole.total_mass)
    for name, period, interval in (
        (FORCE, limit_cycle(OscillatorParameters()).period, sd_friction_env.Task().control_interval),
        ("CartPole-v1", 2.0 * math.pi * math.sqrt(reach / cartpole.gravity), cartpole.tau),
        ("Pendulum-v1", 2.0 * math.pi * math.sqrt(2.0 * pendulum.l / (3.0 * pendulum.g)), pendulum.dt),
    ):
        text = f"{period / interval:.1f} of {interval:g}"
        bench.note("work", f"{name}: control intervals per period", period / interval, text)
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
