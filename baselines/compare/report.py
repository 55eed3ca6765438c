"""A comparison as a Markdown page beside its tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

from baselines.compare.curves import draw_learning_curves, draw_statistics
from baselines.compare.records import Results, RunRecord, find_records
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, overall_tables
from baselines.evaluation.rollout import record_episode, write_episode
from baselines.policies.load import load_trained
from baselines.runs.files import Place, write_json, write_provenance, write_text
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

    ``out`` is that of :meth:`Place.of`; it records the exact command, and ``force`` moves one that
    is there aside. ``note`` receives what is left out, and why. Errors are those of
    :meth:`Results.of` and :func:`find_records`.
    """
    results = Results.of(find_records(paths, note))
    place = Place.of(out, PAGE)
    place.claim(force=force)
    write_provenance(place.folder, command)
    return write_comparison(results, place)


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
        groups = results.of_field(field)
        name = pictures[f"Learning curves, {field}"] = f"learning_curves_{field}.png"
        save(draw_learning_curves(field, groups, results.looks), out / name)
        best = max(itertools.chain(*groups.values()), key=_returns)
        episode = record_episode(load_trained(best.run), best.field, best.config["environment"])
        title = f"{best.run.path.name}: return {episode.team_return:,.0f}, {episode.steps} steps"
        write_episode(episode, out / f"trajectories_{field}.png", title)
        write_episode(episode, out / f"episode_{field}.gif")
    tables = overall_tables(comparison) | field_tables(comparison)
    broken = [f"- {name}: {error}" for name, error in comparison.broken_runs.items()]
    parts = [f"# {comparison.question}", comparison.verdict]
    if broken:
        parts += ["## Runs that diverged: their variants are left out", "\n".join(broken)]
    parts += [table.markdown(title) for title, table in tables.items()]
    parts += ["## Figures", *(f"![{one}]({place.link(name)})" for one, name in pictures.items())]
    write_text(place.page, "\n\n".join(parts) + "\n")
    return comparison


def _returns(record: RunRecord) -> list[float]:
    return [record.final(kind, "return_mean") for kind in ("deterministic", "stochastic")]
