"""Friction-induced vibration as a control problem: an event-exact SD oscillator on a moving belt.

Importing the package registers its environments with Gymnasium; everything else is loaded when first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

if TYPE_CHECKING:  # what __getattr__ below loads when first used, spelled out for type checkers
    from sd_friction_env.basins import Basins, basin_grid
    from sd_friction_env.curves import amplitude_curve, attractor_curves
    from sd_friction_env.env import EnvState, SDFrictionEnv
    from sd_friction_env.orbits import (
        ContactLossError,
        CriticalBeltSpeeds,
        Equilibrium,
        LimitCycle,
        OrbitError,
        attractors,
        critical_belt_speeds,
        equilibria,
        first_lyapunov_coefficient,
        limit_cycle,
        slip_cycles,
        stick_intervals,
    )
    from sd_friction_env.parameters import OscillatorParameters
    from sd_friction_env.pretrained import load_pretrained
    from sd_friction_env.simulation import Trajectory, simulate
    from sd_friction_env.tables import Table
    from sd_friction_env.task import Task
    from sd_friction_env.vector_env import SDFrictionVectorEnv

__version__ = "0.1.0"

_PUBLIC = {
    "OscillatorParameters": "parameters",
    "Trajectory": "simulation",
    "simulate": "simulation",
    "CriticalBeltSpeeds": "orbits",
    "LimitCycle": "orbits",
    "Equilibrium": "orbits",
    "ContactLossError": "orbits",
    "OrbitError": "orbits",
    "limit_cycle": "orbits",
    "equilibria": "orbits",
    "critical_belt_speeds": "orbits",
    "attractors": "orbits",
    "first_lyapunov_coefficient": "orbits",
    "slip_cycles": "orbits",
    "stick_intervals": "orbits",
    "amplitude_curve": "curves",
    "attractor_curves": "curves",
    "Basins": "basins",
    "basin_grid": "basins",
    "Table": "tables",
    "Task": "task",
    "SDFrictionEnv": "env",
    "EnvState": "env",
    "SDFrictionVectorEnv": "vector_env",
    "Asymmetric": "laws",
    "check_friction_law": "laws",
    "check_spring_law": "laws",
    "friction_law": "laws",
    "friction_table": "laws",
    "load_pretrained": "pretrained",
    "spring_law": "laws",
    "tabulated_friction": "laws",
}
__all__ = [
    "ENVIRONMENT_IDS",
    "Asymmetric",
    "Basins",
    "ContactLossError",
    "CriticalBeltSpeeds",
    "EnvState",
    "Equilibrium",
    "LimitCycle",
    "OrbitError",
    "OscillatorParameters",
    "SDFrictionEnv",
    "SDFrictionVectorEnv",
    "Table",
    "Task",
    "Trajectory",
    "__version__",
    "amplitude_curve",
    "attractor_curves",
    "attractors",
    "basin_grid",
    "check_friction_law",
    "check_spring_law",
    "critical_belt_speeds",
    "equilibria",
    "first_lyapunov_coefficient",
    "friction_law",
    "friction_table",
    "limit_cycle",
    "load_pretrained",
    "simulate",
    "slip_cycles",
    "spring_law",
    "stick_intervals",
    "tabulated_friction",
]

# Hidden parameters of the randomised tier, and the sensor of the sensed tier.
_RANDOMISED: dict[str, Any] = {"randomise": {"belt_speed": (0.1, 0.35), "alpha": (0.6, 0.95), "mu_m": (0.03, 0.12)}}
_SENSED: dict[str, Any] = {"sensor": "position", "sensor_noise": 0.005, "sensor_delay": 1}
_TIERS = {"": {}, "Randomised": _RANDOMISED, "Sensed": _SENSED}
_ACTUATORS = {"Force": "force", "BeltSpeed": "belt_speed"}

ENVIRONMENT_IDS = tuple(f"SDFriction/{name}{tier}-v0" for name in _ACTUATORS for tier in _TIERS)

for _name, _actuator in _ACTUATORS.items():
    for _tier, _arguments in _TIERS.items():
        register(
            id=f"SDFriction/{_name}{_tier}-v0",
            entry_point="sd_friction_env.env:SDFrictionEnv",
            vector_entry_point="sd_friction_env.vector_env:SDFrictionVectorEnv",
            kwargs={"actuator": _actuator, **_arguments},
        )


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
