"""Controllers with a state of their own against what theory says of them."""

import gymnasium as gym
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from sd_friction_env.control.policies import Dither, Model, Readings, ScheduledFeedback, SoftBelt, SuperTwisting
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical

FORCE, BELT, RANDOMISED = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0", "SDFriction/BeltSpeedRandomised-v0"


def observe(readings, x, v, modulation=0.0):
    """The observation of a deviation from the equilibrium."""
    seen = [(x + readings.x_equilibrium - readings.x_offset) / readings.x_scale, v / readings.v_scale, modulation]
    return np.array(seen[: len(readings.names)])


def pushed(policy, v, disturbance, interval, steps):
    """Velocities of a mass that only the controller and a disturbance push."""
    found, state = [v], None
    for i in range(steps):
        action, state = policy.predict(observe(policy.readings, 0.0, v), state)
        assert abs(action[0]) < 1.0
        v += interval * (policy.readings.authority * float(action[0]) + disturbance(i * interval))
        found.append(v)
    return np.abs(found)


def test_super_twisting_reaches_its_line_within_the_bound_of_moreno_and_osorio_and_stays():
    """Theorem 1 of 2012: V = z'Pz, z = (sqrt|s| sign s, w + d), t <= 2 sqrt(V)/gamma, for a constant disturbance d."""
    env, interval, v, d = gym.make(FORCE), 1e-3, 0.004, 0.01
    proportional, integral = 10.0, 0.5
    policy = SuperTwisting.from_env(env, 0.0, proportional, integral, control_interval=interval)
    k1, k2 = policy.readings.authority * proportional, policy.readings.authority * integral
    a = np.array([[-0.5 * k1, 0.5], [-k2, 0.0]])
    q = np.eye(2)
    p = scipy.linalg.solve_continuous_lyapunov(a.T, -q)
    least, largest = np.linalg.eigvalsh(p)
    z = np.array([np.sqrt(v), d])
    bound = 2.0 * np.sqrt(z @ p @ z) / (np.sqrt(least) * np.linalg.eigvalsh(q).min() / largest)
    steps = int(bound / interval)
    assert steps < 30_000
    speed = pushed(policy, v, lambda t: d, interval, steps)
    assert speed[-200:].max() < 20.0 * interval**2
    # A disturbance that changes more slowly than k2 is rejected too; without the integral even a constant one is not.
    slow = pushed(policy, v, lambda t: d + 0.008 * np.sin(t), interval, steps)
    assert slow[-2000:].max() < 20.0 * interval**2
    without = SuperTwisting.from_env(env, 0.0, proportional, 0.0, control_interval=interval)
    assert pushed(without, v, lambda t: d, interval, steps)[-1] == pytest.approx((d / k1) ** 2, rel=1e-3)


def test_the_integral_of_super_twisting_does_not_wind_up():
    policy = SuperTwisting.from_env(gym.make(FORCE), 0.0, 0.0, 5.0)
    state = None
    for _ in range(100):
        action, state = policy.predict(observe(policy.readings, 0.0, 0.1), state)
    assert action == [-1.0]
    for _ in range(3):
        action, state = policy.predict(observe(policy.readings, 0.0, -0.1), state)
    assert action[0] == pytest.approx(0.0)


def test_a_soft_belt_moves_under_a_load_as_mass_spring_and_damper_do():
    env, interval, x = gym.make(BELT), 1e-3, 0.02
    inertia, damping, stiffness = 2.0, 0.5, 3.0
    policy = SoftBelt.from_env(env, inertia, damping, stiffness, control_interval=interval)
    nominal, rest = env.unwrapped.nominal, policy.readings.x_equilibrium
    load = policy.mount_stiffness * x
    assert load == pytest.approx(nominal.restoring_force(rest + x) - nominal.restoring_force(rest), rel=0.05)
    found, w, state = [], 0.0, None
    for _ in range(4000):
        action, state = policy.predict(observe(policy.readings, x, 0.0, w / policy.readings.authority), state)
        w = policy.readings.authority * float(action[0])
        found.append(w)
    times = interval * np.arange(1, 4001)
    _, expected = scipy.signal.step(([-load, 0.0], [inertia, damping, stiffness]), T=np.append(0.0, times))
    assert np.abs(np.array(found) - expected[1:]).max() < 0.003 * np.abs(expected).max()


def test_a_soft_belt_yields_to_the_inertia_of_the_mass_and_not_at_rest():
    policy = SoftBelt.from_env(gym.make(BELT), 1.0, 0.1, 0.1)
    at_rest, state = policy.predict(observe(policy.readings, 0.0, 0.0))
    assert at_rest[0] == pytest.approx(0.0, abs=1e-9)
    speeds_up, _ = policy.predict(observe(policy.readings, 0.0, 0.01), state)
    assert speeds_up[0] == pytest.approx(-0.01 / policy.readings.authority, rel=1e-6)  # interval x load / inertia
    anew, _ = policy.predict(observe(policy.readings, 0.0, 0.01), state, True)
    assert anew[0] == pytest.approx(0.0, abs=1e-9)


def test_dither_is_a_cosine_from_the_start_of_each_episode_whatever_is_seen():
    env = gym.make("SDFriction/ForceSensed-v0")
    policy = Dither.from_env(env, 0.7, 3.0)
    state, found = None, []
    for i in range(12):
        action, state = policy.predict(np.full((2, 1), float(i)), state, np.array([False, i == 5]))
        found.append(action[:, 0])
    expected = 0.7 * np.cos(0.3 * np.arange(12))
    assert np.array(found)[:, 0] == pytest.approx(expected, abs=1e-6)
    assert np.array(found)[5:, 1] == pytest.approx(expected[:7], abs=1e-6)
    fastest = Dither.from_env(env, 1.0, np.pi / 0.1)
    assert fastest.predict([0.0], (np.array(1.0),))[0] == [-1.0]


@pytest.mark.parametrize("env_id", [RANDOMISED, "SDFriction/ForceRandomised-v0"])
def test_scheduled_gains_are_the_regulators_of_the_belt_speed_at_which_the_mass_stuck(env_id):
    """The regulator by a Riccati iteration on differences of the plant's own step."""
    env = make_env(env_id)
    policy = classical.build("LQR, gains scheduled by belt speed", env_id, (0.5, -0.3))
    speed = policy.belt_speeds[6]
    plant = env.nominal.replace(belt_speed=speed)
    model, k, h = Model(plant, env.task.actuator_of(plant)), len(policy.readings.names), 1e-5
    units = np.array([1.0, 1.0, env.task.belt_authority * speed, 1.0])[[*range(k), 3]]
    rest = np.array([policy.places[6], 0.0, speed, 0.0])
    moves = h * np.diag([1.0, 1.0, env.task.belt_authority * speed, 1.0])[[*range(k), 3]]
    ends = [model.step((rest + sign * moves)[:, :3], (rest + sign * moves)[:, 3])[0] for sign in (1.0, -1.0)]
    matrix = ((ends[0] - ends[1]) / (2.0 * h)).T[:k] / units[:k, None]
    a, b = matrix[:, :k], matrix[:, k:]
    q, r = np.diag([10**0.5, 1.0 / speed**2, 0.0][:k]), 10**-0.3 * env.task.w_effort
    p = q
    for _ in range(20_000):
        gains = -(b.T @ p @ a) / (r + b.T @ p @ b)
        p = q + a.T @ p @ (a + b @ gains)
    assert policy.gains[6] == pytest.approx(gains[0], rel=1e-4)
    # Twice at the same speed, the mass sticks; from then on these gains act, about that plant's place of rest.
    state = None
    for _ in range(2):
        _, state = policy.predict(observe(policy.readings, 0.0, speed), state)
    deviation = np.array([0.003, -0.002, 0.0])[:k]
    place = policy.places[6] - policy.readings.x_equilibrium
    action, _ = policy.predict(observe(policy.readings, place + 0.003, -0.002), state)
    assert action[0] == pytest.approx(gains[0] @ deviation, rel=1e-3)


def test_between_scheduled_speeds_gains_and_places_are_interpolated():
    readings = Readings.from_env(gym.make("SDFriction/ForceRandomised-v0"))
    policy = ScheduledFeedback(
        (0.1, 0.3), ((1.0, 2.0), (3.0, -2.0)), (0.8, 0.9), readings=readings, belt_speed=0.2, belt_authority=0.0
    )
    _, state = policy.predict(observe(readings, 0.0, 0.15))
    _, state = policy.predict(observe(readings, 0.0, 0.15), state)
    action, _ = policy.predict(observe(readings, 0.825 - readings.x_equilibrium + 0.1, 0.05), state)
    assert action[0] == pytest.approx(1.5 * 0.1 + 1.0 * 0.05, abs=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SoftBelt.from_env(gym.make(FORCE), 1.0, 1.0, 1.0), "SoftBelt needs the actuator 'belt_speed', got"),
        (lambda: SoftBelt.from_env(gym.make(BELT), 0.0, 1.0, 1.0), "inertia must be"),
        (lambda: SuperTwisting.from_env(gym.make(FORCE), 0.0, float("nan"), 1.0), "proportional must be"),
        (lambda: SuperTwisting.from_env(gym.make("SDFriction/ForceSensed-v0"), 0.0, 1.0, 1.0), "needs the velocity"),
        (lambda: Dither.from_env(gym.make(FORCE), 0.5, 32.0), r"frequency must be .*31\.4.*got 32"),
        (lambda: Dither.from_env(gym.make(FORCE), 1.5, 3.0), "amplitude must be"),
        (lambda: Dither.from_env(gym.make(FORCE), 0.5, 3.0, control_interval=0.0), "control_interval must be"),
        (
            lambda: ScheduledFeedback.from_env(gym.make(FORCE), (0.2, 0.1), ((1.0, 1.0),) * 2, (0.8, 0.8)),
            "belt_speeds increasing",
        ),
        (lambda: ScheduledFeedback.from_env(gym.make(BELT), (0.2,), ((1.0, 1.0),), (0.8,)), r"shapes \(k,\), \(k, 3\)"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
