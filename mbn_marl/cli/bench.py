"""``mbn bench``: how fast the suite is here, how well it learns and plans, against targets."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional


@dataclass(frozen=True)
class Bench:
    """Measure in one run, print tables with targets, and write them and figures."""

    subject: Positional[Literal["speed", "learning", "sharing", "planning"]] = "speed"
    """speed: the engine, its adapters, the plain loop, and the peers that are installed. learning:
    one setting on all ten fields against its targets. sharing: the ways to share parameters.
    planning: proofs and plans for the ten fields and random ones."""
    fields: tuple[str, ...] = ()
    """learning, sharing: names of `mbn fields`, or paths; by default all ten."""
    seeds: tuple[int, ...] = ()
    """learning, sharing: one run per variant, field and seed; by default 0 1 2 3 4."""
    steps: int | None = None
    """learning, sharing: env-steps of every run; by default 1,441,792 and 655,360."""
    processes: int | None = None
    """learning, sharing: runs at a time, each on one core; by default as many as there are."""
    out: Path | None = None
    """The folder to write; by default runs/bench-SUBJECT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """learning, sharing: go on with what is in the folder, as `mbn compare` does."""

    def run(self, command_line: str) -> None:
        """Measure, then print the tables."""
        out = self.out or Path(f"runs/bench-{self.subject}")
        if self.subject == "speed":
            self._refuse_sizes()
            self._measure_speed(out, command_line)
        elif self.subject == "planning":
            self._refuse_sizes()
            self._measure_planning(out, command_line)
        else:
            self._study(out, command_line)

    def _refuse_sizes(self) -> None:
        from mbn_marl.errors import ConfigError

        problems = [
            f"{name}: for learning and sharing, not for {self.subject}"
            for name in ("fields", "seeds", "steps", "processes", "resume")
            if getattr(self, name)
        ]
        if problems:
            raise ConfigError("bench", problems)

    def _measure_speed(self, out: Path, command_line: str) -> None:
        from rich.console import Console
        from rich.progress import Progress

        from baselines.storage import claim_folder
        from benchmarks.report import print_result, write_result
        from benchmarks.speed import STAGES, measure_speed
        from benchmarks.timing import Budget

        folder = claim_folder(out, force=self.force)
        console = Console()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("measuring", total=STAGES)
            result = measure_speed(command_line, Budget(), lambda: progress.advance(task))
        print_result(result, console)
        write_result(result, folder)
        console.print(f"written to {folder}: speed.json, speed.png")

    def _measure_planning(self, out: Path, command_line: str) -> None:
        from rich.console import Console
        from rich.progress import Progress

        from baselines.storage import claim_folder, write_json
        from benchmarks.machine import describe_machine, machine_line
        from benchmarks.planning.study import CONVEX, WINDING, study_planning
        from benchmarks.report import rows_table
        from mbn_marl.field import catalogue_names

        folder = claim_folder(out, force=self.force)
        console, machine = Console(), describe_machine()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("planning", total=len(catalogue_names()) + CONVEX + WINDING)
            rows, instances = study_planning(lambda: progress.advance(task))
        console.print(f"{machine_line(machine)}\n", highlight=False)
        console.print(rows_table(rows, "the planner; seconds of processor time on one core"))
        targets = [row.to_json() for row in rows]
        result = {"command": command_line, "machine": machine, "targets": targets, **instances}
        write_json(folder / "planning.json", result)
        console.print(f"written to {folder}: planning.json")

    def _study(self, out: Path, command_line: str) -> None:
        from rich.console import Console

        from benchmarks.studies.learning import print_targets, target_rows, write_targets
        from benchmarks.studies.study import STUDIES
        from mbn_marl.cli.compare import train_and_compare

        config = STUDIES[self.subject].config(self.fields, self.seeds, self.steps)
        processes = (os.cpu_count() or 1) if self.processes is None else self.processes
        results = train_and_compare(
            config,
            out,
            command=command_line,
            processes=processes,
            force=self.force,
            resume=self.resume,
        )
        console = Console()
        if self.subject == "learning":
            rows = target_rows(results, processes)
            print_targets(rows, console)
            write_targets(results, rows, out)
        console.print(f"written to {out}: comparison.md, comparison.json, figures, runs")
