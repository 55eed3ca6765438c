"""``python -m mbn_marl`` is the command line ``mbn``."""

import sys

try:
    from baselines.cli.main import main
except ModuleNotFoundError as error:
    if error.name not in ("baselines.cli", "baselines.cli.main"):
        raise
    import baselines

    theirs = baselines.__file__ or list(baselines.__path__)
    sys.exit(f"mbn: error: {theirs} is another package called baselines; it hides that of mbn_marl")

if __name__ == "__main__":
    sys.exit(main())
