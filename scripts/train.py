"""``sd-friction train`` from a checkout: python scripts/train.py --help."""

import sys

from sd_friction_env.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["train", *sys.argv[1:]]))
