"""Where the trials of a study are kept: in a journal of its folder, or in a database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import optuna
from optuna import Study
from optuna.exceptions import DuplicatedStudyError, StorageInternalError
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from sqlalchemy.exc import SQLAlchemyError

from baselines.runs.files import RunError
from baselines.tuning.journal import CheckedJournal

JOURNAL = "study.log"
NAME = "study"
"""The only study of a journal."""


@dataclass(frozen=True)
class Address:
    """Where the trials of a study are kept, for any process that takes part in it.

    Attributes:
        name: of the study there.
        storage: the path of an Optuna journal, or the URL of a database.
    """

    name: str
    storage: str

    @classmethod
    def of(cls, folder: Path, database: str | None) -> Self:
        """That of the study of ``folder``, in its own journal or in a database."""
        if database is None:
            return cls(NAME, str(folder.resolve() / JOURNAL))
        return cls(folder.name, database)

    def begin(self) -> None:
        """Begin the study.

        Raises:
            RunError: the database has one of this name, or cannot be reached.
        """
        with _named_database(self):
            optuna.create_study(study_name=self.name, storage=self._backend(), direction="maximize")

    def open(self) -> Study:
        """Open the study.

        Raises:
            RunError: the database cannot be reached, or has no such study.
        """
        with _named_database(self):
            return optuna.load_study(study_name=self.name, storage=self._backend())

    def _backend(self) -> BaseStorage:
        optuna.logging.set_verbosity(optuna.logging.ERROR)  # the display tells of every trial
        if "://" in self.storage:
            return RDBStorage(self.storage)
        return JournalStorage(CheckedJournal(Path(self.storage)))


@contextmanager
def _named_database(address: Address) -> Iterator[None]:
    """Turn what a database says against a study into one error."""
    try:
        yield
    except DuplicatedStudyError:
        raise RunError(
            f"{address.storage} has a study {address.name} already; choose another --out, whose "
            "name the study has"
        ) from None
    except KeyError as error:
        raise RunError(f"{address.storage} is damaged: it lacks {error}") from None
    except (SQLAlchemyError, ImportError, StorageInternalError) as error:
        raise RunError(f"{address.storage}: {str(error).splitlines()[0]}") from None
