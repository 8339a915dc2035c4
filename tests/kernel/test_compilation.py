"""Compiled code: kept, checked before it is believed, and told about only when something is compiled."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import sd_friction_env
from sd_friction_env import OscillatorParameters, kernel, limit_cycle
from sd_friction_env.kernel import compilation
from sd_friction_env.storage import AGENTS

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")

PACKAGE = Path(sd_friction_env.__file__).parent
NOWHERE = "/dev/null/nowhere"  # below a file nobody can make a folder, not even root
SOURCE = """
from sd_friction_env.kernel.compilation import entry

@entry
def add(x):
    return x + 1

@entry
def twice(x):
    return 2 * add(x)
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Return a module with two compiled functions, not yet compiled, whose cache is beside it."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(compilation, "_said", set())
    (tmp_path / "tiny.py").write_text(SOURCE)
    return loaded(tmp_path / "tiny.py")


def loaded(path):
    specification = importlib.util.spec_from_file_location(path.stem, path)
    made = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(made)
    sys.modules[path.stem] = made  # numba pickles by name
    return made


def again(module):
    """Return the module's functions as another process has them: nothing of them is compiled."""
    return loaded(Path(module.__file__))


def files(module, ending):
    return sorted(Path(module.twice.stats.cache_path).glob(f"tiny.*.{ending}"))


def hits(function):
    return sum(function.stats.cache_hits.values()), sum(function.stats.cache_misses.values())


def test_what_is_compiled_is_kept_and_loaded(module):
    assert module.twice(3) == 8
    assert hits(module.twice) == (0, 1)
    other = again(module)
    assert other.twice(3) == 8
    assert hits(other.twice) == (1, 0)
    assert len(files(module, "nbi")) == len(files(module, "nbc")) == 2


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_costs_a_compilation_and_a_line_that_names_it(module, ending, capsys, monkeypatch):
    assert module.twice(3) == 8
    (file,) = (file for file in files(module, ending) if "twice" in file.name)
    whole = file.read_bytes()
    places = range(0, len(whole), max(1, len(whole) // 40))
    flipped = [whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in places]
    for damaged in (*flipped, b"", whole[:1], whole[:-1], whole[: len(whole) // 2], whole + b"x", b"\0" * len(whole)):
        file.write_bytes(damaged)
        monkeypatch.setattr(compilation, "_said", set())
        other = again(module)
        assert other.twice(3) == 8
        assert hits(other.twice) == (0, 1)
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert f"{str(file)!r} of compiled code is damaged: compiled anew" in error
        mended = again(module)
        assert mended.twice(3) == 8
        assert hits(mended.twice) == (1, 0)
        assert capsys.readouterr().err == ""


def test_what_cannot_be_read_or_written_is_no_obstacle(module, capsys):
    assert module.twice(3) == 8
    for file in (*files(module, "nbi"), *files(module, "nbc")):
        file.unlink()
        file.mkdir()
    other = again(module)
    assert other.twice(3) == 8
    first, second = capsys.readouterr().err.splitlines()
    assert "compiled anew" in first
    assert "cannot be kept" in second
    shutil.rmtree(Path(module.twice.stats.cache_path))
    Path(module.twice.stats.cache_path).write_text("a file in the folder's place")
    assert module.twice(3.5) == 9.0  # for a type it is not compiled for yet


def test_a_file_of_another_signature_function_or_source_is_not_taken_for_it(module):
    """As two processes leave it that compile at once, and one that was ended between its two files."""
    assert module.twice(3) == 8
    assert module.twice(3.5) == 9.0
    one, other = (file for file in files(module, "nbc") if "twice" in file.name)
    adding = next(file for file in files(module, "nbc") if "add" in file.name)
    code_of_one = one.read_bytes()
    for wrong in (other.read_bytes(), adding.read_bytes()):
        one.write_bytes(wrong)
        third = again(module)
        assert (third.twice(3), third.twice(3.5)) == (8, 9.0)
        assert hits(third.twice) == (1, 1)
        assert hits(again(module).twice) == (0, 0)
    Path(module.__file__).write_text(SOURCE.replace("x + 1", "x + 2"))
    changed = again(module)
    assert changed.twice(3) == 10
    one.write_bytes(code_of_one)  # its index is of the new source
    assert again(module).twice(3) == 10


def test_an_edit_in_the_kernel_renews_the_code(module, monkeypatch):
    assert module.twice(3) == 8
    monkeypatch.setattr(compilation, "_SOURCES", b"an edited file")
    other = again(module)
    assert other.twice(3) == 8
    assert hits(other.twice) == (0, 1)


def test_only_what_is_compiled_is_announced_once_and_with_the_seconds(module, capsys, monkeypatch):
    monkeypatch.setattr(compilation, "_PATIENCE", 0.0)
    monkeypatch.setattr(compilation, "_SECONDS_PER_BYTE", 1.0)
    assert module.twice(3) == 8
    bytecode = sum(len(f.py_func.__code__.co_code) for f in (module.twice, module.add))
    said = "sd_friction_env: compiling {}, about {} s (once) ...\n"
    assert capsys.readouterr().err == said.format("twice", bytecode)  # add within it
    other = again(module)
    assert other.twice(3) == 8
    assert capsys.readouterr().err == ""  # however long it takes
    assert other.add(3.5) == 4.5
    assert capsys.readouterr().err == said.format("add", len(module.add.py_func.__code__.co_code))
    monkeypatch.setattr(compilation, "_PATIENCE", 1e9)
    assert other.twice(3.5) == 9.0
    assert capsys.readouterr().err == ""  # over before it is read


def test_the_announcement_of_the_kernel_counts_what_it_calls():
    assert len(list(compilation._bytecode_to_compile(kernel.iterate_to_attractor, [object()]))) > 30


def run(code, folder, **environment):
    paths = os.pathsep.join([str(folder), str(PACKAGE.parent)])
    command = [sys.executable, *code] if isinstance(code, list) else [sys.executable, "-c", code]
    return subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


SLOW = """
import faulthandler, math, signal
from typing import NamedTuple
from sd_friction_env.kernel.compilation import entry

faulthandler.enable()

class Pair(NamedTuple):
    first: float
    second: float

class Result(NamedTuple):
    pair: Pair
    steps: int

@entry
def sines(n):
    total = 0.0
    for i in range(n):
        total += math.sin(total + i)
    return Result(Pair(total, 2.0 * total), n)

short = sines(3)
assert type(short) is Result and type(short.pair) is Pair and short.steps == 3
signal.signal(signal.SIGALRM, signal.default_int_handler)
for _ in range(3):
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    try:
        while True:
            sines(30_000_000)
    except KeyboardInterrupt:
        print("interrupted")
assert sines(3) == short
"""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="a signal by the clock")
def test_an_interrupt_of_compiled_code_that_returns_a_named_tuple_is_no_crash(tmp_path):
    (tmp_path / "slow.py").write_text(SLOW)
    for _ in range(2):  # compiled, then loaded
        out, error = run("import slow", tmp_path, NUMBA_CACHE_DIR="").communicate(timeout=120)
        assert (out, error) == ("interrupted\n" * 3, "")


def test_processes_that_compile_at_once_give_and_leave_what_is_right(tmp_path):
    (tmp_path / "tiny.py").write_text(SOURCE)
    values = ["3", "3.5", "np.float32(3)", "np.arange(3.0)"]
    code = "import sys, numpy as np, tiny; sys.stdin.read(1); print(np.sum(tiny.twice({})), file=sys.stdout)"
    for _ in range(2):  # cold, then what the first round has left
        running = [run(code.format(value), tmp_path, NUMBA_CACHE_DIR="") for value in values]
        told = [process.communicate(timeout=120) for process in running]
        assert [float(out) for out, _ in told] == [8.0, 9.0, 8.0, 12.0]
        assert [error for _, error in told] == [""] * 4


def test_without_a_folder_for_it_everything_works_and_one_line_says_what_to_set(tmp_path):
    (tmp_path / "tiny.py").write_text(SOURCE)
    (tmp_path / "__pycache__").write_text("a file")
    nowhere = {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "NUMBA_CACHE_DIR": NOWHERE}
    process = run("import tiny; print(tiny.twice(3), tiny.add(3.5), tiny.twice.stats.cache_path)", tmp_path, **nowhere)
    out, error = process.communicate(timeout=120)
    assert out == "8 4.5 None\n"
    assert error == f"sd_friction_env: {compilation.NO_FOLDER}\n"
    assert "NUMBA_CACHE_DIR" in error


def copied(tmp_path, *, with_cache):
    limit_cycle(OscillatorParameters())  # compiled, if it was not
    left = shutil.ignore_patterns() if with_cache else shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, tmp_path / "sd_friction_env", ignore=left)
    shutil.copytree(AGENTS, tmp_path / "agents", ignore=shutil.ignore_patterns("pretrained", "optimum"))
    return tmp_path / "sd_friction_env"


@pytest.mark.slow  # compiles the kernel
def test_the_doctor_works_without_a_folder_for_compiled_code(tmp_path):
    package = copied(tmp_path, with_cache=False)
    for folder in (package / "kernel", package / "kernel" / "friction"):
        (folder / "__pycache__").write_text("a file")
    nowhere = {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "NUMBA_CACHE_DIR": NOWHERE}
    process = run(["-m", "sd_friction_env", "doctor"], tmp_path, **nowhere)
    assert process.stdout.readline().split() == ["sd_friction_env", sd_friction_env.__version__]  # before it compiles
    out, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    assert "limit cycle of amplitude 0.3934432611" in out
    assert f"compiled code    {compilation.NO_FOLDER}" in out
    assert error.count("NUMBA_CACHE_DIR") == 1
    assert "compiling iterate_to_attractor, about" in error


@pytest.mark.slow  # compiles the kernel
def test_the_doctor_works_with_damaged_files_and_names_the_folder_in_use(tmp_path):
    package = copied(tmp_path, with_cache=True)
    folder = package / "kernel" / "__pycache__" if os.environ.get("NUMBA_CACHE_DIR") is None else None
    if folder is None or not list(folder.glob("*.nbc")):
        pytest.skip("the cache of these tests is elsewhere")
    damaged = [*folder.glob("return_map.stick_slip_lap-*.nbc"), *folder.glob("slip.slip_across-*.nbi")]
    assert len(damaged) >= 2
    for file in damaged:
        file.write_bytes(file.read_bytes()[:-100])
    process = run(["-m", "sd_friction_env", "doctor", "--json"], tmp_path)
    out, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    found = json.loads(out)
    assert found["kernel"]["amplitude"] == limit_cycle(OscillatorParameters()).amplitude
    assert found["cache"]["folder"] == str(folder)
    assert found["cache"]["files"] == len(list(folder.glob("*.nb[ic]")))
    assert error.count("damaged") == 1
    assert str(folder) in error


MAKERS = """
import sys
from typing import NamedTuple
from sd_friction_env.kernel.compilation import entry, reader


class Push(NamedTuple):
    force: float


class Place(NamedTuple):
    x: float


def maker(kind):
    source = f"def read():\\n    return {len(kind.__name__)}.0\\n"
    names = {}
    exec(source, names)
    read = reader(names["read"], source, [kind], 0)

    @entry
    def value(x):
        return kind(read() * x)

    return value


def results(names):
    kept = [maker(globals()[name]) for name in names]  # one process keeps both
    return [value(2.0) for value in kept]
"""
ASK_MAKERS = "import sys, makers; print(makers.results(sys.argv[1:]))"
ASK_FORKED = """
import multiprocessing, sys, makers
child = multiprocessing.get_context("fork").Process(target=makers.results, args=(sys.argv[1:],))
child.start()
child.join()
"""


@pytest.mark.parametrize(
    "before",
    [
        ["Push", "Place"],
        pytest.param(["Push", "Push Place"], marks=pytest.mark.slow),
        pytest.param(["forked Push", "forked Place"], marks=pytest.mark.slow),
    ],
)
def test_code_that_two_processes_compiled_under_one_name_keeps_its_own_constants(before, tmp_path):
    (tmp_path / "makers.py").write_text(MAKERS)

    def ask(*names):
        code, names = (ASK_FORKED, names[1:]) if names[0] == "forked" else (ASK_MAKERS, names)
        out, error = run(["-c", code, *names], tmp_path, NUMBA_CACHE_DIR="").communicate(timeout=300)
        assert error == "", error
        return out.strip()

    for names in before:
        ask(*names.split())
    assert ask("Push", "Place") == "[Push(force=8.0), Place(x=10.0)]"
    assert ask("Place", "Push") == "[Place(x=10.0), Push(force=8.0)]"


OWN = """
from typing import NamedTuple
from sd_friction_env import friction_law

@friction_law
class Level(NamedTuple):
    mu_s: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_s

    def slope(self, mode, v_rel):
        return 0.0

    def curvature(self, mode, v_rel):
        return 0.0

    def third_derivative(self, mode, v_rel):
        return 0.0

    def breakaway_coefficient(self, mode):
        return self.mu_s
"""
ASK = """
from own import Level
from sd_friction_env import OscillatorParameters, kernel
p = OscillatorParameters(geometry="linear", friction=Level(0.5))
mode, _, _, normal = kernel.left_alone(p.plant, 0.2, 0.1, 0.1)
print(mode, normal, *kernel.left_alone.stats.cache_hits.values())
"""


@pytest.mark.slow  # compiles the kernel
def test_an_edit_of_a_callee_in_another_file_or_of_a_users_law_renews_the_caller(tmp_path):
    package = tmp_path / "sd_friction_env"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(AGENTS, tmp_path / "agents", ignore=shutil.ignore_patterns("pretrained", "optimum"))
    law, spring = tmp_path / "own.py", package / "kernel" / "springs" / "linear.py"
    law.write_text(OWN)

    def told():
        out, error = run(ASK, tmp_path, NUMBA_CACHE_DIR="").communicate(timeout=300)
        assert out, error
        return out.split()

    assert told() == ["0", "1.0"]
    assert told() == ["0", "1.0", "1"]  # from the cache
    law.write_text(
        OWN.replace("return self.mu_s\n", "return 0.1 * self.mu_s\n").replace("mode * self.mu_s", "0.05 * mode")
    )
    assert told() == ["-1", "1.0"]
    assert told() == ["-1", "1.0", "1"]
    spring.write_text(spring.read_text() + "\n    def normal_force(self, weight, x):\n        return 3.0 * weight\n")
    assert told() == ["-1", "3.0"]


@pytest.mark.slow  # compiles the kernel
def test_what_is_compiled_for_a_law_of_a_script_is_kept(tmp_path):
    (tmp_path / "script.py").write_text(OWN + ASK.replace("from own import Level\n", ""))

    def told():
        process = run([str(tmp_path / "script.py")], tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
        out, error = process.communicate(timeout=300)
        assert out, error
        return out.split(), error

    assert told()[0] == ["0", "1.0"]
    assert told() == (["0", "1.0", "1"], "")
    (tmp_path / "script.py").write_text((tmp_path / "script.py").read_text().replace("Level(0.5)", "Level(0.0)"))
    assert told()[0] == ["-1", "1.0"]
