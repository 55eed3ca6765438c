"""The cost of many runs: the schedulers' share, how workers add up, the capacity of machines."""

from __future__ import annotations

import heapq
import logging
import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from baselines.algorithms import SPEEDS
from baselines.compare.text_table import TextTable
from baselines.sweep.processes import LocalEngine
from baselines.sweep.ray_cluster import RayEngine
from baselines.sweep.run import Engine, Sweep
from baselines.sweep.spec import GridSpec, runs_of
from baselines.sweep.status import duration
from baselines.sweep.store import open_store
from baselines.sweep.worker import TrainJob, Watch, source_of
from baselines.training.config import TrainConfig
from benchmarks.report import Advance, Benchmark, Findings, Measurement

EMPTY, CELLS = 1000, 4  # cells that train nothing, and that train
WORKERS = 2
Job = tuple[str, str | None, float]  # a name, that of the job to wait for, and seconds
CORES, MACHINES = 2, (1, 16, 256)  # cores of a machine, and how many machines
CAPTION = (
    f"Machines have {CORES} cores and train as many runs at a time; runs begin in the order of the "
    "grid, those under C when the one that they start from is done."
)


@dataclass(frozen=True)
class GridCosts(Benchmark):
    """Measure what the engines of `mbn grid` cost; Ray only where it is installed."""

    name: ClassVar[str] = "grid"
    stages: ClassVar[int] = 5

    steps: int = 20_000
    """Env-steps of each of the runs that train."""

    def measure(self, advance: Advance) -> Findings:
        """Measure both engines."""
        rows = []
        for workers in (1, WORKERS):
            seconds = _empty(LocalEngine(workers, retries=1), workers)
            rows.append(_overhead("local", workers, seconds))
            advance()
        rows.append(_on_ray())
        advance()
        (wall, processor), (wall_of_many, processor_of_many) = (
            _train(self.steps, workers, advance) for workers in (1, WORKERS)
        )
        cells = f"{CELLS} runs of A2C, {self.steps:,} env-steps each, start of processes included"
        many = f"{WORKERS} workers"
        time = 100.0 * wall / (WORKERS * wall_of_many)
        time_note = f"time with one over {WORKERS} times that with {WORKERS}; 100 with one"
        work = 100.0 * processor / processor_of_many
        work_note = "what the cells cost beside each other; other processes hardly bend it"
        rows += [
            Measurement("local: all cells, 1 worker", wall, "s", note=cells),
            Measurement(f"local: all cells, {many}", wall_of_many, "s", note=cells),
            Measurement(f"local: efficiency, {many}", time, "%", note=time_note),
            Measurement(f"local: the same by processor time, {many}", work, "%", note=work_note),
        ]
        return Findings("the engines of mbn grid", rows)


def _overhead(engine: str, workers: int, seconds: float) -> Measurement:
    name = f"{engine}: per cell, {workers} at a time"
    note = f"{EMPTY:,} cells that train nothing; what they note in the store included"
    return Measurement(name, 1000.0 * seconds / EMPTY, "ms", note=note)


def claim_and_leave(job: TrainJob, report: Callable[[Any], None]) -> None:
    """Do everything that a run costs but training."""
    store = open_store(job.store)
    if not store.finished([job.name]):
        Watch(store, job, report).note(state="done")


def _spec(store: Path, seeds: Sequence[int], steps: int) -> GridSpec:
    values = {"algorithms": ["a2c"], "fields": ["field_03"], "settings": ["A"], "seeds": seeds}
    budget = {"steps": steps, "evaluate_every": steps, "episodes": 1}
    return GridSpec.model_validate({"store": str(store), **values, "budget": budget})


def _empty(engine: Engine, workers: int) -> float:
    """Return the seconds for all empty runs, at the rate since every worker has ended one."""
    with tempfile.TemporaryDirectory() as folder:
        runs = runs_of(_spec(Path(folder), seeds=range(EMPTY), steps=1))
        jobs = [TrainJob(run, folder, noted=True) for run in runs]
        ends: list[float] = []
        engine.run(claim_and_leave, jobs, print, lambda job, end: ends.append(perf_counter()))
        return (ends[-1] - ends[workers - 1]) * len(ends) / (len(ends) - workers)


def _on_ray() -> Measurement:
    if find_spec("ray") is None:
        return Measurement("ray: per cell", None, "ms", note="not installed")
    import ray

    quiet: dict[str, Any] = {
        "include_dashboard": False,
        "log_to_driver": False,
        "logging_level": logging.ERROR,
    }
    ray.init(num_cpus=WORKERS, object_store_memory=80 * 2**20, **quiet)
    try:
        return _overhead("ray", WORKERS, _empty(RayEngine(), WORKERS))
    finally:
        ray.shutdown()


def _train(steps: int, workers: int, advance: Advance) -> tuple[float, float]:
    """Train the cells of a grid; return seconds by the clock, and of the processors."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = Sweep.of(_spec(Path(folder), seeds=range(CELLS), steps=steps))
        wall, before = perf_counter(), os.times()
        sweep.train(LocalEngine(workers, retries=1))
        after = os.times()
        wall = perf_counter() - wall
    advance()
    return wall, sum(after[2:4]) - sum(before[2:4])  # of child processes that have ended


def makespan(jobs: Iterable[Job], workers: int) -> float:
    """Return the seconds that ``workers`` side by side take for jobs, in this order."""
    waiting, done = list(jobs), set[str | None]([None])
    running: list[tuple[float, str]] = []
    now = 0.0
    while waiting or running:
        ready = (job for job in waiting if job[1] in done)
        job = next(ready, None) if len(running) < workers else None
        if job is None:
            now, name = heapq.heappop(running)
            done.add(name)
        else:
            waiting.remove(job)
            heapq.heappush(running, (now + job[2], job[0]))
    return now


def jobs_of(runs: Iterable[TrainConfig]) -> list[Job]:
    """Return runs as jobs, with their seconds on one core."""
    return [(run.name, source_of(run), run.steps / SPEEDS[run.algorithm]) for run in runs]


@dataclass(frozen=True)
class Capacity:
    """Print how long the paper's grid takes on so many machines."""

    def run(self, command: str) -> bool:
        """Print the table as Markdown."""
        lines = []
        for count, name in ((6, "all six"), (4, "without CrossQ and TQC")):
            for seeds in (1, 10):
                axes = {"algorithms": [*SPEEDS][:count], "settings": ["A", "B", "C"]}
                values = {"store": "runs", **axes, "seeds": list(range(seeds))}
                jobs = jobs_of(runs_of(GridSpec.model_validate(values)))
                hours = sum(seconds for _, _, seconds in jobs) / 3600
                times = (duration(makespan(jobs, CORES * machines)) for machines in MACHINES)
                label = f"{name}, {seeds} seed{'' if seeds == 1 else 's'}"
                lines.append((label, str(len(jobs)), f"{hours:,.0f}", *times))
        headings = ("grid", "runs", "core hours", *(f"on {n}" for n in MACHINES))
        print(TextTable(CAPTION, headings, tuple(lines)).markdown())
        return True
