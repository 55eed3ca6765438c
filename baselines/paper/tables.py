"""The paper's tables, with what the runs here give beside its numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import pandas
from pandas import DataFrame, MultiIndex, Series

from baselines.compare.text_table import DASH, TextTable, csv_text
from baselines.paper import published
from baselines.paper.published import STATISTICS
from baselines.paper.trainings import Trainings

MISSING = "missing"
"""A cell that no run has given."""


class Sample(NamedTuple):
    """The evaluations that a number is taken over: in words, for a label, and how."""

    name: str
    label: str
    summarise: Callable[[DataFrame], list[float]]


def of_episodes(rows: DataFrame) -> list[float]:
    """The numbers of a cell over every training episode of ``rows`` (reward units).

    Exact, from the count, mean, deviation and range of each row: the squared deviation from the
    mean of all is the row's variance plus the square of its mean's distance.
    """
    some = rows[rows.episodes > 0]
    mean = np.average(some.return_mean, weights=some.episodes)
    squares = some.return_std**2 + (some.return_mean - mean) ** 2
    variance = np.average(squares, weights=some.episodes)
    highest, lowest = some.return_max.max(), some.return_min.min()
    return [mean, np.sqrt(variance), highest, highest - lowest]


def of_moving_means(rows: DataFrame) -> list[float]:
    """The numbers of a cell over the moving means of ``rows``, one a row (reward units)."""
    means = rows.moving_mean
    return [means.mean(), means.std(ddof=0), means.max(), means.max() - means.min()]


SAMPLES = (
    Sample("single episodes", "episodes", of_episodes),
    Sample("moving means of 100 episodes", "means", of_moving_means),
)


class Kind(NamedTuple):
    """The subject of a table's ``row``; in the plural, the name of its files.

    Its ``unit``, in reward units, and ``digits`` are the paper's, whose numbers ``in_paper`` gives
    by (row, setting).
    """

    row: Literal["algorithm", "field"]
    title: str
    unit: float
    unit_name: str
    digits: int
    in_paper: Callable[[], dict[tuple[str, str], published.Numbers]]


ALGORITHMS = Kind(
    "algorithm",
    "Table 1: each algorithm over the paper's ten fields",
    published.ALGORITHM_UNIT,
    "1e6 reward",
    4,
    published.by_algorithm,
)
FIELDS = Kind(
    "field",
    "Appendix tables: each field over the paper's six algorithms",
    1.0,
    "reward",
    1,
    published.by_field,
)

COLUMNS = [
    (setting, source)
    for setting in published.REPORTED
    for source in ("paper", "here")
    if source == "here" or setting in published.SETTINGS
]
"""Columns of a table: a setting, in the paper or here."""


@dataclass(frozen=True)
class PaperTable:
    """A table in reward units, with our numbers over a ``sample``.

    ``cells`` has a row for each (row, setting, source), a column for each of ``STATISTICS``; NaN
    where there is nothing.
    """

    kind: Kind
    sample: Sample
    cells: DataFrame

    @classmethod
    def of(cls, kind: Kind, sample: Sample, names: Iterable[str], rows: DataFrame) -> PaperTable:
        """Make the table of the rows ``names`` from the paper's numbers and training's ``rows``."""
        here = {
            (*key, "here"): Series(sample.summarise(group), list(STATISTICS))
            for key, group in rows.groupby([kind.row, "setting"], sort=False)
        }
        paper = {(*key, "paper"): Series(numbers) for key, numbers in kind.in_paper().items()}
        index = MultiIndex.from_tuples(
            [(name, *column) for name in names for column in COLUMNS],
            names=["row", "setting", "source"],
        )
        cells = DataFrame({**paper, **here}).T.reindex(index=index, columns=list(STATISTICS))
        return cls(kind, sample, cells)

    def means(self, setting: str, source: str) -> Series:
        """The means of a column, of the rows that have one, the best first."""
        column = self.cells.xs((setting, source), level=("setting", "source"))["mean"]
        return column.dropna().sort_values(ascending=False, kind="stable")

    def text(self) -> TextTable:
        """The table as it is shown: four lines a row, one for each number."""
        wide = (self.cells / self.kind.unit).stack(future_stack=True).unstack(["setting", "source"])
        order = MultiIndex.from_product([self.cells.index.unique("row"), STATISTICS])
        lines = [
            (
                self._shown(name) if statistic == "mean" else "",
                statistic,
                *(self._word(numbers[column], column[1]) for column in COLUMNS),
            )
            for (name, statistic), numbers in wide.reindex(order).iterrows()
        ]
        caption = (
            f"{self.kind.title}, in units of {self.kind.unit_name}, the paper's and ours; "
            f"'here' is over {self.sample.name}."
        )
        headings = (f"{' '.join(column)}{marked(column[0])}" for column in COLUMNS)
        return TextTable(caption, (self.kind.row, "", *headings), tuple(lines), words=2)

    def _word(self, number: float, source: str) -> str:
        """A number with the digits that the paper gives, or the word for a missing one."""
        if np.isnan(number):
            return DASH if source == "paper" else MISSING
        return f"{number:,.{self.kind.digits}f}"

    def lines(self) -> DataFrame:
        """The table for a CSV file, a line a cell; the numbers of a missing one are empty."""
        lines = (self.cells / self.kind.unit).reset_index(
            names=[self.kind.row, "setting", "source"]
        )
        lines[self.kind.row] = lines[self.kind.row].map(self._shown)
        lines.insert(3, "over", np.where(lines.source == "here", self.sample.name, ""))
        lines.insert(4, "unit", self.kind.unit_name)
        return lines

    def _shown(self, row: str) -> str:
        return published.display_name(row) if self.kind is ALGORITHMS else row


def marked(setting: str) -> str:
    """A mark behind a setting that is not the paper's."""
    return "" if setting in published.SETTINGS else ", ours"


def paper_tables(trainings: Trainings) -> list[PaperTable]:
    """Per algorithm and per field, each over single episodes and over moving means.

    Runs on other fields have rows of their own per field, but are not in an algorithm's numbers;
    runs of other algorithms the other way round.
    """
    rows = trainings.rows
    chosen = (
        (ALGORITHMS, trainings.algorithms, rows[rows.field.isin(published.FIELDS)]),
        (FIELDS, trainings.field_names, rows[rows.algorithm.isin(published.ALGORITHMS)]),
    )
    return [PaperTable.of(kind, sample, *part) for kind, *part in chosen for sample in SAMPLES]


def write_csv(tables: Iterable[PaperTable]) -> str:
    """Tables of one kind as CSV; the paper's numbers once."""
    lines = pandas.concat([table.lines() for table in tables]).drop_duplicates()
    return csv_text(lines, "%.10g")
