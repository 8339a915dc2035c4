"""Our cycles against simulation programs that no one here wrote: SUNDIALS CVODE, PathSim and, where it is, Siconos.

CVODE and PathSim get our right-hand side and nothing else: the steps, the error control and the search for events are
theirs. So an error in how we step, land on the belt or break away from it would show here; one in the forces would not
(for that there is `oracle.py`). Siconos has a form of its own for dry friction, with the forces written again.
"""

import importlib
import itertools
import json
import shutil
import subprocess
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from sd_friction_env import LimitCycle, OscillatorParameters, kernel, limit_cycle

RTOL, ATOL = 1e-11, 1e-13
AGREEMENT = 1e-7

# Slip starts on the surface that ends it (v_rel = 0 at breakaway, v = 0 at a maximum of x). Whether a zero at the very
# start is an event is each program's own convention, and rounding decides on which side of zero it lies, so nothing is
# looked for until this time. By then the mass has left the surface, and no leg here is less than ten times as long.
HEAD_START = 0.1
# Programs look at an event function at the ends of their steps; longer ones might step over a pair of crossings, the
# more so in stick, where x is a straight line and every step is exact.
MAX_STEP = 0.1
LONGEST = 50.0

State = tuple[float, float]
Flow = Callable[[float, float], State]
Surface = Callable[[float, float], float]


class Leg(NamedTuple):
    """The time and state at which a surface was first crossed upwards, and the states at which a watched one was."""

    t: float
    x: float
    v: float
    watched: list[State]


def with_cvode(flow: Flow, start: State, surface: Surface, watched: Surface) -> Leg:
    """Follow a flow until ``surface`` rises through zero, with CVODE's Adams method and its root finding."""
    CVODE = pytest.importorskip("sksundae.cvode", reason="scikit-sundae is not installed").CVODE

    def rhs(t: float, y: Any, yp: Any) -> None:
        yp[:] = flow(float(y[0]), float(y[1]))

    def surfaces(t: float, y: Any, events: Any) -> None:
        x, v = float(y[0]), float(y[1])
        events[:] = surface(x, v), watched(x, v)

    surfaces.terminal = [True, False]  # type: ignore[attr-defined]
    surfaces.direction = [1, 0]  # type: ignore[attr-defined]
    options = {"method": "Adams", "rtol": RTOL, "atol": ATOL, "max_step": MAX_STEP, "max_num_steps": 20_000}
    head = CVODE(rhs, **options).solve([0.0, HEAD_START], start)
    run = CVODE(rhs, eventsfn=surfaces, num_events=2, **options).solve([HEAD_START, LONGEST], head.y[-1])
    assert head.success
    assert run.success
    assert run.i_events[-1][0] == 1, "the surface was never reached"
    x, v = run.y_events[-1].tolist()
    passed = [(y[0], y[1]) for y, which in zip(run.y_events.tolist(), run.i_events, strict=True) if which[1]]
    return Leg(float(run.t_events[-1]), x, v, passed)


def with_pathsim(flow: Flow, start: State, surface: Surface, watched: Surface) -> Leg:
    """The same with PathSim: an ODE block, Prince and Dormand's 8(7) pair, and its zero-crossing events."""
    pytest.importorskip("pathsim", reason="PathSim is not installed")
    events, blocks, solvers = (importlib.import_module(f"pathsim.{part}") for part in ("events", "blocks", "solvers"))
    block = blocks.ODE(lambda y, u, t: np.array(flow(float(y[0]), float(y[1]))), np.array(start))
    options = {"Solver": solvers.RKDP87, "tolerance_lte_rel": RTOL, "tolerance_lte_abs": ATOL, "dt_max": MAX_STEP}
    simulation = importlib.import_module("pathsim").Simulation([block], [], log=False, **options)
    reached: list[tuple[float, float, float]] = []
    passed: list[State] = []

    def state() -> State:
        x, v = block.engine.state.tolist()
        return x, v

    def arrive(t: float) -> None:
        reached.append((float(t), *state()))
        simulation.stop()

    simulation.run(HEAD_START)
    # PathSim stops its search for an event where |surface| is this small, in our dimensionless units.
    simulation.add_event(events.ZeroCrossingUp(lambda t: surface(*state()), arrive, tolerance=1e-11))
    simulation.add_event(
        events.ZeroCrossing(lambda t: watched(*state()), lambda t: passed.append(state()), tolerance=1e-11)
    )
    simulation.run(LONGEST)
    assert reached, "the surface was never reached"
    return Leg(*reached[0], passed)


Program = Callable[[Flow, State, Surface, Surface], Leg]
PROGRAMS = [pytest.param(with_cvode, id="CVODE"), pytest.param(with_pathsim, id="PathSim")]


def backward_slip(parameters: OscillatorParameters) -> Flow:
    """Our right-hand side while the mass lags behind the belt."""
    plant, v_belt = parameters.plant, parameters.belt_speed

    def flow(x: float, v: float) -> State:
        return v, kernel.slip_acceleration(
            plant, kernel.SLIP_BACKWARD, kernel.State(x, v), kernel.Drive(v_belt, 0.0, 0.0)
        )

    return flow


def slip_then_stick(program: Program, cycle: LimitCycle) -> tuple[Leg, Leg]:
    """One cycle from its breakaway: slip until the mass has the belt's speed again, then stick until breakaway."""
    p = cycle.parameters
    v_belt = p.belt_speed
    slip = program(backward_slip(p), (cycle.x_breakaway, v_belt), lambda x, v: v - v_belt, lambda x, v: v)

    def overload(x: float, v: float) -> float:
        return float(abs(2.0 * p.beta * v_belt + p.restoring_force(x)) - p.mu_s * p.normal_force(x))

    assert overload(slip.x, v_belt) < 0.0, "the mass would not stick where it lands"
    stick = program(lambda x, v: (v_belt, 0.0), (slip.x, v_belt), overload, lambda x, v: v)
    return slip, stick


def close_to(value: float) -> Any:
    return pytest.approx(value, rel=AGREEMENT, abs=0.0)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize(
    ("geometry", "alpha", "belt_speed"),
    [("exact", 0.8, 0.2), ("cubic", 0.8, 0.2), ("linear", 0.8, 0.2), ("exact", 0.2, 0.2), ("exact", 0.8, 0.05)],
)
def test_another_program_finds_the_same_stick_slip_cycle(program, geometry, alpha, belt_speed):
    cycle = limit_cycle(OscillatorParameters(geometry=geometry, alpha=alpha, belt_speed=belt_speed))
    assert (cycle.kind, cycle.sticks, cycle.forward_arcs) == ("stick-slip", 1, 0)
    slip, stick = slip_then_stick(program, cycle)
    assert slip.x == close_to(cycle.x_restick)
    assert slip.t == close_to(cycle.period * (1.0 - cycle.stick_fraction))
    assert stick.x == close_to(cycle.x_breakaway)
    assert slip.t + stick.t == close_to(cycle.period)
    # x runs on after breakaway and back before landing, so both extremes lie in slip, where v passes zero.
    turns = [x for x, _ in slip.watched]
    assert max(turns) == close_to(cycle.x_max)
    assert min(turns) == close_to(cycle.x_min)
    assert 0.5 * (max(turns) - min(turns)) == close_to(cycle.amplitude)


@pytest.mark.parametrize("program", PROGRAMS)
def test_another_program_comes_back_to_the_start_of_a_pure_slip_cycle(program):
    cycle = limit_cycle(OscillatorParameters(belt_speed=0.41))
    assert cycle.kind == "pure-slip"
    flow, start = backward_slip(cycle.parameters), (cycle.x_max, 0.0)
    lap = program(flow, start, lambda x, v: -v, lambda x, v: v)
    assert lap.x == close_to(cycle.x_max)
    assert lap.t == close_to(cycle.period)
    assert min(x for x, _ in lap.watched) == close_to(cycle.x_min)
    # ... and on the way the mass never had the belt's speed.
    again = program(flow, start, lambda x, v: -v, lambda x, v: v - cycle.parameters.belt_speed)
    assert again.watched == []


# Siconos comes with Debian (python3-siconos) for Debian's own Python and NumPy, so it runs as a program of its own. It
# steps over events instead of finding them: friction's set-valued part is a relay law, solved for in each step. The
# smooth falling part of mu is held over a step, which makes the whole of first order in the step.
SICONOS = """
import json, sys
import siconos.kernel as sk

beta, limit, k1, k3, v_belt, x, duration, steps = json.loads(sys.argv[1])
amplitudes = []
for step in steps:
    mass = sk.FirstOrderLinearTIDS([x, v_belt], [[0.0, 1.0], [-1.0, -2.0 * beta]], [0.0, 0.0])
    v_rel = sk.FirstOrderLinearTIR([[0.0, 1.0]], [[0.0], [1.0]])
    v_rel.setePtr(sk.SiconosVector([-v_belt]))
    system = sk.NonSmoothDynamicalSystem(0.0, duration)
    system.insertDynamicalSystem(mass)
    system.link(sk.Interaction(sk.RelayNSL(1, -limit, limit), v_rel), mass)
    clock = sk.TimeDiscretisation(0.0, step)
    run = sk.TimeStepping(system, clock, sk.EulerMoreauOSI(0.5), sk.Relay())
    places = [x]
    while run.hasNextEvent():
        w = mass.x()[1] - v_belt
        mass.setbPtr(sk.SiconosVector([0.0, k1 * w - k3 * w**3]))
        run.computeOneStep()
        places.append(float(mass.x()[0]))
        run.nextStep()
    amplitudes.append(0.5 * (max(places) - min(places)))
print(json.dumps(amplitudes))
"""


def test_siconos_tends_to_our_amplitude_on_the_linear_belt_as_its_step_shrinks():
    for name in ("python3", "/usr/bin/python3"):
        python = shutil.which(name)
        probe = ["-c", "import siconos.kernel"]
        if python and subprocess.run([python, *probe], check=False, capture_output=True, timeout=60).returncode == 0:
            break
    else:
        pytest.skip("Siconos is not installed (Debian's python3-siconos)")
    p = OscillatorParameters(geometry="linear")
    cycle = limit_cycle(p)
    steps = [0.008, 0.004, 0.002, 0.001]
    # g1 = 1 on the linear belt: N drops out of the friction force.
    sent = [p.beta, p.mu_s, p.k1, p.k3, p.belt_speed, cycle.x_breakaway, cycle.period, steps]
    command = [python, "-c", SICONOS, json.dumps(sent)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    errors = [abs(amplitude - cycle.amplitude) for amplitude in json.loads(done.stdout.splitlines()[-1])]
    assert errors[-1] < 1e-4 * cycle.amplitude
    assert [coarse / fine for coarse, fine in itertools.pairwise(errors)] == pytest.approx([2.0] * 3, rel=0.02)
