"""How the engine's functions are compiled, and when compiled code is reused."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def _digest_of_sources() -> str:
    """A hash of all source files of the engine."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


SOURCES = _digest_of_sources()


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a rule or a pass, to become part of what calls it."""
    return _compile(function, forceinline=True)


def entry_point(function: Callable[..., Any]) -> Any:
    """Compile what Python calls."""
    return _compile(function)


def parallel_entry_point(function: Callable[..., Any]) -> Any:
    """Compile what Python calls and what shares its ``prange`` loops among Numba's threads."""
    return _compile(function, parallel=True)


def _compile(function: Callable[..., Any], **options: bool) -> Any:
    """Compile for the types of each call, without the GIL, and keep the machine code on disk.

    Numba renews a cached function when its own file changes, but a rule is compiled into every
    function that calls it, wherever that is. So the cache is stamped with all of the engine's
    sources instead. Where nothing can be written, the code is compiled anew in each process.
    """
    common: dict[str, Any] = {"nogil": True, "error_model": "numpy", **options}
    try:
        dispatcher = numba.njit(cache=True, **common)(function)
        dispatcher._cache._cache_file._source_stamp = SOURCES
    except RuntimeError:  # no folder for the cache
        dispatcher = numba.njit(**common)(function)
    return dispatcher
