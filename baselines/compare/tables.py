"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from baselines.compare.aggregate import Estimate
from baselines.compare.summary import Aggregate, Comparison, FieldOutcome, Outcome
from baselines.compare.text_table import TextTable

UNKNOWN = "-"
THRESHOLD = ("steps to\n100k", "s to\n100k")
OF_AGGREGATES = (
    "Scores are true returns as shares of the field's proved optimum. IQM: interquartile mean of "
    "all runs, with its 95 % interval by stratified bootstrap; gap: the optimality gap, how far "
    "runs fall short of 1 on average, with sampled and with mean actions; to 100k: as per field."
)
OF_IMPROVEMENT = (
    "How likely a run of the row has a higher return with sampled actions than a run of the column "
    "on the same field, mean over all fields; equal returns count half."
)
OF_FIELDS = (
    "Fresh episodes with sampled actions, mean over seeds; the interval is the 95 % bootstrap over "
    "seeds. mean actions: the return without sampling. to 100k: until the first fresh evaluation "
    "at 100 000 or more, mean of the runs that got there (how many did); seconds are of training "
    "alone."
)
OF_GAPS = (
    "How far the mean return with sampled actions falls short of the proved optimum, with its 95 % "
    "bootstrap interval over seeds."
)


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print every table, and below it what its columns mean."""
    per_field = field_tables(comparison)
    for title, table in per_field.items():
        console.print(table.rich(title))
    console.print(OF_FIELDS, "\n")
    for title, table in overall_tables(comparison).items():
        console.print(table.rich(title))
        console.print(table.caption, "\n")


def overall_tables(comparison: Comparison) -> dict[str, TextTable]:
    """Tables over all fields, by title."""
    tables = {}
    if comparison.aggregates:
        first = comparison.aggregates[0]
        title = f"Over {_counted(first.fields, 'field')}, {_counted(first.seeds, 'seed')} each"
        tables[title] = _aggregates(comparison)
    if len(comparison.looks) > 1:
        tables["Probability of improvement"] = _improvement(comparison)
    return tables


def field_tables(comparison: Comparison) -> dict[str, TextTable]:
    """A table for each field, by title, which begins with the field's name and a colon."""
    tables = {}
    for field in dict.fromkeys(row.field for row in comparison.rows):
        rows = [row for row in comparison.rows if row.field == field]
        steps = " or ".join(f"{steps:,}" for steps in sorted({row.env_steps for row in rows}))
        seeds = _counted(rows[0].seeds, "seed")
        tables[f"{field}: {steps} env-steps a run, {seeds} each"] = _field(rows)
    return tables


def gaps(comparison: Comparison) -> TextTable:
    """How far each label falls short of the proved optimum on each field."""
    lines = tuple(
        (field, *(_gap(row) for row in comparison.rows if row.field == field))
        for field in dict.fromkeys(row.field for row in comparison.rows if row.optimum is not None)
    )
    return TextTable(OF_GAPS, ("field", *comparison.looks), lines)


def _aggregates(comparison: Comparison) -> TextTable:
    left_out = ", ".join(comparison.unproved)
    caption = OF_AGGREGATES + (
        f" Left out, with no proved optimum: {left_out}." if left_out else ""
    )
    headings = ("algo", "IQM", "interval", "gap", "gap, mean\nactions", "success", *THRESHOLD)
    return TextTable(caption, headings, tuple(map(_aggregate_line, comparison.aggregates)))


def _aggregate_line(aggregate: Aggregate) -> tuple[str, ...]:
    return (
        aggregate.label,
        f"{aggregate.iqm.value:.1%}",
        _ends(aggregate.iqm, 0.01),
        f"{aggregate.gap.value:.2%}",
        f"{aggregate.deterministic_gap.value:.2%}",
        f"{aggregate.success_rate:.1%}",
        *_threshold(aggregate, aggregate.seeds * aggregate.fields),
    )


def _improvement(comparison: Comparison) -> TextTable:
    labels = tuple(comparison.looks)

    def cell(ours: str, theirs: str) -> str:
        return UNKNOWN if ours == theirs else f"{comparison.improvement[ours][theirs].value:.0%}"

    lines = tuple((ours, *(cell(ours, theirs) for theirs in labels)) for ours in labels)
    return TextTable(OF_IMPROVEMENT, ("", *labels), lines)


def _field(rows: Sequence[FieldOutcome]) -> TextTable:
    headings = (
        *("algo", "return", "interval\n(x 1000)", "success", "make-\nspan", "of\noptimum"),
        *("mean\nactions", *THRESHOLD),
    )
    return TextTable(OF_FIELDS, headings, tuple(map(_row_line, rows)))


def _row_line(row: FieldOutcome) -> tuple[str, ...]:
    return (
        row.label,
        f"{row.return_mean:,.0f}",
        _ends(Estimate(row.return_mean, row.return_low, row.return_high), 1000.0),
        f"{row.success_rate:.1%}",
        _shown(row.makespan, "{:.1f}"),
        _shown(row.optimum_share, "{:.1%}"),
        f"{row.deterministic_return:,.0f}",
        *_threshold(row, row.seeds),
    )


def _gap(row: FieldOutcome) -> str:
    def short(value: float) -> float:
        assert row.optimum is not None  # all labels of a field have the same
        return 100.0 * (1.0 - value / row.optimum)

    gap = f"{short(row.return_mean):.2f}%"
    if row.return_low is None or row.return_high is None:
        return gap
    return f"{gap} ({short(row.return_high):.2f}..{short(row.return_low):.2f})"


def _threshold(outcome: Outcome, runs: int) -> tuple[str, str]:
    """Env-steps and seconds to the threshold, and how many of ``runs`` got there."""
    steps = outcome.env_steps_to_threshold
    shown = UNKNOWN if steps is None else f"{steps / 1000.0:,.0f}k"
    return f"{shown} {outcome.reached}/{runs}", _shown(outcome.seconds_to_threshold, "{:.1f}")


def _ends(estimate: Estimate, unit: float, digits: int = 1) -> str:
    """The interval in units of ``unit``."""
    if estimate.low is None or estimate.high is None:
        return UNKNOWN
    return f"{estimate.low / unit:.{digits}f}..{estimate.high / unit:.{digits}f}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _shown(value: float | None, form: str) -> str:
    return UNKNOWN if value is None else form.format(value)
