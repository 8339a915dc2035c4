"""The squeal as sound: the file has the pitch of the limit cycle, and control silences it."""

import numpy as np
import pytest
from scipy.io import wavfile

from sd_friction_env import OscillatorParameters, limit_cycle, simulate
from sd_friction_env.cli.main import main
from sd_friction_env.control import sound
from sd_friction_env.control.observed import threshold_follower
from sd_friction_env.control.policies import ConstantPolicy, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.physics import signals
from sd_friction_env.physics.orbits import OrbitError

BELT = "SDFriction/BeltSpeed-v0"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--pitch", "523.25"],
        ["--geometry", "cubic", "--belt-speed", "0.42", "--task", "force"],
        ["--geometry", "linear", "--alpha", "1", "--belt-speed", "0.1"],
    ],
    ids=["stick-slip", "pure slip", "linear"],
)
def test_the_file_has_the_pitch_of_the_limit_cycle_and_control_silences_it(arguments, tmp_path, capsys):
    file = tmp_path / "squeal.wav"
    assert main(["listen", "--seconds", "0.15", "--rate", "22050", "--out", str(file), *arguments]) == 0
    rate, samples = wavfile.read(file)
    assert (rate, samples.dtype, len(samples)) == (22_050, np.int16, 2 * round(0.15 * 22_050))
    before, after = np.split(samples.astype(float), 2)
    assert limit_cycle(OscillatorParameters(geometry="cubic", belt_speed=0.42)).kind == "pure-slip"
    pitch = float(arguments[1]) if arguments[0] == "--pitch" else 440.0
    assert signals.harmonics(before, 1.0 / rate, count=1)["frequency"][0] == pytest.approx(pitch, rel=1e-3)
    assert np.abs(after[len(after) // 2 :]).max() <= 1.0 < 0.1 * np.abs(before).max()
    assert "fundamental in the sound" in capsys.readouterr().out


@pytest.mark.parametrize(
    "plant",
    [
        OscillatorParameters(),
        OscillatorParameters(geometry="cubic", belt_speed=0.42),
        OscillatorParameters(geometry="linear", belt_speed=0.1),
        OscillatorParameters(time_scale=1e-4),
    ],
)
def test_the_written_sound_of_every_plant_has_its_pitch(plant, tmp_path):
    pitch, path, rate = sound.pitch_of(plant), tmp_path / "squeal.wav", 22_050
    env = make_env(BELT, {"parameters": plant, "episode_steps": 100_000})
    sound.write_sound(path, sound.squeal(env, ZeroPolicy(), pitch, seconds=0.15, rate=rate)[0], rate)
    samples = wavfile.read(path)[1].astype(float)
    assert signals.harmonics(samples, 1.0 / rate, count=1)["frequency"][0] == pytest.approx(pitch.played, rel=1e-3)


def test_a_rig_is_played_at_its_own_frequency_if_that_is_audible():
    slow, fast = (OscillatorParameters(time_scale=scale) for scale in (1e-2, 1e-4))
    frequency = limit_cycle(OscillatorParameters()).frequency
    assert sound.pitch_of(fast).played == pytest.approx(frequency / 1e-4)
    assert sound.pitch_of(fast).unit == pytest.approx(1e-4)
    assert sound.pitch_of(slow).own == pytest.approx(frequency / 1e-2)
    assert sound.pitch_of(slow).played == 440.0


def test_without_control_the_second_part_sounds_as_the_first():
    pitch = sound.pitch_of(OscillatorParameters())
    env = make_env(BELT, {"episode_steps": 10_000})
    before, after = sound.squeal(env, ZeroPolicy(), pitch, seconds=0.1, rate=16_000)
    assert np.std(after) == pytest.approx(np.std(before), rel=0.01)
    assert signals.harmonics(after, 1 / 16_000, count=1)["frequency"][0] == pytest.approx(440.0, rel=1e-3)


def test_the_sound_under_control_is_the_motion_on_the_belt_as_it_moves():
    env, plant, dt = make_env(BELT), OscillatorParameters(), 0.0125
    times, velocities = sound._controlled(env, ConstantPolicy(1.0), (0.7, 0.1), 3.0, dt)
    accelerations = np.zeros(40)
    accelerations[:2] = 0.5  # from 0.2 to 0.3, at the belt's greatest acceleration
    motion = simulate(plant, 0.7, 0.1, 4.0, dt=dt, belt_acceleration=accelerations, hold=0.1)
    count = len(times)
    np.testing.assert_allclose(times, motion.t[:count], atol=1e-12)
    np.testing.assert_allclose(velocities, motion.v[:count], atol=1e-7)  # actions are in single precision


def test_what_cannot_be_heard_is_refused(tmp_path):
    with pytest.raises(OrbitError, match="there is nothing to hear"):
        sound.pitch_of(OscillatorParameters(belt_speed=0.6))
    with pytest.raises(ValueError, match=r"pitch must be .* got 5"):
        sound.pitch_of(OscillatorParameters(), 5.0)
    env = make_env(BELT)
    pitch = sound.pitch_of(OscillatorParameters())
    with pytest.raises(ValueError, match=r"episode_steps must be at least .* got 500"):
        sound.squeal(env, threshold_follower(env), pitch)
    with pytest.raises(ValueError, match=r"rate must be at least 2\.5 times"):
        sound.squeal(env, threshold_follower(env), pitch._replace(played=10_000.0), rate=20_000)
    with pytest.raises(ValueError, match=r"must end in \.wav"):
        sound.write_sound(tmp_path / "a.mp3", np.zeros(3))
