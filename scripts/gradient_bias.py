"""Compare the mean gradient of a return with the gradient of the mean return, near grazing and away from it.

    python scripts/gradient_bias.py                    20,000 starts of each case (about three minutes)
    python scripts/gradient_bias.py --samples 2000

The return is that of 100 control steps of ``SDFriction/Force-v0`` under one constant action, from random starts; the
derivative is by that action, at 0. The gradient of the mean comes from central differences with the same starts.
"missing" is what the mean gradient lacks where the return jumps at the graze: its jump, times the density of starts at
the graze, times how fast the graze moves with the action.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import bisect

from sd_friction_env import OscillatorParameters, Task, equilibria, simulate
from sd_friction_env.cli.options import Parser
from sd_friction_env.environments.jacobian import return_with_gradient

STEPS = 100
DIFFERENCES = (0.2, 0.05, 0.0125)  # steps of the action
DISTANCES = (1e-2, 1e-4, 1e-6, 1e-8)  # from the graze

STRIBECK, COULOMB = OscillatorParameters(), OscillatorParameters(friction="coulomb", mu_k=0.1)
TWO_WELLS = OscillatorParameters(alpha=0.2)


class Case(NamedTuple):
    """A plant, a weight of the stick fraction, and starts: at rest a random offset from x, or at x with a random v."""

    title: str
    parameters: OscillatorParameters
    w_stick: float
    low: float  # of the offset, or of the velocity
    high: float
    x: float
    of_v: bool = False
    grazes: bool = False

    def start(self, offset: float) -> tuple[float, float]:
        """Return x and v of a start."""
        return (self.x, offset) if self.of_v else (self.x + offset, 0.0)

    def returned(self, offset: float, action: float = 0.0) -> tuple[float, float]:
        """Return the sum of rewards from a start, and its derivative by the action."""
        state = (*self.start(offset), self.parameters.belt_speed)
        task = Task(w_stick=self.w_stick)
        found = return_with_gradient(state, np.full(STEPS, action), self.parameters, task)
        return found.total, float(found.by_actions.sum())

    def graze(self, action: float = 0.0) -> float:
        """Return the offset at which the mass just touches the belt's speed."""
        task = Task()

        def sticks(offset: float) -> float:
            t_end = STEPS * task.control_interval
            found = simulate(self.parameters, *self.start(offset), t_end, dt=t_end, force=task.force_limit * action)
            return 1.0 if found.stick_time > 0.0 else -1.0

        return float(bisect(sticks, self.low, self.high, xtol=1e-14))

    @property
    def missing(self) -> float:
        """What the mean gradient lacks of the gradient of the mean, from a jump of the return at the graze."""
        place, step, near = self.graze(), 0.01, 1e-10
        moves = (self.graze(step) - self.graze(-step)) / (2.0 * step)
        before, behind = self.returned(place - near)[0], self.returned(place + near)[0]
        return (before - behind) * moves / (self.high - self.low)


def cases() -> list[Case]:
    """Return the cases: starts beside steady slip that never stick, all stick or graze; starts between two wells."""
    of_stribeck, of_coulomb = equilibria(STRIBECK)[0].x, equilibria(COULOMB)[0].x
    return [
        Case("stribeck, no start sticks", STRIBECK, 0.5, 0.0, 0.1, of_stribeck),
        Case("stribeck, all stick", STRIBECK, 0.5, 0.14, 0.24, of_stribeck),
        Case("stribeck, some graze, w_stick 0", STRIBECK, 0.0, 0.07, 0.17, of_stribeck, grazes=True),
        Case("stribeck, some graze, w_stick 0.5", STRIBECK, 0.5, 0.07, 0.17, of_stribeck, grazes=True),
        Case("coulomb, no start sticks", COULOMB, 0.5, 0.2, 0.3, of_coulomb),
        Case("coulomb, some graze, w_stick 0", COULOMB, 0.0, 0.28, 0.38, of_coulomb, grazes=True),
        Case("coulomb, some graze, w_stick 0.5", COULOMB, 0.5, 0.28, 0.38, of_coulomb, grazes=True),
        Case("two wells, alpha 0.2", TWO_WELLS, 0.5, -1.6, -1.3, 1.0, of_v=True),
    ]


def beside_the_graze(case: Case) -> None:
    """Print the return and its derivative at small distances before and behind the graze."""
    place = case.graze()
    print(f"\n{case.title}: graze at {place:.8f}\ndistance    return before  behind       derivative before  behind")
    for distance in DISTANCES:
        (before, slope_before), (behind, slope_behind) = (case.returned(place + s * distance) for s in (-1, 1))
        print(f"{distance:8.0e}  {before:14.5f} {behind:12.5f} {slope_before:14.4f} {slope_behind:14.4f}")


def compare(case: Case, samples: int, rng: np.random.Generator) -> None:
    """Print the mean gradient, the gradient of the mean by differences, and their difference, with standard errors."""
    offsets = rng.uniform(case.low, case.high, samples)
    gradients = np.array([case.returned(offset)[1] for offset in offsets])
    rows = [("mean gradient", gradients)]
    for step in DIFFERENCES:
        sides = [np.array([case.returned(offset, s * step)[0] for offset in offsets]) for s in (1.0, -1.0)]
        rows.append((f"difference, step {step}", (sides[0] - sides[1]) / (2.0 * step)))
    print(f"\n{case.title}: largest derivative {np.abs(gradients).max():.3g}, median {np.median(gradients):.3g}")
    for title, values in rows:
        error = values.std(ddof=1) / np.sqrt(samples)
        lacking = values - gradients
        less = "" if title == "mean gradient" else f"  less the mean gradient {lacking.mean():+9.3f} +- "
        less += f"{lacking.std(ddof=1) / np.sqrt(samples):.3f}" if less else ""
        print(f"  {title:24} {values.mean():9.3f} +- {error:.3f}{less}")
    if case.grazes:
        print(f"  missing                  {case.missing:9.3f}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return the exit status."""
    parser = Parser(description=__doc__, prog="gradient_bias.py")
    parser.add_argument("--samples", type=int, default=20_000, metavar="N", help="starts of a case (default: 20,000)")
    options = parser.parse_args(arguments)
    if options.samples < 2:
        parser.error(f"--samples must be at least 2, got {options.samples}")
    for case in cases():
        if case.grazes:
            beside_the_graze(case)
    for number, case in enumerate(cases()):
        compare(case, options.samples, np.random.default_rng(number))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
