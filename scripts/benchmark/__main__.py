"""Measure the speed, ours and others', interleaved in one run: medians, spreads and ratios, because timings vary.

    python scripts/benchmark                         all of it (about five minutes)
    python scripts/benchmark --quick                 fewer and shorter slices (a minute)
    python scripts/benchmark --only batch kernel     some sections
    python scripts/benchmark --out result.json --plot result.png

Each round times one slice of every contender, so what slows the machine slows them all, and a ratio is the median of
the rounds' ratios. EnvPool and gymnax run in an interpreter of their own (`make benchmark-peers` makes .venv-peers)
and wait while others are timed. What is not installed is skipped with a message. The exit status is 1 if a check fails
on which the validity of the numbers depends; a missed target is only printed.
"""

import argparse
import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import sd_friction_env
from scripts.benchmark import arithmetic, batches, drawing, peers, sb3, startup, with_scipy
from scripts.benchmark.batches import FORCE, our_label
from scripts.benchmark.measuring import Bench, Numbers, Rows, Target, best_ratio
from sd_friction_env.cli.options import check_file
from sd_friction_env.pictures import plotting
from sd_friction_env.storage import atomic_file

ROOT = Path(__file__).resolve().parents[2]
BUSY = 0.5
KIBIBYTE = 1024.0

SECTIONS: dict[str, Callable[[Bench], None]] = {
    "work": batches.work,
    "single": batches.single,
    "batch": batches.batch,
    "slip": batches.slip,
    "kernel": arithmetic.compiled_step,
    "peers": peers.peers,
    "sb3": sb3.sb3,
    "ppo": sb3.ppo,
    "scipy": with_scipy.with_scipy,
    "cycle": with_scipy.one_cycle,
    "startup": startup.startup,
    "memory": startup.memory,
}


def targets(rows: Rows, numbers: Numbers) -> list[Target]:
    """Return the targets and the values reached."""

    def ratio(section: str, ours: Sequence[str], others: Sequence[str]) -> float | None:
        return best_ratio(rows.get(section, {}), ours, others)

    def ours(n: int) -> list[str]:
        return [our_label(FORCE, n, threads) for threads in (1, 2)]

    result = [Target("one environment, CartPole-v1's speed times", ratio("single", [FORCE], ["CartPole-v1"]), 2.0)]
    for n, bound in ((1024, 1.5), (8192, 2.0)):
        what = f"batch of {n:,} (1 or 2 threads), CartPole-v1's speed times"
        result.append(Target(what, ratio("batch", ours(n), [f"CartPole-v1, {n:,}"]), bound))
    for name, program, bound in (("EnvPool's Pendulum", "envpool", 20.0), ("gymnax's Pendulum", "gymnax", 5.0)):
        others = [label for label, (which, _) in peers.PEERS.items() if which == program]
        result.append(Target(f"batch of 1,024, {name}'s speed times", ratio("peers", ours(1024), others), bound))
    share = numbers.get("kernel", {}).get("share of the limit, slip only")
    result.append(Target("kernel on one core, slip only, share of the arithmetic limit", share, 0.5))
    trained = ratio("ppo", [f"PPO, SDFrictionVecEnv of 256 {FORCE}"], ["PPO, 256 environments that cost nothing"])
    result.append(Target("PPO, speed with environments that cost nothing times", trained, 0.93))
    held = numbers.get("memory", {}).get("bytes per environment")
    kibibytes = None if held is None else held / KIBIBYTE
    result.append(Target("memory per environment of a batch, KiB", kibibytes, 1.0, at_least=False))
    return result


def print_targets(every: Sequence[Target]) -> None:
    """Print the table of targets."""
    print(f"\nTargets (median of the rounds' ratios)\n  {'':62}{'reached':>14}{'target':>16}")
    words = {True: "met", False: "NOT MET", None: "not measured"}
    for target in every:
        reached = "" if target.reached is None else f"{target.reached:.3g}"
        bound = f"{'at least' if target.at_least else 'below'} {target.bound:g}"
        print(f"  {target.what:62}{reached:>14}{bound:>16}   {words[target.met]}")
    sys.stdout.flush()


def machine() -> dict[str, Any]:
    """Return what the numbers were measured on."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    result: dict[str, Any] = {
        "cpu": name,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
    for package in ("numpy", "numba", "gymnasium", "scipy", "stable-baselines3", "torch"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            result[package] = importlib.metadata.version(package)
    result["sd_friction_env"] = sd_friction_env.__version__
    if hasattr(os, "getloadavg"):
        result["load"] = os.getloadavg()[0]
    return result


def print_machine(measured_on: Mapping[str, Any]) -> None:
    """Print what the numbers were measured on, and a warning if it has other work."""
    parts = (f"{name} {value:.2f}" if name == "load" else f"{name} {value}" for name, value in measured_on.items())
    print(", ".join(parts))
    if measured_on.get("load", 0.0) > BUSY:
        print(f"WARNING: the machine is busy (load {measured_on['load']:.2f}): ratios can be trusted, rates less")
    sys.stdout.flush()


def as_json(bench: Bench, measured_on: Mapping[str, Any], *, interrupted: bool) -> dict[str, Any]:
    """Return all measurements, ready for JSON."""
    rows = {
        section: {
            label: {"median": row.median, "quartiles": list(row.quartiles), **dataclasses.asdict(row)}
            for label, row in measured.items()
        }
        for section, measured in bench.rows.items()
    }
    return {
        "machine": dict(measured_on),
        "settings": {"quick": bench.quick, "rounds": bench.rounds, "steps": bench.steps, "interrupted": interrupted},
        "rows": rows,
        "numbers": bench.numbers,
        "checks": [{**check._asdict(), "met": check.met} for check in bench.checks],
        "targets": [{**target._asdict(), "met": target.met} for target in targets(bench.rows, bench.numbers)],
        "skipped": bench.skipped,
    }


def _default_peers() -> Path | None:
    folder = ROOT / ".venv-peers"
    return next((path for path in (folder / "bin/python", folder / "Scripts/python.exe") if path.is_file()), None)


def _parsed(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer and shorter slices, no cold start")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=f"some sections: {', '.join(SECTIONS)}"
    )
    parser.add_argument("--rounds", type=int, metavar="N", help="how many slices of each (default 15; --quick 3)")
    parser.add_argument("--steps", type=int, metavar="N", help="steps (of a batch: calls) in a slice, for a trial")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the numbers as JSON")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the rates: .png, .pdf or .svg")
    parser.add_argument(
        "--peers", metavar="PYTHON", help="interpreter that has EnvPool and gymnax (default: .venv-peers, or this one)"
    )
    options = parser.parse_args(arguments)
    for name in ("rounds", "steps"):
        value = getattr(options, name)
        if value is not None and value < 1:
            parser.error(f"--{name} must be a whole number of at least 1, got {value}")
    try:
        check_file("--out", options.out, ".json")
        check_file("--plot", options.plot, *plotting.FORMATS)
    except ValueError as error:
        parser.error(str(error))
    if options.peers is None:
        options.peers = _default_peers()
    else:
        options.peers = Path(options.peers).absolute()  # not resolved: a virtual environment's Python is a link
        try:
            command = [str(options.peers), "-c", "import sys; print(sys.version_info[0])"]
            answer = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
        except (OSError, subprocess.SubprocessError):
            answer = ""
        if answer.strip() != "3":
            parser.error(f"--peers must be a Python 3 interpreter, such as .venv-peers/bin/python, got {options.peers}")
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; return the exit status: 1 if a check failed, 130 if it was interrupted."""
    options = _parsed(arguments)
    bench = Bench(quick=options.quick, rounds=options.rounds, steps=options.steps, peers=options.peers)
    measured_on = machine()
    print_machine(measured_on)
    interrupted = False
    try:
        for name, section in SECTIONS.items():
            if options.only is None or name in options.only:
                bench.progress(f"{name}: {(section.__doc__ or '').splitlines()[0]}")
                section(bench)
    except KeyboardInterrupt:
        interrupted = True
        print("\nInterrupted: the measurements so far follow")
    print_targets(targets(bench.rows, bench.numbers))
    if options.out is not None:
        with atomic_file(options.out) as file:
            json.dump(as_json(bench, measured_on, interrupted=interrupted), file, indent=1)
    if options.plot is not None:
        if importlib.util.find_spec("matplotlib") is None:
            print("--plot: skipped, matplotlib is not installed")
        elif not any(row.panel for measured in bench.rows.values() for row in measured.values()):
            print("--plot: skipped, nothing was measured that it shows")
        else:
            drawing.draw(bench.rows, options.plot)
    failed = [check.what for check in bench.checks if not check.met]
    if failed:
        print(f"FAILED: {'; '.join(failed)}", file=sys.stderr)
        return 1
    return 130 if interrupted else 0


if __name__ == "__main__":
    raise SystemExit(main())
