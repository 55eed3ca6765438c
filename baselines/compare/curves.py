"""The figures of comparisons, of the paper's report, and of a study of hyperparameters."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from baselines.compare.records import RunRecord
from baselines.compare.summary import RESAMPLES, Comparison
from baselines.evaluation.intervals import RETURN_THRESHOLD
from mbn_marl.render import style

FloatArray = NDArray[np.float64]
Curves = Mapping[str, Sequence[tuple[FloatArray, FloatArray]]]
Band = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Pair = tuple[float | None, float | None]  # two returns; ``None`` is missing

_RATIOS = (1.0, 1.1, 1.2, 1.3, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0)
_STEPS = (10, 20, 30, 40, 50, 70, 100, 200, 300, 500, 1000)
_RULE: dict[str, Any] = {"color": style.FAINT_INK, "lw": 1.0}  # the look of a marked return
_PAIR_MARKS: tuple[dict[str, Any], ...] = (
    {"marker": "o", "ls": "none", "color": style.BLUE, "mfc": style.WHITE, "ms": 7.5, "mew": 1.3},
    {"marker": "s", "ls": "none", "color": style.VERMILLION, "ms": 3.8},
)


class Panel(NamedTuple):
    """Learning curves, as of one field, and the best possible return to mark, or ``None``."""

    curves: Curves
    optimum: float | None = None


def draw_gaps(comparison: Comparison) -> Figure:
    """Draw the makespan gaps of all runs on the fields with a proved bound."""
    gaps: dict[str, list[float | None]] = {one["label"]: [] for one in comparison.aggregates}
    for run in comparison.runs:
        if run["field"] not in comparison.fields_without_bound:
            gaps[run["label"]].append(run["deterministic_gap"] if run["passed"] else None)
    return strips_figure(gaps)


def draw_learning_curves(
    field: str, groups: Mapping[str, Sequence[RunRecord]], looks: Mapping[str, int]
) -> Figure:
    points = [point for runs in groups.values() for run in runs for point in run.curve]
    bounded = all(point["spl"] is not None for point in points)
    name, title = ("spl", "SPL") if bounded else ("success_rate", "success")
    found = {
        label: [tuple(np.array([[p["env_steps"], p[name]] for p in run.curve]).T) for run in runs]
        for label, runs in groups.items()
    }
    subject = f"{title}, sampled actions: mean, 95 % band over seeds"
    return learning_curves({field: Panel(found)}, looks, subject)


@matplotlib.rc_context(style.MATPLOTLIB)
def strips_figure(groups: Mapping[str, Sequence[float | None]], *, steps: bool = False) -> Figure:
    """Draw makespan gaps, or makespans in ``steps``, a column a group, a dot a run.

    ``None`` failed. The median is a line, left out if it is a failure.
    """
    figure = Figure(figsize=(max(4.6, 0.7 * len(groups) + 1.0), 3.4), layout="constrained")
    axes = figure.add_subplot()
    least = 0.0 if steps else 1.0
    known = [least + value for values in groups.values() for value in values if value is not None]
    most = max([1.1, *known])
    top, rng = most**1.15, np.random.default_rng(0)
    for column, values in enumerate(groups.values()):
        places = column + rng.uniform(-0.25, 0.25, len(values))
        heights = np.array([top if value is None else least + value for value in values])
        failed = np.array([value is None for value in values])
        axes.plot(places[~failed], heights[~failed], "o", c=style.BLUE, ms=3.5, alpha=0.6)
        median = np.median(np.where(failed, np.inf, heights))
        if np.isfinite(median):
            axes.hlines(median, column - 0.35, column + 0.35, color=style.INK)
        if failed.any():
            axes.plot(places[failed], heights[failed], "x", c=style.VERMILLION, ms=5, clip_on=False)
    marks = {f"{n}": float(n) for n in _STEPS if 0.95 * min(known, default=1.0) <= n <= most}
    if not steps:
        marks = {f"{ratio - 1.0:.0%}": ratio for ratio in _RATIOS if ratio <= most}
    marks |= {"failed": top} if any(None in values for values in groups.values()) else {}
    bottom = 0.95 * min(known, default=1.0) if steps else min([0.99, *known])
    axes.set(yscale="log", ylim=(bottom, top))
    axes.set_yticks([*marks.values()], [*marks])
    axes.minorticks_off()
    axes.set_xticks(range(len(groups)), list(groups), rotation=30 if len(groups) > 4 else 0)
    axes.set_ylabel(f"makespan{', steps' if steps else ' over the bound'}, mean actions")
    axes.grid(True, axis="y")
    return figure


@matplotlib.rc_context({**style.MATPLOTLIB, "lines.linewidth": 1.2})
def learning_curves(
    panels: Mapping[str, Panel],
    looks: Mapping[str, int],
    subject: str,
    threshold: float | None = None,
) -> Figure:
    """Draw the mean of each name's curves against env-steps with its 95 % band.

    Values are shares, or returns if there is a ``threshold`` to mark. If early returns lie far
    below the others, the axis is logarithmic there, as its label says.
    """
    bands = {
        (title, name): mean_and_band(seeds)
        for title, panel in panels.items()
        for name, seeds in panel.curves.items()
    }
    styles = {name: style.series(look) for name, look in looks.items()}
    optima = [panel.optimum for panel in panels.values() if panel.optimum is not None]
    figure, grid = _layout(len(panels), 2.2 if len(panels) > 1 else 2.85)
    for axes, (title, panel) in zip(grid, panels.items(), strict=True):
        for name, seeds in panel.curves.items():
            look, (steps, mean, low, high) = styles[name], bands[title, name]
            shape: dict[str, Any] = {"ls": look.dash, "marker": look.marker, "ms": 4}
            every = max(len(steps) // 8, 1)
            axes.plot(steps, mean, color=look.colour, zorder=3, markevery=every, **shape)
            if len(seeds) > 1:
                axes.fill_between(steps, low, high, color=look.colour, alpha=0.18, lw=0)
        if threshold is not None:
            axes.axhline(threshold, ls=":", zorder=2, **_RULE)
        if panel.optimum is not None:
            axes.axhline(panel.optimum, zorder=2, **_RULE)
        axes.set_title(title, loc="left")
        axes.grid(True)
    grid[0].xaxis.set_major_formatter(EngFormatter(sep=" "))
    note = ""
    if threshold is None:
        grid[0].yaxis.set_major_formatter(PercentFormatter(1.0))
    else:
        ends = np.concatenate([end for band in bands.values() for end in band[2:]])
        top, ticks = max(float(ends.max()), threshold, *optima), 2 if len(panels) > 1 else 4
        note = _scale_returns(grid[0], "y", float(ends.min()), top, ticks=ticks)
    for axes in grid[-2:]:
        axes.set_xlabel("env-steps")
    figure.supylabel(f"{subject}{note}", fontsize=9.0, ha="center")
    drawn = {name for _, name in bands}
    handles = [
        Line2D([], [], c=look.colour, ls=look.dash, marker=look.marker, ms=4, label=name)
        for name, look in styles.items()
        if name in drawn
    ]
    if threshold is not None:
        handles.append(Line2D([], [], ls=":", label=f"threshold {threshold:,.0f}", **_RULE))
    if optima:
        handles.append(Line2D([], [], label="proved optimum", **_RULE))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=3.2)
    return figure


@matplotlib.rc_context(style.MATPLOTLIB)
def pairs(panels: Mapping[str, Mapping[str, Pair]], names: tuple[str, str]) -> Figure:
    """Draw two returns on a line each, a panel a title; ``names`` are those of the two."""
    found = itertools.chain(*(itertools.chain(*panel.values()) for panel in panels.values()))
    values = [value for value in found if value is not None]
    labels = list(dict.fromkeys(label for panel in panels.values() for label in panel))
    figure, grid = _layout(len(panels), 0.19 * len(labels) + 0.5)
    for axes, (title, panel) in zip(grid, panels.items(), strict=True):
        for place, label in enumerate(labels):
            pair = panel.get(label, (None, None))
            if None not in pair:
                axes.plot(pair, [place, place], zorder=2, **_RULE)
            for value, mark in zip(pair, _PAIR_MARKS, strict=True):
                if value is not None:
                    axes.plot([value], [place], zorder=3, clip_on=False, **mark)
            if pair == (None, None):
                at: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "va": "center"}
                axes.annotate("missing", (0.02, place), color=style.FAINT_INK, fontsize=7.0, **at)
        axes.axvline(RETURN_THRESHOLD, ls=":", zorder=1, **_RULE)
        axes.set_title(title, loc="left")
        axes.grid(True, axis="x")
    grid[0].set_yticks(range(len(labels)), labels)
    grid[0].set_ylim(len(labels) - 0.4, -0.6)
    note = _scale_returns(grid[0], "x", min(values), max(RETURN_THRESHOLD, *values), ticks=2)
    for axes in grid[-2:]:
        axes.set_xlabel(f"mean return during training{note}")
    handles = [
        Line2D([], [], label=name, **mark) for name, mark in zip(names, _PAIR_MARKS, strict=True)
    ]
    handles.append(Line2D([], [], ls=":", label=f"threshold {RETURN_THRESHOLD:,.0f}", **_RULE))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def mean_and_band(runs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Band:
    """Return steps, mean, and the ends of the 95 % percentile bootstrap over runs, (k,) each.

    The steps are all those of any run that lie within every run's range; between two of a run
    its value is interpolated. If there are none, as of two runs of ARS with an evaluation each,
    the one step is where the latest run begins; a run that has ended keeps its last value.
    """
    first = max(steps[0] for steps, _ in runs)
    last = max(first, min(steps[-1] for steps, _ in runs))
    every = np.unique(np.concatenate([steps for steps, _ in runs])).astype(np.float64)
    grid = every[(every >= first) & (every <= last)]
    values = np.stack([np.interp(grid, steps, returns) for steps, returns in runs])
    count = len(values)
    drawn = np.random.default_rng(0).integers(0, count, (RESAMPLES, count))
    weights = np.stack([(drawn == run).mean(axis=1) for run in range(count)], axis=1)
    low, high = np.percentile(weights @ values, [2.5, 97.5], axis=0)
    return grid, values.mean(axis=0), low, high


def _layout(count: int, tall: float) -> tuple[Figure, NDArray[np.object_]]:
    columns = min(count, 2)
    rows = -(-count // columns)
    figure = Figure(figsize=(7.2, tall * rows + 0.75), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for empty in grid[count:]:
        empty.set_visible(False)
    if count < grid.size:
        grid[count - columns].tick_params(axis="x", labelbottom=True)
    return figure, grid[:count]


def _scale_returns(
    axes: Axes, which: Literal["x", "y"], bottom: float, top: float, *, ticks: int = 4
) -> str:
    """Scale an axis for returns up to ``top`` > 0; return a note for its label."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    if bottom >= -2.0 * top:
        axis.set_major_locator(MaxNLocator(ticks + 2, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(EngFormatter(sep=" "))
        return ""
    # The linear part, from -top to top, has the policies that succeed; the decades below, failures.
    linear = 1.5 * max(float(np.log10(-bottom / top)), 1.0)
    getattr(axes, f"set_{which}scale")("symlog", linthresh=top, linscale=linear)
    near = np.asarray(MaxNLocator(ticks, steps=[1, 2, 5, 10]).tick_values(-top, top))
    powers = 10.0 ** np.arange(np.ceil(np.log10(1.5 * top)), np.floor(np.log10(-bottom)) + 1)
    # Words side by side take more room than words below each other: every second power.
    axis.set_ticks([*-powers[:: -2 if which == "x" else -1], *near[np.abs(near) <= top]])
    axes.minorticks_off()
    axis.set_major_formatter(EngFormatter(sep=" "))
    axes.set(**{f"{which}lim": (1.3 * bottom, 1.15 * top)})
    return f"\n(logarithmic below {EngFormatter(places=0, sep=' ')(-top)})"
