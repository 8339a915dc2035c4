"""Print what signals and basins reach: pitch of sounds, smallest shocks, memory of labels on disk, linear response.

python scripts/signals_and_shocks.py            everything, with 10^6 starts on disk
python scripts/signals_and_shocks.py --starts 1000000 10000000   also 10^7 (some minutes)
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import wavfile

from sd_friction_env import OscillatorParameters, attractors, signals
from sd_friction_env.control import sound
from sd_friction_env.control.policies import ZeroPolicy
from sd_friction_env.learning import evaluation
from sd_friction_env.physics.basins import basins
from sd_friction_env.physics.forced import response_curve
from sd_friction_env.physics.orbits import LimitCycle
from sd_friction_env.physics.shocks import Shock, smallest_shock

EXACT = OscillatorParameters()
CUBIC, LINEAR = EXACT.replace(geometry="cubic"), EXACT.replace(geometry="linear")
FREE = LINEAR.replace(mu_s=0.0, mu_m=0.0, force_amplitude=0.1)
HEARD = [EXACT, CUBIC.replace(belt_speed=0.42), LINEAR.replace(belt_speed=0.1), EXACT.replace(time_scale=1e-4)]
BISTABLE = LINEAR.replace(friction="exponential", mu_s=1.0, mu_k=0.5, v_0=0.5)
SHAKEN = [
    *(EXACT.replace(alpha=alpha, belt_speed=speed) for alpha, speed in ((0.5, 0.43), (0.7, 0.46))),
    *(CUBIC.replace(alpha=alpha, belt_speed=0.46) for alpha in (0.5, 0.7)),
    *(BISTABLE.replace(belt_speed=speed) for speed in (1.3, 1.7)),
]
STEP = 0.02  # of the grid of shocks, in x and v


def heard_pitch(parameters: OscillatorParameters, folder: str, rate: int = 22_050) -> tuple[float, float]:
    """Return the fundamental of a written sound of the passive cycle, and 1/T of the cycle as it is played, in Hz."""
    pitch, path = sound.pitch_of(parameters), Path(folder) / "squeal.wav"
    env = evaluation.make_env("SDFriction/BeltSpeed-v0", {"parameters": parameters, "episode_steps": 100_000})
    sound.write_sound(path, sound.squeal(env, ZeroPolicy(), pitch, seconds=0.15, rate=rate)[0], rate)
    samples = wavfile.read(path)[1].astype(float)
    return float(signals.harmonics(samples, 1.0 / rate, count=1)["frequency"][0]), pitch.played


def smallest_on_grid(
    plant: OscillatorParameters, cycle: LimitCycle, label: int, shock: Shock, phases: int = 32
) -> float:
    """Return the smallest shock of a square grid, at phases of a cycle, after which a motion ends elsewhere."""
    size = np.arange(-2.0, 2.0 + STEP, STEP)
    dx, dv = np.meshgrid(size, size)
    sizes = np.hypot(dx, dv)
    near = sizes < shock.size + 3.0 * STEP
    smallest = math.inf
    for phase in np.arange(phases if cycle.period > 0.0 else 1) / phases:
        x, v = cycle.state(phase)
        labels = basins(plant, x + dx[near], v + dv[near]).labels
        smallest = min(smallest, float(sizes[near][(labels != label) & (labels != -2)].min(initial=math.inf)))
    return smallest


def transfer(plant: OscillatorParameters, rates: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the response of the linear oscillator without friction to its force, as complex amplitudes."""
    return np.asarray(plant.force_amplitude / (1.0 - rates**2 + 2j * plant.beta * rates), np.complex128)


def label_file(starts: int, folder: str) -> str:
    """Write the labels of so many starts by the command line, and return its time and peak memory in words."""
    rows, out, begun = math.isqrt(starts), str(Path(folder) / "labels.npy"), time.perf_counter()
    arguments = ["basins", "--alpha", "0.2", "--shape", str(starts // rows), str(rows), "--out", out]
    process = subprocess.Popen([sys.executable, "-m", "sd_friction_env", *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    took, peak = time.perf_counter() - begun, usage.ru_maxrss / 1024
    return f"{starts} labels on disk: {took:.1f} s, at most {peak:.0f} MiB, exit status {status}"


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, nargs="+", default=[10**6], help="sizes of label files (default: 10^6)")
    options = parser.parse_args()
    rates = np.linspace(0.3, 3.0, 28)
    found = response_curve(FREE, "force_frequency", rates, direction="up", transient=300)["first_harmonic"]
    error = np.abs(found / np.abs(transfer(FREE, rates)) - 1.0).max()
    print(f"linear response at {len(rates)} frequencies: greatest relative error {error:.0e}")
    with tempfile.TemporaryDirectory() as folder:
        for plant in HEARD:
            heard, played = heard_pitch(plant, folder)
            print(
                f"fundamental of the sound {heard:.4f} Hz, 1/T {played:.4f} Hz, error {abs(heard / played - 1.0):.1e}"
            )
        for plant in SHAKEN:
            for label, cycle in enumerate(attractors(plant)):
                shock = smallest_shock(cycle, starts=4000)
                over = smallest_on_grid(plant, cycle, label, shock) - shock.size
                print(f"smallest shock from {cycle.kind} {shock.size:.6f}; the grid's is larger by {over:.6f}")
        for starts in options.starts:
            print(label_file(starts, folder))


if __name__ == "__main__":
    main()
