"""How often, how fast and how closely the planner solves the catalogue and random instances."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar

import numpy as np

from benchmarks.instances import convex_instance, winding_instance
from benchmarks.report import Advance, Benchmark, Findings, Measurement
from mbn_marl.field import Field, catalogue_names, load_field
from mbn_marl.planning import plan

CONVEX, WINDING = 100, 50  # random instances
CONVEX_LIMIT, WINDING_LIMIT = 10.0, 30.0  # seconds of processor time for each
GRACE = 2.0  # plans may take so many times as long by the clock


@dataclass(frozen=True)
class Attempt:
    """One instance."""

    name: str
    rois: int
    robots: int
    makespan: int | None  # steps of the plan, None if there is none
    bound: int  # proved, steps
    known: int | None  # the optimum that the catalogue has
    seconds: float  # of processor time

    @property
    def gap(self) -> float:
        """How far the bound lies below the makespan, as a share of it; 1 without a plan."""
        return 1.0 if self.makespan is None else 1.0 - self.bound / self.makespan


def attempt(field: Field, limit: float) -> Attempt:
    """Plan for a field, within ``limit`` seconds of processor time."""
    began = time.process_time()
    found = plan(field, time_limit=GRACE * limit)
    return Attempt(
        name=field.name,
        rois=len(field.rois),
        robots=len(field.starts),
        makespan=found.makespan,
        bound=found.makespan_lower_bound,
        known=field.optimal_makespan,
        seconds=time.process_time() - began,
    )


@dataclass(frozen=True)
class Planning(Benchmark):
    """Plan for the ten fields and for random ones, and prove how good the plans are."""

    name: ClassVar[str] = "planning"
    stages: ClassVar[int] = len(catalogue_names()) + CONVEX + WINDING

    def measure(self, advance: Advance) -> Findings:
        """Plan for every field."""
        return study_planning(advance)


def study_planning(advance: Advance, convex: int = CONVEX, winding: int = WINDING) -> Findings:
    """Plan for the catalogue, and for so many convex and winding instances."""
    plan("field_03")  # loads and compiles
    sets = {
        "catalogue": ([load_field(name) for name in catalogue_names()], CONVEX_LIMIT),
        "convex": ([convex_instance(seed) for seed in range(convex)], CONVEX_LIMIT),
        "winding": ([winding_instance(seed) for seed in range(winding)], WINDING_LIMIT),
    }
    done: dict[str, list[Attempt]] = {name: [] for name in sets}
    for name, (fields, limit) in sets.items():
        for field in fields:
            done[name].append(attempt(field, limit))
            advance()
    return Findings(
        "the planner; seconds of processor time on one core",
        target_rows(**done),
        details={name: [asdict(one) for one in all_] for name, all_ in done.items()},
    )


def target_rows(
    catalogue: Sequence[Attempt], convex: Sequence[Attempt], winding: Sequence[Attempt]
) -> list[Measurement]:
    """Return the targets, with what was reached."""
    proved = sum(one.makespan == one.bound == one.known for one in catalogue)
    optimal = sum(one.makespan == one.bound and one.seconds <= CONVEX_LIMIT for one in convex)
    planned = sum(one.makespan is not None and one.seconds <= WINDING_LIMIT for one in winding)
    wrong = sum(
        length is not None and length < one.bound
        for one in (*catalogue, *convex, *winding)
        for length in (one.makespan, one.known)
    )
    c, w = len(convex), len(winding)
    slowest = [max(one.seconds for one in each) for each in (catalogue, convex, winding)]
    median = float(np.median([one.seconds for one in convex]))
    gap = 100.0 * float(np.median([one.gap for one in winding]))
    ten, some, bent = "the ten fields", "random convex fields", "winding fields"
    return [
        Measurement(f"{ten}: proved, equal to the catalogue", proved, "", len(catalogue)),
        Measurement(f"{ten}: slowest", slowest[0], "s", 1.0, at_least=False),
        Measurement(f"{some}: proved within 10 s", optimal, f"of {c}", 0.95 * c),
        Measurement(f"{some}: median", median, "s"),
        Measurement(f"{some}: slowest", slowest[1], "s"),
        Measurement(f"{bent}: a verified plan within 30 s", planned, f"of {w}", 0.96 * w),
        Measurement(f"{bent}: median gap", gap, "%", 10.0, at_least=False),
        Measurement(f"{bent}: proved optimal", sum(one.gap == 0.0 for one in winding), ""),
        Measurement(f"{bent}: slowest", slowest[2], "s"),
        Measurement("plans or optima below their bound", wrong, "", 0.0, at_least=False),
    ]
