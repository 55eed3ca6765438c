"""The comparison's numbers: what runs recorded, summarised over seeds and over fields."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

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
from baselines.evaluation.intervals import mean_interval, mean_of_known, reach

THRESHOLDS = np.concatenate([np.arange(90) / 100, np.arange(900, 1001) / 1000])
"""Scores at which performance profiles are taken: more closely near the best possible one."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Results of the runs of one label, on one field or on several.

    Attributes:
        label: of an algorithm, or of a variant of one.
        algorithm: its algorithm.
        form: ``"centralized"`` or ``"decentralized"``.
        seeds: runs on each field.
        env_steps: env-steps of a run.
        success_rate: share of the final episodes with sampled actions that visited every ROI.
        deterministic_success_rate: share of the runs' final episodes with mean actions.
        reached: runs with a fresh evaluation at 100 000 or more.
        env_steps_to_threshold: mean env-steps of the first such evaluation, of those runs.
        seconds_to_threshold: mean training seconds of it, evaluations excluded.
        seconds: mean training seconds of a whole run, evaluations excluded.
    """

    label: str
    algorithm: str
    form: str
    seeds: int
    env_steps: int
    success_rate: float
    deterministic_success_rate: float
    reached: int
    env_steps_to_threshold: float | None
    seconds_to_threshold: float | None
    seconds: float


@dataclass(frozen=True, kw_only=True)
class FieldOutcome(Outcome):
    """One label on one field, over seeds.

    Attributes:
        field: the field's name.
        return_mean: mean over seeds of the mean true team return of the final stochastic episodes.
        return_low: lower end of its 95 % bootstrap interval; ``None`` for one seed.
        return_high: upper end.
        makespan: mean length of the successful ones, in steps.
        optimum: the proved best return, or ``None`` if there is no proof.
        optimum_share: ``return_mean / optimum``.
        deterministic_return: mean over seeds of the return with mean actions.
        deterministic_median: their median.
        deterministic_best: their best.
    """

    field: str
    return_mean: float
    return_low: float | None
    return_high: float | None
    makespan: float | None
    optimum: float | None
    optimum_share: float | None
    deterministic_return: float
    deterministic_median: float
    deterministic_best: float


@dataclass(frozen=True, kw_only=True)
class Aggregate(Outcome):
    """One label over all fields with a proved optimum; scores are returns as shares of it.

    Attributes:
        fields: how many they are.
        iqm: the interquartile mean of the scores with sampled actions.
        gap: their optimality gap.
        deterministic_iqm: as ``iqm``, with mean actions.
        deterministic_gap: as ``gap``, with mean actions.
        profile: the performance profile with sampled actions, at ``THRESHOLDS``.
    """

    fields: int
    iqm: Estimate
    gap: Estimate
    deterministic_iqm: Estimate
    deterministic_gap: Estimate
    profile: Profile


@dataclass(frozen=True)
class Comparison:
    """Everything that a comparison found.

    Attributes:
        looks: the labels in order, with the numbers of their looks in figures.
        rows: every label on every field, field by field.
        aggregates: every label over the fields with a proved optimum; empty if there is none.
        improvement: for each two labels how likely a run of the first has a higher return with
            sampled actions than one of the second on the same field, over all fields.
        unproved: the fields that the aggregates leave out.
        broken: the error of each run that diverged, by its name; its label is left out.
    """

    looks: Mapping[str, int]
    rows: tuple[FieldOutcome, ...]
    aggregates: tuple[Aggregate, ...]
    improvement: Mapping[str, Mapping[str, Estimate]]
    unproved: tuple[str, ...]
    broken: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "rows": [_plain(row) for row in self.rows],
            "aggregates": [_plain(aggregate) for aggregate in self.aggregates],
            "profile_thresholds": THRESHOLDS.tolist(),
            "probability_of_improvement": {
                ours: {theirs: _plain(estimate) for theirs, estimate in others.items()}
                for ours, others in self.improvement.items()
            },
            "fields_without_proved_optimum": list(self.unproved),
            "broken_runs": dict(self.broken),
        }

    def csv(self) -> str:
        """The rows as CSV; an unknown value is empty."""
        text = io.StringIO()
        names = [field.name for field in fields(FieldOutcome)]
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(_plain(row) for row in self.rows)
        return text.getvalue()


def summarise(results: Results) -> Comparison:
    """Summarise results over seeds, and over fields."""
    proved = results.proved()
    return Comparison(
        looks=results.looks,
        rows=tuple(
            _row(results.cells[label, field])
            for field in results.fields
            for label in results.labels
        ),
        aggregates=(
            () if proved is None else tuple(_aggregate(proved, label) for label in proved.labels)
        ),
        improvement={
            ours: {
                theirs: probability_of_improvement(results.returns(ours), results.returns(theirs))
                for theirs in results.labels
                if theirs != ours
            }
            for ours in results.labels
        },
        unproved=tuple(
            field for field in results.fields if proved is None or field not in proved.fields
        ),
        broken=results.broken,
    )


def _common(records: Sequence[RunRecord], seeds: int) -> dict[str, Any]:
    """The attributes of :class:`Outcome`."""
    first = records[0]
    hits = reach([one.evaluations for one in records])

    def mean(*path: str) -> float:
        return float(np.mean([one.final(*path) for one in records]))

    return {
        "label": first.label,
        "algorithm": first.config["algorithm"],
        "form": first.form,
        "seeds": seeds,
        "env_steps": max(one.evaluation["env_steps"] for one in records),
        "success_rate": mean("stochastic", "success_rate"),
        "deterministic_success_rate": mean("deterministic", "success_rate"),
        "reached": hits.reached,
        "env_steps_to_threshold": hits.env_steps,
        "seconds_to_threshold": hits.seconds,
        "seconds": mean("seconds"),
    }


def _row(cell: Sequence[RunRecord]) -> FieldOutcome:
    stochastic = [one.evaluation["stochastic"] for one in cell]
    returns = mean_interval([entry["return_mean"] for entry in stochastic])
    deterministic = [one.final("deterministic", "return_mean") for one in cell]
    optimum = cell[0].optimum
    return FieldOutcome(
        **_common(cell, len(cell)),
        field=cell[0].field.name,
        return_mean=returns.mean,
        return_low=returns.low,
        return_high=returns.high,
        makespan=mean_of_known(entry["makespan"] for entry in stochastic),
        optimum=optimum,
        optimum_share=None if optimum is None else returns.mean / optimum,
        deterministic_return=float(np.mean(deterministic)),
        deterministic_median=float(np.median(deterministic)),
        deterministic_best=max(deterministic),
    )


def _aggregate(results: Results, label: str) -> Aggregate:
    sampled, mean = (
        results.returns(label, kind) / results.optima()[:, None]
        for kind in ("stochastic", "deterministic")
    )
    return Aggregate(
        **_common(results.of_label(label), results.seeds),
        fields=len(results.fields),
        iqm=interquartile_mean(sampled),
        gap=optimality_gap(sampled),
        deterministic_iqm=interquartile_mean(mean),
        deterministic_gap=optimality_gap(mean),
        profile=performance_profile(sampled, THRESHOLDS),
    )


def _plain(value: Any) -> Any:
    """Return an outcome, an estimate or a profile as JSON values."""
    if isinstance(value, Estimate | Profile):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, Outcome):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return value.tolist() if isinstance(value, np.ndarray) else value
