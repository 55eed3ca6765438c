"""The page of a comparison, with its tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from baselines.compare.results import Kind, Result, Results, find_results
from baselines.compare.summary import THRESHOLDS, Comparison, summarise
from baselines.compare.tables import field_grids, markdown, overall_grids
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.evaluation.policy import load_policy
from baselines.evaluation.rollout import record_episode, write_animation, write_trajectories
from baselines.runs.files import write_json, write_text
from baselines.runs.provenance import write_provenance
from baselines.runs.report_path import Place

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "comparison.md"
STATISTICS = {
    "Aggregates": "aggregates.png",
    "Performance profiles": "profiles.png",
    "Probability of improvement": "improvement.png",
}
"""Files of the figures over all fields, by title."""


def report_comparison(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    force: bool = False,
    trust: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[Place, Comparison]:
    """Compare the finished runs at ``paths``, wherever they were trained.

    Args:
        paths: run folders, or folders that hold some.
        out: see :meth:`Place.of`.
        command: the exact command, recorded in the folder.
        force: move a report that is already there aside.
        trust: load pickled files of the runs whoever made them.
        note: is told which folders at ``paths`` are left out, and why.

    Raises:
        RunError: a path holds no run, a run is not finished, or something is at ``out`` already.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    results = find_results(paths, note, trust=trust)
    place = Place.of(out, PAGE)
    place.claim(force=force)
    write_provenance(place.folder, command)
    return place, write_comparison(results, place)


def write_comparison(results: Results, place: Place) -> Comparison:
    """Write tables, figures and every number.

    The page has the tables; the folder ``comparison.json`` with every number, ``table.csv`` with a
    row for every label and field, and the figures.
    """
    comparison, out = summarise(results), place.folder
    write_json(out / "comparison.json", comparison.to_json())
    write_text(out / "table.csv", comparison.csv())
    pictures = _save_statistics(comparison, out)
    for field in results.fields:
        pictures |= _draw_field(
            {label: results.cells[label, field] for label in results.labels}, out
        )
    write_text(place.page, _page(comparison, pictures, place))
    return comparison


def _page(comparison: Comparison, pictures: Mapping[str, str], place: Place) -> str:
    """The Markdown page."""
    overall = [markdown(title, grid) for title, grid in overall_grids(comparison).items()]
    fields = [markdown(title, grid) for title, grid in field_grids(comparison).items()]
    images = [f"![{title}]({place.link(name)})" for title, name in pictures.items()]
    broken = [f"- {name}: {error}" for name, error in comparison.broken.items()]
    if broken:
        broken = ["## Runs that broke down: their variants are left out", "\n".join(broken)]
    parts = ["# Comparison", *broken, *overall, *fields, "## Figures", *images]
    return "\n\n".join(parts) + "\n"


def draw_statistics(comparison: Comparison) -> dict[str, Figure]:
    """Figures of what is over all fields, by title."""
    from mbn_marl.render import figures

    drawn = {}
    if comparison.aggregates:
        names = {
            "interquartile mean": "iqm",
            "optimality gap": "gap",
            "optimality gap, mean actions": "deterministic_gap",
        }
        panels = {
            title: {entry.label: getattr(entry, name) for entry in comparison.aggregates}
            for title, name in names.items()
        }
        profiles = {entry.label: entry.profile for entry in comparison.aggregates}
        score = "return as a share of the proved optimum"
        drawn["Aggregates"] = figures.intervals_figure(panels)
        drawn["Performance profiles"] = figures.profiles_figure(profiles, THRESHOLDS, score)
    pairs = list(itertools.combinations(comparison.improvement, 2))
    if pairs:
        chances = {f"{x} > {y}": comparison.improvement[x][y] for x, y in pairs}
        panels = {"probability of improvement": chances}
        drawn["Probability of improvement"] = figures.intervals_figure(panels, rule=0.5)
    return drawn


def draw_learning_curves(groups: Mapping[str, Sequence[Result]]) -> Figure:
    """The learning curves of one field's runs, by label."""
    from mbn_marl.render import figures

    first = next(iter(groups.values()))[0]
    return figures.learning_curves(
        {label: [_curve(result) for result in group] for label, group in groups.items()},
        threshold=RETURN_THRESHOLD,
        optimum=first.optimum,
    )


def _save_statistics(comparison: Comparison, out: Path) -> dict[str, str]:
    """The files' names by what they show."""
    from mbn_marl.render import figures

    drawn = draw_statistics(comparison)
    for title, figure in drawn.items():
        figures.save(figure, out / STATISTICS[title])
    return {title: STATISTICS[title] for title in drawn}


def _draw_field(groups: Mapping[str, Sequence[Result]], out: Path) -> dict[str, str]:
    """Draw the learning curves of one field's runs, and an episode of the best policy."""
    from mbn_marl.render import figures

    results = list(itertools.chain(*groups.values()))
    field = results[0].field
    curves = f"learning_curves_{field.name}.png"
    figures.save(draw_learning_curves(groups), out / curves)
    best = best_result(results)
    episode = record_episode(load_policy(best.run), field, best.config["environment"])
    title = f"{best.run.path.name}: return {episode.team_return:,.0f}, {episode.steps} steps"
    write_trajectories(episode, out / f"trajectories_{field.name}.png", title)
    write_animation(episode, out / f"episode_{field.name}.gif")
    return {f"Learning curves, {field.name}": curves}


def best_result(results: Sequence[Result]) -> Result:
    """The one with the best return with mean actions; of equal ones with sampled actions."""
    return max(results, key=rank)


def rank(result: Result) -> tuple[float, float]:
    """What results are ordered by: the return with mean actions, then with sampled ones."""
    kinds: tuple[Kind, Kind] = ("deterministic", "stochastic")
    mean, sampled = (result.final(kind, "return_mean") for kind in kinds)
    return mean, sampled


def _curve(result: Result) -> tuple[np.ndarray, np.ndarray]:
    history = result.evaluations
    steps = np.asarray([entry["env_steps"] for entry in history])
    return steps, np.asarray([entry["return_mean"] for entry in history])
