"""The tables of the pages of results, of the same rows as their figures."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas
from numpy.typing import NDArray
from pandas import DataFrame
from scipy.stats import binomtest

from baselines.compare.text_table import TextTable
from baselines.evaluation.intervals import mean_interval
from baselines.runs.files import RunError, read_json, read_text, write_text
from benchmarks.leaderboard import SPLIT
from mbn_marl.field import load_split, splits

PLACE = re.compile(r"(?m)^<!-- table: (\S+) -->\n(?:\n(?:\|.*\n)+)?")
CLASSICAL_ROWS = "classical.csv"
BOARD, SEARCHED, PRICED, PASSED = "leaderboard", "search", "price", "passages"
RADII_ROWS = "radii.csv"
# Of makespans at communication radii, or the proved bound.
RATIOS = "0 / bound", "100 / bound", "inf / bound", "100 / inf", "0 / inf"
SEARCH_ROW = ["policy", "information", "field", "comm_radius", "gap"]
ROW = [
    *("label", "information", "field", "seed", "passed"),
    *("success_rate", "deterministic_makespan", "deterministic_gap", "spl"),
]


@dataclass(frozen=True)
class Tables:
    """Write below each `<!-- table: STUDY -->` the table of that study."""

    folder: Path = Path("docs/results")
    """With the pages, STUDY/runs.csv, and results of `mbn benchmark`."""

    def run(self, command: str) -> bool:
        pages = sorted(self.folder.glob("*.md"))
        if not pages:
            raise RunError(f"{self.folder}: no pages; allowed: a folder with some, docs/results")
        for page in pages:
            if (filled := fill(page)) != read_text(page):
                write_text(page, filled)
                print(f"written to {page}")
        return True


def fill(page: Path) -> str:
    def below(place: re.Match[str]) -> str:
        folder = page.parent / place[1]
        if not folder.is_dir():  # not run yet
            return place[0]
        made = {BOARD: weather, SEARCHED: searched, PRICED: searched, PASSED: passages}
        text = made.get(folder.name, table)(folder)
        return f"<!-- table: {place[1]} -->\n\n{text.markdown().strip()}\n"

    return PLACE.sub(below, read_text(page))


def weather(folder: Path) -> TextTable:
    """Return makespan and success under each condition, by mean actions, most success first."""
    lines = []
    for path in folder.glob("*.json"):
        instances = read_json(path)["tiers"][splits.WEATHER]["instances"]
        if instances:
            rows = DataFrame([{"condition": row["condition"], **row["mean"]} for row in instances])
            means = rows.groupby("condition")[["makespan", "success_rate"]].mean()
            cells = [means.loc[name] for name in splits.CONDITIONS]
            words = [f"{cell.makespan:.1f} ({cell.success_rate:.0%})" for cell in cells]
            words = [word.replace("nan", "-") for word in words]  # no success
            sees = instances[0]["information"]
            order = -rows.success_rate.mean(), np.nan_to_num(rows.makespan.mean(), nan=np.inf)
            lines.append((*order, path.stem, sees, *words))
    headings = ("policy", "information", *splits.CONDITIONS)
    return TextTable("", headings, [line[2:] for line in sorted(lines)], words=2)


def searched(folder: Path) -> TextTable:
    """Return success at each radius, and ratios of makespans, by mean actions, fields paired."""
    lines = []
    for (policy, sees), own in by_radius(folder).groupby(["policy", "information"]):
        success = own.gap.notna().groupby(own.comm_radius).mean().reindex(splits.RADII.values())
        shares = " / ".join("-" if np.isnan(share) else f"{share:.0%}" for share in success)
        gaps = own.pivot_table("gap", "field", "comm_radius").reindex(columns=success.index)
        never, near, all_heard = (1.0 + gaps).to_numpy().T
        found = (never, near, all_heard, near / all_heard, never / all_heard)  # as RATIOS has them
        words = [_with_ends(ratios[~np.isnan(ratios)]) for ratios in found]
        lines.append((-success.sum(), words[2], policy, sees, shares, *words))
    headings = ("policy", "information", f"success at {' / '.join(splits.RADII)}", *RATIOS)
    return TextTable("", headings, [line[2:] for line in sorted(lines)], words=2)


def by_radius(folder: Path) -> DataFrame:
    """Read the makespan over the bound, less one, by policy, field and communication radius.

    Of policies measured at many radii, of results of the benchmark, and of runs, whose labels are
    POLICY-RADIUS and whose fields have a row for each seed. A failure has no gap.
    """
    found = [pandas.read_csv(path) for path in folder.glob(RADII_ROWS)]
    known = {policy for rows in found for policy in rows.policy}
    for path in sorted(folder.glob("*.json")):
        if path.stem not in known:
            rows = DataFrame(read_json(path)["tiers"][splits.SEARCH]["instances"])
            gap, radius = [one["gap"] for one in rows["mean"]], rows.comm_radius.map(splits.RADII)
            found.append(rows.assign(policy=path.stem, comm_radius=radius, gap=gap))
    if (path := folder / "instances.csv").is_file():
        rows = pandas.read_csv(path)
        policy, radius = rows.label.str.rsplit("-", n=1, expand=True).to_numpy().T
        gap = rows.makespan / rows.bound - 1.0
        runs = pandas.read_csv(folder / "runs.csv").groupby("label").information
        sees = rows.label.map(runs.first())
        own = {"policy": policy, "information": sees, "field": rows.instance, "gap": gap}
        found.append(DataFrame({**own, "comm_radius": radius.astype(float)}))
    return pandas.concat(found, ignore_index=True)[SEARCH_ROW]


def passages(folder: Path) -> TextTable:
    """Return success, and makespans over the bound and the best plan, by mean actions."""
    frozen = load_split(SPLIT, splits.PASSAGES)
    best = {one.field.name: one.best_known for one in frozen}
    lines = []
    for path in folder.glob("*.json"):
        instances = read_json(path)["tiers"][splits.PASSAGES]["instances"]
        rows = DataFrame([{**row, **row["mean"]} for row in instances])
        won, success = rows.dropna(subset="makespan"), rows.success_rate.mean()
        ratios = (won.makespan / least for least in (won.makespan_lower_bound, won.field.map(best)))
        words = [_with_ends(some.to_numpy()) for some in ratios]
        sees = ", ".join(rows.information.unique())
        lines.append((-success, words[0], path.stem, sees, f"{success:.0%}", *words))
    headings = ("policy", "information", "success", "makespan / bound", "makespan / best plan")
    return TextTable("", headings, [line[2:] for line in sorted(lines)], words=2)


def _with_ends(ratios: NDArray[np.float64]) -> str:
    if not len(ratios):
        return "-"
    mean, low, high = mean_interval([*ratios])
    return f"{mean:.2f}" + ("" if low in (None, high) else f" ({low:.2f}..{high:.2f})")


def rows_of(study: Path) -> DataFrame:
    """Read a row for each run, also of policies that do not learn."""
    files = (study / name for name in ("runs.csv", CLASSICAL_ROWS))
    parts = [pandas.read_csv(path) for path in files if path.is_file()]
    return pandas.concat(parts, ignore_index=True).reindex(columns=ROW)


def unbounded(rows: DataFrame) -> bool:
    """Return whether some run passes in a field without a known bound."""
    return bool((rows.passed & rows.deterministic_gap.isna()).any())


def table(study: Path) -> TextTable:
    """Return a row for each variant, by SPL; gaps are of the median run of a field, mean actions.

    Without bounds makespans are in their place. A column that no row has a value for is left out.
    """
    rows = rows_of(study)
    steps = unbounded(rows)
    shown = rows.deterministic_makespan if steps else rows.deterministic_gap
    cells = shown.where(rows.passed, np.inf).groupby([rows.label, rows.field]).median().unstack()
    form = "{:.1f}" if steps else "{:.0%}"
    lines = []
    for label, own in rows.groupby("label", sort=False):
        passed, runs = own.passed.sum(), len(own)
        low, high = binomtest(passed, runs).proportion_ci(method="wilson")
        known = cells.loc[label].dropna()
        solved = known[np.isfinite(known)]
        words = {
            "variant": label,
            "sees": own.information.iloc[0],
            "runs pass": f"{passed}/{runs}",
            "95 %": f"{low:.0%}..{high:.0%}",
            "success": f"{own.success_rate.mean():.1%}",
            "makespan" if steps else "gap": form.format(solved.mean()),
            "worst field": form.format(solved.max()),
            "fields failed": f"{len(known) - len(solved)}",
            "SPL": "nan" if steps else f"{own.spl.mean():.3f}",
        }
        lines.append(words)
    found = DataFrame(lines).replace({"nan": None, "nan%": None}).dropna(axis="columns", how="all")
    if "SPL" in found:
        found = found.sort_values("SPL", ascending=False, kind="stable")
    cells_of = found.fillna("-").astype(str).to_numpy().tolist()
    return TextTable("", tuple(found), cells_of, words=1 + ("sees" in found))
