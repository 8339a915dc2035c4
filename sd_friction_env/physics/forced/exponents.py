"""Lyapunov exponents, from the tangent flow of a motion or from the period or eigenvalues of its attractor."""

import math
from dataclasses import dataclass

import numpy as np

from sd_friction_env.physics.forced.orbits import lap_with_tangents
from sd_friction_env.physics.forced.sections import MOST_CYCLES, Cycles, Stroboscope, stroboscope
from sd_friction_env.physics.orbits import LimitCycle, equilibria, limit_cycle
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count

BATCHES = 20  # whose means give an exponent's standard error


@dataclass(frozen=True, kw_only=True)
class LyapunovExponent:
    """Rate at which neighbouring motions separate (per unit of time).

    Attributes:
        largest: the largest nontrivial exponent. Under excitation the phase is no state, and both exponents count;
            without, the one along the flow is 0 and left out. Minus infinity where sticking leaves no other direction.
        standard_error: of ``largest``, from the means of 20 batches; 0 where it follows from one period.
        exponents: both, the greater first; the second is minus infinity where the motion sticks.
        cycles: of the excitation that were averaged over; 0 without excitation.
        singular_events: events without a derivative (grazing), which are passed over.
        x, v: the state at the end.
        parameters: of the oscillator.
    """

    largest: float
    standard_error: float
    exponents: tuple[float, float]
    cycles: int
    singular_events: int
    x: float
    v: float
    parameters: OscillatorParameters


def lyapunov_exponent(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 200,
    period: float | None = None,
) -> LyapunovExponent:
    """Return the Lyapunov exponents of the motion that starts at (x, v), from the tangent flow.

    Without excitation the attractor's own period or eigenvalues give them exactly: a steady state the greatest real
    part, a pure-slip cycle ln|Floquet multiplier|/period, a stick-slip cycle minus infinity, and a mass at rest on a
    standing belt, which is neutral, 0.

    Args:
        parameters: of the oscillator.
        x, v: the start, as in :func:`poincare_section`, at t = 0.
        cycles: of the excitation to average over, from 20 on.
        transient: cycles to follow before, from 0 on.
        period: of renormalisation; by default :func:`drive_period`.

    Raises:
        OrbitError: if the mass loses contact, or an unexcited motion does not settle.
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    cycles = checked_count("cycles", cycles, BATCHES, MOST_CYCLES)
    transient = checked_count("transient", transient, 0, MOST_CYCLES)
    if not parameters.excited:
        return _passive_exponent(limit_cycle(parameters, x, v))
    strobe = stroboscope(parameters, period)
    return exponent_of(strobe, strobe.follow(strobe.checked_start(x, v), transient, cycles, growing=True))


def exponent_of(strobe: Stroboscope, cycles: Cycles) -> LyapunovExponent:
    """Return the exponents from the growth recorded over some cycles."""
    growth, period = cycles.growth, strobe.period
    first, second = (float(rate) for rate in growth.mean(axis=0) / period)
    error = 0.0
    if math.isfinite(first):
        used = len(growth) // BATCHES * BATCHES
        means = growth[len(growth) - used :, 0].reshape(BATCHES, -1).mean(axis=1) / period
        error = float(means.std(ddof=1)) / math.sqrt(BATCHES)
    x, v = cycles.end
    return LyapunovExponent(
        largest=max(first, second),
        standard_error=error,
        exponents=(max(first, second), min(first, second)),
        cycles=len(cycles.rows),
        singular_events=cycles.singular_events,
        x=x,
        v=v,
        parameters=strobe.parameters,
    )


def _passive_exponent(cycle: LimitCycle) -> LyapunovExponent:
    singular = 0
    if cycle.kind == "pure-slip":
        strobe = Stroboscope(cycle.parameters, cycle.period)
        end, tangent = lap_with_tangents(strobe, (cycle.x_phase0, cycle.v_phase0), 1)
        singular = int(end.touched)
        # One multiplier is 1, along the flow.
        largest = math.log(abs(float(np.linalg.det(tangent)))) / cycle.period
        exponents = (0.0, largest) if largest < 0.0 else (largest, 0.0)
    elif cycle.kind == "steady-slip":
        place = min(equilibria(cycle.parameters), key=lambda e: abs(e.x - cycle.x_max))
        parts = sorted((value.real for value in place.eigenvalues), reverse=True)
        largest, exponents = parts[0], (parts[0], parts[1])
    else:
        largest, exponents = {
            "neutral": (0.0, (0.0, 0.0)),
            "rest": (0.0, (0.0, -math.inf)),
            "stick-slip": (-math.inf, (0.0, -math.inf)),
        }[cycle.kind]
    return LyapunovExponent(
        largest=largest,
        standard_error=0.0,
        exponents=exponents,
        cycles=0,
        singular_events=singular,
        x=cycle.x_phase0,
        v=cycle.v_phase0,
        parameters=cycle.parameters,
    )
