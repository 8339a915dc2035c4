"""The optimum's control by the belt's speed beside the rule of two numbers: best actions over the phase plane, and the
belt's sawtooth over time.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scripts.figures.common import metadata, select
from scripts.figures.control import PHASE, VELOCITIES
from sd_friction_env import OscillatorParameters, Table
from sd_friction_env.control.policies import ThresholdFollower
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning.optimal import TASKS, OptimalPolicy, Problem
from sd_friction_env.pictures import plotting

STEPS = 200  # control intervals drawn
PIXELS = (101, 91)  # of the picture of the actions, along x and v
PLACES = (-0.1, 1.2)  # x shown
TITLES = {"optimum": "optimum (stored values)", "rule": "rule: one line, two numbers"}
ENV_ID = TASKS["belt"]


class Rule:
    """The rule as a function of states."""

    def __init__(self) -> None:
        self.env = make_env(ENV_ID)
        self.follower = ThresholdFollower.from_env(self.env)
        self.line = self.follower.threshold * (1.0 - self.env.task.belt_authority) * self.env.nominal.belt_speed

    def actions(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the actions (n,) at states (x, v, v_belt), shape (n, 3)."""
        seen = np.zeros_like(states)
        assert self.env.task.v_scale is not None
        seen[:, 1] = states[:, 1] / self.env.task.v_scale  # the rule uses nothing else
        return self.follower.predict(seen)[0][:, 0].astype(np.float64)


def controllers() -> dict[str, OptimalPolicy | Rule]:
    """Return the optimum and the rule by name."""
    return {"optimum": OptimalPolicy.load(ENV_ID), "rule": Rule()}


def compute() -> Table:
    """Return both motions from one state of the passive cycle: t, x, v, v_belt and the action taken."""
    plant = OscillatorParameters()
    task = make_env(ENV_ID).task
    start = np.array([[*task.cycle_state(plant, PHASE), plant.belt_speed]])
    problem = Problem(ENV_ID, task, (plant,), start, ((),))
    parts = []
    for name, controller in controllers().items():
        states, rows = start, []
        for _ in range(STEPS):
            action = controller.actions(states)
            rows.append([*states[0], *action])
            states, _ = problem.step(states, action)
        columns = dict(zip(("x", "v", "v_belt", "action"), np.array(rows).T, strict=True))
        parts.append({"controller": np.full(STEPS, name), "t": task.control_interval * np.arange(STEPS), **columns})
    return Table.stacked(parts, metadata([plant]))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw a column for each controller: its actions over the phase plane, and the speeds over time."""
    figure, axes = plotting.new_figure(9.0, 6.4, 2, 2, sharex="row", sharey="row")
    belt_speed = OscillatorParameters().belt_speed
    x, v = np.linspace(*PLACES, PIXELS[0]), np.linspace(*VELOCITIES, PIXELS[1])
    plane = np.stack(np.meshgrid(x, v), axis=-1).reshape(-1, 2)
    line = Rule().line
    for (above, below), (name, controller) in zip(axes.T, controllers().items(), strict=True):
        motion = select(table, controller=name)
        states = np.column_stack([plane, np.full(len(plane), belt_speed)])
        actions = controller.actions(states).reshape(len(v), len(x))
        image = above.pcolormesh(x, v, actions, cmap="PuOr", vmin=-1.0, vmax=1.0, rasterized=True)
        above.plot(motion["x"], motion["v"], color=plotting.GREEN, linewidth=1.6)
        above.plot(motion["x"][0], motion["v"][0], "o", color=plotting.GREEN, markeredgecolor="white")
        above.set(title=f"{TITLES[name]}: action $a$", xlabel="displacement $x$", xlim=PLACES, ylim=VELOCITIES)
        below.plot(motion["t"], motion["v_belt"], color=plotting.BLUE, label=r"belt speed $v_\mathrm{belt}$")
        below.plot(motion["t"], motion["v"], color=plotting.VERMILION, label=r"velocity of the mass $\dot x$")
        below.set_xlabel("time $t$ since control begins")
        for axis in (above, below):
            axis.axhline(line, color=plotting.BLACK, linestyle=":", linewidth=1.2, label="the rule's threshold")
            axis.grid(visible=axis is below)
    axes[0, 0].set_ylabel(r"velocity $\dot x$")
    axes[1, 0].set_ylabel("speed")
    figure.colorbar(image, ax=axes[0], label="action at the nominal belt speed", ticks=(-1, -0.5, 0, 0.5, 1))
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9, frameon=False)
    plotting.save_figure(figure, path, dpi=90)
