"""The tables of a comparison, in the order of SPL."""

from itertools import groupby
from operator import itemgetter

from rich.console import Console

from baselines.compare.summary import Comparison, Numbers
from baselines.compare.text_table import TextTable, shown

OF_FIELDS = (
    "C: centralised, one policy moves the team; D: decentralised, each robot its own. sees: all, a "
    "planner's assignment, or its own sight. pass: runs with 99 % success, with sampled and with "
    "mean actions. gap: makespan over the proved bound with mean actions, median of the runs that "
    "pass. SPL: bound / makespan of an episode, 0 for a failure, mean over sampled episodes and "
    "seeds with its 95 % interval. to pass: env-steps until the first evaluation that passes; runs "
    "that never do count with their whole budget. return: with sampled actions."
)
OF_AGGREGATES = (
    "As per field, but pass with the Wilson interval; gap, mean over fields; SPL, the "
    "interquartile mean of all runs with its stratified bootstrap interval; worst tenth: mean SPL "
    "of the lowest tenth of the runs."
)
OF_PAIRS = (
    "Difference of mean SPL over fields in points, with its interval by stratified bootstrap; p by "
    "permuting labels within each field, corrected by Holm over these pairs."
)
HEADINGS = ("algo", "sees", "C/D", "pass", "gap", "success")


def print_comparison(comparison: Comparison, console: Console) -> None:
    console.print(comparison.question)
    console.print(comparison.verdict, "\n")
    for title, table in (field_tables(comparison) | overall_tables(comparison)).items():
        table.print(title, console)
        console.print()


def field_tables(comparison: Comparison) -> dict[str, TextTable]:
    """Return a table for each field, by title; the first one says what columns mean."""
    headings = (*HEADINGS, "SPL", "makespan", "return", "to pass")
    tables: dict[str, TextTable] = {}
    for field, same in groupby(comparison.rows, key=itemgetter("field")):
        rows = list(same)
        steps = " or ".join(f"{steps:,}" for steps in sorted({row["env_steps"] for row in rows}))
        title = f"{field}: {steps} env-steps a run, {_counted(rows[0]['runs'], 'seed')} each"
        lines = [
            (
                *_begin(row, f"{row['passed']}/{row['runs']}"),
                f"{shown(row['spl'], '{:.1%}')}\n{_ends(row, 'spl')}",
                shown(row["deterministic_makespan"], "{:.1f}"),
                shown(row["return_mean"]),
                _to_pass(row),
            )
            for row in rows
        ]
        tables[title] = TextTable("" if tables else OF_FIELDS, headings, lines, words=2)
    return tables


def overall_tables(comparison: Comparison) -> dict[str, TextTable]:
    tables: dict[str, TextTable] = {}
    if comparison.aggregates:
        first = comparison.aggregates[0]
        seeds = _counted(first["runs"] // first["fields"], "seed")
        title = f"Over {_counted(first['fields'], 'field')}, {seeds} each"
        tables[title] = _aggregates(comparison)
    if comparison.pairs:
        known = [one["detectable"] for one in comparison.pairs if one["detectable"] is not None]
        caption = OF_PAIRS
        if known:
            least, most = 100 * min(known), 100 * max(known)
            caption += f" Shown in 80 % of such comparisons: {least:.1f} to {most:.1f} points."
        lines = [
            (
                *(one["better"], one["worse"], f"{100 * one['difference']:.1f}"),
                *(_ends(one, "difference"), f"{one['p_holm']:.2g}"),
            )
            for one in comparison.pairs
        ]
        headings = ("ahead", "behind", "points", "interval", "p (Holm)")
        tables["Differences of SPL"] = TextTable(caption, headings, lines, words=2)
    return tables


def _aggregates(comparison: Comparison) -> TextTable:
    left_out = ", ".join(comparison.fields_without_bound)
    caption = OF_AGGREGATES + (
        f" Left out, without a proved bound for all: {left_out}." if left_out else ""
    )
    headings = (*HEADINGS, "SPL\n(IQM)", "worst\ntenth", "return", "to pass")
    lines = [
        (
            *_begin(one, f"{one['passed']}/{one['runs']}\n{_ends(one, 'pass')}"),
            f"{one['iqm']:.1%}\n{_ends(one, 'iqm')}",
            f"{one['worst_tenth']:.1%}",
            shown(one["return_mean"]),
            _to_pass(one),
        )
        for one in comparison.aggregates
    ]
    return TextTable(caption, headings, lines, words=2)


def _begin(numbers: Numbers, passed: str) -> tuple[str, ...]:
    """Return the cells below ``HEADINGS``."""
    return (
        *(numbers["label"], numbers["information"], numbers["form"][0].upper(), passed),
        *(shown(numbers["gap"], "{:.1%}"), f"{numbers['success_rate']:.1%}"),
    )


def _to_pass(numbers: Numbers) -> str:
    never = numbers["never_passed"]
    return f"{numbers['env_steps_to_pass'] / 1000:,.0f}k" + (f"\n{never} never" if never else "")


def _ends(numbers: Numbers, name: str) -> str:
    low, high = numbers[f"{name}_low"], numbers[f"{name}_high"]
    return "-" if low is None or high is None else f"{100 * low:.1f}..{100 * high:.1f}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
