"""What the mean gradient of a return lacks where trajectories graze."""

import numpy as np
import pytest

from scripts import gradient_bias

CASES = {case.title: case for case in gradient_bias.cases()}


def lacking(case, samples, step):
    """Return what the mean gradient lacks of the central difference of the mean return, and its standard error."""
    offsets = np.random.default_rng(7).uniform(case.low, case.high, samples)
    sides = [np.array([case.returned(offset, sign * step)[0] for offset in offsets]) for sign in (1.0, -1.0)]
    found = (sides[0] - sides[1]) / (2.0 * step) - [case.returned(offset)[1] for offset in offsets]
    return found.mean(), found.std(ddof=1) / samples**0.5


def test_friction_without_a_step_makes_no_bias():
    case = CASES["stribeck, some graze, w_stick 0"]
    assert case.missing == pytest.approx(0.0, abs=1e-4)
    bias, error = lacking(case, 1000, 0.05)
    assert abs(bias) < 4.0 * error < 0.5


@pytest.mark.parametrize("w_stick", [0, 0.5])
def test_a_step_of_friction_hides_the_jump_at_the_graze_from_the_mean_gradient(w_stick):
    case = CASES[f"coulomb, some graze, w_stick {w_stick}"]
    bias, error = lacking(case, 1000, 0.2)
    assert bias > 10.0 * error
    assert abs(bias - case.missing) < 4.0 * error
