"""Finished studies of ``mbn tune``: what a report copies of them, and their best values."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Self

import pandas

from baselines.compare.text_table import DASH, TextTable
from baselines.paper import published
from baselines.runs import files
from baselines.runs.files import RunError

PICTURES = {"history.png": "history of the trials", "importances.png": "importances"}
NEEDED = ("config.json", "trials.csv", "history.png")


@dataclass(frozen=True)
class Study:
    """A study: its best trial's values and mean return, and its files but the trials' own."""

    name: str
    algorithm: str
    subject: str
    steps: int
    trials: int
    pruned: int
    values: dict[str, float]
    mean_return: float
    contents: dict[str, bytes]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a study, or what a report copied of one; a RunError names what is wrong."""
        for name in NEEDED:
            if not (folder / name).is_file():
                raise RunError(f"{folder} has no {name}: mbn tune has finished no study there")
        with files.reading(folder):
            config = files.read_json(folder / "config.json", dict)
            algorithm, field = config["algorithm"], Path(config["field"]).stem
            names = {*NEEDED, *PICTURES, f"{algorithm}.yaml"}
            contents = {p.name: p.read_bytes() for p in map(folder.joinpath, names) if p.is_file()}
            rows = pandas.read_csv(BytesIO(contents["trials.csv"]))
            complete, pruned = (rows[rows.state == state] for state in ("COMPLETE", "PRUNED"))
            best = complete.loc[complete.value.astype(float).idxmax()]
            tuned = [name for name in published.tuned_values(algorithm) if f"params_{name}" in best]
            return cls(
                folder.resolve().name,
                algorithm,
                f"{published.display_name(algorithm)} on {field}",
                int(config["steps"]),
                len(complete) + len(pruned),
                len(pruned),
                {name: float(best[f"params_{name}"]) for name in tuned},
                float(best.value),
                contents,
            )

    def save(self, folder: Path) -> None:
        (folder / self.name).mkdir()
        for name, content in self.contents.items():
            (folder / self.name / name).write_bytes(content)


def read_studies(folders: Sequence[Path]) -> list[Study]:
    """Read studies; a RunError names all that cannot be read, or that two have one name."""
    studies: dict[str, Study] = {}
    problems = []
    for folder in folders:
        try:
            study = Study.read(folder)
        except RunError as error:
            problems.append(str(error))
            continue
        if study.name in studies:
            problems.append(f"{folder}: another study has this name, and a report keeps both by it")
        studies[study.name] = study
    if problems:
        raise RunError("\n".join(problems))
    return [*studies.values()]


def best_values(studies: Sequence[Study]) -> TextTable:
    """Return the best values of each study below those of the paper."""
    paper = [published.tuned_values(study.algorithm) for study in studies]
    names = [name for name in published.RANGES if any(name in values for values in paper)]

    def words(values: dict[str, float]) -> list[str]:
        numbers = (values.get(name) for name in names)
        return [DASH if v is None else f"{v:.4g}" if v < 1 else f"{v:,.0f}" for v in numbers]

    lines = []
    for study, theirs in zip(studies, paper, strict=True):
        protocol = [f"{published.TRIALS}", f"{published.TRIAL_STEPS:,}", DASH, DASH]
        lines.append([study.subject, "paper", *words(theirs), *protocol])
        ends = (study.trials, study.steps, study.pruned, round(study.mean_return))
        lines.append(["", "here", *words(study.values), *(f"{end:,}" for end in ends)])
    caption = (
        f"The best values of each study; {DASH}: not tuned, or not in the paper. The mean return "
        "is over the fresh episodes at the end of the best trial."
    )
    headings = ("study", "", *names, "trials", "env-steps each", "pruned", "mean return")
    return TextTable(caption, headings, lines, words=2)
