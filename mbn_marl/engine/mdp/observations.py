"""A robot's observation: a table of entries for each kind, and the function that writes them."""

# Entries are float32 and bounded: scaled to [-1, 1] by the arena, the speed limit and the sensing
# radius, but for ``entities`` (``entities.py``) and ``state``, the paper's vector in raw units with
# the own robot first. The visit bits of the ROIs are those that the robot knows (``knowledge.py``).
#
# ``put_...`` functions write entries from k on, or from 0 on, for worlds lo to hi - 1, and return
# how many there are by then; ``put_flag``, ``put_heading`` and ``put_failed`` how many they wrote.
#
# Source: Choton, Woods, Hsu, section 3 (``state``); the others are this package's
# (observations.md).

from typing import NamedTuple, get_args

import numpy as np

from mbn_marl.config import NavigationConfig, Observation
from mbn_marl.engine.mdp import lidar
from mbn_marl.engine.mdp.assignment import assign
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.entities import entity_rows, put_entities, shows_entities
from mbn_marl.engine.mdp.events import visit_code, within
from mbn_marl.engine.mdp.failures import blank_absent, blank_gone, put_flag
from mbn_marl.engine.mdp.kinds import put_mine
from mbn_marl.engine.mdp.knowledge import hide_unnoticed, is_left, knows_own
from mbn_marl.engine.mdp.lidar import has_rays
from mbn_marl.engine.mdp.sight import (
    Robots,
    Row,
    View,
    disturbs_sight,
    drop,
    flag_row,
    heading_rows,
    look,
    mine_row,
    put_heading,
    put_own_motion,
    roi_place,
    sensed_robots,
)
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import FIRST, clip, column, select
from mbn_marl.jit.intrinsics import SIDE, transpose

RELATIVE, STATE, LOCAL, LIDAR, LIDAR_LOCAL, ENTITIES = range(6)
OBSERVATIONS = {name: number for number, name in enumerate(get_args(Observation))}
LIDARS = ("lidar", "lidar_local")
WITH_RAYS = (*LIDARS, "entities")


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
    config: NavigationConfig,
    n: int,
    m: int,
    arena: tuple[float, float],
    teams_vary: bool = False,
    kinds: bool = False,
) -> tuple[Entry, ...]:
    """The entries of a robot's observation, where fields have ``kinds`` of robots, or not.

    If ``teams_vary``, episodes may have fewer robots.
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
        rows = _scaled_rows(n, m, config.observation, turns, flag, kinds)
    if config.one_hot:
        rows += [(f"is_robot_{i}", 0.0, 1.0, "flag") for i in range(n)]
    return tuple(Entry(row[0], k, *row[1:]) for k, row in enumerate(rows))


def _scaled_rows(
    n: int, m: int, observation: str, turns: bool, flag: str, kinds: bool
) -> list[Row]:
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
        rows += [(f"roi_{j}_visited", 0.0, 1.0, "flag"), *mine_row(f"roi_{j}", kinds)]
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
        k += put_flag(ep, lo, hi, i, tile, k)
    for w in range(lo, hi):
        tile[k, w - lo] = visit_code(ep.visited[w], ep.codes[w])


@compiled
def put_own_state(p, g, view, lo, hi):
    ep, i, tile = view.ep, view.i, view.tile
    n = ep.x.shape[0]
    k = put_motion(view.robots, lo, hi, i, tile)
    for place in range(p.headings):
        k += put_heading(p, view, lo, hi, nth_robot(place, i), k)
    for place in range(n):
        for first in range(2 * place, k, 2 * n):
            drop(view, lo, hi, nth_robot(place, i), first, first + 2)
    for place in range(n):
        k += put_flag(ep, lo, hi, nth_robot(place, i), tile, k)
    for w in range(lo, hi):
        f = column(g.field, w)
        tile[k, w - lo] = visit_code(ep.visited[w], g.field.codes[f])
    return k + 1


@compiled
def put_own(p, view, lo, hi):
    robots, i = view.robots, view.i
    for w in range(lo, hi):
        view.tile[0, w - lo] = (robots.x[i, w] - p.half_arena_x) * p.per_half_arena_x
        view.tile[1, w - lo] = (robots.y[i, w] - p.half_arena_y) * p.per_half_arena_y
    return put_own_motion(p, view, lo, hi, 2)


@compiled
def put_other(p, view, lo, hi, j, k):
    robots, tile, i = view.robots, view.tile, view.i
    for w in range(lo, hi):
        tile[k, w - lo] = (robots.x[j, w] - robots.x[i, w]) * p.per_arena_x
        tile[k + 1, w - lo] = (robots.y[j, w] - robots.y[i, w]) * p.per_arena_y
        tile[k + 2, w - lo] = (robots.vx[j, w] - robots.vx[i, w]) * p.per_speed_range
        tile[k + 3, w - lo] = (robots.vy[j, w] - robots.vy[i, w]) * p.per_speed_range
    put_heading(p, view, lo, hi, j, k + 4)


@compiled
def put_roi(p, g, view, lo, hi, j, k):
    field, robots, tile, i = g.field, view.robots, view.tile, view.i
    for w in range(lo, hi):
        f = column(field, w)
        tile[k, w - lo] = (roi_place(g, view, 0, j, f, w) - robots.x[i, w]) * p.per_arena_x
        tile[k + 1, w - lo] = (roi_place(g, view, 1, j, f, w) - robots.y[i, w]) * p.per_arena_y
        tile[k + 2, w - lo] = p.zero if is_left(p, g, view.ep, i, j, w) else p.one


@compiled
def put_present(p, view, lo, hi, k):
    for w in range(lo, hi):
        view.tile[k, w - lo] = p.one


@compiled
def hide_roi(p, g, view, lo, hi, j, first, end):
    """Hide ROI j, in entries first to end - 1, where it is far."""
    robots, tile, i = view.robots, view.tile, view.i
    for entry in range(first, end):
        for w in range(lo, hi):
            f = column(g.field, w)
            dx = roi_place(g, view, 0, j, f, w) - robots.x[i, w]
            dy = roi_place(g, view, 1, j, f, w) - robots.y[i, w]
            tile[entry, w - lo] *= select(within(dx, dy, p.sensing_squared), p.one, p.zero)


@compiled
def end_other(p, view, lo, hi, j, first, end):
    """Blank the entries of robot j where it is not sensed or gone; add its flag; where they end."""
    drop(view, lo, hi, j, first, end)
    blank_gone(p, view, lo, hi, j, first, end)
    flags = put_flag(view.ep, lo, hi, j, view.tile, end)
    if knows_own(view.ep):
        hide_unnoticed(p, view, lo, hi, j, end, end + flags)
    return end + flags


@compiled
def put_relative(p, g, view, lo, hi):
    local, n = p.observation == LOCAL, view.ep.x.shape[0]
    flag = 1 if local else 0
    k = body = put_own(p, view, lo, hi)
    k += put_flag(view.ep, lo, hi, view.i, view.tile, k)
    for j in range(n):
        if j != view.i:
            put_other(p, view, lo, hi, j, k + flag)
            if local:
                put_present(p, view, lo, hi, k)
                hide_unnoticed(p, view, lo, hi, j, k, k + 1 + body)
            k = end_other(p, view, lo, hi, j, k, k + flag + body)
    for j in range(g.field.roi_bits.shape[0]):
        put_roi(p, g, view, lo, hi, j, k + flag)
        if local:
            put_present(p, view, lo, hi, k)
            hide_roi(p, g, view, lo, hi, j, k, k + 3)
        drop(view, lo, hi, n + j, k, k + flag + 2)
        k += flag + 3
        k += put_mine(p, g, view, lo, hi, j, k)
    return k


@compiled
def put_centred(p, g, view, lo, hi):
    robots, boxes, i = view.robots, g.field.boxes, view.i
    count = put_own(p, view, lo, hi)
    for w in range(lo, hi):
        f = column(g.field, w)
        x, y = robots.x[i, w] - boxes[0, f], robots.y[i, w] - boxes[1, f]
        view.tile[0, w - lo] = clip((x + (x - boxes[2, f])) * p.per_arena_x, -p.one, p.one)
        view.tile[1, w - lo] = clip((y + (y - boxes[3, f])) * p.per_arena_y, -p.one, p.one)
    return count


@compiled
def put_lidar(p, g, view, lo, hi):
    local, n = p.observation == LIDAR_LOCAL, view.ep.x.shape[0]
    k = body = put_centred(p, g, view, lo, hi)
    k += put_flag(view.ep, lo, hi, view.i, view.tile, k)
    for j in range(n):
        if j != view.i:
            put_other(p, view, lo, hi, j, k)
            lidar.put_near(p, g, view, lo, hi, j, k + body)
            if local:
                hide_unnoticed(p, view, lo, hi, j, k, k + body)
            k = end_other(p, view, lo, hi, j, k, k + body + 1)
    for j in range(g.field.roi_bits.shape[0]):
        put_roi(p, g, view, lo, hi, j, k)
        lidar.put_direction(p, g, view, lo, hi, j, k + 2)
        if local:
            hide_roi(p, g, view, lo, hi, j, k, k + 4)
        drop(view, lo, hi, n + j, k, k + 4)
        k += 5
        k += put_mine(p, g, view, lo, hi, j, k)
    return k


@compiled
def write_observation(p, g, mem, ep, i, lo, hi, tile):
    """Write what robot i observes to ``tile`` (size, at least hi - lo), worlds side by side."""
    robots = Robots(ep.x, ep.y, ep.vx, ep.vy, ep.cos, ep.sin)
    if disturbs_sight(mem):
        look(p, g, mem, ep, i, lo, hi)
        robots = sensed_robots(mem, ep, g.field.roi_bits.shape[0])
    view = View(mem.sensed, mem.plan, ep, robots, i, tile)
    if shows_entities(g):
        k = put_entities(p, g, view, lo, hi)
    elif has_rays(g):
        k = lidar.put_walls(p, g, view, lo, hi, put_lidar(p, g, view, lo, hi))
    elif p.observation == STATE:
        k = put_own_state(p, g, view, lo, hi)
    else:
        k = put_relative(p, g, view, lo, hi)
    if p.one_hot:
        for j in range(ep.x.shape[0]):
            for w in range(lo, hi):
                tile[k + j, w - lo] = p.one if i == j else p.zero
    blank_absent(p, view, lo, hi)


@compiled
def turn_over(tile, lo, hi, i, rows):
    """``rows[w, i, entry] = tile[entry, w - lo]`` for all worlds from ``lo`` to ``hi - 1``."""
    # By squares, of which the last one of a row may overlap the one before it.
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
    assign(p, g, mem, ep, lo, hi)
    # An entry of all worlds at once is one vector loop, but its places in ``rows`` are far apart.
    # So entries are made in ``tile``, where worlds lie side by side, and then turned over.
    for i in range(ep.x.shape[0]):
        write_observation(p, g, mem, ep, i, lo, hi, tile)
        turn_over(tile, lo, hi, np.uint64(i), rows)
