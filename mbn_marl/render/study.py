"""A study of hyperparameters: its history and what mattered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.render.scales import scale_returns


class StudyTrial(NamedTuple):
    """One trial of a study.

    Attributes:
        number: its number, from 0.
        value: its return, or the last one before it was pruned.
        pruned: whether it was.
    """

    number: int
    value: float
    pruned: bool


def study_figure(
    trials: Sequence[StudyTrial], importances: Mapping[str, float], title: str
) -> Figure:
    """The history of a study beside the importance of each hyperparameter.

    Args:
        trials: those that have a return, in order.
        importances: how much each hyperparameter had to do with a trial's being in the better
            half, as shares of 1, largest first; empty if that is not known.
        title: above the figure.

    Raises:
        MbnError: there is no trial.
    """
    if not trials:
        raise MbnError("study: there is no trial to draw")
    with matplotlib.rc_context(style.MATPLOTLIB):
        figure = Figure(figsize=(7.2, 2.9), layout="constrained")
        history, bars = figure.subplots(1, 2, width_ratios=(3, 2))
        _draw_history(history, trials)
        _draw_importances(bars, importances)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.0)
        figure.legend(*history.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _draw_history(axes: Axes, trials: Sequence[StudyTrial]) -> None:
    finished = [trial for trial in trials if not trial.pruned]
    pruned = [trial for trial in trials if trial.pruned]
    if finished:
        best = np.maximum.accumulate([trial.value for trial in finished])
        places = [trial.number for trial in finished]
        axes.step(places, best, where="post", color=style.ORANGE, lw=1.6, label="best so far")
        axes.plot(*_points(finished), "o", color=style.BLUE, ms=4.5, label="finished", zorder=3)
    if pruned:
        axes.plot(
            *_points(pruned), "x", color=style.VERMILLION, ms=4.5, label="pruned, last return"
        )
    values = [trial.value for trial in trials]
    note = scale_returns(axes, "y", min(values), max(values))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("trial")
    axes.set_ylabel(f"mean return of fresh episodes{note}")
    axes.grid(True)


def _draw_importances(axes: Axes, importances: Mapping[str, float]) -> None:
    axes.set_xlabel("share in being in the better half")
    if not importances:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.annotate(
            "unknown: too few\nfinished trials",
            (0.5, 0.5),
            xycoords="axes fraction",
            ha="center",
            va="center",
            color=style.FAINT_INK,
        )
        return
    places = range(len(importances), 0, -1)
    bars = axes.barh(places, list(importances.values()), 0.6, color=style.BLUISH_GREEN)
    axes.bar_label(bars, fmt="{:.0%}", padding=2, fontsize=8.0)
    axes.set_yticks(places, list(importances))
    axes.set_xlim(0.0, 1.15 * max(importances.values()))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(True, axis="x")


def _points(trials: Sequence[StudyTrial]) -> tuple[list[int], list[float]]:
    return [trial.number for trial in trials], [trial.value for trial in trials]
