"""Two episodes from the same starts in one panel: what was planned, and what became of it."""

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
from mbn_marl.field import Field
from mbn_marl.render import style
from mbn_marl.render.maps import draw_field, draw_wind

_COLUMNS, _WIDTH = 5, 2.6
"""Panels side by side at most, and the width of one, inches."""


def overlay_panels(
    episodes: Mapping[str, tuple[Snapshot, Snapshot]], names: tuple[str, str]
) -> Figure:
    """The paths of two episodes over each other, a panel for each pair.

    Args:
        episodes: the last snapshots of a pair, by what to write above its panel; what came of both
            is written below. The ROIs are those that the second one visited.
        names: what the first and the second of each pair are; the first is dashed.

    Raises:
        MbnError: there is none.
    """
    if not episodes:
        raise MbnError("overlays: at least one pair of episodes is needed")
    columns = min(_COLUMNS, len(episodes))
    rows = math.ceil(len(episodes) / columns)
    size = (max(_WIDTH * columns, 4.0), (_WIDTH + 0.3) * rows + 0.3)
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=size, layout="constrained")
        for number, (title, (first, second)) in enumerate(episodes.items(), start=1):
            axes = figure.add_subplot(rows, columns, number)
            draw_field(
                axes,
                second.field,
                visited=second.visited,
                roi_radius=second.roi_radius,
                numbered=False,
            )
            _fit_square(axes, second.field)
            _draw_paths(axes, first, dashed=True)
            _draw_paths(axes, second, dashed=False)
            if float(np.hypot(*second.wind)) > 1e-9:
                draw_wind(axes, second.wind)
            axes.set_title(title, loc="left")
            axes.set_xlabel(f"{_outcome(first)} / {_outcome(second)}")
        ink = style.FAINT_INK
        handles = [
            Line2D([], [], color=ink, ls=look, lw=1.2, label=name)
            for name, look in zip(names, ("--", "-"), strict=True)
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _fit_square(axes: Axes, field: Field) -> None:
    """Show a square about the field, so that all panels are of one shape."""
    low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
    middle, half = (low + high) / 2.0, 0.55 * float((high - low).max())
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)


def _draw_paths(axes: Axes, last: Snapshot, *, dashed: bool) -> None:
    """Every robot's path; that of a dashed one is wider and lighter, so that both can be seen."""
    for robot in range(last.trail.shape[1]):
        colour = style.robot_colour(robot)
        x, y = last.trail[:, robot].T
        if dashed:
            axes.plot(x, y, "--", color=colour, lw=2.2, alpha=0.45, zorder=3)
        else:
            axes.plot(x, y, "-", color=colour, lw=1.0, zorder=3.2)
            axes.plot(x[:1], y[:1], "o", color=colour, mfc=style.WHITE, ms=4, mew=1.1, zorder=3.5)
            axes.plot(x[-1:], y[-1:], "o", color=colour, ms=4.5, zorder=3.5)


def _outcome(last: Snapshot) -> str:
    if last.success:
        return f"{last.step} steps"
    return "collision" if last.collision else f"{int(last.visited.sum())} ROIs"
