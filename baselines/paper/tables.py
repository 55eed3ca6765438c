"""The paper's tables beside what the runs here give, and how both compare at a glance."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from pandas import DataFrame, MultiIndex, Series
from scipy.stats import kendalltau

from baselines.compare.text_table import DASH, TextTable
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published
from baselines.paper.published import REPORTED, STATISTICS
from baselines.paper.trainings import CELL, Trainings

MISSING = "missing"


def of_episodes(rows: DataFrame) -> list[float]:
    """Exact numbers of a cell over every training episode of ``rows`` (reward units)."""
    some = rows[rows.episodes > 0]
    mean = np.average(some.return_mean, weights=some.episodes)
    squares = some.return_std**2 + (some.return_mean - mean) ** 2
    variance = np.average(squares, weights=some.episodes)
    highest, lowest = some.return_max.max(), some.return_min.min()
    return [mean, np.sqrt(variance), highest, highest - lowest]


def of_moving_means(rows: DataFrame) -> list[float]:
    """The numbers of a cell over the moving means of ``rows``, one a row (reward units)."""
    means = rows.moving_mean
    return [means.mean(), means.std(ddof=0), means.max(), means.max() - means.min()]


SAMPLES = {
    "episodes": ("single episodes", of_episodes),
    "means": ("moving means of 100 episodes", of_moving_means),
}
"""The evaluations that a number is taken over: in words, and how; by the end of LaTeX's label."""


PAGE = "means"  # the sample that the page shows

KINDS = {
    "algorithm": (
        *("Table 1: each algorithm over the paper's ten fields", published.by_algorithm),
        *(published.ALGORITHM_UNIT, "1e6 reward", 4),
    ),
    "field": (
        *("Appendix tables: each field over the paper's six algorithms", published.by_field),
        *(1.0, "reward", 1),
    ),
}
"""By the subject of a row: title, the paper's numbers by (row, setting), its unit and digits."""
COLUMNS = [
    (setting, source)
    for setting in REPORTED
    for source in ("paper", "here")
    if source == "here" or setting in published.SETTINGS
]


@dataclass(frozen=True)
class PaperTable:
    """``cells`` (reward units or NaN): rows (row, setting, source), a column a statistic."""

    kind: str
    sample: str
    cells: DataFrame

    @classmethod
    def of(cls, kind: str, sample: str, names: Iterable[str], rows: DataFrame) -> Self:
        here = {
            (*key, "here"): Series(SAMPLES[sample][1](group), list(STATISTICS))
            for key, group in rows.groupby([kind, "setting"], sort=False)
        }
        paper = {(*key, "paper"): Series(cell) for key, cell in KINDS[kind][1]().items()}
        index = MultiIndex.from_tuples(
            [(name, *column) for name in names for column in COLUMNS],
            names=["row", "setting", "source"],
        )
        cells = DataFrame({**paper, **here}).T.reindex(index=index, columns=list(STATISTICS))
        return cls(kind, sample, cells)

    def means(self, setting: str, source: str) -> Series:
        column = self.cells.xs((setting, source), level=("setting", "source"))["mean"]
        return column.dropna().sort_values(ascending=False, kind="stable")

    def text(self) -> TextTable:
        title, _, unit, unit_name, digits = KINDS[self.kind]

        def word(name: str, setting: str, number: float) -> str:
            return absent(name, setting) if np.isnan(number) else f"{number:,.{digits}f}"

        wide = (self.cells / unit).stack(future_stack=True).unstack(["setting", "source"])
        order = MultiIndex.from_product([self.cells.index.unique("row"), STATISTICS])
        lines = [
            (
                self._shown(name) if statistic == "mean" else "",
                statistic,
                *(word(name, column[0], numbers[column]) for column in COLUMNS),
            )
            for (name, statistic), numbers in wide.reindex(order).iterrows()
        ]
        caption = f"{title}, in units of {unit_name}; 'here' is over {SAMPLES[self.sample][0]}."
        headings = (f"{' '.join(column)}{marked(column[0])}" for column in COLUMNS)
        return TextTable(caption, (self.kind, "", *headings), lines, words=2)

    def lines(self) -> DataFrame:
        """The table for a CSV file, a line a cell; the numbers of a missing one are empty."""
        _, _, unit, unit_name, _ = KINDS[self.kind]
        lines = (self.cells / unit).reset_index(names=[self.kind, "setting", "source"])
        lines[self.kind] = lines[self.kind].map(self._shown)
        lines.insert(3, "over", np.where(lines.source == "here", SAMPLES[self.sample][0], ""))
        lines.insert(4, "unit", unit_name)
        return lines

    def _shown(self, row: str) -> str:
        return published.display_name(row) if self.kind == "algorithm" else row


def absent(name: str, setting: str) -> str:
    """Return the word for a cell without a number: a dash if the paper has none there either."""
    known = {*published.ALGORITHMS, *published.FIELDS}
    return DASH if setting in published.SETTINGS and name not in known else MISSING


def marked(setting: str) -> str:
    return "" if setting in published.SETTINGS else ", ours"


def paper_tables(trainings: Trainings) -> list[PaperTable]:
    """Per algorithm over the paper's fields, per field over its algorithms, for both samples."""
    rows = trainings.rows
    papers = (
        rows[rows.field.isin(published.FIELDS)],
        rows[rows.algorithm.isin(published.ALGORITHMS)],
    )
    names = (trainings.algorithms, trainings.field_names)
    chosen = [*zip(KINDS, names, papers, strict=True)]
    return [PaperTable.of(kind, sample, *part) for kind, *part in chosen for sample in SAMPLES]


def coverage(trainings: Trainings) -> TextTable:
    def cell(runs: DataFrame) -> str:
        ends = runs.env_steps.min(), runs.env_steps.max()
        unfinished = int((~runs.finished).sum())
        steps = " to ".join(dict.fromkeys(map(_short, ends)))
        return f"{len(runs)} x {steps}" + (f", {unfinished} unfinished" if unfinished else "")

    caption = "Runs x env-steps of each. The paper has one seed of 5M for each of ten fields."
    return _per_setting(trainings, caption, cell)


def success(trainings: Trainings) -> TextTable:
    def cell(runs: DataFrame) -> str:
        return f"{runs.success_rate.mean():.0%}" if runs.finished.any() else MISSING

    fields = trainings.field_names
    table = trainings.runs.groupby(CELL).apply(cell, include_groups=False).unstack()
    index = MultiIndex.from_product([trainings.algorithms, REPORTED])
    table = table.reindex(index.intersection(table.index, sort=False), columns=fields)
    lines = [
        (published.display_name(name), setting, *cells)
        for (name, setting), *cells in table.fillna(MISSING).itertuples()
    ]
    caption = (
        "Success of the trained policies in fresh episodes with sampled actions, mean over seeds. "
        "The paper has no such numbers."
    )
    return TextTable(caption, ("algorithm", "setting", *fields), lines, words=2)


def reached(trainings: Trainings) -> TextTable:
    def cell(runs: DataFrame) -> str:
        hits = runs.reach.count()
        return f"{hits} of {len(runs)}" + (f", soonest {_short(runs.reach.min())}" if hits else "")

    caption = (
        f"Runs whose moving mean of 100 training episodes reached {RETURN_THRESHOLD:,.0f}, and the "
        "env-steps of the soonest. In the paper only CrossQ reaches it under A within 500k."
    )
    return _per_setting(trainings, caption, cell)


def ranking(trainings: Trainings) -> TextTable:
    alike = trainings.alike()
    (table,) = (t for t in paper_tables(alike) if (t.kind, t.sample) == ("algorithm", PAGE))
    lines = []
    for setting in published.SETTINGS:
        fields = set(alike.runs.field[alike.runs.setting == setting]) & set(published.FIELDS)
        paper, here = table.means(setting, "paper"), table.means(setting, "here")
        here = here[here.index.isin(paper.index)]
        orders = [" > ".join(map(published.display_name, side.index)) for side in (paper, here)]
        agreement = [MISSING, MISSING]
        if len(here) > 1:
            agreement = [f"{number:.2f}" for number in kendalltau(paper[here.index], here)]
        words = (*orders, *agreement, ", ".join(sorted(fields)))
        lines.append((setting, *(word or MISSING for word in words)))
    caption = (
        "Algorithms by their mean, best first; 'here' by moving means over the fields that all of "
        "them have. Algorithms with less than half of the fields do not count. Kendall's tau is 1 "
        "for the same order and -1 for the reverse; p is its probability by chance."
    )
    headings = ("setting", "paper", "here", "Kendall's tau", "p", "fields here")
    return TextTable(caption, headings, lines, words=3)


def _per_setting(
    trainings: Trainings, caption: str, shown: Callable[[DataFrame], str]
) -> TextTable:
    table = trainings.runs.groupby(CELL[:2]).apply(shown, include_groups=False)
    lines = [
        (published.display_name(name), *(table.get((name, s), absent(name, s)) for s in REPORTED))
        for name in trainings.algorithms
    ]
    headings = (f"{setting}{marked(setting)}" for setting in REPORTED)
    return TextTable(caption, ("algorithm", *headings), lines)


def _short(steps: float) -> str:
    return f"{steps / 1e6:.3g}M" if steps >= 1e6 else f"{steps / 1e3:.3g}k"
