"""Finished studies of ``mbn tune``: what a report copies of them, and their best values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Self

import pandas
from pandas import DataFrame

from baselines.compare.text_table import DASH, TextTable
from baselines.paper import published
from baselines.runs import files
from baselines.runs.files import RunError

PICTURES = {"history.png": "history of the trials", "importances.png": "importances"}


@dataclass(frozen=True)
class Study:
    """A study: its configuration, a row a trial, and its files but the trials' own."""

    name: str
    config: dict[str, Any]
    trials: DataFrame
    contents: dict[str, bytes]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a study, or what a report copied of one; a RunError if it has not finished."""
        config = files.read_json(folder / "config.json", dict)
        names = ("config.json", "trials.csv", *PICTURES, f"{config.get('algorithm')}.yaml")
        contents = {p.name: p.read_bytes() for p in map(folder.joinpath, names) if p.is_file()}
        for name in ("trials.csv", "history.png"):
            if name not in contents:
                raise RunError(f"{folder} has no {name}: mbn tune has finished no study there")
        trials = pandas.read_csv(BytesIO(contents["trials.csv"]))
        return cls(folder.resolve().name, config, trials, contents)

    @property
    def subject(self) -> str:
        return f"{published.display_name(self.config['algorithm'])} on {self.config['field']}"

    def save(self, folder: Path) -> None:
        (folder / self.name).mkdir()
        for name, content in self.contents.items():
            (folder / self.name / name).write_bytes(content)


def best_values(studies: Sequence[Study]) -> TextTable:
    """Return the best values of each study below those of the paper."""
    tuned = [published.tuned_values(study.config["algorithm"]) for study in studies]
    names = [name for name in published.RANGES if any(name in values for values in tuned)]

    def line(study: Study, source: str, values: Mapping[str, float], *ends: str) -> list[str]:
        words = (f"{values[name]:.4g}" if name in values else DASH for name in names)
        return [study.subject, source, *words, *ends]

    lines = []
    for study, values in zip(studies, tuned, strict=True):
        states = study.trials.state.value_counts()
        best = study.trials.loc[study.trials.value[study.trials.state == "COMPLETE"].idxmax()]
        ours = {name: best[f"params_{name}"] for name in values if f"params_{name}" in best}
        theirs = {name: values[name] for name in ours}
        ends = [f"{states.get(state, 0)}" for state in ("COMPLETE", "PRUNED")]
        lines.append(line(study, "paper", theirs, DASH, DASH, DASH))
        lines.append(line(study, "here", ours, *ends, f"{best.value:,.0f}"))
    steps = " or ".join(dict.fromkeys(f"{study.config['steps']:,}" for study in studies))
    caption = (
        f"The best values of each study, with {steps} env-steps a trial, below the paper's, with "
        f"{published.TRIAL_STEPS:,}. The mean return is that of the best trial's fresh episodes."
    )
    headings = ("study", "", *names, "trials finished", "pruned", "mean return")
    return TextTable(caption, headings, lines, words=2)
