r"""The map of a forced orbit at a sliding bifurcation: the leading term by which a new arc changes it.

Time is counted from the event, in the belt's frame, where stick is w = v - v_b = 0. E is the excess over the stick
cone on the side of a slip of mode m (-1 backward, 1 forward), so that m w' = E at w = 0; r is its slope along the
stick. What the vanishing arc adds to the motion without it:

- grazing-sliding: m w > 0 would fall to -d; it sticks at 0 instead: w changes by m d.
- crossing-sliding: E = -d on arrival, r > 0. A slip would have m w = -d t + r t^2/2, at least -d^2/(2 r) where E = 0;
  the stick ends there with w = 0: w changes by m d^2/(2 r).
- switching-sliding: E = d on arrival, r < 0. The slip m w = d t + r t^2/2 returns at t = -2 d/r, by when the mass is
  ahead of the stuck one: x changes by m 2 d^3/(3 r^2).
- adding-sliding: E = d - k t^2/2 in stick. The slip from t = -s to 2 s, s = sqrt(2 d/k), moves x by m 9 d^2/(2 k).

The orders are those of di Bernardo, Kowalczyk and Nordmark (2002), Physica D 170, 175-205. The tangent flow from the
section to the event gives d, and from the event to the section what becomes of the change.
"""

from typing import NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.continuation import FloatArray
from sd_friction_env.physics.forced.branches import Arc, OrbitProblem, shortest_arc, sliding_kind
from sd_friction_env.physics.forced.orbits import ForcedOrbit
from sd_friction_env.physics.orbits.boundaries import grazes_at_breakaway
from sd_friction_env.physics.parameters import RANGES, brief_repr

# The leading order in which the maps on both sides of a sliding bifurcation differ, and how many arcs a lap gains.
LOCAL_MAPS = {
    "grazing-sliding": (1, 2),
    "crossing-sliding": (2, 1),
    "adding-sliding": (2, 2),
    "switching-sliding": (3, 1),
}

_AT_BIFURCATION = 1e-6  # greatest condition, in speed or force, of an orbit at one
_STEPS = (1e-10, 1e-9, 1e-8, 1e-7)  # in x or v, from the orbit to the maps on both sides
_APART = 1e-6  # from an event, in time: the tangents are taken before and after it
_DIFFERENCE = 1e-4  # in time, of the slope of E


class SlidingMap(NamedTuple):
    """The stroboscopic map around an orbit at a sliding bifurcation, for small changes (dx, dv) of its section point.

    Where d = ``by`` @ (dx, dv) > 0 a lap has one arc more (two where a stick is cut), and ends ``coefficient`` *
    d**``order`` apart from the smooth map of d <= 0, plus higher orders.

    Attributes:
        kind: of the bifurcation.
        order: leading order of the difference.
        by: gradient of d, (2,); d in speed at a grazing-sliding, else in acceleration.
        coefficient: (2,), of x and v.
        phase: of the section, in slip, a share of the excitation's cycle.
        x, v: the section point, in the lab's frame.
    """

    kind: str
    order: int
    by: FloatArray
    coefficient: FloatArray
    phase: float
    x: float
    v: float


def sliding_map(orbit: ForcedOrbit) -> SlidingMap:
    """Return the leading term of the map at a sliding bifurcation, as :func:`follow_orbit` locates it.

    Raises:
        TypeError: if the orbit is not a ForcedOrbit.
        ValueError: if it is not at a sliding bifurcation, or friction is not continuous at rest: the map jumps there.
        OrbitError: if it has no slip.
    """
    if not isinstance(orbit, ForcedOrbit):
        raise TypeError(f"orbit must be a ForcedOrbit, see forced_orbit, got {brief_repr(orbit)}")
    p = orbit.parameters
    if not all(grazes_at_breakaway(p.excited_plant(0.0), mode) for mode in (kernel.SLIP_BACKWARD, kernel.SLIP_FORWARD)):
        raise ValueError(f"friction must be continuous at rest, or the map jumps at a sliding bifurcation, got {p}")
    start = np.array([orbit.x, orbit.v, p.beta])
    problem = OrbitProblem(orbit, "beta", RANGES["beta"], orbit.phase / orbit.multiple)
    problem, y, _ = problem.moved(start, np.zeros(3))
    kind, (before, arc, after), shorter = _new_arc(problem, y)
    mode = arc.mode or after.mode  # of the slip on whose side of the cone the event lies
    time = arc.begin + (arc.end - arc.begin) * {"grazing-sliding": 1.0, "adding-sliding": 1.0 / 3.0}.get(kind, 0.0)
    dx, dv = _tangent(problem, shorter, 0.0, time - _APART)
    to_end = _tangent(problem, shorter, arc.end + _APART, problem.duration(y))

    plant, belt = kernel.at_time(problem.shifted(y).excited_plant(0.0), time), kernel.steady(p.belt_speed)
    x = plant.excitation.to_belt_frame(*_state(problem, shorter, time), p.belt_speed)[0]
    plant = kernel.select_field(plant, x, p.belt_speed)
    place = plant.excitation.lab_position(x)
    by_x = -mode * kernel.restoring_slope(plant, place)
    by_x -= plant.friction.breakaway_coefficient(mode) * kernel.normal_slope(plant, place)
    rate = kernel.cone_excess(plant, -mode, x, belt, 0.0)[1]
    arriving = kernel.slip_acceleration(plant, before.mode, kernel.State(x, p.belt_speed), belt)
    match kind:
        case "grazing-sliding":
            by, change = -mode * dv, np.array([0.0, mode])
        case "crossing-sliding":
            by, change = rate / arriving * dv - by_x * dx, np.array([0.0, mode / (2.0 * rate)])
        case "switching-sliding":
            by, change = by_x * dx - rate / arriving * dv, np.array([mode * 2.0 / (3.0 * rate * rate), 0.0])
        case _:
            slopes = [kernel.cone_excess(plant, -mode, x, belt, t)[1] for t in (-_DIFFERENCE, _DIFFERENCE)]
            curvature = (slopes[0] - slopes[1]) / (2.0 * _DIFFERENCE)
            by, change = by_x * dx, np.array([mode * 9.0 / (2.0 * curvature), 0.0])
    phase = problem.share * orbit.multiple % 1.0
    return SlidingMap(kind, LOCAL_MAPS[kind][0], by, to_end @ change, phase, float(y[0]), float(y[1]))


def _new_arc(problem: OrbitProblem, y: FloatArray) -> tuple[str, list[Arc], FloatArray]:
    """Return the kind of the bifurcation, the new arc between its neighbours, and a state beside y without it."""
    for step in _STEPS:
        for way in (*np.eye(2, 3), *-np.eye(2, 3)):
            arcs = problem.arcs(y + step * way)
            i = shortest_arc(arcs)
            kind, condition = sliding_kind(arcs)
            shorter = y - step * way
            located = kind in LOCAL_MAPS and condition < _AT_BIFURCATION
            if located and len(arcs) - len(problem.arcs(shorter)) == LOCAL_MAPS[kind][1]:
                return kind, arcs[i - 1 : i + 2], shorter
    raise ValueError(
        "orbit must be at one sliding bifurcation, as follow_orbit locates it (a symmetric orbit meets two at once), "
        f"got {brief_repr(problem.orbit)}"
    )


def _state(problem: OrbitProblem, y: FloatArray, time: float) -> tuple[float, float]:
    """Return the state (x, v) of an orbit at a time from the section on."""
    end = problem.lap(y, np.empty((kernel.TANGENT_ROWS, 0)), None, time / problem.duration(y))
    return end.x, end.v


def _tangent(problem: OrbitProblem, y: FloatArray, begin: float, end: float) -> FloatArray:
    """Return the derivative of the state at one time of an orbit by that at another, (2, 2)."""
    duration = problem.duration(y)
    there = OrbitProblem(problem.orbit, problem.name, problem.limits, problem.share + begin / duration)
    tangents = np.eye(kernel.TANGENT_ROWS, 2)
    there.lap(np.array([*_state(problem, y, begin), y[2]]), tangents, None, (end - begin) / duration)
    return tangents[:2]
