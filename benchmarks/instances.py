"""Random instances to plan for: convex fields, and fields with bays and holes."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.field import Field

APART = 12.0
"""Least distance between starts, in units."""
MOST_EACH = 5
"""No instance has more ROIs than this for each robot."""


def convex_instance(seed: int) -> Field:
    """A convex field 100 to 400 units wide, with 4 to 10 ROIs and 2 to 7 robots."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(4, 11))
    n = int(rng.integers(max(2, math.ceil(m / MOST_EACH)), 8))
    while True:
        size = rng.uniform(120.0, 400.0, 2)
        corners = rng.uniform(0.0, 1.0, (int(rng.integers(5, 14)), 2)) * size
        outline = shapely.MultiPoint(corners + rng.uniform(100.0, 500.0, 2)).convex_hull
        if outline.area > 8000.0:
            return _field(rng, outline, m, n, f"convex_{seed}")


def winding_instance(seed: int) -> Field:
    """A star-shaped field, not convex or with holes, with 4 to 8 ROIs and 2 to 5 robots."""
    rng = np.random.default_rng(10_000 + seed)
    m, n = int(rng.integers(4, 9)), int(rng.integers(2, 6))
    while True:
        corners = int(rng.integers(5, 12))
        area = _ring(rng, rng.uniform(350.0, 650.0, 2), corners, 70.0, 220.0)
        for _ in range(int(rng.integers(0, 4))):
            room = area.buffer(-30.0)
            if not room.is_empty:
                centre = np.array(_points(rng, room, 1, 0.0)[0])
                hole = _ring(rng, centre, int(rng.integers(3, 6)), 6.0, 24.0)
                if area.contains_properly(hole):
                    area = area.difference(hole)
        if area.interiors or area.area < 0.98 * area.convex_hull.area:
            return _field(rng, area, m, n, f"winding_{seed}")


def _field(rng: np.random.Generator, area: shapely.Polygon, m: int, n: int, name: str) -> Field:
    inner = area.buffer(-1.0)
    return Field(
        np.array(area.exterior.coords)[:-1],
        rois=_points(rng, inner, m, 5.0),
        starts=_points(rng, inner, n, APART),
        holes=[np.array(hole.coords)[:-1] for hole in area.interiors],
        name=name,
    )


def _ring(
    rng: np.random.Generator, centre: NDArray[np.float64], corners: int, low: float, high: float
) -> shapely.Polygon:
    """Corners at rising angles and random distances from the centre."""
    angles = (np.arange(corners) + rng.uniform(0.0, 0.45, corners)) * (2.0 * math.pi / corners)
    radii = rng.uniform(low, high, corners)
    offsets = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return shapely.Polygon(centre + offsets)


def _points(
    rng: np.random.Generator, area: shapely.Geometry, count: int, apart: float
) -> list[tuple[float, float]]:
    """Random points of an area, at least so far apart."""
    low_x, low_y, high_x, high_y = area.bounds
    points: list[tuple[float, float]] = []
    while len(points) < count:
        point = float(rng.uniform(low_x, high_x)), float(rng.uniform(low_y, high_y))
        free = all(math.dist(point, other) >= apart for other in points)
        if free and shapely.intersects_xy(area, *point):
            points.append(point)
    return points
