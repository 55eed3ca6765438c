"""Least steps of single legs in closed form, and what follows for whole sets of ROIs.

Sets of ROIs are bit masks: ROI j is the bit ``1 << j``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.planning.problem import Drive, Floats, Problem, reach_from_rest
from mbn_marl.planning.roadmap import Roadmap, make_roadmap

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


def _least(meets: Callable[[int], bool], most: int) -> int:
    """The least count in [0, most] for which ``meets`` holds, from there on always; or NEVER."""
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


@dataclass(frozen=True, eq=False)
class Legs:
    """Least steps of single legs.

    Attributes:
        first: (n, m), from each robot's start, at rest, to each ROI's disc; at least 1.
        between: (m, m), from disc to disc, with any velocities at both.
    """

    first: Ints
    between: Ints


def proved_legs(problem: Problem, slack: float, most: int) -> Legs:
    """Least steps that hold in the engine: by the dynamics, and by the shape of the field.

    Args:
        problem: the instance.
        slack: what rounding may do, in units.
        most: entries above this are :data:`NEVER`.
    """
    first = first_steps(problem, slack, most)
    between = steps_between(problem, slack, most)
    if problem.convex:
        return Legs(first, between)
    area = _steppable(problem, slack)
    radius = problem.config.roi_radius + slack
    around = way_legs(problem, make_roadmap(area, _places(problem), largest=True), radius, most)
    return Legs(np.maximum(first, around.first), np.maximum(between, around.between))


def way_legs(problem: Problem, roadmap: Roadmap, radius: float, most: int) -> Legs:
    """Least steps if no way between two places is shorter than the roadmap's.

    Args:
        problem: the instance.
        roadmap: of the starts and the ROIs, in this order, by larger coordinates.
        radius: of the discs.
        most: entries above this are :data:`NEVER`.
    """
    n, m = problem.n, problem.m
    first, between = np.empty((n, m), np.int64), np.zeros((m, m), np.int64)
    for i, drive in enumerate(problem.drives):
        rate = max(*drive.rise, *drive.fall)
        for j in range(m):
            far = roadmap.lengths[i, n + j] - radius

            def reaches(steps: int, far: float = far, rate: float = rate) -> bool:
                top, tau = problem.config.v_clip, problem.config.tau
                return far <= reach_from_rest(rate, top, tau, steps)

            first[i, j] = max(_least(reaches, most), 1)
    stride = problem.config.v_clip * problem.config.tau
    steps = np.ceil((roadmap.lengths[n : n + m, n : n + m] - 2.0 * radius) / stride - 1e-9)
    between = np.where(steps <= most, np.maximum(steps, 0.0), NEVER).astype(np.int64)
    np.fill_diagonal(between, 0)
    return Legs(first, between)


def _places(problem: Problem) -> Floats:
    return np.concatenate([problem.starts, problem.rois])


def _steppable(problem: Problem, slack: float) -> shapely.Geometry:
    """What the straight lines between a robot's positions after its steps cannot leave.

    Only these positions have to be in the field. Each point of the line between two of them is
    within half a step of one. The ROIs' discs belong to it, so that each is one place.
    """
    config = problem.config
    half = math.hypot(0.5, 0.5) * config.v_clip * config.tau + slack
    grown = problem.field.polygon.buffer(half, join_style="mitre")
    outer = (config.roi_radius + slack) / math.cos(math.pi / 16.0)
    discs = shapely.buffer(shapely.points(problem.rois), outer, quad_segs=4)
    return shapely.union_all([grown, *discs])
