"""Sharing the worlds of a batch among threads."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

WORLDS_PER_THREAD = 256
"""With fewer worlds than this for each thread, handing them over would cost more than it saves."""


class WorldThreads:
    """Runs a compiled kernel over ranges of worlds, one range per thread, and adds up its results.

    The kernels release the GIL and no two worlds share memory that is written, so neither the
    number of threads nor where the ranges are cut changes any result.

    Args:
        worlds: how many worlds there are.
        threads: how many threads; ``None`` takes one per core where the batch is worth it.
    """

    def __init__(self, worlds: int, threads: int | None) -> None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        if threads is None:
            threads = max(1, min(cores or 1, worlds // WORLDS_PER_THREAD))
        cuts = [np.uint64(worlds * k // threads) for k in range(threads + 1)]
        self.count = threads
        self._first, *self._others = list(itertools.pairwise(cuts))
        self._pool: ThreadPoolExecutor | None = None

    def run(self, kernel: Callable[..., int], *arguments: Any) -> int:
        """Call ``kernel(*arguments, lo, hi)`` for every range; the sum of what the calls return."""
        if not self._others:
            return int(kernel(*arguments, *self._first))
        if self._pool is None:
            self._pool = ThreadPoolExecutor(len(self._others), thread_name_prefix="mbn_marl")
        rest = [self._pool.submit(kernel, *arguments, lo, hi) for lo, hi in self._others]
        return int(kernel(*arguments, *self._first)) + sum(future.result() for future in rest)
