"""Imports that need an extra of the installation: what is missing is named with the line that installs it."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Import within this block what comes with an extra.

    Raises:
        ModuleNotFoundError: names the missing module and the line that installs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("sd_friction_env"):
            raise
        text = f'{error.name.partition(".")[0]} is not installed: pip install "sd-friction-env[{name}]"'
        raise ModuleNotFoundError(text, name=error.name) from None
