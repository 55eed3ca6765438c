"""The figures of the pages of results: makespan over the proved optimum, a dot a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np
import pandas
from matplotlib.figure import Figure
from pandas import DataFrame

from baselines import load_policy
from baselines.compare.benchmark import load_tiers
from baselines.compare.curves import strips_figure
from baselines.compare.text_table import csv_text
from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.intervals import mean_interval
from baselines.policies.classical import CLASSICAL
from baselines.policies.information import information
from baselines.policies.load import Source
from baselines.runs.files import write_text
from benchmarks.leaderboard import SPLIT
from benchmarks.tables import ROW, SEARCHED, rows_of
from mbn_marl.field import catalogue_names, splits
from mbn_marl.render import figures, style

FIELDS = "fields"  # the folder of policies that were not trained on the field
POLICIES = {"hint": "zoo:generalist-hint", "generalist": "zoo:generalist"}  # others by their name
COLUMNS = {  # of the first figure, by label: the folder
    **{"planner": FIELDS, "replan": FIELDS, "trpo": "aids", "ppo": "aids", "hint": FIELDS},
    **{"mappo": "forms", "generalist": FIELDS, "ippo": "forms", "ppo-joint": "forms"},
    "greedy": FIELDS,
}
RADII = (0.0, 50.0, 100.0, 150.0, 200.0, 300.0, math.inf)
SEARCHERS = {"greedy-local": RADII, "greedy": (math.inf,)}  # greedy sees the state anyway


@dataclass(frozen=True)
class Strip:
    """Draw the makespan gap of every run: all at a glance, and one figure for each study.

    And of robots that know only their own, the makespan by communication radius.
    """

    folder: Path = Path("docs/results")
    """With STUDY/runs.csv or comparison.json; fields/runs.csv and search/radii.csv are measured if
    missing."""

    def run(self, command: str) -> bool:
        radii = self.folder / SEARCHED / "radii.csv"
        for path, measure in ((self.folder / FIELDS / "runs.csv", untrained), (radii, searched)):
            if not path.is_file():
                path.parent.mkdir(exist_ok=True)
                write_text(path, csv_text(measure(), "%.4f"))
        figures.save(reach(pandas.read_csv(radii)), radii.with_suffix(".png"))
        sources = (*self.folder.glob("*/runs.csv"), *self.folder.glob("*/comparison.json"))
        names = {one.parent.name for one in sources}
        found = {name: rows_of(self.folder / name) for name in sorted(names)}
        shown = {label: found[name].query("label == @label") for label, name in COLUMNS.items()}
        together = pandas.concat(shown.values())
        write_text(self.folder / "strip.csv", csv_text(together, "%.4f"))
        figures.save(strip(shown), self.folder / "strip.png")
        for name, rows in found.items():
            if rows.deterministic_gap.notna().any():
                groups = dict(list(rows.groupby("label", sort=False)))
                figures.save(strip(groups), self.folder / name / "gaps.png")
        print(f"written to {self.folder}: strip.csv, strip.png, STUDY/gaps.png, search/radii.png")
        return True


def untrained() -> DataFrame:
    """Measure the policies that are not trained on a field, one episode each by mean actions."""
    rows = []
    for label, field in product(COLUMNS, catalogue_names()):
        if COLUMNS[label] == FIELDS:
            policy = load_policy(POLICIES.get(label, label), field)
            done = evaluate(policy, field, policy.settings, episodes=1, deterministic=True)
            found = done.summary()
            sees = "state" if label in CLASSICAL else information(policy.settings)
            won = found["success_rate"]
            rows.append((label, sees, field, "", won == 1.0, won, found["gap"], found["spl"]))
    return DataFrame(rows, columns=ROW)


def strip(groups: Mapping[str, DataFrame]) -> Figure:
    gaps = {label: rows.deterministic_gap.where(rows.passed) for label, rows in groups.items()}
    return strips_figure({label: [*some.replace({np.nan: None})] for label, some in gaps.items()})


def searched() -> DataFrame:
    """Measure each field of 6-search at many radii, one episode each; a failure has no gap."""
    rows = []
    frozen = load_tiers(SPLIT, [splits.SEARCH])[splits.SEARCH][:: len(splits.RADII)]
    for (label, radii), one in product(SEARCHERS.items(), frozen):
        for radius in radii:
            policy = Source(label).make(one.field, **{**one.settings, "comm_radius": radius})
            done = evaluate(policy, [one], policy.settings, episodes=1, deterministic=True)
            rows.append((label, one.field.name, radius, done.summary()["gap"]))
    return DataFrame(rows, columns=["policy", "field", "comm_radius", "gap"])


@matplotlib.rc_context(style.MATPLOTLIB)
def reach(rows: DataFrame) -> Figure:
    """Draw the makespan over the bound by radius: the mean over fields and its 95 % interval."""
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    axes = figure.add_subplot()
    for label, own in rows.dropna().groupby("policy"):
        found = own.groupby("comm_radius").gap.apply(lambda gaps: mean_interval([*(1.0 + gaps)]))
        places = [RADII.index(radius) for radius in found.index]
        means, *ends = np.array([*found], float).T
        if len(found) == 1:
            axes.axhline(means[0], ls="--", color=style.FAINT_INK, label=f"{label}, which sees all")
            continue
        axes.plot(places, means, "o-", ms=4, color=style.BLUE, label=label)
        axes.fill_between(places, *ends, color=style.BLUE, alpha=0.18, lw=0)
    axes.set_xticks(range(len(RADII)), ["all" if r == math.inf else f"{r:g}" for r in RADII])
    axes.set(ylim=(1.0, None), xlabel="comm_radius, units", ylabel="makespan over the bound")
    axes.grid(True)
    axes.legend()
    return figure
