"""Timing that noise cannot fool: all cases take turns, and medians and paired ratios are kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Budget:
    """How much is measured.

    Attributes:
        rounds: how often every case has its turn.
        seconds: how long a turn takes, about; at least one call.
        warm_up: steps before the first turn. As many as an episode has at most let the worlds'
            episodes be of all ages.
        worlds: worlds of a batch.
        many_worlds: worlds of a large batch.
        sized_worlds: worlds of the batches that show the cost against a size.
        startup: also start fresh processes, with an empty cache and with a filled one.
    """

    rounds: int = 15
    seconds: float = 0.06
    warm_up: int = 1000
    worlds: int = 4096
    many_worlds: int = 16_384
    sized_worlds: int = 1024
    startup: bool = True


@dataclass(frozen=True)
class Case:
    """Something to time.

    Attributes:
        name: of the case, unique in its group.
        run: does it so many times.
        units: how many units (env-steps, say) it does each time.
        prepare: gets ready for so many times before the clock starts.
    """

    name: str
    run: Callable[[int], object]
    units: float = 1.0
    prepare: Callable[[int], object] = lambda calls: None


@dataclass(frozen=True)
class Timing:
    """Seconds per unit of one case, (rounds,)."""

    seconds: NDArray[np.float64]

    @property
    def median(self) -> float:
        """Median seconds per unit."""
        return float(np.median(self.seconds))

    @property
    def rate(self) -> float:
        """Units per second."""
        return 1.0 / self.median

    def times_faster_than(self, other: Timing) -> float:
        """Median of the ratios of turns that followed each other, so that drift cancels."""
        return float(np.median(other.seconds / self.seconds))

    def longer_than(self, other: Timing) -> float:
        """Median of the differences of such turns, in seconds per unit."""
        return float(np.median(self.seconds - other.seconds))


def interleaved(cases: Sequence[Case], budget: Budget) -> dict[str, Timing]:
    """Time all cases, round by round.

    Returns:
        A timing for the name of each case.
    """
    calls = {case.name: _calls_per_turn(case, budget.seconds) for case in cases}
    seconds: dict[str, list[float]] = {case.name: [] for case in cases}
    for _ in range(budget.rounds):
        for case in cases:
            count = calls[case.name]
            seconds[case.name].append(_time(case, count) / (count * case.units))
    return {name: Timing(np.array(samples)) for name, samples in seconds.items()}


def _time(case: Case, calls: int) -> float:
    case.prepare(calls)
    start = perf_counter()
    case.run(calls)
    return perf_counter() - start


def _calls_per_turn(case: Case, seconds: float) -> int:
    """How many calls take about ``seconds``; the first calls, which warm up, do not count."""
    _time(case, 1)
    calls, taken = 1, _time(case, 1)
    while taken < seconds / 4:
        calls *= 2
        taken = _time(case, calls)
    return max(1, round(calls * seconds / max(taken, 1e-9)))
