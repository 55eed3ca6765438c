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
EDGES, WAYS_IN = "geometry.edges", "geometry.ways_in"
WAYS = ("geometry.waypoints", "geometry.legs")
"""Tables that are left out where no field has a corner to go round."""
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
    """Put ``saved`` in their place; either may have room for a larger field.

    Raises:
        MbnError: a name, a shape or a type is not that of these worlds. Nothing has changed.
    """
    given = {name: array for name, array in saved.items() if 0 not in array.shape}
    arrays, rois = changing_arrays(backend), backend.geometry.rois
    if differing := (given.keys() ^ arrays.keys()) - (set(WAYS) if WAYS_IN in arrays else set()):
        names = ", ".join(sorted(differing))
        raise MbnError(f"worlds: these arrays are missing or unknown: {names}")
    edges, waypoints = (
        given[name].shape[1] if name in given and given[name].ndim == 3 else 0
        for name in (EDGES, WAYS[0])
    )
    nodes, fields = rois.shape[1] + waypoints, rois.shape[2]
    tables = [(4, edges, fields), (2, waypoints, fields), (nodes, nodes, fields)]
    room = dict(zip((EDGES, *WAYS), tables, strict=True))
    for name, array in given.items():
        host = backend.host(arrays.get(name, rois))
        allowed = room.get(name, host.shape)
        if (array.shape, array.dtype) != (allowed, host.dtype):
            raise MbnError(
                f"worlds: {name} is {array.shape} of {array.dtype}; "
                f"allowed: {allowed} of {host.dtype}, as these worlds have it"
            )
    if EDGES in given:
        backend.make_room(edges, waypoints)
        padding = backend.geometry.edges[:, edges:]
        padding[:2] = padding[2:] = backend.xp.asarray(given[EDGES][:2, :1])
    for name, array in changing_arrays(backend).items():
        if name in given:
            array[tuple(map(slice, given[name].shape))] = backend.xp.asarray(given[name])
    backend.recount()
