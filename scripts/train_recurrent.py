"""Train the recurrent followers of the open tiers, agents/recurrent: about five minutes of one core each.

python scripts/train_recurrent.py --tier blind blind-hard
python scripts/train_recurrent.py --tier blind --seed 1 --rounds 10 --out .
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from sd_friction_env.cli.options import Parser, check_at_least
from sd_friction_env.control.pretrained import RECURRENT, fingerprint, recurrent_file
from sd_friction_env.environments.ids import OPEN_TIERS, environment_id
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.recurrent import train_follower
from sd_friction_env.learning.versions import versions


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit status."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tier", nargs="+", choices=OPEN_TIERS, default=list(OPEN_TIERS), help="default: all")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--rounds", type=int, default=100, help="of 256 episodes and a fit (default: 100)")
    parser.add_argument("--out", type=Path, default=RECURRENT, help="folder (default: agents/recurrent)")
    options = parser.parse_args(arguments)
    check_at_least(options, seed=0, rounds=1)
    torch.set_num_threads(1)  # a second one is slower on matrices this small
    for tier in options.tier:
        env_id = environment_id("belt", tier)
        about = {"env_id": env_id, "seed": options.seed, "rounds": options.rounds, "versions": versions()}
        about["fingerprint"] = fingerprint(env_id)
        with tqdm(total=options.rounds, desc=env_id, dynamic_ncols=True, mininterval=5.0) as bar:

            def show(done: int, error: float, mean_return: float, bar: "tqdm[None]" = bar) -> None:
                bar.set_postfix_str(f"error {error:.4f}, return {mean_return:.1f}")
                bar.update(1)

            policy = train_follower(env_id, seed=options.seed, rounds=options.rounds, metadata=about, report=show)
        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / recurrent_file(env_id).name
        policy.save(path)
        table = evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS)
        print(
            f"{path}: validation return {table['return'].mean():.2f}, suppressed {table['suppressed'].mean():.0%}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
