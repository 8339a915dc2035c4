"""Curves of a report: other plants, single histories, and learning."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.stats

from sd_friction_env import OscillatorParameters, Table, amplitude_curve, simulate
from sd_friction_env.control.policies import Policy, State, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.report.agents import ENV_IDS, Agent, Row, by_algorithm
from sd_friction_env.learning.report.comparison import Effort

_SAMPLE = 0.05  # time between samples of a history
REACHED = (0.9, 0.95)  # scores whose time in training is reported
# What a sweep varies: label, first and last value.
SWEEPS = {
    "belt_speed": (r"belt speed $v_b$", 0.02, 0.5),
    "alpha": (r"$\alpha$", 0.5, 1.0),
    "friction_drop": (r"$\mu_s - \mu_m$", 0.01, 0.19),
}


def swept_parameters(sweep: str, values: Any, nominal: OscillatorParameters) -> dict[str, Any]:
    """Return the parameters of a plant of a sweep, or (n,) of n plants; "friction_drop" varies mu_m."""
    return {"mu_m": nominal.mu_s - values} if sweep == "friction_drop" else {sweep: values}


def sweep_plants(task: str, sweep: str, policies: Mapping[str, tuple[str, Policy]], effort: Effort) -> list[Row]:
    """Return the settled amplitude of each controller on each plant of a sweep, passive first.

    It is the largest over the starts of the amplitude over an episode's last quarter; NaN where contact is lost. The
    passive amplitude is that of the attractor (over the belt speed: Fig. 3 of the paper), at finer steps.

    Args:
        sweep: a key of ``SWEEPS``. policies: by name, each with the tier whose environment it sees.
    """
    values = np.linspace(*SWEEPS[sweep][1:], effort.points)
    each = np.repeat(values, effort.phases)
    seeds = np.tile(evaluation.EVALUATION_SEEDS[: effort.phases], len(values)).tolist()

    def episodes(policy: Policy, env_id: str) -> evaluation.Episodes:
        env = make_env(env_id)
        options = {"parameters": evaluation.nominal_draws(env, len(each)) | swept_parameters(sweep, each, env.nominal)}
        return evaluation.run_episodes(policy, env_id, seeds, options=options)

    def rows(name: str, tier: str, **columns: Any) -> list[Row]:
        where = {"task": task, "sweep": sweep, "controller": name, "tier": tier}
        return [where | row for row in Table(columns).rows()]

    nominal_id = ENV_IDS[task, "nominal"]
    nominal = make_env(nominal_id).nominal
    fine = np.linspace(*SWEEPS[sweep][1:], 4 * effort.points - 3)
    plants = [nominal.replace(**swept_parameters(sweep, value, nominal)) for value in fine.tolist()]
    attractors = [amplitude_curve(plant, plant.belt_speed)["amplitude"][0] for plant in plants]
    found = rows("passive", "nominal", value=fine, amplitude=attractors)
    passive, shape = episodes(ZeroPolicy(), nominal_id), (len(values), effort.phases)
    for name, (tier, policy) in policies.items():
        table = evaluation.metrics(episodes(policy, ENV_IDS[task, tier]), passive)
        amplitudes, suppressed = (table[column].reshape(shape) for column in ("late_amplitude", "suppressed"))
        columns = {"amplitude": amplitudes.max(axis=1), "suppressed": suppressed.mean(axis=1)}
        found += rows(name, tier, value=values, **columns)
    return found


def history(policy: Policy, env_id: str, seed: int) -> Table:
    """Return an episode of ``reset(seed=seed)`` sampled finely (t, x, v, v_belt, action)."""
    env = make_env(env_id)
    observation, first = env.reset(seed=seed)
    parameters, hold = env.parameters, env.task.control_interval
    state: State = None
    drive: list[tuple[float, float, float]] = []
    over = False
    while not over:
        action, state = policy.predict(observation[None], state, np.array([not drive]), deterministic=True)
        observation, _, terminated, truncated, info = env.step(action[0])
        drive.append((info["force"], info["belt_acceleration"], info["action"]))
        over = terminated or truncated
    force, belt_acceleration, action = np.array(drive).T
    start, end = (first["x"], first["v"]), len(drive) * hold
    path = simulate(parameters, *start, end, dt=_SAMPLE, force=force, belt_acceleration=belt_acceleration, hold=hold)
    held = np.minimum((path.t / hold + 1e-9).astype(int), len(drive) - 1)
    return Table({"t": path.t, "x": path.x, "v": path.v, "v_belt": path.v_belt, "action": action[held]})


def learning_curves(agents: Sequence[Agent]) -> list[Row]:
    """Return rows of return and suppressed fraction over steps and over seconds of training, for each algorithm of each
    task and tier: interquartile mean, smallest and largest of the runs, where all of them were evaluated."""
    rows: list[Row] = []
    for (task, tier), those in itertools.groupby(agents, key=lambda agent: (agent.task, agent.tier)):
        for (algorithm, group), over in itertools.product(list(by_algorithm(those)), ("steps", "seconds")):
            tables = [agent.evaluations for agent in group]
            first, last = max(t[over].min() for t in tables), min(t[over].max() for t in tables)
            at = np.unique(np.concatenate([t[over] for t in tables]))
            at = at[(at >= first) & (at <= last)]
            columns: dict[str, Any] = {"at": at}
            for name, column in (("return", "mean_return"), ("suppressed", "suppressed")):
                curves = np.array([np.interp(at, t[over], t[column]) for t in tables])
                columns |= {f"{name}_low": curves.min(axis=0), f"{name}_high": curves.max(axis=0)}
                columns[name] = scipy.stats.trim_mean(curves, 0.25, axis=0)
            where = {"task": task, "tier": tier, "algorithm": algorithm, "runs": len(group), "over": over}
            rows += [where | row for row in Table(columns).rows()]
    return rows


def training_times(agents: Sequence[Agent], passive: float, optimum: float) -> list[Row]:
    """Return the duration of each run, and the seconds until its evaluations first reached a score (NaN: never).

    These evaluations are of the validation episodes; the score uses the means of the evaluation episodes.
    """
    rows: list[Row] = []
    for agent in agents:
        seconds, returns = agent.evaluations["seconds"], agent.evaluations["mean_return"]
        row: Row = {"task": agent.task, "tier": agent.tier, "run": agent.name}
        row |= {"steps": float(agent.evaluations["steps"][-1]), "seconds": float(seconds[-1])}
        for score in REACHED:
            there = seconds[(returns - passive) / (optimum - passive) >= score]
            row[f"seconds_to_{score:g}"] = float(there[0]) if len(there) else float("nan")
        rows.append(row)
    return rows
