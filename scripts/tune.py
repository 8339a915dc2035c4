"""``sd-friction tune`` from a checkout: python scripts/tune.py --help."""

import sys

from sd_friction_env.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["tune", *sys.argv[1:]]))
