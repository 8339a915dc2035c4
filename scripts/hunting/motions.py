"""Long motions of random legal plants: attractors that attract, multipliers that do not depend on the section, labels
of basins; and damaged files."""

import math
from collections.abc import Mapping

import numpy as np

from scripts.hunting import draws, files, labels
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, attractors, kernel, simulate
from sd_friction_env.physics.forced import forced_orbit
from sd_friction_env.physics.orbits import LimitCycle, OrbitError, equilibria
from sd_friction_env.physics.parameters import STATE_LIMIT

LAPS = 20
MOVED = 1e-3  # of a cycle's size
ATTRACTS = 1e-7  # by how much of itself a distance must shrink in that many laps
SAME_MULTIPLIER = 1e-5
STARTS = 12  # of one plant, in basins


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
    out = kernel.advance(p.plant, kernel.State(x, v), kernel.Drive(p.belt_speed, 0.0, 0.0), time, None)
    if out[4] in (kernel.STEP_LIMIT, kernel.EVENT_LIMIT):
        raise SetAside(kernel.STATUS_NAMES[out[4]])
    if out[4] != kernel.OK:
        return math.inf
    out = kernel.advance(
        p.plant, kernel.State(out[0], out[1]), kernel.Drive(p.belt_speed, 0.0, 0.0), 1.25 * period, None
    )
    return float(max(abs(out[11] - cycle.x_max), abs(out[10] - cycle.x_min)) / abs(moved))


def place_scale(p: OscillatorParameters, x: float) -> float:
    """Return over which distance the forces near a place change."""
    return max(min(1.0, p.alpha) if "alpha" in draws.SPRING_FIELDS[p.geometry] and p.alpha else 1.0, 1e-3 * abs(x))


def attractor_trial(seed: int, index: int) -> Mapping[str, float] | None:
    """Check that whatever is called an attractor draws in what starts beside it."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng, excited=0.0)
    if p.belt_speed == 0.0:
        p = p.replace(belt_speed=0.1)
    if rng.random() < 0.2:
        p = p.replace(beta=0.0)
    try:
        found = attractors(p)
        for cycle in found:
            if cycle.kind in ("pure-slip", "steady-slip"):
                size = cycle.amplitude if cycle.amplitude > 0.0 else 1e-3 * place_scale(p, cycle.x_max)
                left = min(distance_left(cycle, sign * MOVED * size) for sign in (1.0, -1.0))
                if not left < 1.0 - ATTRACTS:
                    words = f"a {cycle.kind} attractor of amplitude {cycle.amplitude:.3g}, multiplier "
                    words += f"{cycle.floquet_multiplier!r}, keeps {left!r} of a distance from it after {LAPS} laps"
                    raise Failure("attracts nothing", words)
            elif cycle.kind == "stick-slip":
                end = kernel.advance(
                    p.plant,
                    kernel.State(cycle.x_phase0, cycle.v_phase0),
                    kernel.Drive(p.belt_speed, 0.0, 0.0),
                    cycle.period,
                    None,
                )
                if end[4] == kernel.OK and abs(end[0] - cycle.x_phase0) > 1e-7 * max(1.0, abs(cycle.x_phase0)):
                    words = f"a stick-slip cycle from x = {cycle.x_phase0!r} is at {end[0]!r} after its period"
                    raise Failure("no cycle", words)
    except Exception as error:
        error.add_note(f"attractors({draws.described(p)})")
        raise
    return None


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
            found = Failure("multipliers", words)
            found.add_note(
                f"forced_orbit({draws.described(shifted)}, {event.x!r}, {event.v!r}, multiple={orbit.multiple}"
                ", transient=0)"
            )
            raise found
        worst = max(worst, gap)
    return {"largest gap of multipliers": worst}


def label_trial(seed: int, index: int) -> None:
    """Check labels of basins against direct runs."""
    starts, _, others = labels.check_basins(own_seed(seed, index), STARTS)
    wrong = [other for other in others if other["verdict"] not in ("not settled", "slow", "undecided")]
    if not wrong and any(other["verdict"] == "undecided" for other in others):
        raise SetAside("a start of the plant is labelled as not decided")
    if wrong:
        raise Failure(f"labels: {wrong[0]['verdict']}", f"{len(wrong)} of {starts} starts, such as {wrong[0]}")


def file_trial(seed: int, index: int) -> None:
    """Check what damaged files do."""
    _, _, wrong = files.check_files(own_seed(seed, index))
    if wrong:
        raise Failure("files", f"{wrong}")


def own_seed(seed: int, index: int) -> int:
    """Return a seed for another script's check."""
    return int(draws.generator(seed, index).integers(2**31))


def prepare() -> None:
    """Compile what the trials call."""
    attractors(OscillatorParameters())
    attractors(OscillatorParameters(friction="coulomb"))


ATTRACTORS = Check("attractors", "attractors draw in what starts beside them", attractor_trial, prepare, patience=60.0)
MULTIPLIERS = Check(
    "multipliers",
    "multipliers of forced orbits: the same from a section on an event",
    multiplier_trial,
    prepare,
    patience=60.0,
)
LABELS = Check("labels", "labels of basins against direct runs", label_trial, prepare, patience=120.0)
FILES = Check("files", "damaged and hostile files", file_trial, patience=120.0)
