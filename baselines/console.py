"""The console that every command prints on."""

import os
import sys

from rich.console import Console

UNBOUNDED = 100_000


def console() -> Console:
    """Return a console on standard output; in a pipe it wraps nothing, unless COLUMNS is set.

    It shows words as they are: rich would take ``[old]`` in a path as a style.
    """
    known = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdecimal()
    return Console(width=None if known else UNBOUNDED, markup=False, emoji=False)
