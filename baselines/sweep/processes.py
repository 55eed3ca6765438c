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
    """A piece of work that can be pickled."""

    @property
    def name(self) -> str:
        """Unique among the jobs."""

    @property
    def after(self) -> str | None:
        """The name of an earlier job that has to end before this one begins, or ``None``."""


@dataclass(frozen=True)
class Failure:
    """The message or traceback of a job that failed, or whose process or machine was lost."""

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
    """

    processes: int
    retries: int = 0

    def __post_init__(self) -> None:
        """Check the number of processes; raise a ConfigError if it is below 1."""
        if self.processes < 1:
            raise ConfigError("engine", [f"processes: must be at least 1 (got {self.processes})"])

    def run(
        self, work: Work, jobs: Iterable[Job], report: Callable[[Any], None], ended: Ended
    ) -> None:
        """Do all jobs, each drawn when it can begin, in order but for those that have to wait.

        A worker that dies fails its job alone. An error that ``report`` or ``ended`` raises, or
        Ctrl-C, stops all; workers end with this process.
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
    """Jobs to do; some wait for others, or are begun again."""

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
        """Receive how a job ended; return whether it is over, not begun again."""
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
    """Processes that do jobs, each with its own connection, so that a death harms no other."""

    def __init__(self, work: Work) -> None:
        self.busy: dict[Any, tuple[SpawnProcess, Job]] = {}  # by connection
        self._idle: list[tuple[Any, SpawnProcess]] = []
        self._work = work

    def begin(self, job: Job) -> None:
        """Send a job to a process, to a new one if none is idle."""
        if not self._idle:
            context = multiprocessing.get_context("spawn")
            ours, theirs = context.Pipe()
            new = context.Process(target=_serve, args=(self._work, theirs))
            new.start()
            theirs.close()
            self._idle.append((ours, new))
        connection, process = self._idle.pop()
        self.busy[connection] = (process, job)
        with suppress(OSError):  # it is dead, which messages() reports
            connection.send(job)

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
        busy = (process for process, _ in self.busy.values())
        for process in (*busy, *(process for _, process in self._idle)):
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
