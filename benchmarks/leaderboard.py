"""The leaderboard: a page made of the results that are committed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from baselines.compare.benchmark import WAYS, load_protocol, load_tiers
from baselines.compare.benchmark_page import CAPTION, cells, headings
from baselines.compare.text_table import TextTable
from baselines.runs.files import read_json, write_text
from mbn_marl.errors import ConfigError
from mbn_marl.field import Instance

SPLIT = "test"
INTRODUCTION = """# Leaderboard

Policies on the split `test` by protocol {version} of [the benchmark](../benchmark.md), which says
what the columns are and how to enter one. `python -m benchmarks leaderboard` makes this page of
`docs/results/leaderboard/*.json`. In each table, who needs the fewest steps where failures count
as T_max comes first.
"""
NOBODY = "No policy has been entered yet."


@dataclass(frozen=True)
class Leaderboard:
    """Make the page of the leaderboard of the results in a folder."""

    name: ClassVar[str] = "leaderboard"

    folder: Path = Path("docs/results/leaderboard")
    """With results of `mbn benchmark`, each under a name of its own; the page is beside it."""

    def run(self, command: str) -> bool:
        """Write the page."""
        page = self.folder.with_suffix(".md")
        write_text(page, leaderboard(self.folder))
        print(f"written to {page}")
        return True


def leaderboard(folder: Path) -> str:
    """Return the page of the results in a folder.

    Raises:
        ConfigError: naming the results that are not of the whole split by the present protocol.
    """
    protocol = load_protocol()
    results = {path.stem: read_json(path) for path in sorted(folder.glob("*.json"))}
    parts = [INTRODUCTION.format(version=protocol.version)]
    if not results:
        return "\n".join([*parts, NOBODY, ""])
    frozen = load_tiers(SPLIT, protocol.tiers)
    problems = [
        f"{name}.json: {problem}"
        for name, record in results.items()
        for problem in _problems(record, frozen)
    ]
    if problems:
        raise ConfigError(str(folder), problems)
    parts += [CAPTION, ""]
    whole = {name: record["all"] for name, record in results.items() if record["all"]}
    parts += [_table(whole).markdown("All tiers"), ""] if whole else []
    for tier in protocol.tiers:
        found = {name: record["tiers"][tier] for name, record in results.items()}
        parts += [_table(found).markdown(tier), ""]
    commands = [f"- {name}: `{record['command']}`" for name, record in results.items()]
    return "\n".join([*parts, "## Commands", "", *commands, ""])


def _problems(record: Any, frozen: Mapping[str, tuple[Instance, ...]]) -> Iterator[str]:
    """Yield why a result has no place in the leaderboard."""
    protocol = load_protocol()
    wanted = {"protocol": protocol.version, "splits": protocol.splits, "split": SPLIT}
    try:
        for name, value in wanted.items():
            if record[name] != value:
                yield f"{name}: {record[name]!r}; needed: {value!r}"
        for tier, instances in frozen.items():
            if tier not in record["tiers"]:
                yield f"tiers: {tier} is missing"
                continue
            one = record["tiers"][tier]
            known = [
                (row["field"], row["condition"], row["makespan_lower_bound"], row["best_known"])
                for row in one["instances"]
            ]
            now = [
                (each.field.name, each.condition, each.makespan_lower_bound, each.makespan)
                for each in instances
            ]
            if not one["misfit"] and known != now:
                yield f"{tier}: fields or bounds are not those of today; run it again"
    except (KeyError, TypeError):
        yield "is no result of mbn benchmark"


def _table(found: Mapping[str, Mapping[str, Any]]) -> TextTable:
    """Return a table with a line for each policy and way of acting, the best first."""
    lines = []
    for name, one in found.items():
        for way in WAYS:
            if one.get(way):
                shown = one[way]["gap_with_failures"] or one[way]["makespan_with_failures"]
                words = (text.replace("\n", "<br>") for text in cells(one, way, "mean"))
                lines.append((shown["mean"], (name, way, *words)))
        if one.get("misfit"):
            lines.append((float("inf"), (name, "does not fit", *cells({}, "mean", "mean"))))
    ordered = tuple(line for _, line in sorted(lines))
    return TextTable("", ("policy", "actions", *headings()), ordered, words=2)
