"""Trained agents of a report: finished runs in folders TASK-TIER-ALGO-SEED."""

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sd_friction_env import Table
from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.environments.ids import TASKS, TIERS, bare_id, environment_id
from sd_friction_env.learning import runs
from sd_friction_env.learning.settings import ALGORITHMS, one_line

Key = tuple[str, str]  # task, tier
ENV_IDS: dict[Key, str] = {key: environment_id(*key) for key in itertools.product(TASKS, TIERS)}
Row = dict[str, Any]
_FOLDER = re.compile(rf"({'|'.join(TASKS)})-({'|'.join(TIERS)})-({'|'.join(ALGORITHMS)})-(\d+)")
LEARNING = ("steps", "seconds", "mean_return", "suppressed")  # columns read from evaluations.csv


@dataclass(frozen=True)
class Agent:
    """A finished run: what it was trained for, its actor, and its evaluations during training."""

    name: str
    task: str
    tier: str
    algorithm: str
    seed: int
    policy: NetworkPolicy
    evaluations: Table


def find_agents(folder: Path) -> tuple[list[Agent], list[str]]:
    """Return the runs in the folders TASK-TIER-ALGO-SEED of a folder, in order, and a note on each folder left out.

    Raises:
        runs.RunFolderError: if there is no such folder, or a run is damaged or not the one of its name.
    """
    if not folder.is_dir():
        raise runs.RunFolderError(f"there is no folder of agents {str(folder)!r}")
    agents, left_out = [], []
    for place in sorted(folder.iterdir()):
        if not place.is_dir() or place.name.startswith((".", "__")):
            continue
        named = _FOLDER.fullmatch(place.name)
        if named is None:
            left_out.append(f"{place.name!r} is left out: its name is not TASK-TIER-ALGO-SEED.")
            continue
        task, tier, algorithm, seed = named.groups()
        policy, config = runs.load_network(place), runs.load_config(place)
        expected: tuple[Any, ...] = (ENV_IDS[task, tier], {}, algorithm, int(seed))
        environment = config["environment"]
        stored = (bare_id(environment["id"]), environment["kwargs"], config["algorithm"], config["seed"])
        if stored != expected:
            raise runs.RunFolderError(f"{str(place)!r} must hold {expected}, as its name says; it holds {stored}")
        agents.append(Agent(place.name, task, tier, algorithm, int(seed), policy, _evaluations(place)))
    return sorted(agents, key=lambda a: (TASKS.index(a.task), TIERS.index(a.tier), a.policy.title, a.seed)), left_out


def _evaluations(place: Path) -> Table:
    path = place / runs.EVALUATIONS
    try:
        table = Table.from_csv(path)
    except (OSError, ValueError) as error:
        raise runs.RunFolderError(f"{str(path)!r} cannot be read: {one_line(error)}") from None
    if not table.n_rows or any(name not in table or table[name].dtype.kind != "f" for name in LEARNING):
        raise runs.RunFolderError(f"{str(path)!r} must have columns of numbers: {', '.join(LEARNING)}")
    return table


def by_algorithm(agents: Iterable[Agent]) -> Iterator[tuple[str, list[Agent]]]:
    """Yield title and agents of each algorithm, those that started from a controller apart; agents must be in order."""
    for title, group in itertools.groupby(agents, key=lambda agent: agent.policy.title):
        yield title, list(group)
