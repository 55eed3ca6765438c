"""Which robot would be the first at each ROI that is left (mdp.md, "Entities").

``Memory.plan`` has it, computed for each observation. For n robots and m ROIs its rows are, one
after the other: how far each robot would go in all (n), how many ROIs it would visit (n), the robot
that would visit each ROI (m), 1 over its place in that robot's order (m), each robot's way to each
ROI: its length (n m) and its first waypoint (n m); the way from where each robot would be (n m),
and the least of these sums and where it is (2). Where nothing is assigned, it has three dimensions
and no entries, and all of this is left out when it is compiled.

Source: this package.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.compiled.jit import compiled
from mbn_marl.compiled.scalars import column, select
from mbn_marl.engine.mdp.failures import is_absent, works
from mbn_marl.engine.mdp.ways import (
    CLOSE,
    EDGES,
    NEVER,
    WAYPOINTS,
    count_waypoints,
    in_sight,
    length,
)

STRAIGHT, NO_WAY = -1, -2
"""In place of a first waypoint: the ROI is in straight sight, or no way is known."""


def rows_planned(n: int, m: int) -> int:
    """How many rows ``Memory.plan`` has for n robots and m ROIs."""
    return 2 * n + 2 * m + 3 * n * m + 2


@compiled
def look_for(edges, rois, roi_bits, plan, visited, x, y, way, via, count, f, w):
    """Find which ROIs that are left are not in sight from (x, y); return whether any is not.

    ``way`` and ``via`` are the first rows of the robot that looks, in a field of ``count`` edges.
    """
    some = False
    for j in range(rois.shape[1]):
        left = (visited & roi_bits[j, f]) == 0
        if left and not in_sight(edges, count, f, x, y, rois[0, j, f], rois[1, j, f]):
            plan[way + j, w], plan[via + j, w] = NEVER, NO_WAY
            some = True
    return some


@compiled
def try_waypoint(legs, plan, m, way, via, c, first, f, w):
    """Go by waypoint c, to which it is ``first`` units, wherever that is shorter.

    Of several ways that are equally long, that with the shortest rest.
    """
    for j in range(m):
        if plan[via + j, w] != STRAIGHT:
            rest, best = legs[j, m + c, f], plan[way + j, w]
            better = first + rest < best - CLOSE
            if (plan[via + j, w] >= 0) & (first + rest <= best + CLOSE):
                better |= rest < legs[j, m + np.int64(plan[via + j, w]), f] - CLOSE
            if better:
                plan[via + j, w] = c
                plan[way + j, w] = first + rest


@compiled
def look_around(g, plan, status, ep, lo, hi):
    """Find robots' ways to the ROIs that they do not see, in fields with corners in the way."""
    edges, rois, bits, visited = g.edges, g.rois, g.roi_bits, ep.visited
    waypoints, legs, ways_in, xs, ys = g.waypoints, g.legs, g.ways_in, ep.x, ep.y
    n, m = xs.shape[0], rois.shape[1]
    for w in range(lo, hi):
        f = column(g, w)
        count, corners = ways_in[EDGES, f], ways_in[WAYPOINTS, f]
        for i in range(n if corners > 0 else 0):
            if is_absent(status, i, w):
                continue
            x, y = xs[i, w], ys[i, w]
            way, via = 2 * n + 2 * m + m * i, 2 * n + 2 * m + n * m + m * i
            if look_for(edges, rois, bits, plan, visited[w], x, y, way, via, count, f, w):
                for c in range(corners):
                    cx, cy = waypoints[0, c, f], waypoints[1, c, f]
                    if in_sight(edges, count, f, x, y, cx, cy):
                        first = length(cx - x, cy - y)
                        try_waypoint(legs, plan, m, way, via, c, first, f, w)
                for j in range(m):
                    if plan[via + j, w] == NO_WAY:
                        plan[way + j, w] = length(rois[0, j, f] - x, rois[1, j, f] - y)


@compiled
def find_ways(g, plan, status, ep, lo, hi):
    """Find each robot's way to each ROI."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    ways, vias = 2 * n + 2 * m, 2 * n + 2 * m + n * m
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                f = column(g, w)
                dx, dy = g.rois[0, j, f] - ep.x[i, w], g.rois[1, j, f] - ep.y[i, w]
                plan[ways + m * i + j, w] = length(dx, dy)
                plan[vias + m * i + j, w] = STRAIGHT
    if g.waypoints.shape[1] > 0:
        look_around(g, plan, status, ep, lo, hi)


@compiled
def begin_plan(g, plan, status, ep, lo, hi):
    """Nothing is assigned: each robot that works can go to each ROI that is left."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    for row in range(2 * n + 2 * m):
        for w in range(lo, hi):
            plan[row, w] = 0
    find_ways(g, plan, status, ep, lo, hi)
    ways, costs = 2 * n + 2 * m, 2 * n + 2 * m + 2 * n * m
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                left = (ep.visited[w] & g.roi_bits[j, column(g, w)]) == 0
                way = plan[ways + m * i + j, w]
                possible = left & works(status, i, w)
                plan[costs + m * i + j, w] = select(possible, way, NEVER)


@compiled
def find_next(plan, n, m, lo, hi):
    """Find the earliest visit that is possible, the lowest robot's and ROI's of several."""
    costs = 2 * n + 2 * m + 2 * n * m
    least, place = costs + n * m, costs + n * m + 1
    for w in range(lo, hi):
        plan[least, w] = NEVER
    for i in range(n):
        for j in range(m):
            here = np.float32(m * i + j)
            for w in range(lo, hi):
                total = plan[i, w] + plan[costs + m * i + j, w]
                closer = total < plan[least, w]
                plan[place, w] = select(closer, here, plan[place, w])
                plan[least, w] = select(closer, total, plan[least, w])


@compiled
def assign_next(plan, rois, legs, bent, n, m, f, w):
    """Assign the visit that was found; return whether there was one.

    ``bent``: whether corners of the field in column f are in the way.
    """
    costs = 2 * n + 2 * m + 2 * n * m
    total = plan[costs + n * m, w]
    if total == NEVER:
        return False
    place = np.int64(plan[costs + n * m + 1, w])
    i, j = place // m, place % m
    plan[i, w] = total
    plan[n + i, w] += 1
    plan[2 * n + j, w] = i
    plan[2 * n + m + j, w] = 1 / plan[n + i, w]
    for robot in range(n):
        plan[costs + m * robot + j, w] = NEVER
    for k in range(m):
        if plan[costs + m * i + k, w] < NEVER:
            way = length(rois[0, k, f] - rois[0, j, f], rois[1, k, f] - rois[1, j, f])
            if bent:
                way = select(legs[j, k, f] < NEVER, legs[j, k, f], way)
            plan[costs + m * i + k, w] = way
    return True


@compiled
def assign(g, plan, status, ep, lo, hi):
    """Assign the ROIs that are left to the robots that work, in each world of a block.

    ``plan`` is that of the memory, ``status`` that of ``ep``.
    """
    if plan.ndim == 2:
        rois, legs, waypoints, ways_in = g.rois, g.legs, g.waypoints, g.ways_in
        n, m = ep.x.shape[0], rois.shape[1]
        begin_plan(g, plan, status, ep, lo, hi)
        some = True
        for _ in range(m):
            if some:
                find_next(plan, n, m, lo, hi)
                some = False
                for w in range(lo, hi):
                    f = column(g, w)
                    bent = count_waypoints(ways_in, waypoints, f) > 0
                    some |= assign_next(plan, rois, legs, bent, n, m, f, w)


@compiled
def tour(plan, i, w):
    """How far robot i would go in all, units."""
    return plan[i, w]


@compiled
def turn_of(plan, n, m, i, j, w):
    """1 over the place of ROI j in the order in which robot i would visit it, 0 if it would not."""
    return plan[2 * n + m + j, w] if plan[2 * n + j, w] == i else plan[0, w] * 0


@compiled
def way_to(plan, n, m, i, j, w):
    """How far robot i's way to ROI j is, and its first waypoint, or ``STRAIGHT`` or ``NO_WAY``."""
    row = 2 * n + 2 * m + m * i + j
    return plan[row, w], np.int64(plan[row + n * m, w])
