"""Run jobs in processes of this machine, or as tasks of a Ray cluster."""

import logging
import multiprocessing
import signal
import socket
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


@dataclass(frozen=True)
class RayEngine:
    """Run jobs on a Ray cluster; one is repeated when its machine is lost, or after an error."""

    # HOST:PORT; by default that of ``RAY_ADDRESS``, or of this machine.
    address: str | None = None
    # Of each job: cores, and GPUs or a share of one.
    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 3

    def run(self, work: Work, jobs: Iterable[Any], report: Report, ended: Ended) -> None:
        import ray

        address = self.address
        try:
            if address is not None:  # Ray would try for minutes
                host, _, port = address.removeprefix("ray://").rpartition(":")
                if not host or not port.isdecimal():
                    raise ValueError("the address must be HOST:PORT")
                socket.create_connection((host, int(port)), timeout=10.0).close()
            ray.init(address=address or "auto", log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            place = "here" if address is None else f"at {address}"
            raise MbnError(
                f"no Ray cluster {place} ({str(error).splitlines()[0]}); start one with `ray start "
                "--head`, or name one with --address HOST:PORT"
            ) from None
        try:
            task = ray.remote(_work_in_task).options(
                num_cpus=self.cpus,
                num_gpus=self.gpus,
                max_retries=self.retries,
                retry_exceptions=True,
            )
            running = {task.remote(work, job): job for job in jobs}
            while running:
                for ref in ray.wait(list(running))[0]:
                    try:
                        result = ray.get(ref)
                    except ray.exceptions.RayError as error:
                        result = Failure(str(getattr(error, "cause", None) or error))
                    ended(running.pop(ref), result)
        finally:
            ray.shutdown()  # which ends the tasks that are running


def _work_in_task(work: Work, job: Any) -> Any:
    try:
        return work(job, lambda message: None)
    except MbnError as error:  # a repetition would raise it again
        return Failure(str(error))
