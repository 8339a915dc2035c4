"""``sd-friction export`` from a checkout: python scripts/export.py --help."""

import sys

from sd_friction_env.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["export", *sys.argv[1:]]))
