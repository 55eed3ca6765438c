"""The figure of a study of hyperparameters, from the files of its folder."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from matplotlib.figure import Figure

from baselines.runs.files import RunError, read_json
from mbn_marl.render.curves import StudyTrial, study_figure


def draw_study(folder: Path) -> Figure:
    """Draw the history of the study of ``folder`` and what mattered in it.

    Raises:
        RunError: there is no study, or ``mbn tune`` has not come to its end there.
        MbnError: no trial has a return yet.
    """
    try:
        with (folder / "trials.csv").open(newline="") as file:
            trials = [
                StudyTrial(int(row["trial"]), float(row["return_mean"]), row["state"] != "complete")
                for row in csv.DictReader(file)
                if row["return_mean"] and row["state"] != "fail"
            ]
        importances = json.loads((folder / "importances.json").read_text())
    except (OSError, ValueError, KeyError) as error:
        raise RunError(
            f"{folder} is not the folder of a study that mbn tune has written to its end ({error})"
        ) from None
    config = read_json(folder / "config.json")
    title = f"{config['algorithm']} on {config['field']}, {config['steps']:,} env-steps a trial"
    return study_figure(trials, importances, title)
