"""Least steps of single legs in closed form, and what follows for whole sets of ROIs.

Sets of ROIs are bit masks: ROI j is the bit ``1 << j``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mbn_marl.planning.problem import Drive, Floats, Problem, reach_from_rest

Ints = NDArray[np.int64]
NEVER = 1 << 40
"""More steps than any plan has."""


def first_steps(problem: Problem, slack: float, most: int) -> Ints:
    """(n, m): the least steps in which each robot, at rest at first, reaches each ROI's disc.

    At least one: ROIs are visited after steps, not at the start.
    """
    steps = np.empty((problem.n, problem.m), np.int64)
    for i, (start, drive) in enumerate(zip(problem.starts, problem.drives, strict=True)):
        for j, roi in enumerate(problem.rois):
            steps[i, j] = _first(roi - start, drive, problem.config.roi_radius + slack, most)
    return steps


def _first(offset: Floats, drive: Drive, radius: float, most: int) -> int:
    """The least L whose box of reachable offsets meets the disc about ``offset``."""

    def meets(steps: int) -> bool:
        gaps = []
        for axis in (0, 1):
            rate = drive.rise[axis] if offset[axis] > 0 else drive.fall[axis]
            reach = reach_from_rest(rate, drive.top, drive.tau, steps)
            gaps.append(max(abs(float(offset[axis])) - reach, 0.0))
        return math.hypot(*gaps) <= radius

    return max(_least(meets, most), 1)


def steps_between(problem: Problem, slack: float, most: int) -> Ints:
    """(m, m): the least steps from one disc to another, with any velocities at both."""
    config = problem.config
    apart = 2.0 * (config.roi_radius + slack)
    steps = np.zeros((problem.m, problem.m), np.int64)
    for j in range(problem.m):
        for k in range(j):
            offset = np.abs(problem.rois[j] - problem.rois[k])

            def meets(count: int, offset: Floats = offset) -> bool:
                gaps = np.maximum(offset - config.v_clip * config.tau * count, 0.0)
                return math.hypot(*gaps) <= apart

            steps[j, k] = steps[k, j] = _least(meets, most)
    return steps


def _least(meets: object, most: int) -> int:
    """The least count in [0, most] for which ``meets`` holds, from there on always; or NEVER."""
    assert callable(meets)
    if not meets(most):
        return NEVER
    low, high = -1, most
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if meets(middle) else (middle, high)
    return high


def tails(between: Ints) -> Ints:
    """(2^m, m): the least steps in which the ROIs of a set are visited, coming from ROI j.

    Held and Karp's recursion; entries whose set holds j are of no use.
    """
    m = len(between)
    table = np.zeros((1 << m, m), np.int64)
    for mask in range(1, 1 << m):
        chosen = [k for k in range(m) if mask >> k & 1]
        after = np.array([table[mask & ~(1 << k), k] for k in chosen])
        table[mask] = np.minimum((between[:, chosen] + after).min(axis=1), NEVER)
    return table


def set_bounds(first: Ints, tail: Ints) -> Ints:
    """(n, 2^m): a lower bound of the steps in which each robot visits the ROIs of each set."""
    n, m = first.shape
    bounds = np.zeros((n, 1 << m), np.int64)
    for mask in range(1, 1 << m):
        chosen = [k for k in range(m) if mask >> k & 1]
        after = np.array([tail[mask & ~(1 << k), k] for k in chosen])
        bounds[:, mask] = np.minimum((first[:, chosen] + after).min(axis=1), NEVER)
    return bounds
