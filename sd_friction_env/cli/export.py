"""``sd-friction export``: a trained agent as ONNX, checked against the agent."""

import argparse
import time
from pathlib import Path

import numpy as np

from sd_friction_env import ENVIRONMENT_IDS, load_pretrained
from sd_friction_env.cli.agents import stored_agent
from sd_friction_env.cli.options import (
    Command,
    FailedError,
    UsageError,
    add_environment,
    check_at_least,
    check_file,
    environment_of,
    named_environment,
)
from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.extras import extra

TEXT = """\
The graph scales and clips the measurements and converts the action to a command; its metadata list the measurements and
the sampling time. All is dimensionless. Nothing is written unless the actions
on the trial measurements agree with the agent's to 1e-6, and the map from measurements to observations and commands
with the environment's own."""


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("agent", nargs="?", type=Path, help="run folder or policy.npz (default: the package's own)")
    add_environment(parser, arguments=False)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.onnx", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--trials", type=int, default=10_000, metavar="N", help="measurements tried (default: 10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the trial measurements (default: 0)")


def _chosen(options: argparse.Namespace) -> tuple[NetworkPolicy, str]:
    """Return the agent that the options name, and the id of its environment."""
    env_id = named_environment(options)
    if options.agent is None:
        if env_id is None:
            raise UsageError("name a run folder or a policy.npz, or --task for the package's own agent")
        return load_pretrained(env_id), env_id
    policy, environment = stored_agent(options.agent)
    if environment is None:
        trained = policy.metadata.get("env_id", environment_of(options))
    else:
        trained = environment["id"]
        if trained not in ENVIRONMENT_IDS or environment["kwargs"]:
            raise UsageError(f"{str(options.agent)!r} was trained with arguments of its own: {environment['kwargs']}")
    if env_id not in (None, trained):
        raise UsageError(f"{str(options.agent)!r} was trained on {trained}, not on {env_id}")
    return policy, str(trained)


def _export(options: argparse.Namespace) -> int:
    out: Path = options.out
    check_file("--out", out, ".onnx")
    if out.exists() and not options.force:
        raise UsageError(f"--out {str(out)!r} exists: replace it with --force")
    check_at_least(options, trials=2, seed=0)
    with extra("export"):
        from sd_friction_env.learning import export
    policy, env_id = _chosen(options)
    origin = {name: value for name, value in policy.metadata.items() if name != "fingerprint"}
    about = {"environment": env_id, "agent": str(options.agent or "pretrained"), "origin": origin}
    model = export.build(policy, make_env(env_id), about)
    measurements = export.trial_measurements(policy, env_id, options.trials, options.seed)
    worst = export.worst_difference(model, policy, env_id, measurements)
    astray = export.map_difference(env_id, min(options.trials, 10_000), options.seed)
    print(f"{env_id}: largest difference of actions over {options.trials:,} measurements: {worst:.2e}")
    print(f"largest difference of its observations and commands from the environment's own: {astray:.2e}")
    if not (worst < export.TOLERANCE and astray < export.TOLERANCE):
        raise FailedError(f"not under {export.TOLERANCE:g}: nothing was written")
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
    export.write(model, out)
    print(f"{out}: {out.stat().st_size:,} bytes")
    return 0


COMMANDS = {
    "export": Command(
        _add,
        _export,
        [
            "--task belt --out belt.onnx",
            "runs/belt-nominal-ppo-0 --out mine.onnx",
            "policy.npz --task force --tier sensed --out mine.onnx",
        ],
        TEXT,
    )
}
