"""Timing that noise cannot fool: all cases take turns, and medians and paired ratios are kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl import BatchEngine
from mbn_marl.engine.cpu import CpuBackend

SETS = 64
"""Steps for which actions are drawn at a time; longer turns use them again."""


@dataclass(frozen=True)
class Budget:
    """How much is measured."""

    rounds: int = 15  # how often every case has its turn
    seconds: float = 0.06  # how long a turn takes, about; at least one call
    warm_up: int = 1000  # steps before; as many as an episode has at most: episodes of all ages
    worlds: int = 4096
    many_worlds: int = 16_384  # of a large batch
    sized_worlds: int = 1024  # of the batches that show the cost against a size
    startup: bool = True  # also start fresh processes, with an empty cache and with a filled one


@dataclass(frozen=True)
class Case:
    """Something to time; the name is unique in its group."""

    name: str
    run: Callable[[int], object]  # does it so many times
    units: float = 1.0  # how many units (env-steps, say) it does each time
    prepare: Callable[[int], object] = lambda calls: None  # before the clock starts


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


class RandomSteps:
    """Uniform random actions in [-1, 1), float32, of a batch, for one step after the other.

    Args:
        shape: of the actions of one step.
        step: what takes them.
    """

    def __init__(self, shape: tuple[int, ...], step: Callable[[Any], object]) -> None:
        self._rng = np.random.default_rng(0)
        self._actions = np.empty((SETS, *shape), np.float32)
        self._step = step

    def draw(self, calls: int) -> None:
        """Draw the actions of ``calls`` steps."""
        actions = self._actions[:calls]
        self._rng.random(out=actions, dtype=np.float32)
        actions *= 2
        actions -= 1

    def run(self, calls: int) -> None:
        """Step ``calls`` times."""
        step, actions = self._step, self._actions
        for k in range(calls):
            step(actions[k % SETS])

    def case(self, name: str, units: float, warm_up: int = 0) -> Case:
        """These steps as a case, after ``warm_up`` of them."""
        for done in range(0, warm_up, SETS):
            calls = min(SETS, warm_up - done)
            self.draw(calls)
            self.run(calls)
        return Case(name, self.run, units, self.draw)


def cpu_backend(engine: BatchEngine) -> CpuBackend:
    """The arrays, threads and checks behind an engine on the CPU."""
    backend = engine._backend
    assert isinstance(backend, CpuBackend)
    return backend


def engine_case(name: str, engine: BatchEngine, warm_up: int) -> Case:
    """``BatchEngine.step`` as a case, in seconds per env-step; resets the engine."""
    engine.reset()
    shape = (engine.num_worlds, engine.n_robots, 2)
    return RandomSteps(shape, engine.step).case(name, engine.num_worlds, warm_up)
