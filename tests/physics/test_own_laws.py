"""Laws of one's own, tables, asymmetric friction, and batches of several laws."""

import math
import pickle
import struct
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest

import sd_friction_env
from sd_friction_env import (
    Asymmetric,
    OscillatorParameters,
    check_friction_law,
    check_spring_law,
    critical_belt_speeds,
    friction_law,
    friction_table,
    kernel,
    limit_cycle,
    simulate,
    spring_law,
    tabulated_friction,
)
from sd_friction_env.physics.laws import Coulomb, Exponential, Gaussian, Hyperbolic, Stribeck

pytestmark = pytest.mark.usefixtures("either_way")


def each_way(laws, compiled):
    """Run a test with each law interpreted, with one of them compiled, too, and in the slow tests with all."""
    ways = [("interpreted", law) for law in laws]
    ways += [
        pytest.param("compiled", law, marks=() if i == compiled else pytest.mark.slow) for i, law in enumerate(laws)
    ]
    return pytest.mark.parametrize(("either_way", "law"), ways, indirect=["either_way"])


@friction_law
class OwnStribeck(NamedTuple):
    """Eq. 5 as a user would write it, in the built-in law's own order of operations."""

    mu_s: float
    k1: float
    k3: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_s - self.k1 * v_rel + self.k3 * (v_rel * v_rel * v_rel)

    def slope(self, mode, v_rel):
        return -self.k1 + 3.0 * self.k3 * (v_rel * v_rel)

    def curvature(self, mode, v_rel):
        return 6.0 * self.k3 * v_rel

    def third_derivative(self, mode, v_rel):
        return 6.0 * self.k3

    def may_be_steep(self):
        return False


@spring_law
class OwnLinear(NamedTuple):
    """R = stiffness x, N = g1."""

    stiffness: float

    def restoring_force(self, x):
        return self.stiffness * x

    def restoring_slope(self, x):
        return self.stiffness

    def restoring_curvature(self, x):
        return 0.0

    def potential(self, x):
        return 0.5 * self.stiffness * (x * x)

    def may_be_stiff(self):
        return False


NOMINAL = OscillatorParameters()
OWN = OscillatorParameters(friction=OwnStribeck(NOMINAL.mu_s, NOMINAL.k1, NOMINAL.k3))


def bits(values):
    return struct.pack(f"<{len(values)}d", *map(float, values))


def episode(env, seed, steps=40):
    rng = np.random.default_rng(seed)
    out = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        observation, reward, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
        out += [observation, np.atleast_1d(reward)]
    return b"".join(part.tobytes() for part in out)


# A user's own law -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("either_way", ["compiled"], indirect=True)
def test_an_environment_with_a_users_law_gives_the_bits_of_the_same_law_built_in():
    own, built_in = (gym.make("SDFriction/Force-v0", parameters=p) for p in (OWN, NOMINAL))
    assert episode(own, 3) == episode(built_in, 3)


def test_a_users_law_gives_the_bits_of_the_same_law_built_in():
    assert limit_cycle(OWN).amplitude == limit_cycle(NOMINAL).amplitude
    ours, theirs = (simulate(p, x=0.6, v=0.0, t_end=30.0, dt=0.1) for p in (OWN, NOMINAL))
    assert ours.x.tobytes() == theirs.x.tobytes()
    assert ours.energy.contact == theirs.energy.contact
    own, built_in = (gym.make_vec("SDFriction/BeltSpeed-v0", 20, parameters=p) for p in (OWN, NOMINAL))
    assert episode(own, 4) == episode(built_in, 4)


def test_a_users_spring_gives_the_bits_of_the_same_spring_built_in():
    own, built_in = OscillatorParameters(geometry=OwnLinear(1.0)), OscillatorParameters(geometry="linear")
    states = [
        kernel.advance(p.plant, kernel.State(0.3, -0.2), kernel.Drive(0.2, 0.1, 0.0), 9.0, None)
        for p in (own, built_in)
    ]
    assert bits(states[0]) == bits(states[1])
    assert limit_cycle(own).amplitude == pytest.approx(limit_cycle(built_in).amplitude, abs=1e-12)


def test_critical_speeds_of_a_users_law_are_those_of_the_law_built_in():
    assert critical_belt_speeds(OWN) == pytest.approx(critical_belt_speeds(NOMINAL), abs=1e-9)


def test_numbers_of_a_users_law_have_names():
    changed = OWN.replace(**{"friction.k1": 0.3})
    assert changed.friction == OWN.friction._replace(k1=0.3)
    with pytest.raises(ValueError, match=r"unknown parameter 'friction.k2'; allowed: .*friction.k1"):
        OWN.replace(**{"friction.k2": 0.3})


def test_numbers_of_a_users_law_are_randomised_alike_in_one_and_in_many():
    arguments = {"parameters": OWN, "randomise": {"friction.k1": (0.3, 0.5)}, "show_parameters": True}
    env = gym.make("SDFriction/Force-v0", **arguments)
    envs = gym.make_vec("SDFriction/Force-v0", 3, **arguments)
    observations, info = envs.reset(seed=5)
    for i in range(3):
        assert (env.reset(seed=5 + i)[0] == observations[i]).all()
        assert env.unwrapped.parameters.friction.k1 == info["parameters"]["friction.k1"][i]
    assert len(set(info["parameters"]["friction.k1"])) == 3
    action = np.full((3, 1), 0.5, np.float32)
    assert (env.step(action[2])[0] == envs.step(action)[0][2]).all()


def test_environments_with_a_users_law_are_pickled_and_drawn():
    env = gym.make("SDFriction/Force-v0", parameters=OWN, render_mode="rgb_array").unwrapped
    env.reset(seed=1)
    twin = pickle.loads(pickle.dumps(env))
    action = np.array([0.3], np.float32)
    assert (env.step(action)[0] == twin.step(action)[0]).all()
    assert twin.render().shape == env.render().shape
    envs = gym.make_vec("SDFriction/Force-v0", 2, parameters=OWN)
    envs.reset(seed=1)
    again = pickle.loads(pickle.dumps(envs.unwrapped))
    actions = np.array([[0.3], [0.1]], np.float32)
    assert (envs.step(actions)[0] == again.step(actions)[0]).all()


# What is refused ------------------------------------------------------------------------------------------------------


def test_a_class_without_a_method_or_with_other_arguments_is_refused_by_name():
    methods = {name: getattr(OwnStribeck, name) for name in ("coefficient", "slope", "curvature")}
    with pytest.raises(
        TypeError, match=r"the friction law Short lacks the method third_derivative\(self, mode, v_rel\)"
    ):
        friction_law(type("Short", (NamedTuple("Short", [("mu_s", float)]),), methods))
    methods |= {"third_derivative": lambda self, v_rel: 0.0}
    with pytest.raises(TypeError, match=r"Other.third_derivative must have the arguments \(self, mode, v_rel\), got"):
        friction_law(type("Other", (NamedTuple("Other", [("mu_s", float)]),), methods))
    with pytest.raises(TypeError, match="a spring law must be a NamedTuple class with at least one field"):
        spring_law(int)


def test_laws_of_two_classes_with_the_same_numbers_are_two():
    @friction_law
    class Another(Coulomb):
        pass

    one, other = (OscillatorParameters(friction=law(0.3, 0.2)) for law in (Coulomb, Another))
    assert one != other
    assert one == OscillatorParameters(friction=Coulomb(0.3, 0.2))
    assert hash(one) == hash(OscillatorParameters(friction=Coulomb(0.3, 0.2)))
    assert len({one, other}) == 2  # what is kept of one is not taken for the other's
    table = tabulated_friction([0.0, 0.5, 1.0], [0.3, 0.1, 0.2])
    assert table == tabulated_friction([0.0, 0.5, 1.0], [0.3, 0.1, 0.2])
    assert table != tabulated_friction([0.0, 0.5, 1.0], [0.3, 0.1, 0.25])


def test_a_wrong_derivative_is_refused_with_the_place_and_both_values():
    @friction_law
    class Wrong(NamedTuple):
        mu_s: float
        coefficient = OwnStribeck.coefficient
        slope = OwnStribeck.slope
        curvature = OwnStribeck.curvature
        third_derivative = OwnStribeck.third_derivative
        k1 = 0.45
        k3 = -0.6

    class Sloped(Wrong):
        def slope(self, mode, v_rel):
            return 0.45

    with pytest.raises(ValueError, match=r"Sloped.slope must be the derivative of coefficient: at -?\d"):
        OscillatorParameters(friction=Sloped(0.2))
    check_friction_law(Wrong(0.2))


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (OwnStribeck(math.nan, 0.4, 0.6), "OwnStribeck.mu_s must be a finite number, got nan"),
        (OwnStribeck("0.2", 0.4, 0.6), "OwnStribeck.mu_s must be a finite number, got '0.2'"),
        (
            OwnStribeck(-0.1, 0.4, 0.6),
            r"OwnStribeck.breakaway_coefficient\(-1\) must be finite and not below 0, got -0.1",
        ),
        (
            Coulomb(0.1, 0.2),
            r"Coulomb.coefficient\(-1, 0.0\) must not exceed breakaway_coefficient\(-1\) = 0.1 in size",
        ),
        (
            (0.2, 0.4, 0.6),
            r"friction must be one of 'stribeck', .* or a law declared with @friction_law, got \(0.2, 0.4",
        ),
        ("wet", "friction must be one of 'stribeck'"),
    ],
)
def test_a_law_that_makes_no_sense_is_refused(law, message):
    with pytest.raises(ValueError, match=message):
        OscillatorParameters(friction=law)


def test_whole_numbers_in_a_law_are_taken_as_floats():
    law = OscillatorParameters(friction=OwnStribeck(1, 0, 0)).friction
    assert tuple(law) == (1.0, 0.0, 0.0)
    assert all(type(number) is float for number in law)
    check_spring_law(OwnLinear(2))


def test_the_derivatives_of_all_built_in_laws_are_those_of_differences():
    table = tabulated_friction([0.0, 0.2, 0.5, 1.1, 3.0], [0.4, 0.3, 0.24, 0.26, 0.3])
    frictions = [
        Stribeck(0.3, 0.4, 0.2),
        Coulomb(0.3, 0.2),
        Hyperbolic(0.3, 2.0, 0.02),
        Exponential(0.3, 0.1, 0.4, 0.02),
        Gaussian(0.3, 0.1, 0.4, 0.02),
        table,
        Asymmetric(Gaussian(0.3, 0.1, 0.4, 0.0), Hyperbolic(0.4, 1.5, 0.01)),
    ]
    for law in (*frictions, *(kernel.ScaledFriction(law, 1.7) for law in frictions)):
        check_friction_law(law)
    springs = [
        kernel.Inclined(0.7),
        kernel.Cubic(0.9),
        kernel.Linear(1.0),
        kernel.Duffing(-0.8, 1.3),
        kernel.Discontinuous(0.0),
    ]
    for spring in (*springs, *(kernel.ScaledSpring(spring, 0.3, 2.5) for spring in springs[:-1])):
        check_spring_law(spring)
    widths = [Asymmetric(Gaussian(0.3, 0.1, 0.4, 0.0), Coulomb(0.4, 0.2)).layer_width(mode) for mode in (-1, 1)]
    assert widths == [0.4, 0.0]
    assert kernel.ScaledFriction(Gaussian(0.3, 0.1, 0.4, 0.0), 2.0).layer_width(1) == 0.2


# Tables ---------------------------------------------------------------------------------------------------------------


def stribeck_table(points):
    speeds = np.linspace(0.0, 1.2, points)
    return tabulated_friction(speeds, NOMINAL.mu_s - NOMINAL.k1 * speeds + NOMINAL.k3 * speeds**3)


def test_a_table_of_the_stribeck_curve_comes_to_its_cycle_with_the_interpolations_order():
    exact = limit_cycle(NOMINAL).amplitude
    errors = [
        abs(limit_cycle(OscillatorParameters(friction=stribeck_table(n))).amplitude - exact) for n in (13, 25, 97)
    ]
    assert errors[0] < 1e-3
    assert errors[0] > 4.0 * errors[1]
    assert errors[0] > 8.0**2 * errors[2]  # three doublings, second order or better


def test_a_table_is_read_from_a_file(tmp_path):
    file = tmp_path / "curve.csv"
    file.write_text("# measured\nspeed,mu\n0,0.3\n0.1,0.24\n\n0.5,0.2\n")
    table = friction_table(file)
    assert table.speeds.tolist() == [0.0, 0.1, 0.5]
    assert table.coefficients.tolist() == [0.3, 0.24, 0.2]
    assert table.coefficient(-1, -0.1) == -0.24
    assert table.coefficient(1, 7.0) == 0.2
    file.write_text("0,0.3\n0.1,much\n")
    with pytest.raises(
        ValueError, match=r"line 2 of '.*curve.csv' must be a speed and a coefficient, got \['0.1', 'much'\]"
    ):
        friction_table(file)
    file.write_text("0,0.3\n0.1,0.2\n")
    with pytest.raises(
        ValueError, match=r"curve.csv' holds no friction curve: speeds must have at least 3 points, got 2"
    ):
        friction_table(file)


@pytest.mark.parametrize(
    ("speeds", "coefficients", "message"),
    [
        ([0.0, 0.1], [0.3, 0.2], "speeds must have at least 3 points, got 2"),
        ([0.0, 0.1, 0.1], [0.3, 0.2, 0.1], "speeds must ascend, got 0.1 after 0.1 at point 2"),
        ([0.0, 0.2, 0.1], [0.3, 0.2, 0.1], "speeds must ascend, got 0.1 after 0.2 at point 2"),
        ([-0.1, 0.1, 0.2], [0.3, 0.2, 0.1], "speeds must begin with 0"),
        ([0.0, 0.1, math.nan], [0.3, 0.2, 0.1], "speeds must be finite, got nan at point 2"),
        ([0.0, 0.1, 0.2], [0.3, math.inf, 0.1], "coefficients must be finite, got inf at point 1"),
        ([0.0, 0.1, 0.2], [0.3, -0.2, 0.1], "coefficients must not be below 0, got -0.2 at point 1"),
        ([0.0, 0.1, 0.2], [0.3, 0.2], "speeds and coefficients must have one length, got 3 and 2"),
        ([[0.0, 0.1, 0.2]], [0.3, 0.2, 0.1], r"speeds must be an array of shape \(n,\), got shape \(1, 3\)"),
    ],
)
def test_a_table_that_is_no_friction_curve_is_refused(speeds, coefficients, message):
    with pytest.raises(ValueError, match=message):
        tabulated_friction(speeds, coefficients)


def test_a_table_works_in_one_environment_and_in_many():
    p = OscillatorParameters(friction=stribeck_table(25))
    envs = gym.make_vec("SDFriction/Force-v0", 5, parameters=p)
    env = gym.make("SDFriction/Force-v0", parameters=p)
    rng = np.random.default_rng(2)
    envs.reset(seed=7)
    env.reset(seed=9)
    for _ in range(60):
        actions = rng.uniform(-1.0, 1.0, (5, 1)).astype(np.float32)
        assert (envs.step(actions)[0][2] == env.step(actions[2])[0]).all()


# Asymmetric friction, several laws ------------------------------------------------------------------------------------


def test_asymmetric_friction_of_one_law_twice_is_that_law():
    law = Stribeck(NOMINAL.mu_s, NOMINAL.k1, NOMINAL.k3)
    p = OscillatorParameters(friction=Asymmetric(law, law))
    assert limit_cycle(p).amplitude == pytest.approx(limit_cycle(NOMINAL).amplitude, abs=1e-12)


def test_asymmetric_friction_holds_and_slips_by_each_direction():
    p = OscillatorParameters(geometry="linear", beta=0.0, friction=Asymmetric(Coulomb(0.3, 0.2), Coulomb(0.5, 0.4)))
    belt = kernel.Drive(0.0, 0.0, 0.0)
    # load = x: backward slip from +0.3 on, forward slip from -0.5 on
    modes = [kernel.mode_at_zero_v_rel(p.plant, x, belt) for x in (0.29, 0.31, -0.49, -0.51)]
    assert modes == [kernel.STICK, kernel.SLIP_BACKWARD, kernel.STICK, kernel.SLIP_FORWARD]
    assert p.friction_coefficient(-1.0) == -0.2
    assert p.friction_coefficient(1.0) == 0.4
    (interval,) = sd_friction_env.stick_intervals(p.replace(belt_speed=0.1))
    assert interval == pytest.approx((-0.5, 0.3))


LAWS = [
    {},
    {"friction": "coulomb"},
    {"friction": "gaussian", "mu_k": 0.08, "v_0": 0.2},
    {"friction": "hyperbolic", "mu_v": 0.02},
    {"geometry": "linear"},
    {"geometry": "duffing", "linear_stiffness": -1.0, "kappa": 4.0},
    {"alpha": 0.0},
    {"friction": OwnStribeck(0.25, 0.5, 0.7)},
    {"force_amplitude": 0.05, "force_frequency": 1.3},
]


def test_a_batch_of_several_laws_is_the_single_environments_bit_for_bit():
    n = 3 * len(LAWS)
    envs = gym.make_vec("SDFriction/BeltSpeed-v0", n, info_keys="all", start="random")
    per_env = [{"parameters": LAWS[i % len(LAWS)]} for i in range(n)]
    observations, info = envs.reset(seed=11, options=per_env)
    singles = [gym.make("SDFriction/BeltSpeed-v0", start="random").unwrapped for _ in range(n)]
    for i, env in enumerate(singles):
        observation, told = env.reset(seed=11 + i, options=per_env[i])
        assert (observation == observations[i]).all()
        assert told["normal_force"] == info["normal_force"][i]
    rng = np.random.default_rng(3)
    for _ in range(80):
        actions = rng.uniform(-1.0, 1.0, (n, 1)).astype(np.float32)
        observations, rewards, terminated, *_, info = envs.step(actions)
        for i, env in enumerate(singles):
            if terminated[i] or env is None:
                singles[i] = None
                continue
            observation, reward, *_, told = env.step(actions[i])
            assert (observation == observations[i]).all(), (i, per_env[i])
            assert reward == rewards[i]
            assert told["v_rel"] == info["v_rel"][i]
            assert told["events"] == info["events"][i]
        if sum(env is not None for env in singles) < n // 2:
            break


@each_way([law for law in LAWS if law], compiled=1)
def test_lanes_of_each_law_give_the_bits_of_single_environments(law):
    n = 24
    envs = gym.make_vec("SDFriction/Force-v0", n, parameters=law, start="random", force_limit=0.3)
    arguments = {"parameters": law, "start": "random", "force_limit": 0.3}
    singles = [gym.make("SDFriction/Force-v0", **arguments).unwrapped for _ in range(4)]
    observations, _ = envs.reset(seed=21)
    for i, env in enumerate(singles):
        assert (env.reset(seed=21 + i)[0] == observations[i]).all()
    rng = np.random.default_rng(5)
    over = np.zeros(4, bool)
    for _ in range(100):
        actions = rng.uniform(-1.0, 1.0, (n, 1)).astype(np.float32)
        observations, rewards, *_ = envs.step(actions)
        for i, env in enumerate(singles):
            if not over[i]:
                observation, reward, terminated, truncated, _ = env.step(actions[i])
                assert (observation == observations[i]).all(), (i, law)
                assert reward == rewards[i]
                over[i] = terminated or truncated


@friction_law
class OwnCoulomb(NamedTuple):
    """Level friction, with a number of the same name as one of :class:`OwnStribeck`."""

    mu_s: float
    k1: float

    def coefficient(self, mode, v_rel):
        return mode * self.k1

    def slope(self, mode, v_rel):
        return 0.0

    def curvature(self, mode, v_rel):
        return 0.0

    def third_derivative(self, mode, v_rel):
        return 0.0


def test_numbers_of_one_users_law_are_not_taken_for_those_of_another():
    laws = [OwnCoulomb(0.4, 0.3), OwnStribeck(0.3, 0.2, 0.1), OWN.friction, "coulomb", OwnCoulomb(0.2, 0.1)]
    per_env = [{"parameters": {"friction": law}} for law in laws]
    envs = gym.make_vec("SDFriction/Force-v0", len(laws), parameters=OWN, start="random")
    observations, _ = envs.reset(seed=2, options=per_env)
    actions = np.linspace(-1.0, 1.0, len(laws), dtype=np.float32)[:, None]
    for _ in range(30):
        observations, rewards, *_ = envs.step(actions)
    for i, law in enumerate(laws):
        env = gym.make("SDFriction/Force-v0", parameters=OWN, start="random").unwrapped
        env.reset(seed=2 + i, options=per_env[i])
        for _ in range(30):
            observation, reward, *_ = env.step(actions[i])
        assert (observation == observations[i]).all(), law
        assert reward == rewards[i]
        assert envs.unwrapped.get_states()[i].parameters.friction == law


def test_a_law_in_the_options_of_a_whole_batch_is_one_value():
    envs = gym.make_vec("SDFriction/Force-v0", 2, start="random").unwrapped
    envs.reset(seed=0, options={"parameters": {"friction": OwnCoulomb(0.3, 0.2)}})
    assert [state.parameters.friction for state in envs.get_states()] == [OwnCoulomb(0.3, 0.2)] * 2


def test_a_friction_law_without_a_coefficient_of_stick_is_refused():
    methods = {name: getattr(OwnCoulomb, name) for name in ("coefficient", "slope", "curvature", "third_derivative")}
    with pytest.raises(
        TypeError, match=r"Stickless lacks the field mu_s or the method breakaway_coefficient\(self, mode\)"
    ):
        friction_law(type("Stickless", (NamedTuple("Stickless", [("k1", float)]),), methods))


def test_a_mass_leaves_the_belt_each_way_where_that_directions_law_lets_it():
    p = OscillatorParameters(geometry="linear", beta=0.0, friction=Asymmetric(Coulomb(0.3, 0.2), Coulomb(0.5, 0.4)))
    for v_belt, place in ((0.1, 0.3), (-0.1, -0.5)):
        events = np.empty((4, 4))
        kernel.advance(p.plant, kernel.State(0.0, v_belt), kernel.Drive(v_belt, 0.0, 0.0), 6.0, events)
        assert events[0, 1] == kernel.BREAKAWAY
        assert events[0, 2] == pytest.approx(place, abs=1e-13)
    # as the stick load rises with the belt's acceleration, the slopes that the search steps along must be the law's too
    for side, mode in ((1.0, -1), (-1.0, 1)):
        excess = [kernel.cone_excess(p.plant, side, 0.1, kernel.Drive(0.1, 0.02, 0.0), t) for t in (0.0, 1e-6)]
        assert excess[0][0] == pytest.approx(side * 0.12 - p.plant.friction.breakaway_coefficient(mode), abs=1e-15)
        assert excess[0][1] == pytest.approx((excess[1][0] - excess[0][0]) / 1e-6, abs=1e-6)
        # and where the normal force changes with the place, by that side's law
        exact, drive = p.replace(geometry="exact").plant, kernel.Drive(0.1, 0.02, 0.0)
        low, (_, slope), high = (kernel.cone_excess(exact, side, 0.6, drive, t) for t in (-1e-4, 0.0, 1e-4))
        assert slope == pytest.approx((high[0] - low[0]) / 2e-4, abs=1e-6)


SHARP = [
    {"friction": "hyperbolic", "delta": 800.0},
    {"friction": "exponential", "v_0": 0.001, "mu_k": 0.02},
    {"friction": "gaussian", "v_0": 0.001, "mu_k": 0.02},
    {"alpha": 0.0},
    {"alpha": 0.0, "friction": "coulomb", "mu_s": 1.5, "mu_k": 0.3},
    {"alpha": 0.0, "friction": "hyperbolic", "delta": 800.0, "mu_s": 1.2},
]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # interpreted: trial steps across a layer that are refused
@each_way(SHARP, compiled=0)
@pytest.mark.parametrize("actuator", ["Force", "BeltSpeed"])
def test_lanes_next_to_a_layer_and_to_a_switch_of_the_field_give_the_bits_of_single_environments(
    law, actuator, either_way
):
    rng = np.random.default_rng(8)
    n = 120 if either_way == "compiled" else 24
    x = np.concatenate((rng.uniform(-0.12, 0.12, n - 4), [0.0, 0.0, 0.0, 1e-15]))
    belts = 0.2 + np.array([0.0, 1e-9, -1e-9, 1e-4, -1e-4, 1e-3, -1e-3, 0.02, -0.02, 0.8, -0.8, -1.4])
    v = belts[np.arange(n) % len(belts)]
    arguments = {"parameters": law, "force_limit": 1.5, "belt_authority": 1.0, "belt_acceleration_limit": 6.0}
    envs = gym.make_vec(f"SDFriction/{actuator}-v0", n, start="random", info_keys="all", **arguments)
    envs.reset(seed=1, options={"x": x, "v": v})
    env = gym.make(f"SDFriction/{actuator}-v0", start="random", **arguments).unwrapped
    actions = rng.uniform(-1.0, 1.0, (6, n, 1)).astype(np.float32)
    told = [envs.step(actions[k]) for k in range(6)]
    for i in range(n):
        env.reset(seed=1 + i, options={"x": float(x[i]), "v": float(v[i])})
        for k, (observations, rewards, terminated, _, info) in enumerate(told):
            observation, reward, over, _, own = env.step(actions[k, i])
            assert (observation == observations[i]).all(), (i, k)
            assert (reward, over) == (rewards[i], terminated[i])
            for name in ("events", "mode", "x_min", "x_max", "stick_fraction", "friction_power", "normal_force"):
                assert own[name] == info[name][i], (name, i, k)
            if over:
                break
