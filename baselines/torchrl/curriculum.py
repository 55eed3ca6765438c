"""A curriculum: ROIs are large at first, shrink when the team succeeds, grow when it fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass
class RoiCurriculum:
    """The size of ROIs while a team learns, as a multiple of the true radius.

    It falls from ``first`` to 1 in ``stages``, by the same factor each. Below the first of the
    ``bounds`` of the success rate of ``window`` episodes ROIs grow by a stage, from the second on
    they shrink by one.
    """

    first: float
    stages: int
    bounds: tuple[float, float]
    window: int
    stage: int = 0
    ended: int = 0
    succeeded: int = 0

    @property
    def radius(self) -> float:
        """The present multiple."""
        return float(self.first ** (1.0 - self.stage / self.stages))

    def add(self, successes: Sequence[float]) -> None:
        """Count episodes that ended: 1 for a success, 0 for a failure."""
        self.ended += len(successes)
        self.succeeded += round(sum(successes))

    def move(self) -> bool:
        """Change the stage if the window is full; return whether the size has changed."""
        if self.ended < self.window:
            return False
        low, high = self.bounds
        rate, before = self.succeeded / self.ended, self.radius
        self.ended = self.succeeded = 0
        if rate >= high:
            self.stage = min(self.stage + 1, self.stages)
        elif rate < low:
            self.stage = max(self.stage - 1, 0)
        return self.radius != before
