"""Several episodes side by side, to the same scale."""

from __future__ import annotations

import math
from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from mbn_marl.engine import Snapshot
from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.maps import draw_field, draw_trails, draw_wind, mark_collision

_COLUMNS = 3
_WIDTH = 3.2
"""Width of a panel, inches."""


def trajectory_panels(lasts: Mapping[str, Snapshot], *, columns: int = _COLUMNS) -> Figure:
    """The paths of several episodes, a panel each, as in ``trajectory_figure``.

    Args:
        lasts: the last snapshot of each episode, by what to write above its panel; its outcome is
            written below.
        columns: how many panels are side by side at most.

    Raises:
        MbnError: there is none.
    """
    if not lasts:
        raise MbnError("panels: at least one episode is needed")
    columns = min(columns, len(lasts))
    rows = math.ceil(len(lasts) / columns)
    sides = [np.ptp(last.field.vertices, axis=0) for last in lasts.values()]
    tall = max(height / width for width, height in sides)
    size = (_WIDTH * columns, (_WIDTH * tall + 0.5) * rows)
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=size, layout="constrained")
        for number, (name, last) in enumerate(lasts.items(), start=1):
            axes = figure.add_subplot(rows, columns, number)
            draw_field(axes, last.field, visited=last.visited, roi_radius=last.roi_radius)
            draw_trails(axes, last.trail)
            if last.collision:
                mark_collision(axes, last.trail[-1])
            if float(np.hypot(*last.wind)) > 1e-9:
                draw_wind(axes, last.wind)
            axes.set_title(name, loc="left")
            axes.set_xlabel(_outcome(last))
    return figure


def _outcome(last: Snapshot) -> str:
    visited = f"{int(last.visited.sum())} of {len(last.visited)} ROIs"
    how = "collision" if last.collision else "success" if last.success else visited
    return f"{how}, {last.step} steps, return {last.team_return:,.0f}"
