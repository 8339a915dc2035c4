"""The table of controllers: every controller of a task and tier on the protocol's episodes."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import Table
from sd_friction_env.control.policies import Actions, ConstantPolicy, Policy, State, ZeroPolicy
from sd_friction_env.environments.ids import TASKS
from sd_friction_env.learning import classical, evaluation, scores
from sd_friction_env.learning import optimal as stored
from sd_friction_env.learning.report.agents import ENV_IDS, Agent, Key, Row, by_algorithm

_OPTIMUM_KNOWS = {"nominal": "", "randomised": " (knows the parameters)", "sensed": " (sees all)"}


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Amount of computation.

    Attributes:
        episodes: the first of the protocol's 100. resamples: of each bootstrap.
        points: of each sweep. phases: starts on the passive cycle at each of them.
    """

    episodes: int = 100
    resamples: int = scores.RESAMPLES
    points: int = 33
    phases: int = 4


FULL, QUICK = Effort(), Effort(episodes=4, resamples=100, points=5, phases=1)


@dataclass(frozen=True)
class Replay:
    """A policy that replays stored actions, shape (n, steps), one sequence for each of n episodes side by side."""

    actions: NDArray[np.float32]

    def predict(
        self, observation: Any, state: State = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Actions, State]:
        """Return each episode's next action; the state is the number of actions taken."""
        taken = 0 if state is None else int(state[0][0])
        return self.actions[:, taken, None], (np.array([taken + 1], np.float32),)


@dataclass(frozen=True)
class Comparison:
    """All controllers of one task and tier.

    Attributes:
        rows: a summary of each, as :func:`evaluation.summarise` makes them, with task, tier, kind ("baseline",
            "classical", "learned", "optimum"), runs and interval_over ("episodes" or "runs") added.
        runs: a summary of each run. shown: by name, for pictures: the best classical controller and a typical
            run of the best algorithm. notes: what is missing.
    """

    rows: list[Row]
    runs: list[Row]
    shown: dict[str, Policy]
    notes: list[str]


_WITH_INTERVALS = ("score", "suppressed")


def _ends(key: str, groups: Sequence[NDArray[np.float64]], seed: int, resamples: int) -> Row:
    low, high = scores.run_interval(groups, seed=seed, resamples=resamples)
    return {f"{key}_low": low, f"{key}_high": high}


def over_runs(name: str, summaries: Sequence[Row], *, seed: int, resamples: int) -> Row:
    """Return the interquartile means of several runs' summaries, with the stratified bootstrap's intervals.

    Means leave out runs whose value is NaN; a single run keeps its own intervals.
    """
    if len(summaries) == 1:
        return {**summaries[0], "controller": name, "runs": 1, "interval_over": "episodes"}
    row: Row = {"controller": name, "runs": len(summaries), "interval_over": "runs"}
    ends: Row = {}
    for key in summaries[0]:
        if key == "controller":
            continue
        values = np.array([summary[key] for summary in summaries], dtype=float)
        finite = values[np.isfinite(values)]
        row[key] = scores.interquartile_mean(finite) if finite.size else float("nan")
        if key in _WITH_INTERVALS and np.isfinite(values).all():
            ends |= _ends(key, [values], seed, resamples)
    row |= ends  # in place of the means of the runs' own intervals
    return row | {key: round(row[key]) for key in ("episodes", "scored_episodes")}


def compare(key: Key, agents: Sequence[Agent], effort: Effort, seed: int) -> Comparison:
    """Evaluate all controllers of a task and tier on the protocol's episodes."""
    env_id, seeds = ENV_IDS[key], evaluation.EVALUATION_SEEDS[: effort.episodes]
    passive = evaluation.passive_episodes(env_id, seeds)
    passive_table = evaluation.metrics(passive, passive)
    optimal = evaluation.optimal_returns(env_id, seeds)
    how = {"seed": seed, "resamples": effort.resamples}

    def summary(name: str, policy: Policy) -> Row:
        table = evaluation.evaluate(policy, env_id, seeds, passive=passive)
        return evaluation.summarise(name, table, passive_table, optimal, **how)

    notes = []
    try:
        tuned = classical.classical_controllers(env_id)
    except classical.NotTunedError:
        tuned = {}
        notes.append("Left out, because no tuned classical controllers are stored")
    baselines = {"passive": ZeroPolicy(), "constant -1": ConstantPolicy(-1.0), "constant +1": ConstantPolicy(1.0)}
    rows: list[Row] = []
    for kind, policies in (("baseline", baselines), ("classical", tuned)):
        alone = {"kind": kind, "runs": 1, "interval_over": "episodes"}
        rows += [alone | summary(name, policy) for name, policy in policies.items()]
    all_runs: list[Row] = []
    typical: dict[str, Policy] = {}
    for name, group in by_algorithm(agents):
        summaries = [summary(agent.name, agent.policy) for agent in group]
        row = {"kind": "learned"} | over_runs(name, summaries, **how)
        away = [abs(one["return"] - row["return"]) for one in summaries]
        typical[name] = group[int(np.argmin(away))].policy
        rows.append(row)
        all_runs += [{"algorithm": name, **one} for one in summaries]
    if optimal is not None:
        rows.append(_optimum(key, seeds, optimal, passive_table, how))
    else:
        notes.append("No scores, because no optimum is stored")
    shown = {}
    for kind, made in (("classical", tuned), ("learned", typical)):
        those = [row for row in rows if row["kind"] == kind]
        if those:
            best = max(those, key=lambda row: (row["suppressed"], row["return"]))["controller"]
            shown[best] = made[best]
    where = {"task": key[0], "tier": key[1]}
    return Comparison([where | row for row in rows], [where | row for row in all_runs], shown, notes)


def _optimum(
    key: Key, seeds: Sequence[int], optimal: NDArray[np.float64], passive: Table, how: Mapping[str, int]
) -> Row:
    """Return the row of the optimum over the episodes whose optimum is known; its metrics if its actions are stored."""
    name = f"optimum{_OPTIMUM_KNOWS[key[1]]}"
    known = np.isfinite(optimal)
    row: Row = {"controller": name, "return": float(optimal[known].mean()), "score": 1.0}
    with contextlib.suppress(FileNotFoundError):
        stored_seeds, actions = stored.optimal_actions(ENV_IDS[key])
        starts = np.array(seeds)[known].tolist()
        policy = Replay(actions[[stored_seeds.index(start) for start in starts]])
        same = Table({column: values[known] for column, values in passive.items()})
        row = evaluation.summarise(name, evaluation.evaluate(policy, ENV_IDS[key], starts), same, optimal[known], **how)
        row |= {"score_low": float("nan"), "score_high": float("nan")}  # it defines the score
    count = int(known.sum())
    about = {"kind": "optimum", "runs": 1, "interval_over": "episodes"}
    return {**about, **row, "episodes": count, "scored_episodes": count}


def over_tasks(run_rows: Sequence[Row], *, seed: int, resamples: int) -> list[Row]:
    """Return, for each tier and algorithm with scored runs on both tasks, the interquartile mean over all of them."""
    rows = []
    for tier, algorithm in dict.fromkeys((row["tier"], row["algorithm"]) for row in run_rows):
        mine = [row for row in run_rows if (row["tier"], row["algorithm"]) == (tier, algorithm)]
        tasks = [[row for row in mine if row["task"] == task] for task in TASKS]
        if not all(tasks) or not np.isfinite([row["score"] for row in mine]).all():
            continue
        row: Row = {"tier": tier, "controller": algorithm, "kind": "learned", "runs": len(mine)}
        for key in _WITH_INTERVALS:
            values = [np.array([one[key] for one in task]) for task in tasks]
            row[key] = scores.interquartile_mean(np.concatenate(values))
            row |= _ends(key, values, seed, resamples)
        rows.append(row)
    return rows
