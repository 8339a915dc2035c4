"""Friction oscillators as a Gymnasium vector environment that steps in compiled code."""

import copy as copying
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.episodes import Draft, Episodes, Starts
from sd_friction_env.environments.info import (
    REWARD_TERMS,
    STEP_KEYS,
    BatchInfo,
    Buffers,
    checked_info_keys,
    episode_statistics,
)
from sd_friction_env.environments.members import Members, displays
from sd_friction_env.environments.options import apply_options, checked_batch_options, checked_seeds, real_array
from sd_friction_env.environments.single import RewardFunction, SDFrictionEnv
from sd_friction_env.environments.task import EPISODE_STEPS, FloatArray, IntegerArray
from sd_friction_env.physics.parameters import OscillatorParameters, checked_count

_MOST_ENVS = 2**24
_MOST_THREADS = 256
_PICTURED = ("x_min", "x_max", "stick_fraction", "force", "mode")  # what a picture shows of a step


class SDFrictionVectorEnv(Members):
    """
    ## Description

    ``num_envs`` environments of :class:`SDFrictionEnv`, stepped together in compiled code: ``gym.make_vec(id,
    num_envs=...)``. Environment i matches the single environment with the same seed bit for bit, whatever
    ``num_envs``, its position in the batch and the number of threads.

    ## Action Space, Observation Space, Rewards, Starting State, Episode End

    As of :class:`SDFrictionEnv`, with a leading axis of length ``num_envs``.

    ## Seeds

    ``reset(seed=7)`` seeds environment i with 7 + i; ``reset(seed=[...])`` with entry i of the list (None: no new
    seed).

    ## Options

    The options of :class:`SDFrictionEnv`, for the episodes that this reset starts. Each value may also be an array
    (num_envs,) with one entry per environment; ``parameters`` a mapping of names to numbers or such arrays, or a
    sequence of ``num_envs`` mappings. A sequence of ``num_envs`` mappings gives each environment its own options.
    ``reset_mask``, a boolean array (num_envs,), selects the environments to be reset; the others go on.

    ## Info

    A dictionary of arrays in Gymnasium's form: beside each array "name" is a mask "_name" (masks that are true
    throughout are one read-only array). ``reset`` reports everything. A step reports ``info_keys``, by default the
    reward terms, because writing all values takes longer than the step itself; ``info_keys="all"`` reports what the
    single environment reports. For environments that are reset within a step, info has what ``reset`` reports. When
    episodes end, ``statistics`` has their return, length, late amplitude and so on; the first four are also entries of
    info itself. All values are numbers (see :class:`SDFrictionEnv`).

    ## Arguments

    num_envs: in [1, 2**24].
    parameters, reward, and every field of :class:`Task`: as of :class:`SDFrictionEnv`. A ``reward`` function is called
        once per environment and step, which is slow; an array expression of ``info`` in a vector wrapper is fast.
    autoreset_mode: "NextStep" (the default), "SameStep" or "Disabled" (https://farama.org/Vector-Autoreset-Mode).
    threads: largest number of threads that share a step, in [1, 256]; each has at least 512 environments. More than 1
        pays where that many cores are idle. A process forked after threads have run uses one thread (start processes
        by "spawn" or "forkserver" to have threads in them).
    max_episode_steps: as of ``gym.make``: replaces ``episode_steps``; if both are given, the smaller one applies. None
        or -1: no limit of its own.
    copy: True returns new arrays at every step. False: the next step overwrites them (slightly faster).
    info_keys: "all", or the names of the single environment's info that a step reports.
    render_mode: "rgb_array" (:meth:`render` returns a tuple of frames) or "human" (a window for one environment).
    render_size: of a frame, as of :class:`SDFrictionEnv`.
    render_envs: positions of the environments that are drawn; None: the first 16 (of "human": the first).

    Raises:
        TypeError, ValueError: if an argument has the wrong type or is out of range.
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
        self._single = single = SDFrictionEnv(parameters, render_size=render_size, reward=reward, **task_arguments)
        keys = checked_info_keys(info_keys)
        self.info_keys = keys
        self._displays = displays(single, n, render_mode, render_envs)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.nominal, self.task, self.reward = single.nominal, single.task, reward
        self.single_observation_space, self.single_action_space = single.observation_space, single.action_space
        self.observation_space = batch_space(single.observation_space, n)
        self.action_space = batch_space(single.action_space, n)
        self._episodes = Episodes(self.nominal, self.task, n, self.threads)
        needed = STEP_KEYS if reward is not None else _PICTURED if self._displays else ()
        self._info = BatchInfo(n, self._episodes.width, keys, needed)
        self._actions = np.zeros(n)
        self._expected_actions = f"actions must be finite numbers in an array of shape ({n}, 1)"
        self._buffers: Buffers | None = None  # used again if nothing is copied
        self._over = np.zeros(0, np.int64)
        self._seeds: list[int | None] = [None] * n
        self._is_reset = False
        self._attributes: dict[str, list[Any]] = {}

    @property
    def step_keys(self) -> tuple[str, ...]:
        """Names that a step's info holds, in order."""
        return self._info.step_keys

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start episodes in all environments, or in those of ``options["reset_mask"]``; see the class.

        A reset that fails changes nothing.

        Returns:
            Observations (num_envs, size), float32, and info.

        Raises:
            TypeError, ValueError: if an option or a seed is not as said.
            gymnasium.error.ResetNeeded: if the first reset leaves environments out.
        """
        n = self.num_envs
        seeds = checked_seeds(seed, n)
        mask, options_of_each = checked_batch_options(options, n)
        which = np.arange(n) if mask is None else np.flatnonzero(mask)
        if not self._is_reset and len(which) < n:
            raise gym.error.ResetNeeded("reset all environments once before resetting some: the others have no state")
        keys, episodes = self._episodes.next_keys(which)
        new_seeds = list(self._seeds)
        stream = None if self._is_reset else copying.deepcopy(self.np_random)
        for place, i in enumerate(which.tolist()):
            if seeds[i] is not None:
                new_seeds[i] = seeds[i]
                keys[place], episodes[place] = seeding.np_random(seeds[i])[0].integers(2**62), 0
            elif stream is not None:
                keys[place], episodes[place] = stream.integers(2**62), 0
        draft = self._episodes.draft(which, keys, episodes)
        if options_of_each is not None:
            self._apply(draft, [options_of_each[i] for i in which.tolist()])
        starts = self._episodes.prepare(draft)
        # From here on nothing can fail.
        if stream is not None:
            self.np_random.bit_generator.state = stream.bit_generator.state
        self._seeds = new_seeds
        self._is_reset = True
        self._restart(which, starts)
        self._over = self._over[~np.isin(self._over, which)]
        info = self._info.reset(which, *self._episodes.start_info(which))
        observations = self._episodes.observations
        return observations.copy() if self.copy else observations, info

    def _apply(self, draft: Draft, options_of_each: Sequence[Mapping[str, Any]]) -> None:
        """Put the parameters and states that options set into a draft."""
        for place, options in enumerate(options_of_each):
            key, episode = int(draft.keys[place]), int(draft.episodes[place])
            drawn = self._episodes.drafted(draft, place)
            parameters, state = apply_options(self.task, drawn, options, key, episode)
            if "parameters" in options:
                self._episodes.put(draft, place, parameters)
            if state is not None:
                draft.x[place], draft.v[place] = state
                draft.placed[place] = True

    def _restart(self, which: IntegerArray, starts: Starts | None) -> None:
        self._episodes.restart(which, starts)
        self._clear_displays(which)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold the actions (num_envs, 1) for one control interval.

        If an episode cannot be started, nothing has been stepped; with autoreset_mode "SameStep" all environments have
        been stepped, and those whose episodes ended wait for a reset.

        Returns:
            Observations (num_envs, size), float32; rewards, float64; terminated; truncated; info.

        Raises:
            TypeError, ValueError: if the actions are not finite numbers of this shape; nothing has then been stepped.
            gymnasium.error.ResetNeeded: before the first reset; with autoreset_mode "Disabled" also if an
                environment's episode has ended.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        checked = self._checked_actions(actions)
        resting = self._over
        if len(resting) and self.autoreset_mode == AutoresetMode.DISABLED:
            some = ", ".join(map(str, resting[:5].tolist())) + (", ..." if len(resting) > 5 else "")
            raise gym.error.ResetNeeded(
                f"the episodes of environments {some} have ended: reset them with "
                "options={'reset_mask': ...} before step()"
            )
        next_starts = self._episodes.next_starts(resting) if len(resting) else None
        out = self._buffers or self._info.buffers()
        if not self.copy:
            self._buffers = out
        ended = self._episodes.advance(checked, self._info.rows, out)
        terminated, truncated = out.over
        report = self._info.report(out, self._episodes.counts)
        if self.reward is not None:
            self._replace_rewards(report, resting, out.rewards)
        for i, display in self._displays.items():
            if i not in resting:
                display.note({name: report[name][i].item() for name in _PICTURED})
        info = self._info.step(report)
        if len(resting):
            self._restart(resting, next_starts)
            out.rewards[resting] = 0.0
            out.over[:, resting] = False
            self._show_restarted(info, resting)
        if ended or len(resting):
            self._end(info, np.flatnonzero(terminated | truncated))
        if self.render_mode == "human":
            self.render()
        observations = self._episodes.observations.copy() if self.copy else self._episodes.observations
        return observations, out.rewards, terminated, truncated, info

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

    def _replace_rewards(self, report: Mapping[str, Any], resting: IntegerArray, rewards: FloatArray) -> None:
        """Write the rewards of the user's function."""
        assert self.reward is not None
        columns = {name: report[name].tolist() for name in STEP_KEYS}
        skipped = set(resting.tolist())
        for i in range(self.num_envs):
            if i not in skipped:
                rewards[i] = float(self.reward({name: values[i] for name, values in columns.items()}))
        self._episodes.state[kernel.STATE_RETURN, : self.num_envs] += rewards

    def _show_restarted(self, info: dict[str, Any], which: IntegerArray) -> None:
        restarted = self._info.reset(which, *self._episodes.start_info(which))
        self._info.replace_restarted(info, which, restarted)

    def _end(self, info: dict[str, Any], which: IntegerArray) -> None:
        """Add the statistics of episodes that have ended to info; reset their environments in mode "SameStep"."""
        if len(which):
            episodes = self._episodes
            custom = self.reward is not None
            statistics = episode_statistics(episodes.state, episodes.counts, which, custom, self.num_envs)
            ends = self._info.end(which, statistics)
            if self.autoreset_mode == AutoresetMode.SAME_STEP:
                final = self._info.final(info, which, ends, episodes.observations)
                self._over = which  # in case they cannot be restarted
                self._restart(which, episodes.next_starts(which))
                self._show_restarted(info, which)
                info.update(final)
                which = which[:0]
            else:
                info.update(ends)
        self._over = which

    def stagger(self) -> None:
        """Shorten the running episodes, each by another share, so that they do not all end in the same step.

        Environment i counts as having done i/num_envs of its episode's steps. From the second episode on the batch then
        has squealing, settling and settled motion in fixed shares, which helps a learner.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._is_reset:
            raise gym.error.ResetNeeded("call reset() before stagger(): no episode is running")
        steps = np.arange(self.num_envs) * self.task.episode_steps // self.num_envs
        for row in (kernel.COUNT_STEPS, kernel.COUNT_FIRST_STEP):
            self._episodes.counts[row, : self.num_envs] = steps
