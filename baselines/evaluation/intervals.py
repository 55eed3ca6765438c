"""Statistics over seeds. A run is one sample: its episodes are averaged before anything else."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

# A mean return at or above this needs the success of nearly every episode (r_inf = 100 000).
RETURN_THRESHOLD = 100_000.0
# Share of the episodes that have to succeed for a policy to pass, with either kind of actions.
SUCCESS_THRESHOLD = 0.99


def passes(*success_rates: float) -> bool:
    """Return whether a policy does its task, by success with sampled and with mean actions."""
    return min(success_rates) >= SUCCESS_THRESHOLD


class Interval(NamedTuple):
    """A mean or a difference of means with its bootstrap interval; one seed gives none."""

    mean: float
    low: float | None
    high: float | None


def mean_interval(values: Sequence[float]) -> Interval:
    """Mean and 95 % percentile-bootstrap interval: too narrow with a handful of seeds."""
    if not values:
        raise ValueError("a mean needs at least one value")
    sample = np.asarray(values, dtype=np.float64)
    mean = float(sample.mean())
    if len(sample) == 1:
        return Interval(mean, None, None)
    if np.ptp(sample) == 0.0:
        return Interval(mean, mean, mean)
    from scipy import stats  # takes half a second

    how: dict[str, Any] = {"n_resamples": 10_000, "method": "percentile"}
    found = stats.bootstrap((sample,), np.mean, rng=np.random.default_rng(0), **how)
    return Interval(mean, *map(float, found.confidence_interval))


def mean_of_known(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
