"""Fit alpha, mu_m, v_m and the start to noisy records of x, with 95% intervals; also where the friction law is wrong.

    python scripts/identification.py               20 seeds (under a minute)
    python scripts/identification.py --only recovery --seeds 1000   one of: recovery, misfit, variants

The records last ten periods of the nominal limit cycle, sampled every 0.1, with noise of 1% of their amplitude: one is
the limit cycle from its largest x on, the other starts beside steady slip and grows into it. All other parameters are
known. Guesses are up to 20% off. "inside" counts the seeds whose 95% interval holds the true value.
"""

import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from sd_friction_env import LimitCycle, OscillatorParameters, equilibria, limit_cycle, simulate
from sd_friction_env.cli.options import Parser
from sd_friction_env.physics.simulation import Trajectory

Array = NDArray[np.float64]

NOMINAL = OscillatorParameters()
PERIODS, DT, NOISE = 10, 0.1, 0.01
SOUGHT = ("alpha", "mu_m", "v_m")
TRUTH = np.array([NOMINAL.values[name] for name in SOUGHT])
UNKNOWN = (*SOUGHT, "x", "v")
LOWEST, HIGHEST = (0.1, 0.0, 0.1, -2.0, -1.0), (2.0, NOMINAL.mu_s, 10.0, 2.0, 1.0)
WINDOWS = (1 / 8, 1 / 4, 1 / 2, 1)  # parts of the record: over all of it at once a wrong guess is out of phase
STARTS = ("limit cycle", "growth")
VARIANTS: dict[str, dict[str, Any]] = {
    "as above": {},
    "forward differences": {"jacobian": "2-point"},
    "whole record at once": {"windows": (1,)},
}
LAWS: dict[str, dict[str, Any]] = {
    "stribeck": {},
    "exponential": {"friction": "exponential", "mu_k": 0.05, "v_0": 0.2},
    "gaussian": {"friction": "gaussian", "mu_k": 0.05, "v_0": 0.3},
    "coulomb": {"friction": "coulomb", "mu_k": 0.1},
}


class Fit(NamedTuple):
    """Estimates of ``UNKNOWN`` with the half-widths of their 95% intervals, and what is left of the record."""

    values: Array
    half_widths: Array
    residuals: Array

    @property
    def noise(self) -> float:
        """Standard deviation of the residuals."""
        return float(np.sqrt(self.residuals @ self.residuals / (self.residuals.size - len(UNKNOWN))))

    @property
    def autocorrelation(self) -> float:
        """Correlation of each residual with the next."""
        return float(self.residuals[1:] @ self.residuals[:-1] / (self.residuals @ self.residuals))


@functools.cache
def cycle() -> LimitCycle:
    """Return the nominal limit cycle."""
    return limit_cycle(NOMINAL)


def state_at(start: str) -> tuple[float, float]:
    """Return x and v where a record begins."""
    return (cycle().x_max, 0.0) if start == "limit cycle" else (equilibria(NOMINAL)[0].x, 0.05)


def motion(values: Array, t: Array, sensitivities: Sequence[str] = ()) -> Trajectory:
    """Return the motion with these values of ``UNKNOWN``, sampled at the times t."""
    *sought, x, v = values.tolist()
    plant = NOMINAL.replace(**dict(zip(SOUGHT, sought, strict=True)))
    return simulate(plant, x, v, float(t[-1]), dt=DT, sensitivities=sensitivities)


def residuals(values: Array, t: Array, x: Array) -> Array:
    """Return the motion less the record."""
    return motion(values, t).x - x


def residual_jacobian(values: Array, t: Array, _: Array) -> Array:
    """Return the derivatives of the residuals by ``UNKNOWN``, (n, 5)."""
    sensitivities = motion(values, t, UNKNOWN).sensitivities
    return np.column_stack([sensitivities[name][:, 0] for name in UNKNOWN])


def fit(
    t: Array, x: Array, guess: Array, *, jacobian: Any = residual_jacobian, windows: Sequence[float] = WINDOWS
) -> Fit:
    """Fit ``UNKNOWN`` to a record from a guess of ``SOUGHT``: to its beginning first, then to more and more of it."""
    values = np.array([*guess, x[0], np.polyfit(t[:10], x[:10], 2)[1]])
    for share in windows:
        n = round(share * t.size)
        found = least_squares(residuals, values, jacobian, (LOWEST, HIGHEST), args=(t[:n], x[:n]))
        values = found.x
    freedom = t.size - values.size
    spread = np.sqrt(found.fun @ found.fun / freedom) * standard_deviations(np.asarray(found.jac))
    return Fit(values, student.ppf(0.975, freedom) * spread, -found.fun)


def standard_deviations(jacobian: Array) -> Array:
    """Return the standard deviations of estimates under unit noise: the roots of the diagonal of (J^T J)^-1."""
    spreads: Array = np.linalg.norm(np.linalg.inv(np.linalg.qr(jacobian, mode="r")), axis=1)
    return spreads


def record(law: str, start: str) -> tuple[Array, Array, float]:
    """Return the times and positions of a record without noise, and the noise to be added."""
    x, v = state_at(start)
    t = DT * np.arange(int(PERIODS * cycle().period / DT) + 1)
    found = simulate(NOMINAL.replace(**LAWS[law]), x, v, float(t[-1]), dt=DT)
    return np.asarray(t), found.x, NOISE * found.amplitude()


def fits(law: str, start: str, seeds: int, **options: Any) -> tuple[list[Fit], float]:
    """Return the fits to a record with the noise of each seed, and the noise's standard deviation."""
    t, x, noise = record(law, start)
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        guess = TRUTH * rng.uniform(0.8, 1.2, TRUTH.size)
        found.append(fit(t, x + noise * rng.standard_normal(t.size), guess, **options))
    return found, noise


def recovery(seeds: int) -> None:
    """Print the estimates of each seed, their errors, and how many are near the truth and inside their interval."""
    for start in STARTS:
        found, noise = fits("stribeck", start, seeds)
        values = np.array([one.values[:3] for one in found])
        errors = values / TRUTH - 1.0
        inside = np.abs(values - TRUTH) <= [one.half_widths[:3] for one in found]
        near = np.abs(errors) <= 0.02
        print(f"\nrecord: {start}\nseed  " + "".join(f"{name:>9}  error      " for name in SOUGHT))
        for seed in range(seeds):
            cells = zip(values[seed], errors[seed], inside[seed], strict=True)
            print(f"{seed:4}  " + "".join(f"{x:9.5f} {e:+6.2%} {'in ' if i else 'out'}  " for x, e, i in cells))
        for title, hits in (("within 2%", near), ("inside", inside)):
            each = "  ".join(f"{name} {k}" for name, k in zip(SOUGHT, hits.sum(axis=0), strict=True))
            print(f"{title:9} of {seeds}: {each}  all three {hits.all(axis=1).sum()}")
        t, x, _ = record("stribeck", start)
        jacobian = residual_jacobian(np.array([*TRUTH, *state_at(start)]), t, x)
        expected = noise * standard_deviations(jacobian)[:3] / TRUTH
        for title, spread in (("measured", errors.std(axis=0)), ("expected", expected)):
            print(
                f"standard deviation {title}: "
                + "  ".join(f"{name} {s:.2%}" for name, s in zip(SOUGHT, spread, strict=True))
            )


def misfit(seeds: int) -> None:
    """Print how fits of the Stribeck law to records of other laws show that the law is wrong."""
    print("\nStribeck law fitted to records of other laws: medians over the seeds")
    print("record       law          s/noise  autocorrelation  seen   alpha            mu_m             v_m")
    for start in STARTS:
        for law in LAWS:
            found, noise = fits(law, start, seeds)
            ratio = np.median([one.noise for one in found]) / noise
            correlations = np.array([one.autocorrelation for one in found])
            seen = int((np.abs(correlations) > 1.96 / np.sqrt(found[0].residuals.size)).sum())
            values, widths = (
                np.median([getattr(one, name)[:3] for one in found], axis=0) for name in ("values", "half_widths")
            )
            cells = "".join(f"{x:7.4f} +- {w:<8.2g}" for x, w in zip(values, widths, strict=True))
            print(f"{start:12} {law:12} {ratio:6.3f}  {np.median(correlations):+.3f}  {seen:8} of {seeds} {cells}")


def variants(seeds: int) -> None:
    """Print what the exact Jacobian and the growing window are good for: time of a fit, and fits that go astray."""
    print("\nthe same records and guesses; astray: residuals over 1.2 times the noise")
    for start in STARTS:
        fits("stribeck", start, 1)  # compiled
        usual: list[Fit] = []
        for title, options in VARIANTS.items():
            begin = time.perf_counter()
            found, noise = fits("stribeck", start, seeds, **options)
            milliseconds = 1e3 * (time.perf_counter() - begin) / seeds
            usual = usual or found
            right = [one.noise < 1.2 * noise for one in found]
            pairs = [(one, other) for one, other, ok in zip(usual, found, right, strict=True) if ok]
            apart = max((np.abs((a.values - b.values) / a.half_widths).max() for a, b in pairs), default=np.nan)
            astray = f"astray {seeds - sum(right)} of {seeds}, others within {apart:.0e} half-widths"
            print(f"{start:12} {title:20} {milliseconds:3.0f} ms a fit, {astray}")


PARTS = {
    "recovery": recovery,
    "misfit": misfit,
    "variants": variants,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return the exit status."""
    parser = Parser(description=__doc__, prog="identification.py")
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="records of each kind (default: 20)")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts to run (default: all)")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {options.seeds}")
    for part in options.only:
        PARTS[part](options.seeds)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
