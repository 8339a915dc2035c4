"""Files of tensors and plain values (.pt): sealed, written whole or not at all, read without executing anything."""

import io
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sd_friction_env.storage import StoredFileError, naming, open_archive, open_regular, sealed_archive


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values as a sealed file."""
    import torch

    buffer = io.BytesIO()  # torch turns the system's errors into a bare RuntimeError
    torch.save(dict(content), buffer)
    with sealed_archive(path) as file:
        file.write(buffer.getbuffer())


def load_tensors(path: Path, *, sealed: bool = False) -> dict[str, Any]:
    """Return what :func:`save_tensors` wrote; a file with code in it is refused.

    Args:
        sealed: whether a file without a seal is refused.

    Raises:
        StoredFileError: naming the file, if it is missing, damaged, or not a table of tensors and plain values.
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
        raise StoredFileError(f"{error}: not a table of tensors, or damaged") from None
    if not isinstance(content, dict):
        raise StoredFileError(f"{str(path)!r} is not a table of tensors")
    return content
