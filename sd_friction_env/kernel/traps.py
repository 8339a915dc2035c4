"""Traps: states of slip that certainly tend to a stable equilibrium."""

import math

from sd_friction_env.kernel.codes import SLIP_BACKWARD
from sd_friction_env.kernel.compilation import compiled, entry
from sd_friction_env.kernel.forces import normal_force, slip_acceleration
from sd_friction_env.kernel.plant import State, steady

TRAP_POINTS, TRAP_REFINEMENTS = 600, 5  # distances from a node at which its trap is seen to hold, and finer ones

# A row of ``traps`` says which states certainly tend to a stable equilibrium.
(TRAP_X, TRAP_BALL, TRAP_SLOPE, TRAP_LEFT, TRAP_RIGHT), TRAP_ROW = range(5), 5


@compiled
def _hems_in(plant, v_belt, centre, slope, side, s):
    """Whether, at a distance s to one side of a node, the line v = -slope (x - centre) hems in slip that nears it."""
    belt = steady(v_belt)
    x = centre + side * s
    v = -side * slope * s
    if normal_force(plant, x) <= 0.0 or side * slip_acceleration(plant, SLIP_BACKWARD, State(x, 0.0), belt) >= 0.0:
        return False
    if v >= v_belt:
        return slip_acceleration(plant, SLIP_BACKWARD, State(x, v_belt), belt) <= 0.0
    return slope * slope * s - side * slip_acceleration(plant, SLIP_BACKWARD, State(x, v), belt) <= 0.0


@entry
def trap_extent(plant, v_belt, centre, slope, side, nearest, farthest):
    """Return how far to one side of a node the line v = -slope (x - centre) hems slip in.

    Below the line a mass that nears the node cannot pass it: there the flow crosses the line towards v = 0, and v = 0
    towards the line. Where the line is above the belt's speed, the mass must not land on the belt either.
    """
    low = 0.0
    high = nearest
    ratio = math.exp(math.log(farthest / nearest) / TRAP_POINTS)
    while high <= farthest and _hems_in(plant, v_belt, centre, slope, side, high):
        low = high
        high = high * ratio
    if low == 0.0 or high > farthest:
        return low
    for _ in range(TRAP_REFINEMENTS):
        step = (high - low) / 32.0
        for _ in range(31):
            if not _hems_in(plant, v_belt, centre, slope, side, low + step):
                break
            low = low + step
        high = low + step
    return low


@compiled
def trap_of(traps, mode, x, v):
    """Return which of the ``traps`` (m, TRAP_ROW) holds a state of slip, or -1."""
    if mode != SLIP_BACKWARD:
        return -1
    for i in range(len(traps)):
        ahead = traps[i, TRAP_X] - x
        ball = traps[i, TRAP_BALL]
        if abs(ahead) < ball and abs(v) < ball:
            return i
        extent = traps[i, TRAP_LEFT] if ahead > 0.0 else traps[i, TRAP_RIGHT]
        if abs(ahead) <= extent and v * ahead >= 0.0 and abs(v) <= traps[i, TRAP_SLOPE] * abs(ahead):
            return i
    return -1
