"""The report on the paper's experiments: a Markdown page, tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from baselines.algorithms import SETTINGS, Setting
from baselines.compare.text_table import MISSING, NOT_IN_PAPER
from baselines.paper import figures, glance, published
from baselines.paper.tables import ALGORITHMS, Table, paper_tables, write_csv
from baselines.paper.trainings import Training, find_trainings
from baselines.runs.files import RunError, write_text
from baselines.runs.provenance import write_provenance
from baselines.runs.report_path import Place
from baselines.tuning.study import draw_study
from mbn_marl.render.figures import save

OVERVIEW = "fields"
STUDY = "optuna"


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
    """Write the report on the runs at ``paths``.

    Args:
        paths: run folders, or folders that hold some.
        out: see :meth:`Place.of`.
        command: the exact command, recorded in the folder and on the page.
        study: the folder of a study of hyperparameters, to draw.
        notes: a Markdown file to put at the top of the page.
        force: move a report that is already there aside.
        note: is told which folders at ``paths`` are left out, and why.

    Raises:
        RunError: a run, the study or the notes cannot be read, or something is at ``out`` already.
    """
    preface = "" if notes is None else _read_notes(notes)
    trainings = find_trainings(paths, note)
    tables = paper_tables(trainings)
    drawn = _draw(trainings, study)
    place = Place.of(out, "paper.md")
    place.claim(force=force)
    for name, figure in drawn.items():
        if figure is not None:
            save(figure, place.folder / f"{name}.png")
    for kind, group in itertools.groupby(tables, key=lambda table: table.kind):
        same = list(group)
        write_text(place.folder / f"{kind.row}s.csv", write_csv(same))
        latex = [table.grid().latex(f"tab:{kind.row}s-{table.sample.label}") for table in same]
        write_text(place.folder / f"{kind.row}s.tex", "\n".join(latex))
    write_provenance(place.folder, command)
    write_text(place.page, _page(trainings, tables, drawn, place, command, preface))
    return place


def _read_notes(path: Path) -> str:
    """The text of a Markdown file."""
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise RunError(f"{path} is not a text file in UTF-8: {error}") from None


def _draw(trainings: Sequence[Training], study: Path | None) -> dict[str, Figure | None]:
    """Every figure by its file's name; ``None`` for one that no run has anything for."""
    others = [setting for setting in SETTINGS if setting != "A"]
    return {
        **{f"curves_{name}": figures.learning_curves(trainings, name) for name in SETTINGS},
        **{f"A_against_{name}": figures.against(trainings, "A", name) for name in others},
        STUDY: None if study is None else draw_study(study),
        OVERVIEW: figures.overview(),
    }


def _page(
    trainings: Sequence[Training],
    tables: Sequence[Table],
    drawn: Mapping[str, Figure | None],
    place: Place,
    command: str,
    preface: str,
) -> str:
    """The Markdown page."""

    def picture(name: str, what: str) -> str:
        if drawn[name] is None:
            return f"{what}: missing."
        return f"{what}:\n\n![{what}]({place.link(f'{name}.png')})"

    of_algorithms = [table for table in tables if table.kind is ALGORITHMS]
    of_fields = [table for table in tables if table.kind is not ALGORITHMS]
    files = ", ".join(
        f"[{name}]({place.link(name)})"
        for name in ("algorithms.csv", "algorithms.tex", "fields.csv", "fields.tex")
    )
    curves = [picture(f"curves_{name}", f"Setting {name}: {_meaning(name)}") for name in SETTINGS]
    against = [
        picture(f"A_against_{name}", f"Setting A against {name}")
        for name in SETTINGS
        if name != "A"
    ]
    parts = [
        "# The paper's experiments, and ours beside them",
        preface.strip(),
        _introduction(command, files),
        "## What was run",
        glance.coverage(trainings).markdown(),
        "## Table 1",
        *(table.grid().markdown() for table in of_algorithms),
        "## Rankings",
        glance.ranking(of_algorithms).markdown(),
        "## Who got there",
        glance.reached(trainings).markdown(),
        glance.success(trainings).markdown(),
        "## Learning curves",
        *curves,
        "## Settings against each other",
        *against,
        "## Hyperparameters",
        picture(STUDY, "History of the study and importance of each hyperparameter"),
        "## Per field",
        *(table.grid().markdown() for table in of_fields),
        "## The fields",
        picture(OVERVIEW, "The ten fields, each to a scale of its own"),
        "## The runs",
        _commands(trainings),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _meaning(setting: Setting) -> str:
    summary = SETTINGS[setting].summary
    return summary if setting in published.settings() else f"ours: {summary}"


def _introduction(command: str, files: str) -> str:
    """Where the numbers come from and how to read them."""
    settings = "\n".join(f"- **{name}**: {_meaning(name)}." for name in SETTINGS)
    return f"""\
The paper's numbers are those of {published.source()}. Ours come from the `progress.csv` of the
runs listed at the end. This page was written by

```sh
{command}
```

The settings:

{settings}

How to read the tables:

- Units: the paper gives its numbers per algorithm in **1e6 reward** and those per field in
  **reward**. Ours are shown in the unit of the table they stand in.
- Each number is of the true, unscaled reward of an episode during training: mean, standard
  deviation (SD), largest (max) and largest minus smallest (range).
- Each table comes twice. Over *single episodes* every training episode counts once. Over *moving
  means of 100 episodes* every row of `progress.csv` counts once, with the mean of the latest 100
  episodes (of all so far while there are fewer), as Stable-Baselines3 logs it. The paper does not
  say which it took, but its largest values are multiples of 0.1 where the reward of an episode is a
  multiple of 10: they are means of episodes, and the second kind is the one to compare with.
- A cell pools all runs of its setting, over the fields and seeds of "What was run" only; the
  paper's pools 5M env-steps on each of ten fields. *{MISSING}*: no run here. {NOT_IN_PAPER}: not in
  the paper.
- The same numbers as files: {files}."""


def _commands(trainings: Sequence[Training]) -> str:
    """The exact command of every run."""
    commands = "\n".join(training.command for training in trainings)
    return f"The exact commands:\n\n```sh\n{commands}\n```"
