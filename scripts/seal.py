"""Add their digest to stored files that lack it: JSON files and .npz archives of an earlier version.

    python scripts/seal.py                          the files that come with the project
    python scripts/seal.py runs/mine/config.json    these files

Values and arrays stay as they are, to the bit. A file that has a digest already is checked and left alone.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from agents import classical, optimal
from scripts.train import Parser
from sd_friction_env import pretrained
from sd_friction_env.storage import (
    StoredFileError,
    file_digest,
    is_sealed,
    json_text,
    load_arrays,
    read_bytes,
    read_json,
    read_text,
    sealed_archive,
    write_json,
)

AGENTS = Path(__file__).resolve().parent.parent / "agents" / "pretrained"
TEXTS = ("header", "fingerprint")


def stored_files() -> list[Path]:
    """Return the files that come with the project, archives before the tables that name their digests."""
    folders = (optimal.OPTIMUM_DIRECTORY, pretrained.PRETRAINED)
    archives = [path for folder in folders for path in sorted(folder.glob("*.npz"))]
    tables = [*sorted(optimal.OPTIMUM_DIRECTORY.glob("*.json")), *sorted(AGENTS.glob("*/config.json"))]
    return [*archives, *tables, classical.GAINS_FILE]


def seal(path: Path) -> bool:
    """Add the digest to a file; return whether it lacked it.

    Raises:
        OSError, StoredFileError: if it cannot be read or written, is damaged or is of another kind.
    """
    if path.suffix == ".npz":
        load_arrays(path, "fiu", TEXTS)
        if is_sealed(path):
            return False
        data = read_bytes(path)
        with sealed_archive(path) as file:
            file.write(data)
        return True
    content = read_json(path)
    if path.suffix != ".json" or not isinstance(content, dict):
        raise StoredFileError(f"{str(path)!r} must be an .npz archive or an object in a .json file")
    if is_sealed(path):
        return False
    text = read_text(path)
    indent = next((width for width in (1, 2, None) if json_text(content, width) == text), 2)
    sequences = path.with_suffix(".npz")
    if "seeds" in content and sequences.is_file():
        content["sequences"] = f"sha256:{file_digest(sequences)}"
    write_json(path, content, indent=indent)
    return True


def main(arguments: Sequence[str] | None = None) -> int:
    """Seal the files that the command line names; return the exit status."""
    parser = Parser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, prog="seal.py"
    )
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="default: those of the project")
    options = parser.parse_args(arguments)
    files = options.files or stored_files()
    try:
        added = sum(seal(path) for path in files)
    except (OSError, StoredFileError) as error:
        print(f"seal.py: error: {error}", file=sys.stderr)
        return 1
    print(f"{added} of {len(files)} files had no digest, and have it now")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
