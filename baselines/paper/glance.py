"""How the runs compare with the paper at a glance: what was run, rankings, who got there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import kendalltau

from baselines.algorithms import SETTINGS
from baselines.compare.text_table import MISSING, Grid
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.summary import first_reach
from baselines.paper.tables import (
    ALGORITHMS,
    Column,
    Table,
    algorithms_of,
    fields_of,
)
from baselines.paper.trainings import Cell, Training


def coverage(trainings: Sequence[Training]) -> Grid:
    """Which cells were run: seeds and env-steps."""

    def cell(runs: Sequence[Training]) -> str:
        steps = " to ".join(dict.fromkeys(map(_short, _ends(run.env_steps for run in runs))))
        unfinished = sum(run.evaluation is None for run in runs)
        return f"{len(runs)} x {steps}" + (f", {unfinished} unfinished" if unfinished else "")

    caption = "Runs x env-steps of each; a run is a seed. The paper: one seed x 5M in every cell."
    return _per_cell(trainings, caption, cell)


def success(trainings: Sequence[Training]) -> Grid:
    """Success of the trained policies on fresh episodes."""

    def cell(runs: Sequence[Training]) -> str:
        finals = [run.evaluation["stochastic"] for run in runs if run.evaluation is not None]
        if not finals:
            return MISSING
        rate = np.mean([final["success_rate"] for final in finals])
        reward = np.mean([final["return_mean"] for final in finals])
        return f"{rate:.0%}, {reward:,.0f}"

    caption = (
        "After training: share of fresh episodes with sampled actions that visited every ROI, and "
        "their mean reward, both over seeds. The paper has no such numbers."
    )
    return _per_cell(trainings, caption, cell)


def reached(trainings: Sequence[Training]) -> Grid:
    """How many runs of an algorithm passed the threshold during training, and how soon."""

    def cell(runs: Sequence[Training]) -> str:
        if not runs:
            return MISSING
        firsts = [first_reach(run.windows, RETURN_THRESHOLD) for run in runs]
        hits = [first for first in firsts if first is not None]
        soonest = f", soonest {_short(min(hits))}" if hits else ""
        return f"{len(hits)} of {len(runs)}{soonest}"

    lines = tuple(
        (
            published.display_name(name),
            *(
                cell([run for run in trainings if run.cell[:2] == (name, setting)])
                for setting in SETTINGS
            ),
        )
        for name in algorithms_of(trainings)
    )
    caption = (
        f"Runs whose moving mean of 100 training episodes reached {RETURN_THRESHOLD:,.0f}, once so "
        "many had ended, of all runs of that algorithm and setting on any field, and the env-steps "
        "of the soonest. In the paper only CrossQ does so under A within 500k env-steps."
    )
    return Grid(caption, ("algorithm", *_setting_headings()), lines)


def ranking(tables: Iterable[Table]) -> Grid:
    """The algorithms of each setting from the best mean to the worst, in the paper and here."""
    lines = [
        _ranking_line(table, setting)
        for setting in published.settings()
        for table in tables
        if table.kind is ALGORITHMS
    ]
    caption = (
        "Algorithms by the mean of Table 1, best first; those without a run here are left out "
        "here. Kendall's tau is 1 for the same order and -1 for the reverse."
    )
    headings = ("setting", "here: over", "paper", "here", "Kendall's tau")
    return Grid(caption, headings, tuple(lines), words=4)


def _ranking_line(table: Table, setting: str) -> tuple[str, ...]:
    paper = table.means(Column(setting, "paper"))
    here = {n: mean for n, mean in table.means(Column(setting, "here")).items() if n in paper}
    agreement = MISSING
    if len(here) > 1:
        tau = kendalltau([paper[name] for name in here], list(here.values())).statistic
        agreement = f"{tau:.2f}"
    return setting, table.sample.name, _order(paper), _order(here) or MISSING, agreement


def _order(means: Mapping[str, float]) -> str:
    best_first = sorted(means, key=lambda name: -means[name])
    return " > ".join(map(published.display_name, best_first))


def _per_cell(
    trainings: Sequence[Training], caption: str, shown: Callable[[Sequence[Training]], str]
) -> Grid:
    """A line for every algorithm and setting, a column for every field."""
    algorithms, fields = algorithms_of(trainings), fields_of(trainings)
    runs: dict[Cell, list[Training]] = {}
    for training in trainings:
        runs.setdefault(training.cell, []).append(training)
    lines = []
    for algorithm in algorithms:
        for setting in SETTINGS:
            groups = [runs.get(Cell(algorithm, setting, field), []) for field in fields]
            if algorithm in published.algorithms() or any(groups):
                cells = (shown(group) if group else MISSING for group in groups)
                lines.append((published.display_name(algorithm), setting, *cells))
    return Grid(caption, ("algorithm", "setting", *fields), tuple(lines), words=2)


def _setting_headings() -> list[str]:
    return [name if name in published.settings() else f"{name}, ours" for name in SETTINGS]


def _ends(values: Iterable[int]) -> tuple[int, int]:
    ordered = sorted(values)
    return ordered[0], ordered[-1]


def _short(steps: float) -> str:
    """Env-steps in three digits with k or M."""
    return f"{steps / 1e6:.3g}M" if steps >= 1e6 else f"{steps / 1e3:.3g}k"
