"""Episodes of a batch: the kernel's arrays with one column per environment, their starts and their steps."""

import functools
import multiprocessing
import os
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.info import Buffers
from sd_friction_env.environments.plants import Plants
from sd_friction_env.environments.states import EnvState, read_state, write_state
from sd_friction_env.environments.task import PHASE_SLOT, FloatArray, IntegerArray, Task, passive_motion
from sd_friction_env.physics.orbits import rest_place
from sd_friction_env.physics.parameters import Kind, OscillatorParameters

_ENVS_WORTH_A_THREAD = 512


def _has_threads() -> bool:
    """Return whether numba's threads have been started, by this package or by any other user of numba."""
    try:
        numba.threading_layer()  # type: ignore[attr-defined]
    except ValueError:
        return False
    return True


# Threads do not survive a fork, and most of numba's threading layers abort a forked process that uses them. A process
# that may have been forked after they started never uses them.
_threads_are_lost = multiprocessing.parent_process() is not None and _has_threads()


def _note_fork() -> None:
    global _threads_are_lost  # noqa: PLW0603
    _threads_are_lost = _threads_are_lost or _has_threads()


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_note_fork)


class Draft(NamedTuple):
    """Episodes to be started, one column each."""

    which: IntegerArray  # their environments
    keys: IntegerArray
    episodes: IntegerArray
    numbers: FloatArray  # parameters, see Plants
    laws: IntegerArray
    x: FloatArray  # states of those that are placed; the others start as the task says
    v: FloatArray
    placed: NDArray[np.bool_]


class Starts(NamedTuple):
    """Episodes ready to begin; the batch has not been changed yet."""

    draft: Draft
    kinds: list[tuple[Kind, IntegerArray]]  # kinds of plant, each with its columns
    state: FloatArray  # columns of the kernel's arrays
    counts: IntegerArray
    own: NDArray[np.bool_]  # which have other parameters than the nominal ones


class _Group(NamedTuple):
    """Environments whose plants are of one kind."""

    kind: Kind
    which: IntegerArray
    steppers: kernel.Steppers
    tables: FloatArray


class Episodes:
    """Running episodes of a batch.

    Attributes:
        observations: (num_envs, size), float32, of the last step or reset.
        counts: whole numbers of the episodes, rows as in :mod:`sd_friction_env.kernel.rows`.
    """

    def __init__(self, nominal: OscillatorParameters, task: Task, num_envs: int, threads: int) -> None:
        n = self.num_envs = num_envs
        self._task = task
        self._plants = Plants(nominal, task)
        self._task_numbers, self._task_codes = task.arrays()
        # Rows of an odd number of cache lines: rows of a power of two would compete for few places of the cache.
        self.width = n if n < kernel.LANES else 8 * (2 * (n // 16) + 3)
        self.state = np.zeros((kernel.STATE_PLANT, self.width))
        self.state[kernel.STATE_BELT] = nominal.belt_speed
        self.counts = np.zeros((kernel.COUNT_ROWS, self.width), np.int64)
        self._numbers = np.repeat(self._plants.nominal_column, n, axis=1)
        self._laws = np.zeros(n, np.int64)
        self._past = np.zeros((task.sensor_delay + 1 if task.sensor_delay else 0, 2, n))
        self._shown = np.zeros((n, len(task.shown)))
        self._own = np.zeros(n, np.bool_)  # which have other parameters than the nominal ones
        self._drift_ends = np.zeros((len(task.drift), n))
        self.observations = np.zeros((n, task.observation_size), np.float32)
        # Each thread steps a share; all shares but the last are made of whole blocks.
        shares = max(1, min(threads, n // _ENVS_WORTH_A_THREAD))
        blocks = -(-n // kernel.LANES)
        self._bounds = np.minimum(kernel.LANES * (np.arange(shares + 1) * blocks // shares), n)
        self._ended = np.zeros(shares, np.int64)
        self._kinds = [(task.kind_of(nominal), np.arange(n))]
        self._form_groups()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_arrays", "_groups", "_works")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._form_groups()  # compiled code is not copied

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that hold the state of all episodes, not copies, by name."""
        return {name: value for name, value in self.__getstate__().items() if isinstance(value, np.ndarray)}

    # Groups of one kind -----------------------------------------------------------------------------------------------

    def _form_groups(self) -> None:
        """Find the compiled code of each kind of plant."""
        self._groups = [self._group(*kind) for kind in self._kinds]
        rows = kernel.STATE_PLANT + max(group.steppers.leaves for group in self._groups)
        if len(self.state) < rows:
            self.state = np.concatenate((self.state, np.zeros((rows - len(self.state), self.width))))
        self._arrays = (self._task_numbers, self._task_codes, self.state, self.counts, self._past, self._shown)
        self._works = np.ones((len(self._ended), self._groups[0].steppers.work_size))
        self._task_codes[kernel.TASK_ONE_PLANT] = False

    def _group(self, kind: Kind, which: IntegerArray) -> _Group:
        plant = self._plants.example(kind)
        return _Group(kind, which, kernel.steppers(plant), kernel.tables_of(plant))

    def _in_groups(self, which: IntegerArray) -> list[tuple[_Group, IntegerArray]]:
        """Return the groups of environments, each with those of ``which`` in it."""
        if len(self._groups) == 1:
            return [(self._groups[0], which)]
        parts = [(group, which[np.isin(which, group.which)]) for group in self._groups]
        return [(group, members) for group, members in parts if len(members)]

    # Starts -----------------------------------------------------------------------------------------------------------

    def draft(self, which: IntegerArray, keys: IntegerArray, episodes: IntegerArray) -> Draft:
        """Return episodes with drawn parameters that start as the task says."""
        n = len(which)
        numbers, laws = self._plants.draw(keys, episodes), np.zeros(n, np.int64)
        return Draft(which, keys, episodes, numbers, laws, np.zeros(n), np.zeros(n), np.zeros(n, np.bool_))

    def next_keys(self, which: IntegerArray) -> tuple[IntegerArray, IntegerArray]:
        """Return the keys and numbers of the next episodes of environments."""
        return self.counts[kernel.COUNT_KEY, which], self.counts[kernel.COUNT_EPISODE, which] + 1

    def drafted(self, draft: Draft, place: int) -> OscillatorParameters:
        """Return the parameters of one episode of a draft."""
        return self._plants.parameters_of(draft.numbers[:, place], int(draft.laws[place]))

    def put(self, draft: Draft, place: int, parameters: OscillatorParameters) -> None:
        """Give one episode of a draft its parameters."""
        draft.numbers[:, place], draft.laws[place] = self._plants.column_of(parameters)

    def prepare(self, draft: Draft) -> Starts:
        """Return episodes ready to begin. What can fail at a start fails here, before the batch is changed."""
        numbers, laws = draft.numbers, draft.laws
        kinds = self._plants.kinds_of(numbers, laws)
        leaves = list(self._plants.leaves(kinds, numbers, laws))
        state = np.zeros((kernel.STATE_PLANT + 1 + max(row for row, _, _ in leaves), len(draft.which)))
        for row, columns, values in leaves:
            state[kernel.STATE_PLANT + row, columns] = values
        state[kernel.STATE_BELT_SPEED] = self._plants.by_name(numbers)["belt_speed"]
        state[kernel.STATE_X], state[kernel.STATE_V] = draft.x, draft.v
        counts = np.zeros((kernel.COUNT_ROWS, len(draft.which)), np.int64)
        counts[kernel.COUNT_KEY], counts[kernel.COUNT_EPISODE] = draft.keys, draft.episodes
        kernel.blank_episodes(state, counts, np.arange(len(draft.which)))
        own = (laws != 0) | (numbers != self._plants.nominal_column).any(axis=0) | bool(self._task.drift)
        starts = Starts(draft, kinds, state, counts, own)
        self._place(starts)
        return starts

    def _place(self, starts: Starts) -> None:
        """Set the states of the episodes that start as the task says."""
        task, (draft, kinds, state, counts, own) = self._task, starts
        if task.start == "random":
            columns = np.flatnonzero(~draft.placed)
            x, v = task.random_states(draft.keys[columns], draft.episodes[columns])
            state[kernel.STATE_X, columns], state[kernel.STATE_V, columns] = x, v
            return
        left = []
        for kind, columns in kinds:
            group = self._group(kind, columns)
            columns = columns[~draft.placed[columns]]
            nominal, others = columns[~own[columns]], columns[own[columns]]
            if len(nominal):
                group.steppers.place_on_cycle(state, counts, nominal, *self._nominal_start, group.tables)
            if task.start == "cycle" and len(others):
                phases = task.phases(draft.keys[others], draft.episodes[others])
                others = others[group.steppers.own_cycle_starts(state, counts, others, phases, group.tables) == 1]
            left += others.tolist()
        for j in left:
            place = task.start_state(self.drafted(draft, j), int(draft.keys[j]), int(draft.episodes[j]))
            state[kernel.STATE_X, j], state[kernel.STATE_V, j] = place

    @functools.cached_property
    def _nominal_start(self) -> tuple[FloatArray, float, int]:
        """Starts with the nominal parameters that are not random: points of the passive motion, its period (0 for a
        single state) and the slot of the random phase."""
        task, nominal = self._task, self._plants.nominal
        cycle = passive_motion(nominal)
        if task.start == "cycle" and cycle is not None and cycle.period > 0.0:
            return cycle.points, cycle.period, PHASE_SLOT
        place = (rest_place(nominal), 0.0) if task.start == "rest" else task.cycle_state(nominal, 0.0)
        return np.array([place] * kernel.CYCLE_POINTS), 0.0, PHASE_SLOT

    def begin(self, starts: Starts) -> None:
        """Start episodes; they are not observed yet."""
        draft, kinds = starts.draft, starts.kinds
        which, n = draft.which, self.num_envs
        here = slice(n) if len(which) == n else which  # a slice is copied faster
        self._numbers[:, here] = draft.numbers
        self._laws[here] = draft.laws
        if len(which) < n:
            kinds = self._plants.kinds_of(self._numbers, self._laws)
        same = [kind for kind, _ in kinds] == [kind for kind, _ in self._kinds]
        self._kinds = kinds
        if same:
            pairs = zip(self._groups, kinds, strict=True)
            self._groups = [group._replace(which=members) for group, (_, members) in pairs]
        else:
            self._form_groups()
        self.state[: len(starts.state), here] = starts.state
        self.counts[:, here] = starts.counts
        self._own[here] = starts.own
        for row, ends in zip(self._drift_ends, self._task.drift_ends(draft.keys, draft.episodes).values(), strict=True):
            row[here] = ends
        one_plant = not self._own.any()
        if one_plant and not self._task_codes[kernel.TASK_ONE_PLANT]:
            for work in self._works:
                kernel.fill_plant(work, self.state[:, which[0]])
        self._task_codes[kernel.TASK_ONE_PLANT] = one_plant
        if self._task.show_parameters:
            self._shown[which] = self._task.shown_parameters(self._plants.by_name(draft.numbers)).T

    def next_starts(self, which: IntegerArray) -> Starts | None:
        """Return the next episodes of environments; None if compiled code alone can begin them."""
        if self._task.start != "random" and not self._task.randomise and not self._own[which].any():
            _ = self._nominal_start  # computed here, where it may fail
            return None
        return self.prepare(self.draft(which, *self.next_keys(which)))

    def restart(self, which: IntegerArray, starts: Starts | None) -> None:
        """Start the next episodes of environments, as :meth:`next_starts` returned them, and observe them."""
        if starts is not None:
            self.begin(starts)
            self.observe(which)
            return
        for group, members in self._in_groups(which):
            group.steppers.restart(*self._arrays, group.tables, self.observations, members, *self._nominal_start)

    def observe(self, which: IntegerArray) -> None:
        """Write what environments observe into ``observations``."""
        for group, members in self._in_groups(which):
            group.steppers.observe(*self._arrays, group.tables, self.observations, members)

    def start_info(self, which: IntegerArray) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
        """Return what info reports of environments (k,) that have been reset, and their parameters, each (k,)."""
        mode, (v_belt, v_rel, normal_force) = np.empty(len(which), np.int64), np.empty((3, len(which)))
        for group, members in self._in_groups(which):
            here = np.searchsorted(which, members) if len(members) < len(which) else slice(None)
            parts = [np.empty(len(members), out.dtype) for out in (mode, v_belt, v_rel, normal_force)]
            group.steppers.contact(self.state, self.counts, members, *parts, group.tables)
            mode[here], v_belt[here], v_rel[here], normal_force[here] = parts
        start = {
            "x": self.state[kernel.STATE_X, which],
            "v": self.state[kernel.STATE_V, which],
            "v_belt": v_belt,
            "v_rel": v_rel,
            "mode": mode,
            "normal_force": normal_force,
            "time": np.zeros(len(which)),
        }
        return start, self._plants.info(self._numbers[:, which], self._laws[which])

    # States -----------------------------------------------------------------------------------------------------------

    def read(self, i: int) -> EnvState:
        """Return the state of an environment."""
        parameters = self._plants.parameters_of(self._numbers[:, i], int(self._laws[i]))
        return read_state(parameters, self.state, self.counts, self._past, i)

    def write(self, which: IntegerArray, states: Any) -> None:
        """Put (checked) states into environments."""
        draft = self.draft(which, *np.array([(saved.key, saved.episode) for saved in states]).T)
        draft.placed[:] = True
        for place, saved in enumerate(states):
            self.put(draft, place, saved.parameters)
        self.begin(self.prepare(draft))
        for i, saved in zip(which.tolist(), states, strict=True):
            write_state(saved, self.state, self.counts, self._past, i)

    # Steps ------------------------------------------------------------------------------------------------------------

    def advance(self, actions: FloatArray, rows: IntegerArray, out: Buffers) -> int:
        """Step all environments with actions (num_envs,) and report ``rows``; return how many episodes ended."""
        if self._task.drift:
            steps = self.counts[kernel.COUNT_STEPS, : self.num_envs]
            numbers = self._plants.drift(self._numbers, self._drift_ends, steps)
            for row, columns, values in self._plants.leaves(self._kinds, numbers, self._laws):
                self.state[kernel.STATE_PLANT + row, columns] = values
        if len(self._groups) > 1:
            return sum(self._advance_group(group, actions, rows, out) for group in self._groups)
        group = self._groups[0]
        arguments = (*self._arrays, group.tables, actions, rows, self.observations, *out)
        if len(self._works) == 1 or _threads_are_lost:
            ended: int = group.steppers.step_many(self._works[0], 0, self.num_envs, *arguments)
            return ended
        group.steppers.step_in_threads(self._works, self._bounds, self._ended, *arguments)
        return int(self._ended.sum())

    def _advance_group(self, group: _Group, actions: FloatArray, rows: IntegerArray, out: Buffers) -> int:
        """Step the environments of one group of several: gather their columns, step them, scatter them back."""
        own, task = group.which, (self._task_numbers, self._task_codes)
        columns = (self.state, self.counts, self._past, out.over, out.report, out.codes)
        state, counts, past, over, report, codes = gathered = [
            np.ascontiguousarray(array[..., own]) for array in columns
        ]
        observations, rewards = self.observations[own], out.rewards[own]
        inputs = (*task, state, counts, past, self._shown[own], group.tables, actions[own], rows)
        outputs = (observations, rewards, over, report, codes)
        work = np.ones(group.steppers.work_size)
        ended: int = group.steppers.step_many(work, 0, len(own), *inputs, *outputs)
        for array, part in zip(columns, gathered, strict=True):
            array[..., own] = part
        self.observations[own], out.rewards[own] = observations, rewards
        return ended
