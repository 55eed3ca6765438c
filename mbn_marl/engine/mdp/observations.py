"""A robot's observation: a table of entries for each kind, and the function that writes them.

Entries are float32 and bounded: scaled to [-1, 1] by the arena, the speed limit and the sensing
radius, but for ``entities`` (``entities.py``) and ``state``, the paper's vector in raw units with
the own robot first. The visit bits of the ROIs are shared by the team in all of them.

Source: Choton, Woods, Hsu, section 3 (``state``); the others are this package's (mdp.md, "What a
robot sees").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.mdp import lidar
from mbn_marl.engine.mdp.assignment import assign
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.entities import entity_rows, put_entities
from mbn_marl.engine.mdp.entries import Row, flag_row, heading_rows, put_heading, put_own_motion
from mbn_marl.engine.mdp.failures import blank_absent, blank_gone, put_flag
from mbn_marl.engine.mdp.sight import drop, look, seen_places, seen_robots, spot
from mbn_marl.engine.mdp.visits import visit_code, within
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import FIRST, clip, column, select
from mbn_marl.jit.intrinsics import SIDE, transpose

RELATIVE, STATE, LOCAL, LIDAR, LIDAR_LOCAL, ENTITIES = range(6)
OBSERVATIONS = {
    "relative": RELATIVE,
    "state": STATE,
    "local": LOCAL,
    "lidar": LIDAR,
    "lidar_local": LIDAR_LOCAL,
    "entities": ENTITIES,
}
LIDARS = ("lidar", "lidar_local")
WITH_RAYS = (*LIDARS, "entities")
WITH_RADIUS = ("local", *WITH_RAYS)
"""The observations that depend on the sensing radius."""


class Entry(NamedTuple):
    """One number of an observation.

    Attributes:
        name: such as ``own_x`` or ``roi_0_visited``.
        offset: its place in the observation, from 0.
        low: the least value, in ``unit``.
        high: the greatest value, in ``unit``.
        unit: the meaning of 1, in words.
    """

    name: str
    offset: int
    low: float
    high: float
    unit: str


def observation_table(
    config: NavigationConfig, n: int, m: int, arena: tuple[float, float], teams_vary: bool = False
) -> tuple[Entry, ...]:
    """The entries of one robot's observation, in order, for a team of n robots and m ROIs.

    ``teams_vary``: whether there may be fewer robots in an episode.
    """
    rows: list[Row]
    turns = count_headings(config.of_each("dynamics", n)) > 0
    flag = "failed" if config.failures else "absent" if teams_vary else ""
    if config.observation == "state":
        rows = _state_rows(n, m, arena, config.top_speed, turns, flag)
    elif config.observation == "entities":
        failed = flag if config.failures else ""  # who is absent, its tokens say
        rows = entity_rows(n, m, turns, failed, bool(config.assignment))
    else:
        rows = _scaled_rows(n, m, config.observation, turns, flag)
    if config.one_hot:
        rows += [(f"is_robot_{i}", 0.0, 1.0, "flag") for i in range(n)]
    return tuple(Entry(row[0], k, *row[1:]) for k, row in enumerate(rows))


def _scaled_rows(n: int, m: int, observation: str, turns: bool, flag: str) -> list[Row]:
    """The entries of ``relative``, and what ``local`` and ``lidar`` add to them."""
    flags, lidar_only = observation == "local", observation in LIDARS
    centre = "the field's centre" if lidar_only else "its centre"
    velocity, radii = "speed limits", "sensing radii"
    rows = [(f"own_{a}", -1.0, 1.0, f"half arenas from {centre}") for a in "xy"]
    rows += [(f"own_v{a}", -1.0, 1.0, velocity) for a in "xy"]
    rows += heading_rows("own", turns) + flag_row("own", flag)
    for k in range(1, n):
        rows += [(f"other_{k}_present", 0.0, 1.0, "flag")] * flags
        rows += [(f"other_{k}_d{a}", -1.0, 1.0, "arenas") for a in "xy"]
        rows += [(f"other_{k}_dv{a}", -1.0, 1.0, f"2 {velocity}") for a in "xy"]
        rows += heading_rows(f"other_{k}", turns)
        rows += [(f"other_{k}_near", 0.0, 1.0, f"1 - {radii}")] * lidar_only
        rows += flag_row(f"other_{k}", flag)
    for j in range(m):
        rows += [(f"roi_{j}_present", 0.0, 1.0, "flag")] * flags
        rows += [(f"roi_{j}_d{a}", -1.0, 1.0, "arenas") for a in "xy"]
        rows += [(f"roi_{j}_u{a}", -1.0, 1.0, "soft unit vector") for a in "xy"] * lidar_only
        rows += [(f"roi_{j}_visited", 0.0, 1.0, "flag")]
    if lidar_only:
        rows += lidar.wall_rows()
    return rows


def _state_rows(
    n: int, m: int, arena: tuple[float, float], top_speed: float, turns: bool, flag: str
) -> list[Row]:
    who = ["own", *(f"other_{k}" for k in range(1, n))]
    rows = [(f"{r}_{a}", 0.0, arena[k], "units") for r in who for k, a in enumerate("xy")]
    rows += [(f"{r}_v{a}", -top_speed, top_speed, "units/step") for r in who for a in "xy"]
    rows += [row for r in who for row in heading_rows(r, turns)]
    rows += [row for r in who for row in flag_row(r, flag)]
    return [*rows, ("visit_code", 0.0, float(2**m - 1), "code")]


@compiled
def nth_robot(place, first):
    """The robot at a place of the list that has ``first`` first and the others in index order."""
    return first if place == 0 else (place - 1 if place <= first else place)


@compiled
def put_motion(ep, lo, hi, first, tile):
    """All positions, then all velocities, robot ``first`` first; how many entries there are."""
    n = ep.x.shape[0]
    for place in range(n):
        i = nth_robot(place, first)
        k = 2 * place
        for w in range(lo, hi):
            tile[k, w - lo] = ep.x[i, w]
            tile[k + 1, w - lo] = ep.y[i, w]
            tile[k + 2 * n, w - lo] = ep.vx[i, w]
            tile[k + 2 * n + 1, w - lo] = ep.vy[i, w]
    return 4 * n


@compiled
def put_state(ep, lo, hi, tile):
    """The paper's vector (4n + 1); headings in radians and failures come before the visit code."""
    k = put_motion(ep, lo, hi, 0, tile)
    for i in range(ep.heading.shape[0]):
        for w in range(lo, hi):
            tile[k, w - lo] = ep.heading[i, w]
        k += 1
    for i in range(ep.x.shape[0]):
        k += put_flag(ep.status, lo, hi, i, tile, k)
    for w in range(lo, hi):
        tile[k, w - lo] = visit_code(ep.visited[w], ep.codes[w])


@compiled
def put_own_state(p, g, seen, status, ep, lo, hi, i, tile):
    """The entries of ``state`` for robot i: the paper's vector with it first; how many."""
    k = put_motion(ep, lo, hi, i, tile)
    if p.headings > 0:
        for place in range(p.headings):
            put_heading(ep, lo, hi, nth_robot(place, i), tile, k)
            k += 2
    for place in range(ep.x.shape[0]):
        for first in range(2 * place, k, 2 * ep.x.shape[0]):
            drop(seen, nth_robot(place, i), lo, hi, tile, first, first + 2)
    if status.ndim == 2:
        for place in range(status.shape[0]):
            k += put_flag(status, lo, hi, nth_robot(place, i), tile, k)
    for w in range(lo, hi):
        tile[k, w - lo] = visit_code(ep.visited[w], g.codes[column(g, w)])
    return k + 1


@compiled
def put_own(p, ep, lo, hi, i, tile):
    """Robot i's own position, velocity and heading, the first entries; how many there are."""
    for w in range(lo, hi):
        tile[0, w - lo] = (ep.x[i, w] - p.half_arena_x) * p.per_half_arena_x
        tile[1, w - lo] = (ep.y[i, w] - p.half_arena_y) * p.per_half_arena_y
    return put_own_motion(p, ep, lo, hi, i, tile, 2)


@compiled
def put_other(p, ep, lo, hi, i, j, tile, k):
    """Where robot j is and how it moves, as robot i sees it."""
    for w in range(lo, hi):
        tile[k, w - lo] = (ep.x[j, w] - ep.x[i, w]) * p.per_arena_x
        tile[k + 1, w - lo] = (ep.y[j, w] - ep.y[i, w]) * p.per_arena_y
        tile[k + 2, w - lo] = (ep.vx[j, w] - ep.vx[i, w]) * p.per_speed_range
        tile[k + 3, w - lo] = (ep.vy[j, w] - ep.vy[i, w]) * p.per_speed_range
    if p.headings > 0:
        put_heading(ep, lo, hi, j, tile, k + 4)


@compiled
def put_roi(p, g, ep, lo, hi, i, j, tile, k):
    """Where ROI j is, as robot i sees it, and whether the team has visited it."""
    for w in range(lo, hi):
        f = column(g, w)
        tile[k, w - lo] = (spot(g.rois, 0, j, f, w) - ep.x[i, w]) * p.per_arena_x
        tile[k + 1, w - lo] = (spot(g.rois, 1, j, f, w) - ep.y[i, w]) * p.per_arena_y
        tile[k + 2, w - lo] = p.one if (ep.visited[w] & g.roi_bits[j, f]) != 0 else p.zero


@compiled
def hide_other(p, ep, lo, hi, i, j, tile, k, end, flag):
    """Hide robot j, in entries k to end - 1, where it is far; the flag before them says so."""
    for entry in range(k - flag, end):
        for w in range(lo, hi):
            dx, dy = ep.x[j, w] - ep.x[i, w], ep.y[j, w] - ep.y[i, w]
            seen = select(within(dx, dy, p.sensing_squared), p.one, p.zero)
            tile[entry, w - lo] = seen * select(entry < k, p.one, tile[entry, w - lo])


@compiled
def hide_roi(p, g, ep, lo, hi, i, j, tile, k, end, flag):
    """Hide ROI j, in entries k to end - 1, where it is far; its visit bit, after them, stays."""
    for entry in range(k - flag, end):
        for w in range(lo, hi):
            f = column(g, w)
            dx = spot(g.rois, 0, j, f, w) - ep.x[i, w]
            dy = spot(g.rois, 1, j, f, w) - ep.y[i, w]
            seen = select(within(dx, dy, p.sensing_squared), p.one, p.zero)
            tile[entry, w - lo] = seen * select(entry < k, p.one, tile[entry, w - lo])


@compiled
def put_relative(p, g, seen, status, ep, lo, hi, i, tile):
    """The entries of ``relative`` and ``local`` for robot i; how many there are."""
    local, n = p.observation == LOCAL, ep.x.shape[0]
    flag = 1 if local else 0
    k = body = put_own(p, ep, lo, hi, i, tile)
    k += put_flag(status, lo, hi, i, tile, k)
    for j in range(n):
        if j != i:
            put_other(p, ep, lo, hi, i, j, tile, k + flag)
            if local:
                hide_other(p, ep, lo, hi, i, j, tile, k + 1, k + 1 + body, True)
            drop(seen, j, lo, hi, tile, k, k + flag + body)
            first, k = k, k + flag + body
            blank_gone(p, status, lo, hi, j, tile, first, k)
            k += put_flag(status, lo, hi, j, tile, k)
    for j in range(g.roi_bits.shape[0]):
        put_roi(p, g, ep, lo, hi, i, j, tile, k + flag)
        if local:
            hide_roi(p, g, ep, lo, hi, i, j, tile, k + 1, k + 3, True)
        drop(seen, n + j, lo, hi, tile, k, k + flag + 2)
        k += flag + 3
    return k


@compiled
def put_centred(p, g, ep, lo, hi, i, tile):
    """As ``put_own``, with the place about the centre of the field's bounding box."""
    count = put_own(p, ep, lo, hi, i, tile)
    for w in range(lo, hi):
        f = column(g, w)
        x, y = ep.x[i, w] - g.boxes[0, f], ep.y[i, w] - g.boxes[1, f]
        tile[0, w - lo] = clip((x + (x - g.boxes[2, f])) * p.per_arena_x, -p.one, p.one)
        tile[1, w - lo] = clip((y + (y - g.boxes[3, f])) * p.per_arena_y, -p.one, p.one)
    return count


@compiled
def put_lidar(p, g, seen, status, rays, ep, lo, hi, i, tile):
    """The entries of ``lidar`` and ``lidar_local`` for robot i but the walls; how many."""
    local, n = p.observation == LIDAR_LOCAL, ep.x.shape[0]
    k = body = put_centred(p, g, ep, lo, hi, i, tile)
    k += put_flag(status, lo, hi, i, tile, k)
    for j in range(n):
        if j != i:
            put_other(p, ep, lo, hi, i, j, tile, k)
            lidar.put_near(p, rays, ep, lo, hi, i, j, tile, k + body)
            if local:
                hide_other(p, ep, lo, hi, i, j, tile, k, k + body, False)
            drop(seen, j, lo, hi, tile, k, k + body + 1)
            first, k = k, k + body + 1
            blank_gone(p, status, lo, hi, j, tile, first, k)
            k += put_flag(status, lo, hi, j, tile, k)
    for j in range(g.roi_bits.shape[0]):
        put_roi(p, g, ep, lo, hi, i, j, tile, k)
        lidar.put_direction(p, g, ep, lo, hi, i, j, tile, k + 2)
        if local:
            hide_roi(p, g, ep, lo, hi, i, j, tile, k, k + 4, False)
        drop(seen, n + j, lo, hi, tile, k, k + 4)
        k += 5
    return k


@compiled
def describe(p, g, keys, seen, plan, status, rays, scales, ep, lo, hi, i, tile):
    """Write what robot i sees to ``tile`` (size, at least hi - lo), worlds side by side.

    ``keys``, ``seen`` and ``plan`` are those of the memory, ``status`` is that of ``ep``, ``rays``
    and ``scales`` are those of ``g``. Conditions on their types leave the code of noise, of
    failures, of lidar and of entities, which takes seconds to compile, to those who use it.
    """
    n, places, robots = ep.x.shape[0], g, ep
    if seen.ndim == 2:
        look(p, g, keys, seen, ep, lo, hi, i)
        places, robots = seen_places(seen, g, n), seen_robots(seen, ep, g.roi_bits.shape[0])
    if scales.ndim == 1:
        k = put_entities(
            *(p, g, places, seen, plan, status, rays, scales, ep, robots, lo, hi, i, tile)
        )
    elif rays.ndim == 2:
        k = put_lidar(p, places, seen, status, rays, robots, lo, hi, i, tile)
        k = lidar.put_walls(p, g, rays, ep, lo, hi, i, tile, k)
    elif p.observation == STATE:
        k = put_own_state(p, places, seen, status, robots, lo, hi, i, tile)
    else:
        k = put_relative(p, places, seen, status, robots, lo, hi, i, tile)
    if p.one_hot:
        for j in range(n):
            for w in range(lo, hi):
                tile[k + j, w - lo] = p.one if i == j else p.zero
    blank_absent(p, status, lo, hi, i, tile)


@compiled
def turn_over(tile, lo, hi, i, rows):
    """``rows[w, i, entry] = tile[entry, w - lo]`` for all worlds from ``lo`` to ``hi - 1``.

    By squares, of which the last one of a row may overlap the one before it.
    """
    side, size = np.uint64(SIDE), np.uint64(rows.shape[2])
    w = lo
    if size >= side:
        while w + side <= hi:
            for entry in range(FIRST, size, side):
                transpose(tile, min(entry, size - side), w - lo, rows, w, i)
            w += side
    while w < hi:
        for entry in range(size):
            rows[w, i, entry] = tile[entry, w - lo]
        w += np.uint64(1)


@compiled
def observe(p, g, mem, ep, lo, hi, tile, rows):
    """Write the observations of worlds ``lo`` to ``hi - 1`` to ``rows`` (W, n, size).

    They are made entry by entry in ``tile`` (size, at least hi - lo), where worlds lie side by
    side, and then turned over: faster than writing each entry to its far-apart places at once.
    """
    keys, seen, plan, status = mem.key, mem.seen, mem.plan, ep.status
    rays, scales = g.rays, g.scales
    assign(p, g, plan, status, ep, lo, hi)
    for i in range(ep.x.shape[0]):
        describe(p, g, keys, seen, plan, status, rays, scales, ep, lo, hi, i, tile)
        turn_over(tile, lo, hi, np.uint64(i), rows)
