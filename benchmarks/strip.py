"""The figures of the pages of results: makespan over the proved optimum, a dot a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np
import pandas
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from pandas import DataFrame

from baselines import load_policy
from baselines.compare.text_table import csv_text
from baselines.evaluation.evaluate import evaluate
from baselines.runs.files import write_text
from benchmarks.tables import ROW, rows_of
from mbn_marl.field import catalogue_names
from mbn_marl.render import figures, style

FIELDS = "fields"  # the folder of policies that were not trained on the field
POLICIES = {"hint": "zoo:generalist-hint", "generalist": "zoo:generalist"}  # others by their name
COLUMNS = {  # of the first figure, by label: the folder
    **{"planner": FIELDS, "replan": FIELDS, "trpo": "aids", "ppo": "aids", "hint": FIELDS},
    **{"mappo": "forms", "generalist": FIELDS, "ippo": "forms", "ppo-joint": "forms"},
    "greedy": FIELDS,
}
TOP, FAILED = 1.0, 1.1  # larger gaps are drawn at the top, failures above it


@dataclass(frozen=True)
class Strip:
    """Draw the makespan gap of every run: all at a glance, and one figure for each study."""

    folder: Path = Path("docs/results")
    """With STUDY/runs.csv or comparison.json; a missing fields/runs.csv is measured."""

    def run(self, command: str) -> bool:
        path = self.folder / FIELDS / "runs.csv"
        if not path.is_file():
            path.parent.mkdir(exist_ok=True)
            write_text(path, csv_text(untrained(), "%.4f"))
        names = {FIELDS, *(one.parent.name for one in self.folder.glob("*/comparison.json"))}
        found = {name: rows_of(self.folder / name) for name in sorted(names)}
        shown = {label: found[name].query("label == @label") for label, name in COLUMNS.items()}
        together = pandas.concat(shown.values())
        write_text(self.folder / "strip.csv", csv_text(together, "%.4f"))
        figures.save(strip(shown), self.folder / "strip.png")
        for name, rows in found.items():
            if rows.deterministic_gap.notna().any():
                groups = dict(list(rows.groupby("label", sort=False)))
                figures.save(strip(groups), self.folder / name / "gaps.png")
        print(f"written to {self.folder}: strip.csv, strip.png, STUDY/gaps.png")
        return True


def untrained() -> DataFrame:
    """Measure the policies that are not trained on a field, one episode each by mean actions."""
    rows = []
    for label, field in product(COLUMNS, catalogue_names()):
        if COLUMNS[label] == FIELDS:
            policy = load_policy(POLICIES.get(label, label), field)
            done = evaluate(policy, field, policy.settings, episodes=1, deterministic=True)
            rows.append((label, field, "", all(done.successes), done.summary()["gap"]))
    return DataFrame(rows, columns=ROW)


@matplotlib.rc_context(style.MATPLOTLIB)
def strip(groups: Mapping[str, DataFrame]) -> Figure:
    """Draw a column for each group: a dot a run, a cross and a count for failures, the mean."""
    figure = Figure(figsize=(max(0.75 * len(groups) + 0.8, 4.0), 3.0), layout="constrained")
    axes = figure.subplots()
    for place, rows in enumerate(groups.values()):
        gaps = rows.deterministic_gap[rows.passed].dropna()
        x = place + np.linspace(-0.25, 0.25, len(gaps))
        axes.scatter(x, gaps.clip(upper=TOP), s=14, c=style.BLUE, alpha=0.6, lw=0)
        axes.hlines(gaps.mean(), place - 0.35, place + 0.35, color=style.INK, lw=1.5)
        if failures := len(rows) - len(gaps):
            axes.plot(place, FAILED, "x", c=style.VERMILLION)
            axes.annotate(f" {failures}", (place + 0.1, FAILED), va="center")
    axes.set_xticks(range(len(groups)), groups, rotation=30 if len(groups) > 4 else 0)
    axes.set(ylim=(-0.05, 1.18), ylabel="makespan over the optimum")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(True, axis="y")
    return figure
