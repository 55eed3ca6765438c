"""A comparison as a Markdown page beside its tables and figures, or as one HTML page."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from baselines.compare.curves import draw_learning_curves, draw_statistics
from baselines.compare.page import (
    episodes_html,
    figures_html,
    folded_html,
    report_page,
    tables_html,
)
from baselines.compare.records import Results, RunRecord, find_records
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, overall_tables
from baselines.evaluation.rollout import record_episode, write_episode
from baselines.policies.load import load_trained
from baselines.runs.files import Place, write_json, write_provenance, write_text
from mbn_marl.files import check_free, claim_file, replacing
from mbn_marl.render.figures import save
from mbn_marl.version import __version__

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

    ``out`` is an ``.html`` file for one self-contained page, otherwise that of :meth:`Place.of`;
    it records the exact command, and ``force`` moves one that is there aside. ``note`` receives
    what is left out, and why. Errors are those of :meth:`Results.of` and :func:`find_records`.
    """
    results = Results.of(find_records(paths, note))
    if is_page(out):
        check_free(out, force=force)  # before the work
        comparison = summarise(results)
        text = comparison_page(results, comparison, command)
        with replacing(claim_file(out, force=force)) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return comparison
    place = Place.of(out, PAGE)
    place.claim(force=force)
    write_provenance(place.folder, command)
    return write_comparison(results, place)


def is_page(out: Path) -> bool:
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
        groups = results.of_field(field)
        name = pictures[f"Learning curves, {field}"] = f"learning_curves_{field}.png"
        save(draw_learning_curves(field, groups, results.looks), out / name)
        best = ranked(itertools.chain(*groups.values()))[0]
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


def ranked(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Sort runs by their return with mean actions, then with sampled ones, the best first."""

    def returns(record: RunRecord) -> list[float]:
        return [record.final(kind, "return_mean") for kind in ("deterministic", "stochastic")]

    return sorted(records, key=returns, reverse=True)


def comparison_page(results: Results, comparison: Comparison, command: str) -> str:
    runs = [record for cell in results.cells.values() for record in cell]
    over_all, drawn = tables_html(overall_tables(comparison)), draw_statistics(comparison)
    sections = {"Over all fields": [*over_all, figures_html(drawn)]}
    sections |= {field: _field_parts(results, comparison, field) for field in results.fields}
    made = "\n".join(record.run.command for record in runs)
    texts = {"This page": command, f"The {len(runs)} runs": made}
    sections["Commands"] = folded_html(texts)
    summary = f"{comparison.verdict} {len(runs)} runs, by mbn_marl {__version__}."
    return report_page(comparison.question, summary, sections)


def _field_parts(results: Results, comparison: Comparison, field: str) -> list[str]:
    """Return the table and the curves of a field, and episodes of the best and median policy."""
    groups, tables = results.of_field(field), field_tables(comparison).items()
    records = ranked(itertools.chain(*groups.values()))
    chosen = {"best": records[0], "median": records[len(records) // 2]}
    episodes = []
    for rank, one in chosen.items():
        if rank == "best" or one is not records[0]:
            policy, settings = load_trained(one.run), one.config["environment"]
            name = f"{rank}: {one.run.path.name}"
            episodes.append(record_episode(policy, one.field, settings, source=name))
    curves = draw_learning_curves(field, groups, results.looks)
    return [
        *tables_html({title: one for title, one in tables if title.startswith(f"{field}:")}),
        figures_html({f"Learning curves on {field}": curves}),
        *episodes_html(field, episodes),
    ]
