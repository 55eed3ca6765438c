"""The leaderboard: a page made of the results that are committed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compare.benchmark import (
    CAPTION,
    WAYS,
    cells,
    load_protocol,
    load_tiers,
    summarise,
)
from baselines.compare.benchmark import COLUMNS as COLUMNS_OF_RESULTS
from baselines.compare.text_table import TextTable
from baselines.policies.shielded import behind
from baselines.runs.files import read_json, write_text
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Instance, splits

SPLIT, REFERENCE = "test", "greedy"
INTRODUCTION = """# Leaderboard

Policies on the split `test` by protocol {version} of [the benchmark](../benchmark.md), which says
what the columns are and how to enter one. `python -m benchmarks leaderboard` makes this page of
`docs/results/leaderboard/*.json`, which have the other columns too. Tables are in the order of
their first number, the smallest first: the gap in which failures count as T_max or, of `5-weather`,
which has no bounds, the steps so counted. Times were measured on different machines, some of them
busy: rows differ by that too.
"""
COLUMNS = ("success_rate", "makespan", "decision_ms")
NO_BREAK = "\N{NO-BREAK SPACE}"
NOBODY = "No policy has been entered yet."


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
    if not folder.is_dir():
        raise ConfigError("leaderboard", [f"folder: {folder} is none"])
    problems: list[str] = []
    results: dict[str, Any] = {}
    for path in sorted(folder.glob("*.json")):
        with collecting(problems):
            results[path.stem] = read_json(path)
    parts = [INTRODUCTION.format(version=protocol.version)]
    if not results and not problems:
        return "\n".join([*parts, NOBODY, ""])
    frozen = load_tiers(SPLIT, protocol.tiers)
    problems += [
        f"{name}.json: {problem}"
        for name, record in results.items()
        for problem in _problems(record, frozen)
    ]
    if problems:
        raise ConfigError(str(folder), problems)
    results = {_row_name(name, record): record for name, record in results.items()}
    parts += [CAPTION, ""]
    every = {name: record["tiers"].values() for name, record in results.items()}
    whole = {
        name: summarise([row for one in tiers for row in one["instances"]])
        for name, tiers in every.items()
        if not any(one["misfit"] for one in tiers)
    }
    parts += [_table(whole).markdown("All tiers"), ""] if whole else []
    for tier in protocol.tiers:
        found = {name: record["tiers"][tier] for name, record in results.items()}
        parts += [_table(found).markdown(tier), ""]
    parts += [_by_condition(results).markdown(f"{splits.WEATHER}, success by condition"), ""]
    if REFERENCE in results:
        parts += [_faster(results).markdown(f"Instances solved faster than by {REFERENCE}"), ""]
    commands = [f"- {name}: `{record['command']}`" for name, record in results.items()]
    return "\n".join([*parts, "## Commands", "", *commands, ""])


def _by_condition(results: Mapping[str, Any]) -> TextTable:
    lines = []
    for name, way, rows in _rows_of(results, splits.WEATHER):
        cells = []
        for condition in splits.CONDITIONS:
            own = [row[way]["success_rate"] for row in rows if row["condition"] == condition]
            cells.append(f"{np.mean(own):.1%}" if own else "-")
        lines.append((name, way, *cells))
    return TextTable("", ("policy", "actions", *splits.CONDITIONS), lines, words=2)


def _faster(results: Mapping[str, Any]) -> TextTable:
    counts: dict[tuple[str, str], dict[str, str]] = {}
    for tier in splits.TIERS:
        theirs = [row["mean"]["makespan"] for row in results[REFERENCE]["tiers"][tier]["instances"]]
        for name, way, rows in _rows_of(results, tier):
            pairs = [*zip((row[way]["makespan"] for row in rows), theirs, strict=True)]
            faster = sum(a is not None and (b is None or a < b) for a, b in pairs)
            if name != REFERENCE:
                counts.setdefault((name, way), {})[tier] = f"{faster} of {len(pairs)}"
    lines = [(*who, *(one.get(tier, "-") for tier in splits.TIERS)) for who, one in counts.items()]
    return TextTable("", ("policy", "actions", *splits.TIERS), lines, words=2)


def _rows_of(results: Mapping[str, Any], tier: str) -> Iterator[tuple[str, str, Sequence[Any]]]:
    for name, record in results.items():
        rows = record["tiers"][tier]["instances"]
        yield from ((name, way, rows) for way in WAYS if rows and rows[0][way])


def _row_name(name: str, record: Mapping[str, Any]) -> str:
    shield = record.get("shield", False)
    return f"{name.removesuffix('-shield') if shield else name}{behind(shield)}"


def _problems(record: Any, frozen: Mapping[str, tuple[Instance, ...]]) -> Iterator[str]:
    """Yield what is wrong with a result; put statistics of its rows in place of those it has."""
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
    names = ("condition", "makespan_lower_bound", "best_known")
    for tier, instances in frozen.items():
        if tier not in tiers:
            yield f"tiers: {tier} is missing"
            continue
        now = [[one.field.name, *(getattr(one, name) for name in names)] for one in instances]
        try:
            rows, wanted = tiers[tier]["instances"], [] if tiers[tier]["misfit"] else now
            if [[row[name] for name in ("field", *names)] for row in rows] != wanted:
                yield f"{tier}: fields or bounds are not those of today; run it again"
            tiers[tier] |= summarise(rows)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            yield f"{tier}: not as mbn benchmark writes it: {type(error).__name__}: {error}"


def _table(found: Mapping[str, Mapping[str, Any]]) -> TextTable:
    ways = [one[way] for one in found.values() for way in WAYS if one.get(way)]
    bounded = any(way["gap_with_failures"] for way in ways)
    key = "gap_with_failures" if bounded else "makespan_with_failures"
    columns, lines = (key, *COLUMNS), []
    for name, one in found.items():
        for way in filter(one.get, WAYS):
            whole = (text.replace(" ", NO_BREAK) for text in cells(one, way, columns))
            lines.append((one[way][key]["mean"], (name, way, *whole)))
        if one.get("misfit"):
            line = (name, "does not fit", *cells({}, "mean", columns))
            lines.append((float("inf"), line))
    headings = (COLUMNS_OF_RESULTS[column][0] for column in columns)
    ordered = [line for _, line in sorted(lines)]
    return TextTable("", ("policy", "actions", *headings), ordered, words=2)
