"""The worlds of an engine as plain NumPy arrays by name, to be kept in a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from mbn_marl.engine.backend import Backend
from mbn_marl.errors import MbnError

VIEWS = ("x_bits", "y_bits", "trail_bits", "trail_key")
"""Arrays of ``Memory`` that are another array's memory."""
PASSING = ("acted", "seen")
"""Arrays of ``Memory`` that nothing is read from after a step."""
FIXED = ("robots", "kinds", "fail_at", "ranges", "rays", "scales", "scratch")
"""Arrays of ``Geometry`` that do not depend on the field, or that nothing is read from."""
COUNTERS = ("seed", "draw")
"""Arrays of ``Memory`` that do not belong to a world."""


def changing_arrays(backend: Backend) -> dict[str, Any]:
    """Every array that steps and resets write, by name, but those without entries."""
    groups = {name: getattr(backend, name) for name in ("now", "final", "memory", "output")}
    if backend.geometry.sampler.ndim == 1:
        groups["geometry"] = backend.geometry
    return {
        name if name in COUNTERS else f"{group}.{name}": array
        for group, members in groups.items()
        for name, array in members._asdict().items()
        if name not in (*VIEWS, *PASSING, *FIXED) and 0 not in array.shape
    }


def save_worlds(backend: Backend) -> dict[str, NDArray[Any]]:
    """Copies of them."""
    return {name: backend.host(array) for name, array in changing_arrays(backend).items()}


def restore_worlds(backend: Backend, saved: Mapping[str, NDArray[Any]]) -> None:
    """Put ``saved`` in their place.

    Raises:
        MbnError: a name, a shape or a type is not that of these worlds. Nothing has changed.
    """
    backend.fit_fields(saved)
    arrays = changing_arrays(backend)
    given = {name for name in saved if 0 not in saved[name].shape}
    if given != set(arrays):
        differing = ", ".join(sorted(given ^ set(arrays)))
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
