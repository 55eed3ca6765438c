"""A comparison as one self-contained HTML page."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from baselines.compare.pictures import draw_learning_curves, draw_statistics, ranked
from baselines.compare.results import Results
from baselines.compare.summary import Comparison
from baselines.compare.tables import field_tables, gaps, overall_tables
from baselines.compare.text_table import TextTable
from baselines.evaluation.rollout import record_episode
from baselines.policies.trained import load_trained
from mbn_marl.render.figures import svg, trajectory_panels
from mbn_marl.version import __version__
from mbn_marl.web.report import Section, Table, report_page


def comparison_page(results: Results, comparison: Comparison, command: str) -> str:
    """The page, which needs no other file and records the exact command."""
    runs = [record for cell in results.cells.values() for record in cell]
    made = "\n".join(record.run.command for record in runs)
    tables = overall_tables(comparison) | {"Optimality gap per field": gaps(comparison)}
    drawn = {title: svg(figure) for title, figure in draw_statistics(comparison).items()}
    sections = [
        Section("Over all fields", tables=_tables(tables), figures=drawn),
        *(_field_section(results, comparison, field) for field in results.fields),
        Section("Commands", texts={"This page": command, f"The {len(runs)} runs": made}),
    ]
    summary = f"{comparison.verdict} {len(runs)} runs, by mbn_marl {__version__}."
    return report_page(comparison.question, summary, sections)


def _field_section(results: Results, comparison: Comparison, field: str) -> Section:
    """One field: its table, its learning curves, and episodes of the best and the median policy."""
    groups = results.of_field(field)
    tables = field_tables(comparison).items()
    records = ranked(itertools.chain(*groups.values()))
    chosen = {"best": records[0], "median": records[len(records) // 2]}
    episodes = {}
    for rank, record in chosen.items():
        if rank == "best" or record is not records[0]:
            name = f"{rank}: {record.run.path.name}"
            policy, settings = load_trained(record.run), record.config["environment"]
            episodes[name] = record_episode(policy, record.field, settings, source=name)
    lasts = {name: episode.snapshot(episode.steps) for name, episode in episodes.items()}
    figures = {
        f"Learning curves on {field}": draw_learning_curves(groups, results.looks),
        f"Paths of the best and the median policy on {field}": trajectory_panels(lasts, columns=1),
    }
    return Section(
        field,
        tables=_tables({title: table for title, table in tables if title.startswith(f"{field}:")}),
        figures={title: svg(figure) for title, figure in figures.items()},
        episodes=list(episodes.values()),
    )


def _tables(tables: Mapping[str, TextTable]) -> list[Table]:
    return [Table(title, **vars(table)) for title, table in tables.items() if table.lines]
