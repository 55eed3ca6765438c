"""Estimates with their intervals, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style

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
    """Draw performance profiles: the share of runs above each threshold.

    The axis is logarithmic in what a threshold lacks of 1, since good runs differ there, and begins
    where the first profile falls.

    Args:
        profiles: for each line its shares and the ends of their band, (k,) each.
        thresholds: (k,), increasing up to 1, of the ``score``.
        score: the name of the x axis.
        looks: the number of each line's style.

    Raises:
        MbnError: there is nothing to draw.
    """
    if not profiles:
        raise MbnError("profiles: there is nothing to draw")
    figure = Figure(figsize=(_WIDTH, 3.6), layout="constrained")
    axes = figure.add_subplot()
    lacks = 1.0 - thresholds[:-1]  # more than 1 has none
    for name, band in profiles.items():
        share, low, high = (values[:-1] for values in band)
        look = style.series(looks[name])
        axes.step(lacks, share, where="post", c=look.colour, ls=look.dash)
        falls = np.flatnonzero(np.diff(share, append=0.0))
        marks: dict[str, Any] = {"marker": look.marker, "ms": 4, "c": look.colour}
        axes.plot(lacks[falls], share[falls], ls="none", **marks)
        axes.plot([], [], ls=look.dash, label=name, **marks)
        axes.fill_between(lacks, low, high, step="post", color=look.colour, alpha=0.18, lw=0)
    shares = np.stack([share for share, _, _ in profiles.values()])
    fallen = np.flatnonzero((shares[:, :-1] < shares[:, :1]).any(axis=0))
    first = max(fallen[0] - 1, 0) if len(fallen) and fallen[0] < len(lacks) - 1 else 0
    axes.set(xscale="log", xlim=(lacks[first], lacks[-1]), ylim=(-0.02, 1.02))
    ticks = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
    shown = [lack for lack in ticks if lacks[-1] * 0.99 <= lack <= lacks[first]]
    axes.set_xticks(shown, [f"{1.0 - lack:.1%}".replace(".0", "") for lack in shown])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel=score, ylabel="share of runs above it")
    axes.grid(True)
    figure.legend(loc="outside lower center", ncols=min(len(profiles), 3), handlelength=3.2)
    return figure
