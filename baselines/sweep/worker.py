"""Train one run into a store, on whatever machine: safe to begin again at any time."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from baselines.runs.files import RunError, alone, claim_folder
from baselines.runs.folder import RunFolder
from baselines.sweep.store import Note, Store, open_store
from baselines.training.config import DivergenceError, TrainConfig
from baselines.training.run_logger import Report
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
        run: what to train; ``transferred_from`` names a run in the store.
        store: the store's path or URL.
        after: the name of a job that has to end before this one begins, or ``None``.
        noted: whether notes about it are written.
        upload_seconds: least seconds between two copies of checkpoints into a remote store.
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
    """The end of work on a run; ``"elsewhere"`` if another process trains it."""

    name: str
    state: Literal["done", "diverged", "failed", "elsewhere"]
    error: str | None = None


def train_in_store(job: TrainJob, report: Callable[[Report], None]) -> Outcome:
    """Train a run to its end, unless it is finished in the store; resume an interrupted one.

    What would come again (wrong values, a learner that diverges) is an outcome. Everything else is
    raised as an error, for the engine to try again.
    """
    store, name = open_store(job.store), job.name
    if store.finished([name]):
        return Outcome(name, "done")
    folder = store.folder(name)
    try:
        if folder.is_dir():
            with alone(folder, "mbn train", patience=PATIENCE):
                pass
    except RunError:
        return Outcome(name, "elsewhere", f"{name}: another process trains it")
    watch = Watch(store, job, report)
    try:
        _train(store, job, watch, folder)
        store.finish(name)
        outcome = Outcome(name, "done")
    except MbnError as error:
        diverged = isinstance(error, DivergenceError)
        outcome = Outcome(name, "diverged" if diverged else "failed", str(error))
    except Exception as error:
        watch.note(state="failed", error=f"{type(error).__name__}: {error}")
        raise
    watch.note(state=outcome.state, error=outcome.error)
    return outcome


def _train(store: Store, job: TrainJob, watch: Watch, out: Path) -> None:
    """Train in a folder, from the newest checkpoint that the store has."""
    run, source = job.run, source_of(job.run)
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
    """Listen to a training: pass reports to ``listener``, keep checkpoints, write notes."""

    def __init__(self, store: Store, job: TrainJob, listener: Callable[[Report], None]) -> None:
        self._store, self._job, self._listener = store, job, listener
        self._run = RunFolder(store.folder(job.name))
        before = (store.last_note(job.name) if job.noted else None) or Note(attempt=0)
        self._note = Note(
            attempt=before.attempt + 1,
            machine=platform.node(),
            process=os.getpid(),
            env_steps=before.env_steps,
        )
        self.note()

    def start(self) -> None:
        """Begin to count: the run is where it is trained."""
        self._kept = self._run.checkpoint
        self._first_steps = self._run.saved_steps
        self._started_at = self._kept_at = time.monotonic()

    def __call__(self, report: Report) -> None:
        """Receive a report."""
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
