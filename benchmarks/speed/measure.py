"""The benchmark of speed: every row in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from itertools import chain
from time import perf_counter
from typing import Any, ClassVar

import torch

from benchmarks.report import Benchmark, Findings, Measurement, measurement_table
from benchmarks.speed.adapters import FIELD, measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.speed.peers import plain_case, vmas_cases
from benchmarks.speed.timing import Budget, engine_case, interleaved
from mbn_marl import BatchEngine, FieldSampler
from mbn_marl.field import catalogue_names
from mbn_marl.field.generator.layout import FAMILIES

MILLION, RATE = 1e6, "M env-steps/s"
SCENARIOS = "simple_spread", "navigation"
"""The tasks of VMAS that are measured; the second is like ours."""
MIXED = FieldSampler(FAMILIES, robots=(2, 7), rois=(3, 10), size=(160, 420), seed=1)
FIRST_STEP = """
from mbn_marl import parallel_env
env = parallel_env("field_03")
env.reset()
env.step(dict.fromkeys(env.agents, (0.0, 0.0)))
"""


@dataclass(frozen=True)
class Speed(Benchmark):
    """Measure the engine and its adapters against the plain loop and the peers installed."""

    name: ClassVar[str] = "speed"
    budget: ClassVar[Budget] = Budget()

    def measure(self) -> Findings:
        """Measure the engine, its adapters, and the start of a process."""
        torch.set_num_threads(1)  # an engine with several threads would undo it
        startup = measure_startup() if self.budget.startup else []
        parts = (measure_engine, measure_pettingzoo, measure_torchrl, measure_sb3)
        rows = [*chain.from_iterable(part(self.budget) for part in parts), *startup]
        title = "CPU time of one thread; 3 robots, 6 ROIs, field_01, random actions, float32"
        return Findings({title: measurement_table(rows)}, {"rows": [row.to_json() for row in rows]})


def measure_startup() -> list[Measurement]:
    """Measure a new process up to its first PettingZoo step: without a cache, and with one."""
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        for name, target in (("first call on a machine (compiles)", 6.0), ("later starts", 0.6)):
            wall, before = perf_counter(), os.times()
            subprocess.run([sys.executable, "-c", FIRST_STEP], env=environment, check=True)
            wall, after = perf_counter() - wall, os.times()
            used = sum(after[2:4]) - sum(before[2:4])  # by ended children
            rows.append(Measurement(name, used, "s", target, False, f"by the clock {wall:.3g} s"))
    return rows


def measure_engine(budget: Budget) -> list[Measurement]:
    """Measure ``BatchEngine`` on field_01.

    All cases, the plain loop and VMAS (where installed) take turns.
    """
    some, many = budget.worlds, budget.many_worlds
    mixed = "drawn fields of all families, 2 to 7 robots, 3 to 10 ROIs"
    batches: dict[str, tuple[Any, int, float | None]] = {
        f"BatchEngine.step, {some:,} worlds": (FIELD, some, 11.0),
        f"BatchEngine.step, {many:,} worlds": (FIELD, many, 7.5),
        f"the ten fields in one batch, {some:,} worlds": (catalogue_names(), some, None),
        f"{mixed}, {some:,} worlds": (MIXED, some, 1.9),
    }
    cases = [
        engine_case(name, BatchEngine(fields, worlds, threads=1), budget.warm_up)
        for name, (fields, worlds, _) in batches.items()
    ]
    plain = plain_case()
    vmas = {scenario: vmas_cases(scenario) for scenario in SCENARIOS}
    every = [plain, *chain.from_iterable(vmas.values()), *cases]
    timings, walls = interleaved(every, budget)
    step, rates = timings[cases[0].name], 1 / timings.median()
    walled = 1 / walls[[*batches]].median() / MILLION
    rows = [
        Measurement(name, rates[name] / MILLION, RATE, target, note=f"by the clock {wall:.3g} M")
        for (name, (*_, target)), wall in zip(batches.items(), walled, strict=True)
    ]
    times = (timings[plain.name] / step).median()
    of_loop = f"the loop: {rates[plain.name]:,.0f} env-steps/s"
    name = "BatchEngine.step against the plain loop"
    rows.append(Measurement(name, times, "x", 1000.0, note=of_loop))
    for scenario, peers in vmas.items():
        ratio, note = None, "needs vmas, in the extra bench"
        if peers:
            best = rates[[case.name for case in peers]].idxmax()
            ratio = (timings[best] / step).median()
            note = f"its best: {best.partition(', ')[2]}, {rates[best] / MILLION:.2f} {RATE}"
        name = f"BatchEngine.step against VMAS {scenario}"
        rows.append(Measurement(name, ratio, "x", 5.0, note=note))
    return rows
