"""The numbers of a comparison, statistics over seeds and over fields, and its result in words.

Those over fields are what Agarwal et al. (NeurIPS 2021) recommend. Scores are arrays (fields,
seeds), a run each. Every interval is the 95 % percentile bootstrap, stratified: each resample
draws, within every field, as many runs as there are, with replacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas
from numpy.typing import NDArray
from scipy import stats

from baselines.algorithms import Algorithm, find_algorithm
from baselines.compare.records import Results, RunRecord
from baselines.compare.text_table import csv_text
from baselines.evaluation.intervals import RETURN_THRESHOLD, mean_interval, mean_of_known, passes

RESAMPLES, CERTAIN = 10_000, 0.05
ENDS = (2.5, 97.5)
THRESHOLDS = np.concatenate([np.arange(90) / 100, np.arange(900, 1001) / 1000])

FloatArray = NDArray[np.float64]


class Estimate(NamedTuple):
    """A statistic and its interval; one seed a field gives no interval."""

    value: float
    low: float | None
    high: float | None


class Profile(NamedTuple):
    """The share of runs above each threshold and its band (k,); one seed gives it no width."""

    share: FloatArray
    low: FloatArray
    high: FloatArray


def interquartile_mean(scores: FloatArray) -> Estimate:
    """The mean of the middle half of all runs: a quarter, rounded down, is cut at both ends."""
    return _estimate(scores, lambda runs: stats.trim_mean(runs, 0.25, axis=-1))


def optimality_gap(scores: FloatArray) -> Estimate:
    """By how much runs fall short of a score of 1, on average; 0 if none does."""
    return _estimate(scores, lambda runs: np.maximum(1.0 - runs, 0.0).mean(axis=-1))


def probability_of_improvement(ours: FloatArray, theirs: FloatArray) -> Estimate:
    """The chance that a run of ``ours`` scores more than one of ``theirs``, mean over fields.

    Equal scores count half, so that the two directions sum to 1.
    """
    wins = np.where(ours[:, :, None] == theirs[:, None, :], 0.5, ours[:, :, None] > theirs[:, None])
    if max(ours.shape[1], theirs.shape[1]) == 1:
        return Estimate(float(wins.mean()), None, None)
    rng = np.random.default_rng(0)
    our_shares, their_shares = (_shares(scores.shape, rng) for scores in (ours, theirs))
    resampled = np.einsum("rfi,fij,rfj->r", our_shares, wins, their_shares, optimize=True)
    return Estimate(float(wins.mean()), *np.percentile(resampled / len(wins), ENDS).tolist())


def performance_profile(scores: FloatArray, thresholds: FloatArray) -> Profile:
    """The share of runs that score more than each of ``thresholds`` (k,), with a pointwise band."""
    above = (scores[..., None] > thresholds).reshape(-1, thresholds.size)
    shares = _shares(scores.shape, np.random.default_rng(0)).reshape(RESAMPLES, -1)
    low, high = np.percentile(shares @ above / scores.shape[0], ENDS, axis=0)
    return Profile(above.mean(axis=0), low, high)


def _estimate(scores: FloatArray, statistic: Callable[[FloatArray], Any]) -> Estimate:
    value = float(statistic(scores.ravel()))
    if scores.shape[1] == 1:
        return Estimate(value, None, None)
    drawn = np.random.default_rng(0).integers(0, scores.shape[1], (RESAMPLES, *scores.shape))
    resampled = np.take_along_axis(scores[None], drawn, axis=2).reshape(RESAMPLES, -1)
    return Estimate(value, *np.percentile(statistic(resampled), ENDS).tolist())


def _shares(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    # The count of each run in each resample, as a share of its field's: (resamples, *shape).
    drawn = rng.integers(0, shape[1], (RESAMPLES, *shape))
    return np.stack([(drawn == seed).mean(axis=2) for seed in range(shape[1])], axis=2)


Numbers = Mapping[str, Any]
"""A label's numbers by name; ``None`` is unknown."""


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found; of rows and aggregates see ``_row``, ``_aggregate``."""

    question: str
    verdict: str
    looks: Mapping[str, int]  # the labels in order, with the numbers of their looks in figures
    rows: Sequence[Numbers]  # every label on every field, field by field
    aggregates: Sequence[Numbers]  # every label over the fields with a proved optimum
    # The chance that a run of the first label has a higher return with sampled actions than one of
    # the second on the same field, over all fields.
    probability_of_improvement: Mapping[str, Mapping[str, Estimate]]
    fields_without_proved_optimum: Sequence[str]  # the aggregates leave them out
    broken_runs: Mapping[str, str]  # the error of each that diverged; its label is left out

    def to_json(self) -> dict[str, Any]:
        values = {name: value for name, value in vars(self).items() if name != "looks"}
        plain: dict[str, Any] = _plain({**values, "profile_thresholds": THRESHOLDS})
        return plain

    def csv(self) -> str:
        """The rows as CSV; an unknown value is empty."""
        return csv_text(pandas.DataFrame(self.rows))


def summarise(results: Results) -> Comparison:
    labels, proved = results.labels, results.optima
    return Comparison(
        question=question(results),
        verdict=verdict(results),
        looks=results.looks,
        rows=[_row(results.cells[label, field]) for field in results.fields for label in labels],
        aggregates=[_aggregate(results.on(proved), label) for label in labels if proved],
        probability_of_improvement={
            ours: {
                theirs: probability_of_improvement(results.returns(ours), results.returns(theirs))
                for theirs in labels
                if theirs != ours
            }
            for ours in labels
        },
        fields_without_proved_optimum=[field for field in results.fields if field not in proved],
        broken_runs=results.broken,
    )


def _common(records: Sequence[RunRecord], seeds: int) -> Numbers:
    first, finals = records[0], pandas.json_normalize([one.evaluation for one in records])
    reaching = (
        (e for e in one.evaluations if e["return_mean"] >= RETURN_THRESHOLD) for one in records
    )
    hits = [hit for entries in reaching if (hit := next(entries, None))]
    return {
        "label": first.label,
        "algorithm": first.config["algorithm"],
        "form": find_algorithm(first.config["algorithm"]).form,
        "seeds": seeds,
        "env_steps": int(finals.env_steps.max()),
        "success_rate": float(np.mean(finals["stochastic.success_rate"])),
        "deterministic_success_rate": float(np.mean(finals["deterministic.success_rate"])),
        "passed": _passed(records),
        "reached": len(hits),
        "env_steps_to_threshold": mean_of_known(hit["env_steps"] for hit in hits),
        "seconds_to_threshold": mean_of_known(hit["seconds"] for hit in hits),
        "seconds": float(np.mean(finals.seconds)),
    }


def _row(cell: Sequence[RunRecord]) -> Numbers:
    stochastic = [one.evaluation["stochastic"] for one in cell]
    mean, low, high = mean_interval([entry["return_mean"] for entry in stochastic])
    deterministic = [one.final("deterministic", "return_mean") for one in cell]
    optimum = cell[0].optimum
    return {
        **_common(cell, len(cell)),
        "field": cell[0].field.name,
        "return_mean": mean,
        "return_low": low,
        "return_high": high,
        "makespan": mean_of_known(entry["makespan"] for entry in stochastic),
        "optimum": optimum,
        "optimum_share": None if optimum is None else mean / optimum,
        "deterministic_return": float(np.mean(deterministic)),
        "deterministic_median": float(np.median(deterministic)),
        "deterministic_best": max(deterministic),
    }


def _aggregate(results: Results, label: str) -> Numbers:
    optima = np.array([*results.optima.values()])[:, None]
    sampled = results.returns(label) / optima
    mean = results.returns(label, "deterministic") / optima
    return {
        **_common(results.of_label(label), results.seeds),
        "fields": len(results.fields),
        "iqm": interquartile_mean(sampled),
        "gap": optimality_gap(sampled),
        "deterministic_iqm": interquartile_mean(mean),
        "deterministic_gap": optimality_gap(mean),
        "profile": performance_profile(sampled, THRESHOLDS),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Estimate | Profile):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


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
        return f"{names[0]} and {names[1]} pass; with one seed the order stays open."
    shape = len(results.fields), seeds
    steps = [np.reshape([_steps(run) for run in side], shape) for side in (theirs, ours)]
    low, high = difference_interval(*steps)
    given = f"{seeds} seeds" + (f", {shape[0]} fields" if shape[0] > 1 else "")
    if low <= 0.0 <= high:
        ends = f"{low:.1f} .. {high:.1f} steps, {given}"
        return f"{names[0]} and {names[1]} pass; the order stays open ({ends})."
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


def difference_interval(ours: FloatArray, theirs: FloatArray) -> tuple[float, float]:
    """Bootstrap the mean of ``ours`` less that of ``theirs``, (fields, seeds) each."""
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, side.shape[1], (RESAMPLES, *side.shape)) for side in (ours, theirs)]
    means = [
        np.take_along_axis(side[None], drawn, axis=2).mean(axis=(1, 2))
        for side, drawn in zip((ours, theirs), draws, strict=True)
    ]
    low, high = np.percentile(means[0] - means[1], ENDS)
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
