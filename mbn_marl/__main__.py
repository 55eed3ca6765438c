"""``python -m mbn_marl`` is the command line ``mbn``."""

import sys

from baselines.cli import main

if __name__ == "__main__":
    sys.exit(main())
