"""A comparison as a Markdown page beside its tables and figures, or as one HTML page."""

import itertools
import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pandas import DataFrame

from baselines.compare import page
from baselines.compare.curves import draw_gaps, draw_learning_curves
from baselines.compare.records import Results, RunRecord, find_records
from baselines.compare.summary import Comparison, summarise
from baselines.compare.tables import field_tables, overall_tables
from baselines.compare.text_table import csv_text
from baselines.evaluation.rollout import record_episode, write_episode
from baselines.policies.load import load_trained
from baselines.runs.files import Place, write_json, write_provenance, write_text
from mbn_marl.config import make_config
from mbn_marl.episode import Episode
from mbn_marl.files import check_free, claim_file
from mbn_marl.render.figures import save
from mbn_marl.version import __version__

PAGE = "comparison.md"


def report_comparison(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    marl_eval: Path | None = None,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Compare the finished runs at ``paths``: run folders, or folders that hold some.

    ``out`` is an ``.html`` file for one self-contained page, otherwise that of :meth:`Place.of`;
    it records the exact command, and ``force`` moves one that is there aside. ``marl_eval`` is a
    file for :func:`marl_eval_data`. ``note`` receives what is left out, and why. Errors are those
    of :meth:`Results.of` and :func:`find_records`.
    """
    results = Results.of(find_records(paths, note))
    if marl_eval is not None:
        check_free(marl_eval, force=force)  # before the work
    if is_page(out):
        check_free(out, force=force)
        comparison = summarise(results)
        text = comparison_page(results, comparison, command)
        write_text(claim_file(out, force=force), text)
    else:
        place = Place.of(out, PAGE)
        ours = force or not place.folder.exists()
        place.claim(force=force)
        try:
            write_provenance(place.folder, command)
            comparison = write_comparison(results, place)
        except BaseException:
            if ours:  # half a report would be in the way of the next
                shutil.rmtree(place.folder, ignore_errors=True)
            raise
    if marl_eval is not None:
        write_json(claim_file(marl_eval, force=force), marl_eval_data(results))
    return comparison


def is_page(out: Path) -> bool:
    return out.suffix.lower() == ".html"


def write_comparison(results: Results, place: Place) -> Comparison:
    """Write the page with the tables, and in its folder every number, the rows, the figures."""
    comparison, out = summarise(results), place.folder
    write_json(out / "comparison.json", vars(comparison))
    curves = [point for one in results.records for point in one.curve]
    tables = {"table": comparison.rows, "runs": comparison.runs, "curves": curves}
    if of_tier := [one for one in results.records if one.config.get("tier") is not None]:
        tables["instances"] = [row for one in of_tier for row in one.instances]
    for name, rows in tables.items():  # of objects: a whole number stays one beside an unknown one
        write_text(out / f"{name}.csv", csv_text(DataFrame(rows, dtype=object)))
    pictures = {}
    if comparison.aggregates:
        pictures["Makespan gaps"] = "gaps.png"
        save(draw_gaps(comparison), out / "gaps.png")
    for field in results.fields:
        groups = results.of_field(field)
        name = pictures[f"Learning curves, {field}"] = f"learning_curves_{field}.png"
        save(draw_learning_curves(field, groups, results.looks), out / name)
        best = ranked(itertools.chain(*groups.values()))[0]
        episode = _episode(best)
        title = f"{best.run.path.name}: {episode.steps} steps"
        write_episode(episode, out / f"trajectories_{field}.png", title)
        write_episode(episode, out / f"episode_{field}.gif")
    shown = overall_tables(comparison) | field_tables(comparison)
    broken = [f"- {name}: {error}" for name, error in comparison.broken_runs.items()]
    parts = [f"# {comparison.question}", comparison.verdict]
    if broken:
        parts += ["## Runs that diverged: their variants are left out", "\n".join(broken)]
    parts += [table.markdown(title) for title, table in shown.items()]
    parts += ["## Figures", *(f"![{one}]({place.link(name)})" for one, name in pictures.items())]
    write_text(place.page, "\n\n".join(parts) + "\n")
    return comparison


def ranked(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Sort runs, those that pass first, then the fast ones with mean actions."""

    def rank(one: RunRecord) -> tuple[Any, ...]:
        makespan = one.row["deterministic_makespan"] or math.inf
        return not one.row["passed"], makespan, -one.row["return_mean"]

    return sorted(records, key=rank)


def marl_eval_data(results: Results) -> dict[str, Any]:
    """Return the runs as marl-eval reads them, all evaluations with sampled actions.

    In ``makespan`` a failure counts as the longest episode; ``spl`` needs a bound on all fields.
    """

    def metrics(entry: Mapping[str, Any], longest: int) -> dict[str, list[float]]:
        rate, makespan = entry["success_rate"], entry["makespan"] or 0.0
        values = {"return": entry["return_mean"], "success_rate": rate}
        values["makespan"] = rate * makespan + (1.0 - rate) * longest
        values |= {} if len(results.bounded) < len(results.fields) else {"spl": entry["spl"]}
        return {name: [value] for name, value in values.items()}

    tasks: dict[str, Any] = {}
    for one in results.records:
        longest = make_config(one.config["environment"]).max_steps
        steps: dict[str, Any] = {
            f"step_{k}": {"step_count": entry["env_steps"], **metrics(entry, longest)}
            for k, entry in enumerate(one.run.evaluations)
        }
        steps["absolute_metrics"] = metrics(one.run.evaluation["stochastic"], longest)
        seeds = tasks.setdefault(one.place, {}).setdefault(one.label, {})
        seeds[f"seed_{one.config['seed']}"] = steps
    return {"mbn_marl": tasks}


def comparison_page(results: Results, comparison: Comparison, command: str) -> str:
    drawn = {"Makespan gaps": draw_gaps(comparison)} if comparison.aggregates else {}
    sections = {
        "Over all fields": [page.figures_html(drawn), *page.tables_html(overall_tables(comparison))]
    }
    sections |= {field: _field_parts(results, comparison, field) for field in results.fields}
    made = "\n".join(record.run.command for record in results.records)
    texts = {"This page": command, f"The {len(results.records)} runs": made}
    sections["Commands"] = page.folded_html(texts)
    summary = f"{comparison.verdict} {len(results.records)} runs, by mbn_marl {__version__}."
    return page.report_page(comparison.question, summary, sections)


def _field_parts(results: Results, comparison: Comparison, field: str) -> list[str]:
    """Return the table and the curves of a field, and episodes of the best and median policy."""
    groups, tables = results.of_field(field), field_tables(comparison).items()
    records = ranked(itertools.chain(*groups.values()))
    chosen = {"best": records[0], "median": records[len(records) // 2]}
    if chosen["median"] is records[0]:
        del chosen["median"]
    episodes = [_episode(one, f"{rank}: {one.run.path.name}") for rank, one in chosen.items()]
    curves = draw_learning_curves(field, groups, results.looks)
    return [
        *page.tables_html({title: one for title, one in tables if title.startswith(f"{field}:")}),
        page.figures_html({f"Learning curves on {field}": curves}),
        *page.episodes_html(field, episodes),
    ]


def _episode(one: RunRecord, source: str = "") -> Episode:
    policy, field = load_trained(one.run), one.field_to_show()
    return record_episode(policy, field, one.config["environment"], source=source)
