"""Statistics over seeds. A run is one sample: its episodes are averaged before anything else."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

RETURN_THRESHOLD = 100_000.0
"""A mean return at or above this needs the success of nearly every episode (r_inf = 100 000)."""

SUCCESS_THRESHOLD = 0.99
"""Share of the episodes with sampled actions that have to succeed for a policy to pass."""


def passes(
    sampled: Mapping[str, Any], mean_success_rate: float, threshold: float = RETURN_THRESHOLD
) -> bool:
    """Return whether a fresh evaluation says that a policy does its task.

    Args:
        sampled: summary of the episodes with sampled actions: their ``return_mean`` has to be at
            least ``threshold``, their ``success_rate`` at least 0.99.
        mean_success_rate: share of the episodes with mean actions that succeed: all have to.
        threshold: of the mean true return.
    """
    return bool(
        sampled["return_mean"] >= threshold
        and sampled["success_rate"] >= SUCCESS_THRESHOLD
        and mean_success_rate == 1.0
    )


@dataclass(frozen=True)
class Interval:
    """A mean over seeds with its bootstrap interval; one seed gives no interval."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Reach:
    """How many runs reached the threshold, and the mean cost of those that did.

    Attributes:
        reached: runs with an evaluation at or above the threshold.
        runs: all runs.
        env_steps: mean env-steps of the first such evaluation; ``None`` if no run reached it.
        seconds: mean training time of the first such evaluation, evaluations excluded.
    """

    reached: int
    runs: int
    env_steps: float | None
    seconds: float | None


def mean_interval(values: Sequence[float], *, confidence: float = 0.95) -> Interval:
    """Mean and percentile-bootstrap interval (10 000 resamples, fixed generator).

    With a handful of seeds the interval is narrow for what it claims; it lies within
    ``[min(values), max(values)]`` by construction.

    Raises:
        ValueError: ``values`` is empty.
    """
    if not values:
        raise ValueError("a mean needs at least one value")
    sample = np.asarray(values, dtype=np.float64)
    mean = float(sample.mean())
    if len(sample) == 1:
        return Interval(mean, None, None)
    if np.ptp(sample) == 0.0:
        return Interval(mean, mean, mean)
    result = stats.bootstrap(
        (sample,),
        np.mean,
        confidence_level=confidence,
        n_resamples=10_000,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    bounds = result.confidence_interval
    return Interval(mean, float(bounds.low), float(bounds.high))


def share_interval(outcomes: Sequence[bool], *, confidence: float = 0.95) -> Interval:
    """The share of ``True`` with Wilson's interval, for independent outcomes.

    Raises:
        ValueError: ``outcomes`` is empty.
    """
    if not outcomes:
        raise ValueError("a share needs at least one outcome")
    test = stats.binomtest(sum(outcomes), len(outcomes))
    bounds = test.proportion_ci(confidence, method="wilson")
    return Interval(sum(outcomes) / len(outcomes), float(bounds.low), float(bounds.high))


def mean_of_known(values: Iterable[float | None]) -> float | None:
    """The mean of the values that are not ``None``; ``None`` if there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def first_reach(
    evaluations: Iterable[dict[str, Any]], threshold: float = RETURN_THRESHOLD
) -> dict[str, Any] | None:
    """The first of a run's evaluations, in order, with ``return_mean >= threshold``."""
    return next((entry for entry in evaluations if entry["return_mean"] >= threshold), None)


def reach(
    histories: Sequence[Sequence[dict[str, Any]]], threshold: float = RETURN_THRESHOLD
) -> Reach:
    """Summarise :func:`first_reach` over the evaluation histories of several runs."""
    firsts = [first_reach(history, threshold) for history in histories]
    hits = [entry for entry in firsts if entry is not None]
    return Reach(
        reached=len(hits),
        runs=len(firsts),
        env_steps=mean_of_known(entry["env_steps"] for entry in hits),
        seconds=mean_of_known(entry["seconds"] for entry in hits),
    )
