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

Interval = tuple[float, float | None, float | None]
"""A value and the ends of its interval, ``None`` if it has none."""

Band = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Values and the ends of their band, (k,) each."""


def intervals_figure(
    panels: Mapping[str, Mapping[str, Interval]], rule: float | None = None
) -> Figure:
    """Shares with their intervals, a panel for each quantity, the same lines in all.

    Args:
        panels: for each title, for each line its share and interval.
        rule: a share to mark in every panel, or ``None``.

    Raises:
        MbnError: there is nothing to draw.
    """
    if not panels or not any(panels.values()):
        raise MbnError("intervals: there is nothing to draw")
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    with matplotlib.rc_context(style.MATPLOTLIB):
        size = (1.2 + 2.4 * len(panels), 0.9 + 0.27 * len(names))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False).ravel()
        for axes, (title, lines) in zip(grid, panels.items(), strict=True):
            if rule is not None:
                axes.axvline(rule, color=style.FAINT_INK, ls=":", lw=1.0)
            for place, name in enumerate(names):
                value, low, high = lines[name]
                if low is not None and high is not None:
                    axes.hlines(place, low, high, color=style.BLUE, lw=6.0, alpha=0.35)
                axes.plot([value], [place], color=style.BLUE, marker="|", ms=11.0, mew=2.0)
            axes.set_title(title, loc="left", fontsize=9.0)
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.xaxis.set_major_formatter(PercentFormatter(1.0))
            axes.grid(True, axis="x")
        grid[0].set_yticks(range(len(names)), names)
        grid[0].set_ylim(len(names) - 0.5, -0.5)
    return figure


def profiles_figure(profiles: Mapping[str, Band], thresholds: NDArray[Any], score: str) -> Figure:
    """Performance profiles: the share of runs above each threshold, whole and its end.

    Args:
        profiles: for each line its shares and the ends of their band, (k,) each.
        thresholds: (k,), increasing.
        score: what is measured.

    Raises:
        MbnError: there is nothing to draw.
    """
    if not profiles:
        raise MbnError("profiles: there is nothing to draw")
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        whole, end = figure.subplots(1, 2, sharey=True)
        for axes, first in ((whole, thresholds[0]), (end, END)):
            for index, (name, (share, low, high)) in enumerate(profiles.items()):
                look = style.series(index)
                axes.step(thresholds, share, where="post", c=look.colour, ls=look.dash, label=name)
                axes.fill_between(
                    thresholds, low, high, step="post", color=look.colour, alpha=0.18, lw=0
                )
            axes.set_xlabel(score)
            axes.set_xlim(first, thresholds[-1])
            axes.set_ylim(-0.02, 1.02)
            axes.xaxis.set_major_formatter(PercentFormatter(1.0))
            axes.grid(True)
        whole.yaxis.set_major_formatter(PercentFormatter(1.0))
        whole.set_ylabel("share of runs above it")
        handles, labels = whole.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(profiles), 4))
    return figure
