"""Work in several processes side by side, and training runs as such work."""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any, Self

from baselines.runs.files import RunError, claim_folder
from baselines.training.config import DivergenceError, TrainConfig
from baselines.training.progress_bar import Listener, Report
from baselines.training.train import train
from mbn_marl.errors import MbnError

Work = Callable[..., None]
"""``work(job, report)``: a function of a module; ``report`` takes messages for the listener."""

Failed = Callable[[int, str], bool]
"""Is told which job failed, by its place, and why; says whether to try it again."""


@dataclass(frozen=True)
class Job:
    """A run to train and the folder to make for it, or with ``resume`` to go on with.

    ``wandb`` is a project of Weights & Biases to log to as well, or ``None``; ``trust`` is whether
    pickled files of runs may be loaded whoever made them.
    """

    config: TrainConfig
    out: Path
    resume: bool = False
    wandb: str | None = None
    trust: bool = False

    @classmethod
    def left(cls, run: TrainConfig, out: Path, wandb: str | None = None) -> Self:
        """What is left to do for a run; a folder that was killed before it began is moved aside."""
        begun = (out / "config.json").is_file()
        if out.exists() and not begun:
            claim_folder(out, force=True)
        return cls(run, out, resume=begun, wandb=wandb)

    def train(self, listener: Listener) -> None:
        """Do it here; a learner that breaks down is reported, and is no error."""
        try:
            train(
                self.config,
                self.out,
                resume=self.resume,
                trust=self.trust,
                wandb=self.wandb,
                listener=listener,
            )
        except DivergenceError as error:
            listener(Report.broken(self.config.name, str(error)))


@dataclass(frozen=True)
class Ended:
    """A worker's last word on a job; ``error`` is a message or a traceback if it failed."""

    error: str | None = None


def spawning() -> SpawnContext:
    """What locks and arrays that are shared with :func:`run_processes` have to come from."""
    return multiprocessing.get_context("spawn")


def train_all(jobs: Sequence[Job], processes: int, listener: Listener) -> dict[str, str]:
    """Train every job; at most ``processes`` at once, each on one core.

    With one process they are trained here, one after the other. The first failure, Ctrl-C or a
    killed worker stops all; a learner that breaks down stops its own run alone.

    Returns:
        What was said of each run that broke down, by the run's name.

    Raises:
        RunError: a job failed in another process; the message says how.
    """
    broken: dict[str, str] = {}

    def listen(report: Report) -> None:
        if report.error is not None:
            broken[report.run] = report.error
        listener(report)

    if processes == 1:
        for job in jobs:
            job.train(listen)
    else:
        work_all(_train_job, jobs, processes, listen)
    return broken


def _train_job(job: Job, report: Listener) -> None:
    """Train a job; an error names the run."""
    try:
        job.train(report)
    except (MbnError, OSError) as error:
        raise RunError(f"{job.config.name}: {error}") from error
    except Exception as error:
        error.add_note(f"in the run {job.config.name}")
        raise


def run_processes(
    work: Callable[..., None],
    arguments: tuple[Any, ...],
    count: int,
    listener: Callable[[Any], None],
) -> None:
    """Run ``work(*arguments, report)`` in each of ``count`` new processes, until all have ended.

    The first failure, Ctrl-C or a killed worker stops all. Workers end with this process.

    Args:
        work: a function of a module.
        arguments: can be pickled, or are locks and arrays from :func:`spawning`.
        count: how many processes.
        listener: is told here what a worker passes to its ``report``.

    Raises:
        RunError: a worker failed; the message is its own, or has the traceback of a defect.
    """
    work_all(_call, [work] * count, count, listener, shared=arguments)


def _call(work: Callable[..., None], report: Callable[[Any], None], *shared: Any) -> None:
    work(*shared, report)


def stop_all(place: int, error: str) -> bool:
    """The answer to a failure that ends all work.

    Raises:
        RunError: always, with the worker's message.
    """
    raise RunError(error)


def work_all(
    work: Work,
    jobs: Sequence[Any],
    processes: int,
    listener: Callable[[Any], None],
    *,
    failed: Failed = stop_all,
    after: Sequence[int | None] = (),
    shared: tuple[Any, ...] = (),
) -> None:
    """Do all jobs in new processes, at most ``processes`` at once, in order.

    A worker that dies, even by kill -9, fails its job and no other one. Ctrl-C stops all, and
    workers end with this process.

    Args:
        work: does one job.
        jobs: can be pickled.
        processes: how many at once.
        listener: is told here what the work reports.
        failed: by default, the first failure stops all.
        after: for each job the place of one that has to end before it begins, or ``None``.
        shared: what every worker gets with its work, ``work(job, report, *shared)``: can be
            pickled, or comes from :func:`spawning`.

    Raises:
        RunError: by default, when a job failed; the message is the job's own, or has the traceback
            of a defect.
    """
    order = list(after) or [None] * len(jobs)
    waiting = list(range(len(jobs)))
    over: set[int | None] = {None}
    workers = [_Worker(work, shared) for _ in range(min(processes, len(jobs)))]
    try:
        while waiting or any(worker.place is not None for worker in workers):
            for worker in (one for one in workers if one.place is None):
                ready = next((place for place in waiting if order[place] in over), None)
                if ready is not None:
                    waiting.remove(ready)
                    worker.begin(ready, jobs[ready])
            busy = {worker.connection: worker for worker in workers if worker.place is not None}
            for connection in wait(list(busy)):
                worker = next(one for one in workers if one.connection is connection)
                message = worker.receive()
                if not isinstance(message, Ended):
                    listener(message)
                    continue
                place, worker.place = worker.place, None
                assert place is not None
                if not worker.process.is_alive():
                    workers[workers.index(worker)] = _Worker(work, shared)
                if message.error is not None and failed(place, message.error):
                    waiting.insert(0, place)
                else:
                    over.add(place)
    finally:
        for worker in workers:
            worker.process.terminate()
            worker.process.join()


class _Worker:
    """A process that does one job after the other.

    Attributes:
        process: it.
        connection: to it. No other worker has a share in it, so that none is harmed by its death.
        place: of the job that it does, if it does one.
    """

    def __init__(self, work: Work, shared: tuple[Any, ...]) -> None:
        self.connection, theirs = spawning().Pipe()
        self.process = spawning().Process(target=_serve, args=(work, shared, theirs))
        self.process.start()
        theirs.close()
        self.place: int | None = None

    def begin(self, place: int, job: Any) -> None:
        """Hand it a job."""
        self.place = place
        with suppress(OSError):  # it is dead; :meth:`receive` says so
            self.connection.send(job)

    def receive(self) -> Any:
        """Its next message; a dead process has failed its job."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            return Ended(f"a process died with exit code {self.process.exitcode}")


def _serve(work: Work, shared: tuple[Any, ...], connection: Connection[Any, Any]) -> None:
    """Do what comes, in a process of its own, as long as the parent lives."""
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
            work(job, report, *shared)
        except (MbnError, OSError) as error:
            report(Ended(str(error)))
        except Exception:
            report(Ended(f"a process failed:\n{traceback.format_exc()}"))
        else:
            report(Ended())
