"""A study of hyperparameters in a folder: its storage, and what it has found.

Files of a study's folder:
    config.json         what is tuned on what, fixed for the life of the study
    command.txt         the exact command that began it
    versions.json       Python, packages, machine, git revision
    study.log           every trial, as Optuna's journal, unless config.json names a database
    trials/             the run folder of each trial
    trials.csv          a line a trial
    <algorithm>.yaml    the best values, for ``mbn train ... --setting B --hyperparams``
    importances.json    what mattered
    study.png           both as a figure
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import optuna
import pandas
from optuna import Study
from optuna.exceptions import DuplicatedStudyError, StorageInternalError
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from baselines.compare.text_table import csv_text
from baselines.runs.files import RunError, read_json

CONFIG = "config.json"
DATABASE = "database"
"""The entry of ``config.json`` that names one, or is null."""
JOURNAL = "study.log"
ENOUGH = 10
"""Finished trials that importances need: Optuna asks for five on the good side."""
DIVERGED = "diverged"
"""The attribute of a trial whose learner diverged, with its error, and its constraint."""


def begin_study(folder: Path, database: str | None) -> None:
    """Begin the study of ``folder``, in a journal there or in the database at a URL.

    Raises:
        RunError: the database has one of this name, or cannot be reached.
    """
    with _errors_named(folder, database) as (name, storage):
        optuna.create_study(study_name=name, storage=storage, direction="maximize")


def load_study(folder: Path, database: str | None) -> Study:
    """Open a study where it is kept; of its folder no file but the journal has to be here.

    Raises:
        RunError: the journal or the database cannot be read, or has no such study.
    """
    with _errors_named(folder, database) as (name, storage):
        return optuna.load_study(study_name=name, storage=storage)


def open_study(folder: Path) -> Study:
    """Open the study of ``folder``.

    Raises:
        RunError: there is none, or trials have gone from it, or its database cannot be reached.
    """
    config = read_json(folder / CONFIG) if (folder / CONFIG).is_file() else {}
    if DATABASE not in config and not (folder / JOURNAL).is_file():
        raise RunError(f"{folder} is not the folder of a study: it has no {JOURNAL}")
    study = load_study(folder, config.get(DATABASE))
    folders = sum(1 for _ in (folder / "trials").glob("trial-*"))
    known = len(study.get_trials(deepcopy=False))
    if folders > known:
        raise RunError(f"the study of {folder} is damaged: it has {known} of {folders} trials")
    return study


def resume_study(folder: Path) -> Study:
    """Open the study of ``folder`` and tidy up what an interrupted process left.

    Raises:
        RunError: as :func:`open_study`.
    """
    study, journal = open_study(folder), folder / JOURNAL
    if journal.exists():  # a last line that was not written to its end
        os.truncate(journal, journal.read_bytes().rfind(b"\n") + 1)
    (folder / "checksums.json").unlink(missing_ok=True)  # of files that change; by older versions
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
    return study


@contextmanager
def _errors_named(folder: Path, database: str | None) -> Iterator[tuple[str, BaseStorage]]:
    """Return a study's name and storage; turn what either says against it into one error."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # the display reports every trial
    place = database or str(folder / JOURNAL)
    try:
        if database is None:
            yield "study", JournalStorage(JournalFileBackend(place))
        else:
            yield folder.resolve().name, RDBStorage(database)
    except DuplicatedStudyError:
        raise RunError(
            f"{place} has a study {folder.resolve().name} already; choose another --out, whose "
            "name the study has"
        ) from None
    except (AttributeError, ImportError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{place} cannot be read: {str(error).splitlines()[0]}") from None
    except (SQLAlchemyError, StorageInternalError) as error:
        raise RunError(f"{place} cannot be used: {str(error).splitlines()[0]}") from None


def ended(study: Study) -> list[FrozenTrial]:
    """Return the trials that count: finished or pruned."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))


def importances(study: Study) -> Mapping[str, float]:
    """Return the share of each hyperparameter in a trial's being in the better half (PED-ANOVA).

    Largest first; empty with fewer than ``ENOUGH`` finished trials.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(finished) < ENOUGH:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.5)
    return optuna.importance.get_param_importances(study, evaluator=evaluator)


def trials_csv(study: Study) -> str:
    """Return a line for each trial: number, state, last return, hyperparameters."""
    rows = []
    for trial in study.get_trials(deepcopy=False):
        state = DIVERGED if DIVERGED in trial.user_attrs else trial.state.name.lower()
        last = max(trial.intermediate_values.items(), default=(0, None))[1]
        value = trial.value if trial.state is TrialState.COMPLETE else last
        rows.append({"trial": trial.number, "state": state, "return_mean": value, **trial.params})
    return csv_text(pandas.DataFrame(rows, dtype=object))
