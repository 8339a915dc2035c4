"""All attractors, and which start reaches which."""

import math

import numpy as np
import pytest

from scripts.hunting import labels
from sd_friction_env import (
    OrbitError,
    OscillatorParameters,
    attractor_curves,
    attractors,
    critical_belt_speeds,
    equilibria,
    first_lyapunov_coefficient,
    limit_cycle,
    simulate,
    slip_cycles,
    stick_intervals,
)
from sd_friction_env.physics.basins import _labels_for, basin_grid, basins
from sd_friction_env.physics.forced import lyapunov_exponent
from sd_friction_env.physics.orbits import ContactLossError, ReturnMap, same_motion

EXACT = OscillatorParameters()
CUBIC = EXACT.replace(geometry="cubic")


def test_three_stick_intervals_with_their_exits():
    # exact alpha .2, v_b .2: [-1.199, -.779] exits backward, [-.091, .104] forward, [.732, 1.159] backward
    p = EXACT.replace(alpha=0.2)
    intervals = stick_intervals(p)
    assert np.array(intervals) == pytest.approx(np.array([(-1.199, -0.779), (-0.091, 0.104), (0.732, 1.159)]), abs=6e-4)
    loads = [2.0 * p.beta * 0.2 + p.restoring_force(right) for _, right in intervals]
    assert [load > 0.0 for load in loads] == [True, False, True]
    assert [abs(load) for load in loads] == pytest.approx([p.mu_s * p.normal_force(right) for _, right in intervals])


@pytest.mark.parametrize(
    ("parameters", "left"),
    [
        (EXACT.replace(alpha=0.2, belt_speed=0.1), "stick-slip"),
        (EXACT.replace(alpha=0.2, belt_speed=0.42), "pure-slip"),
        (EXACT.replace(alpha=0.2, belt_speed=0.58), "steady-slip"),
        (EXACT.replace(alpha=0.5, belt_speed=0.41), None),
        (EXACT.replace(alpha=0.5, belt_speed=0.43), "pure-slip"),
        (EXACT.replace(alpha=0.6, belt_speed=0.42), None),
        (EXACT.replace(alpha=0.7, belt_speed=0.46), "steady-slip"),
        (EXACT.replace(alpha=0.8, belt_speed=0.58), None),
        (CUBIC.replace(alpha=0.2, belt_speed=0.14), "stick-slip"),
        (CUBIC.replace(alpha=0.2, belt_speed=0.2), None),
        (CUBIC.replace(alpha=0.2, belt_speed=0.46), "steady-slip"),
        (CUBIC.replace(alpha=0.3, belt_speed=0.08), "stick-slip"),
        (CUBIC.replace(alpha=0.3, belt_speed=0.12), None),
        (CUBIC.replace(alpha=0.5, belt_speed=0.46), "steady-slip"),
        (CUBIC.replace(alpha=0.8, belt_speed=0.5), None),
    ],
)
def test_left_well_attractors_are_where_they_are_known_to_be(parameters, left):
    kinds = [cycle.kind for cycle in attractors(parameters) if cycle.x_max < 0.0]
    assert kinds == ([] if left is None else [left])


@pytest.mark.parametrize(
    "parameters",
    [
        EXACT.replace(alpha=0.2),
        EXACT.replace(alpha=0.5, belt_speed=0.43),
        EXACT.replace(alpha=0.7, belt_speed=0.46),
        CUBIC.replace(alpha=0.2, belt_speed=0.1),
        CUBIC.replace(belt_speed=0.42),
        EXACT.replace(alpha=0.5, beta=3.0, mu_m=0.2),
    ],
)
def test_a_basin_label_is_the_attractor_that_following_the_start_finds(parameters):
    rng = np.random.default_rng(1)
    x, v = rng.uniform(-1.5, 1.5, 150), rng.uniform(-1.0, 1.0, 150)
    result = basins(parameters, x, v)
    for label, x0, v0 in zip(result.labels, x, v, strict=True):
        try:
            cycle = limit_cycle(parameters, x0, v0)
        except OrbitError:
            assert label == -1
        else:
            assert same_motion(cycle, result.attractors[label])


def test_threads_change_no_label(monkeypatch):
    rng = np.random.default_rng(2)
    x, v = rng.uniform(-1.5, 1.5, 2000), rng.uniform(-1.0, 1.0, 2000)
    alone = basins(EXACT.replace(alpha=0.2), x, v).labels
    monkeypatch.setattr("sd_friction_env.physics.basins._STARTS_WORTH_A_THREAD", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    assert np.array_equal(basins(EXACT.replace(alpha=0.2), x, v).labels, alone)


def test_fractions_add_to_one_and_carry_their_uncertainty():
    _, _, result = basin_grid(EXACT.replace(alpha=0.2), (-1.5, 1.5), (-1.0, 1.0), (60, 50))
    assert result.labels.shape == (50, 60)
    shares = [result.fraction(label) for label in range(-2, len(result.attractors))]
    assert sum(share for share, _ in shares) == pytest.approx(1.0)
    share, error = shares[2]
    assert error == pytest.approx(math.sqrt(share * (1.0 - share) / 3000))


def test_pure_slip_cycles_and_equilibrium_alternate_in_stability():
    stable = slip_cycles(EXACT.replace(belt_speed=0.42))
    assert len(stable) == 1
    assert 0.0 < stable[0].floquet_multiplier < 1.0
    assert not equilibria(EXACT.replace(belt_speed=0.42))[-1].stable
    assert slip_cycles(EXACT.replace(belt_speed=0.45)) == []


def test_a_pair_of_cycles_about_to_merge_is_not_stepped_over():
    laps = ReturnMap(EXACT, equilibria(EXACT)[-1])
    laps.lap = lambda r: (None, math.nan) if r > 1.0 else ((0, 0), 1e-7 - (r - 0.4321) ** 2)  # type: ignore[method-assign]
    (found,) = laps.ranges()
    assert found.cycles == pytest.approx((0.4321 - math.sqrt(1e-7), 0.4321 + math.sqrt(1e-7)))
    assert found.tendencies == (-1, 1, -1)
    assert found.ends == (0.0, pytest.approx(1.0))


@pytest.mark.parametrize("parameters", [EXACT, CUBIC, EXACT.replace(geometry="linear"), CUBIC.replace(mu_m=0.14)])
def test_the_lyapunov_coefficient_predicts_the_growth_of_amplitude_below_v_b1(parameters):
    # Normal form r' = c (v_b1 - v_b) r + a r^3 with 2 c the slope of the eigenvalues' sum: r^2 = -c (v_b1 - v_b)/a.
    a = first_lyapunov_coefficient(parameters)
    assert a < 0.0
    v_b1 = critical_belt_speeds(parameters).v_b1
    lead = 1e-6
    below = equilibria(parameters.replace(belt_speed=v_b1 - lead))[-1]
    radius = math.sqrt(-below.eigenvalues[0].real / a)
    assert limit_cycle(parameters.replace(belt_speed=v_b1 - lead)).amplitude == pytest.approx(radius, rel=0.01)


def test_attractor_curves_tell_the_wells_apart():
    table = attractor_curves(EXACT.replace(alpha=0.5), [0.41, 0.43])
    assert table["belt_speed"].tolist() == [0.41, 0.43, 0.43]
    assert table["well"].tolist() == ["right", "left", "right"]
    for row in table.rows():
        cycle = limit_cycle(EXACT.replace(alpha=0.5, belt_speed=row["belt_speed"]), row["x_start"], row["v_start"])
        assert cycle.amplitude == pytest.approx(row["amplitude"], rel=1e-9)


def test_bad_starts_and_grids_are_refused():
    with pytest.raises(ValueError, match="x must be a finite number"):
        basins(EXACT, [0.0, math.nan], 0.0)
    with pytest.raises(ValueError, match="at least one start"):
        basins(EXACT, [], [])
    with pytest.raises(ValueError, match="belt_speed must be positive"):
        basins(EXACT.replace(belt_speed=0.0), 0.0, 0.0)
    with pytest.raises(ValueError, match="x_limits must have low < high"):
        basin_grid(EXACT, (1.0, -1.0), (-1.0, 1.0))
    with pytest.raises(ValueError, match="shape"):
        basin_grid(EXACT, (-1.0, 1.0), (-1.0, 1.0), (1, 5))


LINEAR = EXACT.replace(geometry="linear")
OVERDAMPED = LINEAR.replace(g1=1.22, beta=0.01, mu_s=0.55, mu_m=0.3, v_m=0.25, belt_speed=1.06)


@pytest.mark.parametrize(
    ("parameters", "starts"),
    [
        (OVERDAMPED, [(-1.38, 0.67), (-0.72, 1.99)]),
        (OVERDAMPED.replace(geometry="duffing", kappa=0.2, belt_speed=0.95), [(7.73, 7.04), (0.0, 0.95)]),
        # a belt so fast that the equilibrium is far out, and crept to for longer than motions are followed
        (LINEAR.replace(g1=1.5, beta=0.0, mu_s=0.5, mu_m=0.1, v_m=0.2, belt_speed=2.5), [(0.0, 2.5), (3.0, 2.0)]),
        # a level spring: the equilibrium attracts more slowly than any exponential
        (EXACT.replace(alpha=1.0, mu_s=0.0, mu_m=0.0), [(0.1, 0.0), (1.0, 0.5)]),
    ],
)
def test_what_creeps_into_a_node_is_steady_slip_and_keeps_contact(parameters, starts):
    (place,) = [e.x for e in equilibria(parameters)]
    result = basins(parameters, *np.array(starts).T)
    assert [(a.kind, a.x_max) for a in result.attractors] == [("steady-slip", place)]
    assert result.labels.tolist() == [0] * len(starts)
    for x, v in starts:
        cycle = limit_cycle(parameters, x, v)
        assert (cycle.kind, cycle.x_max) == ("steady-slip", place)


def test_an_exit_that_leads_nowhere_known_is_undecided_and_one_off_the_belt_lost(monkeypatch):
    monkeypatch.setattr("sd_friction_env.physics.basins._labels_for", _labels_for.__wrapped__)  # past its cache
    for error, label in ((OrbitError("no"), -2), (ContactLossError("off"), -1)):

        def fail(*_, error=error):
            raise error

        monkeypatch.setattr("sd_friction_env.physics.basins.limit_of_motion", fail)
        assert basins(EXACT, 0.5, EXACT.belt_speed).labels.tolist() == label


def test_a_stick_interval_may_end_beyond_the_states_that_starts_may_have():
    parameters = LINEAR.replace(g1=80.0, mu_s=0.2, mu_m=0.1)
    assert stick_intervals(parameters)[-1][1] > 10.0
    assert [cycle.kind for cycle in attractors(parameters)] == ["stick-slip"]
    assert basins(parameters, 0.0, 0.2).labels.tolist() == 0


@pytest.mark.parametrize(
    ("parameters", "x", "v"),
    [
        (EXACT.replace(alpha=0.43, g1=0.9, beta=0.25, mu_s=0.51, friction="coulomb", mu_k=0.05), 0.854, 2.761),
        (EXACT.replace(alpha=0.0, g1=1.06, beta=0.03, friction="hyperbolic", mu_s=0.06, delta=0.15), -1.966, -1.209),
        (CUBIC.replace(alpha=0.4, g1=2.0, beta=0.03, mu_s=0.1), 0.0, -0.6),
    ],
)
def test_laps_round_both_wells_do_not_decide_the_well(parameters, x, v):
    rng = np.random.default_rng(5)
    xs, vs = x + rng.uniform(-0.3, 0.3, 40), v + rng.uniform(-0.3, 0.3, 40)
    result = basins(parameters.replace(belt_speed=0.8 if parameters.geometry == "cubic" else 1.1), xs, vs)
    assert set(result.labels.tolist()) == {0, 1}
    for label, x0, v0 in zip(result.labels, xs, vs, strict=True):
        late = simulate(result.parameters, x0, v0, 400.0, dt=0.5)
        assert late.status == "ok"
        assert result.attractors[label].x_max == pytest.approx(late.x[-1], abs=0.05)


def test_a_centre_attracts_nothing_and_its_orbits_are_one_family():
    # Circles about x = mu_k that stay below the belt's speed are closed; all other motion ends in the stick-slip cycle.
    parameters = LINEAR.replace(friction="coulomb", mu_s=0.4, mu_k=0.25, beta=0.0)
    found = attractors(parameters)
    assert [cycle.kind for cycle in found] == ["neutral", "stick-slip"]
    assert (found[0].x_min, found[0].x_max) == pytest.approx((0.05, 0.45), abs=1e-8)
    rng = np.random.default_rng(3)
    x, v = rng.uniform(-0.2, 0.7, 300), rng.uniform(-0.5, 0.5, 300)
    result = basins(parameters, x, v)
    inside = np.hypot(x - 0.25, v) < 0.2
    assert result.labels.tolist() == np.where(inside, 0, 1).tolist()
    assert result.fraction(0)[0] == inside.mean()
    cycle = limit_cycle(parameters, 0.3, 0.1)
    assert (cycle.kind, cycle.floquet_multiplier) == ("neutral", 1.0)
    assert cycle.amplitude == pytest.approx(math.hypot(0.05, 0.1), rel=1e-9)
    assert cycle.period == pytest.approx(2.0 * math.pi, rel=1e-9)
    assert same_motion(cycle, found[0])
    assert limit_cycle(parameters, 0.25, 0.0).kind == "neutral"
    assert lyapunov_exponent(parameters, 0.3, 0.1).exponents == (0.0, 0.0)


@pytest.mark.parametrize(
    ("parameters", "kinds"),
    [
        (EXACT.replace(friction="hyperbolic", delta=0.0), ["neutral"]),
        (EXACT.replace(alpha=0.2, mu_m=0.2), ["neutral", "neutral"]),
        (EXACT.replace(geometry="duffing", friction="exponential", mu_k=0.2), ["neutral"]),
        (EXACT.replace(friction="coulomb"), ["neutral", "stick-slip"]),
        (LINEAR.replace(friction="coulomb", mu_s=0.4, mu_k=0.0), ["neutral", "stick-slip", "neutral"]),
        (EXACT.replace(alpha=0.2, mu_s=0.0, mu_m=0.0), ["neutral", "neutral", "neutral"]),
        (EXACT.replace(alpha=0.0, friction="coulomb"), ["neutral", "stick-slip", "neutral", "stick-slip"]),
    ],
)
def test_neutral_families_in_every_law_and_none_once_it_is_damped(parameters, kinds):
    centre = parameters.replace(beta=0.0)
    found = attractors(centre)
    assert sorted(cycle.kind for cycle in found) == sorted(kinds)
    rng = np.random.default_rng(4)
    x, v = rng.uniform(-1.5, 1.5, 60), rng.uniform(-0.5, 0.19, 60)
    result = basins(centre, x, v)
    assert (result.labels >= 0).all()
    for label, x0, v0 in zip(result.labels, x, v, strict=True):
        cycle = limit_cycle(centre, x0, v0)
        assert same_motion(cycle, result.attractors[label])
        if cycle.kind == "neutral":
            late = simulate(centre, x0, v0, 300.0, dt=0.02)
            x_late = late.x[late.t > 200.0]
            assert (x_late.min(), x_late.max()) == pytest.approx((cycle.x_min, cycle.x_max), abs=1e-3)
    for beta in (1e-12, 1e-3):
        assert not {"neutral", "pure-slip"} & {cycle.kind for cycle in attractors(centre.replace(beta=beta))}


def test_a_focus_whose_linearisation_is_neutral_attracts_by_its_curvature():
    # At v_b = v_m friction is least: neither falls nor rises, and rises on both sides of it.
    for parameters in (EXACT.replace(beta=0.0, belt_speed=0.5), LINEAR.replace(beta=0.0, belt_speed=0.5)):
        assert [cycle.kind for cycle in attractors(parameters)] == ["steady-slip"]
        centre = equilibria(parameters)[-1].x
        for radius in (1e-5, 1e-4, 1e-2):
            assert limit_cycle(parameters, centre + radius, 0.0).kind == "steady-slip"


def test_labels_agree_with_direct_runs_of_random_plants():
    verdicts = [verdict.what for index in range(5) for verdict in labels.verdicts(1000, index)]
    assert set(verdicts) <= {"held", "not settled"}
    assert verdicts.count("held") > 0.8 * len(verdicts)  # the others decay too slowly for a direct run to end
