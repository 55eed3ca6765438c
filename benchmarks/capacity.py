"""How long the paper's grid takes on so many machines, from the measured speeds of single runs.

It prints the table of docs/grid.md.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from baselines.compare.text_table import TextTable
from baselines.sweep.spec import GridSpec, runs_of
from baselines.sweep.status import duration
from baselines.sweep.worker import source_of
from baselines.training.config import TrainConfig

Job = tuple[str, str | None, float]
"""A name, the name of the job to wait for if there is one, and seconds."""
SPEEDS: Mapping[str, float] = {
    "a2c": 835.0,
    "ppo": 1039.0,
    "trpo": 1084.0,
    "ars": 4229.0,
    "crossq": 10.0,
    "tqc": 50.0,
}
"""Env-steps per second of training on one core of a machine of two (Intel Xeon): harmonic means
over the runs of 1 M env-steps behind docs/results/paper.md; CrossQ and TQC, which were not run to
their end, as that page has them."""
CORES = 2  # of a machine
MACHINES = (1, 16, 256)
SEEDS = (1, 10)
CHEAP = ("a2c", "ppo", "trpo", "ars")
CAPTION = (
    f"Machines have {CORES} cores and train as many runs at a time; runs begin in the order of the "
    "grid, those under C when the one that they start from is done."
)


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
        for algorithms, name in ((tuple(SPEEDS), "all six"), (CHEAP, "without CrossQ and TQC")):
            for seeds in SEEDS:
                values = {"store": "runs", "algorithms": algorithms, "settings": ["A", "B", "C"]}
                spec = GridSpec.model_validate({**values, "seeds": list(range(seeds))})
                jobs = jobs_of(runs_of(spec))
                hours = sum(seconds for _, _, seconds in jobs) / 3600
                times = (duration(makespan(jobs, CORES * machines)) for machines in MACHINES)
                label = f"{name}, {seeds} seed{'' if seeds == 1 else 's'}"
                lines.append((label, str(len(jobs)), f"{hours:,.0f}", *times))
        headings = ("grid", "runs", "core hours", *(f"on {n}" for n in MACHINES))
        print(TextTable(CAPTION, headings, tuple(lines)).markdown())
        return True
