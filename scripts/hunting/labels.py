"""Labels of ``basins`` against direct runs of random starts of random plants.

A direct run follows the motion by ``kernel.advance`` alone, without return maps: the extremes of x over stretches of
growing length are compared with those of the attractor that the label names. It is "not settled" where its budget of
integration steps ends before the extremes are constant; such starts decide nothing.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from scripts.hunting import draws
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, kernel
from sd_friction_env.physics.basins import LOST_CONTACT, UNDECIDED, Basins, basins
from sd_friction_env.physics.orbits import equilibria, stick_intervals

STARTS = 12  # of one plant
SAME = 1e-5  # extremes of x, relative to the motion's size
STILL = 1e-9
BUDGET = 3e5  # integration steps of a direct run


class Verdict(NamedTuple):
    """What a direct run says of a label: "held", "wrong", "undecided" or "not settled", and why."""

    what: str
    why: str = ""


_SPREAD = {  # ends of a parameter's whole range, and of its middle; the share of plants with 0
    "alpha": (1e-3, 10.0, 0.05, 2.0, 0.0),
    "g1": (1e-3, 100.0, 0.5, 2.0, 0.0),
    "beta": (1e-5, 10.0, 1e-2, 2.0, 0.15),
    "mu_s": (1e-3, 10.0, 0.05, 1.0, 0.02),
    "v_m": (1e-2, 100.0, 0.2, 2.0, 0.0),
    "belt_speed": (1e-3, 10.0, 0.02, 2.0, 0.0),
    "delta": (1e-3, 1e3, 0.1, 10.0, 0.1),
    "v_0": (1e-3, 100.0, 0.1, 2.0, 0.0),
    "mu_v": (1e-4, 10.0, 0.01, 0.5, 0.5),
    "kappa": (1e-4, 10.0, 0.1, 2.0, 0.1),
}


def draw_plant(rng: np.random.Generator) -> OscillatorParameters:
    """Return a plant from the whole accepted range; half of them from its middle."""
    wide = rng.random() < 0.5
    numbers: dict[str, Any] = {
        name: 0.0 if rng.random() < zero else float(np.exp(rng.uniform(*np.log(whole if wide else middle))))
        for name, (*whole, low, high, zero) in _SPREAD.items()
        for middle in [(low, high)]
    }
    numbers["geometry"] = str(rng.choice(["exact", "cubic", "linear", "duffing"]))
    numbers["friction"] = str(rng.choice(["stribeck", "coulomb", "hyperbolic", "exponential"]))
    if numbers["geometry"] == "exact" and rng.random() < 0.3:
        numbers["alpha"] = 0.0 if rng.random() < 0.7 else float(rng.uniform(1e-3, 0.05))
    share = rng.choice([0.0, 1.0, rng.random()], p=[0.1, 0.1, 0.8])
    numbers["mu_m"] = numbers["mu_k"] = float(share * numbers["mu_s"])
    return OscillatorParameters(**numbers)


def draw_starts(rng: np.random.Generator, parameters: OscillatorParameters, count: int) -> np.ndarray:
    """Return starts (count, 2): anywhere, in the middle, and about the equilibria."""
    starts = rng.uniform(-10.0, 10.0, (count, 2))
    starts[count // 4 : count // 2] *= 0.2
    places = [e.x for e in equilibria(parameters) if abs(e.x) < 9.0] or [0.0]
    for i in range(count // 2, count):
        size = np.exp(rng.uniform(np.log(1e-3), 0.0))
        starts[i] = [rng.choice(places), 0.0] + size * rng.uniform(-1.0, 1.0, 2)
    return starts


def stiffest(p: OscillatorParameters, x: float, v: float) -> float:
    """Return a rate that bounds the step of an explicit integration about a state."""
    speeds = (abs(v) + p.belt_speed, p.belt_speed, 1e-6)
    slope = max(abs(p.plant.friction.slope(-1, -w)) for w in speeds)
    return float(max(15.0, 2.0 * p.beta + max(p.normal_force(x), p.normal_force(0.5 * x), p.g1) * slope))


def conserves(p: OscillatorParameters) -> bool:
    """Whether neither the damper nor friction in slip depends on the speed."""
    slopes = [p.plant.friction.slope(-1, -w) for w in np.geomspace(1e-6, 30.0, 50)]
    return p.beta == 0.0 and not any(slopes)


def follow(p: OscillatorParameters, x: float, v: float, found: Basins, label: int) -> Verdict:
    """Return what a direct run says of a label."""
    plant, belt = p.plant, p.belt_speed
    stuck = sum(high - low for low, high in stick_intervals(p)) / belt
    slowest = min((abs(e.eigenvalues[0] * e.eigenvalues[1]) for e in equilibria(p)), default=1.0)
    duration = max(30.0, 3.0 * stuck, min(30.0 / math.sqrt(max(slowest, 1e-12)), 1e4))
    spent, last, near = 0.0, (math.nan, math.nan), None
    while True:
        low, high, left = math.inf, -math.inf, duration
        while left > 0.0:
            rate = stiffest(p, x, v)
            piece = min(left, 2e4 / rate)
            x, v, _, mode, status, t, _, _, stick_time, _, x_min, x_max = kernel.advance(
                plant, kernel.State(x, v), kernel.Drive(belt, 0.0, 0.0), piece, None
            )
            low, high = min(low, x_min), max(high, x_max)
            left = 0.0 if piece == left and status == kernel.OK else left - t
            spent += rate * (t - stick_time) / 3.0 + 200.0
            if status == kernel.CONTACT_LOST:
                return Verdict("held" if label == LOST_CONTACT else "wrong", "contact lost")
            if status == kernel.STEP_LIMIT or not math.isfinite(x + v):
                return Verdict("not settled", "step limit")
            if spent > 2.0 * BUDGET:
                return Verdict("not settled", f"stiff: {rate:.3g}")
        size = max(1e-2, abs(low), abs(high))
        change = max(abs(low - last[0]), abs(high - last[1])) / size
        last = (low, high)
        distances = [max(abs(low - a.x_min), abs(high - a.x_max)) / size for a in found.attractors]
        order = sorted(range(len(distances)), key=distances.__getitem__)
        close = (
            order[0] if order and distances[order[0]] < SAME and found.attractors[order[0]].kind != "neutral" else None
        )
        if close is not None and close == near:
            return Verdict("held" if close == label else "wrong", f"reaches {close}")
        near = close
        inside = label >= 0 and found.attractors[label].kind == "neutral" and change < STILL
        if inside:
            family = found.attractors[label]
            inside = family.x_min - SAME * size <= low and high <= family.x_max + SAME * size
        if inside or spent > BUDGET:
            here = f"{low:.9g} to {high:.9g} after {duration:.3g}, changed by {change:.2g}"
            # Where slip gains or loses energy, a motion that seems to stand still may drift too slowly to be seen.
            stands = change < STILL and close is None and conserves(p)
            return Verdict("held" if inside else "wrong" if stands else "not settled", here)
        duration *= 2.0


def drawn(seed: int, index: int) -> tuple[OscillatorParameters, np.ndarray]:
    """Return a plant and starts (STARTS, 2)."""
    rng = draws.generator(seed, index)
    p = draw_plant(rng)
    return p, np.clip(draw_starts(rng, p, STARTS), -10.0, 10.0)


def verdicts(seed: int, index: int) -> list[Verdict]:
    """Return what direct runs say of the labels of each start of one random plant."""
    p, starts = drawn(seed, index)
    found = basins(p, *starts.T)
    return [
        Verdict("undecided") if label == UNDECIDED else follow(p, x, v, found, label)
        for (x, v), label in zip(starts.tolist(), found.labels.tolist(), strict=True)
    ]


def trial(seed: int, index: int) -> None:
    """Check labels of basins against direct runs."""
    found = verdicts(seed, index)
    if "wrong" in {verdict.what for verdict in found}:
        raise Failure("labels", f"{found}")
    if "undecided" in {verdict.what for verdict in found}:
        raise SetAside("a start of the plant is labelled as not decided")


def described(seed: int, index: int) -> str:
    """Return the call that labels the starts."""
    p, starts = drawn(seed, index)
    return f"basins({draws.described(p)}, *np.transpose({starts.tolist()}))"


CHECK = Check("labels", "labels of basins against direct runs", trial, drawn=described, patience=120.0)
