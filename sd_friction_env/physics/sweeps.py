"""Parameter sweeps in chunks, on one core, several cores or a cluster, with results that do not depend on where.

All backends run through joblib: only the name ("sequential", "loky", "dask", "ray") and an address change. A sweep is
divided into chunks by what it computes, never by the number of workers, so any backend gives the same bits. With a
folder every finished chunk is stored, with its checksum in its name and the sweep that it belongs to inside, and a
sweep that was killed resumes. One process at a time works in a folder.

In all of them ``plants`` are (n,) oscillators and ``engine`` says where the sweep runs. They raise TypeError or
ValueError if an argument is not of the type or in the range given, before anything is computed, and SweepError as
:func:`run_chunks`.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.physics.basins import UNDECIDED, Basins, basins, fraction_table
from sd_friction_env.physics.chunks import (
    BACKENDS,
    Backend,
    ChunkFunction,
    Columns,
    Engine,
    SweepError,
    run_chunks,
    stream_chunks,
)
from sd_friction_env.physics.curves import amplitude_curve, attractor_curves, checked_belt_speeds, cycle_table
from sd_friction_env.physics.forced import (
    Direction,
    bifurcation_diagram,
    forced_orbit,
    orbit_branches,
    response_curve,
)
from sd_friction_env.physics.forced.branches import MOST_DOUBLINGS, checked_branch, without_branch
from sd_friction_env.physics.forced.sections import MOST_CYCLES, stroboscope
from sd_friction_env.physics.orbits import OrbitError
from sd_friction_env.physics.parameters import STATE_LIMIT, OscillatorParameters, checked_count, checked_number
from sd_friction_env.physics.shocks import basin_integrity, check_search, without_attractors
from sd_friction_env.physics.starts import checked_grid
from sd_friction_env.physics.tables import Table
from sd_friction_env.storage import atomic_file, checked_ending

__all__ = [
    "BACKENDS",
    "Backend",
    "ChunkFunction",
    "Columns",
    "Engine",
    "SweepError",
    "amplitude_sweep",
    "basin_file",
    "basin_sweep",
    "bifurcation_sweep",
    "branch_sweep",
    "integrity_sweep",
    "response_sweep",
    "run_chunks",
    "stream_chunks",
]

STARTS_A_CHUNK, SPEEDS_A_CHUNK = 250_000, 25
_MOST = 1_000_000_000


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
        plants: their belt speed is not used.
        belt_speeds: (m,), each in [0, 10].
        x, v: the start at every belt speed, in [-10, 10].
        all_attractors: whether to list all attractors, as :func:`sd_friction_env.attractor_curves` does.
        chunk: number of belt speeds in a chunk.
    """
    speeds = checked_belt_speeds(belt_speeds)
    x = checked_number("x", x, -STATE_LIMIT, STATE_LIMIT)
    v = None if v is None else checked_number("v", v, -STATE_LIMIT, STATE_LIMIT)
    size = checked_count("chunk", chunk, 1, _MOST)
    pieces = [speeds[i : i + size] for i in range(0, len(speeds), size)]
    chunks = [(plant, piece, x, v, all_attractors) for plant in plants for piece in pieces]
    how = {"belt_speeds": speeds.tolist(), "start": [x, v], "all_attractors": all_attractors, "chunk": size}
    description = _described("amplitude", plants, **how)
    results = run_chunks(_amplitude_chunk, chunks, engine, description=description)
    tables = []
    for i, plant in enumerate(plants):
        parts = results[i * len(pieces) : (i + 1) * len(pieces)]
        tables.append(cycle_table(Table.stacked(parts), plant))
    return tables


def _described(what: str, plants: Sequence[OscillatorParameters], **arguments: Any) -> dict[str, Any]:
    """Return a sweep's description, as :func:`run_chunks` takes it."""
    return {"what": what, "plants": [dataclasses.asdict(plant) for plant in plants], **arguments}


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
        parameters, x_limits, v_limits, shape: as of ``basin_grid``.
        chunk: number of starts in a chunk, rounded to whole rows of the grid.
    """
    grid = _BasinChunks.of(parameters, x_limits, v_limits, shape, chunk)
    results = run_chunks(_basin_chunk, grid.chunks, engine, description=grid.description)
    return grid.x, grid.v, dataclasses.replace(grid.found, labels=np.concatenate([part["labels"] for part in results]))


def basin_file(
    parameters: OscillatorParameters,
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
    shape: tuple[int, int],
    engine: Engine,
    path: str | os.PathLike[str],
    *,
    chunk: int = STARTS_A_CHUNK,
) -> Table:
    """Write the labels of a grid of any size to an .npy file and return :func:`basins.fraction_table`.

    The file is written whole or not at all; ``numpy.load(path, mmap_mode="r")`` opens it as int8 of shape (m, n), rows
    of one v each. Memory holds a few chunks at a time, with loky as with one process, whatever the number of starts.

    Args:
        parameters, x_limits, v_limits, shape, chunk: as of :func:`basin_sweep`.

    Raises:
        OSError: if the file cannot be written. ValueError: if its name does not end in .npy.
    """
    checked_ending(path, (".npy",))
    grid = _BasinChunks.of(parameters, x_limits, v_limits, shape, chunk)
    counts = np.zeros(len(grid.found.attractors) - UNDECIDED, dtype=np.int64)
    with atomic_file(path, "wb") as file:
        shown = {"descr": "|i1", "fortran_order": False, "shape": (len(grid.v), len(grid.x))}
        np.lib.format.write_array_header_1_0(file, shown)
        for part in stream_chunks(_basin_chunk, grid.chunks, engine, description=grid.description):
            counts += np.bincount(part["labels"].ravel().astype(np.intp) - UNDECIDED, minlength=len(counts))
            file.write(part["labels"].tobytes())
    return fraction_table(grid.found.attractors, counts.tolist())


class _BasinChunks(NamedTuple):
    """A grid of starts as chunks of whole rows, with the attractors that they reach."""

    x: NDArray[np.float64]
    v: NDArray[np.float64]
    found: Basins
    chunks: list[Any]
    description: dict[str, Any]

    @classmethod
    def of(
        cls,
        parameters: OscillatorParameters,
        x_limits: tuple[float, float],
        v_limits: tuple[float, float],
        shape: tuple[int, int],
        chunk: int,
    ) -> Self:
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
        return cls(x, v, found, [(parameters, x, v[i : i + rows]) for i in range(0, len(v), rows)], description)


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
    """Return the bifurcation diagram of each plant, as :func:`forced.bifurcation_diagram` does, bit for bit.

    A diagram is one chunk, because each of its values starts where the one before ended.

    The other arguments are those of ``bifurcation_diagram``.
    """
    checked_count("cycles", cycles, 20 if lyapunov else 1, _MOST)
    arguments = {"direction": direction, "cycles": cycles, "transient": transient, "lyapunov": bool(lyapunov)}
    return _diagram_sweep("bifurcation", plants, name, values, engine, arguments)


def response_sweep(
    plants: Sequence[OscillatorParameters],
    name: str,
    values: ArrayLike,
    engine: Engine,
    *,
    direction: Direction = "both",
    cycles: int = 32,
    transient: int = 200,
) -> list[Table]:
    """Return the response curve of each plant, as :func:`forced.response_curve` does, bit for bit; one chunk each."""
    arguments = {"direction": direction, "cycles": cycles, "transient": transient}
    return _diagram_sweep("response", plants, name, values, engine, arguments)


def branch_sweep(
    plants: Sequence[OscillatorParameters],
    over: tuple[str, float, float],
    engine: Engine,
    *,
    x: float = 0.0,
    v: float | None = None,
    transient: int = 200,
    points: int = 100,
    doublings: int = 0,
) -> list[Table]:
    """Return the branches that begin at the orbit of each plant, as :func:`forced.orbit_branches` does; one chunk each.

    A plant whose motion settles on no orbit has one row of kind "none" with the reason.

    Args:
        plants: each branch starts at the oscillator's own value of the parameter.
        x, v, transient: of the motion, as of :func:`forced.forced_orbit`.
        over, points, doublings: as of ``orbit_branches``.
    """
    checked_count("transient", transient, 0, MOST_CYCLES)
    checked_count("doublings", doublings, 0, MOST_DOUBLINGS)
    for plant in plants:
        stroboscope(plant, None, repeats=True).checked_start(x, v)
        over, points = checked_branch(plant, over, points)
    start, how = {"x": x, "v": v, "transient": transient}, {"points": points, "doublings": doublings}
    description = _described("branches", plants, over=list(over), start=start, **how)
    results = run_chunks(_branch_chunk, [(p, over, start, how) for p in plants], engine, description=description)
    return [Table(columns, {"over": over[0], "range": list(over[1:]), **how}) for columns in results]


def _branch_chunk(
    chunk: tuple[OscillatorParameters, tuple[str, float, float], dict[str, Any], dict[str, Any]],
) -> Columns:
    plant, over, start, how = chunk
    try:
        return dict(orbit_branches(forced_orbit(plant, **start), over, **how))
    except OrbitError as error:
        return dict(without_branch(over[0], plant.values[over[0]], str(error)))


def integrity_sweep(
    plants: Sequence[OscillatorParameters],
    x_limits: tuple[float, float],
    v_limits: tuple[float, float],
    engine: Engine,
    *,
    starts: int = 20_000,
    scales: tuple[float, float] = (1.0, 1.0),
    limit: float = 2.0,
    seed: int = 0,
) -> list[Table]:
    """Return the table of each plant that :func:`shocks.basin_integrity` returns, bit for bit; one chunk each.

    A plant without basins (excited, or with a belt at rest) has one row of NaN with the reason.

    The other arguments are those of ``basin_integrity``.
    """
    x, v = checked_grid(x_limits, v_limits, (2, 2))
    check_search(starts, scales, limit, seed)
    arguments = {"starts": starts, "scales": list(scales), "limit": limit, "seed": seed}
    limits = [x.tolist(), v.tolist()]
    description = _described("integrity", plants, limits=limits, **arguments)
    chunks = [(plant, limits, arguments) for plant in plants]
    return [Table(columns) for columns in run_chunks(_integrity_chunk, chunks, engine, description=description)]


def _integrity_chunk(chunk: tuple[OscillatorParameters, list[Any], dict[str, Any]]) -> Columns:
    plant, limits, arguments = chunk
    try:
        return dict(basin_integrity(plant, *limits, **arguments))
    except ValueError as error:
        return dict(without_attractors(str(error)))


_DIAGRAMS: dict[str, Callable[..., Table]] = {"bifurcation": bifurcation_diagram, "response": response_curve}


def _diagram_sweep(
    what: str,
    plants: Sequence[OscillatorParameters],
    name: str,
    values: ArrayLike,
    engine: Engine,
    arguments: dict[str, Any],
) -> list[Table]:
    checked_count("transient", arguments["transient"], 0, _MOST)
    numbers = np.unique(np.asarray(values, dtype=np.float64)).tolist()
    metadata = []
    for plant in plants:
        for value in numbers[1:]:
            plant.replace(**{name: value})
        # Arguments that a diagram would refuse are refused at once by one of the first value.
        first = _DIAGRAMS[what](plant, name, numbers[:1], **(arguments | {"cycles": 20, "transient": 0}))
        metadata.append(first.metadata)
    chunks = [(what, plant, name, numbers, arguments) for plant in plants]
    description = _described(what, plants, name=name, values=numbers, **arguments)
    results = run_chunks(_diagram_chunk, chunks, engine, description=description)
    return [Table(columns, known) for columns, known in zip(results, metadata, strict=True)]


def _diagram_chunk(chunk: tuple[str, OscillatorParameters, str, list[float], dict[str, Any]]) -> Columns:
    what, plant, name, values, arguments = chunk
    return dict(_DIAGRAMS[what](plant, name, values, **arguments))
