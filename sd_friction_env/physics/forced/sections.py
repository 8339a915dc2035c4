"""Stroboscopic (Poincare) sections: the state at one phase of each cycle of the excitation."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env import kernel
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import (
    EXCITATIONS,
    STATE_LIMIT,
    OscillatorParameters,
    checked_count,
    checked_number,
)
from sd_friction_env.physics.simulation import amplitude
from sd_friction_env.physics.tables import Table
from sd_friction_env.physics.theory import FloatArray

MOST_CYCLES = 10_000_000
_LONGEST_PERIOD = 1e4
_SAME_FREQUENCY = 1e-12


class Cycles(NamedTuple):
    """What the stroboscope recorded of each cycle.

    Attributes:
        rows: (n, 8), with columns ``kernel.CYCLE_X`` and so on.
        growth: logarithms of the growth of two tangent vectors, (n, 2), or (0, 2) if not asked for.
        singular_events: number of events without a derivative.
    """

    rows: FloatArray
    growth: FloatArray
    singular_events: int

    @property
    def end(self) -> tuple[float, float]:
        """The last state (x, v)."""
        return float(self.rows[-1, kernel.CYCLE_X]), float(self.rows[-1, kernel.CYCLE_V])


class Stroboscope(NamedTuple):
    """An oscillator seen once every ``period``, at a ``phase``: a share of the period, counted from t = 0."""

    parameters: OscillatorParameters
    period: float
    phase: float = 0.0

    @property
    def plant(self) -> kernel.Plant:
        """The plant at the first section, in its excited form, so that the kernel is compiled for one form only."""
        return self.parameters.excited_plant(self.phase * self.period)

    def checked_start(self, x: float, v: float | None) -> tuple[float, float]:
        """Return the start (x, v); v is by default the belt's speed at the first section, ripple included.

        Raises:
            TypeError, ValueError: if x or v is not a number in [-10, 10].
        """
        x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
        if v is None:
            return x, float(self.plant.excitation.lab_velocity(self.parameters.belt_speed))
        return x, checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)

    def follow(self, state: tuple[float, float], transient: int, cycles: int, *, growing: bool = False) -> Cycles:
        """Return ``cycles`` cycles that follow a transient.

        Raises:
            OrbitError: if the mass loses contact, or the motion cannot be followed.
        """
        rows, growth = np.empty((cycles, kernel.CYCLE_ROW)), np.empty((cycles if growing else 0, 2))
        x, v, status, written, singular = kernel.stroboscope(
            self.plant, *state, self.parameters.belt_speed, self.period, transient, rows, growth
        )
        if status != kernel.OK:
            raise lost_motion(self.parameters, (x, v), status, transient + written)
        return Cycles(rows, growth, int(singular))


def lost_motion(parameters: OscillatorParameters, state: tuple[float, float], status: int, cycle: int) -> OrbitError:
    """Return the error for a motion that ends with a status other than OK."""
    reason = f"the motion cannot be followed ({kernel.STATUS_NAMES[status]})"
    if status == kernel.CONTACT_LOST:
        reason = "the mass loses contact with the belt (N <= 0)"
    return OrbitError(f"{reason} at x = {state[0]:.6g}, v = {state[1]:.6g} in cycle {cycle}; {parameters}")


def active_excitations(parameters: OscillatorParameters, swept: str = "") -> list[str]:
    """Return the names of the excitations that act, or will where an amplitude is swept."""
    return [
        kind for kind in EXCITATIONS if getattr(parameters, f"{kind}_amplitude") > 0.0 or f"{kind}_amplitude" == swept
    ]


def at_phase(parameters: OscillatorParameters, time: float) -> OscillatorParameters:
    """Return the oscillator whose excitation is at t = 0 what it is here at a time."""
    phases = {
        f"{kind}_phase": math.remainder(
            getattr(parameters, f"{kind}_phase") + time * getattr(parameters, f"{kind}_frequency"), 2.0 * math.pi
        )
        for kind in EXCITATIONS
    }
    return parameters.replace(**phases)


def drive_period(parameters: OscillatorParameters) -> float:
    """Return the period of the excitation, 2 pi/frequency.

    Raises:
        ValueError: without excitation, or if several act with different frequencies.
    """
    return common_period(parameters, active_excitations(parameters))


def common_period(parameters: OscillatorParameters, acting: list[str]) -> float:
    """Return the period of the excitations ``acting``; raise ValueError as :func:`drive_period`."""
    rates = {f"{kind}_frequency": float(getattr(parameters, f"{kind}_frequency")) for kind in acting}
    if not rates:
        raise ValueError(
            "parameters must be excited (force_amplitude, ripple_amplitude or stiffness_amplitude over 0), "
            f"got {parameters!r}; without, see sd_friction_env.physics.orbits"
        )
    low, high = min(rates.values()), max(rates.values())
    if high - low > _SAME_FREQUENCY * high:
        shown = ", ".join(f"{name} = {rate!r}" for name, rate in rates.items())
        raise ValueError(f"period= must be given where excitations have different frequencies, got {shown}")
    return 2.0 * math.pi / low


def checked_period(parameters: OscillatorParameters, period: float | None, *, repeats: bool) -> float:
    """Return the time between sections; ``repeats``: the excitation must be the same after it."""
    if period is None:
        return drive_period(parameters)
    period = checked_number("period", period, 1e-3, _LONGEST_PERIOD)
    for kind in active_excitations(parameters) if repeats else ():
        turns = period * getattr(parameters, f"{kind}_frequency") / (2.0 * math.pi)
        if abs(turns - round(turns)) > 1e-9 * max(1.0, turns) or round(turns) < 1:
            raise ValueError(
                f"period must be a multiple of 2 pi/{kind}_frequency, so that the excitation repeats, got {period!r}"
            )
    return period


def stroboscope(
    parameters: OscillatorParameters, period: float | None, phase: float = 0.0, *, repeats: bool = False
) -> Stroboscope:
    """Return the stroboscope with these arguments checked; see :func:`checked_period`.

    Raises:
        TypeError, ValueError: if the phase is not in [0, 1), or the period not as required.
    """
    phase = checked_number("phase", phase, 0.0, 1.0)
    if phase == 1.0:
        raise ValueError("phase must be in [0, 1), a share of the excitation's cycle, got 1.0")
    return Stroboscope(parameters, checked_period(parameters, period, repeats=repeats), phase)


def poincare_section(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 200,
    phase: float = 0.0,
    period: float | None = None,
) -> Table:
    """Return the states at one phase of the excitation's cycles.

    Args:
        parameters: of the oscillator.
        x, v: the start, in [-10, 10], at the section's phase; v defaults to the belt's speed, ripple included.
        cycles: number recorded, from 1 on.
        transient: number of cycles followed before them, from 0 on.
        phase: of the section, in [0, 1): a share of the cycle, counted from t = 0.
        period: time between sections; by default :func:`drive_period`.

    Returns:
        A table with a row for each cycle: cycle, x, v and mode at its end; stick_fraction, sticks and forward_arcs
        (numbers that begin in it), x_min and x_max in it.

    Raises:
        OrbitError: if the mass loses contact.
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    cycles = checked_count("cycles", cycles, 1, MOST_CYCLES)
    transient = checked_count("transient", transient, 0, MOST_CYCLES)
    strobe = stroboscope(parameters, period, phase)
    rows = strobe.follow(strobe.checked_start(x, v), transient, cycles).rows
    columns: dict[str, Any] = {
        "cycle": np.arange(transient, transient + cycles),
        "x": rows[:, kernel.CYCLE_X],
        "v": rows[:, kernel.CYCLE_V],
        "mode": rows[:, kernel.CYCLE_MODE].astype(np.int8),
        "stick_fraction": rows[:, kernel.CYCLE_STICK_TIME] / strobe.period,
        "sticks": rows[:, kernel.CYCLE_STICKS].astype(np.int64),
        "forward_arcs": rows[:, kernel.CYCLE_FORWARD_ARCS].astype(np.int64),
        "x_min": rows[:, kernel.CYCLE_X_MIN],
        "x_max": rows[:, kernel.CYCLE_X_MAX],
    }
    metadata = {"parameters": dataclasses.asdict(parameters), "period": strobe.period, "phase": strobe.phase}
    return Table(columns, metadata)


def dithered_amplitude(
    parameters: OscillatorParameters,
    x: float = 0.0,
    v: float | None = None,
    *,
    cycles: int = 1000,
    transient: int = 20_000,
) -> float:
    """Return the amplitude under a fast exciting force minus that of the fast motion itself, f/Omega^2.

    Fast dither smooths the friction that drives the vibration: on the linear belt the rest falls to zero once
    f/Omega passes :func:`theory.dither_threshold`. Source: Thomsen (1999), J. Sound Vib. 228, 1079-1102.

    Args:
        parameters: of the oscillator, with force_amplitude over 0.
        x, v: the start, as in :func:`poincare_section`.
        cycles: of the force in which the extremes of x are taken, from 1 on.
        transient: cycles followed before, from 0 on; near v_b1, where the vibration decays slowly, it takes many.

    Raises:
        OrbitError: if the mass loses contact.
        TypeError, ValueError: if an argument is not of the type or in the range above.
    """
    if parameters.force_amplitude == 0.0:
        raise ValueError(f"parameters must have force_amplitude over 0, got {parameters!r}")
    rate = parameters.force_frequency
    section = poincare_section(parameters, x, v, cycles=cycles, transient=transient, period=2.0 * math.pi / rate)
    whole = amplitude(float(section["x_min"].min()), float(section["x_max"].max()))
    return whole - parameters.force_amplitude / (rate * rate)
