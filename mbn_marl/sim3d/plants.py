"""Plants of the field, as meshes: rows of young corn, and a weed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

ROW_SPACING, PLANT_SPACING = 0.75, 0.25
"""Metres between rows and along them, as corn is sown; further apart in large fields."""
MOST_PLANTS = 1500
CORN_HEIGHT = 0.22  # metres: the vehicles fly above it
LEAF = np.array([[0.0, -0.012, 0.0], [0.0, 0.012, 0.0], [0.07, 0.0, 1.0], [0.16, 0.0, 0.7]])
"""A leaf that points along +x: base, bend and tip; z in heights of the plant."""
LEAF_FACES = np.array([[0, 1, 2], [0, 2, 1], [1, 3, 2], [1, 2, 3]])  # both sides of each triangle

Array = NDArray[np.float64]


class Mesh(NamedTuple):
    """Triangles: vertices (k, 3) in metres, faces (f, 3)."""

    vertices: Array
    faces: NDArray[np.intp]


def corn_rows(ground: shapely.Polygon) -> Array:
    """Return places of corn in rows along y on ``ground``, (k, 2) in metres; maybe none."""
    wider = max(1.0, (ground.area / (ROW_SPACING * PLANT_SPACING * MOST_PLANTS)) ** 0.5)
    left, bottom, right, top = ground.bounds
    rows = np.arange(left, right, ROW_SPACING * wider) + ROW_SPACING * wider / 2.0
    places = np.arange(bottom, top, PLANT_SPACING * wider)
    grid = np.stack(np.meshgrid(rows, places), axis=-1).reshape(-1, 2)
    inside: Array = grid[shapely.contains_xy(ground, grid)]
    return inside


def corn(places: Array) -> Mesh:
    """Return corn at ``places`` (k, 2) as one mesh; every plant is a little different."""
    random = np.random.default_rng(0)
    turns = random.uniform(0.0, np.pi, len(places))
    heights = CORN_HEIGHT * random.uniform(0.7, 1.0, len(places))
    return _leaves(places, turns, heights, leaves=4, width=1.0)


def weed() -> Mesh:
    """Return a weed at the origin: broad leaves close to the ground."""
    return _leaves(np.zeros((1, 2)), np.zeros(1), np.array([0.1]), leaves=9, width=2.0)


def _leaves(places: Array, turns: Array, heights: Array, leaves: int, width: float) -> Mesh:
    """Return plants at ``places`` (k, 2), turned by ``turns`` and of ``heights`` (k,)."""
    angles = turns[:, None] + np.arange(leaves) * 2.0 * np.pi / leaves
    cos, sin = np.cos(angles)[..., None], np.sin(angles)[..., None]
    x, y, z = LEAF[:, 0] * width, LEAF[:, 1] * width, LEAF[:, 2]
    points = np.stack(
        [
            places[:, 0, None, None] + cos * x - sin * y,
            places[:, 1, None, None] + sin * x + cos * y,
            np.broadcast_to(heights[:, None, None] * z, (*angles.shape, len(LEAF))),
        ],
        axis=-1,
    )
    faces = LEAF_FACES + len(LEAF) * np.arange(angles.size)[:, None, None]
    return Mesh(points.reshape(-1, 3), faces.reshape(-1, 3))
