"""The comparisons of learning, and the targets of the recorded setting."""

from __future__ import annotations

import heapq
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import ClassVar

from baselines.cli.compare import train_and_compare
from baselines.compare.config import CompareConfig
from baselines.compare.results import Results
from baselines.compare.text_table import TextTable
from baselines.compare.variants import read_variants
from baselines.console import console
from baselines.runs.files import write_json, write_text
from benchmarks.report import HEADINGS, Benchmark, Measurement
from benchmarks.studies.passing import FieldLine, Passing, passes
from mbn_marl.field import catalogue_names

STEPS = 1_441_792
"""Env-steps of a run."""
NEAR = 0.005
"""How far below the optimum a return may be to count as near it."""
BUDGET = 1_500_000
"""Env-steps within which a run has to pass."""
CAPTION = (
    "A run passes when the mean return of fresh sampled episodes is 100 000 or more, 99 % of them "
    "succeed, and so does the policy with mean actions. Wall times have the evaluations in them, "
    "but not the start of Python and compilation; in the table, of as many runs at a time as there "
    "were processes. Returns of fields are those of mean actions, over seeds: the median is of "
    "final policies, the best of any fresh evaluation. Targets are scaled to the runs made: for "
    "ten fields 180 s until all pass, 30 minutes in all."
)


@dataclass(frozen=True)
class Study(Benchmark):
    """Compare the variants in a YAML file of this folder, with the name of the study."""

    fields: tuple[str, ...] = tuple(catalogue_names())
    """Names of `mbn fields`, or paths."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """One run for each variant, field and seed."""
    steps: int = STEPS
    """Env-steps of every run."""
    processes: int = os.cpu_count() or 1
    """Runs at a time, each on one core."""
    resume: bool = False
    """Resume what is in the folder, as `mbn compare` does."""

    def config(self) -> CompareConfig:
        """Return the comparison.

        Raises:
            MbnError: as :class:`~baselines.compare.config.CompareConfig`.
        """
        variants = read_variants(Path(__file__).with_name(f"{self.name}.yaml"))
        return CompareConfig(variants, self.fields, self.seeds, self.steps, 32_768, 100)

    def run(self, command: str) -> bool:
        """Train what is missing, print and write the comparison."""
        self.compare(command)
        return True

    def compare(self, command: str) -> Results:
        """Train what is missing, print and write the comparison, and return its results."""
        results = train_and_compare(
            self.config(),
            self.folder,
            command=command,
            processes=self.processes,
            force=self.force,
            resume=self.resume,
        )
        print(f"written to {self.folder}: comparison.md, comparison.json, figures, runs")
        return results


@dataclass(frozen=True)
class Learning(Study):
    """Train the recorded setting on all ten fields, against its targets."""

    name: ClassVar[str] = "learning"

    def run(self, command: str) -> bool:
        """Compare, and add the targets."""
        results = self.compare(command)
        rows = target_rows(results, self.processes)
        terminal = console()
        terminal.print(measurement_grid(rows).rich("targets"))
        terminal.print(CAPTION, "\n")
        write_targets(results, rows, self.folder)
        return True


@dataclass(frozen=True)
class Sharing(Study):
    """Compare the ways to share parameters."""

    name: ClassVar[str] = "sharing"


@dataclass(frozen=True)
class Ablations(Study):
    """Leave one thing at a time out of the recorded setting."""

    name: ClassVar[str] = "ablations"

    fields: tuple[str, ...] = ("field_02", "field_10")
    """Names of `mbn fields`, or paths."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run for each variant, field and seed."""


def makespan(seconds: Sequence[float], processes: int) -> float:
    """Return how long ``processes`` workers take for jobs in this order."""
    free = [0.0] * processes
    for job in seconds:
        heapq.heapreplace(free, free[0] + job)
    return max(free)


def target_rows(results: Results, processes: int) -> list[Measurement]:
    """Return the targets of the first label, for ``processes`` runs at a time."""
    setting = results.labels[0]
    runs = results.of_label(setting)
    cells = [results.cells[setting, field] for field in results.fields]
    lines = [FieldLine.of(cell) for cell in cells]
    passed = [passes(run) for run in runs]
    return [
        _count(f"{setting}: final policies that pass", passed, 1.0),
        Measurement(
            f"{setting}: until a run passes, worst run",
            max(Passing.of(result).env_steps for result in runs),
            "env-steps",
            BUDGET,
            at_least=False,
        ),
        Measurement(
            f"{setting}: until {len(lines)} fields pass, one seed each, wall time",
            median(
                makespan([Passing.of(cell[seed]).seconds for cell in cells], processes)
                for seed in range(results.seeds)
            ),
            "s",
            18.0 * len(lines),
            False,
            f"{processes} at a time, median over seeds",
        ),
        _count(
            f"{setting}: fields, median return within 0.5 % of the optimum",
            (
                line.optimum is not None and line.deterministic_median >= (1 - NEAR) * line.optimum
                for line in lines
            ),
            1.0,
        ),
        *best_rows(setting, lines),
        Measurement(
            f"{setting}: wall time of all runs",
            sum(result.final("wall_seconds") for result in runs) / processes,
            "s",
            180.0 * len(lines),
            False,
            f"{processes} at a time",
        ),
    ]


def best_rows(label: str, lines: Sequence[FieldLine]) -> list[Measurement]:
    """Compare the best return of each field with the paper's and with the optimum."""
    return [
        _count(
            f"{label}: fields, best return at or above the paper's",
            (
                line.paper_best is not None and line.deterministic_best >= line.paper_best
                for line in lines
            ),
            0.8,
        ),
        _count(
            f"{label}: fields, best return is the proved optimum",
            (line.deterministic_best == line.optimum for line in lines),
            0.5,
        ),
    ]


def write_targets(results: Results, rows: Sequence[Measurement], out: Path) -> None:
    """Write ``learning.md`` and ``learning.json`` into the folder ``out``."""
    lines = [FieldLine.of(cell) for cell in results.cells.values()]
    write_json(
        out / "learning.json",
        {"targets": [row.to_json() for row in rows], "fields": [asdict(line) for line in lines]},
    )
    parts = [measurement_grid(rows).markdown("Targets")]
    parts += [
        field_grid([line for line in lines if line.label == label]).markdown(label)
        for label in results.labels
    ]
    write_text(out / "learning.md", "\n\n".join(["# Learning", *parts]) + "\n")


def field_grid(lines: Sequence[FieldLine]) -> TextTable:
    """Return the lines of one label as a table."""
    caption = (
        "pass: runs whose final policy does. env-steps, s: to the first evaluation that passes, "
        "median over seeds, wall time; worst: the most env-steps. mean actions: the median return "
        "of final policies; below: how far it is below the proved optimum; best: of any evaluation."
    )
    headings = "field|pass|env-steps|worst|s|sampled return|success|mean actions|below|best"
    headings += "|optimum|paper's best"
    return TextTable(caption, tuple(headings.split("|")), tuple(map(_field_words, lines)))


def _field_words(line: FieldLine) -> tuple[str, ...]:
    below = None if line.optimum is None else 1.0 - line.deterministic_median / line.optimum
    return (
        line.field,
        f"{line.passed}/{line.runs}",
        shown(line.env_steps),
        shown(line.worst_env_steps),
        shown(line.seconds, "{:.1f}"),
        shown(line.return_mean),
        f"{line.success_rate:.1%}",
        shown(line.deterministic_median),
        shown(below, "{:.2%}"),
        shown(line.deterministic_best),
        shown(line.optimum),
        shown(line.paper_best),
    )


def measurement_grid(rows: Sequence[Measurement], caption: str = CAPTION) -> TextTable:
    """Return the targets as a table."""
    return TextTable(caption, HEADINGS, tuple(row.words() for row in rows))


def _count(name: str, met: Iterable[bool], share: float) -> Measurement:
    """Count how many are met, with the share that is aimed at."""
    outcomes = [bool(one) for one in met]
    least = math.ceil(share * len(outcomes) - 1e-9)
    return Measurement(name, sum(outcomes), f"of {len(outcomes)}", least)


def shown(value: float | None, form: str = "{:,.0f}") -> str:
    """Return a number as a table has it."""
    return "-" if value is None else form.format(value)
