"""Cost of a step against the number of robots, ROIs and edges, on fields made for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from benchmarks.report import Advance, table
from benchmarks.speed.timing import Budget, engine_case, interleaved
from mbn_marl import BatchEngine, Field

USUAL = {"robots": 3, "ROIs": 6, "edges": 4}
SIZES = {
    "robots": (1, 2, 4, 8, 16, 32, 64),
    "ROIs": (1, 2, 4, 8, 16, 24),
    "edges": (3, 4, 8, 16, 32, 64),
}
WARM_UP = 100
"""Steps before timing, at most: 64 robots on long trails would fill the memory."""
CENTRE, RADIUS = 500.0, 490.0
APART = 25.0


@dataclass(frozen=True)
class Curve:
    """Cost of a step against one size, the others fixed.

    Attributes:
        quantity: ``"robots"``, ``"ROIs"`` or ``"edges"``.
        sizes: the sizes measured, ascending.
        nanoseconds: elapsed time of a world-step at each of them, all threads working.
        growth: the fitted law, as a sentence.
    """

    quantity: str
    sizes: tuple[int, ...]
    nanoseconds: tuple[float, ...]
    growth: str


def measure_sizes(
    budget: Budget, advance: Advance, sizes: dict[str, tuple[int, ...]] = SIZES
) -> list[Curve]:
    """Measure a curve for each quantity, the others as in a field of the catalogue (``USUAL``)."""
    curves = []
    for quantity, counts in sizes.items():
        cases = [
            engine_case(
                str(count),
                BatchEngine(make_field(**{**USUAL, quantity: count}), budget.sized_worlds),
                min(budget.warm_up, WARM_UP),
            )
            for count in counts
        ]
        timings = interleaved(cases, budget)
        costs = tuple(1e9 * timings[str(count)].median for count in counts)
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
    """Fit the law that the passes follow: each loops over robots, and over ROIs, edges or pairs.

    Least squares on relative errors, so that small sizes count as much as large ones.
    """
    n = np.array(counts, float)
    laws = [np.ones_like(n), n] + ([n * n] if quantity == "robots" else [])
    design = np.stack(laws, axis=1) / np.array(costs)[:, None]
    fitted = np.linalg.lstsq(design, np.ones_like(n))[0]
    terms = [f"{fitted[0]:.3g}", f"{fitted[1]:.3g} {quantity}"]
    terms += [f"{coefficient:.3g} {quantity}^2" for coefficient in fitted[2:]]
    return f"about {' + '.join(terms)} ns"


def curves_table(curves: Sequence[Curve]) -> Table:
    """Return the curves side by side."""
    lines = [
        [
            cell
            for curve in curves
            for cell in (
                (str(curve.sizes[k]), f"{curve.nanoseconds[k]:,.0f}")
                if k < len(curve.sizes)
                else ("", "")
            )
        ]
        for k in range(max(len(curve.sizes) for curve in curves))
    ]
    headings = [word for curve in curves for word in (curve.quantity, "ns")]
    return table("cost against sizes: ns per world-step, all threads working", headings, lines)
