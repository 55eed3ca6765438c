"""Snapshots to draw, and what is found in their pictures."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.field import Field
from mbn_marl.render import Viewer, style

SQUARE = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]
HOLE = [(190.0, 190.0), (210.0, 190.0), (210.0, 210.0), (190.0, 210.0)]
FIELD = Field(SQUARE, rois=[(150.0, 150.0), (250.0, 250.0)], starts=[(120.0, 200.0)])

SIZE = (400, 400)  # pixels, unless the test is of the size

Frame = NDArray[np.uint8]


def snapshot(trail: Any = ((120.0, 200.0),), **changes: Any) -> Snapshot:
    path = np.asarray(trail, np.float64)
    path = path[:, None] if path.ndim == 2 else path
    robots, steps = path.shape[1], len(path) - 1
    values = {"field": FIELD, "trail": path, "positions": path[-1]}
    values |= {"velocities": np.zeros((robots, 2)), "headings": np.full(robots, np.nan)}
    values |= dict.fromkeys(("failed", "gone"), np.zeros(robots, bool))
    values |= {"visited": np.zeros(2, bool), "winds": np.zeros((1, 2))}
    values |= dict.fromkeys(("roi_radius", "safety_distance"), 10.0)
    values |= {"step": steps, "team_return": -10.0 * steps, "success": False, "collision": False}
    return Snapshot(**(values | changes))


def draw(moment: Snapshot, viewer: Viewer | None = None) -> Frame:
    frame = (viewer or Viewer("rgb_array", SIZE)).draw(moment)
    assert frame is not None
    return frame


def where(frame: Frame, colour: str) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    rows, columns = np.nonzero((frame == style.rgb(colour)).all(axis=2))
    return rows, columns


def wander(steps: int, robots: int, seed: int = 0) -> NDArray[np.float64]:
    walk = np.random.default_rng(seed).normal(0.0, 3.0, (steps + 1, robots, 2)).cumsum(axis=0)
    return np.clip(200.0 + walk, 105.0, 295.0)
