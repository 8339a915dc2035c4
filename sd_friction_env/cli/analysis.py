"""Passive and forced analysis: amplitude, cycle, critical, chart, simulate, basins, integrity, poincare, and so on."""

import argparse
import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from sd_friction_env.cli.options import (
    FAILURE,
    Command,
    UsageError,
    add_engine,
    add_oscillator,
    add_output,
    add_start,
    check_output,
    emit,
    engine_of,
    grid_of,
    metadata_of,
    numbers,
    one_of,
    print_table,
    progress_bar,
    stacked,
    start_of,
)
from sd_friction_env.physics import sweeps
from sd_friction_env.physics.basins import basin_grid
from sd_friction_env.physics.charts import stability_chart
from sd_friction_env.physics.curves import checked_belt_speeds, refined_curve
from sd_friction_env.physics.forced import bifurcation_diagram, lyapunov_exponent, poincare_section
from sd_friction_env.physics.orbits import critical_belt_speeds, first_lyapunov_coefficient, limit_cycle
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.physics.simulation import simulate
from sd_friction_env.physics.tables import Table
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import save_arrays


def _plot(options: argparse.Namespace, width: float, height: float, draw: Callable[..., None], *data: Any) -> None:
    """Draw data into the file of --plot, if it is given."""
    if options.plot is not None:
        figure, axes = plotting.new_figure(width, height, 1, 1)
        draw(axes[0, 0], *data)
        plotting.save_figure(figure, options.plot)


def _amplitude(options: argparse.Namespace) -> int:
    grid = grid_of(options, belt_speed=False)
    given = options.belt_speed or [numbers("0:0.6:0.005")]
    speeds = checked_belt_speeds(list(itertools.chain.from_iterable(given)))
    x, v = start_of(options)
    if options.attractors and options.start is not None:
        raise UsageError("--start and --attractors exclude each other: all attractors need no start")
    curves = sweeps.amplitude_sweep(
        [parameters for _, parameters in grid], speeds, engine_of(options), x=x, v=v, all_attractors=options.attractors
    )
    table = stacked(options, curves, grid)
    emit(options, table)
    if options.plot is not None:
        if not options.attractors:  # lines, which want the points at which they end
            table = stacked(options, (refined_curve(plant, speeds, x=x, v=v) for _, plant in grid), grid)
        plotting.save_figure(plotting.draw_amplitude_table(table, [swept for swept, _ in grid]), options.plot)
    return 0


def _row_for_each(
    options: argparse.Namespace, unit: str, row_of: Callable[[OscillatorParameters], dict[str, Any]], **which: bool
) -> Table:
    """Return a table with a row for each oscillator of the grid, after the swept parameters."""
    grid = grid_of(options, **which)
    show = progress_bar(len(grid), unit)
    rows = []
    for done, (swept, parameters) in enumerate(grid, start=1):
        rows.append(swept | row_of(parameters))
        show(done)
    return Table.from_rows(rows, metadata_of(options))


def _cycle(options: argparse.Namespace) -> int:
    start = start_of(options)

    def row_of(parameters: OscillatorParameters) -> dict[str, Any]:
        cycle = limit_cycle(parameters, *start)
        names = [field.name for field in dataclasses.fields(cycle) if field.name != "parameters"]
        return {name: getattr(cycle, name) for name in names}

    table = _row_for_each(options, "cycles", row_of)
    if table.n_rows == 1 and options.out is None and not options.json:
        for name, value in next(table.rows()).items():
            print(f"{name:22}{value if isinstance(value, str) else format(value, '.12g')}")
    else:
        emit(options, table)
    return 0


def _critical(options: argparse.Namespace) -> int:
    if options.belt_speed is not None:
        raise UsageError("--belt-speed is what this command finds: leave it out")

    def row_of(parameters: OscillatorParameters) -> dict[str, Any]:
        speeds, coefficient = critical_belt_speeds(parameters), first_lyapunov_coefficient(parameters)
        hopf = "" if math.isnan(coefficient) else "supercritical" if coefficient < 0.0 else "subcritical"
        found = {"v_b0": speeds.v_b0, "v_b1": speeds.v_b1, "first_lyapunov_coefficient": coefficient}
        return found | {"hopf": hopf, "reason": speeds.reason}

    emit(options, _row_for_each(options, "oscillators", row_of, belt_speed=False))
    return 0


def _chart(options: argparse.Namespace) -> int:
    over, against, engine = _range_of("--over", options.over), _against(options), engine_of(options)
    if against == "belt_speed" and options.belt_speed is not None:
        raise UsageError("--belt-speed is an axis of the chart: leave it out")
    chart = stability_chart(one_of(options), over, against, points=options.points, engine=engine)
    chart.metadata = metadata_of(options) | chart.metadata
    emit(options, chart)
    _plot(options, 6.4, 4.4, plotting.draw_chart, chart)
    return 0


def _range_of(option: str, given: list[str]) -> tuple[str, float, float]:
    """Return a parameter and its range."""
    name, text = given
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise UsageError(f"{option} {name}: {text!r} must be LOW:HIGH, two numbers") from None
    return name.replace("-", "_"), low, high


def _against(options: argparse.Namespace) -> str | tuple[str, float, float]:
    if options.against in (["belt_speed"], ["belt-speed"]):
        return "belt_speed"
    if len(options.against) != 2:
        raise UsageError(f"--against must be belt_speed, or NAME LOW:HIGH, got {' '.join(options.against)!r}")
    return _range_of("--against", options.against)


def _simulate(options: argparse.Namespace) -> int:
    parameters = one_of(options)
    x, v = start_of(options)
    history = simulate(parameters, x, v, options.t_end, dt=options.dt, force=options.force)
    table = history.to_table()
    events = [list(event) for event in history.events]
    table.metadata = metadata_of(options) | {"status": history.status, "events": events}
    emit(options, table)
    if options.plot is not None:
        plotting.save_figure(plotting.draw_history(history), options.plot)
    if history.status != "ok":
        print(f"sd-friction simulate: {history.status} at t = {history.t[-1]:.6g}", file=sys.stderr)
        return FAILURE
    return 0


def _basins(options: argparse.Namespace) -> int:
    parameters = one_of(options)
    x_limits, v_limits, shape = tuple(options.x), tuple(options.v), tuple(options.shape)
    on_disk = options.out is not None and options.out.suffix.lower() == ".npy"
    if on_disk and options.plot is not None:
        raise UsageError("--plot needs the labels in memory: leave it out with --out FILE.npy")
    if on_disk:
        shares = sweeps.basin_file(parameters, x_limits, v_limits, shape, engine_of(options), options.out)
    elif options.backend == "sequential" and options.folder is None:
        engine_of(options)  # refuses what does not go with it
        x, v, found = basin_grid(parameters, x_limits, v_limits, shape)  # on all cores
        shares = found.fractions()
    else:
        x, v, found = sweeps.basin_sweep(parameters, x_limits, v_limits, shape, engine_of(options))
        shares = found.fractions()
    shares.metadata = metadata_of(options)
    print_table(options, shares)
    if options.out is not None and not on_disk:
        named = zip(shares["label"].tolist(), shares["attractor"].tolist(), strict=True)
        metadata = shares.metadata | {"labels": {str(label): name for label, name in named}}
        if options.out.suffix.lower() == ".npz":
            about = {"metadata": np.array(json.dumps(metadata))}
            save_arrays(options.out, {"x": x, "v": v, "labels": found.labels, **about})
        else:
            grid_x, grid_v = np.meshgrid(x, v)
            columns: dict[str, Any] = {"x": grid_x.ravel(), "v": grid_v.ravel(), "label": found.labels.ravel()}
            emit(options, Table(columns, metadata))
    if not on_disk:
        _plot(options, 6.8, 4.8, plotting.draw_basins, x, v, found)
    return 0


def _integrity(options: argparse.Namespace) -> int:
    grid = grid_of(options)
    tables = sweeps.integrity_sweep(
        [parameters for _, parameters in grid],
        tuple(options.x),
        tuple(options.v),
        engine_of(options),
        starts=options.starts,
        scales=tuple(options.scales),
        limit=options.limit,
        seed=options.seed,
    )
    emit(options, stacked(options, tables, grid))
    return 0


def _poincare(options: argparse.Namespace) -> int:
    x, v = start_of(options)
    section = poincare_section(one_of(options), x, v, cycles=options.cycles, transient=options.transient)
    section.metadata = metadata_of(options)
    emit(options, section)
    _plot(options, 5.4, 4.6, plotting.draw_section, section)
    return 0


def _lyapunov(options: argparse.Namespace) -> int:
    start, how = start_of(options), {"cycles": options.cycles, "transient": options.transient}

    def row_of(parameters: OscillatorParameters) -> dict[str, Any]:
        found = lyapunov_exponent(parameters, *start, **how)
        first, second = found.exponents
        row = {"largest": found.largest, "standard_error": found.standard_error, "first": first, "second": second}
        return row | {"singular_events": found.singular_events, "cycles": found.cycles}

    emit(options, _row_for_each(options, "motions", row_of))
    return 0


def _over(
    options: argparse.Namespace, sweep: Callable[..., list[Table]], draw: Callable[[Any, Table], None], **arguments: Any
) -> int:
    """Run a sweep over the parameter of --over for each oscillator of the grid; write it, and draw the first."""
    name, *texts = options.over
    name = name.replace("-", "_")
    try:
        values = list(itertools.chain.from_iterable(numbers(text) for text in texts))
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"--over {options.over[0]}: {error}") from None
    grid = grid_of(options)
    if name in grid[0][0]:
        raise UsageError(f"--over and --{options.over[0]} are one parameter: give it once")
    arguments |= {"direction": options.direction, "cycles": options.cycles, "transient": options.transient}
    tables = sweep([parameters for _, parameters in grid], name, values, engine_of(options), **arguments)
    table = stacked(options, tables, grid)
    named = {name if column == "value" else column: data for column, data in table.items()}
    emit(options, Table(named, table.metadata))
    _plot(options, 7.0, 4.4, draw, tables[0])
    return 0


def _branches(options: argparse.Namespace) -> int:
    (name, low, high), grid = _range_of("--over", options.over), grid_of(options)
    if name in grid[0][0]:
        raise UsageError(f"--{options.over[0]} is where the branch starts: give one value")
    x, v = start_of(options)
    how: dict[str, Any] = {"points": options.points, "doublings": options.doubled, "transient": options.transient}
    plants = [parameters for _, parameters in grid]
    tables = sweeps.branch_sweep(plants, (name, low, high), engine_of(options), x=x, v=v, **how)
    emit(options, stacked(options, tables, grid))
    if options.plot is not None:
        values = [value for value in np.linspace(low, high, 201).tolist() if _is_valid(plants[0], name, value)]
        brute_force = bifurcation_diagram(plants[0], name, values, direction="both", cycles=60, x=x, v=v)
        figure, axes = plotting.new_figure(7.0, 4.4, 1, 1)
        plotting.draw_bifurcation(axes[0, 0], brute_force)
        plotting.draw_branches(axes[0, 0], tables[0])
        plotting.save_figure(figure, options.plot)
    return 0


def _is_valid(parameters: OscillatorParameters, name: str, value: float) -> bool:
    try:
        return parameters.replace(**{name: value}) is not None
    except ValueError:
        return False


# Options --------------------------------------------------------------------------------------------------------------


def _add_amplitude(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    parser.add_argument("--attractors", action="store_true", help="all attractors of every point, whatever the start")
    add_engine(parser)
    add_output(parser, "amplitude over the belt speed")


def _add_cycle(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    add_output(parser, None)


def _add_chart(parser: argparse.ArgumentParser) -> None:
    _add_range(parser, "the second parameter and its range, such as alpha 0.1:1.2")
    text = "the other axis (default: belt_speed); of another parameter with its range, at the oscillator's belt speed"
    parser.add_argument("--against", nargs="+", default=["belt_speed"], metavar=("NAME", "LOW:HIGH"), help=text)
    _add_points(parser, 200)
    add_engine(parser)
    add_output(parser, "the chart: where it squeals")


def _add_range(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--over", nargs=2, required=True, metavar=("NAME", "LOW:HIGH"), help=text)


def _add_points(parser: argparse.ArgumentParser, default: int) -> None:
    text = f"least number on a curve over the whole range (default: {default})"
    parser.add_argument("--points", type=int, default=default, metavar="N", help=text)


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    parser.add_argument("--t-end", type=float, default=100.0, help="when to end (default: 100)")
    parser.add_argument("--dt", type=float, default=0.01, help="time between samples (default: 0.01)")
    parser.add_argument("--force", type=float, default=0.0, help="constant control force (default: 0)")
    add_output(parser, "displacement, velocity and phase portrait")


def _add_box(parser: argparse.ArgumentParser) -> None:
    for name, default in (("--x", (-1.5, 1.5)), ("--v", (-1.0, 1.0))):
        text = f"starts in {name[2:]} (default: {default[0]} {default[1]})"
        parser.add_argument(name, nargs=2, type=float, default=default, metavar=("LOW", "HIGH"), help=text)


def _add_basins(parser: argparse.ArgumentParser) -> None:
    add_engine(parser)
    _add_box(parser)
    parser.add_argument("--shape", nargs=2, type=int, default=[400, 400], metavar=("N", "M"), help="grid (400 400)")
    add_output(
        parser,
        "the basins",
        out="the label of each start to FILE.npz, .npy (any size), .csv or .json (the shares are printed)",
    )
    parser.set_defaults(out_endings=(".npz", ".npy", ".csv", ".json"))


def _add_integrity(parser: argparse.ArgumentParser) -> None:
    add_engine(parser)
    _add_box(parser)
    parser.add_argument("--starts", type=int, default=20_000, metavar="N", help="drawn in each round (default: 20000)")
    text = "lengths of dx and dv that count as 1 in the size of a shock (default: 1 1)"
    parser.add_argument("--scales", nargs=2, type=float, default=(1.0, 1.0), metavar=("DX", "DV"), help=text)
    parser.add_argument("--limit", type=float, default=2.0, help="largest size of a shock (default: 2)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    add_output(parser, None)


def _add_cycles(parser: argparse.ArgumentParser, default: int) -> None:
    text = f"drive periods recorded (default: {default})"
    parser.add_argument("--cycles", type=int, default=default, metavar="N", help=text)
    _add_transient(parser, "them")


def _add_transient(parser: argparse.ArgumentParser, what: str) -> None:
    text = f"drive periods before {what} (default: 200)"
    parser.add_argument("--transient", type=int, default=200, metavar="N", help=text)


def _add_poincare(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    _add_cycles(parser, 1000)
    add_output(parser, "the section")


def _add_lyapunov(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    _add_cycles(parser, 2000)
    add_output(parser, None)


def _add_over(parser: argparse.ArgumentParser, cycles: int, plot: str) -> None:
    text = "the parameter, and its values or ranges"
    parser.add_argument("--over", nargs="+", required=True, metavar=("NAME", "VALUE"), help=text)
    parser.add_argument("--direction", choices=("up", "down", "both"), default="both", help="(default: both)")
    _add_cycles(parser, cycles)
    add_engine(parser)
    add_output(parser, plot)


def _add_bifurcation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--exponents", action="store_true", help="the largest Lyapunov exponent of each as well")
    _add_over(parser, 60, "the diagram")


def _add_branches(parser: argparse.ArgumentParser) -> None:
    add_start(parser)
    _add_transient(parser, "the orbit is looked for")
    _add_range(parser, "the parameter and its range; the branch starts at the oscillator's own value")
    text = "also the orbits of twice the period from each flip on, N times (default: 1)"
    parser.add_argument("--doubled", type=int, nargs="?", const=1, default=0, metavar="N", help=text)
    _add_points(parser, 100)
    add_engine(parser)
    add_output(parser, "the branches over the bifurcation diagram")


def _command(
    add: Callable[[argparse.ArgumentParser], None], run: Callable[[argparse.Namespace], int], *examples: str
) -> Command:
    def add_all(parser: argparse.ArgumentParser) -> None:
        parser.usage = f"{parser.prog} [options]"  # the list of all takes a page
        add_oscillator(parser)
        add(parser)

    def check_and_run(options: argparse.Namespace) -> int:
        check_output(options)
        limit_cycle(OscillatorParameters())  # compiled here, so that progress bars time the work alone
        return run(options)

    return Command(add_all, check_and_run, examples)


_FORCED = "--force-amplitude 0.2 --force-frequency 1.3"

COMMANDS = {
    "amplitude": _command(
        _add_amplitude,
        _amplitude,
        "--belt-speed 0:0.6:0.005",
        "--alpha 0.2 0.5 0.7 0.8 --belt-speed 0:0.6:0.005 --geometry cubic --out curve.csv --plot curve.png",
        "--alpha 0.5 --belt-speed 0.4:0.45:0.001 --attractors",
        "--alpha 0.2:1:0.01 --belt-speed 0:0.6:0.001 --backend loky --folder map --out map.csv",
    ),
    "cycle": _command(_add_cycle, _cycle, "", "--geometry cubic --belt-speed 0.405 --json", "--alpha 0.2 --start -1 0"),
    "critical": _command(
        lambda parser: add_output(parser, None),
        _critical,
        "",
        "--geometry cubic exact linear --alpha 0.2:0.8:0.1",
        "--mu-m 0.1575 --json",
    ),
    "chart": _command(
        _add_chart,
        _chart,
        "--over alpha 0.1:1.2 --against belt_speed --plot chart.png --out chart.csv",
        "--friction gaussian --geometry linear --over beta 0.02:0.1 --plot chart.png",
        "--belt-speed 0.3 --over alpha 0.4:1.2 --against mu-m 0.05:0.18 --plot chart.png",
    ),
    "simulate": _command(
        _add_simulate,
        _simulate,
        "--t-end 60 --out history.csv --plot history.png",
        "--start 0.3 -0.4 --dt 0.1 --force 0.02",
    ),
    "basins": _command(
        _add_basins,
        _basins,
        "--alpha 0.2 --plot basins.png",
        "--alpha 0.5 --belt-speed 0.43 --x -1.5 1.5 --v -1 1 --shape 800 800",
        "--alpha 0.5 --shape 40000 25000 --backend loky --folder kept --out labels.npy",
        "--alpha 0.5 --shape 4000 2500 --backend dask --address tcp://10.0.0.1:8786 --folder basins-alpha-5",
    ),
    "integrity": _command(
        _add_integrity,
        _integrity,
        "--alpha 0.5:0.7:0.05 --belt-speed 0.46 --out integrity.csv",
        "--geometry linear --friction exponential --mu-s 1 --mu-k 0.5 --belt-speed 1.2:1.8:0.1 --scales 1 2",
    ),
    "poincare": _command(_add_poincare, _poincare, f"{_FORCED} --cycles 2000 --out section.csv --plot section.png"),
    "lyapunov": _command(
        _add_lyapunov,
        _lyapunov,
        _FORCED,
        "--force-amplitude 0.05:0.3:0.01 --force-frequency 1.3 --out exponents.csv",
        "--belt-speed 0.42",
    ),
    "bifurcation": _command(
        _add_bifurcation,
        lambda given: _over(given, sweeps.bifurcation_sweep, plotting.draw_bifurcation, lyapunov=given.exponents),
        "--force-frequency 1.3 --over force-amplitude 0.01:0.3:0.002 --backend loky --plot diagram.png",
    ),
    "branches": _command(
        _add_branches,
        _branches,
        "--alpha 0.7 --force-amplitude 0.12 --over force-amplitude 0.02:0.3 --doubled --out branches.csv --plot b.png",
        "--alpha 0.5:0.9:0.05 --force-amplitude 0.12 --over belt-speed 0.05:0.4 --folder kept --out branches.csv",
    ),
    "response": _command(
        lambda parser: _add_over(parser, 32, "amplitude and phase"),
        lambda given: _over(given, sweeps.response_sweep, plotting.draw_response),
        "--force-amplitude 0.1 --over force-frequency 0.5:1.5:0.01 --out response.csv --plot response.png",
        "--geometry duffing --mu-s 0 --mu-m 0 --force-amplitude 0.1 0.2 --over force-frequency 0.8:1.8:0.02",
    ),
}
