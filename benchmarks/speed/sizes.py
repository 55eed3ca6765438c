"""Cost of a step against the number of robots, ROIs and edges, on fields made for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from baselines.compare.text_table import TextTable
from benchmarks.report import Advance
from benchmarks.speed.timing import Budget, engine_case, interleaved
from mbn_marl import BatchEngine, Field

USUAL = {"robots": 3, "ROIs": 6, "edges": 4}
SIZES = {
    "robots": (1, 2, 4, 8, 16, 32, 64),
    "ROIs": (1, 2, 4, 8, 16, 24),
    "edges": (3, 4, 8, 16, 32, 64),
}
WARM_UP = 100  # steps before, at most: 64 robots on long trails would fill the memory
CENTRE, RADIUS, APART = 500.0, 490.0, 25.0  # units


@dataclass(frozen=True)
class Curve:
    """Cost of a step against one size, the others fixed."""

    quantity: str  # "robots", "ROIs" or "edges"
    sizes: tuple[int, ...]  # ascending
    nanoseconds: tuple[float, ...]  # of CPU per world-step
    growth: str  # the fitted law


def measure_sizes(
    budget: Budget, advance: Advance, sizes: dict[str, tuple[int, ...]] = SIZES
) -> list[Curve]:
    """Measure a curve for each quantity, the others as in a field of the catalogue (``USUAL``)."""
    curves = []
    for quantity, counts in sizes.items():
        fields = [make_field(**{**USUAL, quantity: count}) for count in counts]
        engines = [BatchEngine(field, budget.sized_worlds, threads=1) for field in fields]
        warm_up = min(budget.warm_up, WARM_UP)
        pairs = zip(counts, engines, strict=True)
        cases = [engine_case(str(count), engine, warm_up) for count, engine in pairs]
        costs = tuple((1e9 * interleaved(cases, budget).cpu.median()).tolist())
        curves.append(Curve(quantity, counts, costs, _growth(quantity, counts, costs)))
        advance()
    return curves


def make_field(robots: int, ROIs: int, edges: int) -> Field:  # noqa: N803 - as in the table
    """A regular polygon around its starts, which lie on a square grid, and a circle of ROIs."""
    side = int(np.ceil(np.sqrt(robots)))
    grid = APART * (np.arange(side) - (side - 1) / 2)
    starts = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)[:robots] + CENTRE
    return Field(_circle(edges, RADIUS), _circle(ROIs, RADIUS * 0.45), starts, name="synthetic")


def _circle(count: int, radius: float) -> NDArray[np.float64]:
    """``count`` points, (count, 2), spread evenly over a circle."""
    angles = 2 * np.pi * np.arange(count) / count
    return CENTRE + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _growth(quantity: str, counts: tuple[int, ...], costs: tuple[float, ...]) -> str:
    """Fit the law that the passes follow, by least squares on relative errors."""
    laws = np.vander(counts, 3 if quantity == "robots" else 2, increasing=True)
    fitted = np.linalg.lstsq(laws / np.array(costs)[:, None], np.ones(len(counts)))[0]
    terms = [f"{fitted[0]:.3g}", f"{fitted[1]:.3g} {quantity}"]
    terms += [f"{coefficient:.3g} {quantity}^2" for coefficient in fitted[2:]]
    return f"about {' + '.join(terms)} ns"


def curves_table(curves: Sequence[Curve]) -> TextTable:
    """Return the curves side by side."""
    columns = [
        column
        for curve in curves
        for column in (map(str, curve.sizes), (f"{cost:,.0f}" for cost in curve.nanoseconds))
    ]
    headings = [word for curve in curves for word in (curve.quantity, "ns")]
    return TextTable("", tuple(headings), tuple(zip_longest(*columns, fillvalue="")), words=0)
