"""The registered environments by task and tier: their ids and arguments."""

import math
from typing import Any

_TASKS = {"force": ("Force", "force"), "belt": ("BeltSpeed", "belt_speed")}  # part of the id, actuator


def _position(noise: float, delay: int) -> dict[str, Any]:
    return {"sensor": "position", "sensor_noise": noise, "sensor_delay": delay}


_PLANTS = {"belt_speed": (0.1, 0.35), "alpha": (0.6, 0.95), "mu_m": (0.03, 0.12)}
_EXCITATION = {"force_amplitude": (0.005, 0.01), "force_frequency": (0.3, 1.0), "force_phase": (0.0, 2.0 * math.pi)}
# Part of the id, and what is hidden: parameters drawn for each episode, and what the sensor does not see.
_TIERS: dict[str, tuple[str, dict[str, Any]]] = {
    "nominal": ("", {}),
    "randomised": ("Randomised", {"randomise": _PLANTS}),
    "sensed": ("Sensed", _position(0.005, 1)),
}
# Tiers of the belt task that are still open (docs/howto/observers.md has what controllers reach).
_OPEN_TIERS: dict[str, tuple[str, dict[str, Any]]] = {
    "blind": ("Blind", {"randomise": _PLANTS, **_position(0.005, 1)}),
    "blind-late": ("BlindLate", {"randomise": _PLANTS, **_position(0.01, 3)}),
    "blind-hard": ("BlindHard", {"randomise": {**_PLANTS, "mu_s": (0.15, 0.25)}, **_position(0.02, 5)}),
    "drifting": (
        "Drifting",
        {"randomise": _PLANTS, "drift": {"mu_m": _PLANTS["mu_m"], "mu_s": (0.15, 0.25)}, **_position(0.005, 1)},
    ),
    "excited": ("Excited", {"randomise": _EXCITATION, **_position(0.005, 1)}),
}
TASKS, TIERS, OPEN_TIERS = tuple(_TASKS), tuple(_TIERS), tuple(_OPEN_TIERS)


def environment_id(task: str, tier: str = "nominal") -> str:
    """Return the registered id of a task ("force", "belt") and a tier of TIERS, or for "belt" of OPEN_TIERS.

    Raises:
        ValueError: if the task has no such tier.
    """
    tiers = _tiers_of(task)
    if tier not in tiers:
        raise ValueError(f"tier of task {task!r} must be one of {', '.join(tiers)}, got {tier!r}")
    return f"SDFriction/{_TASKS[task][0]}{tiers[tier][0]}-v0"


def bare_id(env_id: str) -> str:
    """Return an environment's id without the module name before the colon."""
    return env_id.rpartition(":")[2]


def _tiers_of(task: str) -> dict[str, tuple[str, dict[str, Any]]]:
    return _TIERS | (_OPEN_TIERS if task == "belt" else {})


ARGUMENTS: dict[str, dict[str, Any]] = {
    environment_id(task, tier): {"actuator": actuator, **arguments}
    for task, (_, actuator) in _TASKS.items()
    for tier, (_, arguments) in _tiers_of(task).items()
}
ENVIRONMENT_IDS = tuple(ARGUMENTS)
# Those of TIERS: for each the package has trained agents and tuned gains.
SOLVED_IDS = tuple(environment_id(task, tier) for task in TASKS for tier in TIERS)
