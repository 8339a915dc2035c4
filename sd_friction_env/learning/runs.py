"""Run folders: all that is needed to load a trained agent again, and nothing that is executed on loading.

A finished run is a folder with::

    config.json         what was trained, how, with which versions; how to build the network again; the files' digests
    policy.pt           the best model's weights (a table of tensors; read with weights_only=True)
    policy.npz          the same actor for plain NumPy (sd_friction_env.control.policies.load_policy)
    evaluations.csv     what each evaluation during training gave
    checkpoints/        the last checkpoint; in an unfinished run all that is needed to go on as if nothing had
                        happened, and its predecessor, in case it is damaged
    tensorboard/        event files

While it is being trained, the folder is called ``NAME.partial``; it gets its name, and its config.json the status
"finished", when all else is written. So a half-written folder never looks like a finished one, whatever it is called.
A run that was interrupted, or killed at any moment, goes on from its last checkpoint (:func:`training.train`):
``resumed`` in config.json says after how many steps that was done, and with which versions. One process at a time works
on a run: it holds the lock ``.NAME.lock`` beside the folder.
"""

import contextlib
import itertools
import os
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sd_friction_env.control.policies import NetworkPolicy, PolicyFileError, load_policy
from sd_friction_env.storage import (
    LockedError,
    StoredFileError,
    file_digest,
    locked,
    naming,
    open_archive,
    open_regular,
    read_json,
    sealed_archive,
    write_json,
)

if TYPE_CHECKING:
    from stable_baselines3.common.policies import BasePolicy

FORMAT = 1
KIND = "sd_friction_env run"
CONFIG, WEIGHTS, NETWORK, EVALUATIONS = "config.json", "policy.pt", "policy.npz", "evaluations.csv"
CHECKPOINTS, TENSORBOARD = "checkpoints", "tensorboard"
PARTIAL = ".partial"
ALGORITHMS = ("ppo", "sac", "td3", "tqc")

_NEEDED_TO_RESUME = (
    "algorithm",
    "device",
    "environment",
    "evaluation",
    "hyperparameters",
    "seed",
    "threads",
    "versions",
)
_NEEDED = ("algorithm", "environment", "files", "hyperparameters", "seed", "spaces", "steps", "versions")


class RunFolderError(ValueError):
    """A run folder cannot be used: it is missing, unfinished, damaged, of another kind, or in the way."""


# Writing --------------------------------------------------------------------------------------------------------------


def partial_folder(folder: Path) -> Path:
    """Return the name a run folder has while it is being written."""
    return folder.with_name(folder.name + PARTIAL)


def check_free(folder: Path, *, force: bool = False) -> None:
    """Raise unless a run may be written to ``folder``; nothing is written or removed.

    Args:
        folder: of the finished run. force: whether a run that is there already may be replaced.

    Raises:
        RunFolderError: if the name cannot be one, something else is there, or a run is there and ``force`` not given.
    """
    if not folder.name or folder.name.endswith(PARTIAL) or folder.name in (".", ".."):
        raise RunFolderError(f"run folder must have a name that does not end in {PARTIAL!r}, got {str(folder)!r}")
    for parent in folder.parents:
        if parent.exists():
            if not parent.is_dir():
                raise RunFolderError(f"run folder {str(folder)!r} cannot be made: {str(parent)!r} is a file")
            if not os.access(parent, os.W_OK):
                raise RunFolderError(f"run folder {str(folder)!r} cannot be made: {str(parent)!r} is not writable")
            break
    for place, what in ((folder, "exists"), (partial_folder(folder), "is there from an unfinished run")):
        if not place.exists() and not place.is_symlink():
            continue
        reason = _reason_to_keep(place)
        if reason:
            raise RunFolderError(f"{str(place)!r} exists and is no run folder ({reason}): choose another --run-folder")
        if not force:
            raise RunFolderError(f"{str(place)!r} {what}: choose another --run-folder, or replace it with --force")


def _reason_to_keep(place: Path) -> str:
    """Return why removing ``place`` might remove something precious; "" if it is a run or empty."""
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
    """Keep other processes from working on the run that is to become ``folder``.

    Raises:
        RunFolderError: if one does so already, naming it. OSError: if the lock cannot be written.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder.with_name(f".{folder.name}.lock"), f"run folder {str(folder)!r}"):
            yield
    except LockedError as error:
        raise RunFolderError(str(error)) from None


def begin(folder: Path, config: Mapping[str, Any], *, force: bool = False) -> Path:
    """Make the partial folder of a run with its unfinished config.json, and return it.

    Raises:
        RunFolderError: as :func:`check_free`.
    """
    check_free(folder, force=force)
    partial = partial_folder(folder)
    # Made under other names and renamed: whenever this is killed, what is called partial has its config.json.
    fresh, old = (folder.with_name(f".{folder.name}.{os.getpid()}.{age}{PARTIAL}") for age in ("new", "old"))
    for left in (fresh, old):
        shutil.rmtree(left, ignore_errors=True)
    fresh.mkdir(parents=True)
    try:
        write_unfinished(fresh, config)
        if partial.exists():
            os.replace(partial, old)
        os.replace(fresh, partial)
    finally:
        for place in (fresh, old):
            shutil.rmtree(place, ignore_errors=True)
    return partial


def write_unfinished(partial: Path, config: Mapping[str, Any]) -> None:
    """Write the config.json of a run that is being trained to its partial folder."""
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
    """Remove from a partial folder the half-written files that a killed process has left."""
    for place in (partial, partial / CHECKPOINTS):
        for file in place.glob(f".*{PARTIAL}"):
            file.unlink()


def finish(folder: Path, config: Mapping[str, Any], *, force: bool = False) -> None:
    """Give a partial folder its digests, its status and its name.

    Args:
        folder: of the finished run. config: as :func:`load_config` will return it, without ``files``.

    Raises:
        RunFolderError: if something has taken the name meanwhile and ``force`` is not given.
    """
    partial = partial_folder(folder)
    files = {name: file_digest(partial / name) for name in (WEIGHTS, NETWORK, EVALUATIONS)}
    content = {"kind": KIND, "format": FORMAT, "status": "finished", **config, "files": files}
    write_json(partial / CONFIG, content)
    if folder.exists():
        if not force or _reason_to_keep(folder):
            raise RunFolderError(f"{str(folder)!r} exists by now: the finished run is left in {str(partial)!r}")
        old = folder.with_name(folder.name + ".old" + PARTIAL)
        if old.exists():
            shutil.rmtree(old)
        os.replace(folder, old)
        os.replace(partial, folder)
        shutil.rmtree(old)
    else:
        os.replace(partial, folder)


class _File:
    """A file that remembers why it could not be written: torch says only that it could not."""

    def __init__(self, file: Any) -> None:
        self.file = file
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return int(self.file.write(data))
        except OSError as error:
            self.error = error
            raise

    def flush(self) -> None:
        self.file.flush()


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values with torch.save, sealed, whole or not at all, also if the machine fails.

    Raises:
        OSError: if it cannot be written.
    """
    import torch

    with sealed_archive(path) as file:
        target: Any = _File(file)
        try:
            torch.save(dict(content), target)
        except RuntimeError:
            if target.error is not None:
                raise target.error from None
            raise


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
        ValueError: if it describes none.
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
    """Return the configuration of a finished run, after checking that its files are those that were written.

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
        raise RunFolderError(f"{name!r} is half-written: its training has not finished")
    missing = [key for key in _NEEDED if key not in config]
    if missing or config["algorithm"] not in ALGORITHMS or not isinstance(config["files"], dict):
        what = f"lacks {missing[0]!r}" if missing else "holds values that cannot be"
        raise RunFolderError(f"{name!r} is damaged: its {CONFIG} {what}")
    for file in (WEIGHTS, NETWORK, EVALUATIONS):
        try:
            digest = file_digest(place / file)
        except (OSError, StoredFileError):
            raise RunFolderError(f"{name!r} is damaged: {file} is missing or cannot be read") from None
        if digest != config["files"].get(file):
            raise RunFolderError(f"{name!r} is damaged: {file} is not the file that {CONFIG} speaks of")
    return config


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
    """Return the configuration of the unfinished run that is to become ``folder``; nothing is written.

    Args:
        folder: of the finished run. force: whether a finished run that is there too may be replaced in the end.

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
        raise RunFolderError(f"{str(folder)!r} exists: resume with --force to let {str(partial)!r} take its place")
    config = _read_config(partial)
    missing = [key for key in _NEEDED_TO_RESUME if key not in config]
    if missing:
        raise RunFolderError(f"{str(partial)!r} is damaged: its {CONFIG} lacks {missing[0]!r}")
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
        RunFolderError: as :func:`load_config`, or if policy.pt is more than a table of tensors, or another network's.
    """
    from sd_friction_env.learning.training import build_policy

    config = load_config(folder)
    weights = load_tensors(Path(folder) / WEIGHTS)
    try:
        policy_kwargs = config["hyperparameters"].get("policy_kwargs", {})
        _check_size(policy_kwargs, weights)
        observation_space, action_space = (
            described_space(config["spaces"][kind]) for kind in ("observation", "action")
        )
        policy = build_policy(config["algorithm"], observation_space, action_space, policy_kwargs)
        for name, tensor in policy.state_dict().items():
            if name in weights and weights[name].dtype != tensor.dtype:
                raise ValueError(f"{name} in {WEIGHTS} is {weights[name].dtype}, not {tensor.dtype}")
            if name in weights and not weights[name].isfinite().all():
                raise ValueError(f"{name} in {WEIGHTS} has entries that are not finite")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RunFolderError(f"{os.fspath(folder)!r} is damaged: {error}") from None
    try:
        policy.load_state_dict(weights, strict=True)
    except (RuntimeError, TypeError, AttributeError) as error:
        reason = str(error).partition("\n")[0]
        raise RunFolderError(f"{os.fspath(folder)!r} is damaged: {WEIGHTS} does not fit {CONFIG} ({reason})") from None
    policy.set_training_mode(False)
    return policy.to(device)


def _check_size(policy_kwargs: Any, weights: Mapping[str, Any]) -> None:
    """Raise if a policy would have more weights than there are: it is then not even built."""
    from sd_friction_env.learning.training import parse_policy_kwargs

    kwargs = parse_policy_kwargs(policy_kwargs)
    nets = kwargs.get("net_arch", [])
    least = kwargs.get("n_critics", 1) * sum(
        before * after
        for widths in (nets.values() if isinstance(nets, dict) else [nets])
        for before, after in itertools.pairwise([1, *widths, kwargs.get("n_quantiles", 1)])
    )
    there = sum(tensor.numel() for tensor in weights.values())
    if least > there:
        raise ValueError(f"{WEIGHTS} does not fit {CONFIG}: it has {there:,} weights, and {least:,} or more are needed")


def load_tensors(path: Path, *, sealed: bool = False) -> dict[str, Any]:
    """Return what :func:`save_tensors` wrote; a file that asks for code to be run is refused.

    Args:
        sealed: whether a file without a seal is refused.

    Raises:
        RunFolderError: if it is damaged, or anything but a table of tensors and plain values.
    """
    import torch

    try:
        with naming(path), open_regular(path, sys.maxsize) as file:
            with open_archive(file, sealed=sealed, compressed=False):
                file.seek(0)
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # torch only warns of pickles that it did not write
                content = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, StoredFileError) as error:
        raise RunFolderError(f"{error}: it is not a table of tensors, or is damaged") from None
    if not isinstance(content, dict):
        raise RunFolderError(f"{str(path)!r} is not a table of tensors: refused")
    return content
