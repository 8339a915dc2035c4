"""The plant, its state and its drive: what the equations of motion need."""

from typing import Any, NamedTuple

from sd_friction_env.kernel.compilation import in_lanes


class Plant(NamedTuple):
    """The laws by type, and the numbers of Eq. 4 that belong to none of them.

    ``spring``, ``friction`` and ``excitation`` are NamedTuples with methods, see :mod:`sd_friction_env.kernel.laws`.
    """

    spring: Any
    friction: Any
    excitation: Any
    g1: float  # weight
    beta: float  # damping ratio


class State(NamedTuple):
    """Position and velocity of the mass."""

    x: float
    v: float


class Drive(NamedTuple):
    """What is held over an interval: the belt's speed at its start, the belt's acceleration and the control force."""

    v_belt: float
    a_belt: float
    u: float


@in_lanes
def at_time(plant, t):
    """Advance the plant's clock by t."""
    return Plant(plant.spring, plant.friction, plant.excitation.at_time(t), plant.g1, plant.beta)


@in_lanes
def with_spring(plant, spring):
    """Replace the spring."""
    return Plant(spring, plant.friction, plant.excitation, plant.g1, plant.beta)


@in_lanes
def select_field(plant, x, v):
    """Freeze the spring's field to the side on which a mass is, or to which it moves; x, v in the belt's frame."""
    excitation = plant.excitation
    spring = plant.spring.select_field(excitation.lab_position(x), excitation.lab_velocity(v))
    return Plant(spring, plant.friction, excitation, plant.g1, plant.beta)


@in_lanes
def drive_at(drive, t):
    """Return the drive after a time t."""
    return Drive(drive.v_belt + drive.a_belt * t, drive.a_belt, drive.u)


@in_lanes
def steady(v_belt):
    """Return the drive of a steady belt alone."""
    return Drive(v_belt, 0.0, 0.0)
