"""The observation ``entities`` a second time: ``docs/mdp.md``, "What a robot sees"."""

from __future__ import annotations

import math
from typing import Any

NEAR, FAR = 15.0, 100.0


def soft(length: float, scale: float) -> float:
    """A length, or a part of one, as an entry."""
    return length / (abs(length) + scale)


def offset(dx: float, dy: float) -> list[float]:
    """The four entries of an offset."""
    return [soft(part, scale) for scale in (NEAR, FAR) for part in (dx, dy)]


def approach(d: list[float], dv: list[float], time: float) -> float:
    """How near something comes within a time."""
    square = sum(part * part for part in dv)
    when = 0.0
    if square:
        when = min(max(-sum(a * b for a, b in zip(d, dv, strict=True)) / square, 0.0), time)
    return math.hypot(*(a + when * b for a, b in zip(d, dv, strict=True)))


class Plan:
    """Who would visit what: the ROIs that are left, the earliest possible visit always next.

    Args:
        spots: where the robots are.
        works: which of them work.
        rois: where the ROIs are.
        left: the indices of those that are left.
    """

    def __init__(self, spots: list[Any], works: list[bool], rois: list[Any], left: list[int]):
        self.orders: list[list[int]] = [[] for _ in spots]
        self.tours = [spot[0] * 0 for spot in spots]
        at, left = list(spots), list(left)
        team = [i for i, able in enumerate(works) if able]
        while left and team:
            total, i, j = min(
                (self.tours[i] + max(abs(a - b) for a, b in zip(rois[j], at[i], strict=True)), i, j)
                for i in team
                for j in left
            )
            self.tours[i], at[i] = total, rois[j]
            self.orders[i].append(j)
            left.remove(j)

    def turn(self, i: int, j: int) -> float:
        """1 over the place of ROI j in the order of robot i, or 0."""
        return 1.0 / (1 + self.orders[i].index(j)) if j in self.orders[i] else 0.0
