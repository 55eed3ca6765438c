"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console

from baselines.compare.summary import Comparison, Numbers
from baselines.compare.text_table import TextTable, shown

FORMS = "C: centralised, one policy moves the team; D: decentralised, each robot its own. "
OF_AGGREGATES = FORMS + (
    "Scores are true returns as shares of the field's proved optimum. pass: runs whose final "
    "return is 100 000 or more, with 99 % of the sampled episodes and all with mean actions "
    "successful. IQM: interquartile mean of all runs, with its 95 % interval by stratified "
    "bootstrap; gap: the optimality gap, how far runs fall short of 1 on average, with sampled and "
    "with mean actions; to 100k: as per field."
)
OF_IMPROVEMENT = (
    "How likely a run of the row has a higher return with sampled actions than a run of the column "
    "on the same field, mean over all fields; equal returns count half."
)
OF_FIELDS = FORMS + (
    "Fresh episodes with sampled actions, mean over seeds; the interval is the 95 % bootstrap over "
    "seeds. mean actions: the return without sampling. to 100k: until the first fresh evaluation "
    "at 100 000 or more, mean of the runs that got there (how many did)."
)


def print_comparison(comparison: Comparison, console: Console) -> None:
    console.print(comparison.question, markup=False)
    console.print(comparison.verdict, "\n", markup=False)
    for title, table in field_tables(comparison).items():
        replace(table, caption="").print(title, console)
    console.print(OF_FIELDS, "\n")
    for title, table in overall_tables(comparison).items():
        table.print(title, console)
        console.print()


def field_tables(comparison: Comparison) -> dict[str, TextTable]:
    """Return a table for each field, by title."""
    headings = (
        *("algo", "C/D", "return", "interval\n(x 1000)", "success", "make-\nspan"),
        *("of\nopti-\nmum", "mean\nactions", "steps to\n100k"),
    )
    tables = {}
    for field, rows in _by_field(comparison.rows).items():
        steps = " or ".join(f"{steps:,}" for steps in sorted({row["env_steps"] for row in rows}))
        title = f"{field}: {steps} env-steps a run, {_counted(rows[0]['seeds'], 'seed')} each"
        lines = [
            (
                row["label"],
                _letter(row),
                shown(row["return_mean"]),
                _ends(1000.0, row["return_low"], row["return_high"]),
                f"{row['success_rate']:.1%}",
                shown(row["makespan"], "{:.1f}"),
                shown(row["optimum_share"], "{:.1%}"),
                shown(row["deterministic_return"]),
                _steps_to_threshold(row, row["seeds"]),
            )
            for row in rows
        ]
        tables[title] = TextTable(OF_FIELDS, headings, lines)
    return tables


def overall_tables(comparison: Comparison) -> dict[str, TextTable]:
    tables = {}
    if comparison.aggregates:
        first = comparison.aggregates[0]
        fields, seeds = _counted(first["fields"], "field"), _counted(first["seeds"], "seed")
        tables[f"Over {fields}, {seeds} each"] = _aggregates(comparison)
    if len(comparison.looks) > 1:
        lines = [
            (ours, *(f"{than[one].value:.0%}" if one in than else "-" for one in comparison.looks))
            for ours, than in comparison.probability_of_improvement.items()
        ]
        table = TextTable(OF_IMPROVEMENT, ("", *comparison.looks), lines)
        tables["Probability of improvement"] = table
    return tables


def _by_field(rows: Sequence[Numbers]) -> dict[str, list[Numbers]]:
    fields = dict.fromkeys(row["field"] for row in rows)
    return {field: [row for row in rows if row["field"] == field] for field in fields}


def _aggregates(comparison: Comparison) -> TextTable:
    left_out = ", ".join(comparison.fields_without_proved_optimum)
    caption = OF_AGGREGATES + (
        f" Left out, without one proved optimum for all: {left_out}." if left_out else ""
    )
    headings = (
        *("algo", "C/D", "pass", "IQM", "interval", "gap", "gap,\nmean", "success"),
        *("steps to\n100k", "s to\n100k"),
    )
    lines = []
    for one in comparison.aggregates:
        runs = one["seeds"] * one["fields"]
        lines.append(
            (
                one["label"],
                _letter(one),
                f"{one['passed']}/{runs}",
                f"{one['iqm'].value:.1%}",
                _ends(0.01, *one["iqm"][1:]),
                f"{one['gap'].value:.2%}",
                f"{one['deterministic_gap'].value:.2%}",
                f"{one['success_rate']:.1%}",
                _steps_to_threshold(one, runs),
                shown(one["seconds_to_threshold"], "{:.1f}"),
            )
        )
    return TextTable(caption, headings, lines)


def _letter(numbers: Numbers) -> str:
    return str(numbers["form"])[0].upper()


def _steps_to_threshold(numbers: Numbers, runs: int) -> str:
    steps = numbers["env_steps_to_threshold"]
    thousands = shown(steps and steps / 1000.0, "{:,.0f}k")
    return f"{thousands} {numbers['reached']}/{runs}"


def _ends(unit: float, low: float | None, high: float | None) -> str:
    return "-" if low is None or high is None else f"{low / unit:.1f}..{high / unit:.1f}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
