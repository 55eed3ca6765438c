"""The rules of a valid field: each one is a small generator of problems.

The field is a closed set that contains its boundary and those of its holes. In floating point a
point on a slanted edge is seldom exactly on it, so points within ``ROUNDING`` count as inside.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import shapely

from mbn_marl.field.geometry import FieldPoints, Point, PointList

ROUNDING = 1e-9
"""How far outside ROIs and starts may be, as a share of the outline's longer side."""
Rings = list[tuple[PointList, shapely.Polygon | None]]
"""Rings with their polygons, ``None`` for one that is not simple."""


def find_problems(points: FieldPoints) -> list[str]:
    """Return every problem of the readable part of a field, one line each, with its place."""
    outline, *holes = rings = [(ring, _simple(ring)) for ring in (points.outline, *points.holes)]
    problems: list[str] = []
    for entries in (points.outline, *points.holes, points.rois, points.starts):
        problems.extend(_duplicates(entries))
        problems.extend(_outside_arena(entries, points.arena))
    for ring, polygon in rings:
        if polygon is None:
            problems.extend(_crossings(ring))
    problems.extend(_misplaced_holes(outline[1], holes))
    for entries in (points.rois, points.starts):
        problems.extend(_outside_field(entries, outline[1], holes))
    return problems


def _duplicates(points: PointList) -> Iterator[str]:
    first: dict[Point, int] = {}
    for k, point in enumerate(points.points):
        if first.setdefault(point, k) != k:
            yield f"{points.place(k)}: {point} is a duplicate of {points.place(first[point])}"


def _outside_arena(points: PointList, arena: Point) -> Iterator[str]:
    width, height = arena
    for k, (x, y) in enumerate(points.points):
        if not (0.0 <= x <= width and 0.0 <= y <= height):
            bounds = f"[0, {width:g}] x [0, {height:g}]"
            yield f"{points.place(k)}: ({x}, {y}) is outside the arena {bounds}"


def _simple(ring: PointList) -> shapely.Polygon | None:
    """Return the polygon of a ring that is readable and simple, else ``None``."""
    points = ring.distinct().points
    if not ring.complete or len(points) < 3:
        return None
    polygon = shapely.Polygon(points)
    return polygon if polygon.is_valid else None


def _crossings(ring: PointList) -> Iterator[str]:
    """Name the first two edges that meet in a ring that is not simple."""
    corners = ring.distinct()
    count = len(corners.points)
    if not ring.complete or count < 3:
        return
    ends = np.array(corners.points)
    edges = shapely.linestrings(np.stack([ends, np.roll(ends, -1, axis=0)], axis=1))
    first, second = shapely.STRtree(edges).query(edges, predicate="intersects")
    gap = second - first
    meeting = np.argwhere((gap > 1) & (gap < count - 1))[:, 0]
    if len(meeting) == 0:
        yield f"{ring.label}: has no area"
        return

    def edge(k: int) -> str:
        return f"{corners.place(k)}-{corners.place((k + 1) % count)}"

    pairs = sorted(zip(first[meeting].tolist(), second[meeting].tolist(), strict=True))
    others = f", and {len(pairs) - 1} more such pairs" if len(pairs) > 1 else ""
    a, b = pairs[0]
    yield f"{ring.label}: crosses or touches itself: {edge(a)} meets {edge(b)}{others}"


def _misplaced_holes(outline: shapely.Polygon | None, holes: Rings) -> Iterator[str]:
    sound = [(ring, hole) for ring, hole in holes if hole]
    if outline is not None:
        for ring, hole in sound:
            if not shapely.contains_properly(outline, hole):
                yield f"{ring.label}: a hole must lie inside the field without touching its outline"
    for (ring_a, hole_a), (ring_b, hole_b) in combinations(sound, 2):
        if shapely.intersects(hole_a, hole_b):
            yield f"{ring_b.label}: touches or overlaps {ring_a.label}"


def _outside_field(
    points: PointList, outline: shapely.Polygon | None, holes: Rings
) -> Iterator[str]:
    left, low, right, high = outline.bounds if outline else (0.0, 0.0, 0.0, 0.0)
    rounding = ROUNDING * max(right - left, high - low)
    for k, coordinates in enumerate(points.points):
        point = shapely.Point(coordinates)
        if outline is not None and outline.distance(point) > rounding:
            yield f"{points.place(k)}: {coordinates} is outside the field"
        for ring, hole in holes:
            if (
                hole is not None
                and hole.contains(point)
                and hole.exterior.distance(point) > rounding
            ):
                yield f"{points.place(k)}: {coordinates} is inside {ring.label}"
