"""The progress of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from statistics import median
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
    """The progress of a run; one that was interrupted is waiting."""

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
        """Read the store; raise a RunError if a note there cannot be read."""
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
        """Return the status of each learner: algorithm, setting, values of the other axes."""
        parts: dict[str, list[RunStatus]] = {}
        for one in self.runs:
            parts.setdefault(one.run.shown_as, []).append(one)
        return {learner: Status(part) for learner, part in parts.items()}

    def seconds_left(self) -> float | None:
        """Return the seconds until all are done, with as many runs at a time as now.

        A run whose speed is unknown is as fast as the median of its learner's, or else of all
        learners'. ``None`` as long as nothing runs or no speed is known.
        """
        speeds = {
            name: median(found)
            for name, part in self.by_learner().items()
            if (found := [one.speed for one in part.runs if one.speed])
        }
        if not speeds or not (running := self.count("running")):
            return None
        usual = median(speeds.values())
        work = (
            (one.run.steps - one.env_steps) / (one.speed or speeds.get(one.run.shown_as, usual))
            for one in self.runs
            if one.standing in ("running", "waiting")
        )
        return sum(work) / running


def show(status: Status) -> RenderableType:
    """Return the status as a table, with the running and the failed runs below it."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("learner", *STANDINGS, "env-steps"):
        table.add_column(heading, justify="left" if heading == "learner" else "right")
    parts = status.by_learner()
    for learner, part in {**parts, "all": status}.items():
        share = sum(one.env_steps for one in part.runs) / sum(one.run.steps for one in part.runs)
        counts = (str(part.count(standing)) for standing in STANDINGS)
        table.add_row(escape(learner), *counts, f"{share:.0%}", end_section=learner == [*parts][-1])
    lines: list[RenderableType] = [table]
    left = status.seconds_left()
    if left is not None:
        lines.append(f"about {duration(left)} left, with {status.count('running')} at a time")
    for standing in ("running", "failed"):
        runs = [one for one in status.runs if one.standing == standing]
        for one in runs[:SHOWN]:
            note = one.note or Note(state="failed")
            words = (note.machine, f"{one.env_steps / one.run.steps:.0%}")
            where, how = words if standing == "running" else ("failed", first_line(note.error))
            lines.append(escape(f"{one.run.name} ({where}): {how}"))
        if len(runs) > SHOWN:
            lines.append(f"and {len(runs) - SHOWN} more {standing}")
    return Group(*lines)


def duration(seconds: float) -> str:
    """Return seconds in words, in the unit that fits."""
    for unit, form in ((86_400.0, "{:.1f} days"), (3600.0, "{:.1f} h"), (60.0, "{:.0f} min")):
        if seconds >= 2.0 * unit:
            return form.format(seconds / unit)
    return f"{seconds:.0f} s"


def live(sweep: Sweep, console: Console) -> AbstractContextManager[object]:
    """Return a context in which a terminal shows the progress of a grid."""

    def now() -> RenderableType:
        try:
            return show(Status.of(sweep))
        except (MbnError, OSError) as error:
            return f"the store cannot be read now: {error}"

    if not console.is_terminal:
        return nullcontext()
    often = 1.0 / sweep.store.refresh
    return Live(console=console, get_renderable=now, refresh_per_second=often)
