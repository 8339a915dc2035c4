"""Control intervals that take long: stiff plants, fast excitation, long intervals."""

import time
from collections.abc import Mapping

import numpy as np

from scripts.hunting import draws, steps
from scripts.hunting.draws import Start
from scripts.hunting.trials import Check, Failure
from sd_friction_env import OscillatorParameters, kernel
from sd_friction_env.parameters import EXCITATIONS, RANGES, SMALLEST_ALPHA

LONGEST = 1.0  # s of processor time that one control interval may take
_REPEATS = 3  # of an interval that took longer: the least time counts


def drawn(seed: int, index: int) -> tuple[OscillatorParameters, Start, float]:
    """Return a plant that is hard to follow, a start and a control interval."""
    rng = draws.generator(seed, index)
    values = draws.values(rng, excited=0.5)
    used = draws.fields_used(values["geometry"], values["friction"])
    hard = {
        "v_m": RANGES["v_m"][0],
        "v_0": RANGES["v_0"][0],
        "delta": RANGES["delta"][1],
        "mu_s": RANGES["mu_s"][1],
        "g1": RANGES["g1"][1],
        "kappa": RANGES["kappa"][1],
        "belt_speed": RANGES["belt_speed"][1],
        "mu_v": RANGES["mu_v"][1],
        "beta": RANGES["beta"][1],
    }
    for name, value in hard.items():
        if name in used and rng.random() < 0.3:
            values[name] = value
    if "alpha" in used and rng.random() < 0.3:
        values["alpha"] = SMALLEST_ALPHA
    for name in ("mu_m", "mu_k"):
        if name in used and rng.random() < 0.5:
            values[name] = 0.0
        values[name] = min(values[name], values["mu_s"])
    for kind in EXCITATIONS:
        for what in ("amplitude", "frequency"):
            if values.get(f"{kind}_amplitude") and rng.random() < 0.3:
                values[f"{kind}_{what}"] = RANGES[f"{kind}_{what}"][1]
    p = OscillatorParameters(**values)
    interval = (10.0, 1.0, draws.number(rng, 1e-4, 10.0))[int(rng.integers(3))]
    return p, draws.start(rng, p, interval), interval


def described(seed: int, index: int) -> str:
    """Return the plant, the start and the interval of a trial as one types them."""
    p, at, interval = drawn(seed, index)
    return f"{draws.described(p)}, {at}, interval {interval!r}"


def trial(seed: int, index: int) -> Mapping[str, float]:
    """Measure one control interval."""
    p, at, interval = drawn(seed, index)
    plant = kernel.later(p.plant, at.time)
    least = np.inf
    for _ in range(_REPEATS):
        begun = time.thread_time()
        kernel.advance(plant, *at[:5], interval, None)
        least = min(least, time.thread_time() - begun)
        if least <= LONGEST:
            return {"slowest control interval, s": least}
    found = Failure("slow", f"a control interval of {interval!r} takes {least:.3g} s")
    found.add_note(described(seed, index))
    raise found


CHECK = Check("slow", "no control interval takes more than a second", trial, steps.prepare, described, 6.0)
