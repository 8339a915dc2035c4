"""The installation: ``sd-friction hyperparameters``, ``doctor``, ``completion``."""

import argparse
import json
import os
import sys

from sd_friction_env.cli.doctor import as_text, examine, versions_as_text
from sd_friction_env.cli.options import FAILURE, Command, UsageError
from sd_friction_env.extras import extra
from sd_friction_env.storage import HYPERPARAMETERS


def _hyperparameters(options: argparse.Namespace) -> int:
    known = sorted(file.stem for file in HYPERPARAMETERS.glob("*.yml"))
    if options.algorithm is None:
        print(HYPERPARAMETERS)
        return 0
    if options.algorithm not in known:
        raise UsageError(f"algorithm must be one of {', '.join(known)}, got {options.algorithm!r}")
    file = HYPERPARAMETERS / f"{options.algorithm}.yml"
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
    with extra("completion"):
        import shtab
    from sd_friction_env.cli.main import parser

    print(shtab.complete(parser(), shell=options.shell))
    return 0


def _add_hyperparameters(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("algorithm", nargs="?", help="such as ppo (default: the folder of all)")
    parser.add_argument("--show", action="store_true", help="print the file itself")


def _add_doctor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_completion(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"))


COMMANDS = {
    "hyperparameters": Command(_add_hyperparameters, _hyperparameters, ["", "ppo", "ppo --show"]),
    "doctor": Command(_add_doctor, _doctor, ["", "--json"]),
    "completion": Command(
        _add_completion,
        _completion,
        ["bash > ~/.local/share/bash-completion/completions/sd-friction", "zsh > ~/.zfunc/_sd-friction"],
    ),
}
