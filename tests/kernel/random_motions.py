"""Motions of random plants of any law, and their derivatives: exact, and by differences of the motion."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import OscillatorParameters, kernel, tabulated_friction
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
