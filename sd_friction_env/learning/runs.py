"""Run folders: everything that is needed to load a trained agent again; nothing is executed on loading.

A finished run is a folder with::

    config.json         what was trained, how and with which versions; how to rebuild the network; the files' digests
    policy.pt           the best model's weights (a table of tensors; read with weights_only=True)
    policy.npz          the same actor for plain NumPy (sd_friction_env.control.policies.load_policy)
    evaluations.csv     the result of each evaluation during training
    checkpoints/        the last checkpoint; in an unfinished run also its predecessor, in case the last is damaged
    tensorboard/        event files

During training the folder is called ``NAME.partial``. It gets its name, and its config.json the status "finished", when
everything else is written, so that an unfinished folder never looks like a finished one. A run that was interrupted or
killed continues from its last checkpoint (:func:`training.train`); ``resumed`` in config.json records after how many
steps, and with which versions. One process at a time works on a run; it holds the lock ``.NAME.lock`` next to the run.
"""

import contextlib
import itertools
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sd_friction_env.control.policies import NetworkPolicy, PolicyFileError, load_policy
from sd_friction_env.learning.settings import ALGORITHMS, parse_policy_kwargs
from sd_friction_env.learning.tensors import load_tensors
from sd_friction_env.storage import LockedError, StoredFileError, file_digest, locked, read_json, write_json

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

FORMAT = 1
KIND = "sd_friction_env run"
CONFIG, WEIGHTS, NETWORK, EVALUATIONS = "config.json", "policy.pt", "policy.npz", "evaluations.csv"
CHECKPOINTS, TENSORBOARD = "checkpoints", "tensorboard"
PARTIAL = ".partial"

_ALWAYS_STORED = ("algorithm", "environment", "hyperparameters", "seed", "versions")
_NEEDED_TO_RESUME = (*_ALWAYS_STORED, "device", "evaluation", "threads")
_NEEDED = (*_ALWAYS_STORED, "files", "spaces", "steps")


class RunFolderError(ValueError):
    """A run folder cannot be used: it is missing, unfinished, damaged, of another kind, or in the way."""


# Writing --------------------------------------------------------------------------------------------------------------


def partial_folder(folder: Path) -> Path:
    """Return the name of a run folder during training."""
    return folder.with_name(folder.name + PARTIAL)


def check_free(folder: Path, *, force: bool = False) -> None:
    """Raise unless a run may be written to ``folder``; nothing is written or removed.

    Raises:
        RunFolderError: if the name is not allowed, something else has it, or a run has it and ``force`` is not given.
    """
    if not folder.name or folder.name.endswith(PARTIAL) or folder.name in (".", ".."):
        raise RunFolderError(f"run folder must have a name that does not end in {PARTIAL!r}, got {str(folder)!r}")
    parent = next((parent for parent in folder.parents if parent.exists()), None)
    if parent is not None and not (parent.is_dir() and os.access(parent, os.W_OK)):
        what = "not writable" if parent.is_dir() else "a file"
        raise RunFolderError(f"run folder {str(folder)!r} cannot be made: {str(parent)!r} is {what}")
    for place, what in ((folder, "exists"), (partial_folder(folder), "exists, from an unfinished run")):
        if not place.exists() and not place.is_symlink():
            continue
        reason = _reason_to_keep(place)
        if reason:
            raise RunFolderError(f"{str(place)!r} exists and is no run folder ({reason}): choose another --run-folder")
        if not force:
            raise RunFolderError(f"{str(place)!r} {what}: choose another --run-folder, or replace it with --force")


def _reason_to_keep(place: Path) -> str:
    """Return why ``place`` must not be removed; "" if it is a run or empty."""
    if place.is_symlink() or not place.is_dir():
        return "it is a file or a link"
    if not any(place.iterdir()):
        return ""
    try:
        config = read_json(place / CONFIG)
    except (OSError, StoredFileError) as error:
        return str(error)
    return "" if isinstance(config, dict) and config.get("kind") == KIND else f"its {CONFIG} is of something else"


@contextlib.contextmanager
def only_here(folder: Path) -> Iterator[None]:
    """Lock the run that will become ``folder`` against other processes.

    Raises:
        RunFolderError: if another process has locked it, naming that process. OSError: if the lock cannot be written.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder.with_name(f".{folder.name}.lock"), f"run folder {str(folder)!r}"):
            yield
    except LockedError as error:
        raise RunFolderError(str(error)) from None


def begin(folder: Path, config: Mapping[str, Any], *, force: bool = False) -> Path:
    """Make the partial folder of a run with its unfinished config.json, and return it."""
    check_free(folder, force=force)
    partial = partial_folder(folder)
    # Made under another name and renamed: a partial folder has its config.json even if this process is killed.
    fresh = folder.with_name(f".{folder.name}.new{PARTIAL}")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    try:
        write_unfinished(fresh, config)
        _replace_folder(fresh, partial)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return partial


def _replace_folder(source: Path, target: Path) -> None:
    """Give a folder the name of another one, which is removed if it exists."""
    old = target.with_name(f".{target.name}.old{PARTIAL}")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        os.replace(target, old)
    os.replace(source, target)
    shutil.rmtree(old, ignore_errors=True)


def write_unfinished(partial: Path, config: Mapping[str, Any]) -> None:
    """Write the config.json of an unfinished run to its partial folder."""
    write_json(partial / CONFIG, {"kind": KIND, "format": FORMAT, "status": "unfinished", **config})


def checkpoints(partial: Path) -> list[Path]:
    """Return the checkpoints of a run, the last one first."""
    return sorted((partial / CHECKPOINTS).glob("step_*.pt"), reverse=True)


def keep_checkpoints(partial: Path, *kept: Path | None) -> None:
    """Remove all checkpoints of a run but those named."""
    for path in checkpoints(partial):
        if path not in kept:
            path.unlink()


def remove_leftovers(partial: Path) -> None:
    """Remove half-written files that a killed process has left in a partial folder."""
    for place in (partial, partial / CHECKPOINTS):
        for file in place.glob(f".*{PARTIAL}"):
            file.unlink()


def finish(folder: Path, config: Mapping[str, Any], *, force: bool = False) -> None:
    """Give a partial folder its digests, its status and its name.

    Raises:
        RunFolderError: if something else has taken the name and ``force`` is not given.
    """
    partial = partial_folder(folder)
    files = {name: file_digest(partial / name) for name in (WEIGHTS, NETWORK, EVALUATIONS)}
    content = {"kind": KIND, "format": FORMAT, "status": "finished", **config, "files": files}
    write_json(partial / CONFIG, content)
    if folder.exists() and (not force or _reason_to_keep(folder)):
        raise RunFolderError(f"{str(folder)!r} exists: the finished run is left in {str(partial)!r}")
    _replace_folder(partial, folder)


# Spaces ---------------------------------------------------------------------------------------------------------------


def describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return a Box as JSON values.

    Raises:
        TypeError: if it is another space.
    """
    if not isinstance(space, spaces.Box):
        raise TypeError(f"only Box spaces can be described, got {space!r}")
    return {
        "type": "Box",
        "shape": list(space.shape),
        "dtype": str(space.dtype),
        "low": space.low.ravel().tolist(),
        "high": space.high.ravel().tolist(),
    }


def described_space(description: Any) -> spaces.Box:
    """Return the Box that :func:`describe_space` described.

    Raises:
        ValueError: if it is not the description of one.
    """
    try:
        if description["type"] != "Box" or description["dtype"] != "float32":
            raise ValueError
        low, high = (
            np.array(description[side], dtype=np.float32).reshape([int(size) for size in description["shape"]])
            for side in ("low", "high")
        )
        return spaces.Box(low, high, dtype=np.float32)
    except (KeyError, TypeError, ValueError, AssertionError):
        raise ValueError(f"not the description of a Box of float32: {description!r}") from None


# Reading --------------------------------------------------------------------------------------------------------------


def load_config(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the configuration of a finished run, after checking the digests of its files.

    Raises:
        RunFolderError: if the folder is missing, unfinished, damaged, or of another kind or format.
    """
    name, place = os.fspath(folder), Path(folder)
    if not place.is_dir():
        partial = partial_folder(place) if place.name else place
        hint = f" (its training did not finish: {str(partial)!r})" if partial.is_dir() else ""
        raise RunFolderError(f"there is no run folder {name!r}{hint}")
    config = _read_config(place)
    if config.get("status") != "finished":
        raise RunFolderError(f"{name!r} is unfinished: its training has not ended")
    _check_keys(config, _NEEDED, name)
    if config["algorithm"] not in ALGORITHMS or not isinstance(config["files"], dict):
        raise RunFolderError(f"{name!r} is damaged: its {CONFIG} holds values that are not allowed")
    for file in (WEIGHTS, NETWORK, EVALUATIONS):
        try:
            digest = file_digest(place / file)
        except (OSError, StoredFileError):
            raise RunFolderError(f"{name!r} is damaged: {file} is missing or cannot be read") from None
        if digest != config["files"].get(file):
            raise RunFolderError(f"{name!r} is damaged: {file} differs from its digest in {CONFIG}")
    return config


def _check_keys(config: Mapping[str, Any], needed: tuple[str, ...], name: str) -> None:
    missing = [key for key in needed if key not in config]
    if missing:
        raise RunFolderError(f"{name!r} is damaged: its {CONFIG} lacks {missing[0]!r}")


def _read_config(place: Path) -> dict[str, Any]:
    name = str(place)
    try:
        config = read_json(place / CONFIG)
    except (OSError, StoredFileError) as error:
        raise RunFolderError(f"{name!r} is not a run folder: its {CONFIG} cannot be read ({error})") from None
    if not isinstance(config, dict) or config.get("kind") != KIND:
        raise RunFolderError(f"{name!r} is not a run folder of sd_friction_env")
    if config.get("format") != FORMAT:
        raise RunFolderError(f"{name!r} has run format {config.get('format')!r}; this version reads {FORMAT}")
    return config


def load_unfinished(folder: Path, *, force: bool = False) -> dict[str, Any]:
    """Return the configuration of the unfinished run that will become ``folder``; nothing is written.

    Raises:
        RunFolderError: if there is none, it is finished, damaged, of another kind or format, or its name is taken.
    """
    partial = partial_folder(folder)
    if not partial.is_dir():
        if folder.is_dir():
            load_config(folder)
            raise RunFolderError(f"{str(folder)!r} is finished: there is nothing to resume")
        raise RunFolderError(f"there is nothing to resume: no {str(partial)!r}")
    if folder.exists() and not force:
        raise RunFolderError(f"{str(folder)!r} exists: resume with --force to let {str(partial)!r} replace it")
    config = _read_config(partial)
    _check_keys(config, _NEEDED_TO_RESUME, str(partial))
    return config


def load_network(folder: str | os.PathLike[str]) -> NetworkPolicy:
    """Return the agent of a finished run as a policy in plain NumPy.

    Raises:
        RunFolderError: as :func:`load_config`, or if policy.npz cannot be read.
    """
    load_config(folder)
    try:
        return load_policy(Path(folder) / NETWORK)
    except PolicyFileError as error:
        raise RunFolderError(str(error)) from None


def load_torch_policy(folder: str | os.PathLike[str], device: str = "cpu") -> "BasePolicy":
    """Return the agent of a finished run as Stable-Baselines3's policy, built from config.json.

    Its observations are those of the training environment: a stack of ``environment["frame_stack"]`` of them.

    Raises:
        RunFolderError: as :func:`load_config`, or if policy.pt is not a table of tensors, or of another network.
    """
    config = load_config(folder)
    try:
        return _filled_policy(config, load_tensors(Path(folder) / WEIGHTS)).to(device)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunFolderError(f"{os.fspath(folder)!r} is damaged: {error}") from None


def _filled_policy(config: Mapping[str, Any], weights: Mapping[str, Any]) -> "BasePolicy":
    from sd_friction_env.learning import networks

    policy_kwargs = parse_policy_kwargs(config["hyperparameters"].get("policy_kwargs", {}))
    _check_size(policy_kwargs, weights)
    observation_space, action_space = (described_space(config["spaces"][kind]) for kind in ("observation", "action"))
    policy = networks.build_policy(config["algorithm"], observation_space, action_space, policy_kwargs)
    for name, tensor in policy.state_dict().items():
        if name in weights and weights[name].dtype != tensor.dtype:
            raise ValueError(f"{name} in {WEIGHTS} is {weights[name].dtype}, not {tensor.dtype}")
        if name in weights and weights[name].shape == tensor.shape and not weights[name].isfinite().all():
            raise ValueError(f"{name} in {WEIGHTS} has entries that are not finite")
    try:
        policy.load_state_dict(dict(weights), strict=True)
    except (RuntimeError, TypeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{WEIGHTS} does not fit {CONFIG} ({reason})") from None
    policy.set_training_mode(False)
    return policy


def _check_size(policy_kwargs: Mapping[str, Any], weights: Mapping[str, Any]) -> None:
    """Raise if a policy would have more weights than are stored, before it is built."""
    nets = policy_kwargs.get("net_arch", [])
    least = policy_kwargs.get("n_critics", 1) * sum(
        before * after
        for widths in (nets.values() if isinstance(nets, dict) else [nets])
        for before, after in itertools.pairwise([1, *widths, policy_kwargs.get("n_quantiles", 1)])
    )
    stored = sum(tensor.numel() for tensor in weights.values())
    if least > stored:
        raise ValueError(f"{WEIGHTS} does not fit {CONFIG}: it has {stored:,} weights, at least {least:,} are needed")
