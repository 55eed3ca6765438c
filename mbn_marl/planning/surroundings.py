"""Convex pieces of a field that is not convex, one around each point of a path."""

from __future__ import annotations

import numpy as np
import shapely

from mbn_marl.planning.motion import HalfPlanes
from mbn_marl.planning.problem import Floats, Problem

ASIDE = 0.1
"""Points are moved this far from the walls first, in units."""
MOST_PLANES = 40


def surroundings(problem: Problem, paths: Floats) -> list[list[HalfPlanes]]:
    """Return a convex part of the field for each robot and step, around the points of ``paths``.

    Args:
        problem: the instance.
        paths: (n, T, 2), units; points outside the field are moved to the nearest ones inside.
    """
    if problem.convex:
        return [[problem.half_planes]] * len(paths)
    centres = _inside(problem.area, paths.reshape(-1, 2))
    edges = problem.walls
    pieces = [_piece(edges, centre) for centre in centres]
    steps = paths.shape[1]
    return [pieces[i * steps : (i + 1) * steps] for i in range(len(paths))]


def _inside(polygon: shapely.Polygon, points: Floats) -> Floats:
    """Return the points, those outside or at the walls moved a little inside."""
    inner = polygon.buffer(-ASIDE, join_style="mitre")
    area = polygon if inner.is_empty else inner
    shapes = shapely.points(points)
    nearest = shapely.get_coordinates(shapely.shortest_line(area, shapes))[0::2]
    return np.where(shapely.covers(area, shapes)[:, None], points, nearest)


def _piece(edges: Floats, centre: Floats) -> HalfPlanes:
    """Return half-planes that contain ``centre`` and no wall; each one touches the nearest wall.

    Args:
        edges: (E, 4), the walls' ends.
        centre: (2,), not on a wall.
    """
    starts, ends = edges[:, :2] - centre, edges[:, 2:] - centre
    normals: list[Floats] = []
    offsets: list[float] = []
    while len(starts) and len(normals) < MOST_PLANES:
        along = ends - starts
        square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-18)
        share = np.clip(-np.einsum("ij,ij->i", starts, along) / square, 0.0, 1.0)
        nearest = starts + share[:, None] * along
        distance = np.hypot(nearest[:, 0], nearest[:, 1])
        k = int(np.argmin(distance))
        normal = nearest[k] / max(distance[k], 1e-12)
        normals.append(normal)
        offsets.append(float(distance[k]))
        starts, ends = _in_front(starts, ends, normal, float(distance[k]))
    found = np.array(normals)
    return found, np.array(offsets) + found @ centre


def _in_front(starts: Floats, ends: Floats, normal: Floats, offset: float) -> tuple[Floats, Floats]:
    """Return the parts of the walls on the near side of a plane."""
    a, b = starts @ normal - offset, ends @ normal - offset
    kept = np.minimum(a, b) < -1e-7
    starts, ends, a, b = starts[kept], ends[kept], a[kept], b[kept]
    share = np.clip(a / np.where(a == b, 1.0, a - b), 0.0, 1.0)[:, None]
    crossing = starts + share * (ends - starts)
    return (
        np.where((a > 0.0)[:, None], crossing, starts),
        np.where((b > 0.0)[:, None], crossing, ends),
    )
