"""Timing in turns: contenders, rounds, medians and ratios; checks and targets."""

import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

Slice = Callable[[], float]


def rate_of(work: Callable[[], object], steps: int) -> float:
    """Return how many of its ``steps`` some work does a second."""
    begin = time.perf_counter()
    work()
    return steps / (time.perf_counter() - begin)


class Contender(NamedTuple):
    """One thing to time: ``slice()`` runs it for a while and returns its rate (or time) in ``unit``.

    ``panel`` is the part of the plot that shows it; "" for none.
    """

    label: str
    slice: Slice
    ours: bool = False
    panel: str = ""
    unit: str = "steps/s"


@dataclasses.dataclass
class Row:
    """The values of a contender, one per round."""

    unit: str
    ours: bool
    panel: str
    values: list[float] = dataclasses.field(default_factory=list)

    @property
    def median(self) -> float:
        """The median over the rounds."""
        return statistics.median(self.values)

    @property
    def quartiles(self) -> tuple[float, float]:
        """The lower and the upper quartile over the rounds."""
        low, high = np.quantile(self.values, (0.25, 0.75)).tolist()
        return low, high


Rows = dict[str, dict[str, Row]]
Numbers = dict[str, dict[str, float]]


def ratio_of(row: Row, reference: Row) -> float:
    """Return the median over the rounds of one contender's value divided by another's in the same round."""
    return statistics.median(a / b for a, b in zip(row.values, reference.values, strict=False))


def best_ratio(rows: Mapping[str, Row], ours: Sequence[str], others: Sequence[str]) -> float | None:
    """Return the best of our contenders' ratios, each to the fastest of the others; None if one side is missing."""
    here = [rows[label] for label in ours if label in rows]
    there = [rows[label] for label in others if label in rows]
    if not here or not there:
        return None
    return max(min(ratio_of(row, other) for other in there) for row in here)


class Check(NamedTuple):
    """A condition under which the timings are valid: a value below a bound."""

    what: str
    value: float
    bound: float

    @property
    def met(self) -> bool:
        """Whether the value is below its bound."""
        return self.value < self.bound


class Target(NamedTuple):
    """A target for a number; ``reached`` is None where it was not measured."""

    what: str
    reached: float | None
    bound: float
    at_least: bool = True

    @property
    def met(self) -> bool | None:
        """Whether it is reached; None: unknown."""
        if self.reached is None or math.isnan(self.reached):
            return None
        return self.reached >= self.bound if self.at_least else self.reached < self.bound


class Bench:
    """The measurements of one run, and the length of its slices."""

    def __init__(self, *, quick: bool, rounds: int | None, steps: int | None, peers: Path | None) -> None:
        self.quick = quick
        self.rounds = rounds or (3 if quick else 15)
        self.steps = steps
        self.peers = peers
        self.rows: Rows = {}
        self.numbers: Numbers = {}
        self.checks: list[Check] = []
        self.skipped: dict[str, str] = {}
        self._began = time.perf_counter()

    def length(self, full: int, quick: int) -> int:
        """Return the number of steps in a slice: as the command line says, or one of these."""
        return self.steps or (quick if self.quick else full)

    def progress(self, text: str, *, passing: bool = False) -> None:
        """Print progress on stderr; ``passing`` text is shown on a terminal only, and overwritten."""
        terminal = sys.stderr.isatty()
        if not passing or terminal:
            line = f"[{time.perf_counter() - self._began:5.0f} s] {text}"
            print(f"\r\x1b[K{line}" if terminal else line, end="" if passing else "\n", file=sys.stderr, flush=True)

    def measure(
        self, section: str, title: str, contenders: Sequence[Contender], reference: str = "", rounds: int | None = None
    ) -> dict[str, Row]:
        """Time the contenders, one slice each per round after one that does not count, and print the table."""
        rounds = rounds or self.rounds
        every = {each.label: Row(each.unit, each.ours, each.panel) for each in contenders}
        self.rows.setdefault(section, {}).update(every)
        try:
            for each in contenders:
                self.progress(f"{section}: warming up {each.label}", passing=True)
                each.slice()
            for k in range(rounds):
                self.progress(f"{section}: round {k + 1}/{rounds}", passing=True)
                # Back and forth: a drift of the machine then favours nobody.
                for each in contenders if k % 2 == 0 else reversed(contenders):
                    every[each.label].values.append(each.slice())
        finally:
            for label in [label for label, row in every.items() if not row.values]:
                del self.rows[section][label], every[label]
            print_rows(title, every, reference)
        return every

    def note(self, section: str, name: str, value: float, text: str) -> None:
        """Keep a number and print it."""
        self.numbers.setdefault(section, {})[name] = float(value)
        print(f"  {name:62} {text}", flush=True)

    def check(self, what: str, value: float, bound: float) -> None:
        """Check that a value is below a bound; the run's exit status is 1 if one is not."""
        self.checks.append(Check(what, float(value), bound))
        print(f"  {what:62} {value:.1e} (allowed {bound:.0e}){'' if self.checks[-1].met else '   FAILED'}", flush=True)

    def skip(self, section: str, why: str) -> None:
        """Record and print why something is left out."""
        self.skipped[section] = why
        print(f"\n{section}: skipped, {why}", flush=True)


def print_rows(title: str, rows: Mapping[str, Row], reference: str = "") -> None:
    """Print a table: the medians, the quartiles, and the ratio to the contender ``reference``."""
    if not rows:
        return
    to = rows.get(reference)
    head = f"x {reference}" if to is not None else ""
    print(f"\n{title}\n  {'':62}{'median':>14}{'quartiles':>27}   {'':14}{head}".rstrip())
    for label, row in rows.items():
        low, high = row.quartiles
        ratio = "" if to is None else f"{ratio_of(row, to):.3g}"
        name = f"{'*' if row.ours else ' '} {label:62}"
        print(f"{name}{_short(row.median):>14}{f'{_short(low)} .. {_short(high)}':>27}   {row.unit:14}{ratio}".rstrip())
    sys.stdout.flush()


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"
