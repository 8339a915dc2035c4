"""The squeal as sound: the velocity of the mass without control, then under control, at an audible pitch."""

import math
import os
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.io import wavfile

from sd_friction_env.control.policies.policy import Policy, State
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.physics.orbits import LimitCycle, OrbitError, limit_cycle
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count, checked_number
from sd_friction_env.physics.simulation import simulate
from sd_friction_env.storage import atomic_file, checked_ending

AUDIBLE = (20.0, 20_000.0)  # Hz
SECONDS = (0.1, 60.0)  # of each part
_PITCH = 440.0  # of a squeal that is not audible at its own frequency, Hz
_FINER = 4  # samples computed for one written, so that harmonics above half the rate are filtered out
_PEAK = 0.9  # of full scale


class Pitch(NamedTuple):
    """How a squeal is played.

    Attributes:
        cycle: the passive limit cycle. own: its frequency on the rig, Hz; NaN without a rig.
        played: its frequency in the sound, Hz. unit: seconds of sound for a dimensionless unit of time.
    """

    cycle: LimitCycle
    own: float
    played: float
    unit: float


def pitch_of(parameters: OscillatorParameters, pitch: float | None = None) -> Pitch:
    """Return how an oscillator's squeal is played: at a rig's own frequency if that is audible, otherwise at 440 Hz.

    Args:
        parameters: of the oscillator; those of a rig have a ``time_scale`` other than 1.
        pitch: frequency of the squeal in the sound instead, in [20, 20000] Hz.

    Raises:
        OrbitError: if the passive motion does not vibrate. ValueError: if ``pitch`` is out of range.
    """
    pitch = None if pitch is None else checked_number("pitch", pitch, *AUDIBLE)
    cycle = limit_cycle(parameters)
    if not cycle.period > 0.0 or cycle.amplitude == 0.0:
        raise OrbitError(f"there is nothing to hear: the passive motion comes to rest; {parameters}")
    own = cycle.frequency / parameters.time_scale if parameters.time_scale != 1.0 else math.nan
    played = pitch or (own if AUDIBLE[0] <= own <= AUDIBLE[1] else _PITCH)
    return Pitch(cycle, own, played, cycle.frequency / played)


def squeal(
    env: SDFrictionEnv, policy: Policy, pitch: Pitch, *, seconds: float = 1.0, rate: int = 44_100
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the velocity on the passive cycle, and from its end on under control, as samples of a sound, (n,) each.

    Both are computed four times as finely as written, with the events located exactly, and low-pass filtered.

    Args:
        env: of the cycle's parameters, unwrapped; its episodes must be long enough for the sound.
        policy: the controller. pitch: of :func:`pitch_of`.
        seconds: of each part, in [0.1, 60]. rate: samples a second, in [8000, 192000].

    Raises:
        OrbitError: if the mass loses contact.
        TypeError, ValueError: if an argument is not as said, or the rate is below 2.5 times the pitch.
    """
    seconds = checked_number("seconds", seconds, *SECONDS)
    rate = checked_count("rate", rate, 8_000, 192_000)
    if pitch.played > 0.4 * rate:
        raise ValueError(f"rate must be at least 2.5 times the pitch of {pitch.played:g} Hz, got {rate}")
    parameters, size, dt = pitch.cycle.parameters, _FINER * round(seconds * rate), 1.0 / (pitch.unit * _FINER * rate)
    passive = simulate(parameters, *pitch.cycle.state(0.0), size * dt, dt=dt)
    if passive.status != "ok":
        raise OrbitError(f"{passive.status} at t = {passive.t[-1]:.6g}; {parameters}")
    times, velocities = _controlled(env, policy, (float(passive.x[-1]), float(passive.v[-1])), size * dt, dt)
    controlled = CubicSpline(times, velocities)(dt * np.arange(size))
    before, after = (signal.decimate(v, _FINER, ftype="fir") for v in (passive.v[:size], controlled))
    return before, after


def _controlled(
    env: SDFrictionEnv, policy: Policy, start: tuple[float, float], t_end: float, dt: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times up to t_end or later, evenly spaced by dt or less, and the velocities under control from a start.

    Each control interval is simulated from the environment's own state: at rest on the sliding belt the motion is
    unstable without the controller, and a replay of its actions would vibrate again.
    """
    hold = env.task.control_interval
    steps, samples = math.ceil(t_end / hold) + 1, math.ceil(hold / dt)
    if env.task.episode_steps < steps:
        raise ValueError(f"episode_steps must be at least {steps} for this sound, got {env.task.episode_steps}")
    velocities = np.empty((steps, samples))
    observation, info = env.reset(seed=0, options={"x": start[0], "v": start[1]})
    state: State = None
    for step in range(steps):
        x, v, parameters = info["x"], info["v"], env.nominal.replace(belt_speed=info["v_belt"])
        actions, state = policy.predict(observation[None], state, np.array([step == 0]))
        observation, _, terminated, _, info = env.step(actions[0])
        if terminated:
            raise OrbitError(f"the mass loses contact under control at t = {info['time']:.6g}")
        drive = {"force": info["force"], "belt_acceleration": info["belt_acceleration"]}
        velocities[step] = simulate(parameters, x, v, hold, dt=hold / samples, **drive).v[:samples]
    times: NDArray[np.float64] = (hold / samples) * np.arange(velocities.size, dtype=np.float64)
    return times, velocities.ravel()


def write_sound(path: str | os.PathLike[str], samples: NDArray[np.float64], rate: int = 44_100) -> None:
    """Write samples as a mono WAV file of 16 bits, the largest at 0.9 of full scale; whole or not at all.

    Raises:
        ValueError: if the name does not end in .wav. OSError: if the file cannot be written.
    """
    checked_ending(path, (".wav",))
    loudest = float(np.abs(samples).max())
    scale = _PEAK * np.iinfo(np.int16).max / loudest if loudest > 0.0 else 0.0
    with atomic_file(path, "wb") as file:
        wavfile.write(file, rate, np.round(scale * samples).astype(np.int16))
