"""Instances for the planner's tests, and an independent brute-force answer for small ones."""

import itertools
import math
from typing import Any

import numpy as np
import shapely
from scipy.optimize import linprog

from mbn_marl.field import Field
from tests.support.worlds import points_within, ring

SQUARE = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]

BASE, BAY = [(100, 100), (400, 100), (400, 400)], [(300, 400), (300, 150), (200, 150), (200, 400)]
U_SHAPE = Field(
    [*BASE, *BAY, (100, 400)],
    rois=[(350, 380), (150, 380), (250, 110)],
    starts=[(120, 390), (140, 390)],
)


def small_field(seed: int, n: int = 2, m: int = 2, **kinds: Any) -> Field:
    rng = np.random.default_rng(seed)
    outline = shapely.MultiPoint(rng.uniform(0, 1, (8, 2)) * 70.0 + 300.0).convex_hull
    inner = outline.buffer(-0.5)
    return Field(
        np.array(outline.exterior.coords)[:-1],
        rois=points_within(rng, inner, m, 15.0),
        starts=points_within(rng, inner, n, 11.0),
        **kinds,
    )


def star_field(seed: int) -> Field:
    rng = np.random.default_rng(seed)
    outline = ring(rng, np.array([500.0, 500.0]), 8, 80.0, 200.0)
    hole = ring(rng, np.array([500.0, 500.0]), 4, 10.0, 25.0)
    inner = shapely.Polygon(outline, [hole]).buffer(-2.0)
    return Field(
        outline,
        rois=points_within(rng, inner, 4, 20.0),
        starts=points_within(rng, inner, 3, 15.0),
        holes=[hole],
    )


Pair = tuple[float, float]


def brute_force(
    field: Field, radius: float, wind: Pair = (0.0, 0.0), velocity: Pair = (0.0, 0.0)
) -> int:
    """The least makespan without collisions: every partition, order and visit time."""
    robots, rois = range(len(field.starts)), range(len(field.rois))
    for steps in range(1, 200):
        reach = {
            (i, chosen): any(
                _feasible(field, i, order, times, steps, radius, wind, velocity)
                for order in itertools.permutations(chosen)
                for times in itertools.combinations_with_replacement(range(1, steps + 1), size)
            )
            for i in robots
            for size in range(len(rois) + 1)
            for chosen in itertools.combinations(rois, size)
        }
        for owners in itertools.product(robots, repeat=len(rois)):
            shares = [tuple(j for j in rois if owners[j] == i) for i in robots]
            may = all(field.mine[owners, rois])
            if may and all(reach[i, share] for i, share in enumerate(shares)):
                return steps
    raise AssertionError("not within 200 steps")


def _feasible(
    field: Field,
    i: int,
    order: tuple[int, ...],
    times: tuple[int, ...],
    steps: int,
    radius: float,
    wind: Pair,
    velocity: Pair,
) -> bool:
    once = np.tril(np.ones((steps, steps)))
    pushes = np.arange(1, steps + 1)
    pushed = once * 0.5
    drift = [v + w * pushes for v, w in zip(velocity, wind, strict=True)]
    position = [once @ pushed] * 2
    carried = [start + once @ d for start, d in zip(field.starts[i], drift, strict=True)]
    rows = []
    limits = []

    def add(step: int, x: float, y: float, limit: float) -> None:
        rows.append(np.concatenate([x * position[0][step - 1], y * position[1][step - 1]]))
        limits.append(limit - x * carried[0][step - 1] - y * carried[1][step - 1])

    zero = np.zeros((steps, steps))
    for axis in (0, 1):
        blocks = [zero, zero]
        blocks[axis] = pushed
        rows += [*np.hstack(blocks), *-np.hstack(blocks)]
        limits += [*(5.0 - drift[axis]), *(5.0 + drift[axis])]
    corners = np.array(shapely.geometry.polygon.orient(field.polygon).exterior.coords)
    for a, b in itertools.pairwise(corners):
        x, y = b[1] - a[1], a[0] - b[0]
        for step in range(1, steps + 1):
            add(step, x, y, x * a[0] + y * a[1])
    for j, step in zip(order, times, strict=True):
        for k in range(48):
            angle = (2 * k + 1) * math.pi / 48
            x, y = math.cos(angle), math.sin(angle)
            inner = radius * math.cos(math.pi / 48)
            add(step, x, y, x * field.rois[j, 0] + y * field.rois[j, 1] + inner)
    result = linprog(
        np.zeros(2 * steps), A_ub=np.array(rows), b_ub=limits, bounds=(-1.0, 1.0), method="highs"
    )
    return result.status == 0
