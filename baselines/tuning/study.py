"""A study of hyperparameters in a folder: opened, summarised, drawn.

Files of a study's folder:
    config.json         what is tuned on what, fixed for the life of the study
    command.txt         the exact command that began it
    versions.json       Python, packages, machine, git revision
    study.log           every trial, as Optuna's journal, unless config.json names a database
                        instead; it grows, and is never rewritten
    checksums.json      of all files but the trials' and the figure, while no trial runs
    trials/             the run folder of each trial
    trials.csv          a line a trial
    <algorithm>.yaml    the best values, for ``mbn train ... --setting B --hyperparams``
    importances.json    what mattered
    study.png           both as a figure
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import optuna
from matplotlib.figure import Figure
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from baselines.runs.files import RunError, read_json, seal
from baselines.tuning.address import JOURNAL, Address
from baselines.tuning.journal import cut_unfinished_line
from mbn_marl.render.figures import StudyTrial, study_figure

CONFIG = "config.json"
DATABASE = "database"
"""The entry of ``config.json`` that names one."""
FIXED = (CONFIG, "command.txt", "versions.json")
"""Files that never change."""
ENOUGH = 10
"""Finished trials that importances need: Optuna asks for five on the good side."""
DIVERGED = "diverged"
"""The attribute of a trial whose learner broke down, with what it said, and its constraint."""


def open_study(folder: Path) -> Study:
    """Open the study of ``folder``.

    Raises:
        RunError: there is none, or trials have gone from it, or its database cannot be reached.
        DamageError: a file is not what was written.
    """
    if not is_study(folder):
        raise RunError(f"{folder} is not the folder of a study: it has no {JOURNAL}")
    address = Address.of(folder, read_json(folder / CONFIG).get(DATABASE))
    study = address.open()
    folders = sum(1 for _ in (folder / "trials").glob("trial-*"))
    known = len(study.get_trials(deepcopy=False))
    if folders > known:
        raise RunError(f"{address.storage} is damaged: it has {known} of {folders} trials")
    return study


def is_study(folder: Path) -> bool:
    """Whether ``folder`` is that of a study."""
    if (folder / JOURNAL).is_file():
        return True
    path = folder / CONFIG
    config = read_json(path) if path.is_file() else None
    return isinstance(config, dict) and config.get(DATABASE) is not None


def take_up(folder: Path) -> None:
    """Make the files of a study's folder ready to change again.

    Raises:
        DamageError: a file is not what was written.
    """
    open_study(folder)
    if (folder / JOURNAL).exists():
        cut_unfinished_line(folder / JOURNAL)
    seal(folder, FIXED)


def put_down(folder: Path) -> None:
    """List the checksums of the files of a study's folder: no trial runs any more."""
    files = (path for path in folder.iterdir() if path.suffix != ".png")
    seal(folder, [path.name for path in files if not path.name.startswith(".")])


def ended(study: Study) -> list[FrozenTrial]:
    """The trials that count: finished or pruned."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))


def draw_study(folder: Path) -> Figure:
    """The history of the study of ``folder`` and what mattered in it.

    Raises:
        RunError: there is no study.
        MbnError: no trial has a return yet.
    """
    study, config = open_study(folder), read_json(folder / CONFIG)
    trials = [
        StudyTrial(trial.number, value, trial.state is TrialState.PRUNED)
        for trial in ended(study)
        if (value := last_return(trial)) is not None
    ]
    title = f"{config['algorithm']} on {config['field']}, {config['steps']:,} env-steps a trial"
    return study_figure(trials, importances(study), title)


def importances(study: Study) -> Mapping[str, float]:
    """How much each hyperparameter had to do with being in the better half of the finished trials.

    By PED-ANOVA, as shares of 1, largest first; empty with fewer than ``ENOUGH`` finished trials.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(finished) < ENOUGH:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.5)
    return optuna.importance.get_param_importances(study, evaluator=evaluator)


def last_return(trial: FrozenTrial) -> float | None:
    """Its final return, or the last one before it was pruned; ``None`` if it had none."""
    if trial.state is TrialState.COMPLETE:
        return trial.value
    values = trial.intermediate_values
    return values[max(values)] if values else None


def trials_csv(study: Study) -> str:
    """A line a trial: number, state, return, hyperparameters."""
    trials = study.get_trials(deepcopy=False)
    names = list(dict.fromkeys(name for trial in trials for name in trial.params))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "state", "return_mean", *names])
    for trial in trials:
        value = last_return(trial)
        state = DIVERGED if DIVERGED in trial.user_attrs else trial.state.name.lower()
        values = [trial.params.get(name, "") for name in names]
        writer.writerow([trial.number, state, "" if value is None else value, *values])
    return text.getvalue()
