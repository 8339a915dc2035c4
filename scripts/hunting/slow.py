"""Control intervals that take long: stiff plants, fast excitation, long intervals."""

import time
from collections.abc import Mapping

import numpy as np

from scripts.hunting import draws, steps
from scripts.hunting.draws import Start
from scripts.hunting.trials import Check, Failure
from sd_friction_env import OscillatorParameters, kernel

LONGEST = 1.0  # s of processor time that one control interval may take
_REPEATS = 3  # of an interval that took longer: the least time counts


def drawn(seed: int, index: int) -> tuple[OscillatorParameters, Start, float]:
    """Return a plant that is hard to follow, a start and a control interval."""
    rng = draws.generator(seed, index)
    p = draws.plant(rng, excited=0.5, hard=1.0)
    interval = (10.0, 1.0, draws.number(rng, 1e-4, 10.0))[int(rng.integers(3))]
    return p, draws.start(rng, p, interval), interval


def described(seed: int, index: int) -> str:
    """Return the plant, the start and the interval of a trial as one types them."""
    p, at, interval = drawn(seed, index)
    return f"{draws.described(p)}, {at}, interval {interval!r}"


def trial(seed: int, index: int) -> Mapping[str, float]:
    """Measure one control interval."""
    p, at, interval = drawn(seed, index)
    plant = kernel.at_time(p.plant, at.time)
    least = np.inf
    for _ in range(_REPEATS):
        begun = time.thread_time()
        kernel.advance(plant, kernel.State(*at[:2]), kernel.Drive(*at[2:5]), interval, None)
        least = min(least, time.thread_time() - begun)
        if least <= LONGEST:
            return {"slowest control interval, s": least}
    found = Failure("slow", f"a control interval of {interval!r} takes {least:.3g} s")
    found.add_note(described(seed, index))
    raise found


CHECK = Check("slow", "no control interval takes more than a second", trial, steps.prepare, described, 6.0)
