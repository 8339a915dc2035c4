"""Print branches of forced orbits against closed forms, and the conditions at their bifurcations.

python scripts/branches.py   everything (some seconds)
"""

import math
import time
from typing import Any

from sd_friction_env import OscillatorParameters
from sd_friction_env.physics.forced import (
    OrbitBranch,
    doubled_orbit,
    follow_orbit,
    forced_orbit,
)

COULOMB = OscillatorParameters(geometry="linear", friction="coulomb", mu_s=0.2, mu_k=0.2, beta=0.0, belt_speed=0.0)
STRIBECK = OscillatorParameters(alpha=0.7, belt_speed=0.2, force_amplitude=0.12, force_frequency=1.0)


def den_hartog(rate: float) -> float:
    """Return the least force of motion without stops, undamped, mu = 0.2 (Den Hartog, 1931)."""
    return 0.2 * abs(1.0 - rate**2) * math.hypot(1.0 / rate**2, math.tan(0.5 * math.pi / rate) / rate)


def special(branch: OrbitBranch) -> list[dict[str, Any]]:
    """Return the rows that are not ordinary points."""
    return [row for row in branch.table.rows() if row["kind"] != "point"]


def show(branch: OrbitBranch) -> None:
    """Print the special rows of a branch."""
    name = branch.table.metadata["over"]
    for row in special(branch):
        shown = f"    {row['kind']:18} {name} {row[name]:.12f}  {row['sequence']:5} multiplier {row['multiplier']:+.6f}"
        print(f"{shown}  residual {row['residual']:.0e}  condition {row['condition']:.0e}  {row['reason']}")


def main() -> None:
    """Print everything."""
    print("grazing-sliding of a Coulomb oscillator on a belt (v_b = 0.5, beta = 0.05), against the linear response")
    for rate in (0.7, 1.3, 2.0):
        exact = 0.5 * math.hypot(1.0 - rate**2, 0.1 * rate) / rate
        p = COULOMB.replace(beta=0.05, belt_speed=0.5, force_amplitude=0.5 * exact, force_frequency=rate)
        found = follow_orbit(forced_orbit(p), ("force_amplitude", 0.4 * exact, 1.1 * exact))
        value = next(row["force_amplitude"] for row in special(found) if row["kind"] == "grazing-sliding")
        print(f"    frequency {rate}: {value:.14f}, error {abs(value - exact):.0e}")
    print("end of motion without stops (crossing-sliding), against Den Hartog (1931)")
    for rate in (0.7, 0.8, 1.3, 1.9, 3.0):
        exact = den_hartog(rate)
        p = COULOMB.replace(force_amplitude=1.4 * exact, force_frequency=rate)
        found = follow_orbit(forced_orbit(p, 1.0, transient=400), ("force_amplitude", 0.95 * exact, 1.5 * exact))
        value = next(row["force_amplitude"] for row in special(found) if row["kind"] == "crossing-sliding")
        print(f"    frequency {rate}: {value:.14f}, error {abs(value - exact):.0e}")
    print("Coulomb oscillator that stops (f = 0.4, mu = 0.2, beta = 0.05) over the frequency")
    p = COULOMB.replace(beta=0.05, force_amplitude=0.4, force_frequency=0.25)
    show(follow_orbit(forced_orbit(p, 1.0), ("force_frequency", 0.12, 2.0)))
    print("the SD oscillator (alpha = 0.7) over the force")
    begun = time.perf_counter()
    over = ("force_amplitude", 0.02, 0.3)
    branch = follow_orbit(forced_orbit(STRIBECK), over)
    print(f"    {branch.table.n_rows} orbits in {time.perf_counter() - begun:.2f} s")
    show(branch)
    print("its orbits of twice the period, from the flip on")
    flip = branch.table["kind"].tolist().index("flip")
    show(follow_orbit(doubled_orbit(branch.orbits[flip], "force_amplitude"), over))


if __name__ == "__main__":
    main()
