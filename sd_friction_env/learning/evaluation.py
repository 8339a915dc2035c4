"""Evaluation of controllers: episodes from fixed starts, metrics of each episode, and the score against the optimum.

Every metric uses what the integrator reports of whole control intervals (extremes of x, time stuck, mean belt speed),
never samples at their ends.
"""

import functools
import json
import operator
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sd_friction_env import SDFrictionEnv, SDFrictionVectorEnv, Table
from sd_friction_env.control.policies import Policy, State, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import optimal
from sd_friction_env.learning.scores import NO_INTERVAL, RESAMPLES, credited_score, score, score_interval
from sd_friction_env.physics.parameters import checked_number
from sd_friction_env.physics.starts import share_interval

Array = NDArray[np.float64]

# Seeds of reset(). Training draws its own from 2**32 on (training.training_seed), so training never sees these.
EVALUATION_SEEDS = range(1_000_000, 1_000_100)  # the protocol's 100 episodes: for reports only
VALIDATION_SEEDS = range(2_000_000, 2_000_100)  # to choose the best model of a run, and gains

SUPPRESSED_AMPLITUDE = 0.05  # of the passive amplitude
SUPPRESSED_BELT_SPEED = 0.02  # deviation of the mean from nominal, relative
SMALLEST_PASSIVE_AMPLITUDE = 1e-3  # replaces that of passive motion that dies out by itself

_REWARD_TERMS = ("vibration", "effort", "stick", "contact_loss")
_RECORDED = (*(f"reward_{name}" for name in _REWARD_TERMS), "x_min", "x_max", "stick_fraction", "action")


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Record of n episodes of at most T control intervals; NaN after the end of one that ended early.

    Attributes:
        seeds: of reset(), shape (n,).
        control_interval: its length.
        belt_speed: nominal belt speed of each episode, shape (n,).
        reward: of the environment, shape (n, T); ``reward_terms`` are its four terms, (4, n, T).
        x_min, x_max: extremes of x in each interval, shape (n, T).
        stick_fraction, mean_belt_speed, action: of each interval, shape (n, T); the action is the applied one.
        completed: whether the episode ran for all T intervals, shape (n,).
    """

    seeds: NDArray[np.int64]
    control_interval: float
    belt_speed: Array
    reward: Array
    reward_terms: Array
    x_min: Array
    x_max: Array
    stick_fraction: Array
    mean_belt_speed: Array
    action: Array
    completed: NDArray[np.bool_]


def checked_seeds(seeds: Iterable[Any]) -> list[int]:
    """Return seeds of episodes as plain integers.

    Raises:
        TypeError, ValueError: naming the first that is not a whole number >= 0, or if there is none.
    """
    rule = "seeds must be one or more whole numbers >= 0 in a sequence"
    if isinstance(seeds, str | bytes) or not isinstance(seeds, Iterable):
        raise TypeError(f"{rule}, got {seeds!r}")
    checked = []
    for seed in seeds:
        try:
            checked.append(operator.index(seed))
        except TypeError:
            raise TypeError(f"{rule}, got {seed!r} among them") from None
        if isinstance(seed, bool | np.bool_):
            raise TypeError(f"{rule}, got {seed!r} among them")
        if checked[-1] < 0:
            raise ValueError(f"{rule}, got {seed!r} among them")
    if not checked:
        raise ValueError(f"{rule}, got none")
    return checked


def nominal_draws(env: SDFrictionEnv, n: int) -> dict[str, Array]:
    """Return the nominal values, shape (n,), of the parameters that an environment draws: nothing is drawn then."""
    return {name: np.full(n, getattr(env.nominal, name)) for name in env.task.randomise}


def run_episodes(
    policy: Policy,
    env_id: str,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    env_kwargs: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Episodes:
    """Run one episode from ``reset(seed=...)`` for each seed, all side by side, and return the record.

    Args:
        policy: acts on the batch of all observations.
        env_id: of one of our environments. seeds: at least one, each at least 0. env_kwargs: of the environment.
        options: of the reset, as :class:`SDFrictionVectorEnv` takes them, such as parameters of each episode.

    Raises:
        TypeError, ValueError: if a seed or an option is not allowed, or the policy does not fit the environment.
    """
    seeds = checked_seeds(seeds)
    make_env(env_id, env_kwargs)  # refuses what is not ours
    n = len(seeds)
    made = gym.make_vec(env_id, n, info_keys=(*_RECORDED, "v_belt"), **dict(env_kwargs or {}))
    envs = made.unwrapped
    assert isinstance(envs, SDFrictionVectorEnv)
    steps = envs.task.episode_steps
    observations, _ = envs.reset(seed=seeds, options=options)
    belt_speed = np.array([parameters.belt_speed for parameters in envs.get_attr("parameters")])
    record = np.full((steps, 2 + len(_RECORDED), n), np.nan)
    v_belt = belt_speed.copy()
    running = np.ones(n, dtype=bool)
    completed = np.zeros(n, dtype=bool)
    state: State = None
    starts = np.ones(n, dtype=bool)
    for t in range(steps):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        actions = np.asarray(actions)
        if actions.shape != (n, 1):
            raise ValueError(f"the policy returned actions of shape {actions.shape}, not ({n}, 1)")
        starts = np.zeros(n, dtype=bool)
        observations, rewards, terminated, truncated, info = envs.step(actions)
        values = np.stack([rewards, *(info[name] for name in _RECORDED), 0.5 * (v_belt + info["v_belt"])])
        record[t] = np.where(running, values, np.nan)  # the belt accelerates evenly: the mean of its ends is exact
        v_belt = info["v_belt"]
        completed |= running & truncated & ~terminated
        running &= ~(terminated | truncated)
        if not running.any():
            break
    envs.close()
    columns = record.transpose(1, 2, 0)
    return Episodes(
        seeds=np.array(seeds),
        control_interval=envs.task.control_interval,
        belt_speed=belt_speed,
        reward=columns[0],
        reward_terms=columns[1:5],
        x_min=columns[5],
        x_max=columns[6],
        stick_fraction=columns[7],
        action=columns[8],
        mean_belt_speed=columns[9],
        completed=completed,
    )


def _amplitude(episodes: Episodes, first: int) -> Array:
    """Return half the distance between the extremes of x from interval ``first`` on; NaN if the episode ended early."""
    x_max, x_min = episodes.x_max[:, first:].max(axis=1), episodes.x_min[:, first:].min(axis=1)
    return np.asarray(0.5 * (x_max - x_min))


def _part(episodes: Episodes, passive: Episodes, first: int, prefix: str) -> dict[str, Array]:
    """Return the metrics of the part of the episodes from interval ``first`` on, their names with a prefix."""
    # A passive episode may lose contact where the controlled one does not: the amplitudes are then not comparable.
    found = {
        "amplitude": _amplitude(episodes, first),
        "passive_amplitude": np.maximum(_amplitude(passive, first), SMALLEST_PASSIVE_AMPLITUDE),
        "stick_fraction": episodes.stick_fraction[:, first:].mean(axis=1),
        "belt_speed_ratio": episodes.mean_belt_speed[:, first:].mean(axis=1) / episodes.belt_speed,
    }
    return {f"{prefix}{name}": values for name, values in found.items()}


def metrics(episodes: Episodes, passive: Episodes) -> Table:
    """Return a table with one row per episode.

    Returns:
        ``seed``; ``return`` and its terms ``return_vibration``, ``return_effort``, ``return_stick``,
        ``return_contact_loss``; ``steps``; ``completed``; over the last half of the episode ``amplitude`` and
        ``passive_amplitude``, ``amplitude_reduction`` (1: still, 0: as passive), ``stick_fraction`` and
        ``belt_speed_ratio`` (mean belt speed over nominal); over its last quarter ``late_amplitude``,
        ``late_passive_amplitude``, ``late_stick_fraction``, ``late_belt_speed_ratio`` and ``residual_action`` (rms);
        over all of it ``rms_action`` and ``peak_action``; ``settling_time`` (the time after which x stays within 5% of
        the passive amplitude of its final centre; NaN: never); ``suppressed``: over the last quarter, the amplitude is
        under 5% of passive, nothing sticks and the mean belt speed is within 2% of nominal.
        An episode that ended early is not suppressed; metrics of its last half and quarter are NaN.

    Raises:
        ValueError: if the passive episodes are not of the same seeds and length.
    """
    if not np.array_equal(episodes.seeds, passive.seeds) or episodes.reward.shape != passive.reward.shape:
        raise ValueError(
            f"passive must hold episodes of the same seeds and length, got shape {passive.reward.shape} for "
            f"{episodes.reward.shape} and seeds from {passive.seeds[0]} for {episodes.seeds[0]}"
        )
    steps = episodes.reward.shape[1]
    quarter = steps - max(1, steps // 4)
    half, late = _part(episodes, passive, steps - max(1, steps // 2), ""), _part(episodes, passive, quarter, "late_")
    band = SUPPRESSED_AMPLITUDE * late["late_passive_amplitude"]
    is_small = episodes.completed & (late["late_amplitude"] < band)
    is_at_speed = np.abs(late["late_belt_speed_ratio"] - 1.0) <= SUPPRESSED_BELT_SPEED
    centre = 0.5 * (episodes.x_max[:, quarter:].max(axis=1) + episodes.x_min[:, quarter:].min(axis=1))
    outside = (episodes.x_max > (centre + band)[:, None]) | (episodes.x_min < (centre - band)[:, None])
    last_outside = np.where(outside.any(axis=1), steps - np.argmax(outside[:, ::-1], axis=1), 0)
    terms = {f"return_{name}": values for name, values in zip(_REWARD_TERMS, episodes.reward_terms, strict=True)}
    columns = {
        "seed": episodes.seeds,
        "return": np.nansum(episodes.reward, axis=1),
        **{name: np.nansum(values, axis=1) for name, values in terms.items()},
        "steps": np.isfinite(episodes.reward).sum(axis=1),
        "completed": episodes.completed,
        **half,
        **late,
        "residual_action": np.sqrt(np.mean(episodes.action[:, quarter:] ** 2, axis=1)),
        "rms_action": np.sqrt(np.nanmean(episodes.action**2, axis=1)),
        "peak_action": np.nanmax(np.abs(episodes.action), axis=1),
        "settling_time": np.where(is_small, last_outside * episodes.control_interval, np.nan),
        "suppressed": is_small & (late["late_stick_fraction"] == 0.0) & is_at_speed,
        "amplitude_reduction": 1.0 - half["amplitude"] / half["passive_amplitude"],
    }
    return Table({name: columns[name] for name in _METRICS})


_METRICS = (
    *("seed", "return", *(f"return_{name}" for name in _REWARD_TERMS), "steps", "completed"),
    *("amplitude", "passive_amplitude", "amplitude_reduction", "stick_fraction", "belt_speed_ratio"),
    *("late_amplitude", "late_passive_amplitude", "late_stick_fraction", "late_belt_speed_ratio", "residual_action"),
    *("rms_action", "peak_action", "settling_time", "suppressed"),
)


def evaluate(
    policy: Policy,
    env_id: str,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    passive: Episodes | None = None,
    options: Mapping[str, Any] | None = None,
) -> Table:
    """Run one episode per seed and return the table of :func:`metrics`.

    Args:
        policy, env_id, seeds, env_kwargs, options: as :func:`run_episodes` takes them.
        passive: the same episodes without control, if available (otherwise they are run, and cached).
    """
    if passive is None:
        passive = passive_episodes(env_id, seeds, env_kwargs, options)
    return metrics(run_episodes(policy, env_id, seeds, env_kwargs, options), passive)


def plants_off_nominal(env: SDFrictionEnv, n: int, error: float) -> dict[str, Any]:
    """Return the reset's options for n episodes whose plants are not the nominal one that controllers know.

    alpha, mu_m and belt_speed each differ from nominal by the share ``error``: the eight combinations of signs in turn.

    Args:
        env: of the nominal plant. n: number of episodes. error: in [0, 1).

    Raises:
        TypeError, ValueError: if the error is not such a number, or a plant would not be allowed.
    """
    error = checked_number("plant error", error, 0.0, 0.999)
    plants = []
    for i in range(n):
        signs = {name: 1.0 - 2.0 * (i >> bit & 1) for bit, name in enumerate(("alpha", "mu_m", "belt_speed"))}
        changes = {name: getattr(env.nominal, name) * (1.0 + sign * error) for name, sign in signs.items()}
        env.nominal.replace(**changes)
        plants.append(changes)
    return {"parameters": {name: np.array([plant[name] for plant in plants]) for name in plants[0]}}


def decision_milliseconds(
    policy: Policy, env_id: str, env_kwargs: Mapping[str, Any] | None = None, decisions: int = 20
) -> float:
    """Return the wall time in milliseconds of one decision for one environment: the median of several after one."""
    env = make_env(env_id, env_kwargs)
    observation, _ = env.reset(seed=VALIDATION_SEEDS[0])
    state, times = None, []
    for i in range(decisions + 1):
        begun = time.perf_counter()
        actions, state = policy.predict(observation[None], state, np.array([i == 0]), deterministic=True)
        times.append(time.perf_counter() - begun)
        observation, _, terminated, truncated, _ = env.step(actions[0])
        if terminated or truncated:
            break
    return float(1e3 * np.median(times[1:] or times))


def passive_episodes(
    env_id: str,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    env_kwargs: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Episodes:
    """Return the episodes of :func:`run_episodes` without control."""
    if options is not None:
        return run_episodes(ZeroPolicy(), env_id, seeds, env_kwargs, options)
    try:
        key = json.dumps(dict(env_kwargs or {}), sort_keys=True)
    except TypeError:  # arguments that are no plain data, such as a reward function
        return run_episodes(ZeroPolicy(), env_id, seeds, env_kwargs)
    return _passive_episodes(env_id, tuple(checked_seeds(seeds)), key)


@functools.lru_cache(maxsize=8)
def _passive_episodes(env_id: str, seeds: tuple[int, ...], env_kwargs: str) -> Episodes:
    return run_episodes(ZeroPolicy(), env_id, seeds, json.loads(env_kwargs))


# The optimum ----------------------------------------------------------------------------------------------------------


def optimal_returns(env_id: str, seeds: Sequence[int], env_kwargs: Mapping[str, Any] | None = None) -> Array | None:
    """Return the best known return from each start, shape (n,), NaN where none is stored; None if none is stored at all
    (other arguments, tiers without an optimum, other seeds).

    Raises:
        RuntimeError: if the environment has changed since the optimum was computed, or its file is damaged.
    """
    if env_kwargs:
        return None
    stored = optimal.stored_returns(env_id, optimal.OPTIMUM_DIRECTORY)
    if stored is None:
        return None
    known = np.array([stored.get(int(seed), np.nan) for seed in seeds])
    return known if np.isfinite(known).any() else None


# Summaries ------------------------------------------------------------------------------------------------------------

# Name in a summary, and the column whose mean it is. Means leave out NaN (ended early, never settled).
_SUMMARY = {
    "amplitude": "amplitude",
    "reduction": "amplitude_reduction",
    "stick": "stick_fraction",
    "belt_speed": "belt_speed_ratio",
    "settling": "settling_time",
    "rms_action": "rms_action",
    "residual": "residual_action",
}


def summarise(
    name: str, table: Table, passive: Table, optimal: Array | None, *, seed: int = 0, resamples: int = RESAMPLES
) -> dict[str, Any]:
    """Return one row for a controller: means over its episodes, score and suppressed fraction with the ends of their
    95% intervals (``score_low`` and so on), and ``credited``, the score with credit for suppressed episodes only.

    Args:
        name: of the controller. table: of :func:`metrics`. passive: the same for no control.
        optimal: best returns of the same starts, NaN where unknown; None: the score is NaN.
        seed, resamples: of the score's bootstrap.
    """
    row: dict[str, Any] = {"controller": name, "return": float(table["return"].mean())}
    row["score"] = row["credited"] = float("nan")
    (row["score_low"], row["score_high"]), row["scored_episodes"] = NO_INTERVAL, 0
    if optimal is not None:
        returns = table["return"], passive["return"], optimal
        row["score"], row["scored_episodes"] = score(*returns), int(np.isfinite(optimal).sum())
        row["credited"] = credited_score(table["return"], table["suppressed"], *returns[1:])
        row["score_low"], row["score_high"] = score_interval(*returns, seed=seed, resamples=resamples)
    row["suppressed"] = float(table["suppressed"].mean())
    row["suppressed_low"], row["suppressed_high"] = share_interval(int(table["suppressed"].sum()), table.n_rows)
    for key, column in _SUMMARY.items():
        finite = table[column][np.isfinite(table[column])]
        row[key] = float(finite.mean()) if finite.size else float("nan")
    row["peak_action"] = float(table["peak_action"].max())
    row["episodes"] = table.n_rows
    return row


_FORMATS = {
    "return": "{:.2f}",
    "score": "{:.3f}",
    "credited": "{:.3f}",
    "suppressed": "{:.0%}",
    "amplitude": "{:.5f}",
    "reduction": "{:.2%}",
    "stick": "{:.4f}",
    "belt_speed": "{:.4f}",
    "settling": "{:.1f}",
    "rms_action": "{:.3f}",
    "residual": "{:.4f}",
    "peak_action": "{:.3f}",
    "ms": "{:.2f}",
}


def format_summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows of :func:`summarise` as an aligned text table, intervals in brackets, "-" for no number."""
    names = ["controller", *_FORMATS]
    cells = [[name.replace("_", " ") for name in names]]
    for row in rows:
        line = [str(row["controller"])]
        for name, form in _FORMATS.items():
            value, interval = cell(row, name, form)
            line.append(f"{value} {interval}" if interval else value)
        cells.append(line)
    return aligned(cells)


def cell(row: Mapping[str, Any], name: str, form: str) -> tuple[str, str]:
    """Return a value of a summary as text, "-" for no number, and its interval in brackets, "" for none."""
    value, low, high = (row.get(key, float("nan")) for key in (name, f"{name}_low", f"{name}_high"))
    if not np.isfinite(value):
        return "-", ""
    return form.format(value), f"[{form.format(low)}, {form.format(high)}]" if np.isfinite(low) else ""


def aligned(cells: Sequence[Sequence[str]]) -> str:
    """Return rows of texts, the first one the heading, as a table with a rule under the heading."""
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = []
    for first, *others in cells:
        columns = [f"{text:>{width}}" for text, width in zip(others, widths[1:], strict=True)]
        lines.append("  ".join([first.ljust(widths[0]), *columns]))
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)
