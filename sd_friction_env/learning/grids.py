"""A controller evaluated on a grid of plants, in chunks: on one core, several, or many machines (see :mod:`sweeps`)."""

import hashlib
import itertools
import pickle
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sd_friction_env.control.policies import Policy, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.physics.sweeps import Columns, Engine, run_chunks
from sd_friction_env.physics.tables import Table

PLANTS_A_CHUNK = 20
_COLUMNS = ("return", "passive_return", "late_amplitude", "late_passive_amplitude", "late_stick_fraction", "suppressed")


def evaluation_grid(
    policy: Policy,
    env_id: str,
    over: Mapping[str, Sequence[float]],
    engine: Engine,
    *,
    seeds: Sequence[int] = evaluation.EVALUATION_SEEDS[:10],
    plants_a_chunk: int = PLANTS_A_CHUNK,
) -> Table:
    """Evaluate a controller on every plant of a grid, from the same starts.

    Args:
        policy: to be evaluated; it is pickled. env_id: of one of our environments; parameters that its tier
            draws are at their nominal values unless they are swept.
        over: values of each swept parameter, by name; the grid is their product, the last name the fastest.
        engine: where it runs. seeds: of the episodes on each plant. plants_a_chunk: at least 1.

    Returns:
        A table of one row per plant: the swept parameters; the mean over the episodes of return, passive_return,
        late_amplitude, late_passive_amplitude, late_stick_fraction (of the last quarter, see
        :func:`evaluation.metrics`) and suppressed (a share); and the greatest late_amplitude, worst_amplitude.

    Raises:
        TypeError, ValueError: if a parameter is unknown or a value not allowed, before anything is computed.
    """
    seeds = evaluation.checked_seeds(seeds)
    if not over or not all(len(values) for values in over.values()):
        raise ValueError(f"over must name parameters with at least one value each, got {dict(over)!r}")
    if plants_a_chunk != int(plants_a_chunk) or plants_a_chunk < 1:
        raise ValueError(f"plants_a_chunk must be a whole number from 1 on, got {plants_a_chunk!r}")
    nominal = make_env(env_id).nominal
    points = [tuple(float(value) for value in point) for point in itertools.product(*over.values())]
    for point in points:
        nominal.replace(**dict(zip(over, point, strict=True)))
    names = tuple(over)
    pieces = [points[i : i + int(plants_a_chunk)] for i in range(0, len(points), int(plants_a_chunk))]
    description = {
        "what": "evaluation grid",
        "env_id": env_id,
        "policy": hashlib.sha256(pickle.dumps(policy)).hexdigest(),
        "over": {name: [float(value) for value in values] for name, values in over.items()},
        "seeds": seeds,
        "plants_a_chunk": int(plants_a_chunk),
    }
    chunks = [(policy, env_id, names, piece, seeds) for piece in pieces]
    results = run_chunks(_chunk, chunks, engine, description=description)
    columns: dict[str, Any] = dict(zip(names, np.array(points).T, strict=True))
    return Table(columns | dict(Table.stacked(results)), {"env_id": env_id, "episodes": len(seeds)})


def _chunk(chunk: tuple[Policy, str, tuple[str, ...], list[tuple[float, ...]], list[int]]) -> Columns:
    policy, env_id, names, points, seeds = chunk
    env = make_env(env_id)
    each = np.repeat(np.array(points), len(seeds), axis=0)
    options = {"parameters": evaluation.nominal_draws(env, len(each)) | dict(zip(names, each.T, strict=True))}
    episodes, passive = (
        evaluation.run_episodes(who, env_id, seeds * len(points), options=options) for who in (policy, ZeroPolicy())
    )
    table = dict(evaluation.metrics(episodes, passive))
    table["passive_return"] = evaluation.metrics(passive, passive)["return"]
    shaped = {name: np.asarray(table[name], dtype=np.float64).reshape(len(points), len(seeds)) for name in _COLUMNS}
    return {name: values.mean(axis=1) for name, values in shaped.items()} | {
        "worst_amplitude": shaped["late_amplitude"].max(axis=1)
    }
