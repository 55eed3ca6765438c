"""Sharing the worlds of a batch among threads."""

from __future__ import annotations

import os
from threading import Event
from typing import Any

import numpy as np

from mbn_marl.engine import kernels, step
from mbn_marl.engine.store import Store
from mbn_marl.jit.compile import address_of

WORLDS_PER_THREAD = 256
"""With fewer worlds than this for each thread, one does it all."""


_threaded, _forked = Event(), Event()
"""Set once this process has used threads; set in a child forked after that."""


def _after_fork() -> None:
    if _threaded.is_set():
        _forked.set()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class WorldThreads:
    """Steps worlds in ranges, one range per thread.

    No two worlds share memory that is written, so neither the number of threads nor where the
    ranges are cut changes any result. The threads are those of Numba's threading layer: OpenMP
    where there is one, since it starts work in microseconds. OpenMP does not survive a fork: a
    child of a process that has used it steps on one thread.

    Args:
        worlds: how many worlds there are.
        threads: how many ranges; ``None`` takes one per core where the batch is worth it.

    Attributes:
        cuts: the first world of each range, and the number of worlds, (threads + 1,) int64.
    """

    def __init__(self, worlds: int, threads: int | None) -> None:
        if threads is None:
            threads = max(1, min(_cores(), worlds // WORLDS_PER_THREAD))
        self.worlds, self._address = worlds, 0
        self.cuts = np.array([worlds * k // threads for k in range(threads + 1)])

    def step(self, store: Store, actions: np.ndarray[Any, Any]) -> int:
        """Step all worlds with ``actions`` (W, n, 2); return how many episodes ended."""
        if self.cuts.size == 2 or _forked.is_set():
            return int(step.step_worlds(store, actions, 0, self.worlds))
        _threaded.set()
        if not self._address:  # it does for actions that cannot be written, too
            self._address = address_of(step.step_worlds, store, actions, 0, 0)
        return int(kernels.step_ranges(self._address, store, actions, self.cuts))


def _cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
