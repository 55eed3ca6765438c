"""Partitions of the ROIs among the robots: sets of ROIs are bit masks, as in :mod:`.legs`."""

from __future__ import annotations

import bisect

import numpy as np

from mbn_marl.jit.compile import entry_point_of_one_file
from mbn_marl.planning.legs import NEVER, Ints
from mbn_marl.planning.orders import UndecidedError

FEW_ROIS = 11
"""Up to here by dynamic programming over all subsets, beyond by a search for covers."""
MOST_NODES = 100_000
"""Branches of one search for a cover."""


def least_makespan(masks: Ints, bounds: Ints, whole: int) -> int:
    """Return the least T by which the robots can visit all ROIs if each takes just its bound.

    It is :data:`NEVER` if they cannot. If the search ends early, T is a lower bound.

    Args:
        masks: (K,), the sets that some robot can visit, and all of their subsets, rising.
        bounds: (n, K), steps for each robot and set; :data:`NEVER` excludes it.
        whole: the set of all ROIs.
    """
    if whole < 1 << FEW_ROIS:
        return int(_best(_table(masks, bounds, whole), sums=False)[0][-1, -1])

    def may_do(steps: int) -> bool:
        try:
            return _covered(masks, bounds <= steps, whole) is not None
        except UndecidedError:
            return True

    steps = [*np.unique(bounds[bounds < NEVER]).tolist(), NEVER]
    return int(steps[bisect.bisect_left(steps[:-1], True, key=may_do)])


def cheapest_partition(masks: Ints, costs: Ints, whole: int) -> list[int] | None:
    """Return a partition of all ROIs with a small sum of costs, or ``None`` if there is none.

    Arguments as for :func:`least_makespan`. For few ROIs the sum is the least; for many the search
    may raise an UndecidedError.
    """
    if whole >= 1 << FEW_ROIS:
        cover = _covered(masks, costs < NEVER, whole)
        return None if cover is None else _improved(masks, costs, cover)
    total, choice = _best(_table(masks, costs, whole), sums=True)
    n, rest = len(costs), whole
    if total[n - 1, rest] >= NEVER:
        return None
    parts = [0] * n
    for i in range(n - 1, -1, -1):
        parts[i] = int(choice[i, rest])
        rest &= ~parts[i]
    return parts


def _table(masks: Ints, values: Ints, whole: int) -> Ints:
    table = np.full((len(values), whole + 1), NEVER)
    table[:, masks] = values
    return table


@entry_point_of_one_file
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


def _covered(masks: Ints, allowed: np.ndarray, whole: int) -> list[int] | None:
    """Return a partition into allowed sets, (n, K) bool, or ``None``: there is none."""
    owners, sets = [], []
    for i, row in enumerate(allowed):
        largest: list[int] = []  # of a robot's sets those that no other one contains
        for mask in sorted(masks[row].tolist(), key=int.bit_count, reverse=True):
            if not any(mask & ~other == 0 for other in largest):
                largest.append(mask)
        owners += [i] * len(largest)
        sets += largest
    chosen = np.zeros(len(allowed), np.int64)
    budget = np.array([MOST_NODES])
    found = _cover(np.array(owners), np.array(sets), whole, chosen, budget)
    if not found and budget[0] < 0:
        raise UndecidedError
    return chosen.tolist() if found else None


@entry_point_of_one_file
def _cover(owners: Ints, sets: Ints, rest: int, chosen: Ints, budget: Ints) -> bool:
    """Search depth first a part for each robot such that all of ``rest`` is covered.

    Robots with a part in ``chosen`` have theirs. The next ROI is the one in the fewest sets.
    """
    if rest == 0:
        return True
    budget[0] -= 1
    if budget[0] < 0:
        return False
    parts = np.where(chosen[owners] == 0, sets & rest, 0)
    sizes = np.array([_size(part) for part in parts])
    largest = np.zeros_like(chosen)
    for i, size in zip(owners, sizes):  # noqa: B905  (numba has no strict)
        largest[i] = max(largest[i], size)
    if largest.sum() < _size(rest):
        return False
    rarest = _rarest(parts, rest)
    for k in np.argsort(-sizes):
        if parts[k] & rarest and not _contained(k, owners, parts):
            chosen[owners[k]] = parts[k]
            if _cover(owners, sets, rest & ~parts[k], chosen, budget):
                return True
            chosen[owners[k]] = 0
    return False


@entry_point_of_one_file
def _size(mask: int) -> int:
    size = 0
    while mask:
        mask &= mask - 1
        size += 1
    return size


@entry_point_of_one_file
def _rarest(parts: Ints, rest: int) -> int:
    least, rarest = len(parts) + 1, 0
    while rest:
        roi = rest & -rest
        rest &= ~roi
        count = int(np.count_nonzero(parts & roi))
        if count < least:
            least, rarest = count, roi
    return rarest


@entry_point_of_one_file
def _contained(k: int, owners: Ints, parts: Ints) -> bool:
    """Return whether a larger part of the same robot, or an equal one before, contains part k."""
    for other in range(len(parts)):
        larger = parts[other] != parts[k] or other < k
        if larger and owners[other] == owners[k] and parts[k] & ~parts[other] == 0:
            return True
    return False


def _improved(masks: Ints, costs: Ints, parts: list[int]) -> list[int]:
    """Return the partition after single ROIs have gone to other robots while that costs less."""
    place = {mask: k for k, mask in enumerate(masks.tolist())}
    again = True
    while again:
        again = False
        for a, b in np.ndindex(len(parts), len(parts)):
            for j in range(parts[a].bit_length()):
                less, more = parts[a] & ~(1 << j), parts[b] | 1 << j
                if a == b or less == parts[a] or more not in place:
                    continue
                after = costs[a, place[less]] + costs[b, place[more]]
                if after < costs[a, place[parts[a]]] + costs[b, place[parts[b]]]:
                    parts[a], parts[b], again = less, more, True
    return parts
