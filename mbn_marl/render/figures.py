"""Figures of fields and episodes for print and reports, and the files of all figures.

They are matplotlib figures without pyplot: no display, no global state, nothing to close.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from mbn_marl.engine import Snapshot
from mbn_marl.errors import MbnError
from mbn_marl.field import Field
from mbn_marl.files import replacing
from mbn_marl.render import maps, style

FORMATS = (".png", ".pdf", ".svg")

_WIDTH, _HEIGHTS = 4.6, (3.0, 5.6)
"""Of a figure of one field, with its least and greatest height, inches."""
_PANEL_WIDTH, _PAIR_WIDTH, _FIELD_WIDTH = 3.2, 2.6, 1.9
"""Of a panel with one episode, with a pair, and with a field alone, inches."""
_TITLES = 0.6  # height of a panel's title and axis label, inches


@matplotlib.rc_context(style.MATPLOTLIB)
def field_figure(field: Field) -> Figure:
    """Draw a field with its holes, its numbered ROIs, and the starts."""
    figure, axes = _canvas(field, field.name)
    maps.draw_field(axes, field)
    maps.draw_robots(axes, field.starts)
    _explain(figure, [maps.roi_handle(), maps.robot_handle("start of robot i")])
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def fields_figure(fields: Sequence[Field]) -> Figure:
    """Draw fields side by side with ROIs, starts and a scale bar each.

    Raises:
        MbnError: there is no field.
    """
    figure, grid = _panels("fields", len(fields), 5, _FIELD_WIDTH, 2.4)
    for axes, field in zip(grid, fields, strict=True):
        maps.draw_field(axes, field, roi_radius=maps.ROI_RADIUS, numbered=False)
        maps.draw_robots(axes, field.starts, size=7.5)
        axes.set_title(field.name, loc="left")
        maps.replace_ticks(axes, field)
    _explain(figure, [maps.roi_handle(), maps.robot_handle("start of robot i")])
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_figure(
    field: Field,
    trails: NDArray[Any],
    *,
    visited: NDArray[np.bool_] | None = None,
    collision: bool = False,
    wind: ArrayLike = (0.0, 0.0),
    headings: NDArray[Any] | None = None,
    failed: NDArray[np.bool_] | None = None,
    gone: NDArray[np.bool_] | None = None,
    roi_radius: float = maps.ROI_RADIUS,
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
        wind: ``(v_x, v_y)``, units/step per step, or that of each step in gusts, (k, 2); an arrow
            points that way, or a line each, unless it is 0.
        headings: (n,), radians: where the robots face at the end, NaN for a robot without a
            heading; ``None`` if none has one.
        failed: (n,) bool, the robots that failed, which get a cross; ``None`` for none.
        gone: (n,) bool, those that vanished, which collide with nobody; ``None`` for none.
        roi_radius: rho, units.
        title: above the figure; ``None`` for the name of the field.

    Raises:
        MbnError: if ``trails`` or ``visited`` has another shape.
    """
    trails = np.asarray(trails, np.float64)
    if trails.ndim != 3 or trails.shape[2] != 2 or 0 in trails.shape:
        raise MbnError(f"trails: the shape has to be (steps + 1, robots, 2), not {trails.shape}")
    figure, axes = _canvas(field, field.name if title is None else title)
    maps.draw_field(axes, field, visited=visited, roi_radius=roi_radius)
    maps.draw_trails(axes, trails, headings, failed)
    handles = [maps.roi_handle()] + ([] if visited is None else [maps.roi_handle(visited=True)])
    handles.append(maps.robot_handle("start", ms=5, mfc=style.WHITE))
    handles.append(maps.robot_handle("end of robot i"))
    if collision:
        handles.append(maps.mark_collision(axes, trails[-1], gone))
    if failed is not None and failed.any():
        handles.append(maps.failed_handle())
    maps.draw_wind(axes, wind)
    _explain(figure, handles)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_panels(lasts: Mapping[str, Snapshot], *, columns: int = 3) -> Figure:
    """Draw the paths of several episodes, a panel each, as in :func:`trajectory_figure`.

    Args:
        lasts: the last snapshot of each episode, by the title of its panel; its outcome is the
            second line of the title.
        columns: how many panels are side by side at most.

    Raises:
        MbnError: there is none.
    """
    sides = [np.ptp(last.field.vertices, axis=0) for last in lasts.values()]
    tall = _PANEL_WIDTH * max((height / width for width, height in sides), default=1.0)
    figure, grid = _panels("panels", len(lasts), columns, _PANEL_WIDTH, tall + _TITLES)
    for axes, (title, last) in zip(grid, lasts.items(), strict=True):
        _draw_place(axes, last, f"{title}\n{_long_outcome(last)}", numbered=True)
        maps.draw_trails(axes, last.trail, last.headings, last.failed)
        if last.collision:
            maps.mark_collision(axes, last.trail[-1], last.gone)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
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
    figure, grid = _panels("panels", len(episodes), 5, _PAIR_WIDTH, _PAIR_WIDTH + _TITLES)
    for axes, (title, pair) in zip(grid, episodes.items(), strict=True):
        words = zip(names, map(_short_outcome, pair), strict=True)
        outcomes = ", ".join(f"{name}: {outcome}" for name, outcome in words)
        _draw_place(axes, pair[1], f"{title}\n{outcomes}", numbered=False)
        maps.fit_square(axes, pair[1].field)
        for last, dashed in zip(pair, (True, False), strict=True):
            _draw_paths(axes, last, dashed=dashed)
    handles = [
        Line2D([], [], color=style.FAINT_INK, ls=look, lw=1.2, label=name)
        for name, look in zip(names, ("--", "-"), strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def check_name(path: Path) -> Path:
    """Check that a figure can have this name; return ``path``.

    Raises:
        MbnError: for another format, naming the path and the formats.
    """
    if path.suffix.lower() not in FORMATS:
        raise MbnError(f"{path}: the file name has to end in {', '.join(FORMATS)}")
    return path


@matplotlib.rc_context(style.MATPLOTLIB)
def save(figure: Figure, path: str | Path) -> Path:
    """Write ``figure`` as PNG, PDF or SVG, as the end of ``path`` says, and return ``path``.

    Missing folders are made; a file is replaced only once the new one is complete.

    Raises:
        MbnError: for another format, naming the path and the formats.
        OSError: naming the path, if it cannot be written.
    """
    path = check_name(Path(path))
    with replacing(path) as temporary:
        figure.savefig(temporary)
    return path


@matplotlib.rc_context(style.MATPLOTLIB)
def svg(figure: Figure) -> bytes:
    """Return an SVG picture whose ground and inks follow the reader's light or dark mode."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", facecolor="none")
    picture = stream.getvalue()
    for number, colour in enumerate(style.THEMED):
        picture = re.sub(colour, f"var(--c{number})", picture, flags=re.IGNORECASE)
    light, dark = (
        "".join(f"--c{number}:{colour};" for number, colour in enumerate(theme))
        for theme in zip(*style.THEMED.values(), strict=True)
    )
    rules = f":root{{{light}}}@media (prefers-color-scheme: dark){{:root{{{dark}}}}}"
    return re.sub(r"(<svg[^>]*>)", rf"\1<style>{rules}</style>", picture, count=1).encode()


def _canvas(field: Field, title: str) -> tuple[Figure, Axes]:
    width, height = np.ptp(field.vertices, axis=0)
    tall = float(np.clip(_WIDTH * height / width + 0.6, *_HEIGHTS))
    figure = Figure(figsize=(_WIDTH, tall), layout="constrained")
    axes = figure.add_subplot(xlabel="x (units)", ylabel="y (units)")
    axes.set_title(title, loc="left")
    return figure, axes


def _explain(figure: Figure, handles: Sequence[Line2D]) -> None:
    columns = len(handles) if len(handles) <= 4 else 3
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=1.2)


def _panels(
    what: str, count: int, columns: int, width: float, height: float
) -> tuple[Figure, list[Axes]]:
    """Make a figure of ``count`` panels, each ``width`` x ``height`` inches."""
    if not count:
        raise MbnError(f"{what}: there is none to draw")
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(max(width * columns, 4.0), height * rows + 0.3), layout="constrained")
    grid = [figure.add_subplot(rows, columns, number + 1) for number in range(count)]
    for axes in grid[-columns:]:
        axes.set_xlabel("x (units)")
    for axes in grid[::columns]:
        axes.set_ylabel("y (units)")
    return figure, grid


def _draw_place(axes: Axes, last: Snapshot, title: str, *, numbered: bool) -> None:
    """Draw the field, the title of two lines, and the wind beside it, whose speed it may say."""
    radius = last.roi_radius
    maps.draw_field(axes, last.field, visited=last.visited, roi_radius=radius, numbered=numbered)
    maps.draw_wind(axes, last.winds, height=20.5, named="wind " not in title)
    axes.set_title(title, loc="left", fontsize=9.0)


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
            end, heading = (float(x[-1]), float(y[-1])), float(last.headings[robot])
            maps.draw_nose(axes, end, heading, 4.5, color=colour, zorder=3.4)
    maps.mark_failed(axes, last.trail[-1], last.failed)


def _short_outcome(last: Snapshot) -> str:
    if last.success:
        return f"{last.step} steps"
    return "collision" if last.collision else f"{int(last.visited.sum())} ROIs"


def _long_outcome(last: Snapshot) -> str:
    visited = f"{int(last.visited.sum())} of {len(last.visited)} ROIs"
    how = "collision" if last.collision else "success" if last.success else visited
    return f"{how}, {last.step} steps, return {last.team_return:,.0f}"
