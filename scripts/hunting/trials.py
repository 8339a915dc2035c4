"""The hunt itself: trials run one after another in a process of their own, which may hang or crash without harm."""

import math
import multiprocessing
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

_POLL = 0.1  # s
_STARTING = 600.0  # s: a worker that starts may have to compile


class Failure(Exception):  # noqa: N818 (what a trial found, not what went wrong with it)
    """What a trial found to be wrong: its kind, in a word or two, and the numbers."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(f"[{kind}] {words}")


class SetAside(Exception):  # noqa: N818
    """Why a trial says nothing: counted apart and printed."""


def nothing() -> None:
    """Prepare nothing."""


@dataclass(frozen=True)
class Check:
    """One kind of trial.

    Attributes:
        name: as typed. title: what is checked, in a few words.
        trial: runs the trial of a seed and an index; returns numbers whose greatest are printed, or None; raises
            :class:`Failure` or :class:`SetAside`. Any other exception is a failure too.
        prepare: is run once in the process of the trials, such as to compile.
        drawn: returns what a trial is about, for those that had to be ended.
        patience: seconds after which a trial is ended. slow_fails: whether it then counts as failed, or is set aside.
        share: of the time of a hunt that is bounded by minutes.
    """

    name: str
    title: str
    trial: Callable[[int, int], Mapping[str, float] | None]
    prepare: Callable[[], None] = nothing
    drawn: Callable[[int, int], Any] | None = None
    patience: float = 20.0
    slow_fails: bool = True
    share: float = 1.0


@dataclass
class Findings:
    """What became of a check's trials: ``failures`` by index."""

    tried: int = 0
    held: int = 0
    aside: Counter[str] = field(default_factory=Counter)
    failures: dict[int, str] = field(default_factory=dict)
    greatest: dict[str, tuple[float, int]] = field(default_factory=dict)

    def add(self, index: int, kind: str, words: str, numbers: Mapping[str, float]) -> None:
        """Count one trial."""
        self.tried += 1
        self.held += kind == "held"
        if kind == "aside":
            self.aside[words] += 1
        elif kind == "failed":
            self.failures[index] = words
        for name, value in numbers.items():
            if not value <= self.greatest.get(name, (-1.0, 0))[0]:
                self.greatest[name] = value, index


def outcome(check: Check, seed: int, index: int) -> tuple[int, str, str, dict[str, float]]:
    """Run one trial; return its index, "held", "aside" or "failed", why, and its numbers."""
    try:
        return index, "held", "", dict(check.trial(seed, index) or {})
    except SetAside as reason:
        return index, "aside", str(reason), {}
    except Failure as found:
        return index, "failed", "\n      ".join([str(found), *getattr(found, "__notes__", [])]), {}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{place.filename.rsplit('/', 1)[-1]}:{place.lineno}"
        return index, "failed", f"[{type(error).__name__}] at {where}: {error}", {}


def _work(
    check: Check, seed: int, first: int, last: float, skipped: frozenset[int], now: Any, pipe: Connection
) -> None:
    """Run trials from ``first`` on, but none from ``last`` on, and send what became of them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    check.prepare()
    done: list[tuple[int, str, str, dict[str, float]]] = []
    sent = time.monotonic()
    index = first
    pipe.send([])
    while index < last:
        if index not in skipped:
            now[0], now[1] = index, time.monotonic()
            done.append(outcome(check, seed, index))
        index += 1
        if time.monotonic() - sent > _POLL:
            pipe.send(done)
            done, sent = [], time.monotonic()
    now[0] = -1.0
    pipe.send(done)
    time.sleep(_STARTING)  # until ended


def hunt(
    check: Check,
    seed: int,
    first: int,
    count: int | None,
    seconds: float | None,
    most_slow: int,
    report: Callable[[Findings], None] | None = None,
) -> Findings:
    """Run trials of a check, from index ``first`` on, until ``count`` are done, ``seconds`` are over, or ``most_slow``
    had to be ended."""
    findings = Findings()
    context = multiprocessing.get_context("spawn")
    now = context.RawArray("d", 2)
    slow: set[int] = set()
    # Until the first trials are in no time counts: compiling may take minutes.
    begun: float | None = None
    upcoming, last = first, math.inf if count is None else first + count

    def enough() -> bool:
        late = seconds is not None and begun is not None and time.monotonic() - begun > seconds
        return late or (count is not None and findings.tried >= count) or len(slow) >= most_slow

    while not enough():
        ours, theirs = context.Pipe()
        worker = context.Process(
            target=_work, args=(check, seed, upcoming, last, frozenset(slow), now, theirs), daemon=True
        )
        worker.start()
        theirs.close()
        try:
            now[0] = -1.0
            if not ours.poll(_STARTING):
                raise RuntimeError(f"the check {check.name} was not ready after {_STARTING:g} s")
            ours.recv()
            now[1] = time.monotonic()
            begun = begun or time.monotonic()
            while not enough():
                index, since = int(now[0]), now[1]
                if ours.poll(_POLL):
                    for result in ours.recv():
                        upcoming = result[0] + 1
                        findings.add(*result)
                    if report is not None:
                        report(findings)
                elif time.monotonic() - since > check.patience and int(now[0]) == index and index >= 0:
                    slow.add(index)
                    words = f"[slow] not done after {check.patience:g} s"
                    if check.drawn is not None:
                        words += f"\n      {check.drawn(seed, index)}"
                    findings.add(index, "failed" if check.slow_fails else "aside", words, {})
                    break
        except EOFError:  # the process of the trials crashed
            index = int(now[0])
            worker.join()
            if index < 0:
                raise RuntimeError(f"the check {check.name} cannot begin: exit status {worker.exitcode}") from None
            slow.add(index)
            findings.add(index, "failed", f"[crash] the process ended with exit status {worker.exitcode}", {})
        except KeyboardInterrupt:
            print("\ninterrupted", file=sys.stderr)
            raise Interrupted(findings) from None
        finally:
            worker.kill()
            worker.join()
    return findings


class Interrupted(Exception):  # noqa: N818
    """The user stopped a hunt: with what was found until then."""

    def __init__(self, findings: Findings) -> None:
        super().__init__("interrupted")
        self.findings = findings
