"""The linear belt of Thomsen and Fidlin: their closed forms laid over the amplitudes of our orbits.

python scripts/figure_linear.py                     writes figures/linear.csv and figures/linear.png
python scripts/figure_linear.py --out elsewhere     into another folder
"""

from pathlib import Path

import numpy as np

from scripts.figures import curve_with_edges, metadata, run
from sd_friction_env import OscillatorParameters, Table
from sd_friction_env.physics import theory
from sd_friction_env.pictures import plotting

PLANT = OscillatorParameters(geometry="linear")


def compute() -> Table:
    """Return the curve with columns for x_max over the equilibrium, A+ (stick-slip) and A1 (pure slip)."""
    curve = curve_with_edges(PLANT, np.linspace(0.0, 0.6, 121))
    speeds = curve["belt_speed"]
    p = PLANT
    v_b1 = theory.linear_hopf_belt_speed(p.mu_s, p.mu_m, p.v_m, p.beta, p.g1)
    balance = theory.steady_friction(speeds, p.mu_s, p.k1, p.k3) * p.g1
    upper = curve["x_max"] - balance
    first = np.where(speeds < v_b1, theory.pure_slip_amplitude(np.minimum(speeds, v_b1), v_b1), np.nan)
    closed = {"upper": upper, "closed_upper": theory.stick_slip_upper_amplitude(speeds, p.beta, p.k1, p.k3, p.g1)}
    return Table(curve | closed | {"closed_pure_slip": first}, metadata([PLANT]))


@plotting.house_style()
def draw(table: Table, path: Path) -> None:
    """Draw the upper half-amplitude of stick-slip and the amplitude of pure slip, each with its closed form."""
    figure, axes = plotting.new_figure(10.5, 4.0, 1, 2)
    stick_slip, pure_slip = table["kind"] == "stick-slip", table["kind"] == "pure-slip"
    speeds = table["belt_speed"]
    for axis, chosen, value, form, name in (
        (axes[0, 0], stick_slip, "upper", "closed_upper", "stick-slip: $A_+ = x_{max} - \\bar x$"),
        (axes[0, 1], pure_slip, "amplitude", "closed_pure_slip", "pure slip: $A_1$"),
    ):
        axis.plot(speeds[chosen], table[value][chosen], label="orbits", **plotting.PAIR[0])
        axis.plot(speeds[chosen], table[form][chosen], label="closed form", **plotting.PAIR[1])
        axis.set_title(name, loc="left", fontsize=10)
        axis.set_xlabel(r"belt speed $v_b$")
        axis.legend(fontsize=8, frameon=False)
    axes[0, 0].set_ylabel("amplitude")
    plotting.save_figure(figure, path)


if __name__ == "__main__":
    raise SystemExit(run("linear", __doc__, compute, draw))
