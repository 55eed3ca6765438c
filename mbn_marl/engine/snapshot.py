"""The visible state of one world at one moment: the engine makes it, the renderers draw it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mbn_marl.field import Field

FloatArray = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One world with n robots and m ROIs, after ``step`` steps of its episode.

    Attributes:
        field: the field of this world.
        positions: (n, 2), units, in the engine's dtype.
        velocities: (n, 2), units/step.
        headings: (n,), radians in [-pi, pi); NaN for a robot that has none.
        failed: (n,) bool, whether each robot has failed in this episode.
        gone: (n,) bool, whether each robot has vanished in this episode: it touches nothing.
        visited: (m,) bool, whether each ROI has been visited in this episode.
        empty: (m,) bool, whether each ROI is empty in this episode; False for all if a recorded
            one does not tell.
        trail: (step + 1, n, 2), units: the positions of every robot since the reset, the reset
            first, the current ones last.
        step: steps since the reset, 0 to T_max.
        team_return: sum of the centralised rewards since the reset, in reward units.
        winds: (k, 2), the velocity that the wind, with its gust, adds in a step, units/step: in the
            next step, and before it in all steps since the reset, or in none.
        roi_radius: rho, units.
        safety_distance: C, units, from centre to centre.
        success: whether the episode ended with every ROI visited.
        collision: whether the episode ended with two robots closer than C.
        heard: (n, n) bool, whether robot i received words of robot k in this step: for
            recorded episodes of robots that know only their own.
    """

    field: Field
    positions: FloatArray
    velocities: FloatArray
    headings: FloatArray
    failed: NDArray[np.bool_]
    gone: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    trail: FloatArray
    step: int
    team_return: float
    winds: FloatArray
    roi_radius: float
    safety_distance: float
    success: bool
    collision: bool
    empty: NDArray[np.bool_] | np.bool_ = np.False_
    heard: NDArray[np.bool_] | np.bool_ = np.False_

    def judged(self) -> Self:
        at = self.positions[~self.gone]
        first, second = np.triu_indices(len(at), 1)
        squared = ((at[first] - at[second]) ** 2).sum(axis=1)
        collision = bool((squared < self.safety_distance**2).any())
        success = bool((self.visited | self.empty).all()) and not collision
        return replace(self, success=success, collision=collision)

    @property
    def wind(self) -> tuple[float, float]:
        x, y = self.winds[-1].tolist()
        return x, y
