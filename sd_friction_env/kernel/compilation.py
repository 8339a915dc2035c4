"""How the kernel's functions are compiled and where the result is kept: decorators, and a cache that checks its files.

numba's cache watches only the file that defines a function: an edit of a function that it calls, in another file,
would leave the old one in use, silently. Here an edit in any file of the kernel renews all of it, and one in the file
of a law that a function was compiled for renews that. numba's cache trusts its files: a damaged one is a traceback at
every start, a crash or a wrong number, and of two processes that compile at once one can overwrite the other's code
under a name that both then read. Where no folder can be written, it refuses to define a function at all. Here every
file ends with a digest and every entry names the source and the signature it was compiled from; what does not fit is
compiled anew. No fault of the cache raises. Names are unique to a process: numba takes constants by name.
"""

import contextlib
import functools
import hashlib
import inspect
import io
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import boxing, event, types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.pythonapi import _boxers
from numba.core.registry import CPUDispatcher
from numba.core.serialize import NumbaPickler

NO_FOLDER = "compiled code cannot be kept, no folder for it can be written: set NUMBA_CACHE_DIR to one that can"
_KERNEL = Path(__file__).parent


def _digest_of(files: Iterable[Path]) -> bytes:
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        digest.update(f"{file.name} {len(content)} ".encode() + content)
    return digest.digest()


_SOURCES = _digest_of(sorted(_KERNEL.rglob("*.py")))


def _digest_of_own(file: Path) -> bytes:
    """Return the digest of a file that is not of the kernel."""
    return b"" if file.is_relative_to(_KERNEL) else _digest_of([file])


_said: set[str] = set()


def _say(text: str) -> None:
    print(f"sd_friction_env: {text}", file=sys.stderr, flush=True)


def _say_once(kind: str, text: str) -> None:
    """Print a line on standard error, one in a process for each kind."""
    if kind not in _said:
        _said.add(kind)
        _say(text)


def _of_main(name: str) -> Any:
    return getattr(sys.modules["__main__"], name)


class _ByName(NumbaPickler):
    """numba's pickler, but laws of the program that runs are found by name, not copied: a copy is another type."""

    def reducer_override(self, found: Any) -> Any:
        if isinstance(found, type) and issubclass(found, tuple) and found.__module__ == "__main__":
            return _of_main, (found.__name__,)
        return super().reducer_override(found)


class _CheckedFiles(IndexDataCacheFile):
    """numba's files of one function, each with a digest at its end, which unpickling does not read."""

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _check(self, path: str) -> None:
        content = Path(path).read_bytes()
        if hashlib.sha256(content[:-32]).digest() != content[-32:]:
            raise OSError(f"the file {path!r} of compiled code is damaged")

    def _load_index(self) -> dict[Any, str]:
        try:
            self._check(self._index_path)
            return dict(super()._load_index())
        except FileNotFoundError:
            return {}
        except OSError as fault:
            _say_once("damage", f"{fault}: compiled anew")
            return {}

    def _load_data(self, name: str) -> Any:
        self._check(self._data_path(name))
        return super()._load_data(name)

    def _dump(self, content: Any) -> bytes:
        target = io.BytesIO()
        _ByName(target, protocol=4).dump(content)
        return target.getvalue()

    def save(self, key: Any, data: Any) -> None:
        super().save(key, (self._source_stamp, key, data))

    def load(self, key: Any) -> Any:
        name = self._load_index().get(key)
        if name is None:
            return None
        # The index is written before the data: those of a process that was ended in between are of another time.
        stamp, its_key, data = self._load_data(name)
        return data if (stamp, its_key) == (self._source_stamp, key) else None


def _laws_of(function: Callable[..., Any], signature: Any) -> set[Any]:
    """Return the classes of NamedTuples that a function is compiled for, and the sources of readers that it calls."""
    found: set[Any] = set()
    left: list[Any] = [*signature, *(cell.cell_contents for cell in function.__closure__ or ())]
    seen: set[int] = set()
    while left:
        part: Any = left.pop()
        if id(part) in seen:
            continue
        seen.add(id(part))
        if isinstance(part, types.BaseTuple):
            left.extend(part)  # type: ignore[arg-type]
            left.append(getattr(part, "instance_class", None))
        elif isinstance(part, Dispatcher):
            left.extend((*getattr(part, "laws", ()), getattr(part, "source", None)))
            left.extend(cell.cell_contents for cell in part.py_func.__closure__ or ())
        elif isinstance(part, type | str):
            found.add(part)
    return found


def _is_kept(function: Callable[..., Any], signature: Any) -> bool:
    """Whether another process can find the laws of a function by name and file: not those of a session."""
    laws = (law for law in _laws_of(function, signature) if isinstance(law, type))
    return all("<locals>" not in law.__qualname__ and Path(_file_of(law)).is_file() for law in laws)


def _file_of(law: type) -> str:
    try:
        return inspect.getfile(law)
    except (OSError, TypeError):  # a session's
        return ""


@functools.cache
def _identity(law: Any) -> str:
    if isinstance(law, str):
        return law
    digest = _digest_of_own(Path(inspect.getfile(law))).hex()
    return f"{law.__module__}.{law.__qualname__} {digest}"


class _Cache(FunctionCache):
    """numba's cache of one function; a fault costs a compilation and a line on standard error."""

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._cache_file = _CheckedFiles(
            # Not the name numba would choose: what it wrote has no digest.
            cache_path=self._cache_path,
            filename_base=f"{self._impl.filename_base}.checked",
            source_stamp=(_SOURCES, _digest_of_own(Path(inspect.getfile(py_func)))),
        )
        self._function, self._name = py_func, f"{py_func.__module__}.{py_func.__qualname__}"

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        function = self._function
        code = hashlib.sha256(function.__code__.co_code).hexdigest()
        laws = tuple(sorted(_identity(law) for law in _laws_of(function, sig)))
        return f"{self._name} {code} {sig}", codegen.magic_tuple(), laws

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        if not _is_kept(self._function, sig):
            return None
        try:
            return super().load_overload(sig, target_context)
        except FileNotFoundError:
            return None
        except Exception as fault:  # what unpickling raises is not to be foreseen
            _say_once("damage", f"{fault}: compiled anew")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        if not _is_kept(self._function, data.signature.args):
            return
        try:
            super().save_overload(sig, data)
        except Exception as fault:  # a full disk, a folder that is gone
            _say_once("unsaved", f"compiled code cannot be kept in {self._cache_path!r}: {fault}")


class _Inner(CPUDispatcher):
    """A function without a wrapper for Python's calls: those are run by the interpreter, which gives the same bits."""

    def add_overload(self, cres: Any) -> None:
        self.overloads[tuple(cres.signature.args)] = cres  # and not in the table of what Python can call

    def _compile_for_args(self, *arguments: Any, **named: Any) -> Any:
        return self.py_func  # numba calls it


# Results for Python ---------------------------------------------------------------------------------------------------


def _box_named_tuple(kind: Any, value: Any, context: Any) -> Any:
    """Give Python a NamedTuple by C code alone: numba runs Python's code for it, in which Ctrl-C is a crash."""
    if context.env_manager is None:
        return boxing.box_namedtuple(kind, value, context)
    api, constants = context.pyapi, context.env_manager
    new, of_class = (constants.read_const(constants.add_const(part)) for part in (tuple.__new__, kind.instance_class))
    parts = boxing.box_tuple(kind, value, context)
    named = api.call_function_objargs(new, (of_class, parts))
    api.decref(parts)
    return named


_boxers.functions.update(dict.fromkeys((types.NamedTuple, types.NamedUniTuple), _box_named_tuple))

# Options for numba ----------------------------------------------------------------------------------------------------

_SECONDS_PER_BYTE = 0.0003  # of bytecode, on a core of 2020
_PATIENCE = 3.0  # seconds: what takes less is not worth a line
_functions: set[Callable[..., Any]] = set()  # that have one of the decorators below


def _name_by_process(*functions: Callable[..., Any]) -> None:
    """Make the names of functions unique to this process.

    numba finds the constants of compiled code (the class or the array type that it returns) by qualified name and a
    count in the process that compiled it. Code of two processes could agree in both, and take the other's constants.
    """
    for function in functions:
        function.__qualname__ = f"{function.__qualname__.partition('@')[0]}@{_process}"


def _after_fork() -> None:
    global _process  # noqa: PLW0603
    _process = os.urandom(4).hex()
    _name_by_process(*_functions)


_process = os.urandom(4).hex()
if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_after_fork)


class _Announcer(event.Listener):
    """Say on standard error when one of our functions is compiled, and not loaded, and how long that takes."""

    def __init__(self) -> None:
        self.depth = 0  # numba compiles what a function calls within the function's own compilation

    def on_start(self, event: Any) -> None:
        dispatcher = event.data["dispatcher"]
        function = getattr(dispatcher, "py_func", None)
        if self.depth == 0 and function in _functions:
            folder = dispatcher.stats.cache_path
            if folder is None:
                _say_once("no folder", NO_FOLDER)
            plants = [part for part in event.data["args"] if isinstance(part, types.BaseNamedTuple)]
            codes = _bytecode_to_compile(dispatcher, plants[:1])
            seconds = _SECONDS_PER_BYTE * sum(len(code) for code in codes)
            if seconds >= _PATIENCE:
                _say(f"compiling {function.__name__}, about {seconds:.0f} s ({'once' if folder else 'not kept'}) ...")
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1


def _bytecode_to_compile(dispatcher: Any, plants: list[Any]) -> Iterator[bytes]:
    """Yield the bytecode of a function and of those it calls that have no code for this type of plant yet."""
    left, seen = [dispatcher.py_func], {dispatcher.py_func}
    while left:
        function: Any = left.pop()
        yield function.__code__.co_code
        cells = (cell.cell_contents for cell in function.__closure__ or ())
        for callee in (*cells, *(function.__globals__.get(name) for name in function.__code__.co_names)):
            if not isinstance(callee, Dispatcher) or callee.py_func in seen:
                continue
            signatures = list(callee.overloads)
            takes_plant = any(isinstance(part, types.BaseNamedTuple) for args in signatures for part in args)
            if any(plants[0] in args for args in signatures) if takes_plant and plants else signatures:
                continue
            seen.add(callee.py_func)
            left.append(callee.py_func)


def _decorator(*, cached: bool = True, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    numba_options: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True, **options}
    jit: Any = numba.njit(**numba_options)

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = jit(function)
        if isinstance(dispatcher, Dispatcher):  # not with NUMBA_DISABLE_JIT
            _functions.add(function)
            if options.get("no_cpython_wrapper"):
                dispatcher.__class__ = _Inner
            with contextlib.suppress(Exception):  # no folder can be written: compiled in every process
                if cached:
                    dispatcher._cache = _Cache(function)  # type: ignore[attr-defined]
            _name_by_process(function)
        return dispatcher

    return decorate


def reader(function: Callable[..., Any], source: str, laws: list[type], leaves: int) -> Any:
    """Compile the function that reads a plant of these laws from so many numbers."""
    read = _decorator(cached=False, forceinline=True, no_cpython_wrapper=True)(function)
    read.source = source
    read.laws = laws
    read.leaves = leaves
    return read


# What Python calls has a wrapper that takes Python's objects; without one, compiling takes two thirds of the time.
entry = _decorator()
compiled = _decorator(no_cpython_wrapper=True)
in_threads = _decorator(parallel=True)
# For what stands in a loop over lanes: only without a call left in it does such a loop become vector instructions.
in_lanes = _decorator(forceinline=True, no_cpython_wrapper=True)
uncached_in_lanes = _decorator(cached=False, forceinline=True, no_cpython_wrapper=True)

event.register("numba:compile", _Announcer())
