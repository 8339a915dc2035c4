"""Sweeps in chunks, on one core, several, or many machines: what is computed does not depend on where.

All goes through joblib, so that the backend ("sequential", "loky", "dask", "ray") and an address are all that changes.
A sweep is cut into chunks by what it computes, never by who computes: the same bits come from any backend and any
number of workers. With a folder every finished chunk is kept, with its checksum in its name, and a sweep that was
killed goes on where it was.
"""

import contextlib
import dataclasses
import hashlib
import importlib
import importlib.metadata
import io
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.basins import Basins, basins, checked_grid
from sd_friction_env.curves import amplitude_curve, attractor_curves, checked_belt_speeds, cycle_table
from sd_friction_env.forced import Direction, bifurcation_diagram
from sd_friction_env.parameters import STATE_LIMIT, OscillatorParameters, checked_choice, checked_number
from sd_friction_env.tables import Table, atomic_file

Backend = Literal["sequential", "loky", "dask", "ray"]
Columns: TypeAlias = dict[str, NDArray[Any]]
ChunkFunction: TypeAlias = Callable[[Any], Columns]

BACKENDS: tuple[Backend, ...] = get_args(Backend)
STARTS_A_CHUNK, SPEEDS_A_CHUNK = 250_000, 25
_MOST_WORKERS = 10_000
_CHUNKS_A_WORKER = 2  # in each wave, where results come in waves
_PATIENCE = 3  # times that workers may be lost in a row with no chunk finished between
_EXTRAS = {"loky": "sweep", "dask": "dask", "ray": "ray"}
_MANIFEST = "sweep.json"


class SweepError(ValueError):
    """A folder belongs to another sweep, or workers are lost again and again."""


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
            workers = checked_number("workers", self.workers, 1, _MOST_WORKERS)
            if workers != int(workers):
                raise ValueError(f"workers must be a whole number in [1, {_MOST_WORKERS}], got {self.workers!r}")
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
        SweepError: if the folder holds another sweep, or workers are lost again and again.
        OSError: if the folder cannot be written to.
    """
    store = _Store(engine.folder, len(chunks), description)
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
        if engine.backend == "loky":
            threads = {"inner_max_num_threads": 1}
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
                    yield from parallel(joblib.delayed(_numbered)(function, *pair) for pair in part)

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
    with (
        distributed.LocalCluster(
            n_workers=engine.workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
        distributed.Client(cluster),
    ):
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
        except ConnectionError as error:
            raise SweepError(f"address {engine.address!r} is of no Ray cluster that answers: {error}") from None
    try:
        yield
    finally:
        if started:
            ray.shutdown()


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
    of what is in it. Without a folder nothing is kept."""

    def __init__(self, folder: str | os.PathLike[str] | None, count: int, description: Mapping[str, Any]) -> None:
        self.folder = None if folder is None else Path(folder)
        if self.folder is None:
            return
        wanted = {"sd_friction_env": importlib.metadata.version("sd-friction-env"), "chunks": count, **description}
        wanted = json.loads(json.dumps(wanted))
        if self.folder.exists() and not self.folder.is_dir():
            raise SweepError(f"folder {str(self.folder)!r} is a file")
        self.folder.mkdir(parents=True, exist_ok=True)
        manifest = self.folder / _MANIFEST
        if not manifest.exists():
            if any(self.folder.iterdir()):
                raise SweepError(f"folder {str(self.folder)!r} holds other files: take an empty one, or a new name")
            with atomic_file(manifest) as file:
                json.dump(wanted, file, indent=1)
            return
        try:
            stored = json.loads(manifest.read_text(encoding="utf-8"))
        except ValueError:
            raise SweepError(f"{str(manifest)!r} is damaged: remove the folder to begin anew") from None
        for name in sorted(wanted.keys() | stored.keys()):
            if wanted.get(name) != stored.get(name):
                raise SweepError(
                    f"folder {str(self.folder)!r} holds another sweep: its {name} is {stored.get(name)!r}, "
                    f"not {wanted.get(name)!r}"
                )

    def finished(self) -> Iterator[tuple[int, Columns]]:
        """Yield the chunks that are there and whole; remove what is not."""
        for path in sorted(self.folder.glob("chunk-*.npz")) if self.folder else []:
            named = re.fullmatch(r"chunk-(\d+)-([0-9a-f]{64})\.npz", path.name)
            data = path.read_bytes()
            if named is None or hashlib.sha256(data).hexdigest() != named[2]:
                path.unlink()
                continue
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                yield int(named[1]), dict(arrays)

    def keep(self, index: int, columns: Columns) -> None:
        """Write a chunk, whole or not at all."""
        if self.folder is None:
            return
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **columns)
        data = buffer.getvalue()
        with atomic_file(self.folder / f"chunk-{index:06d}-{hashlib.sha256(data).hexdigest()}.npz", "wb") as file:
            file.write(data)


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
    size = _checked_count("chunk", chunk, 1)
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
    rows = max(1, _checked_count("chunk", chunk, 1) // len(x))
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
    """Return the bifurcation diagram of each plant, as :func:`sd_friction_env.forced.bifurcation_diagram` does, bit for
    bit. A diagram is one chunk, for each of its values starts where the one before ended.

    Args:
        plants: (n,) oscillators. engine: where it runs. The others: as of ``bifurcation_diagram``.

    Raises:
        TypeError, ValueError: if an argument is not as said, before anything is computed.
        SweepError: see :func:`run_chunks`.
    """
    cycles, transient = _checked_count("cycles", cycles, 1), _checked_count("transient", transient, 0)
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


def _checked_count(name: str, value: int, low: int) -> int:
    number = checked_number(name, value, low, 1e9)
    if number != int(number):
        raise ValueError(f"{name} must be a whole number in [{low}, 1e9], got {value!r}")
    return int(number)
