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
    return int(_bottleneck(bounds)[-1])


def cheapest_partition(costs: Ints) -> list[int] | None:
    """Return the partition of all ROIs with the least sum of costs.

    Args:
        costs: (n, 2^m), of each robot and ROI set; :data:`NEVER` excludes a set.

    Returns:
        A mask for each robot, or ``None`` if there is no partition.
    """
    total, choice = _cheapest(costs)
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
def _bottleneck(bounds: Ints) -> Ints:
    """Return (2^m,): the least bottleneck with which the robots together visit each set."""
    best: Ints = bounds[0].copy()
    for i in range(1, len(bounds)):
        now = np.empty_like(best)
        for whole in range(len(best)):
            part, least = whole, NEVER
            while True:
                least = min(least, max(bounds[i, part], best[whole & ~part]))
                if part == 0:
                    break
                part = (part - 1) & whole
            now[whole] = least
        best = now
    return best


@numba.njit(cache=True)
def _cheapest(costs: Ints) -> tuple[Ints, Ints]:
    """Return the least costs of robots 0 to i together visiting a set, and robot i's part."""
    total = np.empty_like(costs)
    choice = np.zeros_like(costs)
    total[0] = costs[0]
    for whole in range(costs.shape[1]):
        choice[0, whole] = whole
    for i in range(1, len(costs)):
        for whole in range(costs.shape[1]):
            part, least, chosen = whole, NEVER, 0
            while True:
                cost = costs[i, part] + total[i - 1, whole & ~part]
                if cost < least:
                    least, chosen = cost, part
                if part == 0:
                    break
                part = (part - 1) & whole
            total[i, whole] = least
            choice[i, whole] = chosen
    return total, choice
