"""Work in several processes side by side, and training runs as such work."""

from __future__ import annotations

import multiprocessing
import queue
import signal
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from baselines.progress import Listener, Report
from baselines.runs import DivergenceError, TrainConfig
from baselines.storage import RunError
from baselines.train import train
from mbn_marl.errors import MbnError


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
    """A worker's last word; ``error`` is a message or a traceback if it failed."""

    error: str | None = None


def spawning() -> SpawnContext:
    """What queues and locks that are shared with :func:`run_processes` have to come from."""
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
        return broken
    count = min(processes, len(jobs))
    todo = spawning().Queue()
    for item in (*jobs, *[None] * count):
        todo.put(item)
    run_processes(_train_jobs, (todo,), count, listen)
    return broken


def _train_jobs(todo: multiprocessing.Queue[Job | None], listener: Listener) -> None:
    """Train the jobs of a queue up to its first ``None``."""
    for job in iter(todo.get, None):
        try:
            job.train(listener)
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
        arguments: can be pickled, or are queues and locks from :func:`spawning`.
        count: how many processes.
        listener: is told here what a worker passes to its ``report``.

    Raises:
        RunError: a worker failed; the message is its own, or has the traceback of a defect.
    """
    messages = spawning().Queue()
    workers = [
        spawning().Process(target=_work, args=(work, arguments, messages)) for _ in range(count)
    ]
    try:
        for worker in workers:
            worker.start()
        _watch(workers, messages, listener)
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def _watch(
    workers: Sequence[BaseProcess],
    messages: multiprocessing.Queue[Any],
    listener: Callable[[Any], None],
) -> None:
    """Pass messages on until every worker has ended."""
    running = len(workers)
    while running:
        try:
            message = messages.get(timeout=1.0)
        except queue.Empty:
            dead = [worker.exitcode for worker in workers if worker.exitcode]
            if dead:
                raise RunError(f"a process died with exit code {dead[0]}") from None
            continue
        if not isinstance(message, Ended):
            listener(message)
        elif message.error is not None:
            raise RunError(message.error)
        else:
            running -= 1


def _work(
    work: Callable[..., None], arguments: tuple[Any, ...], messages: multiprocessing.Queue[Any]
) -> None:
    """Do the work in a process of its own, as long as the parent lives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C
    parent = multiprocessing.parent_process()

    def report(message: Any) -> None:
        if parent is not None and not parent.is_alive():
            raise SystemExit
        messages.put(message)

    try:
        work(*arguments, report)
    except (MbnError, OSError) as error:
        messages.put(Ended(str(error)))
        return
    except Exception:
        messages.put(Ended(f"a process failed:\n{traceback.format_exc()}"))
        return
    messages.put(Ended())
