"""The command line ``mbn``, one module a command."""

from mbn_marl.cli.main import main

__all__ = ["main"]
