"""The benchmark of speed: every row in one run."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import ClassVar

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from baselines.compare.text_table import TextTable
from benchmarks.report import Advance, Benchmark, Findings, Measurement, describe_machine
from benchmarks.speed.adapters import FIELD, measure_pettingzoo, measure_sb3, measure_torchrl
from benchmarks.speed.parts import PARTS, REWARDS, part_cases
from benchmarks.speed.peers import plain_case, vmas_cases
from benchmarks.speed.sizes import SIZES, Curve, curves_table, measure_sizes
from benchmarks.speed.timing import Budget, cpu_backend, engine_case, interleaved, random_case
from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names
from mbn_marl.files import replacing
from mbn_marl.render import style

WIDE_RANGE = 30.0  # a curve that grows by more than this is drawn on logarithmic axes
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
    budget: ClassVar[Budget] = Budget()

    def measure(self, advance: Advance) -> Findings:
        """Measure the rates, the parts of a step and the cost against sizes."""
        budget = self.budget
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
    return [
        Measurement("first call on a machine (compiles)", first, "s", 20.0, False),
        Measurement("later starts (cached)", later, "s", 2.0, False, "median of 3"),
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
    step, rates = timings["one field, some"], 1.0 / timings.median()
    rows = [
        Measurement(f"{name}, {sizes[size]:,} worlds", rates[case] / MILLION, RATE, target)
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
        best = rates[[case.name for case in vmas]].idxmax()
        ratio = (timings[best] / step).median()
        note = f"its best: {best.partition(', ')[2]}, {rates[best] / MILLION:.2f} {RATE}"
    share = 100 / (step / timings[check.name]).median()
    times = (timings[plain.name] / step).median()
    of_loop = f"the loop: {rates[plain.name]:,.0f} env-steps/s"
    rows += [
        Measurement("BatchEngine.step against the plain loop", times, "x", 1000.0, note=of_loop),
        Measurement("BatchEngine.step against VMAS simple_spread", ratio, "x", 5.0, note=note),
        Measurement("check of the actions (NaN, shape), of a step", share, "%", 3.0, False),
    ]
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
