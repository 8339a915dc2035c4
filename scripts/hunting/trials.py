"""The hunt itself: trials run one after another in a process of their own, which may hang or crash without harm."""

import faulthandler
import itertools
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import NamedTuple

_STARTING = 600.0  # s: a process that starts may have to compile


class Failure(Exception):  # noqa: N818 (what a trial found, not what went wrong with it)
    """What a trial found to be wrong: its kind, in a word or two, and the numbers."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(f"[{kind}] {words}")
        self.kind, self.words = kind, words


class SetAside(Exception):  # noqa: N818
    """Why a trial says nothing: counted apart and printed."""


def nothing(*_: int) -> str:
    """Prepare nothing, describe nothing."""
    return ""


@dataclass(frozen=True)
class Check:
    """One kind of trial.

    Attributes:
        name: as typed. title: what is checked, in a few words.
        trial: runs the trial of a seed and an index; returns numbers whose greatest are printed, or None; raises
            :class:`Failure` or :class:`SetAside`. Any other exception is a failure too.
        prepare: is run once in the process of the trials, such as to compile.
        drawn: returns what a trial is about, printed with its failure.
        patience: seconds after which a trial is ended. slow_fails: whether it then counts as failed, or is set aside.
        share: of the time of a hunt that is bounded by minutes.
    """

    name: str
    title: str
    trial: Callable[[int, int], Mapping[str, float] | None]
    prepare: Callable[[], object] = nothing
    drawn: Callable[[int, int], str] = nothing
    patience: float = 20.0
    slow_fails: bool = True
    share: float = 1.0


class Outcome(NamedTuple):
    """What became of a trial: "held", "aside" or "failed", why, its numbers, and whether it had to be ended."""

    number: int
    kind: str
    words: str = ""
    numbers: Mapping[str, float] = {}
    ended: bool = False


def outcome(check: Check, seed: int, index: int) -> Outcome:
    """Run one trial."""
    try:
        return Outcome(index, "held", numbers=dict(check.trial(seed, index) or {}))
    except SetAside as reason:
        return Outcome(index, "aside", str(reason))
    except Failure as found:
        words = str(found)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        words = f"[{type(error).__name__}] at {os.path.basename(place.filename)}:{place.lineno}: {error}"
    return Outcome(index, "failed", "\n      ".join(filter(None, [words, check.drawn(seed, index)])))


def _work(check: Check, seed: int, first: int, pipe: Connection) -> None:
    """Run trials from ``first`` on and send what becomes of them; end with exit status 1 when one takes too long."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    with open(os.devnull, "w") as unread:
        faulthandler.dump_traceback_later(_STARTING, exit=True, file=unread)
        check.prepare()
        pipe.send(None)
        for index in itertools.count(first):
            faulthandler.dump_traceback_later(check.patience, exit=True, file=unread)
            pipe.send(outcome(check, seed, index))


def outcomes(check: Check, seed: int, first: int) -> Generator[Outcome | None, None, None]:
    """Yield what becomes of trials from index ``first`` on, without end; None when a process is ready to begin.

    Raises:
        RuntimeError: if the process of the trials cannot begin.
    """
    context = multiprocessing.get_context("spawn")
    while True:
        ours, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(check, seed, first, theirs))
        worker.start()
        theirs.close()
        is_ready = False
        try:
            while True:
                found: Outcome | None = ours.recv()
                first += found is not None
                is_ready = True
                yield found
        except EOFError:  # the process has ended
            worker.join()
            if not is_ready:
                raise RuntimeError(f"the check {check.name} cannot begin: exit status {worker.exitcode}") from None
            words, kind = f"[crash] the process ended with exit status {worker.exitcode}", "failed"
            if worker.exitcode == 1:
                words = f"[slow] not done after {check.patience:g} s"
                kind = "failed" if check.slow_fails else "aside"
            if kind == "failed":
                words += f"\n      {check.drawn(seed, first)}"
            yield Outcome(first, kind, words, ended=True)
            first += 1
        finally:
            worker.kill()
            worker.join()
