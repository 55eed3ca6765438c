"""Where the generator of fields finds its numbers, and what it may use: plain constants.

Lengths are whole numbers of milli-units, so that every processor makes the same field.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FAMILIES = ("convex", "concave", "corridors", "obstacles", "farm")
"""The families of generated fields; their places here are their codes."""
CONVEX, CONCAVE, CORRIDORS, OBSTACLES, FARM = range(len(FAMILIES))
MOST_EDGES = {"convex": 12, "concave": 16, "corridors": 20, "obstacles": 32, "farm": 20}
"""The most corners of a family's fields, of outline and holes together."""

MILLI = 1000
"""Milli-units per unit."""
ARENA, SIZE, ROBOTS, ROIS, WEIGHTS = 0, 2, 4, 6, 8
"""Of a sampler's numbers: the arena's sides, three ranges, and the families' weights, summed up."""
WEIGHT_SUM = 1 << 30

PASSAGE = 12 * MILLI
"""No passage is narrower."""
WALL, WALL_WISH = 4 * MILLI, 8 * MILLI
"""How far ROIs and starts are from walls, at least and if it can be had."""
ROIS_APART, ROIS_WISH = 5 * MILLI, 30 * MILLI
STARTS_APART, STARTS_WISH = 12 * MILLI, 30 * MILLI
ROI_WISH = 20 * MILLI
"""How far starts are from ROIs if it can be had."""

CORNERS = max(MOST_EDGES.values())
COUNTER = 0
X, Y, NEXT, LENGTH = (1 + k * CORNERS for k in range(4))
"""Rows of the scratch: corners, the corner that follows, the length of the edge to it."""
POINTS = 1 + 4 * CORNERS
"""The row of the first ROI's x; then its y, the next ROI's, and the starts."""


def scratch_rows(robots: int, rois: int) -> int:
    """Return how many rows the generator needs for these numbers of robots and ROIs."""
    return POINTS + 2 * (robots + rois)


class Tables(NamedTuple):
    """Generated fields, one in each of F columns, as the engine has them."""

    edges: NDArray[Any]  # (4, E, F) real
    rois: NDArray[Any]  # (2, m, F) real
    starts: NDArray[Any]  # (2, n, F) real
    roi_bits: NDArray[Any]  # (m, F) int32
    codes: NDArray[Any]  # (F,) int32
    boxes: NDArray[Any]  # (4, F) real
    robots_in: NDArray[Any]  # (F,) int32: how many robots a field has


def make_tables(edges: int, rois: int, robots: int, count: int) -> Tables:
    """Return zeroed tables for ``count`` fields, with numbers of float64."""
    return Tables(
        edges=np.zeros((4, edges, count)),
        rois=np.zeros((2, rois, count)),
        starts=np.zeros((2, robots, count)),
        roi_bits=np.zeros((rois, count), np.int32),
        codes=np.zeros(count, np.int32),
        boxes=np.zeros((4, count)),
        robots_in=np.zeros(count, np.int32),
    )
