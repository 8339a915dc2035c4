"""The whole of it in a few minutes: the paper's amplitude curve, an agent for each actuator, and the comparison.

    python scripts/demo.py                       writes demo_output/
    python scripts/demo.py --out elsewhere       into another folder

Draws Fig. 3, trains PPO on the force and on the belt task, evaluates passive, classical and learned controllers on the
same 100 starts, and draws what control does: the closed-loop amplitude over the passive curve, and histories in which
it is switched on.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scripts.figures import common, paper
from sd_friction_env import OscillatorParameters, SDFrictionEnv, Table, limit_cycle, simulate
from sd_friction_env.control.policies import Policy, ZeroPolicy
from sd_friction_env.environments.ids import environment_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import classical, evaluation, training
from sd_friction_env.learning.plan import make_plan
from sd_friction_env.physics.simulation import Trajectory, amplitude
from sd_friction_env.pictures import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TASKS = {task: environment_id(task) for task in ("force", "belt")}
SWEPT_BELT_SPEEDS = np.arange(0.05, 0.451, 0.025)
SWITCH_ON = 300  # control intervals of passive motion in the histories


@plotting.house_style()
def draw_before_and_after(histories: Mapping[str, Trajectory], switched_on: float, title: str) -> "Figure":
    """Draw displacement, velocity and phase portrait of controlled histories, control starting at ``switched_on``.

    Args:
        histories: one row of panels each, by name. switched_on: time at which control begins. title: of the figure.
    """
    figure, axes = plotting.new_figure(11.0, 2.9 * len(histories), len(histories), 3, width_ratios=(2.2, 2.2, 1.6))
    figure.suptitle(title)
    for row, (name, history) in zip(axes, histories.items(), strict=True):
        t, x, v, belt = history.t, history.x, history.v, history.v_belt
        before = t <= switched_on
        for axis, values, label in ((row[0], x, r"displacement $x$"), (row[1], v, r"velocity $\dot x$")):
            axis.axvspan(switched_on, t[-1], color="0.95", zorder=0)
            axis.plot(t[before], values[before], color=plotting.GREY, linewidth=1.4)
            axis.plot(t[~before], values[~before], color=plotting.GREEN, linewidth=1.4)
            axis.set(xlabel=r"time $\tau$", ylabel=label)
            axis.margins(x=0)
        row[0].set_title(name, loc="left", fontsize=10)
        row[1].plot(t, belt, color=plotting.BLACK, linewidth=1.0, linestyle=(0, (4, 2)), label=r"belt $v_b$")
        row[1].legend(loc="lower right", fontsize=8, frameon=False)
        row[2].plot(x[before], v[before], color=plotting.GREY, linewidth=1.2, label="passive")
        row[2].plot(x[~before], v[~before], color=plotting.GREEN, linewidth=1.2, label="controlled")
        row[2].plot(x[-1:], v[-1:], marker="o", color=plotting.BLACK, markersize=5, linestyle="none", label="end")
        row[2].set(xlabel=r"$x$", ylabel=r"$\dot x$")
        row[2].legend(loc="lower left", fontsize=8, frameon=False)
    return figure


def heading(text: str) -> None:
    """Print what comes next."""
    print(f"\n{text}\n{'-' * len(text)}", flush=True)


def closed_loop_amplitude(policy: Policy, env_id: str, belt_speed: float) -> float:
    """Return the amplitude over the last quarter of an episode at another nominal belt speed than trained for."""
    env = make_env(env_id)
    start = {"parameters": {"belt_speed": belt_speed}}
    observation, _ = env.reset(seed=0, options=start)
    low, high, state = np.inf, -np.inf, None
    steps = env.task.episode_steps
    for step in range(steps):
        action, state = policy.predict(observation[None], state, np.array([step == 0]))
        observation, _, _, _, info = env.step(action[0])
        if step >= 3 * steps // 4:
            low, high = min(low, info["x_min"]), max(high, info["x_max"])
    return amplitude(low, high)


def switched_on(policy: Policy, env_id: str) -> Trajectory:
    """Return a history on the passive cycle in which control is switched on after a while."""
    env = SDFrictionEnv(actuator="force" if env_id == TASKS["force"] else "belt_speed", episode_steps=10**6)
    observation, first = env.reset(seed=0, options={"phase": 0.0})
    zero, state = ZeroPolicy(), None
    drive: list[tuple[float, float]] = []
    for step in range(2 * SWITCH_ON):
        if step < SWITCH_ON:
            action, _ = zero.predict(observation[None])
        else:
            action, state = policy.predict(observation[None], state, np.array([step == SWITCH_ON]))
        observation, _, _, _, info = env.step(action[0])
        drive.append((info["force"], info["belt_acceleration"]))
    force, belt_acceleration = np.array(drive).T
    hold = env.task.control_interval
    # The same held actions again, sampled finely between the control instants.
    return simulate(
        env.parameters,
        first["x"],
        first["v"],
        len(drive) * hold,
        dt=0.02,
        force=force,
        belt_acceleration=belt_acceleration,
        hold=hold,
    )


def passive_curve(out: Path) -> Table:
    """Compute and draw Fig. 3; return its table."""
    paper.compute_3().to_csv(out / "figure_3.csv")
    table = Table.from_csv(out / "figure_3.csv")
    paper.draw_3(table, out / "figure_3.png")
    for geometry in ("cubic", "exact"):
        row = common.select(table, geometry=geometry)
        peak = np.nanmax(row["amplitude"])
        print(f"{geometry:6} v_b0 {row['v_b0'][0]:.6f}   v_b1 {row['v_b1'][0]:.6f}   greatest amplitude {peak:.4f}")
    cycle = limit_cycle(OscillatorParameters())
    stuck = f"stuck {100 * cycle.stick_fraction:.0f}% of the time"
    print(f"the nominal machine squeals: amplitude {cycle.amplitude:.4f}, period {cycle.period:.3f}, {stuck}")
    return table


def compare(task: str, policies: dict[str, Policy]) -> list[dict[str, Any]]:
    """Evaluate controllers on the protocol's starts; return a summary row of each, passive first."""
    env_id = TASKS[task]
    seeds = evaluation.EVALUATION_SEEDS
    passive = evaluation.passive_episodes(env_id)
    passive_table = evaluation.metrics(passive, passive)
    optimal = evaluation.optimal_returns(env_id, seeds)
    rows = []
    for name, policy in policies.items():
        table = evaluation.evaluate(policy, env_id, passive=passive)
        rows.append(evaluation.summarise(f"{task}: {name}", table, passive_table, optimal))
    return rows


def train(task: str, out: Path, seed: int, timesteps: int | None) -> training.Result:
    """Train PPO for a task; the run folder is a new one."""
    plan = make_plan(TASKS[task], "ppo", seed=seed, timesteps=timesteps)
    command = " ".join(["python", "scripts/demo.py", *sys.argv[1:]])
    result = training.train(plan, out / "runs" / f"{task}-ppo", force=True, command=command)
    print(f"{result.steps:,} steps in {result.seconds:.0f} s", flush=True)
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="folder to write (default: demo_output)")
    parser.add_argument("--seed", type=int, default=0, help="of the training (default: 0)")
    parser.add_argument("--timesteps", type=int, help="of each training (default: as the hyperparameter files say)")
    options = parser.parse_args(arguments)
    out: Path = options.out
    begun = time.perf_counter()
    try:
        out.mkdir(parents=True, exist_ok=True)

        heading("1/4  The passive oscillator (Fig. 3 of the paper)")
        table = passive_curve(out)

        learned = {}
        for number, task in enumerate(TASKS, start=2):
            heading(f"{number}/4  Training PPO to suppress it by {'a force' if task == 'force' else 'the belt speed'}")
            learned[task] = train(task, out, options.seed, options.timesteps).policy

        heading("4/4  Passive, classical and learned on the same 100 starts")
        rows = []
        for task, env_id in TASKS.items():
            best, feedback = classical.best_controller(env_id)
            policies: dict[str, Policy] = {"passive": ZeroPolicy(), f"{best}, tuned": feedback, "PPO": learned[task]}
            rows += compare(task, policies)
        print(evaluation.format_summary(rows))
        print("\nscore: 0 passive, 1 optimal; suppressed: share of episodes that end still, slipping, at nominal speed")
        Table.from_rows(rows, {"command": " ".join(sys.argv)}).to_csv(out / "comparison.csv")

        points = {}
        for task, env_id in TASKS.items():
            amplitudes = [closed_loop_amplitude(learned[task], env_id, speed) for speed in SWEPT_BELT_SPEEDS.tolist()]
            points[f"PPO by {task}"] = (SWEPT_BELT_SPEEDS.tolist(), amplitudes)
        paper.draw_3(table, out / "figure_3_controlled.png", {"exact": points}, OscillatorParameters().belt_speed)
        histories = {f"control by {task}": switched_on(learned[task], env_id) for task, env_id in TASKS.items()}
        when = SWITCH_ON * make_env(TASKS["force"]).task.control_interval
        figure = draw_before_and_after(histories, when, "Before and after control is switched on")
        plotting.save_figure(figure, out / "before_and_after.png")
    except OSError as error:
        print(f"demo: cannot write into --out {str(out)!r}: {error}", file=sys.stderr)
        return 1
    except (ValueError, TypeError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\ndemo: interrupted; what was finished is in {out}", file=sys.stderr)
        return 130
    heading(f"Done in {time.perf_counter() - begun:.0f} s: look at")
    for name in ("figure_3.png", "figure_3_controlled.png", "before_and_after.png", "comparison.csv", "runs"):
        print(f"  {out / name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
