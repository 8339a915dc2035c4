"""The optimal-control reference: what is stored is true, current and better than anything simple."""

import json
import shutil
import zipfile
import zlib

import gymnasium as gym
import numpy as np
import pytest

from sd_friction_env.cli.main import main
from sd_friction_env.control.policies import PolicyFileError
from sd_friction_env.environments.single import SDFrictionEnv
from sd_friction_env.environments.task import passive_motion
from sd_friction_env.learning import evaluation, optimal, scores
from sd_friction_env.learning.evaluation import EVALUATION_SEEDS
from sd_friction_env.learning.optimal import OPEN, RANDOMISED, SENSED, TASKS, OptimalPolicy

OWN = [OPEN[tier]["belt"] for tier in ("blind-hard", "drifting", "excited")]  # open tiers with a reference of their own
STORED = [*TASKS.values(), *RANDOMISED.values(), *OWN]


def stored_returns(env_id, seeds, directory=optimal.OPTIMUM_DIRECTORY):
    table = optimal.stored_returns(env_id, directory)
    return None if table is None else np.array([table[seed] for seed in seeds])


def write_unsealed(path, content):
    """Write a JSON file as an earlier version did, without a digest: only what is in it can then be refused."""
    path.write_text(json.dumps({name: value for name, value in content.items() if name != "sha256"}), encoding="utf-8")


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


@pytest.mark.parametrize("env_id", STORED)
def test_stored_sequences_replayed_in_the_environment_return_what_is_stored(env_id):
    seeds, actions = optimal.optimal_actions(env_id)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    replayed = returns_of(env_id, seeds, lambda i, step, info: actions[i, step])
    np.testing.assert_allclose(replayed, stored_returns(env_id, seeds), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("env_id", STORED)
def test_optimum_beats_simple_controllers_from_every_start(env_id):
    seeds, _ = optimal.optimal_actions(env_id)
    optimum = stored_returns(env_id, seeds)
    problem = optimal.make_problem(env_id, seeds)
    shape = (len(seeds), problem.steps)
    for action in (0.0, -1.0, 0.5):
        assert np.all(optimum > problem.returns(np.full(shape, action))), f"constant action {action}"
    sign = 1.0 if problem.belt_moves else -1.0
    for gain in (-5.0, 1.0, 5.0):
        feedback = sum_of_rewards(problem, lambda s, k=gain: np.clip(sign * k * s[:, 1], -1.0, 1.0))
        assert np.all(optimum > feedback), f"velocity feedback, gain {gain}"


def sum_of_rewards(problem, law):
    states, total = problem.starts, 0.0
    for t in range(problem.steps):
        states, rewards = problem.step(states, law(states), t)
        total = total + rewards
    return total


# A hidden force leaves some vibration, and one weak squeal of a blind-hard plant is not worth more effort.
SHARES = dict.fromkeys(STORED, 1.0) | {OWN[0]: 0.96, OWN[2]: 0.7}


@pytest.mark.parametrize("env_id", STORED)
def test_optimum_brings_the_starts_to_rest_on_the_sliding_belt(env_id):
    seeds, actions = optimal.optimal_actions(env_id)
    problem = optimal.make_problem(env_id, seeds)
    states, rewards = problem.rollout(actions.astype(np.float64))
    passive, _ = problem.rollout(np.zeros(actions.shape))
    last = slice(-problem.steps // 4, None)
    amplitude, passive_amplitude = (np.ptp(path[:, last, 0], axis=1) for path in (states, passive))
    rests = (
        (amplitude / passive_amplitude < 0.05)
        & (np.abs(states[:, last, 2].mean(axis=1) / problem.starts[:, 2] - 1.0) < 0.02)
        & ((rewards[:, last].min(axis=1) > -0.01) | (env_id == OWN[2]))
    )
    assert rests.mean() >= SHARES[env_id]


def test_seeds_stored_are_the_first_of_the_protocol():
    for task in TASKS:
        assert optimal.optimal_actions(TASKS[task])[0] == list(EVALUATION_SEEDS)
        assert optimal.optimal_actions(RANDOMISED[task])[0] == list(EVALUATION_SEEDS)[:32]


@pytest.mark.parametrize("task", sorted(TASKS))
def test_sensed_tier_has_the_nominal_optimum_for_a_replay_there_returns_the_same(task):
    seeds, actions = optimal.optimal_actions(SENSED[task])
    reference = stored_returns(SENSED[task], seeds)
    assert reference.tolist() == stored_returns(TASKS[task], seeds).tolist()
    replayed = returns_of(SENSED[task], seeds[:5], lambda i, step, info: actions[i, step])
    np.testing.assert_allclose(replayed, reference[:5], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("env_id", [*RANDOMISED.values(), *OWN])
def test_problem_of_many_plants_is_each_of_them_alone(env_id):
    problem = optimal.make_problem(env_id, range(4))
    assert len(problem.plants) == 4
    actions = np.random.default_rng(3).uniform(-1.0, 1.0, (4, problem.steps)).astype(np.float32).astype(np.float64)
    together = problem.returns(actions)
    for i in range(4):
        assert problem.select(np.array([i])).returns(actions[[i]])[0] == together[i]
    env_returns = returns_of(env_id, range(4), lambda i, step, info: np.float32(actions[i, step]))
    np.testing.assert_allclose(env_returns, together, rtol=0.0, atol=1e-9)
    with pytest.raises(ValueError, match="one plant"):
        optimal.make_grid(problem, (9, 9, 9)[: problem.dimensions])


def test_a_grid_has_room_for_the_kick_where_passive_motion_dies_out():
    problem = optimal.make_problem("SDFriction/BeltSpeedBlindHard-v0", [1_000_017])
    assert passive_motion(problem.parameters[0]).amplitude == 0.0
    grid = optimal.make_grid(problem, (9, 9, 9))
    x, _, v_belt = problem.starts[0]
    assert np.all(grid.lows < np.array([x, -v_belt - 0.1, v_belt]))
    assert np.all(grid.highs > np.array([x, 0.0, v_belt]))


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
    grid = optimal.make_grid(problem, (61, 51))
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


def test_settling_brings_a_belt_back_that_rests_beside_its_speed_and_never_makes_a_sequence_worse():
    best = optimal.optimal_actions(TASKS["belt"])[1][:3].astype(np.float64)
    problem = optimal.make_problem(TASKS["belt"], list(EVALUATION_SEEDS)[:3])
    beside = best.copy()
    beside[:, 400:] = 0.2
    settled = problem.returns(optimal.settle(problem, beside))
    assert (settled > problem.returns(beside) + 0.3).all()  # 100 steps cost .1 x .2^2 each
    assert (problem.returns(optimal.settle(problem, best)) >= problem.returns(best)).all()


def test_grid_interpolates_linear_functions_exactly_and_has_a_node_at_zero_relative_velocity():
    for env_id, sizes in ((TASKS["force"], (9, 14)), (TASKS["belt"], (7, 12, 5))):
        grid = optimal.make_grid(optimal.make_problem(env_id, [0]), sizes)
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
        optimal.make_grid(optimal.make_problem(TASKS["force"], [0]), sizes)


def test_extrapolating_backward_induction_changes_nothing(monkeypatch):
    problem = optimal.make_problem(TASKS["force"], [0])
    grid = optimal.make_grid(problem, (121, 101))
    tried = np.linspace(-1.0, 1.0, 11)
    taken = []
    stopped = optimal.value_iteration(problem, grid, tried, lambda steps, label: count(taken, steps, label))
    assert taken.count("backward induction") < problem.steps
    monkeypatch.setattr(optimal.grid, "SPAN", 0.0)
    full = optimal.value_iteration(problem, grid, tried)
    np.testing.assert_allclose(stopped.whole, full.whole, rtol=0.0, atol=5e-4)
    np.testing.assert_allclose(stopped.after_first, full.after_first, rtol=0.0, atol=5e-4)


def count(taken, steps, label):
    for step in steps:
        taken.append(label)
        yield step


def test_unknown_ids_have_no_reference(tmp_path):
    assert stored_returns("SDFriction/Elsewhere-v0", [1_000_000]) is None
    assert stored_returns(TASKS["belt"], [1_000_000], directory=tmp_path) is None
    assert stored_returns("sd_friction_env:SDFriction/Force-v0", [1_000_000]) is not None
    with pytest.raises(FileNotFoundError, match="no optimum"):
        optimal.optimal_actions("SDFriction/Elsewhere-v0")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["draws"][5].__setitem__(1, 0.3), "the parameters of the evaluation seeds"),
        (lambda f: f["configuration"]["task"]["randomise"].update(mu_m=[0.03, 0.2]), "task randomise"),
        (lambda f: f["starts"][7].__setitem__(0, 0.5), r"the starts .* --task belt --tier randomised"),
    ],
)
def test_randomised_reference_of_another_environment_is_refused(tmp_path, change, message):
    path = tmp_path / "belt-randomised.json"
    shutil.copy(optimal.OPTIMUM_DIRECTORY / path.name, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content["fingerprint"])
    write_unsealed(path, content)
    with pytest.raises(RuntimeError, match=message):
        stored_returns(RANDOMISED["belt"], [1_000_000], directory=tmp_path)


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
    write_unsealed(path, content)
    with pytest.raises(RuntimeError, match=message):
        stored_returns(TASKS["force"], [1_000_000], directory=tmp_path)


def test_saving_and_reading_keeps_returns_and_sequences(tmp_path):
    seeds = [3, 4]
    problem = optimal.make_problem(TASKS["belt"], seeds)
    actions = np.random.default_rng(4).uniform(-1.0, 1.0, (2, problem.steps))
    saved = optimal.save_optimum(problem, seeds, actions, {"command": "test"}, tmp_path)
    assert stored_returns(problem.env_id, [4, 3], directory=tmp_path).tolist() == saved[::-1].tolist()
    stored_seeds, stored = optimal.optimal_actions(problem.env_id, directory=tmp_path)
    assert stored_seeds == seeds
    np.testing.assert_allclose(stored, actions, atol=1.0 / optimal.ACTION_LEVELS)


def damaged_copies(path):
    """Yield the path with one damage after another done to its file: cut short, or a bit flipped."""
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    places = np.unique(
        np.concatenate([np.arange(0, 200), rng.integers(len(good), size=150), len(good) - np.arange(1, 400)])
    )
    for place in places.tolist():
        flipped = bytearray(good)
        flipped[place] ^= 1 << int(rng.integers(8))
        for content in (bytes(flipped), good[:place]):
            path.write_bytes(content)
            yield content
    path.write_bytes(good)


@pytest.fixture
def unchanging(monkeypatch):
    """Take every fingerprint for that of now: only what reading refuses is refused, and it is quick."""
    for module in (optimal.stored, optimal.policy):
        monkeypatch.setattr(module, "check_fingerprint", lambda *arguments: None)


def test_no_damage_to_a_value_function_comes_out_as_anything_but_a_policy_file_error(tmp_path, unchanging):
    problem = optimal.make_problem(TASKS["force"], [0])
    grid = optimal.make_grid(problem, (5, 5))
    path = optimal.save_value(problem, optimal.ValueFunction(grid, np.zeros(25), np.zeros(25)), tmp_path)
    refused = []
    for _ in damaged_copies(path):
        try:
            OptimalPolicy.load(TASKS["force"], tmp_path)
        except PolicyFileError as error:
            refused.append(str(error))
    assert len(refused) > 500
    assert all(repr(str(path)) in error for error in refused)
    OptimalPolicy.load(TASKS["force"], tmp_path)


@pytest.mark.parametrize("error", [EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error])
def test_whatever_reading_a_value_function_trips_over_names_the_file(monkeypatch, error):
    def trip(*arguments, **more):
        raise error("tripped")

    monkeypatch.setattr(zipfile.ZipFile, "open", trip)
    with pytest.raises(PolicyFileError, match=rf"belt-value\.npz.*{error.__name__}: tripped.*--task belt --policy`"):
        OptimalPolicy.load(TASKS["belt"])
    with pytest.raises(optimal.DamagedStudyError, match=rf"belt\.npz.*{error.__name__}: tripped"):
        optimal.optimal_actions(TASKS["belt"])


@pytest.mark.parametrize(
    "change",
    [
        {"lows": np.zeros(3)},
        {"highs": np.full(2, -9.0)},
        {"values": np.zeros((5, 5, 5))},
        {"values": np.full((5, 5), np.nan)},
        {"values": np.zeros((1, 5))},
        {"fingerprint": np.array("[]")},
    ],
)
def test_a_value_function_that_cannot_be_is_refused_by_name(tmp_path, unchanging, change):
    problem = optimal.make_problem(TASKS["force"], [0])
    grid = optimal.make_grid(problem, (5, 5))
    path = optimal.save_value(problem, optimal.ValueFunction(grid, np.zeros(25), np.zeros(25)), tmp_path)
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **content | change)
    with pytest.raises(PolicyFileError, match=r"force-value\.npz"):
        OptimalPolicy.load(TASKS["force"], tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.pop("returns"),
        lambda content: content["seeds"].pop(),
        lambda content: content.update(seeds=[], returns=[]),
        lambda content: content["returns"].__setitem__(3, float("nan")),
        lambda content: content["seeds"].__setitem__(3, 1.5),
        lambda content: content.update(fingerprint="4f2a"),
        lambda content: content.update(env_id=TASKS["belt"]),
    ],
)
def test_a_table_of_optima_that_cannot_be_is_refused_by_name(tmp_path, change):
    content = json.loads((optimal.OPTIMUM_DIRECTORY / "force.json").read_text(encoding="utf-8"))
    change(content)
    write_unsealed(tmp_path / "force.json", content)
    with pytest.raises(optimal.DamagedStudyError, match=r"force\.json.* or is damaged .*--task force`"):
        stored_returns(TASKS["force"], [1_000_000], directory=tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.update(fingerprint={}),
        lambda content: content["fingerprint"].update(configuration={}),
        lambda content: content["fingerprint"]["configuration"].pop("task"),
        lambda content: content["fingerprint"]["configuration"].update(parameters={}),
        lambda content: content["fingerprint"].update(golden=[]),
        lambda content: content["fingerprint"].update(golden=[[1.0], [1.0, 2.0]]),
        lambda content: content["fingerprint"].pop("starts"),
    ],
)
def test_a_fingerprint_that_lacks_something_is_that_of_another_environment(tmp_path, change):
    content = json.loads((optimal.OPTIMUM_DIRECTORY / "force.json").read_text(encoding="utf-8"))
    change(content)
    write_unsealed(tmp_path / "force.json", content)
    with pytest.raises(RuntimeError, match="was computed for another environment"):
        stored_returns(TASKS["force"], [1_000_000], directory=tmp_path)


# The policy that acts on a value function -----------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "least"), [(TASKS["force"], 0.999), (TASKS["belt"], 0.98)])
def test_policy_suppresses_and_comes_close_to_the_optimum(env_id, least):
    seeds = list(EVALUATION_SEEDS)[:8]
    table = evaluation.evaluate(OptimalPolicy.load(env_id), env_id, seeds)
    assert table["suppressed"].all()
    passive = np.nansum(evaluation.passive_episodes(env_id, seeds).reward, axis=1)
    assert least < scores.score(table["return"], passive, stored_returns(env_id, seeds)) < 1.0


@pytest.mark.parametrize(("env_id", "sizes"), [(TASKS["force"], (31, 31)), (TASKS["belt"], (21, 31, 5))])
def test_policy_read_from_its_file_acts_as_the_value_function_it_was_made_from(tmp_path, env_id, sizes):
    problem = optimal.make_problem(env_id, range(3))
    grid = optimal.make_grid(problem, sizes)
    value = optimal.value_iteration(problem, grid, np.linspace(-1.0, 1.0, 5))
    optimal.save_value(problem, value, tmp_path)
    policy = OptimalPolicy.load(env_id, tmp_path)
    expected = optimal.greedy_actions(problem, value)[:, 0]
    env = gym.make(env_id)
    seen = np.array([env.reset(seed=seed)[0] for seed in range(3)])
    batch, memory = policy.predict(seen)
    assert memory is None
    assert batch.dtype == np.float32
    np.testing.assert_allclose(batch[:, 0], expected, atol=0.02)  # observations and values are in single precision
    assert policy.predict(seen[1])[0].tolist() == batch[1].tolist()


def test_policy_acts_far_outside_its_grid_and_refuses_what_is_no_observation():
    for env_id, size in ((TASKS["force"], 2), (TASKS["belt"], 3)):
        policy = OptimalPolicy.load(env_id)
        corners = 10.0 * np.array(np.meshgrid(*[[-1.0, 1.0]] * size)).reshape(size, -1).T
        assert np.abs(policy.predict(corners)[0]).max() <= 1.0
        with pytest.raises(ValueError, match="finite"):
            policy.predict(np.full(size, np.nan))
        with pytest.raises(ValueError, match=f"at least {size} entries"):
            policy.predict(np.zeros(size - 1))


def test_value_functions_that_are_missing_damaged_or_of_another_environment_are_refused(tmp_path):
    for env_id in (SENSED["force"], RANDOMISED["belt"], "SDFriction/Elsewhere-v0"):
        with pytest.raises(FileNotFoundError, match="no value function is stored"):
            OptimalPolicy.load(env_id)
    with pytest.raises(FileNotFoundError, match="no value function is stored"):
        OptimalPolicy.load(TASKS["force"], tmp_path)
    path = tmp_path / "force-value.npz"
    with np.load(optimal.OPTIMUM_DIRECTORY / path.name) as archive:
        content = dict(archive)
    fingerprint = json.loads(str(content["fingerprint"]))
    fingerprint["configuration"]["parameters"]["beta"] = 0.06
    np.savez(path, **content | {"fingerprint": np.array(json.dumps(fingerprint))})
    with pytest.raises(RuntimeError, match=r"parameters beta: 0\.06 -> 0\.05"):
        OptimalPolicy.load(TASKS["force"], tmp_path)
    path.write_bytes(b"no archive")
    with pytest.raises(PolicyFileError, match="not a value function"):
        OptimalPolicy.load(TASKS["force"], tmp_path)
    problem = optimal.make_problem(RANDOMISED["force"], [0])
    grid = optimal.make_grid(problem, (5, 5))
    nothing = optimal.ValueFunction(grid, np.zeros(25), np.zeros(25))
    with pytest.raises(ValueError, match="env_id must be one of"):
        optimal.save_value(problem, nothing, tmp_path)


# The script -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "tier"), [("force", "nominal"), ("belt", "randomised")])
def test_show_prints_the_stored_study_and_computes_nothing(monkeypatch, capsys, task, tier):
    monkeypatch.setattr(optimal, "value_iteration", None)
    monkeypatch.setattr(optimal, "find_optimum", None)
    assert main(["optimum", "--task", task, "--tier", tier, "--show"]) == 0
    out = capsys.readouterr().out
    study = optimal.stored_study({"nominal": optimal.TASKS, "randomised": optimal.RANDOMISED}[tier][task])
    for grid, estimate in study["value_estimates"].items():
        row = next(line for line in out.splitlines() if line.split()[:1] == [grid])
        found = [f"{value:.4f}" for name, value in study["stages"].items() if name.endswith(f" {grid}, refined")]
        assert row.split()[1:3] == [f"{estimate:.4f}", f"{study['stages'][f'greedy {grid}']:.4f}"]
        assert row.split()[-1:] == (found or ["-"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--draws", "0"], "--draws must be in [1, 100], got 0"),
        (["--draws", "101"], "--draws must be in [1, 100], got 101"),
        (["--grid", "9x9x9"], "--grid of --task force must be 2 sizes in [3, 2000], got 9x9x9"),
        (["--grid", "9xnine"], "a grid is given as 121x101"),
        (["--beam", "-1"], "--beam must be in [0, 10000], got -1"),
        (["--policy", "--tier", "randomised"], "--policy is for --tier nominal"),
        (["--policy", "--show"], "--policy and --show exclude one another"),
        (["--policy", "--grid", "9x9", "--grid", "8x8"], "--policy takes one --grid, got 2"),
    ],
)
def test_wrong_arguments_are_one_line(capsys, arguments, message):
    assert main(["optimum", "--task", "force", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_stopping_stores_nothing_and_says_so(monkeypatch, tmp_path, capsys):
    def stop(*arguments, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(optimal.study, "best_of", stop)
    small = ["--task", "force", "--draws", "1", "--grid", "9x9", "--beam", "0", "--rounds", "0"]
    assert main(["optimum", *small, "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err.endswith("sd-friction optimum: interrupted; nothing was stored\n")
    assert not list(tmp_path.iterdir())


def test_nothing_stored_is_one_line(tmp_path, capsys):
    assert main(["optimum", "--task", "force", "--show", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("sd-friction optimum: no optimum is stored for 'SDFriction/Force-v0'")


def test_randomised_run_stores_what_can_be_read_again(tmp_path, capsys):
    small = [
        "--task",
        "force",
        "--tier",
        "randomised",
        "--draws",
        "2",
        "--grid",
        "31x31",
        "--beam",
        "0",
        "--rounds",
        "0",
    ]
    assert main(["optimum", *small, "--out", str(tmp_path)]) == 0
    seeds, actions = optimal.optimal_actions(RANDOMISED["force"], tmp_path)
    assert seeds == [1_000_000, 1_000_001]
    returns = stored_returns(RANDOMISED["force"], seeds, tmp_path)
    best = stored_returns(RANDOMISED["force"], seeds)
    np.testing.assert_allclose(returns, best, rtol=0.02)  # even so small a grid
    problem = optimal.make_problem(RANDOMISED["force"], seeds)
    assert problem.returns(actions.astype(np.float64)).tolist() == returns.tolist()


def test_stored_files_are_small():
    for path in optimal.OPTIMUM_DIRECTORY.iterdir():
        assert path.stat().st_size < (1_000_000 if path.name.endswith("-value.npz") else 200_000), path.name


def test_fingerprint_ignores_what_a_controller_sees():
    assert isinstance(gym.make(TASKS["force"], observation_limit=5.0).unwrapped, SDFrictionEnv)
    assert "observation_limit" not in optimal.fingerprint(TASKS["force"], [1])["configuration"]["task"]
