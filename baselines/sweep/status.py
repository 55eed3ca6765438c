"""The progress of a grid: counted, estimated, shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median
from threading import Event, Thread
from typing import Literal

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from baselines.sweep.run import SHOWN, Sweep, first_line
from baselines.sweep.store import Note
from baselines.training.config import TrainConfig
from mbn_marl.errors import MbnError

Standing = Literal["done", "running", "failed", "waiting"]
STANDINGS: tuple[Standing, ...] = ("done", "running", "failed", "waiting")


@dataclass(frozen=True)
class RunStatus:
    """The progress of a run.

    Attributes:
        run: what is trained.
        standing: in a word; one that was interrupted waits.
        note: the last note about it.
    """

    run: TrainConfig
    standing: Standing
    note: Note | None

    @property
    def env_steps(self) -> int:
        """Env-steps that count towards its end."""
        if self.standing == "done":
            return self.run.steps
        return 0 if self.note is None else min(self.note.env_steps, self.run.steps)

    @property
    def speed(self) -> float | None:
        """Env-steps per second of its last attempt, if they are known."""
        return self.note.steps_per_second or None if self.note else None


@dataclass(frozen=True)
class Status:
    """The progress of all runs of a grid."""

    runs: Sequence[RunStatus]

    @classmethod
    def of(cls, sweep: Sweep) -> Status:
        """Look at the store.

        Raises:
            RunError: a note there cannot be read.
        """
        notes, finished = sweep.store.notes(), sweep.store.finished(sweep.names)

        def standing(name: str) -> Standing:
            note = notes.get(name)
            if name in finished:
                return "done"
            if note is not None and note.alive:
                return "running"
            return "failed" if note is not None and note.error is not None else "waiting"

        return cls([RunStatus(run, standing(run.name), notes.get(run.name)) for run in sweep.runs])

    def count(self, standing: Standing) -> int:
        """Return how many stand so."""
        return sum(one.standing == standing for one in self.runs)

    def by_learner(self) -> dict[str, Status]:
        """Return the parts with one algorithm, setting and values of the other axes."""
        parts: dict[str, list[RunStatus]] = {}
        for one in self.runs:
            parts.setdefault(one.run.shown_as, []).append(one)
        return {learner: Status(part) for learner, part in parts.items()}

    def seconds_left(self) -> float | None:
        """Return the seconds until all are done, at the present number of runs at a time.

        Each learner's runs are taken to be as fast as those of it that are known, or else as those
        of all. ``None`` as long as nothing runs or no speed is known.
        """
        running = self.count("running")
        parts = self.by_learner()
        known = {name: _median(one.speed for one in part.runs) for name, part in parts.items()}
        usual = _median(known.values())
        if not running or usual is None:
            return None
        work = 0.0
        for one in self.runs:
            if one.standing in ("running", "waiting"):
                speed = one.speed or known[one.run.shown_as] or usual
                work += (one.run.steps - one.env_steps) / speed
        return work / running


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def show(status: Status) -> RenderableType:
    """Return the status as a table, with the running and the failed runs below it."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("learner")
    for standing in STANDINGS:
        table.add_column(standing, justify="right")
    table.add_column("env-steps", justify="right")
    for learner, part in status.by_learner().items():
        table.add_row(escape(learner), *_numbers(part))
    table.add_section()
    table.add_row("all", *_numbers(status))
    lines: list[RenderableType] = [table]
    left = status.seconds_left()
    if left is not None:
        lines.append(f"about {duration(left)} left, with {status.count('running')} at a time")
    lines += _named(status, "running", lambda one: f"{one.env_steps / one.run.steps:.0%}")
    lines += _named(status, "failed", lambda one: first_line(one.note.error if one.note else ""))
    return Group(*lines)


def _numbers(status: Status) -> list[str]:
    steps = sum(one.env_steps for one in status.runs)
    budget = sum(one.run.steps for one in status.runs)
    return [*(str(status.count(one)) for one in STANDINGS), f"{steps / budget:.0%}"]


def _named(status: Status, standing: Standing, words: Callable[[RunStatus], str]) -> Iterator[str]:
    """Make a line for each of the first runs that stand so."""
    runs = [one for one in status.runs if one.standing == standing]
    for one in runs[:SHOWN]:
        where = one.note.machine if one.note and standing == "running" else standing
        yield escape(f"{one.run.name} ({where}): {words(one)}")
    if len(runs) > SHOWN:
        yield f"and {len(runs) - SHOWN} more {standing}"


def duration(seconds: float) -> str:
    """Return seconds in words, in the unit that fits."""
    minutes, hours, days = seconds / 60.0, seconds / 3600.0, seconds / 86_400.0
    if days >= 2.0:
        return f"{days:.1f} days"
    if hours >= 2.0:
        return f"{hours:.1f} h"
    return f"{minutes:.0f} min" if minutes >= 2.0 else f"{seconds:.0f} s"


@contextmanager
def live(sweep: Sweep, console: Console) -> Iterator[None]:
    """Show how a grid stands while the block runs, and at its end, on a terminal."""
    if not console.is_terminal:
        yield
        return
    over = Event()

    def follow(screen: Live) -> None:
        while not over.wait(sweep.store.refresh):
            try:
                screen.update(show(Status.of(sweep)), refresh=True)
            except (MbnError, OSError) as error:
                screen.update(f"the store cannot be read now: {error}", refresh=True)

    with Live(show(Status.of(sweep)), console=console, auto_refresh=False) as screen:
        follower = Thread(target=follow, args=(screen,), daemon=True)
        follower.start()
        try:
            yield
        finally:
            over.set()
            follower.join()
            screen.update(show(Status.of(sweep)), refresh=True)
