"""Print how exact the curves of stability charts are, and how fast.

python scripts/charts.py             everything (a minute or two)
python scripts/charts.py --points 50 fewer points on a curve
"""

import argparse
import time
from typing import Any

import numpy as np
from scipy.optimize import newton

from sd_friction_env import OscillatorParameters, Table, stability_chart
from sd_friction_env.physics.orbits import grazing_belt_speed, grazing_map, hopf_belt_speed

DIRECT = {"v_b0": grazing_belt_speed, "v_b1": hopf_belt_speed}
OVER_ALPHA = ("alpha", 0.2, 1.2)
# Charts with special points: a plant, and the range of a parameter.
GAUSSIAN: dict[str, Any] = {"geometry": "linear", "friction": "gaussian", "mu_s": 0.4, "mu_k": 0.2}
SPECIAL: dict[str, tuple[dict[str, Any], tuple[str, float, float]]] = {
    "cubic": ({"geometry": "cubic"}, ("mu_m", 0.0, 0.19)),
    "gaussian": (GAUSSIAN, ("beta", 0.02, 0.2)),
    "exact": ({}, ("v_m", 0.1, 2.0)),
}
# At a fixed belt speed: a plant, and the ranges of two parameters.
PAIRS: dict[str, tuple[dict[str, Any], tuple[str, float, float], tuple[str, float, float]]] = {
    "exact": ({"belt_speed": 0.3}, ("alpha", 0.4, 1.2), ("mu_m", 0.05, 0.18)),
    "cubic": ({"geometry": "cubic", "belt_speed": 0.35}, ("g1", 0.8, 1.1), ("beta", 0.02, 0.1)),
    "gaussian": ({**GAUSSIAN, "belt_speed": 0.5}, ("g1", 0.5, 1.5), ("beta", 0.02, 0.2)),
}


def against_direct(parameters: OscillatorParameters, chart: Table, curve: str) -> tuple[int, float, float]:
    """Return the number of points of a curve, their greatest difference from direct roots, and the roots' time."""
    name = chart.metadata["over"]
    chosen = (chart["curve"] == curve) & (chart["branch"] >= 0)
    plants = [parameters.replace(**{name: value}) for value in chart[name][chosen].tolist()]
    begun = time.perf_counter()
    roots = np.array([DIRECT[curve](plant) for plant in plants])
    spent = time.perf_counter() - begun
    return len(roots), float(np.abs(roots - chart["belt_speed"][chosen]).max()), spent


def root_of(parameters: OscillatorParameters, curve: str, name: str, near: float) -> float:
    """Return the value of a parameter, close to one, at which a curve passes the belt speed: the secant method."""

    def missed(value: float) -> float:
        return float(DIRECT[curve](parameters.replace(**{name: value})) - parameters.belt_speed)

    return float(newton(missed, near * (1.0 + 1e-5), tol=1e-11))


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=400, help="least number on a curve (default: 400)")
    options = parser.parse_args()
    print("v_b0 and v_b1 over alpha in [0.2, 1.2] against direct roots, each point of the curves")
    for geometry in ("exact", "cubic"):
        parameters = OscillatorParameters(geometry=geometry)
        stability_chart(parameters, OVER_ALPHA, points=10)  # loads the compiled code
        begun = time.perf_counter()
        chart = stability_chart(parameters, OVER_ALPHA, points=options.points)
        spent, of_roots = time.perf_counter() - begun, 0.0
        for curve in DIRECT:
            count, error, seconds = against_direct(parameters, chart, curve)
            of_roots += seconds
            print(f"  {geometry:6} {curve}: {count} points, greatest difference {error:.1e} (wanted: 1e-8)")
        print(f"  {geometry:6} chart {spent:.2f} s, direct {of_roots:.2f} s: {of_roots / spent:.1f} times (wanted: 5)")
    print("curves at a fixed belt speed against direct roots of the second parameter, about 20 points of each")
    for label, (laws, over, against) in PAIRS.items():
        plant = OscillatorParameters(**laws)
        chart = stability_chart(plant, over, against, points=options.points)
        for curve in DIRECT:
            rows = [row for row in chart.rows() if row["curve"] == curve and row["branch"] >= 0]
            rows = rows[:: max(1, len(rows) // 20)]
            roots = [root_of(plant.replace(**{over[0]: r[over[0]]}), curve, against[0], r[against[0]]) for r in rows]
            error = max(abs(root - row[against[0]]) for root, row in zip(roots, rows, strict=True))
            axes = f"{over[0]} and {against[0]} at v_b = {plant.belt_speed}"
            print(f"  {label:9} {curve} in {axes}: {len(rows)} points, greatest difference {error:.1e} (wanted: 1e-8)")
    print("special points: the largest residual of all their conditions (wanted: 1e-8)")
    for label, (laws, over) in SPECIAL.items():
        chart = stability_chart(OscillatorParameters(**laws), over, points=100)
        for row in chart.rows():
            if row["kind"] in ("turn", "Bautin", "grazing fold", "meeting"):
                where = f"{over[0]} = {row[over[0]]:.9f}, v_b = {row['belt_speed']:.9f}"
                print(f"  {label:9} {row['curve']:5} {row['kind']:12} {where}, residual {row['residual']:.1e}")
    print("return map at the graze of the nominal plant")
    for geometry in ("exact", "cubic", "linear"):
        print(f"  {geometry:6} {grazing_map(OscillatorParameters(geometry=geometry))}")


if __name__ == "__main__":
    main()
