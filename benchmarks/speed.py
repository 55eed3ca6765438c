"""The benchmark of speed: every row in one run."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

from benchmarks.adapters import measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.engine import measure_engine
from benchmarks.load import OtherLoad
from benchmarks.machine import describe_machine
from benchmarks.results import Result, Row
from benchmarks.sizes import SIZES, measure_sizes
from benchmarks.startup import measure_startup
from benchmarks.timing import Budget

STAGES = 5 + len(SIZES)
"""How often ``measure_speed`` reports."""


def measure_speed(command: str, budget: Budget, report: Callable[[], object]) -> Result:
    """Measure everything.

    Args:
        command: the exact command, for the record.
        budget: how much to measure.
        report: called after each of ``STAGES`` stages.
    """
    start, others = perf_counter(), OtherLoad()
    rows: list[Row] = []
    startup = measure_startup() if budget.startup else []
    report()
    engine_rows, parts = measure_engine(budget)
    rows += engine_rows
    report()
    for measure in (measure_pettingzoo, measure_torchrl, measure_sb3):
        rows += measure(budget)
        report()
    curves = measure_sizes(budget, report)
    return Result(
        command=command,
        machine=describe_machine(),
        seconds=perf_counter() - start,
        other_cores=others.cores(),
        rows=rows + startup,
        parts=parts,
        curves=curves,
    )
