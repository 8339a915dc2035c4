"""Run every check of the project: ruff, mypy, the import contracts, then the tests.

    python scripts/check.py                     everything
    python scripts/check.py --fix               mend what ruff can mend first
    python scripts/check.py --lint-only         all but the tests
    python scripts/check.py -k orbits -x        what is not an option of this script goes to pytest
    python scripts/check.py -n 0                tests in one process (default: one for each core)

All checks run even when one fails; the exit status is 1 if any did.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHON = sys.executable

MEND = {
    "ruff check --fix": [PYTHON, "-m", "ruff", "check", "--fix", "."],
    "ruff format": [PYTHON, "-m", "ruff", "format", "."],
}
LINT = {
    "ruff check": [PYTHON, "-m", "ruff", "check", "."],
    "ruff format --check": [PYTHON, "-m", "ruff", "format", "--check", "."],
    "mypy": [PYTHON, "-m", "mypy"],
    # Through the interpreter and not by its script, which lies in another folder on each system.
    "lint-imports": [
        PYTHON,
        "-c",
        "from importlinter.cli import lint_imports_command as main; main(['--no-logo'], prog_name='lint-imports')",
    ],
}


def run(name: str, command: list[str]) -> bool:
    """Run one check under a heading and tell whether it passed."""
    print(f"\n=== {name} ".ljust(80, "="), flush=True)
    start = time.perf_counter()
    passed = subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    # pytest times itself, and its closing line stays the last one: CI reads it.
    if name != "pytest":
        print(f"--- {name}: {'ok' if passed else 'FAILED'} ({time.perf_counter() - start:.1f} s)", flush=True)
    return passed


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
    failed = [name for name, command in LINT.items() if not run(name, command)]

    print("\n=== summary ".ljust(80, "="))
    for name in LINT:
        print(f"{'FAILED' if name in failed else 'ok':>6}  {name}")
    if options.lint_only:
        return int(bool(failed))
    print("  next  pytest", flush=True)
    # One process for each core, unless the arguments say how many, or stop where a process of its own would hide it.
    # Each begins with its own half of the tests: fewer functions are compiled by both.
    alone = any(argument.startswith(("-n", "--numprocesses", "--pdb", "-s")) for argument in for_pytest)
    if not run(
        "pytest", [PYTHON, "-m", "pytest", *([] if alone else ["-n", "auto", "--dist", "worksteal"]), *for_pytest]
    ):
        failed.append("pytest")
    if failed:
        print(f"\nFAILED: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
