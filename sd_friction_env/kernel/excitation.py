"""Excitation by a force, by a ripple on the belt's speed and by a modulated spring, and the belt's frame.

The exciting force is force_amplitude cos(force_frequency t + force_phase), the belt's speed is greater by
ripple_amplitude cos(...), and the spring's force is 1 + stiffness_amplitude cos(...) times as great.
"""

import math
from typing import NamedTuple

from sd_friction_env.kernel.codes import PHASE_ROUNDING, V_REL_ZERO
from sd_friction_env.kernel.compilation import compiled

NO_PHASES = (0.0,) * 6  # cosines and sines of none


class Unexcited(NamedTuple):
    """No excitation: the belt's frame is the lab's."""

    nothing: float = 0.0  # numba finds no method of a NamedTuple without fields

    def acts(self):
        return False

    def modulates_spring(self):
        return False

    def has_power(self):
        return False

    def at_time(self, t):
        return self

    def with_clock_at_zero(self):
        return self

    def lab_position(self, x):
        return x

    def lab_velocity(self, v):
        return v

    def lab_acceleration(self, a):
        return a

    def to_belt_frame(self, x, v, v_belt):
        return x, v

    def belt_frame_velocity(self, v):
        return v

    def belt_frame_origin(self):
        return 0.0

    def v_rel_zero(self, v_belt):
        return V_REL_ZERO

    def drive_force(self, u):
        return u

    def modulated(self, force):
        return force

    def modulated_normal(self, weight, normal):
        return normal

    def drive_force_rate(self):
        return 0.0

    def stiffness_rate(self):
        return 0.0

    def lab_gap(self, side, gap, slope, curvature):
        return gap, slope, curvature

    def shortened(self, angle, duration):
        return duration

    def ripple_speed(self):
        return 0.0

    def roundoff(self):
        return 0.0

    def power(self, velocity, potential):
        return 0.0

    def gradient(self, force, position, velocity, inertia, spring):
        return (0.0,)

    def phases(self):
        return NO_PHASES


class Excitation(NamedTuple):
    """Excitation by all three means; one of amplitude 0 is not there."""

    force_amplitude: float
    force_frequency: float
    force_phase: float
    ripple_amplitude: float
    ripple_frequency: float
    ripple_phase: float
    stiffness_amplitude: float
    stiffness_frequency: float
    stiffness_phase: float
    time: float  # at the beginning of a call

    def acts(self):
        return self.force_amplitude != 0.0 or self.ripple_amplitude != 0.0 or self.stiffness_amplitude != 0.0

    def modulates_spring(self):
        return self.stiffness_amplitude != 0.0

    def has_power(self):
        return self.force_amplitude != 0.0 or self.stiffness_amplitude != 0.0

    def at_time(self, t):
        return _with_clock(self, self.force_phase, self.ripple_phase, self.stiffness_phase, self.time + t)

    def with_clock_at_zero(self):
        if not self.acts():
            return self
        force_phase = _phase_at(self.force_amplitude, self.force_frequency, self.force_phase, self.time)
        ripple_phase = _phase_at(self.ripple_amplitude, self.ripple_frequency, self.ripple_phase, self.time)
        stiffness_phase = _phase_at(self.stiffness_amplitude, self.stiffness_frequency, self.stiffness_phase, self.time)
        return _with_clock(self, force_phase, ripple_phase, stiffness_phase, 0.0)

    def lab_position(self, x):
        return x + _ripple(self)[0] if self.ripple_amplitude != 0.0 else x

    def lab_velocity(self, v):
        return v + _ripple(self)[1] if self.ripple_amplitude != 0.0 else v

    def lab_acceleration(self, a):
        return a + _ripple(self)[2] if self.ripple_amplitude != 0.0 else a

    def to_belt_frame(self, x, v, v_belt):
        if self.ripple_amplitude == 0.0:
            return x, v
        displacement, speed, _, _ = _ripple(self)
        v = v - speed
        return x - displacement, v_belt if abs(v - v_belt) <= _v_rel_zero(self, v_belt) else v

    def belt_frame_velocity(self, v):
        return v - _ripple(self)[1] if self.ripple_amplitude != 0.0 else v

    def belt_frame_origin(self):
        return -_ripple(self)[0] if self.ripple_amplitude != 0.0 else 0.0

    def v_rel_zero(self, v_belt):
        return _v_rel_zero(self, v_belt)

    def drive_force(self, u):
        if self.force_amplitude != 0.0:
            u = u + _force(self)[0]
        if self.ripple_amplitude != 0.0:
            u = u - _ripple(self)[2]
        return u

    def modulated(self, force):
        return force if self.stiffness_amplitude == 0.0 else force * _stiffness(self)[0]

    def modulated_normal(self, weight, normal):
        return normal if self.stiffness_amplitude == 0.0 else weight + (normal - weight) * _stiffness(self)[0]

    def drive_force_rate(self):
        rate = _force(self)[1]
        return rate - _ripple(self)[3] if self.ripple_amplitude != 0.0 else rate

    def stiffness_rate(self):
        return _stiffness(self)[1]

    def lab_gap(self, side, gap, slope, curvature):
        if self.ripple_amplitude == 0.0:
            return gap, slope, curvature
        _, speed, acceleration, jerk = _ripple(self)
        return gap + side * speed, slope + side * acceleration, curvature + side * jerk

    def shortened(self, angle, duration):
        fastest = 0.0
        if self.force_amplitude != 0.0:
            fastest = max(fastest, self.force_frequency)
        if self.ripple_amplitude != 0.0:
            fastest = max(fastest, self.ripple_frequency)
        if self.stiffness_amplitude != 0.0:
            fastest = max(fastest, self.stiffness_frequency)
        return min(duration, angle / fastest) if fastest > 0.0 else duration

    def ripple_speed(self):
        return self.ripple_amplitude

    def roundoff(self):
        drives = self.force_amplitude * (self.force_frequency * self.time + abs(self.force_phase))
        shake = self.ripple_amplitude * self.ripple_frequency
        return drives + shake * (self.ripple_frequency * self.time + abs(self.ripple_phase))

    def power(self, velocity, potential):
        return _force(self)[0] * velocity + _stiffness(self)[1] * potential

    def gradient(self, force, position, velocity, inertia, spring):
        t = self.time
        angle = self.force_frequency * t + self.force_phase
        by_force = force * math.cos(angle), -force * self.force_amplitude * math.sin(angle)
        angle = self.stiffness_frequency * t + self.stiffness_phase
        by_stiffness = spring * math.cos(angle), -spring * self.stiffness_amplitude * math.sin(angle)
        rate = self.ripple_frequency
        angle = rate * t + self.ripple_phase
        c = math.cos(angle)
        s = math.sin(angle)
        displacement = position / rate - inertia * rate  # what the sine of the ripple's phase counts
        by_phase = self.ripple_amplitude * (displacement * c - velocity * s)
        by_rate = t * by_phase - self.ripple_amplitude * (position / (rate * rate) + inertia) * s
        return (
            by_force[0],
            t * by_force[1],
            by_force[1],
            displacement * s + velocity * c,
            by_rate,
            by_phase,
            by_stiffness[0],
            t * by_stiffness[1],
            by_stiffness[1],
            0.0,
        )

    def phases(self):
        force = self.force_frequency * self.time + self.force_phase
        ripple = self.ripple_frequency * self.time + self.ripple_phase
        stiffness = self.stiffness_frequency * self.time + self.stiffness_phase
        return (
            math.cos(force),
            math.sin(force),
            math.cos(ripple),
            math.sin(ripple),
            math.cos(stiffness),
            math.sin(stiffness),
        )


@compiled
def _with_clock(excitation, force_phase, ripple_phase, stiffness_phase, time):
    return Excitation(
        excitation.force_amplitude,
        excitation.force_frequency,
        force_phase,
        excitation.ripple_amplitude,
        excitation.ripple_frequency,
        ripple_phase,
        excitation.stiffness_amplitude,
        excitation.stiffness_frequency,
        stiffness_phase,
        time,
    )


@compiled
def _phase_at(amplitude, frequency, phase, time):
    if amplitude == 0.0:
        return phase
    angle = frequency * time + phase
    return angle % (2.0 * math.pi) if abs(angle) > 2.0 * math.pi else angle


@compiled
def _ripple(excitation):
    """Return the ripple's displacement, speed, acceleration and jerk."""
    if excitation.ripple_amplitude == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    rate = excitation.ripple_frequency
    angle = rate * excitation.time + excitation.ripple_phase
    c = excitation.ripple_amplitude * math.cos(angle)
    s = excitation.ripple_amplitude * math.sin(angle)
    return s / rate, c, -rate * s, -rate * rate * c


@compiled
def _force(excitation):
    """Return the exciting force and its rate of change."""
    if excitation.force_amplitude == 0.0:
        return 0.0, 0.0
    angle = excitation.force_frequency * excitation.time + excitation.force_phase
    rate = -excitation.force_amplitude * excitation.force_frequency * math.sin(angle)
    return excitation.force_amplitude * math.cos(angle), rate


@compiled
def _stiffness(excitation):
    """Return the factor of the spring's force and its rate of change."""
    if excitation.stiffness_amplitude == 0.0:
        return 1.0, 0.0
    angle = excitation.stiffness_frequency * excitation.time + excitation.stiffness_phase
    rate = -excitation.stiffness_amplitude * excitation.stiffness_frequency * math.sin(angle)
    return 1.0 + excitation.stiffness_amplitude * math.cos(angle), rate


@compiled
def _v_rel_zero(excitation, v_belt):
    if excitation.ripple_amplitude == 0.0:
        return V_REL_ZERO
    # Where a state was left, its time was rounded otherwise, and so was the ripple's phase.
    phase = excitation.ripple_frequency * excitation.time + abs(excitation.ripple_phase)
    return V_REL_ZERO + PHASE_ROUNDING * (excitation.ripple_amplitude * phase + abs(v_belt))
