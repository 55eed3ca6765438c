"""Rooms in a row, joined by doors for one robot at a time, with two teams that change sides."""

from __future__ import annotations

import math
from dataclasses import dataclass
from random import Random

from mbn_marl.field.field import Field

Point = tuple[float, float]
ROOMS = (2, 2, 2, 3)
"""Counts, each entry equally likely. Robots seldom wait where there are three."""
TEAM, ROIS = (2, 4), (2, 4)
"""Ranges: robots and ROIs of each of the two kinds."""
SIDE, WIDTH, DEPTH = (60.0, 100.0), (5.0, 8.0), (20.0, 60.0)
"""Ranges of a room's sides, a door's width and its depth, in units."""
WALL, APART, JAMB = 8.0, 20.0, 20.0
"""Least distances of points from walls and from each other, and of a door from corners, units."""
TRIES = 200


@dataclass(frozen=True)
class Passages:
    """Makes fields by number; another Python may draw others, which fail the hashes of a split."""

    seed: int

    def field(self, number: int) -> Field:
        random = Random(f"{self.seed} {number}")
        while True:
            rooms = random.choice(ROOMS)
            team, rois = (random.randint(*ends) for ends in (TEAM, ROIS))
            lower: list[Point] = []
            upper: list[Point] = []
            ends, x = [], 0.0
            for k in range(rooms):
                if k:
                    half, depth = random.uniform(*WIDTH) / 2.0, random.uniform(*DEPTH)
                    for side, sign in ((lower, -1.0), (upper, 1.0)):
                        side += [(x, sign * half), (x + depth, sign * half)]
                    x += depth
                width, height = random.uniform(*SIDE), random.uniform(*SIDE)
                low = random.uniform(JAMB - height, -JAMB)
                lower += [(x, low), (x + width, low)]
                upper += [(x, low + height), (x + width, low + height)]
                if k in (0, rooms - 1):
                    ends.append(_scattered(random, x, low, width, height, team + rois))
                x += width
            if min(map(len, ends)) == team + rois:
                break
        (west, east), angle = ends, random.uniform(0.0, 2.0 * math.pi)
        outline, goals = [*lower, *upper[::-1]], [*east[team:], *west[team:]]
        parts = [_turned(one, angle) for one in (outline, goals, [*west[:team], *east[:team]])]
        left, low = (min(point[axis] for point in parts[0]) - 10.0 for axis in (0, 1))
        corners, goals, starts = (
            [(round(x - left, 3), round(y - low, 3)) for x, y in part] for part in parts
        )
        of_goals, of_starts = ([0] * count + [1] * count for count in (rois, team))
        name = f"passages-{self.seed}-{number}"
        return Field(corners, goals, starts, roi_kinds=of_goals, start_kinds=of_starts, name=name)


def _scattered(
    random: Random, x: float, y: float, width: float, height: float, count: int
) -> list[Point]:
    """Return up to ``count`` points of a room, apart from each other and its walls."""
    points: list[Point] = []
    for _ in range(TRIES):
        right, top = x + width - WALL, y + height - WALL
        point = random.uniform(x + WALL, right), random.uniform(y + WALL, top)
        if len(points) < count and all(math.dist(point, other) >= APART for other in points):
            points.append(point)
    return points


def _turned(points: list[Point], angle: float) -> list[Point]:
    sin, cos = math.sin(angle), math.cos(angle)
    return [(x * cos - y * sin, x * sin + y * cos) for x, y in points]
