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
from typing import Any, ClassVar, NamedTuple

from baselines.sweep.processes import LocalEngine
from baselines.sweep.ray_cluster import RayEngine
from baselines.sweep.run import Engine, Sweep
from baselines.sweep.spec import GridSpec, runs_of
from baselines.sweep.store import open_store
from baselines.sweep.worker import TrainJob, Watch
from benchmarks.report import Advance, Benchmark, Findings, Measurement

EMPTY = 1000
"""Cells that train nothing."""
STEPS = 20_000
"""Env-steps of each of the cells that train."""
CELLS = 4
"""Cells that train."""
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

    steps: int = STEPS
    """Env-steps of each of the runs that train."""

    def measure(self, advance: Advance) -> Findings:
        """Measure both engines."""
        return Findings("the engines of mbn grid", measure_grid(self.steps, advance))


def measure_grid(steps: int, progress: Advance) -> list[Measurement]:
    """Measure both engines, with ``steps`` env-steps in each of the cells that train."""
    rows = []
    for workers in (1, WORKERS):
        seconds = _empty(LocalEngine(workers, retries=1), workers)
        rows.append(_overhead("local", f"{workers} at a time", seconds))
        progress()
    rows.append(_on_ray())
    progress()
    one, many = (_train(steps, workers, progress) for workers in (1, WORKERS))
    of_cells = f"{CELLS} runs of A2C, {steps:,} env-steps each, start of the processes included"
    rows += [
        Measurement("local: all cells, 1 worker", one.wall, "s", note=of_cells),
        Measurement(f"local: all cells, {WORKERS} workers", many.wall, "s", note=of_cells),
        Measurement(
            f"local: efficiency, {WORKERS} workers",
            100.0 * one.wall / (WORKERS * many.wall),
            "%",
            note=f"time with one over {WORKERS} times that with {WORKERS}; 100 with one",
        ),
        Measurement(
            f"local: the same by processor time, {WORKERS} workers",
            100.0 * one.processor / many.processor,
            "%",
            note="what the cells cost beside each other; other processes hardly bend it",
        ),
    ]
    return rows


def _overhead(engine: str, how: str, seconds: float) -> Measurement:
    what = f"{EMPTY:,} cells that train nothing; what they note in the store included"
    return Measurement(f"{engine}: per cell, {how}", 1000.0 * seconds / EMPTY, "ms", note=what)


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
    """Return the seconds for all empty runs, once the processes are there."""
    with tempfile.TemporaryDirectory() as folder:
        runs = runs_of(_spec(Path(folder), seeds=range(EMPTY), steps=1))
        jobs = [TrainJob(run, folder, noted=True) for run in runs]
        ends: list[float] = []
        engine.run(claim_and_leave, jobs, print, lambda job, end: ends.append(perf_counter()))
        return _after_start(ends, workers)


def _after_start(ends: Sequence[float], workers: int) -> float:
    """Seconds for all jobs, from when every worker has ended one."""
    return (ends[-1] - ends[workers - 1]) * len(ends) / (len(ends) - workers)


def _on_ray() -> Measurement:
    if find_spec("ray") is None:
        return Measurement("ray: per cell", None, "ms", note="not installed")
    import ray

    ray.init(**NODE, log_to_driver=False, logging_level=logging.ERROR)
    try:
        return _overhead("ray", f"{WORKERS} at a time", _empty(RayEngine(), WORKERS))
    finally:
        ray.shutdown()


class Seconds(NamedTuple):
    """The time of something by the clock, and of the processors."""

    wall: float
    processor: float


def _train(steps: int, workers: int, progress: Advance) -> Seconds:
    """Train the cells of a grid."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = Sweep.of(_spec(Path(folder), seeds=range(CELLS), steps=steps))
        wall, processor = perf_counter(), _of_children()
        sweep.train(LocalEngine(workers, retries=1))
        taken = Seconds(perf_counter() - wall, _of_children() - processor)
    progress()
    return taken


def _of_children() -> float:
    """Seconds that processors have worked for processes of this one that have ended."""
    return sum(os.times()[2:4])
