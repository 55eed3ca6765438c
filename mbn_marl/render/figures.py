"""Figures of fields and episodes for print and reports, and the files of all figures."""

# They are matplotlib figures without pyplot: no display, no global state, nothing to close.

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mbn_marl.engine import Snapshot
from mbn_marl.errors import MbnError
from mbn_marl.field import Field
from mbn_marl.files import check_ending, replacing
from mbn_marl.render import maps, style

FORMATS = (".png", ".pdf", ".svg")

# The width of a figure of one field, its least and greatest height, inches.
_WIDTH, _HEIGHTS = 4.6, (3.0, 5.6)
_PANEL_WIDTH, _PAIR_WIDTH, _FIELD_WIDTH = 3.2, 2.6, 1.9  # of panels with one or two episodes, none
_TITLES = 0.6  # height of a panel's title and axis label, inches
_ROBOT: dict[str, Any] = {"marker": "o", "ls": "none", "color": style.FAINT_INK, "ms": 8}


@matplotlib.rc_context(style.MATPLOTLIB)
def field_figure(field: Field) -> Figure:
    figure, axes = _canvas(field, field.name)
    maps.draw_field(axes, field)
    maps.draw_robots(axes, field.starts)
    _explain(figure, {"ROI": maps.roi_marker(False), "start of robot i": _ROBOT})
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def fields_figure(fields: Sequence[Field]) -> Figure:
    figure, grid = _panels("fields", len(fields), 5, _FIELD_WIDTH, 2.4)
    for axes, field in zip(grid, fields, strict=True):
        maps.draw_field(axes, field, numbered=False)
        maps.draw_robots(axes, field.starts, size=7.5)
        axes.set_title(field.name, loc="left")
        maps.replace_ticks(axes, field)
    _explain(figure, {"ROI": maps.roi_marker(False), "start of robot i": _ROBOT})
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_figure(last: Snapshot, title: str | None = None) -> Figure:
    # A hollow circle marks a start, a numbered disc the end of a path; the dots between are one
    # step apart, so that their distance shows the speed.
    figure, axes = _canvas(last.field, last.field.name if title is None else title)
    _draw_map(axes, last, numbered=True)
    maps.draw_paths(axes, last)
    maps.draw_wind(axes, last)
    looks = {"ROI": maps.roi_marker(False), "ROI, visited": maps.roi_marker(True)}
    looks |= {"start": {**_ROBOT, "ms": 5, "mfc": style.WHITE}, "end of robot i": _ROBOT}
    if last.collision:
        looks["collision"] = {**maps.SQUARE, "ms": 8, "mew": 1.4}
    if last.failed.any():
        looks["failed"] = {**maps.CROSS, "ms": 7, "mew": 1.4}
    _explain(figure, looks)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_panels(lasts: Mapping[str, Snapshot], *, columns: int = 3) -> Figure:
    sides = [np.ptp(last.field.vertices, axis=0) for last in lasts.values()]
    tall = _PANEL_WIDTH * max((height / width for width, height in sides), default=1.0)
    figure, grid = _panels("panels", len(lasts), columns, _PANEL_WIDTH, tall + _TITLES)
    for axes, (title, last) in zip(grid, lasts.items(), strict=True):
        visited = f"{int(last.visited.sum())} of {len(last.visited)} ROIs"
        outcome = "collision" if last.collision else "success" if last.success else visited
        second = f"{outcome}, {last.step} steps, return {last.team_return:,.0f}"
        _draw_place(axes, last, f"{title}\n{second}", numbered=True)
        maps.draw_paths(axes, last)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def overlay_panels(
    episodes: Mapping[str, tuple[Snapshot, Snapshot]], names: tuple[str, str]
) -> Figure:
    """Draw pairs of episodes over each other: the first is dashed, visits are the second's."""

    def outcome(last: Snapshot) -> str:
        failure = "collision" if last.collision else f"{int(last.visited.sum())} ROIs"
        return f"{last.step} steps" if last.success else failure

    figure, grid = _panels("panels", len(episodes), 5, _PAIR_WIDTH, _PAIR_WIDTH + _TITLES)
    for axes, (title, pair) in zip(grid, episodes.items(), strict=True):
        words = zip(names, map(outcome, pair), strict=True)
        second = ", ".join(f"{name}: {ending}" for name, ending in words)
        _draw_place(axes, pair[1], f"{title}\n{second}", numbered=False)
        maps.fit_square(axes, pair[1].field)
        maps.draw_light_paths(axes, pair[0], dashed=True)
        maps.draw_light_paths(axes, pair[1], dashed=False)
    handles = [
        Line2D([], [], color=style.FAINT_INK, ls=look, lw=1.2, label=name)
        for name, look in zip(names, ("--", "-"), strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def check_name(path: Path) -> Path:
    return check_ending(path, *FORMATS)


@matplotlib.rc_context(style.MATPLOTLIB)
def save(figure: Figure, path: str | Path) -> Path:
    """Write ``figure`` as PNG, PDF or SVG, as the end of ``path`` says, and return ``path``."""
    path = check_name(Path(path))
    with replacing(path) as temporary:
        figure.savefig(temporary)
    return path


def _canvas(field: Field, title: str) -> tuple[Figure, Axes]:
    width, height = np.ptp(field.vertices, axis=0)
    tall = float(np.clip(_WIDTH * height / width + 0.6, *_HEIGHTS))
    figure = Figure(figsize=(_WIDTH, tall), layout="constrained")
    axes = figure.add_subplot(xlabel="x (units)", ylabel="y (units)")
    axes.set_title(title, loc="left")
    return figure, axes


def _explain(figure: Figure, looks: Mapping[str, Mapping[str, Any]]) -> None:
    handles = [Line2D([], [], label=label, **look) for label, look in looks.items()]
    columns = len(handles) if len(handles) <= 4 else 3
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=1.2)


def _panels(
    what: str, count: int, columns: int, width: float, height: float
) -> tuple[Figure, list[Axes]]:
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


def _draw_map(axes: Axes, last: Snapshot, *, numbered: bool) -> None:
    maps.draw_field(
        axes,
        last.field,
        robots=len(last.failed),
        visited=last.visited,
        roi_radius=last.roi_radius,
        numbered=numbered,
    )


def _draw_place(axes: Axes, last: Snapshot, title: str, *, numbered: bool) -> None:
    _draw_map(axes, last, numbered=numbered)
    maps.draw_wind(axes, last, height=20.5, named="wind " not in title)
    axes.set_title(title, loc="left", fontsize=9.0)
