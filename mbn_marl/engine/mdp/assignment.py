"""Which robot would be the first at each ROI that is left (mdp.md, "What a robot sees").

``Memory.plan`` has it, made anew for each observation. For n robots and m ROIs its rows are, one
after the other: how far each robot would go in all (n), how many ROIs it would visit (n), the robot
that would visit each ROI (m), 1 over its place in that robot's order (m), how far each robot has to
go from where it would be to each ROI (n m), and the least of these sums and where it is (2).
Where nothing is assigned, it has three dimensions and no entries, and all of this is left out when
it is compiled.

Source: this package.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.compiled.jit import compiled
from mbn_marl.compiled.scalars import column, select
from mbn_marl.engine.mdp.failures import works

NEVER = np.float32(np.inf)


def rows_planned(n: int, m: int) -> int:
    """How many rows ``Memory.plan`` has for n robots and m ROIs."""
    return 2 * n + 2 * m + n * m + 2


@compiled
def length(dx, dy):
    """How far it is: forces and speed limits are per axis, so this is what takes time."""
    return max(abs(dx), abs(dy))


@compiled
def begin_plan(g, plan, status, ep, lo, hi):
    """Nothing is assigned: how far each robot that works has to go to each ROI that is left."""
    n, m = ep.x.shape[0], g.rois.shape[1]
    ways = 2 * n + 2 * m
    for row in range(ways):
        for w in range(lo, hi):
            plan[row, w] = 0
    for i in range(n):
        for j in range(m):
            for w in range(lo, hi):
                f = column(g, w)
                left = ((ep.visited[w] & g.roi_bits[j, f]) == 0) & works(status, i, w)
                way = length(g.rois[0, j, f] - ep.x[i, w], g.rois[1, j, f] - ep.y[i, w])
                plan[ways + m * i + j, w] = select(left, way, NEVER)


@compiled
def find_next(plan, n, m, lo, hi):
    """Find the earliest visit that is possible, the lowest robot's and ROI's of several."""
    ways = 2 * n + 2 * m
    least, place = ways + n * m, ways + n * m + 1
    for w in range(lo, hi):
        plan[least, w] = NEVER
    for i in range(n):
        for j in range(m):
            here = np.float32(m * i + j)
            for w in range(lo, hi):
                total = plan[i, w] + plan[ways + m * i + j, w]
                closer = total < plan[least, w]
                plan[place, w] = select(closer, here, plan[place, w])
                plan[least, w] = select(closer, total, plan[least, w])


@compiled
def assign_next(g, plan, n, m, w):
    """Assign the visit that was found; return whether there was one."""
    ways = 2 * n + 2 * m
    total = plan[ways + n * m, w]
    if total == NEVER:
        return False
    place = np.int64(plan[ways + n * m + 1, w])
    i, j, f = place // m, place % m, column(g, w)
    plan[i, w] = total
    plan[n + i, w] += 1
    plan[2 * n + j, w] = i
    plan[2 * n + m + j, w] = 1 / plan[n + i, w]
    for robot in range(n):
        plan[ways + m * robot + j, w] = NEVER
    for k in range(m):
        if plan[ways + m * i + k, w] < NEVER:
            dx, dy = g.rois[0, k, f] - g.rois[0, j, f], g.rois[1, k, f] - g.rois[1, j, f]
            plan[ways + m * i + k, w] = length(dx, dy)
    return True


@compiled
def assign(g, plan, status, ep, lo, hi):
    """Assign the ROIs that are left to the robots that work, in each world of a block.

    ``plan`` is that of the memory, ``status`` that of ``ep``.
    """
    if plan.ndim == 2:
        n, m = ep.x.shape[0], g.rois.shape[1]
        begin_plan(g, plan, status, ep, lo, hi)
        some = True
        for _ in range(m):
            if some:
                find_next(plan, n, m, lo, hi)
                some = False
                for w in range(lo, hi):
                    some |= assign_next(g, plan, n, m, w)


@compiled
def tour(plan, i, w):
    """How far robot i would go in all, units."""
    return plan[i, w]


@compiled
def turn_of(plan, n, m, i, j, w):
    """1 over the place of ROI j in the order in which robot i would visit it, 0 if it would not."""
    return plan[2 * n + m + j, w] if plan[2 * n + j, w] == i else plan[0, w] * 0
