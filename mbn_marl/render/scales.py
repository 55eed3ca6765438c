"""An axis for returns: linear where policies that work lie, logarithmic far below."""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator


def scale_returns(
    axes: Axes, which: Literal["x", "y"], bottom: float, top: float, *, ticks: int = 4
) -> str:
    """Scale one axis of ``axes`` for returns from ``bottom`` to ``top`` (reward units).

    Args:
        axes: where.
        which: the axis.
        bottom: the lowest return drawn.
        top: the highest. The axis is linear down to minus its size if ``bottom`` is far below.
        ticks: about how many on the linear part.

    Returns:
        A note for the axis's label that says where the scale is logarithmic; empty if nowhere.
    """
    axis = axes.xaxis if which == "x" else axes.yaxis
    if bottom >= (-2.0 * top if top >= 0.0 else 5.0 * top):
        axis.set_major_locator(MaxNLocator(ticks + 2, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(EngFormatter(sep=" "))
        return ""
    set_scale, set_limits = (
        (axes.set_xscale, axes.set_xlim) if which == "x" else (axes.set_yscale, axes.set_ylim)
    )
    turn = abs(top)
    decades = float(np.log10(-bottom / turn))
    linear = 1.5 * max(decades, 1.0) if top > 0.0 else 1.0
    set_scale("symlog", linthresh=turn, linscale=linear)
    axis.set_ticks(_ticks(bottom, top, ticks, every=2 if which == "x" else 1))
    axes.minorticks_off()
    axis.set_major_formatter(EngFormatter(sep=" "))
    set_limits(1.3 * bottom, 1.15 * top if top > 0.0 else 0.8 * top)
    return f"\n(symlog: logarithmic below {EngFormatter(places=0, sep=' ')(-turn)})"


def _ticks(bottom: float, top: float, count: int, *, every: int) -> list[float]:
    """Powers of ten below, and round numbers between minus ``top`` and ``top`` above.

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
