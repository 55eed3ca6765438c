"""Timing that noise cannot fool: cases take turns; CPU time, medians and paired ratios count."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mbn_marl import BatchEngine

Step = Callable[[Any], object]
SETS = 64  # steps for which actions are drawn at a time; longer turns use them again


@dataclass(frozen=True)
class Budget:
    """How much is measured."""

    rounds: int = 15  # turns of every case
    seconds: float = 0.06  # of a turn, about; at least one call
    warm_up: int = 1000  # steps before; as many as an episode has at most: episodes of all ages
    worlds: int = 4096
    many_worlds: int = 16_384  # of a large batch
    startup: bool = True  # also start fresh processes, with an empty cache and with a filled one


@dataclass(frozen=True)
class Case:
    """Something to time; the name is unique in its group."""

    name: str
    run: Callable[[int], object]  # does it so many times
    units: float = 1.0  # how many units (env-steps, say) it does each time
    prepare: Callable[[int], object] = lambda calls: None  # before the clock starts


class Timings(NamedTuple):
    """Seconds per unit: a row for each round, a column for the name of each case."""

    cpu: pd.DataFrame  # of the calling thread: all of it where a case uses no other
    wall: pd.DataFrame


def interleaved(cases: Sequence[Case], budget: Budget) -> Timings:
    """Time all cases, round by round.

    Ratios and differences of turns that followed each other cancel drift.
    """
    turns = [(case, _calls_per_turn(case, budget.seconds)) for case in cases]
    rounds = [
        [np.divide(_time(case, calls), calls * case.units) for case, calls in turns]
        for _ in range(budget.rounds)
    ]
    names, (cpu, wall) = [case.name for case in cases], np.array(rounds).transpose(2, 0, 1)
    return Timings(pd.DataFrame(cpu, columns=names), pd.DataFrame(wall, columns=names))


def _time(case: Case, calls: int) -> tuple[float, float]:
    """The seconds of CPU and of the clock on the wall that so many calls take."""
    case.prepare(calls)
    cpu, wall = thread_time(), perf_counter()
    case.run(calls)
    return thread_time() - cpu, perf_counter() - wall


def _calls_per_turn(case: Case, seconds: float) -> int:
    """How many calls take about ``seconds``; the first calls, which warm up, do not count."""
    _time(case, 1)
    calls, (taken, _) = 1, _time(case, 1)
    while taken < seconds / 4:
        calls *= 2
        taken, _ = _time(case, calls)
    return max(1, round(calls * seconds / max(taken, 1e-9)))


def random_case(
    name: str, shape: tuple[int, ...], step: Step, units: float, warm_up: int = 0
) -> Case:
    """Steps with uniform random actions of that shape in [-1, 1), float32, after ``warm_up``."""
    rng = np.random.default_rng(0)
    drawn = np.empty((SETS, *shape), np.float32)

    def draw(calls: int) -> None:
        actions = rng.random(out=drawn[:calls], dtype=np.float32)
        np.subtract(2 * actions, 1, out=actions)

    def run(calls: int) -> None:
        for k in range(calls):
            step(drawn[k % SETS])

    for done in range(0, warm_up, SETS):
        draw(SETS)
        run(min(SETS, warm_up - done))
    return Case(name, run, units, draw)


def cycling_case(name: str, sets: Iterable[Any], step: Step, units: float = 1.0) -> Case:
    """Steps with each of the sets of actions in turn, again and again."""
    actions = cycle(sets)

    def run(calls: int) -> None:
        for _ in range(calls):
            step(next(actions))

    return Case(name, run, units)


def engine_case(name: str, engine: BatchEngine, warm_up: int) -> Case:
    """``BatchEngine.step`` as a case, in seconds per env-step; resets the engine."""
    engine.reset()
    shape = (engine.num_worlds, engine.n_robots, 2)
    return random_case(name, shape, engine.step, engine.num_worlds, warm_up)
