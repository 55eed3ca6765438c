"""The numbers of a comparison, statistics over seeds and over fields, and its result in words.

Scores are arrays (fields, seeds), a run each: SPL with sampled actions. Every interval is the 95 %
percentile bootstrap, stratified: each resample draws, within every field, as many runs as there
are, with replacement (Agarwal et al., NeurIPS 2021).
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from baselines.algorithms import Algorithm, find_algorithm
from baselines.compare.records import BOTH, Results
from baselines.evaluation.intervals import Interval, mean_interval, mean_of_known

RESAMPLES, CERTAIN, POWER = 10_000, 0.05, 0.8
ENDS = (2.5, 97.5)

FloatArray = NDArray[np.float64]
Numbers = Mapping[str, Any]
"""Numbers by name; ``None`` is unknown."""


def interquartile_mean(scores: FloatArray) -> Interval:
    """The mean of the middle half of all runs: a quarter, rounded down, is cut at both ends."""
    value = float(stats.trim_mean(scores.ravel(), 0.25))
    if scores.shape[1] == 1:
        return Interval(value, None, None)
    means = stats.trim_mean(_resampled(scores, np.random.default_rng(0)), 0.25, axis=1)
    return Interval(value, *np.percentile(means, ENDS).tolist())


def worst_tenth(scores: FloatArray) -> float:
    """The mean of the lowest tenth of all runs, rounded down, and at least of one."""
    return float(np.sort(scores, axis=None)[: max(scores.size // 10, 1)].mean())


def difference(ours: FloatArray, theirs: FloatArray) -> Interval:
    value = float(ours.mean() - theirs.mean())
    if ours.shape[1] == 1:
        return Interval(value, None, None)
    rng = np.random.default_rng(0)
    means = [_resampled(side, rng).mean(axis=1) for side in (ours, theirs)]
    return Interval(value, *np.percentile(means[0] - means[1], ENDS).tolist())


def permutation_test(ours: FloatArray, theirs: FloatArray) -> float:
    """The two-sided p of the difference of means, if labels are exchanged within each field."""
    both = np.concatenate([ours, theirs], axis=1)
    drawn = np.broadcast_to(both, (RESAMPLES, *both.shape))
    drawn = np.random.default_rng(0).permuted(drawn, axis=2)
    sides = drawn[..., : ours.shape[1]], drawn[..., ours.shape[1] :]
    differences = np.abs(sides[0].mean(axis=(1, 2)) - sides[1].mean(axis=(1, 2)))
    as_far = differences >= abs(ours.mean() - theirs.mean()) - 1e-12
    return float(1 + as_far.sum()) / (1 + RESAMPLES)


def holm(p_values: Sequence[float]) -> list[float]:
    """Correct the p-values of a family of comparisons, so that it errs in 5 % as a whole."""
    order = np.argsort(p_values)
    steps = np.sort(p_values) * np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected.tolist()


def detectable(ours: FloatArray, theirs: FloatArray, family: int = 1) -> float | None:
    """The smallest difference of means that so many runs show in 80 % of cases, at 5 %.

    The 5 % are shared by the comparisons of a ``family``. There is none if no difference can: if
    the least p-value, corrected for them, is above 5 %.
    """
    fields, seeds = ours.shape
    least = 2.0 * float(math.comb(2 * seeds, seeds)) ** -fields
    if seeds == 1 or family * least >= CERTAIN:
        return None
    squares = [(side.var(axis=1, ddof=1) / side.shape[1]).sum() for side in (ours, theirs)]
    tail = stats.t(2 * fields * (seeds - 1))
    errors = tail.ppf(1.0 - CERTAIN / (2.0 * family)) + tail.ppf(POWER)
    return float(errors * np.sqrt(sum(squares)) / fields)


def _resampled(scores: FloatArray, rng: np.random.Generator) -> FloatArray:
    drawn = rng.integers(0, scores.shape[1], (RESAMPLES, *scores.shape))
    return np.take_along_axis(scores[None], drawn, axis=2).reshape(RESAMPLES, -1)


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found; tables are in the order of SPL, the best first."""

    question: str
    verdict: str
    rows: Sequence[Numbers]  # every label on every field, field by field
    aggregates: Sequence[Numbers]  # every label over the fields with a proved bound
    pairs: Sequence[Numbers]  # every two labels over these fields, the better one first
    runs: Sequence[Numbers]  # every run, see ``RunRecord.row``
    fields_without_bound: Sequence[str]  # the aggregates leave them out
    broken_runs: Mapping[str, str]  # the error of each that diverged; its label is left out


def summarise(results: Results) -> Comparison:
    bounded = results.on(results.bounded)
    rows = [
        row
        for field in results.fields
        for row in by_spl(_row(results, label, field) for label in results.labels)
    ]
    aggregates = by_spl(
        _aggregate(bounded, label, rows) for label in results.labels if bounded.fields
    )
    pairs = _pairs(bounded, [one["label"] for one in aggregates])
    return Comparison(
        question=question(results),
        verdict=verdict(results, pairs),
        rows=rows,
        aggregates=aggregates,
        pairs=pairs,
        runs=[one.row for one in results.records],
        fields_without_bound=[name for name in results.fields if name not in bounded.fields],
        broken_runs=results.broken,
    )


def by_spl(lines: Iterable[Numbers]) -> list[Numbers]:
    return sorted(lines, key=lambda line: -(line["spl"] or 0.0))


def _common(runs: Sequence[Numbers]) -> dict[str, Any]:
    passed = sum(run["passed"] for run in runs)
    interval = stats.binomtest(passed, len(runs)).proportion_ci(method="wilson")
    gaps = [run["deterministic_gap"] for run in runs if run["passed"]]
    known = [gap for gap in gaps if gap is not None]
    to_pass = [run["first_pass"] or run["env_steps"] for run in runs]
    return {
        **{name: runs[0][name] for name in ("label", "algorithm", "form", "information")},
        **{"runs": len(runs), "env_steps": max(run["env_steps"] for run in runs)},
        **{"passed": passed, "pass_low": float(interval.low), "pass_high": float(interval.high)},
        "gap": float(np.median(known)) if known else None,
        **{name: mean_of_known(run[name] for run in runs) for name in BOTH if "gap" not in name},
        "env_steps_to_pass": float(np.mean(to_pass)),
        "never_passed": sum(run["first_pass"] is None for run in runs),
        "seconds": float(np.mean([run["seconds"] for run in runs])),
    }


def _named(name: str, found: Sequence[float | None]) -> Numbers:
    return dict(zip((name, f"{name}_low", f"{name}_high"), found, strict=True))


def _row(results: Results, label: str, field: str) -> Numbers:
    runs = [one.row for one in results.cells[label, field]]
    known = [run["spl"] for run in runs if run["spl"] is not None]
    spl = mean_interval(known) if known else (None, None, None)
    return {"field": field, **_common(runs), **_named("spl", spl)}


def _aggregate(results: Results, label: str, rows: Sequence[Numbers]) -> Numbers:
    here = [row for row in rows if row["label"] == label and row["field"] in results.fields]
    return {
        "fields": len(results.fields),
        **_common([one.row for one in results.of_label(label)]),
        "gap": mean_of_known(row["gap"] for row in here),
        **_named("iqm", interquartile_mean(results.spl(label))),
        "worst_tenth": worst_tenth(results.spl(label)),
    }


def _pairs(results: Results, labels: Sequence[str]) -> list[Numbers]:
    pairs = [*itertools.combinations(labels, 2)]
    scores = [tuple(map(results.spl, pair)) for pair in pairs]
    p_values = [permutation_test(*both) for both in scores]
    return [
        {
            "better": better,
            "worse": worse,
            **_named("difference", difference(*both)),
            "p": p_value,
            "p_holm": corrected,
            "detectable": detectable(both[0], both[1], len(p_values)),
        }
        for (better, worse), both, p_value, corrected in zip(
            pairs, scores, p_values, holm(p_values), strict=True
        )
    ]


def verdict(results: Results, pairs: Sequence[Numbers]) -> str:
    """Compare by SPL the best label of each form, or the two best of one form, in a sentence.

    If one library has both forms, only its labels are compared: the library would be a second
    difference.
    """
    runs = len(results.fields) * results.seeds
    passed = {
        name: sum(one.row["passed"] for one in results.of_label(name)) for name in results.labels
    }
    if not any(passed.values()):
        budget = f"{max(one.row['env_steps'] for one in results.records):,} env-steps"
        return f"No run passes: the budget of {budget} is too small to compare."
    if len(passed) == 1:
        return f"{passed[results.labels[0]]} of {runs} runs pass."
    order = list(dict.fromkeys(name for pair in pairs for name in (pair["better"], pair["worse"])))
    order = _of_one_library(results, order or sorted(passed, key=lambda name: -passed[name]))
    forms = {_algorithm(results, label).form: label for label in reversed(order)}
    first, second = sorted(forms.values(), key=order.index) if len(forms) == 2 else order[:2]
    ours, theirs = (f"{one} ({_algorithm(results, one).form})" for one in (first, second))
    counts = f"{passed[first]} and {passed[second]} of {runs} runs pass."
    if not pairs:
        return f"{ours} or {theirs}: no bound is proved (mbn plan), so there is no SPL. {counts}"
    pair = next(one for one in pairs if (one["better"], one["worse"]) == (first, second))
    if results.seeds == 1:
        return f"With one seed the order of {ours} and {theirs} stays open. {counts}"
    low, high = (100.0 * pair[f"difference_{end}"] for end in ("low", "high"))
    points, p_value = f"{low:.1f} .. {high:.1f} points of SPL", f"p = {pair['p_holm']:.2g}, Holm"
    if pair["p_holm"] < CERTAIN:
        return f"{ours} is ahead of {theirs} by {points} ({p_value}). {counts}"
    shown = "with so few seeds none can be shown"
    if pair["detectable"] is not None:
        shown = f"the runs could have shown {100.0 * pair['detectable']:.1f}"
    return f"The order of {ours} and {theirs} stays open ({points}, {p_value}; {shown}). {counts}"


def question(results: Results) -> str:
    sides: dict[str, list[str]] = {}
    for label in results.labels:
        sides.setdefault(_algorithm(results, label).form, []).append(label)
    forms = " or ".join(f"{form} ({', '.join(labels)})" for form, labels in sorted(sides.items()))
    steps = max(one.row["env_steps"] for one in results.records)
    plural = "s" if results.seeds > 1 else ""
    where = f"{', '.join(results.fields)}, {steps:,} env-steps a run, {results.seeds} seed{plural}"
    end = "?" if len(sides) > 1 else ""
    return f"{forms[0].upper()}{forms[1:]} on {where} each{end}"


def _of_one_library(results: Results, order: list[str]) -> list[str]:
    # Those of the first library that has both forms; without one, all labels.
    for first in order:
        package = _algorithm(results, first).package
        labels = [label for label in order if _algorithm(results, label).package == package]
        if len({_algorithm(results, label).form for label in labels}) == 2:
            return labels
    return order


def _algorithm(results: Results, label: str) -> Algorithm:
    return find_algorithm(results.of_label(label)[0].config["algorithm"])
