"""Networks: built by Stable-Baselines3 from checked settings, and converted to policies in plain NumPy."""

from collections.abc import Mapping
from typing import Any

import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sd_friction_env.control.policies import NetworkPolicy
from sd_friction_env.learning.settings import ACTIVATIONS, parse_policy_kwargs

ALGORITHM_CLASSES: dict[str, type[BaseAlgorithm]] = {
    "ppo": stable_baselines3.PPO,
    "sac": stable_baselines3.SAC,
    "td3": stable_baselines3.TD3,
    "tqc": sb3_contrib.TQC,
}


def policy_arguments(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``policy_kwargs`` as Stable-Baselines3 takes them."""
    arguments = parse_policy_kwargs(policy_kwargs)
    if "activation_fn" in arguments:
        arguments["activation_fn"] = getattr(nn, arguments["activation_fn"])
    return arguments


def build_policy(
    algorithm: str, observation_space: spaces.Box, action_space: spaces.Box, policy_kwargs: Mapping[str, Any]
) -> BasePolicy:
    """Return an untrained policy of Stable-Baselines3."""
    policy_class = ALGORITHM_CLASSES[algorithm].policy_aliases["MlpPolicy"]
    return policy_class(observation_space, action_space, lambda _: 0.0, **policy_arguments(policy_kwargs))


def network_policy(policy: BasePolicy, frames: int = 1, metadata: Mapping[str, Any] | None = None) -> NetworkPolicy:
    """Return the deterministic actor of a policy as one in plain NumPy.

    Args:
        policy: of PPO, SAC, TD3 or TQC, with a plain multilayer perceptron.
        frames: observations that it sees at once. metadata: JSON values to store with it.

    Raises:
        TypeError: if the actor is something else.
    """
    agent: Any = policy  # torch.nn.Module hides the types of its attributes
    if hasattr(agent, "mlp_extractor"):  # PPO: no squashing, the action is clipped
        modules, output = [*agent.mlp_extractor.policy_net, agent.action_net], "clip"
    elif hasattr(agent.actor, "latent_pi"):  # SAC, TQC
        modules, output = [*agent.actor.latent_pi, agent.actor.mu], "tanh"
    else:  # TD3: its own last module is the tanh
        *modules, last = agent.actor.mu
        if not isinstance(last, nn.Tanh):
            raise TypeError(f"the actor must end in tanh, not {last!r}")
        output = "tanh"
    linear, between = modules[::2], modules[1::2]
    names = {type(module).__name__ for module in between}
    if len(names) > 1 or not names <= set(ACTIVATIONS) or not all(type(module) is nn.Linear for module in linear):
        raise TypeError(f"the actor must be linear layers with one activation between them, got {modules!r}")
    layers = tuple(
        (module.weight.detach().cpu().numpy().T.astype(float), module.bias.detach().cpu().numpy().astype(float))
        for module in linear
    )
    return NetworkPolicy(layers, names.pop() if names else "Tanh", output, frames, dict(metadata or {}))
