"""A linear program in HiGHS that grows by cuts, with a dual bound that needs no trust in HiGHS."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import highspy
import numpy as np
from numpy.typing import NDArray

from mbn_marl.planning.problem import Floats

CERTAIN = 1e-6
"""Multipliers of size 1 that prove more than this leave no doubt by rounding."""


@dataclass(frozen=True)
class Cut:
    """A row ``coefficients @ x <= limit``, valid where it was found and in narrower windows."""

    columns: tuple[int, ...]
    values: tuple[float, ...]
    limit: float


class LinearProgram:
    """Minimise the last column, within ``bounds`` of each, subject to rows; more can be added."""

    def __init__(
        self, highs: highspy.Highs, bounds: tuple[Floats, Floats], rows: list[Cut]
    ) -> None:
        self.highs, (self.low, self.high) = highs, bounds
        self.cost = np.zeros(len(self.low))
        self.cost[-1] = 1.0
        highs.clearModel()
        highs.addVars(len(self.low), self.low, self.high)
        highs.changeColCost(len(self.low) - 1, 1.0)
        self.rows: list[Cut] = []
        self.arrays = _arrays([])
        self.add(rows)

    def add(self, rows: list[Cut]) -> None:
        columns, values, sizes, limits = fresh = _arrays(rows)
        low, starts = np.full(len(rows), -highspy.kHighsInf), np.cumsum(sizes, dtype=np.int32)
        self.highs.addRows(len(rows), low, limits, len(values), starts - sizes, columns, values)
        self.rows += rows
        self.arrays = [np.concatenate(pair) for pair in zip(self.arrays, fresh, strict=True)]

    def run(self) -> tuple[Floats, float]:
        """Return the solution and a valid lower bound of the optimum, even if the solver failed.

        Any multipliers ``y <= 0`` of the rows give a bound: the optimum is at least
        ``limits @ y`` plus the least of ``(cost - y A) x`` over the columns' bounds. If that is
        more than 0 without the cost, no ``x`` meets the rows, and the bound is infinite.
        """
        self.highs.run()
        solution = self.highs.getSolution()
        self.y = np.minimum(np.array(solution.row_dual), 0.0)
        bound = self._least(self.cost, self.y)
        if self.highs.getModelStatus() == highspy.HighsModelStatus.kInfeasible:
            _, there_is, ray = self.highs.getDualRay()  # type: ignore[attr-defined]
            y = np.minimum(np.array(ray), 0.0) if there_is else self.y
            if self._least(np.zeros_like(self.cost), y) > CERTAIN * np.abs(y).max():
                bound = np.inf
        return np.array(solution.col_value), bound

    def _least(self, cost: Floats, y: Floats) -> float:
        columns, values, sizes, limits = self.arrays
        rest = cost - np.bincount(columns, values * np.repeat(y, sizes), len(cost))
        return float(limits @ y + np.minimum(rest * self.low, rest * self.high).sum())

    def binding(self, first: int) -> list[Cut]:
        return [self.rows[k] for k in np.flatnonzero(self.y[first:]) + first]


def _arrays(rows: list[Cut]) -> list[NDArray[Any]]:
    """Return the rows' columns, values, how many each has, and limits."""
    columns = np.array([column for cut in rows for column in cut.columns], np.int32)
    values = np.array([value for cut in rows for value in cut.values], float)
    sizes = np.array([len(cut.columns) for cut in rows], np.int32)
    return [columns, values, sizes, np.array([cut.limit for cut in rows], float)]


@contextmanager
def _printing_nothing() -> Iterator[None]:
    """Discard what C code prints: HiGHS 1.16 prints a banner before any option can be set."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def make_solver() -> highspy.Highs:
    with _printing_nothing():
        highs = highspy.Highs()  # type: ignore[no-untyped-call]
    highs.setOptionValue("output_flag", False)
    highs.setOptionValue("presolve", "off")
    highs.setOptionValue("solver", "simplex")
    highs.setOptionValue("threads", 1)
    return highs
