"""The report itself: computed stage by stage, then written as tables, pictures and one page."""

import base64
import dataclasses
import functools
import itertools
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sd_friction_env import Table
from sd_friction_env.control.policies import Policy, ZeroPolicy
from sd_friction_env.learning import evaluation
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure
from sd_friction_env.environments.ids import TIERS
from sd_friction_env.learning.report.agents import ENV_IDS, Agent, Key, Row
from sd_friction_env.learning.report.comparison import FULL, Comparison, Effort, compare, over_tasks
from sd_friction_env.learning.report.curves import (
    REACHED,
    SWEEPS,
    history,
    learning_curves,
    sweep_plants,
    training_times,
)
from sd_friction_env.learning.report.pictures import draw_histories, draw_learning, draw_scores, draw_sweeps

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
    """A report, and what has been computed of it so far.

    Attributes:
        agents: as :func:`find_agents` returns them. keys: tasks and tiers to report. effort: how much is computed.
        seed: of the bootstraps. notes: for the reader, such as what is left out.
        comparisons, sweeps, histories, learning, training: filled by the stages. pictures: PNG and caption by name.
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
        """Return the computations in order, each with its name; they write nothing."""
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
        """Return the notes, and those of the comparisons with their tasks and tiers."""
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
        name, where, rows = "-".join(key), f"{key[0]} task, {key[1]} tier", self.comparisons[key].rows
        self._keep(f"scores-{name}", draw_scores(rows), f"Scores and suppressed share, {where}.")
        caption = f"One episode from the same start under each controller, {where}; the dot marks its end."
        self._keep(f"history-{name}", draw_histories(self.histories[key]), caption)
        mine = [row for row in self.learning if (row["task"], row["tier"]) == key]
        if mine:
            marks = {
                row["controller"]: row["return"]
                for row in rows
                if row["kind"] == "optimum" and row["scored_episodes"] == rows[0]["episodes"]
            }
            caption = f"Learning, {where}: interquartile mean over runs, and the band from the smallest to the largest."
            for score in REACHED:
                times = [row[f"seconds_to_{score:g}"] for row in self.training if (row["task"], row["tier"]) == key]
                reached = [time for time in times if np.isfinite(time)]
                if reached:
                    caption += f" Score {score:g} was reached in {len(reached)} of {len(times)} runs,"
                    caption += f" after {np.median(reached):.0f} s ({min(reached):.0f} to {max(reached):.0f})."
            self._keep(f"learning-{name}", draw_learning(mine, {"passive": rows[0]["return"], **marks}), caption)

    def _draw_sweeps(self, task: str) -> None:
        caption = (
            f"Settled amplitude on other plants, {task} task, one parameter varied at a time; each controller was made "
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
        return {name: Table.from_rows(rows) for name, rows in made.items() if rows}

    def overall(self) -> list[Row]:
        """Return the rows of :func:`over_tasks`."""
        run_rows = [row for comparison in self.comparisons.values() for row in comparison.runs]
        return over_tasks(run_rows, seed=self.seed, resamples=self.effort.resamples)

    def summary(self) -> str:
        """Return a Markdown table: for each task and tier, the score and the suppressed share of a constant action, of
        the best classical and of the best learned controller (of those with the most runs)."""
        lines = ["| task, tier | constant -1 | best classical | best learned |", "|---|---|---|---|"]
        for key, comparison in self.comparisons.items():
            cells = [_best(comparison.rows, kind) for kind in ("baseline", "classical", "learned")]
            lines.append(f"| {key[0]}, {key[1]} | {' | '.join(cells)} |")
        return "\n".join(lines) + "\n"

    def html(self, origin: str) -> str:
        """Return the page, with ``origin`` (how it was made) at its foot."""
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
            title="Friction-induced vibration under control",
            summary=f"{len(self.agents)} trained agents and their references, {self.effort.episodes} episodes each.",
            notes=self.remarks(),
            sections=sections,
            origin=origin,
        )

    def _section(self, title: str, anchor: str, rows: Sequence[Row], text: str = "") -> dict[str, Any]:
        columns = [column for column in _COLUMNS if any(column[0] in row for row in rows)]
        mine = [
            picture
            for name, picture in self.pictures.items()
            if name.endswith(f"-{anchor}") or name.startswith(f"{anchor}-")
        ]
        return {
            "title": title,
            "anchor": anchor,
            "text": text,
            "columns": ["controller", *(name for _, name, _ in columns)],
            "rows": [
                (row["kind"], [(row["controller"], ""), *(evaluation.cell(row, key, form) for key, _, form in columns)])
                for row in rows
            ],
            "pictures": [(base64.b64encode(data).decode(), caption) for data, caption in mine],
        }

    def write(self, folder: Path, origin: str) -> list[Path]:
        """Write tables, pictures and page into a folder, all of them or none; return the files."""
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


def _best(rows: Sequence[Row], kind: str) -> str:
    """Return the best controller of a kind with its score and suppressed share; the baseline is a constant -1."""
    those = [row for row in rows if row["kind"] == kind and np.isfinite(row["score"])]
    if kind == "baseline":
        those = [row for row in those if row["controller"] == "constant -1"]
    if not those:
        return "-"
    most = max(row["runs"] for row in those)  # a single run may be a lucky one
    best = max((row for row in those if row["runs"] == most), key=lambda row: row["score"])
    score, interval = evaluation.cell(best, "score", "{:.3f}")
    figures = f"{score}{f' {interval}' if kind == 'learned' else ''}, {best['suppressed']:.0%}"
    runs = f" ({most} run{'s' if most > 1 else ''})" if kind == "learned" else ""
    return figures if kind == "baseline" else f"{best['controller']}{runs}: {figures}"
