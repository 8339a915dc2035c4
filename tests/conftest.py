"""What several files of tests share: the kernel without its compiler, and PyTorch on one core."""

import os
import signal

# Each process of xdist has a core: threads beside it would wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from sd_friction_env.kernel import batch

# A shell starts what it runs in the background with Ctrl-C ignored, and the programs that tests interrupt inherit it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(params=["interpreted", pytest.param("compiled", marks=pytest.mark.slow)])
def either_way(request, monkeypatch):
    """Run the kernel by the interpreter, but for what is compiled already: the same bits, and no 15 s for each plant.

    As compiled code, it does not warn of an overflow. The slow tests run it compiled. That both are the same is tested
    for each law in ``kernel/test_laws.py``.
    """
    if request.param == "interpreted":
        monkeypatch.setattr(Dispatcher, "_compile_for_args", lambda dispatcher, *_, **__: dispatcher.py_func)
        monkeypatch.setattr(batch, "without_refcount", lambda array: array, raising=False)
    with np.errstate(all="ignore" if request.param == "interpreted" else None):
        yield request.param
