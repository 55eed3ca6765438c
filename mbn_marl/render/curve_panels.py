"""Learning curves, a panel a field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.curves import Curves, draw_curve, mean_and_band
from mbn_marl.render.scales import scale_returns

_WIDTH = 7.2
"""Width of a figure, inches."""


@dataclass(frozen=True)
class Panel:
    """Learning curves of one field.

    Attributes:
        curves: for each algorithm, per seed, ``(steps, returns)``, as in ``learning_curves``.
        optimum: the best possible return, to mark, or ``None``.
    """

    curves: Curves
    optimum: float | None


def panels_figure(
    panels: Mapping[str, Panel], looks: Mapping[str, int], threshold: float
) -> Figure:
    """See :func:`mbn_marl.render.figures.learning_curve_panels`."""
    bands = {
        (title, name): mean_and_band(f"{title}, {name}", seeds)
        for title, panel in panels.items()
        for name, seeds in panel.curves.items()
    }
    if not bands:
        raise MbnError("panels: there is no curve to draw")
    styles = {name: style.series(index) for name, index in looks.items()}
    optima = [panel.optimum for panel in panels.values() if panel.optimum is not None]
    with matplotlib.rc_context({**style.MATPLOTLIB, "lines.linewidth": 1.2}):
        figure, grid = layout(len(panels), 2.2)
        for axes, (title, panel) in zip(grid, panels.items(), strict=True):
            for name, seeds in panel.curves.items():
                draw_curve(axes, bands[title, name], styles[name], name, banded=len(seeds) > 1)
            axes.axhline(threshold, color=style.FAINT_INK, ls=":", lw=1.0, zorder=2)
            if panel.optimum is not None:
                axes.axhline(panel.optimum, color=style.FAINT_INK, lw=1.0, zorder=2)
            axes.set_title(title, loc="left")
            axes.grid(True)
        lowest = min(float(low.min()) for _, _, low, _ in bands.values())
        highest = max(float(high.max()) for _, _, _, high in bands.values())
        note = scale_returns(grid[0], "y", lowest, max(highest, threshold, *optima), ticks=2)
        grid[0].xaxis.set_major_formatter(EngFormatter(sep=" "))
        label_below(grid, "env-steps")
        label = f"return of training episodes, moving mean{note}"
        figure.supylabel(label, fontsize=9.0, ha="center")
        drawn = {name for _, name in bands}
        handles = [line_handle(look, name) for name, look in styles.items() if name in drawn]
        handles.append(rule_handle(":", f"threshold {threshold:,.0f}"))
        if optima:
            handles.append(rule_handle("-", "proved optimum"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=3.2)
    return figure


def layout(count: int, tall: float) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of ``count`` panels with common axes, two a row, and those panels.

    Args:
        count: how many (> 0).
        tall: height of a panel, inches.
    """
    columns = min(count, 2)
    rows = -(-count // columns)
    figure = Figure(figsize=(_WIDTH, tall * rows + 0.75), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for empty in grid[count:]:
        empty.set_visible(False)
    if count < grid.size:
        grid[count - columns].tick_params(axis="x", labelbottom=True)
    return figure, grid[:count]


def label_below(panels: NDArray[np.object_], label: str) -> None:
    """Label the x axis of the panels with none below them."""
    for axes in panels[-2:]:
        axes.set_xlabel(label)


def line_handle(look: style.SeriesStyle, label: str) -> Line2D:
    """A curve in a legend."""
    return Line2D([], [], color=look.colour, ls=look.dash, marker=look.marker, ms=4, label=label)


def rule_handle(dash: str, label: str) -> Line2D:
    """A marked return in a legend."""
    return Line2D([], [], color=style.FAINT_INK, ls=dash, lw=1.0, label=label)
