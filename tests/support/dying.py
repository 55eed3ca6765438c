"""Work that dies, for the processes that do it: they import nothing heavier than this."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FileJob:
    """A job that dies unless its file is there; ``after`` as for every job."""

    path: Path
    after: str | None = None

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.name


def die_once(job: FileJob, report: Callable[[str], None]) -> int:
    """Die unless the job's file is there, as if the machine's memory had run out."""
    if not job.path.exists():
        job.path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    report(job.name)
    return 1
