"""A small field with a hole that is not convex, and what is done in it."""

import numpy as np

from baselines.policies.policy import Policy
from mbn_marl.field import Field

BEND = [(200, 150), (300, 150), (300, 170), (220, 170), (220, 250), (200, 250)]
"""A hole that is not convex."""
SMALL = Field(
    vertices=[(100, 100), (400, 100), (400, 300), (100, 300)],
    holes=[BEND],
    rois=[(150, 150), (350, 250), (250, 200)],
    starts=[(120, 120), (380, 120)],
    name="bend",
)


class Wander(Policy):
    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return (np.floor(seen[:, :, :2] * 185.0) % 3 - 1).astype(np.float32)
