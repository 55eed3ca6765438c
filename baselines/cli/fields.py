"""``mbn fields``: fields as a table, or as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from mbn_marl.field import Field


@dataclass(frozen=True)
class Fields:
    """List fields: robots, ROIs, edges, area, proved optimum."""

    fields: Positional[Annotated[tuple[str, ...], arg(metavar="FIELD")]] = ()
    """Names or files; by default the whole catalogue."""
    figure: Path | None = None
    """Draw them in this file (.png, .pdf or .svg), side by side."""
    force: bool = False
    """If that file exists, move it aside."""

    def run(self, command_line: str) -> None:
        """Print the table, and draw the figure if one is asked for."""
        from baselines.compare.text_table import TextTable
        from mbn_marl.field import catalogue_names, load_field
        from mbn_marl.optimum import optimal_return

        fields = [load_field(name) for name in self.fields or catalogue_names()]
        lines = []
        for field in fields:
            makespan, optimum = field.optimal_makespan, optimal_return(field)
            counts = (field.starts, field.rois, field.holes, field.edges)
            best = "-" if optimum is None else f"{optimum:,.0f}"
            area = f"{field.polygon.area:,.0f}"
            lines.append(
                (field.name, *(str(len(one)) for one in counts), area, str(makespan or "-"), best)
            )
        headings = ("field", "robots", "ROIs", "holes", "edges", "area", "makespan", "return")
        title = "fields (makespan, return: proved optima, released rewards, no wind)"
        TextTable("", headings, tuple(lines)).print(title)
        if self.figure is not None:
            self._draw(fields, self.figure)

    def _draw(self, fields: Sequence[Field], path: Path) -> None:
        from mbn_marl.files import claim_file
        from mbn_marl.render import figures

        alone = len(fields) == 1
        figure = figures.field_figure(fields[0]) if alone else figures.fields_figure(fields)
        place = claim_file(figures.check_name(path), force=self.force)
        print(f"written to {figures.save(figure, place)}")
