"""Least steps of single legs in closed form, and the bounds that follow for sets of ROIs.

Sets of ROIs are bit masks: ROI j is the bit ``1 << j``.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.planning.problem import Drive, Floats, Problem, reach
from mbn_marl.planning.roadmap import Roadmap, make_roadmap

Ints = NDArray[np.int64]
NEVER = 1 << 40
"""More steps than any plan has."""
MOST_SETS = 1 << 14


class TooManySetsError(Exception):
    """There are too many sets of ROIs to bound each."""


@dataclass(frozen=True, eq=False)
class Legs:
    """Least steps of single legs; at least 1 from a start, since ROIs are visited after steps."""

    first: Ints  # (n, m), from each robot's start, with its velocity, to each ROI's disc
    between: Ints  # (m, m), from disc to disc, with any velocities at both


def proved_legs(problem: Problem, slack: float, most: int) -> Legs:
    """Return least steps that hold in the engine; those above ``most`` are :data:`NEVER`.

    ``slack`` is the allowance for rounding, in units.
    """
    free = _free_legs(problem, slack, most)
    if problem.convex:
        return free
    places = np.concatenate([problem.starts, problem.rois])
    roadmap = make_roadmap(_steppable(problem, slack), places, largest=True)
    around = roadmap_legs(problem, roadmap, problem.config.roi_radius + slack, most)
    return Legs(np.maximum(free.first, around.first), np.maximum(free.between, around.between))


def _free_legs(problem: Problem, slack: float, most: int) -> Legs:
    radius = problem.config.roi_radius + slack
    stride = problem.config.top_speed * problem.config.tau
    first = np.empty((problem.n, problem.m), np.int64)
    between = np.zeros((problem.m, problem.m), np.int64)
    for j, roi in enumerate(problem.rois):
        for i, drive in enumerate(problem.drives):
            how = roi - problem.starts[i], problem.velocities[i], drive, radius
            first[i, j] = max(_least(partial(_meets, *how), most), 1)
        for k in range(j):
            offset = np.abs(roi - problem.rois[k])

            def meets(count: int, offset: Floats = offset) -> bool:
                return math.hypot(*np.maximum(offset - stride * count, 0.0)) <= 2.0 * radius

            between[j, k] = between[k, j] = _least(meets, most)
    # A set of ROIs takes at least as long as each of them, so no robot gets another kind's.
    first[~problem.mine] = NEVER
    return Legs(first, between)


def _meets(offset: Floats, velocity: Floats, drive: Drive, radius: float, steps: int) -> bool:
    """Return whether the box of offsets that are reachable within ``steps`` meets the disc."""
    gaps = []
    for axis in (0, 1):
        rate, _ = drive.rates(axis, offset[axis])
        along = float(velocity[axis] if offset[axis] > 0 else -velocity[axis])
        far = reach(along, rate, drive.top, drive.tau, steps)
        gaps.append(max(abs(float(offset[axis])) - far, 0.0))
    return math.hypot(*gaps) <= radius


def roadmap_legs(problem: Problem, roadmap: Roadmap, radius: float, most: int) -> Legs:
    """Return least steps if no path between two places is shorter than the roadmap's.

    The roadmap is of the starts, then the ROIs, measured by larger coordinates; ``radius`` is that
    of the discs. Entries above ``most`` are :data:`NEVER`.
    """
    n, m, config = problem.n, problem.m, problem.config
    first = np.empty((n, m), np.int64)
    for i, drive in enumerate(problem.drives):
        rate, speed = max(*drive.rise, *drive.fall), float(np.abs(problem.velocities[i]).max())
        far_by = partial(reach, speed, rate, drive.top, config.tau)
        for j in range(m):
            far = roadmap.lengths[i, n + j] - radius
            first[i, j] = max(_least(far_by, most, far), 1)
    first[~problem.mine] = NEVER
    stride = config.top_speed * config.tau
    steps = np.ceil((roadmap.lengths[n : n + m, n : n + m] - 2.0 * radius) / stride - 1e-9)
    between = np.where(steps <= most, np.maximum(steps, 0.0), NEVER).astype(np.int64)
    np.fill_diagonal(between, 0)
    return Legs(first, between)


def _least(value: Callable[[int], float], most: int, enough: float = True) -> int:
    """Return the least count in [0, most] whose rising ``value`` is ``enough``, or NEVER."""
    least = bisect.bisect_left(range(most + 1), enough, key=value)
    return least if least <= most else NEVER


@dataclass(frozen=True, eq=False)
class Sets:
    """The sets of ROIs that some robot may visit in time; with a set, all of its subsets."""

    masks: Ints  # (K,), rising, from the empty set on
    bounds: Ints  # (n, K), least steps of each robot from its start, or NEVER
    tails: dict[int, Ints]  # of each set (m,), least steps from an ROI outside it


def possible_sets(legs: Legs, most: int) -> Sets:
    """Return the sets with lower bounds up to ``most`` steps, by Held and Karp's recursion.

    A set takes at least as long as any part of it.

    Raises:
        TooManySetsError: there are more than :data:`MOST_SETS`.
    """
    n, m = legs.first.shape
    steps = np.concatenate([legs.between, legs.first])
    table = {0: np.zeros(m + n, np.int64)}
    newest = [0]
    while newest:
        smaller, newest = newest, []
        for mask in smaller:
            for last in range(mask.bit_length(), m):
                larger = mask | 1 << last
                chosen = [k for k in range(m) if larger >> k & 1]
                parts = [larger & ~(1 << k) for k in chosen]
                if any(part not in table for part in parts):
                    continue
                after = [table[part] for part in parts]
                rest = np.array([one[k] for one, k in zip(after, chosen, strict=True)])
                least = np.minimum((steps[:, chosen] + rest).min(axis=1), NEVER)
                least[m:] = np.maximum(least[m:], np.max([one[m:] for one in after], axis=0))
                if least[m:].min() <= most:
                    table[larger] = least
                    newest.append(larger)
            if len(table) > MOST_SETS:
                raise TooManySetsError
    masks = np.array(sorted(table))
    bounds = np.array([table[mask][m:] for mask in masks.tolist()]).T
    tails = {mask: least[:m] for mask, least in table.items()}
    return Sets(masks, np.where(bounds <= most, bounds, NEVER), tails)


def _steppable(problem: Problem, slack: float) -> shapely.Geometry:
    """Return an area that straight lines between consecutive positions of a robot cannot leave.

    Only the positions have to be in the field; every point of such a line is within half a step
    of one of them. The ROIs' discs are included, so that each disc is one place.
    """
    config = problem.config
    half = math.hypot(0.5, 0.5) * config.top_speed * config.tau + slack
    grown = problem.area.buffer(half, join_style="mitre")
    outer = (config.roi_radius + slack) / math.cos(math.pi / 16.0)
    discs = shapely.buffer(shapely.points(problem.rois), outer, quad_segs=4)
    return shapely.union_all([grown, *discs])
