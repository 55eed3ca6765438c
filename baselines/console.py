"""The console that every command prints its tables on."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any

from rich.console import Console, RenderableType
from rich.table import Column, Table

UNBOUNDED = 100_000


class WholeCells(Console):
    """A console that does not break the cells of tables.

    A table that is wider than the console is printed in blocks, one below the other. Each block has
    some of the columns, after the leading ones that are aligned to the left, which name the row.
    Only a column that is too wide alone is wrapped, between words.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does, each table in blocks that fit, below its title on one line."""
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
            if len(blocks[-1]) > lead and not self._fits(_part(table, [*blocks[-1], column])):
                blocks.append(table.columns[:lead])
            blocks[-1] = [*blocks[-1], column]
        for number, columns in enumerate(blocks, start=1):
            block = _part(table, columns)
            block.title = None
            block.caption = table.caption if number == len(blocks) else None
            yield block

    def _fits(self, table: RenderableType) -> bool:
        wide = self.options.update(max_width=UNBOUNDED)
        return self.measure(table, options=wide).maximum <= self.width


def _part(table: Table, columns: Sequence[Column]) -> Table:
    part = copy(table)
    part.columns = [*columns]
    return part


def console() -> Console:
    """Return a console on the standard output of the moment.

    On a terminal it has the terminal's width. In a pipe or a file there is no width to fit into:
    a table takes its natural one, and no line is wrapped.
    """
    return WholeCells(width=None if sys.stdout.isatty() else UNBOUNDED)
