"""The best policies for some fields within a time: more seeds where the optimum is not reached."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.sharedctypes import Synchronized, SynchronizedArray
from pathlib import Path
from typing import NamedTuple

from baselines.compare.results import Result
from baselines.compare.tables import markdown
from baselines.compare.text_table import Grid
from baselines.runs.files import RunError, alone, claim_folder, write_json, write_text
from baselines.runs.folder import RunFolder
from baselines.runs.provenance import write_provenance
from baselines.sweep.processes import Job, run_processes, spawning
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Listener
from benchmarks.results import Row
from benchmarks.studies.learning import best_rows, bound, shown, targets_grid
from benchmarks.studies.passing import FieldLine, best_return
from benchmarks.studies.study import STUDIES
from mbn_marl.errors import ConfigError

CAPTION = (
    "Returns with mean actions, of all runs that finished: the median is of final policies, the "
    "best of any fresh evaluation, on the way or at the end. Each field in turn got another seed, "
    "until a run reached the proved optimum, or the time left was too short for another run."
)


@dataclass(frozen=True)
class PopulationConfig:
    """What to train.

    Attributes:
        fields: catalogue names or paths.
        steps: env-steps of every run.
        minutes: for all fields together, by the clock on the wall.
        processes: runs at a time.

    Raises:
        ConfigError: a number is out of range, or a field is given twice.
        MbnError: a field is not valid.
    """

    fields: tuple[str, ...]
    steps: int
    minutes: float
    processes: int

    def __post_init__(self) -> None:
        """Check everything before the first run starts."""
        problems = []
        if not self.minutes > 0.0:
            problems.append(f"minutes: must be above 0 (got {self.minutes})")
        if self.processes < 1:
            problems.append(f"processes: at least 1, not {self.processes}")
        if problems:
            raise ConfigError("population", problems)
        STUDIES["learning"].config(self.fields, (0,), self.steps)

    def run(self, field: str, seed: int) -> TrainConfig:
        """A run in the recorded setting."""
        (run,) = STUDIES["learning"].config((field,), (seed,), self.steps).runs()
        return run


class Board(NamedTuple):
    """Where the population stands, seen by all processes; ``begun`` has the lock."""

    begun: SynchronizedArray[int]  # runs begun on each field; the next one's seed
    solved: SynchronizedArray[int]  # 1 where a run reached the proved optimum
    slowest: Synchronized[float]  # seconds that the longest run took

    @classmethod
    def of(cls, fields: int) -> Board:
        """Nothing is begun."""
        make = spawning()
        return cls(make.Array("i", fields), make.Array("i", fields), make.Value("d", 0.0))

    def take(self, deadline: float) -> tuple[int, int] | None:
        """The next field's number and seed: of those not solved, the one with the fewest runs.

        ``None`` if all are solved, or what is left until ``deadline`` (as ``time.time``) is less
        than the longest run took; every field gets one run in any case.
        """
        with self.begun.get_lock():
            unsolved = [number for number, solved in enumerate(self.solved[:]) if not solved]
            if not unsolved:
                return None
            number = min(unsolved, key=self.begun.__getitem__)
            seed = self.begun[number]
            if seed > 0 and time.time() + self.slowest.value > deadline:
                return None
            self.begun[number] += 1
            return number, seed

    def enter(self, number: int, result: Result, seconds: float) -> None:
        """Take in a finished run on a field."""
        with self.begun.get_lock():
            self.slowest.value = max(self.slowest.value, seconds)
            if best_return(result) == result.optimum:
                self.solved[number] = 1


def train_population(
    config: PopulationConfig,
    out: Path,
    *,
    command: str,
    force: bool,
    listener: Listener,
) -> tuple[list[Row], Grid]:
    """Train seeds 0, 1, 2 ... on every field in turn, and write what the best of them reached.

    Proved optima say when a field is done, and nothing else: no run learns from them.

    Args:
        config: what to train.
        out: the folder to make: ``population.md``, ``population.json`` and the run folders.
        command: the exact command, recorded there.
        force: move a folder that is already there aside.
        listener: is told where the runs stand.

    Returns:
        The targets, with what was reached, and a table of the fields.

    Raises:
        RunError: ``out`` holds something already, or a field has no run that finished.
        MbnError: a run failed.
    """
    claim_folder(out, force=force)
    with alone(out, "mbn bench"):
        write_json(out / "config.json", asdict(config))
        write_provenance(out, command)
        started = time.time()
        deadline = started + 60.0 * config.minutes
        board = Board.of(len(config.fields))
        work = (config, out, board, deadline)
        run_processes(_train_some, work, config.processes, listener)
        seconds = time.time() - started
    cells = {
        field: _finished(config, out, field, runs)
        for field, runs in zip(config.fields, board.begun[:], strict=True)
    }
    rows, grid = _rows(config, cells, seconds), _grid(cells)
    best = {name: asdict(FieldLine.of(cell)) for name, cell in cells.items()}
    write_json(
        out / "population.json", {"targets": [row.to_json() for row in rows], "fields": best}
    )
    parts = [markdown("Targets", targets_grid(rows, CAPTION)), markdown("Fields", grid)]
    write_text(out / "population.md", "\n\n".join(["# Population", *parts]) + "\n")
    return rows, grid


def _train_some(
    config: PopulationConfig, out: Path, board: Board, deadline: float, listener: Listener
) -> None:
    """Train one run after the other, until there is none to begin."""
    while (taken := board.take(deadline)) is not None:
        number, seed = taken
        run = config.run(config.fields[number], seed)
        began = time.time()
        Job(run, out / run.name).train(listener)
        folder = RunFolder.open(out / run.name)
        if folder.finished:
            board.enter(number, Result.read(folder), time.time() - began)


def _finished(config: PopulationConfig, out: Path, field: str, runs: int) -> list[Result]:
    """The results of a field, by seed."""
    folders = [RunFolder.open(out / config.run(field, seed).name) for seed in range(runs)]
    cell = [Result.read(folder) for folder in folders if folder.finished]
    if not cell:
        raise RunError(f"{out}: no run on {field} finished, all {runs} broke down")
    return cell


def _rows(
    config: PopulationConfig, cells: Mapping[str, Sequence[Result]], seconds: float
) -> list[Row]:
    """The targets."""
    lines = [FieldLine.of(cell) for cell in cells.values()]
    note = f"{config.processes} at a time"
    wall = bound("population: wall time of all runs", seconds, "s", 60.0 * config.minutes, note)
    return [*best_rows("population", lines), wall]


def _grid(cells: Mapping[str, Sequence[Result]]) -> Grid:
    """The fields as a table."""
    headings = ("field", "best run", "runs", "median", "best", "below", "optimum", "paper's best")
    return Grid(CAPTION, headings, tuple(map(_words, cells.values())), words=2)


def _words(cell: Sequence[Result]) -> tuple[str, ...]:
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
