"""The fixed protocol: entries that anyone can make, recompute and compare, and the leaderboard made from them.

An entry is a sealed JSON file: for each environment the return of the protocol's 100 episodes, which of them were
suppressed, rms action and time of a decision, and a fingerprint of the environment (spaces, task, plant, golden
rollout; after the first environment only what differs from the first); its name, its policy, what that knows of the
plant, and versions. Returns are stored to 0.1, and :data:`TOLERANCE` is what they may differ by.
"""

import itertools
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.control.policies import Actions, Policy, State
from sd_friction_env.control.pretrained import changes_since, fingerprint
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.versions import versions
from sd_friction_env.storage import StoredFileError, is_sealed, naming, read_json, write_json

SEEDS = evaluation.EVALUATION_SEEDS
_TIMED = 100  # decisions whose time is taken
KIND, FORMAT = "sd_friction_env benchmark entry", 1
# Of a return: 0.0002 of a score. Half of it is the rounding of stored returns, the rest is for builds that round
# differently (docs/howto/benchmark.md).
TOLERANCE = 0.1
_ABOUT = ("name", "policy", "knows")  # texts of an entry: they say whether another one is the same
_GOLDEN_ROWS = slice(None, None, 4)  # of the fingerprint's rollout: the last one depends on all before it


class EntryError(ValueError):
    """A policy returns no action, or an entry is of other environments or of another policy than asked for."""


# Running --------------------------------------------------------------------------------------------------------------


@dataclass
class Checked:
    """A policy whose actions are checked.

    Attributes:
        policy: acts. name, env_id: for messages. progress: called after each decision.
    """

    policy: Policy
    name: str
    env_id: str
    progress: Callable[[], None] = lambda: None

    def predict(self, observation: ArrayLike, *arguments: Any, **named: Any) -> tuple[Actions, State]:
        """Return the policy's actions and its memory.

        Raises:
            EntryError: naming policy, environment and value, if it fails, or if its actions are not n finite float32
                or float64 numbers in [-1, 1], shape (n, 1).
        """
        try:
            found: Any = self.policy.predict(observation, *arguments, **named)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(place.filename).name}, line {place.lineno}"
            raise self._error(f"fails: {type(error).__name__}: {error} ({where})") from error
        if not isinstance(found, tuple) or len(found) != 2:
            raise self._error(f"must return (action, state), got {type(found).__name__}")
        actions, n = np.asarray(found[0]), len(np.asarray(observation))
        if actions.dtype not in (np.float32, np.float64):
            raise self._error(f"must return actions in float32 or float64, got {actions.dtype}")
        if actions.shape != (n, 1):
            raise self._error(f"must return actions of shape ({n}, 1) for {n} observations, got {actions.shape}")
        wrong = np.flatnonzero(~(np.abs(actions[:, 0]) <= 1.0))
        if wrong.size:
            raise self._error(f"must return actions in [-1, 1], got {float(actions[wrong[0], 0])!r}")
        self.progress()
        return actions.astype(np.float32), found[1]

    def _error(self, what: str) -> EntryError:
        return EntryError(f"policy {self.name!r} on {self.env_id} {what}")


def decisions(env_id: str) -> int:
    """Return how often :func:`measure` calls a policy: in all episodes side by side, then in one alone."""
    return make_env(env_id).task.episode_steps + _TIMED + 1


def measure(policy: Policy, name: str, env_id: str, progress: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Return the results of a policy in the protocol's episodes, as an entry holds them."""
    checked = Checked(policy, name, env_id, progress)
    table = evaluation.evaluate(checked, env_id, SEEDS)
    milliseconds = evaluation.decision_milliseconds(checked, env_id, decisions=_TIMED)
    return {
        "returns": [round(value, 1) for value in table["return"].tolist()],
        "suppressed": "".join("01"[flag] for flag in table["suppressed"].tolist()),
        "rms_action": round(float(table["rms_action"].mean()), 4),
        "milliseconds": float(f"{milliseconds:.2g}"),
        **_fingerprint(env_id),
    }


def _fingerprint(env_id: str) -> dict[str, Any]:
    found = fingerprint(env_id)
    golden = [[round(value, 7) for value in row] for row in found["golden"][_GOLDEN_ROWS]]
    return {"configuration": found["configuration"], "golden": golden}


# Entries --------------------------------------------------------------------------------------------------------------


def new_entry(name: str, policy: str, knows: str = "") -> dict[str, Any]:
    """Return an entry without results.

    Raises:
        ValueError: if the name is empty, or a text has several lines.
    """
    about = dict(zip(_ABOUT, (name, policy, knows), strict=True))
    for key, text in about.items():
        if len(text.splitlines()) > 1 or "|" in text or (key != "knows" and not text.strip()):
            raise ValueError(f"{key} must be one line of text without '|', got {text!r}")
    return {**about, "versions": versions(), "environments": {}}


def resumed(entry: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the entry in a file, to be continued.

    Raises:
        StoredFileError: if it is damaged. EntryError: if it is not the same as ``entry`` but for its results.
    """
    stored = read_entry(path)
    for key in (*_ABOUT, "versions"):
        if stored[key] != entry[key]:
            raise EntryError(f"{str(path)!r} holds another entry: its {key} is {stored[key]!r}, not {entry[key]!r}")
    for env_id in stored["environments"]:
        check_environment(stored, env_id)
    return stored


def write_entry(entry: Mapping[str, Any], path: Path) -> None:
    """Write an entry as a sealed file, whole or not at all."""
    environments: dict[str, Any] = {}
    first: dict[str, Any] = {}
    for env_id, result in entry["environments"].items():
        own = {
            part: dict(item for item in values.items() if item not in first.get(part, {}).items())
            for part, values in result["configuration"].items()
        }
        environments[env_id] = {**result, "configuration": own}
        first = first or result["configuration"]
    content = {"kind": KIND, "format": FORMAT, **entry, "seeds": [SEEDS[0], SEEDS[-1]], "environments": environments}
    write_json(path, content, indent=None)


def read_entry(path: Path) -> dict[str, Any]:
    """Return the entry in a file, each environment with its whole configuration.

    Raises:
        OSError: if it cannot be read.
        StoredFileError: naming the file, if it was changed since it was written, or is no entry.
    """
    content = read_json(path)
    with naming(path):
        if not isinstance(content, dict) or content.get("kind") != KIND or content.get("format") != FORMAT:
            raise StoredFileError(f"not a {KIND} of format {FORMAT}")
        if not is_sealed(path):
            raise StoredFileError("it has no digest: changed since it was written")
        if content["seeds"] != [SEEDS[0], SEEDS[-1]]:
            raise StoredFileError(f"seeds must be the protocol's, {SEEDS[0]} to {SEEDS[-1]}, got {content['seeds']!r}")
        if not content["environments"]:
            raise StoredFileError("it holds no environment")
        entry: dict[str, Any] = {key: content[key] for key in (*_ABOUT, "versions", "environments")}
        new_entry(*(entry[key] for key in _ABOUT))
        first: dict[str, Any] = {}
        for env_id, result in entry["environments"].items():
            _check_result(env_id, result)
            whole = {part: {**first.get(part, {}), **own} for part, own in result["configuration"].items()}
            first = first or whole
            result["configuration"] = whole
    return entry


def _check_result(env_id: str, result: Mapping[str, Any]) -> None:
    returns = np.array(result["returns"], dtype=float)
    numbers = np.array([result["rms_action"], result["milliseconds"]], dtype=float)
    if returns.shape != (len(SEEDS),) or not (np.isfinite(returns).all() and np.isfinite(numbers).all()):
        raise StoredFileError(f"{env_id} must have {len(SEEDS)} finite returns, rms_action and milliseconds")
    if len(result["suppressed"]) != len(SEEDS) or not set(result["suppressed"]) <= set("01"):
        raise StoredFileError(f"{env_id}: suppressed must be {len(SEEDS)} times 0 or 1, got {result['suppressed']!r}")


def check_environment(entry: Mapping[str, Any], env_id: str) -> None:
    """Check that an entry's environment is the one at hand.

    Raises:
        EntryError: if there is no such environment, or it has changed, naming what has.
    """
    if env_id not in ENVIRONMENT_IDS:
        known = ", ".join(ENVIRONMENT_IDS)
        raise EntryError(f"entry {entry['name']!r} has an environment {env_id!r} that is not known here ({known})")
    changed = changes_since(entry["environments"][env_id], _fingerprint(env_id))
    if changed:
        made = entry["versions"].get("sd_friction_env")
        raise EntryError(
            f"entry {entry['name']!r} was made on another {env_id}, by sd_friction_env {made} ({'; '.join(changed)}): "
            "run it again"
        )


def differences(entry: Mapping[str, Any], env_id: str, policy: Policy, episodes: int = len(SEEDS)) -> list[str]:
    """Return a line for each result of an entry that a policy does not reach again: an episode whose return differs by
    more than :data:`TOLERANCE` or that is suppressed on one side only, and the rms action over all episodes.

    Raises:
        EntryError: as :func:`check_environment`. EntryError: as :meth:`Checked.predict`.
    """
    check_environment(entry, env_id)
    stored = entry["environments"][env_id]
    table = evaluation.evaluate(Checked(policy, entry["name"], env_id), env_id, SEEDS[:episodes])
    words = {True: "suppressed", False: "not suppressed"}
    found = []
    for row, value, flag in zip(table.rows(), stored["returns"], _flags(stored).tolist(), strict=False):
        if abs(row["return"] - value) > TOLERANCE or row["suppressed"] != flag:
            now = f"{row['return']:.2f}, {words[row['suppressed']]}"
            found.append(f"seed {row['seed']}: {value:.2f}, {words[flag]}, in the entry; recomputed {now}")
    rms = float(table["rms_action"].mean())
    if episodes == len(SEEDS) and abs(rms - stored["rms_action"]) > 1e-3:
        found.append(f"rms action: {stored['rms_action']} in the entry; recomputed {rms:.4f}")
    return found


def _flags(result: Mapping[str, Any]) -> NDArray[np.bool_]:
    return np.array([flag == "1" for flag in result["suppressed"]])


# The leaderboard ------------------------------------------------------------------------------------------------------

BLOCKS = ("knows the plant", "does not know the plant")
_SUMMARY = ("score", "score_low", "score_high", "scored_episodes", "credited", "suppressed", "return")
_TEXTS = ("environment", "entry", "knows")  # first columns of the Markdown
_NUMBERS = {
    "score": "{:.3f}",
    "credited": "{:.3f}",
    "suppressed": "{:.0%}",
    "return": "{:.1f}",
    "worst_start": "{:.1f}",
    "rms_action": "{:.3f}",
    "milliseconds": "{:g}",
}


def leaderboard(entries: Iterable[Mapping[str, Any]], env_ids: Sequence[str] = ENVIRONMENT_IDS) -> list[dict[str, Any]]:
    """Return the rows of entries: the two :data:`BLOCKS`, in each by environment, the best first (by score; where no
    optimum is known, by suppressed share and return).

    Passive motion and optimum are those of this machine: an entry cannot bring its own.

    Raises:
        EntryError: as :func:`check_environment`. RuntimeError: if a stored optimum is of another environment.
    """
    rows = []
    pairs = [(entry, env_id) for entry in entries for env_id in entry["environments"] if env_id in env_ids]
    for entry, env_id in pairs:
        check_environment(entry, env_id)
        result = entry["environments"][env_id]
        passive = evaluation.passive_episodes(env_id, SEEDS)
        baseline = evaluation.metrics(passive, passive)
        table = Table({**baseline, "return": np.array(result["returns"]), "suppressed": _flags(result)})
        summary = evaluation.summarise(entry["name"], table, baseline, evaluation.optimal_returns(env_id, SEEDS))
        about = {"block": BLOCKS[not entry["knows"]], "environment": env_id, "entry": entry["name"]}
        effort = {"worst_start": min(result["returns"])} | {
            name: result[name] for name in ("rms_action", "milliseconds")
        }
        rows.append(about | {"knows": entry["knows"] or "-"} | {name: summary[name] for name in _SUMMARY} | effort)

    def rank(row: Mapping[str, Any]) -> tuple[Any, ...]:
        place = BLOCKS.index(row["block"]), ENVIRONMENT_IDS.index(row["environment"])
        return *place, -np.nan_to_num(row["score"], nan=-np.inf), -row["suppressed"], -row["return"]

    return sorted(rows, key=rank)


def as_markdown(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows of :func:`leaderboard` as Markdown: a heading and a table for each block."""
    lines = []
    for block, group in itertools.groupby(rows, key=lambda row: row["block"]):
        names = [name.replace("_", " ") for name in (*_TEXTS, *_NUMBERS)]
        lines += [f"### {block.capitalize()}", "", f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
        for row in group:
            cells = [row[name] for name in _TEXTS]
            cells += [" ".join(evaluation.cell(row, name, form)).strip() for name, form in _NUMBERS.items()]
            if 0 < row["scored_episodes"] < len(SEEDS):
                cells[len(_TEXTS)] += f" ({row['scored_episodes']} starts)"
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)
