"""Periodic orbits under excitation: fixed points of the stroboscopic map, closed by Newton's method."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.forced.sections import MOST_CYCLES, Stroboscope, stroboscope
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_count
from sd_friction_env.physics.simulation import amplitude
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


def lap_with_tangents(
    strobe: Stroboscope, state: tuple[float, float], multiple: int, *, in_sections: bool = True
) -> tuple[Any, FloatArray]:
    """Return where ``kernel.integrate_with_tangents`` ends after ``multiple`` periods, and the tangent map (2, 2)."""
    vectors = np.eye(2)
    events = np.empty((kernel.MAX_EVENTS, 4))
    belt_speed, duration = strobe.parameters.belt_speed, multiple * strobe.period
    end = kernel.integrate_with_tangents(strobe.plant, *state, belt_speed, duration, events, vectors, in_sections)
    return end, vectors.T


def _converged_state(strobe: Stroboscope, state: tuple[float, float], multiple: int) -> tuple[float, float] | None:
    """Return the fixed point that Newton's method finds from a state, or None."""
    start = np.array(state)
    for _ in range(_NEWTON_STEPS):
        place = float(start[0]), float(start[1])
        end, tangent = lap_with_tangents(strobe, place, multiple, in_sections=False)
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
    start = _converged_state(strobe, state, multiple)
    if start is None:
        return None
    end, tangent = lap_with_tangents(strobe, start, multiple)
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
        singular_events=end.singular_events,
        parameters=strobe.parameters,
    )
