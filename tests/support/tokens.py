"""The oracle's observation ``entities``: ``docs/observations.md``."""

import cmath
import functools
import heapq
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import shapely

NEAR, FAR = 15.0, 100.0


def soft(length: float, scale: float) -> float:
    return length / (abs(length) + scale)


def offset(dx: float, dy: float) -> list[float]:
    return [soft(part, scale) for scale in (NEAR, FAR) for part in (dx, dy)]


def approach(d: list[float], dv: list[float], time: float) -> float:
    square = sum(part * part for part in dv)
    when = 0.0
    if square:
        when = min(max(-sum(a * b for a, b in zip(d, dv, strict=True)) / square, 0.0), time)
    return math.hypot(*(a + when * b for a, b in zip(d, dv, strict=True)))


def span(a: Any, b: Any) -> Any:
    """Distance of a and b: the longer side, and an eighth of the shorter one."""
    shorter, longer = sorted(abs(p - q) for p, q in zip(a, b, strict=True))
    return longer + shorter / 8


def first_least(choices: list[Any], cost: Callable[[Any], float]) -> Any:
    """The choice that costs least; a later one only if it costs over 1/1000 less."""
    best = choices[0]
    for choice in choices:
        if cost(choice) < cost(best) - 1e-3:
            best = choice
    return best


class Atlas:
    def __init__(self, polygon: shapely.Polygon, rois: list[Any]) -> None:
        self.polygon, self.rois = polygon, rois
        self.waypoints = [*self._off_corners()]
        self.rests = [self._from(roi) for roi in rois]
        self.way = functools.lru_cache(4096)(self._way)

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

    def _way(self, spot: Any, j: int) -> tuple[Any, Any, bool]:
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
    """Orders of ROIs for n robots: made at first and when one with ROIs fails, or if ``fresh``."""

    def __init__(self, atlas: Atlas, n: int, *, fresh: bool = False) -> None:
        self._atlas, self._fresh = atlas, fresh
        self.orders: list[list[int]] = [[] for _ in range(n)]
        self._made = False

    def update(
        self,
        spots: list[Any],
        works: list[bool],
        left: list[int],
        speeds: list[complex],
        mine: list[set[int]],
    ) -> None:
        self._spots, self._speeds, self._mine = spots, speeds, mine
        self.orders = [[j for j in order if j in left] for order in self.orders]
        failed = any(order and not works[i] for i, order in enumerate(self.orders))
        if failed or self._fresh or not self._made:
            made = [self._assigned(works, left, weight) for weight in (1, 1 / 64)]
            self.orders = first_least(made, self.cost)
            self._made = True
        self.tours = [self._tour(i, order) for i, order in enumerate(self.orders)]

    def _assigned(self, works: list[bool], left: list[int], weight: float) -> list[list[int]]:
        team = [i for i, able in enumerate(works) if able]
        orders = [[] for _ in works]
        new = [j for j in left if any(j in self._mine[i] for i in team)]
        while new:
            places = [(*self._best_place(team, orders, j, weight), j) for j in new]
            _, orders, j = first_least(places, lambda place: -place[0])
            new.remove(j)
        for _ in range(2 * len(self._atlas.rois)):
            changes = [(self.cost(orders), orders)]
            for j in itertools.chain(*orders):
                changes.append(self._best_place(team, orders, j, 1 / 64))
            for i, k in itertools.combinations(team, 2):
                if self._mine[i] != self._mine[k]:
                    continue
                for a in range(len(orders[i]) + 1):
                    for b in range(len(orders[k]) + 1):
                        other = [*orders]
                        other[i] = orders[i][:a] + orders[k][b:]
                        other[k] = orders[k][:b] + orders[i][a:]
                        changes.append((self.cost(other), other))
            _, better = first_least(changes, lambda change: change[0])
            if better is orders:
                break
            orders = better
        return orders

    def _tour(self, i: int, order: list[int]) -> Any:
        stops = [self._spots[i], *(self._atlas.rois[j] for j in order)]
        ways = (self._atlas.way(stop, j)[0] for stop, j in zip(stops, order, strict=False))
        total = sum(ways, stops[0][0] * 0)
        if self._fresh and order:
            aim = self._atlas.way(stops[0], order[0])[1] or self._atlas.rois[order[0]]
            go = complex(*map(float, aim)) - complex(*map(float, stops[0]))
            along = (self._speeds[i].conjugate() * go).real / max(abs(go), 1e-3)
            total += 40 * (1.0 - along) ** 2
        places = [complex(*map(float, stop)) for stop in stops]
        for before, here, after in zip(places, places[1:], places[2:], strict=False):
            come, go = here - before, after - here
            if come and go:
                total += 16 * max(0.0, -math.cos(cmath.phase(go) - cmath.phase(come)))
        return total

    def cost(self, orders: list[list[int]], weight: float = 1 / 64) -> float:
        """The longest tour and the weighted sum of all."""
        tours = [float(self._tour(i, order)) for i, order in enumerate(orders)]
        return max(tours) + weight * sum(tours)

    def _best_place(
        self, team: list[int], orders: list[list[int]], j: int, weight: float
    ) -> tuple[float, list[list[int]]]:
        without = [[k for k in order if k != j] for order in orders]
        ways = []
        for i in (i for i in team if j in self._mine[i]):
            for at in range(len(without[i]) + 1):
                longer = [[*order] for order in without]
                longer[i].insert(at, j)
                ways.append((self.cost(longer, weight), longer))
        return first_least(ways, lambda way: way[0])

    def turn(self, i: int, j: int) -> float:
        return 1.0 / (1 + self.orders[i].index(j)) if j in self.orders[i] else 0.0


def entities(oracle: Any, i: int, there: Any, me: Any, others: list[Any]) -> Iterator[Any]:
    """The entries for robot i of an oracle, which is ``there`` and sees itself as ``me``."""
    rois, atlas, tau = oracle.rois, oracle.atlas, float(oracle.tau)
    plan, tours = oracle.plan, [0.0] * len(oracle.robots)
    if plan:
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
        shown = other.seen and oracle.notices(me, other) and not oracle.gone(other)
        yield shown * np.array(token)
    for j, roi in enumerate(rois):
        place, is_seen = oracle.disturbances.seen(i, 64 + j, roi, oracle.bounds)
        rivals = [
            soft(math.dist(other.position, place), FAR)
            for k, other in enumerate(others)
            if other.seen and oracle.notices(me, other) and not other.failed
            if oracle.is_mine(k + (k >= i), j)
        ]
        token = [1.0, *toward(place, me.position), min([*rivals, 1.0])]
        if plan:
            way, corner, straight = atlas.way((there.x, there.y), j)
            if corner is not None:
                token[1:8] = [*toward(corner, me.position)[:-1], soft(float(way), FAR)]
            token += [plan.turn(i, j), straight]
        yield (oracle.is_left(i, j) and oracle.is_mine(i, j) and is_seen) * np.array(token)


def toward(place: Any, spot: Any) -> list[float]:
    dx, dy = (np.array(place) - spot).tolist()
    distance = math.hypot(dx, dy)
    direction = [dx / (distance + 1.0), dy / (distance + 1.0)]
    return [*offset(dx, dy), *direction, soft(distance, FAR)]
