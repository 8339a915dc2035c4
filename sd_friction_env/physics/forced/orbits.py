"""Periodic orbits under excitation: fixed points of the stroboscopic map, closed by Newton's method."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.forced.sections import MOST_CYCLES, Stroboscope, at_phase, stroboscope
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_count
from sd_friction_env.physics.simulation import Trajectory, amplitude, simulate
from sd_friction_env.physics.theory import FloatArray

_SAME_POINT = 1e-6  # section points closer than this repeat, before Newton's method decides
_CONVERGED = 1e-10
_NEWTON_STEPS = 25
_SETTLINGS = 8  # transients after which a motion without repetition counts as not settling


@dataclass(frozen=True, kw_only=True, eq=False)
class ForcedOrbit:
    """A periodic motion under excitation.

    Attributes:
        multiple: number of cycles of the excitation in one period.
        period: duration of the orbit.
        x, v: the state at the section's phase.
        phase: of the section, a share of the excitation's cycle.
        points: the section points (x, v) of one period, (multiple, 2); the first is (x, v).
        amplitude, x_min, x_max: (x_max - x_min)/2 and the extremes of x.
        stick_fraction: share of the period spent stuck.
        sticks, forward_arcs: numbers that begin in a period.
        multipliers: Floquet multipliers, the greater modulus first; the second is 0 where the motion sticks.
        stable: whether both moduli are less than 1.
        singular_events: events in a period without a derivative; the multipliers are valid only if it is 0.
        parameters: of the oscillator.
    """

    multiple: int
    period: float
    x: float
    v: float
    phase: float
    points: FloatArray
    amplitude: float
    x_min: float
    x_max: float
    stick_fraction: float
    sticks: int
    forward_arcs: int
    multipliers: tuple[complex, complex]
    stable: bool
    singular_events: int
    parameters: OscillatorParameters

    def trajectory(self, samples: int = 1000) -> Trajectory:
        """Return one period of the motion; its time begins at the section, and its parameters' phases with it."""
        moved = at_phase(self.parameters, self.phase * self.period / self.multiple)
        return simulate(
            moved, self.x, self.v, self.period, dt=self.period / checked_count("samples", samples, 1, 10**7)
        )


def forced_orbit(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    multiple: int | None = None,
    most: int = 32,
    transient: int = 200,
    phase: float = 0.0,
    period: float | None = None,
) -> ForcedOrbit:
    """Return the periodic orbit that the motion from (x, v) settles on, or near which it starts.

    After the transient, Newton's method on the stroboscopic map with its tangent closes the orbit to 1e-10; a motion
    that sticks is found as soon as its sticks repeat.

    Args:
        parameters, x, v, phase: as in :func:`poincare_section`.
        multiple: period of the orbit in cycles of the excitation, from 1 on; by default the least after which the
            settled motion repeats. With it and transient = 0 unstable orbits are found too, from a start near by.
        most: the greatest multiple that is searched.
        transient: cycles followed before, from 0 on.
        period: as in :func:`poincare_section`; the excitation must repeat after it.

    Raises:
        OrbitError: if the mass loses contact, or no such orbit is reached.
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    if multiple is not None:
        multiple = checked_count("multiple", multiple, 1, 10_000)
    most, transient = checked_count("most", most, 1, 10_000), checked_count("transient", transient, 0, MOST_CYCLES)
    strobe = stroboscope(parameters, period, phase, repeats=True)
    state = strobe.checked_start(x, v)
    if multiple is not None:
        if transient:
            state = strobe.follow(state, transient - 1, 1).end
        found = _closed_orbit(strobe, state, multiple)
        if found is None:
            raise OrbitError(
                f"no orbit of multiple {multiple} near x = {state[0]:.6g}, v = {state[1]:.6g}; {parameters}"
            )
        return found
    for _ in range(_SETTLINGS):
        cycles = strobe.follow(state, transient, 2 * most)
        points, state = cycles.rows[:, :2], cycles.end
        for candidate in range(1, most + 1):
            if np.abs(points[candidate:] - points[:-candidate]).max() < _SAME_POINT:
                found = _closed_orbit(strobe, state, candidate)
                if found is not None:
                    return found
                break
    raise OrbitError(f"the motion from x = {x!r} does not settle on an orbit of multiple up to {most}; {parameters}")


def lap_with_tangents(strobe: Stroboscope, state: tuple[float, float], multiple: int) -> tuple[Any, FloatArray]:
    """Return where ``multiple`` periods from a state end (``kernel.TangentMotion``), and the tangent map, (2, 2)."""
    tangents = np.zeros((kernel.TANGENT_ROWS, 2))
    tangents[kernel.TANGENT_X, 0] = tangents[kernel.TANGENT_V, 1] = 1.0
    return _advance(strobe, state, multiple * strobe.period, tangents), tangents[:2]


def _advance(strobe: Stroboscope, state: tuple[float, float], duration: float, tangents: FloatArray) -> Any:
    belt = kernel.steady(strobe.parameters.belt_speed)
    start = kernel.State(*map(float, state))
    return kernel.advance_with_tangents(strobe.plant, kernel.UNKNOWN, start, belt, duration, tangents, None)


def _end(strobe: Stroboscope, state: tuple[float, float], duration: float) -> tuple[float, float] | None:
    end = _advance(strobe, state, duration, np.empty((kernel.TANGENT_ROWS, 0)))
    return (end.x, end.v) if end.status == kernel.OK else None


def time_away_from_events(strobe: Stroboscope, state: tuple[float, float], multiple: int) -> float:
    """Return the middle of the longest stretch without an event in ``multiple`` periods from a state.

    A section that falls on an event has no derivative; multipliers are those of any other section of the orbit.
    """
    events = np.empty((kernel.MAX_EVENTS, 4))
    belt, duration = kernel.steady(strobe.parameters.belt_speed), multiple * strobe.period
    motion = kernel.advance(strobe.plant, kernel.State(*map(float, state)), belt, duration, events)
    times = np.concatenate(([0.0], events[: motion.n_events, 0], [motion.time]))
    longest = int(np.argmax(np.diff(times)))
    return float(0.5 * (times[longest] + times[longest + 1])) if motion.n_events else 0.0


def _converged_state(strobe: Stroboscope, state: tuple[float, float], multiple: int) -> tuple[float, float] | None:
    """Return the fixed point that Newton's method finds from a state, or None."""
    start = np.array(state)
    for _ in range(_NEWTON_STEPS):
        place = float(start[0]), float(start[1])
        end, tangent = lap_with_tangents(strobe, place, multiple)
        if end.status != kernel.OK:
            return None
        error = np.array(end[:2]) - start
        if np.abs(error).max() < _CONVERGED:
            return place
        try:
            start = start + np.linalg.solve(np.eye(2) - tangent, error)
        except np.linalg.LinAlgError:
            return None
        if not np.abs(start).max() <= STATE_LIMIT:
            return None
    return None


def _closed_orbit(strobe: Stroboscope, state: tuple[float, float], multiple: int) -> ForcedOrbit | None:
    """Return the orbit of this multiple, or of a divisor, that Newton's method finds from a state, or None."""
    time = time_away_from_events(strobe, state, multiple)
    away = strobe._replace(phase=strobe.phase + time / strobe.period)
    begin = _end(strobe, state, time)
    found = None if begin is None else _converged_state(away, begin, multiple)
    return None if found is None else orbit_at(strobe, away, found, multiple)


def orbit_at(strobe: Stroboscope, away: Stroboscope, found: tuple[float, float], multiple: int) -> ForcedOrbit | None:
    """Return the orbit of a fixed point of a section ``away`` from events as one of ``strobe``'s, or None."""
    start = _end(away, found, (strobe.phase - away.phase) % multiple * strobe.period)
    if start is None:
        return None
    end, tangent = lap_with_tangents(away, found, multiple)
    points = np.concatenate((np.array([start]), strobe.follow(start, 0, multiple).rows[:-1, :2]))
    for divisor in range(1, multiple):
        if multiple % divisor == 0 and np.abs(points[divisor] - points[0]).max() < 10.0 * _CONVERGED:
            return _closed_orbit(strobe, start, divisor)
    if end.ever_stuck:
        first, second = complex(np.trace(tangent)), 0j
    else:
        first, second = sorted((complex(m) for m in np.linalg.eigvals(tangent)), key=abs, reverse=True)
    return ForcedOrbit(
        multiple=multiple,
        period=multiple * strobe.period,
        x=start[0],
        v=start[1],
        phase=strobe.phase,
        points=points,
        amplitude=amplitude(end.x_min, end.x_max),
        x_min=end.x_min,
        x_max=end.x_max,
        stick_fraction=end.stick_time / end.time,
        sticks=end.sticks,
        forward_arcs=end.forward_arcs,
        multipliers=(first, second),
        stable=abs(first) < 1.0,
        singular_events=end.touched,
        parameters=strobe.parameters,
    )
