"""Observers against what they should find: the true state and plant, a textbook filter, and each other."""

import dataclasses
import pickle

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env import load_pretrained
from sd_friction_env.control.observed import ObservedPolicy, ObservedRollout, ObservedRule, threshold_follower
from sd_friction_env.control.observers import (
    AlphaBetaFilter,
    Belief,
    EnsembleKalmanFilter,
    KalmanFilter,
    LuenbergerObserver,
    ParticleFilter,
)
from sd_friction_env.control.policies import ThresholdFollower
from sd_friction_env.environments.ensemble import Ensemble
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.optimal import OptimalPolicy

NOMINAL, RANDOMISED, SENSED, DRIFTING, EXCITED = (
    f"SDFriction/BeltSpeed{tier}-v0" for tier in ("", "Randomised", "Sensed", "Drifting", "Excited")
)
BLIND = {"sensor": "position", "sensor_noise": 0.005, "sensor_delay": 1}
FILTERS = [AlphaBetaFilter, LuenbergerObserver, ParticleFilter, EnsembleKalmanFilter, KalmanFilter]
SMALL = {"prior_size": 512}
# A fast belt and starts near the equilibrium: the mass never sticks.
SLIPS = {"parameters": {"belt_speed": 0.6}, "start": "random", "x_offset": 0.84, "x_scale": 0.02, "v_scale": 0.02}


def make(env_id=RANDOMISED, **arguments):
    return gym.make(env_id, **arguments).unwrapped


def small(kind, env, **named):
    return kind.from_env(env, **({} if kind in FILTERS[:2] else SMALL), **named)


def follow(observer, env, steps, seed=2_000_000, amplitude=1.0):
    """The belief after an episode of given actions, and the true state and parameters."""
    observation, info = env.reset(seed=seed)
    memory = None
    for t in range(steps):
        belief, memory = observer.correct(observation, memory, t == 0)
        action = amplitude * np.sin(0.7 * t)
        truth = np.array([info["x"], info["v"], info["v_belt"]])
        observation, _, _, _, info = env.step(np.array([action], np.float32))
        memory = observer.advance(memory, float(np.float32(action)))
    return belief, truth, np.array([getattr(env.parameters, name) for name in env.task.randomise])


@pytest.mark.parametrize("env_id", [RANDOMISED, DRIFTING, EXCITED])
def test_an_ensemble_steps_as_the_environment_does_bit_for_bit(env_id):
    envs = gym.make_vec(env_id, 64, info_keys="all").unwrapped
    _, info = envs.reset(seed=1)
    ensemble = Ensemble(envs.nominal, envs.task)
    keys, episodes = np.array([(saved.key, saved.episode) for saved in envs.get_states()]).T
    hidden = [info["parameters"][name] for name in ensemble.names]
    plants = np.stack([*hidden, *envs.task.drift_ends(keys, episodes).values()], axis=-1)
    rng = np.random.default_rng(0)
    states = np.stack([info[name] for name in ("x", "v", "v_belt")], axis=-1)
    for t in range(100):
        actions = rng.uniform(-1.0, 1.0, 64).astype(np.float32)
        states, rewards = ensemble.step(states, plants, actions.astype(float), t)
        _, own, _, _, info = envs.step(actions[:, None])
        assert states.tobytes() == np.stack([info[name] for name in ("x", "v", "v_belt")], axis=-1).tobytes()
        assert rewards.tobytes() == own.tobytes()


def test_a_mass_that_loses_contact_has_no_state():
    env = make(NOMINAL, parameters={"alpha": 0.6})
    ensemble = Ensemble(env.nominal, env.task)
    states, rewards = ensemble.step(np.array([[9.0, 0.0, 0.2], [0.3, 0.2, 0.2]]), np.empty((2, 0)), np.zeros(2))
    lost = np.isnan(states).all(axis=-1) & np.isnan(rewards)
    assert not lost[1]
    reference = make(NOMINAL, parameters={"alpha": 0.6})
    reference.reset(options={"x": 9.0, "v": 0.0})
    assert lost[0] == reference.step(np.zeros(1, np.float32))[2]


@pytest.mark.parametrize(
    ("kind", "named", "x_error", "share", "finds"),
    [
        (KalmanFilter, {}, 5e-4, 0.02, 6),  # it begins with one guess, and may stay with a wrong one
        (EnsembleKalmanFilter, {}, 5e-4, 0.02, 8),
        (ParticleFilter, {"particles": 2048}, 2e-3, 0.12, 8),
    ],
)
def test_without_noise_the_estimate_comes_to_the_true_state_and_plant(kind, named, x_error, share, finds):
    env = make(**(BLIND | {"sensor_noise": 0.0}))
    observer = kind.from_env(env, **named)
    width = np.array([high - low for low, high in env.task.randomise.values()])
    found = 0
    for seed in range(2_000_000, 2_000_008):
        belief, truth, plant = follow(observer, env, 250, seed)
        state, estimate = belief.mean
        near = abs(state[0] - truth[0]) < x_error and np.abs(state[1:] - truth[1:]).max() < 0.02
        found += near and (np.abs(estimate - plant) / width).max() < share
    assert found >= finds


def textbook(observer, env, steps):
    """A Kalman filter of the delayed reading in its textbook form, by the finite differences of the environment."""
    observation, _ = env.reset(seed=2_000_000)
    prior, delay = observer.prior, env.task.sensor_delay
    rows, noise = prior.shape[1], observer.noise
    memory, mean, covariance, means = None, None, None, []
    for t in range(steps):
        belief, memory = observer.correct(observation, memory, t == 0)
        if t == 0:  # begins as the observer does
            mean, covariance = memory[1][0, 0].copy(), memory[2][0].copy()
        elif t > delay:
            slope = np.zeros((1, rows))
            slope[0, 3] = 1.0
            innovation = slope @ covariance @ slope.T + noise**2
            gain = covariance @ slope.T @ np.linalg.inv(innovation)
            mean = mean + gain[:, 0] * (observer.read(observation)[0] - mean[3])
            covariance = (np.eye(rows) - gain @ slope) @ covariance
        means.append((belief.mean[0], mean[:3]))
        action = 0.3 * np.sin(0.7 * t)
        observation, _, _, _, _ = env.step(np.array([action], np.float32))
        held = float(np.float32(action))
        memory = observer.advance(memory, held)

        def ahead(state, held=held):
            return observer.ensemble.step(state[None], np.empty((1, 0)), np.array([held]))[0][0]

        change = np.zeros((rows, rows))
        for i in range(3):
            small = 1e-5 * np.eye(3)[i]
            change[:3, i] = (ahead(mean[:3] + small) - ahead(mean[:3] - small)) / 2e-5
        change[3:-1, 4:] = np.eye(rows - 4)
        change[-1] = change[0]
        mean = np.concatenate([ahead(mean[:3]), mean[4:], ahead(mean[:3])[:1]])
        covariance = change @ covariance @ change.T
    return means


def test_without_events_the_extended_filter_is_the_textbook_filter():
    env = make(SENSED, **SLIPS, sensor_delay=2)
    observer = KalmanFilter.from_env(env, inflation=1.0, **SMALL)
    for found, expected in textbook(observer, env, 60):
        assert found == pytest.approx(expected, abs=1e-7)


def test_many_particles_agree_with_the_kalman_filter_where_that_is_exact():
    env = make(SENSED, **SLIPS)
    exact, _, _ = follow(KalmanFilter.from_env(env, inflation=1.0), env, 40, amplitude=0.3)
    for kind in (ParticleFilter, EnsembleKalmanFilter):
        found, truth, _ = follow(kind.from_env(env, particles=4096), env, 40, amplitude=0.3)
        spread = np.sqrt((found.weights[:, None] * (found.states - found.mean[0]) ** 2).sum(axis=0))
        assert np.abs(found.mean[0] - exact.mean[0])[:2].max() < 0.5 * spread[:2].max()
        assert np.abs(found.mean[0] - truth)[:2].max() < 4.0 * spread[:2].max()


def policies_on(env, kind):
    observer = small(kind, env)
    network = load_pretrained(RANDOMISED)
    rule, rollout = (each.from_env(env, observer) for each in (ObservedRule, ObservedRollout))
    return [rule, dataclasses.replace(rollout, horizon=5), ObservedPolicy(observer, network)]


def test_an_ensemble_is_copied_without_its_compiled_code():
    ensemble = Ensemble(make().nominal, make().task)
    given = np.array([0.8, 0.1, 0.2]), np.array([0.2, 0.8, 0.05]), np.array(0.5)
    (state, reward), copied = ensemble.step(*given), pickle.dumps(ensemble)
    assert len(copied) < 5_000
    again, same = pickle.loads(copied).step(*given)
    assert (again.tobytes(), same) == (state.tobytes(), reward)


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("arguments", [BLIND, {}], ids=["blind", "state seen"])
def test_one_as_many_and_the_same_seed_the_same_bits(kind, arguments):
    env = make(**arguments)
    rng = np.random.default_rng(0)
    observations = rng.normal(scale=0.3, size=(12, 3, env.observation_space.shape[0])).astype(np.float32)
    begins = rng.random((12, 3)) < 0.2
    begins[0] = True
    for policy, again in zip(policies_on(env, kind), policies_on(env, kind), strict=True):
        state, singles = None, [None] * 3
        for t in range(12):
            together, state = policy.predict(observations[t], state, begins[t])
            for i in range(3):
                alone, singles[i] = again.predict(observations[t, i], singles[i], begins[t, i])
                assert alone.shape == (1,)
                assert alone.tobytes() == together[i].tobytes()


def test_another_seed_draws_other_particles():
    env = make(**BLIND)
    first, again, other = (small(ParticleFilter, env, seed=seed).prior for seed in (0, 0, 1))
    assert first.tobytes() == again.tobytes() != other.tobytes()


def test_weights_that_are_tempered_leave_the_share_that_is_asked_for():
    observer = small(ParticleFilter, make(**BLIND))
    prior = observer.prior[None]
    weights = observer._reweighted(prior, np.full((1, 512), 1 / 512), np.array([[0.4]]), 100.0)
    assert weights.sum() == pytest.approx(1.0)
    assert 100.0 <= 1.0 / (weights**2).sum() < 105.0


def test_the_belief_is_weighted():
    belief = Belief(np.array([[1.0, 0, 0], [3.0, 0, 0]]), np.array([[2.0], [6.0]]), np.array([0.75, 0.25]), np.int64(0))
    assert belief.mean[0][0] == 1.5
    assert belief.mean[1][0] == 3.0


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("plant", [{}, {"force_amplitude": 0.05, "force_frequency": 1.3}])
def test_the_luenberger_observer_follows_a_plant_that_it_knows(delay, plant):
    """Without noise and from the right start, its prediction over the delay is the plant's state, to rounding."""
    env = make(SENSED, sensor_noise=0.0, sensor_delay=delay, parameters=plant)
    observer = LuenbergerObserver.from_env(env)
    observation, info = env.reset(seed=0, options={"x": 0.3, "v": env.nominal.belt_speed})
    memory, rule = None, ThresholdFollower.seeing_all(env)
    for t in range(120):
        belief, memory = observer.correct(observation, memory, t == 0)
        truth = info["x"], info["v"], info["v_belt"]
        assert belief.states[0] == pytest.approx(truth, abs=1e-6), t
        action = np.float32(np.clip(rule.follow(belief.states[0, 1], 0.2), -1.0, 1.0))
        memory = observer.advance(memory, action)
        observation, _, _, _, info = env.step(action[None])


@pytest.mark.parametrize("delay", [0, 2])
def test_the_luenberger_observer_corrects_what_it_believed_when_the_reading_was_taken(delay):
    env = make(SENSED, sensor_noise=0.0, sensor_delay=delay)
    observer = LuenbergerObserver.from_env(env, x_gain=0.25, v_gain=0.5)
    plant = Ensemble(env.nominal, env.task)
    _, memory = observer.correct(np.array([0.3], np.float32))
    first, second = (env.task.x_offset + env.task.x_scale * float(np.float32(x)) for x in (0.3, 0.5))
    state, actions = np.array([first, 0.2, 0.2]), (-1.0, 0.5, 0.8)[: delay + 1]
    for action in actions[:-1]:  # the sensor still repeats its first reading
        memory = observer.advance(memory, action)
        _, memory = observer.correct(np.array([0.3], np.float32), memory, False)
    memory = observer.advance(memory, actions[-1])
    belief, _ = observer.correct(np.array([0.5], np.float32), memory, False)

    def step(state, action):
        return plant.step(state, np.empty(0), np.array(action))[0]

    state = step(state, actions[0])
    state = state + (second - state[0]) * np.array([0.25, 0.5, 0.0])
    for action in actions[1:]:
        state = step(state, action)
    assert belief.states[0] == pytest.approx(state, abs=1e-12)


@pytest.mark.parametrize(
    ("kind", "controller", "least"),
    [
        (AlphaBetaFilter, ObservedRule, 0.75),
        (KalmanFilter, ObservedRule, 0.75),
        (ParticleFilter, ObservedRule, 0.8),
        (EnsembleKalmanFilter, ObservedRule, 0.9),
        (EnsembleKalmanFilter, ObservedRollout, 0.9),
    ],
)
def test_a_belt_that_is_seen_by_its_position_alone_is_suppressed(kind, controller, least):
    starts = evaluation.VALIDATION_SEEDS[60:66]
    policy = controller.from_env(make(**BLIND), kind.from_env(make(**BLIND)))
    table = evaluation.evaluate(policy, RANDOMISED, starts, BLIND)
    assert table["suppressed"].mean() >= least


def test_a_planner_acts_on_an_observer_where_it_does_not_see_the_state():
    starts, env = evaluation.VALIDATION_SEEDS[:4], make(SENSED)
    planner = OptimalPolicy.from_env(make(NOMINAL))
    on_observer = ObservedPolicy(LuenbergerObserver.from_env(env), planner)
    planned, rule = (evaluation.evaluate(each, SENSED, starts) for each in (on_observer, threshold_follower(env)))
    assert planned["suppressed"].all()
    assert (planned["return"] > rule["return"]).all()


def believed(x, v, step):
    states = np.stack([np.atleast_1d(x), np.atleast_1d(v), np.full(np.size(x), 0.2)], axis=-1)[:, None]
    return Belief(states, np.empty((np.size(x), 1, 0)), np.ones((np.size(x), 1)), np.full(np.size(x), step))


def test_a_steady_error_of_the_velocity_leaves_the_rules_action_and_motion_stays():
    env = make(randomise={}, sensor="position")
    policy = ObservedRule.from_env(env, AlphaBetaFilter.from_env(env), blend_time=1.2)
    times, state = 0.1 * np.arange(150), None
    swing = 0.004 * np.sin(times), 0.004 * np.cos(times)
    for t in range(150):  # a mass at rest, believed to creep; the same creep while it swings; one in large motion
        x = np.array([0.8, 0.8 + swing[0][t], 0.8])
        v = np.array([0.01, 0.01 + swing[1][t], 0.1])
        actions, state = policy._decide(believed(x, v, t), state, None)
        left = 0.01 * (11 / 12) ** t  # a first-order lag of 12 intervals
        assert actions == pytest.approx(6.0 / 0.2 * np.array([left, left + swing[1][t], 0.1]), abs=1e-3)
    fresh, _ = policy._decide(believed(x, v, 0), state, None)  # another episode
    assert fresh == pytest.approx(6.0 / 0.2 * v)
    with pytest.raises(ValueError, match=r"blend_time must be .* got 0"):
        dataclasses.replace(policy, blend_time=0.0)


def test_the_velocity_is_mended_where_an_estimated_plant_predicts_it():
    known = {**BLIND, "randomise": {}}
    for kind, arguments, expected in [
        (EnsembleKalmanFilter, BLIND, 1.2),
        (KalmanFilter, BLIND, 1.2),
        (AlphaBetaFilter, BLIND, None),  # without a plant
        (EnsembleKalmanFilter, {}, None),  # the velocity is read
        (EnsembleKalmanFilter, known, None),  # the plant is known
    ]:
        env = make(**arguments)
        assert ObservedRule.from_env(env, kind.from_env(env)).blend_time == expected


@pytest.mark.parametrize(
    ("env_id", "kind", "least"), [(DRIFTING, EnsembleKalmanFilter, 0.85), (EXCITED, ParticleFilter, 0.6)]
)
def test_a_plant_that_drifts_or_is_excited_is_suppressed(env_id, kind, least):
    policy = ObservedRule.from_env(make(env_id), kind.from_env(make(env_id)))
    assert evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS[:8])["suppressed"].mean() >= least


@pytest.mark.parametrize("env_id", [DRIFTING, EXCITED])
def test_the_covariance_grows_by_the_derivatives_of_the_step(env_id):
    observer = small(KalmanFilter, make(env_id), inflation=1.0)
    row, step = observer.prior[3].copy(), np.array([200])
    d = 3 + len(observer.ensemble.ranges)

    def ends(column, change):
        moved = row + change * np.eye(len(row))[column]
        return observer.ensemble.step(moved[None, :3], moved[None, 3:d], np.array([0.3]), step)[0][0]

    for column in range(3, d):
        spread = np.outer(*[np.eye(len(row))[column]] * 2)
        _, grown = observer._step(row[None, None], np.array([[0.3]]), spread[None], step)
        slope = (ends(column, 1e-5) - ends(column, -1e-5)) / 2e-5
        assert grown[0, column, :3] == pytest.approx(slope, rel=1e-4, abs=1e-9)
        assert np.abs(slope).max() > 0.0


def test_phases_are_close_to_each_other_across_a_full_turn():
    observer = small(ParticleFilter, make(EXCITED))
    guesses = observer.prior[None, :2].copy()
    guesses[0, :, 5] = 0.1, 2.0 * np.pi - 0.3
    assert np.ptp(observer._admissible(guesses, np.zeros((1, 2), bool))[0, :, 5]) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ParticleFilter.from_env(make(), particles=4), r"particles must be .* got 4"),
        (lambda: ParticleFilter.from_env(make(), jitter=2.0), r"jitter must be .* got 2.0"),
        (lambda: ParticleFilter.from_env(make(), seed=-1), r"seed must be .* got -1"),
        (lambda: KalmanFilter.from_env(make(), inflation=0.5), r"inflation must be .* got 0.5"),
        (lambda: KalmanFilter.from_env(make(), noise=0.0), r"noise must be .* got 0.0"),
        (lambda: AlphaBetaFilter.from_env(make(), x_gain=float("nan")), r"x_gain must be .* got nan"),
        (lambda: LuenbergerObserver.from_env(make(), v_gain=-0.1), r"v_gain must be .* got -0.1"),
        (
            lambda: ObservedRule.from_env(
                make("SDFriction/ForceSensed-v0"), KalmanFilter.from_env(make("SDFriction/ForceSensed-v0"))
            ),
            "needs the actuator 'belt_speed', got 'force'",
        ),
        (
            lambda: ObservedRollout.from_env(make(), KalmanFilter.from_env(make()), guesses=0),
            r"guesses must be .* got 0",
        ),
        (lambda: small(KalmanFilter, make()).correct(np.zeros(2)), "at least 3 entries"),
        (
            lambda: small(ParticleFilter, make()).correct(
                np.zeros((2, 3)), small(ParticleFilter, make()).correct(np.zeros(3))[1]
            ),
            "as many observations",
        ),
    ],
)
def test_what_cannot_be_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_an_observer_needs_one_of_our_environments():
    with pytest.raises(TypeError, match="must be an SDFrictionEnv"):
        ParticleFilter.from_env(gym.make("CartPole-v1"))


def test_look_ahead_goes_on_with_the_episodes_clock(monkeypatch):
    env, seen, step = make(EXCITED), [], Ensemble.step

    def recorded(self, states, parameters, actions, steps=0):
        seen.append(int(np.max(steps)))
        return step(self, states, parameters, actions, steps)

    policy = ObservedRollout.from_env(env, small(ParticleFilter, env), horizon=3)
    observation, state = env.reset(seed=0)[0], None
    monkeypatch.setattr(Ensemble, "step", recorded)
    for start in (True, False):
        action, state = policy.predict(observation, state, start)
        observation = env.step(action)[0]
    assert seen == [0, 1, 2, 0, 1, 2, 3, 1]  # three intervals ahead, then the one that is taken


def test_look_ahead_leaves_the_rules_action_only_where_the_guesses_agree(monkeypatch):
    # One interval ahead, of two guesses: an action of 1 gains 3 on one and loses 1 on the other, -1 gains 0.1 on both.
    env = make(**BLIND)
    gains = {1.0: np.array([3.0, -1.0]), -1.0: np.array([0.1, 0.1])}

    def rewarded(self, states, parameters, actions, steps=0):
        row = np.arange(2)[:, None]
        return states, np.select([actions == 1.0, actions == -1.0], [gains[1.0][row], gains[-1.0][row]])

    monkeypatch.setattr(Ensemble, "step", rewarded)
    even = Belief(np.zeros((2, 3)), np.full((2, 3), 0.2), np.full(2, 0.5), np.int64(0))
    for caution, best in ((0.0, 1.0), (0.4, 1.0), (1.0, -1.0)):
        policy = ObservedRollout.from_env(
            env, small(ParticleFilter, env), guesses=2, candidates=2, horizon=1, caution=caution
        )
        assert policy._decide(even, None, None)[0] == best
    with pytest.raises(ValueError, match=r"caution must be .* got -1"):
        dataclasses.replace(policy, caution=-1.0)
