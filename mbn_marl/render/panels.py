"""Several episodes side by side, to scale: a panel for each, or for each pair."""

from __future__ import annotations

import math
from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mbn_marl.engine import Snapshot
from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.maps import draw_field, draw_trails, draw_wind, fit_square, mark_collision

_WIDTH, _PAIR_WIDTH = 3.2, 2.6
"""Of a panel with one episode, and with a pair, inches."""
_COLUMNS, _PAIR_COLUMNS = 3, 5
"""Panels side by side at most."""
_TITLES = 0.6
"""Height of a panel's title and axis label, inches."""


def trajectory_panels(lasts: Mapping[str, Snapshot], *, columns: int = _COLUMNS) -> Figure:
    """Draw the paths of several episodes, a panel each, as in ``trajectory_figure``.

    Args:
        lasts: the last snapshot of each episode, by the title of its panel; its outcome is the
            second line of the title.
        columns: how many panels are side by side at most.

    Raises:
        MbnError: there is none.
    """
    _check_any(lasts)
    sides = [np.ptp(last.field.vertices, axis=0) for last in lasts.values()]
    tall = max(height / width for width, height in sides)
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure, grid = _panels(len(lasts), columns, _WIDTH, _WIDTH * tall + _TITLES)
        for axes, (title, last) in zip(grid, lasts.items(), strict=True):
            _draw_place(axes, last, title, _long_outcome(last), numbered=True)
            draw_trails(axes, last.trail)
            if last.collision:
                mark_collision(axes, last.trail[-1])
    return figure


def overlay_panels(
    episodes: Mapping[str, tuple[Snapshot, Snapshot]], names: tuple[str, str]
) -> Figure:
    """Draw two episodes from the same starts over each other, a panel for each pair.

    Args:
        episodes: the last snapshots of a pair, by the title of its panel; both outcomes are the
            second line of the title. The ROIs are those that the second one visited.
        names: what the first and the second of each pair are; the first is dashed.

    Raises:
        MbnError: there is none.
    """
    _check_any(episodes)
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure, grid = _panels(len(episodes), _PAIR_COLUMNS, _PAIR_WIDTH, _PAIR_WIDTH + _TITLES)
        for axes, (title, (first, second)) in zip(grid, episodes.items(), strict=True):
            outcome = f"{_short_outcome(first)} / {_short_outcome(second)}"
            _draw_place(axes, second, title, outcome, numbered=False)
            fit_square(axes, second.field)
            _draw_paths(axes, first, dashed=True)
            _draw_paths(axes, second, dashed=False)
        handles = [
            Line2D([], [], color=style.FAINT_INK, ls=look, lw=1.2, label=name)
            for name, look in zip(names, ("--", "-"), strict=True)
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _check_any(episodes: Mapping[str, object]) -> None:
    if not episodes:
        raise MbnError("panels: at least one episode is needed")


def _panels(count: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Make a figure of ``count`` panels, each ``width`` x ``height`` inches."""
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(max(width * columns, 4.0), height * rows + 0.3), layout="constrained")
    grid = [figure.add_subplot(rows, columns, number + 1) for number in range(count)]
    for axes in grid[-columns:]:
        axes.set_xlabel("x (units)")
    for axes in grid[::columns]:
        axes.set_ylabel("y (units)")
    return figure, grid


def _draw_place(axes: Axes, last: Snapshot, title: str, outcome: str, *, numbered: bool) -> None:
    """Draw the field, the wind and the title."""
    radius = last.roi_radius
    draw_field(axes, last.field, visited=last.visited, roi_radius=radius, numbered=numbered)
    draw_wind(axes, last.wind)
    axes.set_title(f"{title}\n{outcome}", loc="left", fontsize=9.0)


def _draw_paths(axes: Axes, last: Snapshot, *, dashed: bool) -> None:
    """Draw every robot's path; a dashed one is wider and lighter, so that both can be seen."""
    for robot in range(last.trail.shape[1]):
        colour = style.robot_colour(robot)
        x, y = last.trail[:, robot].T
        if dashed:
            axes.plot(x, y, "--", color=colour, lw=2.2, alpha=0.45, zorder=3)
        else:
            axes.plot(x, y, "-", color=colour, lw=1.0, zorder=3.2)
            axes.plot(x[:1], y[:1], "o", color=colour, mfc=style.WHITE, ms=4, mew=1.1, zorder=3.5)
            axes.plot(x[-1:], y[-1:], "o", color=colour, ms=4.5, zorder=3.5)


def _short_outcome(last: Snapshot) -> str:
    if last.success:
        return f"{last.step} steps"
    return "collision" if last.collision else f"{int(last.visited.sum())} ROIs"


def _long_outcome(last: Snapshot) -> str:
    visited = f"{int(last.visited.sum())} of {len(last.visited)} ROIs"
    how = "collision" if last.collision else "success" if last.success else visited
    return f"{how}, {last.step} steps, return {last.team_return:,.0f}"
