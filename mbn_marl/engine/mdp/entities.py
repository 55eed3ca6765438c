"""The observation ``entities``: a token for the robot itself, for each other robot and each ROI.

Lengths are made of units alone, so that a policy can act in fields and teams of any size. The first
entry of another robot or an ROI says whether it is there to be seen; if not, all its entries are 0.

Source: this package (mdp.md, "What a robot sees").
"""

from __future__ import annotations

import math

import numpy as np

from mbn_marl.engine.mdp import lidar
from mbn_marl.engine.mdp.assignment import STRAIGHT, tour, turn_of, way_to
from mbn_marl.engine.mdp.drawn import numbers_of
from mbn_marl.engine.mdp.entries import Row, flag_row, heading_rows, put_heading, put_own_motion
from mbn_marl.engine.mdp.failures import blank_gone, put_flag, works
from mbn_marl.engine.mdp.sight import drop, is_seen, spot
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import clip, column, select

SCALES = np.array([15.0, 100.0])
"""NEAR and FAR: the lengths that become 1/2, units."""
STEPS_AHEAD = np.float32(15.0)
"""How far ahead the approach of another robot is foreseen, steps."""


def entity_rows(n: int, m: int, turns: bool, flag: str, assigned: bool) -> list[Row]:
    """The entries of ``entities`` for a team of n robots and m ROIs.

    ``turns``: whether robots have headings; ``flag``: the name of the flag of robots that have
    failed, or none; ``assigned``: whether ROIs are assigned.
    """
    near, far = (f"soft, {scale:g} units" for scale in SCALES)
    rows = [(f"own_v{a}", -1.0, 1.0, "speed limits") for a in "xy"]
    rows += heading_rows("own", turns) + flag_row("own", flag) + lidar.wall_rows()
    rows += [(f"{who}_tour", 0.0, 1.0, far) for who in ("own", "team")] * assigned
    for k in range(1, n):
        one = f"other_{k}"
        rows += [(f"{one}_present", 0.0, 1.0, "flag"), *_offset_rows(one)]
        rows += [(f"{one}_dv{a}", -1.0, 1.0, "2 speed limits") for a in "xy"]
        rows += [(f"{one}_apart", 0.0, 1.0, near), (f"{one}_approach", 0.0, 1.0, near)]
        rows += heading_rows(one, turns) + flag_row(one, flag)
        rows += [(f"{one}_tour", 0.0, 1.0, far)] * assigned
    for j in range(m):
        one = f"roi_{j}"
        rows += [(f"{one}_left", 0.0, 1.0, "flag"), *_offset_rows(one)]
        rows += [(f"{one}_u{a}", -1.0, 1.0, "soft unit vector") for a in "xy"]
        rows += [(f"{one}_away", 0.0, 1.0, far), (f"{one}_others", 0.0, 1.0, far)]
        if assigned:
            rows += [(f"{one}_order", 0.0, 1.0, "1 / place in the robot's order")]
            rows += [(f"{one}_seen", 0.0, 1.0, "flag")]
    return rows


def _offset_rows(thing: str) -> list[Row]:
    scales = zip(("near", "far"), SCALES, strict=True)
    return [
        (f"{thing}_{name}_{a}", -1.0, 1.0, f"soft, {scale:g} units")
        for name, scale in scales
        for a in "xy"
    ]


@compiled
def soft(length, scale):
    """``d / (|d| + scale)``: 1/2 at the scale, below 1 everywhere."""
    return length / (abs(length) + scale)


@compiled
def norm(x, y):
    """The length of a vector."""
    return math.sqrt(x * x + y * y)


@compiled
def closest(dx, dy, dvx, dvy, most):
    """How near something at an offset comes in a time up to ``most`` if it keeps its velocity."""
    square = dvx * dvx + dvy * dvy
    time = clip(-(dx * dvx + dy * dvy) / square, most * 0, most)
    time = select(square > 0, time, most * 0)
    return norm(dx + time * dvx, dy + time * dvy)


@compiled
def put_offset(scales, dx, dy, tile, k, entry):
    """The four entries of an offset."""
    tile[k, entry] = soft(dx, scales[0])
    tile[k + 1, entry] = soft(dy, scales[0])
    tile[k + 2, entry] = soft(dx, scales[1])
    tile[k + 3, entry] = soft(dy, scales[1])


@compiled
def put_direction(p, scales, dx, dy, tile, k, entry):
    """The four entries of an offset, and the two of its direction."""
    put_offset(scales, dx, dy, tile, k, entry)
    distance = norm(dx, dy) + p.one
    tile[k + 4, entry] = dx / distance
    tile[k + 5, entry] = dy / distance


@compiled
def put_tours(p, scales, plan, n, lo, hi, i, tile, k):
    """How far robot i would go, and the robot that goes farthest."""
    for w in range(lo, hi):
        tile[k, w - lo] = soft(tour(plan, i, w), scales[1])
        tile[k + 1, w - lo] = p.zero
    for j in range(n):
        for w in range(lo, hi):
            tile[k + 1, w - lo] = max(tile[k + 1, w - lo], soft(tour(plan, j, w), scales[1]))


@compiled
def put_robot(p, scales, drawn, ep, lo, hi, i, j, tile, k):
    """Robot j, as robot i sees it; how many entries there are by then."""
    for w in range(lo, hi):
        dx, dy = ep.x[j, w] - ep.x[i, w], ep.y[j, w] - ep.y[i, w]
        dvx, dvy = ep.vx[j, w] - ep.vx[i, w], ep.vy[j, w] - ep.vy[i, w]
        nearest = closest(dx, dy, dvx, dvy, STEPS_AHEAD * numbers_of(p, drawn, w).tau)
        tile[k, w - lo] = p.one
        put_offset(scales, dx, dy, tile, k + 1, w - lo)
        tile[k + 5, w - lo] = dvx * p.per_speed_range
        tile[k + 6, w - lo] = dvy * p.per_speed_range
        tile[k + 7, w - lo] = soft(norm(dx, dy), scales[0])
        tile[k + 8, w - lo] = soft(nearest, scales[0])
    if p.headings > 0:
        put_heading(ep, lo, hi, j, tile, k + 9)
        return k + 11
    return k + 9


@compiled
def put_place(p, g, places, seen, status, scales, ep, lo, hi, i, j, tile, k):
    """ROI j, as robot i sees it; how many entries there are by then."""
    for w in range(lo, hi):
        f = column(g, w)
        dx = spot(places.rois, 0, j, f, w) - ep.x[i, w]
        dy = spot(places.rois, 1, j, f, w) - ep.y[i, w]
        tile[k, w - lo] = p.one
        put_direction(p, scales, dx, dy, tile, k + 1, w - lo)
        tile[k + 7, w - lo] = soft(norm(dx, dy), scales[1])
        tile[k + 8, w - lo] = p.one
    for other in range(ep.x.shape[0]):
        if other != i:
            for w in range(lo, hi):
                f = column(g, w)
                dx = spot(places.rois, 0, j, f, w) - ep.x[other, w]
                dy = spot(places.rois, 1, j, f, w) - ep.y[other, w]
                counts = works(status, other, w) & is_seen(seen, other, w)
                away = select(counts, soft(norm(dx, dy), scales[1]), p.one)
                tile[k + 8, w - lo] = min(tile[k + 8, w - lo], away)
    return k + 9


@compiled
def put_failed(g, status, lo, hi, i, tile, k):
    """Write as entry k whether robot i has failed, if robots can fail; how many entries."""
    if g.fail_at.shape[0] == 0:  # robots are only absent
        return 0
    return put_flag(status, lo, hi, i, tile, k)


@compiled
def put_plan(p, g, scales, plan, ep, lo, hi, i, j, tile, k):
    """Write the assignment of ROI j, from entry k + 9 on, and a way around a corner to it."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    for w in range(lo, hi):
        _, first = way_to(plan, n, m, i, j, w)
        tile[k + 9, w - lo] = turn_of(plan, n, m, i, j, w)
        tile[k + 10, w - lo] = p.one if first == STRAIGHT else p.zero
    waypoints, xs, ys = g.waypoints, ep.x, ep.y
    if waypoints.shape[1] > 0:
        for w in range(lo, hi):
            way, first = way_to(plan, n, m, i, j, w)
            if first >= 0:
                f = column(g, w)
                dx, dy = waypoints[0, first, f] - xs[i, w], waypoints[1, first, f] - ys[i, w]
                put_direction(p, scales, dx, dy, tile, k + 1, w - lo)
                tile[k + 7, w - lo] = soft(way, scales[1])


@compiled
def blank_visited(p, g, ep, lo, hi, j, tile, k, end):
    """Blank the entries k to end - 1, about ROI j, where it is not left."""
    for w in range(lo, hi):
        left = p.one if (ep.visited[w] & g.roi_bits[j, column(g, w)]) == 0 else p.zero
        for entry in range(k, end):
            tile[entry, w - lo] *= left


@compiled
def put_entities(p, g, places, seen, plan, status, rays, scales, ep, robots, lo, hi, i, tile):
    """The entries of ``entities`` for robot i; how many.

    ``places`` and ``robots`` are the ROIs and the robots as it sees them.
    """
    n, m = ep.x.shape[0], g.rois.shape[1]
    k = put_own_motion(p, robots, lo, hi, i, tile, 0)
    k += put_failed(g, status, lo, hi, i, tile, k)
    k = lidar.put_walls(p, g, rays, ep, lo, hi, i, tile, k)
    if plan.ndim == 2:
        put_tours(p, scales, plan, n, lo, hi, i, tile, k)
        k += 2
    for j in range(n):
        if j != i:
            first = k
            k = put_robot(p, scales, ep.drawn, robots, lo, hi, i, j, tile, k)
            k += put_failed(g, status, lo, hi, j, tile, k)
            if plan.ndim == 2:
                for w in range(lo, hi):
                    tile[k, w - lo] = soft(tour(plan, j, w), scales[1])
                k += 1
            drop(seen, j, lo, hi, tile, first, k)
            blank_gone(p, status, lo, hi, j, tile, first, k)
    for j in range(m):
        first = k
        k = put_place(p, g, places, seen, status, scales, robots, lo, hi, i, j, tile, k)
        if plan.ndim == 2:
            put_plan(p, g, scales, plan, robots, lo, hi, i, j, tile, first)
            k += 2
        drop(seen, n + j, lo, hi, tile, first, k)
        blank_visited(p, g, ep, lo, hi, j, tile, first, k)
    return k
