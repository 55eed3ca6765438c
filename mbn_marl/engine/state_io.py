"""Save the worlds of an engine as NumPy arrays by name, and restore them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.backend import Backend
from mbn_marl.engine.mdp.assignment import endless_orders, plan_limits
from mbn_marl.engine.mdp.drawn_numbers import drawn_limits, draws_numbers
from mbn_marl.engine.mdp.events import all_visited
from mbn_marl.engine.mdp.failures import ABSENT
from mbn_marl.engine.mdp.revisits import LEAST_WORDS, ODD_LINES
from mbn_marl.engine.mdp.rewards import RESTED, ROIS_SHIFT
from mbn_marl.engine.state import Team, draws_fields
from mbn_marl.errors import ProblemsError

# Arrays of ``Memory`` that are another array's memory.
VIEWS = ("x_bits", "y_bits", "trail_bits", "trail_key")
# Arrays of ``Memory`` that nothing is read from after a step.
PASSING = ("acted", "sensed")
# Arrays of ``Geometry`` that do not depend on the field, or that nothing is read from.
FIXED = (*Team._fields, "scratch")
EDGES, WAYS_IN = "geometry.edges", "geometry.ways_in"
# Tables that are left out where no field has a corner to go round.
WAYS = ("geometry.waypoints", "geometry.legs")
# Arrays of ``Memory`` that do not belong to a world.
COUNTERS = ("seed", "draw")


def changing_arrays(backend: Backend) -> dict[str, Any]:
    """Every array that steps and resets write, by name, but those without entries."""
    groups = {
        name: getattr(backend, name)._asdict() for name in ("now", "final", "memory", "output")
    }
    if draws_fields(backend.geometry):
        parts = backend.geometry
        groups["geometry"] = {name: one for part in parts for name, one in part._asdict().items()}
    return {
        name if name in COUNTERS else f"{group}.{name}": array
        for group, members in groups.items()
        for name, array in members.items()
        if name not in (*VIEWS, *PASSING, *FIXED) and 0 not in array.shape
    }


def save_worlds(backend: Backend) -> dict[str, NDArray[Any]]:
    return {name: backend.host(array) for name, array in changing_arrays(backend).items()}


def limits(backend: Backend, edges: int, waypoints: int) -> dict[str, tuple[Any, Any]]:
    """The least and the greatest value of an array by name: one value, or one per entry."""
    # Compiled code uses these numbers as indices, counts and shifts without checks. Other reals are
    # finite, other whole numbers are free. ``edges`` and ``waypoints`` are the sizes of the tables.
    spec, g, real = backend.spec, backend.geometry, np.dtype(backend.spec.config.dtype).type
    _, n, _ = spec.actions_shape
    m, steps = g.field.rois.shape[1], spec.config.max_steps
    everything, arena = all_visited(m), np.array(spec.arena, real)
    corners, pi = np.array([*arena, *arena], real)[:, None], real(np.pi)
    episode = {
        "x": (0, arena[0]),
        "y": (0, arena[1]),
        "path_length": (0, np.finfo(real).max),
        "wall_hits": (0, steps),
        "visited": (0, everything),
        "codes": (0, everything),
        "steps": (0, steps),
        "heading": (-pi, pi),
        "cos": (-1, 1),
        "sin": (-1, 1),
        "queue": (-1, 1),
        "status": (0, ABSENT),
        "knows": (0, everything),
    }
    if draws_numbers(backend.now):
        episode["drawn"] = drawn_limits(backend.host(g.team.ranges), real)
    most = np.iinfo(np.int64).max
    return {
        "seed": (0, most),
        "draw": (0, most),
        **{f"{group}.{name}": ends for group in ("now", "final") for name, ends in episode.items()},
        "memory.trail": (0, arena.max()),
        "memory.trail_code": (0, everything),
        "memory.words": (LEAST_WORDS, backend.memory.filter.shape[1] - ODD_LINES),
        "memory.episode": (-1, most),
        "memory.plan": plan_limits(n, m, waypoints),
        "output.events": (0, (m + 1 << ROIS_SHIFT) - 1),
        "output.outcomes": (0, 2 * RESTED - 1),
        EDGES: (0, corners[..., None]),
        "geometry.rois": (0, arena[:, None, None]),
        "geometry.starts": (0, arena[:, None, None]),
        "geometry.boxes": (0, corners),
        "geometry.roi_bits": (0, everything),
        "geometry.codes": (0, everything),
        "geometry.robots_in": (0, n),
        "geometry.waypoints": (0, arena[:, None, None]),
        "geometry.legs": (0, np.inf),
        WAYS_IN: (0, np.array([[edges], [waypoints]])),
    }


def range_problem(
    name: str, array: NDArray[Any], ends: tuple[Any, Any] | None, blanks: bool
) -> list[str]:
    """Name the first value that is not in its range; with ``blanks`` values may be NaN."""
    kind = array.dtype.kind
    if kind == "b":
        array, ends = array.view(np.uint8), (0, 1)  # a file may have any byte
    if ends is None:
        if kind != "f":
            return []
        ends = -np.finfo(array.dtype).max, np.finfo(array.dtype).max
    if np.ndim(ends[1]) == 0 and array.min() >= ends[0] and array.max() <= ends[1]:
        return []  # the usual case, in one look
    fine = (array >= ends[0]) & (array <= ends[1])
    if blanks:
        fine |= np.isnan(array)
    if fine.all():
        return []
    place = tuple(np.argwhere(~fine)[0].tolist())
    low, high = (np.broadcast_to(end, array.shape)[place] for end in ends)
    allowed = f"{low:g} to {high:g}" if kind == "f" else f"{low} to {high}"
    if kind == "f" and high == np.finfo(array.dtype).max:
        allowed = "finite numbers from 0 on" if low == 0 else "finite numbers"
    found = f"{name}{list(place)}{_world(name, place)}: {array[place]}"
    return [f"{found}; allowed: {allowed}"]


def _world(name: str, place: tuple[int, ...]) -> str:
    if name in COUNTERS:
        return ""
    first = name.startswith(("memory.", "output.")) and name != "output.events"
    return f" (world {place[0 if first else -1]})"


def relation_problems(given: Mapping[str, NDArray[Any]], n: int, m: int, steps: int) -> list[str]:
    words, plan = given["memory.words"], given.get("memory.plan")
    goes_on = ~given["memory.pending"] & (given["now.steps"] >= steps)
    wrong = {
        "now.steps": (goes_on, f"less than {steps} where memory.pending is not set"),
        "memory.words": ((words & (words - np.uint64(1))) != 0, "powers of two"),
    }
    if plan is not None:
        wrong["memory.plan"] = endless_orders(plan, n, m), "orders of ROIs that end"
    return [
        f"{name}: not so in world {np.argmax(worlds)}; allowed: {allowed}"
        for name, (worlds, allowed) in wrong.items()
        if worlds.any()
    ]


def problems_of(backend: Backend, given: Mapping[str, Any]) -> list[str]:
    arrays, (_, m, fields) = changing_arrays(backend), backend.geometry.field.rois.shape
    optional = set(WAYS) if WAYS_IN in arrays and len(given.keys() & set(WAYS)) != 1 else set()
    problems = [
        f"{name}: {'unknown' if name in given else 'missing'}; allowed: what save_state() gives"
        for name in sorted((given.keys() ^ arrays.keys()) - optional)
    ]
    edges, waypoints = _room(given)
    nodes = m + waypoints
    tables = [(4, edges, fields), (2, waypoints, fields), (nodes, nodes, fields)]
    room = dict(zip((EDGES, *WAYS), tables, strict=True))
    ranges = limits(backend, edges, waypoints)
    for name in given.keys() & (arrays.keys() | optional):
        array, own = given[name], arrays.get(name, backend.geometry.field.rois)
        allowed = room.get(name, tuple(own.shape)), backend.host(own[:0]).dtype
        found = getattr(array, "shape", None), getattr(array, "dtype", type(array).__name__)
        if not isinstance(array, np.ndarray) or found != allowed:
            shapes = "{} of {}; allowed: {} of {}, as these worlds have it"
            problems.append(f"{name}: {shapes.format(*found, *allowed)}")
        else:
            blanks = name == "memory.trail" and backend.spec.teams_vary
            problems += range_problem(name, array, ranges.get(name), blanks)
    n = backend.spec.actions_shape[1]
    return sorted(problems) or relation_problems(given, n, m, backend.spec.config.max_steps)


def _room(given: Mapping[str, Any]) -> tuple[int, int]:
    shapes: list[Any] = [getattr(given.get(name), "shape", ()) for name in (EDGES, WAYS[0])]
    edges, waypoints = (shape[1] if len(shape) == 3 else 0 for shape in shapes)
    return edges, waypoints


def restore_worlds(backend: Backend, saved: Mapping[str, NDArray[Any]]) -> None:
    given = {
        name: np.asarray(array) if isinstance(array, np.ndarray) else array  # masked ones too
        for name, array in saved.items()
        if 0 not in getattr(array, "shape", ())
    }
    if problems := problems_of(backend, given):
        raise ProblemsError("worlds", problems)
    if EDGES in given:
        edges, waypoints = _room(given)
        backend.make_room(edges, waypoints)
        padding = backend.geometry.field.edges[:, edges:]
        padding[:2] = padding[2:] = backend.xp.asarray(given[EDGES][:2, :1])
    for name, array in changing_arrays(backend).items():
        if name in given:
            array[tuple(map(slice, given[name].shape))] = backend.xp.asarray(given[name])
    backend.recount()
