"""Closed orbits and steady states: one lap measured from a point that lies on the orbit."""

import functools
import math
from dataclasses import dataclass, field
from typing import Literal

from sd_friction_env import kernel
from sd_friction_env.physics import simulation
from sd_friction_env.physics.orbits.balance import SMALLEST_RADIUS, traps_of
from sd_friction_env.physics.parameters import OscillatorParameters, checked_number
from sd_friction_env.physics.theory import FloatArray

Kind = Literal["stick-slip", "pure-slip", "steady-slip", "neutral", "rest"]


class OrbitError(ValueError):
    """The passive motion has no attractor that can be named: it loses contact, or does not settle."""


class ContactLossError(OrbitError):
    """The motion loses contact with the belt (N <= 0)."""


@dataclass(frozen=True, kw_only=True)
class LimitCycle:
    """An attractor of the passive oscillator (dimensionless; a steady state has amplitude 0 and no period).

    Attributes:
        kind: "stick-slip", "pure-slip", "steady-slip" (the mass stands on the sliding belt), "rest" (belt speed 0) or
            "neutral": one of a family of closed orbits, none of which attracts, because slip conserves energy there
            (beta = 0 and level friction). :func:`limit_cycle` returns the start's own orbit,
            :func:`attractors` one entry for each family, its outermost orbit.
        amplitude: (x_max - x_min)/2.
        period, frequency, angular_frequency: T, 1/T and 2 pi/T; NaN for a steady state.
        stick_fraction: share of the period spent stuck.
        x_max, x_min: extremes of x.
        mean_square_velocity: mean of x'^2 over a period.
        x_phase0, v_phase0: the state at phase 0: breakaway in stick-slip, the maximum of x in pure slip.
        x_breakaway, x_restick: where stick ends and where it last began; NaN without stick.
        sticks, forward_arcs: numbers of sticks and of forward-slip arcs in one period.
        floquet_multiplier: 0 for stick-slip (superstable), the return map's slope for pure slip, 1 for a neutral
            orbit, NaN otherwise.
        x_start, v_start: the start that reaches this attractor.
        parameters: of the oscillator.
    """

    kind: Kind
    amplitude: float = field(init=False)
    period: float = math.nan
    frequency: float = field(init=False)
    angular_frequency: float = field(init=False)
    stick_fraction: float = 0.0
    x_max: float
    x_min: float
    mean_square_velocity: float = 0.0
    x_phase0: float
    v_phase0: float
    x_breakaway: float = math.nan
    x_restick: float = math.nan
    sticks: int = 0
    forward_arcs: int = 0
    floquet_multiplier: float = math.nan
    x_start: float
    v_start: float
    parameters: OscillatorParameters

    def __post_init__(self) -> None:
        object.__setattr__(self, "amplitude", simulation.amplitude(self.x_min, self.x_max))
        object.__setattr__(self, "frequency", 1.0 / self.period)
        object.__setattr__(self, "angular_frequency", 2.0 * math.pi / self.period)

    def state(self, phase: float) -> tuple[float, float]:
        """Return (x, v) at ``phase`` in [0, 1] of the period, counted from ``x_phase0``; a steady state has only one.

        Raises:
            TypeError, ValueError: if ``phase`` is not a number in its range.
        """
        phase = checked_number("phase", phase, 0.0, 1.0)
        if not self.period > 0.0:
            return self.x_phase0, self.v_phase0
        p = self.parameters
        state: tuple[float, float] = kernel.cycle_state(p.plant, self.points, p.belt_speed, self.period, phase)
        return state

    @functools.cached_property
    def points(self) -> FloatArray:
        """States (x, v) at evenly spaced phases from 0 on, shape (64, 2); all equal for a steady state."""
        p, period = self.parameters, self.period if self.period > 0.0 else 0.0
        points: FloatArray = kernel.cycle_points(p.plant, self.x_phase0, self.v_phase0, p.belt_speed, period)
        return points


def stick_slip_cycle(parameters: OscillatorParameters, x_exit: float, x: float, v: float) -> LimitCycle:
    """Return the stick-slip cycle through the breakaway at ``x_exit``, reached from the start (x, v).

    Raises:
        OrbitError: if the next breakaway is not there.
    """
    lap = kernel.stick_slip_lap(parameters.plant, parameters.belt_speed, x_exit)
    if lap.outcome != kernel.REPEATED_BREAKAWAY:
        raise OrbitError(f"the stick-slip cycle from breakaway at x = {x_exit!r} does not close; {parameters}")
    return LimitCycle(
        kind="stick-slip",
        period=lap.period,
        stick_fraction=lap.stick_time / lap.period,
        x_max=lap.x_max,
        x_min=lap.x_min,
        mean_square_velocity=lap.int_v2 / lap.period,
        x_phase0=x_exit,
        v_phase0=parameters.belt_speed,
        x_breakaway=x_exit,
        x_restick=lap.x_restick,
        sticks=lap.sticks,
        forward_arcs=lap.forward_arcs,
        floquet_multiplier=0.0,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


def slip_cycle(
    parameters: OscillatorParameters,
    x_max: float,
    x: float | None = None,
    v: float = 0.0,
    kind: Literal["pure-slip", "neutral"] = "pure-slip",
) -> LimitCycle:
    """Return the cycle of slip with its maximum of x at ``x_max``, reached from (x, v), by default that maximum.

    A cycle too small to tell from the equilibrium is returned as a steady state.

    Raises:
        OrbitError: if slip from there does not turn again.
    """
    x = x_max if x is None else x
    plant, speed, traps = parameters.plant, parameters.belt_speed, traps_of(parameters)
    event, _, x_min, period, int_v2, forward_arcs = kernel.next_maximum(plant, speed, x_max, traps)
    if event != kernel.TURNING:
        raise OrbitError(f"the cycle of slip through x = {x_max!r} does not close; {parameters}")
    if x_max - x_min < SMALLEST_RADIUS:
        return steady_state(parameters, "steady-slip" if kind == "pure-slip" else kind, x_max, x, v)
    step = 1e-4 * (x_max - x_min)
    above = kernel.next_maximum(plant, speed, x_max + step, traps).x
    below = kernel.next_maximum(plant, speed, x_max - step, traps).x
    multiplier = (above - below) / (2.0 * step)
    if math.isnan(multiplier):  # the orbit just above sticks
        multiplier = (x_max - below) / step
    return LimitCycle(
        kind=kind,
        period=period,
        x_max=x_max,
        x_min=x_min,
        mean_square_velocity=int_v2 / period,
        x_phase0=x_max,
        v_phase0=0.0,
        forward_arcs=forward_arcs,
        floquet_multiplier=multiplier if kind == "pure-slip" else 1.0,
        x_start=x,
        v_start=v,
        parameters=parameters,
    )


def steady_state(
    parameters: OscillatorParameters,
    kind: Literal["steady-slip", "neutral", "rest"],
    place: float,
    x: float | None = None,
    v: float = 0.0,
) -> LimitCycle:
    """Return the steady state at a place, reached from (x, v), by default that place."""
    return LimitCycle(
        kind=kind,
        stick_fraction=1.0 if kind == "rest" else 0.0,
        x_max=place,
        x_min=place,
        x_phase0=place,
        v_phase0=0.0,
        x_start=place if x is None else x,
        v_start=v,
        parameters=parameters,
    )
