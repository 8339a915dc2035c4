"""The same step by SciPy's solve_ivp, and the same cycle by other programs."""

import importlib.util
import itertools
import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.integrate import solve_ivp

from scripts.benchmark.batches import FORCE, single_slice
from scripts.benchmark.measuring import Bench, Contender, Slice, rate_of
from sd_friction_env import OscillatorParameters, limit_cycle

SCIPY_BOUND = 1e-6


class WithSciPy:
    """The same oscillator stepped by scipy.integrate.solve_ivp and its events, as one would write it by hand.

    Plain Python throughout: solve_ivp calls its right-hand side with arrays of two numbers, where a compiled function
    costs more to call than this arithmetic.
    """

    def __init__(self, parameters: OscillatorParameters, x: float, v: float) -> None:
        p = parameters
        plant = p.plant
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
            run = solve_ivp(flow, (t, duration), start, events=surface, rtol=1e-9, atol=1e-10)
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

    def work() -> None:
        for _ in range(calls):
            stepper.step(limit * actions[next(place) % 1000], interval)

    contenders = [
        Contender(
            "scipy.integrate.solve_ivp with events", lambda: rate_of(work, calls), panel="one environment, gym.make"
        ),
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
        return lambda: 1e3 / rate_of(solve, 1)

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
