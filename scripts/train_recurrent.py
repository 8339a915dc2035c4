"""Train the recurrent followers of the open tiers, agents/recurrent: about four minutes of one core for each seed.

Of several seeds it keeps the follower with the best mean return on validation starts, and prints all on the 100
evaluation starts.

python scripts/train_recurrent.py --tier blind --seed 0 1 2 3 4
python scripts/train_recurrent.py --tier blind --rounds 10 --out .
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from sd_friction_env.cli.options import Parser, UsageError, check_at_least
from sd_friction_env.control.policies import RecurrentFollower
from sd_friction_env.control.pretrained import RECURRENT, fingerprint, recurrent_file
from sd_friction_env.environments.ids import OPEN_TIERS, environment_id
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.recurrent import train_follower
from sd_friction_env.learning.versions import versions


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit status."""
    parser = Parser(description=__doc__)
    parser.add_argument("--tier", nargs="+", choices=OPEN_TIERS, default=list(OPEN_TIERS), help="default: all")
    parser.add_argument("--seed", type=int, nargs="+", default=[0], help="default: 0")
    parser.add_argument("--rounds", type=int, default=100, help="of 256 episodes and a fit (default: 100)")
    parser.add_argument("--out", type=Path, default=RECURRENT, help="folder (default: agents/recurrent)")
    options = parser.parse_args(arguments)
    try:
        check_at_least(options, seed=0, rounds=1)
    except UsageError as error:
        parser.error(str(error))
    torch.set_num_threads(1)  # a second one is slower on matrices this small
    for tier in options.tier:
        env_id = environment_id("belt", tier)
        path = options.out / recurrent_file(env_id).name
        passive = evaluation.metrics(*2 * (evaluation.passive_episodes(env_id),))
        optimum = evaluation.optimal_returns(env_id, evaluation.EVALUATION_SEEDS)
        rows, best = [], -np.inf
        for seed in options.seed:
            policy = _trained(env_id, seed, options.rounds)
            validated = evaluation.evaluate(policy, env_id, evaluation.VALIDATION_SEEDS)["return"].mean()
            if validated > best:
                best = validated
                path.parent.mkdir(parents=True, exist_ok=True)
                policy.save(path)
            name = f"seed {seed}, validation {validated:.2f}"
            rows.append(evaluation.summarise(name, evaluation.evaluate(policy, env_id), passive, optimum))
        print(f"{path}\n{evaluation.format_summary(rows)}", flush=True)
    return 0


def _trained(env_id: str, seed: int, rounds: int) -> RecurrentFollower:
    """Return a follower trained under a progress bar."""
    about = {
        "env_id": env_id,
        "seed": seed,
        "rounds": rounds,
        "versions": versions(),
        "fingerprint": fingerprint(env_id),
    }
    with tqdm(total=rounds, desc=f"{env_id}, seed {seed}", dynamic_ncols=True, mininterval=5.0) as bar:

        def show(done: int, error: float, mean_return: float) -> None:
            bar.set_postfix_str(f"error {error:.4f}, return {mean_return:.1f}")
            bar.update(1)

        return train_follower(env_id, seed=seed, rounds=rounds, metadata=about, report=show)


if __name__ == "__main__":
    sys.exit(main())
