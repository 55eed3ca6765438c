"""The benchmark of speed: every row in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from time import perf_counter
from typing import ClassVar

from baselines.compare.text_table import TextTable
from benchmarks.report import Advance, Benchmark, Findings, Measurement
from benchmarks.speed.adapters import FIELD, measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.speed.figure import write_figure
from benchmarks.speed.parts import PARTS, REWARDS, part_cases
from benchmarks.speed.peers import plain_case, vmas_cases
from benchmarks.speed.sizes import SIZES, curves_table, measure_sizes
from benchmarks.speed.timing import Budget, cpu_backend, engine_case, interleaved, random_case
from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names

MILLION, RATE = 1e6, "M env-steps/s"
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
        tables={
            "where the time of a step goes, all threads working": parts_table(parts),
            "cost against sizes: ns per world-step, all threads working": curves_table(curves),
        },
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


def measure_engine(budget: Budget) -> tuple[list[Measurement], dict[str, float]]:
    """Measure ``BatchEngine`` on field_01, and the parts of its step in ns per world-step.

    All of them, the plain loop and VMAS (where installed) take turns. The loop, on one thread,
    comes after VMAS, whose threads keep a core busy for some time after their work is done.
    """
    sizes = {"some": budget.worlds, "many": budget.many_worlds}
    fields = {"one field": FIELD, "ten fields": list(catalogue_names())}
    vmas, plain, parts = vmas_cases(), plain_case(), part_cases(budget.worlds, budget.warm_up)
    cases = [
        engine_case(f"{field}, {size}", BatchEngine(fields[field], sizes[size]), budget.warm_up)
        for field in fields
        for size in sizes
    ]
    engine = BatchEngine(FIELD, budget.worlds)
    shape, checked = (budget.worlds, engine.n_robots, 2), cpu_backend(engine).checked_actions
    check = random_case("check", shape, checked, budget.worlds)
    timings = interleaved([plain, *cases, check, *parts, *vmas], budget)
    step, loop = timings["one field, some"], timings[plain.name]
    rows = [
        Measurement(f"{name}, {sizes[size]:,} worlds", timings[case].rate / MILLION, RATE, target)
        for name, case, size, target in (
            ("BatchEngine.step", "one field, some", "some", 12.0),
            ("BatchEngine.step", "one field, many", "many", 10.0),
            ("the ten fields in one batch", "ten fields, some", "some", 8.0),
            ("the ten fields in one batch", "ten fields, many", "many", 8.0),
            ("physics, rewards and collisions only", parts[REWARDS].name, "some", None),
        )
    ]
    ratio, note = None, "needs vmas: pip install 'mbn-marl[bench]'"
    if vmas:
        best = min((case.name for case in vmas), key=lambda name: timings[name].median)
        ratio = step.times_faster_than(timings[best])
        note = f"its best: {best.partition(', ')[2]}, {timings[best].rate / MILLION:.2f} {RATE}"
    share = 100 / timings[check.name].times_faster_than(step)
    times, of_loop = step.times_faster_than(loop), f"the loop: {loop.rate:,.0f} env-steps/s"
    rows += [
        Measurement("BatchEngine.step against the plain loop", times, "x", 1000.0, note=of_loop),
        Measurement("BatchEngine.step against VMAS simple_spread", ratio, "x", 5.0, note=note),
        Measurement("check of the actions (NaN, shape), of a step", share, "%", 3.0, False),
    ]
    steps = [*(timings[case.name] for case in parts), step]
    costs = [steps[0].median, *(after.longer_than(before) for before, after in pairwise(steps))]
    names = (*PARTS, "checks around the kernel")
    return rows, {name: 1e9 * cost for name, cost in zip(names, costs, strict=True)}


def parts_table(parts: Mapping[str, float]) -> TextTable:
    """Return the parts with their shares."""
    whole = sum(parts.values())
    lines = ((name, f"{cost:.1f}", f"{cost / whole:.0%}") for name, cost in parts.items())
    return TextTable("", ("part", "ns per world-step", "share"), tuple(lines))
