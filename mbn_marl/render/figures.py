"""Figures of fields and episodes, to scale, for print and reports, and the files of all figures."""

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
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path as Outline
from matplotlib.patheffects import withStroke
from matplotlib.text import OffsetFrom
from matplotlib.transforms import Affine2D, ScaledTranslation
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import Snapshot
from mbn_marl.errors import MbnError
from mbn_marl.field import Field
from mbn_marl.files import check_ending, replacing
from mbn_marl.render import style

FORMATS = (".png", ".pdf", ".svg")

# The width of a figure of one field, its least and greatest height, inches.
_WIDTH, _HEIGHTS = 4.6, (3.0, 5.6)
_PANEL_WIDTH, _PAIR_WIDTH, _FIELD_WIDTH = 3.2, 2.6, 1.9  # of panels with one or two episodes, none
_TITLES = 0.6  # height of a panel's title and axis label, inches
_ROBOT: dict[str, Any] = {"marker": "o", "ls": "none", "color": style.FAINT_INK, "ms": 8}
_ROI_RADIUS = NavigationConfig().roi_radius
_CROSS: dict[str, Any] = {"marker": "x", "ls": "none", "color": style.INK}
_SQUARE: dict[str, Any] = {"marker": "s", "ls": "none", "mfc": "none", "mec": style.COLLISION}
_ARROW = {
    **dict.fromkeys(("shrinkA", "shrinkB"), 0),
    **{"arrowstyle": "-|>", "mutation_scale": 11, "lw": 1.6, "color": style.WIND},
}
_NOSE = Outline([(1.0, 0.0), (0.3, 0.4), (0.3, -0.4), (1.0, 0.0)], closed=True)
_BORDER = 0.06  # empty border round a field, as a share of its larger side


@matplotlib.rc_context(style.MATPLOTLIB)
def field_figure(field: Field) -> Figure:
    figure, axes = _canvas(field, field.name)
    _draw_field(axes, field)
    _draw_robots(axes, field.starts)
    _explain(figure, {"ROI": _roi_marker(False), "start of robot i": _ROBOT})
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def fields_figure(fields: Sequence[Field]) -> Figure:
    figure, grid = _panels("fields", len(fields), 5, _FIELD_WIDTH, 2.4)
    for axes, field in zip(grid, fields, strict=True):
        _draw_field(axes, field, numbered=False)
        _draw_robots(axes, field.starts, size=7.5)
        axes.set_title(field.name, loc="left")
        _replace_ticks(axes, field)
    _explain(figure, {"ROI": _roi_marker(False), "start of robot i": _ROBOT})
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_figure(last: Snapshot, title: str | None = None) -> Figure:
    # A hollow circle marks a start, a numbered disc the end of a path; the dots between are one
    # step apart, so that their distance shows the speed.
    figure, axes = _canvas(last.field, last.field.name if title is None else title)
    _draw_map(axes, last, numbered=True)
    _draw_paths(axes, last)
    _draw_wind(axes, last)
    looks = {"ROI": _roi_marker(False), "ROI, visited": _roi_marker(True)}
    looks |= {"start": {**_ROBOT, "ms": 5, "mfc": style.WHITE}, "end of robot i": _ROBOT}
    if last.collision:
        looks["collision"] = {**_SQUARE, "ms": 8, "mew": 1.4}
    if last.failed.any():
        looks["failed"] = {**_CROSS, "ms": 7, "mew": 1.4}
    _explain(figure, looks)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def trajectory_panels(lasts: Mapping[str, Snapshot], *, columns: int = 3) -> Figure:
    sides = [np.ptp(last.field.vertices, axis=0) for last in lasts.values()]
    tall = _PANEL_WIDTH * max((height / width for width, height in sides), default=1.0)
    figure, grid = _panels("panels", len(lasts), columns, _PANEL_WIDTH, tall + _TITLES)
    for axes, (title, last) in zip(grid, lasts.items(), strict=True):
        count = len(last.visited) - np.count_nonzero(last.empty)
        visited = f"{int(last.visited.sum())} of {count} ROIs"
        outcome = "collision" if last.collision else "success" if last.success else visited
        second = f"{outcome}, {last.step} steps, return {last.team_return:,.0f}"
        _draw_place(axes, last, f"{title}\n{second}", numbered=True)
        _draw_paths(axes, last)
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
        _fit_square(axes, pair[1].field)
        _draw_light_paths(axes, pair[0], dashed=True)
        _draw_light_paths(axes, pair[1], dashed=False)
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
    undated = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower())
    with replacing(path) as temporary:
        figure.savefig(temporary, metadata=undated)
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
    _draw_field(
        axes,
        last.field,
        robots=len(last.failed),
        visited=last.visited,
        roi_radius=last.roi_radius,
        numbered=numbered,
    )


def _draw_place(axes: Axes, last: Snapshot, title: str, *, numbered: bool) -> None:
    _draw_map(axes, last, numbered=numbered)
    _draw_wind(axes, last, height=20.5, named="wind " not in title)
    axes.set_title(title, loc="left", fontsize=9.0)


def _draw_field(
    axes: Axes,
    field: Field,
    *,
    robots: int | None = None,
    visited: NDArray[np.bool_] | None = None,
    roi_radius: float = _ROI_RADIUS,
    numbered: bool = True,
) -> None:
    axes.set_facecolor(style.OBSTACLE)
    ground = orient(field.polygon)  # holes turn against the outline, so that they stay empty
    rings = [Outline(np.array(ring.coords)) for ring in (ground.exterior, *ground.interiors)]
    look = {"fc": style.GROUND, "ec": style.OUTLINE, "lw": 1.3}
    axes.add_patch(PathPatch(Outline.make_compound_path(*rings), **look))
    seen = np.zeros(len(field.rois), bool) if visited is None else visited
    for number, ((x, y), done) in enumerate(zip(field.rois, seen, strict=True), start=1):
        may = field.mine[:robots, number - 1]
        only = "" if may.all() else " " + ",".join(map(str, np.flatnonzero(may)))
        colour = style.ROI_VISITED if done else style.ROI_OPEN
        tint = (colour, 0.28 if done else 0.05)
        axes.add_patch(Circle((x, y), roi_radius, fc=tint, ec=colour, lw=0.7, zorder=2))
        # Above a robot's disc and below its number, so that neither hides the other.
        halo = [withStroke(linewidth=2.0, foreground=style.WHITE)]
        axes.plot([x], [y], **_roi_marker(bool(done)), zorder=4.2, path_effects=halo)
        if numbered:
            axes.annotate(
                f"$w_{{{number}}}${only}",  # and the robots that may visit it, if not all may
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


def _fit_square(axes: Axes, field: Field) -> tuple[NDArray[np.float64], float]:
    """Show a square about the field; return its lower left corner and its side, units."""
    low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
    side = (1.0 + 2.0 * _BORDER) * float((high - low).max())
    corner: NDArray[np.float64] = (low + high - side) / 2.0
    axes.set_xlim(corner[0], corner[0] + side)
    axes.set_ylim(corner[1], corner[1] + side)
    return corner, side


def _replace_ticks(axes: Axes, field: Field) -> None:
    """Show a square about the field, and a scale bar of round length below instead of ticks."""
    (left, _), side = _fit_square(axes, field)
    decade = 10.0 ** np.floor(np.log10(side / 3.0))
    bar = max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= side / 3.0)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    axes.spines[:].set_visible(False)
    below: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "clip_on": False}
    axes.plot([left, left + bar], [-0.06, -0.06], color=style.OUTLINE, lw=2.0, **below)
    place: dict[str, Any] = {"xycoords": below["transform"], "textcoords": "offset points"}
    place |= {"va": "center", "fontsize": 7, "annotation_clip": False}
    axes.annotate(f"{bar:g} units", (left + bar, -0.06), (3, 0), **place)


def _draw_paths(axes: Axes, last: Snapshot) -> None:
    for index in range(last.trail.shape[1]):
        colour = style.robot_colour(index)
        x, y = last.trail[:, index].T
        axes.plot(x, y, color=colour, lw=0.8, zorder=3)
        axes.plot(x, y, ".", color=colour, ms=3.6, mew=0, zorder=3)
        axes.plot(x[:1], y[:1], "o", color=colour, mfc=style.WHITE, ms=5, mew=1.3, zorder=3.5)
    _draw_robots(axes, last.trail[-1], headings=last.headings)
    _mark_failed(axes, last)
    if last.collision:  # a square round the two robots that are closest
        positions = last.trail[-1][~last.gone]
        gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        np.fill_diagonal(gaps, np.inf)
        first, second = np.unravel_index(int(gaps.argmin()), gaps.shape)
        x, y = (positions[first] + positions[second]) / 2.0
        axes.plot([x], [y], ms=25, mew=1.8, zorder=5, **_SQUARE)


def _draw_light_paths(axes: Axes, last: Snapshot, *, dashed: bool) -> None:
    """Draw paths to lie over others; a dashed one is wider, so that both can be seen."""
    for robot, heading in enumerate(last.headings.tolist()):
        colour = style.robot_colour(robot)
        x, y = last.trail[:, robot].T
        if dashed:
            axes.plot(x, y, "--", color=colour, lw=2.2, alpha=0.45, zorder=3)
        else:
            axes.plot(x, y, "-", color=colour, lw=1.0, zorder=3.2)
            axes.plot(x[:1], y[:1], "o", color=colour, mfc=style.WHITE, ms=4, mew=1.1, zorder=3.5)
            axes.plot(x[-1:], y[-1:], "o", color=colour, ms=4.5, zorder=3.5)
            _draw_nose(axes, (x[-1], y[-1]), heading, 4.5, color=colour, zorder=3.4)
    _mark_failed(axes, last)


def _draw_robots(
    axes: Axes, positions: NDArray[Any], size: float = 9.5, headings: NDArray[Any] | None = None
) -> None:
    for index, (x, y) in enumerate(positions.tolist()):
        colour = style.robot_colour(index)
        if headings is not None:
            _draw_nose(axes, (x, y), float(headings[index]), size, color=colour, zorder=4)
        axes.plot([x], [y], "o", color=colour, ms=size, mec=style.WHITE, mew=0.8, zorder=4)
        axes.annotate(
            str(index),
            (x, y),
            ha="center",
            va="center_baseline",
            fontsize=0.68 * size,
            fontweight="bold",
            color=style.ink_on(colour),
            zorder=4.4,
        )


def _draw_nose(
    axes: Axes, place: tuple[float, float], heading: float, size: float, **look: Any
) -> None:
    """Draw the point of a disc, ``size`` points wide, that faces ``heading`` unless it is NaN."""
    if np.isfinite(heading):
        nose = MarkerStyle(_NOSE, transform=Affine2D().rotate(heading))
        axes.plot(*place, ls="none", marker=nose, ms=2 * size, mew=0, **look)


def _mark_failed(axes: Axes, last: Snapshot) -> None:
    if last.failed.any():
        axes.plot(*last.trail[-1][last.failed].T, ms=11, mew=1.8, zorder=4.5, **_CROSS)


def _draw_wind(axes: Axes, last: Snapshot, height: float = 9.5, *, named: bool = True) -> None:
    """Draw the winds of an episode ``height`` points over the top right corner, if any."""
    # One is an arrow the way that it blows; gusts are a line for the strongest of each twelfth of a
    # turn. The greatest speed is written beside them if it is ``named``.
    winds = np.unique(last.winds, axis=0)
    speeds = np.linalg.norm(winds, axis=1)
    if speeds.max() < style.CALM:
        return
    if len(winds) > 1:
        order = np.argsort(-speeds)
        twelfths = np.round(6.0 / np.pi * np.arctan2(*winds[order].T[::-1])) % 12
        winds = winds[order][np.unique(twelfths, return_index=True)[1]]
    corner = OffsetFrom(axes.patch, (1.0, 1.0), unit="points")
    place: dict[str, Any] = {"xycoords": corner, "textcoords": corner, "annotation_clip": False}
    middle, arms = np.array([-11.0, height]), 9.0 * winds / speeds.max()
    if len(speeds) == 1:
        ends = tuple(middle + arms[0]), tuple(middle - arms[0])
        axes.annotate("", *ends, arrowprops=_ARROW, **place)
    else:
        lines = np.full((len(winds), 3, 2), np.nan)
        lines[:, 0], lines[:, 1] = middle, middle + arms
        inches: Any = axes.get_figure()  # matplotlib types transforms too narrowly
        whole: Any = axes.transAxes
        points = Affine2D().scale(1.0 / 72.0) + inches.dpi_scale_trans
        points += ScaledTranslation(1.0, 1.0, whole)
        look: dict[str, Any] = {"lw": 0.6, "color": style.WIND, "clip_on": False}
        axes.add_artist(Line2D(*lines.reshape(-1, 2).T, transform=points, **look))
    if named:
        most = "" if len(speeds) == 1 else "\N{LESS-THAN OR EQUAL TO} "
        look = {"ha": "right", "va": "center", "color": style.WIND}
        axes.annotate(f"wind {most}{speeds.max():.3g}", (-25.0, middle[1]), **look, **place)


def _roi_marker(visited: bool) -> dict[str, Any]:
    if visited:
        return {"marker": "$\\checkmark$", "ms": 7, "color": style.ROI_VISITED, "ls": "none"}
    return {"marker": "o", "ms": 4, "mfc": "none", "color": style.ROI_OPEN, "ls": "none"}
