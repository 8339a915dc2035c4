"""Random legal plants, states and tasks over the whole of what is accepted, ends included."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env import OscillatorParameters, kernel
from sd_friction_env.physics.parameters import EXCITATIONS, FRICTIONS, GEOMETRIES, RANGES, SMALLEST_ALPHA, STATE_LIMIT

NOMINAL = OscillatorParameters()
LAW_FIELDS = {
    "stribeck": ("mu_m", "v_m"),
    "coulomb": ("mu_k",),
    "hyperbolic": ("delta", "mu_v"),
    "exponential": ("mu_k", "v_0", "mu_v"),
    "gaussian": ("mu_k", "v_0", "mu_v"),
}
SPRING_FIELDS: dict[str, tuple[str, ...]] = {
    "exact": ("alpha",),
    "cubic": ("alpha",),
    "linear": (),
    "duffing": ("kappa",),
}
# What makes a plant hard to follow, where it is used: an end of its range.
_HARD = {
    "v_m": 0,
    "v_0": 0,
    "alpha": 0,
    "delta": 1,
    "mu_s": 1,
    "g1": 1,
    "kappa": 1,
    "belt_speed": 1,
    "mu_v": 1,
    "beta": 1,
}
_DRAWN = RANGES | {"kappa": (0.0, 10.0), "linear_stiffness": (1.0, 1.0)}  # a softening spring lets a mass escape
_SCALES = ("time_scale", "length_scale", "force_scale")


class Start(NamedTuple):
    """A state at a time, and what acts on it: a force and the belt's acceleration."""

    x: float
    v: float
    v_belt: float
    a_belt: float
    u: float
    time: float


def generator(seed: int, index: int) -> np.random.Generator:
    """Return the random numbers of one trial."""
    return np.random.default_rng([seed, index])


def number(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number in [low, high]: sometimes an end, log-uniform where the range spans decades."""
    share = rng.random()
    if share < 0.06:
        return low
    if share < 0.12:
        return high
    if low < 0.0 or (low == 0.0 and share < 0.5) or high <= 30.0 * low:
        return float(rng.uniform(low, high))
    return float(max(low, high * 1e-4) ** (share := rng.random()) * high ** (1.0 - share))


def signed(rng: np.random.Generator, limit: float) -> float:
    """Return a number in [-limit, limit]."""
    return number(rng, 0.0, limit) * (1.0 if rng.random() < 0.5 else -1.0)


def fields_used(geometry: str, friction: str) -> set[str]:
    """Return the parameters that the forces of an unexcited plant depend on."""
    return {"g1", "beta", "mu_s", "belt_speed", *SPRING_FIELDS[geometry], *LAW_FIELDS[friction]}


def values(rng: np.random.Generator, excited: float = 0.3, unused: bool = False, hard: float = 0.0) -> dict[str, Any]:
    """Return fields of :class:`OscillatorParameters`.

    Args:
        excited: share of the plants that are excited. unused: whether fields that the plant's laws do not use are drawn
            as well, over the whole of their ranges. hard: share of the plants that are pushed to where they are stiff.
    """
    geometry, friction = str(rng.choice(GEOMETRIES)), str(rng.choice(FRICTIONS))
    used = fields_used(geometry, friction)
    drawn: dict[str, Any] = {"geometry": geometry, "friction": friction}
    for name, (low, high) in _DRAWN.items():
        if name in used or (unused and not name.startswith(EXCITATIONS)):
            drawn[name] = number(rng, low, high)
            if name in used and rng.random() < 0.3:  # plants of which most is ordinary have their own faults
                drawn[name] = getattr(NOMINAL, name)
    stiff = rng.random() < hard
    for name in sorted(used & _HARD.keys()) if stiff else ():
        if rng.random() < 0.3:
            drawn[name] = RANGES[name][_HARD[name]]
    for name in ("mu_m", "mu_k"):
        if name in used:
            drawn[name] = drawn["mu_s"] * min(1.0, max(0.0, rng.uniform(-0.1, 1.1)))
        elif not unused:
            drawn[name] = 0.0
    if "alpha" in used:
        share = rng.random()
        if share < 0.08:
            drawn["alpha"] = 0.0 if geometry == "exact" else SMALLEST_ALPHA
        elif drawn["alpha"] < SMALLEST_ALPHA:
            drawn["alpha"] = SMALLEST_ALPHA
    elif "alpha" in drawn and drawn["alpha"] < SMALLEST_ALPHA:
        drawn["alpha"] = 0.0
    if rng.random() < excited:
        kinds = [kind for kind in EXCITATIONS if rng.random() < 0.5] or [EXCITATIONS[int(rng.integers(3))]]
        for name in (f"{kind}_{what}" for kind in kinds for what in ("amplitude", "frequency", "phase")):
            drawn[name] = RANGES[name][1] if stiff and rng.random() < 0.3 else number(rng, *RANGES[name])
    return drawn


def plant(rng: np.random.Generator, **choices: Any) -> OscillatorParameters:
    """Return a random plant; see :func:`values`."""
    return OscillatorParameters(**values(rng, **choices))


def start(rng: np.random.Generator, parameters: OscillatorParameters, interval: float) -> Start:
    """Return a random state of a plant and what acts on it over one control interval, by either actuator."""
    v_belt, a_belt, u, time = parameters.belt_speed, 0.0, 0.0, 0.0
    action = (-1.0, 0.0, 1.0, float(rng.uniform(-1.0, 1.0)))[int(rng.integers(4))]
    if rng.random() < 0.5:
        u = number(rng, 0.0, 100.0) * action
    else:
        authority, limit = number(rng, 0.0, 1.0), number(rng, 0.0, 1e6)
        v_belt *= 1.0 + authority * rng.uniform(-1.0, 1.0)
        target = (1.0 + authority * action) * parameters.belt_speed
        a_belt = min(max((target - v_belt) / interval, -limit), limit)
    if parameters.excited and rng.random() < 0.5:
        time = number(rng, 0.0, 1e4)
    x = signed(rng, STATE_LIMIT if rng.random() < 0.5 else 1.5)
    v = signed(rng, STATE_LIMIT if rng.random() < 0.5 else 1.0)
    if rng.random() < 0.25:
        v = float(kernel.at_time(parameters.plant, time).excitation.lab_velocity(v_belt))
    if rng.random() < 0.05:
        x = 0.0
    return Start(x, v, v_belt, a_belt, u, time)


def described(parameters: OscillatorParameters) -> str:
    """Return a plant as one types it: the fields that are not as they are by default."""
    words = [f"geometry={parameters.geometry!r}", f"friction={parameters.friction!r}"]
    for name in RANGES:
        value = getattr(parameters, name)
        off = name.startswith(EXCITATIONS) and not getattr(parameters, f"{name.split('_')[0]}_amplitude")
        if value != getattr(NOMINAL, name) and name not in _SCALES and not off:
            words.append(f"{name}={value!r}")
    return f"OscillatorParameters({', '.join(words)})"


def keywords(arguments: Mapping[str, Any]) -> str:
    """Return arguments as one types them."""
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())
