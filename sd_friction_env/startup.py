"""What a user is told while compiled code is built for the first time."""

import contextlib
import sys
import threading
from collections.abc import Iterator

_PATIENCE = 1.0  # seconds; loading from the cache takes less
_MESSAGE = "sd_friction_env: compiling the oscillator's kernel (once; the result is cached) ..."

_compiled: set[str] = set()


@contextlib.contextmanager
def announced(part: str) -> Iterator[None]:
    """Say on standard error what is going on if the block, which may compile, takes longer than a load from the cache.

    ``part`` names what is compiled: after its first time a block of that name is left alone.
    """
    if part in _compiled:
        yield
        return
    timer = threading.Timer(_PATIENCE, print, [_MESSAGE], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
    _compiled.add(part)
