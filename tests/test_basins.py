"""All attractors, and which start reaches which."""

import math

import numpy as np
import pytest

from sd_friction_env import (
    OrbitError,
    OscillatorParameters,
    attractor_curves,
    attractors,
    critical_belt_speeds,
    equilibria,
    first_lyapunov_coefficient,
    limit_cycle,
    slip_cycles,
    stick_intervals,
)
from sd_friction_env.basins import basin_grid, basins
from sd_friction_env.orbits import ReturnMap, same_motion

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
    monkeypatch.setattr("sd_friction_env.basins._STARTS_WORTH_A_THREAD", 100)
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
