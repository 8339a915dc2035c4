"""Fig. 3 of the paper: amplitude over belt speed, with v_b0 and v_b1, as published (cubic) and exact.

python scripts/figure_3.py                     writes figures/figure_3.csv and figures/figure_3.png
python scripts/figure_3.py --out elsewhere     into another folder
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import sd_friction_env
from sd_friction_env import OscillatorParameters, Table, amplitude_curve, critical_belt_speeds, plotting
from sd_friction_env.parameters import Geometry

PANELS: dict[Geometry, str] = {"cubic": "as published (cubic, Eq. 9)", "exact": "exact (Eq. 4)"}
BELT_SPEEDS = np.linspace(0.0, 0.6, 121)


def compute(belt_speeds: np.ndarray = BELT_SPEEDS) -> Table:
    """Return both curves in one table; beside the even grid, points crowd between v_b0 and v_b1."""
    curves, metadata = [], {"version": sd_friction_env.__version__}
    for geometry in PANELS:
        parameters = OscillatorParameters(geometry=geometry)
        v_b0, v_b1 = critical_belt_speeds(parameters)
        metadata |= {f"{geometry} v_b0": repr(v_b0), f"{geometry} v_b1": repr(v_b1), geometry: str(parameters)}
        edge = v_b1 - (v_b1 - v_b0) * np.linspace(0.0, 1.0, 13) ** 2
        speeds = np.unique(np.concatenate((belt_speeds, edge + 1e-9, [v_b0 - 1e-9, v_b1 - 1e-9])))
        curve = amplitude_curve(parameters, speeds)
        curves.append({"geometry": np.full(curve.n_rows, geometry), **curve})
    return Table({name: np.concatenate([curve[name] for curve in curves]) for name in curves[0]}, metadata)


def draw(
    table: Table,
    path: Path,
    controlled: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]] | None = None,
) -> None:
    """Draw the table; ``controlled`` maps a geometry to closed-loop points (belt speeds, amplitudes) by name."""
    figure, axes = plotting.new_figure(10.5, 4.2, 1, len(PANELS), sharey=True)
    for axis, (geometry, title) in zip(axes[0], PANELS.items(), strict=True):
        part = Table({name: values[table["geometry"] == geometry] for name, values in table.items()})
        plotting.draw_amplitude_curve(axis, part)
        axis.set_xlim(0.0, 0.6)
        axis.set_ylim(-0.012, 0.6)
        plotting.mark_critical_speeds(
            axis, float(table.metadata[f"{geometry} v_b0"]), float(table.metadata[f"{geometry} v_b1"])
        )
        plotting.draw_controlled_points(axis, (controlled or {}).get(geometry, {}))
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel(r"belt speed $v_b$")
        axis.legend(loc="upper left", fontsize=8, frameon=False)
    axes[0, 0].set_ylabel(r"amplitude $A = (x_{max} - x_{min})/2$")
    plotting.save_figure(figure, path)


def main(arguments: list[str] | None = None) -> int:
    """Compute, write the table, draw what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for both files (default: figures)")
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        compute().to_csv(options.out / "figure_3.csv")
        draw(Table.from_csv(options.out / "figure_3.csv"), options.out / "figure_3.png")
    except OSError as error:
        print(f"figure_3: cannot write into --out {str(options.out)!r}: {error}", file=sys.stderr)
        return 1
    print(f"wrote {options.out / 'figure_3.csv'} and {options.out / 'figure_3.png'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
