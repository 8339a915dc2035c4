"""``sd-friction evaluate`` from a checkout: python scripts/evaluate.py --help."""

import sys

from sd_friction_env.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["evaluate", *sys.argv[1:]]))
