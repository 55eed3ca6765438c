"""The figures of a comparison."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from baselines.compare.records import Kind, RunRecord
from baselines.compare.summary import THRESHOLDS, Comparison
from baselines.evaluation.intervals import RETURN_THRESHOLD

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AGGREGATES = {
    "interquartile mean": "iqm",
    "optimality gap": "gap",
    "optimality gap, mean actions": "deterministic_gap",
}
"""Attributes of an aggregate by the title of their panel."""


def draw_statistics(comparison: Comparison) -> dict[str, Figure]:
    """Figures of what is over all fields, by title."""
    from mbn_marl.render import estimates

    drawn, aggregates = {}, comparison.aggregates
    if aggregates:
        panels = {
            title: {entry.label: getattr(entry, name) for entry in aggregates}
            for title, name in AGGREGATES.items()
        }
        profiles = {entry.label: entry.profile for entry in aggregates}
        score = "return as a share of the proved optimum"
        drawn["Aggregates"] = estimates.intervals_figure(panels)
        drawn["Performance profiles"] = estimates.profiles_figure(
            profiles, THRESHOLDS, score, comparison.looks
        )
    if pairs := list(itertools.combinations(comparison.looks, 2)):
        chances = {f"{x} > {y}": comparison.improvement[x][y] for x, y in pairs}
        drawn["Probability of improvement"] = estimates.chances_figure(
            chances, "probability of improvement"
        )
    return drawn


def draw_learning_curves(
    groups: Mapping[str, Sequence[RunRecord]], looks: Mapping[str, int]
) -> Figure:
    """The learning curves of one field's runs, by label."""
    from mbn_marl.render import curves

    return curves.learning_curves(
        {label: [_curve(record) for record in group] for label, group in groups.items()},
        threshold=RETURN_THRESHOLD,
        optimum=next(iter(groups.values()))[0].optimum,
        looks=looks,
    )


def ranked(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Runs by their return with mean actions, then with sampled ones, the best first."""
    kinds: tuple[Kind, Kind] = ("deterministic", "stochastic")
    return sorted(
        records,
        key=lambda record: tuple(record.final(kind, "return_mean") for kind in kinds),
        reverse=True,
    )


def _curve(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    history = record.evaluations
    steps = np.asarray([entry["env_steps"] for entry in history])
    return steps, np.asarray([entry["return_mean"] for entry in history])
