"""The console that every command prints its tables on."""

from __future__ import annotations

import sys

from rich.console import Console

UNBOUNDED = 100_000


def console() -> Console:
    """Return a console on the standard output of the moment.

    On a terminal it has the terminal's width. In a pipe or a file there is no width to fit into:
    a table takes its natural one, and no line is wrapped.
    """
    return Console(width=None if sys.stdout.isatty() else UNBOUNDED)
