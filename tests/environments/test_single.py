"""The Gymnasium contract, the reward, the tiers, and the refusals."""

import copy
import dataclasses
import math
import os
import pickle
import random
import subprocess
import sys
import warnings
from decimal import Decimal
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_checker import data_equivalence as same

from sd_friction_env import ENVIRONMENT_IDS, OscillatorParameters, SDFrictionEnv, equilibria, kernel, limit_cycle
from sd_friction_env.environments.states import EnvState
from sd_friction_env.physics.parameters import FRICTIONS, GEOMETRIES

NOMINAL = OscillatorParameters()


def make(env_id="SDFriction/Force-v0", **arguments):
    return gym.make(env_id, **arguments).unwrapped


def roll(env, seed, steps, action_seed=0):
    rng = np.random.default_rng(action_seed)
    out = [env.reset(seed=seed)]
    out += [env.step(rng.uniform(-1, 1, 1).astype(np.float32)) for _ in range(steps)]
    return out


def test_these_ids_are_registered():
    assert sorted(ENVIRONMENT_IDS) == [
        "SDFriction/BeltSpeed-v0",
        "SDFriction/BeltSpeedBlind-v0",
        "SDFriction/BeltSpeedBlindHard-v0",
        "SDFriction/BeltSpeedBlindLate-v0",
        "SDFriction/BeltSpeedDrifting-v0",
        "SDFriction/BeltSpeedExcited-v0",
        "SDFriction/BeltSpeedRandomised-v0",
        "SDFriction/BeltSpeedSensed-v0",
        "SDFriction/Force-v0",
        "SDFriction/ForceRandomised-v0",
        "SDFriction/ForceSensed-v0",
    ]


def test_make_works_with_no_import_of_ours():
    code = "import gymnasium as g; e = g.make('sd_friction_env:SDFriction/Force-v0'); e.reset(seed=0); e.step([0.1])"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=120)


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_both_checkers_are_satisfied_without_a_warning(env_id):
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(env_id, render_mode="rgb_array")
        check_env(env)
        sb3_check_env(env)
        env.close()


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_the_same_seed_gives_the_same_bits_and_another_seed_others(env_id):
    first, again, other = (roll(make(env_id), seed, 40) for seed in (5, 5, 6))
    assert same(first, again, exact=True)
    assert not np.array_equal(first[0][0], other[0][0])
    env = make(env_id)
    env.reset(seed=5)
    second_episode = env.reset()[0]
    env.reset(seed=5)
    assert np.array_equal(second_episode, env.reset()[0])
    assert not np.array_equal(second_episode, first[0][0])


def test_global_random_states_are_never_touched():
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002 (the global state is what this is about)
    before = (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002
    env = make("SDFriction/BeltSpeedSensed-v0", randomise={"alpha": (0.7, 0.9)})
    roll(env, None, 20)
    assert before == (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_copies_and_pickles_go_on_alike(env_id):
    env = make(env_id, render_mode="rgb_array")
    roll(env, 3, 20)
    env.render()
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    rng = np.random.default_rng(9)
    for _ in range(10):
        action = rng.uniform(-1, 1, 1).astype(np.float32)
        results = [e.step(action) for e in (env, *twins)]
        assert same(results[0], results[1], exact=True)
        assert same(results[0], results[2], exact=True)


@pytest.mark.parametrize("env_id", ENVIRONMENT_IDS)
def test_going_back_to_a_state_repeats_the_future_bit_for_bit(env_id):
    env = make(env_id)
    roll(env, 3, 25)
    state = env.get_state()
    assert isinstance(state, EnvState)
    actions = np.random.default_rng(1).uniform(-1, 1, (30, 1)).astype(np.float32)
    first = [env.step(a) for a in actions]
    env.reset(seed=77)
    env.set_state(state)
    assert same(first, [env.step(a) for a in actions], exact=True)
    fresh = make(env_id)
    fresh.set_state(state)
    assert same(first, [fresh.step(a) for a in actions], exact=True)


@pytest.mark.parametrize(("saved_with", "loaded_with"), [(4, 1), (4, 2), (1, 4), (3, 0), (0, 3)])
def test_a_state_goes_into_a_sensor_of_another_delay(saved_with, loaded_with):
    env, other = (make("SDFriction/ForceSensed-v0", sensor_delay=delay) for delay in (saved_with, loaded_with))
    roll(env, 3, 7)
    state = env.get_state()
    other.set_state(state)
    kept = loaded_with + 1 if loaded_with else 0
    assert other.get_state().past == state.past[len(state.past) - min(kept, len(state.past)) :]
    # what is seen next is what was sensed so many intervals before, as far as it is remembered
    seen = other.step(np.zeros(1, np.float32))[0][0]
    reference = make("SDFriction/ForceSensed-v0", sensor_delay=0)
    roll(reference, 3, 7)
    now = reference.step(np.zeros(1, np.float32))[0][0]
    remembered = [(x - env.task.x_offset) / env.task.x_scale for x, _ in state.past[-loaded_with:]] if kept else []
    assert seen == pytest.approx(remembered[0] if remembered else now, abs=1e-6)


def test_the_reward_is_the_sum_of_its_reported_terms_and_each_is_as_documented():
    env = make(w_effort=0.3, w_stick=0.7)
    env.reset(seed=0, options={"x": 0.5, "v": 0.2})
    _, reward, _, _, info = env.step(np.array([0.5], np.float32))
    # stuck on the belt for all of the interval
    assert info["stick_fraction"] == 1.0
    assert info["reward_vibration"] == pytest.approx(-1.0)
    assert info["reward_effort"] == pytest.approx(-0.3 * 0.25)
    assert info["reward_stick"] == pytest.approx(-0.7)
    assert reward == pytest.approx(-2.0 * 0.5 - 0.775)
    assert info["force"] == pytest.approx(0.025)
    assert info["control_power"] == pytest.approx(0.025 * 0.2)


def test_vibration_is_the_integral_over_the_interval_not_a_sample_at_its_end():
    env = make()
    env.reset(options={"phase": 0.3})
    start = env.get_state()
    _, _, _, _, info = env.step(np.zeros(1, np.float32))
    fine = make(control_interval=0.001)
    fine.reset(seed=0)
    fine.set_state(start)
    v2 = [fine.step(np.zeros(1, np.float32))[4]["v"] ** 2 for _ in range(100)]
    assert info["mean_square_velocity"] == pytest.approx(np.mean(v2), rel=5e-3)


def test_raising_the_belt_does_not_change_what_vibration_is_measured_against():
    env = make("SDFriction/BeltSpeed-v0")
    env.reset(options={"x": 0.5, "v": 0.2})
    for _ in range(3):
        _, _, _, _, info = env.step(np.ones(1, np.float32))
    assert info["v_belt"] > 0.2
    assert info["reward_vibration"] == pytest.approx(-info["mean_square_velocity"] / 0.04)


def test_the_belt_heads_for_its_target_within_its_acceleration_limit():
    env = make("SDFriction/BeltSpeed-v0")
    env.reset(seed=0)
    speeds = [env.step(np.ones(1, np.float32))[4]["v_belt"] for _ in range(4)]
    assert speeds == pytest.approx([0.25, 0.3, 0.3, 0.3])
    assert env.step(np.zeros(1, np.float32))[4]["belt_acceleration"] == pytest.approx(-0.5)


def test_an_episode_is_truncated_after_its_steps_and_never_terminated_without_contact_loss():
    env = make(episode_steps=7)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]
    assert all(type(flag) is bool for pair in ends for flag in pair)


@pytest.mark.usefixtures("either_way")
def test_losing_contact_terminates_and_costs_more_than_any_way_to_go_on():
    env = make(parameters={"geometry": "cubic", "alpha": 0.2}, episode_steps=100)
    env.reset(options={"x": 0.1, "v": 3.0})
    total, steps = 0.0, 0
    while True:
        _, reward, terminated, truncated, info = env.step(np.zeros(1, np.float32))
        total, steps = total + reward, steps + 1
        if terminated or truncated:
            break
    assert (terminated, truncated, info["status"]) == (True, False, kernel.CONTACT_LOST)
    worst = -info["reward_vibration"]
    assert info["reward_contact_loss"] <= -(100 - steps) * worst
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))


LOSING = {
    "at rest": {"geometry": "cubic", "alpha": 0.2},
    "under a ripple": {
        "geometry": "cubic",
        "friction": "hyperbolic",
        "alpha": 0.85,
        "mu_s": 0.8,
        "delta": 1.7,
        "g1": 0.6,
        "ripple_amplitude": 0.55,
        "ripple_frequency": 5.2,
    },
    "by the stiffness": {
        "geometry": "cubic",
        "alpha": 0.5,
        "g1": 0.6,
        "stiffness_amplitude": 0.9,
        "stiffness_frequency": 3.0,
        "ripple_amplitude": 0.1,
        "ripple_frequency": 2.0,
        "ripple_phase": 1.0,
    },
}


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("case", LOSING)
@pytest.mark.parametrize("actuator", ["force", "belt_speed"])
def test_the_last_info_and_observation_are_of_the_moment_at_which_contact_is_lost(case, actuator):
    arguments = {"parameters": LOSING[case], "actuator": actuator, "control_interval": 0.32, "start": "random"}
    arguments |= {"show_phases": True}
    env = make(**arguments)
    rng, lost = np.random.default_rng(0), 0
    for seed in range(24):
        if lost == 3:
            break
        observation, info = env.reset(seed=seed)
        if info["normal_force"] <= 0.0:
            continue  # a random start may lie where there is no contact
        steps, terminated = 0, False
        while not terminated and steps < 20:
            observation, _, terminated, _, info = env.step(rng.uniform(-1, 1, 1).astype(np.float32))
            steps += 1
        if not terminated:
            continue
        lost += 1
        time, p = info["time"], env.unwrapped.parameters
        assert (steps - 1) * 0.32 < time < steps * 0.32
        belt = env.unwrapped.get_state().v_belt + p.ripple_amplitude * math.cos(
            p.ripple_frequency * time + p.ripple_phase
        )
        assert info["v_belt"] == pytest.approx(belt, abs=1e-12)
        assert info["v_rel"] == pytest.approx(info["v"] - belt, abs=1e-12)
        assert info["normal_force"] == pytest.approx(0.0, abs=1e-9)
        assert observation[-4:-2] == pytest.approx(
            [
                math.cos(p.ripple_frequency * time + p.ripple_phase),
                math.sin(p.ripple_frequency * time + p.ripple_phase),
            ],
            abs=1e-6,
        )
    assert lost > 0


@pytest.mark.parametrize("case", LOSING)
def test_a_batch_tells_of_a_lost_contact_what_the_single_environment_tells(case):
    arguments = {"parameters": LOSING[case], "control_interval": 0.32, "start": "random", "show_phases": True}
    arguments["actuator"] = "belt_speed"
    envs = [make(**arguments) for _ in range(24)]
    batch = gym.make_vec("SDFriction/Force-v0", 24, info_keys="all", **arguments)
    batch.reset(seed=0)
    for i, env in enumerate(envs):
        env.reset(seed=i)
    rng, running, lost = np.random.default_rng(0), set(range(24)), 0
    for _ in range(40):
        actions = rng.uniform(-1, 1, (24, 1)).astype(np.float32)
        observations, _, _, _, infos = batch.step(actions)
        for i in sorted(running):
            observation, _, terminated, truncated, info = envs[i].step(actions[i])
            assert observation.tobytes() == observations[i].tobytes()
            for name in ("time", "v_belt", "v_rel", "normal_force", "x", "mode"):
                assert info[name] == infos[name][i], name
            if terminated or truncated:
                running.discard(i)
                lost += terminated
    assert lost > 0


def test_a_custom_reward_sees_the_reported_terms():
    env = make(reward=lambda info: info["reward_vibration"] - abs(info["force"]))
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.ones(1, np.float32))
    assert reward == info["reward_vibration"] - 0.05


def test_episodes_start_on_the_passive_cycle_at_every_phase():
    env = make()
    cycle = limit_cycle(NOMINAL)
    starts = np.array([[i["x"], i["v"]] for i in (env.reset(seed=s)[1] for s in range(300))])
    assert starts[:, 0].min() >= cycle.x_min - 1e-9
    assert starts[:, 0].max() <= cycle.x_max + 1e-9
    assert starts[:, 0].max() - starts[:, 0].min() > 1.9 * cycle.amplitude
    stuck = (starts[:, 1] == 0.2).mean()
    assert abs(stuck - cycle.stick_fraction) < 4.0 * math.sqrt(0.25 * 0.75 / 300)


def test_where_nothing_oscillates_an_episode_starts_at_the_kicked_equilibrium():
    env = make(parameters={"belt_speed": 0.45}, kick=0.07)
    _, info = env.reset(seed=0)
    assert info["v"] == 0.07
    p = env.parameters
    assert p.restoring_force(info["x"]) == pytest.approx(-p.friction_coefficient(-0.45) * p.normal_force(info["x"]))


def test_starts_by_option_and_argument():
    env = make()
    assert env.reset(options={"x": 0.3})[1]["v"] == 0.2
    rest = env.reset(options={"start": "rest"})[1]
    assert (rest["x"], rest["v"]) == (pytest.approx(0.6), 0.0)
    assert env.reset(options={"phase": 0.0})[1]["x"] == pytest.approx(limit_cycle(NOMINAL).x_breakaway)
    spread = make(start="random")
    states = {spread.reset(seed=s)[1]["x"] for s in range(20)}
    assert len(states) == 20


def test_a_drifting_parameter_moves_in_a_line_from_its_start_to_what_was_drawn_for_the_end():
    drift = {"alpha": (0.6, 0.7), "mu_m": (0.1, 0.12)}
    env = make("SDFriction/BeltSpeed-v0", drift=drift, episode_steps=40)
    actions = np.random.default_rng(4).uniform(-1.0, 1.0, (40, 1)).astype(np.float32)
    ends = []
    for seed in (3, 4):
        env.reset(seed=seed)
        state = env.get_state()
        end = {name: float(v[0]) for name, v in env.task.drift_ends(np.array([state.key]), np.array([0])).items()}
        assert all(drift[name][0] <= value <= drift[name][1] for name, value in end.items())
        ends.append(end)
        for k, action in enumerate(actions):
            now = {"alpha": 0.8 + (end["alpha"] - 0.8) * k / 40, "mu_m": 0.05 + (end["mu_m"] - 0.05) * k / 40}
            constant = make("SDFriction/BeltSpeed-v0", parameters=now, x_offset=0.0, x_scale=1.0, v_scale=1.0)
            constant.reset(seed=0)
            here = env.get_state()
            constant.set_state(dataclasses.replace(here, parameters=constant.nominal))
            result, expected = env.step(action), constant.step(action)
            assert result[4]["x"] == pytest.approx(expected[4]["x"], rel=1e-12)
            assert result[1] == pytest.approx(expected[1], rel=1e-12)
        assert env.parameters == env.nominal  # those at the start
        env.set_state(here)
        assert env.step(action)[1] == result[1]
    assert ends[0] != ends[1]


def test_a_drift_to_where_a_parameter_starts_changes_nothing():
    runs = [roll(make("SDFriction/Force-v0", **task), 2, 60) for task in ({}, {"drift": {"mu_m": (0.05, 0.05)}})]
    assert same([step[1] for step in runs[0][1:]], [step[1] for step in runs[1][1:]], exact=True)


def test_randomised_parameters_are_drawn_per_episode_and_hidden_unless_asked_for():
    env = make("SDFriction/BeltSpeedRandomised-v0")
    assert env.observation_space.shape == (3,)
    draws = [env.reset(seed=1)[1]["parameters"]] + [env.reset()[1]["parameters"] for _ in range(200)]
    for name, (low, high) in env.task.randomise.items():
        values = np.array([d[name] for d in draws])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
    assert {d["beta"] for d in draws} == {0.05}
    told = make("SDFriction/BeltSpeedRandomised-v0", show_parameters=True)
    observation, info = told.reset(seed=1)
    assert observation.shape == (6,)
    assert observation[3] == pytest.approx(2 * (info["parameters"]["alpha"] - 0.6) / 0.35 - 1, abs=1e-6)
    # the hidden belt speed shows in no scale: the same state looks the same whatever it is
    looks = [
        env.reset(options={"x": 0.8, "v": 0.05, "parameters": {"belt_speed": b, "alpha": 0.8}})[0] for b in (0.15, 0.3)
    ]
    assert np.array_equal(looks[0], looks[1])


def test_the_sensed_tier_sees_the_place_alone_late_and_noisily():
    env = make("SDFriction/ForceSensed-v0", sensor_noise=0.0)
    first, info = env.reset(seed=0)
    assert first.shape == (1,)
    seen, true = [first[0]], [info["x"]]
    for _ in range(5):
        observation, _, _, _, info = env.step(np.zeros(1, np.float32))
        seen.append(observation[0])
        true.append(info["x"])
    scaled = (np.array(true) - env.task.x_offset) / env.task.x_scale
    assert seen[0] == pytest.approx(scaled[0], abs=1e-6)
    assert seen[1:] == pytest.approx(scaled[:-1], abs=1e-6)
    noisy = make("SDFriction/ForceSensed-v0", sensor_delay=0)
    noisy.reset(seed=0)
    errors = []
    for _ in range(400):
        observation, _, _, _, info = noisy.step(np.zeros(1, np.float32))
        errors.append(observation[0] * noisy.task.x_scale + noisy.task.x_offset - info["x"])
    assert np.std(errors) == pytest.approx(0.005, rel=0.15)


def test_zero_action_reproduces_the_limit_cycle():
    for parameters in (NOMINAL, NOMINAL.replace(geometry="cubic"), NOMINAL.replace(belt_speed=0.3, alpha=0.6)):
        cycle = limit_cycle(parameters)
        env = make(parameters=parameters, episode_steps=2000)
        env.reset(options={"phase": 0.4})
        infos = [env.step(np.zeros(1, np.float32))[4] for _ in range(2000)]
        low, high = min(i["x_min"] for i in infos), max(i["x_max"] for i in infos)
        assert 0.5 * (high - low) == pytest.approx(cycle.amplitude, abs=1e-9)
        v = np.array([i["v"] for i in infos])
        x = np.array([i["x"] for i in infos])
        period_steps = cycle.period / 0.1
        laps = int(2000 // period_steps)
        whole = [i["stick_fraction"] for i in infos]
        covered = laps * period_steps
        count = int(covered)
        stuck = sum(whole[:count]) + (covered - count) * whole[count]
        assert stuck / covered == pytest.approx(cycle.stick_fraction, abs=2e-3)
        # period: interpolated downward crossings of the middle, first and last
        middle = 0.5 * (low + high)
        down = np.flatnonzero((x[:-1] > middle) & (x[1:] <= middle))
        times = 0.1 * (down + (x[down] - middle) / (x[down] - x[down + 1]))
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(cycle.period, rel=2e-4)
        assert v.max() <= parameters.belt_speed


def test_observations_are_clipped_to_finite_bounds_and_raw_values_reported():
    env = make(observation_limit=1.0)
    observation, info = env.reset(options={"x": 5.0, "v": -3.0})
    assert observation.tolist() == [1.0, -1.0]
    assert observation.dtype == np.float32
    assert (info["x"], info["v"]) == (5.0, -3.0)
    assert np.isfinite(env.observation_space.high).all()


def test_each_step_hands_out_a_fresh_observation():
    env = make()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.step(np.ones(1, np.float32))
    assert np.array_equal(first, kept)


def test_a_rig_in_si_units_makes_an_environment():
    rig = {
        "M": 2.0,
        "K": 800.0,
        "C": 4.0,
        "L": 0.5,
        "H": 0.4,
        "g": 200.0,
        "V0": 2.0,
        "mu_s": 0.2,
        "mu_m": 0.05,
        "V_m": 5.0,
    }
    env = SDFrictionEnv.from_rig(**rig, sampling_time=0.005, force_limit=20.0)
    assert env.task.control_interval == pytest.approx(0.005 * 20.0)
    assert env.task.force_limit == pytest.approx(20.0 / 400.0)
    for name in ("alpha", "g1", "beta", "mu_s", "mu_m", "v_m", "belt_speed"):  # the nominal plant, scaled up
        assert getattr(env.nominal, name) == pytest.approx(getattr(NOMINAL, name)), name
    env.reset(seed=0)
    assert env.step(np.ones(1, np.float32))[4]["force"] * env.nominal.force_scale == pytest.approx(20.0)
    belt = SDFrictionEnv.from_rig(**rig, sampling_time=0.005, belt_acceleration_limit=100.0, actuator="belt_speed")
    assert belt.task.belt_acceleration_limit == pytest.approx(100.0 / (0.5 * 400.0))


def test_an_action_outside_the_box_is_clipped_and_no_number_is_refused():
    env = make()
    env.reset(seed=0)
    assert env.step(np.array([7.0], np.float32))[4]["action"] == 1.0
    assert env.step([-3])[4]["action"] == -1.0
    before = env.get_state()
    for bad in ([math.nan], [math.inf], np.zeros(2), np.zeros((1, 1)), 0.5):
        with pytest.raises(ValueError, match="action must be one finite number"):
            env.step(bad)
    for bad in (["push"], None, object(), ["1"], np.zeros(1, complex), np.zeros(1, "m8[s]")):
        with pytest.raises((TypeError, ValueError), match="action must be one finite number"):
            env.step(bad)
    assert env.get_state() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 1}, "unknown option 'speed'"),
        ({"x": math.nan}, r"options\['x'\] must be a finite number"),
        ({"v": 0.1}, "only together with options"),
        ({"phase": 1.5}, r"options\['phase'\] must be"),
        ({"phase": 0.5, "x": 0.1}, "exclude one another"),
        ({"start": "nowhere"}, "start must be one of"),
        ({"parameters": {"alfa": 1}}, "unknown parameter 'alfa'"),
        ({"parameters": {"alpha": -1}}, "alpha must be"),
        ({"parameters": {"belt_speed": 0.0}}, "belt_speed must be at least 1e-06"),
    ],
)
def test_a_bad_option_is_refused_and_the_episode_goes_on(options, message):
    env = make()
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    assert env.get_state() == before


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"gain": 1}, TypeError, r"__init__\(\) got an unexpected keyword argument 'gain'; allowed: parameters"),
        ({"actuator": "magnet"}, ValueError, "actuator must be one of"),
        ({"control_interval": 0.0}, ValueError, "control_interval must be"),
        ({"control_interval": math.nan}, ValueError, "control_interval must be"),
        ({"episode_steps": 0}, ValueError, "episode_steps must be"),
        ({"episode_steps": 1.5}, ValueError, "episode_steps must be a whole number"),
        ({"w_effort": -1}, ValueError, "w_effort must be"),
        ({"randomise": {"alfa": (0, 1)}}, ValueError, "randomise has no parameter 'alfa'"),
        ({"randomise": {"alpha": (0.9, 0.8)}}, ValueError, "low <= high"),
        ({"randomise": {"alpha": 0.9}}, ValueError, "must be a pair"),
        ({"randomise": {"belt_speed": (0.0, 0.1)}}, ValueError, "belt_speed must be at least 1e-06"),
        ({"randomise": {"mu_m": (0.1, 0.3)}}, ValueError, "mu_m must not exceed"),
        ({"drift": {"mu_m": (0.1, 0.3)}}, ValueError, "mu_m must not exceed"),
        ({"drift": {"alfa": (0, 1)}}, ValueError, "drift has no parameter 'alfa'"),
        ({"drift": {"belt_speed": (0.1, 0.2)}}, ValueError, "drift cannot change 'belt_speed'"),
        ({"drift": {"alpha": (0.5, 0.6)}, "parameters": {"alpha": 0.0}}, ValueError, "alpha = 0 .* cannot drift"),
        ({"parameters": {"belt_speed": 0}}, ValueError, "belt_speed must be at least 1e-06"),
        ({"parameters": 3}, TypeError, "parameters must be"),
        ({"parameters": {3: 1}}, TypeError, "parameters must map parameter names to values, got the name 3"),
        ({"reward": 3}, TypeError, "reward must be a function"),
        ({"show_parameters": "yes"}, TypeError, "show_parameters must be"),
    ],
)
def test_a_bad_argument_is_refused_by_name(arguments, error, message):
    with pytest.raises(error, match=message):
        SDFrictionEnv(**arguments)


# Whole numbers and fractions beyond the greatest float; the last but one is too long for Python to write.
BEYOND = (10**400, -(10**400), Fraction(10**400, 3), 10**5000, np.longdouble("1e4000"))


@pytest.mark.parametrize("value", BEYOND, ids=["whole", "negative", "fraction", "unwritable", "long double"])
@pytest.mark.parametrize(
    "arguments",
    [
        lambda value: {"parameters": {"alpha": value}},
        lambda value: {"w_effort": value},
        lambda value: {"episode_steps": value},
        lambda value: {"randomise": {"alpha": (0.1, value)}},
        lambda value: {"x_scale": value},
    ],
)
def test_an_argument_beyond_the_greatest_float_is_refused_by_name(arguments, value):
    name = next(iter(arguments(value)))
    name = {"parameters": "alpha", "randomise": r"randomise\['alpha'\] high"}.get(name, name)
    with pytest.raises(ValueError, match=rf"{name} must be a finite number in \[.*\], got "):
        SDFrictionEnv(**arguments(value))


@pytest.mark.parametrize("value", BEYOND, ids=["whole", "negative", "fraction", "unwritable", "long double"])
def test_actions_options_and_states_beyond_the_greatest_float_are_refused_and_change_nothing(value):
    env = make(sensor_delay=1)
    env.reset(seed=0)
    before = env.get_state()
    for action in ([value], np.array([value], object), (value,)):
        with pytest.raises(ValueError, match="action must be one finite number"):
            env.step(action)
    for options in ({"x": value}, {"x": 0.1, "v": value}, {"phase": value}, {"parameters": {"g1": value}}):
        with pytest.raises(ValueError, match="must be a finite number in"):
            env.reset(options=options)
    with pytest.raises(ValueError, match="render_size width must be a whole number"):
        SDFrictionEnv(render_mode="rgb_array", render_size=(value, 200))
    if isinstance(value, int):
        for field in ("steps", "key", "episode"):
            with pytest.raises(ValueError, match=rf"state\.{field} must be in \[0, 2\*\*63\)"):
                env.set_state(dataclasses.replace(before, **{field: value}))
    for ended in (False, True):
        if not isinstance(value, np.longdouble):  # infinite as a float, which a state that has ended may be
            with pytest.raises(ValueError, match=r"state\.x must be a finite number in"):
                env.set_state(dataclasses.replace(before, x=value, ended=ended))
    if not isinstance(value, np.longdouble):
        with pytest.raises(TypeError, match=r"state\.past must be a tuple of pairs"):
            env.set_state(dataclasses.replace(before, past=((0.0, value),)))
    assert env.get_state() == before


def test_fractions_and_numpys_numbers_are_numbers_and_decimals_are_not():
    env = make(w_effort=Fraction(1, 4), episode_steps=np.int64(7), force_limit=np.float32(0.5))
    assert (env.task.w_effort, env.task.episode_steps, env.task.force_limit) == (0.25, 7, 0.5)
    env.reset(seed=2, options={"x": Fraction(1, 2), "v": np.int8(0)})
    assert env.get_state().x == 0.5
    first = env.step([Fraction(1, 2)])[0]
    env.reset(seed=2, options={"x": 0.5, "v": 0.0})
    assert np.array_equal(first, env.step(np.array([0.5]))[0])
    with pytest.raises(TypeError, match=r"w_effort must be a real number in .*, got Decimal\('1'\)"):
        SDFrictionEnv(w_effort=Decimal(1))
    with pytest.raises(TypeError, match=r"action must be one finite number .* got \[Decimal\('1'\)\] of type object"):
        env.step([Decimal(1)])


def test_arrays_without_axes_are_numbers_in_options():
    env = make()
    options = {"x": np.array(0.25), "v": np.float32(0.5), "parameters": {"alpha": np.array(0.7)}}
    info = env.reset(seed=0, options=options)[1]
    assert (info["x"], info["v"], info["parameters"]["alpha"]) == (0.25, 0.5, 0.7)


def test_info_holds_numbers_and_where_they_stand_for_names_the_tables_say_which():
    own = {"geometry": "linear", "friction": "hyperbolic"}
    env = make(episode_steps=1, parameters=own)
    info = env.reset(seed=0)[1]
    found = info["parameters"]
    assert (GEOMETRIES[found["geometry"]], FRICTIONS[found["friction"]]) == ("linear", "hyperbolic")
    assert {**found, **own} == dataclasses.asdict(env.parameters)
    last = env.step(np.zeros(1))[4]
    assert kernel.STATUS_NAMES[last["status"]] == "ok"
    for holder in (info, found, last, last["statistics"]):
        assert {type(value) for value in holder.values()} <= {int, float, dict}


def test_stepping_before_reset_is_an_error_that_says_so():
    env = SDFrictionEnv()
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.step(np.zeros(1, np.float32))
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        env.get_state()
    with pytest.raises(TypeError, match="EnvState"):
        env.set_state((1.0, 2.0))


def test_frames_are_drawn_without_a_display():
    code = (
        "import gymnasium as g, sd_friction_env; e = g.make('SDFriction/BeltSpeed-v0', render_mode='rgb_array');"
        "e.reset(seed=0); e.step([0.3]); f = e.render(); assert f.dtype.name == 'uint8' and f.std() > 10, f; e.close()"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}
    subprocess.run([sys.executable, "-W", "error", "-c", code], env=environment, check=True, timeout=120)


def test_every_public_name_can_be_had():
    import sd_friction_env

    lazy = {*sd_friction_env._PUBLIC, *sd_friction_env._MODULES}
    assert lazy | {"ENVIRONMENT_IDS", "__version__"} == set(sd_friction_env.__all__)
    for name in sd_friction_env.__all__:
        assert getattr(sd_friction_env, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = sd_friction_env.nothing


def test_importing_the_package_loads_nothing_heavy():
    code = (
        "import sys, sd_friction_env\n"
        "heavy = {'scipy', 'numba', 'matplotlib', 'torch', 'stable_baselines3', 'pandas', 'pygame'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_an_environment_and_its_training_start_without_most_of_scipy():
    code = (
        "import sys, gymnasium, sd_friction_env\n"
        "gymnasium.make('SDFriction/BeltSpeed-v0')\n"
        "import sd_friction_env.learning.evaluation\n"
        "heavy = {f'scipy.{part}' for part in ('optimize', 'interpolate', 'stats', 'signal', 'integrate')}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize(
    "plant",
    [
        {"geometry": "linear", "g1": 8.68, "beta": 1.3, "mu_s": 1.54, "mu_m": 0.42, "v_m": 0.0124, "belt_speed": 4.69},
        {
            "geometry": "linear",
            "g1": 24.5,
            "beta": 0.43,
            "mu_s": 0.27,
            "mu_m": 0.024,
            "v_m": 0.0134,
            "belt_speed": 0.0982,
        },
        {"friction": "exponential", "g1": 100.0, "mu_v": 10.0, "belt_speed": 10.0},
    ],
)
def test_a_legal_plant_whose_equilibrium_is_far_away_makes_an_environment(plant):
    env = make(parameters=plant)
    place = equilibria(env.unwrapped.nominal)[-1].x
    assert abs(place) > 1000.0
    assert env.unwrapped.task.x_offset == place
    observation, _ = env.reset(seed=0)
    assert abs(observation[0]) < 1.0
    _, reward, _, _, info = env.step(np.zeros(1, np.float32))
    assert info["status"] == kernel.OK
    assert math.isfinite(reward)
    assert info["x"] == pytest.approx(place, rel=1e-3)
