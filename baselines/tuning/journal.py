"""Optuna's journal of a study, with a checksum on every line."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

from optuna.storages.journal import JournalFileBackend

from baselines.runs.files import RunError
from mbn_marl.checksums import check, digest_of_json
from mbn_marl.errors import DamageError

CHECKSUM = "sha256"


class CheckedJournal(JournalFileBackend):
    """A journal that does not take a line for what it is not.

    Args:
        path: the file. One that its folder lists the checksum of (see :mod:`mbn_marl.checksums`),
            which is that of a study that has come to its end, is checked as a whole.

    Raises:
        DamageError: the file is not what was written.
    """

    def __init__(self, path: Path) -> None:
        if path.exists():
            check(path)
        super().__init__(str(path))
        self._path = path

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Write lines, each with its checksum."""
        super().append_logs([{**log, CHECKSUM: digest_of_json(log)} for log in logs])

    def read_logs(self, log_number_from: int) -> Generator[dict[str, Any], None, None]:
        """The lines from a number on, each one checked; older versions wrote some without checksum.

        Raises:
            DamageError: a line is not what was written.
            RunError: a line is not JSON.
        """
        try:
            for number, log in enumerate(super().read_logs(log_number_from), log_number_from + 1):
                checksum = log.pop(CHECKSUM, None)
                if checksum not in (None, digest_of_json(log)):
                    raise DamageError(f"{self._path}, line {number}: is not what was written")
                yield log
        except (ValueError, AttributeError) as error:
            if isinstance(error, DamageError):
                raise
            raise RunError(f"{self._path} cannot be read: {error}") from None


def cut_unfinished_line(path: Path) -> None:
    """Take away a last line that was not written to its end."""
    data = path.read_bytes()
    os.truncate(path, data.rfind(b"\n") + 1)
