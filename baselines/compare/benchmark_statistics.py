"""Statistics of a benchmark over instances, and whether a result has those of its rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from baselines.compare.aggregate import interquartile_mean
from baselines.evaluation.intervals import mean_interval
from mbn_marl.field import Instance

WAYS = ("mean", "sampled")
"""Of acting: with the mean actions, with sampled ones."""
METRICS = (
    *("success_rate", "clean_rate", "collision_rate", "wall_hits", "steps", "makespan"),
    *("makespan_with_failures", "gap", "gap_to_best_known", "gap_with_failures"),
)
"""The numbers of an instance and a way of acting, see docs/benchmark.md."""
TIMES = ("decision_ms", "begin_s")
"""Processor time of a decision of the team, and of what comes before the first one."""


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics of each metric over instances, for both ways of acting."""
    found: dict[str, Any] = {}
    for way in WAYS:
        known = [row[way] for row in rows if row[way] is not None]
        found[way] = {name: statistics([row[name] for row in known]) for name in METRICS}
        if not known:
            found[way] = None
    times = [row["times"] for row in rows]
    found["times"] = {name: statistics([row[name] for row in times]) for name in TIMES}
    return found


def tier_problems(one: Any, instances: Sequence[Instance]) -> Iterator[str]:
    """Yield why what a result has of a tier is not what its rows say of today's instances."""
    try:
        if one["misfit"] is not None:
            if not isinstance(one["misfit"], str) or one["instances"]:
                yield "misfit: has instances, or gives no reason"
            return
        names = ("field", "condition", "makespan_lower_bound", "best_known")
        known = [tuple(row[name] for name in names) for row in one["instances"]]
        now = [
            (each.field.name, each.condition, each.makespan_lower_bound, each.best_known)
            for each in instances
        ]
        if known != now:
            yield "fields or bounds are not those of today; run it again"
        elif not all(isinstance(row["mean"], dict) for row in one["instances"]):
            yield "mean: missing"
        elif not is_summary(one, one["instances"]):
            yield "statistics are not those of its instances"
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        yield f"is not as mbn benchmark writes it: {type(error).__name__}: {error}"


def is_summary(found: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether statistics that were found are those of the rows, but for rounding."""
    return all(_close(found[name], again) for name, again in summarise(rows).items())


def _close(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_close(one[name], other[name]) for name in one)
    if isinstance(one, float | int) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return bool(one == other)


def statistics(values: Sequence[float | None]) -> dict[str, Any] | None:
    """Return mean and interquartile mean with 95 % intervals, of the values that are known.

    Both are bootstrapped over the values; one value alone has no interval.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    mean, low, high = mean_interval(known)
    same = len(set(known)) == 1
    iqm, iqm_low, iqm_high = (
        (mean, low, high) if same else interquartile_mean(np.array([known], float))
    )
    return {
        **{"instances": len(known), "mean": mean, "low": low, "high": high},
        **{"iqm": iqm, "iqm_low": iqm_low, "iqm_high": iqm_high},
    }
