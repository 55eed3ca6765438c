"""Train one run into a store, on whatever machine: safe to begin again at any time.

Nothing is remembered outside of the store. A run that is finished there is left alone, and one that
was interrupted resumes from its newest checkpoint.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from baselines.runs.files import LOCK, RunError, claim_folder
from baselines.runs.folder import RunFolder
from baselines.sweep.store import Note, Store, open_store
from baselines.training.config import DivergenceError, TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train
from mbn_marl.errors import MbnError

PATIENCE = 60.0
"""Seconds to wait for the lock of a run folder, which a lost machine may hold for a while."""
NOTE_SECONDS = 10.0
"""Seconds between two notes about a run that is being trained."""


@dataclass(frozen=True)
class TrainJob:
    """A run to train, and where it belongs.

    Attributes:
        run: what to train; of ``transferred_from`` only the name counts, of a run in the store.
        store: the store's path or URL.
        after: the name of a job that has to end before this one begins, or ``None``.
        noted: whether notes about it are written.
        upload_seconds: to a store elsewhere checkpoints go no more often than so.
        wandb: a project of Weights & Biases to log to as well, or ``None``.
    """

    run: TrainConfig
    store: str
    after: str | None = None
    noted: bool = False
    upload_seconds: float = 0.0
    wandb: str | None = None

    @property
    def name(self) -> str:
        """The run's name, and that of its folder in the store."""
        return self.run.name


@dataclass(frozen=True)
class Outcome:
    """The end of work on a run.

    Attributes:
        name: of the run.
        state: ``"elsewhere"`` if another process trains it.
        error: what went wrong, if it is not done.
    """

    name: str
    state: Literal["done", "diverged", "failed", "elsewhere"]
    error: str | None = None


def train_in_store(job: TrainJob, report: Callable[[Report], None]) -> Outcome:
    """Train a run to its end, unless it is there already.

    What would come again (wrong values, a learner that diverges) is an outcome. Everything else is
    raised as an error, for the engine to try again.
    """
    store, name = open_store(job.store), job.name
    if store.finished([name]):
        return Outcome(name, "done")
    if not _becomes_free(store.folder(name)):
        return Outcome(name, "elsewhere", f"{name}: another process trains it")
    watch = Watch(store, job, report)
    try:
        _train(store, job, watch)
        store.finish(name)
    except DivergenceError as error:
        outcome = Outcome(name, "diverged", str(error))
    except MbnError as error:
        outcome = Outcome(name, "failed", str(error))
    except Exception as error:
        watch.note(state="failed", error=f"{type(error).__name__}: {error}")
        raise
    else:
        outcome = Outcome(name, "done")
    watch.note(state=outcome.state, error=outcome.error)
    return outcome


def _becomes_free(folder: Path) -> bool:
    """Return whether no process holds the lock of a run folder any more, after some patience."""
    try:
        if folder.is_dir():
            FileLock(folder / LOCK, timeout=PATIENCE).acquire().lock.release()
    except Timeout:
        return False
    return True


def _train(store: Store, job: TrainJob, watch: Watch) -> None:
    """Train in the folder that the store says, from the newest checkpoint that it has."""
    run, source, out = job.run, source_of(job.run), store.folder(job.name)
    if source is not None:
        if not store.finished([source]):
            raise RunError(f"{source}, whose policy {run.name} begins with, is not finished")
        run = replace(run, transferred_from=store.source(source))
    store.restore(job.name)
    watch.start()
    begun = (out / "config.json").is_file()
    if out.exists() and not begun:  # it was killed before it began
        claim_folder(out, force=True)
    train(run, out, resume=begun, wandb=job.wandb, listener=watch)


def source_of(run: TrainConfig) -> str | None:
    """Return the name of the run whose policy this one begins with; ``None`` for most."""
    return None if run.transferred_from is None else run.transferred_from.name


class Watch:
    """Listen to a training: pass reports on, keep checkpoints, write notes.

    Args:
        store: of the run.
        job: what is trained.
        listener: receives the reports too.
    """

    def __init__(self, store: Store, job: TrainJob, listener: Callable[[Report], None]) -> None:
        self._store, self._job, self._listener = store, job, listener
        self._run = RunFolder(store.folder(job.name))
        before = store.last_note(job.name) if job.noted else None
        self._note = Note(
            state="running",
            attempt=1 if before is None else before.attempt + 1,
            machine=platform.node(),
            process=os.getpid(),
            env_steps=0 if before is None else before.env_steps,
        )
        self.note()

    def start(self) -> None:
        """Begin to count: the run is where it is trained."""
        self._kept = self._run.checkpoint
        self._first_steps = 0 if self._kept is None else int(self._kept.name)
        self._started_at = self._kept_at = time.monotonic()

    def __call__(self, report: Report) -> None:
        """Follow the training."""
        self._listener(report)
        if report.finished:
            return
        now, newest = time.monotonic(), self._run.checkpoint
        if now - self._noted_at >= NOTE_SECONDS:
            speed = (report.env_steps - self._first_steps) / (now - self._started_at)
            self.note(env_steps=report.env_steps, steps_per_second=speed)
        if newest != self._kept and now - self._kept_at >= self._job.upload_seconds:
            self._store.keep(self._job.name)
            self._kept, self._kept_at = newest, now

    def note(self, **changes: Any) -> None:
        """Write a note with these changes, if notes are wanted."""
        self._note = self._note.model_copy(update={**changes, "updated": time.time()})
        self._noted_at = time.monotonic()
        if self._job.noted:
            self._store.note(self._job.name, self._note)
