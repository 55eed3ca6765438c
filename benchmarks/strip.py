"""The figures of the pages of results: makespan over the proved optimum, a dot a run."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas
from matplotlib.figure import Figure
from pandas import DataFrame

from baselines.compare.benchmark import load_tiers
from baselines.compare.curves import strips_figure
from baselines.compare.text_table import csv_text
from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.intervals import mean_interval
from baselines.policies.load import Source
from baselines.policies.shielded import Shielded, information_of
from baselines.runs.files import write_text
from benchmarks import tables
from benchmarks.leaderboard import SPLIT
from benchmarks.studies.learning import Study
from mbn_marl.field import catalogue_names, splits
from mbn_marl.render import figures, style

FIELDS = "fields"  # the folder of policies that were not trained on the field
# By study: policies that do not learn, and episodes of each in every environment of the study.
SCRIPTED: Mapping[str, tuple[Sequence[str], int]] = {
    "delayed": (("greedy", "replan"), 1),
    "known": (("greedy-local", "planner"), 100),
    **{f"scale-{robots}": (("generalist",), 1) for robots in (2, 5, 12)},
}
POLICIES = {  # others by their name
    **{"hint": "zoo:generalist-hint", "generalist": "zoo:generalist", "search": "zoo:search"},
}
COLUMNS = {  # of the first figure, by label: the folder
    **{"planner": FIELDS, "replan": FIELDS, "trpo": "aids", "ppo": "aids", "hint": FIELDS},
    **{"mappo": "forms", "generalist": FIELDS, "ippo": "forms", "ppo-joint": "forms"},
    "greedy": FIELDS,
}
RADII = (0.0, 50.0, 100.0, 150.0, 200.0, 300.0, math.inf)
THREE = tuple(splits.RADII.values())
SHIELD = "-shield"
UNDRAWN = ("blind", "open-loop", "replan", f"generalist{SHIELD}", "search", f"search{SHIELD}")
# By folder: the tier, and radii of policies.
SEARCHERS: Mapping[str, tuple[str, Mapping[str, Sequence[float]]]] = {
    tables.SEARCHED: (
        splits.SEARCH,
        {
            **{"greedy-local": RADII, "greedy": THREE, f"generalist{SHIELD}": THREE},
            **{"search": THREE, f"search{SHIELD}": THREE},
        },
    ),
    tables.PRICED: (
        "1-convex",
        {"greedy-local": RADII, "generalist": RADII, f"generalist{SHIELD}": THREE},
    ),
}


@dataclass(frozen=True)
class Strip:
    """Draw the makespan gap of every run: all at a glance, and one figure for each study.

    And of robots that know only their own, the makespan by communication radius.
    """

    folder: Path = Path("docs/results")
    """With STUDY/runs.csv; fields/runs.csv, the classical.csv of delayed, known and scale, and the
    radii.csv of search and price are measured if they are missing in their folders."""

    def run(self, command: str) -> bool:
        places = {self.folder / FIELDS / "runs.csv": untrained}
        for name, case in SCRIPTED.items():
            places[self.folder / name / tables.CLASSICAL_ROWS] = partial(scripted, name, *case)
        for name, task in SEARCHERS.items():
            places[self.folder / name / tables.RADII_ROWS] = partial(searched, *task)
        for path, measure in places.items():
            if path.parent.is_dir() and not path.is_file():
                write_text(path, csv_text(measure(), "%.4f"))
        for path in self.folder.glob(f"*/{tables.RADII_ROWS}"):
            rows = tables.by_radius(path.parent).query("policy not in @UNDRAWN")
            figures.save(reach(rows), path.with_suffix(".png"))
        folders = {path.parent.name: path.parent for path in self.folder.glob("*/runs.csv")}
        found = {name: tables.rows_of(folders[name]) for name in sorted(folders.keys() - SEARCHERS)}
        shown = {label: found[name].query("label == @label") for label, name in COLUMNS.items()}
        together = pandas.concat(shown.values())
        write_text(self.folder / "strip.csv", csv_text(together, "%.4f"))
        figures.save(strip(shown), self.folder / "strip.png")
        for name, rows in found.items():
            if rows[["deterministic_gap", "deterministic_makespan"]].notna().any(axis=None):
                groups = dict(list(rows.groupby("label", sort=False)))
                file = "makespans.png" if tables.unbounded(rows) else "gaps.png"
                figures.save(strip(groups), self.folder / name / file)
        print(f"written to {self.folder}: strip.csv, strip.png, a figure for each study")
        return True


def untrained() -> DataFrame:
    """Measure the policies that are not trained on a field."""
    labels = (label for label, place in COLUMNS.items() if place == FIELDS)
    cases = product(labels, catalogue_names())
    rows = [measured(label, POLICIES.get(label, label), field) for label, field in cases]
    return DataFrame(rows, columns=tables.ROW)


def scripted(name: str, policies: Sequence[str], episodes: int) -> DataFrame:
    """Measure policies that do not learn, in the fields and environments of a study."""
    study = Study(study=name).config()
    variants = {str(one.environment): one for one in reversed(study.variants)}  # the first of each
    rows = []
    for policy, one, field in product(policies, reversed(variants.values()), study.fields):
        settings = {key: some for key, some in one.environment.items() if key != "observation"}
        label = f"{policy}-{one.name.rpartition('-')[2]}"
        rows.append(measured(label, POLICIES.get(policy, policy), field, episodes, **settings))
    return DataFrame(rows, columns=tables.ROW)


def measured(
    label: str, policy: str, field: str, episodes: int = 1, **settings: Any
) -> tuple[Any, ...]:
    """Return a row of episodes by mean actions."""
    source = Source(policy)
    loaded = source.make(field, **settings)
    done = evaluate(loaded, field, loaded.settings, episodes=episodes, deterministic=True)
    sees, found = information_of(loaded.policy, loaded.settings, source.run), done.summary()
    won, numbers = found["success_rate"], (found[name] for name in ("makespan", "gap", "spl"))
    return (label, sees, Path(field).stem, "", won == 1.0, won, *numbers)


def strip(groups: Mapping[str, DataFrame]) -> Figure:
    steps = any(map(tables.unbounded, groups.values()))
    shown = "deterministic_makespan" if steps else "deterministic_gap"
    values = {label: rows[shown].where(rows.passed) for label, rows in groups.items()}
    known = {label: [*some.replace({np.nan: None})] for label, some in values.items()}
    return strips_figure(known, steps=steps)


def searched(tier: str, policies: Mapping[str, Sequence[float]]) -> DataFrame:
    """Measure each field of a tier at many radii, one episode each; a failure has no gap."""
    rows = []
    frozen = {one.field.name: one for one in load_tiers(SPLIT, [tier])[tier]}
    for (label, radii), (name, one) in product(policies.items(), frozen.items()):
        bare = label.removesuffix(SHIELD)
        source = Source(POLICIES.get(bare, bare))
        for radius in radii:
            own = {**one.settings, "knowledge": "own", "comm_radius": radius}
            loaded = source.make(one.field, **own)
            sees = information_of(loaded.policy, loaded.settings, source.run)
            policy = loaded.policy if bare == label else Shielded(loaded.policy)
            done = evaluate(policy, [one], loaded.settings, episodes=1, deterministic=True)
            rows.append((label, sees, name, radius, done.summary()["gap"]))
    return DataFrame(rows, columns=tables.SEARCH_ROW)


@matplotlib.rc_context(style.MATPLOTLIB)
def reach(rows: DataFrame) -> Figure:
    """Draw the makespan over the bound by radius: the mean over fields and its 95 % interval."""
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    axes = figure.add_subplot()
    for look, (label, own) in enumerate(rows.dropna().groupby("policy")):
        of_fields = 1.0 + own.groupby(["comm_radius", "field"]).gap.mean()  # over seeds
        found = of_fields.groupby("comm_radius").apply(lambda some: mean_interval([*some]))
        if own.information.iloc[0] == "state":  # the same at every radius
            mean = found.iloc[0].mean
            axes.axhline(mean, ls="--", color=style.FAINT_INK, label=f"{label}, which sees all")
            continue
        # Radii without a measurement stay NaN, so that no line crosses them.
        measured = np.full((len(RADII), 3), np.nan)
        measured[[RADII.index(radius) for radius in found.index]] = np.array([*found], float)
        means, low, high = measured.T
        colour, dash, marker = style.series(look)
        places = np.arange(len(RADII)) + 0.04 * (look - 3)  # side by side
        ends = (means - low, high - means)
        line = dash if np.isfinite(means[1:] - means[:-1]).any() else "none"
        axes.errorbar(places, means, ends, fmt=marker, color=colour, ls=line, ms=4, label=label)
    axes.set_xticks(range(len(RADII)), ["all" if r == math.inf else f"{r:g}" for r in RADII])
    axes.set(ylim=(1.0, None), xlabel="comm_radius, units", ylabel="makespan over the bound")
    axes.grid(True)
    axes.legend()
    return figure
