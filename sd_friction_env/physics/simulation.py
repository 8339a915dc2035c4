"""Simulation in time: samples, events and energy balance of one motion, passive or driven."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import kernel
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, brief_repr, checked_number
from sd_friction_env.physics.tables import Table

_MOST_SAMPLES = 50_000_000
_CHUNK = 4096


def amplitude(x_min: float, x_max: float) -> float:
    """Return the amplitude of a motion with these extremes: half their distance."""
    return 0.5 * (x_max - x_min)


class Event(NamedTuple):
    """A change of mode: its time, its kind and the state there.

    Kinds: "restick" (slip ends in stick), "crossing" (v_rel changes sign without sticking), "grazing" (v_rel touches
    zero), "breakaway" (stick ends), "switching" (x passes 0 where alpha = 0), "contact-loss" (N falls to zero; the
    motion ends).
    """

    time: float
    kind: str
    x: float
    v: float


@dataclass(frozen=True, kw_only=True)
class EnergyBalance:
    """Energy balance: change = damping + contact + control + excitation, each a work done on the mass.

    Attributes:
        change: of x'^2/2 + V(x).
        damping: -2 beta times the integral of x'^2.
        contact: work of the contact force.
        control: work of the control force.
        excitation: work of the exciting force and of the modulated stiffness.
    """

    change: float
    damping: float
    contact: float
    control: float
    excitation: float = 0.0

    @property
    def residual(self) -> float:
        """The change minus all works: zero up to integration errors."""
        return self.change - self.damping - self.contact - self.control - self.excitation

    @property
    def relative_residual(self) -> float:
        """The residual over the sum of the absolute works; 0 if nothing moved."""
        works = abs(self.damping) + abs(self.contact) + abs(self.control) + abs(self.excitation)
        return abs(self.residual) / works if works > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """A motion of the oscillator in time (dimensionless).

    Attributes:
        t, x, v, v_belt: samples, each of shape (n,); the last is at t_end exactly, unless ``status`` is not "ok".
        mode: -1 slip backward, 0 stick, 1 slip forward, of shape (n,).
        events: changes of mode, in order of time.
        stick_time: time spent stuck.
        energy: the energy balance.
        status: "ok", "contact lost", "event limit" or "step limit"; the samples end where it stops being "ok".
        parameters: of the oscillator.
        sensitivities: derivatives of the samples of x and v by what :func:`simulate` was asked for, by name, (n, 2).
        singular_events: number without a derivative (touched, not passed): sensitivities are not valid after the first.
    """

    t: NDArray[np.float64]
    x: NDArray[np.float64]
    v: NDArray[np.float64]
    v_belt: NDArray[np.float64]
    mode: NDArray[np.int8]
    events: tuple[Event, ...]
    stick_time: float
    energy: EnergyBalance
    status: str
    parameters: OscillatorParameters
    sensitivities: Mapping[str, NDArray[np.float64]] = dataclasses.field(default_factory=dict)
    singular_events: int = 0

    def __repr__(self) -> str:
        samples = f"{len(self.t)} samples up to t = {self.t[-1]:.6g}"
        return f"Trajectory({samples}, {len(self.events)} events, {self.stick_time:.6g} stuck, status {self.status!r})"

    def amplitude(self, since: float = 0.0) -> float:
        """Return half the distance between the extremes of the samples of x from time ``since`` on."""
        part = self.x[self.t >= since]
        if not part.size:
            raise ValueError(f"since must not exceed the last time {self.t[-1]!r}, got {since!r}")
        return amplitude(float(part.min()), float(part.max()))

    def to_table(self) -> Table:
        """Return the samples as a table."""
        return Table({"t": self.t, "x": self.x, "v": self.v, "v_belt": self.v_belt, "mode": self.mode})

    def to_dataframe(self) -> Any:
        """Return the samples as a pandas DataFrame (needs pandas)."""
        return self.to_table().to_dataframe()


def simulate(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    t_end: float = 100.0,
    *,
    dt: float = 0.01,
    force: float | ArrayLike = 0.0,
    belt_acceleration: float | ArrayLike = 0.0,
    hold: float | None = None,
    sensitivities: Sequence[str] = (),
) -> Trajectory:
    """Simulate the oscillator from (x, v) at t = 0 to t_end, with its events located exactly.

    Args:
        parameters: of the oscillator; the belt starts at ``parameters.belt_speed``.
        x, v: the start, in [-10, 10]; v defaults to the belt speed, ripple included.
        t_end: end time, in [0, 1e7].
        dt: time between samples, in [1e-6, 1e6].
        force: control force u: a number, or values of shape (m,), each held for ``hold``.
        belt_acceleration: of the belt, likewise.
        hold: duration of each value of an array, in [1e-6, 1e7]; needed with arrays, which must cover t_end.
        sensitivities: names to differentiate by: "x" and "v" (the start), "force" and "belt_acceleration" (as a whole),
            and parameters of the oscillator. Where v defaults to the belt speed it changes with it.

    Raises:
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    rides = v is None
    v = parameters.first_belt_speed if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    t_end = checked_number("t_end", t_end, 0.0, 1e7)
    dt = checked_number("dt", dt, 1e-6, 1e6)
    if t_end / dt > _MOST_SAMPLES:
        raise ValueError(
            f"dt = {dt!r} makes more than {_MOST_SAMPLES} samples up to t_end = {t_end!r}; take a longer dt"
        )
    forces, accelerations = _held_values("force", force), _held_values("belt_acceleration", belt_acceleration)
    hold = _checked_hold(hold, t_end, {"force": forces, "belt_acceleration": accelerations})
    segments = max(forces.size, accelerations.size)
    grid: NDArray[Any] = dt * np.arange(math.floor(t_end / dt * (1.0 + 1e-12)) + 1)
    grid = np.append(grid[grid < t_end * (1.0 - 1e-12)], t_end) if t_end > 0.0 else np.zeros(1)
    rates = _Rates(parameters, sensitivities, rides=rides) if sensitivities else None
    run = _Run(parameters, x, v, float(forces[0]), float(accelerations[0]), rates)
    segment, begin = 0, 0.0
    while begin < t_end and run.status == kernel.OK:
        end = t_end if segment + 1 >= segments else min(t_end, (segment + 1) * hold)
        u = float(forces[min(segment, forces.size - 1)])
        a_belt = float(accelerations[min(segment, accelerations.size - 1)])
        inside = grid[(np.searchsorted(grid, begin, "right")) : np.searchsorted(grid, end, "right")]
        run.advance(begin, end, u, a_belt, inside)
        segment, begin = segment + 1, end
    return run.trajectory()


class _Run:
    """A simulation in progress: the state, and what has been recorded and integrated so far."""

    def __init__(
        self, parameters: OscillatorParameters, x: float, v: float, u: float, a_belt: float, rates: "_Rates | None"
    ) -> None:
        self.parameters, self.plant, self.rates = parameters, parameters.plant, rates
        self.x, self.v, self.belt = x, v, parameters.belt_speed
        self.status, self.mode, self.drive = kernel.OK, kernel.UNKNOWN, (0.0, 0.0)
        self.start_energy = 0.5 * v * v + kernel.energy_in_spring(self.plant, x)
        mode = kernel.mode_of(self.plant, kernel.State(x, v), kernel.Drive(self.belt, a_belt, u))
        self.parts = [np.array([[0.0, x, v, self.belt, mode]])]
        self.events: list[Event] = []
        self.damping = self.contact = self.control = self.excitation = self.stick_time = 0.0

    def advance(self, begin: float, end: float, u: float, a_belt: float, inside: NDArray[np.float64]) -> None:
        """Advance from ``begin`` to ``end`` under one drive, with samples at the times ``inside``."""
        if (u, a_belt) != self.drive:
            self.mode = kernel.UNKNOWN  # the drive has jumped
        self.drive = u, a_belt
        times = inside - begin
        extra = not inside.size or inside[-1] < end  # then the end is not a sample
        if extra:
            times = np.append(times, end - begin)
        done, x_begin, t0 = 0, self.x, begin
        while done < times.size and self.status == kernel.OK:
            piece = times[done : done + _CHUNK] - (t0 - begin)
            samples, reached = self._trace(t0, piece)
            taken = len(samples)
            stamps = t0 + piece[:taken]
            at_end = done + taken == times.size
            if self.status != kernel.OK:
                stamps[-1] = t0 + reached
            elif at_end:
                stamps[-1] = end
            keep = taken - 1 if extra and self.status == kernel.OK and at_end else taken
            if self.rates:
                self.rates.keep(taken, keep)
            self.parts.append(np.column_stack((stamps[:keep], samples[:keep])))
            t0 = float(stamps[-1])
            done += taken
        self.control += u * (self.x - x_begin)

    def _trace(self, t0: float, piece: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Advance through a piece of sample times, counted from t0; return the samples taken and the time reached."""
        u, a_belt = self.drive
        state, drive = kernel.State(self.x, self.v), kernel.Drive(self.belt, a_belt, u)
        samples = np.empty((piece.size, 4))
        buffer = np.empty((max(4 * kernel.MAX_EVENTS, piece.size), 4))
        now = kernel.at_time(self.plant, t0)
        if self.rates:
            self.rates.trace(now, self.mode, state, drive, piece)
        taken, n_events, self.status, reached, int_v2, stuck, int_fv = kernel.trace(
            now, self.mode, state, drive, piece, samples, buffer
        )
        if self.parameters.excited:
            self.excitation += kernel.excitation_work(now, state, drive, reached, buffer[:n_events])
        self.events += [Event(t0 + e[0], kernel.EVENT_NAMES[int(e[1])], e[2], e[3]) for e in buffer[:n_events].tolist()]
        self.damping -= 2.0 * self.parameters.beta * int_v2
        self.contact += int_fv
        self.stick_time += stuck
        self.x, self.v, self.belt, mode = samples[taken - 1].tolist()
        self.mode = int(mode)
        return samples[:taken], reached

    def trajectory(self) -> Trajectory:
        """Return what was recorded."""
        p, table = self.parameters, np.concatenate(self.parts)
        if p.ripple_amplitude > 0.0:
            table[:, 3] += p.ripple_amplitude * np.cos(p.ripple_frequency * table[:, 0] + p.ripple_phase)
        in_spring = kernel.energy_in_spring(kernel.at_time(self.plant, float(table[-1, 0])), self.x)
        return Trajectory(
            t=table[:, 0],
            x=table[:, 1],
            v=table[:, 2],
            v_belt=table[:, 3],
            mode=table[:, 4].astype(np.int8),
            events=tuple(self.events),
            stick_time=self.stick_time,
            energy=EnergyBalance(
                change=0.5 * self.v * self.v + in_spring - self.start_energy,
                damping=self.damping,
                contact=self.contact,
                control=self.control,
                excitation=self.excitation,
            ),
            status=kernel.STATUS_NAMES[self.status],
            parameters=p,
            sensitivities=self.rates.by_name() if self.rates else {},
            singular_events=self.rates.singular if self.rates else 0,
        )


class _Rates:
    """The tangents of a simulation in progress, in named directions."""

    def __init__(self, parameters: OscillatorParameters, names: Sequence[str], *, rides: bool) -> None:
        try:
            different = not isinstance(names, str) and len(set(names)) == len(names)
        except TypeError:
            different = False
        if not different:
            raise ValueError(f"sensitivities must be different names, got {brief_repr(names)}")
        starts = {"x": kernel.TANGENT_X, "v": kernel.TANGENT_V, "force": kernel.TANGENT_U}
        starts |= {"belt_speed": kernel.TANGENT_BELT, "belt_acceleration": kernel.TANGENT_A_BELT}
        self.names = tuple(names)
        self.ordered = sorted(names, key=lambda name: name not in starts)  # those that change the plant are the last
        self.tangents = np.zeros((kernel.TANGENT_ROWS, len(names)))
        changes = []
        # The speed of a mass that rides with the belt at first.
        angle, size = parameters.ripple_phase, parameters.ripple_amplitude
        riding = {"belt_speed": 1.0, "ripple_amplitude": math.cos(angle), "ripple_phase": -size * math.sin(angle)}
        for column, name in enumerate(self.ordered):
            if name in starts:
                self.tangents[starts[name], column] = 1.0
            else:
                changes.append(parameters.plant_change(name))
            if rides:
                self.tangents[kernel.TANGENT_V, column] += riding.get(name, 0.0)
        self.directions = np.array(changes) if changes else None
        self.parts = [self.tangents[None, :2].copy()]
        self.singular = 0

    def trace(self, plant: Any, mode: int, state: Any, drive: Any, times: NDArray[np.float64]) -> None:
        """Follow the tangents through a piece of sample times."""
        samples = np.full((times.size, 2, len(self.names)), math.nan)
        _, touched = kernel.trace_with_tangents(
            plant, mode, state, drive, times, self.tangents, self.directions, samples
        )
        self.singular += touched
        self.parts.append(samples)

    def keep(self, taken: int, kept: int) -> None:
        """Drop those of the last samples that are not kept, or not taken."""
        self.parts[-1] = self.parts[-1][: min(taken, kept)]

    def by_name(self) -> dict[str, NDArray[np.float64]]:
        """Return the derivatives of x and v, (n, 2), by name."""
        samples = np.concatenate(self.parts)
        return {name: samples[:, :, self.ordered.index(name)] for name in self.names}


def _checked_hold(hold: float | None, t_end: float, drives: dict[str, NDArray[np.float64]]) -> float:
    """Return how long each value of the drives is held."""
    if max(values.size for values in drives.values()) == 1:
        return t_end
    if hold is None:
        raise ValueError("hold must be given with an array of forces or belt accelerations: the duration of each value")
    hold = checked_number("hold", hold, 1e-6, 1e7)
    for name, values in drives.items():
        if values.size > 1 and values.size * hold < t_end * (1.0 - 1e-12):
            raise ValueError(f"{name} has {values.size} values held {hold!r} each, too few to reach t_end = {t_end!r}")
    return hold


def _held_values(name: str, values: Any) -> NDArray[np.float64]:
    try:
        array = np.atleast_1d(np.asarray(values, dtype=np.float64))
    except OverflowError:
        raise ValueError(f"{name} must be finite and within [-1e6, 1e6], got {brief_repr(values)}") from None
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a number or an array of numbers, got {brief_repr(values)}") from None
    if array.ndim != 1 or not array.size:
        raise ValueError(f"{name} must have shape (m,) with m >= 1, got shape {array.shape}")
    if not np.all(np.isfinite(array)) or np.abs(array).max() > 1e6:
        worst = array[~(np.abs(array) <= 1e6)][0]
        raise ValueError(f"{name} must be finite and within [-1e6, 1e6], got {worst!r} among its values")
    return array
