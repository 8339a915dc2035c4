"""Sweeps in chunks: the same bits whoever computes them, and nothing finished is ever lost."""

import contextlib
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, amplitude_curve, attractor_curves, basin_grid
from sd_friction_env.cli import main as cli
from sd_friction_env.physics.sweeps import Engine, SweepError, amplitude_sweep, basin_sweep, run_chunks

TWO_WELLS = OscillatorParameters(alpha=0.2)
GRID = ((-1.5, 1.5), (-1.0, 1.0), (60, 40))
PATIENCE = 120.0
HERE = str(Path(__file__).parent)


def double(chunk):
    return {"doubled": 2.0 * np.array(chunk)}


def refuse(chunk):
    raise ArithmeticError(f"no {chunk}")


def mark_and_wait(chunk):
    """Say which process has begun a chunk, and end when told to."""
    folder, number = Path(chunk[0]), chunk[1]
    (folder / f"begun-{number}-{os.getpid()}").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
    return {"number": np.array([number])}


def until(condition, what):
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, what
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def dask_cluster(tmp_path):
    """A Dask scheduler and two worker processes on this machine: the address, and the workers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    python = [sys.executable, "-m", "distributed.cli"]
    environment = os.environ | {"PYTHONPATH": HERE, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "60s"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment, "cwd": tmp_path}
    with contextlib.ExitStack() as stack:

        def start(*arguments):
            process = stack.enter_context(subprocess.Popen([*python[:2], *arguments], **quiet))
            stack.callback(process.kill)
            return process

        start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        worker = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        workers = [start(*worker, "--name", name) for name in "ab"]
        import distributed

        with distributed.Client(address, timeout=PATIENCE, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=PATIENCE)
        yield address, workers


# The same bits --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected():
    return basin_grid(TWO_WELLS, *GRID)


def same_basins(result, expected):
    (x, v, found), (x_expected, v_expected, basins) = result, expected
    assert np.array_equal(x, x_expected)
    assert np.array_equal(v, v_expected)
    assert np.array_equal(found.labels, basins.labels)
    assert found.attractors == basins.attractors
    return True


@pytest.mark.parametrize("chunk", [60, 500, 10**6])
def test_basins_do_not_depend_on_the_chunks(chunk, expected):
    assert len(np.unique(expected[2].labels)) > 1
    assert same_basins(basin_sweep(TWO_WELLS, *GRID, Engine(), chunk=chunk), expected)


@pytest.mark.parametrize("workers", [1, 2])
def test_basins_from_processes_are_the_same_bits(workers, expected):
    assert same_basins(basin_sweep(TWO_WELLS, *GRID, Engine(backend="loky", workers=workers), chunk=500), expected)


@pytest.mark.slow
def test_basins_from_ray_are_the_same_bits(expected):
    pytest.importorskip("ray")
    program = (
        "import sys, numpy as np\n"
        "from sd_friction_env import OscillatorParameters\n"
        "from sd_friction_env.physics.sweeps import Engine, basin_sweep\n"
        "engine = Engine(backend='ray', workers=2)\n"
        f"found = basin_sweep(OscillatorParameters(alpha=0.2), *{GRID!r}, engine, chunk=500)\n"
        "sys.stdout.write(found[2].labels.tobytes().hex())\n"
    )
    # Ray starts services and leaves warnings: in a process of its own.
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode == 0, run.stderr
    labels = np.frombuffer(bytes.fromhex(run.stdout[-2 * expected[2].labels.size :]), np.int8)
    assert np.array_equal(labels.reshape(expected[2].labels.shape), expected[2].labels)


@pytest.mark.parametrize("all_attractors", [False, True])
def test_amplitude_curves_are_those_of_a_loop(all_attractors):
    plants = [OscillatorParameters(alpha=alpha) for alpha in (0.2, 0.8)]
    speeds = np.linspace(0.02, 0.5, 13)
    engine = Engine(backend="loky", workers=2)
    tables = amplitude_sweep(plants, speeds, engine, all_attractors=all_attractors, chunk=4)
    for plant, table in zip(plants, tables, strict=True):
        wanted = attractor_curves(plant, speeds) if all_attractors else amplitude_curve(plant, speeds)
        assert table.metadata == wanted.metadata
        assert list(table) == list(wanted)
        for name, values in wanted.items():
            equal = values.dtype.kind == "f"
            assert np.array_equal(table[name], values, equal_nan=equal), name


# Nothing is lost ------------------------------------------------------------------------------------------------------


def finished(folder):
    return sorted(int(path.name.split("-")[1]) for path in folder.glob("chunk-*.npz"))


def test_only_what_is_missing_or_damaged_is_computed_again(tmp_path):
    folder = tmp_path / "kept"
    chunks = [[1.0], [2.0], [3.0], [4.0]]
    computed = []

    def counted(chunk):
        computed.append(chunk[0])
        return double(chunk)

    def sweep():
        computed.clear()
        results = run_chunks(counted, chunks, Engine(folder=folder), description={"what": "doubles"})
        assert [result["doubled"].tolist() for result in results] == [[2.0], [4.0], [6.0], [8.0]]
        return list(computed)

    assert sweep() == [1.0, 2.0, 3.0, 4.0]
    assert sweep() == []
    second, third = sorted(folder.glob("chunk-*.npz"))[1:3]
    second.unlink()
    third.write_bytes(third.read_bytes()[:-7])
    assert sweep() == [2.0, 3.0]
    assert finished(folder) == [0, 1, 2, 3]


def test_a_folder_of_another_sweep_is_refused_and_left_alone(tmp_path):
    engine = Engine(folder=tmp_path / "kept")
    run_chunks(double, [[1.0]], engine, description={"what": "doubles", "size": 1})
    before = {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir()}
    for description, chunks, named in (
        ({"what": "doubles", "size": 2}, [[1.0]], "its size is 1, not 2"),
        ({"what": "doubles", "size": 1}, [[1.0], [2.0]], "its chunks is 1, not 2"),
    ):
        with pytest.raises(SweepError, match=named):
            run_chunks(double, chunks, engine, description=description)
    assert {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir()} == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(SweepError, match="holds other files"):
        run_chunks(double, [[1.0]], Engine(folder=tmp_path / "other"), description={})


@pytest.mark.parametrize("backend", ["sequential", "loky"])
def test_what_a_chunk_raises_comes_out_as_it_is(backend):
    with pytest.raises(ArithmeticError, match="no 7"):
        run_chunks(refuse, [7], Engine(backend=backend), description={})


def sweep_in_a_thread(engine, folder, count):
    import threading

    results = []
    chunks = [(str(folder), number) for number in range(count)]
    thread = threading.Thread(
        target=lambda: results.extend(run_chunks(mark_and_wait, chunks, engine, description={"what": "waits"}))
    )
    thread.start()
    return thread, results


def begun(folder):
    return [path.name.split("-") for path in folder.glob("begun-*")]


def end_of(thread, folder, results, count):
    (folder / "go").touch()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert [result["number"].item() for result in results] == list(range(count))


def test_a_process_killed_in_mid_run_loses_nothing(tmp_path):
    kept = tmp_path / "kept"
    thread, results = sweep_in_a_thread(Engine(backend="loky", workers=2, folder=kept), tmp_path, 5)
    first = until(lambda: len(begun(tmp_path)) == 2 and begun(tmp_path), "two workers have begun")
    os.kill(int(first[0][2]), signal.SIGKILL)
    end_of(thread, tmp_path, results, 5)
    assert finished(kept) == [0, 1, 2, 3, 4]
    processes = {number: {pid for _, n, pid in begun(tmp_path) if n == number} for number in "01234"}
    assert len(processes[first[0][1]]) > 1  # what was killed was begun again by another


def test_a_dask_worker_killed_in_mid_run_loses_nothing(tmp_path, expected):
    with dask_cluster(tmp_path) as (address, workers):
        engine = Engine(backend="dask", address=address)
        assert same_basins(basin_sweep(TWO_WELLS, *GRID, engine, chunk=500), expected)
        thread, results = sweep_in_a_thread(engine, tmp_path, 4)
        pids = until(
            lambda: len({pid for *_, pid in begun(tmp_path)}) == 2 and {int(pid) for *_, pid in begun(tmp_path)},
            "both workers have begun",
        )
        assert pids == {worker.pid for worker in workers}
        workers[0].kill()
        end_of(thread, tmp_path, results, 4)


def test_the_program_is_interrupted_and_goes_on(tmp_path):
    folder, out = tmp_path / "kept", tmp_path / "curve.csv"
    arguments = ["amplitude", "--alpha", "0.2:1:0.01", "--belt-speed", "0.01:0.6:0.01", "--folder", str(folder)]
    command = [sys.executable, "-m", "sd_friction_env", *arguments, "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as program:
        until(lambda: len(finished(folder)) >= 3 if folder.is_dir() else False, "three chunks are finished")
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=PATIENCE)
    assert program.returncode == 130
    assert "goes on" in said
    assert not out.exists()
    before = finished(folder)
    manifest = json.loads((folder / "sweep.json").read_text())
    assert 3 <= len(before) < manifest["chunks"]
    times = {path.name: path.stat().st_mtime_ns for path in folder.glob("chunk-*.npz")}
    assert cli.main([*arguments, "--backend", "loky", "--workers", "2", "--out", str(out)]) == 0
    assert len(finished(folder)) == manifest["chunks"]
    assert all((folder / name).stat().st_mtime_ns == time for name, time in times.items())
    assert cli.main([*arguments[:5], "--out", str(tmp_path / "whole.csv")]) == 0
    rows, whole = (path.read_text().splitlines() for path in (out, tmp_path / "whole.csv"))
    assert [row for row in rows if row[0] != "#"] == [row for row in whole if row[0] != "#"]


# Two at once, and what is left behind --------------------------------------------------------------------------------


def test_chunks_of_another_sweep_or_another_place_are_computed_again(tmp_path):
    chunks = [[1.0], [2.0], [3.0]]
    run_chunks(double, chunks, Engine(folder=tmp_path / "a"), description={"what": "doubles"})
    run_chunks(double, [[7.0], [8.0], [9.0]], Engine(folder=tmp_path / "b"), description={"what": "others"})
    first, second, third = sorted((tmp_path / "a").glob("chunk-*.npz"))
    data = first.read_bytes()
    first.unlink()
    shutil.copy(next((tmp_path / "b").glob("chunk-000000-*")), tmp_path / "a")  # another sweep's
    second.unlink()
    (tmp_path / "a" / f"chunk-000001-{hashlib.sha256(data).hexdigest()}.npz").write_bytes(data)  # that of another place
    (tmp_path / "a" / f"chunk-000009-{hashlib.sha256(data).hexdigest()}.npz").write_bytes(data)  # of none
    found = run_chunks(double, chunks, Engine(folder=tmp_path / "a"), description={"what": "doubles"})
    assert [part["doubled"].tolist() for part in found] == [[2.0], [4.0], [6.0]]
    assert [list(part) for part in found] == [["doubled"]] * 3
    assert finished(tmp_path / "a") == [0, 1, 2]


@pytest.mark.parametrize("content", [b"", b"[]", b"[" * 10**5, b"\xff", b'{"chunks": 1, "chunks": 2}'])
def test_a_damaged_manifest_is_named_and_nothing_is_removed(content, tmp_path):
    run_chunks(double, [[1.0]], Engine(folder=tmp_path), description={})
    (tmp_path / "sweep.json").write_bytes(content)
    with pytest.raises(SweepError, match=r"sweep\.json' is damaged.*remove the folder"):
        run_chunks(double, [[1.0]], Engine(folder=tmp_path), description={})
    assert finished(tmp_path) == [0]


def test_a_sweep_killed_while_it_wrote_its_manifest_begins_anew(tmp_path):
    (tmp_path / ".sweep.json.4711.partial").write_text("{")
    (tmp_path / ".sweep.lock").touch()
    run_chunks(double, [[1.0]], Engine(folder=tmp_path), description={})
    assert finished(tmp_path) == [0]


def test_a_second_sweep_in_a_folder_is_refused_by_the_name_of_the_first(tmp_path):
    kept = tmp_path / "kept"
    thread, results = sweep_in_a_thread(Engine(folder=kept), tmp_path, 1)
    until(lambda: begun(tmp_path), "the first has begun")
    with pytest.raises(SweepError, match=rf"kept' is in use by process {os.getpid()} on .* since "):
        run_chunks(double, [[1.0]], Engine(folder=kept), description={"what": "waits"})
    end_of(thread, tmp_path, results, 1)
    assert sorted(path.name.split("-")[0] for path in kept.iterdir()) == ["chunk", "sweep.json"]


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")  # a process that has ended and that nobody has asked about is not running
    return not (stat.exists() and stat.read_text().rpartition(")")[2].split()[0] == "Z")


@pytest.mark.skipif(os.name != "posix", reason="needs processes that can be killed")
def test_workers_end_when_their_parent_is_killed(tmp_path):
    program = (
        "import sys\n"
        "from test_sweeps import Engine, mark_and_wait, run_chunks\n"
        "chunks = [(sys.argv[1], number) for number in range(4)]\n"
        "run_chunks(mark_and_wait, chunks, Engine(backend='loky', workers=2), description={})\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([HERE, str(Path(HERE).parent)])}
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], env=environment) as parent:
        pids = until(lambda: len(begun(tmp_path)) == 2 and [int(pid) for *_, pid in begun(tmp_path)], "two have begun")
        assert all(is_running(pid) for pid in pids)
        parent.kill()
    until(lambda: not any(is_running(pid) for pid in pids), "the workers have ended")


# Kills each process that a Dask cluster starts at once, and prints what the sweep says.
STILLBORN = """
import os, pathlib, signal, sys, threading, time
from test_sweeps import Engine, SweepError, double, run_chunks

def kill():
    while True:
        for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(stat.read_text().rpartition(")")[2].split()[1])
                if parent == os.getpid() and b"spawn_main" in (stat.parent / "cmdline").read_bytes():
                    os.kill(int(stat.parent.name), signal.SIGKILL)
            except OSError:
                pass
        time.sleep(0.005)

if __name__ == "__main__":
    threading.Thread(target=kill, daemon=True).start()
    try:
        run_chunks(double, [[1.0]], Engine(backend="dask", workers=2), description={})
    except SweepError as error:
        print(error)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to find the workers as they start")
def test_dask_workers_killed_while_they_start_are_one_clear_error(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "stillborn.py").write_text(STILLBORN)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([HERE, str(Path(HERE).parent)])}
    words = [sys.executable, str(tmp_path / "stillborn.py")]
    run = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False, env=environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("a Dask cluster on this machine could not be started: ")


# What cannot be -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "named"),
    [
        (
            {"backend": "threads"},
            ValueError,
            "backend must be one of 'sequential', 'loky', 'dask', 'ray', got 'threads'",
        ),
        ({"workers": 0}, ValueError, r"workers must be .*\[1, 10000\], got 0"),
        ({"workers": 1.5}, ValueError, r"workers must be a whole number in \[1, 10000\], got 1.5"),
        ({"workers": "2"}, TypeError, "workers must be a real number"),
        ({"address": "tcp://x:1"}, ValueError, "address goes with the backends 'dask' and 'ray', got 'tcp://x:1'"),
    ],
)
def test_an_engine_that_cannot_be_is_refused(arguments, error, named):
    with pytest.raises(error, match=named):
        Engine(**arguments)


def test_a_missing_backend_is_told_with_its_mend(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r'needs distributed: pip install "sd-friction-env\[dask\]"'):
        Engine(backend="dask")


def test_nothing_is_written_for_a_sweep_that_cannot_be(tmp_path, capsys):
    folder = tmp_path / "kept"
    with pytest.raises(ValueError, match="chunk must be"):
        basin_sweep(TWO_WELLS, *GRID, Engine(folder=folder), chunk=0)
    with pytest.raises(ValueError, match="without excitation"):
        basin_sweep(TWO_WELLS.replace(force_amplitude=0.1), *GRID, Engine(folder=folder))
    with pytest.raises(ValueError, match="v_limits must have low < high"):
        basin_sweep(TWO_WELLS, (-1.0, 1.0), (1.0, -1.0), (5, 5), Engine(folder=folder))
    assert cli.main(["basins", "--workers", "0", "--folder", str(folder)]) == 2
    assert "workers must be" in capsys.readouterr().err
    assert not folder.exists()


def test_workers_that_are_lost_again_and_again_are_given_up(monkeypatch):
    class LostError(Exception):
        pass

    def lose(function, numbered):
        raise LostError("killed")
        yield

    monkeypatch.setattr("sd_friction_env.physics.chunks._worker_losses", lambda backend: (LostError,))
    monkeypatch.setattr("sd_friction_env.physics.chunks._workers", lambda engine: contextlib.nullcontext(lose))
    with pytest.raises(SweepError, match=r"lost 3 times with no chunk finished between; the last time: killed"):
        run_chunks(double, [[1.0]], Engine(), description={})
