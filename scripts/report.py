"""``sd-friction report`` from a checkout: python scripts/report.py --help."""

import sys

from sd_friction_env.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["report", *sys.argv[1:]]))
