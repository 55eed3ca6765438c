"""The runs that a report is made from, as two tables: one of runs, one of training episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas
from pandas import DataFrame

from baselines.compare.records import RunRecord, find_records
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.progress import first_reach, read_progress
from baselines.runs.files import RunError
from mbn_marl.field import Field, catalogue_names

CELL = ["algorithm", "setting", "field"]
"""Columns that name a cell of the experiment; its runs differ in their seeds."""


@dataclass(frozen=True)
class Trainings:
    """Runs, finished or not.

    Attributes:
        runs: a row for each: ``algorithm``, ``setting``, ``field`` (one from a file is called by
            the file's name), ``seed``, ``env_steps`` recorded, ``reach`` (env-steps at which the
            moving mean reached the threshold, NaN for never), ``success_rate`` and ``return_mean``
            of the final evaluation with sampled actions (NaN while it is not finished),
            ``finished`` and the exact ``command``.
        rows: the rows of :func:`baselines.paper.progress.read_progress` in which or before which
            an episode ended, with the cell and the seed of their run.
        fields: the field of each name in ``runs``.
    """

    runs: DataFrame
    rows: DataFrame
    fields: dict[str, Field]

    @property
    def algorithms(self) -> list[str]:
        """The paper's algorithms in its order, then the others."""
        return _known_first(published.algorithms(), self.runs.algorithm)

    @property
    def field_names(self) -> list[str]:
        """The paper's fields, then the others."""
        return _known_first(published.fields(), self.runs.field)


def find_trainings(
    paths: Sequence[Path], note: Callable[[str], None] = lambda text: None
) -> Trainings:
    """Read the runs at ``paths``: run folders, or folders with run folders anywhere inside.

    Studies, comparisons and what ``--force`` moved aside are left out inside; a comparison or a
    folder moved aside that is a path itself is read. Of two runs of one cell and seed, of which one
    is unfinished, the finished one is read.

    Args:
        paths: where to look.
        note: receives what is left out.

    Raises:
        RunError: a path holds no run, a run cannot be read, or two are of one cell and seed.
    """
    records = _one_of_each(find_records(paths, note, comparisons=False, finished=False), note)
    runs, rows = [], []
    for record in records:
        progress = read_progress(record.run.progress)
        cell = dict(zip([*CELL, "seed"], _place(record), strict=True))
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
        {_field_name(record): record.field for record in records},
    )


def _one_of_each(records: Sequence[RunRecord], note: Callable[[str], None]) -> list[RunRecord]:
    """One run for each cell and seed."""
    chosen: dict[tuple[Any, ...], RunRecord] = {}
    for one in sorted(records, key=lambda record: not record.run.finished):
        other = chosen.setdefault(_place(one), one)
        if other is one:
            continue
        if one.run.finished or not other.run.finished:
            raise RunError(
                f"{other.run.path} and {one.run.path} are of the same algorithm, setting, field "
                "and seed; give one of them"
            )
        note(f"left out: {one.run.path}, unfinished; {other.run.path} is the same, finished")
    return [record for record in records if chosen[_place(record)] is record]


def _place(record: RunRecord) -> tuple[Any, ...]:
    """The cell and the seed."""
    config = record.config
    return config["algorithm"], config["setting"], _field_name(record), config["seed"]


def _field_name(record: RunRecord) -> str:
    """A catalogue name as it is; for a file its name, marked if the catalogue has it too."""
    field = record.config["field"]
    if field in catalogue_names():
        return str(field)
    name = Path(field).stem
    return f"{name} (file)" if name in catalogue_names() else name


def _known_first(known: Iterable[str], found: Iterable[str]) -> list[str]:
    return list(dict.fromkeys([*known, *sorted(set(found))]))
