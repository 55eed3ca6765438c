"""Sharing the ROIs out among the robots: the partition whose slowest robot is the fastest."""

from __future__ import annotations

import numba
import numpy as np

from mbn_marl.planning.legs import NEVER, Ints


def least_makespan(bounds: Ints) -> int:
    """The least T such that the robots can share all ROIs, each within its bound.

    Args:
        bounds: (n, 2^m), steps; ROI sets as bit masks.
    """
    return int(_bottleneck(bounds)[-1])


def cheapest_partition(costs: Ints) -> list[int] | None:
    """The partition of all ROIs with the least sum of costs, a mask a robot.

    Args:
        costs: (n, 2^m), of each robot's set, :data:`NEVER` for a set that it cannot have.

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
    """(2^m,): the least bottleneck with which all robots together have exactly each set."""
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
    """(n, 2^m) twice: least costs of the first robots having exactly a set; the last one's part."""
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
