"""Stored optima: returns and action sequences with a fingerprint of their environment."""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env.control.pretrained import close, configuration_changes, golden_actions
from sd_friction_env.environments.ids import bare_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning.optimal.problem import (
    OPEN,
    RANDOMISED,
    SENSED,
    TASKS,
    Array,
    Problem,
    make_problem,
)
from sd_friction_env.storage import (
    AGENTS,
    file_digest,
    load_arrays,
    predecessor_hint,
    read_json,
    save_arrays,
    write_json,
)

OPTIMUM_DIRECTORY = AGENTS / "optimum"
# The files' names; tiers that differ only in what a controller sees share one.
_FILES = {
    **{env_id: task for tier in (TASKS, SENSED) for task, env_id in tier.items()},
    **{env_id: f"{task}-randomised" for task, env_id in RANDOMISED.items()},
    **{OPEN[tier]["belt"]: "belt-randomised" for tier in ("blind", "blind-late")},
    **{OPEN[tier]["belt"]: f"belt-{tier}" for tier in ("blind-hard", "drifting", "excited")},
}
ACTION_LEVELS = 32767  # stored actions are whole numbers of 1/32767: half the size, and far finer than it matters
GOLDEN_TOLERANCE = 1e-7  # other builds round differently, and stick-slip may amplify that; a changed law moves 1e-3
_UNSEEN = ("sensor", "sensor_noise", "sensor_delay", "observation_limit", "x_offset", "x_scale", "v_scale")


class DamagedStudyError(RuntimeError):
    """A file of a stored optimum is damaged."""


def encode(actions: Array) -> NDArray[np.int16]:
    """Return actions in [-1, 1] as whole numbers of 1/32767."""
    return np.round(actions * ACTION_LEVELS).astype(np.int16)


def decode(levels: NDArray[np.int16]) -> NDArray[np.float32]:
    """Return stored actions as the environment takes them."""
    return (levels / ACTION_LEVELS).astype(np.float32)


def fingerprint(env_id: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return what a stored optimum depends on: configuration, starts (x, v) and a golden rollout, all JSON values.

    Where parameters are randomised, ``draws`` holds those of each seed, in the order of their names.
    """
    env = make_env(env_id)
    task = {name: value for name, value in dataclasses.asdict(env.task).items() if name not in _UNSEEN}
    configuration = {"task": task, "parameters": dataclasses.asdict(env.nominal)}
    problem = make_problem(env_id, seeds)
    names = sorted(env.task.randomise or ())
    draws = {"draws": [[getattr(plant, name) for name in names] for plant in problem.parameters]} if names else {}
    env.reset(options={"x": 0.0}, seed=0)
    golden = []
    for action in golden_actions():
        _, reward, _, _, info = env.step(action)
        golden.append([info["x"], info["v"], info["v_belt"], float(reward)])
    starts = problem.starts[:, :2].tolist()
    return {"configuration": json.loads(json.dumps(configuration)), "starts": starts, **draws, "golden": golden[4::5]}


def check_fingerprint(stored: dict[str, Any], env_id: str, seeds: Sequence[int]) -> None:
    """Raise unless the environment is the one that a stored optimum was computed for.

    Raises:
        RuntimeError: naming what changed.
    """
    now = fingerprint(env_id, seeds)
    changed = configuration_changes(stored, now)
    for part, what in (
        ("starts", "the starts of the evaluation seeds"),
        ("draws", "the parameters of the evaluation seeds"),
        ("golden", "the dynamics or the reward"),
    ):
        if not close(stored.get(part, []), now.get(part, []), GOLDEN_TOLERANCE):
            changed.append(what)
    if changed:
        raise RuntimeError(
            f"the stored optimum of {env_id} was computed for another environment ({'; '.join(changed)}): "
            f"recompute it with `{command_of(env_id)}`"
        )


@contextlib.contextmanager
def _reading(path: Path, env_id: str) -> Iterator[None]:
    """Turn errors of reading a file into a :class:`DamagedStudyError` that names it and the remedy."""
    try:
        yield
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DamagedStudyError(
            f"{str(path)!r} does not hold the optimum of {env_id}, or is damaged ({type(error).__name__}: {error})"
            f"{predecessor_hint(path)}: recompute it with `{command_of(env_id)}`"
        ) from None


def _paths(env_id: str, directory: Path) -> tuple[Path, Path]:
    return directory / f"{_FILES[env_id]}.json", directory / f"{_FILES[env_id]}.npz"


def value_path(env_id: str, directory: Path) -> Path:
    """Return the file of a nominal task's value function."""
    return directory / f"{_FILES[env_id]}-value.npz"


def save_optimum(
    problem: Problem, seeds: Sequence[int], actions: Array, about: dict[str, Any], directory: Path = OPTIMUM_DIRECTORY
) -> Array:
    """Store sequences, their returns and the fingerprint; return the returns of the sequences as stored, shape (n,).

    Existing files are kept as their predecessors, "NAME.previous".
    """
    levels = encode(actions)
    returns = problem.returns(decode(levels).astype(np.float64))
    table, sequences = _paths(problem.env_id, directory)
    directory.mkdir(parents=True, exist_ok=True)
    save_arrays(sequences, {"levels": levels}, compress=True, keep=True)
    content = {
        "env_id": problem.env_id,
        "mean_return": float(returns.mean()),
        **about,
        "seeds": [int(seed) for seed in seeds],
        "returns": returns.tolist(),
        "fingerprint": fingerprint(problem.env_id, seeds),
        "sequences": f"sha256:{file_digest(sequences)}",
    }
    write_json(table, content, indent=None, keep=True)  # one list per line: small, and a change shows as one line
    return returns


def stored_study(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> dict[str, Any]:
    """Return the table of a stored optimum, with ``command``, ``stages`` (mean return by stage) and
    ``value_estimates`` (mean by grid).

    Raises:
        FileNotFoundError: if nothing is stored for the id.
        DamagedStudyError: if the file is damaged.
    """
    env_id = bare_id(env_id)
    if env_id not in _FILES or not _paths(env_id, directory)[0].exists():
        stored = [name for name in _FILES if _paths(name, directory)[0].exists()]
        raise FileNotFoundError(f"no optimum is stored for {env_id!r}; stored: {', '.join(stored) or 'none'}")
    path = _paths(env_id, directory)[0]
    with _reading(path, env_id):
        content: dict[str, Any] = read_json(path)
        of, seeds, returns = content["env_id"], content["seeds"], np.array(content["returns"], dtype=float)
        if _FILES.get(of) != _FILES[env_id]:
            raise ValueError(f"it is of {of!r}")
        if not seeds or returns.shape != (len(seeds),) or any(type(seed) is not int for seed in seeds):
            raise ValueError("it must hold one return for each of one or more seeds")
        if not np.isfinite(returns).all():
            raise ValueError("a return is not finite")
        if not isinstance(content["fingerprint"], dict):
            raise ValueError("it has no fingerprint")
    return content


def command_of(env_id: str) -> str:
    """Return the command that computes the optimum of an environment."""
    task, _, tier = _FILES[env_id].partition("-")
    return f"sd-friction optimum --task {task}" + (f" --tier {tier}" if tier else "")


@functools.lru_cache(maxsize=8)
def _checked_table(env_id: str, directory: Path) -> dict[int, float]:
    stored = stored_study(env_id, directory)
    check_fingerprint(stored["fingerprint"], env_id, stored["seeds"])
    return dict(zip(stored["seeds"], stored["returns"], strict=True))


def stored_returns(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> dict[int, float] | None:
    """Return the best known undiscounted returns from the starts of ``reset(seed=...)``, by seed; None: there are none.

    Where parameters are hidden they are those of a controller that knows each episode's parameters and their changes to
    come; where the sensor sees x only, of one that sees the state (tiers that differ in the sensor share plants, starts
    and optimum). Both are upper bounds for controllers that do not.

    Raises:
        RuntimeError: if the environment has changed since they were computed, or (DamagedStudyError) the file cannot be
            read.
    """
    env_id = bare_id(env_id)
    if env_id not in _FILES or not _paths(env_id, directory)[0].exists():
        return None
    return dict(_checked_table(env_id, directory))


def optimal_actions(env_id: str, directory: Path = OPTIMUM_DIRECTORY) -> tuple[list[int], NDArray[np.float32]]:
    """Return the stored seeds and their action sequences, shape (n, steps).

    Raises:
        FileNotFoundError: if nothing is stored for the id.
        DamagedStudyError: if a file is damaged.
    """
    stored = stored_study(env_id, directory)
    path = _paths(bare_id(env_id), directory)[1]
    if not path.exists():
        raise FileNotFoundError(f"no file of actions {str(path)!r}")
    with _reading(path, bare_id(env_id)):
        digest = f"sha256:{file_digest(path)}"
        if stored.get("sequences", digest) != digest:
            raise ValueError("it is not the file that was stored with the table of returns")
        levels = load_arrays(path, "i")["levels"]
        if levels.ndim != 2 or len(levels) != len(stored["seeds"]) or levels.dtype != np.int16:
            raise ValueError(f"levels {levels.dtype} {levels.shape} are not those of {len(stored['seeds'])} seeds")
    return stored["seeds"], decode(levels)
