"""What the commands share: their form, the options of an environment, an oscillator, a sweep and an output."""

import argparse
import contextlib
import itertools
import json
import math
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import numpy as np

import sd_friction_env
from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.environments.ids import OPEN_TIERS, TASKS, TIERS, environment_id
from sd_friction_env.physics import sweeps
from sd_friction_env.physics.laws import friction_table
from sd_friction_env.physics.parameters import FIELDS, FRICTIONS, GEOMETRIES, RANGES, OscillatorParameters
from sd_friction_env.physics.rigs import read_rig
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import StoredFileError, atomic_file, checked_ending, parse_yaml

FAILURE, BAD_USAGE, INTERRUPTED = 1, 2, 130

_SCALES = ("time_scale", "length_scale", "force_scale")
_LAWS_OF_THE_PAPER = ("", "exact, cubic", "stribeck")
_OWN = {name: field for name, field in FIELDS.items() if name not in _SCALES}
_FIELDS = {name: field["meaning"] for name, field in _OWN.items() if field["law"] in _LAWS_OF_THE_PAPER}
_LAW_FIELDS = {name: f"{_OWN[name]['meaning']} ({_OWN[name]['law']})" for name in _OWN if name not in _FIELDS}
_MOST_POINTS = 10_000_000


class UsageError(ValueError):
    """An argument that makes no sense; the message says what would."""


class FailedError(RuntimeError):
    """A command that could not do its work, for a reason that is not in its arguments."""


class Command(NamedTuple):
    """One command of the program.

    ``add`` adds its options to a parser; ``run`` takes what was typed and returns the exit status. ``text`` follows
    the summary in its help; ``interrupted`` says after Ctrl-C what is kept.
    """

    add: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    examples: Sequence[str]
    text: str = ""
    interrupted: str = "nothing was written"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and whose help keeps the lines of its description."""

    def __init__(self, **arguments: Any) -> None:
        formatter = argparse.RawDescriptionHelpFormatter
        super().__init__(**{"allow_abbrev": False, "formatter_class": formatter, **arguments})
        # What argparse takes for a value and not for an option: ranges that begin below zero, too.
        self._negative_number_matcher = re.compile(r"^-[\d.]")

    def error(self, message: str) -> NoReturn:
        """Print the error in one line and exit with status 2."""
        self.exit(BAD_USAGE, f"{self.prog}: {message} (see {self.prog} --help)\n")


# Environments and agents ----------------------------------------------------------------------------------------------


def add_environment(parser: argparse._ActionsContainer, *, arguments: bool = True) -> None:
    """Add the options that name an environment: read them with :func:`environment_of`."""
    parser.add_argument("--task", choices=TASKS, help="actuator: a force on the mass, or the belt's speed")
    parser.add_argument("--tier", choices=(*TIERS, *OPEN_TIERS), help="what is hidden (default: nominal)")
    parser.add_argument("--env-id", metavar="ID", help=f"instead of --task and --tier: {', '.join(ENVIRONMENT_IDS)}")
    if arguments:
        text = "argument of the environment, the value in YAML, such as w_effort=0.2; may be repeated"
        parser.add_argument("--env-arg", action="append", default=[], metavar="NAME=VALUE", help=text)


def named_environment(options: argparse.Namespace) -> str | None:
    """Return the id of the environment that the options of :func:`add_environment` name, None if they name none."""
    if options.env_id not in (None, *ENVIRONMENT_IDS):
        raise UsageError(f"--env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {options.env_id!r}")
    if options.env_id and (options.task or options.tier):
        raise UsageError("--env-id names task and tier itself: leave out --task and --tier")
    if options.tier and not options.task:
        raise UsageError(f"--tier {options.tier} needs --task")
    if options.task:
        return environment_id(options.task, options.tier or "nominal")
    found: str | None = options.env_id
    return found


def environment_of(options: argparse.Namespace) -> str:
    """Return the id of the environment that the options of :func:`add_environment` name."""
    found = named_environment(options)
    if found is None:
        raise UsageError(f"one of --task ({', '.join(TASKS)}) and --env-id is needed")
    return found


def add_overrides(parser: argparse._ActionsContainer, what: str) -> None:
    """Add --set, which says of one hyperparameter what is done with it."""
    text = f"{what}, the value in YAML; may be repeated"
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="overrides", help=text)


def assignments(option: str, given: Sequence[str]) -> dict[str, Any]:
    """Return NAME=VALUE arguments as a mapping, the values read as YAML (safely)."""
    values: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            if not equals or not name.isidentifier():
                raise StoredFileError("it has no name")
            values[name] = parse_yaml(value)
        except StoredFileError as error:
            shown = repr(text[:200])
            raise UsageError(f"{option} must be NAME=VALUE with a value in YAML, got {shown} ({error})") from None
    return values


def command_line(options: argparse.Namespace) -> str:
    """Return the command as it was typed."""
    return shlex.join(["sd-friction", *options.typed])


def check_at_least(options: argparse.Namespace, **lowest: int) -> None:
    """Check whole-number options, or lists of them, against their lowest values."""
    for name, low in lowest.items():
        given = getattr(options, name)
        if np.min(given) < low:
            raise UsageError(f"--{name.replace('_', '-')} must be at least {low}, got {given}")


def check_file(option: str, path: Path | None, *endings: str) -> None:
    """Check that a file could be written: its ending and its folder."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise UsageError(f"{option} {str(path)!r} lies in no existing folder: make {str(path.parent)!r} first")
    if path.is_dir():
        raise UsageError(f"{option} {str(path)!r} is a folder; a file is wanted")
    if endings:
        checked_ending(path, endings, option)


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C was pressed; a second Ctrl-C interrupts at once."""
    requested = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: requested
    finally:
        signal.signal(signal.SIGINT, before)


# Oscillators and sweeps -----------------------------------------------------------------------------------------------


def numbers(text: str) -> list[float]:
    """Return the values of one argument: a number, or start:stop:step with both ends included."""
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number and no start:stop:step") from None
    if len(parts) == 1:
        return parts
    if len(parts) != 3 or not all(math.isfinite(part) for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} must be start:stop:step with three finite numbers")
    start, stop, step = parts
    if step <= 0.0 or stop < start:
        raise argparse.ArgumentTypeError(f"{text!r} is empty: start:stop:step needs start <= stop and step > 0")
    count = math.floor((stop - start) / step * (1.0 + 1e-12) + 1e-9) + 1
    if count > _MOST_POINTS:
        raise argparse.ArgumentTypeError(f"{text!r} holds {count} values; at most {_MOST_POINTS} are taken")
    return [round(start + i * step, 12) for i in range(count)]


def add_oscillator(parser: argparse.ArgumentParser) -> None:
    """Add the options of an oscillator, or of a grid of them: read them with :func:`grid_of`."""
    group = parser.add_argument_group("oscillator", "one or more values each, or start:stop:step; several make a grid")
    group.add_argument("--geometry", nargs="+", choices=GEOMETRIES, help="spring (default: exact)")
    laws = group.add_mutually_exclusive_group()
    laws.add_argument("--friction", nargs="+", choices=FRICTIONS, help="law of friction (default: stribeck)")
    text = "a measured friction curve: speeds and coefficients in two columns"
    laws.add_argument("--friction-table", type=Path, metavar="FILE.csv", help=text)
    text = "a rig in SI units, in TOML or YAML: M, K, C, ...; the options are dimensionless and change it"
    group.add_argument("--rig", type=Path, metavar="FILE", help=text)
    nominal = OscillatorParameters()
    other = parser.add_argument_group("other laws, excitation", "likewise")
    for field, meaning in (_FIELDS | _LAW_FIELDS).items():
        low, high = RANGES[field]
        text = f"{meaning}, in [{low:g}, {high:g}] (default: {getattr(nominal, field):g})"
        (group if field in _FIELDS else other).add_argument(
            f"--{field.replace('_', '-')}", dest=field, nargs="+", type=numbers, metavar="VALUE", help=text
        )


def grid_of(
    options: argparse.Namespace, *, belt_speed: bool = True
) -> list[tuple[dict[str, Any], OscillatorParameters]]:
    """Return what was swept, and the parameters, of each point of the grid; all are checked before any is computed."""
    fields = [name for name in _FIELDS | _LAW_FIELDS if belt_speed or name != "belt_speed"]
    base = read_rig(options.rig) if options.rig else OscillatorParameters()
    values: dict[str, list[Any]] = {"geometry": options.geometry or [base.geometry]}
    values["friction"] = options.friction or [base.friction]
    if options.friction_table:
        values["friction"] = [friction_table(options.friction_table)]
    for name in fields:
        given = getattr(options, name)
        if given is not None:
            values[name] = list(itertools.chain.from_iterable(given))
    count = math.prod(len(v) for v in values.values())
    if count > _MOST_POINTS:
        raise UsageError(f"the grid has {count} points; at most {_MOST_POINTS} are taken")
    grid = []
    for point in itertools.product(*values.values()):
        named = dict(zip(values, point, strict=True))
        swept = {name: value for name, value in named.items() if len(values[name]) > 1}
        grid.append((swept, base.replace(**named)))
    return grid


def one_of(options: argparse.Namespace) -> OscillatorParameters:
    grid = grid_of(options)
    if len(grid) != 1:
        raise UsageError(f"one oscillator is wanted, not a grid of {len(grid)}: give one value of each parameter")
    return grid[0][1]


def start_of(options: argparse.Namespace) -> tuple[float, float | None]:
    return (0.0, None) if options.start is None else (options.start[0], options.start[1])


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where a sweep runs."""
    group = parser.add_argument_group("where it runs", "the result is the same, bit for bit")
    text = "this process, processes of this machine, or a cluster (default: sequential)"
    group.add_argument("--backend", choices=sweeps.BACKENDS, default="sequential", help=text)
    group.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    text = "a running cluster: tcp://host:port of a Dask scheduler, auto or ray://host:port (default: one is started)"
    group.add_argument("--address", metavar="ADDRESS", help=text)
    text = "keep finished chunks here: the same command goes on after a kill"
    group.add_argument("--folder", type=Path, metavar="FOLDER", help=text)


def engine_of(options: argparse.Namespace) -> sweeps.Engine:
    """Return where a sweep runs by the options of :func:`add_engine`; its progress is shown on a terminal."""
    show: list[Callable[[int], None]] = []

    def progress(done: int, total: int) -> None:
        if not show:
            show.append(progress_bar(total, "chunks"))
        show[0](done)

    where = {name: getattr(options, name) for name in ("backend", "workers", "address", "folder")}
    return sweeps.Engine(**where, progress=progress)


def add_start(parser: argparse.ArgumentParser) -> None:
    text = "start (default: set down at x = 0 moving with the belt)"
    parser.add_argument("--start", nargs=2, type=float, metavar=("X", "V"), help=text)


def add_output(
    parser: argparse.ArgumentParser, plot: str | None, out: str = "to FILE.csv or FILE.json (default: print)"
) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--out", type=Path, metavar="FILE", help=f"write {out}")
    group.add_argument("--json", action="store_true", help="print JSON instead of CSV")
    if plot is not None:
        group.add_argument("--plot", type=Path, metavar="FILE", help=f"draw {plot} into FILE.png, .svg or .pdf")


# Output ---------------------------------------------------------------------------------------------------------------


def check_output(options: argparse.Namespace) -> None:
    """Refuse names that could not be written at the end of a long computation."""
    for name, endings in (("out", getattr(options, "out_endings", (".csv", ".json"))), ("plot", plotting.FORMATS)):
        check_file(f"--{name}", getattr(options, name, None), *endings)
    if getattr(options, "plot", None) is not None:
        plotting.new_figure(1.0, 1.0, 1, 1)  # says what to install if matplotlib is missing


def _as_json(table: Table) -> str:
    """Return a table as JSON; NaN and infinity become null."""

    def plain(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    rows = [{name: plain(value) for name, value in row.items()} for row in table.rows()]
    return json.dumps({"metadata": table.metadata, "rows": rows}, indent=1, allow_nan=False)


def print_table(options: argparse.Namespace, table: Table) -> None:
    """Print a table as CSV, or as JSON if --json asks for it."""
    if options.json:
        print(_as_json(table))
    else:
        table.write(sys.stdout)


def emit(options: argparse.Namespace, table: Table) -> None:
    """Write a table to the file of --out, or print it."""
    if options.out is None:
        print_table(options, table)
    elif options.out.suffix.lower() == ".json":
        with atomic_file(options.out) as file:
            file.write(_as_json(table) + "\n")
    else:
        table.to_csv(options.out)


def metadata_of(options: argparse.Namespace) -> dict[str, Any]:
    return {"sd_friction_env": sd_friction_env.__version__, "numpy": np.__version__, "command": command_line(options)}


def progress_bar(total: int, unit: str) -> Callable[[int], None]:
    """Return a function that shows how many of ``total`` are done, on a terminal and only if it takes a while."""
    begun = shown = time.monotonic()

    def show(done: int) -> None:
        nonlocal shown
        now = time.monotonic()
        if sys.stderr.isatty() and now - begun > 1.0 and (now - shown > 0.2 or done == total):
            shown = now
            left = (now - begun) / done * (total - done)
            bar = "#" * (30 * done // total)
            print(f"\r[{bar:30}] {done}/{total} {unit}, {left:.0f} s left ", end="", file=sys.stderr, flush=True)
            if done == total:
                print(file=sys.stderr)

    return show


def stacked(
    options: argparse.Namespace, tables: Iterable[Table], grid: Sequence[tuple[dict[str, Any], OscillatorParameters]]
) -> Table:
    """Return the tables of a grid's oscillators one below the other, after the parameters that were swept."""
    parts = (table.labelled(**swept) for table, (swept, _) in zip(tables, grid, strict=True))
    return Table.stacked(parts, metadata_of(options))
