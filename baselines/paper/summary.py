"""The four numbers of a cell of the paper's tables, from the rows of ``progress.csv``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from baselines.paper.windows import Windows

FloatArray = NDArray[np.float64]

SMOOTHING = 100
"""Episodes of the moving mean: what Stable-Baselines3 logs as ``rollout/ep_rew_mean``."""


@dataclass(frozen=True)
class Summary:
    """A cell: how the reward was distributed during training (reward units).

    Attributes:
        mean: the mean.
        sd: the population's standard deviation.
        maximum: the largest.
        range: the largest minus the smallest.
    """

    mean: float
    sd: float
    maximum: float
    range: float


def of_episodes(runs: Sequence[Windows]) -> Summary | None:
    """Over every training episode of ``runs``; ``None`` if none has ended.

    Exact, from the count, mean, deviation and range of each row: the squared deviation from the
    mean of all is the row's variance plus the square of its mean's distance.
    """
    rows = [window.with_episodes() for window in runs]
    counts = np.concatenate([row.episodes for row in rows] or [np.empty(0)])
    if not counts.size:
        return None
    means = np.concatenate([row.mean for row in rows])
    spreads = np.concatenate([row.sd for row in rows])
    mean = np.average(means, weights=counts)
    variance = np.average(spreads**2 + (means - mean) ** 2, weights=counts)
    highest = max(row.maximum.max() for row in rows if row.maximum.size)
    lowest = min(row.minimum.min() for row in rows if row.minimum.size)
    return Summary(float(mean), float(np.sqrt(variance)), float(highest), float(highest - lowest))


def of_moving_means(runs: Sequence[Windows]) -> Summary | None:
    """Over the moving means of ``runs``, one a row; ``None`` if no episode has ended."""
    values = np.concatenate([moving_mean(window)[1] for window in runs] or [np.empty(0)])
    if not values.size:
        return None
    return Summary(
        float(values.mean()), float(values.std()), float(values.max()), float(np.ptp(values))
    )


def moving_mean(window: Windows) -> tuple[FloatArray, FloatArray]:
    """Env-steps and the mean of the latest episodes, (k,) each, a row each from the first on.

    The mean at a row is over the fewest whole rows, up to that one, that hold at least
    ``SMOOTHING`` episodes; over all so far while there are fewer.
    """
    begun = np.cumsum(window.episodes) > 0
    counts = window.episodes[begun]
    sums = np.where(counts > 0, counts * window.mean[begun], 0.0)
    episodes = np.concatenate([[0.0], np.cumsum(counts)])
    total = np.concatenate([[0.0], np.cumsum(sums)])
    ends = np.arange(1, episodes.size)
    starts = np.searchsorted(episodes, episodes[ends] - SMOOTHING, side="right") - 1
    starts = np.maximum(starts, 0)
    means = (total[ends] - total[starts]) / (episodes[ends] - episodes[starts])
    return window.env_steps[begun], means


def first_reach(window: Windows, threshold: float) -> float | None:
    """Env-steps at which the moving mean first is ``threshold`` or more; ``None`` for never.

    Rows before ``SMOOTHING`` episodes have ended do not count.
    """
    env_steps, means = moving_mean(window)
    ended = np.cumsum(window.episodes)
    reached = (ended[ended > 0] >= SMOOTHING) & (means >= threshold)
    return float(env_steps[reached.argmax()]) if reached.any() else None
