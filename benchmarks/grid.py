"""The costs of many runs: the scheduler's share, and how well workers add up."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from baselines.sweep.processes import LocalEngine
from baselines.sweep.ray_cluster import RayEngine
from baselines.sweep.run import Engine, Sweep
from baselines.sweep.spec import GridSpec, runs_of
from baselines.sweep.store import open_store
from baselines.sweep.worker import TrainJob, Watch
from benchmarks.report import Advance, Benchmark, Findings, Measurement

EMPTY, CELLS = 1000, 4  # cells that train nothing, and that train
WORKERS = 2
NODE: dict[str, Any] = {
    "num_cpus": WORKERS,
    "object_store_memory": 80 * 2**20,
    "include_dashboard": False,
}


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
    what = f"{EMPTY:,} cells that train nothing; what they note in the store included"
    name = f"{engine}: per cell, {workers} at a time"
    return Measurement(name, 1000.0 * seconds / EMPTY, "ms", note=what)


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

    ray.init(**NODE, log_to_driver=False, logging_level=logging.ERROR)
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
