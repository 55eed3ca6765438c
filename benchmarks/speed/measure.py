"""The benchmark of speed: every row in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import matplotlib
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from baselines.compare.text_table import TextTable
from benchmarks.report import Advance, Benchmark, Findings, Measurement, describe_machine
from benchmarks.speed.adapters import FIELD, measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.speed.features import SAMPLERS
from benchmarks.speed.parts import PARTS, part_cases
from benchmarks.speed.peers import plain_case, vmas_cases
from benchmarks.speed.sizes import SIZES, Curve, curves_table, measure_sizes
from benchmarks.speed.timing import Budget, engine_case, interleaved
from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names
from mbn_marl.files import replacing
from mbn_marl.render import style

WIDE_RANGE = 30.0  # a curve that grows by more than this is drawn on logarithmic axes
MILLION, RATE = 1e6, "M env-steps/s"
SCENARIOS = "simple_spread", "navigation"
"""The tasks of VMAS that are measured; the second is like ours."""
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
    stages: ClassVar[int] = 5 + len(SIZES)
    budget: ClassVar[Budget] = Budget()

    def measure(self, advance: Advance) -> Findings:
        """Measure the rates, the parts of a step and the cost against sizes."""
        budget = self.budget
        torch.set_num_threads(1)  # an engine with several threads would undo it
        startup = measure_startup() if budget.startup else []
        advance()
        rows, parts = measure_engine(budget)
        advance()
        for measure in (measure_pettingzoo, measure_torchrl, measure_sb3):
            rows += measure(budget)
            advance()
        curves = measure_sizes(budget, advance)
        return Findings(
            "CPU time of one thread; 3 robots, 6 ROIs, field_01, random actions, float32",
            rows + startup,
            tables={
                "where the time of a step goes": parts_table(parts),
                "cost against sizes: ns per world-step": curves_table(curves),
            },
            remarks=[f"{curve.quantity}: {curve.growth}" for curve in curves],
            details={
                "parts": [{"name": name, "nanoseconds": cost} for name, cost in parts.items()],
                "curves": [asdict(curve) for curve in curves],
            },
            draw=lambda path: write_figure(rows, parts, curves, path),
        )


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


def measure_engine(budget: Budget) -> tuple[list[Measurement], dict[str, float]]:
    """Measure ``BatchEngine`` on field_01, and the parts of its step in ns per world-step.

    All of them, the plain loop and VMAS (where installed) take turns.
    """
    some, many = budget.worlds, budget.many_worlds
    *_, (mixed, (sampler, _)) = SAMPLERS.items()
    batches: dict[str, tuple[Any, int, float | None]] = {
        f"BatchEngine.step, {some:,} worlds": (FIELD, some, 11.0),
        f"BatchEngine.step, {many:,} worlds": (FIELD, many, 7.5),
        f"the ten fields in one batch, {some:,} worlds": (catalogue_names(), some, None),
        f"{mixed}, {some:,} worlds": (sampler, some, 1.9),
    }
    cases = [
        engine_case(name, BatchEngine(fields, worlds, threads=1), budget.warm_up)
        for name, (fields, worlds, _) in batches.items()
    ]
    plain, parts = plain_case(), part_cases(some, budget.warm_up)
    vmas = {scenario: vmas_cases(scenario) for scenario in SCENARIOS}
    every = [plain, *parts, *chain.from_iterable(vmas.values()), *cases]
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
        ratio, note = None, "needs vmas: pip install 'mbn-marl[bench]'"
        if peers:
            best = rates[[case.name for case in peers]].idxmax()
            ratio = (timings[best] / step).median()
            note = f"its best: {best.partition(', ')[2]}, {rates[best] / MILLION:.2f} {RATE}"
        name = f"BatchEngine.step against VMAS {scenario}"
        rows.append(Measurement(name, ratio, "x", 5.0, note=note))
    steps = timings[[*(case.name for case in parts), step.name]]
    costs = 1e9 * steps.sub(steps.shift(axis=1, fill_value=0.0)).median()
    return rows, dict(zip((*PARTS, "checks around the kernel"), costs.tolist(), strict=True))


def parts_table(parts: Mapping[str, float]) -> TextTable:
    """Return the parts with their shares."""
    whole = sum(parts.values())
    lines = ((name, f"{cost:.1f}", f"{cost / whole:.0%}") for name, cost in parts.items())
    return TextTable("", ("part", "ns per world-step", "share"), tuple(lines))


def write_figure(
    rows: Sequence[Measurement], parts: Mapping[str, float], curves: Sequence[Curve], path: Path
) -> None:
    """Draw rates with their targets, the parts of a step, and a panel for each curve."""
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(10.0, 6.0), layout="constrained")
        grid = figure.add_gridspec(2, 1)
        above, below = (figure.add_subfigure(grid[row]) for row in (0, 1))
        left, right = above.subplots(1, 2)
        rated = [row for row in rows if row.unit == RATE]
        rates = {",\n".join(row.name.rsplit(", ", 1)): row.value or 0.0 for row in rated}
        _draw_bars(left, rates, style.BLUE, "million env-steps/s; line: target")
        for place, row in enumerate(reversed(rated), start=1):
            if row.target is not None:
                left.plot([row.target] * 2, [place - 0.4, place + 0.4], color=style.VERMILLION)
        _draw_bars(right, parts, style.BLUISH_GREEN, "ns per world-step")
        panels = below.subplots(1, len(curves))
        for index, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
            _draw_curve(axes, curve, style.series(index))
        machine = describe_machine()
        figure.suptitle(f"{machine['processor']}, {machine['cores']} cores")
        with replacing(path) as temporary:
            figure.savefig(temporary)


def _draw_bars(axes: Axes, values: Mapping[str, float], colour: str, label: str) -> None:
    places = range(len(values), 0, -1)
    axes.barh(places, [*values.values()], 0.6, color=colour)
    axes.set_yticks(places, [*values])
    axes.set_xlabel(label)
    axes.grid(True, axis="x")


def _draw_curve(axes: Axes, curve: Curve, look: style.SeriesStyle) -> None:
    axes.plot(curve.sizes, curve.nanoseconds, color=look.colour, marker=look.marker, ms=4)
    axes.set_xscale("log", base=2)
    if max(curve.nanoseconds) > WIDE_RANGE * min(curve.nanoseconds):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    axes.set_xticks(curve.sizes)
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(curve.quantity)
    axes.set_ylabel("ns per world-step")
    axes.set_title(curve.growth, fontsize=8.0)
    axes.grid(True)
