"""The benchmark of speed: every row in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import ClassVar

from benchmarks.report import Advance, Benchmark, Findings, Measurement
from benchmarks.speed.adapters import measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.speed.engine import measure_engine, parts_table
from benchmarks.speed.figure import write_figure
from benchmarks.speed.sizes import SIZES, curves_table, measure_sizes
from benchmarks.speed.timing import Budget

FIRST_STEP = """
import numpy as np
from mbn_marl import BatchEngine
engine = BatchEngine("field_01", 4096)
engine.reset()
engine.step(np.zeros((4096, 3, 2), np.float32))
"""


@dataclass(frozen=True)
class Speed(Benchmark):
    """Measure the engine and its adapters against the plain loop and the peers installed."""

    name: ClassVar[str] = "speed"
    stages: ClassVar[int] = 5 + len(SIZES)

    def measure(self, advance: Advance) -> Findings:
        """Measure everything."""
        return measure_speed(Budget(), advance)


def measure_speed(budget: Budget, advance: Advance) -> Findings:
    """Measure the rates, the parts of a step and the cost against sizes."""
    startup = measure_startup() if budget.startup else []
    advance()
    rows, parts = measure_engine(budget)
    advance()
    for measure in (measure_pettingzoo, measure_torchrl, measure_sb3):
        rows += measure(budget)
        advance()
    curves = measure_sizes(budget, advance)
    return Findings(
        "3 robots, 6 ROIs, field_01, random actions, float32",
        rows + startup,
        tables=(parts_table(parts), curves_table(curves)),
        remarks=[f"{curve.quantity}: {curve.growth}" for curve in curves],
        details={
            "parts": [{"name": name, "nanoseconds": cost} for name, cost in parts.items()],
            "curves": [asdict(curve) for curve in curves],
        },
        draw=lambda path: write_figure(rows, parts, curves, path),
    )


def measure_startup() -> list[Measurement]:
    """Measure the seconds from starting Python to the end of the first step."""
    with tempfile.TemporaryDirectory() as cache:
        first = _seconds(cache)
        later = sorted(_seconds(cache) for _ in range(3))[1]
    note = "a fresh process"
    return [
        Measurement("first call on a machine (compiles)", first, "s", 20.0, False, note),
        Measurement("later starts (cached)", later, "s", 2.0, False, f"{note}, median of 3"),
    ]


def _seconds(cache: str) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    start = perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_STEP], env=environment, check=True)
    return perf_counter() - start
