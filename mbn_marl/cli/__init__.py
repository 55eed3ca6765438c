"""The command line ``mbn``: ``fields``, ``train``, ``evaluate``, ``compare``, ``render``."""

from mbn_marl.cli.main import main

__all__ = ["main"]
