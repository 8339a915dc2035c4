"""Branches of forced orbits: closed forms of Coulomb oscillators, and each bifurcation's condition by other means."""

import itertools
import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from sd_friction_env import OscillatorParameters, kernel
from sd_friction_env.physics.forced import doubled_orbit, follow_orbit, forced_orbit, orbit_branches, poincare_section
from sd_friction_env.physics.forced.branches import OrbitProblem, begins_at

STRIBECK = OscillatorParameters(alpha=0.7, belt_speed=0.2, force_amplitude=0.12, force_frequency=1.0)
COULOMB = OscillatorParameters(
    geometry="linear", friction="coulomb", mu_s=0.2, mu_k=0.2, beta=0.05, belt_speed=0.5, force_amplitude=0.1
)
STANDING = COULOMB.replace(belt_speed=0.0, force_amplitude=0.4)
SMOOTH = OscillatorParameters(geometry="duffing", mu_s=0.0, mu_m=0.0, belt_speed=9.0, force_amplitude=0.3)


def of_kind(branch, kind):
    """The rows of a kind and their orbits."""
    return [(row, orbit) for row, orbit in zip(branch.table.rows(), branch.orbits, strict=True) if row["kind"] == kind]


@pytest.fixture(scope="module")
def stribeck():
    return follow_orbit(forced_orbit(STRIBECK), ("force_amplitude", 0.02, 0.3))


def test_a_slip_grazes_the_belt_where_the_linear_response_reaches_its_speed():
    # In slip Coulomb friction is constant: x' = f W/|1 - W^2 + 2 i beta W| cos(...) reaches v_b = 0.5.
    rate = 1.3
    branch = follow_orbit(
        forced_orbit(COULOMB.replace(force_frequency=rate)), ("force_amplitude", 0.05, 0.8), points=20
    )
    (row, orbit), *rest = of_kind(branch, "grazing-sliding")
    assert not rest
    assert row["force_amplitude"] == pytest.approx(0.5 * math.hypot(1.0 - rate**2, 0.1 * rate) / rate, abs=1e-11)
    assert orbit.amplitude == pytest.approx(0.5 / rate, abs=1e-10)
    assert [row["sequence"] for row in branch.table.rows() if row["kind"] == "end"] == ["b", "bf"]
    assert branch.table["residual"].max() < 1e-10


@pytest.mark.parametrize("rate", [0.8, 1.3, 1.9])
def test_motion_without_stops_ends_where_den_hartog_says(rate):
    # Den Hartog (1931), undamped: half a period of x'' + x = F + f cos(W t + phi) from rest to rest; A = F/W^2 at last.
    force = 0.2 * abs(1.0 - rate**2) * math.hypot(1.0 / rate**2, math.tan(0.5 * math.pi / rate) / rate)
    p = STANDING.replace(beta=0.0, force_frequency=rate, force_amplitude=1.4 * force)
    branch = follow_orbit(forced_orbit(p, 1.0, transient=400), ("force_amplitude", 0.9 * force, 2.0 * force), points=20)
    (row, orbit), *rest = of_kind(branch, "crossing-sliding")
    assert not rest
    assert row["force_amplitude"] == pytest.approx(force, abs=1e-10)
    assert orbit.amplitude == pytest.approx(0.2 / rate**2, abs=1e-10)
    # Shaw (1986): half a period maps by a rotation and the saltation diag(1, r), r the ratio of the accelerations.
    for row, orbit in zip(branch.table.rows(), branch.orbits, strict=True):
        if row["kind"] in ("start", "end") and row["sequence"] in ("bf", "fb"):
            inertia = orbit.amplitude * rate**2
            r, angle = (inertia - 0.2) / (inertia + 0.2), math.pi / rate
            half = np.diag((1.0, r)) @ [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
            values = np.linalg.eigvals(half @ half)
            for value in orbit.multipliers:
                assert np.abs(values - value).min() < 1e-7


def test_a_stick_is_cut_in_two_where_its_load_touches_the_cone():
    # Stuck at A the force f just moves the mass on: A = f - F. Released from -A at f cos = F - A, it stops at A.
    force, friction, beta = 0.4, 0.2, 0.05
    at_rest, release = force - friction, math.acos((2.0 * friction - force) / force)

    def stop(rate):
        """Where the slip from -A ends, by the matrix exponential of (x, v, cos, sin, 1)."""
        matrix = np.zeros((5, 5))
        matrix[0, 1] = 1.0
        matrix[1] = -1.0, -2.0 * beta, force, 0.0, -friction
        matrix[2, 3], matrix[3, 2] = -rate, rate
        begin = np.array([-at_rest, 0.0, math.cos(-release), math.sin(-release), 1.0])
        time = brentq(lambda t: (expm(matrix * t) @ begin)[1], 1.0, 7.0, xtol=1e-14)
        return (expm(matrix * time) @ begin)[0] - at_rest

    branch = follow_orbit(
        forced_orbit(STANDING.replace(force_frequency=0.25), 1.0), ("force_frequency", 0.16, 0.9), points=20
    )
    (row, orbit), *rest = of_kind(branch, "adding-sliding")
    assert not rest
    assert row["force_frequency"] == pytest.approx(brentq(stop, 0.17, 0.21, xtol=1e-14), abs=1e-10)
    assert orbit.amplitude == pytest.approx(at_rest, abs=1e-10)
    assert row["condition"] < 1e-10


def test_the_folds_of_a_bent_resonance_have_a_multiplier_of_one():
    branch = follow_orbit(forced_orbit(SMOOTH.replace(force_frequency=0.9)), ("force_frequency", 0.8, 2.2))
    folds = of_kind(branch, "fold")
    assert len(folds) == 2
    for row, orbit in folds:
        assert min(abs(value - 1.0) for value in orbit.multipliers) < 1e-9
        # The orbits near by are stable on one side; Newton's method alone finds one where the branch lies.
        rate, inwards = row["force_frequency"], 1.0 if row["force_frequency"] < 1.5 else -1.0
        near = [o for o, r in zip(branch.orbits, branch.table["force_frequency"], strict=True) if abs(r - rate) < 0.02]
        assert {o.stable for o in near} == {True, False}
        beside = forced_orbit(
            SMOOTH.replace(force_frequency=rate + 1e-4 * inwards), orbit.x, orbit.v, multiple=1, transient=0
        )
        assert abs(beside.x - orbit.x) < 0.1
    # the unstable part is listed, between the folds
    middle = branch.table["force_frequency"][~branch.table["stable"]]
    assert min(r["force_frequency"] for r, _ in folds) <= middle.min() + 1e-9
    assert middle.max() - 1e-9 <= max(r["force_frequency"] for r, _ in folds)


def test_at_a_flip_an_orbit_of_twice_the_period_begins(stribeck):
    (row, orbit), *rest = of_kind(stribeck, "flip")
    assert not rest
    assert orbit.multipliers[0] == pytest.approx(-1.0, abs=1e-8)
    before, after = (STRIBECK.replace(force_amplitude=row["force_amplitude"] + d) for d in (-2e-3, 2e-3))
    assert [forced_orbit(p, orbit.x, orbit.v, transient=600).multiple for p in (before, after)] == [1, 2]
    double = doubled_orbit(orbit, "force_amplitude")
    assert double.multiple == 2
    assert 1e-4 < np.abs(double.points[0] - double.points[1]).max() < 1e-2
    branch = follow_orbit(double, ("force_amplitude", 0.12, 0.14))
    direct = forced_orbit(after, orbit.x, orbit.v, transient=600)
    i = int(np.argmin(np.abs(branch.table["force_amplitude"] - after.force_amplitude)))
    assert abs(branch.orbits[i].x_max - direct.x_max) < 0.02
    assert any(o.stable and o.multiple == 2 for o in branch.orbits)
    assert begins_at(branch, orbit)
    assert not begins_at(branch, stribeck.orbits[0])
    with pytest.raises(ValueError, match="orbit must be at a flip"):
        doubled_orbit(stribeck.orbits[0], "force_amplitude")


def test_periods_double_in_a_cascade_and_end_where_they_are_halved(stribeck):
    table = orbit_branches(forced_orbit(STRIBECK), ("force_amplitude", 0.1, 0.15), points=20, doublings=2)
    rows = [row for row in table.rows() if row["cycle"] == 0]
    assert sorted({(row["branch"], row["multiple"]) for row in rows}) == [(0, 1), (1, 2), (2, 4)]
    flips = [row["force_amplitude"] for row in rows if row["kind"] == "flip" and row["multiple"] < 4]
    halved = [row["force_amplitude"] for row in rows if row["reason"] == "the period is halved"]
    # The orbits of four cycles begin at a flip and end where those of two graze the belt.
    (graze,) = [r["force_amplitude"] for r in rows if r["kind"] == "grazing-sliding" and r["multiple"] == 2]
    assert sorted(halved) == pytest.approx(sorted([*flips, graze]), abs=1e-7)
    assert flips[0] == pytest.approx(of_kind(stribeck, "flip")[0][0]["force_amplitude"], abs=1e-10)
    # x and v of each cycle are the section's points, which the excitation maps onto one another.
    row = next(row for row in rows if row["multiple"] == 4 and row["kind"] == "point")
    chosen = (table["branch"] == 2) & (table["force_amplitude"] == row["force_amplitude"])
    p = STRIBECK.replace(force_amplitude=row["force_amplitude"])
    section = poincare_section(p, row["x"], row["v"], cycles=4, transient=0)
    assert np.roll(section["x"], 1) == pytest.approx(table["x"][chosen], abs=1e-9)
    with pytest.raises(ValueError, match="doublings must be"):
        orbit_branches(forced_orbit(STRIBECK), ("force_amplitude", 0.1, 0.15), doublings=-1)


def test_a_flip_without_other_orbits_has_the_reason():
    value = 0.126803628053  # the flip, at the end of the range: the orbits of twice the period lie beyond
    table = orbit_branches(forced_orbit(STRIBECK), ("force_amplitude", 0.1, value + 1e-9), points=10, doublings=1)
    (reason,) = table["reason"][table["kind"] == "flip"]
    assert "force_amplitude of the start must be" in reason
    assert set(table["branch"]) == {0}


def cone_and_approach(orbit):
    """From samples of an orbit: the least distance in force of an event from the cone, and in speed of a slip."""
    path = orbit.trajectory(20_000)
    p = path.parameters
    excess = []
    for event in path.events:
        plant = kernel.at_time(p.plant, event.time)
        load = kernel.stick_load(plant, event.x, kernel.steady(p.belt_speed))
        excess.append(abs(abs(load) - p.mu_s * p.normal_force(event.x)))
    gap = (path.v_belt - path.v)[path.mode != 0]
    inner = [gap[i] for i in range(1, len(gap) - 1) if gap[i - 1] > gap[i] < gap[i + 1] and gap[i] > 0.0]
    return min(excess, default=math.inf), min(inner, default=math.inf)


@pytest.mark.parametrize("kind", ["grazing-sliding", "switching-sliding", "crossing-sliding"])
def test_each_sliding_bifurcation_meets_its_condition(stribeck, kind):
    (row, orbit), *rest = of_kind(stribeck, kind)
    assert not rest
    assert row["condition"] < 1e-10
    assert row["residual"] < 1e-10
    excess, approach = cone_and_approach(orbit)
    assert min(excess, approach if kind == "grazing-sliding" else math.inf) < 1e-6
    sequences = [row["sequence"] for row in stribeck.table.rows()]
    i = [row["kind"] for row in stribeck.table.rows()].index(kind)
    around = {sequences[i - 1], sequences[i + 1]}
    assert (
        around
        == {
            "grazing-sliding": {"b", "bs"},
            "switching-sliding": {"bs", "bfs"},
            "crossing-sliding": {"bfs", "bf"},
        }[kind]
    )


@pytest.mark.parametrize("name", ["force_frequency", "force_amplitude", "force_phase", "belt_speed", "mu_s", "alpha"])
def test_the_derivatives_of_the_map_are_what_differences_say(name):
    p = STRIBECK.replace(force_phase=0.3)
    orbit, value = forced_orbit(p), p.values[name]
    problem = OrbitProblem(orbit, name, (value - 0.1, value + 0.1), 0.0)
    problem, y, _ = problem.moved(np.array([orbit.x, orbit.v, value]), np.zeros(3))
    h = 1e-6
    for column, row in enumerate(np.eye(3)):
        slope = (problem.residual(y + h * row) - problem.residual(y - h * row)) / (2.0 * h)
        assert problem.jacobian(y)[:, column] == pytest.approx(slope, abs=1e-6)


def test_every_orbit_closes_and_the_branch_is_continuous(stribeck):
    for orbit in stribeck.orbits[::10]:
        path = orbit.trajectory(200)
        assert (path.x[-1], path.v[-1]) == pytest.approx((orbit.x, orbit.v), abs=1e-9)
        assert orbit.x_min - 1e-12 <= path.x.min() <= path.x.max() <= orbit.x_max + 1e-12
    steps = [abs(b.amplitude - a.amplitude) for a, b in itertools.pairwise(stribeck.orbits)]
    assert max(steps) < 0.02
    ends = [row["reason"] for row in stribeck.table.rows() if row["kind"] == "end"]
    assert ends == ["force_amplitude reaches 0.02", "force_amplitude reaches 0.3"]


@pytest.mark.parametrize(
    ("p", "name"),
    [
        (STRIBECK, "alpha"),
        (STRIBECK, "belt_speed"),
        (STRIBECK, "force_frequency"),
        (STRIBECK, "mu_m"),
        (OscillatorParameters(ripple_amplitude=0.1, ripple_frequency=0.66, ripple_phase=0.4), "ripple_frequency"),
        (OscillatorParameters(ripple_amplitude=0.1, ripple_frequency=0.66), "belt_speed"),
    ],
)
def test_the_branch_is_what_newton_finds_at_its_parameters(p, name):
    value = p.values[name]
    branch = follow_orbit(forced_orbit(p, phase=0.25), (name, 0.97 * value, 1.03 * value), points=10)
    for orbit in (branch.orbits[0], branch.orbits[-1]):
        direct = forced_orbit(orbit.parameters, orbit.x + 1e-6, orbit.v, multiple=1, transient=0, phase=0.25)
        assert (direct.x, direct.v) == pytest.approx((orbit.x, orbit.v), abs=1e-8)
        assert direct.multipliers[0] == pytest.approx(orbit.multipliers[0], abs=1e-5)
    assert branch.table["residual"].max() < 1e-10


def test_a_branch_of_its_own_is_followed_once_around():
    p = OscillatorParameters(ripple_amplitude=0.1, ripple_frequency=0.66)
    branch = follow_orbit(forced_orbit(p), ("ripple_frequency", 0.4, 1.2), points=50)
    assert branch.table["reason"][-1] == "the curve is closed"
    assert len(of_kind(branch, "fold")) == 4


def test_where_the_map_jumps_the_branch_ends_with_a_reason():
    p = COULOMB.replace(mu_s=0.3, force_frequency=1.3)
    branch = follow_orbit(forced_orbit(p), ("force_amplitude", 0.05, 0.8), points=20)
    last = list(branch.table.rows())[-1]
    assert last["kind"] == "grazing-sliding"
    assert last["reason"] == "no orbit goes on beyond the grazing-sliding"
    assert math.isnan(last["condition"])


def test_a_branch_that_ends_where_it_starts_says_why():
    branch = follow_orbit(forced_orbit(COULOMB.replace(force_frequency=1.3, force_amplitude=0.3)), ("mu_s", 0.1, 0.25))
    first = next(branch.table.rows())
    assert first["mu_s"] == 0.2
    assert first["reason"].startswith("mu_k must not exceed mu_s")
    assert branch.table["reason"][-1] == "mu_s reaches 0.25"


def test_wrong_arguments_are_named():
    orbit = forced_orbit(COULOMB)
    with pytest.raises(TypeError, match="start must be a ForcedOrbit"):
        follow_orbit(COULOMB, ("force_amplitude", 0.0, 1.0))
    with pytest.raises(ValueError, match=r"over must be one of .*'alpha'.* got 'mass'"):
        follow_orbit(orbit, ("mass", 0.0, 1.0))
    with pytest.raises(ValueError, match="the plant does not use the parameter 'kappa'"):
        follow_orbit(orbit, ("kappa", 0.5, 1.5))
    with pytest.raises(ValueError, match="the plant does not use the parameter 'ripple_frequency': ripple_amplitude"):
        follow_orbit(orbit, ("ripple_frequency", 0.5, 1.5))
    with pytest.raises(ValueError, match="low < high"):
        follow_orbit(orbit, ("beta", 0.5, 0.1))
    with pytest.raises(ValueError, match="beta of the start must be"):
        follow_orbit(orbit, ("beta", 0.5, 0.7))
