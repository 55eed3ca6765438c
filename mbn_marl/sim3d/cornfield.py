"""What stands in a field, in metres: the one description that every simulator builds from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import shapely

from mbn_marl.field import Field

Array = npt.NDArray[np.float64]

_SPACING = 0.75
"""Metres between two rows of corn, as maize is sown."""
_MOST_ROWS = 40
"""A larger field gets its rows farther apart: each of them is a body of the scene."""
_HEADLAND = 0.2
"""Metres around weeds that no corn grows in."""


@dataclass(frozen=True, eq=False)
class Cornfield:
    """A field in metres, the centre of its arena at the origin.

    Attributes:
        size: width and height of the arena, metres.
        fence: (E, 2, 2), metres: both ends of each edge of the outline.
        rows: (k, 2, 2), metres: both ends of each stretch of corn, along x.
        obstacles: of each hole its corners, (c, 2) metres.
        weeds: (m, 2), metres.
    """

    size: tuple[float, float]
    fence: Array
    rows: Array
    obstacles: tuple[Array, ...]
    weeds: Array


def grow(field: Field, metres: float) -> Cornfield:
    """What stands in ``field``.

    Args:
        field: any field.
        metres: of one unit, above 0.
    """
    arena = np.array(field.arena)
    polygon = shapely.transform(field.polygon, lambda points: (points - arena / 2) * metres)
    outline = np.array(polygon.exterior.coords)
    weeds = (field.rois - arena / 2) * metres
    bare = shapely.union_all(shapely.buffer(shapely.points(weeds), _HEADLAND))
    width, height = arena * metres
    return Cornfield(
        (float(width), float(height)),
        np.stack([outline[:-1], outline[1:]], axis=1),
        _rows(polygon - bare),
        tuple(np.array(ring.coords)[:-1] for ring in polygon.interiors),
        weeds,
    )


def _rows(soil: shapely.Geometry) -> Array:
    """The stretches of corn that lie on ``soil``, (k, 2, 2) metres, from the south to the north."""
    left, bottom, right, top = soil.bounds
    spacing = max(_SPACING, (top - bottom) / _MOST_ROWS)
    heights = np.arange(bottom + spacing / 2, top, spacing)
    lines = shapely.linestrings([[(left, y), (right, y)] for y in heights])
    stretches = shapely.get_parts(shapely.intersection(lines, soil))
    lines_only = [part.coords for part in stretches if part.geom_type == "LineString"]
    return np.array(lines_only, dtype=np.float64).reshape(-1, 2, 2)
