"""How a grid stands: counted, estimated, shown."""

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

from baselines.sweep.run import Grid, first_line
from baselines.sweep.spec import Cell
from baselines.sweep.store import State
from mbn_marl.errors import MbnError

Standing = Literal["done", "running", "failed", "waiting"]
STANDINGS: tuple[Standing, ...] = ("done", "running", "failed", "waiting")
SHOWN = 10
"""Running and failed cells that are named."""


@dataclass(frozen=True)
class CellStatus:
    """How a cell stands.

    Attributes:
        cell: it.
        standing: in a word; one that was interrupted waits.
        state: the last note about it.
    """

    cell: Cell
    standing: Standing
    state: State | None

    @property
    def env_steps(self) -> int:
        """Env-steps that count for its end."""
        if self.standing == "done":
            return self.cell.config.steps
        return 0 if self.state is None else min(self.state.env_steps, self.cell.config.steps)

    @property
    def speed(self) -> float | None:
        """Env-steps per second of its last attempt, if that says something."""
        return self.state.steps_per_second or None if self.state else None


@dataclass(frozen=True)
class Status:
    """How all cells of a grid stand."""

    cells: Sequence[CellStatus]

    @classmethod
    def of(cls, grid: Grid) -> Status:
        """Look at the store.

        Raises:
            RunError: a note there cannot be read.
        """
        states, finished = grid.store.states(), grid.store.finished(grid.names)

        def standing(name: str) -> Standing:
            state = states.get(name)
            if name in finished:
                return "done"
            if state is not None and state.alive:
                return "running"
            return "failed" if state is not None and state.state == "failed" else "waiting"

        return cls(
            [CellStatus(cell, standing(cell.name), states.get(cell.name)) for cell in grid.cells]
        )

    def count(self, standing: Standing) -> int:
        """How many stand so."""
        return sum(cell.standing == standing for cell in self.cells)

    def of_learner(self, learner: str) -> Status:
        """The part with one algorithm, setting and values of the other axes."""
        return Status([one for one in self.cells if one.cell.learner == learner])

    @property
    def learners(self) -> list[str]:
        """Their names, in order."""
        return list(dict.fromkeys(one.cell.learner for one in self.cells))

    def seconds_left(self) -> float | None:
        """Seconds until what is not done is, at the present number of runs at a time.

        Each learner's runs are taken to be as fast as those of it that are known, or else as those
        of all. ``None`` as long as nothing runs or no speed is known.
        """
        running = self.count("running")
        known = {
            learner: _median(one.speed for one in self.of_learner(learner).cells)
            for learner in self.learners
        }
        usual = _median(known.values())
        if not running or usual is None:
            return None
        work = 0.0
        for one in self.cells:
            if one.standing in ("running", "waiting"):
                speed = one.speed or known[one.cell.learner] or usual
                work += (one.cell.config.steps - one.env_steps) / speed
        return work / running


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def show(status: Status) -> RenderableType:
    """The status as a table, with the cells at work and those that failed below it."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("learner")
    for standing in STANDINGS:
        table.add_column(standing, justify="right")
    table.add_column("env-steps", justify="right")
    for learner in status.learners:
        table.add_row(escape(learner), *_numbers(status.of_learner(learner)))
    table.add_section()
    table.add_row("all", *_numbers(status))
    lines: list[RenderableType] = [table]
    left = status.seconds_left()
    if left is not None:
        lines.append(f"about {duration(left)} left, with {status.count('running')} at a time")
    lines += _named(status, "running", lambda one: f"{one.env_steps / one.cell.config.steps:.0%}")
    lines += _named(status, "failed", lambda one: first_line(one.state.error if one.state else ""))
    return Group(*lines)


def _numbers(status: Status) -> list[str]:
    steps = sum(one.env_steps for one in status.cells)
    budget = sum(one.cell.config.steps for one in status.cells)
    return [*(str(status.count(one)) for one in STANDINGS), f"{steps / budget:.0%}"]


def _named(status: Status, standing: Standing, words: Callable[[CellStatus], str]) -> Iterator[str]:
    """A line for each of the first cells that stand so."""
    cells = [one for one in status.cells if one.standing == standing]
    for one in cells[:SHOWN]:
        where = one.state.machine if one.state and standing == "running" else standing
        yield escape(f"{one.cell.name} ({where}): {words(one)}")
    if len(cells) > SHOWN:
        yield f"and {len(cells) - SHOWN} more {standing}"


def duration(seconds: float) -> str:
    """Seconds in the two units that say most."""
    minutes, hours, days = seconds / 60.0, seconds / 3600.0, seconds / 86_400.0
    if days >= 2.0:
        return f"{days:.1f} days"
    if hours >= 2.0:
        return f"{hours:.1f} h"
    return f"{minutes:.0f} min" if minutes >= 2.0 else f"{seconds:.0f} s"


@contextmanager
def live(grid: Grid, console: Console) -> Iterator[None]:
    """Show how a grid stands while the block runs, and at its end, if there is a terminal."""
    if not console.is_terminal:
        yield
        return
    over = Event()

    def follow(screen: Live) -> None:
        while not over.wait(grid.store.refresh):
            try:
                screen.update(show(Status.of(grid)), refresh=True)
            except (MbnError, OSError) as error:
                screen.update(f"the store cannot be read now: {error}", refresh=True)

    with Live(show(Status.of(grid)), console=console, auto_refresh=False) as screen:
        follower = Thread(target=follow, args=(screen,), daemon=True)
        follower.start()
        try:
            yield
        finally:
            over.set()
            follower.join()
            screen.update(show(Status.of(grid)), refresh=True)
