"""The report: every controller on every task and tier, how it generalises, how it was learned, and what it does.

Everything is computed into tables first (:class:`Report`), then drawn, then written: CSV, PNG, and one HTML page that
holds its pictures and needs nothing else. Needs matplotlib and Jinja2 (extra "report").
"""

import base64
import contextlib
import dataclasses
import functools
import itertools
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from sd_friction_env import ENVIRONMENT_IDS, OscillatorParameters, Table, amplitude_curve, simulate
from sd_friction_env.control.policies import Actions, ConstantPolicy, Policy, State, ZeroPolicy
from sd_friction_env.learning import classical, evaluation, runs
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TASKS = ("force", "belt")
TIERS = ("nominal", "randomised", "sensed")
Key = tuple[str, str]  # task, tier
ENV_IDS: dict[Key, str] = dict(zip(itertools.product(TASKS, TIERS), ENVIRONMENT_IDS, strict=True))
Row = dict[str, Any]

_FOLDER = re.compile(rf"({'|'.join(TASKS)})-({'|'.join(TIERS)})-({'|'.join(runs.ALGORITHMS)})-(\d+)")
_LEARNING = ("steps", "seconds", "mean_return", "suppressed")  # columns read from evaluations.csv
_OPTIMUM_KNOWS = {"nominal": "", "randomised": " (told the parameters)", "sensed": " (sees all)"}
_SAMPLE = 0.05  # time between samples of a history
REACHED = (0.9, 0.95)  # scores whose time in training is told

# What a sweep varies: label, first and last value.
SWEEPS = {
    "belt_speed": (r"belt speed $v_b$", 0.02, 0.5),
    "alpha": (r"$\alpha$", 0.5, 1.0),
    "friction_drop": (r"$\mu_s - \mu_m$", 0.01, 0.19),
}
# Lines differ in dash too, so that grey prints and every eye tell them apart (Okabe and Ito's colours).
_LINES: tuple[dict[str, Any], ...] = (
    {"color": plotting.BLUE, "linestyle": "-", "marker": "o"},
    {"color": plotting.VERMILION, "linestyle": (0, (5, 1.5)), "marker": "s"},
    {"color": plotting.GREEN, "linestyle": (0, (3, 1, 1, 1)), "marker": "^"},
    {"color": "#CC79A7", "linestyle": (0, (1, 1)), "marker": "D"},
    {"color": "#E69F00", "linestyle": (0, (7, 2, 1, 2)), "marker": "v"},
    {"color": "#56B4E9", "linestyle": (0, (2, 2)), "marker": "P"},
)
_KINDS = {
    "baseline": {"color": plotting.GREY, "marker": "o"},
    "classical": {"color": plotting.VERMILION, "marker": "s"},
    "learned": {"color": plotting.BLUE, "marker": "D"},
    "optimum": {"color": plotting.BLACK, "marker": "*"},
}


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is computed.

    Attributes:
        episodes: the first so many of the protocol's 100. resamples: of each bootstrap.
        points: of each sweep. phases: starts on the passive cycle at each of them.
    """

    episodes: int = 100
    resamples: int = evaluation.RESAMPLES
    points: int = 33
    phases: int = 4


FULL, QUICK = Effort(), Effort(episodes=4, resamples=100, points=5, phases=1)


# Trained agents -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Agent:
    """A finished run: what it was trained for, its actor, and its evaluations during training."""

    name: str
    task: str
    tier: str
    algorithm: str
    seed: int
    policy: Policy
    evaluations: Table


def find_agents(folder: Path) -> tuple[list[Agent], list[str]]:
    """Return the runs in the folders TASK-TIER-ALGO-SEED of a folder, in order, and in words what was left out.

    Raises:
        runs.RunFolderError: if there is no such folder, a run is damaged or is not the one its name says.
    """
    if not folder.is_dir():
        raise runs.RunFolderError(f"there is no folder of agents {str(folder)!r}")
    agents, left_out = [], []
    for place in sorted(folder.iterdir()):
        if not place.is_dir() or place.name.startswith((".", "__")):
            continue
        named = _FOLDER.fullmatch(place.name)
        if named is None:
            left_out.append(f"{place.name!r} is left out: it is not called TASK-TIER-ALGO-SEED.")
            continue
        task, tier, algorithm, seed = named.groups()
        policy, config = runs.load_network(place), runs.load_config(place)
        is_named: tuple[Any, ...] = (ENV_IDS[task, tier], {}, algorithm, int(seed))
        environment = config["environment"]
        was = (environment["id"].rpartition(":")[2], environment["kwargs"], config["algorithm"], config["seed"])
        if was != is_named:
            raise runs.RunFolderError(f"{str(place)!r} must hold {is_named}, as its name says; it holds {was}")
        agents.append(Agent(place.name, task, tier, algorithm, int(seed), policy, _evaluations(place)))
    return sorted(agents, key=lambda a: (TASKS.index(a.task), TIERS.index(a.tier), a.algorithm, a.seed)), left_out


def _evaluations(place: Path) -> Table:
    path = place / runs.EVALUATIONS
    try:
        table = Table.from_csv(path)
    except (OSError, ValueError) as error:
        raise runs.RunFolderError(f"{str(path)!r} cannot be read: {' '.join(str(error).split())}") from None
    if not table.n_rows or any(name not in table or table[name].dtype.kind != "f" for name in _LEARNING):
        raise runs.RunFolderError(f"{str(path)!r} must have the columns {', '.join(_LEARNING)}, with numbers in them")
    return table


def _by_algorithm(agents: Iterable[Agent]) -> Iterator[tuple[str, list[Agent]]]:
    for algorithm, group in itertools.groupby(agents, key=lambda agent: agent.algorithm):
        yield algorithm.upper(), list(group)


# The table of controllers ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Replay:
    """A policy that takes stored actions, shape (n, steps), one sequence for each of n episodes side by side."""

    actions: NDArray[np.float32]

    def predict(
        self, observation: Any, state: State = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Actions, State]:
        """Return each episode's next action; the state is the number of those taken."""
        taken = 0 if state is None else int(state[0][0])
        return self.actions[:, taken, None], (np.array([taken + 1], np.float32),)


@dataclass(frozen=True)
class Comparison:
    """All controllers of one task and tier.

    Attributes:
        rows: a summary of each, as :func:`evaluation.summarise` makes them, with task, tier, kind ("baseline",
            "classical", "learned", "optimum"), runs and interval_over ("episodes" or "runs") beside.
        runs: a summary of each run. shown: the best classical controller and a middling run of the best algorithm, for
            pictures, by name. notes: what is missing.
    """

    rows: list[Row]
    runs: list[Row]
    shown: dict[str, Policy]
    notes: list[str]


def over_runs(name: str, summaries: Sequence[Row], *, seed: int, resamples: int) -> Row:
    """Return the interquartile means of several runs' summaries, with the stratified bootstrap's intervals.

    Values that some runs do not have (NaN) are taken over the others; a single run keeps its own intervals.
    """
    if len(summaries) == 1:
        return {**summaries[0], "controller": name, "runs": 1, "interval_over": "episodes"}
    row: Row = {"controller": name, "runs": len(summaries), "interval_over": "runs"}
    for key in summaries[0]:
        if key == "controller":
            continue
        values = np.array([summary[key] for summary in summaries], dtype=float)
        finite = values[np.isfinite(values)]
        row[key] = evaluation.interquartile_mean(finite) if finite.size else float("nan")
    for key in ("score", "suppressed"):
        values = np.array([summary[key] for summary in summaries], dtype=float)
        if np.isfinite(values).all():
            low, high = evaluation.run_interval([values], seed=seed, resamples=resamples)
            row |= {f"{key}_low": low, f"{key}_high": high}
    return row | {key: round(row[key]) for key in ("episodes", "scored_episodes")}


def compare(key: Key, agents: Sequence[Agent], effort: Effort, seed: int) -> Comparison:
    """Evaluate all controllers of a task and tier on the protocol's episodes.

    Args:
        agents: trained for this task and tier. seed: of the bootstraps.
    """
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
        notes.append("No tuned classical controllers are stored, and they are left out")
    baselines = {"passive": ZeroPolicy(), "constant -1": ConstantPolicy(-1.0), "constant +1": ConstantPolicy(1.0)}
    rows: list[Row] = []
    for kind, policies in (("baseline", baselines), ("classical", tuned)):
        alone = {"kind": kind, "runs": 1, "interval_over": "episodes"}
        rows += [alone | summary(name, policy) for name, policy in policies.items()]
    all_runs: list[Row] = []
    middling: dict[str, Policy] = {}
    for name, group in _by_algorithm(agents):
        summaries = [summary(agent.name, agent.policy) for agent in group]
        row = {"kind": "learned"} | over_runs(name, summaries, **how)
        away = [abs(one["return"] - row["return"]) for one in summaries]
        middling[name] = group[int(np.argmin(away))].policy
        rows.append(row)
        all_runs += [{"algorithm": name, **one} for one in summaries]
    if optimal is not None:
        rows.append(_optimum(key, seeds, optimal, passive_table, how))
    else:
        notes.append("No optimum is stored, hence there are no scores")
    shown = {}
    for kind, made in (("classical", tuned), ("learned", middling)):
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
    from sd_friction_env.learning import optimal as stored

    name = f"optimum{_OPTIMUM_KNOWS[key[1]]}"
    known = np.isfinite(optimal)
    row: Row = {"controller": name, "return": float(optimal[known].mean()), "score": 1.0}
    with contextlib.suppress(FileNotFoundError):
        stored_seeds, actions = stored.optimal_actions(ENV_IDS[key])
        starts = np.array(seeds)[known].tolist()
        policy = Replay(actions[[stored_seeds.index(start) for start in starts]])
        same = Table({column: values[known] for column, values in passive.items()})
        row = evaluation.summarise(name, evaluation.evaluate(policy, ENV_IDS[key], starts), same, optimal[known], **how)
        row |= {"score_low": float("nan"), "score_high": float("nan")}  # it is the measure
    count = int(known.sum())
    return {
        "kind": "optimum",
        "runs": 1,
        "interval_over": "episodes",
        **row,
        "episodes": count,
        "scored_episodes": count,
    }


def over_tasks(run_rows: Sequence[Row], *, seed: int, resamples: int) -> list[Row]:
    """Return, for each tier and algorithm with scored runs on both tasks, the interquartile mean over all of them."""
    rows = []
    for tier, algorithm in dict.fromkeys((row["tier"], row["algorithm"]) for row in run_rows):
        mine = [row for row in run_rows if (row["tier"], row["algorithm"]) == (tier, algorithm)]
        tasks = [[row for row in mine if row["task"] == task] for task in TASKS]
        if not all(tasks) or not np.isfinite([row["score"] for row in mine]).all():
            continue
        row: Row = {"tier": tier, "controller": algorithm, "kind": "learned", "runs": len(mine)}
        for key in ("score", "suppressed"):
            values = [np.array([one[key] for one in task]) for task in tasks]
            low, high = evaluation.run_interval(values, seed=seed, resamples=resamples)
            mean = evaluation.interquartile_mean(np.concatenate(values))
            row |= {key: mean, f"{key}_low": low, f"{key}_high": high}
        rows.append(row)
    return rows


# Other plants ---------------------------------------------------------------------------------------------------------


def swept_parameters(sweep: str, values: Any, nominal: OscillatorParameters) -> dict[str, Any]:
    """Return the parameters of a plant of a sweep, or (n,) of n plants; "friction_drop" moves mu_m and leaves mu_s."""
    return {"mu_m": nominal.mu_s - values} if sweep == "friction_drop" else {sweep: values}


def sweep_plants(task: str, sweep: str, policies: Mapping[str, tuple[str, Policy]], effort: Effort) -> list[Row]:
    """Return the settled amplitude of each controller on each plant of a sweep, passive first.

    Settled: over the last quarter of an episode, the greatest over the starts; NaN where contact is lost. The passive
    amplitude is that of the attractor (over the belt speed: the paper's Fig. 3), at finer steps.

    Args:
        sweep: a key of ``SWEEPS``. policies: by name, each with the tier whose environment it sees.
    """
    values = np.linspace(*SWEEPS[sweep][1:], effort.points)
    each = np.repeat(values, effort.phases)
    seeds = np.tile(evaluation.EVALUATION_SEEDS[: effort.phases], len(values)).tolist()

    def episodes(policy: Policy, env_id: str) -> evaluation.Episodes:
        env = evaluation.make_env(env_id)
        # What a tier would draw is told too: one parameter moves at a time.
        fixed = {name: np.full(len(each), getattr(env.nominal, name)) for name in env.task.randomise}
        options = {"parameters": fixed | swept_parameters(sweep, each, env.nominal)}
        return evaluation.run_episodes(policy, env_id, seeds, options=options)

    def rows(name: str, tier: str, **columns: Any) -> list[Row]:
        where = {"task": task, "sweep": sweep, "controller": name, "tier": tier}
        return [where | row for row in Table(columns).rows()]

    nominal_id = ENV_IDS[task, "nominal"]
    nominal = evaluation.make_env(nominal_id).nominal
    fine = np.linspace(*SWEEPS[sweep][1:], 4 * effort.points - 3)
    plants = [nominal.replace(**swept_parameters(sweep, value, nominal)) for value in fine.tolist()]
    attractors = [amplitude_curve(plant, plant.belt_speed)["amplitude"][0] for plant in plants]
    found = rows("passive", "nominal", value=fine, amplitude=attractors)
    passive, shape = episodes(ZeroPolicy(), nominal_id), (len(values), effort.phases)
    for name, (tier, policy) in policies.items():
        table = evaluation.metrics(episodes(policy, ENV_IDS[task, tier]), passive)
        amplitudes, suppressed = (table[column].reshape(shape) for column in ("late_amplitude", "suppressed"))
        columns = {"amplitude": amplitudes.max(axis=1), "suppressed": suppressed.mean(axis=1)}
        found += rows(name, tier, value=values, **columns)
    return found


# Histories and learning -----------------------------------------------------------------------------------------------


def history(policy: Policy, env_id: str, seed: int) -> Table:
    """Return an episode of ``reset(seed=seed)`` sampled finely (t, x, v, v_belt, action)."""
    env = evaluation.make_env(env_id)
    observation, first = env.reset(seed=seed)
    parameters, hold = env.parameters, env.task.control_interval
    state: State = None
    drive: list[tuple[float, float, float]] = []
    over = False
    while not over:
        action, state = policy.predict(observation[None], state, np.array([not drive]), deterministic=True)
        observation, _, terminated, truncated, info = env.step(action[0])
        drive.append((info["force"], info["belt_acceleration"], info["action"]))
        over = terminated or truncated
    force, belt_acceleration, action = np.array(drive).T
    start, end = (first["x"], first["v"]), len(drive) * hold
    path = simulate(parameters, *start, end, dt=_SAMPLE, force=force, belt_acceleration=belt_acceleration, hold=hold)
    held = np.minimum((path.t / hold + 1e-9).astype(int), len(drive) - 1)
    return Table({"t": path.t, "x": path.x, "v": path.v, "v_belt": path.v_belt, "action": action[held]})


def learning_curves(agents: Sequence[Agent]) -> list[Row]:
    """Return return and suppressed fraction over steps and over seconds of training, for each algorithm of each task
    and tier: interquartile mean, least and greatest of the runs, where all of them have been evaluated."""
    rows: list[Row] = []
    for (task, tier), those in itertools.groupby(agents, key=lambda agent: (agent.task, agent.tier)):
        for (algorithm, group), over in itertools.product(list(_by_algorithm(those)), ("steps", "seconds")):
            tables = [agent.evaluations for agent in group]
            first, last = max(t[over].min() for t in tables), min(t[over].max() for t in tables)
            at = np.unique(np.concatenate([t[over] for t in tables]))
            at = at[(at >= first) & (at <= last)]
            columns: dict[str, Any] = {"at": at}
            for name, column in (("return", "mean_return"), ("suppressed", "suppressed")):
                curves = np.array([np.interp(at, t[over], t[column]) for t in tables])
                columns |= {f"{name}_low": curves.min(axis=0), f"{name}_high": curves.max(axis=0)}
                columns[name] = scipy.stats.trim_mean(curves, 0.25, axis=0)
            where = {"task": task, "tier": tier, "algorithm": algorithm, "runs": len(group), "over": over}
            rows += [where | row for row in Table(columns).rows()]
    return rows


def training_times(agents: Sequence[Agent], passive: float, optimum: float) -> list[Row]:
    """Return for each run how long it took, and after how many seconds its evaluations first reached a score (NaN:
    never).

    Those evaluations are of the validation episodes; the score is by the means of the evaluation episodes.

    Args:
        agents: the runs. passive, optimum: mean returns.
    """
    rows: list[Row] = []
    for agent in agents:
        seconds, returns = agent.evaluations["seconds"], agent.evaluations["mean_return"]
        row: Row = {"task": agent.task, "tier": agent.tier, "run": agent.name}
        row |= {"steps": float(agent.evaluations["steps"][-1]), "seconds": float(seconds[-1])}
        for score in REACHED:
            there = seconds[(returns - passive) / (optimum - passive) >= score]
            row[f"seconds_to_{score:g}"] = float(there[0]) if len(there) else float("nan")
        rows.append(row)
    return rows


# Pictures -------------------------------------------------------------------------------------------------------------


@plotting.house_style()
def draw_scores(rows: Sequence[Row]) -> "Figure":
    """Draw scores and suppressed fractions of one task and tier with their intervals."""
    figure, axes = plotting.new_figure(9.0, 1.4 + 0.32 * len(rows), 1, 2, sharey=True)
    for axis, key in zip(axes[0], ("score", "suppressed"), strict=True):
        for place, row in enumerate(rows):
            value = row.get(key, float("nan"))
            if np.isfinite(value):
                ends = [row.get(f"{key}_low", value), row.get(f"{key}_high", value)]
                away = [[max(0.0, value - ends[0])], [max(0.0, ends[1] - value)]]
                style = _KINDS[row["kind"]]
                axis.errorbar([value], [place], xerr=away, fmt="none", ecolor=style["color"], capsize=3)
                axis.plot([value], [place], linestyle="none", markersize=7, **style)
    axes[0, 0].set_yticks(range(len(rows)), [row["controller"] for row in rows])
    axes[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    if not any(np.isfinite(row["score"]) for row in rows):
        axes[0, 0].text(0.5, 0.5, "no optimum is stored", transform=axes[0, 0].transAxes, ha="center")
    for reference in (0.0, 1.0):
        axes[0, 0].axvline(reference, color="0.6", linewidth=0.9, linestyle=(0, (4, 2)))
    axes[0, 0].set_xlabel("score (0 passive, 1 optimum)")
    axes[0, 1].set_xlabel("suppressed episodes")
    axes[0, 1].set_xlim(-0.04, 1.04)
    return figure


@plotting.house_style()
def draw_sweeps(rows: Sequence[Row], task: str) -> "Figure":
    """Draw the settled amplitudes of all sweeps of a task."""
    figure, axes = plotting.new_figure(8.0, 3.0 * len(SWEEPS) + 1.2, len(SWEEPS), 1)
    nominal = evaluation.make_env(ENV_IDS[task, "nominal"]).nominal
    drawn = evaluation.make_env(ENV_IDS[task, "randomised"]).task.randomise
    here = {"belt_speed": nominal.belt_speed, "alpha": nominal.alpha, "friction_drop": nominal.mu_s - nominal.mu_m}
    low, high = drawn["mu_m"]
    ranges = {**drawn, "friction_drop": (nominal.mu_s - high, nominal.mu_s - low)}
    for axis, (sweep, (label, *_)) in zip(axes[:, 0], SWEEPS.items(), strict=True):
        axis.axvspan(*ranges[sweep], color="0.95", zorder=0, label="drawn in the randomised tier")
        axis.axvline(here[sweep], color="0.6", linewidth=0.9, linestyle=(0, (4, 2)), label="nominal")
        names = list(dict.fromkeys(row["controller"] for row in rows))
        for name in names:
            mine = [row for row in rows if row["sweep"] == sweep and row["controller"] == name]
            style = _PASSIVE if name == "passive" else _LINES[(names.index(name) - 1) % len(_LINES)]
            axis.plot(
                [row["value"] for row in mine], [row["amplitude"] for row in mine], label=name, markersize=4, **style
            )
        axis.set_xlabel(label)
        axis.set_ylabel("settled amplitude")
        axis.set_ylim(bottom=-0.01)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


_PASSIVE: dict[str, Any] = {"color": plotting.GREY, "linestyle": "-", "linewidth": 2.5}


@plotting.house_style()
def draw_learning(rows: Sequence[Row], references: Mapping[str, float]) -> "Figure":
    """Draw the learning curves of one task and tier: line the interquartile mean over runs, band least to greatest.

    Args:
        references: returns to be marked, by name.
    """
    from matplotlib.ticker import EngFormatter

    figure, axes = plotting.new_figure(9.0, 6.2, 2, 2, sharex="col", sharey="row")
    algorithms = list(dict.fromkeys(row["algorithm"] for row in rows))
    for column, over in enumerate(("steps", "seconds")):
        for style, algorithm in zip(_LINES, algorithms, strict=False):
            mine = [row for row in rows if (row["algorithm"], row["over"]) == (algorithm, over)]
            table = Table({name: [row[name] for row in mine] for name in rows[0]})
            if not table.n_rows:
                continue
            label = f"{algorithm}, {mine[0]['runs']} run{'s' if mine[0]['runs'] > 1 else ''}"
            marker = {} if table.n_rows < 2 else {"marker": ""}
            for axis, name, sign in ((axes[0, column], "return", -1.0), (axes[1, column], "suppressed", 1.0)):
                axis.plot(table["at"], sign * table[name], label=label, **(style | marker))
                ends = (sign * table[f"{name}_low"], sign * table[f"{name}_high"])
                axis.fill_between(table["at"], *ends, color=style["color"], alpha=0.18, linewidth=0.0)
        for (name, value), dash in zip(references.items(), ((0, (1, 2)), (0, (6, 3))), strict=False):
            axes[0, column].axhline(-value, color="0.35", linewidth=1.0, linestyle=dash, label=name)
        axes[1, column].set_xlabel("environment steps" if over == "steps" else "seconds of training")
        axes[0, column].set_yscale("log")
        for formatter in (axes[0, column].yaxis.set_major_formatter, axes[0, column].yaxis.set_minor_formatter):
            formatter("{x:g}")
        axes[1, column].set_ylim(-0.04, 1.04)
    axes[1, 0].xaxis.set_major_formatter(EngFormatter(sep=""))
    axes[0, 0].set_ylabel("minus return (less is better)")
    axes[1, 0].set_ylabel("suppressed")
    axes[0, 0].legend(fontsize=8, frameon=True)
    return figure


@plotting.house_style()
def draw_histories(histories: Mapping[str, Table]) -> "Figure":
    """Draw displacement, velocity, action and phase portrait of histories from one start, passive first."""
    figure, axes = plotting.new_figure(11.0, 6.2, 2, 2, width_ratios=(1.6, 1.0))
    lines = [_PASSIVE | {"linewidth": 1.4}, *_LINES]
    for (name, path), style in zip(histories.items(), lines, strict=False):
        look = {"linewidth": 1.3} | style | {"marker": ""}
        axes[0, 0].plot(path["t"], path["x"], label=name, **look)
        axes[1, 0].plot(path["t"], path["v"], **look)
        axes[0, 1].plot(path["x"], path["v"], **look)
        axes[0, 1].plot(path["x"][-1:], path["v"][-1:], color=look["color"], marker=style.get("marker", "o"))
        axes[1, 1].plot(path["t"], path["action"], **look)
        if np.ptp(path["v_belt"]) > 0.0:
            axes[1, 0].plot(path["t"], path["v_belt"], color=look["color"], linewidth=0.8, alpha=0.6)
    passive = next(iter(histories.values()))
    axes[1, 0].axhline(passive["v_belt"][0], color="0.35", linewidth=0.9, linestyle=(0, (6, 3)), label="nominal belt")
    time, velocity = r"time $\tau$", r"velocity $\dot x$"
    labels = ((time, r"displacement $x$"), (r"$x$", velocity), (time, f"{velocity}; thin: belt"), (time, "action"))
    for axis, (x_label, y_label) in zip(axes.flat, labels, strict=True):
        axis.set_xlabel(x_label)
        axis.set_ylabel(y_label)
    axes[0, 0].margins(x=0)
    axes[1, 0].margins(x=0)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure


# The report -----------------------------------------------------------------------------------------------------------

_COLUMNS = (
    ("score", "score", "{:.3f}"),
    ("suppressed", "suppressed", "{:.0%}"),
    ("reduction", "amplitude reduction", "{:.1%}"),
    ("stick", "stick fraction", "{:.3f}"),
    ("settling", "settling time", "{:.1f}"),
    ("rms_action", "rms effort", "{:.3f}"),
    ("residual", "late rms effort", "{:.4f}"),
    ("belt_speed", "belt speed / nominal", "{:.3f}"),
    ("return", "return", "{:.1f}"),
    ("runs", "runs", "{:.0f}"),
    ("scored_episodes", "episodes scored", "{:.0f}"),
)


@dataclass
class Report:
    """What is to be reported, and what of it has been computed so far.

    Attributes:
        agents: trained ones, as :func:`find_agents` returns them. keys: tasks and tiers to report.
        effort: how much is computed. seed: of the bootstraps. notes: in words, what the reader must know.
    """

    agents: Sequence[Agent]
    keys: Sequence[Key]
    effort: Effort = FULL
    seed: int = 0
    notes: list[str] = dataclasses.field(default_factory=list)
    comparisons: dict[Key, Comparison] = dataclasses.field(default_factory=dict)
    sweeps: list[Row] = dataclasses.field(default_factory=list)
    histories: dict[Key, dict[str, Table]] = dataclasses.field(default_factory=dict)
    learning: list[Row] = dataclasses.field(default_factory=list)
    training: list[Row] = dataclasses.field(default_factory=list)
    pictures: dict[str, tuple[bytes, str]] = dataclasses.field(default_factory=dict)

    def stages(self) -> list[tuple[str, Callable[[], None]]]:
        """Return what is to be done, in order, each with its name; nothing is written."""
        tasks = list(dict.fromkeys(task for task, _ in self.keys))
        stages: list[tuple[str, Callable[[], None]]] = []
        for key in self.keys:
            for what, work in (("controllers", self._compare), ("histories", self._follow)):
                stages.append((f"{what}, {' '.join(key)}", functools.partial(work, key)))
        for task, sweep in itertools.product(tasks, SWEEPS):
            stages.append((f"sweep, {task} {sweep}", functools.partial(self._sweep, task, sweep)))
        stages.append(("learning curves", self._learn))
        stages += [(f"pictures, {' '.join(key)}", functools.partial(self._draw, key)) for key in self.keys]
        return [*stages, *((f"pictures, {task}", functools.partial(self._draw_sweeps, task)) for task in tasks)]

    def _compare(self, key: Key) -> None:
        mine = [agent for agent in self.agents if (agent.task, agent.tier) == key]
        self.comparisons[key] = compare(key, mine, self.effort, self.seed)

    def remarks(self) -> list[str]:
        """Return the notes, and what is missing with the tasks and tiers where it is."""
        missing: dict[str, list[str]] = {}
        for key, comparison in self.comparisons.items():
            for note in comparison.notes:
                missing.setdefault(note, []).append(" ".join(key))
        return [*self.notes, *(f"{note}: {', '.join(names)}." for note, names in missing.items())]

    def _follow(self, key: Key) -> None:
        shown: dict[str, Policy] = {"passive": ZeroPolicy(), **self.comparisons[key].shown}
        seed = evaluation.EVALUATION_SEEDS[0]
        self.histories[key] = {name: history(policy, ENV_IDS[key], seed) for name, policy in shown.items()}

    def _sweep(self, task: str, sweep: str) -> None:
        chosen = {
            f"{name} ({tier})": (tier, policy)
            for tier in TIERS
            if (task, tier) in self.comparisons
            for name, policy in self.comparisons[task, tier].shown.items()
        }
        self.sweeps += sweep_plants(task, sweep, chosen, self.effort)

    def _learn(self) -> None:
        self.learning = learning_curves([agent for agent in self.agents if (agent.task, agent.tier) in self.keys])
        for key, comparison in self.comparisons.items():
            passive, best = comparison.rows[0], comparison.rows[-1]
            # On the randomised tier the optimum is known for some of the episodes only: their means do not compare.
            if best["kind"] == "optimum" and best["scored_episodes"] == passive["episodes"]:
                those = [agent for agent in self.agents if (agent.task, agent.tier) == key]
                self.training += training_times(those, passive["return"], best["return"])

    def _draw(self, key: Key) -> None:
        name, words, rows = "-".join(key), f"{key[0]} task, {key[1]} tier", self.comparisons[key].rows
        self._keep(f"scores-{name}", draw_scores(rows), f"Scores and suppressed share, {words}.")
        caption = f"One episode from the same start under each controller, {words}; the dot is its end."
        self._keep(f"history-{name}", draw_histories(self.histories[key]), caption)
        mine = [row for row in self.learning if (row["task"], row["tier"]) == key]
        if mine:
            marks = {
                row["controller"]: row["return"]
                for row in rows
                if row["kind"] == "optimum" and row["scored_episodes"] == rows[0]["episodes"]
            }
            caption = f"Learning, {words}: interquartile mean over runs, and the band from the least to the greatest."
            for score in REACHED:
                times = [row[f"seconds_to_{score:g}"] for row in self.training if (row["task"], row["tier"]) == key]
                there = [time for time in times if time == time]
                if there:
                    caption += f" Score {score:g} was reached in {len(there)} of {len(times)} runs,"
                    caption += f" after {np.median(there):.0f} s ({min(there):.0f} to {max(there):.0f})."
            self._keep(f"learning-{name}", draw_learning(mine, {"passive": rows[0]["return"], **marks}), caption)

    def _draw_sweeps(self, task: str) -> None:
        caption = (
            f"Settled amplitude on other plants, {task} task, one parameter moved at a time; each controller was made "
            "for the tier in brackets. A gap: contact is lost."
        )
        figure = draw_sweeps([row for row in self.sweeps if row["task"] == task], task)
        self._keep(f"sweeps-{task}", figure, caption)

    def _keep(self, name: str, figure: "Figure", caption: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "figure.png"
            plotting.save_figure(figure, path, dpi=110)
            self.pictures[name] = (path.read_bytes(), caption)

    def tables(self) -> dict[str, Table]:
        """Return all tables, by the names of their files (less ".csv")."""
        rows = [row for comparison in self.comparisons.values() for row in comparison.rows]
        run_rows = [row for comparison in self.comparisons.values() for row in comparison.runs]
        histories = [
            {"task": task, "tier": tier, "controller": name, **row}
            for (task, tier), paths in self.histories.items()
            for name, path in paths.items()
            for row in path.rows()
        ]
        made = {
            "controllers": rows,
            "runs": run_rows,
            "overall": self.overall(),
            "sweeps": self.sweeps,
            "learning": self.learning,
            "training": self.training,
            "histories": histories,
        }
        return {name: _table(rows) for name, rows in made.items() if rows}

    def overall(self) -> list[Row]:
        """Return the rows of :func:`over_tasks`."""
        run_rows = [row for comparison in self.comparisons.values() for row in comparison.runs]
        return over_tasks(run_rows, seed=self.seed, resamples=self.effort.resamples)

    def summary(self) -> str:
        """Return a Markdown table: for each task and tier a constant action, the best classical and the best learned
        controller (by score, of the learned ones with the most runs), each with its score and, after it, its share of
        suppressed episodes."""
        lines = ["| task, tier | constant -1 | best classical | best learned |", "|---|---|---|---|"]
        for key, comparison in self.comparisons.items():
            cells = []
            for kind in ("baseline", "classical", "learned"):
                those = [row for row in comparison.rows if row["kind"] == kind and row["score"] == row["score"]]
                if kind == "baseline":
                    those = [row for row in those if row["controller"] == "constant -1"]
                if not those:
                    cells.append("-")
                    continue
                most = max(row["runs"] for row in those)  # one run may be a lucky one
                best = max((row for row in those if row["runs"] == most), key=lambda row: row["score"])
                interval = f" [{best['score_low']:.3f}, {best['score_high']:.3f}]" if kind == "learned" else ""
                trained = f" ({best['runs']} run{'s' if best['runs'] > 1 else ''})" if kind == "learned" else ""
                name = "" if kind == "baseline" else f"{best['controller']}{trained}: "
                cells.append(f"{name}{best['score']:.3f}{interval}, {best['suppressed']:.0%}")
            lines.append(f"| {key[0]}, {key[1]} | {' | '.join(cells)} |")
        return "\n".join(lines) + "\n"

    def html(self, origin: str) -> str:
        """Return the page; ``origin`` says at its foot what it was made with."""
        import jinja2

        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
            trim_blocks=True,
        )
        sections = [
            self._section(f"{key[0].capitalize()}, {key[1]}", "-".join(key), comparison.rows)
            for key, comparison in self.comparisons.items()
        ]
        if self.overall():
            text = "Interquartile means over the runs of both tasks."
            rows = [row | {"controller": f"{row['controller']}, {row['tier']}"} for row in self.overall()]
            sections.append(self._section("Over both tasks", "overall", rows, text))
        sections.append(self._section("Other plants", "sweeps", []))
        return environment.get_template("report.html").render(
            title="Friction-induced vibration: what control does",
            summary=f"{len(self.agents)} trained agents and the yardsticks, {self.effort.episodes} episodes each.",
            notes=self.remarks(),
            sections=sections,
            origin=origin,
        )

    def _section(self, title: str, anchor: str, rows: Sequence[Row], text: str = "") -> dict[str, Any]:
        columns = [column for column in _COLUMNS if any(column[0] in row for row in rows)]
        mine = [name for name in self.pictures if name.endswith(f"-{anchor}") or name.startswith(f"{anchor}-")]
        return {
            "title": title,
            "anchor": anchor,
            "text": text,
            "columns": ["controller", *(name for _, name, _ in columns)],
            "rows": [
                {"kind": row["kind"], "cells": [{"value": row["controller"], "interval": ""}, *_cells(row, columns)]}
                for row in rows
            ],
            "pictures": [
                {"data": base64.b64encode(self.pictures[name][0]).decode(), "caption": self.pictures[name][1]}
                for name in mine
            ],
        }

    def write(self, folder: Path, origin: str) -> list[Path]:
        """Write tables, pictures and page into a folder, all of them or none; return the files.

        Raises:
            OSError: if they cannot be written.
        """
        contents = {f"{name}.png": data for name, (data, _) in self.pictures.items()}
        tables, page = self.tables(), self.html(origin)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as place:
            for name, data in contents.items():
                (Path(place) / name).write_bytes(data)
            for name, table in tables.items():
                table.metadata["made by"] = origin
                table.to_csv(Path(place) / f"{name}.csv")
            (Path(place) / "summary.md").write_text(self.summary(), encoding="utf-8")
            with atomic_file(Path(place) / "report.html") as file:
                file.write(page)
            folder.mkdir(exist_ok=True)
            names = sorted(os.listdir(place), key=lambda name: name == "report.html")  # the page last
            for name in names:
                os.replace(Path(place) / name, folder / name)
        return [folder / name for name in names]


def _table(rows: Sequence[Row]) -> Table:
    """Return rows as a table with the columns of all of them, NaN where a row has none."""
    names = dict.fromkeys(name for row in rows for name in row)
    return Table({name: [row.get(name, float("nan")) for row in rows] for name in names})


def _cells(row: Row, columns: Iterable[tuple[str, str, str]]) -> Iterator[dict[str, str]]:
    for key, _, form in columns:
        value, low, high = (row.get(name, float("nan")) for name in (key, f"{key}_low", f"{key}_high"))
        interval = f"[{form.format(low)}, {form.format(high)}]" if np.isfinite(low) else ""
        yield {"value": form.format(value) if np.isfinite(value) else "-", "interval": interval}
