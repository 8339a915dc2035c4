"""The command line: analysis, videos and checks without writing code. ``python -m sd_friction_env --help`` lists it."""

import argparse
import dataclasses
import itertools
import json
import math
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np

import sd_friction_env
from sd_friction_env.cli.doctor import as_text, examine, versions_as_text
from sd_friction_env.control.policies import Policy, VelocityFeedback, ZeroPolicy, load_policy
from sd_friction_env.control.pretrained import load_pretrained
from sd_friction_env.physics import sweeps
from sd_friction_env.physics.basins import LOST_CONTACT, UNDECIDED, basin_grid
from sd_friction_env.physics.curves import checked_belt_speeds
from sd_friction_env.physics.forced import lyapunov_exponent, poincare_section
from sd_friction_env.physics.laws import friction_table
from sd_friction_env.physics.orbits import OrbitError, critical_belt_speeds, first_lyapunov_coefficient, limit_cycle
from sd_friction_env.physics.parameters import FIELDS, FRICTIONS, GEOMETRIES, RANGES, OscillatorParameters
from sd_friction_env.physics.rigs import read_rig
from sd_friction_env.physics.simulation import simulate
from sd_friction_env.physics.tables import Table
from sd_friction_env.pictures import plotting
from sd_friction_env.pictures.rendering import checked_size
from sd_friction_env.storage import HYPERPARAMETERS, atomic_file, checked_ending

FAILURE, BAD_USAGE, INTERRUPTED = 1, 2, 130

_SCALES = ("time_scale", "length_scale", "force_scale")
_LAWS_OF_THE_PAPER = ("", "exact, cubic", "stribeck")
_FIELDS = {name: field["meaning"] for name, field in FIELDS.items() if field["law"] in _LAWS_OF_THE_PAPER}
_FIELDS = {name: meaning for name, meaning in _FIELDS.items() if name not in _SCALES}
_LAW_FIELDS = {
    name: f"{field['meaning']} ({field['law']})"
    for name, field in FIELDS.items()
    if field["law"] not in _LAWS_OF_THE_PAPER
}
_MOST_POINTS = 10_000_000
_TASKS = {"force": "Force", "belt": "BeltSpeed"}
_TIERS = {"nominal": "", "randomised": "Randomised", "sensed": "Sensed"}
_VELOCITY_GAIN = 1.5


class UsageError(ValueError):
    """An argument that makes no sense; the message says what would."""


def numbers(text: str) -> list[float]:
    """Return the values of one argument: a number, or start:stop:step with both ends included.

    Raises:
        argparse.ArgumentTypeError: if it is neither.
    """
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


class _Parser(argparse.ArgumentParser):
    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        # What argparse takes for a value and not for an option: here ranges that begin below zero too.
        self._negative_number_matcher = re.compile(r"^-[\d.]")

    def error(self, message: str) -> NoReturn:
        """Say in one line what is wrong and where to read more."""
        print(f"{self.prog}: {message} (see {self.prog} --help)", file=sys.stderr)
        raise SystemExit(BAD_USAGE)


def _bare_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int], summary: str, examples: Sequence[str]
) -> argparse.ArgumentParser:
    lines = "\n".join(f"  sd-friction {name} {example}" for example in examples)
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"examples:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, analysis=False)
    return parser


def _command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int], summary: str, examples: Sequence[str]
) -> argparse.ArgumentParser:
    parser = _bare_command(commands, name, run, summary, examples)
    parser.set_defaults(analysis=True)
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
    return parser


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
            show.append(_progress(total, "chunks"))
        show[0](done)

    return sweeps.Engine(
        backend=options.backend,
        workers=options.workers,
        address=options.address,
        folder=options.folder,
        progress=progress,
    )


def _add_start(parser: argparse.ArgumentParser) -> None:
    text = "start (default: set down at x = 0 moving with the belt)"
    parser.add_argument("--start", nargs=2, type=float, metavar=("X", "V"), help=text)


def _add_output(parser: argparse.ArgumentParser, plot: str | None) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--out", type=Path, metavar="FILE", help="write to FILE.csv or FILE.json (default: print)")
    group.add_argument("--json", action="store_true", help="print JSON instead of CSV")
    if plot is not None:
        group.add_argument("--plot", type=Path, metavar="FILE", help=f"draw {plot} into FILE.png, .svg or .pdf")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole program."""
    program = _Parser(
        prog="sd-friction",
        description="The self-excited SD oscillator on a moving belt: passive analysis, control, pictures.",
        epilog="each command has its own help with examples: sd-friction amplitude --help",
    )
    program.add_argument("--version", action="version", version=f"sd_friction_env {sd_friction_env.__version__}")
    commands = program.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)

    command = _command(
        commands,
        "amplitude",
        _amplitude,
        "amplitude, period and kind of motion over the belt speed",
        [
            "--belt-speed 0:0.6:0.005",
            "--alpha 0.2 0.5 0.7 0.8 --belt-speed 0:0.6:0.005 --geometry cubic --out curve.csv --plot curve.png",
            "--alpha 0.5 --belt-speed 0.4:0.45:0.001 --attractors",
            "--alpha 0.2:1:0.01 --belt-speed 0:0.6:0.001 --backend loky --folder map --out map.csv",
        ],
    )
    _add_start(command)
    command.add_argument("--attractors", action="store_true", help="all attractors of every point, whatever the start")
    add_engine(command)
    _add_output(command, "amplitude over the belt speed")

    command = _command(
        commands,
        "cycle",
        _cycle,
        "the limit cycle that one start reaches",
        ["", "--geometry cubic --belt-speed 0.405 --json", "--alpha 0.2 --start -1 0"],
    )
    _add_start(command)
    _add_output(command, None)

    command = _command(
        commands,
        "critical",
        _critical,
        "belt speeds at which stick-slip (v_b0) and oscillation (v_b1) end",
        ["", "--geometry cubic exact linear --alpha 0.2:0.8:0.1", "--mu-m 0.1575 --json"],
    )
    _add_output(command, None)

    command = _command(
        commands,
        "simulate",
        _simulate,
        "one history in time",
        ["--t-end 60 --out history.csv --plot history.png", "--start 0.3 -0.4 --dt 0.1 --force 0.02"],
    )
    _add_start(command)
    command.add_argument("--t-end", type=float, default=100.0, help="when to end (default: 100)")
    command.add_argument("--dt", type=float, default=0.01, help="time between samples (default: 0.01)")
    command.add_argument("--force", type=float, default=0.0, help="constant control force (default: 0)")
    _add_output(command, "displacement, velocity and phase portrait")

    command = _command(
        commands,
        "basins",
        _basins,
        "which attractor each start of a grid reaches",
        [
            "--alpha 0.2 --plot basins.png",
            "--alpha 0.5 --belt-speed 0.43 --x -1.5 1.5 --v -1 1 --shape 800 800",
            "--alpha 0.5 --shape 4000 2500 --backend dask --address tcp://10.0.0.1:8786 --folder basins-alpha-5",
        ],
    )
    add_engine(command)
    command.add_argument("--x", nargs=2, type=float, default=[-1.5, 1.5], metavar=("LOW", "HIGH"), help="starts in x")
    command.add_argument("--v", nargs=2, type=float, default=[-1.0, 1.0], metavar=("LOW", "HIGH"), help="starts in v")
    command.add_argument("--shape", nargs=2, type=int, default=[400, 400], metavar=("N", "M"), help="grid (400 400)")
    _add_output(command, "the basins")

    forced = "--force-amplitude 0.2 --force-frequency 1.3"
    command = _command(
        commands,
        "poincare",
        _poincare,
        "the state once per drive period of a forced motion",
        [f"{forced} --cycles 2000 --out section.csv --plot section.png"],
    )
    _add_start(command)
    command.add_argument("--cycles", type=int, default=1000, help="drive periods told of (default: 1000)")
    command.add_argument("--transient", type=int, default=200, help="drive periods before (default: 200)")
    _add_output(command, "the section")

    command = _command(
        commands,
        "lyapunov",
        _lyapunov,
        "Lyapunov exponents: is a motion chaotic?",
        [forced, "--force-amplitude 0.05:0.3:0.01 --force-frequency 1.3 --out exponents.csv", "--belt-speed 0.42"],
    )
    _add_start(command)
    command.add_argument("--cycles", type=int, default=2000, help="drive periods averaged over (default: 2000)")
    command.add_argument("--transient", type=int, default=200, help="drive periods before (default: 200)")
    _add_output(command, None)

    command = _command(
        commands,
        "bifurcation",
        _bifurcation,
        "stroboscopic sections of a forced motion over a parameter, up and down",
        ["--force-frequency 1.3 --over force-amplitude 0.01:0.3:0.002 --backend loky --plot diagram.png"],
    )
    command.add_argument(
        "--over", nargs="+", required=True, metavar=("NAME", "VALUE"), help="the parameter, and its values or ranges"
    )
    command.add_argument("--direction", choices=("up", "down", "both"), default="both", help="(default: both)")
    command.add_argument("--cycles", type=int, default=60, help="drive periods told of (default: 60)")
    command.add_argument("--transient", type=int, default=200, help="drive periods before (default: 200)")
    command.add_argument("--exponents", action="store_true", help="the largest Lyapunov exponent of each as well")
    add_engine(command)
    _add_output(command, "the diagram")

    command = _bare_command(
        commands,
        "explore",
        _explore,
        "the oscillator live in the browser, with sliders, controllers and your own hand",
        ["", "--port 8080 --no-browser", "--host 0.0.0.0 --allow-host oscillator.example.org --no-browser"],
    )
    command.add_argument("--port", type=int, default=5006, help="0: any that is free (default: 5006)")
    command.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine only)")
    text = "serve it under these names too, of a proxy or a forwarded port (default: its address and localhost alone)"
    command.add_argument("--allow-host", nargs="+", default=[], metavar="NAME[:PORT]", help=text)
    command.add_argument("--sessions", type=int, default=8, metavar="N", help="pages at a time (default: 8)")
    command.add_argument("--no-browser", action="store_true", help="open no browser, print the address")

    command = _bare_command(
        commands,
        "video",
        _video,
        "a video of an episode, without control and with it side by side",
        [
            "--task belt --out suppressed.mp4",
            "--task force --agent velocity-feedback --gain 1.5 --size 480 270 --every 3 --fps 10 --out small.gif",
            "--task belt --tier sensed --agent runs/mine/policy.npz --seed 3 --alone --out mine.mp4",
        ],
    )
    command.add_argument("--task", choices=_TASKS, required=True, help="actuator: a force, or the belt's speed")
    command.add_argument("--tier", choices=_TIERS, default="nominal", help="what is hidden (default: nominal)")
    command.add_argument(
        "--agent",
        default="pretrained",
        metavar="AGENT",
        help="pretrained (default), velocity-feedback, none, or a trained agent's policy.npz",
    )
    command.add_argument("--gain", type=float, help="of velocity-feedback (default: 1.5)")
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.mp4 or FILE.gif")
    command.add_argument("--seed", type=int, default=0, help="of the episode (default: 0)")
    command.add_argument("--steps", type=int, default=300, help="control intervals (default: 300)")
    command.add_argument(
        "--size", nargs=2, type=int, default=[960, 540], metavar=("WIDTH", "HEIGHT"), help="of one picture, in pixels"
    )
    command.add_argument("--every", type=int, default=1, metavar="N", help="a frame every N intervals (default: 1)")
    command.add_argument("--fps", type=int, default=30, help="frames a second, 1 to 60 (GIF: to 50; default: 30)")
    command.add_argument("--alone", action="store_true", help="without the passive oscillator beside it")

    command = _bare_command(
        commands,
        "hyperparameters",
        _hyperparameters,
        "where the tuned hyperparameters are, in RL Zoo's format",
        ["", "ppo", "ppo --show"],
    )
    command.add_argument("algorithm", nargs="?", help="such as ppo (default: the folder of all)")
    command.add_argument("--show", action="store_true", help="print the file itself")

    command = _bare_command(
        commands,
        "doctor",
        _doctor,
        "versions, caches, threads, and what is missing for which feature",
        ["", "--json"],
    )
    command.add_argument("--json", action="store_true", help="print JSON")

    command = _bare_command(
        commands,
        "completion",
        _completion,
        "a script that makes a shell complete commands and options",
        ["bash > ~/.local/share/bash-completion/completions/sd-friction", "zsh > ~/.zfunc/_sd-friction"],
    )
    command.add_argument("shell", choices=("bash", "zsh", "tcsh"))
    return program


def _grid(options: argparse.Namespace, *, belt_speed: bool = True) -> list[tuple[dict[str, Any], OscillatorParameters]]:
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


def _one(options: argparse.Namespace) -> OscillatorParameters:
    grid = _grid(options)
    if len(grid) != 1:
        raise UsageError(f"one oscillator is wanted, not a grid of {len(grid)}: give one value of each parameter")
    return grid[0][1]


def _start(options: argparse.Namespace) -> tuple[float, float | None]:
    return (0.0, None) if options.start is None else (options.start[0], options.start[1])


def _check_output(options: argparse.Namespace) -> None:
    """Refuse names that could not be written at the end of a long computation."""
    for name, endings in (("out", (".csv", ".json")), ("plot", plotting.FORMATS)):
        path = getattr(options, name, None)
        if path is None:
            continue
        checked_ending(path, endings, f"--{name}")
        if not path.parent.is_dir():
            raise UsageError(f"--{name} {str(path)!r} lies in no existing folder: make {str(path.parent)!r} first")
        if path.is_dir():
            raise UsageError(f"--{name} {str(path)!r} is a folder")
    if getattr(options, "plot", None) is not None:
        plotting.new_figure(1.0, 1.0, 1, 1)  # says what to install if matplotlib is missing


def _plain(value: Any) -> Any:
    """Return a value as JSON can say it: NaN and infinity become null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _emit(options: argparse.Namespace, table: Table) -> None:
    rows = [{name: _plain(value) for name, value in row.items()} for row in table.rows()]
    document = json.dumps({"metadata": table.metadata, "rows": rows}, indent=1, allow_nan=False)
    if options.out is None:
        if options.json:
            print(document)
        else:
            table.write(sys.stdout)
    elif options.out.suffix.lower() == ".json":
        with atomic_file(options.out) as file:
            file.write(document + "\n")
    else:
        table.to_csv(options.out)


def _metadata(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "sd_friction_env": sd_friction_env.__version__,
        "numpy": np.__version__,
        "command": shlex.join(["sd-friction", *options.typed]),
    }


def _progress(total: int, unit: str) -> Callable[[int], None]:
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


def _with_columns(table: Table, columns: dict[str, Any]) -> dict[str, Any]:
    return {name: np.full(table.n_rows, value) for name, value in columns.items()} | dict(table)


def _stack(tables: Iterator[dict[str, Any]], metadata: dict[str, Any]) -> Table:
    parts = list(tables)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, metadata)


def _amplitude(options: argparse.Namespace) -> int:
    grid = _grid(options, belt_speed=False)
    given = options.belt_speed or [numbers("0:0.6:0.005")]
    speeds = checked_belt_speeds(list(itertools.chain.from_iterable(given)))
    x, v = _start(options)
    if options.attractors and options.start is not None:
        raise UsageError("--start and --attractors exclude each other: all attractors need no start")
    curves = sweeps.amplitude_sweep(
        [parameters for _, parameters in grid], speeds, engine_of(options), x=x, v=v, all_attractors=options.attractors
    )
    table = _stack(
        (_with_columns(curve, swept) for curve, (swept, _) in zip(curves, grid, strict=True)), _metadata(options)
    )
    _emit(options, table)
    if options.plot is not None:
        plotting.save_figure(plotting.draw_amplitude_table(table, [swept for swept, _ in grid]), options.plot)
    return 0


def _cycle(options: argparse.Namespace) -> int:
    grid = _grid(options)
    x, v = _start(options)
    show = _progress(len(grid), "cycles")
    rows = []
    for done, (swept, parameters) in enumerate(grid, start=1):
        cycle = limit_cycle(parameters, x, v)
        fields = [field.name for field in dataclasses.fields(cycle) if field.name != "parameters"]
        rows.append(swept | {name: getattr(cycle, name) for name in fields})
        show(done)
    table = Table({name: [row[name] for row in rows] for name in rows[0]}, _metadata(options))
    if len(rows) == 1 and options.out is None and not options.json:
        for name, value in rows[0].items():
            print(f"{name:22}{value if isinstance(value, str) else format(value, '.12g')}")
    else:
        _emit(options, table)
    return 0


def _critical(options: argparse.Namespace) -> int:
    if options.belt_speed is not None:
        raise UsageError("--belt-speed is what this command finds: leave it out")
    grid = _grid(options, belt_speed=False)
    show = _progress(len(grid), "oscillators")
    rows: list[dict[str, Any]] = []
    for done, (swept, parameters) in enumerate(grid, start=1):
        speeds = critical_belt_speeds(parameters)
        coefficient = first_lyapunov_coefficient(parameters)
        hopf = "" if math.isnan(coefficient) else "supercritical" if coefficient < 0.0 else "subcritical"
        numbers_ = {"v_b0": speeds.v_b0, "v_b1": speeds.v_b1, "first_lyapunov_coefficient": coefficient}
        rows.append(swept | numbers_ | {"hopf": hopf, "reason": speeds.reason})
        show(done)
    _emit(options, Table({name: [row[name] for row in rows] for name in rows[0]}, _metadata(options)))
    return 0


def _simulate(options: argparse.Namespace) -> int:
    parameters = _one(options)
    x, v = _start(options)
    history = simulate(parameters, x, v, options.t_end, dt=options.dt, force=options.force)
    table = history.to_table()
    events = [list(event) for event in history.events]
    table.metadata = _metadata(options) | {"status": history.status, "events": events}
    _emit(options, table)
    if options.plot is not None:
        plotting.save_figure(plotting.draw_history(history), options.plot)
    if history.status != "ok":
        print(f"sd-friction simulate: {history.status} at t = {history.t[-1]:.6g}", file=sys.stderr)
        return FAILURE
    return 0


def _basins(options: argparse.Namespace) -> int:
    parameters = _one(options)
    x_limits, v_limits, shape = tuple(options.x), tuple(options.v), tuple(options.shape)
    if options.backend == "sequential" and options.folder is None:
        engine_of(options)  # refuses what does not go with it
        x, v, found = basin_grid(parameters, x_limits, v_limits, shape)  # on all cores
    else:
        x, v, found = sweeps.basin_sweep(parameters, x_limits, v_limits, shape, engine_of(options))
    names = [f"{cycle.kind} round x = {0.5 * (cycle.x_max + cycle.x_min):.4f}" for cycle in found.attractors]
    rows: list[dict[str, Any]] = []
    for label, name in [*enumerate(names), (LOST_CONTACT, "contact lost"), (UNDECIDED, "undecided")]:
        share, error = found.fraction(label)
        size = found.attractors[label].amplitude if label >= 0 else math.nan
        rows.append({"label": label, "attractor": name, "amplitude": size, "fraction": share, "standard_error": error})
    _emit(options, Table({name: [row[name] for row in rows] for name in rows[0]}, _metadata(options)))
    if options.plot is not None:
        figure, axes = plotting.new_figure(6.8, 4.8, 1, 1)
        plotting.draw_basins(axes[0, 0], x, v, found)
        plotting.save_figure(figure, options.plot)
    return 0


def _poincare(options: argparse.Namespace) -> int:
    x, v = _start(options)
    section = poincare_section(_one(options), x, v, cycles=options.cycles, transient=options.transient)
    section.metadata = _metadata(options)
    _emit(options, section)
    if options.plot is not None:
        figure, axes = plotting.new_figure(5.4, 4.6, 1, 1)
        plotting.draw_section(axes[0, 0], section)
        plotting.save_figure(figure, options.plot)
    return 0


def _lyapunov(options: argparse.Namespace) -> int:
    grid = _grid(options)
    x, v = _start(options)
    show = _progress(len(grid), "motions")
    rows = []
    for done, (swept, parameters) in enumerate(grid, start=1):
        found = lyapunov_exponent(parameters, x, v, cycles=options.cycles, transient=options.transient)
        told = {"largest": found.largest, "standard_error": found.standard_error}
        exponents = {"first": found.exponents[0], "second": found.exponents[1]}
        rows.append(swept | told | exponents | {"singular_events": found.singular_events, "cycles": found.cycles})
        show(done)
    _emit(options, Table({name: [row[name] for row in rows] for name in rows[0]}, _metadata(options)))
    return 0


def _bifurcation(options: argparse.Namespace) -> int:
    name, *texts = options.over
    name = name.replace("-", "_")
    try:
        values = list(itertools.chain.from_iterable(numbers(text) for text in texts))
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--over {options.over[0]}: {error}") from None
    grid = _grid(options)
    if name in grid[0][0]:
        raise UsageError(f"--over and --{options.over[0]} are one parameter: give it once")
    tables = sweeps.bifurcation_sweep(
        [parameters for _, parameters in grid],
        name,
        values,
        engine_of(options),
        direction=options.direction,
        cycles=options.cycles,
        transient=options.transient,
        lyapunov=options.exponents,
    )
    table = _stack(
        (_with_columns(part, swept) for part, (swept, _) in zip(tables, grid, strict=True)), _metadata(options)
    )
    _emit(options, table)
    if options.plot is not None:
        figure, axes = plotting.new_figure(7.0, 4.4, 1, 1)
        plotting.draw_bifurcation(axes[0, 0], tables[0])
        plotting.save_figure(figure, options.plot)
    return 0


def _explore(options: argparse.Namespace) -> int:
    from sd_friction_env.explorer import server as explorer

    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port must be in [0, 65535], got {options.port}")
    if not options.host or ":" in options.host:
        raise UsageError(f"--host must be a name or an IPv4 address, got {options.host!r}")
    if not 1 <= options.sessions <= explorer.MOST_SESSIONS:
        raise UsageError(f"--sessions must be in [1, {explorer.MOST_SESSIONS}], got {options.sessions}")
    try:
        explorer.serve(
            options.host,
            options.port,
            allowed=options.allow_host,
            sessions=options.sessions,
            browser=not options.no_browser,
            say=_say,
        )
    except OSError as error:
        raise UsageError(f"cannot listen at --host {options.host} --port {options.port}: {error}") from None
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


def _video(options: argparse.Namespace) -> int:
    from sd_friction_env.control import video

    for name, low, high in (("steps", 1, video.MOST_STEPS), ("every", 1, video.MOST_STEPS), ("fps", 1, 60)):
        if not low <= getattr(options, name) <= high:
            raise UsageError(f"--{name} must be in [{low}, {high}], got {getattr(options, name)}")
    if options.seed < 0:
        raise UsageError(f"--seed must be at least 0, got {options.seed}")
    video.check_video_path(options.out, options.fps)
    width, height = checked_size(options.size)
    if options.out.suffix.lower() == ".mp4" and (width % 2 or height % 2):
        raise UsageError(f"--size must be even for .mp4, got {width} {height}")
    env_id = f"SDFriction/{_TASKS[options.task]}{_TIERS[options.tier]}-v0"
    policy, title = _agent(options, env_id)
    pictures = video.frames(
        env_id,
        policy,
        seed=options.seed,
        steps=options.steps,
        size=tuple(options.size),
        every=options.every,
        side_by_side=not options.alone,
        title=title,
    )
    show = _progress(options.steps // options.every + 1, "frames")
    video.write_video(options.out, pictures, fps=options.fps, progress=show)
    return 0


def _agent(options: argparse.Namespace, env_id: str) -> tuple[Policy, str]:
    """Return the controller that --agent names, and what to call it."""
    if options.gain is not None and options.agent != "velocity-feedback":
        raise UsageError(f"--gain goes with --agent velocity-feedback, not with {options.agent!r}")
    if options.agent == "none":
        return ZeroPolicy(), "no control"
    if options.agent == "pretrained":
        policy = load_pretrained(env_id)
        return policy, f"{policy.metadata['algorithm'].upper()} agent"
    env = gym.make(env_id)
    if options.agent == "velocity-feedback":
        gain = _VELOCITY_GAIN if options.gain is None else options.gain
        return VelocityFeedback.from_env(env, gain), "velocity feedback"
    if not options.agent.lower().endswith(".npz"):
        known = "pretrained, velocity-feedback, none or a policy.npz"
        raise UsageError(f"--agent must be {known}, got {options.agent!r}")
    try:
        network = load_policy(options.agent)
    except OSError as error:
        raise UsageError(f"--agent {options.agent!r} cannot be read: {error}") from None
    (size,) = env.observation_space.shape or (0,)
    if network.observation_size != size:
        raise UsageError(f"{options.agent!r} observes {network.observation_size} values, and {env_id} gives {size}")
    return network, str(network.metadata.get("algorithm", "controlled"))


def _hyperparameters(options: argparse.Namespace) -> int:
    folder = HYPERPARAMETERS
    known = sorted(file.stem for file in folder.glob("*.yml"))
    if options.algorithm is None:
        print(folder)
        return 0
    if options.algorithm not in known:
        raise UsageError(f"algorithm must be one of {', '.join(known)}, got {options.algorithm!r}")
    file = folder / f"{options.algorithm}.yml"
    print(file.read_text(encoding="utf-8").rstrip() if options.show else file)
    return 0


def _doctor(options: argparse.Namespace) -> int:
    if not options.json:
        print(versions_as_text(), flush=True)  # at once, whatever may fail or be compiled after it
    findings = examine()
    print(json.dumps(findings, indent=1) if options.json else as_text(findings, colour=_coloured()))
    return 0 if findings["works"] else FAILURE


def _coloured() -> bool:
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def _completion(options: argparse.Namespace) -> int:
    try:
        import shtab
    except ImportError:
        raise UsageError('completion needs shtab: pip install "sd-friction-env[completion]"') from None
    print(shtab.complete(parser(), shell=options.shell))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status: 0 done, 1 failed, 2 bad usage, 130 interrupted."""
    typed = list(sys.argv[1:] if arguments is None else arguments)
    options = parser().parse_args(typed)
    options.typed = typed
    try:
        if options.analysis:
            _check_output(options)
            # Compiled here, so that progress bars time the work alone.
            limit_cycle(OscillatorParameters())
        return int(options.run(options))
    except OrbitError as error:
        print(f"sd-friction: {error}", file=sys.stderr)
        return FAILURE
    except (ValueError, TypeError, ImportError) as error:
        print(f"sd-friction: {error}", file=sys.stderr)
        return BAD_USAGE
    except BrokenPipeError:  # the reader of our output has had enough
        sys.stderr.close()
        return 0
    except OSError as error:
        print(f"sd-friction: cannot write: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        kept = getattr(options, "folder", None)
        rest = f"the same command goes on with what is in {str(kept)!r}" if kept else "nothing written"
        print(f"\nsd-friction: interrupted, {rest}", file=sys.stderr)
        return INTERRUPTED
