"""One step of a random legal plant: energy, cone, honest modes, and the same interval in pieces."""

import math
from collections.abc import Mapping
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

import tests.oracle as oracle
from scripts.hunting import draws
from scripts.hunting.draws import Start
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, kernel

FloatArray = NDArray[np.float64]

INTERVAL = 0.1
X, V, BELT, MODE, STATUS, TIME, EVENTS, INT_V2, STICK_TIME, INT_FV, X_MIN, X_MAX = range(12)

PROMISE = 1e-9  # error per unit of time, relative to max(1, |x|, |v|, STIFF |a|)
ROUNDING = 1e-14  # of a sum of forces, relative to the greatest
ENERGY = 1e-7  # residual over the sum of the absolute works and energies
GARBAGE = 1e-4
# How much further apart pieces may end than runs whose state was moved by the promised error.
MARGIN = 10.0
FINE = 16
EXAMINED = 20  # one trial in so many is examined in all respects, others only where runs in pieces do not agree


@numba.njit(error_model="numpy")
def in_pieces(plant, x, v, v_belt, a_belt, u, duration, moved, dx, dv, rows):  # type: ignore[no-untyped-def]
    """Advance over ``duration`` in as many equal pieces as there are ``rows``, which take what ``advance`` returns.

    At the beginning of the piece ``moved`` the state is moved by dx and dv. Return the number of pieces done.
    """
    pieces = len(rows)
    length = duration / pieces  # a power of two of them: exact
    belt = v_belt
    for i in range(pieces):
        if i == moved:
            x = x + dx
            v = v + dv
        begin = i * length
        out = kernel.advance(
            kernel.at_time(plant, begin), kernel.State(x, v), kernel.Drive(belt, a_belt, u), length, None
        )
        x_end, v_end, b, mode, status, t, n, v2, stuck, fv, low, high = out
        rows[i] = np.array([x_end, v_end, b, mode, status, t, n, v2, stuck, fv, low, high])
        if status != kernel.OK:
            return i + 1
        x = x_end
        v = v_end
        belt = b
    return pieces


@numba.njit(error_model="numpy")
def at_nodes(plant, x, v, v_belt, a_belt, u, duration, piece, finer, nodes, weights, rows):  # type: ignore[no-untyped-def]
    """Put times, x, v and weights of a quadrature over ``duration`` into ``rows``; between events it is smooth.

    The pieces are no longer than ``piece``, and then so many times finer.
    Return how many; the rest has no room.
    """
    events = np.empty((kernel.MAX_EVENTS, 4))
    out = kernel.advance(plant, kernel.State(x, v), kernel.Drive(v_belt, a_belt, u), duration, events)
    n_events = out[6]
    t = 0.0
    n = 0
    belt = v_belt
    for event in range(n_events + 1):
        end = events[event, 0] if event < n_events else duration
        pieces = finer * (int((end - t) / piece) + 1)
        length = (end - t) / pieces
        for _ in range(pieces if length > 0.0 else 0):
            for j in range(len(nodes)):
                if n == len(rows):
                    return n
                dt = nodes[j] * length
                out = kernel.advance(
                    kernel.at_time(plant, t), kernel.State(x, v), kernel.Drive(belt, a_belt, u), dt, None
                )
                rows[n, 0] = t + dt
                rows[n, 1] = out[0]
                rows[n, 2] = out[1]
                rows[n, 3] = weights[j] * length
                n += 1
            out = kernel.advance(
                kernel.at_time(plant, t), kernel.State(x, v), kernel.Drive(belt, a_belt, u), length, None
            )
            x = out[0]
            v = out[1]
            belt = out[2]  # as it is returned: a stuck mass has this speed to the bit
            t = t + length
        t = end
    return n


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = 0.5 * (1.0 + _NODES), 0.5 * _WEIGHTS


def run(
    p: OscillatorParameters, at: Start, duration: float, pieces: int, moved: tuple[int, float, float] = (-1, 0, 0)
) -> FloatArray:
    """Return what each piece gave, (n, 12)."""
    rows = np.empty((pieces, 12))
    plant = kernel.at_time(p.plant, at.time)
    i, dx, dv = moved
    done = in_pieces(plant, at.x, at.v, at.v_belt, at.a_belt, at.u, duration, i, float(dx), float(dv), rows)
    return rows[:done]


def excitation_work(p: OscillatorParameters, at: Start, duration: float, size: float) -> float:
    """Return the work of the excitation, by quadrature of this file's own, in finer and finer pieces until it is known
    to a tenth of what the energy balance may miss.

    Raises:
        SetAside: if it does not become known.
    """
    acting = [kind for kind in ("force", "ripple", "stiffness") if getattr(p, f"{kind}_amplitude")]
    piece = min(0.05, *(0.5 / getattr(p, f"{kind}_frequency") for kind in acting))
    plant = kernel.at_time(p.plant, at.time)
    rows = np.empty((10_000, 4))
    before = math.nan
    for halvings in range(11):
        nodes = at_nodes(plant, *at[:5], duration, piece, 2**halvings, _NODES, _WEIGHTS, rows)
        if nodes == len(rows):
            break
        t, x, v, weights = rows[:nodes].T
        power = oracle.exciting_force(p, at.time + t) * v
        power += oracle.stiffness_rate(p, at.time + t) * oracle.potential(p, x)
        work = float(np.sum(weights * power))
        if abs(work - before) < 0.1 * ENERGY * (size + abs(work)):
            return work
        before = work
    raise SetAside("the work of the excitation does not become known")


def forces(
    p: OscillatorParameters, x: float, v: float, belt: float, a_belt: float, u: float, time: float
) -> list[float]:
    """Return the absolute values of all forces."""
    speed, acceleration = (float(part) for part in oracle.ripple(p, time)[1:])
    normal = float(oracle.normal_force(p, x, time))
    w = v - belt - speed
    mu = max(p.mu_s, abs(float(oracle.friction_coefficient(p, w))))
    restoring = float(oracle.restoring(p, x, time))
    return [
        abs(force) for force in (restoring, mu * normal, 2.0 * p.beta * v, u, p.force_amplitude, a_belt, acceleration)
    ]


def grade(what: str, error: float) -> str:
    """Return the kind of a failure: whether the answer is garbage or merely not as exact as promised."""
    return f"{what}: garbage" if not error <= GARBAGE else f"{what}: inexact"


def check_state(p: OscillatorParameters, at: Start, row: FloatArray, begin: float, length: float) -> None:
    """Check what one piece gave on its own: finite values, extremes, mode, cone and contact.

    Raises:
        Failure: if something is wrong.
    """
    x, v, belt, mode, status, reached, _, int_v2, stick_time, _, x_min, x_max = row.tolist()
    if not np.isfinite(row).all():
        raise Failure("not finite", f"not finite: {row.tolist()}")
    if not x_min <= x <= x_max:
        raise Failure("extremes", f"x = {x!r} is not in [x_min, x_max] = [{x_min!r}, {x_max!r}]")
    if not 0.0 <= stick_time <= reached * (1.0 + 1e-12) <= length * (1.0 + 1e-12):
        raise Failure("times", f"of {length!r}, {reached!r} passed and {stick_time!r} was stuck")
    if int_v2 < 0.0:
        raise Failure("integrals", f"the integral of v^2 is {int_v2!r}")
    now = at.time + begin + reached
    normal = float(oracle.normal_force(p, x, now))
    speed = belt + float(oracle.ripple(p, now)[1])
    scale = max(forces(p, x, v, belt, at.a_belt, at.u, now))
    time_error = 4e-16 * now * max(p.ripple_frequency, p.force_frequency, p.stiffness_frequency)
    v_error = 1e-13 * max(1.0, abs(v)) + time_error * p.ripple_amplitude
    if mode == kernel.STICK:
        if abs(v - speed) > v_error:
            raise Failure("creep", f"stuck, but v = {v!r} on a belt at {speed!r}")
        load = abs(float(oracle.stick_load(p, x, belt, at.u, at.a_belt, now, math.copysign(1.0, x))))
        # A mass at x = 0, where alpha = 0, is on one side or the other.
        if p.geometry == "exact" and p.alpha == 0.0 and abs(x) < 1e-13:
            load = min(load, abs(float(oracle.stick_load(p, x, belt, at.u, at.a_belt, now, -math.copysign(1.0, x)))))
            load = min(load, abs(float(oracle.stick_load(p, x, belt, at.u, at.a_belt, now, 0.0))))
        drive = p.force_amplitude + p.ripple_amplitude * p.ripple_frequency
        if load > p.mu_s * normal + 1e-9 * p.mu_s * abs(normal) + (1e-12 + 10.0 * time_error) * (scale + drive):
            raise Failure("cone", f"stuck outside the cone: the load is {load!r}, mu_s N is {p.mu_s * normal!r}")
    elif mode * (v - speed) < -v_error:
        raise Failure("mode", f"mode {mode:g}, but v_rel = {v - speed!r}")
    if status == kernel.OK:
        if normal < -1e-12 * scale:
            raise Failure("contact", f"in contact, but N = {normal!r}")
        if reached != length:
            raise Failure("status", f"status ok, but {reached!r} of {length!r} passed")
    elif status == kernel.CONTACT_LOST and normal > 1e-7 * max(1.0, scale, abs(v)):
        raise Failure("contact", f"contact is said to be lost, but N = {normal!r}")


def energy_residual(p: OscillatorParameters, at: Start, rows: FloatArray) -> float:
    """Return the residual of the energy balance over the sum of the absolute works and energies."""
    x, v = float(rows[-1, X]), float(rows[-1, V])
    reached = INTERVAL * (len(rows) - 1) / max(1, len(rows)) if len(rows) > 1 else 0.0
    reached += float(rows[-1, TIME])
    begin, end = oracle.stiffness(p, at.time), oracle.stiffness(p, at.time + reached)
    energies = (
        0.5 * at.v**2,
        float(begin * oracle.potential(p, at.x)),
        0.5 * v**2,
        float(end * oracle.potential(p, x)),
    )
    works = [-2.0 * p.beta * float(rows[:, INT_V2].sum()), float(rows[:, INT_FV].sum()), at.u * (x - at.x)]
    size = sum(map(abs, energies)) + sum(map(abs, works)) + p.alpha * p.alpha + 1e-3
    if p.excited:
        works.append(excitation_work(p, at, reached, size))
    residual = energies[2] + energies[3] - energies[0] - energies[1] - sum(works)
    return abs(residual) / (size + abs(sum(works[3:])))


def allowed(p: OscillatorParameters, at: Start, rows: FloatArray, duration: float) -> float:
    """Return how large an error of x and v is promised for a run that went as ``rows`` say."""
    greatest = scale = 1.0
    states = [(at.x, at.v, at.v_belt, at.time)]
    states += [(r[X], r[V], r[BELT], at.time + (i + 1) * duration / len(rows)) for i, r in enumerate(rows)]
    for x, v, belt, time in states:
        sizes = forces(p, x, v, belt, at.a_belt, at.u, time)
        greatest = max(greatest, *sizes)
        scale = max(scale, abs(x), abs(v), kernel.STIFF * sum(sizes))
    scale = max(scale, *np.abs(rows[:, [X_MIN, X_MAX]]).ravel().tolist())
    drives = p.force_amplitude * p.force_frequency + p.ripple_amplitude * p.ripple_frequency**2
    late = 1e-15 * (1.0 + at.time) * drives
    return float((PROMISE * scale + ROUNDING * greatest + late) * duration + 4e-16 * scale)


def apart(a: FloatArray, b: FloatArray) -> float:
    """Return how far apart two runs end, infinite if they end for different reasons."""
    if a[-1, STATUS] != b[-1, STATUS]:
        return math.inf
    return float(np.abs(a[-1, [X, V]] - b[-1, [X, V]]).max())


def check_pieces(
    p: OscillatorParameters, at: Start, whole: FloatArray, others: list[FloatArray]
) -> Mapping[str, float]:
    """Check that runs in pieces end where the ``whole`` does.

    The error that is promised at each moment is carried to the end by the flow: where that matters, it is measured, by
    runs in sixteen pieces of which one begins with a state moved by that error, in x and in v, either way. A landing
    that grazes, a breakaway at a piece's end and a motion that blows up are met by the same rule.
    """
    error = allowed(p, at, whole, INTERVAL)
    gap = max(apart(whole, other) for other in others)
    if gap <= error:
        return {"largest gap between pieces over the promised error": gap / error}
    fine = run(p, at, INTERVAL, FINE)
    error = max(error, allowed(p, at, fine, INTERVAL))
    spread = 0.0
    for i in range(len(fine)):
        for dx, dv in ((error, 0.0), (-error, 0.0), (0.0, error), (0.0, -error)):
            if dv and i and fine[i - 1, MODE] == kernel.STICK:
                continue  # a stuck mass has the belt's speed without any error
            spread = max(spread, apart(fine, run(p, at, INTERVAL, FINE, (i, dx, dv))))
    gap = max(apart(fine, other) for other in (whole, *others))
    bound = MARGIN * (spread + error)
    if not gap <= bound:
        ends = "; ".join(
            f"{len(r)}: {r[-1, X]:.12g}, {r[-1, V]:.12g} ({r[-1, STATUS]:g})" for r in (whole, *others, fine)
        )
        raise Failure(
            grade("pieces", gap / max(1.0, *map(abs, fine[-1, [X, V]]))),
            f"pieces end {gap:.3g} apart, {bound:.3g} is allowed: {ends}",
        )
    return {}


def agree(runs: list[FloatArray]) -> bool:
    """Whether runs in pieces are finite, complete and inside their extremes, and end together to within the promise.

    Steps of different lengths do not err alike: one whose answer is garbage ends elsewhere.
    """
    ends = np.array([rows[-1] for rows in runs])
    if not (np.isfinite(ends).all() and (ends[:, STATUS] == kernel.OK).all()):
        return False
    inside = all(((rows[:, X_MIN] <= rows[:, X]) & (rows[:, X] <= rows[:, X_MAX])).all() for rows in runs)
    return inside and float(np.ptp(ends[:, [X, V]], axis=0).max()) <= PROMISE * INTERVAL


def examine(p: OscillatorParameters, at: Start, briefly: bool = False) -> Mapping[str, float]:
    """Check one step of a plant; ``briefly``: no further than that the runs in pieces agree, if they do.

    Raises:
        Failure, SetAside: as of any trial.
    """
    runs = [run(p, at, INTERVAL, pieces) for pieces in (1, 2, 4)]
    if briefly and agree(runs):
        return {}
    for rows in runs:
        for i, row in enumerate(rows):
            pieces = (1, 2, 4)[[r is rows for r in runs].index(True)]
            check_state(p, at, row, i * INTERVAL / pieces, INTERVAL / pieces)
    limited = {kernel.STATUS_NAMES[int(r[-1, STATUS])] for r in runs} & {"step limit", "event limit"}
    if limited:
        raise SetAside(sorted(limited)[0])
    numbers: dict[str, Any] = dict(check_pieces(p, at, runs[0], runs[1:]))
    residual = energy_residual(p, at, runs[0])
    if not residual <= ENERGY:
        raise Failure(
            grade("energy", residual), f"the energy balance misses by {residual:.3g} of the works and energies"
        )
    numbers["largest residual of the energy balance"] = residual
    return numbers


def drawn(seed: int, index: int) -> tuple[OscillatorParameters, Start]:
    """Return the plant and the start of a trial."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng, hard=0.1)
    return p, draws.start(rng, p, INTERVAL)


def described(seed: int, index: int) -> str:
    """Return the plant and the start of a trial as one types them."""
    p, at = drawn(seed, index)
    return f"{draws.described(p)}, {at}"


def trial(seed: int, index: int) -> Mapping[str, float]:
    """Check one step of one random plant."""
    p, at = drawn(seed, index)
    try:
        return examine(p, at, briefly=index % EXAMINED != 0)
    except OverflowError as error:  # the oracle's forces, at what no plant reaches
        raise Failure("not finite", f"{error}\n      {described(seed, index)}") from None
    except Failure as found:
        found.add_note(described(seed, index))
        raise


def prepare() -> None:
    """Compile what the trials call."""
    for friction in ("stribeck", "coulomb"):
        p = OscillatorParameters(friction=friction, force_amplitude=0.1 if friction == "coulomb" else 0.0)
        examine(p, Start(0.5, 0.0, 0.2, 0.0, 0.0, 0.0))


CHECK = Check(
    "steps",
    "single steps: finite, in the cone, honest, energy balanced, the same in 1, 2 and 4 pieces",
    trial,
    prepare,
    described,
    share=4.0,
)
