"""Several training runs side by side, one process per run at a time."""

from __future__ import annotations

import multiprocessing
import queue
import signal
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from baselines.progress import Listener, Report
from baselines.runs import TrainConfig
from baselines.storage import RunError
from baselines.train import train


@dataclass(frozen=True)
class Job:
    """A run to train and the folder to make for it, or with ``resume`` to go on with."""

    config: TrainConfig
    out: Path
    resume: bool = False


@dataclass(frozen=True)
class Finished:
    """A worker's word that a job is done; ``error`` is its traceback if it failed."""

    run: str
    error: str | None = None


def train_all(jobs: Sequence[Job], processes: int, listener: Listener) -> None:
    """Train every job; at most ``processes`` at once, each on one core.

    With one process they are trained here, one after the other. The first failure, Ctrl-C or a
    killed worker stops all.

    Raises:
        RunError: a job failed in another process; the message has its traceback.
    """
    if processes == 1:
        for job in jobs:
            train(job.config, job.out, resume=job.resume, listener=listener)
        return
    context = multiprocessing.get_context("spawn")
    todo, messages = context.Queue(), context.Queue()
    count = min(processes, len(jobs))
    for job in jobs:
        todo.put(job)
    for _ in range(count):
        todo.put(None)
    workers = [context.Process(target=_work, args=(todo, messages)) for _ in range(count)]
    try:
        for worker in workers:
            worker.start()
        _watch(workers, messages, len(jobs), listener)
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def _watch(
    workers: Sequence[BaseProcess],
    messages: multiprocessing.Queue[Report | Finished],
    jobs: int,
    listener: Listener,
) -> None:
    """Pass reports on until every job is finished."""
    while jobs:
        try:
            message = messages.get(timeout=1.0)
        except queue.Empty:
            dead = [worker.exitcode for worker in workers if worker.exitcode]
            if dead:
                raise RunError(f"a training process died with exit code {dead[0]}") from None
            continue
        if isinstance(message, Report):
            listener(message)
        elif message.error is not None:
            raise RunError(f"{message.run} failed:\n{message.error}")
        else:
            jobs -= 1


def _work(todo: multiprocessing.Queue[Job | None], messages: multiprocessing.Queue[Any]) -> None:
    """Train the jobs of a queue, in a process of its own, as long as the parent lives."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent answers Ctrl-C
    parent = multiprocessing.parent_process()

    def report(state: Report) -> None:
        if parent is not None and not parent.is_alive():
            raise SystemExit
        messages.put(state)

    for job in iter(todo.get, None):
        try:
            train(job.config, job.out, resume=job.resume, listener=report)
        except Exception:
            messages.put(Finished(job.config.name, traceback.format_exc()))
            return
        messages.put(Finished(job.config.name))
