"""One step of a random legal plant: energy, cone, honest modes, and the same interval in pieces."""

import itertools
import math
import time
from collections.abc import Mapping
from typing import Any

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
PIECES = (1, 2, 4)
FINE = 16
LONGEST = 1.0  # s of processor time that one control interval may take
EXAMINED = 20  # one trial in so many is examined in all respects, others only where runs in pieces do not agree
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_NODES, _WEIGHTS = 0.5 * (1.0 + _NODES), 0.5 * _WEIGHTS


def advance(p: OscillatorParameters, at: Start, duration: float, since: float = 0.0, events: Any = None) -> FloatArray:
    """Return what the kernel gives for one piece that begins a time ``since`` after the start, (12,)."""
    plant = kernel.at_time(kernel.at_time(p.plant, at.time), since)
    drive = kernel.Drive(at.v_belt, at.a_belt, at.u)
    return np.array(kernel.advance(plant, kernel.State(at.x, at.v), drive, duration, events)[:12], float)


def run(
    p: OscillatorParameters, at: Start, duration: float, pieces: int, moved: tuple[int, float, float] = (-1, 0, 0)
) -> FloatArray:
    """Return what each of equal pieces gives, (n, 12), until contact is lost; piece ``moved[0]`` begins with x and v
    moved by the others."""
    rows: list[FloatArray] = []
    state = at
    length = duration / pieces  # a power of two of them: exact
    for i in range(pieces):
        if i == moved[0]:
            state = state._replace(x=state.x + moved[1], v=state.v + moved[2])
        rows.append(advance(p, state, length, i * length))
        if rows[-1][STATUS] != kernel.OK:
            break
        x, v, belt = rows[-1][:3].tolist()
        state = state._replace(x=x, v=v, v_belt=belt)
    return np.array(rows)


def excitation_work(p: OscillatorParameters, at: Start, duration: float, size: float) -> float:
    """Return the work of the excitation, by Gauss-Legendre quadrature between events, in finer and finer pieces until
    it is known to a tenth of what the energy balance may miss.

    Raises:
        SetAside: if it does not become known.
    """
    acting = [kind for kind in ("force", "ripple", "stiffness") if getattr(p, f"{kind}_amplitude")]
    piece = min(0.05, *(0.5 / getattr(p, f"{kind}_frequency") for kind in acting))
    events = np.empty((kernel.MAX_EVENTS, 4))
    n_events = int(advance(p, at, duration, events=events)[EVENTS])
    stretches = list(itertools.pairwise([0.0, *events[:n_events, 0].tolist(), duration]))
    before = math.nan
    for halvings in range(11):
        counts = [2**halvings * (int((end - begin) / piece) + 1) for begin, end in stretches]
        if len(_NODES) * sum(counts) >= 10_000:
            break
        work, state = 0.0, at
        for (begin, end), count in zip(stretches, counts, strict=True):
            length = (end - begin) / count
            for i in range(count if length > 0.0 else 0):
                since = begin + i * length
                rows = np.array([advance(p, state, node * length, since) for node in _NODES])
                t = at.time + since + _NODES * length
                power = oracle.exciting_force(p, t) * rows[:, V]
                power += oracle.stiffness_rate(p, t) * oracle.potential(p, rows[:, X])
                work += float(np.sum(_WEIGHTS * length * power))
                x, v, belt = advance(p, state, length, since)[:3].tolist()
                state = state._replace(x=x, v=v, v_belt=belt)  # as returned: a stuck mass has this speed to the bit
        if abs(work - before) < 0.1 * ENERGY * (size + abs(work)):
            return work
        before = work
    raise SetAside("the work of the excitation does not become known")


def forces(
    p: OscillatorParameters, x: float, v: float, belt: float, a_belt: float, u: float, now: float
) -> list[float]:
    """Return the absolute values of all forces."""
    speed, acceleration = (float(part) for part in oracle.ripple(p, now)[1:])
    normal = float(oracle.normal_force(p, x, now))
    w = v - belt - speed
    mu = max(p.mu_s, abs(float(oracle.friction_coefficient(p, w))))
    restoring = float(oracle.restoring(p, x, now))
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
    reached = INTERVAL * (len(rows) - 1) / len(rows) + float(rows[-1, TIME])
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
    for x, v, belt, now in states:
        sizes = forces(p, x, v, belt, at.a_belt, at.u, now)
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
    runs = [run(p, at, INTERVAL, pieces) for pieces in PIECES]
    if briefly and agree(runs):
        return {}
    for pieces, rows in zip(PIECES, runs, strict=True):
        for i, row in enumerate(rows):
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
    return examine(*drawn(seed, index), briefly=index % EXAMINED != 0)


def drawn_slow(seed: int, index: int) -> tuple[OscillatorParameters, Start, float]:
    """Return a plant that is hard to follow, a start and a control interval."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng, excited=0.5, hard=1.0)
    interval = (10.0, 1.0, draws.number(rng, 1e-4, 10.0))[int(rng.integers(3))]
    return p, draws.start(rng, p, interval), interval


def slow_trial(seed: int, index: int) -> Mapping[str, float]:
    """Measure one control interval."""
    p, at, interval = drawn_slow(seed, index)
    least = math.inf
    for _ in range(3):  # the least time counts
        begun = time.thread_time()
        advance(p, at, interval)
        least = min(least, time.thread_time() - begun)
        if least <= LONGEST:
            return {"slowest control interval, s": least}
    raise Failure("slow", f"a control interval of {interval!r} takes {least:.3g} s")


def described_slow(seed: int, index: int) -> str:
    """Return the plant, the start and the interval of a trial as one types them."""
    p, at, interval = drawn_slow(seed, index)
    return f"{draws.described(p)}, {at}, interval {interval!r}"


CHECK = Check(
    "steps",
    "single steps: finite, in the cone, honest, energy balanced, the same in 1, 2 and 4 pieces",
    trial,
    drawn=described,
    share=4.0,
)
SLOW = Check("slow", "no control interval takes more than a second", slow_trial, drawn=described_slow)
