"""How a study is shown on a terminal."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from baselines.tuning.trial import News


class TuneDisplay:
    """One bar for the study, and a line for every trial that ended; use as a context manager.

    Args:
        trials: how many trials there are to be.
        ended: how many have ended before.
        steps: env-steps of a trial.
        console: where; by default standard output.
    """

    def __init__(self, trials: int, ended: int, steps: int, console: Console | None = None) -> None:
        console = console or Console()
        self._progress = Progress(
            TextColumn("trials"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[running]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._steps = steps
        self._running: dict[int, str] = {}
        self._task = self._progress.add_task("", total=trials, completed=ended, running="")

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

    def __call__(self, news: News) -> None:
        """Show the news of a trial."""
        reward = "" if news.return_mean is None else f", return {news.return_mean:,.0f}"
        if news.state == "running":
            share = min(news.env_steps / self._steps, 1.0)
            self._running[news.number] = f"{news.number}: {share:.0%}{reward}"
        else:
            self._running.pop(news.number, None)
            self._progress.advance(self._task)
            values = " ".join(f"{name}={value:.4g}" for name, value in news.values.items())
            self._progress.console.print(
                f"trial {news.number}: {news.state} at {news.env_steps:,}{reward}; {values}",
                highlight=False,
                soft_wrap=True,
            )
        self._progress.update(self._task, running=" | ".join(self._running.values()))
