"""A comparison as a Markdown page beside its tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

from baselines.compare.pictures import draw_learning_curves, draw_statistics, ranked
from baselines.compare.results import Results
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, overall_tables
from baselines.evaluation.policy import load_policy
from baselines.evaluation.rollout import record_episode, write_animation, write_trajectories
from baselines.runs.files import write_json, write_text
from baselines.runs.report_path import Place

PAGE = "comparison.md"
STATISTICS = {
    "Aggregates": "aggregates.png",
    "Performance profiles": "profiles.png",
    "Probability of improvement": "improvement.png",
}
"""Files of the figures over all fields, by title."""


def write_comparison(results: Results, place: Place) -> Comparison:
    """Write tables, figures and every number.

    The page has the tables; the folder ``comparison.json`` with every number, ``table.csv`` with a
    row for every label and field, and the figures.
    """
    from mbn_marl.render import figures

    comparison, out = summarise(results), place.folder
    write_json(out / "comparison.json", comparison.to_json())
    write_text(out / "table.csv", comparison.csv())
    pictures = {}
    for title, figure in draw_statistics(comparison).items():
        figures.save(figure, out / STATISTICS[title])
        pictures[title] = STATISTICS[title]
    for field in results.fields:
        name = pictures[f"Learning curves, {field}"] = f"learning_curves_{field}.png"
        curves = draw_learning_curves(results.of_field(field), results.looks)
        figures.save(curves, out / name)
        _draw_best(results, field, out)
    write_text(place.page, _page(comparison, pictures, place))
    return comparison


def _page(comparison: Comparison, pictures: Mapping[str, str], place: Place) -> str:
    """The Markdown page."""
    tables = overall_tables(comparison) | field_tables(comparison)
    images = [f"![{title}]({place.link(name)})" for title, name in pictures.items()]
    broken = [f"- {name}: {error}" for name, error in comparison.broken.items()]
    if broken:
        broken = ["## Runs that diverged: their variants are left out", "\n".join(broken)]
    shown = [table.markdown(title) for title, table in tables.items()]
    return "\n\n".join(["# Comparison", *broken, *shown, "## Figures", *images]) + "\n"


def _draw_best(results: Results, field: str, out: Path) -> None:
    """Draw an episode of the field's best policy, as paths and as an animation."""
    best = ranked(itertools.chain(*results.of_field(field).values()))[0]
    episode = record_episode(load_policy(best.run), best.field, best.config["environment"])
    title = f"{best.run.path.name}: return {episode.team_return:,.0f}, {episode.steps} steps"
    write_trajectories(episode, out / f"trajectories_{field}.png", title)
    write_animation(episode, out / f"episode_{field}.gif")
