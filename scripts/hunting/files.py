"""Damaged and hostile files: none may be accepted as good, or be costly to refuse.

Bits of checkpoints, policies and tables are flipped, files are cut short and swapped, and every reader is given files
that are made to harm. Each must be refused by name within a second and 200 MB. Needs fork, so not Windows.
"""

import contextlib
import functools
import io
import itertools
import json
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch._dynamo  # the first policy imports it, for a second: no part of the time of a refusal

from scripts.hunting import draws
from scripts.hunting.trials import Check, Failure
from sd_friction_env import Table
from sd_friction_env.cli.options import assignments
from sd_friction_env.control.policies import NetworkPolicy, load_policy
from sd_friction_env.learning import checkpoints, classical, optimal, runs, settings, tensors, training
from sd_friction_env.learning.plan import make_plan
from sd_friction_env.physics.sweeps import Engine, run_chunks
from sd_friction_env.storage import HYPERPARAMETERS, file_digest, read_json, sealed_archive, write_json

FORCE = "SDFriction/Force-v0"
SECONDS, BYTES = 1.0, 200 * 10**6
PATIENCE = 20.0  # seconds until a reader that hangs is ended
Reader = Callable[[Path], Any]


# What is tried --------------------------------------------------------------------------------------------------------


def _policy(path: Path) -> None:
    NetworkPolicy(((np.ones((2, 8)), np.zeros(8)), (np.ones((8, 1)), np.zeros(1)))).save(path)


def _checkpoints(folder: Path) -> Path:
    """Train a tiny run until it has two checkpoints; return its partial folder."""
    plan = make_plan(
        FORCE,
        "ppo",
        env_kwargs={"episode_steps": 40},
        overrides={"n_steps": 16, "n_epochs": 2, "policy_kwargs": "dict(net_arch=[8])"},
        timesteps=600,
        envs=4,
        eval_freq=128,
        eval_episodes=2,
        seed=0,
    )
    calls = itertools.count()
    with contextlib.suppress(training.StoppedError):
        training.train(plan, folder, progress=False, should_stop=lambda: next(calls) >= 60)
    return runs.partial_folder(folder)


def doubled(chunk: float) -> dict[str, Any]:
    """Return a chunk of the sweep that is tried."""
    return {"doubled": np.array([2.0 * chunk])}


def _sweep(path: Path) -> None:
    """Compute a sweep in the folder of a file: a chunk that is refused is computed again."""
    found = run_chunks(doubled, [1.0, 2.0], Engine(folder=path.parent), description={"what": "doubles"})
    if [part["doubled"].tolist() for part in found] != [[2.0], [4.0]]:
        raise AssertionError("a wrong chunk was taken")
    raise ValueError(f"{path}: computed again")


def _readers(base: Path) -> dict[str, tuple[Path, Reader]]:
    """Return each reader by name, with the place of the file that it reads; good files lie beside it."""
    for name in ("policy", "optimum", "run", "sweep"):
        (base / name).mkdir()
    _policy(base / "policy" / "policy.npz")
    for file in optimal.OPTIMUM_DIRECTORY.glob("force*"):
        shutil.copy(file, base / "optimum")
    shutil.copy(classical.GAINS_FILE, base)
    source = HYPERPARAMETERS.parent / "pretrained" / "force-nominal-ppo-0"
    shutil.copytree(source, base / "run", dirs_exist_ok=True)
    shutil.copy(HYPERPARAMETERS / "ppo.yml", base)
    with contextlib.suppress(ValueError):
        _sweep(base / "sweep" / "sweep.json")
    chunk = next((base / "sweep").glob("chunk-000000-*"))
    optimum = base / "optimum"
    return {
        "policy": (base / "policy" / "policy.npz", load_policy),
        "actions": (optimum / "force.npz", lambda path: optimal.optimal_actions(FORCE, path.parent)),
        "value": (optimum / "force-value.npz", lambda path: optimal.OptimalPolicy.load(FORCE, path.parent)),
        "optimum": (optimum / "force.json", lambda path: optimal.stored_returns(FORCE, path.parent)),
        "gains": (base / "classical.json", classical.stored_gains),
        "run": (base / "run" / "config.json", lambda path: runs.load_network(path.parent)),
        "weights": (base / "run" / "policy.pt", lambda path: runs.load_torch_policy(path.parent)),
        "network": (base / "run" / "policy.npz", lambda path: runs.load_network(path.parent)),
        "tensors": (base / "run" / "policy.pt", tensors.load_tensors),
        "hyperparameters": (base / "ppo.yml", lambda path: settings.read_hyperparameters("ppo", FORCE, path)),
        "manifest": (base / "sweep" / "sweep.json", _sweep),
        "chunk": (chunk, _sweep),
        "table": (base / "run" / "evaluations.csv", Table.from_csv),
    }


# Hostile contents -----------------------------------------------------------------------------------------------------


def _npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode().ljust(118 + 128 * (len(header) // 128)) + b"\n"
    return b"\x93NUMPY\x02\x00" + len(text).to_bytes(4, "little") + text + data


def _zip(compression: int = zipfile.ZIP_STORED, **entries: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


@functools.cache
def _bomb() -> bytes:
    """Return an archive of 2 MB whose entry inflates to 2 GB."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("weights_0.npy", "w", force_zip64=True) as entry,
    ):
        entry.write(_npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 500000000)}"))
        for _ in range(2000):
            entry.write(bytes(10**6))
    return buffer.getvalue()


def _header(text: str, **arrays: Any) -> bytes:
    return _npz(header=np.array(text), **arrays)


def _network(layers: Any = 1, weights: Any = None, bias: Any = None, **changes: Any) -> bytes:
    header = {
        "kind": "sd_friction_env network policy",
        "format": 1,
        "activation": "Tanh",
        "output": "clip",
        "frames": 1,
        "layers": layers,
        "metadata": {},
    } | changes
    weights = np.ones((2, 1), np.float32) if weights is None else weights
    return _header(json.dumps(header), weights_0=weights, bias_0=np.zeros(1, np.float32) if bias is None else bias)


def _archives() -> dict[str, bytes]:
    shape = "{{'descr': '{}', 'fortran_order': False, 'shape': {}}}"
    of_shape = {
        f"shape {dims[:40]}": _zip(
            header=_npy(shape.format("<U1", "()"), b"{\0\0\0"), weights_0=_npy(shape.format("<f4", dims))
        )
        for dims in ("(-1, -1)", "(1000000000, 1000000000)", f"({'1, ' * 300})", "(0, 10**9)", "(10**30, 0)", "'x'")
    }
    text = '{"kind": "sd_friction_env network policy", "format": 1, "format": 1, "layers": 1}'
    strange = {
        "complex": np.ones((2, 1), np.complex128),
        "structured": np.zeros((2, 1), [("a", "f4"), ("b", "i4")]),
        "datetime": np.zeros((2, 1), "M8[s]"),
        "timedelta": np.ones((2, 1), "m8[s]"),
        "text": np.full((2, 1), "1.5"),
        "bytes": np.full((2, 1), b"1.5"),
        "bool": np.ones((2, 1), bool),
        "NaN": np.full((2, 1), np.nan, np.float32),
        "infinite": np.full((2, 1), np.inf, np.float32),
        "empty": np.zeros((0, 1), np.float32),
        "raw": np.zeros((2, 1), "V8"),
        "three-dimensional": np.ones((2, 1, 1), np.float32),
    }
    return {
        "a zip bomb of 2 GB": _bomb(),
        "no zip": b"PK\x05\x06" + bytes(18) + b"x",
        "an empty zip": b"PK\x05\x06" + bytes(18),
        "200,000 entries": _many_entries(),
        **{f"layers {layers}": _network(layers=layers) for layers in (10**9, -1, True)},
        **{f"frames {frames}": _network(frames=frames) for frames in (10**30, 1.5)},
        "metadata a list": _network(metadata=[]),
        "activation a list": _network(activation=[]),
        "digits": _header('{"layers": ' + "9" * 10**6 + "}"),
        "deep header": _header("[" * 10**5),
        "deeper header": _header('{"a":' * 10**5),
        "header a number": _header("7"),
        "a key twice": _header(text),
        "many keys twice": _header("{" + ",".join(f'"{i}":0' for i in range(200_000)) + ',"1":0}'),
        "a header of 4 MB": _zip(header=_npy("{" + " " * 4_000_000 + "}", b"")),
        "a nested type": _zip(header=_npy("{'descr': " + "[" * 4000 + "]" * 4000 + ", 'shape': ()}")),
        **of_shape,
        **{f"{name} weights": _network(weights=array) for name, array in strange.items()},
        **{
            f"{name} bias": _network(bias=array[:, 0]) for name, array in strange.items() if name != "three-dimensional"
        },
    }


def _many_entries() -> bytes:
    """Return an archive with 200,000 empty entries."""
    one = b"PK\x01\x02" + bytes(24) + (1).to_bytes(2, "little") + bytes(16) + b"a"
    directory = one * 200_000
    end = b"PK\x05\x06" + bytes(4) + (65535).to_bytes(2, "little") * 2
    return directory + end + len(directory).to_bytes(4, "little") + bytes(6)


def _jsons() -> dict[str, bytes]:
    return {
        "deep JSON": b"[" * 10**6,
        "deep objects": b'{"a":' * 10**6,
        "digits": b'{"seed": ' + b"9" * 10**6 + b"}",
        "an infinite number": b'{"kind": 1e999, "gains": 1e999, "seeds": [1e999]}',
        "a key twice": b'{"kind": 1, "kind": 2, "gains": {}, "gains": {}}',
        "many keys twice": b"{" + b",".join(b'"%d":0' % i for i in range(200_000)) + b',"1":0}',
        "many lists": b"[" + b"[]," * 10**6 + b"[]]",
        "another type": b"[1, 2, 3]",
        "no text": b"\xff\xfe\x00",
        "a surrogate": b'{"kind": "\\ud800", "gains": "\\ud800"}',
        "a wrong digest": b'{"kind": 1, "gains": {}, "sha256": 7}',
    }


def _yamls() -> dict[str, bytes]:
    levels = "".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 12))
    merges = "".join(f"m{i}: &m{i} {{<<: [{', '.join([f'*m{i - 1}'] * 9)}]}}\n" for i in range(1, 12))
    return {
        "an anchor bomb": f"l0: &l0 [lol]\n{levels}{FORCE}: {{net_arch: *l11}}\n".encode(),
        "an anchor bomb in a value": f"l0: &l0 [lol]\n{levels}{FORCE}: *l11\n".encode(),
        "a merge bomb": f"m0: &m0 {{a: 1}}\n{merges}{FORCE}: {{<<: *m11}}\n".encode(),
        "an alias of itself": f"{FORCE}: &a {{gamma: *a}}\n".encode(),
        "deep YAML": b"[" * 60_000,
        "deeper YAML": b"- " * 30_000,
        "deep objects": b"{a: " * 15_000,
        "digits": f"{FORCE}: {{gamma: {'9' * 50_000}}}\n".encode(),
        "hexadecimal digits": f"{FORCE}: {{gamma: 0x{'f' * 50_000}}}\n".encode(),
        "sexagesimal digits": f"{FORCE}: {{gamma: 1{':59' * 15_000}}}\n".encode(),
        "a huge number": f"{FORCE}: {{n_timesteps: {'9' * 30}}}\n".encode(),
        "an infinite number": f"{FORCE}: {{gamma: .inf}}\n".encode(),
        "a date": f"{FORCE}: {{gamma: 2001-99-99}}\n".encode(),
        "a key twice": f"{FORCE}: {{gamma: 0.9, gamma: 0.8}}\n".encode(),
        "a key that is a list": f"{FORCE}: {{? [a] : 1}}\n".encode(),
        "code": f"{FORCE}: !!python/object/apply:os.system [echo]\n".encode(),
        "binary": f"{FORCE}: {{gamma: !!binary AAAA}}\n".encode(),
        "10 MB": b"a: 1\n" * 2_000_000,
        "a long policy": f"{FORCE}: {{policy_kwargs: 'dict(net_arch=[{'-' * 40_000}1])'}}\n".encode(),
        "no text": b"\xff\xfe\x00",
    }


def _tensors(good: Path) -> dict[str, bytes]:
    saved = torch.load(good, weights_only=True)

    def changed(change: Callable[[torch.Tensor], torch.Tensor]) -> bytes:
        buffer = io.BytesIO()
        torch.save({name: change(tensor) for name, tensor in saved.items()}, buffer)
        return buffer.getvalue()

    buffer = io.BytesIO()
    torch.save([1, 2, 3], buffer)
    return {
        "complex weights": changed(lambda tensor: tensor.to(torch.complex64)),
        "double weights": changed(lambda tensor: tensor.double()),
        "NaN weights": changed(lambda tensor: tensor * torch.nan),
        "huge shapes": changed(lambda tensor: tensor.flatten()[:1].expand(10**9)),
        "a list": buffer.getvalue(),
    }


def _obstacles(path: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what may lie in place of a file, with a function that puts it there."""
    yield "a folder", path.mkdir
    yield "a pipe", lambda: os.mkfifo(path)
    yield "an endless device", lambda: path.symlink_to("/dev/zero")
    yield "an empty file", path.touch
    yield "2 GB of nothing", lambda: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 2 * 10**9)


# Judging --------------------------------------------------------------------------------------------------------------


def _vm_size() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def judge(read: Callable[[], Any], named: str) -> str:
    """Return what is wrong with how a file is refused; "" if it is refused by name, soon and with little memory.

    Args:
        read: reads it. named: what the refusal must name.
    """
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    reader = context.Process(target=_attempt, args=(read, named, theirs))
    reader.start()
    theirs.close()
    try:
        return str(ours.recv()) if ours.poll(PATIENCE) else f"not refused within {PATIENCE:.0f} s"
    except EOFError:
        reader.join()
        return f"ended with status {reader.exitcode}"
    finally:
        reader.kill()
        reader.join()


def _attempt(read: Callable[[], Any], named: str, pipe: Connection) -> None:
    """Read under a limit of memory; send what is wrong."""
    if sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_AS, (_vm_size() + BYTES, resource.RLIM_INFINITY))
    warnings.simplefilter("ignore")
    begun = time.perf_counter()
    try:
        read()
        wrong = "taken for good"
    except (TypeError, ValueError, RuntimeError) as error:
        wrong = "" if named in str(error) else f"refused without its name: {str(error)[:200]}"
    except BaseException as error:
        wrong = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.perf_counter() - begun
    pipe.send(wrong or (f"refused after {seconds:.1f} s" if seconds > SECONDS else ""))


def _restored(path: Path) -> None:
    """Remove what lies in place of a file."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _cases(name: str, path: Path, rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield all that one reader is given: what it is, and a function that puts it in place of the file."""
    good = path.read_bytes()
    contents: dict[str, bytes] = {}
    if path.suffix == ".npz":
        contents |= _archives()
        if name in ("policy", "network"):
            contents["of another kind"] = (optimal.OPTIMUM_DIRECTORY / "force.npz").read_bytes()
    elif path.suffix == ".json":
        contents |= _jsons()
    elif path.suffix == ".yml":
        contents |= _yamls()
    elif path.suffix == ".pt":
        contents |= {"a zip bomb of 2 GB": _bomb(), "200,000 entries": _many_entries()}
        contents |= _tensors(path) if name == "weights" else {}
    if path.suffix not in (".csv", ".yml"):  # those may be cut short by their owners
        contents |= {
            f"cut short to {length}": good[:length]
            for length in rng.choice(len(good.rstrip()), 20, replace=False).tolist()
        }
    for what, content in contents.items():
        yield what, functools.partial(path.write_bytes, content)
        if what.startswith("a zip bomb") or "entries" in what:

            def seal(content: bytes = content) -> None:
                with sealed_archive(path) as file:
                    file.write(content)

            yield f"{what}, sealed", seal
    yield from _obstacles(path)


def _check_hostile(base: Path, rng: np.random.Generator) -> Iterator[tuple[str, str]]:
    for name, (path, read) in _readers(base).items():
        good = path.read_bytes()
        for what, put in _cases(name, path, rng):
            target = path
            _restored(path)
            put()
            # Who damages on purpose also mends the digests that others keep of the file.
            if name == "chunk" and path.is_file() and path.stat().st_size < 10**8:
                target = path.with_name(f"chunk-000000-{file_digest(path)}.npz")
                path.rename(target)
            if name in ("weights", "network") and path.is_file() and path.stat().st_size < 10**8:
                _mend_config(path)
            if name == "table" and what == "2 GB of nothing":
                _restored(path)
                continue
            named = {"manifest": str(path.parent), "run": str(path.parent), "chunk": "chunk-000000"}.get(
                name, path.name
            )
            yield f"{name}: {what}", judge(functools.partial(read, target), named)
            for left in {path, target}:
                _restored(left)
            path.write_bytes(good)
            if name in ("weights", "network"):
                _mend_config(path)


def _mend_config(path: Path) -> None:
    config = read_json(path.parent / runs.CONFIG)
    config["files"][path.name] = file_digest(path)
    write_json(path.parent / runs.CONFIG, config)


def _flips(path: Path, rng: np.random.Generator, count: int) -> Iterator[int]:
    """Flip single bits of a file, one after the other, and yield their places."""
    good = path.read_bytes()
    for place in rng.choice(8 * len(good), count, replace=False).tolist():
        changed = bytearray(good)
        changed[place // 8] ^= 1 << place % 8
        path.write_bytes(changed)
        yield place
    path.write_bytes(good)


def _check_checkpoint_bits(base: Path, rng: np.random.Generator) -> Iterator[tuple[str, str]]:
    """Flip single bits of the last checkpoint: each must be named, and its predecessor taken."""
    last, before = runs.checkpoints(_checkpoints(base / "bits"))
    for place in _flips(last, rng, 100):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            found = checkpoints.last_whole_checkpoint([last, before])
        is_held = found is not None and found[0] == before and len(said) == 1 and last.name in str(said[0].message)
        yield f"bit {place} of a checkpoint", "" if is_held else "resumed from unnoticed, or not by name"


def _check_bits(base: Path, rng: np.random.Generator) -> Iterator[tuple[str, str]]:
    """Flip single bits of policies and tables: each must be refused by name, or the file says the very same."""
    for name, (path, read) in _readers(base).items():
        if path.suffix not in (".npz", ".json") or name in ("manifest", "chunk"):
            continue
        content = read_json(path) if path.suffix == ".json" else None
        for place in _flips(path, rng, 25):
            try:
                read(path)
                wrong = "" if content is not None and read_json(path) == content else "taken for good"
            except (ValueError, RuntimeError) as error:
                wrong = "" if path.name in str(error) else f"refused without its name: {error}"
            yield f"bit {place} of {name}", wrong


def _check_arguments() -> Iterator[tuple[str, str]]:
    accepted = ("no text", "a huge number", "an infinite number", "binary", "a long policy")  # may be a value
    for what, content in _yamls().items():
        if what not in accepted:
            text = f"gamma={content.decode()}"
            yield f"--set: {what}", judge(functools.partial(assignments, "--set", [text]), "--set")


def check_files(rng: np.random.Generator) -> tuple[int, list[str]]:
    """Return how many damaged and hostile files were tried, and those that were not refused as they should."""
    with tempfile.TemporaryDirectory() as place:
        base = Path(place)
        for name in ("hostile", "flipped"):
            (base / name).mkdir()
        found = [
            *_check_checkpoint_bits(base, rng),
            *_check_bits(base / "flipped", rng),
            *_check_hostile(base / "hostile", rng),
            *_check_arguments(),
        ]
    return len(found), [f"{what}: {wrong}" for what, wrong in found if wrong]


def trial(seed: int, index: int) -> None:
    """Check what damaged files do."""
    wrong = check_files(draws.generator(seed, index))[1]
    if wrong:
        raise Failure("files", f"{wrong}")


CHECK = Check("files", "damaged and hostile files", trial, patience=300.0)
