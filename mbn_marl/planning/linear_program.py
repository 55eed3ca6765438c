"""A linear program in HiGHS that grows by cuts, with a dual bound that needs no trust in HiGHS."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import highspy
import numpy as np

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
    """Minimise the last column subject to rows, which are added as they are found.

    Args:
        highs: the solver.
        bounds: the least and the greatest value of each column.
        rows: the first rows.
    """

    def __init__(
        self, highs: highspy.Highs, bounds: tuple[Floats, Floats], rows: list[Cut]
    ) -> None:
        self.highs, self.rows = highs, rows
        self.low, self.high = bounds
        width = len(self.low)
        self.cost = np.zeros(width)
        self.cost[-1] = 1.0
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = width, len(rows)
        program.col_cost_, program.col_lower_, program.col_upper_ = self.cost, self.low, self.high
        self.matrix = _Matrix(rows)
        program.row_lower_ = np.full(len(rows), -highspy.kHighsInf)
        program.row_upper_ = self.matrix.limits
        program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(self.matrix.start, len(self.matrix.index))
        program.a_matrix_.index_, program.a_matrix_.value_ = self.matrix.index, self.matrix.value
        highs.passModel(program)

    def add(self, rows: list[Cut]) -> None:
        """Add rows."""
        self.rows = self.rows + rows
        fresh = _Matrix(rows)
        low = np.full(len(rows), -highspy.kHighsInf)
        self.highs.addRows(
            len(rows), low, fresh.limits, len(fresh.index), fresh.start, fresh.index, fresh.value
        )
        self.matrix = self.matrix.above(fresh)

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
        """Return the lower bound of a cost that multipliers of the rows give."""
        rest = cost - self.matrix.weighted(y, len(cost))
        return float(self.matrix.limits @ y + np.minimum(rest * self.low, rest * self.high).sum())

    def binding(self, first: int) -> list[Cut]:
        """Return the binding rows from ``first`` on."""
        return [self.rows[k] for k in np.flatnonzero(self.y[first:]) + first]


class _Matrix:
    """Rows in the sparse layout of HiGHS."""

    def __init__(self, rows: list[Cut]) -> None:
        lengths = [len(cut.columns) for cut in rows]
        self.start = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32)
        self.row = np.repeat(np.arange(len(rows)), lengths)
        self.index = np.array([column for cut in rows for column in cut.columns], np.int32)
        self.value = np.array([value for cut in rows for value in cut.values])
        self.limits = np.array([cut.limit for cut in rows])

    def above(self, other: _Matrix) -> _Matrix:
        """Return this matrix with the rows of ``other`` below."""
        both = _Matrix([])
        both.row = np.concatenate([self.row, other.row + len(self.limits)])
        both.index = np.concatenate([self.index, other.index])
        both.value = np.concatenate([self.value, other.value])
        both.limits = np.concatenate([self.limits, other.limits])
        return both

    def weighted(self, weights: Floats, width: int) -> Floats:
        """Return the weighted sum of the rows."""
        return np.asarray(np.bincount(self.index, weights[self.row] * self.value, width), float)


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
    """Return a quiet simplex solver on one thread."""
    with _printing_nothing():
        highs = highspy.Highs()  # type: ignore[no-untyped-call]
    options: dict[str, bool | str | int] = {
        "output_flag": False,
        "presolve": "off",
        "solver": "simplex",
        "threads": 1,
    }
    for name, value in options.items():
        highs.setOptionValue(name, value)
    return highs
