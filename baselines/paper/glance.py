"""How the runs compare with the paper at a glance: what was run, rankings, who got there."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from pandas import DataFrame, MultiIndex
from scipy.stats import kendalltau

from baselines.compare.text_table import TextTable
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.tables import ALGORITHMS, MISSING, PaperTable, marked, paper_tables
from baselines.paper.trainings import CELL, Trainings


def coverage(trainings: Trainings) -> TextTable:
    """Which cells were run: seeds and env-steps."""

    def cell(runs: DataFrame) -> str:
        ends = runs.env_steps.min(), runs.env_steps.max()
        unfinished = int((~runs.finished).sum())
        steps = " to ".join(dict.fromkeys(map(_short, ends)))
        return f"{len(runs)} x {steps}" + (f", {unfinished} unfinished" if unfinished else "")

    caption = "Runs x env-steps of each; a run is a seed. The paper: one seed x 5M in every cell."
    return _per_cell(trainings, caption, cell)


def success(trainings: Trainings) -> TextTable:
    """Success of the trained policies on fresh episodes."""

    def cell(runs: DataFrame) -> str:
        if not runs.finished.any():
            return MISSING
        return f"{runs.success_rate.mean():.0%}, {runs.return_mean.mean():,.0f}"

    caption = (
        "After training: share of fresh episodes with sampled actions that visited every ROI, and "
        "their mean reward, both over seeds. The paper has no such numbers."
    )
    return _per_cell(trainings, caption, cell)


def reached(trainings: Trainings) -> TextTable:
    """How many runs of an algorithm passed the threshold during training, and how soon."""

    def cell(runs: DataFrame) -> str:
        hits = runs.reach.count()
        return f"{hits} of {len(runs)}" + (f", soonest {_short(runs.reach.min())}" if hits else "")

    table = _words(trainings.runs, CELL[:2], cell)
    table = table.reindex(trainings.algorithms, columns=list(published.REPORTED)).fillna(MISSING)
    lines = tuple((published.display_name(name), *cells) for name, *cells in table.itertuples())
    caption = (
        f"Runs whose moving mean of 100 training episodes reached {RETURN_THRESHOLD:,.0f}, once so "
        "many had ended, of all runs of that algorithm and setting on any field, and the env-steps "
        "of the soonest. In the paper only CrossQ does so under A within 500k env-steps."
    )
    headings = (f"{setting}{marked(setting)}" for setting in published.REPORTED)
    return TextTable(caption, ("algorithm", *headings), lines)


def ranking(trainings: Trainings) -> TextTable:
    """The algorithms of each setting from the best mean to the worst, in the paper and here."""
    alike = trainings.alike()
    fields = {
        setting: sorted(set(runs.field) & set(published.FIELDS))
        for setting, runs in alike.runs.groupby("setting")
    }
    tables = [table for table in paper_tables(alike) if table.kind is ALGORITHMS]
    lines = [
        (*_ranking_line(setting, table), ", ".join(fields.get(setting, [])) or MISSING)
        for setting, table in itertools.product(published.SETTINGS, tables)
    ]
    caption = (
        "Algorithms by their mean, best first: in the paper over its ten fields, here over the "
        "fields that all algorithms with a run of the setting have. Those without a run are left "
        "out here. Kendall's tau is 1 for the same order and -1 for the reverse."
    )
    headings = ("setting", "here: over", "paper", "here", "Kendall's tau", "fields here")
    return TextTable(caption, headings, tuple(lines), words=4)


def _ranking_line(setting: str, table: PaperTable) -> tuple[str, ...]:
    paper, here = table.means(setting, "paper"), table.means(setting, "here")
    here = here[here.index.isin(paper.index)]
    agreement = MISSING
    if len(here) > 1:
        agreement = f"{kendalltau(paper[here.index], here).statistic:.2f}"
    orders = (" > ".join(map(published.display_name, means.index)) for means in (paper, here))
    return setting, table.sample.name, *(order or MISSING for order in orders), agreement


def _per_cell(trainings: Trainings, caption: str, shown: Callable[[DataFrame], str]) -> TextTable:
    """A line for every algorithm and setting, a column for every field."""
    fields = trainings.field_names
    index = MultiIndex.from_product([trainings.algorithms, published.REPORTED])
    table = _words(trainings.runs, CELL, shown).reindex(index, columns=fields)
    papers = index.get_level_values(0).isin(published.ALGORITHMS)
    table = table[papers | table.notna().any(axis=1)].fillna(MISSING)
    lines = tuple(
        (published.display_name(name), setting, *cells)
        for (name, setting), *cells in table.itertuples()
    )
    return TextTable(caption, ("algorithm", "setting", *fields), lines, words=2)


def _words(runs: DataFrame, keys: list[str], shown: Callable[[DataFrame], str]) -> DataFrame:
    """The statistic of each group of runs; the last key makes the columns."""
    return runs.groupby(keys).apply(shown, include_groups=False).unstack()


def _short(steps: float) -> str:
    """Env-steps in three digits with k or M."""
    return f"{steps / 1e6:.3g}M" if steps >= 1e6 else f"{steps / 1e3:.3g}k"
