"""The observation ``entities`` a second time: ``docs/mdp.md``, "What a robot sees"."""

from __future__ import annotations

import cmath
import heapq
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

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


def span(a: Any, b: Any) -> Any:
    """How far it is from a to b, by the longer side."""
    return max(abs(p - q) for p, q in zip(a, b, strict=True))


class Atlas:
    """The ways around the corners of a field.

    Args:
        polygon: the field.
        rois: where its ROIs are.
    """

    def __init__(self, polygon: shapely.Polygon, rois: list[Any]) -> None:
        self.polygon, self.rois = polygon, rois
        self.waypoints = [*self._off_corners()]
        self.rests = [self._from(roi) for roi in rois]

    def _off_corners(self) -> Iterator[tuple[float, float]]:
        """Points 3 units off the corners at which the field is not convex, on their bisectors."""
        field = shapely.geometry.polygon.orient(self.polygon)  # it lies to the left of its rings
        for ring in (field.exterior, *field.interiors):
            corners = [complex(x, y) for x, y in ring.coords[:-1]]
            for k, corner in enumerate(corners):
                come = cmath.phase(corner - corners[k - 1])
                go = cmath.phase(corners[(k + 1) % len(corners)] - corner)
                turn = (go - come + math.pi) % (2 * math.pi) - math.pi
                spot = corner + cmath.rect(3.0, come + math.pi / 2 + turn / 2)
                inside = self.polygon.covers(shapely.Point(spot.real, spot.imag))
                if math.sin(turn) < -1e-3 and inside:
                    yield spot.real, spot.imag

    def sees(self, a: Any, b: Any) -> bool:
        """Return whether one can go straight from a to b."""
        return bool(self.polygon.covers(shapely.LineString([a, b])))

    def _from(self, start: Any) -> list[float]:
        """The length of the shortest way to each waypoint, by Dijkstra's algorithm."""
        found = [math.inf] * len(self.waypoints)
        queue = [(0.0, -1)]
        while queue:
            far, here = heapq.heappop(queue)
            spot = start if here < 0 else self.waypoints[here]
            if here >= 0 and far > found[here]:
                continue
            for k, other in enumerate(self.waypoints):
                way = far + float(span(spot, other))
                if way < found[k] and self.sees(spot, other):
                    found[k] = way
                    heapq.heappush(queue, (way, k))
        return found

    def way(self, spot: Any, j: int) -> tuple[Any, Any, bool]:
        """From somewhere to ROI j: the length, the place to go to first, whether it is the ROI."""
        roi, rests = self.rois[j], self.rests[j]
        if not self.waypoints or self.sees(spot, roi):
            return span(spot, roi), None, True
        ways = [
            (float(span(spot, place)) + rest, rest, place)
            for place, rest in zip(self.waypoints, rests, strict=True)
            if rest < math.inf and self.sees(spot, place)
        ]
        if not ways:
            return span(spot, roi), None, False
        least = min(ways)[0]
        _, _, place = min((way for way in ways if way[0] <= least + 1e-3), key=lambda way: way[1])
        return least, place, False


class Plan:
    """Who would visit what: the ROIs that are left, the earliest possible visit always next.

    Args:
        atlas: the ways.
        spots: where the robots are.
        works: which of them work.
        left: the indices of the ROIs that are left.
    """

    def __init__(self, atlas: Atlas, spots: list[Any], works: list[bool], left: list[int]):
        self.orders: list[list[int]] = [[] for _ in spots]
        self.tours = [spot[0] * 0 for spot in spots]
        at, left = list(spots), list(left)
        team = [i for i, able in enumerate(works) if able]
        ways: dict[Any, Any] = {}

        def way(spot: Any, j: int) -> Any:
            if (spot, j) not in ways:
                ways[spot, j] = atlas.way(spot, j)[0]
            return ways[spot, j]

        while left and team:
            total, i, j = min((self.tours[i] + way(at[i], j), i, j) for i in team for j in left)
            self.tours[i], at[i] = total, atlas.rois[j]
            self.orders[i].append(j)
            left.remove(j)

    def turn(self, i: int, j: int) -> float:
        """1 over the place of ROI j in the order of robot i, or 0."""
        return 1.0 / (1 + self.orders[i].index(j)) if j in self.orders[i] else 0.0


def entities(oracle: Any, i: int, there: Any, me: Any, others: list[Any]) -> Iterator[Any]:
    """The entries for robot i of an oracle, which is ``there`` and sees itself as ``me``."""
    rois, atlas, tau = oracle.rois, oracle.atlas, float(oracle.tau)
    left = [j for j, visited in enumerate(oracle.visited) if not visited]
    plan, tours = None, [0.0] * len(oracle.robots)
    if atlas:
        works = [not robot.failed for robot in oracle.robots]
        plan = Plan(atlas, [(robot.x, robot.y) for robot in oracle.robots], works, left)
        tours = [soft(float(tour), FAR) for tour in plan.tours]
    yield from (me.velocity / oracle.top_speed, *[me.ahead] * oracle.turning, oracle._flag(me))
    reach = min(oracle.sensing_radius, math.hypot(oracle.width, oracle.height))
    yield oracle._walls(there, reach)
    if plan:
        yield [tours[i], max(tours)]
    for k, other in enumerate(others):
        d = (other.position - me.position).tolist()
        dv = (other.velocity - me.velocity).tolist()
        token = [1.0, *offset(*d), *(part / 2 / float(oracle.top_speed) for part in dv)]
        token += [soft(math.hypot(*d), NEAR), soft(approach(d, dv, 15 * tau), NEAR)]
        token += [*other.ahead] * oracle.turning
        token += [*oracle._flag(other), *([tours[k + (k >= i)]] if plan else [])]
        yield (other.seen and not oracle._gone(other)) * np.array(token)
    for j, roi in enumerate(rois):
        place, is_seen = oracle.disturbances.seen(i, 64 + j, roi, oracle.bounds)
        rivals = [
            soft(math.dist(other.position, place), FAR)
            for other in others
            if other.seen and not other.failed
        ]
        token = [1.0, *toward(place, me.position), min([*rivals, 1.0])]
        if plan:
            way, corner, straight = atlas.way((there.x, there.y), j)
            if corner is not None:
                token[1:8] = [*toward(corner, me.position)[:-1], soft(float(way), FAR)]
            token += [plan.turn(i, j), straight]
        yield (j in left and is_seen) * np.array(token)


def toward(place: Any, spot: Any) -> list[float]:
    """The entries of a place as it is seen: its offset, its direction and how far away it is."""
    dx, dy = (np.array(place) - spot).tolist()
    distance = math.hypot(dx, dy)
    direction = [dx / (distance + 1.0), dy / (distance + 1.0)]
    return [*offset(dx, dy), *direction, soft(distance, FAR)]
