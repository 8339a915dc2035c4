"""Print how exact the curves of stability charts are, and how fast.

python scripts/charts.py             everything (a minute or two)
python scripts/charts.py --points 50 fewer points on a curve
"""

import argparse
import time
from typing import Any

import numpy as np

from sd_friction_env import OscillatorParameters, Table, stability_chart
from sd_friction_env.physics.orbits import grazing_belt_speed, grazing_map, hopf_belt_speed

DIRECT = {"v_b0": grazing_belt_speed, "v_b1": hopf_belt_speed}
OVER_ALPHA = ("alpha", 0.2, 1.2)
# Charts with special points: a plant, and the range of a parameter.
SPECIAL: dict[str, tuple[dict[str, Any], tuple[str, float, float]]] = {
    "cubic": ({"geometry": "cubic"}, ("mu_m", 0.0, 0.19)),
    "gaussian": ({"geometry": "linear", "friction": "gaussian", "mu_s": 0.4, "mu_k": 0.2}, ("beta", 0.02, 0.2)),
    "exact": ({}, ("v_m", 0.1, 2.0)),
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
