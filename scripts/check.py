"""Run every check of the project: ruff, mypy, the import contracts, then the tests.

    python scripts/check.py                     everything
    python scripts/check.py --fix               mend what ruff can mend first
    python scripts/check.py --lint-only         all but the tests
    python scripts/check.py -k orbits -x        what is not an option of this script goes to pytest
    python scripts/check.py -n 0                tests in one process (default: one for each core)

All checks run even when one fails; the exit status is 1 if any did. mypy, which takes longest, works beside the tests.
"""

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHON = sys.executable

MEND = {
    "ruff check --fix": [PYTHON, "-m", "ruff", "check", "--fix", "."],
    "ruff format": [PYTHON, "-m", "ruff", "format", "."],
}
MYPY = [PYTHON, "-m", "mypy"]
LINT = {
    "ruff check": [PYTHON, "-m", "ruff", "check", "."],
    "ruff format --check": [PYTHON, "-m", "ruff", "format", "--check", "."],
    # Through the interpreter and not by its script, which lies in another folder on each system.
    "lint-imports": [
        PYTHON,
        "-c",
        "from importlinter.cli import lint_imports_command as main; main(['--no-logo'], prog_name='lint-imports')",
    ],
}


def run(name: str, command: list[str]) -> bool:
    """Run one check under a heading and tell whether it passed."""
    heading(name)
    start = time.perf_counter()
    passed = subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    # pytest times itself, and its closing line stays the last one: CI reads it.
    if name != "pytest":
        print(f"--- {name}: {'ok' if passed else 'FAILED'} ({time.perf_counter() - start:.1f} s)", flush=True)
    return passed


def heading(name: str) -> None:
    """Print a line that begins the output of a check."""
    print(f"\n=== {name} ".ljust(80, "="), flush=True)


@contextlib.contextmanager
def beside(name: str, command: list[str]) -> Iterator[Callable[[], bool]]:
    """Start a check; yield a function that waits for it, prints what it said and tells whether it passed."""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)

        def finish() -> bool:
            heading(name)
            passed = process.wait() == 0
            output.seek(0)
            print(f"{output.read()}--- {name}: {'ok' if passed else 'FAILED'}", flush=True)
            return passed

        try:
            yield finish
        finally:
            process.kill()
            process.wait()


def test(command: list[str], before_the_last_line: Callable[[], object]) -> bool:
    """Show the tests while they run, but hold the last line back for the other checks' output."""
    heading("pytest")
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, errors="replace") as process:
        assert process.stdout is not None
        held = ""
        for line in process.stdout:
            print(held, end="", flush=True)
            held = line
        before_the_last_line()
        print(held, end="", flush=True)
    return process.returncode == 0


def main(arguments: list[str] | None = None) -> int:
    """Run the checks that the command line asks for; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--fix", action="store_true", help="let ruff mend and format first")
    parser.add_argument("--lint-only", action="store_true", help="leave the tests out")
    options, for_pytest = parser.parse_known_args(arguments)
    if options.lint_only and for_pytest:
        parser.error(f"--lint-only runs no tests, so nothing reads {' '.join(for_pytest)}")

    if options.fix:
        for name, command in MEND.items():
            run(name, command)
    failed = []
    with beside("mypy", MYPY) as mypy:

        def finish_mypy() -> None:
            if not mypy():
                failed.append("mypy")

        failed += [name for name, command in LINT.items() if not run(name, command)]
        pytest = [PYTHON, "-m", "pytest", *for_pytest]
        # One process for each core, unless the arguments say how many, or stop where that would hide it.
        if options.lint_only or any(given.startswith(("-n", "--numprocesses", "--pdb", "-s")) for given in for_pytest):
            finish_mypy()
            if not options.lint_only and not run("pytest", pytest):
                failed.append("pytest")
        # Each process begins with its own half: fewer functions are compiled by both.
        elif not test([*pytest, "-n", "auto", "--dist", "worksteal"], finish_mypy):
            failed.append("pytest")
    if failed:
        print(f"\nFAILED: {', '.join(failed)}", file=sys.stderr)
    elif options.lint_only:
        print("\nAll passed.")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
