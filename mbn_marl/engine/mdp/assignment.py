"""Which robot visits which of the ROIs that are left, and in which order (mdp.md, "Entities").

``Memory.plan`` has it, up to date at each observation. For n robots and m ROIs a world's numbers
are, in order: how far each robot goes in all (n), the ROI that each visits first (n), the robot
that visits each ROI (m), 1 over its place in that robot's order (m), the ROI visited after it (m),
and each robot's way to each ROI: its length (n m), its first waypoint (n m) and, if it is fresh,
the cost of speeding up (n m), else 0. Where nothing is assigned, it has three dimensions and no
entries, and all of this is left out when it is compiled.

Source: this package.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import column, count_bits

Floats = NDArray[np.floating[Any]]

STRAIGHT, NO_WAY = -1, -2
"""In place of a first waypoint: the ROI is in straight sight, or no way is known."""
END = -1
"""In place of a robot or an ROI: none."""
SUM, SPREAD = np.float32(1), np.float32(1 / 64)
"""Weights of the sum of the tours: both are tried to insert ROIs; changes use the latter."""
CHANGES = 2
"""How often an assignment is changed, at most, for each ROI of the field."""
TURN_BACK = np.float32(16)
"""The cost of a U-turn at an ROI, units; less for smaller turns, 0 up to a right angle."""
GO = np.float32(40)
"""The cost of speeding up from standing, units; 0 at full speed, 4 times it from the wrong way."""


def plan_size(n: int, m: int) -> int:
    """How many numbers ``Memory.plan`` has of a world with n robots and m ROIs."""
    return 2 * n + 3 * m + 3 * n * m


def plan_limits(n: int, m: int, waypoints: int) -> tuple[Floats, Floats]:
    """The least and the greatest value of each number of a world in ``Memory.plan``."""
    most = np.full(plan_size(n, m), np.finfo(np.float32).max)
    low = -most
    first, after, via = 2 * n, 2 * n + 3 * m, 2 * n + 3 * m + n * m
    low[n:after], most[n:after] = END, m - 1
    most[first : first + m], most[first + m : first + 2 * m] = n - 1, 1
    low[via : via + n * m], most[via : via + n * m] = NO_WAY, max(waypoints - 1, END)
    return low, most


def endless_orders(plan: Floats, n: int, m: int) -> NDArray[np.bool_]:
    """In which worlds a robot's order of ROIs comes back to one of them, (W,); all in range."""
    worlds, at = np.arange(len(plan))[:, None], plan[:, n : 2 * n].astype(int)
    after = plan[:, 2 * n + 2 * m : 2 * n + 3 * m].astype(int)
    after = np.append(after, np.full((len(plan), 1), END), axis=1)  # END is followed by END
    for _ in range(m):
        at = after[worlds, at]
    endless: NDArray[np.bool_] = (at != END).any(axis=1)
    return endless


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
            way, via = 2 * n + 3 * m + m * i, 2 * n + 3 * m + n * m + m * i
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
    ways, vias = 2 * n + 3 * m, 2 * n + 3 * m + n * m
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                f = column(g, w)
                dx, dy = g.rois[0, j, f] - ep.x[i, w], g.rois[1, j, f] - ep.y[i, w]
                plan[w, ways + m * i + j] = length(dx, dy)
                plan[w, vias + m * i + j] = STRAIGHT
                plan[w, vias + m * (n + i) + j] = 0
    if g.waypoints.shape[1] > 0:
        look_around(g, plan, status, ep, lo, hi)


@compiled
def get_going(p, g, plan, ep, lo, hi):
    """Write what it costs each robot, as it moves now, to speed up towards each ROI."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    for w in range(lo, hi):
        f = column(g, w)
        for i in range(n):
            for j in range(m):
                _, first = way_to(plan, n, m, i, j, w)
                places, at = (g.waypoints, first) if first >= 0 else (g.rois, j)
                dx, dy = places[0, at, f] - ep.x[i, w], places[1, at, f] - ep.y[i, w]
                far = max(math.sqrt(dx * dx + dy * dy), CLOSE)
                slow = 1 - p.per_speed * (ep.vx[i, w] * dx + ep.vy[i, w] * dy) / far
                plan[w, 2 * n + 3 * m + 2 * n * m + m * i + j] = GO * slow * slow


@compiled
def next_row(n, m, i, a):
    """Where the ROI is kept that robot i visits after ROI a, or first of all if that is ``END``."""
    return n + i if a == END else 2 * n + 2 * m + a


@compiled
def next_of(plan, n, m, i, a, w):
    """The ROI that robot i visits after ROI a, or first of all if that is ``END``."""
    return np.int64(plan[w, next_row(n, m, i, a)])


@compiled
def put_after(plan, n, m, i, a, j, w):
    """Let robot i visit ROI j after ROI a."""
    plan[w, next_row(n, m, i, j)] = next_of(plan, n, m, i, a, w)
    plan[w, next_row(n, m, i, a)] = j


@compiled
def take_after(plan, n, m, i, a, w):
    """Leave out the ROI that robot i visits after ROI a; return it."""
    j = next_of(plan, n, m, i, a, w)
    plan[w, next_row(n, m, i, a)] = next_of(plan, n, m, i, j, w)
    return j


@compiled
def exchange(plan, n, m, i, a, k, b, w):
    """Let robot i visit after ROI a what robot k visits after ROI b, and the other way round."""
    u, v = next_of(plan, n, m, i, a, w), next_of(plan, n, m, k, b, w)
    plan[w, next_row(n, m, i, a)], plan[w, next_row(n, m, k, b)] = v, u


@compiled
def measure(g, plan, ep, i, w):
    """The length of robot i's tour: the ways to its ROIs, and the cost of its turns there."""
    rois, legs, f, n, m = g.rois, g.legs, column(g, w), ep.x.shape[0], g.rois.shape[1]
    bent = count_waypoints(g.ways_in, g.waypoints, f) > 0
    total = ux = uy = plan[w, i] * 0
    a, x, y = END, ep.x[i, w], ep.y[i, w]
    b = next_of(plan, n, m, i, a, w)
    while b != END:
        dx, dy = rois[0, b, f] - x, rois[1, b, f] - y
        if a == END:
            row = 2 * n + 3 * m + m * i + b
            total += plan[w, row] + plan[w, row + 2 * n * m]
        elif bent and legs[a, b, f] < NEVER:
            total += legs[a, b, f]
        else:
            total += length(dx, dy)
        far = max(math.sqrt(dx * dx + dy * dy), CLOSE)
        total += TURN_BACK * max(-(ux * dx + uy * dy) / far, 0)
        a, x, y, ux, uy = b, rois[0, b, f], rois[1, b, f], dx / far, dy / far
        b = next_of(plan, n, m, i, a, w)
    return total


@compiled
def others(plan, n, i, k, w):
    """The longest tour of the robots but for i and k, and the sum of theirs."""
    longest = total = plan[w, 0] * 0
    for other in range(n):
        if (other != i) & (other != k):
            longest, total = max(longest, plan[w, other]), total + plan[w, other]
    return longest, total


@compiled
def best_place(g, plan, status, ep, j, weight, w):
    """Find where ROI j costs least: the cost, the robot, ``END`` if none works, the ROI before.

    The cost is that of all tours: the longest one plus ``weight`` times their sum.
    """
    n, m = ep.x.shape[0], g.rois.shape[1]
    least, robot, after = NEVER, END, END
    for i in range(n):
        if works(status, i, w):
            longest, total = others(plan, n, i, i, w)
            a, more = END, True
            while more:
                put_after(plan, n, m, i, a, j, w)
                tour = measure(g, plan, ep, i, w)
                take_after(plan, n, m, i, a, w)
                cost = max(longest, tour) + weight * (total + tour)
                if cost < least - CLOSE:
                    least, robot, after = cost, i, a
                a = next_of(plan, n, m, i, a, w)
                more = a != END
    return least, robot, after


@compiled
def insert_one(g, plan, status, ep, weight, w):
    """Insert the ROI that costs most where it costs least; return whether one was left."""
    n, m, f = ep.x.shape[0], g.rois.shape[1], column(g, w)
    most, dearest, robot, after = -NEVER, END, END, END
    for j in range(m):
        if (plan[w, 2 * n + j] == END) & ((ep.visited[w] & g.roi_bits[j, f]) == 0):
            cost, i, a = best_place(g, plan, status, ep, j, weight, w)
            if (i != END) & (cost > most + CLOSE):
                most, dearest, robot, after = cost, j, i, a
    if dearest != END:
        put_after(plan, n, m, robot, after, dearest, w)
        plan[w, 2 * n + dearest] = robot
        plan[w, robot] = measure(g, plan, ep, robot, w)
    return dearest != END


@compiled
def best_move(g, plan, status, ep, least, w):
    """Find the ROI that had better be elsewhere, so that the cost is less than ``least``.

    Return the cost, its robot, ``END`` if there is none, the ROI before it, and both elsewhere.
    """
    n, m = ep.x.shape[0], g.rois.shape[1]
    robot, before, to, after = END, END, END, END
    for i in range(n):
        a, tour = END, plan[w, i]
        while next_of(plan, n, m, i, a, w) != END:
            j = take_after(plan, n, m, i, a, w)
            plan[w, i] = measure(g, plan, ep, i, w)
            cost, k, b = best_place(g, plan, status, ep, j, SPREAD, w)
            put_after(plan, n, m, i, a, j, w)
            plan[w, i] = tour
            if cost < least - CLOSE:
                least, robot, before, to, after = cost, i, a, k, b
            a = j
    return least, robot, before, to, after


@compiled
def best_exchange(g, plan, status, ep, least, w):
    """Find two robots that had better exchange the ends of their orders, for less than ``least``.

    Return the first, ``END`` if there is none, the ROI before its end, and both of the second.
    """
    n, m = ep.x.shape[0], g.rois.shape[1]
    one, before, two, after = END, END, END, END
    for i in range(n):
        for k in range(i + 1, n):
            longest, total = others(plan, n, i, k, w)
            a, more = END, works(status, i, w) & works(status, k, w)
            while more:
                b, other_more = END, True
                while other_more:
                    exchange(plan, n, m, i, a, k, b, w)
                    tour, other = measure(g, plan, ep, i, w), measure(g, plan, ep, k, w)
                    exchange(plan, n, m, i, a, k, b, w)
                    cost = max(longest, max(tour, other)) + SPREAD * (total + tour + other)
                    if cost < least - CLOSE:
                        least, one, before, two, after = cost, i, a, k, b
                    b = next_of(plan, n, m, k, b, w)
                    other_more = b != END
                a = next_of(plan, n, m, i, a, w)
                more = a != END
    return one, before, two, after


@compiled
def change_one(g, plan, status, ep, w):
    """Make the change that lowers the cost most; return whether any does."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    longest, total = others(plan, n, END, END, w)
    least, robot, before, to, place = best_move(g, plan, status, ep, longest + SPREAD * total, w)
    one, a, two, b = best_exchange(g, plan, status, ep, least, w)
    if one != END:
        exchange(plan, n, m, one, a, two, b, w)
    elif robot != END:
        put_after(plan, n, m, to, place, take_after(plan, n, m, robot, before, w), w)
    return (one != END) | (robot != END)


@compiled
def measure_all(g, plan, ep, w):
    """Write each robot's tour, and the robot that visits each ROI and 1 over its place."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    for i in range(n):
        plan[w, i] = measure(g, plan, ep, i, w)
        count, j = 0, next_of(plan, n, m, i, END, w)
        while j != END:
            count += 1
            plan[w, 2 * n + j], plan[w, 2 * n + m + j] = i, 1 / count
            j = next_of(plan, n, m, i, j, w)


@compiled
def assign_all(g, plan, status, ep, weight, w):
    """Assign the ROIs that are left, inserted with ``weight``; return the cost."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    for i in range(n):
        plan[w, i] = 0
    for row in range(n, 2 * n + m):
        plan[w, row] = END
    while insert_one(g, plan, status, ep, weight, w):
        pass
    changes, more = CHANGES * count_bits(g.codes[column(g, w)]), True
    while more:
        measure_all(g, plan, ep, w)
        more = (changes > 0) and change_one(g, plan, status, ep, w)
        changes -= 1
    longest, total = others(plan, n, END, END, w)
    return longest + SPREAD * total


@compiled
def keep(g, plan, status, ep, w):
    """Leave out what has been visited; return whether all robots with ROIs left work."""
    n, m, f, kept = ep.x.shape[0], g.rois.shape[1], column(g, w), True
    for i in range(n):
        a = END
        j = next_of(plan, n, m, i, a, w)
        while j != END:
            if (ep.visited[w] & g.roi_bits[j, f]) != 0:
                plan[w, 2 * n + take_after(plan, n, m, i, a, w)] = END
            else:
                a, kept = j, kept & works(status, i, w)
            j = next_of(plan, n, m, i, a, w)
    return kept


@compiled
def assign(p, g, plan, status, ep, lo, hi):
    """Assign the ROIs that are left to the robots that work, in each world of a block.

    ``plan`` is that of the memory, ``status`` that of ``ep``. A fresh one is made each time.
    """
    if plan.ndim == 2:
        find_ways(g, plan, status, ep, lo, hi)
        if p.keeps_plan == 0:
            get_going(p, g, plan, ep, lo, hi)
        for w in range(lo, hi):
            if (p.keeps_plan > 0) and (ep.steps[w] > 0) and keep(g, plan, status, ep, w):
                measure_all(g, plan, ep, w)
            else:
                # The cheaper one is made again, if it was the first: none is stored.
                first = plan[w, 0] * 0
                for weight in (SUM, SPREAD, SUM):  # one call: all that it calls is part of it
                    cost = assign_all(g, plan, status, ep, weight, w)
                    if (weight == SPREAD) & (cost < first - CLOSE):
                        break
                    first = cost


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
    row = 2 * n + 3 * m + m * i + j
    return plan[w, row], np.int64(plan[w, row + n * m])
