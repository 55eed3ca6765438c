"""The runs that a report is made from, as two tables: one of runs, one of training episodes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from numpy.typing import NDArray
from pandas import DataFrame

from baselines.compare.records import RunRecord, find_records
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.runs.files import RunError, read_text
from mbn_marl.field import Field, catalogue_names

CELL = ["algorithm", "setting", "field"]
"""Columns that name a cell of the experiment; its runs differ in their seeds."""
SMOOTHING = 100
"""Episodes of the moving mean: what Stable-Baselines3 logs as ``rollout/ep_rew_mean``."""
RETURNS = ["return_mean", "return_std", "return_min", "return_max"]
COLUMNS = ["env_steps", "episodes", *RETURNS]
"""The columns of ``progress.csv`` that are read."""


@dataclass(frozen=True)
class Trainings:
    """Runs, finished or not.

    Attributes:
        runs: a row for each: ``algorithm``, ``setting``, ``field`` (one from a file is called by
            the file's name), ``seed``, ``env_steps`` recorded, ``reach`` (env-steps at which the
            moving mean reached the threshold, NaN for never), ``success_rate`` and ``return_mean``
            of the final evaluation with sampled actions (NaN while it is not finished),
            ``finished`` and the exact ``command``.
        rows: those of :func:`read_progress` since the first episode, with cell and seed of the run.
        fields: the field of each name in ``runs``.
    """

    runs: DataFrame
    rows: DataFrame
    fields: dict[str, Field]

    @property
    def algorithms(self) -> list[str]:
        """The paper's algorithms in its order, then the others."""
        return _known_first(published.ALGORITHMS, self.runs.algorithm)

    @property
    def field_names(self) -> list[str]:
        """The paper's fields, then the others."""
        return _known_first(published.FIELDS, self.runs.field)


def find_trainings(
    paths: Sequence[Path], note: Callable[[str], None] = lambda text: None
) -> Trainings:
    """Read the runs at ``paths``: run folders, or folders with run folders anywhere inside.

    Studies, comparisons and what ``--force`` moved aside are left out inside, which ``note``
    receives; a comparison or a folder moved aside that is a path itself is read. Of two runs of one
    cell and seed, of which one is unfinished, the finished one is read.

    Raises:
        RunError: a path holds no run, a run cannot be read, or two are of one cell and seed.
    """
    records = _one_of_each(find_records(paths, note, comparisons=False, finished=False), note)
    runs, rows = [], []
    for record in records:
        progress = read_progress(record.run.progress)
        cell = _cell(record)
        final = record.evaluation["stochastic"] if record.run.finished else {}
        runs.append(
            {
                **cell,
                "env_steps": int(progress.env_steps.max()) if len(progress) else 0,
                "reach": first_reach(progress, RETURN_THRESHOLD),
                **{name: final.get(name) for name in ("success_rate", "return_mean")},
                "finished": record.run.finished,
                "command": record.run.command,
            }
        )
        rows.append(progress[progress.moving_mean.notna()].assign(**cell))
    return Trainings(
        DataFrame(runs).astype({"success_rate": float, "return_mean": float}),
        pandas.concat(rows, ignore_index=True),
        {_cell(record)["field"]: record.field for record in records},
    )


def _one_of_each(records: Sequence[RunRecord], note: Callable[[str], None]) -> list[RunRecord]:
    """One run for each cell and seed."""
    chosen: dict[tuple[Any, ...], RunRecord] = {}
    for one in sorted(records, key=lambda record: not record.run.finished):
        other = chosen.setdefault(tuple(_cell(one).values()), one)
        if other is one:
            continue
        if one.run.finished or not other.run.finished:
            raise RunError(
                f"{other.run.path} and {one.run.path} are of the same algorithm, setting, field "
                "and seed; give one of them"
            )
        note(f"left out: {one.run.path}, unfinished; {other.run.path} is the same, finished")
    return [record for record in records if record in chosen.values()]


def _cell(record: RunRecord) -> dict[str, Any]:
    """The cell and the seed; a file's field has its name, marked if the catalogue has it too."""
    cell = {name: record.config[name] for name in (*CELL, "seed")}
    if cell["field"] not in catalogue_names():
        name = Path(cell["field"]).stem
        cell["field"] = f"{name} (file)" if name in catalogue_names() else name
    return cell


def _known_first(known: Iterable[str], found: Iterable[str]) -> list[str]:
    return list(dict.fromkeys([*known, *sorted(set(found))]))


def read_progress(path: Path) -> DataFrame:
    """Read a ``progress.csv``; one that is not there yet gives no rows.

    Returns:
        A row for each window of training: ``env_steps`` at its end, ``episodes`` that ended in it,
        mean, population deviation, minimum and maximum of their true team returns (``return_...``,
        reward units; NaN without an episode), and the ``moving_mean``, see :func:`moving_mean`.

    Raises:
        RunError: naming the file, and the column or the line that is not as it should be.
    """
    text = read_text(path) if path.exists() else ",".join(COLUMNS)
    table = pandas.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    if missing := [name for name in COLUMNS if name not in table]:
        raise RunError(f"{path} has no column {', '.join(missing)}")
    words = table[COLUMNS]
    rows = words.apply(pandas.to_numeric, errors="coerce").astype(float)
    none = (rows.isna() & (words != "nan")).any(axis=1)
    finite = np.isfinite(rows[RETURNS]).all(axis=1)
    wrong = ~(rows.episodes == 0) & ~((rows.episodes > 0) & finite)
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
    returns = np.where(counts > 0, counts * rows.return_mean, 0.0)
    episodes, total = (np.concatenate([[0.0], np.cumsum(each)]) for each in (counts, returns))
    starts = np.searchsorted(episodes, episodes[1:] - SMOOTHING, side="right") - 1
    starts = np.maximum(starts, 0)
    with np.errstate(invalid="ignore"):
        means: NDArray[np.float64] = (total[1:] - total[starts]) / (episodes[1:] - episodes[starts])
    return means


def first_reach(rows: DataFrame, threshold: float) -> float:
    """Env-steps at which the moving mean first is ``threshold`` or more; NaN for never.

    Rows before ``SMOOTHING`` episodes have ended do not count.
    """
    reached = (rows.episodes.cumsum() >= SMOOTHING) & (rows.moving_mean >= threshold)
    return float(rows.env_steps[reached].min())
