"""Checkpoints: the complete state of a run, written between rollouts, restored bit for bit.

Between rollouts there is least to keep: PPO has learnt from its last rollout, and no environment is within a step. A
checkpoint holds tensors and plain values, so nothing is executed on loading.
"""

import random
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sd_friction_env.environments.sb3 import SDFrictionVecEnv
from sd_friction_env.learning.plan import Plan
from sd_friction_env.learning.runs import RunFolderError
from sd_friction_env.learning.settings import one_line
from sd_friction_env.learning.tensors import load_tensors, save_tensors
from sd_friction_env.storage import StoredFileError, content_digest

FORMAT = 2

_COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
_BEGIN_ANEW = "begin anew with --force and without --resume"

Arrays = Mapping[str, NDArray[Any]]


# Files ----------------------------------------------------------------------------------------------------------------


def save_checkpoint(path: Path, plan: Plan, model: BaseAlgorithm, run: Mapping[str, Any], *, at_end: bool) -> None:
    """Write everything that is needed to continue a run.

    Args:
        run: the state of its record, tensors and plain values.
        at_end: whether training is over, so that the replay buffer is no longer needed.
    """
    about = {"format": FORMAT, "plan": content_digest(plan.configuration()), "steps": model.num_timesteps, "run": run}
    save_tensors(path, about | _model_state(model, at_end=at_end))


def last_whole_checkpoint(paths: Sequence[Path]) -> tuple[Path, dict[str, Any]] | None:
    """Return the first checkpoint that is not damaged and its content; None if there is no checkpoint.

    Warns:
        UserWarning: naming those that are damaged.

    Raises:
        RunFolderError: if all are damaged.
    """
    damaged = []
    for path in paths:
        try:
            saved = load_tensors(path, sealed=True)
        except StoredFileError as error:
            damaged.append(one_line(error))
            continue
        if damaged:
            message = f"a checkpoint is damaged ({'; '.join(damaged)}): resumed from its predecessor {str(path)!r}"
            warnings.warn(message, stacklevel=4)
        return path, saved
    if damaged:
        raise RunFolderError(f"no checkpoint can be used ({'; '.join(damaged)}): {_BEGIN_ANEW}")
    return None


def restore_checkpoint(path: Path, saved: Mapping[str, Any], model: BaseAlgorithm, plan: Plan) -> None:
    """Restore an untrained model and its environments from the content of a checkpoint.

    Raises:
        RunFolderError: if it is of another format or of another run.
    """
    if saved.get("format") != FORMAT:
        raise RunFolderError(
            f"checkpoint {str(path)!r} has format {saved.get('format')!r}, this version resumes {FORMAT}: {_BEGIN_ANEW}"
        )
    try:
        if saved["plan"] != content_digest(plan.configuration()):
            raise ValueError("it was written with another configuration")
        _restore_model(model, saved, plan.steps)
        if not {"rows", "best", "best_weights", "seconds", "logged"} <= set(saved["run"]):
            raise ValueError("the record of the run is incomplete")
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise RunFolderError(
            f"checkpoint {str(path)!r} is damaged or of another run: {one_line(error)[:300]}"
        ) from None


# The model ------------------------------------------------------------------------------------------------------------


def _model_state(model: BaseAlgorithm, *, at_end: bool) -> dict[str, Any]:
    """Return the state of a model and its environments as tensors (not copied) and plain values."""
    agent: Any = model
    assert agent.env is not None
    buffer = None if at_end else getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.buffer_size if buffer.full else buffer.pos
        buffer = {"pos": buffer.pos, "full": buffer.full, "arrays": _tensors(_replay_arrays(buffer, filled))}
    return {
        "parameters": model.get_parameters(),
        "variables": {name: recursive_getattr(model, name).detach() for name in agent._get_torch_save_params()[1]},
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "episodes": list(agent.ep_info_buffer),
        "environments": _tensors(_environment_arrays(agent.env)),
        "seen": _tensors({"observations": agent._last_obs, "starts": agent._last_episode_starts}),
        "noises": _tensors(_noise_arrays(model)),
        "replay": buffer,
        "random": _random_states(model),
    }


def _restore_model(model: BaseAlgorithm, saved: Mapping[str, Any], steps: int) -> None:
    """Put an untrained model and its environments into the state that :func:`_model_state` returned.

    Noises of actions are reset when learning starts: call :func:`restore_noises` then.
    """
    agent: Any = model
    model.set_parameters(saved["parameters"])
    for name in agent._get_torch_save_params()[1]:
        part = recursive_getattr(model, name)
        recursive_setattr(model, f"{name}.data", saved["variables"][name].to(part.device).reshape(part.shape))
    for name in _COUNTERS:
        setattr(model, name, type(getattr(model, name))(saved["counters"][name]))
    agent.ep_info_buffer = deque(saved["episodes"], maxlen=agent._stats_window_size)
    agent.ep_success_buffer = deque(maxlen=agent._stats_window_size)  # these environments report no success
    agent._last_obs = agent.env.reset()
    agent._last_episode_starts = np.ones(agent.env.num_envs, np.bool_)
    _fill(_environment_arrays(agent.env), saved["environments"])
    _fill({"observations": agent._last_obs, "starts": agent._last_episode_starts}, saved["seen"])
    restore_noises(model, saved["noises"])
    buffer, kept = getattr(model, "replay_buffer", None), saved["replay"]
    if buffer is not None and model.num_timesteps < steps:
        buffer.pos, buffer.full = int(kept["pos"]), bool(kept["full"])
        if not 0 <= buffer.pos < buffer.buffer_size:
            raise ValueError(f"the replay buffer cannot continue at {buffer.pos}")
        _fill(_replay_arrays(buffer, buffer.buffer_size if buffer.full else buffer.pos), kept["arrays"])
    _restore_random_states(model, saved["random"])


def restore_noises(model: BaseAlgorithm, noises: Mapping[str, torch.Tensor]) -> None:
    """Restore the state of a model's action noises from a checkpoint's "noises"."""
    _fill(_noise_arrays(model), noises)


def _environment_arrays(envs: VecEnv) -> dict[str, NDArray[Any]]:
    """Return the arrays (not copies) that hold the state of environments, statistics and random keys included."""
    base = envs.unwrapped
    assert isinstance(base, SDFrictionVecEnv)
    arrays = base.envs.arrays()
    stack = unwrap_vec_wrapper(envs, VecFrameStack)
    if isinstance(stack, VecFrameStack):
        arrays["stacked observations"] = stack.stacked_obs.stacked_obs
    return arrays


def _replay_arrays(buffer: ReplayBuffer, filled: int) -> dict[str, NDArray[Any]]:
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    return {name: getattr(buffer, name)[:filled] for name in names}


def _noise_arrays(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """Return the arrays (not copies) that hold the state of action noises."""
    noise: Any = getattr(model, "action_noise", None)
    parts = enumerate(getattr(noise, "noises", [noise]))
    return {str(i): part.noise_prev for i, part in parts if isinstance(part, OrnsteinUhlenbeckActionNoise)}


def _tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _fill(arrays: Arrays, saved: Mapping[str, torch.Tensor]) -> None:
    """Copy saved values into arrays of the same names, shapes and types."""
    if set(arrays) != set(saved):
        raise ValueError(f"arrays {sorted(set(arrays) ^ set(saved))} are missing or unknown")
    for name, array in arrays.items():
        values = saved[name].numpy()
        if values.shape != array.shape or values.dtype != array.dtype:
            raise ValueError(f"{name} is {values.dtype} {values.shape}, not {array.dtype} {array.shape}")
        array[...] = values


# Random numbers -------------------------------------------------------------------------------------------------------


def _random_states(model: BaseAlgorithm) -> dict[str, Any]:
    numpy_state: dict[str, Any] = np.random.get_state(legacy=False)  # noqa: NPY002  Stable-Baselines3 draws from it
    inner = numpy_state["state"]
    return {
        "python": random.getstate(),
        "numpy": {
            **numpy_state,
            "state": {"key": torch.from_numpy(inner["key"].astype(np.int64)), "pos": inner["pos"]},
        },
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _restore_random_states(model: BaseAlgorithm, saved: Mapping[str, Any]) -> None:
    inner = saved["numpy"]["state"]
    model.action_space.np_random.bit_generator.state = saved["actions"]
    if model.device.type == "cuda":
        torch.cuda.set_rng_state_all(saved["cuda"])
    torch.set_rng_state(saved["torch"])
    np.random.set_state(  # noqa: NPY002
        {**saved["numpy"], "state": {"key": inner["key"].numpy().astype(np.uint32), "pos": inner["pos"]}}
    )
    random.setstate(saved["python"])
