"""A comparison as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from baselines.compare.markdown import draw_learning_curves, draw_statistics, rank
from baselines.compare.results import Result, Results, find_results
from baselines.compare.summary import Comparison, Row, summarise
from baselines.compare.tables import UNKNOWN, field_grids, overall_grids
from baselines.compare.text_table import Grid
from baselines.evaluation.policy import load_policy
from baselines.evaluation.rollout import record_episode
from mbn_marl.episode import Episode
from mbn_marl.files import claim_file, replacing
from mbn_marl.version import __version__
from mbn_marl.web.report import Section, Table, report_page

SUFFIX = ".html"


def write_html_report(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    force: bool = False,
    trust: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Compare the finished runs at ``paths``, wherever they were trained, on one page.

    Args:
        paths: run folders, or folders that hold some.
        out: the page, an ``.html`` file.
        command: the exact command, recorded on the page.
        force: move a page that is already there aside.
        trust: load pickled files of the runs whoever made them.
        note: is told which folders at ``paths`` are left out, and why.

    Raises:
        RunError: a path holds no run, or a run is not finished.
        MbnError: there is a file at ``out``, and ``force`` is not set.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    results = find_results(paths, note, trust=trust)
    comparison = summarise(results)
    if not force and out.exists():
        claim_file(out)  # says what to do, before the work
    runs = [result for cell in results.cells.values() for result in cell]
    sections = [
        _overall(comparison),
        *(_field_section(results, comparison, field) for field in results.fields),
        Section("Commands", texts=_commands(runs, command)),
    ]
    summary = (
        f"{len(runs)} runs: {', '.join(results.labels)} on {', '.join(results.fields)}, "
        f"{results.seeds} each. Made by mbn_marl {__version__}."
    )
    page = report_page("Comparison", summary, sections)
    with replacing(claim_file(out, force=force)) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return comparison


def _overall(comparison: Comparison) -> Section:
    """What is over all fields."""
    grids = {**overall_grids(comparison), "Optimality gap per field": _gaps(comparison)}
    return Section(
        "Over all fields",
        tables=[_table(title, grid) for title, grid in grids.items() if grid.lines],
        figures={title: _svg(figure) for title, figure in draw_statistics(comparison).items()},
    )


def _gaps(comparison: Comparison) -> Grid:
    """How far each label falls short of the proved optimum on each field."""
    labels = tuple(dict.fromkeys(row.label for row in comparison.rows))
    rows: dict[str, dict[str, Row]] = {}
    for row in comparison.rows:
        if row.optimum is not None:
            rows.setdefault(row.field, {})[row.label] = row
    caption = (
        "How far the mean return with sampled actions falls short of the proved optimum, with its "
        "95 % bootstrap interval over seeds."
    )
    lines = tuple((field, *(_gap(row) for row in cells.values())) for field, cells in rows.items())
    return Grid(caption, ("field", *labels), lines)


def _gap(row: Row) -> str:
    if row.optimum is None:
        return UNKNOWN
    gap = f"{1.0 - row.return_mean / row.optimum:.2%}"
    if row.return_low is None or row.return_high is None:
        return gap
    low, high = (1.0 - end / row.optimum for end in (row.return_high, row.return_low))
    return f"{gap} ({100.0 * low:.2f}..{100.0 * high:.2f})"


def _field_section(results: Results, comparison: Comparison, field: str) -> Section:
    """One field: its table, its learning curves, and what the best and the median policy do."""
    groups = {label: results.cells[label, field] for label in results.labels}
    tables = [
        _table(title, grid)
        for title, grid in field_grids(comparison).items()
        if title.partition(":")[0] == field
    ]
    ranked = sorted((one for group in groups.values() for one in group), key=rank, reverse=True)
    chosen = {"best": ranked[0], "median": ranked[len(ranked) // 2]}
    episodes = {
        f"{name}: {result.run.path.name}": _episode(result, f"{name}: {result.run.path.name}")
        for name, result in chosen.items()
        if name == "best" or result is not ranked[0]
    }
    return Section(
        field,
        tables=tables,
        figures={
            f"Learning curves on {field}": _svg(draw_learning_curves(groups)),
            f"Paths of the best and the median policy on {field}": _svg(_paths(episodes)),
        },
        episodes=list(episodes.values()),
    )


def _episode(result: Result, source: str) -> Episode:
    """An episode of a run's policy with mean actions."""
    policy = load_policy(result.run)
    return record_episode(policy, result.field, result.config["environment"], source=source)


def _paths(episodes: dict[str, Episode]) -> Any:
    from mbn_marl.render import figures

    return figures.trajectory_panels(
        {name: episode.snapshot(episode.steps) for name, episode in episodes.items()}
    )


def _commands(runs: Sequence[Result], command: str) -> dict[str, str]:
    """What made the page, and what made every run."""
    made = "\n".join(one.run.command for one in runs)
    return {"This page": command, f"The {len(runs)} runs": made}


def _table(title: str, grid: Grid) -> Table:
    return Table(title, grid.caption, grid.headings, grid.lines, grid.words)


def _svg(figure: Any) -> bytes:
    from mbn_marl.render import figures

    return figures.svg(figure)
