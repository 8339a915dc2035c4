"""Computation in chunks, on one core, several cores or a cluster; finished chunks are stored in a folder."""

import contextlib
import functools
import hashlib
import importlib
import importlib.metadata
import io
import json
import multiprocessing
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.physics.parameters import checked_choice, checked_count
from sd_friction_env.storage import (
    LockedError,
    StoredFileError,
    atomic_file,
    content_digest,
    locked,
    naming,
    parse_json,
    read_arrays,
    read_bytes,
    write_arrays,
)

Backend = Literal["sequential", "loky", "dask", "ray"]
Columns: TypeAlias = dict[str, NDArray[Any]]
ChunkFunction: TypeAlias = Callable[[Any], Columns]

BACKENDS: tuple[Backend, ...] = get_args(Backend)
_MOST_WORKERS = 10_000
_CHUNKS_A_WORKER = 2  # in each wave, where results come in waves
_WATCH = 0.5  # seconds between two looks at whether the parent lives
_PATIENCE = 3  # times that workers may be lost in a row with no chunk finished between
_NEEDED = {  # by backends: the extra that brings them, and the modules
    "loky": ("sweep", "joblib"),
    "dask": ("dask", "joblib", "distributed"),
    "ray": ("ray", "joblib", "ray"),
}
_MANIFEST, _LOCK = "sweep.json", ".sweep.lock"
_LARGEST_MANIFEST = 2**27  # bytes
_BELONGS = "belongs to"  # name of the text in a chunk's file that says to which sweep, and where in it
_COLUMN_KINDS = "biufcU"


class SweepError(ValueError):
    """A folder belongs to another sweep or is in use, or workers cannot be started or are lost repeatedly."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """Where a sweep runs.

    Attributes:
        backend: "sequential" (this process), "loky" (processes on this machine), "dask" or "ray" (a cluster).
        workers: number of processes, in [1, 10000]; an existing cluster uses all it has. None: one per core.
        address: of a running cluster: "tcp://host:port" of a Dask scheduler, "auto" or "ray://host:port" of Ray. None:
            one is started on this machine, and stopped at the end.
        folder: of stored chunks, which are not computed again; created if missing.
        progress: called with the number of chunks done and their total after each.

    Raises:
        TypeError, ValueError: if a value is not of the type or in the range above.
        ImportError: if the backend is not installed, saying what to install.
    """

    backend: Backend = "sequential"
    workers: int | None = None
    address: str | None = None
    folder: str | os.PathLike[str] | None = None
    progress: Callable[[int, int], None] | None = None

    def __post_init__(self) -> None:
        checked_choice("backend", self.backend, BACKENDS)
        if self.workers is not None:
            checked_count("workers", self.workers, 1, _MOST_WORKERS)
        if self.address is not None and self.backend not in ("dask", "ray"):
            raise ValueError(f"address goes with the backends 'dask' and 'ray', got {self.address!r}")
        extra, *modules = _NEEDED.get(self.backend, ("",))
        for module in modules:
            try:
                importlib.import_module(module)
            except ImportError:
                raise ImportError(
                    f'the backend {self.backend!r} needs {module}: pip install "sd-friction-env[{extra}]"'
                ) from None


def run_chunks(
    function: ChunkFunction, chunks: Sequence[Any], engine: Engine, *, description: Mapping[str, Any]
) -> list[Columns]:
    """Return a function's results for the chunks, in their order.

    Args:
        function: from one chunk to a dictionary of arrays, which depend on nothing else; workers import it by name.
        chunks: its arguments, which can be pickled.
        engine: where it runs.
        description: of the whole sweep, JSON values; a folder with another is refused.

    Raises:
        SweepError: if the folder holds another sweep or is in use, or workers cannot be started or are lost
            repeatedly.
        OSError: if the folder cannot be written to.
    """
    return list(stream_chunks(function, chunks, engine, description=description))


def stream_chunks(
    function: ChunkFunction, chunks: Sequence[Any], engine: Engine, *, description: Mapping[str, Any]
) -> Iterator[Columns]:
    """Yield what :func:`run_chunks` returns: with a folder, or in this process, few results are in memory at a time.

    Nothing is checked before the first result is asked for.
    """
    with _Store(engine.folder, len(chunks), description) as store:
        yield from _stream_chunks(function, chunks, engine, store)


def _stream_chunks(
    function: ChunkFunction, chunks: Sequence[Any], engine: Engine, store: "_Store"
) -> Iterator[Columns]:
    finished = store.finished()
    waiting: dict[int, Columns] = {}  # computed, not stored, and not yielded because an earlier one is missing
    yielded = lost = 0
    show = engine.progress or (lambda done, total: None)
    if finished:
        show(len(finished), len(chunks))
    with _workers(engine) as parallel:
        while len(finished) < len(chunks):
            missing = [index for index in range(len(chunks)) if index not in finished]
            before = len(finished)
            try:
                for index, columns in parallel(function, [(index, chunks[index]) for index in missing]):
                    if not store.keep(index, columns):
                        waiting[index] = columns
                    finished.add(index)
                    show(len(finished), len(chunks))
                    while yielded in finished:
                        yield waiting.pop(yielded) if yielded in waiting else store.read(yielded)
                        yielded += 1
            except _worker_losses(engine.backend) as error:
                lost = 0 if len(finished) > before else lost + 1
                if lost >= _PATIENCE:
                    raise SweepError(
                        f"workers were lost {lost} times with no chunk finished between; the last time: {error}"
                    ) from error
    for index in range(yielded, len(chunks)):
        yield store.read(index)


def _numbered(function: ChunkFunction, index: int, chunk: Any) -> tuple[int, Columns]:
    return index, function(chunk)


def _numbered_in_child(function: ChunkFunction, index: int, chunk: Any) -> tuple[int, Columns]:
    """Compute a numbered chunk in a worker process, which ends with the process that has started it."""
    _end_with_parent()
    return index, function(chunk)


@functools.cache
def _end_with_parent() -> None:
    """Start a thread that ends this process when its parent has died, even by ``kill -9``."""

    def watch() -> None:
        if os.name == "posix":
            while os.getppid() == parent:
                time.sleep(_WATCH)
        elif (started_by := multiprocessing.parent_process()) is not None:  # elsewhere the parent's id stays
            started_by.join()
        else:
            return
        os._exit(1)

    parent = os.getppid()
    threading.Thread(target=watch, name="end with parent", daemon=True).start()


Runner: TypeAlias = Callable[[ChunkFunction, list[tuple[int, Any]]], Iterator[tuple[int, Columns]]]


@contextlib.contextmanager
def _workers(engine: Engine) -> Iterator[Runner]:
    """Yield a function that computes numbered chunks, in any order."""
    if engine.backend == "sequential":
        yield lambda function, numbered: (_numbered(function, *pair) for pair in numbered)
        return
    joblib: Any = importlib.import_module("joblib")
    with contextlib.ExitStack() as stack:
        threads: dict[str, Any] = {}
        compute = _numbered
        if engine.backend == "loky":
            threads = {"inner_max_num_threads": 1}
            compute = _numbered_in_child  # the workers of the others look after themselves
        elif engine.backend == "dask":
            stack.enter_context(_dask_client(engine))
        else:
            stack.enter_context(_ray(engine))
        n_jobs = -1 if engine.workers is None else engine.workers

        def run(function: ChunkFunction, numbered: list[tuple[int, Any]]) -> Iterator[tuple[int, Columns]]:
            with joblib.parallel_config(backend=engine.backend, n_jobs=n_jobs, **threads):
                if engine.backend == "ray":  # gives results only when all that was asked for is done: it is asked often
                    parallel = joblib.Parallel(batch_size=1)
                    wave = _CHUNKS_A_WORKER * joblib.effective_n_jobs(n_jobs)
                    waves = [numbered[i : i + wave] for i in range(0, len(numbered), wave)]
                else:
                    parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1)
                    waves = [numbered]
                for part in waves:
                    yield from parallel(joblib.delayed(compute)(function, *pair) for pair in part)

        yield run


@contextlib.contextmanager
def _dask_client(engine: Engine) -> Iterator[None]:
    distributed: Any = importlib.import_module("distributed")
    if engine.address is not None:
        try:
            client = distributed.Client(engine.address, timeout=30, set_as_default=True)
        except OSError as error:
            raise SweepError(
                f"address {engine.address!r} is not that of a Dask scheduler that answers: {error}"
            ) from None
        with client:
            yield
        return
    with contextlib.ExitStack() as stack:
        try:
            cluster = distributed.LocalCluster(
                n_workers=engine.workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
            )
            stack.enter_context(distributed.Client(stack.enter_context(cluster)))
        except (OSError, RuntimeError) as error:
            raise SweepError(f"a Dask cluster on this machine could not be started: {_causes(error)}") from None
        yield


@contextlib.contextmanager
def _ray(engine: Engine) -> Iterator[None]:
    ray: Any = importlib.import_module("ray")
    importlib.import_module("ray.util.joblib").register_ray()
    started = not ray.is_initialized()
    if started:
        local: dict[str, Any] = {"include_dashboard": False, "num_cpus": engine.workers}
        try:
            ray.init(engine.address, log_to_driver=False, **(local if engine.address is None else {}))
        except (OSError, RuntimeError) as error:
            if engine.address is None:
                raise SweepError(f"a Ray cluster on this machine could not be started: {_causes(error)}") from None
            raise SweepError(f"address {engine.address!r} is not that of a Ray cluster that answers: {error}") from None
    try:
        yield
    finally:
        if started:
            ray.shutdown()


def _causes(error: BaseException) -> str:
    """Return an error and its causes in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if error.__cause__ is None else f"{text} {_causes(error.__cause__)}"


def _worker_losses(backend: Backend) -> tuple[type[Exception], ...]:
    """Return the errors that mean that a worker was lost, not that a chunk cannot be computed."""
    module, *names = {
        "sequential": ("builtins",),
        "loky": ("joblib.externals.loky.process_executor", "TerminatedWorkerError"),
        "dask": ("distributed", "KilledWorker"),
        "ray": ("ray.exceptions", "RayActorError", "WorkerCrashedError"),
    }[backend]
    return tuple(getattr(importlib.import_module(module), name) for name in names)


class _Store:
    """A folder of finished chunks: a manifest of the sweep, and one file for each, with its checksum in its name.

    Without a folder nothing is stored. While it is open, no other process may open it.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, count: int, description: Mapping[str, Any]) -> None:
        self.folder = None if folder is None else Path(folder)
        self.count = count
        self.wanted = {"sd_friction_env": importlib.metadata.version("sd-friction-env"), "chunks": count, **description}
        self.digest = content_digest(self.wanted)
        self.paths: dict[int, Path] = {}
        self.stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        if self.folder is None:
            return self
        if self.folder.exists() and not self.folder.is_dir():
            raise SweepError(f"folder {str(self.folder)!r} is a file")
        with contextlib.ExitStack() as stack:
            self._check()  # before anything is written to the folder of somebody else
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                stack.enter_context(locked(self.folder / _LOCK, f"folder {str(self.folder)!r}"))
            except LockedError as error:
                raise SweepError(str(error)) from None
            if not self._check():
                with atomic_file(self.folder / _MANIFEST) as file:
                    file.write(self._manifest())
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()

    def _manifest(self) -> str:
        return json.dumps(self.wanted, indent=1)

    def _check(self) -> bool:
        """Return whether the folder has the manifest of this sweep; raise if it holds anything else."""
        assert self.folder is not None
        manifest, name = self.folder / _MANIFEST, str(self.folder)
        try:
            text = read_bytes(manifest, _LARGEST_MANIFEST).decode("utf-8")
            if text == self._manifest():
                return True
            stored = parse_json(text)
        except FileNotFoundError:
            others = self.folder.iterdir() if self.folder.is_dir() else ()
            if any(not (path.name == _LOCK or path.name.startswith(f".{_MANIFEST}.")) for path in others):
                raise SweepError(f"folder {name!r} holds other files: take an empty one, or a new name") from None
            return False
        except (StoredFileError, UnicodeDecodeError) as error:
            raise SweepError(f"{str(manifest)!r} is damaged ({error}): remove the folder to begin anew") from None
        if not isinstance(stored, dict):
            raise SweepError(f"{str(manifest)!r} is damaged: remove the folder to begin anew")
        wanted = json.loads(self._manifest())
        for key in sorted(wanted.keys() | stored.keys()):
            if wanted.get(key) != stored.get(key):
                was, now = (_shortened(part.get(key)) for part in (stored, wanted))
                raise SweepError(f"folder {name!r} holds another sweep: its {key} is {was}, not {now}")
        return True

    def finished(self) -> set[int]:
        """Return which stored chunks are whole and of this sweep; remove the others, to be computed again."""
        for path in sorted(self.folder.glob("chunk-*.npz")) if self.folder else []:
            named = re.fullmatch(r"chunk-(\d{1,9})-[0-9a-f]{64}\.npz", path.name)
            if path.is_dir():
                raise SweepError(f"{str(path)!r} must be a file; it is a folder")
            if named and self._content(path, int(named[1])) is not None:
                self.paths[int(named[1])] = path
            else:
                path.unlink()
        return set(self.paths)

    def read(self, index: int) -> Columns:
        """Return a stored chunk.

        Raises:
            SweepError: if its file has been changed or removed since it was found whole.
        """
        columns = self._content(self.paths[index], index)
        if columns is None:
            raise SweepError(f"{str(self.paths[index])!r} was changed during the sweep: start the same sweep again")
        return columns

    def _content(self, path: Path, index: int) -> Columns | None:
        """Return the columns in a chunk's file, None if it is damaged or of another sweep or place."""
        with contextlib.suppress(StoredFileError, FileNotFoundError), naming(path):
            data = read_bytes(path)
            if hashlib.sha256(data).hexdigest() == path.stem.rpartition("-")[2]:
                columns = read_arrays(io.BytesIO(data), _COLUMN_KINDS, texts=(_BELONGS,))
                if str(columns.pop(_BELONGS, "")) == self._place(index):
                    return columns
        return None

    def keep(self, index: int, columns: Columns) -> bool:
        """Write a chunk, whole or not at all; return whether there is a folder to write it to."""
        if self.folder is None:
            return False
        buffer = io.BytesIO()
        write_arrays(buffer, {**columns, _BELONGS: np.array(self._place(index))}, compress=True)
        data = buffer.getvalue()
        path = self.folder / f"chunk-{index:06d}-{hashlib.sha256(data).hexdigest()}.npz"
        with atomic_file(path, "wb") as file:
            file.write(data)
        self.paths[index] = path
        return True

    def _place(self, index: int) -> str:
        return f"{self.digest} {index} of {self.count}"


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."
