"""The best policies for some fields within a time: more seeds where the optimum is not reached."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

from baselines.compare.records import RunRecord
from baselines.compare.text_table import TextTable
from baselines.console import console
from baselines.runs.files import RunError, alone, claim_folder, write_json, write_text
from baselines.runs.folder import RunFolder
from baselines.runs.provenance import write_provenance
from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import train_runs
from baselines.sweep.worker import Outcome
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Listener, print_finished
from benchmarks.report import Benchmark, Measurement
from benchmarks.studies.learning import STEPS, Learning, best_rows, measurement_grid, shown
from benchmarks.studies.passing import FieldLine, best_return
from mbn_marl.errors import ConfigError
from mbn_marl.field import catalogue_names

CAPTION = (
    "Returns with mean actions, of all runs that finished: the median is of final policies, the "
    "best of any fresh evaluation, on the way or at the end. Each field in turn got another seed, "
    "until a run reached the proved optimum, or the time left was too short for another run."
)


@dataclass(frozen=True)
class Population(Benchmark):
    """Train the recorded setting with one seed after the other, within a time."""

    name: ClassVar[str] = "population"

    fields: tuple[str, ...] = tuple(catalogue_names())
    """Names of `mbn fields`, or paths."""
    steps: int = STEPS
    """Env-steps of every run."""
    minutes: float = 30.0
    """For all fields together, by the clock on the wall."""
    processes: int = os.cpu_count() or 1
    """Runs at a time, each on one core."""

    def check(self) -> None:
        """Check everything before the first run starts.

        Raises:
            ConfigError: a number is out of range, or a field is given twice.
            MbnError: a field is not valid.
        """
        problems = []
        if not self.minutes > 0.0:
            problems.append(f"minutes: must be above 0 (got {self.minutes})")
        if self.processes < 1:
            problems.append(f"processes: at least 1, not {self.processes}")
        if problems:
            raise ConfigError("population", problems)
        Learning(fields=self.fields, seeds=(0,), steps=self.steps).config()

    def training(self, field: str, seed: int) -> TrainConfig:
        """Return a run in the recorded setting."""
        (run,) = Learning(fields=(field,), seeds=(seed,), steps=self.steps).config().runs()
        return run

    def run(self, command: str) -> bool:
        """Train, then print and write the best of each field."""
        rows, grid = train_population(self, command, print_finished)
        terminal = console()
        terminal.print(grid.rich("fields"))
        terminal.print(measurement_grid(rows).rich("targets"))
        terminal.print(grid.caption, "\n")
        terminal.print(f"written to {self.folder}: population.md, population.json, runs")
        return True


@dataclass
class Board:
    """The progress of the population.

    Attributes:
        begun: runs begun on each field; the next one's seed.
        solved: whether a run reached the proved optimum, for each field.
        slowest: seconds that the longest run took.
    """

    begun: list[int]
    solved: list[bool]
    slowest: float = 0.0

    @classmethod
    def of(cls, fields: int) -> Board:
        """Begin with nothing."""
        return cls([0] * fields, [False] * fields)

    def take(self, deadline: float) -> tuple[int, int] | None:
        """Return the next field's number and seed: of those not solved, the one with fewest runs.

        ``None`` if all are solved, or what is left until ``deadline`` (as ``time.time``) is less
        than the longest run took; every field gets one run in any case.
        """
        unsolved = [number for number, solved in enumerate(self.solved) if not solved]
        if not unsolved:
            return None
        number = min(unsolved, key=self.begun.__getitem__)
        seed = self.begun[number]
        if seed > 0 and time.time() + self.slowest > deadline:
            return None
        self.begun[number] += 1
        return number, seed

    def enter(self, number: int, result: RunRecord, seconds: float) -> None:
        """Enter a finished run on a field."""
        self.slowest = max(self.slowest, seconds)
        if best_return(result) == result.optimum:
            self.solved[number] = True


def train_population(
    config: Population, command: str, listener: Listener
) -> tuple[list[Measurement], TextTable]:
    """Train seeds 0, 1, 2 ... on every field in turn, and write what the best of them reached.

    Proved optima say when a field is done, and nothing else: no run learns from them.

    Args:
        config: what to train; its folder gets ``population.md``, ``population.json`` and the runs.
        command: the exact command, recorded there.
        listener: receives where the runs stand.

    Returns:
        The targets, with what was reached, and a table of the fields.

    Raises:
        RunError: the folder holds something already, or a field has no run that finished.
        MbnError: a run failed.
    """
    config.check()
    out = claim_folder(config.folder, force=config.force)
    with alone(out, command):
        write_json(out / "config.json", {**asdict(config), "out": str(out)})
        write_provenance(out, command)
        started = time.time()
        deadline = started + 60.0 * config.minutes
        board = Board.of(len(config.fields))
        _train_until(deadline, board, config, out, listener)
        seconds = time.time() - started
    cells = {
        field: _finished(config, out, field, runs)
        for field, runs in zip(config.fields, board.begun, strict=True)
    }
    rows, grid = _rows(config, cells, seconds), _grid(cells)
    best = {name: asdict(FieldLine.of(cell)) for name, cell in cells.items()}
    write_json(
        out / "population.json", {"targets": [row.to_json() for row in rows], "fields": best}
    )
    parts = [measurement_grid(rows, CAPTION).markdown("Targets"), grid.markdown("Fields")]
    write_text(out / "population.md", "\n\n".join(["# Population", *parts]) + "\n")
    return rows, grid


def _train_until(
    deadline: float, board: Board, config: Population, out: Path, listener: Listener
) -> None:
    """Train one run after the other, until there is none to begin."""
    begun: dict[str, tuple[int, float]] = {}

    def runs() -> Iterator[TrainConfig]:
        while (taken := board.take(deadline)) is not None:
            number, seed = taken
            run = config.training(config.fields[number], seed)
            begun[run.name] = number, time.time()
            yield run

    def enter(outcome: Outcome) -> None:
        number, began = begun[outcome.name]
        if outcome.state == "done":
            result = RunRecord.read(RunFolder.open(out / outcome.name))
            board.enter(number, result, time.time() - began)
        elif outcome.state != "diverged":
            raise RunError(str(outcome.error))

    engine = LocalEngine(config.processes)
    train_runs(runs(), str(out), engine, listener=listener, ended=enter)


def _finished(config: Population, out: Path, field: str, runs: int) -> list[RunRecord]:
    """The results of a field, by seed."""
    folders = [RunFolder.open(out / config.training(field, seed).name) for seed in range(runs)]
    cell = [RunRecord.read(folder) for folder in folders if folder.finished]
    if not cell:
        raise RunError(f"{out}: no run on {field} finished: all {runs} diverged")
    return cell


def _rows(
    config: Population, cells: Mapping[str, Sequence[RunRecord]], seconds: float
) -> list[Measurement]:
    """The targets."""
    lines = [FieldLine.of(cell) for cell in cells.values()]
    note = f"{config.processes} at a time"
    wall = Measurement(
        "population: wall time of all runs", seconds, "s", 60.0 * config.minutes, False, note
    )
    return [*best_rows("population", lines), wall]


def _grid(cells: Mapping[str, Sequence[RunRecord]]) -> TextTable:
    """The fields as a table."""
    headings = ("field", "best run", "runs", "median", "best", "below", "optimum", "paper's best")
    return TextTable(CAPTION, headings, tuple(map(_words, cells.values())), words=2)


def _words(cell: Sequence[RunRecord]) -> tuple[str, ...]:
    line = FieldLine.of(cell)
    below = None if line.optimum is None else 1.0 - line.deterministic_best / line.optimum
    return (
        line.field,
        max(cell, key=best_return).run.path.name,
        shown(line.runs),
        shown(line.deterministic_median),
        shown(line.deterministic_best),
        shown(below, "{:.2%}"),
        shown(line.optimum),
        shown(line.paper_best),
    )
