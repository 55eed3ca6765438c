"""The report on the paper's experiments: a Markdown page, tables and figures."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from baselines.algorithms import SETTINGS, Setting
from baselines.compare.text_table import DASH
from baselines.paper import figures, glance, published
from baselines.paper.tables import ALGORITHMS, FIELDS, MISSING, PaperTable, paper_tables, write_csv
from baselines.paper.trainings import ROWS_FILE, RUNS_FILE, Trainings, find_trainings
from baselines.runs.files import Place, RunError, read_text, write_text
from baselines.runs.provenance import write_provenance
from mbn_marl.render.figures import save

TABLES = ("algorithms.csv", "algorithms.tex", "fields.csv", "fields.tex")
OTHERS = [setting for setting in published.REPORTED if setting != "A"]
"""Settings that are compared with A."""


def write_report(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    study: Path | None = None,
    notes: Path | None = None,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Place:
    """Write the report on the runs at ``paths``: run folders, folders that hold some, or reports.

    Args as for :func:`baselines.compare.report.report_comparison`; besides, ``study`` is the folder
    of a study of hyperparameters to draw, ``notes`` a Markdown file for the top of the page.

    Raises:
        RunError: a run, the study or the notes cannot be read, or something is at ``out`` already.
    """
    preface = "" if notes is None else read_text(notes).strip()
    trainings = find_trainings(paths, note)
    tables = paper_tables(trainings)
    drawn = {
        **{
            f"curves_{name}": figures.learning_curves(trainings, name)
            for name in published.REPORTED
        },
        **{f"A_against_{name}": figures.against(trainings, "A", name) for name in OTHERS},
        "fields": figures.overview(),
    }
    copied = {} if study is None else _study_pictures(study)
    place = Place.of(out, "paper.md")
    place.claim(force=force)
    trainings.save(place.folder)
    for name, path in copied.items():
        shutil.copy(path, place.folder / f"{name}.png")
    for name, figure in drawn.items():
        if figure is not None:
            save(figure, place.folder / f"{name}.png")
    for kind, group in itertools.groupby(tables, key=lambda table: table.kind):
        same = list(group)
        write_text(place.folder / f"{kind.row}s.csv", write_csv(same))
        latex = [table.text().latex(f"tab:{kind.row}s-{table.sample.label}") for table in same]
        write_text(place.folder / f"{kind.row}s.tex", "\n".join(latex))
    write_provenance(place.folder, command)
    write_text(place.page, _page(trainings, tables, {**drawn, **copied}, place, command, preface))
    return place


def _page(
    trainings: Trainings,
    tables: Sequence[PaperTable],
    drawn: Mapping[str, object],
    place: Place,
    command: str,
    preface: str,
) -> str:
    """Fill in the Markdown page."""

    def picture(name: str, title: str) -> str:
        if drawn.get(name) is None:
            return f"{title}: missing."
        return f"{title}:\n\n![{title}]({place.link(f'{name}.png')})"

    def links(names: Sequence[str]) -> str:
        return ", ".join(f"[{name}]({place.link(name)})" for name in names)

    join = "\n\n".join
    shown = [(table.kind, table.text().markdown()) for table in tables]
    page = Template((files(__package__) / "page.md").read_text(encoding="utf-8")).substitute(
        notes=preface,
        source=published.SOURCE,
        command=command,
        settings="\n".join(f"- **{name}**: {_meaning(name)}." for name in published.REPORTED),
        missing=MISSING,
        dash=DASH,
        tables=links(TABLES),
        runs=links([RUNS_FILE, ROWS_FILE]),
        coverage=glance.coverage(trainings).markdown(),
        algorithms=join(text for kind, text in shown if kind is ALGORITHMS),
        ranking=glance.ranking(trainings).markdown(),
        reached=glance.reached(trainings).markdown(),
        success=glance.success(trainings).markdown(),
        curves=join(
            picture(f"curves_{name}", f"Setting {name}: {_meaning(name)}")
            for name in published.REPORTED
        ),
        against=join(picture(f"A_against_{name}", f"Setting A against {name}") for name in OTHERS),
        study=join(
            picture(f"study_{name}", title)
            for name, title in (
                ("history", "History of the study"),
                ("importances", "Importance of each hyperparameter in the study"),
            )
        ),
        fields=join(text for kind, text in shown if kind is FIELDS),
        overview=picture("fields", "The ten fields, each to a scale of its own"),
        commands="\n".join(trainings.runs.command),
    )
    return page if preface else page.replace("\n\n\n\n", "\n\n", 1)


def _study_pictures(study: Path) -> dict[str, Path]:
    """Return the pictures that ``mbn tune`` made at the end of a study; a RunError without one."""
    pictures = {path.stem: path for path in study.glob("*.png")}
    if "history" not in pictures:
        raise RunError(f"{study} has no history.png: mbn tune has finished no study there")
    return {f"study_{name}": path for name, path in pictures.items()}


def _meaning(setting: Setting) -> str:
    summary = SETTINGS[setting].summary
    return summary if setting in published.SETTINGS else f"ours: {summary}"
