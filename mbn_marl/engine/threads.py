"""Sharing the worlds of a batch among threads."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from mbn_marl.compiled.jit import address_of
from mbn_marl.engine import kernels, step
from mbn_marl.engine.store import Store

WORLDS_PER_THREAD = 256
"""With fewer worlds than this for each thread, one does it all."""


class WorldThreads:
    """Steps worlds in ranges, one range per thread.

    No two worlds share memory that is written, so neither the number of threads nor where the
    ranges are cut changes any result. The threads are those of Numba's threading layer: OpenMP
    where there is one, since it starts work in microseconds. As always with OpenMP, a process
    that has used it must not continue in a forked child; start such children by spawn.

    Args:
        worlds: how many worlds there are.
        threads: how many ranges; ``None`` takes one per core where the batch is worth it.

    Attributes:
        cuts: the first world of each range, and the number of worlds, (threads + 1,) uint64.
    """

    def __init__(self, worlds: int, threads: int | None) -> None:
        if threads is None:
            threads = max(1, min(_cores(), worlds // WORLDS_PER_THREAD))
        self._address: int | None = None
        self.cuts = np.array([worlds * k // threads for k in range(threads + 1)], np.uint64)

    def step(self, store: Store, actions: np.ndarray[Any, Any]) -> int:
        """Step all worlds with ``actions`` (W, n, 2); return how many episodes ended."""
        if self.cuts.size == 2:
            return int(step.step_worlds(store, actions, self.cuts[0], self.cuts[1]))
        if self._address is None:  # it does for actions that cannot be written, too
            self._address = address_of(step.step_worlds, store, actions, *self.cuts[:2])
        return int(kernels.step_ranges(self._address, store, actions, self.cuts))


def _cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
