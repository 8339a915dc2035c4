"""Tune the classical controllers on the validation episodes and keep their gains in agents/classical.json.

    python scripts/tune_classical.py                              all of them (a quarter of an hour)
    python scripts/tune_classical.py --task belt --tier nominal   those of one environment
    python scripts/tune_classical.py --task force --controller LQR "sliding mode" --generations 60

SciPy's differential evolution maximises the mean return. What is finished is kept at once, unless what is stored does
better; Ctrl-C loses what is running. Several of these may run side by side.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence

from tqdm import tqdm

from scripts.train import TASKS, TIERS, Parser, environment_id
from sd_friction_env.learning import classical


def main(arguments: Sequence[str] | None = None) -> int:
    """Tune as the command line says; return the exit status."""
    parser = Parser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        prog="tune_classical.py",
    )
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS), help="actuators (default: both)")
    parser.add_argument("--tier", nargs="+", choices=TIERS, default=list(TIERS), help="default: all")
    parser.add_argument("--controller", nargs="+", choices=classical.KINDS, help="default: all that the sensor allows")
    parser.add_argument("--seed", type=int, default=0, help="of the search (default: 0)")
    parser.add_argument("--generations", type=int, default=50, metavar="N", help="of the search (default: 50)")
    parser.add_argument("--population", type=int, default=12, metavar="N", help="per tuned value (default: 12)")
    options = parser.parse_args(arguments)
    for option, low in (("seed", 0), ("generations", 1), ("population", 2)):
        if getattr(options, option) < low:
            parser.error(f"--{option} must be at least {low}, got {getattr(options, option)}")
    try:
        classical.stored_gains()
    except ValueError as error:
        parser.error(str(error))
    jobs = []
    for task in options.task:
        for tier in options.tier:
            env_id = environment_id(task, tier)
            allowed = classical.kinds_for(env_id)
            jobs += [(env_id, name) for name in options.controller or allowed if name in allowed]
    if not jobs:
        parser.error(f"--controller {', '.join(options.controller)} cannot see what it needs in --tier {options.tier}")
    command = shlex.join(["python", "scripts/tune_classical.py", *(sys.argv[1:] if arguments is None else arguments)])
    try:
        for env_id, name in jobs:
            with tqdm(total=100, desc=f"{env_id}: {name}", unit="%", dynamic_ncols=True, leave=False) as bar:

                def show(best: float, share: float, bar: "tqdm[None]" = bar) -> None:
                    bar.set_postfix_str(f"return {best:.1f}")
                    bar.update(round(100.0 * share) - bar.n)

                found = classical.tune(
                    name,
                    env_id,
                    seed=options.seed,
                    generations=options.generations,
                    population=options.population,
                    progress=show,
                )
            kept = classical.keep(env_id, name, {**found, "command": command})
            came_to = f"return {found['validation_return']:8.2f}, suppressed {found['suppressed']:4.0%}"
            values = ", ".join(f"{key} {value:.4g}" for key, value in found["values"].items())
            print(f"{env_id:36} {name:38} {came_to}, {values}", flush=True)
            if kept["values"] != found["values"]:
                print(f"  not kept: what is stored comes to {kept['validation_return']:.2f}", flush=True)
            for value, what in kept["at_bound"].items():
                print(f"  {value} is at its bound: {what or 'a wider one may find better'}", flush=True)
    except KeyboardInterrupt:
        print("\ntune_classical.py: interrupted; what was finished is kept", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
