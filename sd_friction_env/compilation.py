"""How the kernel's functions are compiled and where the result is kept: decorators, and a cache that checks its files.

numba's on-disk cache trusts its files: a damaged one is a traceback at every start, a crash or a wrong number, and of
two processes that compile at once one can overwrite the other's code under a name that both then read. Where no folder
can be written, it refuses to define a function at all. Here every file ends with a digest and every entry names the
source and the signature it was compiled from; what does not fit is compiled anew. No fault of the cache raises.
"""

import contextlib
import hashlib
import io
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

NO_FOLDER = "compiled code cannot be kept, no folder for it can be written: set NUMBA_CACHE_DIR to one that can"
_OWN_SOURCE = hashlib.sha256(Path(__file__).read_bytes()).digest()  # the options below change the code too
_said: set[str] = set()


def _say(text: str) -> None:
    print(f"sd_friction_env: {text}", file=sys.stderr, flush=True)


def _say_once(kind: str, text: str) -> None:
    """Print a line on standard error, one in a process for each kind."""
    if kind not in _said:
        _said.add(kind)
        _say(text)


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

    def save(self, key: Any, data: Any) -> None:
        super().save(key, (self._source_stamp, key, data))

    def load(self, key: Any) -> Any:
        name = self._load_index().get(key)
        if name is None:
            return None
        # The index is written before the data: those of a process that was ended in between are of another time.
        stamp, its_key, data = self._load_data(name)
        return data if (stamp, its_key) == (self._source_stamp, key) else None


class _Cache(FunctionCache):
    """numba's cache of one function; a fault costs a compilation and a line on standard error."""

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._cache_file = _CheckedFiles(
            # Not the name numba would choose: what it wrote has no digest.
            cache_path=self._cache_path,
            filename_base=f"{self._impl.filename_base}.checked",
            source_stamp=(self._impl.locator.get_source_stamp(), _OWN_SOURCE),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except FileNotFoundError:
            return None
        except Exception as fault:  # what unpickling raises is not to be foreseen
            _say_once("damage", f"{fault}: compiled anew")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except Exception as fault:  # a full disk, a folder that is gone
            _say_once("unsaved", f"compiled code cannot be kept in {self._cache_path!r}: {fault}")


# Options for numba ----------------------------------------------------------------------------------------------------

_SECONDS_PER_BYTE = 0.0005  # of bytecode, on a core of 2020
_PATIENCE = 3.0  # seconds: what takes less is not worth a line
_functions: set[Callable[..., Any]] = set()  # that have one of the decorators below


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
            seconds = _SECONDS_PER_BYTE * sum(len(code) for code in _bytecode_to_compile(dispatcher))
            if seconds >= _PATIENCE:
                _say(f"compiling {function.__name__}, about {seconds:.0f} s ({'once' if folder else 'not kept'}) ...")
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1


def _bytecode_to_compile(dispatcher: Any) -> Iterator[bytes]:
    """Yield the bytecode of a function and of those it calls that have, by their number, no code for such types yet."""
    function = dispatcher.py_func
    left, seen, known = [function], {function}, len(dispatcher.overloads)
    while left:
        function = left.pop()
        code: Any = function.__code__
        yield code.co_code
        for name in code.co_names:
            callee = function.__globals__.get(name)
            if isinstance(callee, Dispatcher) and len(callee.overloads) <= known and callee.py_func not in seen:
                seen.add(callee.py_func)
                left.append(callee.py_func)


def _decorator(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    jit = numba.njit(error_model="numpy", nogil=True, **options)

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = jit(function)
        if isinstance(dispatcher, Dispatcher):  # not with NUMBA_DISABLE_JIT
            _functions.add(function)
            with contextlib.suppress(Exception):  # no folder can be written: compiled in every process
                dispatcher._cache = _Cache(function)  # type: ignore[attr-defined]
        return dispatcher

    return decorate


compiled = _decorator()
in_threads = _decorator(parallel=True)
# For what stands in a loop over lanes: only without a call left in it does such a loop become vector instructions.
in_lanes = _decorator(forceinline=True)

event.register("numba:compile", _Announcer())
