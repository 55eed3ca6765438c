"""Time windows of the stops on a robot's route."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class StepWindows:
    """The steps that stops and legs may take; leg k ends at stop k, leg 0 begins at step 0."""

    first: tuple[int, ...]  # the earliest step of each stop
    last: tuple[int, ...]
    least: tuple[int, ...]  # the fewest steps of each leg
    most: tuple[int, ...]

    @property
    def fixed(self) -> bool:
        """Return whether every leg has only one possible length."""
        return self.least == self.most

    def tightened(self) -> StepWindows | None:
        """Return the windows with all mutual limits applied, ``None`` if they are empty."""
        first, last = list(self.first), list(self.last)
        before = 0
        for k, least in enumerate(self.least):
            before = first[k] = max(first[k], before + least)
        for k in range(len(last) - 2, -1, -1):
            last[k] = min(last[k], last[k + 1] - self.least[k + 1])
        before = 0
        for k, most in enumerate(self.most):
            before = last[k] = min(last[k], before + most)
        if any(one > other for one, other in zip(first, last, strict=True)):
            return None
        ends, starts = [0, *last], [0, *first]
        fewest = tuple(max(a, f - e) for a, f, e in zip(self.least, first, ends, strict=False))
        longest = tuple(min(b, e - f) for b, e, f in zip(self.most, last, starts, strict=False))
        if any(one > other for one, other in zip(fewest, longest, strict=True)):
            return None
        return StepWindows(tuple(first), tuple(last), fewest, longest)

    def split(self, leg: int, least: int) -> tuple[StepWindows, StepWindows]:
        """Return the windows with fewer than ``least`` steps in a leg, and those with the rest."""
        fewer = (*self.most[:leg], least - 1, *self.most[leg + 1 :])
        more = (*self.least[:leg], least, *self.least[leg + 1 :])
        return replace(self, most=fewer), replace(self, least=more)


def fixed_windows(steps: Sequence[int]) -> StepWindows:
    """Return windows that allow each stop exactly one step."""
    chosen = tuple(steps)
    legs = tuple(b - a for a, b in zip((0, *chosen), chosen, strict=False))
    return StepWindows(chosen, chosen, legs, legs)
