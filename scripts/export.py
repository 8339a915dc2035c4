"""Write a trained agent as ONNX, and check it against the agent.

    python scripts/export.py --task belt --out belt.onnx            the agent that comes with the package
    python scripts/export.py runs/belt-nominal-ppo-0 --out mine.onnx
    python scripts/export.py policy.npz --task force --tier sensed --out mine.onnx

Scaling and clipping of the measurements and the command that an action stands for are in the graph; its metadata say
what the measurements are and how often it is to be asked. All is dimensionless. Nothing is written unless the actions
on the trial measurements agree with the agent's to 1e-6, and the map from measurements to observations and commands
with the environment's own.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scripts.train import TASKS, TIERS, Parser, environment_id
from sd_friction_env import ENVIRONMENT_IDS, load_pretrained
from sd_friction_env.control.policies import NetworkPolicy, load_policy
from sd_friction_env.learning import evaluation, runs


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="export.py"
    )
    parser.add_argument("agent", nargs="?", type=Path, help="run folder or policy.npz (default: the package's own)")
    parser.add_argument("--task", choices=TASKS, help="actuator (default: what a run folder says)")
    parser.add_argument("--tier", choices=TIERS, help="goes with --task (default: nominal)")
    parser.add_argument("--env-id", metavar="ID", help=f"instead of --task and --tier: {', '.join(ENVIRONMENT_IDS)}")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace a file that is there")
    parser.add_argument("--trials", type=int, default=10_000, metavar="N", help="measurements tried (default: 10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the trial measurements (default: 0)")
    return parser


def chosen(parser: Parser, options: argparse.Namespace) -> tuple[NetworkPolicy, str]:
    """Return the agent that the command line names, and the id of its environment."""
    if options.env_id is not None and (options.task or options.tier):
        parser.error("--env-id and --task, --tier exclude one another")
    if options.env_id not in (None, *ENVIRONMENT_IDS):
        parser.error(f"--env-id must be one of {', '.join(ENVIRONMENT_IDS)}, got {options.env_id!r}")
    if options.tier and not options.task:
        parser.error(f"--tier {options.tier} needs --task")
    env_id = environment_id(options.task, options.tier or "nominal") if options.task else options.env_id
    if options.agent is None:
        if env_id is None:
            parser.error("name a run folder or a policy.npz, or --task for the package's own agent")
        return load_pretrained(env_id), env_id
    if options.agent.suffix.lower() == ".npz":
        if env_id is None:
            parser.error(f"{str(options.agent)!r} needs --task (and --tier): which environment it controls")
        policy = load_policy(options.agent)
        trained = policy.metadata.get("env_id", env_id)
        if trained != env_id:
            parser.error(f"{str(options.agent)!r} was trained on {trained}, not on {env_id}")
        return policy, env_id
    environment = runs.load_config(options.agent)["environment"]
    if environment["id"] not in ENVIRONMENT_IDS or environment["kwargs"]:
        parser.error(f"{str(options.agent)!r} was trained with arguments of its own: {environment['kwargs']}")
    if env_id not in (None, environment["id"]):
        parser.error(f"{str(options.agent)!r} was trained on {environment['id']}, not on {env_id}")
    return runs.load_network(options.agent), environment["id"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Export what the command line names; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    out: Path = options.out
    if out.suffix.lower() != ".onnx" or not out.absolute().parent.is_dir() or out.is_dir():
        parser.error(f"--out must be a file FILE.onnx in a folder that exists, got {str(out)!r}")
    if out.exists() and not options.force:
        parser.error(f"--out {str(out)!r} exists: replace it with --force")
    for option, low in (("trials", 2), ("seed", 0)):
        if getattr(options, option) < low:
            parser.error(f"--{option} must be at least {low}, got {getattr(options, option)}")
    try:
        from sd_friction_env.learning import export
    except ModuleNotFoundError as error:
        parser.error(f'{error.name} is not installed: pip install "sd-friction-env[export]"')
    try:
        policy, env_id = chosen(parser, options)
        origin = {name: value for name, value in policy.metadata.items() if name != "fingerprint"}
        about = {"environment": env_id, "agent": str(options.agent or "pretrained"), "origin": origin}
        model = export.build(policy, evaluation.make_env(env_id), about)
        measurements = export.trial_measurements(policy, env_id, options.trials, options.seed)
        worst = export.worst_difference(model, policy, env_id, measurements)
        astray = export.map_difference(env_id, min(options.trials, 10_000), options.seed)
    except (OSError, ValueError) as error:
        parser.error(" ".join(str(error).split()))
    print(f"{env_id}: largest difference of actions over {options.trials:,} measurements: {worst:.2e}")
    print(f"largest difference of its observations and commands from the environment's own: {astray:.2e}")
    if not (worst < export.TOLERANCE and astray < export.TOLERANCE):
        print(f"export.py: error: not under {export.TOLERANCE:g}: nothing was written", file=sys.stderr)
        return 1
    median, slow = export.latency(model, measurements)
    ours = []
    observation = np.zeros(policy.observation_size, np.float32)
    for _ in range(2000):
        begun = time.perf_counter()
        policy.predict(observation)
        ours.append(time.perf_counter() - begun)
    print(
        f"one decision on one thread: {1e6 * median:.1f} us (99th percentile {1e6 * slow:.1f} us) by onnxruntime, "
        f"{1e6 * float(np.median(ours)):.1f} us ({1e6 * float(np.quantile(ours, 0.99)):.1f} us) by NumPy"
    )
    try:
        export.write(model, out)
    except OSError as error:
        print(f"export.py: error: {str(out)!r} cannot be written: {error}", file=sys.stderr)
        return 1
    print(f"{out}: {out.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
