"""Figures of returns: learning curves, and two settings side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style

FloatArray = NDArray[np.float64]

Curves = Mapping[str, Sequence[tuple[NDArray[Any], NDArray[Any]]]]
"""For each algorithm, per seed, env-steps and returns: finite, (k,) each; the steps increase."""

Band = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Steps, mean, and the two ends of the band, (k,) each."""

_RESAMPLES = 10_000
_RULE: dict[str, Any] = {"color": style.FAINT_INK, "lw": 1.0}  # the look of a marked return
_AT_VALUE: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "color": style.FAINT_INK}
_PAIR_MARKS: tuple[dict[str, Any], ...] = (
    {"marker": "o", "ls": "none", "color": style.BLUE, "mfc": style.WHITE, "ms": 7.5, "mew": 1.3},
    {"marker": "s", "ls": "none", "color": style.VERMILLION, "ms": 3.8},
)
"""The first of a pair is a ring, the second a square that fits inside."""


class Panel(NamedTuple):
    """Learning curves of one field, and the best possible return to mark, or ``None``."""

    curves: Curves
    optimum: float | None


class Pair(NamedTuple):
    """Two returns to compare; ``None`` is missing."""

    first: float | None
    second: float | None


@matplotlib.rc_context(style.MATPLOTLIB)
def learning_curves(
    curves: Curves,
    threshold: float | None = None,
    optimum: float | None = None,
    looks: Mapping[str, int] | None = None,
) -> Figure:
    """Draw the mean return over seeds against env-steps with its 95 % band, a line per algorithm.

    The band is the percentile bootstrap over seeds; one seed has none. A line spans the steps
    that all its seeds cover; between two evaluations of a seed its return is interpolated. If
    returns of early training lie far below the others, the axis is logarithmic below minus the
    highest return drawn, and its label says so.

    Args:
        curves: of each algorithm.
        threshold: a return to mark, or ``None``.
        optimum: the best possible return, to mark, or ``None``.
        looks: the number of each algorithm's style; ``None`` numbers them in order.

    Raises:
        MbnError: naming the algorithm and the seed whose arrays cannot be a curve.
    """
    if not curves:
        raise MbnError("curves: there is no algorithm to draw")
    looks = {name: index for index, name in enumerate(curves)} if looks is None else looks
    bands = {name: mean_and_band(name, runs) for name, runs in curves.items()}
    figure = Figure(figsize=(5.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, band in bands.items():
        seeds = len(curves[name])
        label = f"{name} ({seeds} seed{'' if seeds == 1 else 's'})"
        _draw_curve(axes, band, style.series(looks[name]), label, banded=seeds > 1)
    given = (("threshold", threshold, ":"), ("optimum", optimum, "-"))
    marks = [(label, mark, dash) for label, mark, dash in given if mark is not None]
    note = _scale_bands(axes, bands.values(), [mark for _, mark, _ in marks])
    for label, mark, dash in marks:
        axes.axhline(mark, ls=dash, zorder=2, **_RULE)
        place: dict[str, Any] = {"xytext": (0, 2), "textcoords": "offset points", "va": "bottom"}
        axes.annotate(f"{label} {mark:,.0f}", (0.008, mark), fontsize=7.5, **place, **_AT_VALUE)
    axes.set(xlabel="env-steps", ylabel=f"return: mean, 95 % band over seeds{note}")
    axes.grid(True)
    figure.legend(loc="outside lower center", ncols=min(len(bands), 3))
    return figure


@matplotlib.rc_context({**style.MATPLOTLIB, "lines.linewidth": 1.2})
def learning_curve_panels(
    panels: Mapping[str, Panel], looks: Mapping[str, int], threshold: float
) -> Figure:
    """Draw learning curves as :func:`learning_curves`, a panel a field, on common axes.

    Args:
        panels: by title.
        looks: the number of each algorithm's style, in the order of the legend.
        threshold: a return to mark.

    Raises:
        MbnError: naming the panel, the algorithm and the seed whose arrays cannot be a curve.
    """
    bands = {
        (title, name): mean_and_band(f"{title}, {name}", seeds)
        for title, panel in panels.items()
        for name, seeds in panel.curves.items()
    }
    if not bands:
        raise MbnError("panels: there is no curve to draw")
    styles = {name: style.series(index) for name, index in looks.items()}
    optima = [panel.optimum for panel in panels.values() if panel.optimum is not None]
    figure, grid = _layout(len(panels), 2.2)
    for axes, (title, panel) in zip(grid, panels.items(), strict=True):
        for name, seeds in panel.curves.items():
            _draw_curve(axes, bands[title, name], styles[name], name, banded=len(seeds) > 1)
        axes.axhline(threshold, ls=":", zorder=2, **_RULE)
        if panel.optimum is not None:
            axes.axhline(panel.optimum, zorder=2, **_RULE)
        axes.set_title(title, loc="left")
        axes.grid(True)
    note = _scale_bands(grid[0], bands.values(), [threshold, *optima], ticks=2)
    for axes in grid[-2:]:
        axes.set_xlabel("env-steps")
    figure.supylabel(f"return of training episodes, moving mean{note}", fontsize=9.0, ha="center")
    drawn = {name for _, name in bands}
    handles = [
        Line2D([], [], c=look.colour, ls=look.dash, marker=look.marker, ms=4, label=name)
        for name, look in styles.items()
        if name in drawn
    ]
    handles.append(Line2D([], [], ls=":", label=f"threshold {threshold:,.0f}", **_RULE))
    if optima:
        handles.append(Line2D([], [], label="proved optimum", **_RULE))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=3.2)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def pairs(
    panels: Mapping[str, Mapping[str, Pair]], names: tuple[str, str], threshold: float
) -> Figure:
    """Draw two returns side by side on a line each, a panel an algorithm, on common axes.

    Args:
        panels: for each title, for each line of its panel, the two returns.
        names: what the first and the second return of each pair are.
        threshold: a return to mark.

    Raises:
        MbnError: there is no return at all.
    """
    found = [pair for panel in panels.values() for pair in panel.values()]
    values = [value for pair in found for value in pair if value is not None]
    if not values:
        raise MbnError("pairs: there is no return to draw")
    labels = list(dict.fromkeys(label for panel in panels.values() for label in panel))
    figure, grid = _layout(len(panels), 0.19 * len(labels) + 0.5)
    for axes, (title, panel) in zip(grid, panels.items(), strict=True):
        for place, label in enumerate(labels):
            _draw_pair(axes, place, panel.get(label, Pair(None, None)))
        axes.axvline(threshold, ls=":", zorder=1, **_RULE)
        axes.set_title(title, loc="left")
        axes.grid(True, axis="x")
    grid[0].set_yticks(range(len(labels)), labels)
    grid[0].set_ylim(len(labels) - 0.4, -0.6)
    note = _scale_returns(grid[0], "x", min(values), max(threshold, *values), ticks=2)
    for axes in grid[-2:]:
        axes.set_xlabel(f"mean return during training{note}")
    handles = [
        Line2D([], [], label=name, **mark) for name, mark in zip(names, _PAIR_MARKS, strict=True)
    ]
    handles.append(Line2D([], [], ls=":", label=f"threshold {threshold:,.0f}", **_RULE))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def mean_and_band(name: str, runs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Band:
    """Return steps, mean, and the ends of the 95 % percentile bootstrap over seeds, (k,) each.

    The steps are all those of any seed that lie within every seed's range.

    Raises:
        MbnError: naming ``name`` and the seed whose arrays cannot be a curve.
    """
    if not runs:
        raise MbnError(f"{name}: there is no seed to draw")
    checked = [_checked(f"{name}, seed {index}", *run) for index, run in enumerate(runs)]
    first = max(steps[0] for steps, _ in checked)
    last = min(steps[-1] for steps, _ in checked)
    if first > last:
        raise MbnError(f"{name}: the seeds have no range of env-steps in common")
    every = np.unique(np.concatenate([steps for steps, _ in checked]))
    grid = every[(every >= first) & (every <= last)]
    values = np.stack([np.interp(grid, steps, returns) for steps, returns in checked])
    count = len(values)
    drawn = np.random.default_rng(0).integers(0, count, (_RESAMPLES, count))
    weights = np.stack([(drawn == seed).mean(axis=1) for seed in range(count)], axis=1)
    low, high = np.percentile(weights @ values, [2.5, 97.5], axis=0)
    return grid, values.mean(axis=0), low, high


def _checked(
    place: str, steps: NDArray[Any], returns: NDArray[Any]
) -> tuple[FloatArray, FloatArray]:
    steps, returns = np.asarray(steps, np.float64), np.asarray(returns, np.float64)
    if steps.ndim != 1 or steps.shape != returns.shape or not steps.size:
        shapes = f"{steps.shape} and {returns.shape}"
        raise MbnError(f"{place}: steps and returns have to be two arrays (k,), not {shapes}")
    if not np.isfinite([steps, returns]).all():
        raise MbnError(f"{place}: steps and returns have to be finite")
    if not (np.diff(steps) > 0).all():
        raise MbnError(f"{place}: the steps have to increase")
    return steps, returns


def _layout(count: int, tall: float) -> tuple[Figure, NDArray[np.object_]]:
    """Make a figure of ``count`` panels, ``tall`` inches each, with common axes, two a row."""
    columns = min(count, 2)
    rows = -(-count // columns)
    figure = Figure(figsize=(7.2, tall * rows + 0.75), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for empty in grid[count:]:
        empty.set_visible(False)
    if count < grid.size:
        grid[count - columns].tick_params(axis="x", labelbottom=True)
    return figure, grid[:count]


def _draw_curve(
    axes: Axes, band: Band, look: style.SeriesStyle, label: str, *, banded: bool
) -> None:
    """Draw a mean as a line with sparse markers, and its band if it is ``banded``."""
    steps, mean, low, high = band
    every = max(len(steps) // 8, 1)
    shape: dict[str, Any] = {"ls": look.dash, "marker": look.marker, "ms": 4, "markevery": every}
    axes.plot(steps, mean, color=look.colour, label=label, zorder=3, **shape)
    if banded:
        axes.fill_between(steps, low, high, color=look.colour, alpha=0.18, lw=0)


def _draw_pair(axes: Axes, place: int, pair: Pair) -> None:
    """Draw both marks at a height, joined; write a word for what is missing."""
    if pair.first is not None and pair.second is not None:
        axes.plot([pair.first, pair.second], [place, place], zorder=2, **_RULE)
    for value, mark in zip(pair, _PAIR_MARKS, strict=True):
        if value is not None:
            axes.plot([value], [place], zorder=3, clip_on=False, **mark)
    if pair == (None, None):
        axes.annotate("missing", (0.02, place), va="center", fontsize=7.0, **_AT_VALUE)


def _scale_bands(
    axes: Axes, bands: Iterable[Band], marks: Sequence[float], *, ticks: int = 4
) -> str:
    """Scale both axes for bands and marked returns; return the note of :func:`_scale_returns`."""
    ends = [end for band in bands for end in band[2:]]
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    highest = max(*(float(end.max()) for end in ends), *marks)
    return _scale_returns(axes, "y", min(float(end.min()) for end in ends), highest, ticks=ticks)


def _scale_returns(
    axes: Axes, which: Literal["x", "y"], bottom: float, top: float, *, ticks: int = 4
) -> str:
    """Scale an axis for returns: linear where policies that work lie, logarithmic far below.

    The axis is linear from ``top`` down to minus its size if ``bottom`` is far below, with about
    ``ticks`` ticks. The answer is a note for its label that says where it is logarithmic, empty
    if nowhere.
    """
    axis = axes.xaxis if which == "x" else axes.yaxis
    top = top or 1.0  # the axis needs a size
    if bottom >= (-2.0 * top if top >= 0.0 else 5.0 * top):
        axis.set_major_locator(MaxNLocator(ticks + 2, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(EngFormatter(sep=" "))
        return ""
    turn = abs(top)
    linear = 1.5 * max(float(np.log10(-bottom / turn)), 1.0) if top > 0.0 else 1.0
    getattr(axes, f"set_{which}scale")("symlog", linthresh=turn, linscale=linear)
    axis.set_ticks(_ticks(bottom, top, ticks, every=2 if which == "x" else 1))
    axes.minorticks_off()
    axis.set_major_formatter(EngFormatter(sep=" "))
    axes.set(**{f"{which}lim": (1.3 * bottom, 1.15 * top if top > 0.0 else 0.8 * top)})
    return f"\n(logarithmic below {EngFormatter(places=0, sep=' ')(-turn)})"


def _ticks(bottom: float, top: float, count: int, *, every: int) -> list[float]:
    """Return powers of ten below, and round numbers between minus ``top`` and ``top`` above.

    Of the powers, those from the largest on that are a multiple of ``every`` away from it: words
    side by side take more room than words below each other.
    """
    if top < 0.0:
        exponents = np.arange(np.floor(np.log10(-top)), np.floor(np.log10(-bottom)) + 1)
        rounds = -np.outer(10.0**exponents, [1.0, 3.0]).ravel()
        return [float(value) for value in rounds if 1.3 * bottom <= value <= 0.8 * top]
    inner = np.asarray(MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(-top, top))
    exponents = np.arange(np.ceil(np.log10(1.5 * top)), np.floor(np.log10(-bottom)) + 1)
    return [*-(10.0 ** exponents[::-every]), *inner[np.abs(inner) <= top]]
