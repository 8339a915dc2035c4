"""What is not legal: options, actions, arguments and command lines that must be refused in plain words."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from scripts.hunting import draws
from scripts.hunting.trials import Check, Failure
from sd_friction_env import OscillatorParameters, SDFrictionEnv, SDFrictionVectorEnv, simulate
from sd_friction_env.environments.task import Task
from sd_friction_env.physics.parameters import RANGES

ALLOWED = (TypeError, ValueError, gym.error.Error)
COMMAND_SECONDS = 30.0
MODULE = ("-m", "sd_friction_env")
_NUMBERS: tuple[Any, ...] = (
    *map(float, ["nan", "inf", "-inf", "0", "-0", "1", "-1", "0.5", "1e308", "-1e308", "5e-324"]),
    *(10**400, -(10**400), 2**63, True, False, 3, np.float32(0.3), np.float64("nan"), np.int64(7)),
)
_ODD: tuple[Any, ...] = (
    *(None, "", "1", "nan", "cycle", "force", b"1", 1j, (), [], {}, [1.0], (0.1, 0.2), {"alpha": 0.5}, object(), len),
    *(np.zeros(0), np.ones(1), np.ones((2, 2)), np.array("x"), np.array(None), np.datetime64("2020-01-01"), range(3)),
    int,
)


def odd_value(rng: np.random.Generator) -> Any:
    """Return some value, most likely not a legal one."""
    pool = _NUMBERS if rng.random() < 0.5 else _ODD
    return pool[int(rng.integers(len(pool)))]


def refused(name: str, call: Callable[[], Any], names: tuple[str, ...]) -> None:
    """Check that a call either works or is refused with an error that names one of the arguments.

    Raises:
        Failure: if it ends otherwise.
    """
    try:
        with np.errstate(all="ignore"):
            call()
    except ALLOWED as error:
        words = str(error)
        if not any(word in words for word in names):
            raise Failure("names no argument", f"{name}: {type(error).__name__}: {words[:200]}") from None
    except Exception as error:
        raise Failure(type(error).__name__, f"{name}: {str(error)[:200]}") from None


def shown(value: Any) -> str:
    """Return a value in no more than a line."""
    words = repr(value).replace(repr(10**400), "10**400")
    return words if len(words) < 120 else f"{words[:117]}..."


def argument_trial(seed: int, index: int) -> None:
    """Try arguments of constructors, reset, step, simulate and state functions that may be wrong in one place."""
    rng = draws.generator(seed, index)
    value, other = odd_value(rng), odd_value(rng)
    name = str(rng.choice([*RANGES, "geometry", "friction"]))
    task_name = str(rng.choice([*Task.field_names(), "threads", "autoreset_mode", "copy", "info_keys", "no_such_name"]))
    what = int(rng.integers(9))
    size = int(rng.choice([0, 1, 3]))
    of_size = f"of {size or 'one'} with"
    if what == 0:
        refused(f"OscillatorParameters({name}={shown(value)})", lambda: OscillatorParameters(**{name: value}), (name,))
    elif what == 1:
        call = f"SDFrictionEnv(parameters={{{name!r}: {shown(value)}}})"
        refused(call, lambda: SDFrictionEnv({name: value}), (name, "parameters"))
    elif what == 2:
        refused(f"SDFrictionEnv({task_name}={shown(value)})", lambda: SDFrictionEnv(**{task_name: value}), (task_name,))
    elif what == 3:
        key = task_name if rng.random() < 0.7 else "num_envs"
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) < 1000:  # no memory bombs
            call = f"SDFrictionVectorEnv({key}={shown(value)})"
            refused(call, lambda: SDFrictionVectorEnv(**{key: value}), (key,))
    elif what == 4:
        options = {str(rng.choice(["x", "v", "phase", "start", "parameters", "reset_mask", "y"])): value}
        if rng.random() < 0.3:
            options[str(rng.choice(["x", "v", "phase", "start"]))] = other
        if rng.random() < 0.3:
            options = {"parameters": {name: value}}
        names = (*options, *([name] if "parameters" in options else []), "options")
        call = f"reset {of_size} options={shown(options)}"
        refused(call, lambda: made(size).reset(seed=1, options=options), names)
    elif what == 5:
        action = value if rng.random() < 0.3 else [value] if not size else [[value]] * size

        def step() -> None:
            env = made(size)
            env.reset(seed=0)
            env.step(action)

        refused(f"step {of_size} {shown(action)}", step, ("action", "actions"))
    elif what == 6:
        arguments = {str(rng.choice(["x", "v", "t_end", "dt", "force", "belt_acceleration", "hold"])): value}
        if rng.random() < 0.5:
            arguments |= {"force": [0.0, 0.1]}
        if isinstance(arguments.get("t_end"), int | float) and abs(arguments["t_end"]) > 100:
            arguments["dt"] = 1e6
        words = ", ".join(f"{key}={shown(entry)}" for key, entry in arguments.items())
        call = f"simulate(OscillatorParameters(), {words})"
        refused(call, lambda: simulate(OscillatorParameters(), **{"t_end": 1.0, **arguments}), (*arguments, "hold"))
    elif what == 7:
        refused(f"reset {of_size} seed={shown(value)}", lambda: made(size).reset(seed=value), ("seed", "Seed"))
    else:
        call = f"SDFrictionEnv(randomise={{{name!r}: ({shown(value)}, {shown(other)})}})"
        refused(call, lambda: SDFrictionEnv(randomise={name: (value, other)}), ("randomise", name))


def made(size: int) -> Any:
    """Return one environment (size 0) or a batch."""
    return SDFrictionVectorEnv(size) if size else SDFrictionEnv()


def legal_trial(seed: int, index: int) -> None:
    """Check that whatever lies in its range is accepted: fields that a law does not use, and whole environments."""
    rng = draws.generator(seed, index)
    values = draws.values(rng, unused=True)
    shown_values = draws.keywords(values)
    try:
        p = OscillatorParameters(**values)
        assert p.replace(**values) == p
    except ValueError as error:
        raise Failure("legal parameters refused", f"{error}: OscillatorParameters({shown_values})") from None
    if p.belt_speed == 0.0 or rng.random() < 0.5:
        return
    try:
        SDFrictionEnv(p, start=str(rng.choice(["cycle", "rest", "random"]))).reset(seed=1)
    except Exception as error:
        kind = "legal environment refused" if isinstance(error, ValueError) else type(error).__name__
        raise Failure(kind, f"{str(error)[:200]}: SDFrictionEnv(OscillatorParameters({shown_values}))") from None


_COMMANDS = {
    "amplitude": "--geometry --alpha --belt-speed --start --mu-s --json --workers --backend",
    "cycle": "--geometry --alpha --belt-speed --start --attractors --mu-m --v-m",
    "critical": "--geometry --alpha --mu-s --mu-m --v-m --beta",
    "simulate": "--start --t-end --dt --force --friction --force-amplitude --force-frequency",
    "basins": "--x --v --shape --alpha --belt-speed --plot --out",
    "poincare": "--cycles --transient --force-amplitude --force-frequency --ripple-amplitude",
    "lyapunov": "--cycles --transient --force-amplitude --stiffness-amplitude",
    "bifurcation": "--over --direction --cycles --transient --force-amplitude",
    "doctor": "--json",
    "hyperparameters": "--show",
    "video": "--task --tier --steps --every --fps --out --seed",
    "completion": "",
    "no-such-command": "",
}
_VALUES = """nan inf -1 0 1 0.5 1e400 1:2:0.1 1:2:-1 2:1:0.1 0:1:0 x é -- exact cubic force bash both up
/no/such/folder/file.csv file.PNG 100 0.1 10 ppo ../.. coulomb"""
_WORDS = (*_VALUES.split(), "")


def command_line(rng: np.random.Generator) -> list[str]:
    """Return a random command line: a command, options that it has or has not, values that fit or not."""
    command = str(rng.choice(list(_COMMANDS)))
    options, every = _COMMANDS[command].split(), " ".join(_COMMANDS.values()).split()
    line = [command]
    for _ in range(int(rng.integers(0, 5))):
        line.append(str(rng.choice(options if options and rng.random() < 0.9 else every)))
        line += [str(rng.choice(_WORDS)) for _ in range(int(rng.choice([0, 1, 1, 1, 2, 3])))]
    return line


def command_trial(seed: int, index: int) -> None:
    """Run one random command line of ``sd-friction``: exit status 0, 1 or 2, no traceback, within its time."""
    line = command_line(draws.generator(seed, index))
    words = f"sd-friction {' '.join(repr(word) if not word.strip('-.').isalnum() else word for word in line)}"
    root = os.getcwd()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "PYTHONPATH": path, "MPLBACKEND": "agg"}
        where: dict[str, Any] = {"cwd": folder, "env": environment, "stdin": subprocess.DEVNULL}
        command = [sys.executable, *MODULE, *line]
        try:
            done = subprocess.run(command, check=False, capture_output=True, timeout=COMMAND_SECONDS, **where)
        except subprocess.TimeoutExpired:
            raise Failure("command: slow", f"not done after {time.monotonic() - begun:.0f} s: {words}") from None
    said = done.stderr.decode(errors="replace")
    if done.returncode not in (0, 1, 2) or "Traceback" in said:
        last = said.strip().splitlines()[-1:] or [""]
        raise Failure("command", f"exit status {done.returncode}, {last[0][:200]}: {words}")
    if done.returncode and not said.strip():
        raise Failure("command", f"exit status {done.returncode} without a word: {words}")


def prepare() -> None:
    """Compile what the trials call."""
    SDFrictionEnv().reset(seed=0)
    SDFrictionVectorEnv(3).reset(seed=0)
    simulate(OscillatorParameters(), t_end=1.0)


ARGUMENTS = Check("arguments", "illegal arguments, options and actions are refused by name", argument_trial, prepare)
LEGAL = Check("legal", "whatever lies in its range is accepted", legal_trial, prepare, patience=30.0)
COMMANDS = Check(
    "commands", "random command lines: exit status 0, 1 or 2, no traceback, in time", command_trial, patience=60.0
)
