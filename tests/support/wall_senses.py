"""The oracle's sense of the walls: by shapely, and by braking step by step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import shapely
from numpy.typing import NDArray

SLACK = 1e-3
"""A robot this near a wall, in units, may be behind it by rounding."""


@dataclass(frozen=True)
class WallSenses:
    """The last eleven entries of ``lidar`` in a field: rays, time to the wall, brake, distance."""

    polygon: shapely.Polygon
    v_clip: float
    tau: float
    radius: float

    def entries(
        self, spot: NDArray[Any], velocity: NDArray[Any], axes: Sequence[tuple[Any, Any]]
    ) -> list[float]:
        """Of a robot; ``axes``: by how much it can brake a step, and the wind, along x and y."""
        angles = [math.radians(45 * k) for k in range(8)]
        rays = [self._free(spot, math.cos(a), math.sin(a), self.radius) for a in angles]
        speed, time = math.hypot(*velocity), 1.0
        if speed > 0:
            reach = self.radius * speed / self.v_clip  # as long as the radius at the speed limit
            time = self._free(spot, velocity[0] / speed, velocity[1] / speed, reach)
        x, y = (
            self._stop(*along, float(brake), float(wind))
            for along, (brake, wind) in zip(zip(spot, velocity, strict=True), axes, strict=True)
        )
        inside = bool(shapely.intersects_xy(self.polygon, x, y))
        distance = self.polygon.boundary.distance(shapely.Point(spot))
        return [*rays, time, float(inside), min(1.0, distance / self.radius)]

    def _free(self, spot: NDArray[Any], x: float, y: float, reach: float) -> float:
        """The part of ``reach`` that a robot can go along (x, y) before it leaves the field."""
        start, end = shapely.Point(spot), (spot[0] + reach * x, spot[1] + reach * y)
        ways = self.polygon.intersection(shapely.LineString([start, end]))
        own = [way for way in shapely.get_parts(ways) if way.distance(start) < SLACK]
        return max((way.length for way in own), default=0.0) / reach

    def _stop(self, place: float, velocity: float, brake: float, wind: float) -> float:
        """Where the robot comes to rest along an axis, after steps of braking; perhaps never."""
        slower = brake - math.copysign(wind, wind * velocity)
        if velocity != 0 and slower <= 0:
            return math.inf
        while velocity != 0:
            velocity = math.copysign(max(0.0, abs(velocity) - slower), velocity)
            place += velocity * self.tau
        return place
