"""The worlds of an engine as plain NumPy arrays by name, to be kept in a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from mbn_marl.engine.backend import Backend
from mbn_marl.errors import MbnError

SHARED = ("x_bits", "y_bits", "trail_bits", "trail_key")
"""Arrays of ``Memory`` that are another array's memory."""


def changing_arrays(backend: Backend) -> dict[str, Any]:
    """Every array of the worlds that steps and resets write, the backend's own, by name."""
    groups = {name: getattr(backend, name) for name in ("now", "final", "memory", "output")}
    arrays = {
        f"{group}.{name}": array
        for group, members in groups.items()
        for name, array in members._asdict().items()
        if name not in SHARED
    }
    return {**arrays, **backend.counters}


def save_worlds(backend: Backend) -> dict[str, NDArray[Any]]:
    """Copies of them."""
    return {name: backend.host(array) for name, array in changing_arrays(backend).items()}


def restore_worlds(backend: Backend, saved: Mapping[str, NDArray[Any]]) -> None:
    """Put ``saved`` in their place.

    Raises:
        MbnError: a name, a shape or a type is not that of these worlds. Nothing has changed.
    """
    arrays = changing_arrays(backend)
    if set(saved) != set(arrays):
        differing = ", ".join(sorted(set(saved) ^ set(arrays)))
        raise MbnError(f"worlds: these arrays are missing or unknown: {differing}")
    for name, array in arrays.items():
        host = backend.host(array)
        if (saved[name].shape, saved[name].dtype) != (host.shape, host.dtype):
            raise MbnError(
                f"worlds: {name} is {saved[name].shape} of {saved[name].dtype}; "
                f"allowed: {host.shape} of {host.dtype}, as these worlds have it"
            )
    for name, array in arrays.items():
        array[...] = backend.xp.asarray(saved[name])
    backend.recount()
