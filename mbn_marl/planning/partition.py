"""Partitions of the ROIs among the robots, by dynamic programming over subsets."""

from __future__ import annotations

import numba
import numpy as np

from mbn_marl.planning.legs import NEVER, Ints


def least_makespan(bounds: Ints) -> int:
    """Return the least T by which the robots can visit all ROIs if each takes just its bound.

    Args:
        bounds: (n, 2^m), steps for each robot and ROI set (a bit mask).
    """
    return int(_best(bounds, sums=False)[0][-1, -1])


def cheapest_partition(costs: Ints) -> list[int] | None:
    """Return the partition of all ROIs with the least sum of costs, or ``None`` if there is none.

    Args:
        costs: (n, 2^m), of each robot and ROI set; :data:`NEVER` excludes a set.
    """
    total, choice = _best(costs, sums=True)
    n, sets = costs.shape
    rest = sets - 1
    if total[n - 1, rest] >= NEVER:
        return None
    masks = [0] * n
    for i in range(n - 1, -1, -1):
        masks[i] = int(choice[i, rest])
        rest &= ~masks[i]
    return masks


@numba.njit(cache=True)
def _best(costs: Ints, sums: bool) -> tuple[Ints, Ints]:
    """Return the least sum or largest of the costs of robots 0 to i for a set, and robot i's part.

    Both are (n, 2^m).
    """
    best = np.empty_like(costs)
    choice = np.zeros_like(costs)
    best[0] = costs[0]
    for whole in range(costs.shape[1]):
        choice[0, whole] = whole
    for i in range(1, len(costs)):
        for whole in range(costs.shape[1]):
            part, least, chosen = whole, NEVER, 0
            while True:
                own, others = costs[i, part], best[i - 1, whole & ~part]
                cost = own + others if sums else max(own, others)
                if cost < least:
                    least, chosen = cost, part
                if part == 0:
                    break
                part = (part - 1) & whole
            best[i, whole] = least
            choice[i, whole] = chosen
    return best, choice
