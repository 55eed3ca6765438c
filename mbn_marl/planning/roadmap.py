"""Shortest paths inside a polygon with holes, by its visibility graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from mbn_marl.planning.problem import Floats

PASSED = 0.1
"""Within this distance a corner has been reached, in units."""
TOUCH = 1e-7
"""Tolerance of sight lines along walls, in units."""


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Shortest paths between places of an area."""

    area: shapely.Geometry  # contains the paths
    places: Floats  # (k, 2), moved into the area if they lay outside
    corners: Floats  # (c, 2), that paths can bend around
    lengths: Floats  # (k + c, k + c), of the shortest paths, places first; infinite for none
    before: NDArray[np.int32]  # (k + c, k + c), the last point before b from a to b; -9999 for none

    def path(self, a: int, b: int) -> Floats:
        """Return (r, 2): the shortest path from place a to place b; empty if there is none."""
        points: Floats = np.concatenate([self.places, self.corners])
        if not np.isfinite(self.lengths[a, b]):
            return np.zeros((0, 2))
        chain = [b]
        while chain[-1] != a:
            chain.append(int(self.before[a, chain[-1]]))
        return points[chain[::-1]]

    def toward(self, point: Floats, place: int) -> Floats:
        """Return the next point in sight of ``point`` on the shortest path to a place.

        A corner that is reached looks for it, or the nearest point inside the area.
        """
        goal: Floats = self.places[place]
        count = len(self.places)
        targets: Floats = np.concatenate([goal[None], self.corners])
        rest = np.concatenate([[0.0], self.lengths[place, count:]])
        reached = np.hypot(*(targets - point).T) < PASSED
        reached[0] = False  # the place itself
        corner = targets[reached.argmax()] if reached.any() else point
        for eye in (corner, moved_into(self.area, point[None])[0]):
            total = np.where(reached, np.inf, rest + np.hypot(*(targets - eye).T))
            for k in np.argsort(total):
                if np.isfinite(total[k]) and sees(self.area, eye, targets[k]):
                    return np.asarray(targets[k])
        return goal


def make_roadmap(area: shapely.Geometry, places: Floats, *, largest: bool = False) -> Roadmap:
    """Return the roadmap that connects ``places`` (k, 2) in an area, a polygon or several.

    With ``largest``, a path's pieces are measured by their larger coordinate, not by their length.
    """
    moved = moved_into(area, places)
    corners = _corners(area)
    nodes = np.concatenate([moved, corners])
    a, b = np.triu_indices(len(nodes), 1)
    seen = sees(area, nodes[a], nodes[b])
    offsets = np.abs(nodes[a] - nodes[b])
    lengths = offsets.max(axis=1) if largest else np.hypot(*offsets.T)
    graph = np.full((len(nodes), len(nodes)), np.inf)
    # SciPy takes entries up to 1e-8 for no edge.
    graph[a[seen], b[seen]] = graph[b[seen], a[seen]] = np.maximum(lengths[seen], TOUCH)
    shortest, before = dijkstra(
        np.where(np.isfinite(graph), graph, 0.0), directed=False, return_predecessors=True
    )
    return Roadmap(area, moved, corners, shortest, before)


def sees(area: shapely.Geometry, points: Floats, targets: Floats) -> Any:
    """Return whether the straight lines from points (..., 2) to targets stay in the area."""
    lines = shapely.linestrings(np.stack([points, targets], axis=-2))
    return shapely.covers(shapely.buffer(area, TOUCH), lines)


def moved_into(area: shapely.Geometry, places: Floats) -> Floats:
    points = shapely.points(places)
    inside = shapely.covers(area, points)
    lines = shapely.shortest_line(points, area)
    return np.where(inside[:, None], places, shapely.get_coordinates(lines)[1::2])


def _corners(area: shapely.Geometry) -> Floats:
    """Return the corners at which rings turn away from the area."""
    found = [np.zeros((0, 2))]
    for polygon in shapely.get_parts(area):
        for k, ring in enumerate((polygon.exterior, *polygon.interiors)):
            corners = np.array(ring.coords)[:-1]
            into = corners - np.roll(corners, 1, axis=0)
            out = np.roll(corners, -1, axis=0) - corners
            turns = into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0]
            # The area is to the left of a counter-clockwise outline, and of a clockwise hole.
            found.append(corners[turns < 0 if ring.is_ccw == (k == 0) else turns > 0])
    return np.concatenate(found)
