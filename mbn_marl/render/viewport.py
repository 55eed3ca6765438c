"""From field units to pixels: the field's bounding box fitted into a part of the picture, y up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Viewport:
    """The map ``pixel = origin + scale * (x, -y)``.

    Attributes:
        scale: pixels per unit, the same along both axes.
        origin: where the point (0, 0) falls, in pixels from the top left corner.
    """

    scale: float
    origin: tuple[float, float]

    @classmethod
    def fit(cls, points: NDArray[Any], area: tuple[float, float, float, float]) -> Viewport:
        """Centre the bounding box of ``points`` in ``area``, as large as it goes.

        Args:
            points: (k, 2), units; not all on one point.
            area: left, top, width and height, in pixels.
        """
        left, top, width, height = area
        low, high = points.min(axis=0), points.max(axis=0)
        extent = np.maximum(high - low, 1e-9)
        scale = float(min(width / extent[0], height / extent[1]))
        middle = (low + high) / 2.0
        x, y = (scale * middle).tolist()
        return cls(scale, (left + width / 2.0 - x, top + height / 2.0 + y))

    def to_pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return points (..., 2) in units as pixels (..., 2), from the top left corner."""
        return np.asarray(self.origin) + np.asarray(points, np.float64) * (self.scale, -self.scale)
