"""Print what the passive analysis promises: accuracy of curves, speed, attractors, the environment's agreement.

    python scripts/passive_numbers.py                  speed, windows, environment, slow transients (a minute or two)
    python scripts/passive_numbers.py --curves         and 960 points against SciPy (some ten minutes)
    python scripts/passive_numbers.py --basins         and a million starts, twice (half a minute)

Exit status 1 if a number misses its bound.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from scripts.figures import paper
from scripts.figures.common import PANELS
from scripts.reference_numbers import Report
from sd_friction_env import OscillatorParameters, SDFrictionEnv, attractors, critical_belt_speeds, limit_cycle, simulate
from sd_friction_env.physics.basins import basins
from sd_friction_env.physics.curves import amplitude_curve
from sd_friction_env.physics.orbits import rest_place

NOMINAL = OscillatorParameters()
ALPHAS = paper.ALPHAS


def timed(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the median time of some runs, in seconds."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def speed(report: Report) -> None:
    """Figs. 3 to 5 in all, and one curve against transients integrated with SciPy's solve_ivp."""
    report.head("Speed, on one core with a warm cache, seconds")

    def figures() -> None:
        for compute in (paper.compute_3, paper.compute_4, paper.compute_5):
            compute()

    points = sum(compute().n_rows for compute in (paper.compute_3, paper.compute_4, paper.compute_5))
    report.below(f"all {points} points of Figs. 3 to 5", timed(figures), 1.0)

    speeds = np.linspace(0.02, 0.6, 30)
    ours = timed(lambda: amplitude_curve(NOMINAL, speeds))
    begin = time.perf_counter()
    shown = speeds[:: len(speeds) // 3]
    for belt in shown.tolist():
        transient(NOMINAL.replace(belt_speed=belt), 400.0)
    theirs = (time.perf_counter() - begin) * len(speeds) / len(shown)
    print(f"{len(speeds)} belt speeds: {ours:.4f} s; SciPy, transients of 400: {theirs:.1f} s ({len(shown)} timed)")
    ratio = theirs / ours
    report.missed += ratio < 1000.0
    print(f"ratio {ratio:.0f}, wanted at least 1000{'' if ratio >= 1000.0 else '   MISSED'}")


def transient(p: OscillatorParameters, t_end: float) -> float:
    """Return the amplitude over the last eighth of a run: slip by solve_ivp with an event, stick by fine steps."""
    t, x, v, mode = 0.0, 0.0, p.belt_speed, 0
    belt = p.belt_speed
    low, high = math.inf, -math.inf
    while t < t_end:
        if mode == 0:
            while abs(2.0 * p.beta * belt + p.restoring_force(x)) <= p.mu_s * p.normal_force(x) and t < t_end:
                t, x = t + 2e-3, x + 2e-3 * belt
            mode = -1
            continue

        def slip(_: float, y: np.ndarray) -> list[float]:
            w = y[1] - belt
            friction = (-p.mu_s - p.k1 * w + p.k3 * w**3) * p.normal_force(y[0])
            return [y[1], -2.0 * p.beta * y[1] - p.restoring_force(y[0]) - friction]

        def sticks(s: float, y: np.ndarray) -> float:
            return float(y[1] - belt) if s > 1e-3 else -1.0

        sticks.terminal, sticks.direction = True, 1  # type: ignore[attr-defined]
        run = solve_ivp(slip, (0.0, t_end - t), [x, v], events=sticks, rtol=1e-9, atol=1e-11)
        late = run.y[0][t + run.t > 0.875 * t_end]
        if late.size:
            low, high = min(low, late.min()), max(high, late.max())
        t, x, v, mode = t + float(run.t[-1]), float(run.y[0, -1]), belt, 0
    return 0.5 * (high - low)


def slow_transients(report: Report) -> None:
    """The end of oscillation where transients last longest: (mu_s - mu_m)/v_m = .085."""
    report.head("(mu_s - mu_m)/v_m = .085, cubic: the end of oscillation, and what a run of 600 time units still shows")
    p = paper.plant("cubic", 0.085)
    v_b1 = critical_belt_speeds(p).v_b1
    report.row("v_b1", 0.1088, v_b1, 5.1e-5)
    for belt in (0.15, 0.2, 0.25):
        history = simulate(p.replace(belt_speed=belt), t_end=600.0, dt=0.05)
        print(f"    v_b = {belt}: moves by {history.amplitude(since=590.0):.4f} still; in the end: {kind_at(p, belt)}")


def kind_at(p: OscillatorParameters, belt: float) -> str:
    """Return the kind of motion at a belt speed."""
    return limit_cycle(p.replace(belt_speed=belt)).kind


def environment(report: Report) -> None:
    """The environment under zero action against the orbit solver."""
    report.head("Passive environment against orbit solver: worst gap in amplitude, away from v_b1")
    for geometry in PANELS:
        worst = 0.0
        for belt in np.linspace(0.02, 0.42, 21).tolist():
            cycle = limit_cycle(NOMINAL.replace(geometry=geometry, belt_speed=belt))
            env = SDFrictionEnv({"geometry": geometry, "belt_speed": belt}, episode_steps=10**6)
            env.reset(options={"phase": 0.25})
            infos = [env.step(np.zeros(1, np.float32))[4] for _ in range(300)]
            size = 0.5 * (max(i["x_max"] for i in infos) - min(i["x_min"] for i in infos))
            worst = max(worst, abs(size - cycle.amplitude))
        report.below(f"{geometry}: 21 belt speeds from .02 to .42", worst, 1e-6)


def windows() -> None:
    """Print where, in belt speed up to .6, the left well holds an attractor, and of which kind."""
    print("\nLeft-well attractors for belt speeds from .005 to .6 (ends found by bisection)")
    for geometry, alphas in (("exact", (0.2, 0.5, 0.6, 0.7, 0.75, 0.8)), ("cubic", (0.2, 0.3, 0.5, 0.7, 0.8))):
        for alpha in alphas:
            p = NOMINAL.replace(geometry=geometry, alpha=alpha)

            def left(belt: float, p: OscillatorParameters = p) -> str:
                kinds = [c.kind for c in attractors(p.replace(belt_speed=belt)) if c.x_max < 0.0]
                return " and ".join(kinds) or "none"

            before, at = left(0.005), 0.005
            parts = [before]
            for belt in np.arange(0.01, 0.601, 0.005).tolist():
                now = left(belt)
                while now != before:  # a step may hold more than one change
                    low, high = at, belt
                    while high - low > 1e-8:
                        middle = 0.5 * (low + high)
                        low, high = (middle, high) if left(middle) == before else (low, middle)
                    before, at = left(high), high
                    parts.append(f"{high:.6f} {before}")
                before, at = now, belt
            print(f"    {geometry} {alpha}: {' | '.join(parts)}", flush=True)


def curves(report: Report) -> None:
    """All four alphas, both geometries, 120 belt speeds against the SciPy oracle."""
    import tests.oracle as oracle

    report.head("120 belt speeds each, against SciPy DOP853 (rtol 1e-12): worst relative gaps")
    for geometry in PANELS:
        for alpha in ALPHAS:
            worst = dict.fromkeys(("amplitude", "period", "stick_fraction"), 0.0)
            notes: list[str] = []
            for belt in np.linspace(0.005, 0.6, 120).tolist():
                p = NOMINAL.replace(geometry=geometry, alpha=alpha, belt_speed=belt)
                ours = limit_cycle(p, rest_place(p), 0.0)
                if ours.kind == "steady-slip":
                    continue
                theirs = oracle.cycle(p, ours.x_phase0, ours.v_phase0)
                if theirs.kind != ours.kind:
                    notes.append(f"v_b {belt:.4f}: {ours.kind} here, {theirs.kind} there")
                    report.missed += 1
                    continue
                for name, gap in worst.items():
                    value = getattr(theirs, name)
                    worst[name] = max(gap, abs(getattr(ours, name) - value) / (value or 1.0))
            for name, gap in worst.items():
                report.below(f"{geometry} {alpha}: {name}", gap, 1e-7)
            for note in notes:
                print(f"    {note}")
    report.head("Critical belt speeds against the oracle's own search, relative")
    for geometry in PANELS:
        for alpha in ALPHAS:
            p = NOMINAL.replace(geometry=geometry, alpha=alpha)
            v_b0, v_b1 = critical_belt_speeds(p)
            report.below(f"{geometry} {alpha}: v_b0", abs(v_b0 / oracle.grazing(p) - 1.0), 1e-7)
            report.below(f"{geometry} {alpha}: v_b1", abs(v_b1 / oracle.hopf(p) - 1.0), 1e-7)


def million_starts(report: Report) -> None:
    """A million starts in two hard places."""
    report.head("1,000,000 starts, x in [-1.5, 1.5], v in [-1, 1], seconds")
    for alpha, belt in ((0.2, 0.2), (0.5, 0.43)):
        p = NOMINAL.replace(alpha=alpha, belt_speed=belt)
        rng = np.random.default_rng(0)
        x, v = rng.uniform(-1.5, 1.5, 1_000_000), rng.uniform(-1.0, 1.0, 1_000_000)
        basins(p, x[:10], v[:10])
        begin = time.perf_counter()
        found = basins(p, x, v)
        report.below(f"exact alpha {alpha}, v_b {belt}", time.perf_counter() - begin, 30.0)
        for label, cycle in enumerate(found.attractors):
            share, error = found.fraction(label)
            middle = 0.5 * (cycle.x_max + cycle.x_min)
            print(f"    {cycle.kind} round {middle:.4f}: {share:.4f} +- {error:.4f}")
        print(f"    lost contact {found.fraction(-1)[0]}, undecided {found.fraction(-2)[0]}")


def main(arguments: list[str] | None = None) -> int:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curves", action="store_true", help="compare whole curves with SciPy")
    parser.add_argument("--basins", action="store_true", help="classify a million starts")
    options = parser.parse_args(arguments)
    report = Report()
    speed(report)
    slow_transients(report)
    environment(report)
    windows()
    if options.basins:
        million_starts(report)
    if options.curves:
        curves(report)
    print(f"\n{report.missed} missed" if report.missed else "\nall within bounds")
    return int(report.missed > 0)


if __name__ == "__main__":
    sys.exit(main())
