"""A comparison as tables, on a terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console, JustifyMethod
from rich.table import Table

from baselines.compare.aggregate import Estimate
from baselines.compare.summary import Aggregate, Comparison, Row, Summary
from baselines.compare.text_table import Grid

UNKNOWN = "-"


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print every table, 80 columns wide for a few labels, with what its columns mean below."""
    per_field, overall = field_grids(comparison), overall_grids(comparison)
    for title, grid in per_field.items():
        console.print(rich_table(title, grid))
    console.print(next(iter(per_field.values())).caption, "\n")
    for title, grid in overall.items():
        console.print(rich_table(title, grid))
        console.print(grid.caption, "\n")


def markdown(title: str, grid: Grid, level: int = 2) -> str:
    """A table as a section of a page."""
    headings = tuple(word.replace("-\n", "").replace("\n", " ") for word in grid.headings)
    return f"{'#' * level} {title}\n\n{replace(grid, headings=headings).markdown()}"


def overall_grids(comparison: Comparison) -> dict[str, Grid]:
    """Tables over all fields, by title."""
    grids = {}
    if comparison.aggregates:
        first = comparison.aggregates[0]
        title = f"Over {_counted(first.fields, 'field')}, {_counted(first.seeds, 'seed')} each"
        grids[title] = _aggregates(comparison)
    if len(comparison.improvement) > 1:
        grids["Probability of improvement"] = _improvement(comparison)
    return grids


def field_grids(comparison: Comparison) -> dict[str, Grid]:
    """A table for each field, by title."""
    rows: dict[str, list[Row]] = {}
    for row in comparison.rows:
        rows.setdefault(row.field, []).append(row)
    return {_title(group): _rows(group) for group in rows.values()}


def _aggregates(comparison: Comparison) -> Grid:
    left_out = ", ".join(comparison.unproved)
    caption = (
        "Scores are true returns as shares of the field's proved optimum. IQM: interquartile mean "
        "of all runs, with its 95 % interval by stratified bootstrap; gap: the optimality gap, how "
        "far runs fall short of 1 on average, with sampled and with mean actions; to 100k: as per "
        "field." + (f" Left out, with no proved optimum: {left_out}." if left_out else "")
    )
    headings = (
        "algo",
        "IQM",
        "interval",
        "gap",
        "gap, mean\nactions",
        "success",
        "steps to\n100k",
        "s to\n100k",
    )
    return Grid(caption, headings, tuple(map(_aggregate_line, comparison.aggregates)))


def _aggregate_line(aggregate: Aggregate) -> tuple[str, ...]:
    return (
        aggregate.label,
        f"{aggregate.iqm.value:.1%}",
        _interval(aggregate.iqm),
        f"{aggregate.gap.value:.2%}",
        f"{aggregate.deterministic_gap.value:.2%}",
        f"{aggregate.success_rate:.1%}",
        *_threshold(aggregate, aggregate.seeds * aggregate.fields),
    )


def _improvement(comparison: Comparison) -> Grid:
    labels = tuple(comparison.improvement)

    def cell(ours: str, theirs: str) -> str:
        return UNKNOWN if ours == theirs else f"{comparison.improvement[ours][theirs].value:.0%}"

    caption = (
        "How likely a run of the row has a higher return with sampled actions than a run of the "
        "column on the same field, mean over all fields; equal returns count half."
    )
    lines = tuple((ours, *(cell(ours, theirs) for theirs in labels)) for ours in labels)
    return Grid(caption, ("", *labels), lines)


def _rows(rows: Sequence[Row]) -> Grid:
    caption = (
        "Fresh episodes with sampled actions, mean over seeds; the interval is the 95 % bootstrap "
        "over seeds. mean actions: the return without sampling. to 100k: until the first fresh "
        "evaluation at 100 000 or more, mean of the runs that got there (how many did); seconds "
        "are of training alone."
    )
    headings = (
        "algo",
        "return",
        "interval\n(x 1000)",
        "success",
        "make-\nspan",
        "of\noptimum",
        "mean\nactions",
        "steps to\n100k",
        "s to\n100k",
    )
    return Grid(caption, headings, tuple(map(_row_line, rows)))


def _row_line(row: Row) -> tuple[str, ...]:
    return (
        row.label,
        f"{row.return_mean:,.0f}",
        _thousands(row.return_low, row.return_high),
        f"{row.success_rate:.1%}",
        _shown(row.makespan, "{:.1f}"),
        _shown(row.optimum_share, "{:.1%}"),
        f"{row.deterministic_return:,.0f}",
        *_threshold(row, row.seeds),
    )


def _threshold(summary: Summary, runs: int) -> tuple[str, str]:
    """Env-steps and seconds to the threshold, and how many of ``runs`` got there."""
    steps = summary.env_steps_to_threshold
    shown = UNKNOWN if steps is None else f"{steps / 1000.0:,.0f}k"
    return f"{shown} {summary.reached}/{runs}", _shown(summary.seconds_to_threshold, "{:.1f}")


def _thousands(low: float | None, high: float | None) -> str:
    return UNKNOWN if low is None or high is None else f"{low / 1000.0:.1f}..{high / 1000.0:.1f}"


def _interval(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return UNKNOWN
    return f"{100.0 * estimate.low:.1f}..{100.0 * estimate.high:.1f}"


def _title(rows: Sequence[Row]) -> str:
    steps = " or ".join(f"{steps:,}" for steps in sorted({row.env_steps for row in rows}))
    return f"{rows[0].field}: {steps} env-steps a run, {_counted(rows[0].seeds, 'seed')} each"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _shown(value: float | None, form: str) -> str:
    return UNKNOWN if value is None else form.format(value)


def rich_table(title: str, grid: Grid) -> Table:
    """A table for a terminal."""
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for index, heading in enumerate(grid.headings):
        side: JustifyMethod = "left" if index < grid.words else "right"
        table.add_column(heading, justify=side, overflow="fold")
    for line in grid.lines:
        table.add_row(*line)
    return table
