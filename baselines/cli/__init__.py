"""The command line ``mbn``, one module a command."""

from baselines.cli.main import main

__all__ = ["main"]
