"""Many friction oscillators at once as a Gymnasium vector environment, stepped without Python in between."""

import copy as copying
import functools
import inspect
import multiprocessing
import operator
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numba
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.single import (
    EPISODE_STATISTICS,
    PLAIN_STATISTICS,
    EnvState,
    KnowsItsLength,
    RewardFunction,
    SDFrictionEnv,
    check_belt,
    checked_options,
    checked_state,
    named_statistics,
    place_of,
    read_state,
    real_array,
    start_of,
    task_arrays,
    without_axes,
    write_state,
)
from sd_friction_env.environments.task import EPISODE_STEPS, PHASE_SLOT, FloatArray, IntegerArray, passive_motion
from sd_friction_env.physics.orbits import rest_place
from sd_friction_env.physics.parameters import (
    EXCITATIONS,
    FRICTIONS,
    GEOMETRIES,
    RANGES,
    Kind,
    OscillatorParameters,
    brief_repr,
    checked_choice,
    checked_count,
    plant_of,
)

_MOST_ENVS = 2**24
_MOST_THREADS = 256
_ENVS_WORTH_A_THREAD = 512
_MOST_RENDERED = 16

REWARD_TERMS = ("reward_vibration", "reward_effort", "reward_stick", "reward_contact_loss")
_REPORT = {
    "x": kernel.LANE_X_END,
    "v": kernel.LANE_V_END,
    "v_belt": kernel.LANE_BELT_END,
    "v_rel": kernel.LANE_V_REL,
    "normal_force": kernel.LANE_NORMAL,
    "time": kernel.LANE_TIME,
    "action": kernel.LANE_ACTION,
    "force": kernel.LANE_U,
    "belt_acceleration": kernel.LANE_A_BELT,
    "x_min": kernel.LANE_X_MIN,
    "x_max": kernel.LANE_X_MAX,
    "mean_square_velocity": kernel.LANE_MEAN_V2,
    "stick_fraction": kernel.LANE_STICK_FRACTION,
    "friction_power": kernel.LANE_FRICTION_POWER,
    "control_power": kernel.LANE_CONTROL_POWER,
    "reward_vibration": kernel.LANE_VIBRATION,
    "reward_effort": kernel.LANE_EFFORT,
    "reward_stick": kernel.LANE_STICK,
    "reward_contact_loss": kernel.LANE_CONTACT_LOSS,
}
_CODES = {"mode": 0, "events": 1}
_STEP_KEYS = (*_REPORT, *_CODES, "status")
RESET_KEYS = ("x", "v", "v_belt", "v_rel", "mode", "normal_force", "time")
INFO_KEYS = (*_STEP_KEYS, "parameters")
_AMPLITUDES = tuple(f"{means}_amplitude" for means in EXCITATIONS)
_STATE_METHODS = ("reset", "set_state", "step")  # of the single environment


class _Buffers(NamedTuple):
    """What a step hands out."""

    rewards: FloatArray
    over: NDArray[np.bool_]
    report: FloatArray
    codes: IntegerArray


class _Starts(NamedTuple):
    """Episodes of environments that are ready to begin; nothing of the batch has been changed yet."""

    which: IntegerArray
    numbers: FloatArray  # rows: the batch's names, columns as in which
    laws: IntegerArray  # (k,), places in the batch's list of laws
    kinds: list[tuple[Kind, IntegerArray]]  # each kind of plant, and its columns
    state: FloatArray  # columns of the kernel's arrays
    counts: IntegerArray
    own: NDArray[np.bool_]  # who has other parameters than the nominal ones


class _Group(NamedTuple):
    """Environments whose plants are of one kind."""

    kind: Kind
    which: IntegerArray
    steppers: kernel.Steppers
    tables: FloatArray


class FinalObservations(np.ndarray[Any, np.dtype[Any]]):
    """Last observations of episodes, as Gymnasium's vector environments have them: an array (num_envs,) of arrays, None
    where no episode has ended. Other libraries take it as a tensor (num_envs, size), 0 where it has None."""

    def __dlpack__(self, **kwargs: Any) -> Any:
        rows = [row for row in self if row is not None] if self.dtype == object else []
        if not rows:
            return super().__dlpack__(**kwargs)
        whole = np.zeros((len(self), *rows[0].shape), rows[0].dtype)
        whole[[row is not None for row in self]] = rows
        return whole.__dlpack__(**kwargs)


def _has_threads() -> bool:
    """Return whether numba's threads have been started, by this package or by any other user of numba."""
    try:
        numba.threading_layer()  # type: ignore[attr-defined]
    except ValueError:
        return False
    return True


# Threads do not survive a fork, and most of numba's threading layers end a forked process that uses them. Where they
# may have been started before the fork, this process never uses them.
_threads_are_lost = multiprocessing.parent_process() is not None and _has_threads()


def _note_fork() -> None:
    global _threads_are_lost  # noqa: PLW0603
    _threads_are_lost = _threads_are_lost or _has_threads()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_note_fork)


class SDFrictionVectorEnv(KnowsItsLength, VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """
    ## Description

    ``num_envs`` environments of the kind :class:`SDFrictionEnv` describes, stepped together: ``gym.make_vec(id,
    num_envs=...)``. Environment i does bit for bit what the single environment does that is reset with the same seed,
    whatever ``num_envs``, its place in the batch and the number of threads.

    ## Action Space, Observation Space, Rewards, Starting State, Episode End

    As of :class:`SDFrictionEnv`, with a leading axis of length ``num_envs``.

    ## Seeds

    ``reset(seed=7)`` seeds environment i with 7 + i, ``reset(seed=[...])`` with what the list says (None: not at
    all).

    ## Options

    Those of :class:`SDFrictionEnv`; each value may also be an array (num_envs,), one entry per environment, and
    ``parameters`` a mapping of names to numbers or to such arrays, or a sequence of ``num_envs`` mappings. They hold
    for the episodes that this reset starts. A sequence of ``num_envs`` mappings says it for each on its own.
    ``reset_mask``, a boolean array (num_envs,), says which environments are
    reset; the others go on.

    ## Info

    A dictionary of arrays as Gymnasium's own vector environments have it: beside each array "name" stands a mask
    "_name" (all masks that are true throughout are one read-only array). ``reset`` tells everything; a step tells the
    ``info_keys``, by default the reward's terms, for at this speed all else costs more than it is worth
    to most: ``info_keys="all"`` tells what the single environment tells. Of environments that are reset within a step
    it tells what ``reset`` tells. When episodes end, ``statistics`` holds their return, length, late amplitude and so
    on, and the first four also stand beside it. All values are numbers (see :class:`SDFrictionEnv`).

    ## Arguments

    num_envs: in [1, 2**24].
    parameters, reward, and every field of :class:`Task`: as of :class:`SDFrictionEnv`. A ``reward`` function is called
        once per environment and step: slow; an array expression of ``info`` in a vector wrapper is not.
    autoreset_mode: "NextStep" (the default), "SameStep" or "Disabled" (https://farama.org/Vector-Autoreset-Mode).
    threads: how many threads may share a step, in [1, 256]; batches of fewer than 512 environments per thread use
        fewer. More than 1 pays where that many cores are idle. A process that is forked after threads have run steps
        on one (start processes by "spawn" or "forkserver" to have threads in them).
    max_episode_steps: as of ``gym.make``: takes the place of ``episode_steps``; if both are given, the shorter holds.
        None or -1: no limit of its own.
    copy: True hands out new arrays at every step. False: they are overwritten by the next step (a little faster).
    info_keys: "all", or which names of the single environment's info a step tells.
    render_mode: "rgb_array" (:meth:`render` returns a tuple of frames) or "human" (a window for one environment).
    render_size: of a frame, as of :class:`SDFrictionEnv`.
    render_envs: which environments are drawn; None: the first 16 (of "human": the first).

    Raises:
        TypeError, ValueError: if an argument is not as said, naming it and what is allowed.
    """

    metadata: dict[str, Any] = {**SDFrictionEnv.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        parameters: OscillatorParameters | Mapping[str, Any] | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
        copy: bool = True,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (960, 540),
        render_envs: Iterable[int] | None = None,
        reward: RewardFunction | None = None,
        info_keys: Collection[str] | Literal["all"] = REWARD_TERMS,
        max_episode_steps: int | None = None,
        **task_arguments: Any,
    ) -> None:
        super().__init__()
        n = self.num_envs = checked_count("num_envs", num_envs, 1, _MOST_ENVS)
        self.threads = checked_count("threads", threads, 1, _MOST_THREADS)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode must be one of {allowed}, got {autoreset_mode!r}") from None
        if not isinstance(copy, bool):
            raise TypeError(f"copy must be True or False, got {copy!r}")
        self.copy = copy
        if max_episode_steps not in (None, -1):
            limit = checked_count("max_episode_steps", max_episode_steps, *EPISODE_STEPS)
            own = task_arguments.get("episode_steps", limit)
            task_arguments["episode_steps"] = min(checked_count("episode_steps", own, *EPISODE_STEPS), limit)
        self._single = SDFrictionEnv(
            parameters, render_mode=render_mode, render_size=render_size, reward=reward, **task_arguments
        )
        self.info_keys = checked_info_keys(info_keys)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.nominal = self._single.nominal
        self.task = self._single.task
        self.reward = reward
        self.single_observation_space = self._single.observation_space
        self.single_action_space = self._single.action_space
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)

        task = self.task
        self._names = tuple(self.nominal.values)
        self._laws: list[tuple[Any, Any]] = [(self.nominal.geometry, self.nominal.friction)]
        self._law = np.zeros(n, np.int64)  # each environment's place in this list
        self._kinds: list[tuple[Kind, IntegerArray]] = [(self._kind_of(self.nominal), np.arange(n))]
        self._nominal_numbers = np.array(list(self.nominal.values.values()))[:, None]
        self._task_numbers, self._task_codes = task_arrays(task)
        # Rows of an odd number of cache lines: lengths of a power of two would crowd into few places of the cache.
        self._width = n if n < kernel.LANES else 8 * (2 * (n // 16) + 3)
        self._state = np.zeros((kernel.STATE_PLANT, self._width))
        self._counts = np.zeros((kernel.COUNT_ROWS, self._width), np.int64)
        self._numbers = np.zeros((len(self._names), n))
        self._past = np.zeros((task.sensor_delay + 1 if task.sensor_delay else 0, 2, n))
        self._shown = np.zeros((n, len(task.randomise) if task.show_parameters else 0))
        shares = max(1, min(self.threads, n // _ENVS_WORTH_A_THREAD))
        self._own = np.zeros(n, np.bool_)  # who has other parameters than the nominal ones
        # Whether compiled code alone can begin the next episode of one with the nominal parameters.
        self._restarts_alike = task.start != "random" and not task.randomise
        # Every share but the last is made of whole blocks.
        blocks = -(-n // kernel.LANES)
        self._bounds = np.minimum(kernel.LANES * (np.arange(shares + 1) * blocks // shares), n)
        self._ended = np.zeros(shares, np.int64)
        shape = self.single_observation_space.shape
        assert shape is not None
        self._observations = np.zeros((n, *shape), np.float32)
        self._actions = np.zeros(n)
        self._expected_actions = f"actions must be finite numbers in an array of shape ({n}, 1)"
        self._no_codes = np.empty((0, self._width), np.int64)
        self._everyone = np.arange(n)
        # What is reported: all that the info holds, a reward function reads or a picture shows.
        self.step_keys = tuple(name for name in _STEP_KEYS if name in self.info_keys)
        pictured = ("x_min", "x_max", "stick_fraction", "force", "mode") if render_mode is not None else ()
        needed = set(_STEP_KEYS if reward is not None else (*self.step_keys, *pictured))
        self._reported = tuple(name for name in _REPORT if name in needed)
        self._wanted = np.array([_REPORT[name] for name in self._reported], np.int64)
        self._codes_wanted = bool(needed & _CODES.keys())
        self._status_wanted = "status" in needed
        told = {*self._reported, *(_CODES if self._codes_wanted else ()), *(needed & {"status"})}
        self._unasked = tuple(told - set(self.step_keys))
        self._over = np.zeros(0, np.int64)  # whose episodes have ended: they wait for a reset
        self._seeds: list[int | None] = [None] * n
        self._is_reset = False
        self._attributes: dict[str, list[Any]] = {}
        self._views = _views(self._single, render_envs, n, render_mode)
        self._single.render_mode = None  # it takes the place of many and draws none
        self._modes: dict[int, int] = {}  # that the last step told of the environments that are drawn
        self._make_what_does_not_travel()

    def _make_what_does_not_travel(self) -> None:
        """Make what a copy has to make anew: compiled code, and arrays that cannot be written to."""
        self._form_groups()
        self._kept: _Buffers | None = None
        self._all = np.ones(self.num_envs, np.bool_)  # what holds for all is one array for all steps
        self._all.setflags(write=False)
        self._masks = {f"_{name}": self._all for name in self.step_keys}

    def _form_groups(self) -> None:
        """Find what steps the plants of each kind."""
        self._groups = [self._group(*kind) for kind in self._kinds]
        rows = kernel.STATE_PLANT + max(group.steppers.leaves for group in self._groups)
        if len(self._state) < rows:
            self._state = np.concatenate((self._state, np.zeros((rows - len(self._state), self._width))))
        size = self._groups[0].steppers.work_size
        self._works = np.ones((len(self._ended), size))
        self._task_codes[kernel.TASK_ONE_PLANT] = False

    def _group(self, kind: Kind, which: IntegerArray) -> _Group:
        plant = plant_of(kind, self.nominal.values)
        return _Group(kind, which, kernel.steppers(plant), kernel.tables_of(plant))

    def _kind_of(self, parameters: OscillatorParameters) -> Kind:
        # Phases that are shown are those of an excitation, even of one that is too small to be seen.
        kind = parameters.kind
        return kind._replace(excited=kind.excited or self.task.show_phases)

    def __getstate__(self) -> dict[str, Any]:
        anew = ("_groups", "_works", "_kept", "_all", "_masks")
        return {name: value for name, value in vars(self).items() if name not in anew}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_what_does_not_travel()

    # Starting ---------------------------------------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes, in all environments or in those of ``options["reset_mask"]``; see the class.

        Returns:
            Observations (num_envs, size), float32, and info.

        Raises:
            TypeError, ValueError: if an option or a seed is not as said.
            gymnasium.error.ResetNeeded: if some are to go on that were never reset.

        A reset that fails changes nothing.
        """
        n = self.num_envs
        seeds = _checked_seeds(seed, n)
        mask, per_env = _checked_batch_options(options, n)
        which = self._everyone if mask is None else np.flatnonzero(mask)
        if not self._is_reset and len(which) < n:
            raise gym.error.ResetNeeded("reset all environments once before resetting some: the others have no state")
        keys, episodes = self._counts[kernel.COUNT_KEY, which], self._counts[kernel.COUNT_EPISODE, which] + 1
        new_seeds = list(self._seeds)
        stream = None if self._is_reset else copying.deepcopy(self.np_random)
        for place, i in enumerate(which.tolist()):
            if seeds[i] is not None:
                new_seeds[i] = seeds[i]
                keys[place], episodes[place] = seeding.np_random(seeds[i])[0].integers(2**62), 0
            elif stream is not None:
                keys[place], episodes[place] = stream.integers(2**62), 0
        numbers = self._drawn(keys, episodes)
        laws = np.zeros(len(which), np.int64)
        given = self._given(which, keys, episodes, per_env, numbers, laws)
        starts = self._prepared(which, keys, episodes, numbers, laws, *given)
        # Nothing can go wrong from here on, and only now is anything changed.
        if stream is not None:
            self.np_random.bit_generator.state = stream.bit_generator.state
        self._seeds = new_seeds
        self._is_reset = True
        self._begin(starts)
        self._observe(which)
        self._over = self._over[~np.isin(self._over, which)]
        info = self._reset_info(which, self._at_start(which))
        return self._observations.copy() if self.copy else self._observations, info

    def _drawn(self, keys: IntegerArray, episodes: IntegerArray) -> FloatArray:
        """Return the numbers (rows: the batch's names) with which episodes begin."""
        numbers = np.repeat(self._nominal_numbers, len(keys), axis=1)
        for name, values in self.task.draws(keys, episodes).items():
            numbers[self._names.index(name)] = values
        return numbers

    def _given(
        self,
        which: IntegerArray,
        keys: IntegerArray,
        episodes: IntegerArray,
        per_env: list[dict[str, Any]] | None,
        numbers: FloatArray,
        laws: IntegerArray,
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Put what options say into numbers and laws; return the starts that they ask for, and for whom."""
        x, v, placed = np.zeros(len(which)), np.zeros(len(which)), np.zeros(len(which), np.bool_)
        for place, i in enumerate(which.tolist() if per_env is not None else []):
            assert per_env is not None
            options = per_env[i]
            own = self._as_parameters(numbers[:, place], 0)
            if "parameters" in options:
                own = own.replace(**options["parameters"])
                check_belt(own)
                numbers[:, place], laws[place] = self._columns_of(own)
            if any(name in options for name in ("x", "phase", "start")):
                x[place], v[place] = start_of(self.task, own, options, int(keys[place]), int(episodes[place]))
                placed[place] = True
        return x, v, placed

    def _columns_of(self, parameters: OscillatorParameters) -> tuple[list[float], int]:
        """Return parameters as the batch keeps them: numbers by its names, and the place of their laws in its list."""
        values = self._nominal_numbers[:, 0].tolist()
        kind, nominal = parameters.unexcited.kind, self.nominal.unexcited.kind
        alike = kind.friction == nominal.friction and kind.geometry == nominal.geometry
        laws = self._laws[0] if alike else (parameters.geometry, parameters.friction)
        found = parameters.values
        numbers = [
            found[name] if name in RANGES or alike else value for name, value in zip(self._names, values, strict=True)
        ]
        if laws not in self._laws:
            self._laws.append(laws)
        return numbers, self._laws.index(laws)

    def _as_parameters(self, numbers: FloatArray, law: int) -> OscillatorParameters:
        values = dict(zip(self._names, numbers.tolist(), strict=True))
        if law != 0:
            geometry, friction = self._laws[law]
            values = {name: value for name, value in values.items() if name in RANGES}
            return self.nominal.replace(geometry=geometry, friction=friction, **values)
        return self.nominal.replace(**values)

    def _kinds_in(self, numbers: FloatArray, laws: IntegerArray) -> list[tuple[Kind, IntegerArray]]:
        """Return the kinds of plants with these laws and numbers, each with its columns."""
        excited = np.full(len(laws), self.task.show_phases)
        for name in _AMPLITUDES:
            excited |= numbers[self._names.index(name)] > 0.0
        flat = numbers[self._names.index("alpha")] == 0.0
        codes = 4 * laws + 2 * flat + excited
        kinds: dict[Kind, IntegerArray] = {}
        for code in np.unique(codes).tolist():
            columns = np.flatnonzero(codes == code)
            parameters = self._as_parameters(numbers[:, columns[0]], code // 4)
            kind = self._kind_of(parameters)
            if code >= 4:  # the numbers of a law of one's own are not among the batch's
                kind = kind._replace(
                    geometry=kind.geometry if isinstance(kind.geometry, str) else parameters.geometry,
                    friction=kind.friction if isinstance(kind.friction, str) else parameters.friction,
                )
            kinds[kind] = np.union1d(kinds[kind], columns) if kind in kinds else columns
        return list(kinds.items())

    def _prepared(
        self,
        which: IntegerArray,
        keys: IntegerArray,
        episodes: IntegerArray,
        numbers: FloatArray,
        laws: IntegerArray,
        x: FloatArray,
        v: FloatArray,
        placed: NDArray[np.bool_],
    ) -> _Starts:
        """Return episodes with these parameters, at the states (x, v) where ``placed``, else where the task says.

        All that can fail when an episode begins fails here, before the batch is changed.
        """
        kinds = self._kinds_in(numbers, laws)
        values = dict(zip(self._names, numbers, strict=True))
        plants = []
        for kind, columns in kinds:
            # The batch's names are those of the nominal laws: another law of a user's own has its numbers in itself.
            names = self._names if laws[columns[0]] == 0 else tuple(RANGES)
            here = {name: values[name][columns] for name in names}
            plants.append(kernel.leaves_of(plant_of(kind, here), plant_of(kind, self.nominal.values)))
        state = np.zeros((kernel.STATE_PLANT + max(map(len, plants)), len(which)))
        for (_, columns), leaves in zip(kinds, plants, strict=True):
            for leaf, row in enumerate(leaves):
                state[kernel.STATE_PLANT + leaf, columns] = row
        state[kernel.STATE_BELT_SPEED] = values["belt_speed"]
        state[kernel.STATE_X], state[kernel.STATE_V] = x, v
        counts = np.zeros((kernel.COUNT_ROWS, len(which)), np.int64)
        counts[kernel.COUNT_KEY], counts[kernel.COUNT_EPISODE] = keys, episodes
        kernel.blank_episodes(state, counts, np.arange(len(which)))
        own = (laws != 0) | (numbers != self._nominal_numbers).any(axis=0)
        starts = _Starts(which, numbers, laws, kinds, state, counts, own)
        self._place(starts, ~placed)
        return starts

    def _begin(self, starts: _Starts) -> None:
        """Start episodes; they are not observed yet."""
        which = starts.which
        here = slice(self.num_envs) if len(which) == self.num_envs else which  # in one go, where that is possible
        self._numbers[:, here] = starts.numbers
        self._law[here] = starts.laws
        kinds = starts.kinds
        if len(which) < self.num_envs:
            kinds = self._kinds_in(self._numbers, self._law)
        if [kind for kind, _ in kinds] != [kind for kind, _ in self._kinds]:
            self._kinds = kinds
            self._form_groups()
        else:
            self._kinds = kinds
            self._groups = [group._replace(which=own) for group, (_, own) in zip(self._groups, kinds, strict=True)]
        self._state[: len(starts.state), here] = starts.state
        self._counts[:, here] = starts.counts
        self._own[here] = starts.own
        one_plant = not self._own.any()
        if one_plant and not self._task_codes[kernel.TASK_ONE_PLANT]:
            for work in self._works:
                kernel.fill_plant(work, self._state[:, which[0]])
        self._task_codes[kernel.TASK_ONE_PLANT] = one_plant
        if self.task.show_parameters:
            self._shown[which] = self.task.shown_parameters(dict(zip(self._names, starts.numbers, strict=True))).T
        self._clear_pictures(which)

    def _clear_pictures(self, which: IntegerArray) -> None:
        if self._views:
            for i in self._views.keys() & set(which.tolist()):
                self._views[i].clear_picture()
                self._modes.pop(i, None)

    def _place(self, starts: _Starts, asked: NDArray[np.bool_]) -> None:
        """Put the episodes that are asked for where the task starts them."""
        task, state, counts = self.task, starts.state, starts.counts
        if task.start == "random":
            columns = np.flatnonzero(asked)
            keys, episodes = counts[kernel.COUNT_KEY, columns], counts[kernel.COUNT_EPISODE, columns]
            state[kernel.STATE_X, columns], state[kernel.STATE_V, columns] = task.random_states(keys, episodes)
            return
        left = []
        for kind, columns in starts.kinds:
            group = self._group(kind, columns)
            nominal = columns[asked[columns] & ~starts.own[columns]]
            own = columns[asked[columns] & starts.own[columns]]
            if len(nominal):
                group.steppers.place_on_cycle(state, counts, nominal, *self._nominal_start, group.tables)
            if task.start == "cycle" and len(own):
                phases = task.phases(counts[kernel.COUNT_KEY, own], counts[kernel.COUNT_EPISODE, own])
                own = own[group.steppers.own_cycle_starts(state, counts, own, phases, group.tables) == 1]
            left += own.tolist()
        for j in left:
            single = self._as_parameters(starts.numbers[:, j], int(starts.laws[j]))
            key, episode = counts[[kernel.COUNT_KEY, kernel.COUNT_EPISODE], j].tolist()
            state[kernel.STATE_X, j], state[kernel.STATE_V, j] = task.start_state(single, key, episode)

    @functools.cached_property
    def _nominal_start(self) -> tuple[FloatArray, float, int]:
        """Where episodes with the nominal parameters begin that do not begin at random: points of the passive motion,
        its period (0 for a state and no more) and the slot of the random numbers that choose the phase."""
        cycle = passive_motion(self.nominal)
        if self.task.start == "cycle" and cycle is not None and cycle.period > 0.0:
            return cycle.points, cycle.period, PHASE_SLOT
        place = (
            (rest_place(self.nominal), 0.0) if self.task.start == "rest" else self.task.cycle_state(self.nominal, 0.0)
        )
        return np.array([place] * kernel.CYCLE_POINTS), 0.0, PHASE_SLOT

    def _observe(self, which: IntegerArray) -> None:
        arrays = (self._task_numbers, self._task_codes, self._state, self._counts, self._past, self._shown)
        for group, own in self._in_groups(which):
            group.steppers.observe(*arrays, group.tables, self._observations, own)

    def _in_groups(self, which: IntegerArray) -> list[tuple[_Group, IntegerArray]]:
        """Return the groups to which environments belong, with these."""
        if len(self._groups) == 1:
            return [(self._groups[0], which)]
        parts = [(group, which[np.isin(which, group.which)]) for group in self._groups]
        return [(group, own) for group, own in parts if len(own)]

    def _at_start(self, which: IntegerArray) -> dict[str, NDArray[Any]]:
        """Return what info says of environments (k,) that have just been reset, each (k,)."""
        state = self._state
        mode, (v_belt, v_rel, normal_force) = np.empty(len(which), np.int64), np.empty((3, len(which)))
        for group, own in self._in_groups(which):
            here = np.searchsorted(which, own) if len(own) < len(which) else slice(None)
            parts = [np.empty(len(own), out.dtype) for out in (mode, v_belt, v_rel, normal_force)]
            group.steppers.contact(state, self._counts, own, *parts, group.tables)
            mode[here], v_belt[here], v_rel[here], normal_force[here] = parts
        return {
            "x": state[kernel.STATE_X, which],
            "v": state[kernel.STATE_V, which],
            "v_belt": v_belt,
            "v_rel": v_rel,
            "mode": mode,
            "normal_force": normal_force,
            "time": np.zeros(len(which)),
        }

    def _reset_info(self, which: IntegerArray, start: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
        mask = self._mask(which)
        info = self._spread(start, which, mask)
        parameters: dict[str, NDArray[Any]] = {}
        for place, (name, names) in enumerate({"geometry": GEOMETRIES, "friction": FRICTIONS}.items()):
            places = np.array([place_of(laws[place], names) for laws in self._laws])
            parameters[name] = places[self._law[which]]
        parameters.update(zip(self._names, self._numbers[:, which], strict=True))
        return info | {"parameters": self._spread(parameters, which, mask), "_parameters": mask}

    def _spread(
        self, columns: Mapping[str, NDArray[Any]], which: IntegerArray, mask: NDArray[np.bool_]
    ) -> dict[str, Any]:
        """Return arrays (num_envs,) with the columns' values (k,) in the places ``which`` and 0 elsewhere, by name, and
        the mask beside each."""
        info: dict[str, Any] = dict.fromkeys((f"_{name}" for name in columns), mask)
        for dtype in dict.fromkeys(values.dtype for values in columns.values()):  # one array for each is much faster
            names = [name for name, values in columns.items() if values.dtype == dtype]
            block = np.zeros((len(names), self.num_envs), dtype)
            block[:, which] = [columns[name] for name in names]
            info.update(zip(names, block, strict=True))
        return info

    def _mask(self, which: IntegerArray) -> NDArray[np.bool_]:
        if len(which) == self.num_envs:
            return self._all
        mask = np.zeros(self.num_envs, np.bool_)
        mask[which] = True
        return mask

    # Stepping ---------------------------------------------------------------------------------------------------------

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold the actions (num_envs, 1) for one control interval.

        Returns:
            Observations (num_envs, size), float32; rewards, float64; terminated; truncated; info.

        Raises:
            TypeError, ValueError: if the actions are not finite numbers of this shape; nothing has then been stepped.
            gymnasium.error.ResetNeeded: before the first reset; with autoreset_mode "Disabled" also if an
                environment's episode has ended.

        If an episode cannot be started, nothing has been stepped either; with autoreset_mode "SameStep" all have been,
        and the environments whose episodes ended wait for a reset.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        forces = self._checked_actions(actions)
        resting = self._over
        if len(resting) and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded(
                f"the episodes of environments {_listed(resting)} have ended: reset them with "
                "options={'reset_mask': ...} before step()"
            )
        next_starts = self._next_starts(resting) if len(resting) else None
        out = self._buffers()
        ended = self._advance(forces, out)
        terminated, truncated = out.over
        said = self._said(out)
        if self.reward is not None:
            self._replace_rewards(said, resting, out.rewards)
        if self._views:
            self._note_for_views(said, resting)
        info = {**self._masks, **said}
        for name in self._unasked:
            del info[name]
        if len(resting):
            self._restart(resting, next_starts)
            out.rewards[resting] = 0.0
            out.over[:, resting] = False
            self._show_restarted(info, resting)
        if ended or len(resting):
            over = np.flatnonzero(terminated | truncated)
            if len(over):
                statistics = self._statistics(over)
                if self.autoreset_mode == AutoresetMode.SAME_STEP:
                    final = self._final(info, over, statistics)
                    self._over = over  # unless they can be restarted
                    self._restart(over, self._next_starts(over))
                    self._show_restarted(info, over)
                    info.update(final)
                    over = over[:0]
                else:
                    info.update(statistics)
            self._over = over
        if self.render_mode == "human":
            self.render()
        observations = self._observations.copy() if self.copy else self._observations
        return observations, out.rewards, terminated, truncated, info

    def _said(self, out: _Buffers) -> dict[str, Any]:
        """Return what was reported of the step, by name, each (num_envs,)."""
        n = self.num_envs
        said: dict[str, Any] = dict(zip(self._reported, out.report[:, :n], strict=True))
        if self._codes_wanted:
            for name, row in _CODES.items():
                said[name] = out.codes[row, :n]
        if self._status_wanted:
            said["status"] = self._counts[kernel.COUNT_STATUS, :n].copy()
        return said

    def _checked_actions(self, actions: Any) -> FloatArray:
        expected = self._expected_actions
        array = real_array(expected, actions)
        if array.shape != (self.num_envs, 1):
            raise ValueError(f"{expected}, got shape {array.shape}")
        flat = self._actions
        flat[:] = array[:, 0]
        bad = kernel.first_bad(flat)
        if bad >= 0:
            raise ValueError(f"{expected}; outside [-1, 1] they are clipped; environment {bad} got {flat[bad]!r}")
        return flat

    def _buffers(self) -> _Buffers:
        if self._kept is not None:
            return self._kept
        n, width = self.num_envs, self._width
        out = _Buffers(
            np.empty(n),
            np.empty((2, n), np.bool_),
            np.empty((len(self._wanted), width)),
            np.empty((len(_CODES), width), np.int64) if self._codes_wanted else self._no_codes,
        )
        if not self.copy:
            self._kept = out
        return out

    def _advance(self, actions: FloatArray, out: _Buffers) -> int:
        """Step all environments; return how many are at an episode's end."""
        if len(self._groups) > 1:
            return sum(self._advance_group(group, actions, out) for group in self._groups)
        group = self._groups[0]
        arguments = (
            self._task_numbers,
            self._task_codes,
            self._state,
            self._counts,
            self._past,
            self._shown,
            group.tables,
            actions,
            self._wanted,
            self._observations,
            *out,
        )
        if len(self._works) == 1 or _threads_are_lost:
            ended: int = group.steppers.step_many(self._works[0], 0, self.num_envs, *arguments)
            return ended
        group.steppers.step_in_threads(self._works, self._bounds, self._ended, *arguments)
        return int(self._ended.sum())

    def _advance_group(self, group: _Group, actions: FloatArray, out: _Buffers) -> int:
        """Step the environments of one group of several: their columns are brought together and put back."""
        own = group.which
        columns = (self._state, self._counts, self._past, out.over, out.report, out.codes)
        state, counts, past, over, report, codes = (np.ascontiguousarray(array[..., own]) for array in columns)
        observations, rewards = self._observations[own], out.rewards[own]
        ended: int = group.steppers.step_many(
            np.ones(group.steppers.work_size),
            0,
            len(own),
            self._task_numbers,
            self._task_codes,
            state,
            counts,
            past,
            self._shown[own],
            group.tables,
            actions[own],
            self._wanted,
            observations,
            rewards,
            over,
            report,
            codes,
        )
        for array, part in zip(columns, (state, counts, past, over, report, codes), strict=True):
            array[..., own] = part
        self._observations[own], out.rewards[own] = observations, rewards
        return ended

    def _replace_rewards(self, said: Mapping[str, Any], resting: IntegerArray, rewards: FloatArray) -> None:
        assert self.reward is not None
        columns = {name: said[name].tolist() for name in _STEP_KEYS}
        quiet = set(resting.tolist())
        for i in range(self.num_envs):
            if i not in quiet:
                rewards[i] = float(self.reward({name: values[i] for name, values in columns.items()}))
        self._state[kernel.STATE_RETURN, : self.num_envs] += rewards

    def _next_starts(self, which: IntegerArray) -> _Starts | None:
        """Return the next episodes of environments; None if compiled code alone can begin them."""
        if self._restarts_alike and not self._own[which].any():
            _ = self._nominal_start  # which may fail, and must do so now
            return None
        keys, episodes = self._counts[kernel.COUNT_KEY, which], self._counts[kernel.COUNT_EPISODE, which] + 1
        nowhere = np.zeros(len(which))
        return self._prepared(
            which,
            keys,
            episodes,
            self._drawn(keys, episodes),
            np.zeros(len(which), np.int64),
            nowhere,
            nowhere,
            np.zeros(len(which), np.bool_),
        )

    def _restart(self, which: IntegerArray, starts: _Starts | None) -> None:
        """Begin the next episodes of environments, as :meth:`_next_starts` returned them."""
        if starts is not None:
            self._begin(starts)
            self._observe(which)
            return
        arrays = (self._task_numbers, self._task_codes, self._state, self._counts, self._past, self._shown)
        for group, own in self._in_groups(which):  # one: all have the nominal parameters
            group.steppers.restart(*arrays, group.tables, self._observations, own, *self._nominal_start)
        self._clear_pictures(which)

    def _show_restarted(self, info: dict[str, Any], which: IntegerArray) -> None:
        """Let info say of environments what a reset says, in place of what it said of a step."""
        start = self._reset_info(which, self._at_start(which))
        stepped = ~self._mask(which)
        for name in self.step_keys:
            if name in RESET_KEYS:
                info[name][which] = start.pop(name)[which]
                del start[f"_{name}"]
            elif len(which) == self.num_envs:
                del info[name], info[f"_{name}"]
            else:
                info[name][which] = 0
                info[f"_{name}"] = stepped
        info.update(start)

    def _final(self, info: Mapping[str, Any], which: IntegerArray, statistics: Mapping[str, Any]) -> dict[str, Any]:
        """Return the last observations and the info of environments that are about to be reset in the same step."""
        mask = self._mask(which)
        observations = np.full(self.num_envs, None, object).view(FinalObservations)
        for i in which.tolist():
            observations[i] = self._observations[i].copy()
        last = {**statistics, **self._spread({name: info[name][which] for name in self.step_keys}, which, mask)}
        return {"final_obs": observations, "_final_obs": mask, "final_info": last, "_final_info": mask}

    def _statistics(self, which: IntegerArray) -> dict[str, Any]:
        """Return what info says of the episodes of environments that have ended."""
        values = np.zeros((len(EPISODE_STATISTICS), self.num_envs))
        kernel.episode_statistics(self._state, self._counts, which, self.reward is not None, values)
        mask = self._mask(which)
        statistics: dict[str, Any] = {}
        for name, entries in named_statistics(values).items():
            statistics[name], statistics[f"_{name}"] = entries, mask
        plain = {name: statistics[name] for short in PLAIN_STATISTICS for name in (short, f"_{short}")}
        return {"statistics": statistics, "_statistics": mask, **plain}

    def stagger(self) -> None:
        """Cut the running episodes short, each by another share, so that they do not all end in the same step.

        Environment i is taken to have done i/num_envs of its episode's steps: whoever learns from the batch then sees
        squealing, settling and settled motion in their due shares from the second episode on.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before stagger(): no episode is running")
        steps = self._everyone * self.task.episode_steps // self.num_envs
        self._counts[kernel.COUNT_STEPS, : self.num_envs] = steps
        self._counts[kernel.COUNT_FIRST_STEP, : self.num_envs] = steps

    # One by one -------------------------------------------------------------------------------------------------------

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seeds of the environments; None where none was given."""
        return tuple(self._seeds)

    def get_states(self) -> tuple[EnvState, ...]:
        """Return the state of every environment; see :meth:`SDFrictionEnv.get_state`.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before get_states(): there is no state yet")
        return tuple(self._state_of(i) for i in range(self.num_envs))

    def _state_of(self, i: int) -> EnvState:
        parameters = self._as_parameters(self._numbers[:, i], int(self._law[i]))
        return read_state(parameters, self._state, self._counts, self._past, i)

    def set_states(self, states: Sequence[EnvState]) -> None:
        """Go back to states that :meth:`get_states` returned: what follows is the same, bit for bit.

        The episodes' statistics begin anew.

        Raises:
            TypeError, ValueError: if ``states`` are not ``num_envs`` times what :meth:`get_states` returns; nothing is
                then changed.
        """
        if not isinstance(states, Sequence):
            raise TypeError(f"states must be a sequence of {self.num_envs}, as get_states() returns it, got {states!r}")
        if len(states) != self.num_envs:
            raise ValueError(f"states must be {self.num_envs}, one per environment, got {len(states)}")
        for i, state in enumerate(states):
            checked_state(f"states[{i}]", state)
        self._put_states(self._everyone, states)
        self._is_reset = True

    def _put_states(self, which: IntegerArray, states: Sequence[EnvState]) -> None:
        """Put (checked) states into environments."""
        columns = [self._columns_of(saved.parameters) for saved in states]
        numbers = np.array([column for column, _ in columns]).T
        laws = np.array([law for _, law in columns])
        keys = np.array([saved.key for saved in states])
        episodes = np.array([saved.episode for saved in states])
        elsewhere = np.zeros(len(which))  # write_state puts them in their places
        everywhere = np.ones(len(which), np.bool_)
        self._begin(self._prepared(which, keys, episodes, numbers, laws, elsewhere, elsewhere, everywhere))
        for i, saved in zip(which.tolist(), states, strict=True):
            write_state(saved, self._state, self._counts, self._past, i)
        over = np.array([saved.ended or saved.steps >= self.task.episode_steps for saved in states])
        self._over = np.union1d(self._over[~np.isin(self._over, which)], which[over])

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of every environment, or read an attribute; return the results.

        A single environment in the place of each is asked, and what the call changes in its state is kept.

        Raises:
            AttributeError: if an environment has nothing of that name.
            gymnasium.error.ResetNeeded: before the first reset, if the call needs or makes a state.
            ValueError: if it is to draw an environment that ``render_envs`` does not name.
        """
        return tuple(self.call_at(range(self.num_envs), name, *args, **kwargs))

    def call_at(self, indices: int | Iterable[int] | None, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """:meth:`call` for some of the environments; ``indices`` as :meth:`places` takes them."""
        return [self._call_one(name, i, *args, **kwargs) for i in self.places(indices)]

    def places(self, indices: int | Iterable[int] | None) -> list[int]:
        """Return the places in the batch that ``indices`` name.

        Args:
            indices: one or several whole numbers in [-num_envs, num_envs), negative ones from the end as in a list;
                None: all.

        Raises:
            TypeError: if one is not a whole number. IndexError: if there is no such environment.
        """
        if indices is None:
            return self._everyone.tolist()
        several: Any = indices if isinstance(indices, Iterable) and getattr(indices, "ndim", 1) > 0 else [indices]
        places = []
        for index in several:
            try:
                places.append(range(self.num_envs)[operator.index(index)])
            except TypeError:
                raise TypeError(
                    f"indices must be None, a whole number or several of them, got {brief_repr(index)}"
                ) from None
            except IndexError:
                n = self.num_envs
                raise IndexError(f"indices must be in [{-n}, {n - 1}], got {brief_repr(index)}") from None
        return places

    def _call_one(self, name: str, i: int, /, *args: Any, **kwargs: Any) -> Any:
        if name == "render":
            return self._drawn_one(i)
        found = self._attribute(name, i)
        if not callable(found):
            return found
        if name in _STATE_METHODS and not self._is_reset:
            raise gym.error.ResetNeeded(
                f"call reset() before call({name!r}): there is no state yet that it could change"
            )
        result = found(*args, **kwargs)
        if name in _STATE_METHODS:
            self._put_states(np.array([i]), [self._single.get_state()])
        if name == "reset" and kwargs.get("seed") is not None:
            self._seeds[i] = kwargs["seed"]
        return result

    def _attribute(self, name: str, i: int) -> Any:
        """Return an attribute of an environment; a method is that of the single environment put in its place."""
        if name in self._attributes:
            return self._attributes[name][i]
        if name in ("render_mode", "np_random_seed"):
            return self.render_mode if name == "render_mode" else self._seeds[i]
        if self._is_reset:
            self._single.set_state(self._state_of(i))
        return getattr(self._single, name)

    def attributes_at(self, indices: int | Iterable[int] | None, name: str) -> list[Any]:
        """Return an attribute of some of the environments (``indices`` as :meth:`places` takes them); nothing is
        called: a method is one that acts on its own.

        Raises:
            AttributeError: if an environment has nothing of that name.
        """
        found = []
        for i in self.places(indices):
            value = self._attribute(name, i)
            own = inspect.ismethod(value) and value.__self__ is self._single
            found.append(functools.partial(self._call_one, name, i) if own else value)
        return found

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every environment, from a list or tuple of ``num_envs`` values or one for all.

        Raises:
            ValueError: if there are not ``num_envs`` values.
            AttributeError: if environments have an attribute of that name already: it holds for the whole batch, and
                is given to the constructor, or to reset() in its options.
        """
        listed = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(listed) != self.num_envs:
            raise ValueError(f"values must be {self.num_envs}, one per environment, got {len(listed)}")
        for i, value in enumerate(listed):
            self.set_attr_at([i], name, value)

    def set_attr_at(self, indices: int | Iterable[int] | None, name: str, value: Any) -> None:
        """Set an attribute of some of the environments (None for the others, if it is new) to one value; ``indices`` as
        :meth:`places` takes them."""
        places = self.places(indices)
        if hasattr(self._single, name):
            raise AttributeError(
                f"{name!r} cannot be set: parameters and tasks are given to the constructor or to reset(options=...)"
            )
        values = self._attributes.setdefault(name, [None] * self.num_envs)
        for i in places:
            values[i] = value

    # Pictures ---------------------------------------------------------------------------------------------------------

    def _note_for_views(self, said: Mapping[str, Any], resting: IntegerArray) -> None:
        for i, view in self._views.items():
            if i not in resting:
                seen = (float(said["x_min"][i]), float(said["x_max"][i]), float(said["stick_fraction"][i]))
                view.note_for_picture(*seen, float(said["force"][i]))
                self._modes[i] = int(said["mode"][i])

    def render(self) -> tuple[Any, ...] | None:
        """Draw the environments ``render_envs``; a tuple of arrays (height, width, 3), uint8, in mode "rgb_array"."""
        if self.render_mode is None:
            self._single.render()  # which warns
            return None
        frames = tuple(self._drawn_one(i) for i in self._views)
        return frames if self.render_mode == "rgb_array" else None

    def _drawn_one(self, i: int) -> Any:
        """Draw an environment; see :meth:`SDFrictionEnv.render`."""
        if self.render_mode is None:
            return self._single.render()
        if i not in self._views:
            raise ValueError(f"environment {i} is not drawn: render_envs names those that are, {sorted(self._views)!r}")
        view = self._views[i]
        if self._is_reset:
            view.set_state(self._state_of(i))
            if i in self._modes:
                view.note_mode(self._modes[i])
        return view.render()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the windows, if there are any."""
        for view in self._views.values():
            view.close()
        self._single.close()


def _views(
    single: SDFrictionEnv, render_envs: Iterable[int] | None, num_envs: int, render_mode: str | None
) -> dict[int, SDFrictionEnv]:
    """Return the single environments that draw, by the place they draw."""
    if render_envs is not None and not isinstance(render_envs, Iterable):
        raise TypeError(
            f"render_envs must be None or a sequence of whole numbers in [0, {num_envs - 1}], got {render_envs!r}"
        )
    if render_envs is None:
        chosen = list(range(min(num_envs, _MOST_RENDERED if render_mode == "rgb_array" else 1)))
    else:
        chosen = [checked_count("render_envs", i, 0, num_envs - 1) for i in render_envs]
        if len(set(chosen)) < len(chosen) or (render_mode == "human" and len(chosen) != 1):
            raise ValueError(f"render_envs must name each environment once, and one for 'human', got {chosen!r}")
    if render_mode is None:
        return {}
    return {i: single.twin() for i in chosen}


def checked_info_keys(info_keys: Any) -> frozenset[str]:
    """Return the names that a step's info is to hold.

    Raises:
        TypeError, ValueError: if ``info_keys`` is neither "all" nor a sequence or a set of names of ``INFO_KEYS``.
    """
    expected = "info_keys must be 'all' or a sequence of names"
    if isinstance(info_keys, str):
        if info_keys == "all":
            return frozenset(INFO_KEYS)
        raise ValueError(f"{expected}, got {info_keys!r}")
    if not isinstance(info_keys, Collection) or (isinstance(info_keys, np.ndarray) and info_keys.ndim != 1):
        raise TypeError(f"{expected}, got {info_keys!r}")
    for name in info_keys:
        if not isinstance(name, str):
            raise TypeError(f"{expected}, got {name!r} among them")
        checked_choice("info_keys", name, INFO_KEYS)
    return frozenset(map(str, info_keys))


def _listed(places: IntegerArray) -> str:
    return ", ".join(map(str, places[:5].tolist())) + (", ..." if len(places) > 5 else "")


def _checked_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Return the seed of every environment.

    Raises:
        TypeError, ValueError: if ``seed`` is neither None, a whole number, nor ``num_envs`` of these.
    """
    if seed is None:
        return [None] * num_envs
    listed = isinstance(seed, Sequence) and not isinstance(seed, str | bytes | bytearray | memoryview)
    if listed or (isinstance(seed, np.ndarray) and seed.ndim > 0):
        if len(seed) != num_envs:
            raise ValueError(f"seed must hold {num_envs} seeds, one per environment, got {len(seed)}")
        return [None if single is None else _checked_seed(single) for single in seed]
    first = _checked_seed(seed)
    return [first + i for i in range(num_envs)]


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool | np.bool_) or not isinstance(seed, int | np.integer):
        raise TypeError(f"seed must be None, a whole number or a sequence of these, got {brief_repr(seed)}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {brief_repr(seed)}")
    return int(seed)


def _entries(name: str, value: Any, num_envs: int) -> list[Any]:
    """Return what a value says of every environment: the entries of an array, or else the value for all."""
    value = without_axes(value)
    if not isinstance(value, np.ndarray | list | tuple) or _is_law(value):
        return [value] * num_envs
    if isinstance(value, np.ndarray) and value.ndim > 1:
        raise ValueError(f"{name} must be one value or {num_envs}, got shape {value.shape}")
    if len(value) != num_envs:
        raise ValueError(f"{name} must be one value or {num_envs}, got {len(value)}")
    for entry in value:
        if (isinstance(entry, list | tuple) and not _is_law(entry)) or (
            isinstance(entry, np.ndarray) and entry.ndim > 0
        ):
            raise ValueError(f"{name} must be one value or {num_envs}, got {entry!r} among them")
    return [without_axes(entry) for entry in value]


def _is_law(value: Any) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields")


def _checked_batch_options(options: Any, num_envs: int) -> tuple[NDArray[np.bool_] | None, list[dict[str, Any]] | None]:
    """Return who is reset (None: all) and the checked options of each environment (None: no options).

    Raises:
        TypeError, ValueError: naming the option, its value and what is allowed.
    """
    if options is None:
        return None, None
    if isinstance(options, Sequence) and not isinstance(options, str):
        if len(options) != num_envs:
            raise ValueError(f"options must be a mapping or {num_envs} of them, got {len(options)}")
        return None, [checked_options(single) for single in options]
    if not isinstance(options, Mapping):
        raise TypeError(f"options must be a mapping, {num_envs} of them or None, got {options!r}")
    given = dict(options)
    mask = given.pop("reset_mask", None)
    if mask is not None:
        expected = f"options['reset_mask'] must be a boolean array of shape ({num_envs},) with a True in it"
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"{expected}, got {mask!r}")
        if mask.shape != (num_envs,) or not mask.any():
            raise ValueError(f"{expected}, got shape {mask.shape} with {mask.sum()} True")
    if not given:
        return mask, None
    parameters = given.get("parameters")
    if isinstance(parameters, Sequence) and not isinstance(parameters, str) and len(parameters) != num_envs:
        raise ValueError(f"options['parameters'] must be a mapping or {num_envs} of them, got {len(parameters)}")
    columns = {name: _entries(f"options[{name!r}]", value, num_envs) for name, value in given.items()}
    if isinstance(parameters, Mapping):
        named = {
            name: _entries(f"options['parameters'][{name!r}]", value, num_envs) for name, value in parameters.items()
        }
        columns["parameters"] = [{name: entries[i] for name, entries in named.items()} for i in range(num_envs)]
    return mask, [checked_options({name: entries[i] for name, entries in columns.items()}) for i in range(num_envs)]
