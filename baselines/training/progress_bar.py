"""Progress of training runs, and its display on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


@dataclass(frozen=True)
class Report:
    """Where a run stands.

    Attributes:
        run: the name of the run.
        env_steps: env-steps taken; an env-step moves every robot of one world once.
        finished: whether the run has come to its end, of the budget or before.
        steps_per_second: env-steps per second of training, evaluations excluded.
        return_mean: mean true team return of the last fresh evaluation, if there was one.
        success_rate: share of its episodes that visited every ROI, in [0, 1].
        error: what is said of a run that broke down, ``None`` of any other.
    """

    run: str
    env_steps: int
    finished: bool
    steps_per_second: float
    return_mean: float | None
    success_rate: float | None
    error: str | None = None

    @classmethod
    def broken(cls, run: str, error: str) -> Self:
        """The last report of a run that broke down."""
        return cls(run, 0, False, 0.0, None, None, error)


Listener = Callable[[Report], None]


class ProgressDisplay:
    """One bar per run with return, success rate and speed; use as a context manager.

    On a terminal the bars are live. Elsewhere (a log file) each finished run prints one line.
    """

    def __init__(self, runs: Iterable[str], total: int, console: Console | None = None) -> None:
        console = console or Console()
        self._progress = Progress(
            TextColumn("{task.fields[run]}"),
            BarColumn(bar_width=10),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._total = total
        self._tasks: dict[str, TaskID] = {
            run: self._progress.add_task("", total=total, start=False, run=run, status="waiting")
            for run in runs
        }

    def __enter__(self) -> Self:
        """Start the display."""
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the display and leave its last state on the terminal."""
        self._progress.stop()

    def __call__(self, report: Report) -> None:
        """Show a report; that of a finished or broken run closes its bar."""
        task = self._tasks[report.run]
        self._progress.start_task(task)
        if report.error is not None:
            self._progress.update(task, status="broke down")
            self._progress.stop_task(task)
            self._progress.console.print(report.error, markup=False)
            return
        status = describe(report)
        self._progress.update(task, completed=min(report.env_steps, self._total), status=status)
        if report.finished:
            self._progress.stop_task(task)
            if not self._progress.console.is_terminal:
                self._progress.console.print(f"{report.run}: {report.env_steps:,} steps, {status}")


def print_finished(report: Report) -> None:
    """Print a line for a run that finished or broke down."""
    if report.error is not None:
        print(report.error)
    elif report.finished:
        print(f"{report.run}: {report.env_steps:,} steps, {describe(report)}", flush=True)


def describe(report: Report) -> str:
    """The state of a run in a few words."""
    speed = report.steps_per_second
    words = [f"{speed / 1000.0:3.0f}k/s" if speed >= 10_000.0 else f"{speed:4,.0f}/s"]
    if report.return_mean is not None and report.success_rate is not None:
        words.append(f"return {report.return_mean:>8,.0f} success {report.success_rate:4.0%}")
    return " ".join(words)
