"""Stability charts: curves against direct roots and closed forms, their special points, the map at the graze."""

import math

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, kernel, limit_cycle, slip_cycles, stability_chart
from sd_friction_env.physics.continuation import follow
from sd_friction_env.physics.orbits import NoBorderError, grazing_belt_speed, grazing_map, hopf_belt_speed
from sd_friction_env.physics.orbits.boundaries import GrazingBorder, HopfBorder
from sd_friction_env.physics.sweeps import Engine, SweepError
from tests.physics.test_own_laws import OwnStribeck

CUBIC = OscillatorParameters(geometry="cubic")
LINEAR = OscillatorParameters(geometry="linear")
GAUSSIAN = OscillatorParameters(geometry="linear", friction="gaussian", mu_s=0.4, mu_k=0.2)
DIRECT = {"v_b0": grazing_belt_speed, "v_b1": hopf_belt_speed}


def curve_of(chart, curve, kind=None):
    """Return the values of the second parameter and the belt speeds of a curve, or of its points of a kind."""
    chosen = (chart["curve"] == curve) & (chart["branch"] >= 0)
    chosen &= (chart["kind"] == kind) if kind else chosen
    return chart[chart.metadata["over"]][chosen], chart["belt_speed"][chosen]


def difference_from_roots(parameters, chart, curve, every=1):
    name = chart.metadata["over"]
    values, speeds = (column[::every] for column in curve_of(chart, curve))
    roots = [DIRECT[curve](parameters.replace(**{name: value})) for value in values.tolist()]
    return np.abs(speeds - roots).max()


@pytest.mark.slow
@pytest.mark.parametrize("geometry", ["exact", "cubic"])
def test_curves_over_alpha_are_the_direct_roots(geometry):
    parameters = OscillatorParameters(geometry=geometry)
    chart = stability_chart(parameters, ("alpha", 0.2, 1.2))
    for curve in DIRECT:
        assert len(curve_of(chart, curve)[0]) >= 200
        assert difference_from_roots(parameters, chart, curve) < 1e-8


@pytest.mark.parametrize("name", ["g1", "beta", "mu_s", "v_m"])
def test_curves_over_other_parameters_are_the_direct_roots(name):
    value = CUBIC.values[name]
    chart = stability_chart(CUBIC, (name, 0.9 * value, 1.1 * value), points=20)
    assert difference_from_roots(CUBIC, chart, "v_b0", 5) < 1e-8
    assert difference_from_roots(CUBIC, chart, "v_b1", 5) < 1e-8


def test_curves_at_a_fixed_belt_speed_pass_it():
    plant = CUBIC.replace(belt_speed=0.35)
    chart = stability_chart(plant, ("g1", 0.85, 1.1), ("mu_m", 0.05, 0.18), points=10)
    for curve, speed in DIRECT.items():
        part = (chart["curve"] == curve) & (chart["branch"] >= 0)
        values = list(zip(chart["g1"][part].tolist(), chart["mu_m"][part].tolist(), strict=True))
        assert len(values) > 9
        speeds = [speed(plant.replace(g1=g1, mu_m=mu_m)) for g1, mu_m in values[::3]]
        assert np.abs(np.array(speeds) - 0.35).max() < 1e-8
    regions = chart["kind"][chart["curve"] == "region"].tolist()
    assert regions == ["stick-slip", "pure slip", "steady slip"]
    assert chart.metadata["against_range"] == [0.05, 0.18]


@pytest.mark.slow
def test_two_parameters_have_the_closed_form_of_gaussian_friction_and_its_fold():
    # v_b1: 2 beta = g1 (mu_s - mu_k) 2 v/v_0^2 exp(-v^2/v_0^2) of a linear spring.
    plant = GAUSSIAN.replace(belt_speed=0.75)
    chart = stability_chart(plant, ("g1", 0.8, 1.2), ("beta", 0.02, 0.2), points=10)
    part = (chart["curve"] == "v_b1") & (chart["branch"] >= 0)
    slope = 0.2 * 0.75 / plant.v_0**2 * math.exp(-((0.75 / plant.v_0) ** 2))
    assert np.allclose(chart["beta"][part], slope * chart["g1"][part], rtol=0.0, atol=1e-11)
    folds = (chart["curve"] == "fold") & (chart["branch"] >= 0)
    g1, beta = (float(chart[name][folds][3]) for name in ("g1", "beta"))
    gaps = (-1e-4, 1e-4)
    assert [len(slip_cycles(plant.replace(g1=g1, beta=beta + gap))) for gap in gaps] == [2, 0]
    assert "bistable" in chart["kind"]


def test_a_curve_that_does_not_pass_the_belt_speed_says_so():
    chart = stability_chart(LINEAR.replace(belt_speed=2.0), ("g1", 0.5, 1.0), ("beta", 0.05, 0.1), points=10)
    assert set(chart["kind"]) == {"none"}
    assert all("belt_speed = 2 is on the curve at no beta in [0.05, 0.1]" in reason for reason in chart["reason"])


def test_the_linear_belt_has_its_closed_form():
    chart = stability_chart(LINEAR, ("beta", 0.01, 0.1), points=20)
    beta, v_b1 = curve_of(chart, "v_b1")
    v_m, fall = LINEAR.v_m, LINEAR.mu_s - LINEAR.mu_m
    assert np.allclose(v_b1, v_m * np.sqrt(1.0 - 4.0 * beta * v_m / (3.0 * fall)), rtol=0.0, atol=1e-11)
    # Oscillation begins at belt speed 0 where the square root vanishes.
    assert curve_of(stability_chart(LINEAR, ("beta", 0.01, 0.4), points=20), "v_b1", "end")[0][-1] == pytest.approx(
        3.0 * fall / (4.0 * v_m), abs=1e-10
    )


def test_special_points_of_gaussian_friction():
    chart = stability_chart(GAUSSIAN, ("beta", 0.02, 0.2), points=40)
    special = np.isin(chart["kind"], ("turn", "Bautin", "grazing fold", "meeting"))
    assert chart["residual"][special].max() < 1e-8
    # mu''' = 0 and mu'' = 0: the first Lyapunov coefficient of a linear spring and the slope of v_b1(beta).
    assert curve_of(chart, "v_b1", "Bautin")[1] == pytest.approx(GAUSSIAN.v_0 * math.sqrt(1.5), abs=1e-9)
    assert curve_of(chart, "v_b1", "turn")[1] == pytest.approx(GAUSSIAN.v_0 / math.sqrt(2.0), abs=1e-9)
    meeting, speed = curve_of(chart, "v_b0", "meeting")
    assert hopf_belt_speed(GAUSSIAN.replace(beta=float(meeting[0]))) == pytest.approx(float(speed[0]), abs=1e-8)
    (fold,) = curve_of(chart, "v_b0", "grazing fold")[0]
    assert grazing_map(GAUSSIAN.replace(beta=float(fold))).multiplier == pytest.approx(1.0, abs=1e-7)
    # The fold of cycles leaves the graze there, and ends at the Bautin point.
    betas, speeds = curve_of(chart, "fold", "end")
    assert betas[0] == pytest.approx(fold, abs=1e-4)
    assert (betas[1], speeds[1]) == pytest.approx((curve_of(chart, "v_b1", "Bautin")[0][0], 0.6123724), abs=1e-4)


def test_two_cycles_meet_at_the_fold():
    chart = stability_chart(GAUSSIAN, ("beta", 0.05, 0.06), points=10)
    beta, speed = (float(column[5]) for column in curve_of(chart, "fold"))
    counts = [len(slip_cycles(GAUSSIAN.replace(beta=beta, belt_speed=speed + gap))) for gap in (-1e-4, 1e-4)]
    assert counts == [2, 0]


def test_regions_have_the_names_of_their_attractors():
    kinds = set(stability_chart(GAUSSIAN, ("beta", 0.02, 0.2), points=20)["kind"])
    assert {"stick-slip", "pure slip", "bistable", "steady slip", "rest"} <= kinds
    assert "bistable" not in stability_chart(CUBIC, ("alpha", 0.75, 0.85), points=10)["kind"]


@pytest.mark.slow  # compiles its law
def test_a_law_without_derivatives_gives_the_same_curves():
    k1, k3 = CUBIC.k1, CUBIC.k3
    own = CUBIC.replace(friction=OwnStribeck(CUBIC.mu_s, k1, k3))
    chart = stability_chart(own, ("friction.k1", 0.9 * k1, 1.1 * k1), points=10)
    assert curve_of(chart, "v_b0")[0].size > 9
    values, speeds = curve_of(chart, "v_b0")
    # k1 and k3 of Stribeck's law by mu_s - mu_m and v_m.
    for k, speed in zip(values[::4].tolist(), speeds[::4].tolist(), strict=True):
        v_m = math.sqrt(k / (3.0 * k3))
        stribeck = CUBIC.replace(mu_m=CUBIC.mu_s - k * v_m / 1.5, v_m=v_m)
        assert speed == pytest.approx(grazing_belt_speed(stribeck), abs=1e-8)


def test_what_is_not_there_has_a_row_that_says_why():
    unused = stability_chart(CUBIC, ("mu_k", 0.0, 0.2))
    assert set(unused["kind"]) == {"none"}
    assert all("does not use the parameter 'mu_k'" in reason for reason in unused["reason"])
    coulomb = stability_chart(LINEAR.replace(friction="coulomb", beta=0.0), ("g1", 0.5, 1.0), points=10)
    reasons = dict(zip(coulomb["curve"].tolist(), coulomb["reason"].tolist(), strict=True))
    assert "persists up to the greatest belt speed" in reasons["v_b0"]
    assert "steady slip is stable" in reasons["v_b1"]
    soft = LINEAR.replace(geometry="duffing", kappa=-0.5, friction="exponential", mu_s=0.4, mu_k=0.2)
    softening = stability_chart(soft, ("kappa", -1.5, -0.4), points=10)
    assert any("is a saddle" in reason for reason in softening["reason"])
    ends = stability_chart(CUBIC, ("mu_m", 0.15, 0.18), points=10)
    assert all(reason for kind, reason in zip(ends["kind"], ends["reason"], strict=True) if kind == "end")


@pytest.mark.parametrize(
    ("error", "message", "arguments"),
    [
        (ValueError, "over must be one of", {"over": ("gravity", 0.0, 1.0)}),
        (ValueError, "over must be one of", {"over": ("belt_speed", 0.0, 1.0)}),
        (TypeError, r"over must be \(name, low, high\)", {"over": "alpha"}),
        (ValueError, "low < high", {"over": ("alpha", 1.0, 0.5)}),
        (TypeError, "over, alpha, must be a real number", {"over": ("alpha", "a", 0.5)}),
        (ValueError, "against must be 'belt_speed' or", {"against": "g1"}),
        (TypeError, r"against must be \(name, low, high\)", {"against": 3}),
        (ValueError, "against must be one of", {"against": ("alpha", 0.1, 0.2)}),
        (ValueError, "low < high", {"against": ("g1", 0.2, 0.1)}),
        (ValueError, "belt_speed must be", {"parameters": CUBIC.replace(belt_speed=0.0), "against": ("g1", 0.5, 1.0)}),
        (ValueError, "points must be", {"points": 3}),
    ],
)
def test_arguments_are_checked(error, message, arguments):
    with pytest.raises(error, match=message):
        stability_chart(**{"parameters": CUBIC, **arguments})
    with pytest.raises(TypeError, match="parameters must be OscillatorParameters"):
        stability_chart({})
    with pytest.raises(ValueError, match="without excitation"):
        stability_chart(CUBIC.replace(force_amplitude=0.1))


def test_curves_are_kept_in_a_folder(tmp_path):
    folder = Engine(folder=tmp_path / "chart")
    first, again = (stability_chart(LINEAR, ("beta", 0.02, 0.1), points=10, engine=folder) for _ in range(2))
    for name, column in first.items():
        assert np.array_equal(column, again[name], equal_nan=column.dtype.kind == "f")
    with pytest.raises(SweepError, match="another sweep"):
        stability_chart(LINEAR, ("beta", 0.02, 0.2), points=10, engine=folder)


# The return map at the graze ------------------------------------------------------------------------------------------


def gap_after(parameters, x, v):
    """Return by how much the next lap's greatest speed stays below the belt's, from samples and a parabola."""
    times = np.linspace(0.5, 12.0, 4001)
    samples, met = np.empty((len(times), 4)), np.empty((4 * len(times), 4))
    speed = parameters.belt_speed
    drive = kernel.Drive(speed, 0.0, 0.0)
    kernel.trace(parameters.plant, kernel.UNKNOWN, kernel.State(x, v), drive, times, samples, met)
    velocity = samples[:, 1]
    inner = (velocity[1:-1] > velocity[:-2]) & (velocity[1:-1] >= velocity[2:])
    i = int(np.flatnonzero(inner & (velocity[1:-1] > 0.5 * speed))[0]) + 1
    a, b, c = np.polyfit(times[i - 2 : i + 3] - times[i], velocity[i - 2 : i + 3], 2)
    return speed - (c - b * b / (4.0 * a))


@pytest.mark.parametrize("parameters", [CUBIC, LINEAR, GAUSSIAN], ids=["cubic", "linear", "gaussian"])
def test_the_map_at_the_graze_is_the_kernels(parameters):
    found = grazing_map(parameters)
    assert found.kind == "piecewise linear"
    at = parameters.replace(belt_speed=found.v_b0)
    x = limit_cycle(at.replace(belt_speed=found.v_b0 - 1e-9)).x_breakaway
    gaps = np.array([1e-4, 2e-4])
    after = [gap_after(at, x, found.v_b0 - gap) for gap in gaps]
    assert np.diff(after) / np.diff(gaps) == pytest.approx(found.multiplier, rel=5e-3)


@pytest.mark.parametrize("parameters", [CUBIC, LINEAR, GAUSSIAN], ids=["cubic", "linear", "gaussian"])
def test_the_stick_ends_as_a_square_root(parameters):
    found = grazing_map(parameters)
    for below, rel in ((1e-4, 0.05), (1e-6, 0.005)):
        cycle = limit_cycle(parameters.replace(belt_speed=found.v_b0 - below))
        stick = cycle.stick_fraction * cycle.period
        assert stick == pytest.approx(found.stick_time * math.sqrt(below), rel=rel)


def test_two_levels_of_friction_make_a_gap():
    damped = OscillatorParameters(geometry="linear", friction="coulomb", mu_s=0.4, mu_k=0.1, beta=0.1)
    found = grazing_map(damped)
    assert found.kind == "linear with gap"
    # Of slip under level friction the spring is that of a damped oscillator, whose lap shrinks deviations.
    period = 2.0 * math.pi / math.sqrt(1.0 - damped.beta**2)
    assert found.multiplier == pytest.approx(math.exp(-damped.beta * period), rel=1e-9)
    assert found.jump > 0.0
    with pytest.raises(NoBorderError, match="greatest belt speed"):
        grazing_map(damped.replace(beta=0.0))


def test_a_circle_is_followed_through_its_turns():
    class Circle:
        scale = np.ones(2)

        def residual(self, y):
            return np.array([y @ y - 1.0])

        def jacobian(self, y):
            return 2.0 * y[None, :]

    tests = {"turn": lambda y, tangent: tangent[1]}
    branch = follow(Circle(), np.array([1.0, 0.0]), np.array([0.0, 1.0]), longest=0.1, limits={}, tests=tests)
    assert branch.reason == "the curve is closed"
    turns = np.array([point.y for point in branch.points if point.kind == "turn"])
    assert np.allclose(turns, [[0.0, 1.0], [0.0, -1.0]], atol=1e-12)


@pytest.mark.parametrize("name", ["g1", "beta", "mu_s", "mu_m", "v_m", "alpha"])
def test_derivatives_of_the_borders_are_those_of_differences(name):
    scale = np.array([1.0, 10.0, 1.0, 1.0])
    for kind, sizes in ((GrazingBorder, scale), (HopfBorder, scale[1:])):
        border = kind(CUBIC, ("belt_speed", name), sizes)
        y = border.start(np.array([0.2, CUBIC.values[name]]))
        y[-2] += 5e-3  # the orbit stays below the belt's speed: differences need no landing
        if kind is GrazingBorder:
            y[0], _ = border.breakaway(*border.at(y), y[0])
        differences = np.column_stack([border.by_differences(y, column) for column in range(len(y))])
        assert np.allclose(border.jacobian(y), differences, rtol=1e-6, atol=1e-6)
