"""The figures of the pages of results: makespan over the proved optimum, a dot a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pandas
from matplotlib.figure import Figure
from pandas import DataFrame

from baselines import load_policy
from baselines.compare.curves import strips_figure
from baselines.compare.text_table import csv_text
from baselines.evaluation.evaluate import evaluate
from baselines.policies.classical import CLASSICAL
from baselines.policies.information import information
from baselines.runs.files import write_text
from benchmarks.tables import ROW, rows_of
from mbn_marl.field import catalogue_names
from mbn_marl.render import figures

FIELDS = "fields"  # the folder of policies that were not trained on the field
POLICIES = {"hint": "zoo:generalist-hint", "generalist": "zoo:generalist"}  # others by their name
COLUMNS = {  # of the first figure, by label: the folder
    **{"planner": FIELDS, "replan": FIELDS, "trpo": "aids", "ppo": "aids", "hint": FIELDS},
    **{"mappo": "forms", "generalist": FIELDS, "ippo": "forms", "ppo-joint": "forms"},
    "greedy": FIELDS,
}


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
        print(f"written to {self.folder}: strip.csv, strip.png, STUDY/gaps.png")
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
