"""Learning curves: the mean return over seeds with its interval, against env-steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.scales import scale_returns

Curves = Mapping[str, Sequence[tuple[NDArray[Any], NDArray[Any]]]]
"""For each algorithm, per seed, ``(steps, returns)``."""

FloatArray = NDArray[np.float64]

Band = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Steps, mean, and the two ends of the band, (k,) each."""

_RESAMPLES = 10_000
_MARKERS_A_LINE = 8


def curves_figure(
    curves: Curves, threshold: float | None, optimum: float | None, looks: Mapping[str, int] | None
) -> Figure:
    """See :func:`mbn_marl.render.figures.learning_curves`."""
    if not curves:
        raise MbnError("curves: there is no algorithm to draw")
    looks = {name: index for index, name in enumerate(curves)} if looks is None else looks
    lines = {name: mean_and_band(name, runs) for name, runs in curves.items()}
    marks = [mark for mark in (threshold, optimum) if mark is not None]
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(5.0, 3.6), layout="constrained")
        axes = figure.add_subplot()
        for name, band in lines.items():
            seeds = len(curves[name])
            label = f"{name} ({seeds} seed{'' if seeds == 1 else 's'})"
            draw_curve(axes, band, style.series(looks[name]), label, banded=seeds > 1)
        ends = [end for band in lines.values() for end in band[2:]]
        lowest = min(float(end.min()) for end in ends)
        note = scale_returns(axes, "y", lowest, max(*(float(end.max()) for end in ends), *marks))
        _mark(axes, threshold, "threshold", ":")
        _mark(axes, optimum, "optimum", "-")
        axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
        axes.set_xlabel("env-steps")
        axes.set_ylabel(f"return: mean, 95 % band over seeds{note}")
        axes.grid(True)
        figure.legend(loc="outside lower center", ncols=min(len(lines), 3))
    return figure


def draw_curve(
    axes: Axes, band: Band, look: style.SeriesStyle, label: str, *, banded: bool
) -> None:
    """Draw a mean as a line with sparse markers, and its band if it is ``banded``."""
    steps, mean, low, high = band
    axes.plot(
        steps,
        mean,
        color=look.colour,
        ls=look.dash,
        marker=look.marker,
        ms=4,
        markevery=max(len(steps) // _MARKERS_A_LINE, 1),
        label=label,
        zorder=3,
    )
    if banded:
        axes.fill_between(steps, low, high, color=look.colour, alpha=0.18, lw=0)


def mean_and_band(name: str, runs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> Band:
    """Steps, mean, and the ends of the 95 % percentile bootstrap over seeds, (k,) each.

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
    if not (np.isfinite(steps).all() and np.isfinite(returns).all()):
        raise MbnError(f"{place}: steps and returns have to be finite")
    if not (np.diff(steps) > 0).all():
        raise MbnError(f"{place}: the steps have to increase")
    return steps, returns


def _mark(axes: Axes, value: float | None, label: str, dash: str) -> None:
    """A horizontal line at ``value`` with its label, at the left."""
    if value is None:
        return
    axes.axhline(value, color=style.FAINT_INK, ls=dash, lw=1.0, zorder=2)
    axes.annotate(
        f"{label} {value:,.0f}",
        (0.008, value),
        xycoords=("axes fraction", "data"),
        xytext=(0, 2),
        textcoords="offset points",
        va="bottom",
        fontsize=7.5,
        color=style.FAINT_INK,
    )
