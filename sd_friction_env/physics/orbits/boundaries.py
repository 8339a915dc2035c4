"""The borders of stick-slip and of steady slip as equations in two parameters, and the return map at the graze.

Each is a :class:`continuation.Problem`. Its last two unknowns are the values of two parameters; derivatives by them are
exact, as those by the state (:mod:`sd_friction_env.kernel.sensitivity`), unless a user-defined law has none: then they
are central differences.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.kernel.plant_gradients import contact_gradient, external_gradient
from sd_friction_env.physics.continuation import BranchEndError, correct
from sd_friction_env.physics.laws import missing_gradient
from sd_friction_env.physics.orbits.balance import balance_points, check_unexcited, equilibria, slip_slopes
from sd_friction_env.physics.orbits.critical import grazing_belt_speed, hopf_belt_speed, lyapunov_coefficient
from sd_friction_env.physics.orbits.limits import slip_cycles
from sd_friction_env.physics.parameters import OscillatorParameters, plant_derivative, plant_of
from sd_friction_env.physics.theory import FloatArray

_BEFORE_LANDING = 1e-5  # time before a landing at which an orbit that overshoots is left
_LONGEST_EXTENSION = 1.0  # time by which such an orbit is extended as if it did not land
_LONGEST_ORBIT = 300.0
_LEAST_CYCLE = 1e-2  # acceleration at its greatest x below which a fold is taken to be a Bautin point
_DIFFERENCE = 1e-5  # relative step of differences
_STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -2.0 / 3.0), (1.0, 2.0 / 3.0), (2.0, -1.0 / 12.0))  # fourth order


class NoBorderError(ValueError):
    """A plant has no such border; the message says why."""


class End(NamedTuple):
    """An orbit at a time: the state, the acceleration, its rate of change, and the derivatives of (v, a) by columns."""

    x: float
    v: float
    a: float
    jerk: float
    by: FloatArray  # (3, columns): of x, v and a


class Border:
    """What the borders share: the plant at values of the parameters, and derivatives by those."""

    def __init__(self, parameters: OscillatorParameters, names: tuple[str, ...], scale: FloatArray) -> None:
        check_unexcited(parameters)
        self.parameters, self.names, self.scale = parameters, names, scale
        self.exact = all(
            "." not in name or missing_gradient(getattr(parameters, name.partition(".")[0])) is None for name in names
        )

    def values(self, y: FloatArray) -> dict[str, Any]:
        """Return the oscillator's numbers at y."""
        return self.parameters.values | dict(zip(self.names, y[-len(self.names) :].tolist(), strict=True))

    def at(self, y: FloatArray) -> tuple[Any, float]:
        """Return the plant and the belt speed at y."""
        values = self.values(y)
        return plant_of(self.parameters.kind, values), values["belt_speed"]

    def oscillator(self, y: FloatArray) -> OscillatorParameters:
        """Return the oscillator at y.

        Raises:
            BranchEndError: if its parameters are not valid.
        """
        try:
            return self.parameters.replace(**dict(zip(self.names, y[-len(self.names) :].tolist(), strict=True)))
        except ValueError as error:
            raise BranchEndError(str(error)) from None

    def directions(self, y: FloatArray) -> FloatArray:
        """Return the derivatives of the plant's numbers by the parameters, (parameters, numbers): a complex step."""
        values = self.values(y)
        kind, like = self.parameters.kind, self.parameters.plant
        return np.array([plant_derivative(kind, values, name, like) for name in self.names])

    def residual(self, y: FloatArray) -> FloatArray:
        """Return the residual of the border's equations at y."""
        raise NotImplementedError

    def by_differences(self, y: FloatArray, column: int) -> FloatArray:
        """Return a column of the Jacobian by differences."""
        step = np.zeros_like(y)
        step[column] = _DIFFERENCE * max(1e-3, abs(y[column]))
        parts = [weight * self.residual(y + part * step) for part, weight in _STENCIL]
        return np.asarray(np.sum(parts, axis=0) / step[column], dtype=np.float64)

    def orbit(
        self,
        y: FloatArray,
        x: float,
        v: float,
        time: float,
        events: int,
        seeds: FloatArray | None = None,
        parameters: int = 0,
    ) -> End:
        """Return the slip from (x, v) at a time; after so many ``events`` the belt's speed is passed as if v_rel kept
        its sign.

        Args:
            seeds: (2, columns), the changes of x and v at the start.
            parameters: number of the last columns that belong to the first parameters.

        Raises:
            BranchEndError: if the mass sticks long before, or contact is lost.
        """
        if not 0.0 < time < _LONGEST_ORBIT:
            raise BranchEndError(f"the orbit takes longer than {_LONGEST_ORBIT:g}: it passes ever closer to a saddle")
        plant, speed = self.at(y)
        state, belt = kernel.State(x, v), kernel.steady(speed)
        sample, met = np.empty((1, 4)), np.empty((kernel.MAX_EVENTS, 4))
        traced = kernel.trace(plant, kernel.SLIP_BACKWARD, state, belt, np.array([time]), sample, met)
        lands = traced.events > events
        if traced.status != kernel.OK or traced.events < events:
            what = "loses contact" if traced.status == kernel.CONTACT_LOST else "crosses the belt's speed another time"
            raise BranchEndError(f"the orbit {what}")
        if lands and time - met[events, 0] > _LONGEST_EXTENSION:
            raise BranchEndError("the orbit sticks before it is closed")
        mode = kernel.SLIP_BACKWARD if events % 2 == 0 else kernel.SLIP_FORWARD
        columns, changes = 0 if seeds is None else seeds.shape[1], None
        if seeds is None:
            until = met[events, 0] if lands else time
            end = (met[events, 2], speed) if lands else tuple(sample[0, :2].tolist())
        else:
            until = met[events, 0] - _BEFORE_LANDING if lands else time
            of_plant = [i for i, name in enumerate(self.names[:parameters]) if name != "belt_speed" and self.exact]
            first = columns - parameters
            last = [first + i for i in of_plant]  # the kernel wants the columns that change the plant there
            order = [i for i in range(columns) if i not in last] + last
            changes = self.directions(y)[of_plant] if last else None
            tangents = np.zeros((kernel.TANGENT_ROWS, columns))
            tangents[[kernel.TANGENT_X, kernel.TANGENT_V]] = seeds[:, order]
            on_belt = np.array([i >= first and self.names[i - first] == "belt_speed" for i in order], dtype=float)
            tangents[kernel.TANGENT_BELT] = on_belt
            motion = kernel.advance_with_tangents(plant, kernel.SLIP_BACKWARD, state, belt, until, tangents, changes)
            end = (motion.x, motion.v)
        place, rest = kernel.State(*end), time - until
        by = np.zeros((3, columns))
        if columns:
            x, w = place.x, place.v - speed
            stiffness, damping, grip = slip_slopes(plant, mode, x, w)
            dx, dv = tangents[[kernel.TANGENT_X, kernel.TANGENT_V]]
            da = -stiffness * dx - damping * dv + grip * on_belt
            if changes is not None:
                mu, by_friction = plant.friction.coefficient(mode, w), plant.friction.coefficient_gradient(mode, w)
                by_numbers = forces_by_numbers(plant, x, place.v, mu, by_friction)
                da[len(order) - len(last) :] -= changes @ by_numbers
            by[:, order] = dx + rest * dv, dv + rest * da, da
        if lands:
            place = _slipped_on(plant, mode, place, belt, rest)
        a = kernel.slip_acceleration(plant, mode, kernel.State(place.x, place.v), belt)
        return End(place.x, place.v, a, kernel.slip_jerk(plant, mode, place.x, place.v, speed, 0.0, a), by)


def _slipped_on(plant: Any, mode: int, place: Any, belt: Any, h: float) -> Any:
    """Return the state after a short slip whose field does not end at the belt's speed: one step of fourth order."""

    def rates(part: float, dx: float, dv: float) -> tuple[float, float]:
        v = place.v + part * h * dv
        return v, kernel.slip_acceleration(plant, mode, kernel.State(place.x + part * h * dx, v), belt)

    k1 = rates(0.0, 0.0, 0.0)
    k2 = rates(0.5, *k1)
    k3 = rates(0.5, *k2)
    k4 = rates(1.0, *k3)
    dx, dv = (h / 6.0 * (a + 2.0 * b + 2.0 * c + d) for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    return kernel.State(place.x + dx, place.v + dv)


def forces_by_numbers(plant: Any, x: float, v: float, mu: float, by_friction: Any) -> FloatArray:
    """Return the derivatives of 2 beta v + R + mu N by the plant's numbers, given those of mu by its law's."""
    external, contact = np.empty((2, len(kernel.leaves_of(plant))))
    external_gradient(plant, x, v, external)
    contact_gradient(plant, mu, by_friction, x, contact)
    return external + contact


class HopfBorder(Border):
    """v_b1: balance of forces, and 2 beta + N mu'(-v_b) = 0, in (x, parameters)."""

    def residual(self, y: FloatArray) -> FloatArray:
        """Return both sides' difference of the two equations."""
        (plant, speed), mode = self.at(y), kernel.SLIP_BACKWARD
        if kernel.normal_force(plant, y[0]) <= 0.0:
            raise BranchEndError("contact is lost at the equilibrium")
        a = kernel.slip_acceleration(plant, mode, kernel.State(y[0], 0.0), kernel.steady(speed))
        return np.array([-a, slip_slopes(plant, mode, y[0], -speed).damping])

    def jacobian(self, y: FloatArray) -> FloatArray:
        """Return the derivatives by (x, parameters)."""
        plant, speed = self.at(y)
        mode, x, spring = kernel.SLIP_BACKWARD, y[0], plant.spring
        mu, slope = plant.friction.coefficient(mode, -speed), plant.friction.slope(mode, -speed)
        normal, normal_slope = spring.normal_force(plant.g1, x), spring.normal_slope(x)
        columns = [np.array([slip_slopes(plant, mode, x, -speed).stiffness, slope * normal_slope])]
        by_speed = np.array([-slope * normal, -plant.friction.curvature(mode, -speed) * normal])
        if self.exact:
            # The derivatives of mu' are those of mu, differentiated by the relative velocity.
            step, of_slope = _DIFFERENCE * 10.0 * (1.0 + speed), np.zeros(1)
            for part, weight in _STENCIL:
                of_coefficient = plant.friction.coefficient_gradient(mode, -speed + part * step)
                of_slope = of_slope + weight / step * np.array(of_coefficient)
            of_trace = np.empty(len(kernel.leaves_of(plant)))
            contact_gradient(plant, slope, tuple(of_slope), x, of_trace)
            of_trace[-1] = 2.0
            of_coefficient = plant.friction.coefficient_gradient(mode, -speed)
            gradients = np.array([forces_by_numbers(plant, x, 0.0, mu, of_coefficient), of_trace])
            changes = self.directions(y)
        for i, name in enumerate(self.names):
            if name == "belt_speed":
                columns.append(by_speed)
            else:
                columns.append(gradients @ changes[i] if self.exact else self.by_differences(y, 1 + i))
        return np.column_stack(columns)

    def period(self, y: FloatArray) -> float:
        """Return the period of small orbits at the Hopf point, NaN where the equilibrium is a saddle."""
        plant, speed = self.at(y)
        stiffness = slip_slopes(plant, kernel.SLIP_BACKWARD, y[0], -speed).stiffness
        return 2.0 * math.pi / math.sqrt(stiffness) if stiffness > 0.0 else math.nan

    def lyapunov(self, y: FloatArray) -> float:
        """Return the first Lyapunov coefficient; at a saddle raise BranchEndError."""
        if not self.period(y) > 0.0:
            raise BranchEndError("the equilibrium is a saddle, which has no Hopf point")
        return lyapunov_coefficient(*self.at(y), y[0])

    def start(self, y: FloatArray) -> FloatArray:
        """Return y with the unknowns of v_b1 at the parameters in y, its belt speed replaced by v_b1."""
        p = self.oscillator(y)
        speed = hopf_belt_speed(p)
        if math.isnan(speed):
            raise NoBorderError("steady slip is stable at every belt speed, 2 beta + N mu'(-v_b) >= 0")
        p = p.replace(belt_speed=speed)
        values = [p.values[name] for name in self.names]
        return correct(self, np.array([equilibria(p)[-1].x, *values]), np.eye(3)[2])


class GrazingBorder(Border):
    """v_b0: the slip from breakaway reaches the belt's speed at no acceleration, in (x of breakaway, time, parameters).

    ``events`` is the number of crossings of the belt's speed before.
    """

    events = 0

    def breakaway(self, plant: Any, speed: float, x: float) -> tuple[float, float]:
        """Return the breakaway point near x, and by how much the balance of forces is missed at x itself."""
        spring, mode = plant.spring, kernel.SLIP_BACKWARD
        mu, belt = plant.friction.breakaway_coefficient(mode), kernel.steady(speed)

        def missed(x: float) -> float:
            return float(kernel.stick_load(plant, x, belt) - kernel.stick_limit(plant, mode, x))

        at_x, x0 = missed(x), x
        for _ in range(20):
            slope = spring.restoring_slope(x) - mu * spring.normal_slope(x)
            if not slope > 0.0 or abs(x - x0) > 1.0:
                raise BranchEndError("the stick interval ends: there is no breakaway")
            step = missed(x) / slope
            x -= step
            if abs(step) <= 4e-16 * max(1.0, abs(x)):
                break
        if kernel.normal_force(plant, x) <= 0.0:
            raise BranchEndError("contact is lost at the breakaway")
        return x, at_x

    def residual(self, y: FloatArray) -> FloatArray:
        """Return the balance of forces at the breakaway, and v - v_b and the acceleration at the time."""
        plant, speed = self.at(y)
        x, missed = self.breakaway(plant, speed, y[0])
        end = self.orbit(y, x, speed, y[1], self.events)
        return np.array([missed, end.v - speed, end.a])

    def jacobian(self, y: FloatArray) -> FloatArray:
        """Return the derivatives by (x, time, parameters)."""
        plant, speed = self.at(y)
        mode, spring = kernel.SLIP_BACKWARD, plant.spring
        x, _ = self.breakaway(plant, speed, y[0])
        mu = plant.friction.breakaway_coefficient(mode)
        by_x = spring.restoring_slope(x) - mu * spring.normal_slope(x)
        seeds = np.zeros((2, 2))
        matrix = np.zeros((3, 4))
        matrix[0, 0] = by_x
        if self.exact:
            by_friction = tuple(-value for value in plant.friction.breakaway_gradient(mode))
            matrix[0, 2:] = self.directions(y) @ forces_by_numbers(plant, x, speed, -mu, by_friction)
        on_belt = np.array([name == "belt_speed" for name in self.names], dtype=float)
        matrix[0, 2:] += 2.0 * plant.beta * on_belt
        seeds[0], seeds[1] = -matrix[0, 2:] / by_x, on_belt
        end = self.orbit(y, x, speed, y[1], self.events, seeds, 2)
        matrix[1:, 1] = end.a, end.jerk
        matrix[1:, 2:] = end.by[1:]
        matrix[1, 2:] -= on_belt
        for i, name in enumerate(self.names):
            if not self.exact and name != "belt_speed":
                matrix[:, 2 + i] = self.by_differences(y, 2 + i)
        return matrix

    def start(self, y: FloatArray) -> FloatArray:
        """Return y with the unknowns of v_b0 at the parameters in y, its belt speed replaced by v_b0.

        Raises:
            NoBorderError: if stick-slip does not end there, or not by a graze.
        """
        p = self.oscillator(y)
        speed = grazing_belt_speed(p)
        if math.isnan(speed):
            raise NoBorderError("no breakaway is followed by another stick")
        if speed >= 10.0:
            raise NoBorderError("stick-slip persists up to the greatest belt speed, 10")
        p = p.replace(belt_speed=speed)
        load = 2.0 * p.beta * speed
        x = balance_points(p, load, p.plant.friction.breakaway_coefficient(kernel.SLIP_BACKWARD))[-1]
        met = np.empty((4 * kernel.MAX_EVENTS, 4))
        drive, state = kernel.steady(speed), kernel.State(x, speed)
        traced = kernel.trace(
            p.plant, kernel.SLIP_BACKWARD, state, drive, np.array([_LONGEST_ORBIT]), np.empty((1, 4)), met
        )
        kinds = [kernel.EVENT_NAMES[int(kind)] for kind in met[: traced.events, 1]]
        if "restick" not in kinds:
            raise NoBorderError(f"stick-slip ends at v_b0 = {speed:.9g} where the mass is caught, not by a graze")
        self.events = kinds.index("restick")
        time, place = met[self.events, 0], met[self.events, 2]
        mode = kernel.SLIP_BACKWARD if self.events % 2 == 0 else kernel.SLIP_FORWARD
        rate = kernel.slip_acceleration(p.plant, mode, kernel.State(place, speed), drive)
        if abs(rate) > 1e-3:
            raise NoBorderError(f"stick-slip ends at v_b0 = {speed:.9g} by a jump to another motion, not by a graze")
        values = [p.values[name] for name in self.names]
        return correct(self, np.array([x, time, *values]), np.eye(4)[3])

    def multiplier(self, y: FloatArray) -> float:
        """Return by how much the lap from the graze multiplies a small distance of the greatest speed from the belt's.

        Above 1 the pure-slip cycle that ends at the graze is unstable, and lies below v_b0 beside stick-slip.
        """
        return float(self.lap(y).by[1, 0])

    def damping(self, y: FloatArray) -> float:
        """Return the damping of steady slip there: where it is 0, v_b0 = v_b1."""
        points = equilibria(self.oscillator(y))
        return points[-1].damping if points else math.nan

    def lap(self, y: FloatArray) -> End:
        """Return the lap from the graze with the derivatives by v there; it ends at its greatest speed."""
        plant, speed = self.at(y)
        x, time, seeds = self.breakaway(plant, speed, y[0])[0], y[1], np.array([[0.0], [1.0]])
        if not grazes_at_breakaway(plant):
            x = self.orbit(y, x, speed, time, self.events).x
        while True:
            end = self.orbit(y, x, speed, time, self.events, seeds)
            if not abs(end.a) > 1e-9:
                return end
            time -= end.a / end.jerk


def grazes_at_breakaway(plant: Any, mode: int = kernel.SLIP_BACKWARD) -> bool:
    """Return whether friction is continuous at rest, in a mode, so that an orbit grazes where stick ends."""
    limit = plant.friction.breakaway_coefficient(mode)
    return bool(abs(limit - mode * plant.friction.coefficient(mode, 0.0)) <= 1e-12 * max(1.0, limit))


class FoldBorder(Border):
    """Fold of pure-slip cycles: a lap from the greatest x closes with the multiplier 1, in (x, time, parameters).

    The derivatives of the multiplier, which is the determinant of the lap's, are differences.
    """

    events = 0

    def residual(self, y: FloatArray) -> FloatArray:
        """Return by how much x and v = 0 are missed after the lap, and the multiplier less 1."""
        plant, speed = self.at(y)
        belt = kernel.steady(speed)
        if kernel.slip_acceleration(plant, kernel.SLIP_BACKWARD, kernel.State(y[0], 0.0), belt) > -_LEAST_CYCLE:
            raise BranchEndError("the cycle shrinks to the equilibrium: a Bautin point of v_b1")
        end = self.orbit(y, y[0], 0.0, y[1], self.events, np.eye(2))
        return np.array([end.x - y[0], end.v, np.linalg.det(end.by[:2]) - 1.0])

    def jacobian(self, y: FloatArray) -> FloatArray:
        """Return the derivatives by (x, time, parameters)."""
        end = self.orbit(y, y[0], 0.0, y[1], self.events, np.eye(2, 4), 2)
        differences = np.column_stack([self.by_differences(y, column) for column in range(4)])
        matrix = np.vstack((end.by[:2], differences[2]))
        matrix[:2, 1], matrix[0, 0] = (end.v, end.a), end.by[0, 0] - 1.0
        matrix[:2, 2:] = end.by[:2, 2:] if self.exact else differences[:2, 2:]
        return matrix

    def start(self, y: FloatArray) -> FloatArray:
        """Return y with the unknowns of a fold between the borders v_b0 and v_b1 and where no pure-slip cycle is left.

        Raises:
            NoBorderError: if the cycles that end at v_b0 and at v_b1 need no fold to be one branch.
        """
        p = self.oscillator(y)
        graze, hopf = GrazingBorder(p, self.names, self.scale), HopfBorder(p, self.names, self.scale[[0, 2, 3]])
        at_graze, at_hopf = graze.start(y), hopf.start(y)
        below = hopf.lyapunov(at_hopf) < 0.0  # cycles there lie below v_b1
        if below != (graze.multiplier(at_graze) > 1.0):
            raise NoBorderError("no fold: the cycles between v_b0 and v_b1 are one branch")
        self.events = graze.events
        ends = at_graze[2], at_hopf[1]
        edge, way = (min(ends), -1.0) if below else (max(ends), 1.0)
        near, far, cycles = 1e-4, 1e-4, []
        while far < 1.0 and (found := slip_cycles(p.replace(belt_speed=edge * (1.0 + way * far)))):
            near, far, cycles = far, 2.0 * far, found
        for _ in range(14):
            middle = 0.5 * (near + far)
            if found := slip_cycles(p.replace(belt_speed=edge * (1.0 + way * middle))):
                near, cycles = middle, found
            else:
                far = middle
        if not cycles:
            raise NoBorderError("the fold is too close to v_b0 or v_b1 to be seen")
        pair = cycles[-2:]
        x, time = (float(np.mean([getattr(cycle, name) for cycle in pair])) for name in ("x_max", "period"))
        return correct(self, np.array([x, time, edge * (1.0 + way * near), y[-1]]), np.eye(4)[3])


class GrazingMap(NamedTuple):
    """The return map at the graze of v_b0, in the gap g = v_b - max v of a lap, small.

    The next gap is ``multiplier`` g + ``rate`` (v_b - v_b0) + ``jump`` after a lap that slips (g > 0), and
    ``rate`` (v_b - v_b0) after one that sticks, whatever g.

    Attributes:
        v_b0: the belt speed of the graze.
        kind: "piecewise linear" (a grazing-sliding of continuous friction: slopes ``multiplier`` and 0), or
            "linear with gap" (kinetic friction at rest is less than static).
        multiplier: slope of the map in slip; above 1 the graze is a nonsmooth fold with an unstable pure-slip cycle.
        rate: derivative of the gap of the lap from breakaway by the belt speed.
        jump: distance of the two pieces at g = 0.
        stick_time: c of the stick's duration c sqrt(v_b0 - v_b) just below v_b0; NaN with a gap, where it stays finite.
    """

    v_b0: float
    kind: str
    multiplier: float
    rate: float
    jump: float
    stick_time: float


def grazing_map(parameters: OscillatorParameters) -> GrazingMap:
    """Return the leading terms of the return map at v_b0; ``belt_speed`` is not used.

    Source: di Bernardo, Kowalczyk and Nordmark (2002), Bifurcations of dynamical systems with sliding, Physica D 170.

    Raises:
        NoBorderError: a ValueError, if stick-slip does not end by a graze.
        ValueError: if the oscillator is excited.
    """
    border = GrazingBorder(parameters, ("belt_speed", "beta"), np.array([1.0, 10.0, 1.0, 1.0]))
    y = border.start(np.array([parameters.belt_speed, parameters.beta]))
    plant, speed = border.at(y)
    jacobian, lap, continuous = border.jacobian(y), border.lap(y), grazes_at_breakaway(plant)
    rate, jerk = -float(jacobian[1, 2]), float(jacobian[2, 1])
    return GrazingMap(
        v_b0=speed,
        kind="piecewise linear" if continuous else "linear with gap",
        multiplier=float(lap.by[1, 0]),
        rate=rate,
        jump=0.0 if continuous else float(speed - lap.v),
        stick_time=math.sqrt(max(2.0 * rate / abs(jerk), 0.0)) if continuous else math.nan,
    )
