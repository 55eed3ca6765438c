"""A comparison as a Markdown page beside its tables and figures, or as one HTML page."""

from __future__ import annotations

import base64
import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from baselines.compare.curves import draw_learning_curves, draw_statistics
from baselines.compare.records import Results, RunRecord, find_records
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, gaps, overall_tables
from baselines.compare.text_table import TextTable
from baselines.evaluation.rollout import record_episode, write_episode
from baselines.policies.load import load_trained
from baselines.runs.files import Place, write_json, write_provenance, write_text
from mbn_marl.episode import Episode
from mbn_marl.files import claim_file, replacing
from mbn_marl.render import web
from mbn_marl.render.figures import save, svg, trajectory_panels
from mbn_marl.version import __version__

PAGE = "comparison.md"


@dataclass(frozen=True)
class Section:
    """A part of a HTML page; tables, figures and texts are by title."""

    title: str
    tables: Mapping[str, TextTable] = dataclasses.field(default_factory=dict)
    figures: Mapping[str, Figure] = dataclasses.field(default_factory=dict)
    episodes: Sequence[Episode] = ()  # to play side by side
    texts: Mapping[str, str] = dataclasses.field(default_factory=dict)  # folded away


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
    is left out, and why. Errors are those of :meth:`Results.of` and :func:`find_records`.
    """
    results = Results.of(find_records(paths, note))
    if is_page(out):
        if not force and out.exists():
            claim_file(out)  # raises before the work
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
    made = "\n".join(record.run.command for record in runs)
    tables = overall_tables(comparison) | {"Optimality gap per field": gaps(comparison)}
    sections = [
        Section("Over all fields", tables, draw_statistics(comparison)),
        *(_field_section(results, comparison, field) for field in results.fields),
        Section("Commands", texts={"This page": command, f"The {len(runs)} runs": made}),
    ]
    summary = f"{comparison.verdict} {len(runs)} runs, by mbn_marl {__version__}."
    return report_page(comparison.question, summary, sections)


def _field_section(results: Results, comparison: Comparison, field: str) -> Section:
    """Show the table and the curves of a field, and episodes of the best and the median policy."""
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
        f"Learning curves on {field}": draw_learning_curves(field, groups, results.looks),
        f"Paths of the best and the median policy on {field}": trajectory_panels(lasts, columns=1),
    }
    own = {title: table for title, table in tables if title.startswith(f"{field}:")}
    return Section(field, own, figures, list(episodes.values()))


def report_page(title: str, summary: str, sections: Sequence[Section]) -> str:
    """Return a self-contained HTML page, with links to each section and to its player."""
    links = []
    for number, section in enumerate(sections):
        replay = f' (<a href="#replay-{number}">replay</a>)' if section.episodes else ""
        link = f'<a href="#section-{number}">{escape(section.title)}</a>'
        links.append(f"<span>{link}{replay}</span>")
    values = {
        "summary": escape(summary),
        "contents": "\n".join(links),
        "sections": "\n".join(_section(*numbered) for numbered in enumerate(sections)),
    }
    return web.whole("report.html", title, values, extra_styles=("report.css",))


def _section(number: int, section: Section) -> str:
    parts = [f"<h2>{escape(section.title)}</h2>"]
    parts += [table.html(title) for title, table in section.tables.items() if table.lines]
    if section.figures:
        pictures = "".join(_figure(*named) for named in section.figures.items())
        parts.append(f'<div class="figures">{pictures}</div>')
    if section.episodes:
        data = web.episodes_data(section.episodes)
        parts += [
            f'<div id="replay-{number}" data-replay="episodes-{number}"></div>',
            f'<script type="application/json" id="episodes-{number}">{data}</script>',
        ]
    parts += [
        f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>"
        for name, text in section.texts.items()
    ]
    body = "\n".join(parts)
    return f'<section id="section-{number}">\n{body}\n</section>'


def _figure(title: str, figure: Figure) -> str:
    # An image, not parts of the page: names inside two pictures may be the same.
    data = base64.b64encode(svg(figure)).decode("ascii")
    name = escape(title)
    picture = f'<div><img alt="{name}" src="data:image/svg+xml;base64,{data}"></div>'
    return f"<figure>{picture}<figcaption>{name}</figcaption></figure>"
