"""Statistics over the runs of several fields, as Agarwal et al. (NeurIPS 2021) recommend them.

Scores are arrays (fields, seeds), a run each. Every interval is the 95 % percentile bootstrap,
stratified: each resample draws, within every field, as many runs as there are, with replacement.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

RESAMPLES = 10_000
ENDS = (2.5, 97.5)
"""Percentiles of a resampled statistic that bound its 95 % interval."""

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
    """How likely a run of ``ours`` is to score more than one of ``theirs``, mean over fields.

    Equal scores count half, so that the two directions sum to 1. Fields have to be the same.
    """
    wins = np.where(ours[:, :, None] == theirs[:, None, :], 0.5, ours[:, :, None] > theirs[:, None])
    if max(ours.shape[1], theirs.shape[1]) == 1:
        return Estimate(float(wins.mean()), None, None)
    rng = np.random.default_rng(0)
    our_shares, their_shares = (_shares(scores.shape, rng) for scores in (ours, theirs))
    resampled = np.einsum("rfi,fij,rfj->r", our_shares, wins, their_shares, optimize=True)
    return Estimate(float(wins.mean()), *np.percentile(resampled / len(wins), ENDS).tolist())


def difference_interval(ours: FloatArray, theirs: FloatArray) -> tuple[float, float]:
    """The interval of the mean of ``ours`` less that of ``theirs``, whose seeds are drawn apart."""
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, side.shape[1], (RESAMPLES, *side.shape)) for side in (ours, theirs)]
    means = [
        np.take_along_axis(side[None], drawn, axis=2).mean(axis=(1, 2))
        for side, drawn in zip((ours, theirs), draws, strict=True)
    ]
    low, high = np.percentile(means[0] - means[1], ENDS)
    return float(low), float(high)


def performance_profile(scores: FloatArray, thresholds: FloatArray) -> Profile:
    """The share of runs that score more than each of ``thresholds`` (k,), with a pointwise band."""
    above = (scores[..., None] > thresholds).reshape(-1, thresholds.size)
    shares = _shares(scores.shape, np.random.default_rng(0)).reshape(RESAMPLES, -1)
    low, high = np.percentile(shares @ above / scores.shape[0], ENDS, axis=0)
    return Profile(above.mean(axis=0), low, high)


def _estimate(scores: FloatArray, statistic: Callable[[FloatArray], Any]) -> Estimate:
    """A statistic of all runs, which takes them along the last axis, with its interval."""
    value = float(statistic(scores.ravel()))
    if scores.shape[1] == 1:
        return Estimate(value, None, None)
    drawn = np.random.default_rng(0).integers(0, scores.shape[1], (RESAMPLES, *scores.shape))
    resampled = np.take_along_axis(scores[None], drawn, axis=2).reshape(RESAMPLES, -1)
    return Estimate(value, *np.percentile(statistic(resampled), ENDS).tolist())


def _shares(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """How often each resample draws each run, as a share of its field's, (resamples, *shape)."""
    drawn = rng.integers(0, shape[1], (RESAMPLES, *shape))
    return np.stack([(drawn == seed).mean(axis=2) for seed in range(shape[1])], axis=2)
