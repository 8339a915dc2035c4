"""Workers: processes that run the trials of a study until enough of them are finished."""

import contextlib
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import connection
from typing import Any

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import TrialState
from tqdm import tqdm

from sd_friction_env.learning.settings import checked_whole
from sd_friction_env.learning.tuning.study import (
    HEARTBEAT,
    Search,
    StudyError,
    best_trials,
    cause,
    finished_trials,
    open_study,
    shown_url,
    without_experimental_warnings,
)
from sd_friction_env.learning.tuning.trial import FAILURES, InterruptedTrialError, run_trial

_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total} trials [{elapsed}<{remaining}{postfix}]"


class WorkersDiedError(RuntimeError):
    """All workers have ended before the study was complete."""


class InterruptedStudyError(Exception):
    """The study was asked to stop before its end; the same call continues it."""


def work(
    search: Search,
    storage: str,
    name: str,
    trials: int,
    *,
    worker: int = 0,
    heartbeat: int = HEARTBEAT,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Run trials of a study, one after another, until ``trials`` of it are finished.

    While other workers run the last trials, it waits, and runs those again whose process dies.

    Args:
        worker: number of the worker. should_stop: called after every step of training; an interrupted trial is queued
            again. The others are those of :func:`tune`.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = open_study(search, storage, name, heartbeat=heartbeat, worker=worker)
    while not should_stop():
        with without_experimental_warnings():
            optuna.storages.fail_stale_trials(study)
        finished = len(finished_trials(study))
        if finished >= trials:
            return
        if finished + len(_running(study)) >= trials:
            time.sleep(0.2)
            continue
        with contextlib.suppress(UpdateFinishedTrialError):  # missed heartbeats (a suspended machine): queued already
            study.optimize(
                lambda trial: run_trial(trial, search, should_stop),
                n_trials=1,
                catch=(InterruptedTrialError, *FAILURES),
            )


def _running(study: optuna.Study) -> list[Any]:
    return study.get_trials(deepcopy=False, states=[TrialState.RUNNING])


def _process(search: Search, storage: str, name: str, trials: int, worker: int, heartbeat: int, parent: Any) -> None:
    """Work in a process of its own until the parent closes its end of the pipe, also by dying."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent passes it on
    work(search, storage, name, trials, worker=worker, heartbeat=heartbeat, should_stop=parent.poll)


def tune(
    search: Search,
    storage: str,
    name: str,
    trials: int,
    *,
    workers: int = 1,
    heartbeat: int = HEARTBEAT,
    progress: bool = True,
    should_stop: Callable[[], bool] = lambda: False,
) -> optuna.Study:
    """Run a study until ``trials`` of it are finished in all, and return it.

    Several calls, on several machines, may work on one study. Workers that start a trial at the same moment may finish
    one more than asked for.

    Args:
        storage: URL of the database. name: of the study in it; an existing one is continued.
        workers: processes, each with one thread of torch, in [1, 256].
        heartbeat: seconds between a running trial's heartbeats; one that misses six of them is failed and run again.
        progress: show a progress bar on standard error. should_stop: called about ten times a second.

    Raises:
        StudyError: as :func:`open_study`; nothing is then changed.
        ValueError: if ``trials``, ``workers`` or ``heartbeat`` is out of range.
        InterruptedStudyError: if ``should_stop`` returned True; the running trials are then queued again.
        WorkersDiedError: if no worker is left.
    """
    checked_whole("trials", trials, 1, 10**6)
    checked_whole("workers", workers, 1, 256)
    checked_whole("heartbeat", heartbeat, 1, 3600)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = open_study(search, storage, name, heartbeat=heartbeat)
    finished = len(finished_trials(study))
    if finished >= trials:
        return study
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    arguments = (search, storage, name, trials)
    processes = [
        context.Process(target=_process, args=(*arguments, i, heartbeat, reader), name=f"worker {i}", daemon=True)
        for i in range(min(workers, trials - finished))
    ]
    bar = tqdm(total=trials, desc=name, disable=not progress, dynamic_ncols=True, bar_format=_BAR)
    try:
        with _ctrl_c_ignored():
            for process in processes:
                process.start()
        _wait(processes, should_stop, lambda: _show(bar, study, search))
    except optuna.exceptions.StorageInternalError as error:
        raise StudyError(f"storage {shown_url(storage)!r} has failed: {cause(error)}") from None
    finally:
        bar.close()
        writer.close()  # asks them to stop
        try:
            for process in processes:
                process.join()
        finally:  # a second Ctrl-C does not wait for that
            for process in processes:
                process.kill()
    finished = len(finished_trials(study))
    if finished < trials:
        dead = [f"{process.name}: exit code {process.exitcode}" for process in processes if process.exitcode]
        raise WorkersDiedError(f"no worker is left after {finished} of {trials} trials ({', '.join(dead)})")
    return study


@contextlib.contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """Ignore Ctrl-C: processes that are started meanwhile inherit it. Does nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _wait(processes: list[Any], should_stop: Callable[[], bool], show: Callable[[], None]) -> None:
    """Wait until all processes have ended; call ``show`` about once a second and at the end."""
    shown = 0.0
    while any(process.is_alive() for process in processes):
        if should_stop():
            raise InterruptedStudyError
        if time.monotonic() - shown > 1.0:
            show()
            shown = time.monotonic()
        connection.wait([process.sentinel for process in processes if process.is_alive()], timeout=0.1)
    show()


def _show(bar: Any, study: optuna.Study, search: Search) -> None:
    """Update the progress bar."""
    if bar.disable:
        return
    running, best = _running(study), best_trials(study)
    done = len(finished_trials(study)) + sum((trial.last_step or 0) / search.evaluations for trial in running)
    bar.n = min(bar.total, done)
    bar.set_postfix_str(f"{f'best {best[0].value:.1f}, ' if best else ''}{len(running)} running")
