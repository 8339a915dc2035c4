"""Sweeps in chunks, on one core, several, or many machines: what is computed does not depend on where.

All goes through joblib, so that the backend ("sequential", "loky", "dask", "ray") and an address are all that changes.
A sweep is cut into chunks by what it computes, never by who computes: the same bits come from any backend and any
number of workers. With a folder every finished chunk is kept, with its checksum in its name and the sweep that it
belongs to inside, and a sweep that was killed goes on where it was. One process at a time works in a folder.
"""

import contextlib
import dataclasses
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
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.basins import Basins, basins
from sd_friction_env.physics.curves import amplitude_curve, attractor_curves, checked_belt_speeds, cycle_table
from sd_friction_env.physics.forced import Direction, bifurcation_diagram
from sd_friction_env.physics.parameters import (
    STATE_LIMIT,
    OscillatorParameters,
    checked_choice,
    checked_count,
    checked_number,
)
from sd_friction_env.physics.starts import checked_grid
from sd_friction_env.physics.tables import Table
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
STARTS_A_CHUNK, SPEEDS_A_CHUNK = 250_000, 25
_MOST_WORKERS, _MOST = 10_000, 1_000_000_000
_CHUNKS_A_WORKER = 2  # in each wave, where results come in waves
_WATCH = 0.5  # seconds between two looks at whether the parent lives
_PATIENCE = 3  # times that workers may be lost in a row with no chunk finished between
_EXTRAS = {"loky": "sweep", "dask": "dask", "ray": "ray"}
_MANIFEST, _LOCK = "sweep.json", ".sweep.lock"
_LARGEST_MANIFEST = 2**27  # bytes
_BELONGS = "belongs to"  # name of the text in a chunk's file that says to which sweep, and where in it
_COLUMN_KINDS = "biufcU"


class SweepError(ValueError):
    """A folder belongs to another sweep or is in use, or workers cannot be started or are lost again and again."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """Where a sweep runs.

    Attributes:
        backend: "sequential" (this process), "loky" (processes on this machine), "dask" or "ray" (a cluster).
        workers: processes, in [1, 10000]; of a cluster that exists already, all that it has. None: one per core.
        address: of a running cluster: "tcp://host:port" of a Dask scheduler, "auto" or "ray://host:port" of Ray. None:
            one is started on this machine, and stopped at the end.
        folder: where finished chunks are kept, and looked for; made if it is not there.
        progress: called with the chunks done and the chunks in all after each.

    Raises:
        TypeError, ValueError: if a value is not as said.
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
        needed = {"loky": ("joblib",), "dask": ("joblib", "distributed"), "ray": ("joblib", "ray")}
        for module in needed.get(self.backend, ()):
            try:
                importlib.import_module(module)
            except ImportError:
                extra = _EXTRAS[self.backend]
                raise ImportError(
                    f'the backend {self.backend!r} needs {module}: pip install "sd-friction-env[{extra}]"'
                ) from None


def run_chunks(
    function: ChunkFunction, chunks: Sequence[Any], engine: Engine, *, description: Mapping[str, Any]
) -> list[Columns]:
    """Return what a function gives for each chunk, in their order.

    Args:
        function: of one chunk, to a dictionary of arrays; it and its results depend on nothing else. Workers import it
            by name. chunks: whatever it takes, to be pickled. engine: where it runs.
        description: of the whole sweep, JSON values; a folder with another is refused.

    Raises:
        SweepError: if the folder holds another sweep or is in use, or workers cannot be started or are lost again and
            again.
        OSError: if the folder cannot be written to.
    """
    with _Store(engine.folder, len(chunks), description) as store:
        return _run_chunks(function, chunks, engine, store)


def _run_chunks(function: ChunkFunction, chunks: Sequence[Any], engine: Engine, store: "_Store") -> list[Columns]:
    results: dict[int, Columns] = dict(store.finished())
    show = engine.progress or (lambda done, total: None)
    if results:
        show(len(results), len(chunks))
    lost = 0
    with _workers(engine) as parallel:
        while len(results) < len(chunks):
            missing = [index for index in range(len(chunks)) if index not in results]
            before = len(results)
            try:
                for index, columns in parallel(function, [(index, chunks[index]) for index in missing]):
                    store.keep(index, columns)
                    results[index] = columns
                    show(len(results), len(chunks))
            except _worker_losses(engine.backend) as error:
                lost = 0 if len(results) > before else lost + 1
                if lost >= _PATIENCE:
                    raise SweepError(
                        f"workers were lost {lost} times with no chunk finished between; the last time: {error}"
                    ) from error
    return [results[index] for index in range(len(chunks))]


def _numbered(function: ChunkFunction, index: int, chunk: Any) -> tuple[int, Columns]:
    return index, function(chunk)


def _numbered_in_child(function: ChunkFunction, index: int, chunk: Any) -> tuple[int, Columns]:
    """Compute a numbered chunk in a worker process, which ends with the process that has started it."""
    _end_with_parent()
    return index, function(chunk)


@functools.cache
def _end_with_parent() -> None:
    """Start a thread that ends this process when its parent has died, be it by ``kill -9``."""

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
    """Give a function that computes numbered chunks, in any order."""
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
                if (
                    engine.backend == "ray"
                ):  # gives results only when all that was asked for is done: so it is asked often
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
            raise SweepError(f"address {engine.address!r} is of no Dask scheduler that answers: {error}") from None
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
            raise SweepError(f"address {engine.address!r} is of no Ray cluster that answers: {error}") from None
    try:
        yield
    finally:
        if started:
            ray.shutdown()


def _causes(error: BaseException) -> str:
    """Return an error and what it was caused by, in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if error.__cause__ is None else f"{text} {_causes(error.__cause__)}"


def _worker_losses(backend: Backend) -> tuple[type[Exception], ...]:
    """Return the errors that say that a worker was lost, not that a chunk cannot be computed."""
    if backend == "loky":
        module: Any = importlib.import_module("joblib.externals.loky.process_executor")
        return (module.TerminatedWorkerError,)
    if backend == "dask":
        module = importlib.import_module("distributed")
        return (module.KilledWorker,)
    if backend == "ray":
        module = importlib.import_module("ray.exceptions")
        return (module.RayActorError, module.WorkerCrashedError)
    return ()


class _Store:
    """A folder of finished chunks: a manifest that says what of, and one file each, whose name ends with the checksum
    of what is in it. Without a folder nothing is kept. While it is open, no other process may open it."""

    def __init__(self, folder: str | os.PathLike[str] | None, count: int, description: Mapping[str, Any]) -> None:
        self.folder = None if folder is None else Path(folder)
        self.count = count
        self.wanted = {"sd_friction_env": importlib.metadata.version("sd-friction-env"), "chunks": count, **description}
        self.digest = content_digest(self.wanted)
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

    def finished(self) -> Iterator[tuple[int, Columns]]:
        """Yield the chunks that are there, whole and of this sweep; remove the others, for they are computed again."""
        for path in sorted(self.folder.glob("chunk-*.npz")) if self.folder else []:
            named = re.fullmatch(r"chunk-(\d{1,9})-([0-9a-f]{64})\.npz", path.name)
            columns: Columns | None = None
            with contextlib.suppress(StoredFileError), naming(path):
                data = read_bytes(path)
                if named is not None and hashlib.sha256(data).hexdigest() == named[2]:
                    columns = read_arrays(io.BytesIO(data), _COLUMN_KINDS, texts=(_BELONGS,))
            if named and columns and str(columns.pop(_BELONGS, "")) == self._place(int(named[1])):
                yield int(named[1]), columns
            elif path.is_dir():
                raise SweepError(f"{str(path)!r} must be a file; it is a folder")
            else:
                path.unlink()

    def keep(self, index: int, columns: Columns) -> None:
        """Write a chunk, whole or not at all."""
        if self.folder is None:
            return
        buffer = io.BytesIO()
        write_arrays(buffer, {**columns, _BELONGS: np.array(self._place(index))}, compress=True)
        data = buffer.getvalue()
        with atomic_file(self.folder / f"chunk-{index:06d}-{hashlib.sha256(data).hexdigest()}.npz", "wb") as file:
            file.write(data)

    def _place(self, index: int) -> str:
        return f"{self.digest} {index} of {self.count}"


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


# What is swept ------------------------------------------------------------------------------------------------------


def amplitude_sweep(
    plants: Sequence[OscillatorParameters],
    belt_speeds: ArrayLike,
    engine: Engine,
    *,
    x: float = 0.0,
    v: float | None = None,
    all_attractors: bool = False,
    chunk: int = SPEEDS_A_CHUNK,
) -> list[Table]:
    """Return the amplitude curve of each plant, as :func:`sd_friction_env.amplitude_curve` does, bit for bit.

    Args:
        plants: (n,) oscillators; their belt speed is not used. belt_speeds: (m,), each in [0, 10].
        engine: where it runs. x, v: the start. all_attractors: as :func:`sd_friction_env.attractor_curves` instead.
        chunk: belt speeds a chunk.

    Raises:
        TypeError, ValueError: if an argument is not as said, before anything is computed.
        SweepError: see :func:`run_chunks`.
    """
    speeds = checked_belt_speeds(belt_speeds)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    v = None if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    size = checked_count("chunk", chunk, 1, _MOST)
    pieces = [speeds[i : i + size] for i in range(0, len(speeds), size)]
    chunks = [(plant, piece, x, v, all_attractors) for plant in plants for piece in pieces]
    description = {
        "what": "amplitude",
        "plants": [dataclasses.asdict(plant) for plant in plants],
        "belt_speeds": speeds.tolist(),
        "start": [x, v],
        "all_attractors": all_attractors,
        "chunk": size,
    }
    results = run_chunks(_amplitude_chunk, chunks, engine, description=description)
    tables = []
    for i, plant in enumerate(plants):
        parts = results[i * len(pieces) : (i + 1) * len(pieces)]
        tables.append(cycle_table({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, plant))
    return tables


def _amplitude_chunk(chunk: tuple[OscillatorParameters, NDArray[np.float64], float, float | None, bool]) -> Columns:
    plant, speeds, x, v, all_attractors = chunk
    return dict(attractor_curves(plant, speeds) if all_attractors else amplitude_curve(plant, speeds, x=x, v=v))


def basin_sweep(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
    shape: tuple[int, int],
    engine: Engine,
    *,
    chunk: int = STARTS_A_CHUNK,
) -> tuple[NDArray[np.float64], NDArray[np.float64], Basins]:
    """Return what :func:`sd_friction_env.basin_grid` returns, bit for bit.

    Args:
        parameters, x_limits, v_limits, shape: as of ``basin_grid``. engine: where it runs.
        chunk: starts a chunk, rounded to whole rows of the grid.

    Raises:
        TypeError, ValueError: if an argument is not as said, before anything is computed.
        SweepError: see :func:`run_chunks`.
    """
    x, v = checked_grid(x_limits, v_limits, shape)
    rows = max(1, checked_count("chunk", chunk, 1, _MOST) // len(x))
    description = {
        "what": "basins",
        "parameters": dataclasses.asdict(parameters),
        "x_limits": [float(x[0]), float(x[-1])],
        "v_limits": [float(v[0]), float(v[-1])],
        "shape": [len(x), len(v)],
        "rows_a_chunk": rows,
    }
    found = basins(parameters, x[:1], v[:1])  # the attractors, and what may be wrong with the parameters
    chunks = [(parameters, x, v[i : i + rows]) for i in range(0, len(v), rows)]
    results = run_chunks(_basin_chunk, chunks, engine, description=description)
    labels = np.concatenate([part["labels"] for part in results])
    return x, v, dataclasses.replace(found, labels=labels)


def _basin_chunk(chunk: tuple[OscillatorParameters, NDArray[np.float64], NDArray[np.float64]]) -> Columns:
    parameters, x, v = chunk
    return {"labels": basins(parameters, x[None, :], v[:, None], threads=1).labels}


def bifurcation_sweep(
    plants: Sequence[OscillatorParameters],
    name: str,
    values: ArrayLike,
    engine: Engine,
    *,
    direction: Direction = "up",
    cycles: int = 100,
    transient: int = 200,
    lyapunov: bool = False,
) -> list[Table]:
    """Return the bifurcation diagram of each plant, as :func:`forced.bifurcation_diagram` does, bit for
    bit. A diagram is one chunk, for each of its values starts where the one before ended.

    Args:
        plants: (n,) oscillators. engine: where it runs. The others: as of ``bifurcation_diagram``.

    Raises:
        TypeError, ValueError: if an argument is not as said, before anything is computed.
        SweepError: see :func:`run_chunks`.
    """
    cycles, transient = checked_count("cycles", cycles, 1, _MOST), checked_count("transient", transient, 0, _MOST)
    numbers = np.unique(np.asarray(values, dtype=np.float64)).tolist()
    for plant in plants:
        for value in numbers[1:]:
            plant.replace(**{name: value})
        # What a diagram would refuse, one of the first value refuses at once.
        bifurcation_diagram(plant, name, numbers[:1], direction=direction, cycles=20, transient=0, lyapunov=lyapunov)
    arguments = {"direction": direction, "cycles": cycles, "transient": transient, "lyapunov": bool(lyapunov)}
    chunks = [(plant, name, numbers, arguments) for plant in plants]
    described = [dataclasses.asdict(plant) for plant in plants]
    description = {"what": "bifurcation", "plants": described, "name": name, "values": numbers, **arguments}
    results = run_chunks(_diagram_chunk, chunks, engine, description=description)
    return [
        Table(columns, {"parameters": dataclasses.asdict(plant), "swept": name})
        for columns, plant in zip(results, plants, strict=True)
    ]


def _diagram_chunk(chunk: tuple[OscillatorParameters, str, list[float], dict[str, Any]]) -> Columns:
    plant, name, values, arguments = chunk
    return dict(bifurcation_diagram(plant, name, values, **arguments))
