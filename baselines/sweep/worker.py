"""What an engine does for one cell, on whatever machine it is put: safe to begin again at any time.

Nothing is remembered outside of the store. A cell that is finished there is left alone, one that
was interrupted goes on from its newest checkpoint, and the newest attempt of a cell has the right
to it: an older one, on a machine that was given up but is not dead, stops at its next report.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Literal, Self

from baselines.runs.files import RunError, alone
from baselines.runs.folder import RunFolder
from baselines.sweep import store as stores
from baselines.sweep.processes import Job
from baselines.sweep.spec import Cell
from baselines.sweep.store import State, Store, open_store
from baselines.training.progress_bar import Report
from baselines.training.train import train
from mbn_marl.errors import MbnError

PATIENCE = 60.0
"""Seconds that the process of a machine given up has to let go of a run folder."""


@dataclass(frozen=True)
class Assignment:
    """A cell, and where its run belongs.

    Attributes:
        cell: what to train.
        store: the store's path or URL.
        grid: which call of ``mbn grid`` this is of.
        upload_seconds: to a store elsewhere checkpoints go no more often than so.
        trust: whether pickled files of the store may be loaded whoever made them.
    """

    cell: Cell
    store: str
    grid: str
    upload_seconds: float
    trust: bool = False


@dataclass(frozen=True)
class Outcome:
    """How work on a cell ended.

    Attributes:
        name: of its run.
        state: ``"elsewhere"`` if another call of ``mbn grid`` is at work on it.
        error: what went wrong, if it failed for good.
    """

    name: str
    state: Literal["done", "failed", "elsewhere"]
    error: str | None = None


class SupersededError(Exception):
    """Another attempt has taken this cell over."""


def work_on_cell(job: Assignment, report: Callable[[Outcome | Report], None]) -> None:
    """Train a cell to its end, unless it is there already; report the training, then how it ended.

    What cannot go better another time (wrong values, a learner that breaks down) is noted as a
    failure, and is no error here. Everything else is one, for the engine to try again.
    """
    store, name = open_store(job.store), job.cell.name
    if store.finished([name]):
        report(Outcome(name, "done"))
        return
    before = store.state(name)
    if before is not None and before.alive and before.grid != job.grid:
        report(Outcome(name, "elsewhere"))
        return
    try:
        with Claim(store, job, before, report) as claim:
            error = _train(store, job, before, claim)
    except SupersededError:
        report(Outcome(name, "elsewhere"))
    else:
        report(Outcome(name, "done" if error is None else "failed", error))


def _train(store: Store, job: Assignment, before: State | None, claim: Claim) -> str | None:
    """Train a cell, and note how that ended; what went wrong, if it would again.

    Raises:
        SupersededError: another attempt has the cell.
    """
    try:
        _run(store, job, before, claim)
    except MbnError as error:
        claim.end("failed", str(error))
        return str(error)
    except Exception as error:
        if not isinstance(error, SupersededError):
            claim.end("failed", f"{type(error).__name__}: {error}")
        raise
    claim.end("done")
    return None


def _run(store: Store, job: Assignment, before: State | None, claim: Claim) -> None:
    """Train in the folder that the store says."""
    name, source, config = job.cell.name, job.cell.source, job.cell.config
    if source is not None:
        if not store.finished([source]):
            raise RunError(f"{source}, whose policy it begins with, is not finished")
        config = replace(config, transferred_from=store.source(source))
    _wait_until_free(store.folder(name))
    store.take_up(name, before)
    claim.start()
    left = Job.left(config, store.folder(name))
    train(config, left.out, resume=left.resume, trust=job.trust, listener=claim)


def _wait_until_free(folder: Path) -> None:
    """Wait for the process of a machine that was given up; a run at work refuses by itself."""
    deadline = time.monotonic() + PATIENCE
    while folder.is_dir() and time.monotonic() < deadline:
        try:
            with alone(folder, "mbn grid"):
                return
        except RunError:
            time.sleep(0.5)


class Claim:
    """Notes in the store that a cell is at work, until that ends; use as a context manager.

    It listens to the training too: it keeps new checkpoints, and stops what is superseded.

    Args:
        store: of the cell.
        job: what is worked on.
        before: the last note about it.
        listener: is told of the training as well.
    """

    def __init__(
        self,
        store: Store,
        job: Assignment,
        before: State | None,
        listener: Callable[[Report], None],
    ) -> None:
        self._listener = listener
        self._store, self._job, self._name = store, job, job.cell.name
        self._run = RunFolder(store.folder(self._name))
        self._state = State(
            state="running",
            grid=job.grid,
            attempt=1 if before is None else before.attempt + 1,
            machine=platform.node(),
            process=os.getpid(),
            env_steps=0 if before is None else before.env_steps,
            archive=None if before is None else before.archive,
            sha256=None if before is None else before.sha256,
        )
        self._first_steps, self._started_at = 0, 0.0
        self._kept_at = -float("inf")
        self._lock, self._over, self._superseded = Lock(), Event(), Event()
        self._beating = Thread(target=self._beat, daemon=True)

    def __enter__(self) -> Self:
        """Take the cell."""
        self._note()
        self._beating.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let go of it."""
        self._over.set()
        self._beating.join()

    def start(self) -> None:
        """The run is where it is trained; what follows is this attempt's own."""
        checkpoint = self._run.checkpoint
        self._first_steps = 0 if checkpoint is None else int(checkpoint.name)
        self._started_at = time.monotonic()

    def __call__(self, report: Report) -> None:
        """Follow the training.

        Raises:
            SupersededError: another attempt has the cell.
        """
        self._listener(report)
        if self._superseded.is_set():
            raise SupersededError
        now = time.monotonic()
        speed = (report.env_steps - self._first_steps) / (now - self._started_at)
        with self._lock:
            update = {"env_steps": report.env_steps, "steps_per_second": speed}
            self._state = self._state.model_copy(update=update)
            if not report.finished and now - self._kept_at >= self._job.upload_seconds:
                self._keep(now)

    def end(self, state: Literal["done", "failed"], error: str | None = None) -> None:
        """Note how it ended; a run that is done is handed in.

        Raises:
            SupersededError: another attempt has the cell.
        """
        self._over.set()
        self._beating.join()
        self._refuse_if_superseded()
        update = {"state": state, "error": error, "updated": time.time()}
        self._state = self._state.model_copy(update=update)
        if state == "done":
            self._store.hand_in(self._name, self._state)
        else:
            self._store.note(self._name, self._state)

    def _keep(self, now: float) -> None:
        """Keep the newest checkpoint for other machines, unless that has been done."""
        checkpoint = self._run.checkpoint
        if checkpoint is not None and checkpoint.name not in (self._state.archive or ""):
            self._refuse_if_superseded()
            self._state = self._store.keep(self._name, self._state)
            self._kept_at = now

    def _beat(self) -> None:
        """Give a sign of life now and then."""
        while not self._over.wait(stores.BEAT):
            with self._lock:
                try:
                    self._refuse_if_superseded()
                except SupersededError:
                    self._superseded.set()
                    return
                self._note()

    def _note(self) -> None:
        self._state = self._state.model_copy(update={"updated": time.time()})
        self._store.note(self._name, self._state)

    def _refuse_if_superseded(self) -> None:
        known = self._store.state(self._name)
        if known is not None and (known.grid, known.attempt) != (
            self._state.grid,
            self._state.attempt,
        ):
            raise SupersededError
