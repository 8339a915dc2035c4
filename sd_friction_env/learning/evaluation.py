"""How well a controller does: episodes from fixed starts, per-episode metrics, and the score against the optimum.

Every metric is taken from what the integrator reports of whole control intervals (extremes of x, time stuck, mean of
the belt's speed), never from samples at their ends.
"""

import functools
import json
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import scipy.stats
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import SDFrictionEnv, SDFrictionVectorEnv, Table
from sd_friction_env.control.policies import Policy, State, ZeroPolicy

Array = NDArray[np.float64]

# Seeds of reset(). Training draws its own from 2**32 on (training.training_seed), so these are never trained on.
EVALUATION_SEEDS = range(1_000_000, 1_000_100)  # the protocol's 100 episodes: reported, and used for nothing else
VALIDATION_SEEDS = range(2_000_000, 2_000_100)  # to choose the best model of a run, and gains

SUPPRESSED_AMPLITUDE = 0.05  # of the passive amplitude
SUPPRESSED_BELT_SPEED = 0.02  # deviation of the mean from nominal, relative
SMALLEST_PASSIVE_AMPLITUDE = 1e-3  # where passive motion dies out by itself, amplitudes are compared with this

_REWARD_TERMS = ("vibration", "effort", "stick", "contact_loss")
_RECORDED = (*(f"reward_{name}" for name in _REWARD_TERMS), "x_min", "x_max", "stick_fraction", "action")


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """What n episodes of at most T control intervals did; NaN after the end of one that ended early.

    Attributes:
        seeds: of reset(), shape (n,).
        control_interval: its length.
        belt_speed: nominal belt speed of each episode, shape (n,).
        reward: as the environment gave it, shape (n, T); the four terms of it are in ``reward_terms``, (4, n, T).
        x_min, x_max: extremes of x in each interval, shape (n, T).
        stick_fraction, mean_belt_speed, action: of each interval, shape (n, T); the action as applied.
        completed: whether the episode ran for all of T, shape (n,).
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


def make_env(env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> SDFrictionEnv:
    """Return a bare environment (no wrappers: they cost more than the step itself)."""
    env = gym.make(env_id, **dict(env_kwargs or {})).unwrapped
    if not isinstance(env, SDFrictionEnv):
        raise TypeError(f"env_id must name an environment of sd_friction_env, got {env_id!r}")
    return env


def checked_seeds(seeds: Iterable[Any]) -> list[int]:
    """Return seeds of episodes as plain integers.

    Raises:
        TypeError, ValueError: naming the first that is no whole number >= 0, or if there is none.
    """
    if isinstance(seeds, str | bytes) or not isinstance(seeds, Iterable):
        raise TypeError(f"seeds must be whole numbers >= 0 in a sequence, got {seeds!r}")
    checked = []
    for seed in seeds:
        if isinstance(seed, bool | np.bool_):
            raise TypeError(f"seeds must be whole numbers >= 0, got {seed!r} among them")
        try:
            checked.append(operator.index(seed))
        except TypeError:
            raise TypeError(f"seeds must be whole numbers >= 0, got {seed!r} among them") from None
        if checked[-1] < 0:
            raise ValueError(f"seeds must be whole numbers >= 0, got {seed!r} among them")
    if not checked:
        raise ValueError("seeds must be one or more whole numbers >= 0, got none")
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
    """Run one episode from ``reset(seed=...)`` for each seed, all side by side, and return what happened.

    Args:
        policy: acts on the batch of all observations.
        env_id: of one of our environments. seeds: at least one, each at least 0. env_kwargs: of the environment.
        options: of the reset, as :class:`SDFrictionVectorEnv` takes them, such as parameters of each episode.

    Raises:
        TypeError, ValueError: if there is no seed, one is no such number, an option is not as said, or the policy does
            not fit the environment.
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
    """Half the distance between the extremes of x from interval ``first`` on; NaN if the episode ended early."""
    x_max, x_min = episodes.x_max[:, first:].max(axis=1), episodes.x_min[:, first:].min(axis=1)
    return np.asarray(0.5 * (x_max - x_min))


def metrics(episodes: Episodes, passive: Episodes) -> Table:
    """Return one row per episode.

    Args:
        episodes: to be judged. passive: of the same starts without control.

    Returns:
        ``seed``; ``return`` and its terms ``return_vibration``, ``return_effort``, ``return_stick``,
        ``return_contact_loss``; ``steps``; ``completed``; over the last half of the episode ``amplitude`` and
        ``passive_amplitude``, ``amplitude_reduction`` (1: still, 0: as passive), ``stick_fraction`` and
        ``belt_speed_ratio`` (mean belt speed over nominal); over its last quarter ``late_amplitude``,
        ``late_passive_amplitude``, ``late_stick_fraction``, ``late_belt_speed_ratio`` and ``residual_action`` (rms);
        ``rms_action`` and ``peak_action`` of all of it; ``settling_time`` (the time from which on x stays within 5% of
        the passive amplitude of where it ends up; NaN: never); ``suppressed``: over the last quarter, the amplitude is
        under 5% of passive, nothing sticks and the mean belt speed is within 2% of nominal.
        What belongs to the end of an episode is NaN if it ended early; it then is not suppressed.

    Raises:
        ValueError: if the passive episodes are not of the same seeds and length.
    """
    if not np.array_equal(episodes.seeds, passive.seeds) or episodes.reward.shape != passive.reward.shape:
        raise ValueError("passive must hold the same episodes: same seeds, same length")
    steps = episodes.reward.shape[1]
    half, quarter = steps - max(1, steps // 2), steps - max(1, steps // 4)
    floor = SMALLEST_PASSIVE_AMPLITUDE
    amplitude, late_amplitude = _amplitude(episodes, half), _amplitude(episodes, quarter)
    # A passive episode may lose contact where the controlled one does not: there is then nothing to compare with.
    passive_amplitude = np.maximum(_amplitude(passive, half), floor)
    late_passive = np.maximum(_amplitude(passive, quarter), floor)
    band = SUPPRESSED_AMPLITUDE * late_passive
    late_stick = episodes.stick_fraction[:, quarter:].mean(axis=1)
    late_ratio = episodes.mean_belt_speed[:, quarter:].mean(axis=1) / episodes.belt_speed
    suppressed = (
        episodes.completed
        & (late_amplitude < band)
        & (late_stick == 0.0)
        & (np.abs(late_ratio - 1.0) <= SUPPRESSED_BELT_SPEED)
    )
    centre = 0.5 * (episodes.x_max[:, quarter:].max(axis=1) + episodes.x_min[:, quarter:].min(axis=1))
    outside = (episodes.x_max > (centre + band)[:, None]) | (episodes.x_min < (centre - band)[:, None])
    last_outside = np.where(outside.any(axis=1), steps - np.argmax(outside[:, ::-1], axis=1), 0)
    settled = episodes.completed & (late_amplitude < band)
    return Table(
        {
            "seed": episodes.seeds,
            "return": np.nansum(episodes.reward, axis=1),
            **{
                f"return_{name}": np.nansum(terms, axis=1)
                for name, terms in zip(_REWARD_TERMS, episodes.reward_terms, strict=True)
            },
            "steps": np.isfinite(episodes.reward).sum(axis=1),
            "completed": episodes.completed,
            "amplitude": amplitude,
            "passive_amplitude": passive_amplitude,
            "amplitude_reduction": 1.0 - amplitude / passive_amplitude,
            "stick_fraction": episodes.stick_fraction[:, half:].mean(axis=1),
            "belt_speed_ratio": episodes.mean_belt_speed[:, half:].mean(axis=1) / episodes.belt_speed,
            "late_amplitude": late_amplitude,
            "late_passive_amplitude": late_passive,
            "late_stick_fraction": late_stick,
            "late_belt_speed_ratio": late_ratio,
            "residual_action": np.sqrt(np.mean(episodes.action[:, quarter:] ** 2, axis=1)),
            "rms_action": np.sqrt(np.nanmean(episodes.action**2, axis=1)),
            "peak_action": np.nanmax(np.abs(episodes.action), axis=1),
            "settling_time": np.where(settled, last_outside * episodes.control_interval, np.nan),
            "suppressed": suppressed,
        }
    )


def evaluate(
    policy: Policy,
    env_id: str,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    passive: Episodes | None = None,
) -> Table:
    """Run one episode per seed and return the table of :func:`metrics`.

    Args:
        policy, env_id, seeds, env_kwargs: as :func:`run_episodes` takes them.
        passive: the same episodes without control, if they are at hand (else they are run too, and kept).
    """
    if passive is None:
        passive = passive_episodes(env_id, seeds, env_kwargs)
    return metrics(run_episodes(policy, env_id, seeds, env_kwargs), passive)


def passive_episodes(
    env_id: str, seeds: Sequence[int] = EVALUATION_SEEDS, env_kwargs: Mapping[str, Any] | None = None
) -> Episodes:
    """Return the episodes of :func:`run_episodes` without control."""
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
    """Return the best known return from each start, shape (n,), NaN where none is stored; None where none is at all
    (other arguments, tiers without an optimum, other seeds).

    Raises:
        RuntimeError: if the environment has changed since the optimum was computed, or its file is damaged.
    """
    if env_kwargs:
        return None
    try:
        from sd_friction_env.learning import optimal
    except ImportError:
        return None
    stored = optimal.stored_returns(env_id, optimal.OPTIMUM_DIRECTORY)
    if stored is None:
        return None
    known = np.array([stored.get(int(seed), np.nan) for seed in seeds])
    return known if np.isfinite(known).any() else None


# The score and its interval -------------------------------------------------------------------------------------------

CONFIDENCE = 0.95
RESAMPLES = 2000  # of a bootstrap
Interval = tuple[float, float]
_NO_INTERVAL: Interval = (float("nan"), float("nan"))


def _compared(returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike) -> Array:
    """Return the three, shape (3, n), in the episodes of which the optimum is known (not NaN).

    Raises:
        ValueError: if the three are not of one shape, or there is no such episode.
    """
    parts = [np.asarray(values, dtype=float) for values in (returns, passive, optimal)]
    if len({part.shape for part in parts}) > 1 or parts[0].ndim != 1 or not np.isfinite(parts[2]).any():
        shapes = ", ".join(str(part.shape) for part in parts)
        raise ValueError(f"returns, passive and optimal must be of the same episodes, got shapes {shapes}")
    return np.stack(parts)[:, np.isfinite(parts[2])]


def score(returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike) -> float:
    """Return (mean return - mean passive)/(mean optimal - mean passive) over the same episodes: 0 passive, 1 optimal.

    Episodes of which the optimum is not known (NaN) are left out.

    Raises:
        ValueError: if the three are not of one shape (n,), or the optimum is no better than passive.
    """
    mean, mean_passive, mean_optimal = _compared(returns, passive, optimal).mean(axis=1).tolist()
    gap = mean_optimal - mean_passive
    if not gap > 0.0:
        raise ValueError(f"the optimum must be better than passive, got means {mean_optimal} and {mean_passive}")
    return float((mean - mean_passive) / gap)


def score_interval(
    returns: ArrayLike, passive: ArrayLike, optimal: ArrayLike, *, seed: int = 0, resamples: int = RESAMPLES
) -> Interval:
    """Return the 95% interval of a score: the percentile bootstrap over episodes, the three resampled together.

    Args:
        returns, passive, optimal: as :func:`score` takes them; fewer than two episodes have no interval (NaN).
        seed: of the resampling. resamples: how many.
    """
    compared = _compared(returns, passive, optimal)
    n = compared.shape[1]
    if n < 2:
        return _NO_INTERVAL
    drawn = np.random.default_rng(seed).integers(n, size=(resamples, n))
    mean, mean_passive, mean_optimal = (values[drawn].mean(axis=1) for values in compared)
    return _middle((mean - mean_passive) / (mean_optimal - mean_passive))


def _middle(values: Array) -> Interval:
    low, high = np.quantile(values, (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)).tolist()
    return low, high


def share_interval(hits: int, of: int) -> Interval:
    """Return the 95% interval of a share, by Wilson's score (unlike a bootstrap, it is not empty at 0 and 1)."""
    found = scipy.stats.binomtest(hits, of).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def interquartile_mean(values: ArrayLike) -> float:
    """Return the mean of the middle half of all values (a quarter of them, rounded down, is cut at each end)."""
    return float(scipy.stats.trim_mean(np.ravel(values), 0.25))


def run_interval(scores: Sequence[ArrayLike], *, seed: int = 0, resamples: int = RESAMPLES) -> Interval:
    """Return the 95% interval of the interquartile mean over training runs, by the stratified bootstrap.

    Runs are resampled with replacement within each task, and the interquartile mean is taken over all of them (Agarwal
    et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021).

    Args:
        scores: of each task, those of its runs, shape (runs,). With one run for each task there is no interval (NaN).
        seed: of the resampling. resamples: how many.

    Raises:
        ValueError: if there is no task, or one has no runs.
    """
    tasks = [np.asarray(task, dtype=float) for task in scores]
    if not tasks or any(task.ndim != 1 or not task.size for task in tasks):
        raise ValueError(f"scores must be one or more sequences of one or more numbers, got {scores!r}")
    if max(task.size for task in tasks) < 2:
        return _NO_INTERVAL
    rng = np.random.default_rng(seed)
    drawn = [task[rng.integers(task.size, size=(resamples, task.size))] for task in tasks]
    return _middle(np.asarray(scipy.stats.trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)))


# Name in a summary, column it is the mean of. NaN (ended early, never settled) is left out of means.
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
    """Return one row for a controller: means over its episodes, its score and its suppressed fraction, both with the
    ends of their 95% intervals (``score_low`` and so on).

    Args:
        name: of the controller. table: of :func:`metrics`. passive: the same for no control.
        optimal: best returns of the same starts, NaN where unknown, or None (the score then is NaN).
        seed, resamples: of the score's bootstrap.
    """
    row: dict[str, Any] = {"controller": name, "return": float(table["return"].mean())}
    row["score"], (row["score_low"], row["score_high"]), row["scored_episodes"] = float("nan"), _NO_INTERVAL, 0
    if optimal is not None:
        returns = table["return"], passive["return"], optimal
        row["score"], row["scored_episodes"] = score(*returns), int(np.isfinite(optimal).sum())
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
    "suppressed": "{:.0%}",
    "amplitude": "{:.5f}",
    "reduction": "{:.2%}",
    "stick": "{:.4f}",
    "belt_speed": "{:.4f}",
    "settling": "{:.1f}",
    "rms_action": "{:.3f}",
    "residual": "{:.4f}",
    "peak_action": "{:.3f}",
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
