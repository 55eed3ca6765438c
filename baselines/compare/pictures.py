"""The figures of a comparison."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from pandas import DataFrame

from baselines.compare.records import RunRecord
from baselines.compare.summary import THRESHOLDS, Comparison
from baselines.evaluation.intervals import RETURN_THRESHOLD
from mbn_marl.render import curves, estimates

AGGREGATES = {
    "interquartile mean": "iqm",
    "optimality gap": "gap",
    "optimality gap, mean actions": "deterministic_gap",
}
"""Numbers of an aggregate by the title of their panel."""


def draw_statistics(comparison: Comparison) -> dict[str, Figure]:
    """Figures of what is over all fields, by title."""
    drawn, by_label = {}, {one["label"]: one for one in comparison.aggregates}
    if by_label:
        panels = {
            title: {label: one[name] for label, one in by_label.items()}
            for title, name in AGGREGATES.items()
        }
        profiles = {label: one["profile"] for label, one in by_label.items()}
        score = "return as a share of the proved optimum"
        drawn["Aggregates"] = estimates.intervals_figure(panels)
        drawn["Performance profiles"] = estimates.profiles_figure(
            profiles, THRESHOLDS, score, comparison.looks
        )
    if pairs := list(itertools.combinations(comparison.looks, 2)):
        title = "Probability of improvement"
        chances = {f"{x} > {y}": comparison.improvement[x][y] for x, y in pairs}
        drawn[title] = estimates.chances_figure(chances, title.lower())
    return drawn


def draw_learning_curves(
    groups: Mapping[str, Sequence[RunRecord]], looks: Mapping[str, int]
) -> Figure:
    """The learning curves of one field's runs, by label."""
    found = {label: [*map(_curve, group)] for label, group in groups.items()}
    optimum, *others = {one.optimum for group in groups.values() for one in group}
    optimum = None if others else optimum
    return curves.learning_curves(found, RETURN_THRESHOLD, optimum, looks=looks)


def _curve(record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    history = DataFrame(record.evaluations)
    return history.env_steps.to_numpy(), history.return_mean.to_numpy()


def ranked(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Runs by their return with mean actions, then with sampled ones, the best first."""

    def returns(record: RunRecord) -> list[float]:
        return [record.final(kind, "return_mean") for kind in ("deterministic", "stochastic")]

    return sorted(records, key=returns, reverse=True)
