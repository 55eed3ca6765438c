"""The page of a comparison, with its tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from baselines.episode import record_episode, write_animation, write_trajectories
from baselines.place import Place
from baselines.policies import load_policy
from baselines.results import Result, Results, find_results
from baselines.runs import write_provenance
from baselines.statistics import RETURN_THRESHOLD
from baselines.storage import write_json, write_text
from baselines.summary import THRESHOLDS, Comparison, summarise
from baselines.table import field_grids, markdown, overall_grids

PAGE = "comparison.md"


def report_comparison(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[Place, Comparison]:
    """Compare the finished runs at ``paths``, wherever they were trained.

    Args:
        paths: run folders, or folders that hold some.
        out: see :meth:`Place.of`.
        command: the exact command, recorded in the folder.
        force: move a report that is already there aside.
        note: is told which folders at ``paths`` are left out, and why.

    Raises:
        RunError: a path holds no run, a run is not finished, or something is at ``out`` already.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    results = find_results(paths, note)
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
    pictures = _draw_statistics(comparison, out)
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
    return "\n\n".join(["# Comparison", *overall, *fields, "## Figures", *images]) + "\n"


def _draw_statistics(comparison: Comparison, out: Path) -> dict[str, str]:
    """Draw what is over all fields; the files' names by what they show."""
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
        drawn["Aggregates"] = ("aggregates.png", figures.intervals_figure(panels))
        drawn["Performance profiles"] = (
            "profiles.png",
            figures.profiles_figure(profiles, THRESHOLDS, score),
        )
    pairs = list(itertools.combinations(comparison.improvement, 2))
    if pairs:
        chances = {f"{x} > {y}": comparison.improvement[x][y] for x, y in pairs}
        drawn["Probability of improvement"] = (
            "improvement.png",
            figures.intervals_figure({"probability of improvement": chances}, rule=0.5),
        )
    for name, figure in drawn.values():
        figures.save(figure, out / name)
    return {title: name for title, (name, _) in drawn.items()}


def _draw_field(groups: Mapping[str, Sequence[Result]], out: Path) -> dict[str, str]:
    """Draw the learning curves of one field's runs, and an episode of the best policy."""
    from mbn_marl.render import figures

    results = list(itertools.chain(*groups.values()))
    field = results[0].field
    figures.learning_curves(
        {label: [_curve(result) for result in group] for label, group in groups.items()},
        threshold=RETURN_THRESHOLD,
        optimum=results[0].optimum,
        path=out / (curves := f"learning_curves_{field.name}.png"),
    )
    best = best_result(results)
    episode = record_episode(load_policy(best.run), field, best.config["environment"])
    title = f"{best.run.path.name}: return {episode.team_return:,.0f}, {episode.steps} steps"
    write_trajectories(episode, out / f"trajectories_{field.name}.png", title)
    write_animation(episode, out / f"episode_{field.name}.gif")
    return {f"Learning curves, {field.name}": curves}


def best_result(results: Sequence[Result]) -> Result:
    """The one with the best return with mean actions; of equal ones with sampled actions."""

    def rank(result: Result) -> tuple[float, float]:
        kinds = ("deterministic", "stochastic")
        mean, sampled = (result.final(kind, "return_mean") for kind in kinds)
        return mean, sampled

    return max(results, key=rank)


def _curve(result: Result) -> tuple[np.ndarray, np.ndarray]:
    history = result.evaluations
    steps = np.asarray([entry["env_steps"] for entry in history])
    return steps, np.asarray([entry["return_mean"] for entry in history])
