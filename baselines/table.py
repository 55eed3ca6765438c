"""The comparison table: what the runs recorded, summarised over seeds."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from baselines.algorithms import find_algorithm
from baselines.optimum import optimal_return
from baselines.runs import RunFolder
from baselines.statistics import mean_interval, mean_of_known, reach
from baselines.storage import write_json, write_text
from mbn_marl.config import make_config


@dataclass(frozen=True)
class Row:
    """One algorithm on one field, over seeds.

    Attributes:
        algorithm: its name.
        form: ``"centralized"`` or ``"decentralized"``.
        field: the field's name.
        seeds: number of runs.
        env_steps: env-steps of a run.
        return_mean: mean over seeds of the mean true team return of the final stochastic episodes.
        return_low: lower end of its 95 % bootstrap interval; ``None`` for one seed.
        return_high: upper end.
        success_rate: share of those episodes that visited every ROI.
        makespan: mean length of the successful ones, in steps.
        optimum: the proved best return, or ``None`` if there is no proof.
        optimum_share: ``return_mean / optimum``.
        deterministic_return: mean over seeds of the return with mean actions.
        reached: runs with a fresh evaluation at 100 000 or more.
        env_steps_to_threshold: mean env-steps of the first such evaluation, of those runs.
        seconds_to_threshold: mean training seconds of it, evaluations excluded.
        seconds: mean training seconds of a whole run, evaluations excluded.
    """

    algorithm: str
    form: str
    field: str
    seeds: int
    env_steps: int
    return_mean: float
    return_low: float | None
    return_high: float | None
    success_rate: float
    makespan: float | None
    optimum: float | None
    optimum_share: float | None
    deterministic_return: float
    reached: int
    env_steps_to_threshold: float | None
    seconds_to_threshold: float | None
    seconds: float


def summarise(runs: Sequence[RunFolder]) -> Row:
    """Summarise the finished runs of one algorithm on one field, one run per seed.

    Raises:
        RunError: a run is not finished.
    """
    config = runs[0].config
    finals = [run.evaluation for run in runs]
    stochastic = [final["stochastic"] for final in finals]
    returns = mean_interval([entry["return_mean"] for entry in stochastic])
    hits = reach([run.evaluations for run in runs])
    field = runs[0].field
    optimum = optimal_return(field, make_config(config["environment"]))
    return Row(
        algorithm=config["algorithm"],
        form=find_algorithm(config["algorithm"]).form,
        field=field.name,
        seeds=len(runs),
        env_steps=finals[0]["env_steps"],
        return_mean=returns.mean,
        return_low=returns.low,
        return_high=returns.high,
        success_rate=mean_interval([entry["success_rate"] for entry in stochastic]).mean,
        makespan=mean_of_known(entry["makespan"] for entry in stochastic),
        optimum=optimum,
        optimum_share=None if optimum is None else returns.mean / optimum,
        deterministic_return=mean_interval(
            [final["deterministic"]["return_mean"] for final in finals]
        ).mean,
        reached=hits.reached,
        env_steps_to_threshold=hits.env_steps,
        seconds_to_threshold=hits.seconds,
        seconds=mean_interval([final["seconds"] for final in finals]).mean,
    )


def write_table(rows: Sequence[Row], folder: Path) -> None:
    """Write ``table.csv`` and ``table.json`` into ``folder``; an unknown value is empty or null."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_text(folder / "table.csv", text.getvalue())
    write_json(folder / "table.json", [asdict(row) for row in rows])


def print_table(rows: Sequence[Row], console: Console) -> None:
    """Print a table per field, 80 columns wide, with what the columns mean below."""
    for _, group in itertools.groupby(rows, key=lambda row: row.field):
        console.print(_table_of_field(list(group)))
    console.print(
        "Fresh episodes with sampled actions, mean over seeds; the interval is the 95 % bootstrap "
        "over seeds. mean actions: the return without sampling. to 100k: until the first fresh "
        "evaluation at 100 000 or more, mean of the runs that got there (how many did); seconds "
        "are of training alone."
    )


def _table_of_field(rows: Sequence[Row]) -> Table:
    table = Table(title=_title(rows), box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("algo")
    for heading in (
        "return",
        "interval\n(x 1000)",
        "success",
        "make-\nspan",
        "of\noptimum",
        "mean\nactions",
        "steps to\n100k",
        "s to\n100k",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            row.algorithm,
            f"{row.return_mean:,.0f}",
            _interval(row),
            f"{row.success_rate:.1%}",
            _shown(row.makespan, "{:.1f}"),
            _shown(row.optimum_share, "{:.1%}"),
            f"{row.deterministic_return:,.0f}",
            f"{_thousands(row.env_steps_to_threshold)} {row.reached}/{row.seeds}",
            _shown(row.seconds_to_threshold, "{:.1f}"),
        )
    return table


def _interval(row: Row) -> str:
    """The interval in thousands."""
    if row.return_low is None or row.return_high is None:
        return "-"
    return f"{row.return_low / 1000.0:.1f}..{row.return_high / 1000.0:.1f}"


def _thousands(value: float | None) -> str:
    return "-" if value is None else f"{value / 1000.0:,.0f}k"


def _title(rows: Sequence[Row]) -> str:
    budgets = sorted({row.env_steps for row in rows})
    seeds = sorted({row.seeds for row in rows})
    return (
        f"{rows[0].field}: {' / '.join(f'{steps:,}' for steps in budgets)} env-steps a run, "
        f"{' / '.join(map(str, seeds))} seeds each"
    )


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
