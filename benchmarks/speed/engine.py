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
MILLION = 1e6
STEP, LARGE, FIELDS, LARGE_FIELDS, CHECK = "step", "large", "fields", "large fields", "check"


def measure_engine(budget: Budget) -> tuple[list[Measurement], dict[str, float]]:
    """Measure ``BatchEngine`` on field_01, and the parts of its step in ns per world-step.

    All of them, the plain loop and VMAS (where installed) take turns. The loop, on one thread,
    comes after VMAS, whose threads keep a core busy for some time after their work is done.
    """
    vmas = vmas_cases()
    plain = plain_case()
    parts = part_cases(budget.worlds, budget.warm_up)
    cases = [plain, *_engine_cases(budget), *parts, *vmas]
    timings = interleaved(cases, budget)
    rows = [
        *_rate_rows(timings, budget),
        _plain_row(timings, plain.name),
        _vmas_row(timings, [case.name for case in vmas]),
        _check_row(timings),
    ]
    return rows, _parts(timings)


def _engine_cases(budget: Budget) -> list[Case]:
    fields = list(catalogue_names())

    def case(name: str, field: str | list[str], worlds: int) -> Case:
        return engine_case(name, BatchEngine(field, worlds), budget.warm_up)

    return [
        case(STEP, FIELD, budget.worlds),
        case(LARGE, FIELD, budget.many_worlds),
        case(FIELDS, fields, budget.worlds),
        case(LARGE_FIELDS, fields, budget.many_worlds),
        _check_case(budget.worlds),
    ]


def _check_case(worlds: int) -> Case:
    """The check of actions in ``step`` (shape, type, NaN), in seconds per env-step."""
    engine = BatchEngine(FIELD, worlds)
    backend = cpu_backend(engine)
    shape = (worlds, engine.n_robots, 2)
    return RandomSteps(shape, backend.checked_actions).case(CHECK, worlds)


def _rate_rows(timings: dict[str, Timing], budget: Budget) -> list[Measurement]:
    some, many = f"{budget.worlds:,} worlds", f"{budget.many_worlds:,} worlds"
    unit = "M env-steps/s"

    def row(name: str, case: str, target: float | None, note: str = "") -> Measurement:
        return Measurement(name, timings[case].rate / MILLION, unit, target, note=note)

    note = "the rest of a step is in the second table"
    return [
        row(f"BatchEngine.step, {some}", STEP, 12.0),
        row(f"BatchEngine.step, {many}", LARGE, 10.0),
        row(f"the ten fields in one batch, {some}", FIELDS, 8.0),
        row(f"the ten fields in one batch, {many}", LARGE_FIELDS, 8.0),
        row(f"physics, rewards and collisions only, {some}", _up_to(REWARDS), None, note),
    ]


def _plain_row(timings: dict[str, Timing], plain: str) -> Measurement:
    name = "BatchEngine.step against the plain loop"
    loop = timings[plain]
    note = f"the loop: {loop.rate:,.0f} env-steps/s"
    return Measurement(name, timings[STEP].times_faster_than(loop), "x", 1000.0, note=note)


def _vmas_row(timings: dict[str, Timing], vmas: list[str]) -> Measurement:
    name = "BatchEngine.step against VMAS simple_spread"
    if not vmas:
        return Measurement(name, None, "x", 5.0, note="needs vmas: pip install 'mbn-marl[bench]'")
    best = min(vmas, key=lambda case: timings[case].median)
    note = f"its best: {best.partition(', ')[2]}, {timings[best].rate / MILLION:.2f} M env-steps/s"
    return Measurement(name, timings[STEP].times_faster_than(timings[best]), "x", 5.0, note=note)


def _check_row(timings: dict[str, Timing]) -> Measurement:
    share = 100 / timings[CHECK].times_faster_than(timings[STEP])
    return Measurement(
        "check of the actions (NaN, shape), of a step", share, "%", 3.0, at_least=False
    )


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
