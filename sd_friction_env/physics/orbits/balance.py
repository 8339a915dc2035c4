"""Balance of forces: steady-slip equilibria and their stability, stick intervals, and what slip conserves."""

import cmath
import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.parameters import EXCITATIONS, STATE_LIMIT, OscillatorParameters
from sd_friction_env.physics.theory import FloatArray, cubic_wells, exact_wells

SMALLEST_RADIUS = 1e-7  # smaller orbits about an equilibrium count as the equilibrium, relative to max(1, |x|)

_FRICTION_SPEEDS = np.geomspace(1e-6, 100.0, 200).tolist()  # at which the slope of friction is sampled
_OWN_SPRING_REACH = 10.0  # |x| up to which balance points of a user's spring are searched
_LEVEL_STIFFNESS = 1e-9  # below it the forces at a distance of _LEVEL_STEP decide which way they lead
_LEVEL_STEP = 1e-4


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """A steady-slip equilibrium: the mass stands still while the belt slides under it (Eq. 11).

    Attributes:
        x: its position.
        eigenvalues: of the linearised slip motion.
        stable: whether both eigenvalues have negative real parts.
    """

    x: float
    eigenvalues: tuple[complex, complex]
    stable: bool

    @property
    def stiffness(self) -> float:
        """Stiffness of small deviations: the product of the eigenvalues."""
        return (self.eigenvalues[0] * self.eigenvalues[1]).real

    @property
    def damping(self) -> float:
        """Damping of small deviations: minus the sum of the eigenvalues."""
        return -(self.eigenvalues[0] + self.eigenvalues[1]).real

    @property
    def has_roundoff_damping(self) -> bool:
        """Whether the damping is within rounding of zero, so that its sign decides nothing."""
        return abs(self.damping) <= 1e-13 * max(abs(value) for value in self.eigenvalues)

    @property
    def capture_radius(self) -> float:
        """Radius below which orbits about the equilibrium count as the equilibrium."""
        return SMALLEST_RADIUS * max(1.0, abs(self.x))


def find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function changes sign between two arguments (Brent's method)."""
    from scipy.optimize import brentq  # deferred: environments start without it

    return float(brentq(function, low, high, xtol=1e-15, rtol=1e-14))


def check_unexcited(parameters: OscillatorParameters) -> None:
    """Raise ValueError if a force, a ripple or a modulated stiffness acts."""
    if parameters.excited:
        amplitudes = {f"{kind}_amplitude": getattr(parameters, f"{kind}_amplitude") for kind in EXCITATIONS}
        acting = ", ".join(f"{name} = {value!r}" for name, value in amplitudes.items() if value > 0.0)
        raise ValueError(
            f"parameters must be without excitation here (all amplitudes 0), got {acting}: "
            "see sd_friction_env.physics.forced, or take parameters.unexcited"
        )


# Balance points -------------------------------------------------------------------------------------------------------


def balance_points(parameters: OscillatorParameters, load: float, coefficient: float) -> list[float]:
    """Return every x with load + R(x) = coefficient N(x), in ascending order.

    With load 0 and the kinetic coefficient these are the steady-slip equilibria (Eq. 11); with load 2 beta v_b and
    +-mu_s they are the ends of the stick intervals (Eq. 8, corrected). Of a user's spring they are searched within
    |x| <= 10 on a grid of step 0.005: two that are closer to each other are missed.
    """
    push = coefficient * parameters.g1 - load
    if parameters.geometry == "linear":
        return [push]
    if parameters.discontinuous:
        # Where the jump of R at x = 0 passes the balance there is no point to stand on; `stick_intervals` handles it.
        return sorted(push + side for side in (-1.0, 1.0) if (push + side) * side > 0.0)
    spring, g1 = parameters.plant.spring, parameters.g1

    def error(x: float) -> float:
        return float(load + spring.restoring_force(x) - coefficient * spring.normal_force(g1, x))

    if parameters.geometry in ("exact", "cubic", "duffing"):
        return _polynomial_roots(parameters, load, coefficient, error)
    places = np.linspace(-_OWN_SPRING_REACH, _OWN_SPRING_REACH, 4001).tolist()
    values = [error(x) for x in places]
    points = [x for x, value in zip(places, values, strict=True) if value == 0.0]
    for (low, high), (first, last) in zip(itertools.pairwise(places), itertools.pairwise(values), strict=True):
        if first * last < 0.0:
            points.append(find_root(error, low, high))
    return sorted(points)


def _balance_polynomial(parameters: OscillatorParameters, load: float, coefficient: float) -> list[float]:
    """Return a polynomial whose roots include the balance points, highest power first."""
    alpha, g1 = parameters.alpha, parameters.g1
    square = alpha * alpha
    if parameters.geometry == "duffing":
        return [parameters.kappa, 0.0, parameters.linear_stiffness, load - coefficient * g1]
    if parameters.geometry == "cubic":
        constant = load - coefficient * (g1 - alpha + 1.0)
        return [0.5 / (square * alpha), 0.5 * coefficient / square, 1.0 - 1.0 / alpha, constant]
    # (x - c) s = x + d with s = sqrt(x^2 + alpha^2); squared, a quartic with foreign roots among its own
    c, d = coefficient * (g1 - alpha) - load, coefficient * alpha
    return [1.0, -2.0 * c, c * c + square - 1.0, -2.0 * (c * square + d), c * c * square - d * d]


def _polynomial_roots(
    parameters: OscillatorParameters, load: float, coefficient: float, error: Callable[[float], float]
) -> list[float]:
    spring, g1 = parameters.plant.spring, parameters.g1
    points: list[float] = []
    for root in np.roots(_balance_polynomial(parameters, load, coefficient)).tolist():
        if abs(root.imag) > 1e-6 * max(1.0, abs(root.real)):
            continue
        x = at = root.real
        for _ in range(8):
            at = x
            slope = spring.restoring_slope(x) - coefficient * spring.normal_slope(x)
            if slope == 0.0:
                break
            step = error(x) / slope
            x -= step
            if abs(step) < 1e-15 * max(1.0, abs(x)):
                break
        # Squaring and a wandering Newton iteration can both bring in roots that are none, or one twice.
        size = 1.0 + abs(load) + abs(spring.restoring_force(at)) + abs(coefficient * spring.normal_force(g1, at))
        near = abs(x - root.real) < 1e-3 * max(1.0, abs(x))
        if abs(error(at)) < 1e-9 * size and near and all(abs(x - other) > 1e-9 for other in points):
            points.append(x)
    return sorted(points)


def rest_place(parameters: OscillatorParameters) -> float:
    """Return the (right-hand) rest position of the unloaded spring: R(x) = 0 with R'(x) > 0."""
    if parameters.geometry not in ("exact", "cubic", "linear"):
        spring = parameters.plant.spring
        return max((x for x in balance_points(parameters, 0.0, 0.0) if spring.restoring_slope(x) > 0.0), default=0.0)
    wells = {"exact": exact_wells, "cubic": cubic_wells}.get(parameters.geometry)  # alpha = 0 rests at 1
    return wells(parameters.alpha)[-1] if wells else 0.0


def stick_intervals(parameters: OscillatorParameters) -> list[tuple[float, float]]:
    """Return the intervals of x in which a mass can stick, |2 beta v_b + R(x)| <= mu_s N(x), in ascending order."""
    check_unexcited(parameters)
    load = 2.0 * parameters.beta * parameters.belt_speed
    plant, belt = parameters.plant, kernel.Drive(parameters.belt_speed, 0.0, 0.0)
    ends = [
        x
        for side in (-1, 1)
        for x in balance_points(parameters, load, side * plant.friction.breakaway_coefficient(-side))
    ]
    if parameters.discontinuous:
        ends.append(0.0)  # the stick load jumps there, and an interval may end or be passed through
    ends.sort()
    intervals: list[tuple[float, float]] = []
    for low, high in itertools.pairwise(ends):
        if kernel.mode_at_zero_v_rel(plant, 0.5 * (low + high), belt) == kernel.STICK:
            if intervals and intervals[-1][1] == low:
                low = intervals.pop()[0]
            intervals.append((low, high))
    return intervals


# Steady slip ----------------------------------------------------------------------------------------------------------


def equilibria(parameters: OscillatorParameters) -> list[Equilibrium]:
    """Return the steady-slip equilibria (v_rel = -v_b) with contact, in ascending order of x; none if v_b = 0.

    Source: Eq. 11 for the cubic geometry; the same balance of forces for the others.

    Raises:
        ValueError: if the oscillator is excited.
    """
    check_unexcited(parameters)
    speed = parameters.belt_speed
    if speed == 0.0:
        return []
    plant = parameters.plant
    coefficient = -float(plant.friction.coefficient(kernel.SLIP_BACKWARD, -speed))
    found = []
    for x in balance_points(parameters, 0.0, coefficient):
        if kernel.normal_force(plant, x) <= 0.0:
            continue
        stiffness, damping, _ = slip_slopes(plant, kernel.SLIP_BACKWARD, x, -speed)
        root = cmath.sqrt(damping * damping - 4.0 * stiffness)
        pair = (0.5 * (-damping + root), 0.5 * (-damping - root))
        found.append(Equilibrium(x=x, eigenvalues=pair, stable=damping > 0.0 and stiffness > 0.0))
    return found


class SlipSlopes(NamedTuple):
    """How the acceleration in slip changes: by -stiffness dx - damping dv + grip dv_belt."""

    stiffness: float
    damping: float
    grip: float


def slip_slopes(plant: Any, mode: int, x: float, v_rel: float) -> SlipSlopes:
    """Return how the acceleration of an unexcited plant changes in slip at x and a relative velocity."""
    mu, slope = plant.friction.coefficient(mode, v_rel), plant.friction.slope(mode, v_rel)
    stiffness = kernel.restoring_slope(plant, x) + mu * kernel.normal_slope(plant, x)
    grip = slope * kernel.normal_force(plant, x)
    return SlipSlopes(float(stiffness), float(2.0 * plant.beta + grip), float(grip))


@functools.lru_cache(maxsize=256)
def _friction_slopes(parameters: OscillatorParameters) -> FloatArray:
    friction = parameters.plant.friction
    return np.array([friction.slope(mode, mode * speed) for mode in (-1, 1) for speed in _FRICTION_SPEEDS])


def conserves_energy(parameters: OscillatorParameters) -> bool:
    """Return whether slip on one side of the belt's speed conserves energy: beta = 0 and level friction."""
    return parameters.beta == 0.0 and bool((_friction_slopes(parameters) == 0.0).all())


def slip_dissipates(parameters: OscillatorParameters) -> bool:
    """Return whether every slip contracts, so that none is a cycle: damping, or friction that rises with speed."""
    return bool((_friction_slopes(parameters) >= 0.0).all()) and not conserves_energy(parameters)


def is_centre(parameters: OscillatorParameters, equilibrium: Equilibrium) -> bool:
    """Return whether forces lead back to an equilibrium from both sides, so that slip can circle it or creep in."""
    if abs(equilibrium.stiffness) > _LEVEL_STIFFNESS:
        return equilibrium.stiffness > 0.0
    plant, drive = parameters.plant, kernel.Drive(parameters.belt_speed, 0.0, 0.0)
    left, right = (
        kernel.slip_acceleration(
            plant, kernel.SLIP_BACKWARD, kernel.State(equilibrium.x + side * _LEVEL_STEP, 0.0), drive
        )
        for side in (-1, 1)
    )
    return bool(left > 0.0 > right)


def search_radius(parameters: OscillatorParameters, equilibrium: Equilibrium) -> float:
    """Return a distance from an equilibrium that no slip from an accepted start exceeds."""
    return 4.0 * (2.0 * STATE_LIMIT + abs(equilibrium.x) + parameters.belt_speed)


@functools.lru_cache(maxsize=256)
def traps_of(parameters: OscillatorParameters) -> FloatArray:
    """Return regions whose states are sure to end at an attracting equilibrium: rows as ``kernel.trap_of`` reads them.

    A node is approached without a maximum of x, so the return map does not see it; a line in the phase plane bounds
    its trap instead. Where slip conserves energy, the trap of a centre is only the ball that counts as it.
    """
    plant, rows = parameters.plant, []
    for e in equilibria(parameters):
        centre = is_centre(parameters, e)
        stable = centre and e.damping > 0.0 and not e.has_roundoff_damping
        if not stable and not (centre and conserves_energy(parameters)):
            continue
        ball, level = e.capture_radius, e.stiffness <= _LEVEL_STIFFNESS
        rows.append((e.x, ball, 0.0, 0.0, 0.0))
        if stable and e.eigenvalues[0].imag == 0.0:
            # Of all lines the first needs the least damping far out, the second lets the spring stiffen most.
            for slope in (math.sqrt(max(e.stiffness, 0.0)), 0.5 * e.damping)[level:]:
                nearest, farthest = _LEVEL_STEP if level else 0.1 * ball, 2.0 * search_radius(parameters, e)
                extents = (
                    kernel.trap_extent(plant, parameters.belt_speed, e.x, slope, side, nearest, farthest)
                    for side in (-1.0, 1.0)
                )
                rows.append((e.x, ball, slope, *extents))
    return np.array(rows, dtype=np.float64).reshape(len(rows), kernel.TRAP_ROW)
