"""Long motions of random legal plants: attractors that attract, multipliers that do not depend on the section."""

import math
from collections.abc import Mapping

import numpy as np

from scripts.hunting import draws
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, attractors, kernel, simulate
from sd_friction_env.physics.forced import forced_orbit
from sd_friction_env.physics.orbits import LimitCycle, OrbitError, equilibria
from sd_friction_env.physics.parameters import STATE_LIMIT

LAPS = 20
MOVED = 1e-3  # of a cycle's size
ATTRACTS = 1e-7  # by how much of itself a distance must shrink in that many laps
SAME_MULTIPLIER = 1e-5


def distance_left(cycle: LimitCycle, moved: float) -> float:
    """Return which share of a distance from a cycle or an equilibrium is left after some laps, by a direct run."""
    p = cycle.parameters
    period, time = cycle.period, LAPS * cycle.period
    if not period > 0.0:  # of a place, how long its own eigenvalues need
        place = min(equilibria(p), key=lambda place: abs(place.x - cycle.x_max))
        slowest = max(place.eigenvalues, key=lambda value: value.real)
        period = 2.0 * math.pi / max(abs(slowest.imag), 0.1)
        time = max(LAPS * period, -3.0 / slowest.real if slowest.real else 0.0)
    x, v = cycle.x_max + moved, 0.0
    end = kernel.advance(p.plant, kernel.State(x, v), kernel.steady(p.belt_speed), time, None)
    if end.status in (kernel.STEP_LIMIT, kernel.EVENT_LIMIT):
        raise SetAside(kernel.STATUS_NAMES[end.status])
    if end.status != kernel.OK:
        return math.inf
    end = kernel.advance(p.plant, kernel.State(end.x, end.v), kernel.steady(p.belt_speed), 1.25 * period, None)
    return float(max(abs(end.x_max - cycle.x_max), abs(end.x_min - cycle.x_min)) / abs(moved))


def place_scale(p: OscillatorParameters, x: float) -> float:
    """Return over which distance the forces near a place change."""
    return max(min(1.0, p.alpha) if "alpha" in draws.SPRING_FIELDS[p.geometry] and p.alpha else 1.0, 1e-3 * abs(x))


def drawn_free(seed: int, index: int) -> OscillatorParameters:
    """Return an unexcited plant on a moving belt."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng, excited=0.0)
    p = p.replace(belt_speed=p.belt_speed or 0.1)
    return p.replace(beta=0.0) if rng.random() < 0.2 else p


def described_free(seed: int, index: int) -> str:
    """Return the call that finds the attractors."""
    return f"attractors({draws.described(drawn_free(seed, index))})"


def attractor_trial(seed: int, index: int) -> None:
    """Check that whatever is called an attractor draws in what starts beside it."""
    p = drawn_free(seed, index)
    for cycle in attractors(p):
        if cycle.kind in ("pure-slip", "steady-slip"):
            size = cycle.amplitude if cycle.amplitude > 0.0 else 1e-3 * place_scale(p, cycle.x_max)
            left = min(distance_left(cycle, sign * MOVED * size) for sign in (1.0, -1.0))
            if not left < 1.0 - ATTRACTS:
                words = f"a {cycle.kind} attractor of amplitude {cycle.amplitude:.3g}, multiplier "
                words += f"{cycle.floquet_multiplier!r}, keeps {left!r} of a distance from it after {LAPS} laps"
                raise Failure("attracts nothing", words)
        elif cycle.kind == "stick-slip":
            start = kernel.State(cycle.x_phase0, cycle.v_phase0)
            end = kernel.advance(p.plant, start, kernel.steady(p.belt_speed), cycle.period, None)
            if end.status == kernel.OK and abs(end.x - start.x) > 1e-7 * max(1.0, abs(start.x)):
                raise Failure("no cycle", f"a stick-slip cycle from {start!r} is at {end.x!r} after its period")


def forced_plant(rng: np.random.Generator) -> OscillatorParameters:
    """Return a plant with one excitation that most likely settles on a short cycle."""
    kind = str(rng.choice(["force", "force", "ripple", "stiffness"]))
    values = draws.values(rng, excited=0.0)
    values |= {name: rng.uniform(0.2, 1.0) for name in ("alpha",) if "alpha" in values}
    values |= {"beta": rng.uniform(0.01, 0.2), "g1": rng.uniform(0.5, 2.0), "mu_s": rng.uniform(0.05, 0.6)}
    values["belt_speed"] = 0.0 if rng.random() < 0.5 else rng.uniform(0.0, 1.0)
    for name in ("mu_m", "mu_k"):
        values[name] = values["mu_s"] * min(1.0, rng.uniform(0.3, 1.3))
    values[f"{kind}_amplitude"] = rng.uniform(0.1, 1.0 if kind == "stiffness" else 2.0)
    values[f"{kind}_frequency"] = rng.uniform(0.3, 3.0)
    values |= {"v_m": rng.uniform(0.2, 2.0), "delta": rng.uniform(0.0, 5.0), "v_0": rng.uniform(0.2, 2.0)}
    values |= {"mu_v": rng.uniform(0.0, 0.1), "kappa": rng.uniform(0.0, 1.0)}
    return OscillatorParameters(**values)


def multiplier_trial(seed: int, index: int) -> Mapping[str, float]:
    """Check that Floquet multipliers are the same from a section that falls on an event."""
    rng = draws.generator(seed, index)
    p = forced_plant(rng)
    kind = next(kind for kind in ("force", "ripple", "stiffness") if getattr(p, f"{kind}_amplitude"))
    rate, phase = getattr(p, f"{kind}_frequency"), getattr(p, f"{kind}_phase")
    try:
        orbit = forced_orbit(p, 0.3, 0.0, most=4, phase=0.137)
    except OrbitError:
        raise SetAside("no short periodic motion is reached") from None
    if max(abs(orbit.x), abs(orbit.v)) > STATE_LIMIT:
        raise SetAside("a motion beyond where one may start")
    if orbit.singular_events:
        raise SetAside("singular events, which the result tells")
    begin = orbit.phase * 2.0 * math.pi / rate
    at_section = p.replace(**{f"{kind}_phase": math.remainder(phase + rate * begin, 2.0 * math.pi)})
    history = simulate(at_section, orbit.x, orbit.v, orbit.period, dt=1e3)
    worst = 0.0
    for event in [event for event in history.events[:6] if max(abs(event.x), abs(event.v)) <= STATE_LIMIT]:
        shifted = p.replace(**{f"{kind}_phase": math.remainder(phase + rate * (begin + event.time), 2.0 * math.pi)})
        try:
            other = forced_orbit(shifted, event.x, event.v, multiple=orbit.multiple, transient=0)
        except OrbitError:
            continue
        if math.hypot(other.x - event.x, other.v - event.v) > 1e-6 or other.singular_events:
            continue
        mine, its = (sorted(map(abs, o.multipliers)) for o in (orbit, other))
        gap = max(abs(a - b) for a, b in zip(mine, its, strict=True)) / max(1.0, *mine)
        if gap > SAME_MULTIPLIER:
            words = f"multipliers {orbit.multipliers} from phase {orbit.phase}, {other.multipliers} from a {event.kind}"
            call = f"forced_orbit({draws.described(shifted)}, {event.x!r}, {event.v!r}, multiple={orbit.multiple}"
            raise Failure("multipliers", f"{words}\n      {call}, transient=0)")
        worst = max(worst, gap)
    return {"largest gap of multipliers": worst}


ATTRACTORS = Check(
    "attractors",
    "attractors draw in what starts beside them",
    attractor_trial,
    drawn=described_free,
    patience=120.0,
)
MULTIPLIERS = Check(
    "multipliers", "multipliers of forced orbits: the same from a section on an event", multiplier_trial, patience=120.0
)
