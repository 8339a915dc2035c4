"""Equilibria, limit cycles and critical belt speeds of the passive oscillator, found as roots and closed loops.

A trajectory that sticks forgets its past, so a stick-slip cycle closes as soon as a breakaway point repeats. A
pure-slip cycle is a fixed point of the map from one maximum of x to the next. Neither needs a long transient, which
matters near the end of oscillation, where transients decay ever more slowly.
"""

from sd_friction_env.physics.orbits.balance import (
    Equilibrium,
    balance_points,
    equilibria,
    rest_place,
    stick_intervals,
    traps_of,
)
from sd_friction_env.physics.orbits.boundaries import GrazingMap, NoBorderError, grazing_map
from sd_friction_env.physics.orbits.critical import (
    CriticalBeltSpeeds,
    critical_belt_speeds,
    first_lyapunov_coefficient,
    grazing_belt_speed,
    hopf_belt_speed,
)
from sd_friction_env.physics.orbits.cycles import ContactLossError, LimitCycle, OrbitError
from sd_friction_env.physics.orbits.limits import (
    SlipLimit,
    attractors,
    limit_cycle,
    limit_of_motion,
    limits_of_slip,
    same_motion,
    slip_cycles,
)
from sd_friction_env.physics.orbits.return_map import ReturnMap, Section, sections

__all__ = [
    "ContactLossError",
    "CriticalBeltSpeeds",
    "Equilibrium",
    "GrazingMap",
    "LimitCycle",
    "NoBorderError",
    "OrbitError",
    "ReturnMap",
    "Section",
    "SlipLimit",
    "attractors",
    "balance_points",
    "critical_belt_speeds",
    "equilibria",
    "first_lyapunov_coefficient",
    "grazing_belt_speed",
    "grazing_map",
    "hopf_belt_speed",
    "limit_cycle",
    "limit_of_motion",
    "limits_of_slip",
    "rest_place",
    "same_motion",
    "sections",
    "slip_cycles",
    "stick_intervals",
    "traps_of",
]
