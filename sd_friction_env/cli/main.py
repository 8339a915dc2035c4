"""The program ``sd-friction``: analysis, training, evaluation and pictures without writing code."""

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import NoReturn

import sd_friction_env
from sd_friction_env.cli.options import BAD_USAGE, FAILURE, INTERRUPTED, Command, FailedError, Parser, UsageError

# By name: the module that holds it, the extra that it needs, and what it gives.
_COMMANDS = {
    "amplitude": ("analysis", "plot", "amplitude, period and kind of motion over the belt speed"),
    "cycle": ("analysis", "plot", "the limit cycle that one start reaches"),
    "critical": ("analysis", "plot", "belt speeds at which stick-slip (v_b0) and oscillation (v_b1) end"),
    "chart": ("analysis", "plot", "where it squeals: v_b0, v_b1 and the regions between over a second parameter"),
    "simulate": ("analysis", "plot", "one history in time"),
    "basins": ("analysis", "plot", "the attractor that each start of a grid reaches"),
    "integrity": ("analysis", "plot", "the size of each basin, and the smallest shock that leaves it"),
    "poincare": ("analysis", "plot", "the state once per drive period of a forced motion"),
    "lyapunov": ("analysis", "plot", "Lyapunov exponents: is a motion chaotic?"),
    "bifurcation": ("analysis", "plot", "sections of a forced motion over a parameter, up and down"),
    "branches": ("analysis", "plot", "periodic orbits of a forced motion, stable or not, followed over a parameter"),
    "response": ("analysis", "plot", "amplitude and phase of a forced motion over a parameter, up and down"),
    "train": ("train", "train", "an agent that suppresses the vibration, in a run folder"),
    "evaluate": ("evaluate", "train", "agents and classical controllers compared on the protocol's episodes"),
    "benchmark": ("benchmark", "train", "a controller entered in the benchmark; entries verified and ranked"),
    "grid": ("evaluate", "sweep", "one controller on a grid of plants, in chunks"),
    "tune": ("tune", "tune", "a search for hyperparameters with Optuna"),
    "tune-classical": ("tune", "train", "the gains of the classical controllers"),
    "optimum": ("optimum", "train", "the optimal-control reference of a task"),
    "export": ("export", "export", "an agent as ONNX, checked against the agent"),
    "report": ("report", "report", "every controller on every task: tables, pictures, one HTML page"),
    "explore": ("play", "explore", "the oscillator live in the browser, with sliders and controllers"),
    "video": ("play", "video", "a video of an episode, without control and with it side by side"),
    "listen": ("play", "train", "the squeal as sound, without control and then under control"),
    "hyperparameters": ("setup", "train", "where the tuned hyperparameters are, in RL Zoo's format"),
    "doctor": ("setup", "", "versions, caches, threads, and what is missing for which feature"),
    "completion": ("setup", "completion", "a script that makes a shell complete commands and options"),
}


class _Parser(Parser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def _load(name: str) -> Command:
    module = importlib.import_module(f"sd_friction_env.cli.{_COMMANDS[name][0]}")
    command: Command = module.COMMANDS[name]
    return command


def parser(names: Sequence[str] = tuple(_COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser of the program, with the options of these commands; the others are listed only."""
    program = _Parser(
        prog="sd-friction",
        formatter_class=argparse.HelpFormatter,
        description="The self-excited SD oscillator on a moving belt: passive analysis, control, pictures.",
        epilog="each command has its own help with examples: sd-friction amplitude --help",
    )
    program.add_argument("--version", action="version", version=f"sd_friction_env {sd_friction_env.__version__}")
    commands = program.add_subparsers(metavar="COMMAND", required=True, dest="command", parser_class=_Parser)
    for name, (_, _, summary) in _COMMANDS.items():
        if name not in names:
            commands.add_parser(name, help=summary)
            continue
        command = _load(name)
        lines = "\n".join(f"  sd-friction {name} {example}".rstrip() for example in command.examples)
        command.add(
            commands.add_parser(
                name,
                help=summary,
                description=f"{summary[0].upper()}{summary[1:]}.\n\n{command.text}".strip(),
                epilog=f"examples:\n{lines}",
            )
        )
    return program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status: 0 done, 1 failed, 2 bad usage, 130 interrupted."""
    typed = list(sys.argv[1:] if arguments is None else arguments)
    name = next((word for word in typed if not word.startswith("-")), "")
    prog = f"sd-friction {name}".rstrip()
    try:
        options = parser([name] if name in _COMMANDS else []).parse_args(typed)
        options.typed = typed
        command = _load(name)
        return command.run(options)
    except (FailedError, sd_friction_env.OrbitError) as error:
        print(f"{prog}: {_one_line(error)}", file=sys.stderr)
        return FAILURE
    except ModuleNotFoundError as error:
        extra = _COMMANDS[name][1]
        install = "" if "pip install" in str(error) else f': pip install "sd-friction-env[{extra}]"'
        print(f"{prog}: {_one_line(error)}{install}", file=sys.stderr)
        return BAD_USAGE
    except (ValueError, TypeError, ImportError) as error:
        print(f"{prog}: {_one_line(error)}", file=sys.stderr)
        return BAD_USAGE
    except BrokenPipeError:  # the reader of our output has closed it
        sys.stderr.close()
        return 0
    except OSError as error:
        print(f"{prog}: cannot write: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        folder = getattr(options, "folder", None)
        kept = f"the same command goes on with what is in {str(folder)!r}" if folder else command.interrupted
        print(f"\n{prog}: interrupted; {kept}", file=sys.stderr)
        return INTERRUPTED


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
