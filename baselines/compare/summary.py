"""The comparison's numbers: what runs recorded, summarised over seeds and over fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas

from baselines.algorithms import find_algorithm
from baselines.compare.aggregate import (
    Estimate,
    Profile,
    interquartile_mean,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
)
from baselines.compare.records import RunRecord
from baselines.compare.results import Results
from baselines.compare.text_table import csv_text
from baselines.compare.verdict import question, verdict
from baselines.evaluation.intervals import RETURN_THRESHOLD, mean_interval, mean_of_known, passes

THRESHOLDS = np.concatenate([np.arange(90) / 100, np.arange(900, 1001) / 1000])
"""Scores at which performance profiles are taken: more closely near the best possible one."""

Numbers = Mapping[str, Any]
"""A label's numbers by name; ``None`` is unknown."""


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found.

    Rows and aggregates have a label, its ``algorithm`` and ``form``, how many ``seeds`` a field
    has, the ``env_steps`` of a run, the ``success_rate`` of final episodes with sampled actions and
    with mean ones (``deterministic_...``), how many runs ``passed``, those that ``reached`` a fresh
    evaluation at 100 000, and of those the mean env-steps and training seconds of the first such
    evaluation (``..._to_threshold``), and the mean training ``seconds`` of a run; evaluations are
    excluded.

    Attributes:
        question: what is compared, on which fields, at which budget.
        verdict: the result in a sentence.
        looks: the labels in order, with the numbers of their looks in figures.
        rows: every label on every field, field by field: besides, the mean return over seeds with
            its 95 % bootstrap interval, the mean ``makespan`` of successful episodes, the proved
            ``optimum``, the return's share of it, and the returns with mean actions.
        aggregates: every label over the ``fields`` with a proved optimum; empty if there is none.
            Besides: interquartile mean ``iqm`` and optimality ``gap`` of the scores, the returns
            as shares of the optimum, also with mean actions (``deterministic_...``), and their
            performance ``profile`` at ``THRESHOLDS``.
        improvement: for each two labels how likely a run of the first has a higher return with
            sampled actions than one of the second on the same field, over all fields.
        unproved: the fields that the aggregates leave out.
        broken: the error of each run that diverged, by its name; its label is left out.
    """

    question: str
    verdict: str
    looks: Mapping[str, int]
    rows: Sequence[Numbers]
    aggregates: Sequence[Numbers]
    improvement: Mapping[str, Mapping[str, Estimate]]
    unproved: Sequence[str]
    broken: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        values: dict[str, Any] = _plain(
            {
                "question": self.question,
                "verdict": self.verdict,
                "rows": self.rows,
                "aggregates": self.aggregates,
                "profile_thresholds": THRESHOLDS,
                "probability_of_improvement": self.improvement,
                "fields_without_proved_optimum": self.unproved,
                "broken_runs": self.broken,
            }
        )
        return values

    def csv(self) -> str:
        """The rows as CSV; an unknown value is empty."""
        return csv_text(pandas.DataFrame(self.rows))


def summarise(results: Results) -> Comparison:
    """Summarise results over seeds, and over fields."""
    labels, proved = results.labels, results.optima
    return Comparison(
        question=question(results),
        verdict=verdict(results),
        looks=results.looks,
        rows=[_row(results.cells[label, field]) for field in results.fields for label in labels],
        aggregates=[_aggregate(results.on(proved), label) for label in labels if proved],
        improvement={
            ours: {
                theirs: probability_of_improvement(results.returns(ours), results.returns(theirs))
                for theirs in labels
                if theirs != ours
            }
            for ours in labels
        },
        unproved=[field for field in results.fields if field not in proved],
        broken=results.broken,
    )


def _common(records: Sequence[RunRecord], seeds: int) -> Numbers:
    """The numbers that rows and aggregates have both."""
    first = records[0]
    finals = [one.evaluation for one in records]
    reaching = (
        (e for e in one.evaluations if e["return_mean"] >= RETURN_THRESHOLD) for one in records
    )
    hits = [hit for entries in reaching if (hit := next(entries, None))]

    def mean(*path: str) -> float:
        return float(np.mean([one.final(*path) for one in records]))

    return {
        "label": first.label,
        "algorithm": first.config["algorithm"],
        "form": find_algorithm(first.config["algorithm"]).form,
        "seeds": seeds,
        "env_steps": max(one.evaluation["env_steps"] for one in records),
        "success_rate": mean("stochastic", "success_rate"),
        "deterministic_success_rate": mean("deterministic", "success_rate"),
        "passed": sum(
            passes(final["stochastic"], final["deterministic"]["success_rate"]) for final in finals
        ),
        "reached": len(hits),
        "env_steps_to_threshold": mean_of_known(hit["env_steps"] for hit in hits),
        "seconds_to_threshold": mean_of_known(hit["seconds"] for hit in hits),
        "seconds": mean("seconds"),
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
    """Return estimates, profiles and what holds them as JSON values."""
    if isinstance(value, Estimate | Profile):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value
