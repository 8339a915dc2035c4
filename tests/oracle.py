"""A slow and careful second opinion: the belt oscillator as a hybrid automaton on SciPy's DOP853.

It shares no line with the package: forces, modes and events are written again here, in plain NumPy and SciPy, so that
an error has to be made twice to go unseen. Any object with the attributes of `Plant` will do as `p`. Everything is
dimensionless.

In slip the sign of v_rel is frozen and each step's dense output is searched for events, also for a pair of crossings
inside one step (SciPy's own event search looks at the ends of a step only, and so misses the shortest sticks). An event
is then polished by integrating again from the last accepted step with Newton's correction: the dense output's error
never reaches an event state. In stick x is a known function of time and breakaway the first root of the load against
its limit.

Excitation is met as it is: all states are those of the room, the belt's speed has its ripple, time stands in the
forces. With the discontinuous spring (exact, alpha = 0) x = 0 ends a leg too ("switch"), and the spring's side is
frozen on every leg.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq, minimize_scalar

SLIP_BACKWARD, STICK, SLIP_FORWARD = -1, 0, 1

RTOL = 1e-12
ATOL = 1e-14
MAX_STEP = 0.1
# Pieces searched in each step. Two crossings within one piece are found through the turn between them.
SAMPLES = 4
MAX_LEGS = 100_000


class Parameters(Protocol):
    """What the oracle reads of a parameter set."""

    @property
    def geometry(self) -> Any: ...
    @property
    def alpha(self) -> float: ...
    @property
    def g1(self) -> float: ...
    @property
    def beta(self) -> float: ...
    @property
    def mu_s(self) -> float: ...
    @property
    def mu_m(self) -> float: ...
    @property
    def v_m(self) -> float: ...
    @property
    def belt_speed(self) -> float: ...
    @property
    def friction(self) -> Any: ...
    @property
    def mu_k(self) -> float: ...
    @property
    def delta(self) -> float: ...
    @property
    def v_0(self) -> float: ...
    @property
    def mu_v(self) -> float: ...
    @property
    def kappa(self) -> float: ...
    @property
    def linear_stiffness(self) -> float: ...
    @property
    def force_amplitude(self) -> float: ...
    @property
    def force_frequency(self) -> float: ...
    @property
    def force_phase(self) -> float: ...
    @property
    def ripple_amplitude(self) -> float: ...
    @property
    def ripple_frequency(self) -> float: ...
    @property
    def ripple_phase(self) -> float: ...
    @property
    def stiffness_amplitude(self) -> float: ...
    @property
    def stiffness_frequency(self) -> float: ...
    @property
    def stiffness_phase(self) -> float: ...


@dataclass(frozen=True)
class Plant:
    """The oracle's own parameter set; the defaults are those of the paper's figures."""

    geometry: str = "cubic"
    alpha: float = 0.8
    g1: float = 1.0
    beta: float = 0.05
    mu_s: float = 0.2
    mu_m: float = 0.05
    v_m: float = 0.5
    belt_speed: float = 0.2
    friction: str = "stribeck"
    mu_k: float = 0.1
    delta: float = 3.0
    v_0: float = 0.5
    mu_v: float = 0.0
    kappa: float = 1.0
    linear_stiffness: float = 1.0
    force_amplitude: float = 0.0
    force_frequency: float = 1.0
    force_phase: float = 0.0
    ripple_amplitude: float = 0.0
    ripple_frequency: float = 1.0
    ripple_phase: float = 0.0
    stiffness_amplitude: float = 0.0
    stiffness_frequency: float = 1.0
    stiffness_phase: float = 0.0


class Event(NamedTuple):
    """kind: "stick" (landing into stick), "cross" (straight on to the other slip side), "breakaway", "contact-loss",
    "switch" (x passes 0 where alpha = 0)."""

    time: float
    kind: str
    x: float
    v: float


@dataclass
class Run:
    """The end of a run and what was met on the way. Integrals are over the whole run; v_belt is without ripple."""

    t: float
    x: float
    v: float
    v_belt: float
    mode: int
    x_max: float
    x_min: float
    events: list[Event] = field(default_factory=list)
    contact_lost: bool = False
    v_squared: float = 0.0
    time_stuck: float = 0.0
    contact_work: float = 0.0
    control_work: float = 0.0
    excitation_work: float = 0.0


@dataclass
class Leg:
    """One stay in one mode, from one event or control instant to the next. `end` is "" where time ran out."""

    mode: int
    duration: float
    x: float
    v: float
    v_belt: float
    end: str
    next_mode: int
    x_max: float
    x_min: float
    v_squared: float
    contact_work: float
    excitation_work: float
    maxima: list[float]


@dataclass
class Cycle:
    """One period of the steady motion. `kind`: "stick-slip", "pure-slip", "steady-slip" or "rest".

    x_breakaway is the breakaway that repeats and x_restick the landing after it; a cycle of several sticks lists all
    of them in time order in `breakaways` and `resticks`. A stick forgets the past: its Floquet multiplier is 0.
    """

    kind: str
    x_breakaway: float
    x_restick: float
    period: float
    t_slip: float
    stick_fraction: float
    amplitude: float
    x_max: float
    x_min: float
    sticks: int
    floquet_multiplier: float
    breakaways: list[float] = field(default_factory=list)
    resticks: list[float] = field(default_factory=list)


class Equilibrium(NamedTuple):
    """Steady slip: trace and determinant of the Jacobian there (stable: trace < 0 < determinant)."""

    x: float
    trace: float
    determinant: float


def _check(p: Parameters) -> None:
    if p.geometry not in ("exact", "cubic", "linear", "duffing"):
        raise ValueError(f"unknown geometry {p.geometry!r}")
    if p.friction not in ("stribeck", "coulomb", "hyperbolic", "exponential", "gaussian"):
        raise ValueError(f"unknown friction {p.friction!r}")
    if p.geometry == "cubic" and p.alpha <= 0.0:
        raise ValueError("the cubic spring needs a positive alpha")


def _switches(p: Parameters) -> bool:
    """Whether x = 0 is a second switching surface."""
    return bool(p.geometry == "exact" and p.alpha == 0.0)


def _excited(p: Parameters) -> bool:
    return p.force_amplitude != 0.0 or p.ripple_amplitude != 0.0 or p.stiffness_amplitude != 0.0


def _rate(p: Parameters) -> float:
    """The fastest excitation's frequency."""
    kinds = ("force", "ripple", "stiffness")
    return max(getattr(p, f"{kind}_frequency") if getattr(p, f"{kind}_amplitude") else 0.0 for kind in kinds)


def stiffness(p: Parameters, t: Any) -> Any:
    """How many times as great as the calm spring's its force is at a time."""
    return 1.0 + p.stiffness_amplitude * np.cos(p.stiffness_frequency * t + p.stiffness_phase)


def stiffness_rate(p: Parameters, t: Any) -> Any:
    """The rate of change of the same."""
    rate = p.stiffness_frequency
    return -p.stiffness_amplitude * rate * np.sin(rate * t + p.stiffness_phase)


def exciting_force(p: Parameters, t: Any) -> Any:
    """f cos(Omega t + phase)."""
    return p.force_amplitude * np.cos(p.force_frequency * t + p.force_phase)


def ripple(p: Parameters, t: Any) -> tuple[Any, Any, Any]:
    """The way, the speed and the acceleration that the ripple adds to the belt's."""
    angle, rate = p.ripple_frequency * t + p.ripple_phase, p.ripple_frequency
    c, s = p.ripple_amplitude * np.cos(angle), p.ripple_amplitude * np.sin(angle)
    return s / rate, c, -rate * s


def restoring(p: Parameters, x: Any, t: Any = 0.0, side: float | None = None) -> Any:
    """R(x): Eq. 4 (exact), Eq. 9 (cubic), a straight line (linear), Duffing's; at alpha = 0 on a ``side`` of x = 0."""
    if p.stiffness_amplitude:
        return stiffness(p, t) * _calm_restoring(p, x, side)
    return _calm_restoring(p, x, side)


def _calm_restoring(p: Parameters, x: Any, side: float | None) -> Any:
    if p.geometry == "exact" and p.alpha == 0.0:
        return x - (np.sign(x) if side is None else side)
    if p.geometry == "exact":
        return x - x / (x * x + p.alpha * p.alpha) ** 0.5
    if p.geometry == "cubic":
        return x - x / p.alpha + x**3 / (2.0 * p.alpha**3)
    if p.geometry == "duffing":
        return p.linear_stiffness * x + p.kappa * x**3
    return 1.0 * x


def restoring_slope(p: Parameters, x: Any) -> Any:
    """R'(x) of the calm spring."""
    if p.geometry == "exact":
        return 1.0 - (p.alpha**2 / (x * x + p.alpha * p.alpha) ** 1.5 if p.alpha else 0.0)
    if p.geometry == "cubic":
        return 1.0 - 1.0 / p.alpha + 3.0 * x**2 / (2.0 * p.alpha**3)
    if p.geometry == "duffing":
        return p.linear_stiffness + 3.0 * p.kappa * x**2
    return 0.0 * x + 1.0


def potential(p: Parameters, x: Any) -> Any:
    """V(x) with V' = R and V(0) = 0, of the calm spring."""
    if p.geometry == "exact":
        return 0.5 * x * x - (x * x + p.alpha * p.alpha) ** 0.5 + p.alpha
    if p.geometry == "cubic":
        return 0.5 * x * x * (1.0 - 1.0 / p.alpha) + x**4 / (8.0 * p.alpha**3)
    if p.geometry == "duffing":
        return 0.5 * p.linear_stiffness * x * x + 0.25 * p.kappa * x**4
    return 0.5 * x * x


def normal_force(p: Parameters, x: Any, t: Any = 0.0) -> Any:
    """N(x): Eq. 4 (exact), Eq. 9 (cubic), g1 (linear, Duffing); a modulated spring's pull is as many times as great."""
    factor = stiffness(p, t) if p.stiffness_amplitude else 1.0
    if p.geometry == "exact" and p.alpha != 0.0:
        return p.g1 - factor * (p.alpha - p.alpha / (x * x + p.alpha * p.alpha) ** 0.5)
    if p.geometry == "cubic":
        return p.g1 - factor * (p.alpha - 1.0 + x**2 / (2.0 * p.alpha**2))
    return 0.0 * x + p.g1


def normal_force_slope(p: Parameters, x: Any) -> Any:
    """N'(x) of the calm spring."""
    if p.geometry == "exact" and p.alpha != 0.0:
        return -p.alpha * x / (x * x + p.alpha * p.alpha) ** 1.5
    if p.geometry == "cubic":
        return -x / p.alpha**2
    return 0.0 * x


def _stribeck(p: Parameters) -> tuple[float, float]:
    difference = p.mu_s - p.mu_m
    return 1.5 * difference / p.v_m, 0.5 * difference / p.v_m**3


def friction_coefficient(p: Parameters, w: Any, mode: int | None = None) -> Any:
    """mu(v_rel), Eq. 5 with x' in its linear term, or another law; `mode` freezes the sign, as slip does."""
    sign = np.sign(w) if mode is None else mode
    if p.friction == "coulomb":
        return p.mu_k * sign + 0.0 * w
    if p.friction == "hyperbolic":
        return p.mu_s * sign / (1.0 + p.delta * sign * w) + p.mu_v * w
    if p.friction == "exponential":
        return sign * (p.mu_k + (p.mu_s - p.mu_k) * np.exp(-sign * w / p.v_0)) + p.mu_v * w
    if p.friction == "gaussian":
        return sign * (p.mu_k + (p.mu_s - p.mu_k) * np.exp(-((w / p.v_0) ** 2))) + p.mu_v * w
    k1, k3 = _stribeck(p)
    return p.mu_s * sign - k1 * w + k3 * w**3


def friction_slope(p: Parameters, w: Any) -> Any:
    """d mu / d v_rel, away from v_rel = 0."""
    if p.friction == "coulomb":
        return 0.0 * w
    if p.friction == "hyperbolic":
        return p.mu_v - p.mu_s * p.delta / (1.0 + p.delta * abs(w)) ** 2
    if p.friction == "exponential":
        return p.mu_v - (p.mu_s - p.mu_k) / p.v_0 * np.exp(-abs(w) / p.v_0)
    if p.friction == "gaussian":
        return p.mu_v - 2.0 * (p.mu_s - p.mu_k) * abs(w) / p.v_0**2 * np.exp(-((w / p.v_0) ** 2))
    k1, k3 = _stribeck(p)
    return -k1 + 3.0 * k3 * w**2


def stick_load(
    p: Parameters, x: Any, v_belt: Any, u: float = 0.0, a_belt: float = 0.0, t: Any = 0.0, side: float | None = None
) -> Any:
    """The contact force that holds the mass on the belt: acceleration + 2 beta speed + R - all other forces.

    v_belt and a_belt are the belt's without ripple.
    """
    if p.ripple_amplitude:
        _, speed, acceleration = ripple(p, t)
        v_belt, a_belt = v_belt + speed, a_belt + acceleration
    drive = u + exciting_force(p, t) if p.force_amplitude else u
    return a_belt + 2.0 * p.beta * v_belt + restoring(p, x, t, side) - drive


def _side_in_slip(p: Parameters, mode: int, x: float, v: float, w: float, u: float, t: float) -> float | None:
    """The side of x = 0 whose spring acts; a mass at rest there feels none, and goes where the other forces push."""
    if not _switches(p):
        return None
    if x != 0.0 or v != 0.0:
        return float(np.sign(x if x != 0.0 else v))
    force = -friction_coefficient(p, w, mode) * normal_force(p, 0.0, t) + u + exciting_force(p, t)
    return 1.0 if force >= 0.0 else -1.0


def _side_in_stick(p: Parameters, x: float, speed: float) -> float | None:
    return float(np.sign(x if x != 0.0 else speed)) if _switches(p) else None


def _slip_flow(
    p: Parameters, mode: int, v_belt: float, u: float, a_belt: float, t0: float = 0.0, side: float | None = None
) -> Callable[..., Any]:
    """Right-hand side in slip: x, v, and the integrals of v^2, of the contact force's power and of the excitation's."""
    k1, k3 = _stribeck(p)
    static, damping = mode * p.mu_s, 2.0 * p.beta
    plain, excited = p.friction == "stribeck", _excited(p)

    def flow(t: float, y: Any) -> list[float]:
        x, v = float(y[0]), float(y[1])
        w = v - v_belt - a_belt * t
        now, drive, power = t0 + t, u, 0.0
        if excited:
            w -= float(ripple(p, now)[1])
            force = float(exciting_force(p, now))
            drive += force
            power = force * v + float(stiffness_rate(p, now)) * potential(p, x)
        mu = static - k1 * w + k3 * w**3 if plain else float(friction_coefficient(p, w, mode))
        contact = -mu * normal_force(p, x, now)
        return [v, contact - damping * v - restoring(p, x, now, side) + drive, v * v, contact * v, power]

    return flow


_TOLERANCES: dict[str, Any] = {"rtol": RTOL, "atol": np.array([ATOL, ATOL, 10 * ATOL, 10 * ATOL, 10 * ATOL])}


def _polish(
    flow: Callable[..., Any],
    surface: Callable[[float, Any], float],
    surface_rate: Callable[[float, Any], float],
    t_old: float,
    y_old: np.ndarray,
    t: float,
) -> tuple[float, np.ndarray]:
    """Time and state where `surface` is zero, near t, by integration from (t_old, y_old)."""
    y = y_old
    for _ in range(8):
        if t <= t_old:
            return t_old, y_old.copy()
        y = solve_ivp(flow, (t_old, t), y_old, method="DOP853", first_step=t - t_old, **_TOLERANCES).y[:, -1]
        rate = surface_rate(t, y)
        if rate == 0.0:
            break
        correction = -surface(t, y) / rate
        # A grazing root moves by the square root of rounding: a large correction there is noise.
        if abs(correction) <= 2e-16 * max(1.0, t) or abs(correction) > 1e-3 * MAX_STEP:
            break
        t += correction
        if abs(correction) < 1e-9:
            # The remainder is of second order: one straight piece of flow is exact to rounding.
            y = y + correction * np.array(flow(t, y))
            break
    return t, y


def _slip(
    p: Parameters,
    mode: int,
    x: float,
    v: float,
    v_belt: float,
    u: float = 0.0,
    a_belt: float = 0.0,
    duration: float = math.inf,
    stop_after_maxima: int | None = None,
    t0: float = 0.0,
) -> Leg:
    """Slip until v_rel returns to zero, contact is lost, time runs out, or (on request) x has peaked so many times."""
    belt_start = v_belt + float(ripple(p, t0)[1])
    side = _side_in_slip(p, mode, x, v, v - belt_start, u, t0)
    flow = _slip_flow(p, mode, v_belt, u, a_belt, t0, side)
    facing = 0.0 if side is None else side

    def belt(t: Any) -> Any:
        return v_belt + a_belt * t + (ripple(p, t0 + t)[1] if p.ripple_amplitude else 0.0)

    def gap(t: Any, y: Any) -> Any:
        return mode * (y[1] - belt(t))

    def acceleration(t: Any, y: Any) -> Any:
        now = t0 + t
        contact_force = -friction_coefficient(p, y[1] - belt(t), mode) * normal_force(p, y[0], now)
        drive = u + (exciting_force(p, now) if p.force_amplitude else 0.0)
        return contact_force - 2.0 * p.beta * y[1] - restoring(p, y[0], now, side) + drive

    def gap_rate(t: Any, y: Any) -> Any:
        return mode * (acceleration(t, y) - a_belt - (ripple(p, t0 + t)[2] if p.ripple_amplitude else 0.0))

    def contact(t: Any, y: Any) -> Any:
        return normal_force(p, y[0], t0 + t)

    def contact_rate(t: Any, y: Any) -> Any:
        if not p.stiffness_amplitude:
            return normal_force_slope(p, y[0]) * y[1]
        now = t0 + t
        pull = (normal_force(p, y[0], now) - p.g1) / stiffness(p, now)
        return stiffness(p, now) * normal_force_slope(p, y[0]) * y[1] + stiffness_rate(p, now) * pull

    def place(t: Any, y: Any) -> Any:
        return facing * y[0]

    def place_rate(t: Any, y: Any) -> Any:
        return facing * y[1]

    def leg(t: float, y: Any, end: str, next_mode: int) -> Leg:
        belt_now = v_belt + a_belt * t
        # On the surface the two speeds are one number, else stick would creep by the rounding error.
        v_now = float(belt(t)) if end in ("land", "cross") else float(y[1])
        x_now = 0.0 if end == "switch" else float(y[0])
        highs, lows = [x, x_now, *maxima], [x, x_now, *minima]
        return Leg(
            mode, float(t), x_now, v_now, float(belt_now), end, next_mode, max(highs), min(lows),
            float(y[2]), float(y[3]), float(y[4]), maxima,
        )  # fmt: skip

    maxima: list[float] = []
    minima: list[float] = []
    y = np.array([x, v, 0.0, 0.0, 0.0])
    if duration <= 0.0:
        return leg(0.0, y, "", mode)
    longest = min(MAX_STEP, 0.5 / _rate(p)) if _rate(p) else MAX_STEP
    first_step = min(0.02, longest, duration)
    solver = DOP853(flow, 0.0, y, duration, max_step=longest, first_step=first_step, **_TOLERANCES)
    while solver.t < duration:
        t_old, y_old = solver.t, solver.y.copy()
        solver.step()
        if solver.status == "failed":
            raise RuntimeError(f"DOP853 stopped at {solver.t} with x={solver.y[0]}, v={solver.y[1]}")
        dense = solver.dense_output()
        ts = np.linspace(t_old, solver.t, SAMPLES + 1)
        ys = dense(ts)
        ys[:, 0], ys[:, -1] = y_old, solver.y
        gaps, rates, contacts = gap(ts, ys), gap_rate(ts, ys), contact(ts, ys)
        places, speeds = place(ts, ys), place_rate(ts, ys)
        if t_old == 0.0 and abs(v - belt_start) <= (1e-13 if p.ripple_amplitude else 0.0):
            gaps[0] = 0.0

        for i in range(SAMPLES):
            a, b = float(ts[i]), float(ts[i + 1])
            landing = _first_root(dense, gap, gap_rate, a, b, gaps[i : i + 2], rates[i : i + 2])
            switch = None
            if side is not None:
                switch = _first_root(dense, place, place_rate, a, b, places[i : i + 2], speeds[i : i + 2])
            turn = None
            if ys[1, i] * ys[1, i + 1] < 0.0 or (ys[1, i + 1] == 0.0 and ys[1, i] != 0.0):
                turn = _bracketed(dense, lambda t, y: y[1], a, b) if ys[1, i + 1] else b
            loss = None
            if contacts[i] > 0.0:
                # N falls with |x|, so its least value in a piece lies at the piece's ends or where x turns.
                for c in (turn, b):
                    if loss is None and c is not None and contact(c, dense(c)) <= 0.0:
                        loss = _bracketed(dense, contact, a, c)
                if loss is None and p.stiffness_amplitude:
                    falling = contact_rate(ts[i : i + 2], ys[:, i : i + 2])
                    loss = _first_root(dense, contact, contact_rate, a, b, contacts[i : i + 2], falling)

            first = min((s for s in (landing, loss, switch) if s is not None), default=math.inf)
            if turn is not None and turn < first:
                t_turn, y_turn = _polish(flow, lambda t, y: y[1], acceleration, t_old, y_old, turn)
                if acceleration(t_turn, y_turn) < 0.0:
                    maxima.append(float(y_turn[0]))
                    if len(maxima) == stop_after_maxima:
                        return leg(t_turn, y_turn, "maximum", mode)
                else:
                    minima.append(float(y_turn[0]))
            if landing is not None and first == landing:
                t, y = _polish(flow, gap, gap_rate, t_old, y_old, landing)
                belt_now = v_belt + a_belt * t
                load = stick_load(p, y[0], belt_now, u, a_belt, t0 + t, side)
                limit = p.mu_s * normal_force(p, y[0], t0 + t)
                if abs(load) <= limit:
                    return leg(t, y, "land", STICK)
                return leg(t, y, "cross", -int(np.sign(load)))
            if switch is not None and first == switch:
                t, y = _polish(flow, place, place_rate, t_old, y_old, switch)
                return leg(t, y, "switch", mode)
            if loss is not None:
                t, y = _polish(flow, contact, contact_rate, t_old, y_old, loss)
                return leg(t, y, "contact-loss", mode)
    return leg(solver.t, solver.y, "", mode)


def _bracketed(dense: Callable[..., Any], surface: Callable[..., Any], a: float, b: float) -> float:
    """The time in [a, b] at which `surface`, of opposite signs at the ends, is zero along the dense output."""
    return float(brentq(lambda t: float(surface(t, dense(t))), a, b, xtol=1e-15))


def _first_root(
    dense: Callable[..., Any],
    surface: Callable[..., Any],
    surface_rate: Callable[..., Any],
    a: float,
    b: float,
    values: np.ndarray,
    rates: np.ndarray,
) -> float | None:
    """First time in [a, b] at which `surface`, positive on this side, comes down to zero; None where it does not."""

    def at(t: float) -> float:
        return float(surface(t, dense(t)))

    if values[0] <= 0.0:
        # A start on the surface, just after breakaway: not an event. It leaves, or it comes back within this piece.
        if values[1] > 0.0:
            return None
        for k in range(1, 20):
            inner = a + (b - a) * 0.5**k
            if at(inner) > 0.0:
                return _bracketed(dense, surface, inner, b)
        return a
    if values[1] <= 0.0:
        return _bracketed(dense, surface, a, b)
    if rates[0] < 0.0 < rates[1]:
        bottom = _bracketed(dense, surface_rate, a, b)
        if at(bottom) <= 0.0:
            return _bracketed(dense, surface, a, bottom)
    return None


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


def _stick(
    p: Parameters,
    x: float,
    v_belt: float,
    u: float = 0.0,
    a_belt: float = 0.0,
    duration: float = 1e4,
    t0: float = 0.0,
) -> Leg:
    """Ride the belt: x = x0 + v_belt t + a_belt t^2/2 + what the ripple adds until the load first exceeds mu_s N, x
    passes the place where that switches the spring, or time runs out."""
    way0, speed0, _ = ripple(p, t0)
    side = _side_in_stick(p, x, v_belt + float(speed0))

    def position(t: Any) -> Any:
        shift = ripple(p, t0 + t)[0] - way0 if p.ripple_amplitude else 0.0
        return x + v_belt * t + 0.5 * a_belt * t * t + shift

    def speed(t: Any) -> Any:
        return v_belt + a_belt * t + (ripple(p, t0 + t)[1] if p.ripple_amplitude else 0.0)

    def load(t: Any) -> Any:
        return stick_load(p, position(t), v_belt + a_belt * t, u, a_belt, t0 + t, side)

    def reserve(t: Any) -> Any:
        return p.mu_s * normal_force(p, position(t), t0 + t) - abs(load(t))

    scale = min(p.alpha, 1.0) if p.geometry in ("exact", "cubic") and p.alpha else 1.0
    # The longest way the belt can go in this time, turning or not.
    distance = (abs(v_belt) + p.ripple_amplitude) * duration + 0.5 * abs(a_belt) * duration**2
    ts = np.linspace(0.0, duration, 33 + math.ceil(distance / (0.005 * scale) + 40.0 * _rate(p) * duration))
    turning = []
    if p.ripple_amplitude:
        speeds = speed(ts)
        signs = np.flatnonzero(speeds[:-1] * speeds[1:] < 0.0)
        turning += [float(brentq(speed, ts[i], ts[i + 1], xtol=1e-15)) for i in signs]
    elif a_belt != 0.0 and 0.0 < -v_belt / a_belt < duration:
        turning.append(-v_belt / a_belt)
    if side is not None and turning:
        ts = np.sort(np.append(ts, turning))
    end, next_mode, horizon = "", STICK, duration
    if side is not None:
        over = np.flatnonzero(side * position(ts[1:]) < 0.0) + 1
        if len(over):
            i = int(over[0])
            low = 1e-15 if i == 1 and x == 0.0 else float(ts[i - 1])
            horizon = float(brentq(position, low, ts[i], xtol=1e-15))
            ts = np.append(ts[:i], horizon)
            end = "switch"
    reserves = reserve(ts)
    out = np.flatnonzero(reserves[1:] < 0.0) + 1
    last = int(out[0]) if len(out) else len(ts) - 1
    bracket = (float(ts[last - 1]), float(ts[last])) if len(out) else None
    # A dip between two samples that are both inside. (Samples past the first one outside no longer matter.)
    for i in range(1, min(last + 1, len(ts) - 1)):
        if reserves[i] <= reserves[i - 1] and reserves[i] < reserves[i + 1]:
            rise = max(reserves[i - 1], reserves[i + 1]) - reserves[i]
            if 0.0 <= reserves[i] <= rise:
                bottom = minimize_scalar(
                    reserve, bounds=(ts[i - 1], ts[i + 1]), method="bounded", options={"xatol": 1e-14}
                )
                if bottom.fun < 0.0:
                    bracket = (float(ts[i - 1]), float(bottom.x))
                    break
    t = horizon
    if bracket is not None:
        # Landing on the cone's very edge: outside at once.
        t = bracket[0] if reserve(bracket[0]) <= 0.0 else float(brentq(reserve, *bracket, xtol=1e-15))
        end, next_mode = "breakaway", -int(np.sign(load(t)))

    places = [x, float(position(t)), *(float(position(s)) for s in turning if s < t)]
    way = (abs(v_belt) + p.ripple_amplitude) * t + 0.5 * abs(a_belt) * t * t
    panels = 1 + math.ceil(way / (0.1 * scale) + _rate(p) * t)
    edges = np.linspace(0.0, t, panels + 1)
    half = 0.5 * np.diff(edges)[:, None]
    nodes = 0.5 * (edges[1:] + edges[:-1])[:, None] + half * _NODES
    speeds = speed(nodes)
    work = float(np.sum(half * _WEIGHTS * load(nodes) * speeds))
    v_squared = v_belt * v_belt * t + v_belt * a_belt * t * t + a_belt * a_belt * t**3 / 3.0
    excitation_work = 0.0
    if _excited(p):
        v_squared = float(np.sum(half * _WEIGHTS * speeds * speeds))
        power = exciting_force(p, t0 + nodes) * speeds + stiffness_rate(p, t0 + nodes) * potential(p, position(nodes))
        excitation_work = float(np.sum(half * _WEIGHTS * power))
    x_now, x_max, x_min = float(position(t)), max(places), min(places)
    if end == "switch":
        x_now = 0.0
        rest = stick_load(p, 0.0, v_belt + a_belt * t, u, a_belt, t0 + t, _side_in_stick(p, 0.0, float(speed(t))))
        next_mode = STICK if abs(rest) <= p.mu_s * normal_force(p, 0.0, t0 + t) else -int(np.sign(rest))
    v_now = float(speed(t))
    return Leg(
        STICK, t, x_now, v_now, v_belt + a_belt * t, end, next_mode, x_max, x_min, v_squared, work, excitation_work, []
    )


def _mode_at(p: Parameters, x: float, v: float, v_belt: float, u: float, a_belt: float, t: float = 0.0) -> int:
    speed = v_belt + float(ripple(p, t)[1])
    if abs(v - speed) > (1e-13 if p.ripple_amplitude else 0.0):
        return SLIP_FORWARD if v > speed else SLIP_BACKWARD
    load = stick_load(p, x, v_belt, u, a_belt, t, _side_in_stick(p, x, speed))
    return STICK if abs(load) <= p.mu_s * normal_force(p, x, t) else -int(np.sign(load))


def _legs(
    p: Parameters,
    mode: int,
    x: float,
    v: float,
    v_belt: float,
    u: float,
    a_belt: float,
    duration: float,
    t0: float = 0.0,
) -> Iterator[Leg]:
    """The automaton over one control interval."""
    left = duration
    at_once = 0
    while True:
        if mode == STICK:
            leg = _stick(p, x, v_belt, u, a_belt, left, t0)
        else:
            leg = _slip(p, mode, x, v, v_belt, u, a_belt, left, None, t0)
        yield leg
        left -= leg.duration
        t0 += leg.duration
        if leg.end in ("", "contact-loss") or left <= 0.0:
            return
        at_once = at_once + 1 if leg.duration < 1e-12 else 0
        if at_once > 20:
            raise RuntimeError(f"events follow each other without time passing at x={leg.x}, v={leg.v}")
        x, v, v_belt, mode = leg.x, leg.v, leg.v_belt, leg.next_mode


def run(
    p: Parameters,
    x: float,
    v: float,
    intervals: Iterable[tuple[float, float, float]],
    v_belt: float | None = None,
    t: float = 0.0,
) -> Run:
    """The oscillator over control intervals (duration, u, a_belt), from (x, v) at time t on a belt at v_belt (default:
    p's).

    A control instant re-evaluates the mode; a stuck mass that it sets free is a "breakaway" at that instant. The mode
    that the very start finds is not an event. Loss of contact ends the run.
    """
    _check(p)
    belt = float(p.belt_speed) if v_belt is None else float(v_belt)
    state = Run(t, float(x), float(v), belt, STICK, float(x), float(x))
    started = False
    if normal_force(p, state.x, t) <= 0.0:
        state.events.append(Event(t, "contact-loss", state.x, state.v))
        state.contact_lost = True
        state.mode = int(np.sign(state.v - belt))
        return state
    beginning = t
    for duration, u, a_belt in intervals:
        mode = _mode_at(p, state.x, state.v, state.v_belt, u, a_belt, beginning)
        if started and state.mode == STICK and mode != STICK:
            state.events.append(Event(state.t, "breakaway", state.x, state.v))
        started = True
        state.mode = mode
        for count, leg in enumerate(_legs(p, mode, state.x, state.v, state.v_belt, u, a_belt, duration, beginning)):
            if count > MAX_LEGS:
                raise RuntimeError(f"more than {MAX_LEGS} legs in one control interval")
            state.t += leg.duration
            state.control_work += u * (leg.x - state.x)
            state.x, state.v, state.v_belt, state.mode = leg.x, leg.v, leg.v_belt, leg.next_mode
            state.x_max, state.x_min = max(state.x_max, leg.x_max), min(state.x_min, leg.x_min)
            state.v_squared += leg.v_squared
            state.contact_work += leg.contact_work
            state.excitation_work += leg.excitation_work
            state.time_stuck += leg.duration if leg.mode == STICK else 0.0
            if leg.end:
                kind = "stick" if leg.end == "land" else leg.end
                state.events.append(Event(state.t, kind, leg.x, leg.v))
            if leg.end == "contact-loss":
                state.contact_lost = True
                return state
        beginning += duration
        state.t = beginning
    return state


def cycle(
    p: Parameters,
    x0: float = 0.0,
    v0: float | None = None,
    max_time: float = 5000.0,
    settle_maxima: int = 12,
) -> Cycle:
    """The steady motion reached from (x0, v0); the default start sets the mass down at x = 0 moving with the belt.

    Stick-slip is settled once a breakaway repeats to 1e-11. A slip with `settle_maxima` peaks in a row and no stick is
    taken for pure slip, and where its peaks tend to is sought from there as a root.
    """
    _check(p)
    belt = float(p.belt_speed)
    x, v = float(x0), belt if v0 is None else float(v0)
    mode = _mode_at(p, x, v, belt, 0.0, 0.0)
    legs: list[Leg] = []
    # Breakaways: their place, and how many legs lay before them.
    breakaways: list[tuple[float, int]] = []
    elapsed = 0.0
    while elapsed < max_time:
        if mode == STICK:
            leg = _stick(p, x, belt, duration=max_time)
            if leg.end == "":
                return Cycle("rest", math.nan, math.nan, math.nan, 0.0, 1.0, 0.0, leg.x, leg.x, 0, 0.0)
        else:
            leg = _slip(p, mode, x, v, belt, duration=200.0, stop_after_maxima=settle_maxima)
        legs.append(leg)
        elapsed += leg.duration
        x, v, mode = leg.x, leg.v, leg.next_mode
        if leg.end == "contact-loss":
            raise RuntimeError(f"contact lost at x={x}, v={v}")
        if leg.end in ("", "maximum") and abs(v) < 1e-7:
            for equilibrium in equilibria(p):
                if abs(x - equilibrium.x) < 1e-7 and equilibrium.trace < 0.0 < equilibrium.determinant:
                    return _steady_slip(equilibrium.x)
        if leg.end == "maximum":
            pure = _pure_slip_cycle(p, leg.maxima[-1])
            if pure is not None:
                return pure
        if leg.end == "breakaway":
            for place, count in breakaways:
                if abs(place - x) < 1e-11:
                    return _stick_slip_cycle(legs[count:])
            breakaways.append((x, len(legs)))
    raise RuntimeError(f"no periodic motion in {max_time} time units from x={x0}")


def _stick_slip_cycle(legs: list[Leg]) -> Cycle:
    period = sum(leg.duration for leg in legs)
    t_slip = sum(leg.duration for leg in legs if leg.mode != STICK)
    x_max, x_min = max(leg.x_max for leg in legs), min(leg.x_min for leg in legs)
    resticks = [leg.x for leg in legs if leg.end == "land"]
    ends = [leg.x for leg in legs if leg.end == "breakaway"]
    # The legs start at a breakaway and end at the same one.
    breakaways = [ends[-1], *ends[:-1]]
    stuck = 1.0 - t_slip / period
    half = 0.5 * (x_max - x_min)
    return Cycle(
        "stick-slip", breakaways[0], resticks[0], period, t_slip, stuck, half, x_max, x_min, len(resticks), 0.0,
        breakaways, resticks,
    )  # fmt: skip


def _steady_slip(x: float) -> Cycle:
    return Cycle("steady-slip", math.nan, math.nan, math.nan, math.nan, 0.0, 0.0, x, x, 0, math.nan)


def _return(p: Parameters, x: float) -> Leg | None:
    """From a peak (x, v = 0) to the next; None where the mass sticks on the way, or creeps into steady slip."""
    leg = _slip(p, SLIP_BACKWARD, x, 0.0, float(p.belt_speed), duration=200.0, stop_after_maxima=1)
    return leg if leg.end == "maximum" else None


def _pure_slip_cycle(p: Parameters, peak: float) -> Cycle | None:
    """What pure slip through `peak` tends to: a cycle, steady slip, or None where it reaches the belt's speed.

    Peaks move one way only (a return map of one variable keeps order), so the limit is the next zero of the map's
    displacement that way. It is taken over the distance from the equilibrium, which is a zero that nobody asked for.
    """
    leg = _return(p, peak)
    if leg is None:
        return None
    centre = max((e.x for e in equilibria(p) if leg.x_min < e.x < leg.x_max), default=math.nan)

    def growth(x: float) -> float:
        after = _return(p, x)
        return math.nan if after is None else (after.x - x) / (x - centre)

    x, here = peak, growth(peak)
    if abs(here) > 1e-12:
        factor = 1.3 if here > 0.0 else 1.0 / 1.3
        while True:
            beyond = centre + factor * (x - centre)
            there = growth(beyond)
            if not math.isfinite(there) and abs(factor - 1.0) > 1e-3:
                # Sticking lies closer than this stride: shorter ones, in case the cycle is closer still.
                factor = math.sqrt(factor)
            elif not math.isfinite(there):
                return None
            elif abs(beyond - centre) < 1e-6:
                return _steady_slip(centre)
            elif here * there <= 0.0:
                x = float(brentq(growth, x, beyond, xtol=1e-15))
                break
            else:
                x, here = beyond, there
    leg = _return(p, x)
    if leg is None or abs(leg.x - x) > 1e-11:
        return None
    amplitude = 0.5 * (x - leg.x_min)
    # The slope of the return map, from both sides, or from inside where the outer orbits reach the belt's speed.
    h = 1e-3 * amplitude
    at = {k: _return(p, x + k * h) for k in (-3, -2, -1, 1, 2)}
    after = {k: math.nan if side is None else side.x for k, side in at.items()}
    if math.isnan(after[1] + after[2]):
        multiplier = (11.0 * leg.x - 18.0 * after[-1] + 9.0 * after[-2] - 2.0 * after[-3]) / (6.0 * h)
    else:
        multiplier = (8.0 * (after[1] - after[-1]) - (after[2] - after[-2])) / (12.0 * h)
    return Cycle(
        "pure-slip", math.nan, math.nan, leg.duration, leg.duration, 0.0, amplitude, x, leg.x_min, 0, multiplier
    )


def equilibria(p: Parameters, reach: float = 4.0) -> list[Equilibrium]:
    """Steady slip, from left to right: R(x) + mu(-v_belt) N(x) = 0 with N > 0 and a moving belt."""
    _check(p)
    w = -float(p.belt_speed)
    mu, slope = float(friction_coefficient(p, w)), float(friction_slope(p, w))

    def balance(x: Any) -> Any:
        return restoring(p, x) + mu * normal_force(p, x)

    # An odd count of points off a round step, so that none of them is an equilibrium by symmetry.
    xs = np.linspace(-reach, 1.0001 * reach, 8001)
    values = balance(xs)
    found = []
    for i in np.flatnonzero(values[:-1] * values[1:] < 0.0):
        x = float(brentq(balance, xs[i], xs[i + 1], xtol=1e-15))
        # (At alpha = 0 the balance jumps through zero at x = 0: no equilibrium.)
        if normal_force(p, x) > 0.0 and abs(balance(x)) < 1e-9:
            trace = -2.0 * p.beta - slope * normal_force(p, x)
            found.append(Equilibrium(x, float(trace), float(restoring_slope(p, x) + mu * normal_force_slope(p, x))))
    return found


def stick_intervals(p: Parameters, reach: float = 3.0) -> list[tuple[float, float, int]]:
    """Where the belt can hold the mass, left to right: both ends, and the direction of breakaway at the right end."""
    _check(p)
    belt = float(p.belt_speed)

    def reserve(x: Any) -> Any:
        return p.mu_s * normal_force(p, x) - abs(stick_load(p, x, belt))

    xs = np.linspace(-reach, 1.0001 * reach, 20001)
    inside = reserve(xs) >= 0.0
    ends = [float(brentq(reserve, xs[i], xs[i + 1], xtol=1e-15)) for i in np.flatnonzero(inside[:-1] != inside[1:])]
    return [
        (left, right, -int(np.sign(stick_load(p, right, belt))))
        for left, right in zip(ends[::2], ends[1::2], strict=True)
    ]


def _at_speed(p: Parameters, belt_speed: float) -> Plant:
    values = {name.name: getattr(p, name.name) for name in fields(Plant)}
    return Plant(**{**values, "belt_speed": belt_speed})


def hopf(p: Parameters) -> float:
    """v_b1, where the rightmost steady slip becomes stable: 2 beta + N(x_bar) mu'(-v_b1) = 0. NaN if it always is."""

    def trace(v: float) -> float:
        return equilibria(_at_speed(p, v))[-1].trace

    low = 1e-6 * p.v_m
    if p.friction == "stribeck" and p.beta == 0.0:
        return p.v_m
    high = p.v_m if p.friction == "stribeck" else 10.0
    return math.nan if trace(low) <= 0.0 else float(brentq(trace, low, high, xtol=1e-15))


def _peak_after_breakaway(p: Parameters) -> float:
    """The first peak of v_rel after the rightmost breakaway, with slip's sign frozen even past v_rel = 0."""
    belt = float(p.belt_speed)
    xs = np.linspace(-4.0, 4.0001, 8001)

    def reserve(x: Any) -> Any:
        return p.mu_s * normal_force(p, x) - stick_load(p, x, belt)

    values = reserve(xs)
    i = int(np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))[-1])
    breakaway = float(brentq(reserve, xs[i], xs[i + 1], xtol=1e-15))
    flow = _slip_flow(p, SLIP_BACKWARD, belt, 0.0, 0.0)

    def acceleration(t: float, y: Any) -> float:
        # At breakaway the acceleration is zero too, of either sign by rounding: that is no peak.
        return flow(t, y)[1] if t > 0.05 else -1.0

    def well_past(t: float, y: Any) -> float:
        # With its sign frozen a friction that falls on and on can run away there.
        return float(y[1]) - belt - 0.1

    for event in (acceleration, well_past):
        event.terminal = True  # type: ignore[attr-defined]
    acceleration.direction = -1.0  # type: ignore[attr-defined]
    start, events = [breakaway, belt, 0.0, 0.0, 0.0], [acceleration, well_past]
    solution = solve_ivp(flow, (0.0, 200.0), start, "DOP853", events=events, max_step=0.05, **_TOLERANCES)
    assert solution.y_events is not None
    peaks = solution.y_events[0]
    return float(peaks[0][1]) - belt if len(peaks) else 0.1


def grazing(p: Parameters) -> float:
    """v_b0, where the orbit from breakaway just fails to come back to the belt's speed: v_rel's first peak is zero."""
    top = hopf(p)
    # Where friction keeps falling stick-slip may outlive the Hopf point.
    high = top if p.friction == "stribeck" else 3.0 * top
    return float(brentq(lambda v: _peak_after_breakaway(_at_speed(p, v)), 0.5 * top, high, xtol=1e-14))


__all__ = [
    "Cycle",
    "Equilibrium",
    "Event",
    "Parameters",
    "Plant",
    "Run",
    "cycle",
    "equilibria",
    "friction_coefficient",
    "friction_slope",
    "grazing",
    "hopf",
    "normal_force",
    "potential",
    "restoring",
    "run",
    "stick_intervals",
    "stick_load",
]
