"""Estimates with their intervals, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style

END = 0.9
"""Where the second panel of a profile begins: what is left to the best possible score."""

_WIDTH = 4.6  # inches: about that of a phone

Interval = tuple[float, float | None, float | None]
"""A value and the ends of its interval, ``None`` if it has none."""

Band = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Values and the ends of their band, (k,) each."""


@matplotlib.rc_context(style.MATPLOTLIB)
def intervals_figure(panels: Mapping[str, Mapping[str, Interval]]) -> Figure:
    """Draw shares with their intervals, a panel for each title, one below the other.

    Raises:
        MbnError: there is nothing to draw.
    """
    if not panels or not all(panels.values()):
        raise MbnError("intervals: there is nothing to draw")
    tall = sum(0.8 + 0.25 * len(lines) for lines in panels.values())
    figure = Figure(figsize=(_WIDTH, tall), layout="constrained")
    heights = [len(lines) + 1.0 for lines in panels.values()]
    grid = figure.subplots(len(panels), 1, squeeze=False, height_ratios=heights).ravel()
    for axes, (title, lines) in zip(grid, panels.items(), strict=True):
        for place, (value, low, high) in enumerate(lines.values()):
            if low is not None and high is not None:
                axes.hlines(place, low, high, color=style.BLUE, lw=6.0, alpha=0.35, clip_on=False)
            axes.plot([value], [place], c=style.BLUE, marker="|", ms=11.0, mew=2.0, clip_on=False)
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(True, axis="x")
        axes.set_yticks(range(len(lines)), list(lines))
        axes.set_ylim(len(lines) - 0.5, -0.5)
        axes.set_title(title, loc="left", fontsize=9.0)
    return figure


def chances_figure(lines: Mapping[str, Interval], title: str) -> Figure:
    """Draw probabilities with their intervals on an axis from 0 to 100 %, with a line at 50 %."""
    figure = intervals_figure({title: lines})
    (axes,) = figure.axes
    axes.axvline(0.5, color=style.FAINT_INK, ls=":", lw=1.2, zorder=1)
    axes.set(xlim=(0.0, 1.0), xticks=[0.0, 0.25, 0.5, 0.75, 1.0])
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def profiles_figure(
    profiles: Mapping[str, Band], thresholds: NDArray[Any], score: str, looks: Mapping[str, int]
) -> Figure:
    """Draw performance profiles: the share of runs above each threshold, whole and its end.

    Args:
        profiles: for each line its shares and the ends of their band, (k,) each.
        thresholds: (k,), increasing, of the ``score``.
        score: the name of the x axis.
        looks: the number of each line's style.

    Raises:
        MbnError: there is nothing to draw.
    """
    if not profiles:
        raise MbnError("profiles: there is nothing to draw")
    figure = Figure(figsize=(_WIDTH, 5.2), layout="constrained")
    grid = figure.subplots(2, 1)
    for axes, first in zip(grid, (thresholds[0], END), strict=True):
        for name, (share, low, high) in profiles.items():
            look = style.series(looks[name])
            axes.step(thresholds, share, where="post", c=look.colour, ls=look.dash, label=name)
            tint = {"step": "post", "color": look.colour, "alpha": 0.18, "lw": 0}
            axes.fill_between(thresholds, low, high, **tint)
        axes.set(xlim=(first, thresholds[-1]), ylim=(-0.02, 1.02), ylabel="share of runs above it")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(True)
    grid[1].set_xlabel(score)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(profiles), 3))
    return figure
