"""The console that every command prints its tables on."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Collection, Iterable, Iterator
from copy import copy
from dataclasses import replace
from typing import Any

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.table import Column, Table

UNBOUNDED = 100_000
NARROWEST = 20


class WholeCells(Console):
    """A console that does not break the cells of tables.

    A table that is too wide is printed in blocks of columns, one below the other, each after the
    leading columns aligned to the left, which name the row. Only a column that is too wide alone is
    wrapped, between words.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does, each table in blocks that fit, below its title."""
        for one in objects:
            if isinstance(one, Table) and one.title:
                super().print(one.title, style="table.title", highlight=False, soft_wrap=True)
        parts = [[*self._blocks(one)] if isinstance(one, Table) else [one] for one in objects]
        super().print(*itertools.chain.from_iterable(parts), **options)

    def _blocks(self, table: Table) -> Iterator[Table]:
        """Yield the table in blocks without its title, the caption below the last one."""
        names = list(itertools.takewhile(lambda column: column.justify == "left", table.columns))
        lead = len(names) if 0 < len(names) < len(table.columns) else 1
        blocks = [table.columns[:lead]]
        for column in table.columns[lead:]:
            wider = _part(table, [*blocks[-1], column])
            if len(blocks[-1]) > lead and not _fits(wider, self):
                blocks.append(table.columns[:lead])
            blocks[-1] = [*blocks[-1], column]
        for number, columns in enumerate(blocks, start=1):
            block = _part(table, columns)
            block.title = None
            block.caption = table.caption if number == len(blocks) else None
            yield block


class FittingProgress(Progress):
    """Progress bars that are never cut; without a terminal nothing is shown.

    Of the ``columns`` those in ``spare`` are left out, the first one first, until a row fits.
    """

    def __init__(
        self, *columns: ProgressColumn, spare: Iterable[ProgressColumn], screen: Console
    ) -> None:
        self._spare, self._screen = tuple(spare), screen
        super().__init__(*columns, console=screen, disable=not screen.is_terminal)

    def make_tasks_table(self, tasks: Iterable[Task]) -> Table:
        """Return the bars, one a row."""
        table = super().make_tasks_table(tasks)
        columns = dict(zip(self.columns, table.columns, strict=True))
        for column in self._spare:
            if _fits(table, self._screen):
                break
            del columns[column]
            table = _part(table, columns.values())
        return table


def _part(table: Table, columns: Collection[Column]) -> Table:
    part = copy(table)
    part.columns = [replace(column, _index=place) for place, column in enumerate(columns)]
    return part


def _fits(table: Table, console: Console) -> bool:
    wide = console.options.update(max_width=UNBOUNDED)
    return console.measure(table, options=wide).maximum <= console.width


def console() -> Console:
    """Return a console on the standard output.

    In a pipe or a file it is as wide as COLUMNS says; without it, or below 20, it wraps nothing.
    """
    columns = os.environ.get("COLUMNS", "")
    known = sys.stdout.isatty() or (columns.isdecimal() and int(columns) >= NARROWEST)
    return WholeCells(width=None if known else UNBOUNDED)
