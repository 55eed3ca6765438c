"""A comparison as a Markdown page beside its tables and figures, or as one HTML page."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from baselines.compare.html import comparison_page
from baselines.compare.pictures import draw_learning_curves, draw_statistics, ranked
from baselines.compare.records import find_records
from baselines.compare.results import Results
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, overall_tables
from baselines.evaluation.rollout import record_episode, write_episode
from baselines.policies.trained import load_trained
from baselines.runs.files import write_json, write_text
from baselines.runs.provenance import write_provenance
from baselines.runs.report_path import Place
from mbn_marl.files import claim_file, replacing
from mbn_marl.render.figures import save

PAGE = "comparison.md"


def report_comparison(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Compare the finished runs at ``paths``: run folders, or folders that hold some.

    ``out`` is an ``.html`` file for one self-contained page, otherwise see :meth:`Place.of`; it
    records the exact command, and ``force`` moves one that is there aside. ``note`` receives what
    is left out, and why.

    Raises:
        RunError: a path holds no run, a run is not finished, or something is at ``out`` already.
        MbnError: there is a page at ``out`` already.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    results = Results.of(find_records(paths, note))
    if is_page(out):
        if not force and out.exists():
            claim_file(out)  # raises before the work
        comparison = summarise(results)
        page = comparison_page(results, comparison, command)
        with replacing(claim_file(out, force=force)) as temporary:
            temporary.write_text(page, encoding="utf-8")
        return comparison
    place = Place.of(out, PAGE)
    place.claim(force=force)
    write_provenance(place.folder, command)
    return write_comparison(results, place)


def is_page(out: Path) -> bool:
    """Return whether a comparison at ``out`` is one self-contained page."""
    return out.suffix.lower() == ".html"


def write_comparison(results: Results, place: Place) -> Comparison:
    """Write the page with the tables, and in its folder every number, the rows, the figures."""
    comparison, out = summarise(results), place.folder
    write_json(out / "comparison.json", comparison.to_json())
    write_text(out / "table.csv", comparison.csv())
    pictures = {}
    for title, figure in draw_statistics(comparison).items():
        name = pictures[title] = f"{title.lower().split()[-1]}.png"
        save(figure, out / name)
    for field in results.fields:
        name = pictures[f"Learning curves, {field}"] = f"learning_curves_{field}.png"
        save(draw_learning_curves(results.of_field(field), results.looks), out / name)
        _draw_best(results, field, out)
    write_text(place.page, _markdown(comparison, pictures, place))
    return comparison


def _markdown(comparison: Comparison, pictures: Mapping[str, str], place: Place) -> str:
    tables = overall_tables(comparison) | field_tables(comparison)
    images = [f"![{title}]({place.link(name)})" for title, name in pictures.items()]
    broken = [f"- {name}: {error}" for name, error in comparison.broken.items()]
    if broken:
        broken = ["## Runs that diverged: their variants are left out", "\n".join(broken)]
    shown = [table.markdown(title) for title, table in tables.items()]
    return (
        "\n\n".join(
            [f"# {comparison.question}", comparison.verdict, *broken, *shown, "## Figures", *images]
        )
        + "\n"
    )


def _draw_best(results: Results, field: str, out: Path) -> None:
    """Draw an episode of the field's best policy, as paths and as an animation."""
    best = ranked(itertools.chain(*results.of_field(field).values()))[0]
    episode = record_episode(load_trained(best.run), best.field, best.config["environment"])
    title = f"{best.run.path.name}: return {episode.team_return:,.0f}, {episode.steps} steps"
    write_episode(episode, out / f"trajectories_{field}.png", title)
    write_episode(episode, out / f"episode_{field}.gif")
