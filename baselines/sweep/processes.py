"""Jobs in processes of this machine, a number of them at a time."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol

from mbn_marl.errors import ConfigError, MbnError


class Job(Protocol):
    """A piece of work that can be pickled.

    Attributes:
        name: unique among the jobs.
        after: the name of an earlier job that has to end before this one begins, or ``None``.
    """

    @property
    def name(self) -> str:
        """See the class."""

    @property
    def after(self) -> str | None:
        """See the class."""


@dataclass(frozen=True)
class Failure:
    """The end of a job that raised an error, or whose process or machine was lost.

    Attributes:
        error: the message, or the traceback of a defect.
    """

    error: str


Work = Callable[[Any, Callable[[Any], None]], Any]
"""``work(job, report)``, a function of a module: returns the result, reports on the way."""
Ended = Callable[[Any, Any], None]
"""``ended(job, result)`` receives each job once; the result is a :class:`Failure` if it failed."""


@dataclass(frozen=True)
class LocalEngine:
    """Processes of this machine.

    One process without retries is this one: errors of the work are raised as they are.

    Attributes:
        processes: jobs at a time (>= 1).
        retries: how often a job that failed is begun again (>= 0).

    Raises:
        ConfigError: a number is out of range.
    """

    processes: int
    retries: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.processes < 1:
            raise ConfigError("engine", [f"processes: must be at least 1 (got {self.processes})"])

    def run(
        self, work: Work, jobs: Iterable[Job], report: Callable[[Any], None], ended: Ended
    ) -> None:
        """Do all jobs, in order but for those that have to wait.

        A worker that dies, even by kill -9, fails its job and no other one. An error that
        ``report`` or ``ended`` raises, or Ctrl-C, stops all; workers end with this process.

        Args:
            work: does a job.
            jobs: one is drawn when it can begin; what has ended by then has been received.
            report: receives what the work reports.
            ended: receives how each job ended.
        """
        if self.processes == 1 and self.retries == 0:
            for job in jobs:
                ended(job, work(job, report))
            return
        queue, workers = _Queue(jobs, self.retries), _Workers(work)
        try:
            while True:
                while len(workers.busy) < self.processes and (ready := queue.draw()) is not None:
                    workers.begin(ready)
                if not workers.busy:
                    return
                for job, message in workers.messages():
                    if not isinstance(message, _Ended):
                        report(message)
                    elif queue.is_over(job, message.result):
                        ended(job, message.result)
        finally:
            workers.stop()


class _Queue:
    """Jobs to do, some of which have to wait for others, or are begun again."""

    def __init__(self, jobs: Iterable[Job], retries: int) -> None:
        self._jobs, self._retries = iter(jobs), retries
        self._waiting: list[Job] = []
        self._tries = Counter[str]()
        self._over: set[str | None] = {None}

    def draw(self) -> Job | None:
        """Return the next job that can begin now."""
        for job in self._waiting:
            if job.after in self._over:
                self._waiting.remove(job)
                return job
        for job in self._jobs:
            if job.after in self._over:
                return job
            self._waiting.append(job)
        return None

    def is_over(self, job: Job, result: Any) -> bool:
        """Take in how a job ended; return whether it is not begun again."""
        self._tries[job.name] += 1
        if isinstance(result, Failure) and self._tries[job.name] <= self._retries:
            self._waiting.insert(0, job)
            return False
        self._over.add(job.name)
        return True


@dataclass(frozen=True)
class _Ended:
    """A worker's last message about a job."""

    result: Any


class _Workers:
    """Processes that do one job after the other.

    Each has a connection of its own, so that a death harms no other one.

    Attributes:
        busy: the process and the job of each connection that a job was sent to.
    """

    def __init__(self, work: Work) -> None:
        self.busy: dict[Any, tuple[SpawnProcess, Job]] = {}
        self._idle: list[tuple[Any, SpawnProcess]] = []
        self._work = work

    def begin(self, job: Job) -> None:
        """Send a job to a process, to a new one if none is idle."""
        connection, process = self._idle.pop() if self._idle else self._start()
        self.busy[connection] = (process, job)
        with suppress(OSError):  # it is dead, which messages() reports
            connection.send(job)

    def _start(self) -> tuple[Any, SpawnProcess]:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(self._work, theirs))
        process.start()
        theirs.close()
        return ours, process

    def messages(self) -> Iterator[tuple[Job, Any]]:
        """Wait for messages about jobs; a dead process has failed its job."""
        connection: Any
        for connection in wait(list(self.busy)):
            process, job = self.busy[connection]
            try:
                message = connection.recv()
            except (EOFError, OSError):
                process.join()
                message = _Ended(Failure(f"a process died with exit code {process.exitcode}"))
            if isinstance(message, _Ended):
                del self.busy[connection]
                if process.is_alive():
                    self._idle.append((connection, process))
            yield job, message

    def stop(self) -> None:
        """End all processes."""
        processes = [process for _, process in self._idle]
        for process in (*processes, *(process for process, _ in self.busy.values())):
            process.terminate()
            process.join()


def _serve(work: Work, connection: Connection[Any, Any]) -> None:
    """Do the jobs that come, in a process of its own, as long as the parent lives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C

    def report(message: Any) -> None:
        try:
            connection.send(message)
        except OSError:
            raise SystemExit from None  # the parent is dead

    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        try:
            result = work(job, report)
        except (MbnError, OSError) as error:
            result = Failure(str(error))
        except Exception:
            result = Failure(f"{job.name}: a process failed:\n{traceback.format_exc()}")
        report(_Ended(result))
