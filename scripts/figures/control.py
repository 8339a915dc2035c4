"""Optimal control over the phase plane: the cost still to come and the best action, for both actuators.

Both come from the stored value functions (sd-friction optimum --policy). On belt they are those at the nominal belt
speed; along the controlled path it varies. There an action of .5 already asks for all of the belt's acceleration.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scripts.figures.common import metadata, select
from sd_friction_env import OscillatorParameters, Table, limit_cycle
from sd_friction_env.learning.optimal import TASKS, OptimalPolicy, Problem
from sd_friction_env.pictures import plotting

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PHASE = 0.35  # of the passive cycle, from breakaway: where control begins
PATH_STEPS = 250  # control intervals drawn
PIXELS = (161, 141)  # of the picture of the actions, along x and v
COSTS = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 80.0, 120.0, 200.0)
VELOCITIES = (-0.42, 0.25)  # shown
NAMES = {"force": "force on the mass", "belt": "belt speed, at its nominal value"}


def compute() -> Table:
    """Return the passive cycle and a controlled path of each task: x, v, v_belt and the action taken."""
    plant = OscillatorParameters()
    period = limit_cycle(plant).period
    parts = []
    for task, env_id in TASKS.items():
        policy = OptimalPolicy.load(env_id)
        start = np.array([[*policy.task.cycle_state(plant, PHASE), plant.belt_speed]])
        problem = Problem(env_id, policy.task, (plant,), start, ((),))
        round_once = int(np.ceil(period / policy.task.control_interval))
        for motion, steps in (("passive", round_once), ("controlled", PATH_STEPS)):
            states, rows = start, []
            for _ in range(steps + 1):
                action = policy.actions(states) if motion == "controlled" else np.zeros(1)
                rows.append([*states[0], *action])
                states, _ = problem.step(states, action)
            columns = dict(zip(("x", "v", "v_belt", "action"), np.array(rows).T, strict=True))
            labels = {"task": np.full(len(rows), task), "motion": np.full(len(rows), motion)}
            parts.append({**labels, "t": policy.task.control_interval * np.arange(len(rows)), **columns})
    return Table.stacked(parts, metadata([plant]))


def on_plane(policy: OptimalPolicy) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the grid's x, shape (n,), its v at the nominal belt speed, (m,), and the cost still to come, (n, m)."""
    grid, belt_speed = policy.grid, policy.parameters.belt_speed
    x, v_rel = (np.linspace(*axis) for axis in zip(grid.lows[:2], grid.highs[:2], grid.sizes[:2], strict=True))
    v = v_rel + belt_speed
    states = np.stack([*np.meshgrid(x, v, indexing="ij"), np.full((len(x), len(v)), belt_speed)], axis=-1)
    return x, v, -grid.interpolate(policy.values, states)


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw a row for each actuator: the cost still to come on the left, the best action on the right."""
    from matplotlib.colors import BoundaryNorm

    figure, axes = plotting.new_figure(10.5, 7.6, len(TASKS), 2, sharex=True, sharey=True)
    for (left, right), (task, env_id) in zip(axes, TASKS.items(), strict=True):
        policy = OptimalPolicy.load(env_id)
        belt_speed = policy.parameters.belt_speed
        x, v, cost = on_plane(policy)
        norm = BoundaryNorm(COSTS, 256)
        filled = left.contourf(x, v, cost.T, levels=COSTS, norm=norm, cmap="cividis_r", extend="max")
        figure.colorbar(filled, ax=left, label="cost still to come", ticks=COSTS)
        columns, rows = np.linspace(x[0], x[-1], PIXELS[0]), np.linspace(v[0], v[-1], PIXELS[1])
        plane = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        states = np.column_stack([plane, np.full(len(plane), belt_speed)])
        actions = policy.actions(states).reshape(len(rows), len(columns))
        image = right.pcolormesh(columns, rows, actions, cmap="PuOr", vmin=-1.0, vmax=1.0, rasterized=True)
        figure.colorbar(image, ax=right, label="best action $a$", ticks=(-1, -0.5, 0, 0.5, 1))
        for axis in (left, right):
            draw_motions(axis, table, task, belt_speed)
        left.set_title(f"actuator: {NAMES[task]}", loc="left", fontsize=10)
        left.set_ylabel(r"velocity $\dot x$")
    for axis in axes[-1]:
        axis.set_xlabel(r"displacement $x$")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9, frameon=False)
    plotting.save_figure(figure, path, dpi=120)


def draw_motions(axis: "Axes", table: Table, task: str, belt_speed: float) -> None:
    """Lay the stick line, the passive cycle and the controlled path over a panel, edged in white to be seen on any."""
    from matplotlib.patheffects import withStroke

    edge = [withStroke(linewidth=3.4, foreground="white")]
    axis.grid(False)
    axis.axhline(belt_speed, color=plotting.BLACK, linestyle=":", linewidth=1.2, label="stick line $\\dot x = v_b$")
    styles = {
        "passive": {"color": plotting.BLACK, "linestyle": (0, (5, 1.5)), "linewidth": 1.6, "label": "passive cycle"},
        "controlled": {"color": plotting.GREEN, "linewidth": 1.8, "label": "controlled path"},
    }
    for motion, style in styles.items():
        path = select(table, task=task, motion=motion)
        axis.plot(path["x"], path["v"], path_effects=edge, **style)  # type: ignore[arg-type]
    axis.plot(path["x"][0], path["v"][0], "o", color=plotting.GREEN, markeredgecolor="white", label="control begins")
    axis.set_ylim(VELOCITIES)
