"""Friction-induced vibration as a control problem: an event-exact SD oscillator on a moving belt.

Importing the package registers its environments with Gymnasium; everything else is loaded when first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from sd_friction_env.environments.ids import ARGUMENTS, ENVIRONMENT_IDS

if TYPE_CHECKING:  # what __getattr__ below loads when first used, spelled out for type checkers
    from sd_friction_env.control import observed, observers, policies
    from sd_friction_env.control.policies import load_policy
    from sd_friction_env.control.pretrained import load_pretrained
    from sd_friction_env.environments.batch import SDFrictionVectorEnv
    from sd_friction_env.environments.callbacks import AnnealedExploration
    from sd_friction_env.environments.differentiable import jax_step, torch_step
    from sd_friction_env.environments.jacobian import StepJacobian, return_with_gradient, step_with_jacobian
    from sd_friction_env.environments.sb3 import SDFrictionVecEnv
    from sd_friction_env.environments.single import SDFrictionEnv
    from sd_friction_env.environments.states import EnvState
    from sd_friction_env.environments.task import Task
    from sd_friction_env.environments.wrappers import ScaledReward
    from sd_friction_env.physics import forced, shocks, signals, sweeps, theory
    from sd_friction_env.physics.basins import Basins, basin_grid
    from sd_friction_env.physics.charts import stability_chart
    from sd_friction_env.physics.curves import amplitude_curve, attractor_curves
    from sd_friction_env.physics.laws import (
        Asymmetric,
        check_friction_law,
        check_spring_law,
        friction_law,
        friction_table,
        spring_law,
        tabulated_friction,
    )
    from sd_friction_env.physics.orbits import (
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
    from sd_friction_env.physics.parameters import OscillatorParameters
    from sd_friction_env.physics.rigs import read_rig
    from sd_friction_env.physics.simulation import Trajectory, simulate
    from sd_friction_env.physics.tables import Table
    from sd_friction_env.pictures import plotting

__version__ = "0.1.0"

_PUBLIC = {
    "load_policy": "control.policies",
    "load_pretrained": "control.pretrained",
    "SDFrictionVectorEnv": "environments.batch",
    "AnnealedExploration": "environments.callbacks",
    "jax_step": "environments.differentiable",
    "torch_step": "environments.differentiable",
    "StepJacobian": "environments.jacobian",
    "return_with_gradient": "environments.jacobian",
    "step_with_jacobian": "environments.jacobian",
    "SDFrictionVecEnv": "environments.sb3",
    "EnvState": "environments.states",
    "SDFrictionEnv": "environments.single",
    "Task": "environments.task",
    "ScaledReward": "environments.wrappers",
    "Basins": "physics.basins",
    "basin_grid": "physics.basins",
    "stability_chart": "physics.charts",
    "amplitude_curve": "physics.curves",
    "attractor_curves": "physics.curves",
    "Asymmetric": "physics.laws",
    "check_friction_law": "physics.laws",
    "check_spring_law": "physics.laws",
    "friction_law": "physics.laws",
    "friction_table": "physics.laws",
    "spring_law": "physics.laws",
    "tabulated_friction": "physics.laws",
    "ContactLossError": "physics.orbits",
    "CriticalBeltSpeeds": "physics.orbits",
    "Equilibrium": "physics.orbits",
    "LimitCycle": "physics.orbits",
    "OrbitError": "physics.orbits",
    "attractors": "physics.orbits",
    "critical_belt_speeds": "physics.orbits",
    "equilibria": "physics.orbits",
    "first_lyapunov_coefficient": "physics.orbits",
    "limit_cycle": "physics.orbits",
    "slip_cycles": "physics.orbits",
    "stick_intervals": "physics.orbits",
    "OscillatorParameters": "physics.parameters",
    "read_rig": "physics.rigs",
    "Trajectory": "physics.simulation",
    "simulate": "physics.simulation",
    "Table": "physics.tables",
}
_MODULES = {
    "forced": "physics.forced",
    "observed": "control.observed",
    "observers": "control.observers",
    "plotting": "pictures.plotting",
    "policies": "control.policies",
    "shocks": "physics.shocks",
    "signals": "physics.signals",
    "sweeps": "physics.sweeps",
    "theory": "physics.theory",
}
__all__ = [
    "ENVIRONMENT_IDS",
    "AnnealedExploration",
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
    "SDFrictionVecEnv",
    "SDFrictionVectorEnv",
    "ScaledReward",
    "StepJacobian",
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
    "forced",
    "friction_law",
    "friction_table",
    "jax_step",
    "limit_cycle",
    "load_policy",
    "load_pretrained",
    "observed",
    "observers",
    "plotting",
    "policies",
    "read_rig",
    "return_with_gradient",
    "shocks",
    "signals",
    "simulate",
    "slip_cycles",
    "spring_law",
    "stability_chart",
    "step_with_jacobian",
    "stick_intervals",
    "sweeps",
    "tabulated_friction",
    "theory",
    "torch_step",
]

for _id, _arguments in ARGUMENTS.items():
    register(
        id=_id,
        entry_point="sd_friction_env.environments.single:SDFrictionEnv",
        vector_entry_point="sd_friction_env.environments.batch:SDFrictionVectorEnv",
        kwargs=_arguments,
    )


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value: Any = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    elif name in _PUBLIC:
        value = getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
