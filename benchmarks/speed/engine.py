"""The engine's own rows: its rate, against the plain loop and VMAS, and where its time goes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

from rich.table import Table

from benchmarks.report import Measurement, table
from benchmarks.speed.parts import PARTS, REWARDS, part_cases
from benchmarks.speed.peers import plain_case, vmas_cases
from benchmarks.speed.timing import (
    Budget,
    Case,
    RandomSteps,
    Timing,
    cpu_backend,
    engine_case,
    interleaved,
)
from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names

FIELD = "field_01"
MILLION, RATE = 1e6, "M env-steps/s"
STEP, LARGE, FIELDS, LARGE_FIELDS, CHECK = "step", "large", "fields", "large fields", "check"


def measure_engine(budget: Budget) -> tuple[list[Measurement], dict[str, float]]:
    """Measure ``BatchEngine`` on field_01, and the parts of its step in ns per world-step.

    All of them, the plain loop and VMAS (where installed) take turns. The loop, on one thread,
    comes after VMAS, whose threads keep a core busy for some time after their work is done.
    """
    vmas, plain, all_fields = vmas_cases(), plain_case(), list(catalogue_names())
    parts = part_cases(budget.worlds, budget.warm_up)
    cases = [
        engine_case(name, BatchEngine(field, worlds), budget.warm_up)
        for name, field, worlds in (
            (STEP, FIELD, budget.worlds),
            (LARGE, FIELD, budget.many_worlds),
            (FIELDS, all_fields, budget.worlds),
            (LARGE_FIELDS, all_fields, budget.many_worlds),
        )
    ]
    timings = interleaved([plain, *cases, _check_case(budget.worlds), *parts, *vmas], budget)
    rows = [*_rates(timings, budget), *_ratios(timings, plain.name, [case.name for case in vmas])]
    return rows, _parts(timings)


def _check_case(worlds: int) -> Case:
    """The check of actions in ``step`` (shape, type, NaN), in seconds per env-step."""
    engine = BatchEngine(FIELD, worlds)
    shape = (worlds, engine.n_robots, 2)
    return RandomSteps(shape, cpu_backend(engine).checked_actions).case(CHECK, worlds)


def _rates(timings: dict[str, Timing], budget: Budget) -> list[Measurement]:
    some, many = f"{budget.worlds:,} worlds", f"{budget.many_worlds:,} worlds"
    note = "the rest of a step is in the second table"
    return [
        Measurement(name, timings[case].rate / MILLION, RATE, target, note=note)
        for name, case, target, note in (
            (f"BatchEngine.step, {some}", STEP, 12.0, ""),
            (f"BatchEngine.step, {many}", LARGE, 10.0, ""),
            (f"the ten fields in one batch, {some}", FIELDS, 8.0, ""),
            (f"the ten fields in one batch, {many}", LARGE_FIELDS, 8.0, ""),
            (f"physics, rewards and collisions only, {some}", _up_to(REWARDS), None, note),
        )
    ]


def _ratios(timings: dict[str, Timing], plain: str, vmas: list[str]) -> list[Measurement]:
    step, loop = timings[STEP], timings[plain]
    ratio, note = None, "needs vmas: pip install 'mbn-marl[bench]'"
    if vmas:
        best = min(vmas, key=lambda case: timings[case].median)
        ratio = step.times_faster_than(timings[best])
        note = f"its best: {best.partition(', ')[2]}, {timings[best].rate / MILLION:.2f} {RATE}"
    share = 100 / timings[CHECK].times_faster_than(step)
    times, of_loop = step.times_faster_than(loop), f"the loop: {loop.rate:,.0f} env-steps/s"
    return [
        Measurement("BatchEngine.step against the plain loop", times, "x", 1000.0, note=of_loop),
        Measurement("BatchEngine.step against VMAS simple_spread", ratio, "x", 5.0, note=note),
        Measurement("check of the actions (NaN, shape), of a step", share, "%", 3.0, False),
    ]


def _parts(timings: dict[str, Timing]) -> dict[str, float]:
    """Return the ns that each part adds; the rest is the checks and passing worlds to threads."""
    steps = [timings[_up_to(last)] for last in range(len(PARTS))]
    costs = [steps[0].median]
    costs += [after.longer_than(before) for before, after in pairwise(steps)]
    costs.append(timings[STEP].longer_than(steps[-1]))
    names = (*PARTS, "checks around the kernel")
    return {name: 1e9 * cost for name, cost in zip(names, costs, strict=True)}


def parts_table(parts: Mapping[str, float]) -> Table:
    """Return the parts with their shares."""
    whole = sum(parts.values())
    lines = [(name, f"{cost:.1f}", f"{cost / whole:.0%}") for name, cost in parts.items()]
    title = "where the time of a step goes, all threads working"
    return table(title, ("part", "ns per world-step", "share"), lines)


def _up_to(last: int) -> str:
    return f"up to {PARTS[last]}"
