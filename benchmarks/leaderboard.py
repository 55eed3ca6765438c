"""The leaderboard: a page made of the results that are committed."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.compare import benchmark
from baselines.compare.benchmark import ALL, WAYS, cells, rank
from baselines.compare.text_table import TextTable
from baselines.policies.shielded import behind
from baselines.runs.files import differences, read_json, write_text
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Instance

SPLIT = "test"
INTRODUCTION = """# Leaderboard

Policies on the split `test` by protocol {version}. [The benchmark](../benchmark.md) says
what the columns are and how to enter one. `python -m benchmarks leaderboard` makes this page of
`docs/results/leaderboard/*.json`, which have the other columns too. SPL orders the tables; success,
then makespan, order those of `5-weather`, which has no bounds. *Information* is
[what a policy acts on](../benchmark.md#information). `6-search` and
`7-passages` have [another page](search.md).
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
    protocol = benchmark.load_protocol()
    if not (paths := sorted(folder.glob("*.json"))):
        raise ConfigError("leaderboard", [f"folder: {folder} has no result"])
    problems: list[str] = []
    results: dict[str, Any] = {}
    for path in paths:
        with collecting(problems):
            results[path.stem] = read_json(path)
    frozen = benchmark.load_tiers(SPLIT, protocol.tiers)
    problems += [
        f"{name}.json: {problem}"
        for name, record in results.items()
        for problem in _problems(record, frozen)
    ]
    if problems:
        raise ConfigError(str(folder), problems)
    results = {_row_name(name, record): record for name, record in results.items()}
    parts = [INTRODUCTION.format(version=protocol.version), benchmark.CAPTION, ""]
    found = {name: benchmark.summaries(record["tiers"]) for name, record in results.items()}
    for tier in (ALL, *protocol.tiers):
        table = _table(found, tier)
        parts += [table.markdown("All tiers" if tier == ALL else tier), ""] if table.lines else []
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
    headings = (benchmark.COLUMNS[column][0] for column in COLUMNS)
    return TextTable("", (*WHO, *headings), lines, words=3)


def _row_name(name: str, record: Mapping[str, Any]) -> str:
    shield = record.get("shield", False)
    return f"{name.removesuffix('-shield') if shield else name}{behind(shield)}"


def _problems(record: Any, frozen: Mapping[str, tuple[Instance, ...]]) -> Iterator[str]:
    if not isinstance(record, dict) or not isinstance(record.get("tiers"), dict):
        yield "is no result of mbn benchmark"
        return
    protocol, tiers = benchmark.load_protocol(), record["tiers"]
    ours = {"protocol": protocol.version, "splits": protocol.splits, "split": SPLIT}
    yield from differences(record, ours)
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
