"""Figures for print and reports: fields, trajectories, learning curves, comparisons, studies.

They are matplotlib figures without pyplot: no display, no global state, nothing to close.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from mbn_marl.errors import MbnError
from mbn_marl.files import replacing
from mbn_marl.render import style
from mbn_marl.render.curve_panels import Panel, panels_figure
from mbn_marl.render.curves import Curves, curves_figure
from mbn_marl.render.estimates import chances_figure, intervals_figure, profiles_figure
from mbn_marl.render.maps import (
    draw_field,
    draw_trails,
    field_figure,
    fields_figure,
    trajectory_figure,
)
from mbn_marl.render.pairs import Pair, pairs_figure
from mbn_marl.render.panels import overlay_panels, trajectory_panels
from mbn_marl.render.study import StudyTrial, study_figure

__all__ = [
    "FORMATS",
    "Pair",
    "Panel",
    "StudyTrial",
    "chances_figure",
    "check_name",
    "draw_field",
    "draw_trails",
    "field_figure",
    "fields_figure",
    "intervals_figure",
    "learning_curve_panels",
    "learning_curves",
    "overlay_panels",
    "pairs",
    "profiles_figure",
    "save",
    "study_figure",
    "svg",
    "trajectory_figure",
    "trajectory_panels",
]

FORMATS = (".png", ".pdf", ".svg")


def learning_curves(
    curves: Curves,
    threshold: float | None = None,
    optimum: float | None = None,
    path: str | Path | None = None,
    looks: Mapping[str, int] | None = None,
) -> Figure:
    """The mean return over seeds against env-steps, with its 95 % band, a line per algorithm.

    The band is the percentile bootstrap over seeds; one seed has none. A line spans the steps
    that all its seeds cover; between two evaluations of a seed its return is interpolated. If
    returns of early training lie far below the others, the axis is logarithmic below minus the
    highest return drawn, and its label says so.

    Args:
        curves: for each algorithm a list with, per seed, ``(steps, returns)``: two finite arrays
            (k,), the steps in env-steps and increasing.
        threshold: a return to mark, or ``None``.
        optimum: the best possible return, to mark, or ``None``.
        path: where to :func:`save` it as well, or ``None``.
        looks: the number of each algorithm's style; ``None`` numbers them in order.

    Raises:
        MbnError: naming the algorithm and the seed whose arrays are not as above, or the path.
        OSError: naming the path, if it cannot be written.
    """
    figure = curves_figure(curves, threshold, optimum, looks)
    if path is not None:
        save(figure, path)
    return figure


def learning_curve_panels(
    panels: Mapping[str, Panel], looks: Mapping[str, int], threshold: float
) -> Figure:
    """Learning curves as in :func:`learning_curves`, a panel a field, on common axes.

    Args:
        panels: for each title the curves of its panel.
        looks: the number of each algorithm's style, in the order of the legend.
        threshold: a return to mark.

    Raises:
        MbnError: naming the panel, the algorithm and the seed whose arrays cannot be a curve.
    """
    return panels_figure(panels, looks, threshold)


def pairs(
    panels: Mapping[str, Mapping[str, Pair]], names: tuple[str, str], threshold: float
) -> Figure:
    """Two returns side by side on a line each, a panel an algorithm, on common axes.

    Args:
        panels: for each title, for each line of its panel, the two returns.
        names: what the first and the second return of each pair are.
        threshold: a return to mark.

    Raises:
        MbnError: there is no return at all.
    """
    return pairs_figure(panels, names, threshold)


def check_name(path: Path) -> Path:
    """``path``, if a figure can be written there as far as its name goes.

    Raises:
        MbnError: for another format, naming the path and the formats.
    """
    if path.suffix.lower() not in FORMATS:
        raise MbnError(f"{path}: the file name has to end in {', '.join(FORMATS)}")
    return path


def save(figure: Figure, path: str | Path) -> Path:
    """Write ``figure`` as PNG, PDF or SVG, as the end of ``path`` says.

    Missing folders are made; a file is replaced only once the new one is complete.

    Returns:
        The path.

    Raises:
        MbnError: for another format, naming the path and the formats.
        OSError: naming the path, if it cannot be written.
    """
    path = check_name(Path(path))
    with replacing(path) as temporary, matplotlib.rc_context(style.MATPLOTLIB):
        figure.savefig(temporary)
    return path


def svg(figure: Figure) -> bytes:
    """``figure`` as an SVG picture whose ground and inks follow the reader's light or dark mode."""
    stream = io.StringIO()
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure.savefig(stream, format="svg", facecolor="none")
    picture, light, dark = stream.getvalue(), "", ""
    for number, (colour, themes) in enumerate(style.THEMED.items()):
        picture = re.sub(colour, f"var(--c{number})", picture, flags=re.IGNORECASE)
        light, dark = (
            f"{rules}--c{number}:{theme};"
            for rules, theme in zip((light, dark), themes, strict=True)
        )
    rules = f":root{{{light}}}@media (prefers-color-scheme: dark){{:root{{{dark}}}}}"
    return re.sub(r"(<svg[^>]*>)", rf"\1<style>{rules}</style>", picture, count=1).encode()
