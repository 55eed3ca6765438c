"""The assignment of the ROIs that are left to robots, in an order (observations.md, "Entities")."""

# ``Memory.plan`` has it, up to date at each observation. For n robots and m ROIs a world's numbers
# are, in order: how far each robot goes in all (n), the ROI that each visits first (n), the robot
# that visits each ROI (m), 1 over its place in that robot's order (m), the ROI visited after it
# (m), and each robot's way to each ROI: its length (n m), its first waypoint (n m) and, if it is
# fresh, the cost of speeding up (n m), else 0.
#
# Source: this package.

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.mdp.failures import ABSENT, WORKS, status_of
from mbn_marl.engine.mdp.kinds import are_alike, is_mine
from mbn_marl.engine.mdp.paths import CLOSE, EDGES, NEVER, WAYPOINTS, in_sight, path_length
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import column, count_bits

Floats = NDArray[np.floating[Any]]

# In place of a first waypoint: the ROI is in straight sight, or no way is known.
STRAIGHT, NO_WAY = -1, -2
# In place of a robot or an ROI: none.
END = -1
# Weights of the sum of the tours: both are tried to insert ROIs; changes use the latter.
SUM, SPREAD = np.float32(1), np.float32(1 / 64)
# The most changes of an assignment for each ROI of the field.
CHANGES = 2
# The cost of a U-turn at an ROI, units; less for smaller turns, 0 up to a right angle.
TURN_BACK = np.float32(16)
# The cost of speeding up from standing, units; 0 at full speed, 4 times it from the wrong way.
GO = np.float32(40)


def plan_size(n: int, m: int) -> int:
    return 2 * n + 3 * m + 3 * n * m


def plan_limits(n: int, m: int, waypoints: int) -> tuple[Floats, Floats]:
    most = np.full(plan_size(n, m), np.finfo(np.float32).max)
    low = -most
    first, after, via = 2 * n, 2 * n + 3 * m, 2 * n + 3 * m + n * m
    low[n:after], most[n:after] = END, m - 1
    most[first : first + m], most[first + m : first + 2 * m] = n - 1, 1
    low[via : via + n * m], most[via : via + n * m] = NO_WAY, max(waypoints - 1, END)
    return low, most


def endless_orders(plan: Floats, n: int, m: int) -> NDArray[np.bool_]:
    """Find the worlds, (W,), in which an order of ROIs comes back to one; all are in range."""
    worlds, at = np.arange(len(plan))[:, None], plan[:, n : 2 * n].astype(int)
    after = plan[:, 2 * n + 2 * m : 2 * n + 3 * m].astype(int)
    after = np.append(after, np.full((len(plan), 1), END), axis=1)  # END is followed by END
    for _ in range(m):
        at = after[worlds, at]
    endless: NDArray[np.bool_] = (at != END).any(axis=1)
    return endless


assigns = Feature(lambda mem: mem.plan.ndim == 2)


class Tours(NamedTuple):
    plan: Any  # Memory.plan
    n: Any
    m: Any
    w: Any


@compiled
def way_row(t, i, j):
    """The row of the length of robot i's way to ROI j; n m rows on is its first waypoint."""
    return 2 * t.n + 3 * t.m + t.m * i + j


@compiled
def hide_rois(g, ep, t, i, x, y):
    """Find which ROIs that are left are not in sight from (x, y); return whether any is not."""
    field, plan, f, w = g.field, t.plan, column(g.field, t.w), t.w
    count, some = g.paths.ways_in[EDGES, f], False
    for j in range(t.m):
        left = (ep.visited[w] & field.roi_bits[j, f]) == 0
        jx, jy = field.rois[0, j, f], field.rois[1, j, f]
        if left and not in_sight(field.edges, count, f, x, y, jx, jy):
            row = way_row(t, i, j)
            plan[w, row], plan[w, row + t.n * t.m] = NEVER, NO_WAY
            some = True
    return some


@compiled
def try_waypoint(g, t, i, c, first):
    """Go by waypoint c, to which it is ``first`` units, wherever that is shorter."""
    # Of several ways that are equally long, that with the shortest rest.
    legs, plan, m, f, w = g.paths.legs, t.plan, t.m, column(g.field, t.w), t.w
    for j in range(m):
        way, via = way_row(t, i, j), way_row(t, i, j) + t.n * m
        if plan[w, via] != STRAIGHT:
            rest, best = legs[j, m + c, f], plan[w, way]
            better = first + rest < best - CLOSE
            if (plan[w, via] >= 0) & (first + rest <= best + CLOSE):
                better |= rest < legs[j, m + np.int64(plan[w, via]), f] - CLOSE
            if better:
                plan[w, via] = c
                plan[w, way] = first + rest


@compiled
def look_around(g, ep, t, i):
    field, paths, f, w = g.field, g.paths, column(g.field, t.w), t.w
    x, y, edges = ep.x[i, w], ep.y[i, w], paths.ways_in[EDGES, f]
    if hide_rois(g, ep, t, i, x, y):
        for c in range(paths.ways_in[WAYPOINTS, f]):
            cx, cy = paths.waypoints[0, c, f], paths.waypoints[1, c, f]
            if in_sight(field.edges, edges, f, x, y, cx, cy):
                try_waypoint(g, t, i, c, path_length(cx - x, cy - y))
        for j in range(t.m):
            row = way_row(t, i, j)
            if t.plan[w, row + t.n * t.m] == NO_WAY:
                t.plan[w, row] = path_length(field.rois[0, j, f] - x, field.rois[1, j, f] - y)


@compiled
def find_ways(g, mem, ep, lo, hi):
    n, m, plan, rois = ep.x.shape[0], g.field.rois.shape[1], mem.plan, g.field.rois
    ways, vias = 2 * n + 3 * m, 2 * n + 3 * m + n * m
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                f = column(g.field, w)
                dx, dy = rois[0, j, f] - ep.x[i, w], rois[1, j, f] - ep.y[i, w]
                plan[w, ways + m * i + j] = path_length(dx, dy)
                plan[w, vias + m * i + j] = STRAIGHT
                plan[w, vias + m * (n + i) + j] = 0
    if g.paths.waypoints.shape[1] > 0:
        for w in range(lo, hi):
            for i in range(n if g.paths.ways_in[WAYPOINTS, column(g.field, w)] > 0 else 0):
                if status_of(ep, i, w) != ABSENT:
                    look_around(g, ep, Tours(plan, n, m, w), i)


@compiled
def get_going(p, g, ep, t):
    f, w = column(g.field, t.w), t.w
    for i in range(t.n):
        for j in range(t.m):
            _, first = way_to(t, i, j)
            places, at = (g.paths.waypoints, first) if first >= 0 else (g.field.rois, j)
            dx, dy = places[0, at, f] - ep.x[i, w], places[1, at, f] - ep.y[i, w]
            far = max(math.sqrt(dx * dx + dy * dy), CLOSE)
            slow = 1 - p.per_speed * (ep.vx[i, w] * dx + ep.vy[i, w] * dy) / far
            t.plan[w, way_row(t, i, j) + 2 * t.n * t.m] = GO * slow * slow


@compiled
def next_row(t, i, a):
    """The row of the ROI that robot i visits after ROI a, or first of all if that is ``END``."""
    return t.n + i if a == END else 2 * t.n + 2 * t.m + a


@compiled
def next_of(t, i, a):
    return np.int64(t.plan[t.w, next_row(t, i, a)])


@compiled
def put_after(t, i, a, j):
    t.plan[t.w, next_row(t, i, j)] = next_of(t, i, a)
    t.plan[t.w, next_row(t, i, a)] = j


@compiled
def take_after(t, i, a):
    j = next_of(t, i, a)
    t.plan[t.w, next_row(t, i, a)] = next_of(t, i, j)
    return j


@compiled
def exchange(t, i, a, k, b):
    u, v = next_of(t, i, a), next_of(t, k, b)
    t.plan[t.w, next_row(t, i, a)], t.plan[t.w, next_row(t, k, b)] = v, u


@compiled
def tour_length(g, ep, t, i):
    rois, legs, f, w = g.field.rois, g.paths.legs, column(g.field, t.w), t.w
    bent = g.paths.waypoints.shape[1] > 0 and g.paths.ways_in[WAYPOINTS, f] > 0
    total = ux = uy = t.plan[w, i] * 0
    a, x, y = END, ep.x[i, w], ep.y[i, w]
    b = next_of(t, i, a)
    while b != END:
        dx, dy = rois[0, b, f] - x, rois[1, b, f] - y
        if a == END:
            row = way_row(t, i, b)
            total += t.plan[w, row] + t.plan[w, row + 2 * t.n * t.m]
        elif bent and legs[a, b, f] < NEVER:
            total += legs[a, b, f]
        else:
            total += path_length(dx, dy)
        far = max(math.sqrt(dx * dx + dy * dy), CLOSE)
        total += TURN_BACK * max(-(ux * dx + uy * dy) / far, 0)
        a, x, y, ux, uy = b, rois[0, b, f], rois[1, b, f], dx / far, dy / far
        b = next_of(t, i, a)
    return total


@compiled
def other_tours(t, i, k):
    longest = total = t.plan[t.w, 0] * 0
    for other in range(t.n):
        if (other != i) & (other != k):
            tour = t.plan[t.w, other]
            longest, total = max(longest, tour), total + tour
    return longest, total


@compiled
def best_place(g, ep, t, j, weight):
    """Find where ROI j costs least: the cost, the robot, ``END`` if none works, the ROI before."""
    # The cost is that of all tours: the longest one plus ``weight`` times their sum.
    least, robot, after = NEVER, END, END
    for i in range(t.n):
        if (status_of(ep, i, t.w) == WORKS) & is_mine(g, i, j, t.w):
            longest, total = other_tours(t, i, i)
            a, more = END, True
            while more:
                put_after(t, i, a, j)
                tour = tour_length(g, ep, t, i)
                take_after(t, i, a)
                cost = max(longest, tour) + weight * (total + tour)
                if cost < least - CLOSE:
                    least, robot, after = cost, i, a
                a = next_of(t, i, a)
                more = a != END
    return least, robot, after


@compiled
def insert_one(g, ep, t, weight):
    field, w = g.field, t.w
    most, dearest, robot, after = -NEVER, END, END, END
    for j in range(t.m):
        left = (ep.visited[w] & field.roi_bits[j, column(field, w)]) == 0
        if (t.plan[w, 2 * t.n + j] == END) & left:
            cost, i, a = best_place(g, ep, t, j, weight)
            if (i != END) & (cost > most + CLOSE):
                most, dearest, robot, after = cost, j, i, a
    if dearest != END:
        put_after(t, robot, after, dearest)
        t.plan[w, 2 * t.n + dearest] = robot
        t.plan[w, robot] = tour_length(g, ep, t, robot)
    return dearest != END


@compiled
def best_move(g, ep, t, least):
    # Find the ROI that had better be elsewhere, so that the cost is less than ``least``. Return the
    # cost, its robot, ``END`` if there is none, the ROI before it, and both elsewhere.
    robot, before, to, after = END, END, END, END
    for i in range(t.n):
        a, tour = END, t.plan[t.w, i]
        while next_of(t, i, a) != END:
            j = take_after(t, i, a)
            t.plan[t.w, i] = tour_length(g, ep, t, i)
            cost, k, b = best_place(g, ep, t, j, SPREAD)
            put_after(t, i, a, j)
            t.plan[t.w, i] = tour
            if cost < least - CLOSE:
                least, robot, before, to, after = cost, i, a, k, b
            a = j
    return least, robot, before, to, after


@compiled
def best_exchange(g, ep, t, least):
    # Find two robots that had better exchange the ends of their orders, for less than ``least``.
    # Return the first, ``END`` if there is none, the ROI before its end, and both of the second.
    one, before, two, after = END, END, END, END
    for i in range(t.n):
        for k in range(i + 1, t.n):
            longest, total = other_tours(t, i, k)
            both_work = (status_of(ep, i, t.w) == WORKS) & (status_of(ep, k, t.w) == WORKS)
            a, more = END, both_work & are_alike(g, i, k, t.w)
            while more:
                b, other_more = END, True
                while other_more:
                    exchange(t, i, a, k, b)
                    tour, other = tour_length(g, ep, t, i), tour_length(g, ep, t, k)
                    exchange(t, i, a, k, b)
                    cost = max(longest, max(tour, other)) + SPREAD * (total + tour + other)
                    if cost < least - CLOSE:
                        least, one, before, two, after = cost, i, a, k, b
                    b = next_of(t, k, b)
                    other_more = b != END
                a = next_of(t, i, a)
                more = a != END
    return one, before, two, after


@compiled
def change_one(g, ep, t):
    longest, total = other_tours(t, END, END)
    least, robot, before, to, place = best_move(g, ep, t, longest + SPREAD * total)
    one, a, two, b = best_exchange(g, ep, t, least)
    if one != END:
        exchange(t, one, a, two, b)
    elif robot != END:
        put_after(t, to, place, take_after(t, robot, before))
    return (one != END) | (robot != END)


@compiled
def measure_all(g, ep, t):
    for i in range(t.n):
        t.plan[t.w, i] = tour_length(g, ep, t, i)
        count, j = 0, next_of(t, i, END)
        while j != END:
            count += 1
            t.plan[t.w, 2 * t.n + j], t.plan[t.w, 2 * t.n + t.m + j] = i, 1 / count
            j = next_of(t, i, j)


@compiled
def assign_all(g, ep, t, weight):
    for i in range(t.n):
        t.plan[t.w, i] = 0
    for row in range(t.n, 2 * t.n + t.m):
        t.plan[t.w, row] = END
    while insert_one(g, ep, t, weight):
        pass
    changes, more = CHANGES * count_bits(g.field.codes[column(g.field, t.w)]), True
    while more:
        measure_all(g, ep, t)
        more = (changes > 0) and change_one(g, ep, t)
        changes -= 1
    longest, total = other_tours(t, END, END)
    return longest + SPREAD * total


@compiled
def keep(g, ep, t):
    """Leave out what has been visited; return whether all robots with ROIs left work."""
    field, w, kept = g.field, t.w, True
    for i in range(t.n):
        a = END
        j = next_of(t, i, a)
        while j != END:
            if (ep.visited[w] & field.roi_bits[j, column(field, w)]) != 0:
                t.plan[w, 2 * t.n + take_after(t, i, a)] = END
            else:
                a, kept = j, kept & (status_of(ep, i, w) == WORKS)
            j = next_of(t, i, a)
    return kept


@compiled
def assign(p, g, mem, ep, lo, hi):
    if assigns(mem):
        find_ways(g, mem, ep, lo, hi)
        n, m = ep.x.shape[0], g.field.rois.shape[1]
        for w in range(lo, hi):
            t = Tours(mem.plan, n, m, w)
            if p.keeps_plan == 0:
                get_going(p, g, ep, t)
            if (p.keeps_plan > 0) and (ep.steps[w] > 0) and keep(g, ep, t):
                measure_all(g, ep, t)
            else:
                # Two weights are tried. If the first was cheaper, it is made again, since no plan
                # is stored. The loop has one call: Numba compiles in all that it calls only once.
                first = t.plan[w, 0] * 0
                for weight in (SUM, SPREAD, SUM):
                    cost = assign_all(g, ep, t, weight)
                    if (weight == SPREAD) & (cost < first - CLOSE):
                        break
                    first = cost


@compiled
def way_to(t, i, j):
    """The length of robot i's way to ROI j; its first waypoint, ``STRAIGHT`` or ``NO_WAY``."""
    row = way_row(t, i, j)
    return t.plan[t.w, row], np.int64(t.plan[t.w, row + t.n * t.m])
