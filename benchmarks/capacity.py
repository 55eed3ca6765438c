"""How long the paper's grid takes on so many machines, from the measured speeds of single runs.

It prints the table of docs/grid.md.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from baselines.compare.text_table import TextTable
from baselines.sweep.spec import GridSpec, runs_of
from baselines.sweep.status import duration
from baselines.sweep.worker import source_of
from baselines.training.config import TrainConfig

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
CORES = 2
"""Of a machine."""
MACHINES = (1, 16, 256)
SEEDS = (1, 10)
CHEAP = ("a2c", "ppo", "trpo", "ars")
CAPTION = (
    f"Machines have {CORES} cores and train as many runs at a time; runs begin in the order of the "
    "grid, those under C when the one that they start from is done."
)


def makespan(runs: Sequence[TrainConfig], workers: int) -> float:
    """Return the seconds that ``workers`` take for ``runs``, in the order of an engine."""
    waiting, done = list(runs), set[str | None]([None])
    running: list[tuple[float, str]] = []
    now = 0.0
    while waiting or running:
        ready = (place for place, run in enumerate(waiting) if source_of(run) in done)
        place = next(ready, None) if len(running) < workers else None
        if place is None:
            now, name = heapq.heappop(running)
            done.add(name)
        else:
            run = waiting.pop(place)
            seconds = run.steps / SPEEDS[run.algorithm]
            heapq.heappush(running, (now + seconds, run.name))
    return now


def capacity() -> TextTable:
    """Return the table."""
    lines = []
    for algorithms, name in ((tuple(SPEEDS), "all six"), (CHEAP, "without CrossQ and TQC")):
        for seeds in SEEDS:
            values = {"store": "runs", "algorithms": algorithms, "settings": ["A", "B", "C"]}
            runs = runs_of(GridSpec.model_validate({**values, "seeds": list(range(seeds))}))
            hours = sum(run.steps / SPEEDS[run.algorithm] for run in runs) / 3600
            times = (duration(makespan(runs, CORES * machines)) for machines in MACHINES)
            label = f"{name}, {seeds} seed{'' if seeds == 1 else 's'}"
            lines.append((label, str(len(runs)), f"{hours:,.0f}", *times))
    headings = ("grid", "runs", "core hours", *(f"on {n}" for n in MACHINES))
    return TextTable(CAPTION, headings, tuple(lines))


@dataclass(frozen=True)
class Capacity:
    """Print how long the paper's grid takes on so many machines."""

    def run(self, command: str) -> bool:
        """Print the table as Markdown."""
        print(capacity().markdown())
        return True
