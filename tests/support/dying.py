"""Work that dies, for the processes that do it: they import nothing heavier than this."""

import os
import signal
from collections.abc import Callable
from pathlib import Path


def die_once(job: Path, report: Callable[[str], None]) -> int:
    """Die unless the job's file is there, as if the memory had run out; fail if it is ``bad``."""
    if not job.exists():
        job.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if job.name == "bad":
        raise RuntimeError("a defect")
    report(job.name)
    return 1
