"""``mbn bench``: how fast the suite is here, how well it learns and plans, against targets."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

STUDIES_OF_VARIANTS = ("learning", "sharing", "ablations")
LEARNING = (*STUDIES_OF_VARIANTS, "population")
OPTIONS = {
    "fields": LEARNING,
    "seeds": STUDIES_OF_VARIANTS,
    "steps": (*LEARNING, "grid"),
    "processes": LEARNING,
    "minutes": ("population",),
    "resume": STUDIES_OF_VARIANTS,
}
"""The subjects that an option is for, where it is not for all."""


@dataclass(frozen=True)
class Bench:
    """Measure in one run, print tables with targets, and write them and figures."""

    subject: Positional[
        Literal["speed", "learning", "sharing", "ablations", "population", "planning", "grid"]
    ] = "speed"
    """speed: the engine, its adapters, the plain loop, and the peers that are installed. learning:
    one setting on all ten fields against its targets. sharing: the ways to share parameters.
    ablations: what the setting is made of. population: the best policies within a time.
    planning: proofs and plans for the ten fields and random ones. grid: what the engines of
    `mbn grid` take for themselves."""
    fields: tuple[str, ...] = ()
    """All that learn: names of `mbn fields`, or paths; by default all ten, for ablations two."""
    seeds: tuple[int, ...] = ()
    """learning, sharing, ablations: one run per variant, field and seed; by default 0 1 2 3 4, for
    ablations 0 1 2."""
    steps: int | None = None
    """All that learn: env-steps of every run; by default 1,441,792. grid: 20,000."""
    processes: int | None = None
    """All that learn: runs at a time, each on one core; by default as many as there are."""
    minutes: float | None = None
    """population: for all fields together; by default 30."""
    out: Path | None = None
    """The folder to write; by default runs/bench-SUBJECT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """learning, sharing, ablations: go on with what is in the folder, as `mbn compare` does."""

    def run(self, command_line: str) -> None:
        """Measure, then print the tables."""
        out = self.out or Path(f"runs/bench-{self.subject}")
        self._refuse_others()
        if self.subject == "speed":
            self._measure_speed(out, command_line)
        elif self.subject == "planning":
            self._measure_planning(out, command_line)
        elif self.subject == "population":
            self._train_population(out, command_line)
        elif self.subject == "grid":
            self._measure_grid(out, command_line)
        else:
            self._study(out, command_line)

    def _refuse_others(self) -> None:
        """Refuse options of other subjects."""
        from mbn_marl.errors import ConfigError

        problems = [
            f"{name}: for {', '.join(subjects)}, not for {self.subject}"
            for name, subjects in OPTIONS.items()
            if getattr(self, name) and self.subject not in subjects
        ]
        if problems:
            raise ConfigError("bench", problems)

    def _measure_speed(self, out: Path, command_line: str) -> None:
        from rich.console import Console
        from rich.progress import Progress

        from baselines.runs.files import claim_folder
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

        from baselines.runs.files import claim_folder, write_json
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

    def _train_population(self, out: Path, command_line: str) -> None:
        from rich.console import Console

        from baselines.compare.tables import rich_table
        from baselines.training.progress_bar import print_finished
        from benchmarks.studies.learning import targets_grid
        from benchmarks.studies.population import PopulationConfig, train_population
        from benchmarks.studies.study import STUDIES
        from mbn_marl.field import catalogue_names

        config = PopulationConfig(
            fields=self.fields or tuple(catalogue_names()),
            steps=STUDIES["learning"].steps if self.steps is None else self.steps,
            minutes=30.0 if self.minutes is None else self.minutes,
            processes=(os.cpu_count() or 1) if self.processes is None else self.processes,
        )
        rows, grid = train_population(
            config, out, command=command_line, force=self.force, listener=print_finished
        )
        console = Console()
        console.print(rich_table("fields", grid))
        console.print(rich_table("targets", targets_grid(rows)))
        console.print(grid.caption, "\n")
        console.print(f"written to {out}: population.md, population.json, runs")

    def _measure_grid(self, out: Path, command_line: str) -> None:
        from rich.console import Console
        from rich.progress import Progress

        from baselines.runs.files import claim_folder, write_json
        from benchmarks.grid import STAGES, measure_grid
        from benchmarks.load import OtherLoad
        from benchmarks.machine import describe_machine, machine_line
        from benchmarks.report import rows_table

        folder = claim_folder(out, force=self.force)
        console, machine, load = Console(), describe_machine(), OtherLoad()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task("running grids", total=STAGES)
            rows = measure_grid(self.steps, lambda: progress.advance(task))
        others = load.cores()
        console.print(f"{machine_line(machine)}\n", highlight=False)
        console.print(rows_table(rows, "the engines of mbn grid"))
        if others is not None:
            console.print(f"other processes used {others:.2f} cores meanwhile", highlight=False)
        result = {"command": command_line, "machine": machine, "other_cores": others}
        write_json(folder / "grid.json", {**result, "rows": [row.to_json() for row in rows]})
        console.print(f"written to {folder}: grid.json")

    def _study(self, out: Path, command_line: str) -> None:
        from rich.console import Console

        from baselines.cli.compare import train_and_compare
        from benchmarks.studies.learning import print_targets, target_rows, write_targets
        from benchmarks.studies.study import STUDIES

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
