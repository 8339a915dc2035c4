"""PPO in one file, in CleanRL's manner: PyTorch alone, every step of the algorithm in sight, to copy and change.

    python scripts/cleanrl_ppo.py --out agent.npz
    python scripts/cleanrl_ppo.py --env-id SDFriction/BeltSpeed-v0 --total-timesteps 1200000 --gamma 0.995 \\
        --log-std-end -2.5
    python scripts/cleanrl_ppo.py --vector sync --num-envs 4        # Gymnasium's SyncVectorEnv: same bits, slower

Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) with generalised advantages (Schulman et al. 2016,
arXiv:1506.02438). Two things differ from CleanRL's ppo_continuous_action.py: an episode that was only cut short by its
time limit is continued by the value of its last observation, and the spread of the actions falls on a schedule. For
runs that are kept, resumed and evaluated there is `sd-friction train`.
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.cli.options import Parser
from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.environments.wrappers import scaled_reward

if TYPE_CHECKING:
    from torch import Tensor

# Each number's type, default, least and greatest value, and meaning.
NUMBERS: dict[str, tuple[type, float, float, float, str]] = {
    "seed": (int, 0, 0, 2**31 - 1, "of everything random"),
    "threads": (int, 1, 1, 256, "of PyTorch"),
    "total-timesteps": (int, 500_000, 1, 10**12, "environment steps, rounded up to whole rollouts"),
    "num-envs": (int, 32, 1, 65_536, "environments side by side"),
    "num-steps": (int, 125, 1, 10**6, "steps of each environment in a rollout"),
    "num-minibatches": (int, 4, 1, 10**6, "parts of a rollout that are learnt from one after the other"),
    "update-epochs": (int, 8, 1, 1000, "times that a rollout is learnt from"),
    "learning-rate": (float, 2e-3, 0.0, 1.0, "of Adam; falls linearly to 0"),
    "gamma": (float, 0.98, 0.0, 1.0, "discount factor"),
    "gae-lambda": (float, 0.95, 0.0, 1.0, "of the generalised advantages"),
    "clip-coef": (float, 0.2, 1e-6, 1e6, "how far a probability ratio may move"),
    "vf-coef": (float, 0.5, 0.0, 1e6, "weight of the value's error"),
    "max-grad-norm": (float, 0.5, 1e-6, 1e12, "gradients are cut to this length"),
    "log-std-start": (float, 0.0, -20.0, 5.0, "log standard deviation of the actions at the beginning"),
    "log-std-end": (float, -2.0, -20.0, 5.0, "and at the end"),
    "reward-scale": (float, 0.1, 1e-6, 1e6, "the agent learns from scale sign(r) |r|^power"),
    "reward-power": (float, 0.5, 0.1, 1.0, "see --reward-scale"),
}


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(description=__doc__, prog="cleanrl_ppo.py")
    parser.add_argument("--env-id", choices=ENVIRONMENT_IDS, default="SDFriction/Force-v0", metavar="ID", help="which")
    parser.add_argument("--vector", choices=("native", "sync"), default="native", help="who steps the environments")
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="where the trained policy goes (default: nowhere)")
    for name, (kind, default, low, high, meaning) in NUMBERS.items():
        said = f"{meaning}, in [{low:g}, {high:g}] (default: {default:g})"
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="X", help=said)
    return parser


def check(parser: Parser, options: argparse.Namespace) -> None:
    """Exit with status 2 and one line if an option is not as its help says."""
    for name, (_, _, low, high, _) in NUMBERS.items():
        value = getattr(options, name.replace("-", "_"))
        if not low <= value <= high:
            parser.error(f"--{name} must be in [{low:g}, {high:g}], got {value!r}")
    batch = options.num_envs * options.num_steps
    if batch < 2 * options.num_minibatches:
        parser.error(f"--num-minibatches must leave 2 of the {batch} steps to each, got {options.num_minibatches}")
    if options.out is not None:
        if options.out.suffix.lower() != ".npz":
            parser.error(f"--out must end in .npz, got {str(options.out)!r}")
        if not os.access(options.out.parent, os.W_OK):
            parser.error(f"--out must lie in a folder that can be written to, got {str(options.out)!r}")


def make_envs(env_id: str, num_envs: int, vector: str) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Return ``num_envs`` environments that begin a new episode in the very step that ends one."""
    if vector == "native":
        return gym.make_vec(env_id, num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    return gym.make_vec(env_id, num_envs, vectorization_mode="sync", vector_kwargs=mode)


def generalised_advantages(
    rewards: "Tensor", values: "Tensor", next_values: "Tensor", over: "Tensor", gamma: float, gae_lambda: float
) -> "Tensor":
    """Return the advantages of a rollout, shape (steps, n), Eq. 16 of arXiv:1506.02438.

    Args:
        rewards, values: of each step, and of what was seen before it, (steps, n).
        next_values: of what was seen after it, of the same episode; 0 where the episode has terminated.
        over: 1 where the episode ended with the step, 0 elsewhere.
        gamma, gae_lambda: in [0, 1].
    """
    deltas = rewards + gamma * next_values - values
    advantages = deltas.clone()
    for t in reversed(range(len(deltas) - 1)):
        advantages[t] += gamma * gae_lambda * (1.0 - over[t]) * advantages[t + 1]
    return advantages


def train(options: argparse.Namespace, progress: bool = True) -> NetworkPolicy:
    """Train as the options say and return the deterministic policy; its metadata tell the episodes' returns."""
    import torch
    from torch import nn
    from torch.distributions import Normal
    from tqdm import tqdm

    normal: Any = Normal  # whose methods PyTorch has not typed
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    envs = make_envs(options.env_id, options.num_envs, options.vector)
    assert envs.single_observation_space.shape is not None
    size = envs.single_observation_space.shape[0]

    def layer(inputs: int, outputs: int, gain: float) -> nn.Linear:
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, gain)
        nn.init.zeros_(linear.bias)
        return linear

    def network(last_gain: float) -> nn.Sequential:
        gain = 2.0**0.5
        return nn.Sequential(layer(size, 64, gain), nn.Tanh(), layer(64, 64, gain), nn.Tanh(), layer(64, 1, last_gain))

    actor, critic = network(0.01), network(1.0)
    weights = [*actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(weights, lr=options.learning_rate, eps=1e-5)

    steps, n = options.num_steps, options.num_envs
    observations = torch.zeros((steps, n, size))
    actions = torch.zeros((steps, n, 1))
    log_probs, rewards, values, next_values, over = (torch.zeros((steps, n)) for _ in range(5))
    batch = steps * n
    rollouts = -(-options.total_timesteps // batch)
    returns: list[float] = []
    began = time.perf_counter()
    first, _ = envs.reset(seed=options.seed)
    observation = torch.from_numpy(first)

    with tqdm(total=rollouts * batch, unit="step", unit_scale=True, dynamic_ncols=True, disable=not progress) as bar:
        for rollout in range(rollouts):
            left = 1.0 - rollout / rollouts
            optimizer.param_groups[0]["lr"] = left * options.learning_rate
            log_std = left * options.log_std_start + (1.0 - left) * options.log_std_end
            std = torch.tensor(log_std).exp()

            # Act ------------------------------------------------------------------------------------------------------
            with torch.no_grad():
                for t in range(steps):
                    distribution = normal(actor(observation), std)
                    action = distribution.sample()
                    observations[t], actions[t] = observation, action
                    log_probs[t] = distribution.log_prob(action).sum(1)
                    values[t] = critic(observation).squeeze(1)
                    seen, reward, terminated, truncated, info = envs.step(action.clamp(-1.0, 1.0).numpy())
                    observation = torch.from_numpy(seen)
                    shaped = scaled_reward(reward, options.reward_scale, options.reward_power)
                    rewards[t] = torch.from_numpy(np.asarray(shaped, np.float32))
                    over[t] = torch.from_numpy((terminated | truncated).astype(np.float32))
                    next_values[t] = critic(observation).squeeze(1)
                    for i in np.flatnonzero(terminated | truncated):  # the observation is already the next episode's
                        last = torch.from_numpy(np.asarray(info["final_obs"][i]))
                        next_values[t, i] = 0.0 if terminated[i] else critic(last).item()
                        returns.append(float(info["final_info"]["statistics"]["return"][i]))

                advantages = generalised_advantages(
                    rewards, values, next_values, over, options.gamma, options.gae_lambda
                )

            # Learn ----------------------------------------------------------------------------------------------------
            flat = [part.reshape(batch, *part.shape[2:]) for part in (observations, actions, log_probs, advantages)]
            targets = (advantages + values).reshape(batch)
            for _ in range(options.update_epochs):
                for chosen in torch.randperm(batch).tensor_split(options.num_minibatches):
                    seen_then, done_then, old_log_prob, advantage = (part[chosen] for part in flat)
                    log_prob = normal(actor(seen_then), std).log_prob(done_then).sum(1)
                    ratio = (log_prob - old_log_prob).exp()
                    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                    clipped = ratio.clamp(1.0 - options.clip_coef, 1.0 + options.clip_coef)
                    policy_loss = -torch.min(advantage * ratio, advantage * clipped).mean()  # Eq. 7 of arXiv:1707.06347
                    value_loss = 0.5 * (critic(seen_then).squeeze(1) - targets[chosen]).square().mean()
                    optimizer.zero_grad()
                    (policy_loss + options.vf_coef * value_loss).backward()
                    nn.utils.clip_grad_norm_(weights, options.max_grad_norm)
                    optimizer.step()
            bar.update(batch)
            if returns:
                bar.set_postfix_str(f"return {np.mean(returns[-n:]):.1f}")
    envs.close()

    pairs = [
        (part.weight.detach().numpy().T.astype(float), part.bias.detach().numpy().astype(float))
        for part in actor
        if isinstance(part, nn.Linear)
    ]
    told = {name.replace("-", "_"): getattr(options, name.replace("-", "_")) for name in NUMBERS}
    metadata = {"env_id": options.env_id, "made_by": "scripts/cleanrl_ppo.py", "options": told, "returns": returns}
    return NetworkPolicy(
        tuple(pairs), metadata={**metadata, "steps": rollouts * batch, "seconds": time.perf_counter() - began}
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command line says; return the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    check(parser, options)
    try:
        policy = train(options)
        if options.out is not None:
            policy.save(options.out)
    except KeyboardInterrupt:
        print("\ncleanrl_ppo.py: interrupted; nothing was written", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"cleanrl_ppo.py: error: the policy cannot be written: {error}", file=sys.stderr)
        return 1
    told = policy.metadata
    returns = told["returns"][-options.num_envs :]
    mean = f"return {np.mean(returns):.1f} with exploration, over the last {len(returns)} episodes" if returns else ""
    print(f"{told['steps']:,} steps in {told['seconds']:.0f} s. {mean or 'No episode has ended.'}")
    if options.out is not None:
        print(f"Use it: sd_friction_env.control.policies.load_policy({str(options.out)!r})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
