"""The result of a benchmark: its tables, and its page with replays."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from baselines.compare.benchmark import CHOSEN, EPISODES
from baselines.compare.benchmark_statistics import WAYS
from baselines.compare.text_table import TextTable
from baselines.policies.shielded import behind
from mbn_marl.episode import load_episode
from mbn_marl.errors import EpisodeError
from mbn_marl.render.figures import svg, trajectory_panels
from mbn_marl.version import __version__
from mbn_marl.web.report import Section, Table, report_page

PAGE = "page.html"
COLUMNS: Mapping[str, tuple[str, str]] = {
    "success_rate": ("success", "{:.1%}"),
    "clean_rate": ("clean", "{:.1%}"),
    "collision_rate": ("collisions", "{:.1%}"),
    "wall_hits": ("wall hits", "{:.2f}"),
    "steps": ("steps", "{:.1f}"),
    "makespan": ("makespan", "{:.1f}"),
    "makespan_with_failures": ("makespan,\nfailed: T_max", "{:.1f}"),
    "gap": ("gap", "{:.1%}"),
    "gap_to_best_known": ("gap to\nbest known", "{:.1%}"),
    "gap_with_failures": ("gap,\nfailed: T_max", "{:.1%}"),
    "decision_ms": ("ms a\ndecision", "{:.2f}"),
    "begin_s": ("s to\nbegin", "{:.2f}"),
}
"""Headings and forms of the metrics, and of the times."""
STATISTICS = {"mean": "means", "iqm": "interquartile means"}
CAPTION = (
    "Intervals: 95 % over the instances. Gap: makespan over the proved bound, of successes. With "
    "failed: T_max, failures count as 1000 steps. Times: of the processor, with mean actions."
)


def cells(
    found: Mapping[str, Any], way: str, statistic: str, columns: Iterable[str] = COLUMNS
) -> tuple[str, ...]:
    """Return the cells of what was found in a tier or in all; dashes for nothing."""
    known = {**(found.get(way) or {}), **(found.get("times") or {})}
    return tuple(cell(known.get(name), statistic, COLUMNS[name][1]) for name in columns)


def cell(one: Mapping[str, Any] | None, statistic: str, form: str) -> str:
    """Return a statistic with its interval below; a dash for none."""
    if one is None:
        return "-"
    ends = ("iqm_low", "iqm_high") if statistic == "iqm" else ("low", "high")
    low, high = (one[end] for end in ends)
    interval = "" if low is None or low == high else f"\n{form.format(low)} .. {form.format(high)}"
    return form.format(one[statistic]) + interval


def headings(columns: Iterable[str] = COLUMNS) -> tuple[str, ...]:
    """Return the headings of the :func:`cells`."""
    return tuple(COLUMNS[name][0] for name in columns)


def result_tables(record: Mapping[str, Any], statistic: str = "mean") -> dict[str, TextTable]:
    """Return the tables of a result, one of :data:`STATISTICS`, by the way of acting in words."""
    misfits = {tier: one["misfit"] for tier, one in record["tiers"].items() if one["misfit"]}
    reasons = [f"{tier} does not fit: {reason}" for tier, reason in misfits.items()]
    tables = {}
    for way in WAYS:
        fitting = {tier: one for tier, one in record["tiers"].items() if one.get(way)}
        lines = [(tier, len(one["instances"]), one) for tier, one in fitting.items()]
        if record["all"] is not None:
            lines.append(("all", record["all"]["instances"], record["all"]))
        if fitting:
            table = [(tier, str(count), *cells(one, way, statistic)) for tier, count, one in lines]
            table += [(tier, "-", *cells({}, way, statistic)) for tier in misfits]
            columns, caption = ("tier", "fields", *headings()), "\n".join([CAPTION, *reasons])
            tables[f"{way} actions, {STATISTICS[statistic]}"] = TextTable(
                caption, columns, tuple(table)
            )
    return tables


def result_page(record: Mapping[str, Any], out: Path) -> str:
    """Return the page of a result whose episodes are in the folder ``out``."""
    found = [result_tables(record, statistic).items() for statistic in STATISTICS]
    tables = [Table(title, **vars(table)) for title, table in itertools.chain(*found)]
    sections = [Section("All tiers", tables=tables), *_tier_sections(record, out)]
    sections.append(Section("Command", texts={"This benchmark": record["command"]}))
    policy = f"{record['policy']}{behind(record['shield'])}"
    summary = (
        f"{policy} on the split {record['split']}, protocol {record['protocol']}. "
        f"Made by mbn_marl {__version__}."
    )
    return report_page("Benchmark", summary, sections)


def _tier_sections(record: Mapping[str, Any], out: Path) -> Iterator[Section]:
    """Yield the paths and replays of the median and the worst instance of each tier."""
    for tier, found in record["tiers"].items():
        if found["misfit"]:
            yield Section(tier, texts={"Does not fit": found["misfit"]})
            continue
        try:
            loaded = [load_episode(out / EPISODES / f"{tier}-{name}.json") for name in CHOSEN]
        except (EpisodeError, OSError) as error:  # of a tier that was done before
            yield Section(tier, texts={"Not shown": str(error)})
            continue
        episodes = {episode.source: episode for episode in loaded}
        lasts = {title: episode.snapshot(episode.steps) for title, episode in episodes.items()}
        drawn = svg(trajectory_panels(lasts, columns=2))
        figures = {f"Paths in the median and the worst instance of {tier}": drawn}
        yield Section(tier, figures=figures, episodes=list(episodes.values()))
