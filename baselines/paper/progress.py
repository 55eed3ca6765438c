"""The training episodes of a run: the rows of its ``progress.csv`` and their moving mean."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame, read_csv, to_numeric

from baselines.runs.files import RunError, read_text

SMOOTHING = 100
"""Episodes of the moving mean: what Stable-Baselines3 logs as ``rollout/ep_rew_mean``."""

COLUMNS = {
    "env_steps": "env_steps",
    "episodes": "episodes",
    "return_mean": "mean",
    "return_std": "sd",
    "return_min": "minimum",
    "return_max": "maximum",
}
"""What is read: the column of ``progress.csv`` -> as it is called here."""


def read_progress(path: Path) -> DataFrame:
    """Read a ``progress.csv``; one that is not there yet gives no rows.

    Returns:
        A row for each window of training: ``env_steps`` at its end, ``episodes`` that ended in it,
        the ``mean``, population ``sd``, ``minimum`` and ``maximum`` of their true team returns
        (reward units; NaN without an episode), and the ``moving_mean``, see :func:`moving_mean`.

    Raises:
        RunError: naming the file, and the column or the line that is not as it should be.
    """
    text = read_text(path) if path.exists() else ",".join(COLUMNS)
    table = read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    if missing := [name for name in COLUMNS if name not in table]:
        raise RunError(f"{path} has no column {', '.join(missing)}")
    words = table[list(COLUMNS)].rename(columns=COLUMNS)
    rows = words.apply(to_numeric, errors="coerce").astype(float)
    none = (rows.isna() & (words != "nan")).any(axis=1)
    returns = np.isfinite(rows[["mean", "sd", "minimum", "maximum"]]).all(axis=1)
    wrong = ~(rows.episodes == 0) & ~((rows.episodes > 0) & returns)
    for bad, problem in (
        (none, "a number is missing or is none"),
        (wrong, "episodes have to be 0 or more, with finite returns"),
    ):
        if bad.any():
            line = int(bad.to_numpy().argmax())
            raise RunError(f"{path}, line {line + 2}: {problem}: {dict(words.loc[line])}")
    if not (np.diff(rows.env_steps) > 0).all():
        raise RunError(f"{path}: env_steps have to increase from row to row")
    return rows.assign(moving_mean=moving_mean(rows))


def moving_mean(rows: DataFrame) -> NDArray[np.float64]:
    """The mean return of the latest episodes at each row, (k,) reward units.

    It is over the fewest whole rows, up to that one, that hold at least ``SMOOTHING`` episodes;
    over all so far while there are fewer; NaN before the first.
    """
    counts = rows.episodes.to_numpy()
    episodes = np.concatenate([[0.0], np.cumsum(counts)])
    total = np.concatenate([[0.0], np.cumsum(np.where(counts > 0, counts * rows["mean"], 0.0))])
    ends = np.arange(1, episodes.size)
    starts = np.searchsorted(episodes, episodes[ends] - SMOOTHING, side="right") - 1
    starts = np.maximum(starts, 0)
    with np.errstate(invalid="ignore"):
        means: NDArray[np.float64] = (total[ends] - total[starts]) / (
            episodes[ends] - episodes[starts]
        )
    return means


def first_reach(rows: DataFrame, threshold: float) -> float:
    """Env-steps at which the moving mean first is ``threshold`` or more; NaN for never.

    Rows before ``SMOOTHING`` episodes have ended do not count.
    """
    reached = (rows.episodes.cumsum() >= SMOOTHING) & (rows.moving_mean >= threshold)
    return float(rows.env_steps[reached].min())
