"""Compute the figures of the paper and of the pages, write each table, and draw what was written.

    python scripts/figures                              all of them, into figures/
    python scripts/figures figure_3 basins              these
    python scripts/figures figure_3 --out elsewhere     into another folder

Each writes NAME.csv and NAME.png; chaos draws forced_basins.png too.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from scripts.figures import basins, chaos, chart, control, paper, rule
from sd_friction_env import Table

FIGURES: dict[str, tuple[Callable[[], Table], Callable[[Table, Path], None]]] = {
    "figure_2": (paper.compute_2, paper.draw_2),
    "figure_3": (paper.compute_3, paper.draw_3),
    "figure_4": (paper.compute_4, paper.draw_4),
    "figure_5": (paper.compute_5, paper.draw_5),
    "linear": (paper.compute_linear, paper.draw_linear),
    "basins": (basins.compute, basins.draw),
    "chaos": (chaos.compute, chaos.draw),
    "chart": (chart.compute, chart.draw),
    "control": (control.compute, control.draw),
    "rule": (rule.compute, rule.draw),
}


def main() -> int:
    """Write the figures that are named; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(FIGURES)} (default: all)")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder to write (default: figures)")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in FIGURES]
    if unknown:
        parser.error(f"NAME must be one of {', '.join(FIGURES)}, got {unknown[0]!r}")
    for name in options.names or FIGURES:
        compute, draw = FIGURES[name]
        table, picture = options.out / f"{name}.csv", options.out / f"{name}.png"
        try:
            options.out.mkdir(parents=True, exist_ok=True)
            compute().to_csv(table)
            draw(Table.from_csv(table), picture)
        except OSError as error:
            print(f"{name}: cannot write into --out {str(options.out)!r}: {error}", file=sys.stderr)
            return 1
        print(f"wrote {table} and {picture}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
