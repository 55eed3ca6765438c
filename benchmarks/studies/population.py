"""The best policies for some fields within a time: more seeds where the optimum is not reached."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import ClassVar

from baselines.compare.records import RunRecord
from baselines.compare.text_table import TextTable
from baselines.runs.files import RunError, alone, claim_folder, write_json
from baselines.runs.folder import RunFolder
from baselines.runs.provenance import write_provenance
from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import train_runs
from baselines.sweep.worker import Outcome
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import print_finished
from benchmarks.report import Benchmark, Measurement, measurement_table
from benchmarks.studies import learning
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import catalogue_names

CAPTION = (
    "Returns with mean actions, of all runs that finished: the median is of final policies, the "
    "best of any fresh evaluation, on the way or at the end. Each field in turn got another seed, "
    "until a run reached the proved optimum, or the time left was too short for another run."
)
COLUMNS = {
    "field": ("field", "{}"),
    "best run": ("run", "{}"),
    "runs": ("runs", learning.WHOLE),
    "median": ("deterministic_median", learning.WHOLE),
    "best": ("deterministic_best", learning.WHOLE),
    "below": ("below", "{:.2%}"),
    "optimum": ("optimum", learning.WHOLE),
    "paper's best": ("paper_best", learning.WHOLE),
}


@dataclass(frozen=True)
class Population(Benchmark):
    """Train the recorded setting, and search, with one seed after the other, within a time."""

    name: ClassVar[str] = "population"

    fields: tuple[str, ...] = tuple(catalogue_names())
    """Names of `mbn fields`, or paths."""
    steps: int = learning.STEPS
    """Env-steps of every run."""
    minutes: float = 30.0
    """For all fields together, by the clock on the wall."""
    processes: int = os.cpu_count() or 1
    """Runs at a time, each on one core."""

    def training(self, field: str, seed: int) -> TrainConfig:
        """Return a run in the recorded setting, with the search at its end."""
        study = learning.Study(study="records", fields=(field,), seeds=(seed,), steps=self.steps)
        (run,) = study.config().runs()
        return run

    def run(self, command: str) -> bool:
        """Train, then print and write the best of each field."""
        rows, table = train_population(self, command)
        measurement_table(rows).print("targets")
        table.print("fields")
        print(f"written to {self.folder}: population.md, population.json, runs")
        return True


@dataclass
class Board:
    """The progress of the population."""

    begun: dict[str, int]  # runs begun on each field; the next one's seed
    solved: set[str] = field(default_factory=set)  # fields whose proved optimum was reached
    slowest: float = 0.0  # seconds that the longest run took

    def take(self, deadline: float) -> tuple[str, int] | None:
        """Return the next field and seed: of the fields not solved, the one with fewest runs.

        ``None`` if all are solved, or what is left until ``deadline`` (as ``time.time``) is less
        than the longest run took; every field gets one run in any case.
        """
        unsolved = [name for name in self.begun if name not in self.solved]
        name = min(unsolved, key=self.begun.__getitem__, default="")
        seed = self.begun.get(name, 0)
        if not unsolved or (seed > 0 and time.time() + self.slowest > deadline):
            return None
        self.begun[name] += 1
        return name, seed

    def enter(self, name: str, result: RunRecord, seconds: float) -> None:
        """Enter a finished run on a field."""
        self.slowest = max(self.slowest, seconds)
        if learning.best_return(result) == result.optimum:
            self.solved.add(name)


def train_population(config: Population, command: str) -> tuple[list[Measurement], TextTable]:
    """Train seeds 0, 1, 2 ... on every field in turn, and write what the best of them reached.

    Proved optima say when a field and the search of a run are done, and nothing else: no run learns
    from them. Return the targets, with what was reached, and a table of the fields.

    Raises:
        ConfigError: a number is out of range, a field is given twice or is not valid.
        RunError: the folder holds something, a run failed, or all on a field diverged.
    """
    problems = []
    if not config.minutes > 0.0:
        problems.append(f"minutes: must be above 0 (got {config.minutes})")
    with collecting(problems):
        engine = LocalEngine(config.processes)
    with collecting(problems):
        learning.Study(study="records", fields=config.fields, steps=config.steps).config()
    if problems:
        raise ConfigError("population", problems)
    out = claim_folder(config.folder, force=config.force)
    board = Board(dict.fromkeys(config.fields, 0))
    places: dict[str, tuple[str, float]] = {}  # of each run its field, and when it began
    started = time.time()

    def runs() -> Iterator[TrainConfig]:
        while (taken := board.take(started + 60.0 * config.minutes)) is not None:
            run = config.training(*taken)
            places[run.name] = taken[0], time.time()
            yield run

    def enter(outcome: Outcome) -> None:
        if outcome.state == "done":
            name, began = places[outcome.name]
            result = RunRecord.read(RunFolder.open(out / outcome.name))
            board.enter(name, result, time.time() - began)
        elif outcome.state != "diverged":
            raise RunError(str(outcome.error))

    with alone(out, command):
        write_json(out / "config.json", {**asdict(config), "out": str(out)})
        write_provenance(out, command)
        train_runs(runs(), str(out), engine, listener=print_finished, ended=enter)
    seconds = time.time() - started
    records = []
    for name, count in board.begun.items():
        folders = [RunFolder.open(out / config.training(name, seed).name) for seed in range(count)]
        finished = [RunRecord.read(folder) for folder in folders if folder.finished]
        if not finished:
            raise RunError(f"{out}: no run on {name} finished: all {count} diverged")
        records += finished
    trained = learning.run_table(records)
    lines = learning.field_table(trained)
    lines["run"] = trained.run[trained.groupby("field", sort=False).best.idxmax()].to_numpy()
    lines["below"] = 1.0 - lines.deterministic_best / lines.optimum
    limit, note = 60.0 * config.minutes, f"{config.processes} at a time"
    wall = Measurement("population: wall time of all runs", seconds, "s", limit, False, note)
    rows = [*learning.best_rows("population", lines), wall]
    table = learning.shown_table(lines, COLUMNS, CAPTION, 2)
    learning.write_study(out / "population.md", rows, lines, {"Fields": table})
    return rows, table
