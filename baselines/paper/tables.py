"""The paper's tables, with what the runs here give beside its numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from baselines.algorithms import SETTINGS
from baselines.compare.text_table import MISSING, NOT_IN_PAPER, Grid
from baselines.paper import published
from baselines.paper.summary import Summary, of_episodes, of_moving_means
from baselines.paper.trainings import Training, windows_of

Source = Literal["paper", "here"]
STATISTICS = {"mean": "mean", "sd": "SD", "maximum": "max", "range": "range"}
"""The numbers of a cell: attribute of :class:`Summary` -> as the paper calls it."""


class Sample(NamedTuple):
    """What the numbers here are taken over: in words, for a label, and how."""

    name: str
    label: str
    summarise: Callable[..., Summary | None]


SAMPLES = (
    Sample("single episodes", "episodes", of_episodes),
    Sample("moving means of 100 episodes", "means", of_moving_means),
)


class Kind(NamedTuple):
    """What a table has a row for.

    Attributes:
        row: what a row is; also the name of the table's files, in the plural.
        title: of the table.
        unit: one unit of the numbers, in reward units; the paper has one for each kind.
        unit_name: that in words.
        digits: after the point, as in the paper.
        in_paper: ``(row, setting)`` -> the paper's numbers.
    """

    row: Literal["algorithm", "field"]
    title: str
    unit: float
    unit_name: str
    digits: int
    in_paper: Callable[[str, str], Summary | None]


ALGORITHMS = Kind(
    "algorithm",
    "Table 1: each algorithm over the paper's ten fields",
    published.ALGORITHM_UNIT,
    "1e6 reward",
    4,
    published.of_algorithm,
)
FIELDS = Kind(
    "field",
    "Appendix tables: each field over the paper's six algorithms",
    1.0,
    "reward",
    1,
    published.of_field,
)


class Column(NamedTuple):
    """A column of a table: a setting, in the paper or here."""

    setting: str
    source: Source

    @property
    def heading(self) -> str:
        """As it stands above the column."""
        return f"{self.setting} {self.source}" + (
            "" if self.setting in published.settings() else ", ours"
        )


SOURCES: tuple[Source, ...] = ("paper", "here")
COLUMNS = tuple(
    Column(setting, source)
    for setting in SETTINGS
    for source in SOURCES
    if source == "here" or setting in published.settings()
)


@dataclass(frozen=True)
class Table:
    """A table of summaries in reward units.

    Attributes:
        kind: what it has a row for, and how it shows its numbers.
        sample: what our numbers are taken over.
        rows: for each row's name its cells; ``None`` for one that is missing.
    """

    kind: Kind
    sample: Sample
    rows: Mapping[str, Mapping[Column, Summary | None]]

    def means(self, column: Column) -> dict[str, float]:
        """The means of a column, of the rows that have one."""
        cells = {name: row[column] for name, row in self.rows.items()}
        return {name: cell.mean for name, cell in cells.items() if cell is not None}

    def grid(self) -> Grid:
        """The table as it is shown: four lines a row, one for each number."""
        lines = [
            (
                self._shown(name) if key == "mean" else "",
                shown,
                *(self._word(cells, column, key) for column in COLUMNS),
            )
            for name, cells in self.rows.items()
            for key, shown in STATISTICS.items()
        ]
        caption = (
            f"{self.kind.title}, in units of {self.kind.unit_name}, the paper's and ours; "
            f"'here' is over {self.sample.name}."
        )
        headings = (self.kind.row, "", *(column.heading for column in COLUMNS))
        return Grid(caption, headings, tuple(lines), words=2)

    def _word(self, cells: Mapping[Column, Summary | None], column: Column, key: str) -> str:
        """A number with the digits that the paper gives, or what stands for it."""
        summary = cells[column]
        if summary is None:
            return NOT_IN_PAPER if column.source == "paper" else MISSING
        return f"{getattr(summary, key) / self.kind.unit:,.{self.kind.digits}f}"

    def lines(self) -> list[list[str]]:
        """The table for a CSV file, a line a cell; the numbers of a missing one are empty."""
        return [
            [
                self._shown(name),
                column.setting,
                column.source,
                self.sample.name if column.source == "here" else "",
                self.kind.unit_name,
                *("" if cell is None else self._number(cell, key) for key in STATISTICS),
            ]
            for name, cells in self.rows.items()
            for column, cell in cells.items()
        ]

    def _shown(self, row: str) -> str:
        return published.display_name(row) if self.kind is ALGORITHMS else row

    def _number(self, cell: Summary, key: str) -> str:
        return f"{getattr(cell, key) / self.kind.unit:.10g}"


def paper_tables(trainings: Sequence[Training]) -> list[Table]:
    """Per algorithm and per field, each over single episodes and over moving means.

    Runs on other fields have rows of their own per field, but are not in an algorithm's numbers;
    runs of other algorithms the other way round.
    """
    in_fields = [run for run in trainings if run.cell.field in published.fields()]
    in_algorithms = [run for run in trainings if run.cell.algorithm in published.algorithms()]
    algorithms = {
        name: [run for run in in_fields if run.cell.algorithm == name]
        for name in algorithms_of(trainings)
    }
    fields = {
        name: [run for run in in_algorithms if run.cell.field == name]
        for name in fields_of(trainings)
    }
    return [
        Table(kind, sample, {name: _row(name, runs, kind, sample) for name, runs in groups.items()})
        for kind, groups in ((ALGORITHMS, algorithms), (FIELDS, fields))
        for sample in SAMPLES
    ]


def write_csv(tables: Iterable[Table]) -> str:
    """Tables of one kind as CSV; the paper's numbers once."""
    tables = list(tables)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    headings = [tables[0].kind.row, "setting", "source", "over", "unit", *STATISTICS.values()]
    lines = dict.fromkeys(tuple(line) for table in tables for line in table.lines())
    writer.writerows([headings, *lines])
    return text.getvalue()


def algorithms_of(trainings: Sequence[Training]) -> list[str]:
    """The paper's algorithms in its order, then the others."""
    return _known_first(published.algorithms(), (run.cell.algorithm for run in trainings))


def fields_of(trainings: Sequence[Training]) -> list[str]:
    """The paper's fields, then the others."""
    return _known_first(published.fields(), (run.cell.field for run in trainings))


def _row(
    name: str, trainings: Sequence[Training], kind: Kind, sample: Sample
) -> dict[Column, Summary | None]:
    def cell(column: Column) -> Summary | None:
        if column.source == "paper":
            return kind.in_paper(name, column.setting)
        here = [run for run in trainings if run.cell.setting == column.setting]
        return sample.summarise(windows_of(here))

    return {column: cell(column) for column in COLUMNS}


def _known_first(known: Iterable[str], found: Iterable[str]) -> list[str]:
    return list(dict.fromkeys([*known, *sorted(set(found))]))
