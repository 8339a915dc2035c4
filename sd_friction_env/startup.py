"""What a user is told while compiled code is built for the first time."""

import contextlib
import sys
import threading
from collections.abc import Iterator

_PATIENCE = 1.0  # seconds; loading from the cache takes less


@contextlib.contextmanager
def announced(message: str) -> Iterator[None]:
    """Print ``message`` to standard error if the block takes longer than a load from the cache would."""

    def tell() -> None:
        print(f"sd_friction_env: {message} ...", file=sys.stderr, flush=True)

    timer = threading.Timer(_PATIENCE, tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
