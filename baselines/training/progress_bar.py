"""Progress of training runs, and its display on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column

from baselines.console import console


@dataclass(frozen=True)
class Report:
    """The progress of a run.

    Attributes:
        run: the name of the run.
        env_steps: env-steps taken.
        finished: whether the run has come to its end, of the budget or before.
        steps_per_second: env-steps per second of training, evaluations excluded.
        return_mean: mean true team return of the last fresh evaluation, if there was one.
        success_rate: share of its episodes that visited every ROI, in [0, 1].
        error: why the run failed; ``None`` as long as it has not.
    """

    run: str
    env_steps: int = 0
    finished: bool = False
    steps_per_second: float = 0.0
    return_mean: float | None = None
    success_rate: float | None = None
    error: str | None = None

    @property
    def speed(self) -> str:
        """The speed, in a few columns."""
        speed = self.steps_per_second
        return f"{speed / 1000.0:3.0f}k/s" if speed >= 10_000.0 else f"{speed:4,.0f}/s"

    @property
    def result(self) -> str:
        """The last evaluation in words; empty without one."""
        if self.return_mean is None or self.success_rate is None:
            return ""
        return f"return {self.return_mean:>8,.0f} success {self.success_rate:4.0%}"


Listener = Callable[[Report], None]


@contextmanager
def progress_bars(runs: Iterable[str], total: int) -> Iterator[Listener]:
    """Show one bar per run with speed, return and success rate; yield what receives the reports.

    On a terminal the bars are live. Elsewhere (a log file) each finished run prints one line.
    """
    run = TextColumn("{task.fields[run]}", table_column=Column(overflow="fold"))
    bar, share = BarColumn(bar_width=10), TextColumn("{task.percentage:>3.0f}%")
    speed, result = TextColumn("{task.fields[speed]}"), TextColumn("{task.fields[result]}")
    elapsed = TimeElapsedColumn()
    screen = console()
    columns = (run, bar, share, speed, result, elapsed)
    with Progress(*columns, console=screen, disable=not screen.is_terminal) as progress:
        tasks = {
            name: progress.add_task("", False, total, run=name, speed="", result="waiting")
            for name in runs
        }

        def show(report: Report) -> None:
            task = tasks[report.run]
            progress.start_task(task)
            if report.error is not None:
                progress.update(task, result="failed")
            else:
                done = min(report.env_steps, total)
                progress.update(task, completed=done, speed=report.speed, result=report.result)
            if report.finished or report.error is not None:
                progress.stop_task(task)
            if report.error is not None or not screen.is_terminal:
                print_finished(report)

        yield show


def print_finished(report: Report) -> None:
    """Print a line for a run that finished or failed."""
    if report.error is not None:
        print(report.error, flush=True)
    elif report.finished:
        steps = f"{report.run}: {report.env_steps:,} steps"
        print(f"{steps}, {report.speed} {report.result}".rstrip(), flush=True)
