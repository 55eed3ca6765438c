"""Driving what is measured: random actions are drawn before the clock starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.timing import Case
from mbn_marl import BatchEngine
from mbn_marl.engine.cpu import CpuBackend

SETS = 64
"""Steps for which actions are drawn at a time; longer turns use them again."""


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
        """Draw actions for ``calls`` steps."""
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
