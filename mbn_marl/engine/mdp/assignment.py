"""Which robot visits which of the ROIs that are left, and in which order (mdp.md, "Entities").

``Memory.plan`` has it, up to date at each observation. For n robots and m ROIs a world's numbers
are, one after the other: how far each robot goes in all (n), the ROI that each visits first (n),
the robot that visits each ROI (m), 1 over its place in that robot's order (m), the ROIs visited
after (m) and before it (m), and each robot's way to each ROI: its length (n m) and its first
waypoint (n m).
Where nothing is assigned, it has three dimensions and no entries, and all of this is left out when
it is compiled.

Source: this package.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.compiled.jit import compiled
from mbn_marl.compiled.scalars import column, count_bits, select
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
END = -1
"""In place of a robot or an ROI: none."""
SUM, SPREAD = np.float32(1), np.float32(1 / 64)
"""The weight of the sum of the tours when ROIs are inserted, and when they are moved."""
MOVES = 2
"""How often ROIs are moved, at most, for each ROI of the field."""


def plan_size(n: int, m: int) -> int:
    """How many numbers ``Memory.plan`` has of a world with n robots and m ROIs."""
    return 2 * n + 4 * m + 2 * n * m


@compiled
def look_for(edges, rois, roi_bits, plan, visited, x, y, way, via, count, f, w):
    """Find which ROIs that are left are not in sight from (x, y); return whether any is not.

    ``way`` and ``via`` are the first rows of the robot that looks, in a field of ``count`` edges.
    """
    some = False
    for j in range(rois.shape[1]):
        left = (visited & roi_bits[j, f]) == 0
        if left and not in_sight(edges, count, f, x, y, rois[0, j, f], rois[1, j, f]):
            plan[w, way + j], plan[w, via + j] = NEVER, NO_WAY
            some = True
    return some


@compiled
def try_waypoint(legs, plan, m, way, via, c, first, f, w):
    """Go by waypoint c, to which it is ``first`` units, wherever that is shorter.

    Of several ways that are equally long, that with the shortest rest.
    """
    for j in range(m):
        if plan[w, via + j] != STRAIGHT:
            rest, best = legs[j, m + c, f], plan[w, way + j]
            better = first + rest < best - CLOSE
            if (plan[w, via + j] >= 0) & (first + rest <= best + CLOSE):
                better |= rest < legs[j, m + np.int64(plan[w, via + j]), f] - CLOSE
            if better:
                plan[w, via + j] = c
                plan[w, way + j] = first + rest


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
            way, via = 2 * n + 4 * m + m * i, 2 * n + 4 * m + n * m + m * i
            if look_for(edges, rois, bits, plan, visited[w], x, y, way, via, count, f, w):
                for c in range(corners):
                    cx, cy = waypoints[0, c, f], waypoints[1, c, f]
                    if in_sight(edges, count, f, x, y, cx, cy):
                        first = length(cx - x, cy - y)
                        try_waypoint(legs, plan, m, way, via, c, first, f, w)
                for j in range(m):
                    if plan[w, via + j] == NO_WAY:
                        plan[w, way + j] = length(rois[0, j, f] - x, rois[1, j, f] - y)


@compiled
def find_ways(g, plan, status, ep, lo, hi):
    """Find each robot's way to each ROI."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    ways, vias = 2 * n + 4 * m, 2 * n + 4 * m + n * m
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                f = column(g, w)
                dx, dy = g.rois[0, j, f] - ep.x[i, w], g.rois[1, j, f] - ep.y[i, w]
                plan[w, ways + m * i + j] = length(dx, dy)
                plan[w, vias + m * i + j] = STRAIGHT
    if g.waypoints.shape[1] > 0:
        look_around(g, plan, status, ep, lo, hi)


@compiled
def next_row(n, m, i, a):
    """Where the ROI is kept that robot i visits after ROI a, or first of all if that is ``END``."""
    return n + i if a == END else 2 * n + 2 * m + a


@compiled
def next_of(plan, n, m, i, a, w):
    """The ROI that robot i visits after ROI a, or first of all if that is ``END``."""
    return np.int64(plan[w, next_row(n, m, i, a)])


@compiled
def leg(plan, rois, legs, bent, n, i, a, b, f, w):
    """How far robot i goes to ROI b from ROI a, or from where it is if that is ``END``.

    ``bent``: whether corners of the field in column f are in the way.
    """
    m = rois.shape[1]
    if a == END:
        return plan[w, 2 * n + 4 * m + m * i + b]
    way = length(rois[0, b, f] - rois[0, a, f], rois[1, b, f] - rois[1, a, f])
    if bent:
        way = select(legs[a, b, f] < NEVER, legs[a, b, f], way)
    return way


@compiled
def detour(plan, rois, legs, bent, n, i, a, j, f, w):
    """How much farther robot i goes if it visits ROI j between ROI a and the one after that."""
    then = next_of(plan, n, rois.shape[1], i, a, w)
    more = leg(plan, rois, legs, bent, n, i, a, j, f, w)
    if then != END:
        more += leg(plan, rois, legs, bent, n, i, j, then, f, w)
        more -= leg(plan, rois, legs, bent, n, i, a, then, f, w)
    return more


@compiled
def place(plan, rois, legs, bent, n, i, a, j, f, w):
    """Let robot i visit ROI j after ROI a, or first of all."""
    m = rois.shape[1]
    then = next_of(plan, n, m, i, a, w)
    plan[w, i] += detour(plan, rois, legs, bent, n, i, a, j, f, w)
    plan[w, next_row(n, m, i, a)] = j
    plan[w, 2 * n + j], plan[w, 2 * n + 2 * m + j], plan[w, 2 * n + 3 * m + j] = i, then, a
    if then != END:
        plan[w, 2 * n + 3 * m + then] = j


@compiled
def take_out(plan, rois, legs, bent, n, j, f, w):
    """Let no robot visit ROI j; return the one that did, and the ROI that it visits before."""
    m = rois.shape[1]
    i, a = np.int64(plan[w, 2 * n + j]), np.int64(plan[w, 2 * n + 3 * m + j])
    then = next_of(plan, n, m, i, j, w)
    plan[w, next_row(n, m, i, a)] = then
    if then != END:
        plan[w, 2 * n + 3 * m + then] = a
    plan[w, 2 * n + j] = END
    plan[w, i] -= detour(plan, rois, legs, bent, n, i, a, j, f, w)
    return i, a


@compiled
def best_place(plan, status, rois, legs, bent, n, j, weight, f, w):
    """Find where ROI j costs least: the cost, the robot, ``END`` if none works, the ROI before.

    The cost is that of all tours: the longest one plus ``weight`` times their sum.
    """
    least, robot, after = NEVER, END, END
    for i in range(n):
        if works(status, i, w):
            longest, total = -NEVER, plan[w, i]
            for other in range(n):
                if other != i:
                    longest = max(longest, plan[w, other])
                    total += plan[w, other]
            a = END
            while True:
                more = detour(plan, rois, legs, bent, n, i, a, j, f, w)
                cost = max(longest, plan[w, i] + more) + weight * (total + more)
                if cost < least - CLOSE:
                    least, robot, after = cost, i, a
                a = next_of(plan, n, rois.shape[1], i, a, w)
                if a == END:
                    break
    return least, robot, after


@compiled
def insert_one(plan, status, left, bits, rois, legs, bent, n, f, w):
    """Insert the ROI that costs most where it costs least; return whether one was left to insert.

    ``left`` has the bits of the ROIs that are to be visited.
    """
    most, dearest, robot, after = -NEVER, END, END, END
    for j in range(rois.shape[1]):
        if (plan[w, 2 * n + j] == END) & ((left & bits[j, f]) != 0):
            cost, i, a = best_place(plan, status, rois, legs, bent, n, j, SUM, f, w)
            if (i != END) & (cost > most + CLOSE):
                most, dearest, robot, after = cost, j, i, a
    if dearest != END:
        place(plan, rois, legs, bent, n, robot, after, dearest, f, w)
    return dearest != END


@compiled
def move_one(plan, status, rois, legs, bent, n, f, w):
    """Move the ROI to another place that lowers the cost most; return whether any does."""
    longest, total = plan[w, 0], plan[w, 0]
    for i in range(1, n):
        longest, total = max(longest, plan[w, i]), total + plan[w, i]
    least, moved, robot, after = longest + SPREAD * total, END, END, END
    for j in range(rois.shape[1]):
        if plan[w, 2 * n + j] != END:
            i, a = take_out(plan, rois, legs, bent, n, j, f, w)
            cost, to, at = best_place(plan, status, rois, legs, bent, n, j, SPREAD, f, w)
            place(plan, rois, legs, bent, n, i, a, j, f, w)
            if cost < least - CLOSE:
                least, moved, robot, after = cost, j, to, at
    if moved != END:
        take_out(plan, rois, legs, bent, n, moved, f, w)
        place(plan, rois, legs, bent, n, robot, after, moved, f, w)
    return moved != END


@compiled
def forget(plan, status, visited, bits, rois, legs, bent, n, f, w):
    """Take out the ROIs that are visited, or whose robots do not work; return whether any is."""
    some = False
    for j in range(rois.shape[1]):
        i = np.int64(plan[w, 2 * n + j])
        if (i != END) and (((visited & bits[j, f]) != 0) | (not works(status, i, w))):
            take_out(plan, rois, legs, bent, n, j, f, w)
            some = True
    return some


@compiled
def measure_tours(plan, rois, legs, bent, n, f, w):
    """Write the tours' lengths, leg by leg, and 1 over each visit's place."""
    m = rois.shape[1]
    for i in range(n):
        count, plan[w, i] = 0, 0
        a = np.int64(END)
        j = next_of(plan, n, m, i, a, w)
        while j != END:
            count += 1
            plan[w, i] += leg(plan, rois, legs, bent, n, i, a, j, f, w)
            plan[w, 2 * n + m + j] = 1 / count
            a, j = j, next_of(plan, n, m, i, j, w)


@compiled
def assign(g, plan, status, ep, lo, hi):
    """Assign the ROIs that are left to the robots that work, in each world of a block.

    ``plan`` is that of the memory, ``status`` that of ``ep``.
    """
    if plan.ndim == 2:
        rois, legs, waypoints, ways_in, bits = g.rois, g.legs, g.waypoints, g.ways_in, g.roi_bits
        n, m, visited, steps = ep.x.shape[0], rois.shape[1], ep.visited, ep.steps
        find_ways(g, plan, status, ep, lo, hi)
        for w in range(lo, hi):
            f, seen = column(g, w), visited[w]
            bent = count_waypoints(ways_in, waypoints, f) > 0
            changed = steps[w] == 0
            if changed:
                for row in range(n, 2 * n + m):
                    plan[w, row] = END
            else:
                changed = forget(plan, status, seen, bits, rois, legs, bent, n, f, w)
            measure_tours(plan, rois, legs, bent, n, f, w)
            if changed:
                while insert_one(plan, status, ~seen, bits, rois, legs, bent, n, f, w):
                    pass
                for _ in range(MOVES * count_bits(g.codes[f])):
                    if not move_one(plan, status, rois, legs, bent, n, f, w):
                        break
                measure_tours(plan, rois, legs, bent, n, f, w)


@compiled
def tour(plan, i, w):
    """How far robot i goes in all, units."""
    return plan[w, i]


@compiled
def turn_of(plan, n, m, i, j, w):
    """1 over the place of ROI j in the order of robot i, 0 if that does not visit it."""
    return plan[w, 2 * n + m + j] if plan[w, 2 * n + j] == i else plan[w, 0] * 0


@compiled
def way_to(plan, n, m, i, j, w):
    """How far robot i's way to ROI j is, and its first waypoint, or ``STRAIGHT`` or ``NO_WAY``."""
    row = 2 * n + 4 * m + m * i + j
    return plan[w, row], np.int64(plan[w, row + n * m])
