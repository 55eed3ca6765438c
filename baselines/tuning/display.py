"""The progress of a study on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Column

from baselines.tuning.trial import News


@contextmanager
def tune_display(
    trials: int, ended: int, steps: int, console: Console
) -> Iterator[Callable[[News], None]]:
    """Show a bar for a study of so many trials, some of them ``ended``, of ``steps`` each."""
    running: dict[int, str] = {}
    bar, elapsed = BarColumn(bar_width=20), TimeElapsedColumn()
    words = TextColumn("{task.fields[running]}", table_column=Column(overflow="fold"))
    columns = (TextColumn("trials"), bar, MofNCompleteColumn(), words, elapsed)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=trials, completed=ended, running="")

        def show(news: News) -> None:
            reward = "" if news.return_mean is None else f", return {news.return_mean:,.0f}"
            if news.state == "running":
                share = min(news.env_steps / steps, 1.0)
                running[news.number] = f"{news.number}: {share:.0%}{reward}"
            else:
                running.pop(news.number, None)
                progress.advance(task)
                values = " ".join(f"{name}={value:.4g}" for name, value in news.values.items())
                console.print(
                    f"trial {news.number}: {news.state} at {news.env_steps:,}{reward}; {values}",
                    highlight=False,
                    soft_wrap=True,
                )
            progress.update(task, running=" | ".join(running.values()))

        yield show
