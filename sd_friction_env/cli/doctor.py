"""What is installed here and what is missing for which feature: ``sd-friction doctor``."""

import importlib.metadata
import os
import platform
import re
import time
from pathlib import Path
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

import sd_friction_env
from sd_friction_env import kernel
from sd_friction_env.control.policies import PolicyFileError
from sd_friction_env.control.pretrained import load_pretrained
from sd_friction_env.environments.ids import SOLVED_IDS
from sd_friction_env.kernel.compilation import NO_FOLDER
from sd_friction_env.physics.orbits import limit_cycle
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import HYPERPARAMETERS

DISTRIBUTION = "sd-friction-env"
_FEATURES = {
    "plot": "figures and data frames",
    "render": "windows and frames of an environment",
    "video": "videos",
    "explore": "the explorer in the browser",
    "train": "training with Stable-Baselines3",
    "tune": "tuning with Optuna",
    "zoo": "training with RL Zoo",
    "report": "the report",
    "export": "agents as ONNX",
    "sweep": "sweeps in several processes",
    "dask": "sweeps on a Dask cluster",
    "ray": "sweeps on a Ray cluster",
    "torch": "the differentiable step in PyTorch",
    "jax": "the differentiable step in JAX",
    "completion": "completion in the shell",
}


def versions() -> dict[str, str | None]:
    """Return the versions of the package, of Python and of what the package needs, and the system; at once."""
    return {
        "sd_friction_env": sd_friction_env.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        **{name: _version(name) for name in ("gymnasium", "numpy", "scipy", "numba")},
    }


def examine() -> dict[str, Any]:
    """Return what there is, as JSON values.

    ``versions``, ``kernel`` (a limit cycle computed now; ``fault``: "" or what was raised instead), ``cache`` of
    compiled code, ``threads``, ``features`` (by extra: what it is for, what is missing), ``agents`` (by environment, ""
    or what is wrong), ``hyperparameters``, and ``works``: whether all that is needed without extras does.
    """
    kernel_findings = _kernel()
    agents = {env_id: _agent_fault(env_id) for env_id in SOLVED_IDS}
    return {
        "versions": versions(),
        "kernel": kernel_findings,
        "cache": _cache(),
        "threads": {"cores": os.cpu_count(), "numba": numba.get_num_threads()},
        "features": _features(),
        "agents": agents,
        "hyperparameters": str(HYPERPARAMETERS),
        "works": not kernel_findings["fault"] and not any(agents.values()),
    }


def _kernel() -> dict[str, Any]:
    """Return the amplitude of the nominal limit cycle, and how long it took the first time and the second."""
    amplitude, took = float("nan"), []
    try:
        for _ in range(2):
            begun = time.perf_counter()
            amplitude = limit_cycle(OscillatorParameters()).amplitude
            took.append(time.perf_counter() - begun)
    except Exception as fault:  # whatever it is, the rest is to be looked at too
        return {"fault": f"{type(fault).__name__}: {fault}"}
    return {"fault": "", "amplitude": amplitude, "first_call_seconds": round(took[0], 3), "seconds": round(took[1], 6)}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _agent_fault(env_id: str) -> str:
    try:
        load_pretrained(env_id)
    except (PolicyFileError, ValueError) as error:
        return str(error)
    return ""


def _cache() -> dict[str, Any]:
    """Return where numba keeps what it compiled of ours: the folder it uses, or None and the reason."""
    is_compiled = isinstance(kernel.iterate_to_attractor, Dispatcher)
    folder = kernel.iterate_to_attractor.stats.cache_path if is_compiled else None
    reason = NO_FOLDER if is_compiled else "nothing is compiled: NUMBA_DISABLE_JIT is set"
    files = list(Path(folder).glob("*.nb[ic]")) if folder is not None else []
    return {
        "folder": folder,
        "reason": "" if folder is not None else reason,
        "files": len(files),
        "megabytes": round(sum(file.stat().st_size for file in files) / 1e6, 1),
    }


def _features() -> dict[str, dict[str, Any]]:
    """Return what each extra is for, and which of its distributions are not installed."""
    try:
        required = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:  # run from its source without being installed
        return {}
    found: dict[str, dict[str, Any]] = {}
    for line in required:
        extra = re.search(r"extra *== *['\"]([\w-]+)['\"]", line)
        name = re.match(r"[\w.-]+", line)
        if extra is None or name is None or extra[1] not in _FEATURES:
            continue
        feature = found.setdefault(extra[1], {"for": _FEATURES[extra[1]], "missing": []})
        if _version(name[0]) is None:
            feature["missing"].append(name[0])
    return {name: found[name] for name in _FEATURES if name in found}


def versions_as_text() -> str:
    """Return :func:`versions` as lines for people."""
    return "\n".join(f"{name:16} {version}" for name, version in versions().items())


def as_text(findings: dict[str, Any], *, colour: bool = False) -> str:
    """Return findings of :func:`examine` as lines for people, without the versions."""

    def mark(good: bool, text: str) -> str:
        return f"\x1b[{32 if good else 33}m{text}\x1b[0m" if colour else text

    found, cache, threads = (findings[part] for part in ("kernel", "cache", "threads"))
    if found["fault"]:
        lines = [mark(False, f"{'kernel':16} {found['fault']}")]
    else:
        took = f"{1e3 * found['seconds']:.2f} ms (first call {found['first_call_seconds']:.2f} s)"
        lines = [f"{'kernel':16} limit cycle of amplitude {found['amplitude']:.10f} in {took}"]
    if cache["folder"] is None:
        lines.append(mark(False, f"{'compiled code':16} {cache['reason']}"))
    else:
        lines.append(f"{'compiled code':16} {cache['files']} files, {cache['megabytes']} MB, in {cache['folder']}")
    lines += [
        f"{'threads':16} {threads['cores']} cores, numba uses up to {threads['numba']}",
        f"{'hyperparameters':16} {findings['hyperparameters']}",
        "",
    ]
    for name, feature in findings["features"].items():
        missing = feature["missing"]
        mend = f'missing {", ".join(missing)}: pip install "{DISTRIBUTION}[{name}]"'
        lines.append(f"{name:16} {feature['for']}: {mark(not missing, 'ready' if not missing else mend)}")
    lines.append("")
    for env_id, fault in findings["agents"].items():
        lines.append(f"agent of {env_id:36} {mark(not fault, fault or 'ready')}")
    return "\n".join(lines)
