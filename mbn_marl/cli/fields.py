"""``mbn fields``: the catalogue as a table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fields:
    """List the catalogue: robots, ROIs, edges, area, proved optimum."""

    def run(self, command_line: str) -> None:
        """Print the table."""
        from rich.console import Console
        from rich.table import Table

        from mbn_marl.field import catalogue_names, load_field
        from mbn_marl.optimum import optimal_return

        table = Table(title="fields (optimum: proved, released rewards, no wind)")
        table.add_column("field")
        for heading in ("robots", "ROIs", "holes", "edges", "area", "makespan", "return"):
            table.add_column(heading, justify="right")
        for name in catalogue_names():
            field = load_field(name)
            optimum = optimal_return(field)
            table.add_row(
                name,
                str(len(field.starts)),
                str(len(field.rois)),
                str(len(field.holes)),
                str(len(field.edges)),
                f"{field.polygon.area:,.0f}",
                "-" if field.optimal_makespan is None else str(field.optimal_makespan),
                "-" if optimum is None else f"{optimum:,.0f}",
            )
        Console().print(table)
