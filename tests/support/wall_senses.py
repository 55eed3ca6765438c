"""The oracle's sense of the walls, by shapely."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import shapely
from numpy.typing import NDArray

SLACK = 1e-3  # a robot this near a wall, in units, may be behind it by rounding
RESIDUE = 1e-9  # rounding leaves a slower speed, in units/step, of a robot that has braked


@dataclass(frozen=True)
class WallSenses:
    """The last eleven entries of ``lidar`` in a field: rays, time to the wall, brake, distance."""

    polygon: shapely.Polygon
    top_speed: float
    radius: float

    def entries(
        self, spot: NDArray[Any], velocity: NDArray[Any], rest: tuple[float, float]
    ) -> list[float]:
        angles = [math.radians(45 * k) for k in range(8)]
        rays = [self._free(spot, math.cos(a), math.sin(a), self.radius) for a in angles]
        speed, time = math.hypot(*velocity), 1.0
        if speed > RESIDUE:
            reach = self.radius * speed / self.top_speed  # as long as the radius at the speed limit
            time = self._free(spot, velocity[0] / speed, velocity[1] / speed, reach)
        inside = bool(shapely.intersects_xy(self.polygon, *rest))
        distance = self.polygon.boundary.distance(shapely.Point(spot))
        return [*rays, time, float(inside), min(1.0, distance / self.radius)]

    def _free(self, spot: NDArray[Any], x: float, y: float, reach: float) -> float:
        """The part of ``reach`` that a robot can go along (x, y) before it leaves the field."""
        start, end = shapely.Point(spot), (spot[0] + reach * x, spot[1] + reach * y)
        ways = self.polygon.intersection(shapely.LineString([start, end]))
        own = [way for way in shapely.get_parts(ways) if way.distance(start) < SLACK]
        return max((way.length for way in own), default=0.0) / reach
