"""The optimal-control reference: what is stored is true, current and better than anything simple."""

import json
import shutil

import gymnasium as gym
import numpy as np
import pytest

from agents import optimal
from agents.evaluation import EVALUATION_SEEDS
from agents.optimal import TASKS
from sd_friction_env.env import SDFrictionEnv

ENV_IDS = sorted(TASKS.values())


def returns_of(env_id, seeds, controller):
    """Return the episode returns of ``controller(step, info)`` -> action, through the registered environment."""
    env = gym.make(env_id)
    returns = []
    for i, seed in enumerate(seeds):
        _, info = env.reset(seed=seed)
        total, step, truncated = 0.0, 0, False
        while not truncated:
            action = np.array([controller(i, step, info)], np.float32)
            _, reward, terminated, truncated, info = env.step(action)
            assert not terminated
            total += float(reward)
            step += 1
        returns.append(total)
    return np.array(returns)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_stored_sequences_replayed_in_the_environment_return_what_is_stored(env_id):
    seeds, actions = optimal.optimal_actions(env_id)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    replayed = returns_of(env_id, seeds, lambda i, step, info: actions[i, step])
    np.testing.assert_allclose(replayed, optimal.optimal_returns(env_id, seeds), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_optimum_beats_simple_controllers_from_every_start(env_id):
    seeds = list(EVALUATION_SEEDS)
    optimum = optimal.optimal_returns(env_id, seeds)
    problem = optimal.make_problem(env_id, seeds)
    shape = (len(seeds), problem.steps)
    for action in (0.0, -1.0, -0.5, 0.5, 1.0):
        assert np.all(optimum > problem.returns(np.full(shape, action))), f"constant action {action}"
    sign = -1.0 if env_id == TASKS["force"] else 1.0
    for gain in (-5.0, 0.5, 1.0, 2.0, 5.0, 20.0):
        feedback = sum_of_rewards(problem, lambda s, k=gain: np.clip(sign * k * s[:, 1], -1.0, 1.0))
        assert np.all(optimum > feedback), f"velocity feedback, gain {gain}"


def sum_of_rewards(problem, law):
    states, total = problem.starts, 0.0
    for _ in range(problem.steps):
        states, rewards = problem.step(states, law(states))
        total = total + rewards
    return total


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_optimum_brings_every_start_to_rest_on_the_sliding_belt(env_id):
    seeds, actions = optimal.optimal_actions(env_id)
    problem = optimal.make_problem(env_id, seeds)
    states, rewards = problem.rollout(actions.astype(np.float64))
    last = slice(-problem.steps // 4, None)
    assert np.ptp(states[:, last, 0], axis=1).max() / 2.0 < 0.05 * 0.3934
    assert np.abs(states[:, last, 2].mean(axis=1) / 0.2 - 1.0).max() < 0.02
    assert rewards[:, last].min() > -0.01


def test_batch_step_is_the_environment_step():
    env_id = TASKS["belt"]
    problem = optimal.make_problem(env_id, [5])
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (1, problem.steps)).astype(np.float32)
    expected = returns_of(env_id, [5], lambda i, step, info: actions[0, step])
    total = 0.0
    for reward in problem.rollout(actions.astype(np.float64))[1][0]:
        total += reward
    assert total == expected[0]


def test_tiny_grid_already_comes_close_on_force():
    problem = optimal.make_problem(TASKS["force"], range(20))
    grid = optimal.make_grid(problem.env_id, (61, 51))
    value = optimal.value_iteration(problem, grid, np.linspace(-1.0, 1.0, 11))
    estimate = grid.interpolate(value.whole, problem.starts)
    assert -100.0 < estimate.mean() < -50.0
    assert np.all(value.whole <= value.after_first)  # one step more costs something or nothing
    greedy = problem.returns(optimal.greedy_actions(problem, value))
    assert -66.0 < greedy.mean() < -55.0


def test_refinement_never_makes_a_sequence_worse_and_finds_the_zero_of_a_rest():
    problem = optimal.make_problem(TASKS["belt"], range(4))
    start = np.random.default_rng(1).uniform(-1.0, 1.0, (4, problem.steps))
    refined = optimal.refine(problem, start, iterations=3)
    assert np.all(problem.returns(refined) > problem.returns(start))


def test_grid_interpolates_linear_functions_exactly_and_has_a_node_at_zero_relative_velocity():
    for env_id, sizes in ((TASKS["force"], (9, 14)), (TASKS["belt"], (7, 12, 5))):
        grid = optimal.make_grid(env_id, sizes)
        nodes = grid.nodes(0.2)

        def plane(states):
            return 2.0 * states[..., 0] - 3.0 * states[..., 1] + 0.5 * states[..., 2] + 1.0

        share = np.random.default_rng(2).random((50, 1))
        between = share * nodes[3] + (1.0 - share) * nodes[-4]
        np.testing.assert_allclose(grid.interpolate(plane(nodes), between), plane(between), atol=1e-12)
        assert np.abs(nodes[:, 1] - nodes[:, 2]).min() < 1e-12


@pytest.mark.parametrize("sizes", [(9,), (9, 9, 9), (2, 9)])
def test_grid_sizes_that_do_not_fit_are_refused(sizes):
    with pytest.raises(ValueError, match="grid sizes"):
        optimal.make_grid(TASKS["force"], sizes)


def test_hard_tiers_and_unknown_ids_have_no_reference_and_unknown_seeds_are_refused():
    assert optimal.optimal_returns("SDFriction/ForceSensed-v0", [1_000_000]) is None
    assert optimal.optimal_returns("SDFriction/BeltSpeedRandomised-v0", [1_000_000]) is None
    assert optimal.optimal_returns("sd_friction_env:SDFriction/Force-v0", [1_000_000]) is not None
    with pytest.raises(ValueError, match="seed 3 "):
        optimal.optimal_returns(TASKS["force"], [1_000_000, 3])
    with pytest.raises(FileNotFoundError, match="no optimum"):
        optimal.optimal_actions("SDFriction/ForceSensed-v0")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["configuration"]["task"].update(w_effort=0.2), r"task w_effort: 0\.2 -> 0\.1"),
        (lambda f: f["configuration"]["parameters"].update(mu_m=0.06), r"parameters mu_m: 0\.06 -> 0\.05"),
        (lambda f: f["golden"][3].__setitem__(1, f["golden"][3][1] + 1e-5), "the dynamics or the reward"),
        (lambda f: f["starts"][7].__setitem__(0, 0.5), "the starts"),
    ],
)
def test_reference_of_another_environment_is_refused(tmp_path, change, message):
    path = tmp_path / "force.json"
    shutil.copy(optimal.OPTIMUM_DIRECTORY / "force.json", path)
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content["fingerprint"])
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(RuntimeError, match=message):
        optimal.optimal_returns(TASKS["force"], [1_000_000], directory=tmp_path)


def test_saving_and_reading_keeps_returns_and_sequences(tmp_path):
    seeds = [3, 4]
    problem = optimal.make_problem(TASKS["belt"], seeds)
    actions = np.random.default_rng(4).uniform(-1.0, 1.0, (2, problem.steps))
    saved = optimal.save_optimum(problem, seeds, actions, {"command": "test"}, tmp_path)
    assert optimal.optimal_returns(problem.env_id, [4, 3], directory=tmp_path).tolist() == saved[::-1].tolist()
    stored_seeds, stored = optimal.optimal_actions(problem.env_id, directory=tmp_path)
    assert stored_seeds == seeds
    np.testing.assert_allclose(stored, actions, atol=1.0 / optimal.ACTION_LEVELS)


def test_stored_files_are_small():
    for path in optimal.OPTIMUM_DIRECTORY.iterdir():
        assert path.stat().st_size < 200_000, path.name


def test_fingerprint_ignores_what_a_controller_sees():
    assert isinstance(gym.make(TASKS["force"], observation_limit=5.0).unwrapped, SDFrictionEnv)
    assert "observation_limit" not in optimal.fingerprint(TASKS["force"], [1])["configuration"]["task"]
