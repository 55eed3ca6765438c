"""The tables of the pages of results, of the same rows as their figures."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pandas import DataFrame
from scipy.stats import binomtest

from baselines.compare.text_table import TextTable
from baselines.runs.files import read_json, read_text, write_text
from benchmarks.strip import rows_of

PLACE = re.compile(r"(?m)^<!-- table: (\S+) -->\n(?:\n\|.*(?:\n\|.*)*\n)?")
HEADINGS = ("variant", "runs pass", "95 %", "gap", "worst field", "fields failed")


@dataclass(frozen=True)
class Tables:
    """Write below each `<!-- table: STUDY -->` the table of that study."""

    folder: Path = Path("docs/results")
    """With STUDY/runs.csv or comparison.json, and the pages."""

    def run(self, command: str) -> bool:
        for page in sorted(self.folder.glob("*.md")):
            if (filled := fill(page)) != read_text(page):
                write_text(page, filled)
                print(f"written to {page}")
        return True


def fill(page: Path) -> str:
    return PLACE.sub(
        lambda place: f"<!-- table: {place[1]} -->\n{table(page.parent / place[1])}\n",
        read_text(page),
    )


def table(study: Path) -> str:
    """Return a row for each variant; gaps are of the median run of a field, by mean actions."""
    rows = rows_of(study)
    gaps = rows.deterministic_gap.where(rows.passed, np.inf)
    cells = gaps.groupby([rows.label, rows.field]).median().unstack()
    lines = []
    for label, (passed, runs) in counts(study, rows).iterrows():
        low, high = binomtest(passed, runs).proportion_ci(method="wilson")
        solved = cells.loc[label][np.isfinite(cells.loc[label])]
        gap = (f"{solved.mean():.0%}", f"{solved.max():.0%}") if len(solved) else ("-", "-")
        failed = cells.loc[label].notna().sum() - len(solved)
        lines.append((label, f"{passed}/{runs}", f"{low:.0%}..{high:.0%}", *gap, f"{failed}"))
    return TextTable("", HEADINGS, lines).markdown()


def counts(study: Path, rows: DataFrame) -> DataFrame:
    """Return how many runs of each label pass, and how many there are."""
    if (study / "runs.csv").is_file():
        return rows.groupby("label", sort=False).passed.agg(["sum", "size"])
    cells = DataFrame(read_json(study / "comparison.json")["rows"])
    return cells.groupby("label", sort=False)[["passed", "seeds"]].sum()
