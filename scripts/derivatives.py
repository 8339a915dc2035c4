"""Print how exact the derivatives through stick and slip are, and what they cost.

python scripts/derivatives.py                  everything (minutes)
python scripts/derivatives.py --only accuracy  one of: accuracy, multipliers, exponents, cost, gradient, recovery
python scripts/derivatives.py --motions 200    fewer motions
"""

import argparse
import itertools
import math
import statistics
import time
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import mathieu_a, mathieu_b

from sd_friction_env import (
    OrbitError,
    OscillatorParameters,
    SDFrictionVectorEnv,
    Task,
    critical_belt_speeds,
    kernel,
    limit_cycle,
    simulate,
    tabulated_friction,
)
from sd_friction_env.environments.jacobian import return_with_gradient, step_with_jacobian
from sd_friction_env.physics.forced import drive_period, forced_orbit, lyapunov_exponent
from sd_friction_env.physics.laws import Asymmetric, Coulomb, Exponential

Array = NDArray[np.float64]

FRICTIONS: dict[str, dict[str, Any]] = {
    "stribeck": {},
    "coulomb": {"friction": "coulomb"},
    "hyperbolic": {"friction": "hyperbolic", "mu_v": 0.05},
    "exponential": {"friction": "exponential", "mu_v": 0.05},
    "gaussian": {"friction": "gaussian", "mu_v": 0.05},
    "tabulated": {"friction": tabulated_friction([0.0, 0.3, 0.8, 2.0], [0.25, 0.1, 0.15, 0.3])},
    "asymmetric": {"friction": Asymmetric(Coulomb(0.3, 0.2), Exponential(0.25, 0.1, 0.5, 0.02))},
}
SPRINGS: dict[str, dict[str, Any]] = {
    "exact": {},
    "alpha = 0": {"alpha": 0.0},
    "cubic": {"geometry": "cubic"},
    "linear": {"geometry": "linear"},
    "duffing": {"geometry": "duffing"},
}
EXCITATIONS = {
    "none": (),
    "force": ("force",),
    "ripple": ("ripple",),
    "stiffness": ("stiffness",),
    "all": ("force", "ripple", "stiffness"),
}
STENCIL = (4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0)  # central differences of eighth order
STEPS = (4e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 3e-5)
SHOWN = (kernel.TANGENT_X, kernel.TANGENT_V, kernel.TANGENT_V2, kernel.TANGENT_STICK, kernel.TANGENT_FV)


class Motion(NamedTuple):
    """A motion to be differentiated: its plant, start, drive, duration and the time at its start."""

    parameters: OscillatorParameters
    x: float
    v: float
    a_belt: float
    u: float
    duration: float
    time: float


def random_motion(rng: np.random.Generator) -> Motion:
    """Return a motion of a random plant of any law."""
    excitation = EXCITATIONS[rng.choice(list(EXCITATIONS))]
    # Each law with one other of its pair: 11 pairs to compile for 35.
    friction, spring = FRICTIONS[rng.choice(list(FRICTIONS))], SPRINGS[rng.choice(list(SPRINGS))]
    friction, spring = (friction, SPRINGS["exact"]) if rng.random() < 0.6 else (FRICTIONS["stribeck"], spring)
    drives = {}
    for kind in excitation:
        drives[f"{kind}_amplitude"] = rng.uniform(0.05, 0.4)
        drives[f"{kind}_frequency"] = rng.uniform(0.5, 3.0)
        drives[f"{kind}_phase"] = rng.uniform(-3.0, 3.0)
    numbers: dict[str, Any] = {
        "alpha": rng.uniform(0.5, 1.5),
        "g1": rng.uniform(1.0, 2.0),
        "beta": rng.uniform(0.0, 0.1),
        "mu_s": rng.uniform(0.2, 0.4),
        "mu_m": rng.uniform(0.05, 0.2),
        "v_m": rng.uniform(0.3, 1.0),
        "mu_k": rng.uniform(0.05, 0.2),
        "v_0": rng.uniform(0.2, 1.0),
        "delta": rng.uniform(1.0, 4.0),
        "belt_speed": rng.uniform(0.05, 0.6),
        "linear_stiffness": rng.uniform(-0.5, 1.5),
        "kappa": rng.uniform(0.1, 1.0),
    }
    parameters = OscillatorParameters(**(numbers | drives | friction | spring))
    stuck = rng.random() < 0.3
    v = parameters.belt_speed if stuck else rng.uniform(-1.0, 1.0)
    duration = rng.choice((0.1, 1.0, 4.0)) * rng.uniform(0.5, 1.5)
    a_belt = rng.uniform(-0.1, 0.1) * (rng.random() < 0.5)
    return Motion(
        parameters, rng.uniform(-1.2, 1.2), v, a_belt, rng.uniform(-0.05, 0.05), duration, rng.uniform(0.0, 5.0)
    )


def form_of(motion: Motion) -> bool | None:
    """Return whether a motion's plant is taken in its excited form: all but some nominal ones, for fewer to compile."""
    return None if motion.parameters.kind == OscillatorParameters().kind else True


def plant_at(motion: Motion, parameters: OscillatorParameters) -> kernel.Plant:
    """Return the plant at the motion's start."""
    return (
        kernel.at_time(parameters.plant, motion.time)
        if form_of(motion) is None
        else parameters.excited_plant(motion.time)
    )


def names_of(motion: Motion) -> list[str]:
    """Return the parameters that a plant's derivative can be taken by."""
    names = []
    for name in motion.parameters.values:
        try:
            motion.parameters.plant_change(name, excited=form_of(motion))
        except ValueError:
            continue
        # At amplitude 0 an excitation has no other side.
        if getattr(motion.parameters, f"{name.rpartition('_')[0]}_amplitude", 1.0) > 0.0:
            names.append(name)
    return names


def jacobian_of(motion: Motion, names: list[str]) -> tuple[Any, Array]:
    """Return the end of a motion and its derivatives by x, v, belt speed, a_belt, u and ``names``, (SHOWN, 5 + m)."""
    parameters = motion.parameters
    tangents = np.zeros((kernel.TANGENT_ROWS, 5 + len(names)))
    tangents[range(5), range(5)] = 1.0
    directions = np.array([parameters.plant_change(name, excited=form_of(motion)) for name in names])
    drive = kernel.Drive(parameters.belt_speed, motion.a_belt, motion.u)
    plant = plant_at(motion, parameters)
    state = kernel.State(motion.x, motion.v)
    end = kernel.advance_with_tangents(plant, kernel.UNKNOWN, state, drive, motion.duration, tangents, directions)
    return end, tangents[SHOWN, :]


def end_of(motion: Motion, names: list[str], changes: Array) -> tuple[Array, list[int]]:
    """Return where a changed motion ends, (SHOWN,), and the kinds of its events."""
    parameters = motion.parameters
    values = parameters.values
    moved = {name: values[name] + change for name, change in zip(names, changes[5:], strict=True) if change}
    parameters = parameters.replace(**moved)
    drive = kernel.Drive(parameters.belt_speed + changes[2], motion.a_belt + changes[3], motion.u + changes[4])
    events = np.empty((kernel.MAX_EVENTS, 4))
    plant = plant_at(motion, parameters)
    state = kernel.State(motion.x + changes[0], motion.v + changes[1])
    end = kernel.advance(plant, state, drive, motion.duration, events)
    if end.status != kernel.OK:
        return np.full(len(SHOWN), math.nan), []
    found = np.array([end.x, end.v, end.int_v2, end.stick_time, end.int_fv])
    return found, [end.mode, *(int(kind) for kind in events[: end.n_events, 1])]


def differences(motion: Motion, names: list[str], column: int, stuck: bool) -> tuple[Array, float]:
    """Return a column of the Jacobian by differences, and how far those of two steps agree (nan: events differ)."""
    _, kinds = end_of(motion, names, np.zeros(5 + len(names)))
    best, spread, before = np.full(len(SHOWN), math.nan), math.inf, None
    for h in STEPS:
        total = np.zeros(len(SHOWN))
        for k, weight in enumerate(STENCIL, 1):
            for sign in (1.0, -1.0):
                changes = np.zeros(5 + len(names))
                changes[column] = sign * k * h
                if stuck and column == 2:
                    changes[1] = changes[2]  # the mass stays on the belt
                try:
                    end, met = end_of(motion, names, changes)
                except ValueError:  # out of the parameter's range
                    met = []
                total += sign * weight * end if met == kinds else math.nan
        found = total / h
        if before is not None:
            change = float(np.abs(found - before).max())
            if change < spread:
                best, spread = found, change
            if spread < 1e-11 * max(1.0, float(np.abs(best).max())):
                break
        before = found
    return best, spread if math.isfinite(spread) else math.nan


def accuracy(options: argparse.Namespace) -> None:
    """Compare the derivatives of random motions with differences of the exact step."""
    rng = np.random.default_rng(0)
    errors: dict[str, list[float]] = {}
    events: list[int] = []
    unclear, columns, flagged, lost = 0, 0, 0, 0
    while len(events) < options.motions:
        motion = random_motion(rng)
        names = names_of(motion)
        end, exact = jacobian_of(motion, names)
        if end.status != kernel.OK:
            lost += 1
            continue
        events.append(end.n_events)
        if end.derivative > kernel.FROM_BELT:
            flagged += 1
            continue
        stuck = end.derivative == kernel.FROM_BELT
        scale = np.abs(exact).max()
        worst = 0.0
        for column in range(exact.shape[1]):
            if stuck and column == 1:  # the mass cannot leave the belt
                continue
            wanted = exact[:, column] + (exact[:, 1] if stuck and column == 2 else 0.0)
            found, spread = differences(motion, names, column, stuck)
            columns += 1
            if not spread < 1e-10 * scale:
                unclear += 1
                continue
            worst = max(worst, float(np.abs(wanted - found).max() / scale))
        friction = motion.parameters.friction
        errors.setdefault(friction if isinstance(friction, str) else type(friction).__name__.lower(), []).append(worst)
    print(f"{len(events)} motions of 0 to {max(events)} events ({lost} more lost contact)")
    print(f"flagged as without a derivative: {flagged} motions")
    print(f"differences that do not settle to 1e-10, a graze being near: {unclear} of {columns} columns")
    print("largest error of a motion, relative to the largest entry of its Jacobian")
    for law, own in sorted(errors.items()):
        over = sum(error > 1e-9 for error in own)
        middle, worst = np.median(own), max(own)
        print(f"  {law:12} {len(own):5} motions  median {middle:.1e}  worst {worst:.1e}  over 1e-9: {over}")


def multipliers(_options: argparse.Namespace) -> None:
    """Compare Floquet multipliers with closed forms."""
    print("multipliers, largest error")
    # Without friction and damping: exp(+- i T), modulus 1.
    worst = 0.0
    for rate in (0.37, 0.8, 1.3, 2.9):
        p = OscillatorParameters(
            geometry="linear", mu_s=0.0, mu_m=0.0, beta=0.0, force_amplitude=0.3, force_frequency=rate
        )
        found = np.array(sorted(np.linalg.eigvals(tangent_map(p, 1.0, 0.2)), key=np.imag))
        exact = np.exp(np.array([-1j, 1j]) * 2.0 * math.pi / rate)
        worst = max(worst, float(np.abs(found - np.array(sorted(exact, key=np.imag))).max()))
    print(f"  linear, undamped (exp(+-iT)): {worst:.1e}")
    # Edges of the Mathieu equation's tongues: the trace is 2 or -2.
    worst, edges = 0.0, 0
    for order, q in itertools.product(range(1, 5), (0.05, 0.2, 0.4)):
        for edge in (mathieu_a, mathieu_b):
            a = float(edge(order, q))
            if not 0.0 < 2.0 * q / a <= 1.0:
                continue
            edges += 1
            p = OscillatorParameters(
                geometry="linear",
                mu_s=0.0,
                mu_m=0.0,
                beta=0.0,
                stiffness_amplitude=2.0 * q / a,
                stiffness_frequency=2.0 / math.sqrt(a),
            )
            trace = float(np.trace(tangent_map(p, 1.0, 0.2)))
            worst = max(worst, abs(abs(trace) - 2.0))
    print(f"  edges of Mathieu's tongues (trace 2, -2), {edges} of them: {worst:.1e}")
    # Coulomb friction on a standing floor, symmetric motion: det = exp(-2 beta T) and the ratios at the two reversals.
    worst = 0.0
    for rate, friction, beta in itertools.product((0.8, 1.3, 1.7), (0.1, 0.3), (0.02, 0.1)):
        p = OscillatorParameters(
            geometry="linear",
            friction="coulomb",
            mu_s=friction,
            mu_k=friction,
            beta=beta,
            belt_speed=0.0,
            force_amplitude=1.0,
            force_frequency=rate,
        )
        orbit = forced_orbit(p, 1.5, 0.0, transient=2000)
        squared = math.exp(-2.0 * beta * orbit.period)
        for event in simulate(p, orbit.x, orbit.v, orbit.period, dt=0.1).events:
            rest = math.cos(rate * event.time) - event.x
            squared *= (abs(rest) - friction) / (abs(rest) + friction)
        worst = max(worst, abs(abs(orbit.multipliers[0] * orbit.multipliers[1]) - squared))
    print(f"  Coulomb (Shaw 1986), product of both, 12 oscillators: {worst:.1e}")
    # Pure slip without excitation: one multiplier is 1, the other the slope of the map of maxima.
    worst, cycles = 0.0, 0
    for alpha in (0.7, 0.8, 1.0):
        p = OscillatorParameters(alpha=alpha)
        v_b0, v_b1 = critical_belt_speeds(p)
        for share in (0.3, 0.6, 0.9):
            cycle = limit_cycle(p.replace(belt_speed=v_b0 + share * (v_b1 - v_b0)))
            determinant = float(
                np.linalg.det(tangent_map(cycle.parameters, cycle.x_phase0, cycle.v_phase0, cycle.period))
            )
            plant, speed, traps = cycle.parameters.plant, cycle.parameters.belt_speed, np.empty((0, kernel.TRAP_ROW))
            step = 1e-3 * (cycle.x_max - cycle.x_min)
            maxima = [kernel.next_maximum(plant, speed, cycle.x_max + k * step, traps).x for k in (-2, -1, 1, 2)]
            slope = (8.0 * (maxima[2] - maxima[1]) - (maxima[3] - maxima[0])) / (12.0 * step)
            if math.isfinite(slope):
                worst, cycles = max(worst, abs(determinant - slope)), cycles + 1
    print(f"  pure slip, against the slope of the return map (fourth-order differences), {cycles} cycles: {worst:.1e}")


def tangent_map(p: OscillatorParameters, x: float, v: float, duration: float | None = None) -> Array:
    """Return the tangent map over a period of the excitation, or over a duration, (2, 2)."""
    tangents = np.zeros((kernel.TANGENT_ROWS, 2))
    tangents[kernel.TANGENT_X, 0] = tangents[kernel.TANGENT_V, 1] = 1.0
    duration = drive_period(p) if duration is None else duration
    state, belt = kernel.State(x, v), kernel.steady(p.belt_speed)
    kernel.advance_with_tangents(p.excited_plant(0.0), kernel.UNKNOWN, state, belt, duration, tangents, None)
    return tangents[:2]


def exponents(_options: argparse.Namespace) -> None:
    """Compare the sum of both exponents with the mean divergence and the determinants of the saltations."""
    worst, counted = 0.0, 0
    for friction, excitation in itertools.product(("stribeck", "hyperbolic", "coulomb"), ("force", "ripple")):
        for amplitude in (0.8, 1.2):
            p = OscillatorParameters(
                friction=friction, mu_k=0.1, alpha=0.8, belt_speed=0.1, g1=1.0,
                **{f"{excitation}_amplitude": amplitude, f"{excitation}_frequency": 1.7},
            )  # fmt: skip
            cycles = 40
            try:
                found = lyapunov_exponent(p, 0.9, 0.3, cycles=cycles, transient=0)
                motion = simulate(p, 0.9, 0.3, cycles * drive_period(p), dt=0.01)
            except OrbitError:
                continue
            if motion.stick_time > 0.0:
                continue
            counted += 1
            worst = max(worst, abs(sum(found.exponents) - mean_divergence(p, motion)))
    print(f"sum of exponents against divergence and saltation determinants, {counted} motions: {worst:.1e}")


def mean_divergence(p: OscillatorParameters, motion: Any) -> float:
    """Return the mean rate at which areas grow along a motion without sticks: in slip, and by its crossings."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    times = [0.0, *(event.time for event in motion.events), float(motion.t[-1])]
    states = [(motion.x[0], motion.v[0]), *((event.x, event.v) for event in motion.events)]
    belt = kernel.steady(p.belt_speed)
    for i, (begin, end) in enumerate(itertools.pairwise(times)):
        pieces = int((end - begin) / 0.2) + 1
        length = (end - begin) / pieces
        now = kernel.at_time(p.plant, begin)
        # From just inside the leg: at its first state friction has two values.
        mode = kernel.advance(now, kernel.State(*states[i]), belt, 0.5 * length, None).mode
        for k, (node, weight) in itertools.product(range(pieces), zip(nodes, weights, strict=True)):
            t = (k + 0.5 * (1.0 + node)) * length
            here = kernel.advance(now, kernel.State(*states[i]), belt, t, None)
            there = kernel.at_time(p.plant, begin + t)
            _, v = there.excitation.to_belt_frame(here.x, here.v, p.belt_speed)
            slope = there.friction.slope(mode, v - p.belt_speed)
            total -= 0.5 * length * weight * (2.0 * p.beta + slope * kernel.normal_force(there, here.x))
        if i + 1 < len(states):
            then = kernel.at_time(p.plant, end)
            x_belt, _ = then.excitation.to_belt_frame(*states[i + 1], p.belt_speed)
            a, after = (
                kernel.slip_acceleration(then, side, kernel.State(x_belt, p.belt_speed), belt) for side in (mode, -mode)
            )
            total += math.log(abs(after / a))
    return float(total / times[-1])


def cost(_options: argparse.Namespace) -> None:
    """Measure what derivatives by state and action cost, in one interleaved run."""
    rng, n = np.random.default_rng(0), 8192
    p = OscillatorParameters()
    print("cost of a step with its Jacobian by x, v, v_belt and action, over the plain step (medians of 15)")
    for task in (Task(), Task(actuator="belt_speed")):
        actuator = task.actuator_of(p)
        env = gym.make_vec(
            f"SDFriction/{'Force' if task.actuator == 'force' else 'BeltSpeed'}-v0",
            num_envs=n,
            vectorization_mode="vector_entry_point",
        )
        env.reset(seed=0)
        for _ in range(100):
            actions = rng.uniform(-1.0, 1.0, (n, 1)).astype(np.float32)
            env.step(actions)
        states = cast(SDFrictionVectorEnv, env).get_states()
        starts = np.array(
            [[s.x, s.v, s.v_belt, action] for s, action in zip(states, rng.uniform(-1.0, 1.0, n), strict=True)]
        )
        starts = np.ascontiguousarray(starts.T)
        outcomes, jacobians, codes = np.empty((n, 11)), np.empty((n, 11, 4)), np.empty((2, n), np.int64)
        ends = [np.empty(n) for _ in range(4)]
        state, action = starts[:3, 0].copy(), float(starts[3, 0])
        alone = [np.ascontiguousarray(row[:1]) for row in starts]
        runs: dict[str, Any] = {
            "plain": lambda a=actuator, s=starts, e=ends: kernel.control_intervals(p.plant, a, *s, *e),
            "jacobian": lambda a=actuator, s=starts, o=outcomes, j=jacobians, c=codes: (
                kernel.control_intervals_with_tangents(p.plant, a, s, None, np.empty(0), o, j, c)
            ),
            "vector env": lambda e=env, a=actions: e.step(a),
            "one plain": lambda a=actuator, s=alone, e=ends: [
                kernel.control_intervals(p.plant, a, *s, *(end[:1] for end in e)) for _ in range(200)
            ],
            "one": lambda s=state, a=action, t=task: [step_with_jacobian(s, a, p, t) for _ in range(200)],
        }
        times = interleaved(runs, 15)
        print(
            f"  {task.actuator}: {n} states, one by one in compiled code: {times['jacobian'] / times['plain']:.2f}x "
            f"({times['jacobian'] / n * 1e9:.0f} ns); over the vector environment's step: "
            f"{times['jacobian'] / times['vector env']:.1f}x; one state from Python: "
            f"{times['one'] / times['one plain']:.2f}x ({times['one'] / 200 * 1e6:.1f} us)"
        )


def interleaved(runs: dict[str, Any], repeats: int) -> dict[str, float]:
    """Return the median duration of each function, run in turn."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}


@numba.njit
def plain_return(plant: Any, actuator: Any, x: float, v: float, v_belt: float, actions: Array) -> float:
    """Return the sum of rewards of an action sequence."""
    total = 0.0
    kind, authority, a_limit, belt_speed, interval, w_effort, w_stick = actuator
    for action in actions:
        u, a_belt = kernel.actuation(kind, authority, a_limit, belt_speed, interval, v_belt, action)
        drive = kernel.Drive(v_belt, a_belt, u)
        end = kernel.follow(plant, kernel.UNKNOWN, kernel.State(x, v), drive, interval, None, kernel.UNTRIED)
        averages = kernel.interval_averages(
            x, end.x, end.int_v2, end.stick_time, end.int_fv, action, u, belt_speed, interval, w_effort, w_stick
        )
        total += averages.vibration + averages.effort + averages.stick
        x, v, v_belt = end.x, end.v, end.v_belt
    return total


def gradient(_options: argparse.Namespace) -> None:
    """Measure the gradient of a 500-step return in its actions against the plain compiled rollout."""
    p, rng = OscillatorParameters(), np.random.default_rng(0)
    for task in (Task(), Task(actuator="belt_speed")):
        actuator, actions = task.actuator_of(p), rng.uniform(-0.3, 0.3, 500)
        state = np.array([0.5, -0.3, 0.2])
        found = return_with_gradient(state, actions, p, task)
        plain = plain_return(p.plant, actuator, 0.5, -0.3, 0.2, actions)
        assert found.total == plain
        runs: dict[str, Any] = {
            "plain": lambda a=actuator, b=actions: plain_return(p.plant, a, 0.5, -0.3, 0.2, b),
            "gradient": lambda b=actions, t=task, s=state: return_with_gradient(s, b, p, t),
        }
        times = interleaved(runs, 101)
        ratio = times["gradient"] / times["plain"]
        checked = [0, 50, 250, 499]
        differences = []
        for k in checked:
            step = np.zeros(500)
            step[k] = 1e-6
            up, down = (plain_return(p.plant, actuator, 0.5, -0.3, 0.2, actions + s * step) for s in (1.0, -1.0))
            differences.append((up - down) / 2e-6)
        error = np.abs(found.by_actions[checked] - differences).max() / np.abs(found.by_actions).max()
        print(
            f"gradient of a 500-step return in its 500 actions, {task.actuator}: {ratio:.1f}x the plain rollout "
            f"({times['gradient'] * 1e6:.0f} us); differences from central ones of 1e-6: {error:.0e}"
        )


PARTS = {
    "accuracy": accuracy, "multipliers": multipliers, "exponents": exponents, "cost": cost, "gradient": gradient
}  # fmt: skip


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, help="one part")
    parser.add_argument("--motions", type=int, default=2000, help="of accuracy (default %(default)s)")
    options = parser.parse_args()
    for name, part in PARTS.items():
        if options.only in (None, name):
            part(options)


if __name__ == "__main__":
    main()
