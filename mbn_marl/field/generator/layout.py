"""The numbers of generated fields, and the tables that they fill; lengths are in milli-units."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

Family = Literal["convex", "concave", "corridors", "obstacles", "farm"]
FAMILIES: tuple[str, ...] = get_args(Family)
"""The families of generated fields; their places here are their codes."""
MOST_EDGES = {"convex": 12, "concave": 16, "corridors": 20, "obstacles": 32, "farm": 20}
"""The most corners of a family's fields, of outline and holes together."""

MILLI = 1000
"""Milli-units per unit."""
WEIGHT_SUM = 1 << 30

WALL, ROIS_APART, STARTS_APART = 4 * MILLI, 5 * MILLI, 12 * MILLI
"""The least distances of ROIs and starts from walls, of ROIs, of starts."""
CORNERS = max(MOST_EDGES.values())
POINTS = 1 + 4 * CORNERS
"""The scratch's row of the first ROI's x; then its y, the next ROI's, and the starts."""


def scratch_rows(robots: int, rois: int) -> int:
    return POINTS + 2 * (robots + rois)


class Tables(NamedTuple):
    """Generated fields, one in each of F columns, as the engine has them."""

    edges: npt.NDArray[Any]  # (4, E, F) real
    rois: npt.NDArray[Any]  # (2, m, F) real
    starts: npt.NDArray[Any]  # (2, n, F) real
    roi_bits: npt.NDArray[Any]  # (m, F) int32
    codes: npt.NDArray[Any]  # (F,) int32
    boxes: npt.NDArray[Any]  # (4, F) real
    robots_in: npt.NDArray[Any]  # (F,) int32: how many robots a field has
    mine: npt.NDArray[Any]  # (n, F) int32: see mdp.kinds; (0, 0, F) if no field has kinds


def make_tables(edges: int, rois: int, robots: int, count: int, kinds: bool = False) -> Tables:
    """Return zeroed tables for ``count`` fields, with numbers of float64."""
    lines, goals, starts, boxes = (
        np.zeros((*shape, count)) for shape in ((4, edges), (2, rois), (2, robots), (4,))
    )
    bits, codes, robots_in = (np.zeros((*shape, count), np.int32) for shape in ((rois,), (), ()))
    mine = np.zeros((robots, count) if kinds else (0, 0, count), np.int32)
    return Tables(lines, goals, starts, bits, codes, boxes, robots_in, mine)
