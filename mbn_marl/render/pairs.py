"""Returns under one setting against another, a panel an algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.curve_panels import label_below, layout, rule_handle
from mbn_marl.render.scales import scale_returns

_MARKS: tuple[dict[str, Any], ...] = (
    {"marker": "o", "ls": "none", "color": style.BLUE, "mfc": style.WHITE, "ms": 7.5, "mew": 1.3},
    {"marker": "s", "ls": "none", "color": style.VERMILLION, "ms": 3.8},
)
"""The first of a pair is a ring, the second a square that fits inside."""


class Pair(NamedTuple):
    """Two returns to compare; ``None`` is missing."""

    first: float | None
    second: float | None


def pairs_figure(
    panels: Mapping[str, Mapping[str, Pair]], names: tuple[str, str], threshold: float
) -> Figure:
    """See :func:`mbn_marl.render.figures.pairs`."""
    pairs = [pair for panel in panels.values() for pair in panel.values()]
    values = [value for pair in pairs for value in pair if value is not None]
    if not values:
        raise MbnError("pairs: there is no return to draw")
    labels = list(dict.fromkeys(label for panel in panels.values() for label in panel))
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure, grid = layout(len(panels), 0.19 * len(labels) + 0.5)
        for axes, (title, panel) in zip(grid, panels.items(), strict=True):
            for place, label in enumerate(labels):
                _draw_pair(axes, place, panel.get(label, Pair(None, None)))
            axes.axvline(threshold, color=style.FAINT_INK, ls=":", lw=1.0, zorder=1)
            axes.set_title(title, loc="left")
            axes.grid(True, axis="x")
        grid[0].set_yticks(range(len(labels)), labels)
        grid[0].set_ylim(len(labels) - 0.4, -0.6)
        note = scale_returns(grid[0], "x", min(values), max(threshold, *values), ticks=2)
        label_below(grid, f"mean return during training{note}")
        handles = [
            Line2D([], [], label=name, **mark) for name, mark in zip(names, _MARKS, strict=True)
        ]
        handles.append(rule_handle(":", f"threshold {threshold:,.0f}"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _draw_pair(axes: Axes, place: int, pair: Pair) -> None:
    """Both marks at a height, joined; a word for what is missing."""
    if pair.first is not None and pair.second is not None:
        axes.plot(
            [pair.first, pair.second], [place, place], color=style.FAINT_INK, lw=1.0, zorder=2
        )
    for value, mark in zip(pair, _MARKS, strict=True):
        if value is not None:
            axes.plot([value], [place], zorder=3, clip_on=False, **mark)
    if pair == (None, None):
        axes.annotate(
            "missing",
            (0.02, place),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.0,
            color=style.FAINT_INK,
        )
