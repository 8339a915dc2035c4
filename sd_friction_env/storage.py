"""Stored files: written whole or not at all, sealed with a digest, read within bounds, and locked while in use.

A file may come from anywhere, be cut short, have a flipped bit or be made to harm. So nothing in a file is used before
it is checked against a bound: memory and time follow from the size of the file, never from a number in it.

A *seal* is the SHA-256 digest of a file in the file itself: the last value of a JSON object, or the comment of an
archive (.npz of NumPy, .pt of PyTorch: both are zip files), which other programs ignore. Files of earlier versions have
no seal and are read without one where the caller allows it.
"""

import contextlib
import datetime
import functools
import hashlib
import io
import itertools
import json
import math
import os
import re
import socket
import stat
import struct
import sys
import time
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

PathLike = str | os.PathLike[str]

_PACKAGE = Path(__file__).parent
# Agents, optima, gains and hyperparameters: package data of an installed package, in the repository a folder beside it.
AGENTS = _PACKAGE / "agents" if (_PACKAGE / "agents").is_dir() else _PACKAGE.parent / "agents"
HYPERPARAMETERS = AGENTS / "hyperparameters"

LARGEST_ARCHIVE = 2**30  # bytes
LARGEST_INFLATED = 2**25  # bytes of an archive's compressed entries in all; larger arrays are not compressed
LARGEST_JSON = 2**20
LARGEST_YAML = 2**16  # PyYAML reads some hundred kilobytes a second
DEEPEST_YAML, MOST_YAML_VALUES = 100, 20_000
MOST_DIGITS = 40  # of a whole number
PREVIOUS = ".previous"

_LARGEST_DIRECTORY = 2**20  # bytes: some ten thousand entries
_SEAL_KEY = "sha256"
_SEALED_TEXT = re.compile(r'"[0-9a-f]{64}"\s*\}\s*\Z')
_COMMENT = b"sha256:"
_COMMENT_LENGTH = len(_COMMENT) + 64
# The records that end a zip file. The last one: signature, disks, numbers of entries, size and place of the directory,
# length of the comment. Before it, in the form for large files (which PyTorch writes always): signature, sizes,
# versions, disks, numbers of entries, size and place of the directory; and a locator.
_END, _END_SIGNATURE = struct.Struct("<4s4H2LH"), b"PK\x05\x06"
_END_64, _END_64_SIGNATURE, _LOCATOR_SIGNATURE = struct.Struct("<4sQ2H2L4Q4s16x"), b"PK\x06\x06", b"PK\x06\x07"
_POLL = 0.02  # seconds between two attempts to take a lock


class StoredFileError(ValueError):
    """A stored file is damaged, too large, or of another kind than expected."""


class LockedError(StoredFileError):
    """Another process holds the lock."""


# Bytes ----------------------------------------------------------------------------------------------------------------


def checked_ending(path: str | os.PathLike[str], endings: Sequence[str], name: str = "path") -> str:
    """Return the ending of a file's name, in lower case.

    Raises:
        ValueError: if it is none of ``endings``; ``name`` is what the message calls the path.
    """
    ending = Path(path).suffix.lower()
    if ending not in endings:
        *others, last = endings
        known = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"{name} must end in {known}, got {os.fspath(path)!r}")
    return ending


@contextlib.contextmanager
def atomic_file(path: PathLike, mode: str = "w", *, keep: bool = False) -> Iterator[Any]:
    """Open a file beside ``path`` (mode "w" for text, "wb" or "w+b" for bytes) and move it to its place when complete.

    After an error, a full disk or a killed process, ``path`` is the old file or the new one, never a part.

    Args:
        keep: whether the old file is kept as its predecessor, "NAME.previous".
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    text = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    try:
        with open(partial, mode, **text) as file:  # type: ignore[call-overload]
            yield file
            file.flush()
            os.fsync(file.fileno())
        if keep and target.exists():
            with atomic_file(predecessor(target), "wb") as copy:
                copy.write(target.read_bytes())
        os.replace(partial, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(partial)
        raise


def predecessor(path: PathLike) -> Path:
    """Return where :func:`atomic_file` keeps the file that it has replaced."""
    target = Path(path)
    return target.with_name(target.name + PREVIOUS)


def predecessor_hint(path: PathLike) -> str:
    """Return words that name the predecessor of a damaged file; "" if there is none."""
    before = predecessor(path)
    return f" (its predecessor is kept in {str(before)!r})" if before.is_file() else ""


def open_regular(path: PathLike, most: int = LARGEST_ARCHIVE) -> io.BufferedReader:
    """Open a file for reading after checking that it is a file (not a folder, pipe or device) and not too large.

    Raises:
        OSError: if it is missing or cannot be read. StoredFileError: if it is something else or larger than ``most``.
    """
    name, found = repr(os.fspath(path)), os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise StoredFileError(f"{name} must be a file; it is {kind}")
    if found.st_size > most:
        raise StoredFileError(f"{name} is too large: {found.st_size:,} bytes; at most {most:,} are read")
    return open(path, "rb")


def read_bytes(path: PathLike, most: int = LARGEST_ARCHIVE) -> bytes:
    """Return the content of a file."""
    with open_regular(path, most) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)
    if len(data) != size:  # as for some files in /proc
        raise StoredFileError(f"{os.fspath(path)!r} is not as large as it says: another process is writing to it")
    return data


def read_text(path: PathLike, most: int = LARGEST_JSON) -> str:
    """Return the text in a file in UTF-8.

    Raises:
        OSError, StoredFileError: as :func:`open_regular`, or if it is not UTF-8.
    """
    with naming(path):
        return read_bytes(path, most).decode("utf-8")


def file_digest(path: PathLike) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def naming(path: PathLike) -> Iterator[None]:
    """Turn any error in reading a file, except those of the operating system, into one that names the file."""
    name = repr(os.fspath(path))
    try:
        yield
    except StoredFileError as error:
        raise StoredFileError(str(error) if str(error).startswith(name) else f"{name}: {error}") from None
    except OSError as error:
        if error.errno is None:  # a library's, about the content
            raise StoredFileError(f"{name}: {type(error).__name__}: {error}") from None
        raise
    except Exception as error:  # zip, deflate, NumPy's headers, JSON and YAML each fail in ways of their own
        raise StoredFileError(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:300]}") from None


def is_sealed(path: PathLike) -> bool:
    """Return whether a JSON file or an archive has a seal, right or wrong."""
    end = read_bytes(path)[-200:]
    return end[-_COMMENT_LENGTH:].startswith(_COMMENT) or bool(_SEALED_TEXT.search(end.decode("utf-8", "replace")))


# JSON -----------------------------------------------------------------------------------------------------------------


def content_digest(content: Any) -> str:
    """Return the SHA-256 digest of a JSON value, whatever its layout and the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def json_text(content: Mapping[str, Any], indent: int | None) -> str:
    """Return an object as JSON, indented by ``indent``; None: with one line for each of its values."""
    if indent is not None:
        return json.dumps(content, indent=indent, allow_nan=False) + "\n"
    dense = functools.partial(json.dumps, allow_nan=False, separators=(",", ":"))
    lines = [f"  {json.dumps(name)}: {dense(value)}" for name, value in content.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def write_json(path: PathLike, content: Mapping[str, Any], *, indent: int | None = 2, keep: bool = False) -> None:
    """Write an object as a JSON file with its seal, whole or not at all.

    Raises:
        ValueError: if a number is not finite, or it would be too large to be read again.
    """
    unsealed = {name: value for name, value in content.items() if name != _SEAL_KEY}
    text = json_text({**unsealed, _SEAL_KEY: content_digest(unsealed)}, indent)
    if len(text) > LARGEST_JSON:
        raise ValueError(f"{os.fspath(path)!r} would have {len(text):,} characters; at most {LARGEST_JSON:,} are read")
    with atomic_file(path, keep=keep) as file:
        file.write(text)


def parse_json(text: str) -> Any:
    """Return the value of a JSON text, without its seal if it has one.

    Raises:
        StoredFileError: if it is no JSON, too long or too deep, a key is given twice, or it differs from its seal.
    """
    if len(text) > LARGEST_JSON:
        raise StoredFileError(f"too long a text: {len(text):,} characters; at most {LARGEST_JSON:,} are read")
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_int=_whole)
    except StoredFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise StoredFileError(f"not JSON: {type(error).__name__}: {error}") from None
    if isinstance(content, dict) and (_SEAL_KEY in content or _SEALED_TEXT.search(text)):
        seal = content.pop(_SEAL_KEY, None)
        if seal != content_digest(content):
            raise StoredFileError("damaged, or changed since it was written: it differs from its digest")
    return content


def read_json(path: PathLike) -> Any:
    """Return the value in a JSON file.

    Raises:
        OSError: if it is missing or cannot be read. StoredFileError: as :func:`parse_json`, naming the file.
    """
    with naming(path):
        return parse_json(read_text(path))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))  # type: ignore[func-returns-value]
        raise StoredFileError(f"the key {twice[:100]!r} is given twice")
    return found


def _whole(digits: str) -> int:
    _check_digits(digits)
    return int(digits)


def _check_digits(digits: str) -> None:
    if len(digits) > MOST_DIGITS:
        raise StoredFileError(f"a whole number of {len(digits)} digits; at most {MOST_DIGITS} are read")


# YAML -----------------------------------------------------------------------------------------------------------------


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text of plain data.

    A few lines of aliases can expand to gigabytes: values are counted with aliases expanded before any is made.

    Raises:
        StoredFileError: if it is not valid YAML, expands to too many values, or a key is given twice.
    """
    import yaml

    if len(text) > LARGEST_YAML:
        raise StoredFileError(f"too long a text: {len(text):,} characters; at most {LARGEST_YAML:,} are read")
    depth = max(itertools.accumulate((mark in "[{") - (mark in "]}") for mark in text), default=0)
    if depth > DEEPEST_YAML:  # PyYAML's time goes with the square of that
        raise StoredFileError(f"{depth:,} brackets lie in one another; at most {DEEPEST_YAML} are read")
    loader = yaml.SafeLoader(text)
    try:
        root = loader.get_single_node()
        if root is None:
            return None
        _count_values(root, {})
        return loader.construct_document(root)
    except StoredFileError:
        raise
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise StoredFileError(f"not YAML: {' '.join(str(error).split())}") from None
    finally:
        loader.dispose()


def _count_values(node: Any, counts: dict[int, int]) -> int:
    """Return the number of values of a YAML node with aliases expanded; raise if it is too large or infinite.

    Args:
        counts: of the nodes seen so far, by identity; 0 while one is being counted.
    """
    if id(node) in counts:
        if not counts[id(node)]:
            raise StoredFileError("a YAML alias refers to a value that contains it")
        return counts[id(node)]
    counts[id(node)] = 0
    children = node.value if isinstance(node.value, list) else []
    if children and isinstance(children[0], tuple):
        keys = [key.value for key, _ in children if isinstance(key.value, str) and key.value != "<<"]
        if len(set(keys)) < len(keys):
            twice = next(key for i, key in enumerate(keys) if key in keys[:i])
            raise StoredFileError(f"the key {twice[:100]!r} is given twice")
        children = [part for pair in children for part in pair]
    elif node.tag == "tag:yaml.org,2002:int":
        _check_digits(node.value)
    count = 1 + sum(_count_values(child, counts) for child in children)
    if count > MOST_YAML_VALUES:
        raise StoredFileError(f"its aliases make it more than {MOST_YAML_VALUES:,} values")
    counts[id(node)] = count
    return count


def read_yaml(path: PathLike) -> Any:
    """Return the value in a YAML file.

    Raises:
        OSError: if it is missing or cannot be read. StoredFileError: as :func:`parse_yaml`, naming the file.
    """
    with naming(path):
        return parse_yaml(read_text(path, LARGEST_YAML))


# Archives -------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def sealed_archive(path: PathLike, *, keep: bool = False) -> Iterator[BinaryIO]:
    """Open a file to write a zip archive to; sealed, it takes its place when complete (see :func:`atomic_file`)."""
    with atomic_file(path, "w+b", keep=keep) as file:
        yield file
        file.seek(-2, os.SEEK_END)
        file.write(_COMMENT_LENGTH.to_bytes(2, "little"))
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0, os.SEEK_END)
        file.write(_COMMENT + digest.encode())


@contextlib.contextmanager
def open_archive(file: BinaryIO, *, sealed: bool = False, compressed: bool = True) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive after checking its seal and the total size of its entries.

    Args:
        file: open for reading.
        sealed: whether an archive without a seal is refused.
        compressed: whether entries may be compressed.

    Raises:
        StoredFileError: if it differs from its seal, or is not an archive of the form that this package writes.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(-min(size, _END_64.size + _END.size + _COMMENT_LENGTH), os.SEEK_END)
    tail = file.read()
    has_seal = tail[-_COMMENT_LENGTH:].startswith(_COMMENT)
    if has_seal:
        _check_digest(file, size - _COMMENT_LENGTH, tail[-64:])
        tail = tail[:-_COMMENT_LENGTH]
    elif sealed:
        raise StoredFileError("it has no digest: it is cut short, damaged or of an earlier version")
    end = tail[-_END.size :]
    if len(end) < _END.size:
        raise StoredFileError("not an archive: it is too short")
    signature, *_, directory, _, comment = _END.unpack(end)
    if signature != _END_SIGNATURE or comment != has_seal * _COMMENT_LENGTH:
        raise StoredFileError("not an archive, cut short or damaged: its last record is missing")
    before = tail[: -_END.size][-_END_64.size :]
    if before[-20:].startswith(_LOCATOR_SIGNATURE):
        if not before.startswith(_END_64_SIGNATURE):
            raise StoredFileError("not an archive that would be written here: its directory is elsewhere")
        directory = _END_64.unpack(before)[-3]
    if directory > _LARGEST_DIRECTORY:
        raise StoredFileError(f"an archive whose directory has {directory:,} bytes; at most {_LARGEST_DIRECTORY:,}")
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        found = archive.infolist()
        inflated = [entry.file_size for entry in found if entry.compress_type == zipfile.ZIP_DEFLATED]
        stored = [entry.file_size for entry in found if entry.compress_type == zipfile.ZIP_STORED]
        if len(inflated) + len(stored) < len(found) or (inflated and not compressed):
            raise StoredFileError("an archive with an entry that is compressed in a way that is not used here")
        if len({entry.filename for entry in found}) < len(found) or any(entry.flag_bits & 1 for entry in found):
            raise StoredFileError("an archive with an entry that is encrypted or there twice")
        if sum(inflated) > LARGEST_INFLATED or sum(stored) > size:
            raise StoredFileError(
                f"its entries come to {sum(inflated) + sum(stored):,} bytes; at most {LARGEST_INFLATED:,} are inflated"
            )
        yield archive


def _check_digest(file: BinaryIO, size: int, digest: bytes) -> None:
    """Raise unless the first ``size`` bytes of a file have the digest ``digest``."""
    found = hashlib.sha256()
    file.seek(0)
    while size > 0 and (part := file.read(min(size, 2**20))):
        found.update(part)
        size -= len(part)
    if found.hexdigest().encode() != digest:
        raise StoredFileError("damaged, or changed since it was written: it differs from its digest")


def write_arrays(file: BinaryIO, arrays: Mapping[str, NDArray[Any]], *, compress: bool = False) -> None:
    """Write arrays to an open file as an .npz archive, uncompressed where :func:`load_arrays` would not inflate them.

    Raises:
        TypeError: if an array holds Python objects.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise TypeError(f"{name!r} must be numbers or texts, got {array.dtype}")
    inflatable = sum(array.nbytes for array in arrays.values()) < LARGEST_INFLATED // 2
    save: Any = np.savez_compressed if compress and inflatable else np.savez
    save(file, **arrays)


def save_arrays(
    path: PathLike, arrays: Mapping[str, NDArray[Any]], *, compress: bool = False, keep: bool = False
) -> None:
    """Write arrays as a sealed .npz file, whole or not at all."""
    with sealed_archive(path, keep=keep) as file:
        write_arrays(file, arrays, compress=compress)


def load_arrays(path: PathLike, kinds: str = "fiu", texts: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Return all arrays of an .npz file by name; nothing in the file is ever executed.

    Args:
        kinds: of the arrays' types that are allowed, as NumPy's ``dtype.kind`` names them.
        texts: names of arrays that are one text each.

    Raises:
        OSError: if it is missing or cannot be read.
        StoredFileError: naming the file, if it is damaged, too large or holds something else.
    """
    with naming(path), open_regular(path) as file:
        return read_arrays(file, kinds, texts)


def read_arrays(file: BinaryIO, kinds: str = "fiu", texts: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Return what :func:`load_arrays` returns, from an open file.

    Raises:
        Exception: of any kind, if it is damaged.
    """
    arrays = {}
    with open_archive(file) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name == entry.filename:
                raise StoredFileError(f"an archive with an entry that is no array: {name[:100]!r}")
            with archive.open(entry) as member:
                arrays[name] = _read_array(name, member, kinds, name in texts)
    return arrays


def _read_array(name: str, file: IO[bytes], kinds: str, is_text: bool) -> NDArray[Any]:
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise StoredFileError(f"{name!r} is an array of format {version}; (1, 0) and (2, 0) are read")
    shape, by_columns, dtype = readers[version](file)
    allowed = dtype.kind == "U" and shape == () if is_text else dtype.kind in kinds and len(shape) <= 8
    if not allowed or dtype.itemsize == 0 or min(shape, default=0) < 0:
        raise StoredFileError(f"{name!r} must be {'one text' if is_text else 'numbers'}, got {dtype} of shape {shape}")
    length = math.prod(map(int, shape)) * dtype.itemsize
    data = file.read()
    if len(data) != length:
        raise StoredFileError(f"{name!r} has {len(data):,} bytes, and {dtype} of shape {shape} wants {length:,}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C").copy("K")


# Locks ----------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def locked(path: PathLike, what: str, *, wait: bool = False) -> Iterator[None]:
    """Hold a lock of the operating system on a file that names its holder; exclude other processes and threads.

    The lock of a process that dies is released, so a file that it leaves behind blocks nobody.

    Args:
        path: of the lock's file, which is removed in the end.
        what: name of the locked resource, for the message.
        wait: whether to wait until it is free, not to raise at once.

    Raises:
        LockedError: if another process holds it, naming that process.
        OSError: if the file cannot be created or locked.
    """
    target = Path(path)
    while True:
        with open(target, "a+b") as file:
            is_free = _take_lock(file)
            if not is_free and not wait:
                raise LockedError(f"{what} is in use by {_holder(file)}: wait until it has ended, or end it")
            if is_free and _is_at(file, target):
                try:
                    file.truncate(0)
                    file.write(_describe_holder())
                    file.flush()
                    yield
                finally:
                    if sys.platform != "win32":  # there, an open file cannot be removed
                        target.unlink(missing_ok=True)
                break
        time.sleep(_POLL)
    if sys.platform == "win32":
        with contextlib.suppress(OSError):  # another one waits for it
            target.unlink()


def _describe_holder() -> bytes:
    since = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    return json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": since}).encode()


def _take_lock(file: BinaryIO) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(2**30)  # away from where others read the holder
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _is_at(file: BinaryIO, path: Path) -> bool:
    """Return whether an open file is still the one at a path: its previous holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _holder(file: BinaryIO) -> str:
    try:
        file.seek(0)
        about = json.loads(file.read(4096))
        return f"process {about['process']} on {about['host']} since {about['since']}"
    except (OSError, KeyError, TypeError, ValueError):  # it has only just started, and has not written its name yet
        return "another process"
