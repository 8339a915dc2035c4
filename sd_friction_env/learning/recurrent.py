"""Training of recurrent followers: a network learns to estimate velocity and belt speed from readings and actions.

Each round runs episodes under the network's own policy, labels them with the truth, which training may know and the
policy may not, and fits the network to the last rounds: DAgger (S. Ross, G. Gordon and D. Bagnell, A reduction of
imitation learning and structured prediction to no-regret online learning, AISTATS 2011). The error is that of the
estimates and of the rule's action: near rest, a small constant error of the velocity lets the belt run at a wrong speed
and hardly counts among velocities. Needs PyTorch.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sd_friction_env import SDFrictionVectorEnv
from sd_friction_env.control.policies import RecurrentFollower, State, ThresholdFollower
from sd_friction_env.environments.ids import ARGUMENTS
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning.plan import training_seed

EPISODES = 256  # in each round
KEPT = 16  # rounds that the network is fitted to
BATCHES = 12  # in each round, of BATCH episodes
BATCH = 64
LEARNING_RATE = 3e-3  # falls to 0 over the rounds
_SHOWN = 0.5  # share of the first round's episodes in which the rule acts on the truth


def train_follower(
    env_id: str,
    *,
    seed: int = 0,
    rounds: int = 100,
    size: int = 64,
    metadata: Mapping[str, Any] | None = None,
    report: Callable[[int, float, float], None] = lambda done, error, mean_return: None,
) -> RecurrentFollower:
    """Return a recurrent follower trained on an environment with the sensor "position" and the belt actuator.

    Args:
        env_id: a registered id. seed: of the episodes and the network. rounds: of episodes and fits. size: of memory.
        metadata: origin, kept in the policy's file.
        report: called after each round with its number from 1, the mean error and the episodes' mean return.
    """
    torch.manual_seed(seed)
    env = make_env(env_id)
    unit, linear = nn.GRU(2, size), nn.Linear(size, 2)
    parameters = [*unit.parameters(), *linear.parameters()]
    optimiser = torch.optim.Adam(parameters, LEARNING_RATE)
    rule = ThresholdFollower.seeing_all(env)
    kept: list[tuple[Tensor, Tensor]] = []
    slope = 0.5 * rule.gain  # of the rule's action over an estimate, at the nominal belt speed
    speeds = env.task.randomise.get("belt_speed", (env.nominal.belt_speed,) * 2)

    def policy() -> RecurrentFollower:
        weights = {
            name: value.detach().numpy().astype(np.float64)
            for module in (unit, linear)
            for name, value in module.named_parameters()
        }
        return RecurrentFollower(weights, rule, speeds, dict(metadata or {}))

    for done in range(1, rounds + 1):
        shown = _SHOWN if done == 1 else 0.0
        inputs, targets, mean_return = _episodes(policy(), env_id, training_seed(seed, done * EPISODES), shown)
        kept = [*kept, (inputs, targets)][-KEPT:]
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * (1.0 - (done - 1) / rounds)
        errors = []
        for _ in range(BATCHES):
            inputs, targets = kept[int(torch.randint(len(kept), ()))]
            chosen = torch.randint(EPISODES, (BATCH,))
            error = _error(linear(unit(inputs[:, chosen])[0]), targets[:, chosen], slope)
            optimiser.zero_grad()
            error.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(parameters, 1.0)
            optimiser.step()
            errors.append(error.item())
        report(done, float(np.mean(errors)), mean_return)
    return policy()


def _error(estimates: Tensor, truth: Tensor, slope: float) -> Tensor:
    """Return the mean squared error of estimates (..., 2), and that of the actions by their velocities."""
    actions, wanted = ((slope * part[..., 0]).clamp(-1.0, 1.0) for part in (estimates, truth))
    return ((estimates - truth) ** 2).mean() + ((actions - wanted) ** 2).mean()


def _episodes(policy: RecurrentFollower, env_id: str, seed: int, shown: float) -> tuple[Tensor, Tensor, float]:
    """Return the network's inputs and targets, (steps, n, 2), and the mean return of episodes from a seed.

    In a share ``shown`` of them the rule acts on the truth.
    """
    steps = make_env(env_id).task.episode_steps
    arguments = {**ARGUMENTS[env_id], "episode_steps": steps + 1}  # no episode ends before the last step
    envs = SDFrictionVectorEnv(EPISODES, info_keys=("v",), **arguments)
    observation, info = envs.reset(seed=seed)
    speed, v = info["parameters"]["belt_speed"], info["v"]
    scale = 0.5 * policy.rule.belt_speed
    inputs, targets = np.zeros((2, steps, EPISODES, 2), np.float32)
    state: State = None
    last, total = np.zeros(EPISODES, np.float32), np.zeros(EPISODES)
    for t in range(steps):
        inputs[t] = np.stack([observation[:, 0], last], axis=-1)
        targets[t] = np.stack([v / scale, (speed - policy.rule.belt_speed) / scale], axis=-1)
        actions, state = policy.predict(observation, state)
        if shown:
            few = int(shown * EPISODES)
            actions[:few, 0] = np.clip(policy.rule.follow(v, speed), -1.0, 1.0)[:few]
            assert state is not None
            state = (actions[:, 0].astype(np.float64), *state[1:])
        observation, rewards, _, _, info = envs.step(actions)
        last, v = actions[:, 0], info["v"]
        total += rewards
    return torch.from_numpy(inputs), torch.from_numpy(targets), float(total.mean())
