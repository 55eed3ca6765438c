"""The figure of speed: rates, where the time goes, and cost against sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from benchmarks.report import Measurement, describe_machine
from benchmarks.speed.sizes import Curve
from mbn_marl.files import replacing
from mbn_marl.render import style

WIDE_RANGE = 30.0
"""A curve that grows by more than this is drawn on logarithmic axes."""


def write_figure(
    rows: Sequence[Measurement], parts: Mapping[str, float], curves: Sequence[Curve], path: Path
) -> None:
    """Draw rates with their targets, the parts of a step, and a panel for each curve."""
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(10.0, 6.0), layout="constrained")
        grid = figure.add_gridspec(2, 1)
        above, below = (figure.add_subfigure(grid[row]) for row in (0, 1))
        left, right = above.subplots(1, 2)
        _draw_rates(left, [row for row in rows if row.unit.startswith("M env")])
        _draw_parts(right, parts)
        panels = below.subplots(1, len(curves))
        for index, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
            _draw_curve(axes, curve, style.series(index))
        machine = describe_machine()
        figure.suptitle(f"{machine['processor']}, {machine['cores']} cores")
        with replacing(path) as temporary:
            figure.savefig(temporary)


def _draw_rates(axes: Axes, rows: list[Measurement]) -> None:
    places = range(len(rows), 0, -1)
    axes.barh(places, [row.value or 0.0 for row in rows], 0.6, color=style.BLUE)
    for place, row in zip(places, rows, strict=True):
        if row.target is not None:
            axes.plot([row.target] * 2, [place - 0.4, place + 0.4], color=style.VERMILLION)
    axes.set_yticks(places, [",\n".join(row.name.rsplit(", ", 1)) for row in rows])
    axes.set_xlabel("million env-steps/s; line: target")
    axes.grid(True, axis="x")


def _draw_parts(axes: Axes, parts: Mapping[str, float]) -> None:
    places = range(len(parts), 0, -1)
    axes.barh(places, [*parts.values()], 0.6, color=style.BLUISH_GREEN)
    axes.set_yticks(places, [*parts])
    axes.set_xlabel("ns per world-step")
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
