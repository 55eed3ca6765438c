"""Read the points of a field: from any input to finite numbers and a list of problems."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real

import numpy as np

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS
from mbn_marl.field.limits import MAX_COORDINATE, MAX_HOLES, MAX_VERTICES

Point = tuple[float, float]


@dataclass(frozen=True)
class PointList:
    """The readable points of one list."""

    label: str  # the name of the list in problems, such as "starts" or "holes[0]"
    points: list[Point] = field(default_factory=list)  # finite, in units
    indices: list[int] = field(default_factory=list)  # of the points in the input
    complete: bool = True  # whether every entry of the input was readable

    def place(self, k: int) -> str:
        """Return the place of ``points[k]`` in the input, e.g. ``"starts[2]"``."""
        return f"{self.label}[{self.indices[k]}]"

    def distinct(self) -> PointList:
        """Return the list without repeated points."""
        first: dict[Point, int] = {}
        for index, point in zip(self.indices, self.points, strict=True):
            first.setdefault(point, index)
        return PointList(self.label, list(first), list(first.values()), self.complete)


@dataclass(frozen=True)
class FieldPoints:
    """The readable points of a field; an unreadable ``arena`` is unlimited."""

    outline: PointList
    holes: list[PointList]
    rois: PointList
    starts: PointList
    arena: Point


class PointReader:
    """Turns unchecked input into :class:`FieldPoints`, and lists all ``problems`` by place."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def read(
        self, vertices: object, rois: object, starts: object, holes: object, arena: object
    ) -> FieldPoints:
        """Read a field; each list is a sequence or array of ``(x, y)``."""
        outline = self._points(vertices, "vertices", at_least=3, at_most=MAX_VERTICES)
        rings = [
            self._points(hole, f"holes[{k}]", at_least=3, at_most=MAX_VERTICES)
            for k, hole in enumerate(self._entries(holes, "holes", 0, MAX_HOLES) or ())
        ]
        corners = len(outline.points) + sum(len(ring.points) for ring in rings)
        if rings and corners > MAX_VERTICES:
            limit = f"at most {MAX_VERTICES} corners in the outline and all holes"
            self.problems.append(f"holes: expected {limit}, got {corners}")
        return FieldPoints(
            outline=outline,
            holes=rings,
            rois=self._points(rois, "rois", at_least=1, at_most=MAX_ROIS),
            starts=self._points(starts, "starts", at_least=1, at_most=MAX_ROBOTS),
            arena=self._arena(arena),
        )

    def _points(self, value: object, label: str, at_least: int, at_most: int) -> PointList:
        entries = self._entries(value, label, at_least, at_most)
        if entries is None:
            return PointList(label, complete=False)
        read = [self._point(entry, f"{label}[{k}]") for k, entry in enumerate(entries[:at_most])]
        found = {k: point for k, point in enumerate(read) if point is not None}
        return PointList(label, [*found.values()], [*found], complete=len(found) == len(entries))

    def _entries(
        self, value: object, label: str, at_least: int, at_most: int
    ) -> Sequence[object] | None:
        """Return the entries of a list, at most one more than allowed; ``None`` if not a list."""
        entries = _as_sequence(value)
        if entries is None:
            self.problems.append(f"{label}: expected a list, got {type(value).__name__}")
            return None
        if not at_least <= len(entries) <= at_most:
            bound = f"at least {at_least}" if len(entries) < at_least else f"at most {at_most}"
            self.problems.append(f"{label}: expected {bound}, got {len(entries)}")
        return entries[: at_most + 1]

    def _point(self, value: object, place: str) -> Point | None:
        entries = _as_sequence(value)
        if entries is None or len(entries) != 2:
            got = type(value).__name__ if entries is None else f"{len(entries)} entries"
            self.problems.append(f"{place}: expected two numbers (x, y), got {got}")
            return None
        x, y = (self._coordinate(entries[k], f"{place}.{axis}") for k, axis in enumerate("xy"))
        return None if x is None or y is None else (x, y)

    def _coordinate(self, value: object, place: str) -> float | None:
        number = _as_float(value)
        if number is None:
            got = f"the text {value[:40]!r}" if isinstance(value, str) else type(value).__name__
            self.problems.append(f"{place}: expected a number, got {got}")
        elif not abs(number) <= MAX_COORDINATE:
            limit = f"a finite number, at most {MAX_COORDINATE:g} in size"
            self.problems.append(f"{place}: expected {limit}, got {number}")
        else:
            return number
        return None

    def _arena(self, value: object) -> Point:
        arena = self._point(value, "arena")
        if arena is not None and min(arena) <= 0.0:
            self.problems.append(f"arena: expected two positive sides, got {arena}")
            arena = None
        return arena or (math.inf, math.inf)


def _as_sequence(value: object) -> Sequence[object] | None:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes, bytearray)):
        return value
    return None


def _as_float(value: object) -> float | None:
    """Return a number as a float (never -0.0), infinite if too large; ``None`` for the rest."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    try:
        return float(value) + 0.0
    except OverflowError:
        return math.inf
