"""One step of a random legal plant against SciPy: the tests' oracle, with DOP853 or, where forces are stiff, Radau."""

import math
from collections.abc import Mapping
from unittest import mock

import numpy as np
from scipy.integrate import DOP853, Radau

import tests.oracle as oracle
from scripts.hunting import steps
from scripts.hunting.draws import Start
from scripts.hunting.steps import INTERVAL, STATUS, V, X
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, kernel

GAP = 1e-6  # of x and v, relative to max(1, |x|, |v|)
STIFF = 300.0  # rate of decay from which the implicit method takes over
GRAZES = 1e-9  # what the start is moved by, relative to its size
GRAZING = 100.0  # growth over a step from which an answer counts as grazing


def stiffness(p: OscillatorParameters, at: Start) -> float:
    """Return how fast a disturbance of v decays at the start."""
    speed = at.v_belt + float(oracle.ripple(p, at.time)[1])
    slope = float(oracle.friction_slope(p, at.v - speed)) * float(oracle.normal_force(p, at.x, at.time))
    return abs(slope) + 2.0 * p.beta


def answer(p: OscillatorParameters, at: Start) -> oracle.Run:
    """Return the oracle's answer."""
    solver = Radau if stiffness(p, at) > STIFF else DOP853
    with mock.patch.object(oracle, "DOP853", solver):
        return oracle.run(p, at.x, at.v, [(INTERVAL, at.u, at.a_belt)], at.v_belt, at.time)


def growth(p: OscillatorParameters, at: Start) -> float:
    """Return how many times as far apart as their starts two runs of the kernel end, infinite if their modes differ."""
    here = steps.run(p, at, INTERVAL, 1)
    most = 0.0
    for name in ("x", "v") if at.v != at.v_belt or p.ripple_amplitude else ("x",):
        for sign in (1.0, -1.0):
            by = sign * GRAZES * max(1.0, abs(getattr(at, name)))
            there = steps.run(p, at._replace(**{name: getattr(at, name) + by}), INTERVAL, 1)
            most = max(most, steps.apart(here, there) / abs(by))
    return most


def trial(seed: int, index: int) -> Mapping[str, float]:
    """Compare one step of one random plant."""
    p, at = steps.drawn(seed, index)
    row = steps.run(p, at, INTERVAL, 1)[0]
    if int(row[STATUS]) in (kernel.STEP_LIMIT, kernel.EVENT_LIMIT):
        raise SetAside(kernel.STATUS_NAMES[int(row[STATUS])])
    try:
        with np.errstate(all="ignore"):
            wanted = answer(p, at)
    except (RuntimeError, ValueError, ArithmeticError) as error:
        raise SetAside(f"SciPy gives up ({type(error).__name__})") from None
    x, v = row[[X, V]].tolist()
    gap = max(abs(x - wanted.x), abs(v - wanted.v)) / max(1.0, abs(wanted.x), abs(wanted.v))
    same = (row[STATUS] == kernel.CONTACT_LOST) == wanted.contact_lost
    if same and gap <= GAP:
        return {"largest gap to SciPy": gap}
    grows = growth(p, at)
    if grows > GRAZING:
        return {"largest gap to SciPy over the growth, of those that graze": math.inf if not same else gap / grows}
    words = f"x, v = {x:.12g}, {v:.12g} ({kernel.STATUS_NAMES[int(row[STATUS])]}); "
    words += f"SciPy has {wanted.x:.12g}, {wanted.v:.12g} ({'contact lost' if wanted.contact_lost else 'ok'})"
    raise Failure(steps.grade("scipy", gap), f"{words}; a start moved by 1 moves the end by {grows:.3g}")


CHECK = Check(
    "scipy",
    f"single steps against SciPy (rtol {oracle.RTOL:g}): gaps of x and v, relative, under {GAP:g}",
    trial,
    drawn=steps.described,
    slow_fails=False,
    share=2.0,
)
