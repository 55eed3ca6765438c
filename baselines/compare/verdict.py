"""The result of a comparison in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baselines.algorithms import Algorithm, find_algorithm
from baselines.compare.records import Results, RunRecord
from baselines.evaluation.intervals import passes

CERTAIN, RESAMPLES = 0.05, 10_000


def verdict(results: Results) -> str:
    """Compare the best label of each form, or the two best of one form, in a sentence.

    More runs that pass are better; if as many do, fewer steps with sampled actions are. If one
    library has both forms, only its labels are compared: the library would be a second difference.
    """
    runs, seeds = len(results.fields) * results.seeds, results.seeds
    order = sorted(results.labels, key=lambda label: _rank(results.of_label(label)))
    if not any(map(_passed, map(results.of_label, order))):
        budget = f"{results.of_label(order[0])[0].evaluation['env_steps']:,} env-steps"
        return f"No run passes: the budget of {budget} is too small to compare."
    if len(order) == 1:
        return f"{_passed(results.of_label(order[0]))} of {runs} runs pass."
    order = _of_one_library(results, order)
    forms = {form_of(results, label): label for label in reversed(order)}
    first, second = sorted(forms.values(), key=order.index) if len(forms) == 2 else order[:2]
    ours, theirs = results.of_label(first), results.of_label(second)
    names = [f"{label} ({form_of(results, label)})" for label in (first, second)]
    passed = _passed(ours), _passed(theirs)
    if passed != (runs, runs):
        counts = f"{names[0]} passes in {passed[0]} of {runs} runs, {names[1]} in {passed[1]}"
        table = np.array([[number, runs - number] for number in passed])
        certain = stats.fisher_exact(table).pvalue < CERTAIN
        return f"{counts}{'' if certain else ': too few runs to tell them apart'}."
    if seeds == 1:
        return f"{names[0]} and {names[1]} pass; with one seed no order can be told."
    shape = len(results.fields), seeds
    steps = [np.reshape([_steps(run) for run in side], shape) for side in (theirs, ours)]
    low, high = difference_interval(*steps)
    given = f"{seeds} seeds" + (f", {shape[0]} fields" if shape[0] > 1 else "")
    if low <= 0.0 <= high:
        ends = f"{low:.1f} .. {high:.1f} steps, {given}"
        return f"{names[0]} and {names[1]} pass; no order can be told ({ends})."
    faster, slower = names if low > 0.0 else names[::-1]
    least, most = sorted((abs(low), abs(high)))
    return f"{faster} is faster than {slower} by {least:.1f} .. {most:.1f} steps, {given}."


def question(results: Results) -> str:
    sides: dict[str, list[str]] = {}
    for label in results.labels:
        sides.setdefault(form_of(results, label), []).append(label)
    forms = " or ".join(f"{form} ({', '.join(labels)})" for form, labels in sorted(sides.items()))
    steps = max(run.evaluation["env_steps"] for runs in results.cells.values() for run in runs)
    plural = "s" if results.seeds > 1 else ""
    where = f"{', '.join(results.fields)}, {steps:,} env-steps a run, {results.seeds} seed{plural}"
    return f"{forms[0].upper()}{forms[1:]} on {where} each?"


def difference_interval(
    ours: NDArray[np.float64], theirs: NDArray[np.float64]
) -> tuple[float, float]:
    """Bootstrap the mean of ``ours`` less that of ``theirs``, (fields, seeds) each."""
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, side.shape[1], (RESAMPLES, *side.shape)) for side in (ours, theirs)]
    means = [
        np.take_along_axis(side[None], drawn, axis=2).mean(axis=(1, 2))
        for side, drawn in zip((ours, theirs), draws, strict=True)
    ]
    low, high = np.percentile(means[0] - means[1], (2.5, 97.5))
    return float(low), float(high)


def form_of(results: Results, label: str) -> str:
    return _algorithm(results, label).form


def _of_one_library(results: Results, order: list[str]) -> list[str]:
    # Those of the first library that has both forms; without one, all labels.
    for first in order:
        package = _algorithm(results, first).package
        labels = [label for label in order if _algorithm(results, label).package == package]
        if len({form_of(results, label) for label in labels}) == 2:
            return labels
    return order


def _algorithm(results: Results, label: str) -> Algorithm:
    return find_algorithm(results.of_label(label)[0].config["algorithm"])


def _passed(runs: Sequence[RunRecord]) -> int:
    return sum(
        passes(run.evaluation["stochastic"], run.final("deterministic", "success_rate"))
        for run in runs
    )


def _steps(run: RunRecord) -> float:
    steps: float | None = run.evaluation["stochastic"]["makespan"]
    return np.inf if steps is None else steps


def _rank(runs: Sequence[RunRecord]) -> tuple[int, float]:
    return -_passed(runs), float(np.mean([_steps(run) for run in runs]))
