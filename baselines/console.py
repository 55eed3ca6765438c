"""The console that every command prints on."""

from shutil import get_terminal_size

from rich.console import Console

UNBOUNDED = 100_000


def console() -> Console:
    """Return a console on standard output; in a pipe it wraps nothing, unless COLUMNS is above 0.

    It shows words as they are: rich would take ``[old]`` in a path as a style.
    """
    width = get_terminal_size((UNBOUNDED, 0)).columns
    return Console(width=width, markup=False, emoji=False)
