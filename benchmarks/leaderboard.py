"""The leaderboard: a page made of the results that are committed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.compare.benchmark import (
    ALL,
    CAPTION,
    WAYS,
    cells,
    load_protocol,
    load_tiers,
    rank,
    summaries,
)
from baselines.compare.benchmark import COLUMNS as COLUMNS_OF_RESULTS
from baselines.compare.text_table import TextTable, shown
from baselines.evaluation.intervals import mean_of_known
from baselines.policies.shielded import behind
from baselines.runs.files import read_json, write_text
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Instance, splits

SPLIT, REFERENCE = "test", "greedy"
INTRODUCTION = """# Leaderboard

Policies on the split `test` by protocol {version} of [the benchmark](../benchmark.md), which says
what the columns are and how to enter one. `python -m benchmarks leaderboard` makes this page of
`docs/results/leaderboard/*.json`, which have the other columns too. SPL orders the tables; success,
then makespan, order those of `5-weather`, which has no bounds. *Information* is
[what a policy acts on](../benchmark.md#information).
"""
COLUMNS = ("spl", "success_rate", "gap", "makespan", "decision_ms")
WHO = ("policy", "actions", "information")
Row = tuple[str, str, dict[str, Any]]
NO_BREAK = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Leaderboard:
    """Make the page of the leaderboard of the results in a folder."""

    folder: Path = Path("docs/results/leaderboard")
    """With results of `mbn benchmark`, behind the shield NAME-shield; the page is beside it."""

    def run(self, command: str) -> bool:
        page = self.folder.with_suffix(".md")
        write_text(page, leaderboard(self.folder))
        print(f"written to {page}")
        return True


def leaderboard(folder: Path) -> str:
    """Return the page; a ConfigError names results that are damaged, or not of the whole split."""
    protocol = load_protocol()
    if not (paths := sorted(folder.glob("*.json"))):
        raise ConfigError("leaderboard", [f"folder: {folder} has no result"])
    problems: list[str] = []
    results: dict[str, Any] = {}
    for path in paths:
        with collecting(problems):
            results[path.stem] = read_json(path)
    frozen = load_tiers(SPLIT, protocol.tiers)
    problems += [
        f"{name}.json: {problem}"
        for name, record in results.items()
        for problem in _problems(record, frozen)
    ]
    if problems:
        raise ConfigError(str(folder), problems)
    results = {_row_name(name, record): record for name, record in results.items()}
    parts = [INTRODUCTION.format(version=protocol.version), CAPTION, ""]
    found = {name: summaries(record["tiers"]) for name, record in results.items()}
    for tier in (ALL, *protocol.tiers):
        table = _table(found, tier)
        parts += [table.markdown("All tiers" if tier == ALL else tier), ""] if table.lines else []
    parts += [_by_condition(results, found).markdown(f"{splits.WEATHER} by condition"), ""]
    if REFERENCE in results:
        parts += [_faster(results).markdown(f"Instances solved faster than by {REFERENCE}"), ""]
    commands = [f"- {name}: `{record['command']}`" for name, record in results.items()]
    return "\n".join([*parts, "## Commands", "", *commands, ""])


def _ordered(found: Mapping[str, Mapping[str, Any]], tier: str) -> list[Row]:
    """Return name, way of acting and summary of the policies that fit a tier, the best first."""
    fit = {name: tiers[tier] for name, tiers in found.items() if tier in tiers}
    rows = [(name, way, one) for name, one in fit.items() for way in WAYS if one[way]]
    means = [{k: value and value.mean for k, value in one[way].items()} for _, way, one in rows]
    return [rows[k] for k in sorted(range(len(rows)), key=lambda k: rank(means[k]), reverse=True)]


def _table(found: Mapping[str, Mapping[str, Any]], tier: str) -> TextTable:
    lines = []
    for name, way, one in _ordered(found, tier):
        whole = (text.replace(" ", NO_BREAK) for text in cells(one, way, COLUMNS))
        lines.append((name, way, one["information"], *whole))
    if tier != ALL:
        misfits = (name for name, tiers in found.items() if tier not in tiers)
        lines += [(name, "does not fit", "-", *cells({}, "mean", COLUMNS)) for name in misfits]
    headings = (COLUMNS_OF_RESULTS[column][0] for column in COLUMNS)
    return TextTable("", (*WHO, *headings), lines, words=3)


def _by_condition(results: Mapping[str, Any], found: Mapping[str, Mapping[str, Any]]) -> TextTable:
    lines = []
    for name, way, one in _ordered(found, splits.WEATHER):
        rows, texts = results[name]["tiers"][splits.WEATHER]["instances"], []
        for condition in splits.CONDITIONS:
            own = [row[way] for row in rows if row["condition"] == condition]
            forms = {"success_rate": "{:.1%}", "makespan": "{:.1f}"}.items()
            both = [shown(mean_of_known(row[name] for row in own), form) for name, form in forms]
            texts.append(", ".join(both))
        lines.append((name, way, one["information"], *texts))
    return TextTable("Success and makespan.", (*WHO, *splits.CONDITIONS), lines, words=3)


def _faster(results: Mapping[str, Any]) -> TextTable:
    counts: dict[tuple[str, ...], dict[str, str]] = {}
    for tier in splits.TIERS:
        theirs = [row["mean"]["makespan"] for row in results[REFERENCE]["tiers"][tier]["instances"]]
        for name, record in results.items():
            rows = record["tiers"][tier]["instances"]
            for way in (way for way in WAYS if name != REFERENCE and rows and rows[0][way]):
                pairs = [*zip((row[way]["makespan"] for row in rows), theirs, strict=True)]
                faster = sum(a is not None and (b is None or a < b) for a, b in pairs)
                who = name, way, rows[0]["information"]
                counts.setdefault(who, {})[tier] = f"{faster} of {len(pairs)}"
    lines = [(*who, *(one.get(tier, "-") for tier in splits.TIERS)) for who, one in counts.items()]
    return TextTable("", (*WHO, *splits.TIERS), lines, words=3)


def _row_name(name: str, record: Mapping[str, Any]) -> str:
    shield = record.get("shield", False)
    return f"{name.removesuffix('-shield') if shield else name}{behind(shield)}"


def _problems(record: Any, frozen: Mapping[str, tuple[Instance, ...]]) -> Iterator[str]:
    """Yield what is wrong with a result."""
    if not isinstance(record, dict) or not isinstance(record.get("tiers"), dict):
        yield "is no result of mbn benchmark"
        return
    protocol, tiers = load_protocol(), record["tiers"]
    ours = {"protocol": protocol.version, "splits": protocol.splits, "split": SPLIT}
    for name, value in ours.items():
        if record.get(name) != value:
            yield f"{name}: {record.get(name)!r}; needed: {value!r}"
    if not isinstance(record.get("command"), str):
        yield "command: missing"
    names = ("condition", "makespan_lower_bound")
    for tier, instances in frozen.items():
        if tier not in tiers:
            yield f"tiers: {tier} is missing"
            continue
        now = [[one.field.name, *(getattr(one, name) for name in names)] for one in instances]
        try:
            rows, wanted = tiers[tier]["instances"], [] if tiers[tier]["misfit"] else now
            if [[row[name] for name in ("field", *names)] for row in rows] != wanted:
                yield f"{tier}: fields or bounds are not those of today; run it again"
            _ = [[row[name] for name in ("information", *WAYS, "times")] for row in rows]  # raises
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            yield f"{tier}: not as mbn benchmark writes it: {type(error).__name__}: {error}"
