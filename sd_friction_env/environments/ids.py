"""The registered environments by task and tier: their ids and arguments."""

from typing import Any

_TASKS = {"force": ("Force", "force"), "belt": ("BeltSpeed", "belt_speed")}  # part of the id, actuator
# Hidden parameters of the randomised tier, and the sensor of the sensed tier.
_TIERS: dict[str, tuple[str, dict[str, Any]]] = {
    "nominal": ("", {}),
    "randomised": (
        "Randomised",
        {"randomise": {"belt_speed": (0.1, 0.35), "alpha": (0.6, 0.95), "mu_m": (0.03, 0.12)}},
    ),
    "sensed": ("Sensed", {"sensor": "position", "sensor_noise": 0.005, "sensor_delay": 1}),
}
TASKS, TIERS = tuple(_TASKS), tuple(_TIERS)


def environment_id(task: str, tier: str = "nominal") -> str:
    """Return the registered id of a task ("force", "belt") and a tier ("nominal", "randomised", "sensed")."""
    return f"SDFriction/{_TASKS[task][0]}{_TIERS[tier][0]}-v0"


ARGUMENTS: dict[str, dict[str, Any]] = {
    environment_id(task, tier): {"actuator": actuator, **arguments}
    for task, (_, actuator) in _TASKS.items()
    for tier, (_, arguments) in _TIERS.items()
}
ENVIRONMENT_IDS = tuple(ARGUMENTS)
