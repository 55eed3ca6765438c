"""Figures of fields, and of the paths of robots in them, to scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.text import OffsetFrom
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.errors import MbnError
from mbn_marl.field import Field
from mbn_marl.render import style

_ROI_RADIUS = NavigationConfig().roi_radius
_WIDTH = 4.6
"""Width of a figure of one field, inches."""
_HEIGHTS = (3.0, 5.6)
"""Least and greatest height of a figure of one field, inches."""
_ARROW = {
    **dict.fromkeys(("shrinkA", "shrinkB"), 0),
    **{"arrowstyle": "-|>", "mutation_scale": 11, "lw": 1.6, "color": style.WIND},
}
_COLUMNS = 5
"""Fields side by side in a figure of many."""
_BORDER = 0.06
"""Empty border round a field, as a share of its larger side."""


def field_figure(field: Field, *, roi_radius: float = _ROI_RADIUS) -> Figure:
    """Draw the field with its holes, its numbered ROIs and the robots' starts.

    Args:
        field: what to draw.
        roi_radius: rho, units.
    """
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure, axes = _canvas(field)
        draw_field(axes, field, roi_radius=roi_radius)
        for index, (x, y) in enumerate(field.starts):
            _robot(axes, index, x, y)
        _finish(axes, field.name, [_roi_handle(False), _robot_handle("start of robot i")])
    return figure


def fields_figure(fields: Sequence[Field], *, roi_radius: float = _ROI_RADIUS) -> Figure:
    """Draw all ``fields`` side by side with their ROIs, starts and a scale bar each.

    Args:
        fields: what to draw (one at least).
        roi_radius: rho, units.

    Raises:
        MbnError: there is no field.
    """
    if not fields:
        raise MbnError("fields: there is none to draw")
    columns = min(len(fields), _COLUMNS)
    rows = -(-len(fields) // columns)
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(1.9 * columns, 2.1 * rows + 0.4), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, field in zip(grid, fields, strict=False):
            draw_field(axes, field, roi_radius=roi_radius, numbered=False)
            for index, (x, y) in enumerate(field.starts):
                _robot(axes, index, x, y, size=7.5)
            axes.set_title(field.name, loc="left")
            _replace_ticks(axes, field)
        for empty in grid[len(fields) :]:
            empty.set_visible(False)
        handles = [_roi_handle(False), _robot_handle("start of robot i")]
        figure.legend(handles=handles, loc="outside lower center", ncols=2, handlelength=1.2)
    return figure


def trajectory_figure(
    field: Field,
    trails: NDArray[Any],
    *,
    visited: NDArray[np.bool_] | None = None,
    collision: bool = False,
    wind: tuple[float, float] = (0.0, 0.0),
    roi_radius: float = _ROI_RADIUS,
    title: str | None = None,
) -> Figure:
    """Draw the paths of one episode in its field.

    A hollow circle marks a start, a numbered disc the end of a path; the dots between are one
    step apart, so that their distance shows the speed.

    Args:
        field: where the episode took place.
        trails: (t + 1, n, 2), units: the positions of each robot, from the reset on.
        visited: (m,) bool, the ROIs that were visited; ``None`` if that is not known.
        collision: whether the episode ended in one; the closest pair is marked.
        wind: ``(v_x, v_y)``, units/step per step; an arrow points that way unless it is 0.
        roi_radius: rho, units.
        title: above the figure; ``None`` for the name of the field.

    Raises:
        MbnError: if ``trails`` or ``visited`` has another shape.
    """
    trails = np.asarray(trails, np.float64)
    if trails.ndim != 3 or trails.shape[2] != 2 or 0 in trails.shape:
        raise MbnError(f"trails: the shape has to be (steps + 1, robots, 2), not {trails.shape}")
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure, axes = _canvas(field)
        draw_field(axes, field, visited=visited, roi_radius=roi_radius)
        draw_trails(axes, trails)
        start = _robot_handle("start")
        start.set(markersize=5, markerfacecolor=style.WHITE)
        handles = [_roi_handle(False), start, _robot_handle("end of robot i")]
        if visited is not None:
            handles.insert(1, _roi_handle(True))
        if collision:
            handles.append(mark_collision(axes, trails[-1]))
        draw_wind(axes, wind)
        _finish(axes, field.name if title is None else title, handles)
    return figure


def draw_field(
    axes: Axes,
    field: Field,
    *,
    visited: NDArray[np.bool_] | None = None,
    roi_radius: float = _ROI_RADIUS,
    numbered: bool = True,
) -> None:
    """Draw the field and its ROIs on ``axes``, to scale, and fit the axes to it.

    Args:
        axes: where to draw.
        field: what to draw.
        visited: (m,) bool, the ROIs to show as visited; ``None`` for none.
        roi_radius: rho, units.
        numbered: write the name of each ROI beside it.

    Raises:
        MbnError: if ``visited`` has another shape.
    """
    count = len(field.rois)
    visited = np.zeros(count, bool) if visited is None else np.asarray(visited, bool)
    if visited.shape != (count,):
        raise MbnError(f"visited: the shape has to be ({count},), not {visited.shape}")
    axes.set_facecolor(style.OBSTACLE)
    rings = [np.vstack([ring, ring[:1]]) for ring in (field.vertices, *_opposed(field))]
    codes = [[Path.MOVETO] + [Path.LINETO] * (len(ring) - 1) for ring in rings]
    ground = Path(np.vstack(rings), np.concatenate(codes))
    axes.add_patch(PathPatch(ground, fc=style.GROUND, ec=style.OUTLINE, lw=1.3))
    for number, ((x, y), seen) in enumerate(zip(field.rois, visited, strict=True), start=1):
        colour = style.ROI_VISITED if seen else style.ROI_OPEN
        tint = (colour, 0.28 if seen else 0.05)
        axes.add_patch(Circle((x, y), roi_radius, fc=tint, ec=colour, lw=0.7, zorder=2))
        axes.plot([x], [y], **_roi_marker(bool(seen)), zorder=2.5)
        if numbered:
            axes.annotate(
                f"$w_{{{number}}}$",
                (x + 0.72 * roi_radius, y + 0.72 * roi_radius),
                xytext=(1, 0),
                textcoords="offset points",
                fontsize=8,
                color=style.INK,
                zorder=6,
                path_effects=[withStroke(linewidth=2.4, foreground=style.WHITE)],
            )
    low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
    border = _BORDER * float((high - low).max())
    axes.set_xlim(low[0] - border, high[0] + border)
    axes.set_ylim(low[1] - border, high[1] + border)
    axes.set_aspect("equal")


def draw_trails(axes: Axes, trails: NDArray[Any]) -> None:
    """Draw the paths of one episode, (t + 1, n, 2) in units, on ``axes``."""
    for index in range(trails.shape[1]):
        colour = style.robot_colour(index)
        path = trails[:, index]
        axes.plot(path[:, 0], path[:, 1], color=colour, lw=0.8, zorder=3)
        axes.plot(path[:, 0], path[:, 1], ".", color=colour, ms=3.6, mew=0, zorder=3)
        axes.plot(*path[0], "o", color=colour, mfc=style.WHITE, ms=5, mew=1.3, zorder=3.5)
    for index, (x, y) in enumerate(trails[-1]):
        _robot(axes, index, float(x), float(y))


def _canvas(field: Field) -> tuple[Figure, Axes]:
    width, height = np.ptp(field.vertices, axis=0)
    tall = float(np.clip(_WIDTH * height / width + 0.6, *_HEIGHTS))
    figure = Figure(figsize=(_WIDTH, tall), layout="constrained")
    return figure, figure.add_subplot()


def fit_square(axes: Axes, field: Field) -> tuple[NDArray[np.float64], float]:
    """Show a square about the field; return its lower left corner and its side, units."""
    low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
    side = (1.0 + 2.0 * _BORDER) * float((high - low).max())
    corner: NDArray[np.float64] = (low + high - side) / 2.0
    axes.set_xlim(corner[0], corner[0] + side)
    axes.set_ylim(corner[1], corner[1] + side)
    return corner, side


def _replace_ticks(axes: Axes, field: Field) -> None:
    """Show a square about the field, with a scale bar of round length instead of ticks."""
    (left, bottom), side = fit_square(axes, field)
    decade = 10.0 ** np.floor(np.log10(side / 3.0))
    bar = max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= side / 3.0)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    start, height = left + 0.05 * side, bottom + 0.05 * side
    axes.plot([start, start + bar], [height, height], color=style.OUTLINE, lw=2.0)
    end, text = (start + bar, height), f"{bar:g} units"
    axes.annotate(text, end, (3, 0), textcoords="offset points", va="center", fontsize=7)


def _finish(axes: Axes, title: str, handles: Sequence[Line2D]) -> None:
    axes.set_title(title, loc="left")
    axes.set_xlabel("x (units)")
    axes.set_ylabel("y (units)")
    columns = len(handles) if len(handles) <= 4 else 3
    axes.figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=1.2)


def _opposed(field: Field) -> list[NDArray[np.float64]]:
    """Return the holes, each turning against the outline, so that filling leaves them empty."""
    turn = shapely.LinearRing(field.vertices).is_ccw
    return [hole[::-1] if shapely.LinearRing(hole).is_ccw == turn else hole for hole in field.holes]


def _roi_marker(visited: bool) -> dict[str, Any]:
    """Return the look of an ROI: hollow until visited, then filled and ticked."""
    if visited:
        return {"marker": "$\\checkmark$", "ms": 7, "color": style.ROI_VISITED, "ls": "none"}
    return {"marker": "o", "ms": 4, "mfc": style.WHITE, "color": style.ROI_OPEN, "ls": "none"}


def _robot(axes: Axes, index: int, x: float, y: float, size: float = 9.5) -> None:
    """Draw a numbered disc, ``size`` points wide."""
    colour = style.robot_colour(index)
    axes.plot([x], [y], "o", color=colour, ms=size, mec=style.WHITE, mew=0.8, zorder=4)
    axes.annotate(
        str(index),
        (x, y),
        ha="center",
        va="center_baseline",
        fontsize=0.68 * size,
        fontweight="bold",
        color=style.ink_on(colour),
        zorder=4,
    )


def mark_collision(axes: Axes, positions: NDArray[np.float64]) -> Line2D:
    """Draw a square round the two robots that are closest; return its legend entry."""
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    first, second = np.unravel_index(int(gaps.argmin()), gaps.shape)
    x, y = (positions[first] + positions[second]) / 2.0
    look: dict[str, Any] = {"marker": "s", "ls": "none", "mfc": "none", "mec": style.COLLISION}
    axes.plot([x], [y], ms=25, mew=1.8, zorder=5, **look)
    return Line2D([], [], ms=8, mew=1.4, label="collision", **look)


def draw_wind(axes: Axes, wind: tuple[float, float]) -> None:
    """Draw an arrow the way the wind blows, and its speed, over the top right corner, if any."""
    speed = float(np.hypot(*wind))
    if speed < style.CALM:
        return
    corner = OffsetFrom(axes.patch, (1.0, 1.0), unit="points")
    middle, half = np.array([-11.0, 9.5]), 9.0 * np.asarray(wind) / speed
    axes.annotate(
        "",
        tuple(middle + half),
        xytext=tuple(middle - half),
        xycoords=corner,
        textcoords=corner,
        arrowprops=_ARROW,
        annotation_clip=False,
    )
    axes.annotate(
        f"wind {speed:.3g}",
        (-25.0, middle[1]),
        xycoords=corner,
        ha="right",
        va="center",
        color=style.WIND,
        annotation_clip=False,
    )


def _robot_handle(label: str) -> Line2D:
    return Line2D([], [], marker="o", ls="none", color=style.FAINT_INK, ms=8, label=label)


def _roi_handle(visited: bool) -> Line2D:
    label = "ROI, visited" if visited else "ROI"
    return Line2D([], [], label=label, **_roi_marker(visited))
