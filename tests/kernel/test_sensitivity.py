"""Tangents through stick and slip: against differences of the motion, compiled as interpreted, and what has none."""

import itertools
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import mathieu_a, mathieu_b

from sd_friction_env import OscillatorParameters, kernel
from sd_friction_env.physics.forced import drive_period
from tests.kernel import random_motions

ROOT = Path(__file__).parents[2]
NOMINAL = OscillatorParameters().kind


def motions(accept, count, seed):
    rng = np.random.default_rng(seed)
    while count:
        motion = random_motions.random_motion(rng)
        if accept(motion.parameters):
            count -= 1
            yield motion


def worst_errors(chosen):
    """The largest error of each motion's Jacobian, and the kinds of events that were met."""
    errors, met = [], set()
    for motion in chosen:
        names = random_motions.names_of(motion)
        end, exact = random_motions.jacobian_of(motion, names)
        if end.status != kernel.OK or end.derivative > kernel.FROM_BELT:
            continue
        met |= set(random_motions.end_of(motion, names, np.zeros(5 + len(names)))[1][1:])
        stuck, scale = end.derivative == kernel.FROM_BELT, np.abs(exact).max()
        for column in range(exact.shape[1]):
            if stuck and column == 1:
                continue
            wanted = exact[:, column] + (exact[:, 1] if stuck and column == 2 else 0.0)
            found, spread = random_motions.differences(motion, names, column, stuck)
            if spread < 1e-10 * scale:
                errors.append(np.abs(wanted - found).max() / scale)
    return np.array(errors), met


def test_derivatives_of_the_nominal_laws_are_those_of_the_motion():
    errors, met = worst_errors(motions(lambda p: p.kind == NOMINAL, 30, 1))
    assert len(errors) > 250
    assert errors.max() < 1e-9
    assert {kernel.RESTICK, kernel.BREAKAWAY, kernel.CROSSING} <= met


@pytest.mark.slow
def test_derivatives_of_all_laws_are_those_of_the_motion():
    errors, met = worst_errors(motions(lambda p: True, 300, 2))
    assert (errors > 1e-9).mean() < 2e-3  # tables bend at their points, which the step does not stop at
    assert errors.max() < 1e-6
    assert {kernel.RESTICK, kernel.BREAKAWAY, kernel.CROSSING, kernel.SWITCHING} <= met


def test_interpreted_tangents_of_every_law_are_those_of_the_motion():
    code = (
        "import numpy as np\n"
        "from sd_friction_env import kernel\n"
        "from tests.kernel import random_motions\n"
        "from tests.kernel.test_sensitivity import motions, worst_errors\n"
        "kinds = lambda m: random_motions.end_of(m, [], np.zeros(5))[1][1:]\n"
        "chosen = [m for m in motions(lambda p: True, 90, 3) if m.duration < 3.0 and kinds(m)][:14]\n"
        "errors, met = worst_errors(chosen)\n"
        "assert len(errors) > 150, len(errors)\n"
        "assert np.median(errors) < 1e-11 and errors.max() < 1e-7, errors.max()\n"
        "assert {kernel.RESTICK, kernel.BREAKAWAY, kernel.CROSSING} <= met, met\n"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, env=environment, timeout=600)


def tangent(parameters, x, v, duration, **drive):
    rows = np.zeros((kernel.TANGENT_ROWS, 2))
    rows[kernel.TANGENT_X, 0] = rows[kernel.TANGENT_V, 1] = 1.0
    held = kernel.Drive(parameters.belt_speed, drive.get("a_belt", 0.0), drive.get("u", 0.0))
    end = kernel.advance_with_tangents(parameters.plant, kernel.UNKNOWN, kernel.State(x, v), held, duration, rows, None)
    return end, rows


def test_what_has_no_derivative_is_told():
    p = OscillatorParameters()
    assert tangent(p, 0.5, -0.3, 0.1)[0].derivative == kernel.SMOOTH
    assert tangent(p, 0.5, p.belt_speed, 0.1)[0].derivative == kernel.FROM_BELT
    events = np.empty((kernel.MAX_EVENTS, 4))
    kernel.advance(p.plant, kernel.State(0.5, -0.3), kernel.steady(p.belt_speed), 5.0, events)
    for late in (0.0, 1e-10, -1e-10):
        assert tangent(p, 0.5, -0.3, events[0, 0] + late)[0].derivative == kernel.AT_BORDER
    # A mass that just reaches the belt's speed, backwards in time from there, touches it. Without friction's pull in
    # slip (mu = 0) the motion is the spring's alone.
    free = OscillatorParameters(geometry="linear", mu_s=0.0, mu_m=0.0, beta=0.0, belt_speed=0.3)
    end, _ = tangent(free, -0.3, 0.0, 3.0)
    assert end.derivative == kernel.TOUCHED
    assert end.touched == 1
    end, rows = tangent(free, -0.2999, 0.0, 3.0)
    assert end.derivative == kernel.SMOOTH
    assert rows[:2] == pytest.approx(
        np.array([[math.cos(3.0), math.sin(3.0)], [-math.sin(3.0), math.cos(3.0)]]), abs=1e-11
    )


@pytest.mark.parametrize("edge", [mathieu_a, mathieu_b])
def test_on_the_edges_of_mathieus_tongues_the_trace_is_two(edge):
    for order, q in itertools.product(range(1, 5), (0.05, 0.2, 0.4)):
        a = float(edge(order, q))
        if not 2.0 * q <= a:
            continue
        p = OscillatorParameters(
            geometry="linear",
            mu_s=0.0,
            mu_m=0.0,
            beta=0.0,
            stiffness_amplitude=2.0 * q / a,
            stiffness_frequency=2.0 / math.sqrt(a),
        )
        _, rows = tangent(p, 1.0, 0.2, drive_period(p))
        assert abs(np.trace(rows[:2])) == pytest.approx(2.0, abs=1e-9)


def test_many_tangents_are_stepped_as_few_are():
    p, rng = OscillatorParameters(), np.random.default_rng(0)
    many = rng.standard_normal((kernel.TANGENT_ROWS, 37))
    few = [many[:, i : i + 5].copy() for i in range(0, 37, 5)]
    belt, state = kernel.steady(p.belt_speed), kernel.State(0.5, -0.3)
    for rows in (many, *few):
        kernel.advance_with_tangents(p.plant, kernel.UNKNOWN, state, belt, 4.0, rows, None)
    assert np.concatenate(few, axis=1) == pytest.approx(many, rel=1e-9, abs=1e-9)
