"""Run jobs in processes of this machine."""

import multiprocessing
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from mbn_marl.errors import ConfigError, MbnError


@dataclass(frozen=True)
class Failure:
    """The error of a job that failed, or whose process or machine was lost."""

    error: str


Report = Callable[[Any], None]
# A function of a module: work(job, report) returns a result, and reports on the way.
Work = Callable[[Any, Report], Any]
# ended(job, result) receives each job once; the result may be a Failure.
Ended = Callable[[Any, Any], None]


@dataclass(frozen=True)
class LocalEngine:
    """Run so many jobs at a time, each in a new process; repeat a failed one ``retries`` times."""

    # A single process without retries is this process: errors of the work are raised.
    processes: int
    retries: int = 0

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise ConfigError("engine", [f"processes: must be at least 1 (got {self.processes})"])

    def run(self, work: Work, jobs: Iterable[Any], report: Report, ended: Ended) -> None:
        if self.processes == 1 and self.retries == 0:
            for job in jobs:
                ended(job, work(job, report))
            return
        context = multiprocessing.get_context("spawn")
        waiting = deque((job, self.retries) for job in jobs)
        # Each process has its connection: a shared queue would break when one is killed.
        busy: dict[Any, tuple[SpawnProcess, Any, int]] = {}
        try:
            while waiting or busy:
                while waiting and len(busy) < self.processes:
                    job, retries = waiting.popleft()
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_work_in_process, args=(work, job, theirs))
                    process.start()
                    theirs.close()
                    busy[ours] = (process, job, retries)
                connection: Any
                for connection in wait(list(busy)):
                    process, job, retries = busy[connection]
                    try:
                        is_over, message = connection.recv()
                    except (EOFError, OSError):
                        process.join()
                        is_over = True
                        message = Failure(f"a process died with exit code {process.exitcode}")
                    if not is_over:
                        report(message)
                        continue
                    del busy[connection]
                    process.join()
                    if isinstance(message, Failure) and retries:
                        waiting.appendleft((job, retries - 1))
                    else:
                        ended(job, message)
        finally:
            for process, *_ in busy.values():
                process.terminate()
                process.join()


def _work_in_process(work: Work, job: Any, connection: "Connection[Any, Any]") -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C

    def report(message: Any) -> None:
        try:
            connection.send((False, message))
        except OSError:
            raise SystemExit from None  # the parent is dead

    try:
        result = work(job, report)
    except (MbnError, OSError) as error:
        result = Failure(str(error))
    except Exception as error:
        result = Failure(f"a process failed: {error!r}\n{traceback.format_exc()}")
    connection.send((True, result))
