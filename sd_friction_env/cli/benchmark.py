"""``sd-friction benchmark``: entries of controllers made, verified and ranked; controllers on other plants."""

import argparse
import contextlib
import itertools
import sys
from pathlib import Path

from sd_friction_env import ENVIRONMENT_IDS, Table
from sd_friction_env.cli.agents import AGENTS_TEXT, agent_of
from sd_friction_env.cli.evaluate import check_episodes
from sd_friction_env.cli.options import Command, FailedError, UsageError, check_at_least, check_file, progress_bar
from sd_friction_env.control.policies import Policy
from sd_friction_env.environments.ids import OPEN_TIERS, TASKS, TIERS, environment_id
from sd_friction_env.learning import evaluation, off_nominal, protocol

TEXT = """\
run evaluates a controller on the protocol's 100 episodes of every environment that it fits, and writes an entry: one
JSON file with a digest. verify runs the controller again and compares. table ranks entries. off-nominal evaluates
controllers, unchanged, on fifteen plants that they were not made for. A controller is %s: a policy, or a class or
function that makes one, from the current folder or an installed package. docs/howto/benchmark.md shows an example."""
_TIERS = (*TIERS, *OPEN_TIERS)
_CONTROLLERS = ("passive", "threshold-follower", "threshold-follower@randomised", "pretrained", "pretrained@randomised")


def _add(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True, dest="action", parser_class=type(parser))
    run = actions.add_parser("run", help="evaluate a controller and write its entry; the same command resumes")
    run.add_argument("--policy", required=True, help=AGENTS_TEXT)
    run.add_argument("--name", required=True, help="of the entry's rows")
    run.add_argument("--knows", default="", metavar="TEXT", help="what it knows of the plant (default: nothing)")
    run.add_argument("--out", type=Path, required=True, metavar="FILE.json", help="file to write")
    run.add_argument("--overwrite", action="store_true", help="begin again, in place of what --out holds")
    verify = actions.add_parser("verify", help="run an entry's controller again and compare")
    verify.add_argument("entry", type=Path, metavar="ENTRY.json")
    verify.add_argument("--policy", help="where the controller is now (default: the entry's)")
    text = "episodes of an environment that may differ (default: 0); see the page on single precision"
    verify.add_argument("--allow", type=int, default=0, metavar="N", help=text)
    table = actions.add_parser("table", help="rank entries")
    table.add_argument("entries", nargs="+", type=Path, metavar="ENTRY.json")
    plants = actions.add_parser("off-nominal", help="evaluate controllers on other plants")
    plants.add_argument(
        "--policy",
        nargs="+",
        default=_CONTROLLERS,
        help=f"as of run; POLICY@TIER is the one for that tier (default: {' '.join(_CONTROLLERS)})",
    )
    plants.add_argument("--task", choices=TASKS, default="belt", help="actuator (default: belt)")
    for parser_of, episodes in ((verify, len(protocol.SEEDS)), (plants, 50)):
        text = f"the first N of the protocol's (default: {episodes})"
        parser_of.add_argument("--episodes", type=int, default=episodes, metavar="N", help=text)
    for parser_of in (run, verify, table):
        parser_of.add_argument("--task", nargs="+", choices=TASKS, default=TASKS, help="these only (default: all)")
        parser_of.add_argument("--tier", nargs="+", choices=_TIERS, default=_TIERS, help="these only (default: all)")
    for parser_of in (table, plants):
        parser_of.add_argument("--format", choices=("markdown", "csv"), default="markdown", help="(default: markdown)")


def _environments(options: argparse.Namespace) -> list[str]:
    found = []
    for task, tier in itertools.product(options.task, options.tier):
        with contextlib.suppress(ValueError):  # a tier that the task does not have
            found.append(environment_id(task, tier))
    known = [env_id for env_id in ENVIRONMENT_IDS if env_id in found]
    if not known:
        raise UsageError(f"no environment is of --task {options.task} and --tier {options.tier}: {ENVIRONMENT_IDS}")
    return known


def _fitting(spec: str, env_ids: list[str]) -> dict[str, Policy]:
    """Return the policies that --policy names, for each environment that it fits; say which are left out."""
    policies, reasons = {}, {}
    for env_id in env_ids:
        try:
            policies[env_id] = agent_of(spec, env_id)
        except (TypeError, ValueError) as error:
            reasons[env_id] = str(error)
    if not policies:
        raise UsageError(f"--policy {spec!r} fits none of {', '.join(env_ids)}: {reasons[env_ids[0]]}")
    for env_id, reason in reasons.items():
        print(f"{env_id} is left out: {reason}", file=sys.stderr)
    return policies


def _run(options: argparse.Namespace) -> int:
    out: Path = options.out
    check_file("--out", out, ".json")
    entry = protocol.new_entry(options.name, options.policy, options.knows)
    if out.exists() and not options.overwrite:
        try:
            entry = protocol.resumed(entry, out)
        except ValueError as error:
            raise UsageError(f"--out is not overwritten without --overwrite: {error}") from None
    done = entry["environments"]
    left = {key: policy for key, policy in _fitting(options.policy, _environments(options)).items() if key not in done}
    if not left:
        print(f"{out} is complete: {', '.join(done)}; --overwrite runs it again")
    count = itertools.count(1)
    show = progress_bar(sum(map(protocol.decisions, left)), "decisions")
    for env_id, policy in left.items():
        done[env_id] = protocol.measure(policy, options.name, env_id, lambda: show(next(count)))
        protocol.write_entry(entry, out)
        mean, share = sum(done[env_id]["returns"]) / len(protocol.SEEDS), done[env_id]["suppressed"].count("1")
        print(f"{env_id}: return {mean:.2f}, {share} of {len(protocol.SEEDS)} episodes suppressed", flush=True)
    return 0


def _verify(options: argparse.Namespace) -> int:
    check_episodes(options)
    check_at_least(options, allow=0)
    entry = protocol.read_entry(options.entry)
    spec, different = options.policy or entry["policy"], []
    env_ids = [env_id for env_id in _environments(options) if env_id in entry["environments"]]
    if not env_ids:
        has = ", ".join(entry["environments"])
        raise UsageError(f"{str(options.entry)!r} has no results for --task and --tier; it has {has}")
    for env_id in env_ids:
        protocol.check_environment(entry, env_id)
    for env_id in env_ids:
        lines = protocol.differences(entry, env_id, agent_of(spec, env_id), options.episodes)
        print("\n  ".join([f"{env_id}: {len(lines) or 'no'} differences in {options.episodes} episodes", *lines]))
        different += [env_id] * (len(lines) > options.allow)
    if different:
        raise FailedError(f"{str(options.entry)!r} is not what {spec!r} reaches on {', '.join(different)}")
    return 0


def _table(options: argparse.Namespace) -> int:
    try:
        rows = protocol.leaderboard(map(protocol.read_entry, options.entries), _environments(options))
    except RuntimeError as error:  # a stored optimum of another environment
        raise FailedError(str(error)) from None
    if not rows:
        raise UsageError("no entry has a row for --task and --tier")
    if options.format == "csv":
        Table.from_rows(rows).write(sys.stdout)
    else:
        print(protocol.as_markdown(rows))
    return 0


def _off_nominal(options: argparse.Namespace) -> int:
    check_episodes(options)
    policies = {}
    for spec in options.policy:
        name, at, tier = spec.partition("@")
        if at and tier not in _TIERS:
            raise UsageError(f"--policy POLICY@TIER must name one of {', '.join(_TIERS)}, got {spec!r}")
        policies[spec] = agent_of(name, environment_id(options.task, tier or "nominal"))
    seeds = evaluation.EVALUATION_SEEDS[: options.episodes]
    table = off_nominal.evaluate_off_nominal(policies, environment_id(options.task), seeds)
    if options.format == "csv":
        table.write(sys.stdout)
    else:
        print(off_nominal.as_markdown(table))
    return 0


_ACTIONS = {"run": _run, "verify": _verify, "table": _table, "off-nominal": _off_nominal}
COMMANDS = {
    "benchmark": Command(
        _add,
        lambda options: _ACTIONS[options.action](options),
        [
            "run --policy mine:Follower --name mine --out mine.json",
            "verify mine.json",
            "table mine.json agents/entries/*.json --task belt",
            "off-nominal --policy mine:Follower pretrained@randomised",
        ],
        TEXT % AGENTS_TEXT,
        "environments that are finished are kept in --out: the same command goes on",
    )
}
