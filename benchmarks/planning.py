"""How often, how fast and how closely the planner solves the catalogue and random instances."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import ClassVar

import numpy as np
import shapely
from numpy.typing import NDArray

from benchmarks.report import Advance, Benchmark, Findings, Measurement
from mbn_marl.field import Field, catalogue_names, load_field
from mbn_marl.planning import plan

CONVEX, WINDING = 100, 50  # random instances
CONVEX_LIMIT, WINDING_LIMIT = 10.0, 30.0  # seconds of processor time for each
GRACE = 2.0  # plans may take so many times as long by the clock
APART = 12.0  # least distance between starts, in units
MOST_EACH = 5  # ROIs for each robot, at most


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

    @classmethod
    def of(cls, field: Field, limit: float) -> Attempt:
        """Plan for a field, within ``limit`` seconds of processor time."""
        began = time.process_time()
        found = plan(field, time_limit=GRACE * limit)
        seconds, steps = time.process_time() - began, (found.makespan, found.makespan_lower_bound)
        size = len(field.rois), len(field.starts)
        return cls(field.name, *size, *steps, field.optimal_makespan, seconds)


@dataclass(frozen=True)
class Planning(Benchmark):
    """Plan for the ten fields and for random ones, and prove how good the plans are."""

    name: ClassVar[str] = "planning"
    stages: ClassVar[int] = len(catalogue_names()) + CONVEX + WINDING

    def measure(self, advance: Advance) -> Findings:
        """Plan for every field."""
        plan("field_03")  # loads and compiles
        sets = {
            "catalogue": ([load_field(name) for name in catalogue_names()], CONVEX_LIMIT),
            "convex": ([convex_instance(seed) for seed in range(CONVEX)], CONVEX_LIMIT),
            "winding": ([winding_instance(seed) for seed in range(WINDING)], WINDING_LIMIT),
        }
        done: dict[str, list[Attempt]] = {name: [] for name in sets}
        for name, (fields, limit) in sets.items():
            for field in fields:
                done[name].append(Attempt.of(field, limit))
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


def convex_instance(seed: int) -> Field:
    """A convex field 100 to 400 units wide, with 4 to 10 ROIs and 2 to 7 robots."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(4, 11))
    n = int(rng.integers(max(2, math.ceil(m / MOST_EACH)), 8))
    while True:
        size = rng.uniform(120.0, 400.0, 2)
        corners = rng.uniform(0.0, 1.0, (int(rng.integers(5, 14)), 2)) * size
        outline = shapely.MultiPoint(corners + rng.uniform(100.0, 500.0, 2)).convex_hull
        if outline.area > 8000.0:
            return _field(rng, outline, m, n, f"convex_{seed}")


def winding_instance(seed: int) -> Field:
    """A star-shaped field, not convex or with holes, with 4 to 8 ROIs and 2 to 5 robots."""
    rng = np.random.default_rng(10_000 + seed)
    m, n = int(rng.integers(4, 9)), int(rng.integers(2, 6))
    while True:
        corners = int(rng.integers(5, 12))
        area = _ring(rng, rng.uniform(350.0, 650.0, 2), corners, 70.0, 220.0)
        for _ in range(int(rng.integers(0, 4))):
            room = area.buffer(-30.0)
            if not room.is_empty:
                centre = np.array(_points(rng, room, 1, 0.0)[0])
                hole = _ring(rng, centre, int(rng.integers(3, 6)), 6.0, 24.0)
                if area.contains_properly(hole):
                    area = area.difference(hole)
        if area.interiors or area.area < 0.98 * area.convex_hull.area:
            return _field(rng, area, m, n, f"winding_{seed}")


def _field(rng: np.random.Generator, area: shapely.Polygon, m: int, n: int, name: str) -> Field:
    inner = area.buffer(-1.0)
    return Field(
        np.array(area.exterior.coords)[:-1],
        rois=_points(rng, inner, m, 5.0),
        starts=_points(rng, inner, n, APART),
        holes=[np.array(hole.coords)[:-1] for hole in area.interiors],
        name=name,
    )


def _ring(
    rng: np.random.Generator, centre: NDArray[np.float64], corners: int, low: float, high: float
) -> shapely.Polygon:
    """Corners at rising angles and random distances from the centre."""
    angles = (np.arange(corners) + rng.uniform(0.0, 0.45, corners)) * (2.0 * math.pi / corners)
    radii = rng.uniform(low, high, corners)
    offsets = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return shapely.Polygon(centre + offsets)


def _points(
    rng: np.random.Generator, area: shapely.Geometry, count: int, apart: float
) -> list[tuple[float, float]]:
    """Random points of an area, at least so far apart."""
    low_x, low_y, high_x, high_y = area.bounds
    points: list[tuple[float, float]] = []
    while len(points) < count:
        point = float(rng.uniform(low_x, high_x)), float(rng.uniform(low_y, high_y))
        free = all(math.dist(point, other) >= apart for other in points)
        if free and shapely.intersects_xy(area, *point):
            points.append(point)
    return points
