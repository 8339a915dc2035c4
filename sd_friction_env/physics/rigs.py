"""Rig files: parameters of a machine in SI units, in TOML or YAML."""

import tomllib
from pathlib import Path
from typing import Any

from sd_friction_env.extras import extra
from sd_friction_env.physics.laws import friction_table
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import parse_yaml


def read_rig(path: str | Path) -> OscillatorParameters:
    """Return the dimensionless parameters of a rig described in a file.

    Its entries are the arguments of :meth:`OscillatorParameters.from_physical` (M, K, C, L, ..., in SI units), and
    ``friction_table``, the name of a CSV file of speeds (m/s) and coefficients in the same folder.

    Args:
        path: a file whose name ends in .toml, .yaml or .yml.

    Raises:
        OSError: if the file, or its table, cannot be read.
        ImportError: if PyYAML is missing for YAML.
        ValueError: if it does not hold names and values, or they make no rig; names the file.
    """
    path = Path(path)
    entries = _entries(path)
    table = entries.pop("friction_table", None)
    if table is not None:
        if "friction" in entries:
            raise ValueError(f"{str(path)!r} must have friction or friction_table, not both")
        entries["friction"] = friction_table(path.parent / str(table))
    try:
        return OscillatorParameters.from_physical(**entries)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"{str(path)!r} describes no rig: {fault}") from None


def _entries(path: Path) -> dict[str, Any]:
    ending = path.suffix.lower()
    if ending not in (".toml", ".yaml", ".yml"):
        raise ValueError(f"a rig file must end in .toml, .yaml or .yml, got {str(path)!r}")
    content = path.read_bytes()
    try:
        if ending == ".toml":
            entries: Any = tomllib.loads(content.decode())
        else:
            with extra("train"):
                entries = parse_yaml(content.decode())
    except ValueError as fault:
        kind = "TOML" if ending == ".toml" else "YAML"
        raise ValueError(f"{str(path)!r} is no {kind} file: {fault}") from None
    if not isinstance(entries, dict) or not all(isinstance(name, str) for name in entries):
        raise ValueError(f"{str(path)!r} must hold names and values, got {type(entries).__name__}")
    return entries
