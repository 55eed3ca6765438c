"""The rows of a run's ``progress.csv`` that tell of its training episodes, as arrays."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from baselines.runs.files import RunError, read_text

COLUMNS = {
    "env_steps": "env_steps",
    "episodes": "episodes",
    "mean": "return_mean",
    "sd": "return_std",
    "minimum": "return_min",
    "maximum": "return_max",
}
"""The column of ``progress.csv`` that each array of :class:`Windows` comes from."""


@dataclass(frozen=True)
class Windows:
    """Arrays (k,), one entry for each row, which tells of a window of training.

    Attributes:
        env_steps: env-steps at the end of the window.
        episodes: episodes that ended in it.
        mean: of their true team returns (NaN without an episode, as below).
        sd: population standard deviation of these.
        minimum: the smallest.
        maximum: the largest.
    """

    env_steps: NDArray[np.float64]
    episodes: NDArray[np.float64]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]
    minimum: NDArray[np.float64]
    maximum: NDArray[np.float64]

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a ``progress.csv``; one that is not there yet gives empty arrays.

        Raises:
            RunError: naming the file, and the column or the line that is not as it should be.
        """
        rows: list[dict[str, str | None]] = []
        if path.exists():
            rows = list(csv.DictReader(io.StringIO(read_text(path), newline="")))
        missing = [name for name in COLUMNS.values() if rows and name not in rows[0]]
        if missing:
            raise RunError(f"{path} has no column {', '.join(missing)}")
        table = [_numbers(row, f"{path}, line {line}") for line, row in enumerate(rows, start=2)]
        columns = np.asarray(table, np.float64).reshape(len(table), len(COLUMNS)).T
        windows = cls(**dict(zip(COLUMNS, columns, strict=True)))
        if not (np.diff(windows.env_steps) > 0).all():
            raise RunError(f"{path}: env_steps have to increase from row to row")
        return windows

    def with_episodes(self) -> Self:
        """The rows in which an episode ended."""
        some = self.episodes > 0
        return type(self)(**{field.name: getattr(self, field.name)[some] for field in fields(self)})


def _numbers(row: dict[str, str | None], place: str) -> list[float]:
    """The numbers of a row, in the order of ``COLUMNS``."""
    try:
        values = [float(row[name] or "") for name in COLUMNS.values()]
    except ValueError:
        raise RunError(f"{place}: a number is missing or is none: {row}") from None
    _, episodes, *returns = values
    if not (episodes >= 0 and (episodes == 0 or np.isfinite(returns).all())):
        raise RunError(f"{place}: episodes have to be 0 or more, with finite returns: {row}")
    return values
