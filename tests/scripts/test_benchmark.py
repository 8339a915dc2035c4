"""The benchmark's bookkeeping: what it counts, compares, writes and refuses. No test looks at a time."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import sd_friction_env
from scripts.benchmark import __main__ as benchmark
from scripts.benchmark import arithmetic, batches, measuring, peers
from scripts.benchmark.measuring import Bench, Check, Contender, Row, Target
from scripts.benchmark.with_scipy import WithSciPy

ROOT = Path(__file__).resolve().parents[2]
SHORT = ("--rounds", "2", "--steps", "20")


def run(*arguments):
    return benchmark.main([str(argument) for argument in arguments])


def row(*values, ours=False):
    return Row("steps/s", ours, "", [float(value) for value in values])


def short_bench(rounds=2):
    return Bench(quick=True, rounds=rounds, steps=20, peers=None)


def test_a_run_prints_its_tables_and_writes_its_numbers_and_its_picture(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    out, plot = tmp_path / "result.json", tmp_path / "result.png"
    assert run("--only", "single", *SHORT, "--out", out, "--plot", plot) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert set(result) == {"machine", "settings", "rows", "numbers", "checks", "targets", "skipped"}
    assert {"cpu", "cores", "python", "numpy", "numba", "gymnasium"} <= set(result["machine"])
    assert result["settings"] == {"quick": False, "rounds": 2, "steps": 20, "interrupted": False}
    measured = result["rows"]["single"]
    assert set(measured) == {"CartPole-v1", "Pendulum-v1", *sd_friction_env.ENVIRONMENT_IDS}
    for each in measured.values():
        assert len(each["values"]) == 2
        assert min(each["values"]) <= each["quartiles"][0] <= each["median"] <= each["quartiles"][1]
    reached = {target["what"]: target for target in result["targets"]}
    assert len(reached) == 8
    assert [what for what, target in reached.items() if target["met"] is not None] == [
        "one environment, CartPole-v1's speed times"
    ]
    assert plot.read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr()
    assert "* SDFriction/Force-v0 " in printed.out
    assert printed.out.count("not measured") == 7
    assert "single: One environment" in printed.err


@pytest.mark.parametrize(
    ("target", "met"),
    [
        (Target("speed", 2.0, 2.0), True),
        (Target("speed", 1.99, 2.0), False),
        (Target("speed", None, 2.0), None),
        (Target("speed", float("nan"), 2.0), None),
        (Target("size", 0.99, 1.0, at_least=False), True),
        (Target("size", 1.0, 1.0, at_least=False), False),
        (Target("size", None, 1.0, at_least=False), None),
    ],
)
def test_a_target_is_met_missed_or_unknown(target, met):
    assert target.met is met


def test_a_ratio_is_the_median_of_the_rounds_ratios():
    # The second round was slow for both: ratios 2, 2, 3. The ratio of the medians would be 20/10 too, of the means not.
    assert measuring.ratio_of(row(20, 2, 30), row(10, 1, 10)) == 2.0


def test_our_best_variant_is_compared_with_the_fastest_of_the_others():
    rows = {"1 thread": row(30, 30), "2 threads": row(40, 40), "slow": row(1, 1), "fast": row(10, 20)}
    assert measuring.best_ratio(rows, ["1 thread", "2 threads"], ["slow", "fast"]) == 3.0
    assert measuring.best_ratio(rows, ["1 thread"], ["absent"]) is None
    assert measuring.best_ratio(rows, ["absent"], ["slow"]) is None


def test_the_targets_are_read_from_the_rows_that_the_sections_measure():
    force = batches.FORCE
    threads = [batches.our_label(force, n, k) for n in (1024, 8192) for k in (1, 2)]
    rows = {
        "single": {force: row(210), "CartPole-v1": row(100)},
        "batch": {
            **{label: row(160) for label in threads},
            "CartPole-v1, 1,024": row(100),
            "CartPole-v1, 8,192": row(100),
        },
        "peers": {**{label: row(30) for label in threads}, **{label: row(1) for label in peers.PEERS}},
        "ppo": {
            f"PPO, SDFrictionVecEnv of 256 {force}": row(95),
            "PPO, 256 environments that cost nothing": row(100),
        },
    }
    numbers = {"kernel": {"share of the limit, slip only": 0.4}, "memory": {"bytes per environment": 512.0}}
    every = benchmark.targets(rows, numbers)
    assert [target.reached for target in every] == [2.1, 1.6, 1.6, 30.0, 30.0, 0.4, 0.95, 0.5]
    assert [target.met for target in every] == [True, True, False, True, True, False, True, True]


def test_every_name_that_a_target_reads_is_one_that_is_measured(capsys):
    bench = short_bench(rounds=1)
    for section in ("single", "batch", "memory"):
        benchmark.SECTIONS[section](bench)
    reached = [target.reached for target in benchmark.targets(bench.rows, bench.numbers)]
    assert [value is not None for value in reached] == [True, True, True, False, False, False, False, True]
    labels = set(bench.rows["batch"])
    for n in batches.SIZES:
        assert {f"CartPole-v1, {n:,}", *(batches.our_label(batches.BELT, n, k) for k in (1, 2))} <= labels
    assert batches.our_label(batches.FORCE, 8192, 1, staggered=True) in labels


def test_contenders_take_turns_and_a_first_slice_does_not_count(capsys):
    order = []

    def timed(name):
        def one():
            order.append(name)
            return float(len(order))

        return one

    bench = short_bench()
    rows = bench.measure("trial", "Trial", [Contender(name, timed(name)) for name in "ab"], "a")
    assert "".join(order) == "ab" + "ab" + "ba"
    assert (rows["a"].values, rows["b"].values) == ([3.0, 6.0], [4.0, 5.0])
    assert "x a" in capsys.readouterr().out


def test_what_was_measured_before_an_interruption_is_printed_and_written(tmp_path, capsys, monkeypatch):
    calls = []

    def interrupted():
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return 7.0

    def section(bench):
        """Trial."""
        bench.measure("single", "Trial", [Contender("seven", interrupted)])

    monkeypatch.setitem(benchmark.SECTIONS, "single", section)
    out = tmp_path / "result.json"
    assert run("--only", "single", "--rounds", 5, "--out", out) == 130
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["settings"]["interrupted"]
    assert result["rows"]["single"]["seven"]["values"] == [7.0]
    assert "seven" in capsys.readouterr().out


def test_ctrl_c_ends_a_real_run_cleanly(tmp_path):
    if os.name == "nt":
        pytest.skip("Windows has other signals")
    out = tmp_path / "result.json"
    command = [
        sys.executable,
        str(ROOT / "scripts/benchmark"),
        "--only",
        "single",
        "--rounds",
        "10000",
        "--steps",
        "9",
    ]
    with subprocess.Popen(
        [*command, "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        assert process.stderr is not None
        assert "single" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        printed, complaints = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in complaints
    assert "Targets" in printed
    assert json.loads(out.read_text(encoding="utf-8"))["settings"]["interrupted"]


# The work -------------------------------------------------------------------------------------------------------------


def test_the_work_checks_pass_and_count_what_single_environments_count(capsys):
    bench = short_bench()
    batches.work(bench)
    assert [check.met for check in bench.checks] == [True, True]
    single = gym.make(batches.FORCE)
    space = gym.make_vec(batches.FORCE, num_envs=8).action_space
    space.seed(0)
    actions = [space.sample() for _ in range(16)]
    events = stick = 0.0
    for i in range(8):
        single.reset(seed=i)
        for k in range(100):
            info = single.step(actions[k % 16][i])[4]
            events += info["events"] / 800
            stick += info["stick_fraction"] / 800
    seen = batches.watched(batches.FORCE, 8, 100, batches.WAYS["as it is"])
    assert (seen.events, seen.stick) == pytest.approx((events, stick))
    assert seen.events > 0.0


def test_a_failed_check_of_the_work_makes_the_exit_status_1(monkeypatch, capsys):
    monkeypatch.setattr(batches, "amplitude_gap", lambda env_id: 1e-3 if env_id == batches.BELT else 0.0)
    assert run("--only", "work", *SHORT) == 1
    assert "FAILED: SDFriction/BeltSpeed-v0: gap of the settled amplitude" in capsys.readouterr().err
    assert not Check("nan", float("nan"), 1.0).met


@pytest.mark.parametrize("name", ["slip only", "slip only, random force"])
def test_what_is_called_slip_only_meets_no_event_and_never_sticks(name):
    seen = batches.watched(batches.FORCE, 64, batches.EPISODE, batches.WAYS[name])
    assert (seen.events, seen.stick) == (0.0, 0.0)
    assert seen.turns > 0.0


def test_scipys_stepper_goes_where_the_environment_goes_through_slip_and_stick():
    env = gym.make(batches.FORCE)
    info = env.reset(seed=3)[1]
    inner = env.unwrapped
    stepper = WithSciPy(inner.nominal, info["x"], info["v"])
    modes = set()
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, 200):
        info = env.step(np.array([action]))[4]
        stepper.step(inner.task.force_limit * action, inner.task.control_interval)
        assert stepper.x == pytest.approx(info["x"], abs=1e-7)
        modes.add(info["mode"])
    assert len(modes) > 1


# The arithmetic limit -------------------------------------------------------------------------------------------------


def test_an_operation_counts_once_however_often_it_is_written():
    def law(a, b):
        first = 2.0 * (a * b) + (b * a) / b
        return -first - (1.0 - (a * a + 3).sqrt()) / b

    counted = arithmetic.count_operations(law, 2)
    assert counted == {"multiply": 3, "add": 4, "divide": 2, "square root": 1}  # a b is b a
    # A sum grouped otherwise is another sum: rounding forbids to reuse it.
    regrouped = arithmetic.count_operations(lambda a, b: (a + b + 1.0) * (a + (b + 1.0)), 2)
    assert regrouped == {"add": 4, "multiply": 1}


def test_a_slip_step_has_twelve_stages_and_one_error_estimate():
    counts = arithmetic.kernel_operations()
    # Each stage takes a square root and a division by it (Eq. 4), the estimate one more of both.
    assert counts["square root"] == counts["divide"] == 13
    assert counts["add"] + counts["multiply"] == 624


def test_the_limit_is_the_sum_over_kinds_of_operations_by_rate():
    rates = {"add and multiply": 50.0, "square root": 2.0, "divide": 4.0}
    operations = {"add": 200, "multiply": 300, "square root": 10, "divide": 12}
    assert arithmetic.limit_of(operations, rates) == 10.0 + 5.0 + 3.0


# Peers, and what is refused -------------------------------------------------------------------------------------------


def test_absent_peers_are_skipped_with_a_word(tmp_path, capsys, monkeypatch):
    for name in ("envpool", "gymnax"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('no {name} here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    out = tmp_path / "result.json"
    assert run("--only", "peers", *SHORT, "--peers", sys.executable, "--out", out) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert set(result["skipped"]) == {f"peers: {label}" for label in peers.PEERS}
    assert "no envpool here" in result["skipped"]["peers: EnvPool Pendulum-v1, 1,024, 1 thread"]
    assert "benchmark-peers" in capsys.readouterr().out


def test_a_peer_is_asked_for_one_slice_at_a_time(tmp_path, monkeypatch):
    (tmp_path / "envpool.py").write_text(
        "class Env:\n    def reset(self): print('noise')\n    def step(self, actions): assert actions.shape == (5, 1)\n"
        "def make(name, kind, num_envs, num_threads):\n    return Env()\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    peer = peers.Peer(Path(sys.executable), "envpool", 5, 1)
    measure = peer.slice(10)
    assert measure() > 0.0
    assert measure() > 0.0
    peer.close()


def test_a_peer_that_breaks_is_told_with_its_last_word(tmp_path, monkeypatch):
    (tmp_path / "envpool.py").write_text("raise RuntimeError('no such core')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(peers.PeerError, match="RuntimeError: no such core"):
        peers.Peer(Path(sys.executable), "envpool", 5, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nonsense"], "invalid choice: 'nonsense'"),
        (["--out", "nowhere/result.json"], "--out 'nowhere/result.json' lies in no existing folder"),
        (["--plot", "nowhere/result.png"], "--plot 'nowhere/result.png' lies in no existing folder"),
        (["--out", "."], "--out '.' is a folder"),
        (["--plot", "result.gif"], r"--plot must end in .png, .svg or .pdf, got 'result.gif'"),
        (["--peers", "nowhere/python"], "--peers must be a Python 3 interpreter"),
        (["--rounds", "0"], "--rounds must be a whole number of at least 1, got 0"),
        (["--steps", "-3"], "--steps must be a whole number of at least 1, got -3"),
    ],
)
def test_bad_arguments_are_refused_before_anything_runs(arguments, message, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "machine", lambda: pytest.fail("it ran"))
    with pytest.raises(SystemExit, match="2"):
        run(*arguments)
    assert message.replace("nowhere/", f"nowhere{os.sep}") in capsys.readouterr().err


def test_a_busy_machine_is_told(capsys):
    benchmark.print_machine({"cpu": "any", "load": 1.25})
    assert "WARNING: the machine is busy (load 1.25)" in capsys.readouterr().out
    benchmark.print_machine({"cpu": "any", "load": 0.1})
    assert "WARNING" not in capsys.readouterr().out
