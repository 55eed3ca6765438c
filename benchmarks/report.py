"""A result as tables on a terminal, and as files."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from baselines.runs.files import write_json
from benchmarks.figure import write_figure
from benchmarks.load import ALLOWED
from benchmarks.machine import machine_line
from benchmarks.results import Curve, Part, Result, Row
from mbn_marl.files import replacing

VERDICTS = {True: "[green]met[/]", False: "[red]missed[/]", None: "-"}


def print_result(result: Result, console: Console) -> None:
    """Print the machine, the rows, where the time goes, and cost against sizes."""
    console.print(f"{machine_line(dict(result.machine))}\n", highlight=False)
    console.print(rows_table(result.rows, "3 robots, 6 ROIs, field_01, random actions, float32"))
    console.print(_parts_table(result.parts))
    console.print(_curves_table(result.curves))
    for curve in result.curves:
        console.print(f"{curve.quantity}: {curve.growth}", highlight=False)
    console.print(f"{result.seconds:.0f} s in all", highlight=False)
    if result.other_cores is not None and result.other_cores > ALLOWED:
        console.print(
            f"[bold red]not valid[/]: other processes used {result.other_cores:.2f} cores "
            "meanwhile, which bends ratios too; run it again on an idle machine",
            highlight=False,
        )


def write_result(result: Result, folder: Path) -> None:
    """Write ``speed.json`` and ``speed.png`` into ``folder``."""
    write_json(folder / "speed.json", result.to_json())
    with replacing(folder / "speed.png") as temporary:
        write_figure(result, temporary)


def rows_table(rows: list[Row], title: str) -> Table:
    """The rows with their targets and verdicts."""
    table = Table(title=title)
    table.add_column("what")
    for heading in ("measured", "target"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("note", style="dim")
    for row in rows:
        bound = ">=" if row.at_least else "<="
        table.add_row(
            row.name,
            "-" if row.value is None else f"{_number(row.value)} {row.unit}",
            "-" if row.target is None else f"{bound} {_number(row.target)}",
            VERDICTS[row.met],
            row.note,
        )
    return table


def _parts_table(parts: list[Part]) -> Table:
    table = Table(title="where the time of a step goes, all threads working")
    table.add_column("part")
    table.add_column("ns per world-step", justify="right")
    table.add_column("share", justify="right")
    whole = sum(part.nanoseconds for part in parts)
    for part in parts:
        share = part.nanoseconds / whole
        table.add_row(part.name, f"{part.nanoseconds:.1f}", f"{share:.0%}")
    return table


def _curves_table(curves: list[Curve]) -> Table:
    table = Table(title="cost against sizes: ns per world-step, all threads working")
    for curve in curves:
        table.add_column(curve.quantity, justify="right")
        table.add_column("ns", justify="right")
    for k in range(max(len(curve.sizes) for curve in curves)):
        cells = []
        for curve in curves:
            here = k < len(curve.sizes)
            cells += [f"{curve.sizes[k]}", f"{curve.nanoseconds[k]:,.0f}"] if here else ["", ""]
        table.add_row(*cells)
    return table


def _number(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
