"""The figures of the pages of results: makespan over the proved optimum, a dot a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

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
from baselines.runs.files import read_json, write_text
from benchmarks.leaderboard import SPLIT
from benchmarks.studies.learning import Study
from benchmarks.tables import CLASSICAL_ROWS, ROW, SEARCHED, rows_of, unbounded
from mbn_marl.field import catalogue_names, splits
from mbn_marl.render import figures, style

FIELDS = "fields"  # the folder of policies that were not trained on the field
DELAYED = "delayed"
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
    """With STUDY/runs.csv or comparison.json; fields/runs.csv, search/radii.csv and
    delayed/classical.csv are measured if they are missing in their folders."""

    def run(self, command: str) -> bool:
        radii = self.folder / SEARCHED / "radii.csv"
        places = {self.folder / FIELDS / "runs.csv": untrained, radii: searched}
        places[self.folder / DELAYED / CLASSICAL_ROWS] = late
        for path, measure in places.items():
            if path.parent.is_dir() and not path.is_file():
                write_text(path, csv_text(measure(), "%.4f"))
        reached = pandas.concat([pandas.read_csv(radii), learned(radii.parent)])
        figures.save(reach(reached), radii.with_suffix(".png"))
        sources = (*self.folder.glob("*/runs.csv"), *self.folder.glob("*/comparison.json"))
        names = {one.parent.name for one in sources}
        found = {name: rows_of(self.folder / name) for name in sorted(names)}
        shown = {label: found[name].query("label == @label") for label, name in COLUMNS.items()}
        together = pandas.concat(shown.values())
        write_text(self.folder / "strip.csv", csv_text(together, "%.4f"))
        figures.save(strip(shown), self.folder / "strip.png")
        for name, rows in found.items():
            if rows[["deterministic_gap", "deterministic_makespan"]].notna().any(axis=None):
                groups = dict(list(rows.groupby("label", sort=False)))
                file = "makespans.png" if unbounded(rows) else "gaps.png"
                figures.save(strip(groups), self.folder / name / file)
        print(f"written to {self.folder}: strip.csv, strip.png, a figure a study, search/radii.png")
        return True


def untrained() -> DataFrame:
    """Measure the policies that are not trained on a field."""
    labels = (label for label, place in COLUMNS.items() if place == FIELDS)
    cases = product(labels, catalogue_names())
    rows = [measured(label, POLICIES.get(label, label), field) for label, field in cases]
    return DataFrame(rows, columns=ROW)


def late() -> DataFrame:
    """Measure policies that do not learn with the delays of the study ``delayed``."""
    study = Study(study=DELAYED).config()
    delays = [one.environment["action_delay"] for one in study.variants]
    cases = product(("greedy", "replan"), delays, study.fields)
    rows = [measured(f"{name}-{d}", name, field, action_delay=d) for name, d, field in cases]
    return DataFrame(rows, columns=ROW)


def measured(label: str, policy: str, field: str, **settings: Any) -> tuple[Any, ...]:
    """Return a row of one episode by mean actions."""
    loaded = load_policy(policy, field, **settings)
    found = evaluate(loaded, field, loaded.settings, episodes=1, deterministic=True).summary()
    sees = "state" if policy in CLASSICAL else information(loaded.settings)
    won, numbers = found["success_rate"], (found[name] for name in ("makespan", "gap", "spl"))
    return (label, sees, Path(field).stem, "", won == 1.0, won, *numbers)


def strip(groups: Mapping[str, DataFrame]) -> Figure:
    steps = any(map(unbounded, groups.values()))
    shown = "deterministic_makespan" if steps else "deterministic_gap"
    values = {label: rows[shown].where(rows.passed) for label, rows in groups.items()}
    known = {label: [*some.replace({np.nan: None})] for label, some in values.items()}
    return strips_figure(known, steps=steps)


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


def learned(folder: Path) -> DataFrame:
    """Read the results of the zoo in 6-search, as rows of :func:`searched`."""
    rows = [
        (path.stem, one["field"], splits.RADII[one["comm_radius"]], one["mean"]["gap"])
        for path in sorted(folder.glob("zoo-*.json"))
        for one in read_json(path)["tiers"][splits.SEARCH]["instances"]
    ]
    return DataFrame(rows, columns=["policy", "field", "comm_radius", "gap"])


@matplotlib.rc_context(style.MATPLOTLIB)
def reach(rows: DataFrame) -> Figure:
    """Draw the makespan over the bound by radius: the mean over fields and its 95 % interval."""
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    axes = figure.add_subplot()
    for look, (label, own) in enumerate(rows.dropna().groupby("policy")):
        found = own.groupby("comm_radius").gap.apply(lambda gaps: mean_interval([*(1.0 + gaps)]))
        places = [RADII.index(radius) for radius in found.index]
        means, *ends = np.array([*found], float).T
        if len(found) == 1:
            axes.axhline(means[0], ls="--", color=style.FAINT_INK, label=f"{label}, which sees all")
            continue
        colour, dash, marker = style.series(look)
        axes.plot(places, means, color=colour, ls=dash, marker=marker, ms=4, label=label)
        axes.fill_between(places, *ends, color=colour, alpha=0.18, lw=0)
    axes.set_xticks(range(len(RADII)), ["all" if r == math.inf else f"{r:g}" for r in RADII])
    axes.set(ylim=(1.0, None), xlabel="comm_radius, units", ylabel="makespan over the bound")
    axes.grid(True)
    axes.legend()
    return figure
