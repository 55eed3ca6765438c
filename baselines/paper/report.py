"""The report on the paper's experiments: a Markdown page, tables and figures."""

from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

import pandas
from matplotlib.figure import Figure

from baselines.algorithms import SETTINGS, Setting
from baselines.compare import curves
from baselines.compare.curves import Pair, Panel
from baselines.compare.records import ordered
from baselines.compare.text_table import DASH, csv_text
from baselines.evaluation.intervals import RETURN_THRESHOLD
from baselines.paper import published, tables
from baselines.paper.studies import PICTURES, Study, best_values, read_studies
from baselines.paper.tables import KINDS, MISSING, PAGE
from baselines.paper.trainings import ROWS_FILE, RUNS_FILE, Trainings, find_trainings
from baselines.runs.files import Place, read_text, write_provenance, write_text
from mbn_marl.field import load_field
from mbn_marl.render import figures

TABLES = ("algorithms.csv", "algorithms.tex", "fields.csv", "fields.tex")
OTHERS = [setting for setting in published.REPORTED if setting != "A"]


def write_report(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    study: Sequence[Path] = (),
    notes: Path | None = None,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Place:
    """Write the report on the runs at ``paths``: run folders, folders that hold some, or reports.

    ``study`` has folders of studies of hyperparameters, ``notes`` is a Markdown file for the top. A
    RunError names what cannot be read, or what is at ``out`` already.
    """
    preface = "" if notes is None else read_text(notes).strip()
    studies = read_studies(study)
    trainings = find_trainings(paths, note)
    reported = published.REPORTED
    drawn = {
        "curves": learning_curves(trainings, mean_panels(trainings)),
        **{f"curves_{one}": learning_curves(trainings, panels(trainings, one)) for one in reported},
        **{f"A_against_{name}": against(trainings, "A", name) for name in OTHERS},
        "fields": figures.fields_figure([load_field(name) for name in published.FIELDS]),
    }
    place = Place.of(out, "paper.md")
    place.claim(force=force)
    trainings.save(place.folder)
    for one in studies:
        one.save(place.folder)
    for name, figure in drawn.items():
        if figure is not None:
            figures.save(figure, place.folder / f"{name}.png")
    for kind in KINDS:
        same = [table for table in tables.paper_tables(trainings) if table.kind == kind]
        lines = pandas.concat([table.lines() for table in same]).drop_duplicates()
        write_text(place.folder / f"{kind}s.csv", csv_text(lines, "%.10g"))
        latex = [table.text().latex(f"tab:{kind}s-{table.sample}") for table in same]
        write_text(place.folder / f"{kind}s.tex", "\n".join(latex))
    write_provenance(place.folder, command)
    write_text(place.page, _page(trainings, studies, drawn, place, command, preface))
    return place


def _page(
    trainings: Trainings,
    studies: Sequence[Study],
    drawn: Mapping[str, object],
    place: Place,
    command: str,
    preface: str,
) -> str:
    def picture(name: str, title: str) -> str:
        if drawn.get(name) is None:
            return f"{title}: missing."
        return f"{title}:\n\n![{title}]({place.link(f'{name}.png')})"

    def links(names: Sequence[str]) -> str:
        return ", ".join(f"[{name}]({place.link(name)})" for name in names)

    def meaning(setting: Setting) -> str:
        summary = SETTINGS[setting].summary
        return summary if setting in published.SETTINGS else f"ours: {summary}"

    paper = {t.kind: t.text() for t in tables.paper_tables(trainings) if t.sample == PAGE}
    reported = {name: meaning(name) for name in published.REPORTED}
    mean = "Mean over the fields that algorithms share, as in the rankings, 95 % band over fields"
    shown = [
        picture("curves", mean),
        *(picture(f"curves_{one}", f"Setting {one}: {text}") for one, text in reported.items()),
    ]
    pairs = [picture(f"A_against_{name}", f"Setting A against {name}") for name in OTHERS]
    tuning = [best_values(studies).markdown()] if studies else []
    for study in studies:
        tuning.append(f"{study.subject}, every trial: {links([f'{study.name}/trials.csv'])}.")
        tuning += [
            f"![{study.subject}: {title}]({place.link(f'{study.name}/{name}')})"
            for name, title in PICTURES.items()
            if name in study.contents
        ]
    page = Template((files(__package__) / "page.md").read_text(encoding="utf-8")).substitute(
        notes=preface,
        source=published.SOURCE,
        command=command,
        settings="\n".join(f"- **{name}**: {text}." for name, text in reported.items()),
        missing=MISSING,
        dash=DASH,
        tables=links(TABLES),
        runs=links([RUNS_FILE, ROWS_FILE]),
        coverage=tables.coverage(trainings).markdown(),
        algorithms=paper["algorithm"].markdown(),
        fields=paper["field"].markdown(),
        ranking=tables.ranking(trainings).markdown(),
        reached=tables.reached(trainings).markdown(),
        success=tables.success(trainings).markdown(),
        curves="\n\n".join(shown),
        against="\n\n".join(pairs),
        studies="\n\n".join(tuning) if studies else f"Studies: {MISSING}.",
        overview=picture("fields", "The ten fields, each to its scale"),
    )
    return page if preface else page.replace("\n\n\n\n", "\n\n", 1)


def panels(trainings: Trainings, setting: str) -> dict[str, Panel]:
    """Return the moving means of a setting, a panel a field and a curve a seed."""
    rows = trainings.rows[trainings.rows.setting == setting]
    groups, found = rows.groupby(["field", "algorithm"]), {}
    for field in trainings.field_names:
        runs = {
            published.display_name(name): [
                (run.env_steps.to_numpy(), run.moving_mean.to_numpy())
                for _, run in groups.get_group((field, name)).groupby("seed")
            ]
            for name in trainings.algorithms
            if (field, name) in groups.groups
        }
        if runs:
            found[field] = Panel(runs, trainings.optimum(field))
    return found


def mean_panels(trainings: Trainings) -> dict[str, Panel]:
    """Return a panel a setting, on the fields that all its algorithms have, and a curve a field."""
    found, alike = {}, trainings.alike()
    for setting in published.REPORTED:
        fields = panels(alike, setting)
        if not fields:
            continue
        means = {
            name: [curves.mean_and_band(panel.curves[name])[:2] for panel in fields.values()]
            for name in next(iter(fields.values())).curves
        }
        optima = [panel.optimum for panel in fields.values() if panel.optimum is not None]
        best = sum(optima) / len(fields) if len(optima) == len(fields) else None
        counted = f"{len(fields)} field{'s' if len(fields) > 1 else ''}"
        found[f"setting {setting}, {counted}"] = Panel(means, best)
    return found


def learning_curves(trainings: Trainings, drawn: Mapping[str, Panel]) -> Figure | None:
    if not drawn:
        return None
    looks = ordered({name: name for name in trainings.algorithms})
    shown = {published.display_name(name): look for name, look in looks.items()}
    subject = "return of training episodes, moving mean"
    return curves.learning_curves(drawn, shown, subject, RETURN_THRESHOLD)


def against(trainings: Trainings, first: str, second: str) -> Figure | None:
    """Draw one setting against another, a panel an algorithm; ``None`` without a common cell."""
    rows = trainings.rows[trainings.rows.setting.isin([first, second])]
    means = rows.pivot_table("moving_mean", ["algorithm", "field"], "setting")
    means = means.reindex(columns=[first, second]).dropna()
    fields = [name for name in trainings.field_names if name in means.index.unique("field")]
    paper = published.by_algorithm()
    compared = {}
    for algorithm in trainings.algorithms:
        both = [field for field in fields if (algorithm, field) in means.index]
        if not both:
            continue
        lines: dict[str, Pair] = {
            field: (means[first].get((algorithm, field)), means[second].get((algorithm, field)))
            for field in fields
        }
        own = rows[(rows.algorithm == algorithm) & rows.field.isin(both)]
        together = own.groupby("setting").moving_mean.mean()
        lines["these together"] = together[first], together[second]
        if {first, second} <= set(published.SETTINGS):
            ours, theirs = (paper.get((algorithm, name), {}) for name in (first, second))
            lines["paper, all ten"] = ours.get("mean"), theirs.get("mean")
        compared[published.display_name(algorithm)] = lines
    if not compared:
        return None
    return curves.pairs(compared, (f"setting {first}", f"setting {second}"))
