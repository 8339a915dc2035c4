"""Arrays in one: the memory of an environment on its own, and the work space of a batch."""

from typing import Any, NamedTuple

import numba
import numba.extending
import numpy as np

from sd_friction_env.kernel.compilation import entry, in_lanes
from sd_friction_env.kernel.rows import *


class Memory(NamedTuple):
    """The arrays that lie in the flat memory of one environment, as a batch of one has them.

    One environment on its own keeps its arrays in a single one, for each that is handed over costs a call more time.
    """

    task: Any
    codes: Any
    counts: Any  # (COUNT_ROWS, 1)
    state: Any  # (STATE_PLANT, 1)
    lane: Any  # a lane with a stride of 1
    past: Any  # (delay + 1 or 0, 2, 1)
    shown: Any  # (1, p)
    plant: Any  # its leaves, and more
    tables: Any


@entry
def memory_size(sensor_delay, shows):
    """Return how many numbers the memory of an environment has without its plant."""
    kept = sensor_delay + 1 if sensor_delay > 0 else 0
    return TASK_NUMBERS + TASK_CODES + COUNT_ROWS + STATE_PLANT + LANE_PLANT + 2 * kept + shows


@in_lanes
def arrays_in(memory, leaves):
    """Return the arrays in the memory of an environment whose plant has so many leaves."""
    first = TASK_NUMBERS + TASK_CODES
    codes = memory[TASK_NUMBERS:first].view(np.int64)
    counts = memory[first : first + COUNT_ROWS].view(np.int64).reshape((COUNT_ROWS, 1))
    first += COUNT_ROWS
    state = memory[first : first + STATE_PLANT].reshape((STATE_PLANT, 1))
    first += STATE_PLANT
    lane = memory[first : first + LANE_PLANT]
    first += LANE_PLANT
    kept = codes[TASK_SENSOR_DELAY] + 1 if codes[TASK_SENSOR_DELAY] > 0 else 0
    past = memory[first : first + 2 * kept].reshape((kept, 2, 1))
    first += 2 * kept
    shown = memory[first : first + codes[TASK_SHOWS]].reshape((1, codes[TASK_SHOWS]))
    first += codes[TASK_SHOWS]
    plant = memory[first:]
    return Memory(memory[:TASK_NUMBERS], codes, counts, state, lane, past, shown, plant, plant[leaves:])


if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]

    def without_refcount(array):
        """Return the array."""
        return array

else:

    @numba.extending.intrinsic
    def without_refcount(context, array):
        """Return the array without its count of references, which all threads would have to write to at every slice."""

        def generate(context, builder, signature, arguments):
            bare = context.make_array(array)(context, builder, arguments[0])
            bare.meminfo = bare.meminfo.type(None)
            bare.parent = bare.parent.type(None)
            return bare._getvalue()

        return array(array), generate


@entry
def fill_plant(work, state):
    """Put one environment's plant and belt speed, from its column of the state, into all lanes of both work spaces."""
    half = len(work) // 2
    for i in range(STRIDE):
        work[LANE_BELT_SPEED * STRIDE + i] = state[STATE_BELT_SPEED]
        work[half + LANE_BELT_SPEED * STRIDE + i] = state[STATE_BELT_SPEED]
        for leaf in range(half // STRIDE - LANE_PLANT):
            work[(LANE_PLANT + leaf) * STRIDE + i] = state[STATE_PLANT + leaf]
            work[half + (LANE_PLANT + leaf) * STRIDE + i] = state[STATE_PLANT + leaf]
