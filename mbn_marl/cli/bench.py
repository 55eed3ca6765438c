"""``mbn bench``: how fast the suite is here, against targets and against its peers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class Bench:
    """Measure in one run, print a table with targets, and write it as JSON and as a figure."""

    subject: Positional[Literal["speed"]] = "speed"
    """speed: the engine, its adapters, the plain loop, and the peers that are installed."""
    out: Path | None = None
    """The folder to write; by default runs/bench-SUBJECT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Measure with a progress bar, then print the tables."""
        from rich.console import Console
        from rich.progress import Progress

        from baselines.storage import claim_folder
        from benchmarks.report import print_result, write_result
        from benchmarks.speed import STAGES, measure_speed
        from benchmarks.timing import Budget

        folder = claim_folder(self.out or Path(f"runs/bench-{self.subject}"), force=self.force)
        console = Console()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("measuring", total=STAGES)
            result = measure_speed(command_line, Budget(), lambda: progress.advance(task))
        print_result(result, console)
        write_result(result, folder)
        console.print(f"written to {folder}: speed.json, speed.png")
