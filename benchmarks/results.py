"""What a benchmark found: rows with targets, where the time goes, and cost against sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: what was measured.
        value: the figure, or ``None`` if it was not measured; ``note`` then says why.
        unit: of ``value`` and ``target``.
        target: the figure aimed at, or ``None``.
        at_least: whether the target is a lower bound; otherwise it is an upper one.
        note: how the figure came about, if the name does not say it.
    """

    name: str
    value: float | None
    unit: str
    target: float | None = None
    at_least: bool = True
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the target is met; ``None`` without a figure or a target."""
        if self.value is None or self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    def to_json(self) -> dict[str, Any]:
        """The row as JSON values."""
        return {**asdict(self), "met": self.met}


@dataclass(frozen=True)
class Part:
    """What one part of a step costs, in ns of elapsed time per world-step, all threads working."""

    name: str
    nanoseconds: float


@dataclass(frozen=True)
class Curve:
    """Cost of a step against one size, the others fixed.

    Attributes:
        quantity: ``"robots"``, ``"ROIs"`` or ``"edges"``.
        sizes: the sizes measured, ascending.
        nanoseconds: elapsed time of a world-step at each of them, all threads working.
        growth: what was fitted to them, as a sentence.
    """

    quantity: str
    sizes: tuple[int, ...]
    nanoseconds: tuple[float, ...]
    growth: str


@dataclass(frozen=True)
class Result:
    """Everything that one run of a benchmark found.

    Attributes:
        command: the exact command.
        machine: processor, memory and versions, see :mod:`benchmarks.machine`.
        seconds: how long the run took.
        other_cores: cores that other processes used meanwhile, on average; ``None`` if unknown.
        rows: the table.
        parts: where the time of a step goes.
        curves: cost against sizes.
    """

    command: str
    machine: Mapping[str, Any]
    seconds: float
    other_cores: float | None = None
    rows: list[Row] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """The result as JSON values."""
        return {**asdict(self), "rows": [row.to_json() for row in self.rows]}
